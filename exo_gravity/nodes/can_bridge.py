"""can_bridge: CAN motors -> `joint_states`, `effort_commands` -> CAN, through the safety machine.

A control thread runs the bus (hardware/control_loop.py). Efforts carry the stamp of the joint state that they answer.
The bridge remembers when, on the monotonic clock, each stamped state was measured: so the age of an answer does not
depend on the wall clock, and an unknown stamp is refused.
"""

from __future__ import annotations

import math
import os
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from exo_gravity.core.control_params import CAN_BRIDGE, OPTIONS, limits_of, motors_of
from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.faults import FaultCode
from exo_gravity.core.limits import JointSample
from exo_gravity.core.safety import SafetyMachine
from exo_gravity.core.validation import check_bridge
from exo_gravity.core.wire import check_rate
from exo_gravity.hardware.control_loop import NO_COMMAND, ControlLoop, EffortCommand
from exo_gravity.hardware.handover import Charge
from exo_gravity.hardware.motor_bus import MotorBus
from exo_gravity.hardware.owned_bus import OwnedBus
from exo_gravity.hardware.scheduling import request_real_time
from exo_gravity.nodes.bridge_recovery import is_requested, run_recovery
from exo_gravity.nodes.bridge_report import BridgeReport, log_limits
from exo_gravity.nodes.bridge_services import CALL_TIMEOUT, BridgeServices
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
DESCENT_TIMEOUT = 60.0  # s in which a deactivated arm must be down, with its motors off
AUTOSTART_PATIENCE = 30.0  # s for the watchdog of a dead bridge to let the arm down
REMINDER_PERIOD = 10.0  # s between two reminders that a motor cannot be reached


class CanBridge(LifecycleNode):
    """The lifecycle node: configure opens the bus, activate starts the loop and arms, deactivate lets the arm down.

    Raises BusError if `autostart` is set and the node cannot be configured or activated.
    """

    def __init__(self) -> None:
        super().__init__("can_bridge", automatically_declare_parameters_from_overrides=True)
        values = declare(self, CAN_BRIDGE, free_prefix=OPTIONS)
        self._names = values["joint_names"]
        self._motors = motors_of(values)
        self._limits = limits_of(values)
        check_bridge(values["rate"], self._motors, self._limits)
        self._period = 1.0 / values["rate"]
        self._charge = Charge(bus_of(self, values), self._motors, self._limits, self._period)
        self._owner = f"{self.get_fully_qualified_name()} (PID {os.getpid()})"
        self._real_time = values["thread_priority"], values["lock_memory"]
        self._wire = check_rate(values["rate"], len(self._motors))
        self._command = NO_COMMAND  # the newest from the compensator
        self._measured = -math.inf  # monotonic s, when the last published joint state was measured
        self._owned: OwnedBus | None = None  # while configured
        self._bus: MotorBus | None = None  # while inactive
        self._loop: ControlLoop | None = None  # while active
        self._patience = AUTOSTART_PATIENCE if values["autostart"] else 0.0
        self._error = ""  # why the last transition failed
        self._published: OrderedDict[int, float] = OrderedDict()
        self._refusal = "none"
        self._commander = SolePublisher(self, "effort_commands")
        self._report_writer = BridgeReport(self, self._names, self._wire, self._period)
        self._publisher = self.create_publisher(JointState, "joint_states", 1)
        self._joint_states = JointState(name=self._names)  # one message, reused
        self._efforts = HotPath(self, JointState, "effort_commands", self._on_efforts, EFFORTS)
        BridgeServices(self, lambda: self._loop, self._motors, self._limits)
        self.create_timer(REPORT_PERIOD, self._report)
        log_limits(self, self._limits, self._wire, values["rate"])
        if values["autostart"]:
            for trigger in (self.trigger_configure, self.trigger_activate):
                if trigger() is not TransitionCallbackReturn.SUCCESS:
                    self.close()
                    raise BusError(self._error)

    @property
    def failure(self) -> BaseException | None:
        """The exception that ended the control thread, if any."""
        return self._loop.failure if self._loop else None

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take the bus, open it, and listen."""
        return self._transition(self._configure, super().on_configure, state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start the control loop, and enable the arm once it passes the start gate."""
        return self._transition(self._activate, super().on_activate, state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the arm down and wait until its motors are off; the bus stays ours for the next activation."""
        return self._transition(self._deactivate, super().on_deactivate, state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the bus and release it."""
        return self._transition(self.close, super().on_cleanup, state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the arm down and close the bus."""
        return self._transition(self.close, super().on_shutdown, state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the arm down and close the bus, after an exception in a transition."""
        return self._transition(self.close, super().on_error, state)

    def close(self) -> None:
        """Let the arm down, send the last frames, close the bus and release it, in any state.

        A motor that cannot be reached may still be on, so this waits for it without end.
        """
        loop, self._loop = self._loop, None
        while loop is not None and not loop.stop(REMINDER_PERIOD):
            if loop.safety.is_unreached:
                self.get_logger().error("a motor does not reply; it may still be powered; trying again")
        if self._bus is not None:
            self._bus.stop()
            self._bus = None
        if self._owned is not None:
            self._owned.close()
            self._owned = None

    def _transition(
        self,
        function: Callable[[], None],
        superior: Callable[[LifecycleState], TransitionCallbackReturn],
        state: LifecycleState,
    ) -> TransitionCallbackReturn:
        """Run a transition; if it raises, log why, which rclpy does not."""
        try:
            function()
            return superior(state)
        except BusError as error:
            self._error = str(error)
        except Exception as error:
            self._error = f"{type(error).__name__}: {error}"
        self.get_logger().error(self._error)
        return TransitionCallbackReturn.FAILURE

    def _configure(self) -> None:
        self._owned = OwnedBus(self._charge, self._owner, self.get_logger().error, self._patience)
        try:
            self._bus = self._owned.open()
        except BaseException:
            self.close()
            raise

    def _activate(self) -> None:
        self._command = NO_COMMAND
        if self._owned is None:
            raise BusError("the node is not configured")
        bus, self._bus = self._bus or self._owned.open(), None
        safety = SafetyMachine(self._limits, self._period, [motor.peak_effort for motor in self._motors])
        hand_over = self._owned.watchdog.hand_over
        loop = ControlLoop(bus, safety, self._period, self._publish, self._get_efforts, hand_over)
        loop.start()
        try:
            for refused in request_real_time(*self._real_time):
                self.get_logger().warning(refused)
        except BaseException:
            loop.stop()
            raise
        self._loop = loop
        loop.call(lambda: safety.enable(time.monotonic()))

    def _deactivate(self) -> None:
        loop, end = self._loop, time.monotonic() + DESCENT_TIMEOUT
        if loop is None:
            raise BusError("the node is not active")
        loop.call(lambda: loop.safety.disable(time.monotonic())).result(CALL_TIMEOUT)
        while not loop.is_off:
            if loop.failure:
                raise BusError(f"the control thread has ended: {loop.failure}")
            if time.monotonic() > end:
                raise BusError("a motor does not reply and may still be powered; the node stays active")
            time.sleep(self._period)
        self._loop = None
        loop.stop()

    # Control thread

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

    # ROS callbacks

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

    def _report(self) -> None:
        if self._loop is not None and self._owned is not None and not self._owned.watchdog.alive:
            self._loop.trip_if_carried(FaultCode.WATCHDOG_DEAD, "the watchdog process has died or is frozen")
        self._report_writer.send(self._loop, self._refusal, self._command.answered)


def main() -> None:
    """Entry point of the executable `can_bridge`."""
    raise SystemExit(run_recovery() if is_requested() else run(CanBridge, priority=20))
