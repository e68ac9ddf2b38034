"""What `can_bridge` tells: in its log what it starts with, on /diagnostics state, fault, limits, loop and wire."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rclpy.node import Node

from exo_gravity.core.limits import Limits
from exo_gravity.core.rate import Rate
from exo_gravity.core.safety import State
from exo_gravity.core.wire import Load, load
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.nodes.diagnostics import ERROR, OK, WARN, Diagnostics
from exo_gravity.nodes.run import open_to_others

RECENT = 2.0  # s for which a limit that acted is still named


def introduce(node: Node, limits: Limits, wire: Load, rate: float) -> None:
    """Log what the arm will be held to, what `rate` (Hz) asks of the wire, and who else could command the arm."""
    log = node.get_logger()
    efforts = ", ".join(f"{effort:g}" for effort in limits.max_effort)
    log.info(
        f"at most {efforts} Nm, {limits.max_effort_rate:g} Nm/s, {max(limits.max_velocity):g} rad/s, "
        f"{limits.max_temperature:g} degC; efforts no older than {limits.command_timeout * 1000:.0f} ms"
    )
    worst = load(rate, len(limits.joint_names), worst=True)
    log.info(
        f"{rate:g} Hz load the bus with {wire.bits_per_second / 1000:.0f} kbit/s, {wire.share:.0%} of it, "
        f"{worst.share:.0%} at worst; {int(wire.largest_rate)} Hz would fill it"
    )
    opening = open_to_others()
    if opening:
        log.warning(f"{opening}: other hosts can command this arm; set LOCALHOST, or enforce SROS2")


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
