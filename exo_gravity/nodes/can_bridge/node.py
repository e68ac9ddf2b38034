# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""can_bridge: CAN motors -> `joint_states`, `effort_commands` -> CAN, through the safety machine.

A control thread runs the bus (hardware/control_loop.py). In each cycle it publishes the joint states and reads the
efforts that answer them (effort_exchange.py). operation.py has the services and the report on /diagnostics.

Started with EXO_GRAVITY_RECOVER, it does one thing only: it lets down an arm that a dead bridge and its dead watchdog
left with its motors on.
"""

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable
from functools import wraps
from typing import Any

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from exo_gravity.core.arm.tilt import SIDES
from exo_gravity.core.errors import BusError, ExoGravityError, ParameterError
from exo_gravity.core.motors.joint_motor import OPTIONS, motors_of, traffic_of
from exo_gravity.core.safety.command import NO_EFFORTS, FaultCode, State
from exo_gravity.core.safety.limits import CAN_BRIDGE, check_bridge, limits_of
from exo_gravity.core.trunk.inputs import TiltInput
from exo_gravity.core.vocabulary import NO_REASON, Status, Wait
from exo_gravity.hardware.can_port import ArmOnBus, serials_of
from exo_gravity.hardware.clock import set_realtime_priority
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.hardware.motor_bus import MotorBus
from exo_gravity.hardware.network import restrict_to_localhost
from exo_gravity.hardware.owned_bus import OwnedBus, Watchdog, take_over
from exo_gravity.nodes.can_bridge import operation
from exo_gravity.nodes.can_bridge.effort_exchange import Answer, EffortExchange
from exo_gravity.nodes.ros.inner import Until, prepare_transitions, why_too_old
from exo_gravity.nodes.ros.parameters import bus_of, declare
from exo_gravity.nodes.ros.run import run
from exo_gravity.nodes.ros.subscriptions import TiltSubscription

REPORT_PERIOD = 0.1  # s
TILT_TIMEOUT = 0.08  # s for which /imu/data goes before /imu/pitch_yaw
TRANSITION_TIMEOUT = 60.0  # s for a transition to let the arm down; then it is refused, and the arm held as before
REMINDER_PERIOD = 10.0  # s between two reminders that a motor cannot be reached
UNREACHED = "a motor does not reply and may still be powered; the node stays active"
LEAVING = "the node is being deactivated"
# Transitions by the label or the number of a request: those that arm the arm, and those that let it down first.
ARMING = ("configure", Transition.TRANSITION_CONFIGURE, "activate", Transition.TRANSITION_ACTIVATE)
DEACTIVATE = ("deactivate", Transition.TRANSITION_DEACTIVATE)
SHUTDOWN = ("shutdown", "active_shutdown", Transition.TRANSITION_ACTIVE_SHUTDOWN)
# Set by launcher and launch file: the time in s for the watchdog of the dead bridge to let the arm down.
RECOVER = "EXO_GRAVITY_RECOVER"
WITHOUT_LOG_FILE = ("--ros-args", "--disable-external-lib-logs")


def _gravity_for(node: Node, get_loop: Callable[[], ControlLoop | None], is_monitored: bool) -> TiltSubscription:
    """Return what tells the loop where gravity points, as often as it is polled; before that it is upright.

    The side is that of the node's namespace: a compensator with the wrong `side` does not decide it. Without one, only
    how far the trunk is from upright counts.
    """
    side = node.get_namespace().rpartition("/")[2]
    if side not in SIDES:
        if is_monitored:
            raise ParameterError("largest_moment", "given", f"0, or the namespace one of {' or '.join(SIDES)}")
        side = SIDES[0]
    tilt = TiltInput(side, TILT_TIMEOUT)

    def pass_on(now: float) -> None:
        if loop := get_loop():
            loop.safety.motion.follow(now, tilt.at(now), tilt.overtaken)

    return TiltSubscription(node, tilt, threading.Lock(), on_tilt=pass_on)


def _transition(function: Callable[[Any], None]) -> Callable[..., TransitionCallbackReturn]:
    """Return a transition callback of a method; if that raises, it logs why, which rclpy does not."""

    @wraps(function)
    def callback(node: "CanBridge", _state: LifecycleState) -> TransitionCallbackReturn:
        node.error = ""
        try:
            function(node)
            return TransitionCallbackReturn.SUCCESS
        except Exception as error:
            node.error = str(error) if isinstance(error, BusError) else f"{type(error).__name__}: {error}"
        node.get_logger().error(node.error)
        return TransitionCallbackReturn.FAILURE

    return callback


class CanBridge(LifecycleNode):
    """The lifecycle node: configure opens the bus, activate starts the loop and arms, deactivate lets the arm down.

    loop: the control loop while the node is active, else None. answer: of a compensator in this process. Raises
    BusError if `autostart` is set and the node cannot be configured or activated.
    """

    def __init__(self, answer: Answer | None = None) -> None:
        super().__init__("can_bridge", automatically_declare_parameters_from_overrides=True)
        values, self._arm = _declared(self)
        operation.refuse_simulated_time(self, self._arm.address[0])
        motors, limits = self._arm.motors, self._arm.limits
        traffic = traffic_of(values, self._arm.address[2])
        check_bridge(values["rate"], motors, limits, traffic.values())
        self.loop: ControlLoop | None = None
        self._thread_priority = values["thread_priority"]
        self._owned: OwnedBus | None = None  # while configured
        self._bus: MotorBus | None = None  # while inactive
        self._is_leaving = False  # the arm is let down for a transition
        self.error = ""  #: why the last transition failed
        gravity = _gravity_for(self, lambda: self.loop, any(limits.largest_moment))
        self._exchange = EffortExchange(self, limits, lambda: self.loop, answer, gravity.poll)
        lease = operation.Operator(self, lambda: self.loop).lease
        services = operation.BridgeServices(
            self, lambda: self.loop, motors, lambda: LEAVING if self._is_leaving else ""
        )
        self._report = operation.BridgeReport(self, self._arm, traffic, lease, services)
        prepare_transitions(self, self._prepare)
        self.create_timer(REPORT_PERIOD, self._on_report)
        operation.log_risks(self, self._arm.address[0], traffic, values["rate"])
        if values["autostart"]:
            for trigger in (self.trigger_configure, self.trigger_activate):
                if trigger() is not TransitionCallbackReturn.SUCCESS:
                    self.close()
                    raise BusError(self.error)

    @property
    def failure(self) -> BaseException | None:
        """The exception that ended the control thread, if any."""
        return self.loop.failure if self.loop else None

    @_transition
    def on_configure(self) -> None:
        """Take the bus, open it, and listen."""
        self._owned = OwnedBus(self._arm, _owner(self), self.get_logger().error)
        try:
            self._bus = self._owned.open()
        except BaseException:
            self.close()
            raise

    @_transition
    def on_activate(self) -> None:
        """Start the control loop, and enable the arm once it passes the start gate."""
        self._exchange.newest = NO_EFFORTS
        assert self._owned, "the node is not configured"
        bus, self._bus = self._bus or self._owned.open(), None
        loop = ControlLoop(bus, self._arm.limits, self._arm.period, self._exchange, self._owned.watchdog.hand_over)
        loop.start()
        try:
            set_realtime_priority(self._thread_priority, self.get_logger().warning)
        except BaseException:
            loop.stop()
            raise
        self.loop = loop
        self._check_watchdog(self._owned.watchdog, loop)
        loop.call(lambda: loop.safety.enable(time.monotonic()))

    @_transition
    def on_deactivate(self) -> None:
        """Let the arm down and wait until its motors are off; the bus stays ours for the next activation."""
        loop, end = self.loop, time.monotonic() + TRANSITION_TIMEOUT
        assert loop, "the node is not active"
        loop.call(lambda: loop.safety.disable(time.monotonic())).result(operation.CALL_TIMEOUT)
        while not loop.is_off:
            if loop.failure:
                raise BusError(f"the control thread has ended: {loop.failure}")
            if time.monotonic() > end:
                raise BusError(UNREACHED)
            self._report_descent()
            time.sleep(REPORT_PERIOD)
        self._stop(loop)

    async def _prepare(self, request: ChangeState.Request) -> str:
        """Let the arm down before a transition that needs it off; return why a transition is refused, or ''.

        Meanwhile the executor goes on: reports are sent, and requests are answered.
        """
        transition, loop = request.transition.label or request.transition.id, self.loop
        if self._is_leaving:
            return LEAVING
        if transition in ARMING:
            return why_too_old(self)
        if loop is None or loop.is_off or transition not in (*DEACTIVATE, *SHUTDOWN):
            return ""
        self._is_leaving = True
        try:
            loop.call(lambda: loop.safety.disable(time.monotonic()))
            await Until(lambda: loop.is_off or loop.failure, TRANSITION_TIMEOUT)
        finally:
            self._is_leaving = False
        return "" if loop.is_off or loop.failure or transition in SHUTDOWN else UNREACHED

    def close(self) -> None:
        """Let the arm down, send the last frames, close the bus and release it, in any state.

        A motor that cannot be reached may still be on, so this waits for it as long as it takes.
        """
        if self.loop is not None:
            self._stop(self.loop)
        if self._bus is not None:
            self._bus.stop()
            self._bus = None
        if self._owned is not None:
            self._owned.close()
            self._owned = None

    # Also at a shutdown, and after an error in a transition.
    on_cleanup = on_shutdown = on_error = _transition(close)

    def _stop(self, loop: ControlLoop) -> None:
        reminder = time.monotonic() + REMINDER_PERIOD
        while not loop.stop(REPORT_PERIOD):
            self._report_descent()
            if loop.safety.is_unreached and time.monotonic() > reminder:
                self.get_logger().error("a motor does not reply; it may still be powered; trying again")
                reminder += REMINDER_PERIOD
        self._report_descent()
        self.loop = None

    def _on_report(self) -> None:
        if self.loop is not None and self._owned is not None:
            self._check_watchdog(self._owned.watchdog, self.loop)
        self._report.send(self.loop, self._exchange.newest, self._exchange.refusal, self.error)

    def _check_watchdog(self, watchdog: Watchdog, loop: ControlLoop) -> None:
        """Let no motor be switched on before the watchdog watches, and none stay on without it or this node."""
        loop.attended = time.monotonic()
        loop.setup_error = Status(Wait.WATCHDOG, "the watchdog to start") if watchdog.is_starting else NO_REASON
        if not watchdog.alive and loop.safety.state is not State.LETTING_DOWN:
            loop.trip(FaultCode.WATCHDOG_DEAD, "the watchdog process has died, is frozen, or did not start")

    def _report_descent(self) -> None:
        with contextlib.suppress(Exception):  # whatever the middleware does, the arm comes down
            self._report.send(self.loop, self._exchange.newest, self._exchange.refusal, self.error)


def _declared(node: Node) -> tuple[dict[str, Any], ArmOnBus]:
    """Declare the parameters; return their values, and the arm that they describe. Raises ParameterError."""
    values = declare(node, CAN_BRIDGE, free_prefix=OPTIONS)
    serials = serials_of(values["can.serial"], values["can.channel"], len(values["joint_names"]))
    address, motors, limits = bus_of(node, values), motors_of(values), limits_of(values)
    return values, ArmOnBus(address, motors, limits, 1.0 / values["rate"], serials=serials)


def _owner(node: Node) -> str:
    return f"{node.get_fully_qualified_name()} (PID {os.getpid()})"


def main(make_node: Callable[[], CanBridge] = CanBridge) -> None:
    """Entry point of the executable `can_bridge`; with RECOVER, the exit code is 0 if no motor is on."""
    if not (patience := os.environ.get(RECOVER)):
        raise SystemExit(run(make_node, priority=20))
    restrict_to_localhost()
    # The launcher shows the log. A log file cannot be opened on a full disk, which must not leave the motors on.
    rclpy.init(args=[*sys.argv, *WITHOUT_LOG_FILE], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("can_bridge", automatically_declare_parameters_from_overrides=True)
    try:
        take_over(_declared(node)[1], _owner(node), node.get_logger().error, float(patience)).release()
    except ExoGravityError as error:
        node.get_logger().error(str(error))
        raise SystemExit(1) from None
