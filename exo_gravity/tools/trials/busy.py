"""Whether a trial on the simulated device failed because this computer was too busy, not because of the arm.

Each simulator measures how long it was not run and how long it got no command. Its arm, motors and bus are programs on
this computer, so a long gap means that the computer ran other programs instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from exo_gravity.core.safety.drive import FaultCode

LONG_GAP = 50.0  # ms; a simulated device loses time after such a stall
# Faults that a busy computer can cause; '' stands for a trial that ended early without a fault.
POSSIBLE = (
    "",
    FaultCode.MOTOR_SILENT.value,
    FaultCode.COMMAND_STALE.value,
    FaultCode.COMMAND_WITHDRAWN.value,
    FaultCode.SIGN_UNPROVEN.value,
)
# A connected simulated motor always replies and the compensator always answers: if they are late, the computer is.
LATE = {
    FaultCode.MOTOR_SILENT.value: "the replies of the simulated motors came too late",
    FaultCode.COMMAND_STALE.value: "the efforts came too late",
}
ADVICE = "Close other programs and try again. The arm has no fault."

Status = Mapping[str, Mapping[str, Any]]  # of each node on /diagnostics, as in the recorder's live lines


def fault_of(status: Status) -> tuple[str, str]:
    """Return the code and the message of the first fault that a bridge reports, or ('', '')."""
    for name, values in status.items():
        if values.get("fault", "none") != "none":
            return str(values["fault"]), f"{name}: {values['message']}"
    return "", ""


def too_busy(status: Status) -> str:
    """Return what was late and, if it is known, by how much; '' if the simulated device ran in time.

    status: of all nodes, after a trial that ended early. A simulated fault is a reason by itself.
    """
    simulators = {name: values for name, values in status.items() if "longest stall (ms)" in values}
    code, _ = fault_of(status)
    if code not in POSSIBLE or any(values["disconnected"] == "yes" for values in simulators.values()):
        return ""
    for name, values in simulators.items():
        stall, silence = float(values["longest stall (ms)"]), float(values["longest silence (ms)"])
        if stall >= LONG_GAP:
            return f"{name} was not run for {stall:.0f} ms"
        if silence >= LONG_GAP:
            return f"{name.removesuffix('simulator')}can_bridge was not run for {silence:.0f} ms"
    return LATE.get(code, "") if simulators else ""
