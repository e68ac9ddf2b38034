"""can_bridge: CAN motors -> `joint_states`, `effort_commands` -> CAN, through the safety machine.

A control thread runs the bus (hardware/control_loop.py). Efforts carry the stamp of the joint state that they answer.
The bridge remembers when, on the monotonic clock, each stamped state was measured: so the age of an answer does not
depend on the wall clock, and an unknown stamp is refused.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from exo_gravity.core.control_params import CAN_BRIDGE, OPTIONS, limits_of, motors_of
from exo_gravity.core.drive import State
from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.faults import FaultCode
from exo_gravity.core.limits import JointSample
from exo_gravity.core.safety import SafetyMachine
from exo_gravity.core.wire import check_rate
from exo_gravity.hardware.control_loop import NO_COMMAND, ControlLoop, EffortCommand
from exo_gravity.hardware.motor_bus import MotorBus, open_bus
from exo_gravity.hardware.scheduling import request_real_time
from exo_gravity.hardware.watchdog import Charge, Watchdog
from exo_gravity.nodes.bridge_report import BridgeReport, log_limits
from exo_gravity.nodes.conversions import by_name, to_nanoseconds
from exo_gravity.nodes.declare import bus_of, declare
from exo_gravity.nodes.hot_path import HotPath
from exo_gravity.nodes.run import run
from exo_gravity.nodes.sole_publisher import SolePublisher

# The control thread reads them once a cycle; the depth lets it notice a second commander. Not reliable: an old effort
# sent again is useless, and acknowledging each one wakes a thread in both nodes (measured: 2 % of a core).
EFFORTS = QoSProfile(depth=8, reliability=ReliabilityPolicy.BEST_EFFORT)
REMEMBERED = 256  # stamps of joint states: more than command_timeout covers at any rate
REPORT_PERIOD = 0.1  # s
ZERO_TOLERANCE = 0.02  # rad that a motor may report after set_zero
ZERO_TIMEOUT = 3.0  # s; motors are silent for up to 1.5 s while they write their memory
Response = TypeVar("Response", SetBool.Response, Trigger.Response)
CALL_TIMEOUT = 2.0  # s that a service waits for the control thread


class CanBridge(LifecycleNode):
    """The lifecycle node: configure opens the bus, activate starts the loop and arms, deactivate lets the arm down."""

    def __init__(self) -> None:
        super().__init__("can_bridge", automatically_declare_parameters_from_overrides=True)
        values = declare(self, CAN_BRIDGE, free_prefix=OPTIONS)
        self._address = bus_of(self, values)
        self._names = values["joint_names"]
        self._motors = motors_of(values)
        self._limits = limits_of(values)
        self._period = 1.0 / values["rate"]
        self._real_time = values["thread_priority"], values["lock_memory"]
        self._wire = check_rate(values["rate"], len(self._motors))
        self._command = NO_COMMAND  # the newest from the compensator
        self._measured = -math.inf  # monotonic s, when the last published joint state was measured
        self._watchdog = Watchdog()
        self._watchdog.guard(Charge(self._address, self._motors, self._limits, self._period))
        self._bus: MotorBus | None = None
        self._loop: ControlLoop | None = None
        self._published: OrderedDict[int, float] = OrderedDict()
        self._refusal = "none"
        self._commander = SolePublisher()
        self._report_writer = BridgeReport(self, self._names, self._wire, self._period)
        self._publisher = self.create_publisher(JointState, "joint_states", 1)
        self._joint_states = JointState(name=self._names)  # one message, reused
        self._efforts = HotPath(self, JointState, "effort_commands", self._on_efforts, EFFORTS)
        self.create_service(SetBool, "~/enable", self._on_enable)
        self.create_service(Trigger, "~/clear_fault", self._on_clear_fault)
        self.create_service(Trigger, "~/set_zero", self._on_set_zero)
        self.create_timer(REPORT_PERIOD, self._report)
        log_limits(self, self._limits, self._wire, values["rate"])
        if values["autostart"]:
            self._open()
            self.trigger_configure()
            self.trigger_activate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the bus."""
        try:
            self._open()
        except BusError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start the control loop, and enable the arm once it passes the start gate."""
        safety = SafetyMachine(self._limits, self._period)
        loop = ControlLoop(self._open(), safety, self._period, self._publish, get_efforts=self._get_efforts)
        self._bus, self._loop = None, loop  # the bus is now owned by the loop
        loop.call(lambda: safety.enable(time.monotonic()))
        loop.start()
        for refused in request_real_time(*self._real_time):
            self.get_logger().warning(refused)
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the arm down and wait until it is down; the bus stays open for the next activation."""
        self._stop_loop()
        self._open()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the bus."""
        self.close()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the arm down and close the bus."""
        self.close()
        return super().on_shutdown(state)

    def close(self) -> None:
        """Let the arm down, send the last frames and close the bus, in any state."""
        self._stop_loop()
        if self._bus is not None:
            self._bus.stop()
            self._bus = None

    def _open(self) -> MotorBus:
        if self._bus is None:
            self._bus = MotorBus(open_bus(*self._address), self._motors, note=self._watchdog.note)
        return self._bus

    def _stop_loop(self) -> None:
        if self._loop is not None:
            self._loop.stop()
            self._loop = None

    def _get_efforts(self, latest: float) -> EffortCommand:
        """Return the newest efforts; wait until `latest` (monotonic s) for the answer to the last joint state."""
        self._efforts.poll()
        if self._command.answered < self._measured:
            self._efforts.poll(latest - time.monotonic())
        return self._command

    def _publish(self, now: float, joints: Sequence[JointSample]) -> None:
        """Publish a joint state if every motor has replied recently: an unknown angle is never sent as a number."""
        if any(self._limits.is_silent(now, joint) for joint in joints):
            return
        message = self._joint_states
        message.position, message.velocity, message.effort, *_ = zip(*joints, strict=True)
        message.header.stamp = self.get_clock().now().to_msg()
        self._measured = min(joint.time for joint in joints)
        self._published[to_nanoseconds(message.header.stamp)] = self._measured
        if len(self._published) > REMEMBERED:
            self._published.popitem(last=False)
        self._publisher.publish(message)

    def _on_efforts(self, message: JointState, info: dict[str, Any]) -> None:
        loop = self._loop
        if loop is None:
            return
        answered = self._published.get(to_nanoseconds(message.header.stamp))
        if self._commander.is_another(info):
            self._refusal = "a second publisher of effort_commands"
            self._command = EffortCommand(None, time.monotonic())  # fails the start gate
            loop.trip_if_carried(FaultCode.SECOND_COMMANDER, "more than one publisher of effort_commands")
        elif answered is None:
            self._refusal = f"stamp {to_nanoseconds(message.header.stamp)} ns answers no joint state of this bridge"
        else:
            try:
                effort = by_name(message, "effort", self._names) if message.effort else None
            except ParameterError as error:
                effort, self._refusal = None, str(error)
                loop.trip(FaultCode.COMMAND_IMPOSSIBLE, f"effort_commands: {error.name} must be {error.expected}")
            self._command = EffortCommand(effort, answered)

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        def switch(safety: SafetyMachine) -> str:
            if not request.data:
                safety.disable(time.monotonic())
            elif not safety.enable(time.monotonic()):
                return f"refused: the arm is {safety.state.value}" + (
                    f" ({safety.fault.reason})" if safety.fault else ""
                )
            return ""

        return self._on_control_thread(switch, response)

    def _on_clear_fault(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def clear(safety: SafetyMachine) -> str:
            return "" if safety.clear(time.monotonic()) else f"no fault to clear: the arm is {safety.state.value}"

        return self._on_control_thread(clear, response)

    def _on_set_zero(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        since = time.monotonic()
        loop = self._loop
        self._on_control_thread(lambda safety: self._set_zero(safety, loop), response)
        if response.success and loop is not None and not self._zeroed(loop, since):
            response.success = False
            response.message = f"the motors did not set their zero: {self._positions(loop)}"
        return response

    def _zeroed(self, loop: ControlLoop, since: float) -> bool:
        """Wait until every motor has replied again; return whether all then report 0."""
        end = since + ZERO_TIMEOUT
        while time.monotonic() < end:
            if all(joint.time > since and abs(joint.position) <= ZERO_TOLERANCE for joint in loop.samples):
                return True
            time.sleep(self._period)
        return False

    def _positions(self, loop: ControlLoop) -> str:
        return ", ".join(f"{n} at {j.position:.3f} rad" for n, j in zip(self._names, loop.samples, strict=True))

    def _set_zero(self, safety: SafetyMachine, loop: ControlLoop | None) -> str:
        if any(motor.zero for motor in self._motors):
            return f"zero = {[motor.zero for motor in self._motors]}: must be all 0 when the motors store the zero"
        if safety.state is not State.DISABLED:
            return f"refused: the arm is {safety.state.value}, must be disabled"
        now = time.monotonic()
        if loop is None or any(self._limits.is_silent(now, joint) for joint in loop.samples):
            return "refused: a motor does not reply"
        if not safety.settled(now):
            return "refused: the arm is not at rest"
        loop.set_zero()
        return ""

    def _on_control_thread(self, function: Callable[[SafetyMachine], str], response: Response) -> Response:
        """Run `function` on the control thread; it returns an error text, or ''."""
        loop = self._loop
        try:
            if loop is None:
                raise BusError("the node is not active")
            response.message = loop.call(lambda: function(loop.safety)).result(CALL_TIMEOUT)
        except (BusError, TimeoutError) as error:
            response.message = str(error) or "the control thread did not respond"
        response.success = not response.message
        return response

    def _report(self) -> None:
        if self._loop is not None and not self._watchdog.alive:
            self._loop.trip_if_carried(FaultCode.WATCHDOG_DEAD, "the watchdog process has died")
        self._report_writer.send(self._loop, self._refusal, self._command.answered)


def main() -> None:
    """Entry point of the executable `can_bridge`."""
    raise SystemExit(run(CanBridge, priority=20))
