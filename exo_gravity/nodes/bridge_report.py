"""What `can_bridge` tells on /diagnostics: state, fault, limits that act, and how the loop and the wire are doing."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rclpy.node import Node

from exo_gravity.core.rate import Rate
from exo_gravity.core.safety import State
from exo_gravity.core.wire import Load
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.nodes.diagnostics import ERROR, OK, WARN, Diagnostics

RECENT = 2.0  # s for which a limit that acted is still named


class BridgeReport:
    """The report of one bridge. wire: the load of a whole `period` (s)."""

    def __init__(self, node: Node, names: Sequence[str], wire: Load, period: float):
        self._diagnostics = Diagnostics(node)
        self._names = names
        self._load = wire.share * period  # of one cycle, in s of the bus
        self._rate = Rate()

    def send(self, loop: ControlLoop | None, refusal: str, answers: float) -> None:
        """Report on `loop`, None while the node is inactive.

        refusal: the last message that was refused, and why. answers: when the joint states were taken that the newest
        efforts answer, monotonic s.
        """
        if loop is None:
            self._diagnostics.report(WARN, "inactive")
            return
        now, safety = time.monotonic(), loop.safety
        acting = ", ".join(sorted(limit for limit, when in tuple(safety.acted.items()) if when > now - RECENT))
        rate = self._rate.update(now, loop.cycles)
        values = {
            "state": safety.state.value,
            "fault": safety.fault.code if safety.fault else "none",
            "limits acting": acting or "none",
            "rate (Hz)": f"{rate:.1f}",
            "bus load (%)": f"{100.0 * self._load * rate:.0f}",
            "age of efforts (ms)": f"{1000.0 * (now - answers):.1f}",
            "cycles": loop.cycles,
            "late cycles": loop.late,
            "incomplete cycles": loop.incomplete,
            "frames ignored": ", ".join(f"{kind}: {n}" for kind, n in sorted(loop.ignored.items())) or "none",
            "last refused message": refusal,
        }
        for name, joint in zip(self._names, loop.samples, strict=True):
            values[f"{name} temperature (degC)"] = joint.temperature
        self._diagnostics.report(*_headline(loop, acting), values)


def _headline(loop: ControlLoop, acting: str) -> tuple[bytes, str]:
    safety = loop.safety
    if safety.fault:
        return ERROR, f"{safety.state.value}: {safety.fault.code}: {safety.fault.reason}"
    if safety.state is State.CHECKING:
        return WARN, f"checking: waiting for {safety.waiting_for}"
    return (WARN, f"{safety.state.value}, limited by {acting}") if acting else (OK, safety.state.value)
