"""compensator: joint states and trunk tilt in, effort commands out, at the rate at which joint states arrive.

It has no timer: each joint state is answered at once, with the joint state's stamp, so that `can_bridge` can tell how
old the reading is. Where there is no safe answer it withdraws: it sends a command without efforts, and puts the reason
on /diagnostics. To `can_bridge` silence means the same, a little later.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from exo_gravity.core.anfis_law import AnfisLaw
from exo_gravity.core.arm import ArmModel
from exo_gravity.core.budget import USUAL_TILT
from exo_gravity.core.compensator import Answer, Compensator
from exo_gravity.core.compensator_settings import Settings
from exo_gravity.core.control_params import COMPENSATOR, settings_of
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.terms.spring import PosePath
from exo_gravity.hardware.scheduling import request_real_time
from exo_gravity.nodes.assist_efforts import AssistEfforts
from exo_gravity.nodes.budget_watch import BudgetWatch
from exo_gravity.nodes.conversions import by_name, velocity_of
from exo_gravity.nodes.declare import declare, values_after, with_floats
from exo_gravity.nodes.diagnostics import ERROR, OK, WARN, Diagnostics
from exo_gravity.nodes.hot_path import HotPath
from exo_gravity.nodes.run import run
from exo_gravity.nodes.sole_publisher import DISTRUST, SolePublisher
from exo_gravity.nodes.tilt_subscription import NEWEST, TiltSubscription

SILENCE = 0.5  # s without joint states until diagnostics report it
REPORT_PERIOD = 0.5  # s
Loaded = TypeVar("Loaded")
MAX_CHANGES = 16  # answers whose reason is new, waiting for the report


def read_settings(values: dict[str, Any]) -> Settings:
    """Return the settings that parameter values describe, with the files they name, or raise ParameterError."""
    anfis = _loaded(AnfisLaw.load, values, "anfis_file", "a file from train_anfis")
    return settings_of(values, anfis, _loaded(PosePath.load, values, "spring.path_file", "a file with a path"))


def _loaded(load: Callable[[str], Loaded], values: dict[str, Any], name: str, expected: str) -> Loaded | None:
    """Return what is in the file that parameter `name` gives, None if it gives none. Raises ParameterError."""
    path = values[name]
    try:
        return load(Path(path).read_text(encoding="utf-8")) if path else None
    except (OSError, UnicodeDecodeError, DataError) as error:
        raise ParameterError(name, path, f"{expected} ({error})") from None


class CompensatorNode(Node):
    """The ROS shell around `core.compensator.Compensator`."""

    def __init__(self) -> None:
        super().__init__("compensator", automatically_declare_parameters_from_overrides=True)
        values = declare(self, COMPENSATOR)
        self._names = values["joint_names"]
        self._compensator = Compensator(read_settings(values), self._names)
        self._diagnostics = Diagnostics(self)
        self._budget = BudgetWatch(self, self._names, math.radians(USUAL_TILT) if values["use_imu"] else 0.0)
        self._answer = Answer(None)
        self._changes: deque[Answer] = deque(maxlen=MAX_CHANGES)
        self._last_answer = -math.inf
        self._answers = 0
        self._refusal = "none"
        self._source = SolePublisher(self, "joint_states")
        # Which input had a second publisher, as a sentence, and when (monotonic s).
        self._intruder, self._intruded = "", -math.inf
        self._publisher = self.create_publisher(JointState, "effort_commands", 1)
        self._command = JointState(name=self._names)  # one message, reused
        self._lock = threading.Lock()  # guards the compensator: joint states arrive on another thread
        self._assist = AssistEfforts(self, self._compensator.terms.assist, self._lock)
        self._joint_states = HotPath(self, JointState, "joint_states", self._on_joint_states, NEWEST)
        if values["use_imu"]:
            TiltSubscription(self, self._compensator, self._lock, self._refused, self._withdraw, self._on_motion)
        self.add_pre_set_parameters_callback(lambda changes: with_floats(self, COMPENSATOR, changes))
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        # Only the executor's thread reports: diagnostics and budget are not for two threads.
        self._changed = self.create_guard_condition(self._report_changes)
        self.create_timer(REPORT_PERIOD, self._report_current)
        self._log(self._compensator.settings)
        self._assist.start()
        self._joint_states.start()
        for refused in request_real_time(values["thread_priority"], values["lock_memory"]):
            self.get_logger().warning(refused)

    @property
    def failure(self) -> Exception | None:
        """The exception that ended the thread of the joint states, or that of the assistance."""
        return self._joint_states.failure or self._assist.failure

    def close(self) -> None:
        """Stop answering joint states."""
        self._joint_states.stop()
        self._assist.stop()

    def _on_joint_states(self, message: JointState, info: dict[str, Any]) -> None:
        command = self._command
        command.header.stamp = message.header.stamp
        now = time.monotonic()
        try:
            if self._source.is_another(info):
                self._withdraw("joint_states")
            theta = by_name(message, "position", self._names)
            velocity = velocity_of(message, self._names)
            with self._lock:
                answer = self._compensator.step(now, theta, velocity)
        except ParameterError as error:
            answer = Answer(None, self._refused("joint_states", error))
        if now - self._intruded < DISTRUST:
            answer = Answer(None, self._intruder)
        command.effort = answer.effort or ()
        self._answers += answer.effort is not None
        self._publisher.publish(command)
        changed = answer.reason != self._answer.reason
        self._answer, self._last_answer = answer, now
        if changed:
            self._changes.append(answer)
            self._changed.trigger()

    def _on_motion(self, *sample: Any) -> None:
        if self._compensator.settings.inertial:
            self._compensator.set_motion(*sample)

    def _withdraw(self, topic: str) -> None:
        """Withdraw for a while: a second publisher sends on `topic`."""
        self._intruder, self._intruded = f"more than one publisher of {topic}", time.monotonic()

    def _refused(self, topic: str, error: ParameterError) -> str:
        """Note an impossible message. Its value goes to /diagnostics only: a hostile sender could fill the log."""
        self._refusal = f"{topic}: {error}"
        return f"{topic}: {error.name} must be {error.expected}"

    def _check_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            read_settings(values_after(self, COMPENSATOR, changes))
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, _changes: list[Parameter]) -> None:
        try:
            settings = read_settings(values_after(self, COMPENSATOR))
        except ParameterError as error:  # checked just before: only a file can have changed since
            self.get_logger().error(f"parameters not applied: {error}")
            return
        with self._lock:
            self._compensator.apply(settings)
        self._log(settings)

    def _log(self, s: Settings) -> None:
        of_wearer = f", wearer {_row(s.wearer_mass)} kg at {_row(s.wearer_cog)} m" if any(s.wearer_mass) else ""
        self.get_logger().info(
            f"{s.side} arm, law {s.law}, mode {s.mode}, support {s.support:g}: compensates {s.arm.total_mass:.2f} kg, "
            f"at most {_row(s.max_effort)} Nm; robot {_of_robot(s.robot)}{of_wearer}"
        )

    def _values(self) -> dict[str, object]:
        """Return the current values for /diagnostics."""
        s = self._compensator.settings
        return {
            "law": s.law,
            "mode": s.mode,
            "support": s.support,
            "answers": self._answers,
            "robot mass (kg)": "not known" if s.robot.by_moments else _row(s.robot.mass),
            "robot cog (m)": "not known" if s.robot.by_moments else _row(s.robot.cog),
            "robot moments (kg m)": _row((*s.robot.first_moment, *s.robot.off_axis)),
            "wearer mass (kg)": _row(s.wearer_mass),
            "wearer cog (m)": _row(s.wearer_cog),
            "mass carried (kg)": f"{s.arm.total_mass:.3f}",
            "max effort (Nm)": _row(s.max_effort),
            **self._of_terms(),
            "budget": self._budget.text,
            "last refused message": self._refusal,
        }

    def _of_terms(self) -> dict[str, object]:
        terms = self._compensator.terms
        return {
            "terms": ", ".join(terms.active) or "none",
            "assist": terms.assist.report,
            "inertia tank (J)": f"{terms.energy:.2f}",
        }

    def _report_changes(self) -> None:
        while self._changes:
            self._report(self._changes.popleft())

    def _report_current(self) -> None:
        self._budget.update(self._compensator.settings)
        self._report_changes()
        self._report(self._answer)

    def _report(self, answer: Answer) -> None:
        values = self._values()
        if time.monotonic() - self._last_answer > SILENCE:
            self._diagnostics.report(WARN, "waiting for joint_states", values)
        elif answer.effort is None:
            self._diagnostics.report(ERROR, f"withdrawn: {answer.reason}", values)
        elif answer.fallback:
            self._diagnostics.report(
                WARN, f"the exact law replaces {self._compensator.settings.law}: {answer.fallback}", values
            )
        elif answer.clamped:
            joints = ", ".join(self._names[joint] for joint in answer.clamped)
            self._diagnostics.report(WARN, f"gravity exceeds max_effort: {joints}", values)
        elif problem := self._compensator.terms.problem:
            self._diagnostics.report(WARN, f"gravity compensation alone: {problem}", values)
        else:
            self._diagnostics.report(OK, "compensating", values)


def _of_robot(robot: ArmModel) -> str:
    along = f"{_row(robot.mass)} kg at {_row(robot.cog)} m"
    if robot.by_moments:
        along = f"moments {_row(robot.first_moment)} kg m"
    return f"{along}, across the links {_row(robot.off_axis)} kg m" if any(robot.off_axis) else along


def _row(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.3f}".rstrip("0").rstrip(".") for value in values)


def main() -> None:
    """Entry point of the executable `compensator`."""
    raise SystemExit(run(CompensatorNode, priority=15))
