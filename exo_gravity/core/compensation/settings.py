"""The settings of the compensator, checked against each other, and what follows from them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.anfis import AnfisLaw
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.gravity import LAWS, NO_TORQUE, Torque
from exo_gravity.core.model.rotation import Floats3
from exo_gravity.core.model.tilt import SIDES, Tilt
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

    side: str  #: 'left' or 'right'
    robot: ArmModel  #: the exoskeleton's own arm
    law: str = owned("exact", "law that computes the gravity torque", choices=LAW_NAMES)
    mode: str = owned("one_g", "one_g compensates the robot; zero_g also compensates the wearer's arm", choices=MODES)
    support: float = owned(1.0, "share of the wearer's arm that zero_g compensates", (0.0, 1.0))
    wearer_mass: Sequence[float] = NO_TORQUE  #: (4,) kg, the wearer's segment on each link
    wearer_cog: Sequence[float] = NO_TORQUE  #: (4,) m from joint n, its centre of gravity
    max_effort: Sequence[float] = owned((3.0, 9.0, 3.0, 3.0), "torque limit per joint", (0.0, MAX_COMMAND), "Nm")
    max_effort_rate: float = owned(50.0, "fastest change of torque", (1.0, 1000.0), "Nm/s", expert=True)
    tilt_timeout: float = owned(
        0.08, "age of the trunk tilt at which the efforts are withdrawn", (0.01, 0.5), "s", expert=True
    )
    inertial: bool = owned(False, "also compensate the trunk's acceleration, as its IMU measures it")
    shoulder_from_imu: Floats3 = (0.0, 0.0, 0.0)  #: (3,) m in the trunk's axes, for `inertial`
    use_imu: bool = True  #: False assumes an upright trunk
    anfis: AnfisLaw | None = None  #: the model for the law 'anfis'
    terms: TermSettings = field(default_factory=TermSettings)
    robot_by_mass: ArmModel | None = None  #: the robot by its masses, for `terms`; None: `robot`
    #: what is compensated: the robot in One-G, the robot plus `support` times the wearer in Zero-G
    arm: ArmModel = field(init=False)
    moving: ArmModel = field(init=False)  #: the same by its masses

    def __post_init__(self) -> None:
        if self.side not in SIDES:
            raise ParameterError("side", self.side, f"one of {', '.join(SIDES)}")
        check_owned(self)
        if self.law == "anfis" and self.anfis is None:
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

    def torque(self, theta: Sequence[float], tilt: Tilt, exact: bool = False) -> Torque:
        """Return the torque (4,) in Nm that holds the arm at `theta` (4,) rad; exact: by the exact law."""
        if self.law == "anfis" and self.anfis and not exact:
            return self.anfis.torque(self.arm, theta, tilt)
        return LAWS["exact" if exact else self.law](self.arm, theta, tilt)

    def outside(self, theta: Sequence[float], tilt: Tilt) -> str:
        """Return why the law does not apply to this pose or tilt, as `AnfisLaw.outside`; '' if it does."""
        return self.anfis.outside(self.arm, theta, tilt) if self.law == "anfis" and self.anfis else ""


class GravityModel(Protocol):
    """An arm of n joints whose torques come from outside `core`."""

    max_effort: tuple[float, ...]  #: the joints' own limits, (n,) Nm; 0 if not known
    mass: float  #: kg that the joints carry

    def torque(self, theta: Sequence[float], gravity: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm at `theta` (n,) rad; gravity: (3,) m/s^2 in the root link's axes."""
        ...


@dataclass(frozen=True)
class UrdfSettings:
    """Settings of any serial arm of n joints, whose torques come from `arm`."""

    law: ClassVar[str] = URDF_LAW
    inertial: ClassVar[bool] = False
    side: ClassVar[str] = "left"  # the root link's axes are not mirrored

    arm: GravityModel
    gain: Sequence[float]  #: scales the torque, (n,)
    gravity: float  #: m/s^2
    max_effort: Sequence[float]  #: (n,) Nm
    max_effort_rate: float  #: Nm/s
    tilt_timeout: float  #: s
    use_imu: bool  #: False assumes that the root link's z axis points up

    def torque(self, theta: Sequence[float], tilt: Tilt, exact: bool = True) -> Torque:
        """Return the torque (n,) in Nm that holds the arm at `theta` (n,) rad."""
        torque = self.arm.torque(theta, [self.gravity * component for component in tilt.gravity_in_trunk])
        return tuple([gain * tau for gain, tau in zip(self.gain, torque, strict=True)])

    def outside(self, theta: Sequence[float], tilt: Tilt) -> str:
        """Return '': the law applies everywhere."""
        return ""
