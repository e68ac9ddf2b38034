# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""wearer: estimates what the wearer of an arm does, beside the path of the torque.

It reads `joint_states`, the trunk's motion and the compensator's parameters, 100 times a second, and publishes

    wearer_efforts      sensor_msgs/JointState: the torque that the wearer adds at each joint, Nm
    wearer_efforts_std  sensor_msgs/JointState: one standard deviation of it, Nm
    support_request     sensor_msgs/JointState: the support that it asks the compensator for, with `support_adapts`

No arm comes down if it ends or is late: without a fresh request the compensator returns to its parameter `support`.
While the compensator is silent, or its parameters are not known, nothing is published, and /diagnostics says why.
An arm from a URDF (`law: urdf`) is read from the compensator's own file or topic.
"""

import math
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.rotation import ZERO, Floats3
from exo_gravity.core.arm.tilt import Tilt, turning_in_base
from exo_gravity.core.compensation.settings import Settings, settings_of
from exo_gravity.core.compensation.support import NAME, TOPIC
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.command import State
from exo_gravity.core.trunk.inputs import FELT, TiltInput
from exo_gravity.core.vocabulary import NO_REASON, NONE, UNKNOWN, Status
from exo_gravity.hardware.urdf_arm import UrdfArm, arm_from, read_urdf
from exo_gravity.lab.budget import USUAL_TILT, budget, largest_support, motor_torques, overload, workspace
from exo_gravity.lab.inputs.arms import fitting
from exo_gravity.lab.observer import PERIOD, WearerWatch, values_of
from exo_gravity.lab.vocabulary import Adapts, Budget, NoEstimate, WearerState
from exo_gravity.nodes.others import NodeParameters, Statuses
from exo_gravity.nodes.ros.messages import OK, STALE, WARN, Diagnostics, by_name
from exo_gravity.nodes.ros.parameters import declare
from exo_gravity.nodes.ros.run import run
from exo_gravity.nodes.ros.subscriptions import (
    LATCHED,
    PeriodicThread,
    PolledSubscription,
    ThreadedNode,
    TiltSubscription,
)

COMPENSATOR = "compensator"
PARAMETER_PERIOD = 0.1  # s between two looks whether the compensator's parameters are to be read
REPORT_PERIOD = 0.5  # s
REQUEST_PERIOD = 0.2  # s
SILENCE = 0.5  # s without joint states, after which they are waited for
# s without the compensator's diagnostics, which come twice a second: the middleware lists a killed node for 20 s
COMPENSATOR_SILENCE = 2.0
FRESH = 0.1  # s, age of the trunk's motion that is used
MOST = 1e3  # rad, rad/s and Nm: no joint reports more, and the observer would take minutes to forget it
BRIDGE_PARAMETERS = {
    "motor", "torque_scale", "torque_scale_slope", "torque_scale_temperature", "position_min", "position_max",
}  # fmt: skip


class BudgetWatch:
    """The torque budget of what an arm carries at present: whether its motors can hold it in every pose.

    It takes about 0.2 s of arithmetic on the executor's thread, and 1.2 s for seven joints; the estimate has its own.
    Motors and joint limits are parameters of `can_bridge`, which are read once.
    """

    def __init__(self, node: Node) -> None:
        #: the result for the settings checked last
        self.result = Status(Budget.UNKNOWN, "unknown: waiting for can_bridge's parameters")
        #: share 0..1 of the wearer's arm within rated torque everywhere, 0 if none is, 'none' without a wearer
        self.largest_support = UNKNOWN
        self._logger = node.get_logger()
        self._bridge = NodeParameters(node, "can_bridge", once=True, fitting=fitting)
        self._checked: object = None  # what the motors were last found to hold, or not

    def update(self, names: Sequence[str], s: Settings) -> None:
        """Check the compensator's settings if they are new; names: of the joints (n,)."""
        self._bridge.update()
        support = (1.0 if s.support_adapts else s.support) if s.mode == "zero_g" else 0.0
        arms, springs = (s.loaded, s.worn(s.loaded)), (s.joint_spring, s.tissue)
        carried, bridge = (*arms, springs, support, s.use_imu), self._bridge.values
        if not bridge.keys() >= BRIDGE_PARAMETERS or carried == self._checked:
            return
        self._checked, self.largest_support = carried, UNKNOWN
        try:
            if len(bridge["motor"]) != len(names):
                raise ParameterError(
                    "motor", bridge["motor"], f"{len(names)} motors, one for each of {', '.join(names)}"
                )
            tilt = math.radians(USUAL_TILT) if s.use_imu else 0.0
            bounds = workspace(bridge["position_min"], bridge["position_max"], tilt)
            joints = budget(*arms, springs, support, bounds, *motor_torques(bridge))
        except ParameterError as error:
            self.result = Status(Budget.UNKNOWN, f"unknown: can_bridge has {error}")
        else:
            overloaded = overload(names, joints)
            code = Budget.ABOVE_RATED if overloaded else Budget.WITHIN_RATED
            self.result = Status(code, overloaded or "within rated torque everywhere")
            self.largest_support = NONE if arms[0] == arms[1] else f"{largest_support(joints) or 0.0:g}"
        if self.result.code != Budget.WITHIN_RATED:
            self._logger.warning(f"{self.result}; efforts stay clamped to max_effort")


class Trunk:
    """The trunk's tilt and motion, from the topics of the IMU. settings: of its arm's compensator."""

    def __init__(self, node: Node, settings: Settings) -> None:
        self._side = settings.side
        self.tilt = TiltInput(settings.side, settings.tilt_timeout)
        self._felt_at, self._force, self._rate = -math.inf, ZERO, ZERO  # monotonic s, m/s^2, rad/s
        self._subscription = TiltSubscription(node, self.tilt, threading.Lock(), on_motion=self._on_motion)

    def at(self, now: float) -> tuple[Tilt, Floats3, Tilt] | None:
        """Return the tilt of what the trunk feels as gravity, its angular velocity, and the tilt of gravity alone.

        now: monotonic s. The angular velocity is in the arm's base frame, (3,) rad/s. None if none is fresh.
        """
        self._subscription.poll()
        gravity = None if self.tilt.problem(now) else self.tilt.at(now)
        if now - self._felt_at < FRESH and FELT.range[0] < math.hypot(*self._force) < FELT.range[1]:
            tilt = Tilt.of_felt(self._side, [-component for component in self._force], STANDARD_GRAVITY)
            return tilt, turning_in_base(self._side, self._rate), gravity or tilt
        return (gravity, ZERO, gravity) if gravity else None

    def _on_motion(self, now: float, force: Floats3, rate: Floats3, _age: float) -> None:
        self._felt_at, self._force, self._rate = now, force, rate


class WearerNode(ThreadedNode):
    """The ROS shell around a `WearerWatch`.

    The estimate has a thread of its own: rclpy's executor would take more of the processor than the arithmetic does.
    """

    def __init__(self) -> None:
        super().__init__("wearer", automatically_declare_parameters_from_overrides=True)
        declare(self, ())
        name = f"{self.get_namespace().rstrip('/')}/{COMPENSATOR}"
        self._compensator = NodeParameters(self, name, self._on_parameters, fitting=fitting)
        self._status_name = name.lstrip("/")
        self._bridge_name = f"{self.get_namespace().strip('/')}/can_bridge".lstrip("/")
        self._answers = 0  # of the compensator, since its start
        self._statuses = Statuses(self)
        self.create_subscription(ParameterEvent, "/parameter_events", self._on_parameter_event, 50)
        self._budget = BudgetWatch(self)
        self._diagnostics = Diagnostics(self)
        self._efforts, self._deviations = (
            self.create_publisher(JointState, f"wearer_efforts{part}", 1) for part in ("", "_std")
        )
        self._requests = self.create_publisher(JointState, TOPIC, 1)
        self._request_due, self._requested = -math.inf, 0.0  # s, and the last one
        # Of the compensator: its parameters, what never changes of them, and why they cannot be used.
        self._settings: Settings | None = None
        self._fixed: tuple[object, ...] = ()
        self._refusal = Status(NoEstimate.NO_PARAMETERS, f"waiting for the parameters of {self._status_name}")
        # Of an arm from a URDF: its text where it comes from a topic, and the arm, None for the paper's.
        self._description = ""
        self._descriptions: Any = None  # the topic's subscription
        self._urdf: UrdfArm | None = None
        # What is read and reported, once the parameters are known.
        self._names: list[str] = []
        self._joint_states: PolledSubscription | None = None
        self._trunk: Trunk | None = None
        self._watch: WearerWatch | None = None
        self._lock = threading.Lock()  # guards the watch
        self._due = 0.0  # monotonic s
        self._newest: tuple[float, JointState | None] = (-math.inf, None)  # monotonic s of its arrival
        self._problem = NO_REASON  # with the newest sample
        self._last = -math.inf  # monotonic s of the newest sample
        self.create_timer(PARAMETER_PERIOD, self._follow_compensator)
        self.create_timer(REPORT_PERIOD, self._report)
        self.threads.append(PeriodicThread("estimate", self._tick, 0.0))
        self.threads[0].start()

    def _follow_compensator(self) -> None:
        """Read the compensator's parameters if they may have changed."""
        answers = 0
        with suppress(ValueError):  # another program may publish a status of that name
            answers = int(self._statuses.within(COMPENSATOR_SILENCE, self._status_name).get("answers", "0"))
        if answers < self._answers:  # silent, or restarted: it may have other parameters
            self._compensator.refresh()
        self._answers = answers
        self._compensator.update()
        if self._settings:
            self._budget.update(self._names, self._settings)

    def _on_parameter_event(self, event: ParameterEvent) -> None:
        if event.node.lstrip("/") == self._status_name:
            self._compensator.refresh()

    def _on_parameters(self, _name: str, values: dict[str, Any]) -> None:
        """Use the compensator's parameters, or note why they cannot be used."""
        self._settings = None
        try:
            settings = self._read(values)
        except (ParameterError, KeyError) as error:
            # A KeyError: of another version, or another program's node.
            what = f"no parameter {error}" if isinstance(error, KeyError) else error
            self._refusal = Status(NoEstimate.REFUSED_PARAMETERS, f"the compensator has {what}")
            return
        if settings is None:
            self._refusal = Status(NoEstimate.NO_DESCRIPTION, f"waiting for the arm's URDF on {values['urdf.topic']}")
            return
        is_multi_array = values.get("command_interface") == "multi_array"
        topic = values["multi_array.joint_states"] if is_multi_array else "joint_states"
        urdf = (values.get(f"urdf.{part}") for part in ("file", "topic", "hand"))
        fixed = (values["joint_names"], settings.side, settings.use_imu, topic, *urdf)
        if self._watch is None:
            self._fixed, self._names = fixed, values["joint_names"]
            self._joint_states = PolledSubscription(self, JointState, topic, self._on_joint_state)
            self._trunk = Trunk(self, settings) if settings.use_imu else None
            self._watch = WearerWatch(self._names, settings)
        if fixed != self._fixed:
            self._refusal = Status(
                NoEstimate.REFUSED_PARAMETERS,
                "the compensator has another arm or another trunk than before: restart this node",
            )
            return
        with self._lock:
            self._watch.apply(settings)
        if self._trunk:
            self._trunk.tilt.timeout = settings.tilt_timeout
        self._settings, self._refusal = settings, NO_REASON

    def _read(self, values: dict[str, Any]) -> Settings | None:
        """Return the settings of the compensator's parameters; None while its URDF has not arrived on its topic.

        Raises ParameterError.
        """
        if "urdf.file" not in values:
            return settings_of({**values, "law": "exact"})  # by which the wearer's torque is estimated in any case
        if self._urdf is None:
            text = read_urdf(values["urdf.file"]) if values["urdf.file"] else self._description
            if not text and self._descriptions is None:
                topic = values["urdf.topic"]
                self._descriptions = self.create_subscription(String, topic, self._on_description, LATCHED)
            if not text:
                return None
            self._urdf = arm_from(values, text)
        return settings_of(values, self._urdf)

    def _on_description(self, message: String) -> None:
        self._description = message.data
        self._compensator.refresh()

    def _on_joint_state(self, message: JointState, info: dict[str, Any]) -> None:
        age = (self.get_clock().now().nanoseconds - info["received_timestamp"]) * 1e-9
        self._newest = time.monotonic() - max(0.0, age), message

    def _tick(self) -> None:
        now = time.monotonic()
        self._due = max(self._due + PERIOD, now)
        time.sleep(self._due - now)
        self._estimate()

    def _estimate(self) -> None:
        """Publish the estimate from the newest joint state, if it is new."""
        settings, watch = self._settings, self._watch
        if not settings or not watch or not self._joint_states or self._missing:
            return
        self._joint_states.poll()
        taken, message = self._newest
        if message is None or taken <= self._last:
            return
        self._last = taken
        upright = Tilt.of(settings.side)
        joints, trunk = self._joints(message), self._trunk.at(taken) if self._trunk else (upright, ZERO, upright)
        # An arm of ros2_control has no bridge that says what it does.
        bridge = self._statuses.within(COMPENSATOR_SILENCE, self._bridge_name)
        with self._lock:
            estimate = watch.update(taken, joints, trunk, bridge.get("state", State.ACTIVE) == State.ACTIVE)
        self._problem = NO_REASON
        if estimate:
            for publisher, values in ((self._efforts, estimate.torque), (self._deviations, estimate.deviation)):
                statement = JointState(name=self._names, effort=values.tolist())
                statement.header.stamp = message.header.stamp
                publisher.publish(statement)
        elif trunk is None:
            self._problem = Status(NoEstimate.NO_TILT, "no fresh tilt of the trunk")
        else:
            self._problem = Status(
                NoEstimate.INCOMPLETE_JOINT_STATES,
                "joint_states have no possible positions, velocities and efforts of these joints",
            )
        self._ask_for_support()

    def _joints(self, message: JointState) -> list[tuple[float, ...]] | None:
        """Return positions, velocities and efforts (n,); None if one is missing, or beyond MOST."""
        try:
            if self._urdf:
                self._urdf.follow(message.name, message.position)
            parts = [by_name(message, field, self._names, exact=False) for field in ("position", "velocity", "effort")]
        except ParameterError:
            return None
        return parts if max(map(abs, chain(*parts))) <= MOST else None

    def _ask_for_support(self) -> None:
        """Renew the request, or change it at once."""
        requested, now = self._watch.adaptation.requested if self._watch else None, time.monotonic()
        if requested is None or (now < self._request_due and requested == self._requested):
            return
        self._request_due, self._requested = now + REQUEST_PERIOD, requested
        request = JointState(name=[NAME], position=[requested])
        request.header.stamp = self.get_clock().now().to_msg()
        self._requests.publish(request)

    @property
    def _missing(self) -> Status:
        """What is missing of the compensator, false if nothing is."""
        if self._statuses.within(COMPENSATOR_SILENCE, self._status_name):
            return self._refusal
        return Status(NoEstimate.NO_COMPENSATOR, f"waiting for {self._status_name}")

    def _why_not(self, now: float) -> tuple[bytes, WearerState, Status]:
        """Return level, state, and why nothing is estimated."""
        problem = self._missing
        if not problem and now - self._last > SILENCE:
            problem = Status(NoEstimate.NO_JOINT_STATES, "waiting for joint_states")
            if math.isfinite(self._last):
                return STALE, WearerState.STOPPED, problem
        problem = problem or self._problem
        return (WARN, WearerState.WAITING, problem) if problem else (OK, WearerState.ESTIMATING, NO_REASON)

    def _report(self) -> None:
        now, budget = time.monotonic(), self._budget
        level, state, why_not = self._why_not(now)
        values: dict[str, object] = {"state": state, "reason": why_not.code, "budget": budget.result.code}
        values |= {"budget text": budget.result, "largest support": budget.largest_support}
        if self._watch and not self._missing:
            with self._lock:
                values |= self._watch.values(now)
        else:
            values |= {**values_of(self._names, None, None), "support adapts": Adapts.OFF, "support asked for": NONE}
        self._diagnostics.report(level, why_not.text or "estimating the wearer's torque", values)


def main() -> None:
    """Entry point of the executable `wearer`."""
    raise SystemExit(run(WearerNode, priority=5))  # below the control loop
