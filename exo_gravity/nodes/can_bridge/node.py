"""can_bridge: CAN motors -> `joint_states`, `effort_commands` -> CAN, through the safety machine.

A control thread runs the bus (hardware/control_loop.py). In each cycle it publishes the joint states and reads the
efforts that answer them (nodes/can_bridge/effort_exchange.py).
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from exo_gravity.core.errors import BusError
from exo_gravity.core.model.budget import motor_torques
from exo_gravity.core.motors.joint_motor import peaks_of
from exo_gravity.core.motors.params import OPTIONS, motors_of, traffic_of
from exo_gravity.core.safety.checks import check_bridge
from exo_gravity.core.safety.faults import FaultCode
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.core.safety.params import CAN_BRIDGE, limits_of
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.hardware.ownership.handover import ArmOnBus
from exo_gravity.hardware.ownership.owned_bus import OwnedBus
from exo_gravity.hardware.scheduling import request_real_time
from exo_gravity.nodes.can_bridge.effort_exchange import EffortExchange
from exo_gravity.nodes.can_bridge.recovery import is_requested, run_recovery
from exo_gravity.nodes.can_bridge.report import BridgeReport, log_limits
from exo_gravity.nodes.can_bridge.services import CALL_TIMEOUT, BridgeServices
from exo_gravity.nodes.ros.parameters import bus_of, declare
from exo_gravity.nodes.ros.run import run

REPORT_PERIOD = 0.1  # s
DESCENT_TIMEOUT = 60.0  # s in which a deactivated arm must be down, with its motors off
REMINDER_PERIOD = 10.0  # s between two reminders that a motor cannot be reached


class CanBridge(LifecycleNode):
    """The lifecycle node: configure opens the bus, activate starts the loop and arms, deactivate lets the arm down.

    Raises BusError if `autostart` is set and the node cannot be configured or activated.
    """

    def __init__(self) -> None:
        super().__init__("can_bridge", automatically_declare_parameters_from_overrides=True)
        values = declare(self, CAN_BRIDGE, free_prefix=OPTIONS)
        self._motors = motors_of(values)
        self._limits = limits_of(values)
        check_bridge(values["rate"], self._motors, self._limits, values["status_rate"])
        self._period = 1.0 / values["rate"]
        address = bus_of(self, values)
        traffic = traffic_of(values, address[2])
        traffic.check(values["rate"])
        self._arm = ArmOnBus(address, self._motors, self._limits, self._period)
        self._owner = f"{self.get_fully_qualified_name()} (PID {os.getpid()})"
        self._real_time = values["thread_priority"], values["thread_priority"] > 0
        self._owned: OwnedBus | None = None  # while configured
        self._bus: MotorBus | None = None  # while inactive
        self._loop: ControlLoop | None = None  # while active
        self._error = ""  # why the last transition failed
        self._exchange = EffortExchange(self, values["joint_names"], self._limits, lambda: self._loop)
        rated, _ = motor_torques(values["motor"], values["torque_scale"])
        self._report_writer = BridgeReport(self, values["joint_names"], traffic, self._period, rated.tolist())
        BridgeServices(self, lambda: self._loop, self._motors, self._limits)
        self.create_timer(REPORT_PERIOD, self._report)
        log_limits(self, self._limits, traffic, values["rate"])
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
        loop = self._loop
        if loop is not None:
            self._stop(loop)
            self._loop = None
        if self._bus is not None:
            self._bus.stop()
            self._bus = None
        if self._owned is not None:
            self._owned.close()
            self._owned = None

    def _stop(self, loop: ControlLoop) -> None:
        reminder = time.monotonic() + REMINDER_PERIOD
        while not loop.stop(REPORT_PERIOD):
            self._report_descent()
            if loop.safety.is_unreached and time.monotonic() > reminder:
                self.get_logger().error("a motor does not reply; it may still be powered; trying again")
                reminder += REMINDER_PERIOD
        self._report_descent()

    def _report_descent(self) -> None:
        with contextlib.suppress(Exception):  # whatever the middleware does, the arm comes down
            self._report_writer.send(self._loop, self._exchange.refusal, self._exchange.answered)

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
        self._owned = OwnedBus(self._arm, self._owner, self.get_logger().error)
        try:
            self._bus = self._owned.open()
        except BaseException:
            self.close()
            raise

    def _activate(self) -> None:
        self._exchange.forget()
        if self._owned is None:
            raise BusError("the node is not configured")
        bus, self._bus = self._bus or self._owned.open(), None
        safety = SafetyMachine(self._limits, self._period, peaks_of(self._motors))
        hand_over = self._owned.watchdog.hand_over
        loop = ControlLoop(bus, safety, self._period, self._exchange.publish, self._exchange.get_efforts, hand_over)
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
            self._report_descent()
            time.sleep(REPORT_PERIOD)
        self._stop(loop)
        self._loop = None

    def _report(self) -> None:
        if self._loop is not None and self._owned is not None and not self._owned.watchdog.alive:
            self._loop.trip_if_carried(FaultCode.WATCHDOG_DEAD, "the watchdog process has died or is frozen")
        self._report_writer.send(self._loop, self._exchange.refusal, self._exchange.answered)


def main() -> None:
    """Entry point of the executable `can_bridge`."""
    raise SystemExit(run_recovery() if is_requested() else run(CanBridge, priority=20))
