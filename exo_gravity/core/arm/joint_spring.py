# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Springs that the device has across its joints: cables, hoses, bellows. They are part of the model, like the masses.

In joint n a spring of stiffness k_n [Nm/rad] that is slack at r_n [rad] pulls with -k_n (theta_n - r_n), so the motor
must give k_n (theta_n - r_n) more than gravity needs. Linear in k_n and in k_n r_n: two columns of a joint's regressor,
of which the second is the constant offset that the identification has in any case.

The term `spring` (core/compensation/terms) is another thing: a virtual spring that the motors add.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from exo_gravity.core.arm.gravity import Torque
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.params import check_owned, owned

# Nm/rad. An arm whose spring is not there is pushed away from `rest` with the stiffness that is entered: more than this
# is about what gravity's own slope is on a light arm, g times 0.2 kg m.
MAX_STIFFNESS = 2.0
MAX_REST = 3.15  # rad, half a turn


@dataclass(frozen=True)
class JointSpring:
    """The spring of each joint. Raises ParameterError."""

    stiffness: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT,
        "of the device's own springs, such as cables, by `calibrate`",
        (0.0, MAX_STIFFNESS),
        "Nm/rad",
        expert=True,
    )
    rest: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT, "angle at which each of them is slack", (-MAX_REST, MAX_REST), "rad", expert=True
    )
    on: bool = field(init=False, repr=False, compare=False)  #: whether any joint has one

    def __post_init__(self) -> None:
        check_owned(self, len(self.stiffness))
        object.__setattr__(self, "on", any(self.stiffness))

    def torque(self, theta: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm that holds the joints at `theta` (n,) rad against their springs."""
        return tuple([k * (q - rest) for k, q, rest in zip(self.stiffness, theta, self.rest, strict=True)])

    def torques(self, theta: np.ndarray) -> np.ndarray:
        """Return the same for poses (m, n) in rad: (m, n) Nm."""
        return np.asarray(np.asarray(self.stiffness) * (theta - np.asarray(self.rest)))

    def largest(self, low: Sequence[float], high: Sequence[float]) -> Torque:
        """Return the largest torque (n,) in Nm between the joint limits `low` and `high`, (n,) rad each."""
        columns = zip(self.stiffness, self.rest, low, high, strict=True)
        return tuple([k * max(abs(least - rest), abs(most - rest)) for k, rest, least, most in columns])
