"""How `can_bridge` is operated: the services enable, clear_fault and set_zero; its limits in the log; /diagnostics.

Each service runs on the control thread between two cycles.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent import futures
from typing import TypeVar

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.bus_load import Traffic
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.numbers import Rate
from exo_gravity.core.safety.delivery import MotorLoad
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import MAX_EFFORT_RATE, MAX_TEMPERATURE, Limits
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.nodes.ros.messages import ERROR, OK, WARN, Diagnostics, milliseconds, row
from exo_gravity.nodes.ros.run import open_to_others

RECENT = 2.0  # s for which a limit that acted is still shown
SLOW = 0.9  # share of the set rate below which the loop is slow
ZERO_TOLERANCE = 0.02  # rad that a motor may report after set_zero
ZERO_TIMEOUT = 3.0  # s; motors are silent for up to 1.5 s while they write their memory
CALL_TIMEOUT = 2.0  # s that a service waits for the control thread

UNREACHED = "a motor that was on does not reply and may still be powered, unless its supply is cut: cut it"

Response = TypeVar("Response", SetBool.Response, Trigger.Response)


class BridgeServices:
    """Creates the services on `node`. get_loop returns the present control loop, None while the node is inactive."""

    def __init__(self, node: Node, get_loop: Callable[[], ControlLoop | None], motors: Sequence[JointMotor]) -> None:
        self._get_loop = get_loop
        self._zero = [motor.zero for motor in motors]
        node.create_service(SetBool, "~/enable", self.enable)
        node.create_service(Trigger, "~/clear_fault", self.clear_fault)
        node.create_service(Trigger, "~/set_zero", self.set_zero)

    def enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Enable the arm, or let it down and disable it."""

        def switch(loop: ControlLoop) -> str:
            safety = loop.safety
            if not request.data:
                safety.disable(time.monotonic())
            elif not safety.enable(time.monotonic()):
                reason = f" ({safety.fault.reason})" if safety.fault else ""
                return f"refused: the arm is {safety.state.value}{reason}"
            return ""

        return self._on_control_thread(switch, response)

    def clear_fault(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Clear a latched fault."""

        def clear(loop: ControlLoop) -> str:
            safety = loop.safety
            return "" if safety.clear(time.monotonic()) else f"no fault to clear: the arm is {safety.state.value}"

        return self._on_control_thread(clear, response)

    def set_zero(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Make the present pose the motors' zero, while they are off."""
        since = time.monotonic()
        self._on_control_thread(self._set_zero, response)
        loop = self._get_loop()
        if not response.success or loop is None:
            return response
        while not all(joint.time > since and abs(joint.position) <= ZERO_TOLERANCE for joint in loop.samples):
            if time.monotonic() > since + ZERO_TIMEOUT:
                columns = zip(loop.safety.limits.joint_names, loop.samples, strict=True)
                positions = ", ".join(f"{name} at {joint.position:.3f} rad" for name, joint in columns)
                response.success, response.message = False, f"the motors did not set their zero: {positions}"
                break
            time.sleep(0.005)
        return response

    def _set_zero(self, loop: ControlLoop) -> str:
        safety = loop.safety
        if any(self._zero):
            return f"zero = {self._zero}: must be all 0 when the motors store the zero"
        if safety.state is not State.DISABLED:
            return f"refused: the arm is {safety.state.value}, must be disabled"
        now = time.monotonic()
        if any(safety.limits.is_silent(now, joint) for joint in loop.samples):
            return "refused: a motor does not reply"
        if not safety.settled(now):
            return "refused: the arm is not at rest"
        loop.set_zero()
        return ""

    def _on_control_thread(self, function: Callable[[ControlLoop], str], response: Response) -> Response:
        """Run `function` on the control thread; it returns an error text, or ''.

        A call that has timed out never runs later: an arm must not be enabled after its operator was refused.
        """
        loop = self._get_loop()
        if loop is None:
            response.success, response.message = False, "the node is not active"
            return response
        future = loop.call(lambda: function(loop))
        try:
            response.message = future.result(CALL_TIMEOUT)
        except BusError as error:
            response.message = str(error)
        except futures.TimeoutError:  # before Python 3.11 not the built-in one
            future.cancel()
            response.message = "the control thread did not respond"
        response.success = not response.message
        return response


def log_limits(node: Node, limits: Limits, traffic: Traffic, rate: float) -> None:
    """Log the limits, the bus load at `rate` (Hz), and whether other hosts can command the arm."""
    log = node.get_logger()
    efforts = ", ".join(f"{effort:g}" for effort in limits.max_effort)
    log.info(
        f"limits: {efforts} Nm, {MAX_EFFORT_RATE:g} Nm/s, {max(limits.max_velocity):g} rad/s, "
        f"{MAX_TEMPERATURE:g} degC, effort commands at most {limits.command_timeout * 1000:.0f} ms old"
    )
    wire, worst = traffic.load(rate), traffic.load(rate, worst=True)
    log.info(
        f"bus load at {rate:g} Hz: {wire.bits_per_second / 1000:.0f} of {traffic.bitrate / 1000:g} kbit/s, "
        f"{wire.share:.0%} of the bus, {worst.share:.0%} at worst; the bus is full at {int(wire.largest_rate)} Hz"
    )
    if warning := traffic.warning(rate):
        log.warning(warning)
    if opening := open_to_others():
        log.warning(f"{opening}: other hosts can command this arm; unset it, or enforce SROS2")


class BridgeReport:
    """The status of one bridge.

    rate: Hz, as set. rated: (4,) Nm, the motors' rated torque at the joints.
    """

    def __init__(self, node: Node, names: Sequence[str], traffic: Traffic, rate: float, rated: Sequence[float]) -> None:
        self._diagnostics = Diagnostics(node)
        self._names = names
        self._traffic = traffic
        self._rate = Rate()
        self._slow = SLOW * rate  # Hz
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
        acting = ", ".join(sorted(limit for limit, acted in tuple(safety.acted.items()) if acted > now - RECENT))
        rate = self._rate.update(now, loop.cycles)
        self._motors.update(now, loop.samples)
        values: dict[str, object] = {
            "state": safety.state.value,
            "fault": safety.fault.code if safety.fault else "none",
            "refusal": safety.refusal or "none",
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
        columns = self._names, loop.samples, self._motors.power, self._motors.rms, self._motors.share
        for name, joint, power, rms, share in zip(*columns, strict=True):
            values[f"{name} temperature (degC)"] = joint.temperature
            values[f"{name} torque (Nm)"] = row([joint.effort], 2)
            values[f"{name} power (W)"] = row([power], 1)
            values[f"{name} RMS torque (Nm)"] = row([rms], 2)
            values[f"{name} RMS of rated torque (%)"] = row([100.0 * share], 0)
        warnings = [f"limited by {acting}"] if acting else []
        hot = [name for name, share in zip(self._names, self._motors.share, strict=True) if share > 1.0]
        if hot:
            warnings.append(f"above rated torque for too long: {', '.join(hot)}")
        if 0.0 < rate < self._slow:
            warnings.append(f"slower than {self._slow:.0f} Hz")
        self._diagnostics.report(*_headline(loop, ", ".join(warnings)), values)


def _headline(loop: ControlLoop, warnings: str) -> tuple[bytes, str]:
    safety = loop.safety
    if loop.failure:
        return ERROR, f"the control thread has ended: {loop.failure}"
    if safety.is_unreached:
        return ERROR, f"{safety.state.value}: {UNREACHED}"
    if safety.fault:
        return ERROR, f"{safety.state.value}: {safety.fault.code}: {safety.fault.reason}"
    if safety.state is State.CHECKING:
        return WARN, f"checking: waiting for {safety.waiting_for}"
    if safety.refusal:
        return WARN, f"{safety.state.value}: {safety.refusal}"
    return (WARN, f"{safety.state.value}, {warnings}") if warnings else (OK, safety.state.value)
