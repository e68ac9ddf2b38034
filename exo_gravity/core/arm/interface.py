# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What everything that carries an arm of n joints asks of it: gravity, inertia, and what it holds.

`ArmModel` (core/arm/paper.py) is the paper's arm in closed form, `UrdfArm` (hardware/urdf_arm.py) any serial arm
that a URDF describes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from exo_gravity.core.arm.rotation import ZERO, Floats3
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.numbers import Torque, Vector

STANDARD_GRAVITY = 9.80665  # m/s^2, ISO 80000-3; the paper rounds to 9.8

# These bounds catch wrong units (grams for kilograms, millimetres for metres), not unusual designs.
MAX_MASS = 20.0  # kg per link; the whole arm of a 150 kg person weighs about 8 kg
MAX_PAYLOAD = 5.0  # kg in the hand; at 0.7 m from the shoulder it takes 34 Nm, about twice an AK80-9's peak torque
MAX_REACH = 0.5  # m of its centre of gravity from the hand
MAX_GAIN = 2.0
MAX_GRAVITY = 25.0  # m/s^2


class Payload(NamedTuple):
    """A load in the hand."""

    mass: float = 0.0  #: kg
    cog: Floats3 = ZERO  #: m, its centre of gravity in the frame of the hand


NO_LOAD = Payload()


class Frames(NamedTuple):
    """Where the n joints of an arm are in m poses, how they and their links are turned, in the axes of its base."""

    before: np.ndarray  #: (m, n, 3, 3) how the joints' frames would be turned with the joint itself at 0
    after: np.ndarray  #: (m, n, 3, 3) how the links' frames are turned, in which their first moments are
    places: np.ndarray  #: (m, n + 1, 3) m, where the joints are, and the hand, or the last joint again


class Skeleton(NamedTuple):
    """What `can_bridge` needs to compute the gravity of an arm of n joints itself, in the root link's axes."""

    axes: np.ndarray  #: (n, 3), unit vectors along the joints' axes while all angles are 0; (0, 3): the paper's
    ways: np.ndarray  #: (n, 3), unit vectors along the links, zeros for one without length; (0, 3): the paper's
    moments: np.ndarray  #: (n,) kg m, largest first moment along each link, with all mass beyond it
    beside: np.ndarray  #: (n,) kg m, bound on the first moment about each joint of mass that lies off the links' axes


class Links(Protocol):
    """The inertia of an arm's links, of what they hold, and of the rotors where these are known."""

    def torque(self, theta: Sequence[float], velocity: Sequence[float], acceleration: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm for theta rad, velocity rad/s and acceleration rad/s^2, (n,) each."""
        ...

    def momentum(
        self, theta: Sequence[float], velocity: Sequence[float], turning: Floats3 = ZERO
    ) -> tuple[Torque, Torque]:
        """Return the generalized momentum p = M v, (n,) kg m^2/s, and C^T v, (n,) Nm, with M' = C + C^T.

        turning: angular velocity of the base in its own axes, (3,) rad/s.
        """
        ...

    def matrix(self, theta: Sequence[float]) -> np.ndarray:
        """Return the mass matrix (n, n) in kg m^2 at `theta` (n,) rad."""
        ...

    @property
    def least(self) -> tuple[float, ...]:
        """The least inertia (n,) in kg m^2 that each joint feels in any pose, the other joints being free."""
        ...


class Arm(Protocol):
    """An arm of n joints with what it holds. Immutable; equal arms have equal hashes."""

    @property
    def length(self) -> Vector:
        """(n,) m of each link."""
        ...

    @property
    def gain(self) -> np.ndarray:
        """(n,) By which the torque of each joint is scaled, the paper's c_n."""
        ...

    @property
    def gravity(self) -> float:
        """m/s^2."""
        ...

    @property
    def scale(self) -> tuple[float, ...]:
        """(n,) m/s^2, gain times gravity."""
        ...

    @property
    def payload(self) -> Payload:
        """The load in the hand."""
        ...

    @property
    def total_mass(self) -> float:
        """Kg of all that the joints carry."""
        ...

    @property
    def given_mass(self) -> float:
        """Kg of it that parameters give, where a wrong unit is likely."""
        ...

    @property
    def has_hand(self) -> bool:
        """Whether it is known where a load is held."""
        ...

    @property
    def links(self) -> Links:
        """The inertia."""
        ...

    @property
    def facts(self) -> Mapping[str, Sequence[float] | None]:
        """What is known of the arm itself, by name and unit, for /diagnostics; None for what is not known."""
        ...

    def frames(self, theta: np.ndarray) -> Frames:
        """Return where the arm is at `theta` (m, n) rad."""
        ...

    def skeleton(self) -> Skeleton | None:
        """Return axes, links and largest moments of all that the arm holds; None if its joints are no single chain."""
        ...

    def with_masses(self, law: str) -> Any:
        """Return this arm for a law of the paper's arm that needs its masses, an `ArmModel`. Raises ParameterError."""
        ...

    def worn_links(self, mass: Vector, cog: Vector) -> Links:
        """Return the inertia with the wearer's whole arm. mass, cog: as in `with_wearer`."""
        ...

    def torque(self, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (n,) in Nm that holds the arm at `theta` (n,) rad."""
        ...

    def torques(self, theta: ArrayLike, direction: ArrayLike) -> np.ndarray:
        """Return the torque (m, n) in Nm that holds the arm at `theta` (m, n) rad.

        direction: (m, 3), gravity's unit vectors in the left arm's base frame, as `Tilt.direction`.
        """
        ...

    def turning_torque(self, side: str, theta: Sequence[float], angular_acceleration: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm that turns the `side` arm at `theta` (n,) rad along with its base.

        angular_acceleration: of the trunk, (3,) rad/s^2 in its own axes.
        """
        ...

    def massless(self, gravity: float) -> Arm:
        """Return an arm with these joints, without any mass, with gains of 1, where gravity is `gravity` m/s^2."""
        ...

    def with_payload(self, mass: float, cog: Vector = ZERO) -> Arm:
        """Return this arm with a load of `mass` kg in its hand, instead of any other. Raises ParameterError.

        cog: (3,) m, its centre of gravity in the frame of the hand.
        """
        ...

    def with_wearer(self, mass: Vector, cog: Vector, support: float = 1.0) -> Arm:
        """Return this arm plus a share `support` (0..1) of the wearer's arm. Raises ParameterError.

        mass, cog: of the wearer's segment on each link, (n,) kg, and (n,) m from the link's joint along the link.
        """
        ...

    def with_wearer_moments(self, moments: Sequence[Vector], support: float = 1.0) -> Arm:
        """Return this arm plus a share `support` (0..1) of what a wearer's arm adds to its moments, in kg m.

        moments: of the paper's arm M1..M4 and W, Z, Y3, Y4, (2, 4); of another (n, 3), of each link along x, y, z of
        its joint's frame. The inertia is that of the arm alone. Raises ParameterError.
        """
        ...
