"""can_bridge: CAN motors -> `joint_states`, `effort_commands` -> CAN, through the safety machine.

The bus is run by a control thread (hardware/control_loop.py); ROS callbacks only leave things for it. Efforts carry the
stamp of the joint state they answer. The bridge remembers when, on the monotonic clock, it published each stamp: the
age of an answer needs no wall clock, and a stamp it never gave is no answer.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from exo_gravity.core.control_params import CAN_BRIDGE, OPTIONS, limits_of, motors_of
from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.limits import JointSample
from exo_gravity.core.safety import SafetyMachine, State
from exo_gravity.core.wire import check_rate
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.hardware.motor_bus import MotorBus, open_bus
from exo_gravity.hardware.scheduling import ask_real_time
from exo_gravity.hardware.watchdog import Charge, Watchdog
from exo_gravity.nodes.bridge_report import BridgeReport, introduce
from exo_gravity.nodes.conversions import by_name, to_nanoseconds
from exo_gravity.nodes.declare import bus_of, declare
from exo_gravity.nodes.hot_path import HotPath
from exo_gravity.nodes.run import run
from exo_gravity.nodes.sole_publisher import SolePublisher

# Taken by the control thread, each cycle: deep enough that a second commander is not overlooked. Not reliable: an old
# effort sent again is of no use, and acknowledging each one costs both nodes a thread's work (measured: 2 % of a core).
EFFORTS = QoSProfile(depth=8, reliability=ReliabilityPolicy.BEST_EFFORT)
REMEMBERED = 256  # joint states whose stamps are known: more than command_timeout holds at any rate
REPORT_PERIOD = 0.1  # s
ZEROED = 0.02  # rad about 0 that a motor may report after set_zero
ZERO_TIMEOUT = 3.0  # s: motors are deaf for up to 1.5 s while they write their memory
ORDER_TIMEOUT = 2.0  # s that a service waits for the control thread


class CanBridge(LifecycleNode):
    """The lifecycle node: configure opens the bus, activate starts the loop and arms, deactivate lets the arm down."""

    def __init__(self):
        super().__init__("can_bridge", automatically_declare_parameters_from_overrides=True)
        values = declare(self, CAN_BRIDGE, free_prefix=OPTIONS)
        self._address = bus_of(self, values)
        self._names = values["joint_names"]
        self._motors = motors_of(values)
        self._limits = limits_of(values)
        self._period = 1.0 / values["rate"]
        self._real_time = values["thread_priority"], values["lock_memory"]
        self._wire = check_rate(values["rate"], len(self._motors))
        # When the joint states of the newest efforts were taken, and those that were published last, monotonic s.
        self._answers = self._asked = -math.inf
        self._watchdog = Watchdog()
        self._watchdog.guard(Charge(self._address, self._motors, self._limits, self._period))
        self._bus: MotorBus | None = None
        self._loop: ControlLoop | None = None
        self._published: OrderedDict[int, float] = OrderedDict()
        self._refusal = "none"
        self._commander = SolePublisher()
        self._said = BridgeReport(self, self._names, self._wire, self._period)
        self._publisher = self.create_publisher(JointState, "joint_states", 1)
        self._joint_states = JointState(name=self._names)  # the one message that is sent, over and over
        self._efforts = HotPath(self, JointState, "effort_commands", self._on_efforts, EFFORTS)
        self.create_service(SetBool, "~/enable", self._on_enable)
        self.create_service(Trigger, "~/clear_fault", self._on_clear_fault)
        self.create_service(Trigger, "~/set_zero", self._on_set_zero)
        self.create_timer(REPORT_PERIOD, self._report)
        introduce(self, self._limits, self._wire, values["rate"])
        if values["autostart"]:
            self._open()
            self.trigger_configure()
            self.trigger_activate()

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the bus."""
        try:
            self._open()
        except BusError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start the control loop and arm, once the start gate is passed."""
        safety = SafetyMachine(self._limits, self._period)
        self._loop = ControlLoop(self._bus, safety, self._period, self._publish, before_cycle=self._take_efforts)
        self._bus = None  # the loop's from now on
        self._loop.order(lambda: self._loop.safety.enable(time.monotonic()))
        self._loop.start()
        for refused in ask_real_time(*self._real_time):
            self.get_logger().warning(refused)
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the arm down, and wait for that; the bus stays open for the next activation."""
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
        """Let the arm down, send the last frames and close the bus, whatever the state."""
        self._stop_loop()
        if self._bus is not None:
            self._bus.stop()
            self._bus = None

    def _open(self) -> None:
        if self._bus is None:
            self._bus = MotorBus(open_bus(*self._address), self._motors, note=self._watchdog.note)

    def _stop_loop(self) -> None:
        if self._loop is not None:
            self._loop.stop()
            self._loop = None

    # Control thread

    def _take_efforts(self, latest: float) -> None:
        """Take the answer to the last joint state; wait until `latest` (monotonic s) for one that is late."""
        self._efforts.poll()
        if self._answers < self._asked:
            self._efforts.poll(latest - time.monotonic())

    def _publish(self, now: float, joints: Sequence[JointSample]) -> None:
        """Publish a joint state if every motor has answered lately: an unknown angle is never sent as a number."""
        if any(self._limits.silent(now, joint) for joint in joints):
            return
        message = self._joint_states
        message.position, message.velocity, message.effort, *_ = zip(*joints, strict=True)
        message.header.stamp = self.get_clock().now().to_msg()
        self._asked = min(joint.time for joint in joints)
        self._published[to_nanoseconds(message.header.stamp)] = self._asked
        if len(self._published) > REMEMBERED:
            self._published.popitem(last=False)
        self._publisher.publish(message)

    # ROS callbacks

    def _on_efforts(self, message: JointState, info: dict) -> None:
        loop = self._loop
        if loop is None:
            return
        answers = self._published.get(to_nanoseconds(message.header.stamp))
        if self._commander.another(info):
            self._refusal = "a second publisher of effort_commands"
            loop.ask(None, time.monotonic())  # while the arm is still being checked it is not armed
            loop.trip_if_carried("second_commander", "more than one publisher of effort_commands")
        elif answers is None:
            self._refusal = f"stamp {to_nanoseconds(message.header.stamp)} ns answers no joint state of this bridge"
        else:
            self._answers = answers
            try:
                loop.ask(by_name(message, "effort", self._names) if message.effort else None, answers)
            except ParameterError as error:
                self._refusal = str(error)
                loop.trip("command_impossible", f"effort_commands: {error.name} must be {error.expected}")

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        def switch(safety: SafetyMachine) -> str:
            if not request.data:
                safety.disable(time.monotonic())
            elif not safety.enable(time.monotonic()):
                return f"refused: the arm is {safety.state.value}" + (
                    f" ({safety.fault.reason})" if safety.fault else ""
                )
            return ""

        return self._ordered(switch, response)

    def _on_clear_fault(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def clear(safety: SafetyMachine) -> str:
            return "" if safety.clear(time.monotonic()) else f"no fault to clear: the arm is {safety.state.value}"

        return self._ordered(clear, response)

    def _on_set_zero(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        ordered = time.monotonic()
        self._ordered(self._set_zero, response)
        if response.success and not self._zeroed(ordered):
            response.success, response.message = False, f"the motors did not take it: {self._where()}"
        return response

    def _zeroed(self, ordered: float) -> bool:
        """Wait until every motor has answered anew; return whether all then say 0."""
        end = ordered + ZERO_TIMEOUT
        while time.monotonic() < end:
            if all(joint.time > ordered and abs(joint.position) <= ZEROED for joint in self._loop.samples):
                return True
            time.sleep(self._period)
        return False

    def _where(self) -> str:
        return ", ".join(f"{n} at {j.position:.3f} rad" for n, j in zip(self._names, self._loop.samples, strict=True))

    def _set_zero(self, safety: SafetyMachine) -> str:
        if any(motor.zero for motor in self._motors):
            return f"zero = {[motor.zero for motor in self._motors]}: must be all 0 where the motors keep the zero"
        if safety.state is not State.DISABLED:
            return f"refused: the arm is {safety.state.value}, must be disabled"
        now = time.monotonic()
        if any(self._limits.silent(now, joint) for joint in self._loop.samples):
            return "refused: a motor does not answer"
        if not safety.settled(now):
            return "refused: the arm is not at rest"
        self._loop.set_zero()
        return ""

    def _ordered(self, function: Callable[[SafetyMachine], str], response):
        """Run `function` on the control thread; it returns what went wrong, or ''."""
        loop = self._loop
        try:
            if loop is None:
                raise BusError("the node is not active")
            response.message = loop.order(lambda: function(loop.safety)).result(ORDER_TIMEOUT)
        except (BusError, TimeoutError) as error:
            response.message = str(error) or "the control thread did not answer"
        response.success = not response.message
        return response

    def _report(self) -> None:
        if self._loop is not None and not self._watchdog.alive:
            self._loop.trip_if_carried("watchdog_dead", "nobody would let the arm down if this process died")
        self._said.send(self._loop, self._refusal, self._answers)


def main() -> None:
    """Entry point of the executable `can_bridge`."""
    raise SystemExit(run(CanBridge, priority=20))
