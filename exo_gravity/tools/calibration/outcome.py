"""What a calibration found: the values for the new YAML, the sentences for the person, and the data for the page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from exo_gravity.tools.inputs.arms import ConfiguredArm

if TYPE_CHECKING:
    from exo_gravity.core.calibration.identification import Identified, Observation

Value = bool | int | float | str | list[int] | list[float] | list[str]


class Change(NamedTuple):
    """A new value of a parameter.

    node: '/right/compensator'. name: dotted, 'robot.first_moment'. note: uncertainty and unit, for a comment in the
    file.
    """

    node: str
    name: str
    value: Value
    note: str = ""


class Curve(NamedTuple):
    """Friction of one joint: speed (n,) rad/s, torque (n,) Nm measured, fit (n,) Nm."""

    speed: np.ndarray
    torque: np.ndarray
    fit: np.ndarray


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of one subcommand of `calibrate`.

    changes: written unless there are `refusals`, the sentences on why it is not calibrated. lines: the result in
    sentences. arm: as configured before. suggestion: the next best pose, (4,) rad, None if none is wanted.
    """

    changes: tuple[Change, ...]
    lines: tuple[str, ...]
    refusals: tuple[str, ...] = ()
    arm: ConfiguredArm | None = None
    observations: tuple[Observation, ...] = ()
    identified: Identified | None = None
    suggestion: tuple[float, ...] | None = None
    curves: tuple[Curve, ...] = ()
