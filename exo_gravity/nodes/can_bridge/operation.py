# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How `can_bridge` is operated: its services enable, clear_fault, resume, confirm_pose and set_zero; /diagnostics.

Each service runs on the control thread between two cycles, and the executor does not wait for it: a request to let the
arm down never waits behind others, and ends those that would arm it. A request that would arm the arm is refused once
it is older than REQUEST_LIFE: its sender no longer expects it to be carried out. One that lets the arm down is
carried out at any age. Who holds control is a lease (core/safety/lease.py).
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent import futures
from functools import partial
from typing import Any

from diagnostic_msgs.msg import KeyValue
from rcl_interfaces.msg import ParameterDescriptor, ParameterType
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool, Trigger

from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.joint_motor import (
    REPLY_SHARE,
    SIMULATED_BUSES,
    JointMotor,
    JointSample,
    Traffic,
    source_of_bus,
)
from exo_gravity.core.numbers import Rate
from exo_gravity.core.safety.command import Efforts, FaultCode, State
from exo_gravity.core.safety.lease import Lease
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.core.safety.start import at_least, turns_back
from exo_gravity.core.vocabulary import INACTIVE, NO_REASON, NONE, UNKNOWN, Answer, BridgeWarning, Status, words
from exo_gravity.hardware.can_port import ArmOnBus, serial_of
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.hardware.network import open_to_others
from exo_gravity.nodes.ros.inner import Until, wake, why_too_old
from exo_gravity.nodes.ros.messages import (
    ERROR,
    HELD_BY,
    NO_POSE,
    NOBODY,
    OK,
    POSE_TO_CONFIRM,
    WARN,
    Diagnostics,
    milliseconds,
    row,
)
from exo_gravity.nodes.ros.subscriptions import MANY_REQUESTS, PolledSubscription

RECENT = 2.0  # s for which a limit that acted is still shown
SLOW = 0.9  # share of the set rate below which the loop is slow
REQUESTS = 32  # of control, that wait for the next look
WATCH_PERIOD = 0.1  # s between two looks at them
CALL_TIMEOUT = 2.0  # s that a service waits for the control thread

# What follows a request that was carried out, by the state that it led to.
FOLLOWS = {
    State.CHECKING: "torque follows in 5 s, at the first start in 10 s; if not, /diagnostics says what is missing",
    State.LETTING_DOWN: "the motors are switched off once the arm is down; /diagnostics shows the state",
}
MOTOR_UNREACHED = "a motor that was on does not reply and may still be powered, unless its supply is cut: cut it"
THERMAL_TIME = 60.0  # s; an assumption for motors of this size: the data sheets state none


def refuse_simulated_time(node: Node, interface: str) -> None:
    """Refuse `use_sim_time`, now and live, unless the python-can `interface` leads to a simulated device.

    Efforts are as old as the joint states whose stamp they carry: a clock that stops would hide a dead compensator.
    Raises ParameterError.
    """
    if interface in SIMULATED_BUSES:
        return
    why = f"with a real bus (can.interface {interface}): it stamps the joint states with a clock that can stop"
    if node.get_parameter("use_sim_time").value:
        raise ParameterError("use_sim_time", True, f"false {why}")
    fixed = ParameterDescriptor(type=ParameterType.PARAMETER_BOOL, description=f"always false {why}", read_only=True)
    node.set_descriptor("use_sim_time", fixed)


class BridgeServices:
    """Creates the services on `node`.

    get_loop: returns the present control loop, None while the node is inactive.
    refusal: returns why the arm may not be armed now; '' if it may.
    last: the request that was answered last, and the Answer.

    Each method below, on the control thread, does what its service is for and returns why it is refused, or ''.
    """

    def __init__(
        self,
        node: Node,
        get_loop: Callable[[], ControlLoop | None],
        motors: Sequence[JointMotor],
        refusal: Callable[[], str],
    ) -> None:
        self.last: tuple[str, str] = NONE, Answer.NONE
        self._node = node
        self._get_loop = get_loop
        self._refusal = refusal
        self._arming: set[futures.Future[str]] = set()  # requests that are not yet carried out
        self._motors = tuple(motors)
        # A callback that waits keeps no other waiting
        serve = partial(node.create_service, qos_profile=MANY_REQUESTS, callback_group=ReentrantCallbackGroup())
        serve(SetBool, "~/enable", partial(self.answer, self.enable))
        for function in (self.clear_fault, self.resume, self.confirm_pose, self.set_zero):
            serve(Trigger, f"~/{function.__name__}", partial(self.answer, function))

    def enable(self, loop: ControlLoop, request: SetBool.Request) -> str:
        """Enable the arm, or let it down and disable it."""
        safety = loop.safety
        if not request.data:
            safety.disable(time.monotonic())
        elif not safety.enable(time.monotonic()):
            reason = f" ({safety.fault.reason})" if safety.fault else ""
            return f"refused: the arm's state is {safety.state.value}{reason}"
        return ""

    def clear_fault(self, loop: ControlLoop, _request: Trigger.Request) -> str:
        """Clear a latched fault."""
        return "" if loop.safety.clear(time.monotonic()) else f"no fault to clear: the arm is {loop.safety.state.value}"

    def resume(self, loop: ControlLoop, _request: Trigger.Request) -> str:
        """Clear a fault that leaves nothing to repair, and enable the arm where it is."""
        why_not = loop.safety.why_not_resumed
        return "" if loop.safety.resume(time.monotonic()) else f"refused: {why_not}"

    def confirm_pose(self, loop: ControlLoop, _request: Trigger.Request) -> str:
        """Take the operator's word that the arm hangs as it is drawn, for the start that waits for it."""
        return loop.safety.confirm_pose(time.monotonic())

    def set_zero(self, loop: ControlLoop, _request: Trigger.Request) -> str:
        """Return what to write instead: some firmware forgets a zero that is set over the bus with its power."""
        if any(not math.isfinite(joint.position) for joint in loop.samples):
            return "refused: motors may forget a zero that is set over the bus; write zero: in the file, once all reply"
        columns = zip(self._motors, loop.samples, strict=True)
        zeros = ", ".join(f"{motor.motor_position(joint.position):.4f}" for motor, joint in columns)
        return (
            "refused: motors may forget a zero that is set over the bus when their power goes. To make the present "
            f"angles 0, write zero: [{zeros}] for can_bridge in the parameter file, and start again"
        )

    async def answer(self, function: Callable[[ControlLoop, Any], str], request: Any, response: Any) -> Any:
        """Run `function` on the control thread, and fill the response."""
        loop, lets_down = self._get_loop(), function == self.enable and not request.data
        if loop is None:
            why_not = Status(Answer.INACTIVE, "the node is not active")
        else:
            why_not = await self._carry_out(loop, function, request, lets_down)
        self.last = "let_down" if lets_down else function.__name__, why_not.code
        response.success, response.message = not why_not, str(why_not)
        if loop is not None and response.success:
            response.message = FOLLOWS.get(loop.safety.state, "")
            if function == self.confirm_pose:
                response.message = f"confirmed (degrees): {loop.safety.pose.text}; {response.message}"
        return response

    async def _carry_out(
        self, loop: ControlLoop, function: Callable[[ControlLoop, Any], str], request: Any, lets_down: bool
    ) -> Status:
        """Run `function` on the control thread; return why it was not carried out, false if it was.

        A call that has timed out never runs later: an arm must not be enabled after its operator was refused.
        """
        if lets_down:
            for waiting in tuple(self._arming):
                waiting.cancel()
        elif too_old := why_too_old(self._node):
            return Status(Answer.TOO_OLD, too_old)
        elif refusal := self._refusal():
            return Status(Answer.LEAVING, refusal)
        future = loop.call(lambda: function(loop, request))
        if not lets_down:
            self._arming.add(future)
        future.add_done_callback(lambda _: wake(self._node))
        await Until(future.done, CALL_TIMEOUT)
        self._arming.discard(future)
        try:
            refusal = future.result(0.0)
        except BusError as error:
            return Status(Answer.BUS_ERROR, str(error))
        except futures.CancelledError:
            return Status(Answer.OVERTAKEN, "refused: the arm was asked to be let down")
        except futures.TimeoutError:  # before Python 3.11 not the built-in one
            future.cancel()
            return Status(Answer.NO_RESPONSE, "the control thread did not respond")
        return Status(Answer.REFUSED if refusal else Answer.DONE, refusal)


class Operator:
    """Who holds control of the arm, by the topic `~/control`: a KeyValue of a name, and hold, take or release.

    get_loop returns the present control loop, None while the node is inactive. lease: the holder. It is renewed several
    times a second. Messages wait until `watch`, ten times a second: a flood of them costs nothing, and at most lets the
    arm down.
    """

    def __init__(self, node: Node, get_loop: Callable[[], ControlLoop | None], clock: Clock = COMPUTER_CLOCK) -> None:
        self.lease = Lease()
        self._get_loop = get_loop
        self._now = clock.monotonic
        self._log = node.get_logger()
        self._news = ""  # for the log, which a flood must not fill
        self._requests = PolledSubscription(node, KeyValue, "~/control", self._on_request, QoSProfile(depth=REQUESTS))
        node.create_timer(WATCH_PERIOD, self.watch)

    def watch(self) -> None:
        """Do what was asked for, and let the arm down if its operator is gone."""
        self._requests.poll()
        if self._news:
            self._log.info(self._news)
            self._news = ""
        reason, loop = self.lease.lost(self._now()), self._get_loop()
        if reason:
            self._log.warning(reason)
        if reason and loop is not None and loop.safety.state is not State.LETTING_DOWN:
            loop.trip(FaultCode.CONTROL_LOST, reason)

    def _on_request(self, message: KeyValue, _info: dict[str, Any]) -> None:
        self._news = self.lease.request(self._now(), message.key, message.value) or self._news


def log_risks(node: Node, interface: str, traffic: Mapping[str, Traffic], rate: float) -> None:
    """Log the load of each bus at `rate` (Hz), its adapter, and whether other hosts can command the arm."""
    log = node.get_logger()
    for name, bus in traffic.items():
        if serial := serial_of(interface, name):
            log.info(f"the adapter of {name} has the serial number {serial}: can.serial binds the bus to it")
        log.info(
            f"bus load of {name} at {rate:g} Hz: {bus.load(rate):.0%} of {bus.bitrate / 1000:g} kbit/s, "
            f"{bus.load(rate, worst=True):.0%} at worst; the bus is full at {int(bus.largest_rate)} Hz"
        )
        if bus.is_crowded(rate):
            fitting = int(REPLY_SHARE * bus.largest_rate)
            log.warning(f"replies on {name} may be late at {rate:g} Hz: at most {fitting} Hz leave them time")
    if opening := open_to_others():
        log.warning(f"{opening}: other hosts can command this arm; unset it, or enforce SROS2")


class MotorLoad:
    """The load of the motors over minutes: RMS torque and power of each joint's motor, which starts cold.

    A motor's heat grows with the square of its torque, so the mean square is averaged over THERMAL_TIME. rated: (n,)
    Nm, which the motors bear for any time.
    """

    def __init__(self, rated: Sequence[float]) -> None:
        self._rated = tuple(rated)
        self._mean_square = [0.0] * len(self._rated)  # Nm^2
        self._time = math.inf

    def update(self, now: float, joints: Sequence[JointSample]) -> list[tuple[float, float, float]]:
        """Add the readings `joints` (n,), the newest at `now` s, and return three figures of each motor.

        They are power (W, > 0 where the motor drives), RMS torque (Nm), and its share of rated torque: above 1 the
        motor overheats if the load stays. Ten a second are enough. A motor that never replied adds nothing.
        """
        share = -math.expm1(-max(0.0, now - self._time) / THERMAL_TIME)
        self._time = now
        loads = []
        for i, joint in enumerate(joints):
            if joint.time > -math.inf:
                self._mean_square[i] += share * (joint.effort**2 - self._mean_square[i])
            power = joint.effort * joint.velocity if joint.time > -math.inf else 0.0
            rms = math.sqrt(self._mean_square[i])
            loads.append((power, rms, rms / self._rated[i]))
        return loads


class BridgeReport:
    """The status of one bridge, with its keys for programs. lease: of control. services: what was asked for last."""

    def __init__(
        self, node: Node, arm: ArmOnBus, traffic: Mapping[str, Traffic], lease: Lease, services: BridgeServices
    ) -> None:
        self._diagnostics = Diagnostics(node)
        self._limits, self._names = arm.limits, arm.limits.joint_names
        self._source = source_of_bus(*arm.address[:2])
        self._lease, self._services = lease, services
        self._traffic = traffic
        self._rate = Rate()
        self._slow = SLOW / arm.period  # Hz
        self._warmed = [motor.warmed for motor in arm.motors]
        self._motors = MotorLoad([motor.rated_effort for motor in arm.motors])
        names = zip(self._names, arm.motors, strict=True)
        self._without_timeout = words(*[name for name, motor in names if not motor.timeout])

    def send(self, loop: ControlLoop | None, newest: Efforts, refusal: Status, error: str) -> None:
        """Report on `loop`, None while the node is inactive.

        refusal: why the last message was refused. error: why the last transition failed, ''.
        """
        request, answer = self._services.last
        operator = {HELD_BY: self._lease.holder or NOBODY, "request": request, "answer": answer}
        if loop is None:
            why = error or "enable it on the page, or configure and activate it"
            self._diagnostics.report(
                WARN, f"{INACTIVE}: {why}", {"state": INACTIVE, "source": self._source, **operator}
            )
            return
        now, safety = time.monotonic(), loop.safety
        fault, resume = safety.fault, safety.why_not_resumed  # read once: the control thread goes on
        acting, damping = (
            words(*sorted(name for name, acted in tuple(last.items()) if name and acted > now - RECENT))
            for last in (safety.acted, safety.damped)
        )
        rate = self._rate.update(now, loop.cycles)
        samples = loop.samples
        loads = self._motors.update(now, samples)
        hot = [name for name, (_, _, share) in zip(self._names, loads, strict=True) if share > 1.0]
        warnings: dict[BridgeWarning, str] = {}
        if acting != NONE:
            warnings[BridgeWarning.LIMITED] = f"limited by {acting}"
        if now - safety.stale.seen < RECENT:
            warnings[BridgeWarning.LATE_EFFORTS] = f"still used: {safety.stale.why}"
        if hot:
            warnings[BridgeWarning.ABOVE_RATED_TORQUE] = f"above rated torque for too long: {', '.join(hot)}"
        if odd := loop.bus.boards.odd_temperature:
            warnings[BridgeWarning.ODD_TEMPERATURE] = odd
        if 0.0 < rate < self._slow:
            warnings[BridgeWarning.SLOW_LOOP] = f"slower than {self._slow:.0f} Hz"
        values: dict[str, object] = {
            "state": safety.state.value,
            "source": self._source,
            "motors": safety.motors,
            "fault": fault.code if fault else NONE,
            "fault joint": (fault and fault.joint) or NONE,
            "fault text": fault.reason if fault else "",
            **self._start(safety, samples),
            "resume": resume.code,
            "resume text": resume,
            **operator,
            "warnings": words(*warnings),
            "limits acting": acting,
            "damped by": damping,
            "joints above rated torque": words(*hot),
            "rate (Hz)": f"{rate:.1f}",
            "bus load (%)": row([100.0 * bus.load(rate) if rate else 0.0 for bus in self._traffic.values()], 0),
            "age of efforts (ms)": milliseconds(now - newest.answered),
            "rides": safety.stale.count,
            "cycles": loop.cycles,
            "late cycles": loop.late,
            "incomplete cycles": loop.incomplete,
            "temperatures when switched on": "implausible" if odd else "plausible",
            "frames ignored": words(*[f"{kind}: {n}" for kind, n in sorted(dict(loop.bus.ignored).items())]),
            "motors without time-out": self._without_timeout,
            "publishing errors": loop.cycle_errors,
            "publishing error text": loop.cycle_error if loop.cycle_errors else "",
            "refused message": refusal.code,
            "refused message text": refusal,
        }
        for name, joint, warmed, (power, rms, share) in zip(self._names, samples, self._warmed, loads, strict=True):
            temperature = joint.temperature
            values |= {
                f"{name} temperature (degC)": UNKNOWN if temperature is None else temperature,
                f"{name} torque by temperature (%)": (
                    UNKNOWN if temperature is None else row([100.0 * warmed(temperature)], 1)
                ),
                f"{name} torque (Nm)": row([joint.effort], 2),
                f"{name} power (W)": row([power], 1),
                f"{name} RMS torque (Nm)": row([rms], 2),
                f"{name} RMS of rated torque (%)": row([100.0 * share], 0),
            }
        self._diagnostics.report(*_headline(loop, ", ".join(warnings.values())), values)

    def _start(self, safety: SafetyMachine, samples: Sequence[JointSample]) -> dict[str, object]:
        """Return the keys of the present start, and of the last one that was refused."""
        waiting = safety.waiting_for if safety.state in (State.CHECKING, State.PROVING) else NO_REASON
        turns = {n: turn for n, turn in turns_back(self._limits, samples).items() if math.isfinite(turn)}
        pose = [math.degrees(angle) for angle in safety.pose.asked]
        return {
            "waiting for": waiting.code,
            "waiting text": waiting,
            "signs proven (%)": row([100.0 * safety.signs.progress], 0),
            "refusal": safety.refusal.code,
            "refusal text": safety.refusal,
            "joints outside limits": words(*[self._names[n] for n in turns]),
            "turn back (deg)": words(*map(at_least, turns.values())),
            POSE_TO_CONFIRM: row(pose, 0) if pose else NO_POSE,
        }


def _headline(loop: ControlLoop, warnings: str) -> tuple[bytes, str]:
    safety = loop.safety
    if loop.failure:
        return ERROR, f"the control thread has ended: {loop.failure}"
    if safety.is_unreached:
        return ERROR, f"{safety.state.value}: {MOTOR_UNREACHED}"
    if safety.fault:
        return ERROR, f"{safety.state.value}: {safety.fault.code}: {safety.fault.reason}"
    if safety.state is State.CHECKING:
        return WARN, f"checking: waiting for {safety.waiting_for}"
    if safety.refusal:
        return WARN, f"{safety.state.value}: {safety.refusal}"
    return (WARN, f"{safety.state.value}, {warnings}") if warnings else (OK, safety.state.value)
