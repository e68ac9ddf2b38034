"""The settings of the compensator, checked against each other, and what follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from exo_gravity.core.compensation.terms.settings import TermSettings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.anfis_law import AnfisLaw
from exo_gravity.core.model.arm import MAX_TOTAL_MASS, ArmModel
from exo_gravity.core.model.gravity import LAWS, NO_TORQUE, Law
from exo_gravity.core.model.rotation import Floats3
from exo_gravity.core.model.tilt import SIDES
from exo_gravity.core.params import check_owned, owned
from exo_gravity.core.safety.limits import MAX_COMMAND
from exo_gravity.core.trunk.tilt_input import STILL

MODES = ("one_g", "zero_g")
LAW_NAMES = (*LAWS, "anfis")
# Gain times gravity, m/s^2: twice the Earth's, rounded up. Calibrated gains are 0.8 to 1.3.
MAX_SCALE = 20.0


@dataclass(frozen=True)
class Settings:
    """Settings of the compensator. All but `side` and `use_imu` may change while the arm is worn.

    side: 'left' or 'right'. robot: the exoskeleton's own arm. wearer_mass (4,) kg, wearer_cog (4,) m: the wearer's
    segments on each link. shoulder_from_imu: (3,) m in the trunk's axes, for `inertial`. use_imu: False assumes an
    upright trunk. anfis: the model for the law 'anfis'. robot_by_mass: the robot by its masses, for `terms`; None for
    `robot`. The other fields are parameters of `compensator`. Derived: `arm` is the compensated arm, which is the robot
    in One-G and the robot plus `support` times the wearer in Zero-G; `moving`, the same by its masses; `active_law`,
    the law in use. Raises ParameterError.
    """

    side: str
    robot: ArmModel
    law: str = owned("exact", "law that computes the gravity torque", choices=LAW_NAMES)
    mode: str = owned("one_g", "one_g compensates the robot; zero_g also compensates the wearer's arm", choices=MODES)
    support: float = owned(1.0, "share of the wearer's arm that zero_g compensates", (0.0, 1.0))
    wearer_mass: Sequence[float] = NO_TORQUE
    wearer_cog: Sequence[float] = NO_TORQUE
    max_total_mass: float = owned(
        10.0, "largest total mass; a larger one probably has the wrong unit", (0.5, MAX_TOTAL_MASS), "kg"
    )
    max_effort: Sequence[float] = owned((3.0, 9.0, 3.0, 3.0), "torque limit per joint", (0.0, MAX_COMMAND), "Nm")
    max_effort_rate: float = owned(50.0, "fastest change of torque", (1.0, 1000.0), "Nm/s")
    transition_time: float = owned(1.0, "time over which a change of mass, mode or law takes effect", (0.2, 30.0), "s")
    tilt_timeout: float = owned(0.08, "age of the trunk tilt at which the efforts are withdrawn", (0.01, 0.5), "s")
    inertial: bool = owned(False, "also compensate the trunk's acceleration, as its IMU measures it")
    shoulder_from_imu: Floats3 = STILL
    use_imu: bool = True
    anfis: AnfisLaw | None = None
    terms: TermSettings = field(default_factory=TermSettings)
    robot_by_mass: ArmModel | None = None
    arm: ArmModel = field(init=False)
    moving: ArmModel = field(init=False)
    active_law: Law = field(init=False)

    def __post_init__(self) -> None:
        if self.side not in SIDES:
            raise ParameterError("side", self.side, f"one of {', '.join(SIDES)}")
        check_owned(self)
        law = self.anfis if self.law == "anfis" else LAWS[self.law]
        if law is None:
            raise ParameterError("law", self.law, "used with anfis_file, a model from train_anfis")
        if self.law != "exact":
            self.robot.check_masses(f"law {self.law}")
        # Computed in every mode, so that an impossible wearer is refused now and not when the mode becomes zero_g.
        whole = self.robot.with_wearer(self.wearer_mass, self.wearer_cog, self.support)
        if whole.total_mass > self.max_total_mass:
            robot, wearer = self.robot.total_mass, whole.total_mass - self.robot.total_mass
            bound = f"at most max_total_mass = {self.max_total_mass:g} (robot {robot:.2f}, wearer's share {wearer:.2f})"
            raise ParameterError("total mass in kg", round(whole.total_mass, 2), bound)
        if max(self.robot.scale) > MAX_SCALE:
            scale = [round(value, 2) for value in self.robot.scale]
            raise ParameterError("gain times gravity", scale, f"at most {MAX_SCALE:g} m/s^2, twice the Earth's gravity")
        by_mass = self.robot_by_mass or self.robot
        self.terms.check(by_mass)
        carried = by_mass.with_wearer(self.wearer_mass, self.wearer_cog, self.support)
        object.__setattr__(self, "arm", whole if self.mode == "zero_g" else self.robot)
        object.__setattr__(self, "moving", carried if self.mode == "zero_g" else by_mass)
        object.__setattr__(self, "active_law", law)
