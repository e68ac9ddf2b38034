"""What `can_bridge` reports: its limits in the log at the start; state, fault, loop and bus load on /diagnostics."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rclpy.node import Node

from exo_gravity.core.motors.bus_load import Traffic
from exo_gravity.core.rate import Rate
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.motor_load import MotorLoad
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.nodes.ros.messages import ERROR, OK, WARN, Diagnostics, milliseconds, row
from exo_gravity.nodes.ros.run import open_to_others

RECENT = 2.0  # s for which a limit that acted is still shown
SLOW = 0.9  # share of the set rate below which the loop counts as slow


def log_limits(node: Node, limits: Limits, traffic: Traffic, rate: float) -> None:
    """Log the limits, the bus load at `rate` (Hz), and whether other hosts can command the arm."""
    log = node.get_logger()
    efforts = ", ".join(f"{effort:g}" for effort in limits.max_effort)
    log.info(
        f"limits: {efforts} Nm, {limits.max_effort_rate:g} Nm/s, {max(limits.max_velocity):g} rad/s, "
        f"{limits.max_temperature:g} degC, effort commands at most {limits.command_timeout * 1000:.0f} ms old"
    )
    wire, worst = traffic.load(rate), traffic.load(rate, worst=True)
    log.info(
        f"bus load at {rate:g} Hz: {wire.bits_per_second / 1000:.0f} of {traffic.bitrate / 1000:g} kbit/s, "
        f"{wire.share:.0%} of the bus, {worst.share:.0%} at worst; the bus is full at {int(wire.largest_rate)} Hz"
    )
    if warning := traffic.warning(rate):
        log.warning(warning)
    opening = open_to_others()
    if opening:
        log.warning(f"{opening}: other hosts can command this arm; unset it, or enforce SROS2")


class BridgeReport:
    """The status of one bridge.

    period: s of a cycle. rated: (4,) Nm, the motors' rated torque at the joints.
    """

    def __init__(
        self, node: Node, names: Sequence[str], traffic: Traffic, period: float, rated: Sequence[float]
    ) -> None:
        self._diagnostics = Diagnostics(node)
        self._names = names
        self._traffic = traffic
        self._rate = Rate()
        self._slow = SLOW / period  # Hz
        self._motors = MotorLoad(rated)

    def send(self, loop: ControlLoop | None, refusal: str, answered: float) -> None:
        """Report on `loop`, None while the node is inactive.

        refusal: why the last message was refused. answered: monotonic s, when the joint states were measured that the
        newest efforts answer.
        """
        if loop is None:
            self._diagnostics.report(WARN, "inactive")
            return
        now, safety = time.monotonic(), loop.safety
        acting = ", ".join(
            sorted(limit for limit, time_acted in tuple(safety.acted.items()) if time_acted > now - RECENT)
        )
        rate = self._rate.update(now, loop.cycles)
        self._motors.update(now, loop.samples)
        values: dict[str, object] = {
            "state": safety.state.value,
            "fault": safety.fault.code if safety.fault else "none",
            "limits acting": acting or "none",
            "rate (Hz)": f"{rate:.1f}",
            "bus load (%)": f"{100.0 * self._traffic.load(rate).share:.0f}" if rate else "0",
            "age of efforts (ms)": milliseconds(now - answered),
            "cycles": loop.cycles,
            "late cycles": loop.late,
            "incomplete cycles": loop.incomplete,
            "frames ignored": ", ".join(f"{kind}: {n}" for kind, n in sorted(loop.ignored.items())) or "none",
            "publishing errors": f"{loop.cycle_errors}, last: {loop.cycle_error}" if loop.cycle_errors else "none",
            "last refused message": refusal,
        }
        values |= self._of_joints(loop)
        warnings = [f"limited by {acting}"] if acting else []
        hot = [name for name, share in zip(self._names, self._motors.share, strict=True) if share > 1.0]
        if hot:
            warnings.append(f"above rated torque for too long: {', '.join(hot)}")
        if 0.0 < rate < self._slow:
            warnings.append(f"slower than {self._slow:.0f} Hz")
        self._diagnostics.report(*_headline(loop, ", ".join(warnings)), values)

    def _of_joints(self, loop: ControlLoop) -> dict[str, object]:
        values: dict[str, object] = {}
        columns = self._names, loop.samples, self._motors.power, self._motors.rms, self._motors.share
        for name, joint, power, rms, share in zip(*columns, strict=True):
            values[f"{name} temperature (degC)"] = joint.temperature
            values[f"{name} torque (Nm)"] = row([joint.effort], 2)
            values[f"{name} power (W)"] = row([power], 1)
            values[f"{name} RMS torque (Nm)"] = row([rms], 2)
            values[f"{name} RMS of rated torque (%)"] = row([100.0 * share], 0)
        return values


def _headline(loop: ControlLoop, warnings: str) -> tuple[bytes, str]:
    safety = loop.safety
    if loop.failure:
        return ERROR, f"the control thread has ended: {loop.failure}"
    if safety.is_unreached:
        return ERROR, f"{safety.state.value}: a motor does not reply and may still be powered: cut the motors' supply"
    if safety.fault:
        return ERROR, f"{safety.state.value}: {safety.fault.code}: {safety.fault.reason}"
    if safety.state is State.CHECKING:
        return WARN, f"checking: waiting for {safety.waiting_for}"
    return (WARN, f"{safety.state.value}, {warnings}") if warnings else (OK, safety.state.value)
