"""Whether a trial on the simulated device failed because this computer was too busy, not because of the arm.

Each simulator measures how long it was not run and how long it got no command. Its arm, motors and bus are programs on
this computer, so a long gap means that the computer ran other programs instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from exo_gravity.core.faults import FaultCode

LONG_GAP = 50.0  # ms; a simulated device loses time after such a stall
ADVICE = "Close other programs and try again. The arm has no fault."

Status = Mapping[str, Mapping[str, Any]]  # of each node on /diagnostics, as in the recorder's live lines


def fault_of(status: Status) -> tuple[str, str]:
    """Return code and message of the first latched fault of a bridge, ('', '') if there is none."""
    for name, values in status.items():
        if values.get("fault", "none") != "none":
            return str(values["fault"]), f"{name}: {values['message']}"
    return "", ""


def too_busy(status: Status) -> str:
    """Return which simulated device or bridge was not run for how long, or ''.

    status: of all nodes, at the end of a trial that failed. A simulated fault explains a failure by itself.
    """
    simulators = {name: values for name, values in status.items() if "longest stall (ms)" in values}
    if any(values["disconnected"] == "yes" for values in simulators.values()):
        return ""
    for name, values in simulators.items():
        stall, silence = float(values["longest stall (ms)"]), float(values["longest silence (ms)"])
        if stall >= LONG_GAP:
            return f"{name} was not run for {stall:.0f} ms"
        if silence >= LONG_GAP:
            return f"{name.removesuffix('simulator')}can_bridge was not run for {silence:.0f} ms"
    if simulators and fault_of(status)[0] == FaultCode.COMMAND_STALE:
        return "the efforts came too late"
    return ""
