# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arm that `compensator` carries: its parameters, what is reported of it, and where its efforts go.

It is the paper's arm, or with `law: urdf` any serial arm, whose URDF comes from a file or from `robot_description`.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any

from rclpy.node import Node
from rclpy.wait_for_message import wait_for_message
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from exo_gravity.core.arm.tilt import SIDES
from exo_gravity.core.compensation import settings
from exo_gravity.core.compensation.compensator import Compensation, Compensator
from exo_gravity.core.compensation.laws import GROUP
from exo_gravity.core.compensation.load_change import CommandFade
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import Param, installed
from exo_gravity.core.trunk.inputs import TILT
from exo_gravity.core.vocabulary import NONE, UNKNOWN, CompensatorWarning, words
from exo_gravity.hardware.model_file import read_model
from exo_gravity.hardware.urdf_arm import UrdfArm, arm_from, read_urdf
from exo_gravity.nodes.ros.messages import LATE_TILT, by_name, known, row, to_nanoseconds
from exo_gravity.nodes.ros.parameters import declare, given_to
from exo_gravity.nodes.ros.subscriptions import LATCHED, PeriodicThread

DESCRIPTION_TIMEOUT = 10.0  # s in which robot_description must arrive
TICK = 0.01  # s between two messages of a fade

JointReading = tuple[Sequence[float], Sequence[float] | None]  # positions (n,) rad, velocities (n,) rad/s if known
Read = Callable[[dict[str, Any]], Settings]


def declared(node: Node) -> tuple[Sequence[Param], dict[str, Any], Read, UrdfArm | None]:
    """Declare the parameters of the node's arm. Raises ParameterError.

    Returns their table, their values, a function that returns the settings that such values describe, and the arm from
    a URDF, to which the positions of its other joints are told; None for the paper's arm.
    """
    installed(GROUP)  # not while an arm is carried
    table = settings.compensator_table(given_to(node))
    _forget_unused(node, {param.name for param in table})
    values = declare(node, table)
    arm = arm_from(values, _description(node, values)) if "urdf.file" in values else None
    for note in arm.notes if arm else ():
        node.get_logger().warning(note)
    return table, values, lambda values: settings.settings_of(values, arm, read_model), arm


def check_side(namespace: str, side: str) -> None:
    """Raise ParameterError if `side` is not the one that the arm's namespace names, which its can_bridge goes by.

    side: '' for an arm that has none.
    """
    named = namespace.rpartition("/")[2]
    if side and named in SIDES and named != side:
        raise ParameterError("side", side, f"{named}, as the namespace {namespace} says, or the node in another one")


def sentence(s: Settings, side: str) -> str:
    """Return what is compensated, for the log. side: as in `check_side`."""
    how = f"mode {s.mode}, support {s.support:g}, law {s.law}"
    return f"{f'{side} arm, ' if side else ''}{how}: compensates {s.mass:.2f} kg, at most {row(s.max_effort)} Nm"


def report(control: Compensator, answer: Compensation, names: Sequence[str]) -> dict[str, object]:
    """Return what the arm's settings and terms are, for /diagnostics. names: of the joints."""
    s, terms, now = control.settings, control.terms, time.monotonic()
    most, name = max(zip(map(abs, answer.remainder), names, strict=False), default=(0.0, NONE))
    asked, why_not = control.support_request.fresh(now), terms.assist.reason
    worn = tuple(chain.from_iterable(s.wearer_moments))
    facts = {f"robot {what}": UNKNOWN if known is None else row(known) for what, known in s.robot.facts.items()}
    return {
        "law": s.law,
        "changing load": name,
        "load to change (Nm)": f"{most:.1f}" if answer.remainder else NONE,
        "max effort (Nm)": row(s.max_effort),
        "law in use": "exact" if answer.fallback else s.law,
        "mass carried (kg)": f"{s.mass:.3f}",
        "gain": row(s.robot.gain),
        "mode": s.mode,
        "support": s.support,
        "support in use": row([s.support_now]),
        "support request": control.support_request.report(now).code,
        "support requested": NONE if asked is None else row([asked]),
        **facts,
        "wearer mass (kg)": row(s.wearer_mass),
        "wearer cog (m)": row(s.wearer_cog),
        "wearer moments (kg m)": row(worn) if worn else NONE,
        "wearer stiffness (Nm/rad)": row(s.tissue.stiffness),
        "payload mass (kg)": f"{s.payload.mass:.3f}",
        "terms": words(*terms.active),
        "assist": terms.assist.state,
        "assist reason": why_not.code,
        "assist text": why_not,
        "inertia tank (J)": f"{terms.tank.level:.2f}",
    }


def warnings_of(control: Compensator, answer: Compensation, names: Sequence[str]) -> dict[CompensatorWarning, str]:
    """Return what `control` works with although it is not as it should be. names: of the joints."""
    warnings: dict[CompensatorWarning, str] = {}
    problem = control.terms.problem
    if answer.held:
        warnings[CompensatorWarning.LATE_TILT] = answer.held
    if answer.fallback:
        warnings[CompensatorWarning.EXACT_LAW] = f"the exact law replaces {control.settings.law}: {answer.fallback}"
    if problem:
        warnings[CompensatorWarning.TERMS_REFUSED] = f"gravity compensation alone: {problem}"
    if answer.remainder:
        warnings[CompensatorWarning.CHANGING_LOAD] = "changing load"
    if answer.clamped:
        clamped = ", ".join(names[joint] for joint in answer.clamped)
        warnings[CompensatorWarning.CLAMPED] = f"gravity exceeds max_effort: {clamped}"
    return warnings


def _forget_unused(node: Node, used: set[str]) -> None:
    """Undeclare the parameters of the paper's arm, which a file may have, and log them."""
    unused = [param.name for param in settings.COMPENSATOR if param.name not in used and node.has_parameter(param.name)]
    for name in unused:
        node.undeclare_parameter(name)
    if unused:
        node.get_logger().warning(f"law urdf takes the arm from its URDF and ignores {', '.join(unused)}")


def _description(node: Node, values: dict[str, Any]) -> str:
    """Return the URDF from its file or topic. Raises ParameterError."""
    path, topic = values["urdf.file"], values["urdf.topic"]
    if not path:
        from std_msgs.msg import String  # as below

        arrived, message = wait_for_message(String, node, topic, qos_profile=LATCHED, time_to_wait=DESCRIPTION_TIMEOUT)
        if not arrived:
            raise ParameterError("urdf.topic", topic, f"published, latched, within {DESCRIPTION_TIMEOUT:g} s")
        return str(message.data)
    return read_urdf(path)


class JointStateInterface:
    """Answers each joint state with `effort_commands` of the same stamp; without efforts: withdrawn.

    The frame LATE_TILT says that they are computed from a late tilt: the bridge damps the motion meanwhile.
    """

    topic = "joint_states"
    problem = ""

    def __init__(self, node: Node, names: Sequence[str]) -> None:
        self._names = names
        self._publisher = node.create_publisher(JointState, "effort_commands", 1)
        self._command = JointState(name=names)  # one message, reused
        self._still = (0.0,) * len(names)
        self.values: dict[str, object] = {}  # for /diagnostics

    def read(self, message: JointState) -> JointReading:
        """Return positions and velocities of exactly these joints. Raises ParameterError."""
        return by_name(message, "position", self._names), known(message, "velocity", self._names)

    def send(self, now: float, message: JointState, answer: Compensation) -> JointState:
        """Publish the answer to the joint states of `message`, and return it."""
        self._command.header.stamp = message.header.stamp
        self._command.effort = answer.effort or ()
        self._command.header.frame_id = LATE_TILT if answer.held else ""
        self._command.velocity = self._still if answer.damped else ()  # asks for damping about standstill
        self._publisher.publish(self._command)
        return self._command


class MultiArrayInterface(PeriodicThread):
    """Sends Float64MultiArray in the order of `names`; fades to zero when there are no fresh, sound efforts.

    It watches the age of the joint states itself, on its own thread, because the receiver does not (`CommandFade`).
    After a fade zeros follow, for a controller that starts late, until the service `~/clear_fault` is called.
    values: the compensator's parameters.
    """

    def __init__(self, node: Node, names: Sequence[str], values: Mapping[str, Any]) -> None:
        from std_msgs.msg import Float64MultiArray  # not for the paper's arm: 5 % of a start

        super().__init__("fade", self._tick, TICK)
        self.topic = values["multi_array.joint_states"]
        self._names = names
        self._clock = node.get_clock()
        self._timeout = values["multi_array.timeout"]
        self._fade = CommandFade(self._timeout)
        self._lock = threading.Lock()  # guards the fade, and the order of its messages
        self._publisher = node.create_publisher(Float64MultiArray, values["multi_array.topic"], 1)
        self._message = Float64MultiArray()
        self._is_late = False  # the last joint state, by its stamp
        self._applied: Sequence[float] = ()  # Nm, what the joints applied before the first effort
        self._velocity: Sequence[float] | None = None  # rad/s, of the last joint state
        node.create_service(Trigger, "~/clear_fault", self._clear)

    @property
    def problem(self) -> str:
        """Why no efforts are sent; '' while they are."""
        return self._fade.problem

    @property
    def values(self) -> dict[str, object]:
        """What is known of the output, for /diagnostics."""
        return {"output": self._fade.state, "output text": self._fade.reason}

    def read(self, message: JointState) -> JointReading:
        """Return positions and velocities of these joints, which may be some of many.

        Raises ParameterError if one is missing, and if the message is old by its stamp: a driver that lost its hardware
        may go on publishing. Raises it, too, while nothing was sent and the efforts are missing: the controller may
        hold a torque, from which the next one must begin.
        """
        age = (self._clock.now().nanoseconds - to_nanoseconds(message.header.stamp)) * 1e-9
        self._is_late = not -TILT.lead <= age <= self._timeout
        if self._is_late:
            raise ParameterError("age by its stamp", round(age, 3), f"from {-TILT.lead:g} to {self._timeout:g} s")
        if self._fade.state == "waiting":
            self._applied = by_name(message, "effort", self._names, exact=False)
        self._velocity = known(message, "velocity", self._names, exact=False)
        return by_name(message, "position", self._names, exact=False), self._velocity

    def send(self, now: float, message: JointState, answer: Compensation) -> None:
        """Send the answer to a joint state, or begin the fade."""
        with self._lock:
            if self._is_late:
                return  # one late message is not yet a reason to let the arm down
            if answer.effort is None:
                self._fade.withdraw(now, answer.reason.text)
            elif effort := self._fade.take(now, answer.effort, self._applied, self._velocity):
                self._publish(effort)

    def stop(self) -> None:
        """Fade to zero, and end the thread."""
        with self._lock:
            self._fade.withdraw(time.monotonic(), "the node stops")
        while self._fade.state == "fading" and not self.failure:
            time.sleep(TICK)
        super().stop()

    def _tick(self) -> None:
        with self._lock:
            effort = self._fade.tick(time.monotonic())
            if effort is not None:
                self._publish(effort)

    def _publish(self, effort: Sequence[float]) -> None:
        self._message.data = effort
        self._publisher.publish(self._message)

    def _clear(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._lock:
            response.success = self._fade.clear()
        response.message = "cleared: the torque begins" if response.success else "nothing to clear, or still fading"
        return response
