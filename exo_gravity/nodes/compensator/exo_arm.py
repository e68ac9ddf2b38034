"""The exoskeleton's own arm, as `compensator` runs it: its laws, the wearer, the terms, and the torque budget."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from rclpy.node import Node

from exo_gravity.core.compensation.compensator import Answer, Compensator
from exo_gravity.core.compensation.params import COMPENSATOR, settings_of
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.terms.spring import PosePath
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.model.anfis_law import AnfisLaw
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.nodes.compensator.assist_efforts import AssistEfforts
from exo_gravity.nodes.compensator.budget_watch import BudgetWatch
from exo_gravity.nodes.ros.messages import row
from exo_gravity.nodes.ros.parameters import declare

Loaded = TypeVar("Loaded")


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


class ExoArm:
    """Parameters, control and reports of the four-joint arm. lock: guards `control`."""

    table = COMPENSATOR

    def __init__(self, node: Node, lock: threading.Lock) -> None:
        self.values = declare(node, COMPENSATOR)
        names = self.values["joint_names"]
        self.control = Compensator(read_settings(self.values), names)
        self._budget = BudgetWatch(node, names)
        self._assist = AssistEfforts(node, self.control.terms.assist, lock)

    def read(self, values: dict[str, Any]) -> Settings:
        """Return the settings that parameter values describe. Raises ParameterError."""
        return read_settings(values)

    @property
    def failure(self) -> Exception | None:
        """The exception that ended the thread of the assistance."""
        return self._assist.failure

    def start(self) -> None:
        """Start the assistance."""
        self._assist.start()

    def stop(self) -> None:
        """Stop the assistance."""
        self._assist.stop()

    def update(self) -> None:
        """Keep the torque budget up to date."""
        self._budget.update(self.control.settings)

    def on_motion(self, *sample: Any) -> None:
        """Use a sample of the trunk's motion."""
        if self.control.settings.inertial:
            self.control.set_motion(*sample)

    def sentence(self, s: Settings) -> str:
        """Return settings in a sentence for the log."""
        of_wearer = f", wearer {row(s.wearer_mass)} kg at {row(s.wearer_cog)} m" if any(s.wearer_mass) else ""
        return (
            f"{s.side} arm, law {s.law}, mode {s.mode}, support {s.support:g}: compensates {s.arm.total_mass:.2f} kg, "
            f"at most {row(s.max_effort)} Nm; robot {_of_robot(s.robot)}{of_wearer}"
        )

    def concern(self, answer: Answer) -> str:
        """Return why the arm is not carried as set; '' if it is."""
        if answer.fallback:
            return f"the exact law replaces {self.control.settings.law}: {answer.fallback}"
        problem = self.control.terms.problem
        return f"gravity compensation alone: {problem}" if problem else ""

    def report(self, answer: Answer) -> dict[str, object]:
        """Return the current values for /diagnostics."""
        s, terms = self.control.settings, self.control.terms
        return {
            "law": s.law,
            "law in use": "exact" if answer.fallback else s.law,
            "mode": s.mode,
            "support": s.support,
            "robot mass (kg)": "not known" if s.robot.by_moments else row(s.robot.mass),
            "robot cog (m)": "not known" if s.robot.by_moments else row(s.robot.cog),
            "robot moments (kg m)": row((*s.robot.first_moment, *s.robot.off_axis)),
            "wearer mass (kg)": row(s.wearer_mass),
            "wearer cog (m)": row(s.wearer_cog),
            "mass carried (kg)": f"{s.arm.total_mass:.3f}",
            "max effort (Nm)": row(s.max_effort),
            "terms": ", ".join(terms.active) or "none",
            "assist": terms.assist.report,
            "inertia tank (J)": f"{terms.energy:.2f}",
            "budget": self._budget.text,
        }


def _of_robot(robot: ArmModel) -> str:
    along = f"{row(robot.mass)} kg at {row(robot.cog)} m"
    if robot.by_moments:
        along = f"moments {row(robot.first_moment)} kg m"
    return f"{along}, across the links {row(robot.off_axis)} kg m" if any(robot.off_axis) else along
