"""What a term is: a torque on top of gravity compensation, computed from the arm's state.

    Friction, Damping, Spring, Coupling, SoftLimits    frozen dataclasses of parameters, which are terms themselves
    Inertia                                             the same, plus an `EnergyTank`

Each has one parameter that is 0 by default and switches it off. The torque reaches the joint late: the motor's reply,
the computation, the bus. DELAY is what every term must bear without harm; the tests vary it from 0 to 10 ms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.gravity import Torque

DELAY = 0.015  # s from a reading to its torque: 10 ms, and half of a 10 ms cycle in which the torque is held
LATE = 2.0 * DELAY  # s: a spring of k Nm/rad needs the damping LATE k, in Nm s/rad, to be passive despite the delay


class TermState(NamedTuple):
    """The arm as the terms see it.

    time: s. dt: s since the last state, 0 for the first. position, velocity, acceleration: (4,) rad, rad/s and rad/s^2,
    the acceleration low-passed. gravity: (4,) Nm of gravity compensation. elapsed: s since the spring's settings.
    """

    time: float
    dt: float
    position: Sequence[float]
    velocity: Sequence[float]
    acceleration: Sequence[float]
    gravity: Sequence[float]
    elapsed: float


class Term(Protocol):
    """One contribution to the torque on top of gravity compensation."""

    @property
    def on(self) -> bool:
        """Whether the parameters ask for any torque."""
        ...

    def torque(self, state: TermState) -> Torque:
        """Return the torque (4,) in Nm that the motors add."""
        ...


def clamp(value: float, limit: float) -> float:
    """Return `value` limited to -limit..limit."""
    return max(-limit, min(limit, value))


def check_stiffness(name: str, stiffness: Sequence[float], least_inertia: Sequence[float]) -> None:
    """Raise ParameterError unless a spring of `stiffness` (4,) Nm/rad can be damped on these inertias (4,) kg m^2.

    A spring that acts DELAY late gives the energy of a damping of -stiffness * DELAY. Virtual damping acts as late, so
    inertia / (2 DELAY) is the most that damps: twice what the spring needs.
    """
    check_stable(name, stiffness, [inertia / (4.0 * DELAY**2) for inertia in least_inertia], "Nm/rad")


def check_stable(name: str, values: Sequence[float], most: Sequence[float], unit: str) -> None:
    """Raise ParameterError that names `name` unless `values` (4,) are at most `most` (4,), both in `unit`."""
    if any(value > limit for value, limit in zip(values, most, strict=True)):
        shown = [round(limit, 3) for limit in most]
        raise ParameterError(name, list(values), f"at most {shown} {unit}, which {1000 * DELAY:.0f} ms late is stable")
