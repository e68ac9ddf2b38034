"""The settings of the compensator, checked against each other, and what follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

from exo_gravity.core.compensation.terms.settings import TermSettings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.anfis import AnfisLaw
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.gravity import LAWS, NO_TORQUE, Law, Torque
from exo_gravity.core.model.kinematics import turning_torque
from exo_gravity.core.model.quaternion import Floats3
from exo_gravity.core.model.tilt import SIDES, Tilt
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.params import check_owned, owned
from exo_gravity.core.safety.limits import MAX_COMMAND

MODES = ("one_g", "zero_g")
LAW_NAMES = (*LAWS, "anfis")
URDF_LAW = "urdf"  # chosen at the start, because it is that of another arm
# Gain times gravity, m/s^2: twice the Earth's, rounded up. Calibrated gains are 0.8 to 1.3.
MAX_SCALE = 20.0
MAX_CARRIED = 10.0  # kg, robot and wearer's share: the arm of a 150 kg wearer has 8; more is probably in another unit


@dataclass(frozen=True)
class Settings:
    """Settings of the exoskeleton's own arm. All but `side` and `use_imu` may change while the arm is worn.

    Raises ParameterError.
    """

    count: ClassVar[int] = JOINT_COUNT

    #: 'left' or 'right'
    side: str
    #: the exoskeleton's own arm
    robot: ArmModel
    law: str = owned("exact", "law that computes the gravity torque", choices=LAW_NAMES)
    mode: str = owned("one_g", "one_g compensates the robot; zero_g also compensates the wearer's arm", choices=MODES)
    support: float = owned(1.0, "share of the wearer's arm that zero_g compensates", (0.0, 1.0))
    #: (4,) kg, the wearer's segment on each link
    wearer_mass: Sequence[float] = NO_TORQUE
    #: (4,) m from joint n, its centre of gravity
    wearer_cog: Sequence[float] = NO_TORQUE
    max_effort: Sequence[float] = owned((3.0, 9.0, 3.0, 3.0), "torque limit per joint", (0.0, MAX_COMMAND), "Nm")
    max_effort_rate: float = owned(50.0, "fastest change of torque", (1.0, 1000.0), "Nm/s", expert=True)
    tilt_timeout: float = owned(
        0.08, "age of the trunk tilt at which the efforts are withdrawn", (0.01, 0.5), "s", expert=True
    )
    inertial: bool = owned(False, "also compensate the trunk's acceleration, as its IMU measures it")
    #: (3,) m in the trunk's axes, for `inertial`
    shoulder_from_imu: Floats3 = (0.0, 0.0, 0.0)
    #: False assumes an upright trunk
    use_imu: bool = True
    #: the model for the law 'anfis'
    anfis: AnfisLaw | None = None
    terms: TermSettings = field(default_factory=TermSettings)
    #: the robot by its masses, for `terms`; None: `robot`
    robot_by_mass: ArmModel | None = None
    #: what is compensated: the robot in One-G, the robot plus `support` times the wearer in Zero-G
    arm: ArmModel = field(init=False)
    #: the same by its masses
    moving: ArmModel = field(init=False)
    #: the law in use
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
        if whole.total_mass > MAX_CARRIED:
            robot, wearer = self.robot.total_mass, whole.total_mass - self.robot.total_mass
            bound = f"at most {MAX_CARRIED:g} (robot {robot:.2f}, wearer's share {wearer:.2f})"
            raise ParameterError("total mass in kg", round(whole.total_mass, 2), bound)
        if max(self.robot.scale) > MAX_SCALE:
            scale = [round(value, 2) for value in self.robot.scale]
            raise ParameterError("gain times gravity", scale, f"at most {MAX_SCALE:g} m/s^2, twice the Earth's gravity")
        by_mass = self.robot_by_mass or self.robot
        carried = by_mass.with_wearer(self.wearer_mass, self.wearer_cog, self.support)
        object.__setattr__(self, "terms", self.terms.on_arm(by_mass))
        object.__setattr__(self, "arm", whole if self.mode == "zero_g" else self.robot)
        object.__setattr__(self, "moving", carried if self.mode == "zero_g" else by_mass)
        object.__setattr__(self, "active_law", law)

    def torque(self, theta: Sequence[float], tilt: Tilt, exact: bool = False) -> Torque:
        """Return the torque (4,) in Nm that holds the arm at `theta` (4,) rad; exact: by the exact law."""
        law = LAWS["exact"] if exact else self.active_law
        return law.torque(self.arm, theta, tilt)

    def outside(self, theta: Sequence[float], tilt: Tilt) -> str:
        """Return why the law does not apply to this pose or tilt, as `Law.outside`; '' if it does."""
        return self.active_law.outside(self.arm, theta, tilt)

    def turning_torque(self, theta: Sequence[float], angular_acceleration: Sequence[float]) -> Torque:
        """Return the torque (4,) in Nm that turns the arm with the trunk, whose acceleration (3,) is in rad/s^2."""
        return turning_torque(self.arm, self.side, theta, angular_acceleration)


class GravityModel(Protocol):
    """An arm of n joints whose torques come from outside `core`."""

    #: the joints' own limits, (n,) Nm; 0 if not known
    max_effort: tuple[float, ...]
    #: kg that the joints carry
    mass: float

    def torque(self, theta: Sequence[float], gravity: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm that holds the arm at `theta` (n,) rad.

        gravity: (3,) m/s^2 in the axes of the arm's root link.
        """
        ...


@dataclass(frozen=True)
class UrdfSettings:
    """Settings of any serial arm of n joints, whose torques come from `arm`."""

    law: ClassVar[str] = URDF_LAW
    side: ClassVar[str] = "left"  # the root link's axes are not mirrored
    inertial: ClassVar[bool] = False
    shoulder_from_imu: ClassVar[Floats3] = (0.0, 0.0, 0.0)
    terms: ClassVar[None] = None

    arm: GravityModel
    #: scales the torque, (n,)
    gain: Sequence[float]
    #: m/s^2
    gravity: float
    #: (n,) Nm
    max_effort: Sequence[float]
    #: Nm/s
    max_effort_rate: float
    #: s
    tilt_timeout: float
    #: False assumes that the root link's z axis points up
    use_imu: bool

    @property
    def count(self) -> int:
        """Number of joints."""
        return len(self.gain)

    def torque(self, theta: Sequence[float], tilt: Tilt, exact: bool = False) -> Torque:
        """Return the torque (n,) in Nm that holds the arm at `theta` (n,) rad."""
        x, y, z = tilt.gravity_in_trunk
        g = self.gravity
        torque = self.arm.torque(theta, (g * x, g * y, g * z))
        return tuple([gain * tau for gain, tau in zip(self.gain, torque, strict=True)])

    def outside(self, theta: Sequence[float], tilt: Tilt) -> str:
        """Return '': the law applies everywhere."""
        return ""

    def turning_torque(self, theta: Sequence[float], angular_acceleration: Sequence[float]) -> Torque:
        """Return zeros (n,): the root link is taken as at rest."""
        return (0.0,) * self.count
