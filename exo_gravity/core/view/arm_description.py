"""What a robot description and a picture of an arm need to know about it, read from the nodes' parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from exo_gravity.core.compensation.params import robot_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import ZEROS, ArmModel
from exo_gravity.core.model.tilt import SIDES
from exo_gravity.core.numbers import JOINT_COUNT, Vector
from exo_gravity.core.params import Param
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.params import LIMIT_PARAMETERS, limits_of

Point = tuple[float, float, float]

HALF_BREADTH = 0.15  # m from the middle of the trunk to the axis of joint 1, if `shoulder` is not given
# The parameters that `described` reads.
OF_COMPENSATOR = (
    "side", "link_length", "gain", "gravity", "robot.mass", "robot.cog", "robot.first_moment", "robot.off_axis",
    "shoulder_from_imu", "friction.viscous", "friction.coulomb",
)  # fmt: skip
OF_BRIDGE = ("joint_names", *(param.name for param in LIMIT_PARAMETERS))


@dataclass(frozen=True, eq=False)
class ArmDescription:
    """What a description states about one arm."""

    side: str  #: 'left' or 'right'
    robot: ArmModel  #: without a wearer
    mass: Vector  #: (4,) kg, used if `robot` is given by its moments
    limits: Limits  #: names, position, speed and torque limits of the joints
    damping: Vector = ZEROS  #: (4,) Nm s/rad, 0 for unknown
    friction: Vector = ZEROS  #: (4,) Nm, 0 for unknown
    shoulder: Vector = (0.0, 0.0, 0.0)  #: (3,) m, the arm's base in the trunk's axes; zeros for unknown

    def __post_init__(self) -> None:
        if self.side not in SIDES:
            raise ParameterError("side", self.side, f"one of {', '.join(SIDES)}")

    @property
    def outward(self) -> float:
        """1 if the arm is on the trunk's +y side (left), -1 otherwise."""
        return 1.0 if self.side == "left" else -1.0

    @property
    def base(self) -> Point:
        """Origin of joint 1 in the trunk's axes, m."""
        x, y, z = map(float, self.shoulder)
        return (x, y, z) if any((x, y, z)) else (0.0, self.outward * HALF_BREADTH, 0.0)

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links (4,), and of the frame at the far end of link 4."""
        return (*(f"{self.side}_link_{n}" for n in range(1, JOINT_COUNT + 1)), f"{self.side}_end")


def described(compensator: Mapping[str, Any], can_bridge: Mapping[str, Any]) -> ArmDescription:
    """Return the arm that the parameters of its two nodes describe, or raise ParameterError."""
    return ArmDescription(
        compensator["side"],
        robot_of(compensator),
        compensator["robot.mass"],
        limits_of(can_bridge),
        compensator["friction.viscous"],
        compensator["friction.coulomb"],
        compensator["shoulder_from_imu"],
    )


# The parameters of `robot_model`.
# fmt: off
ROBOT_MODEL = (
    Param("rate", 30.0, "joint states of all arms per second", (1.0, 100.0), "Hz", fixed=True),
    Param("meshes", "", "address of a folder with LINK.stl for each link, as package://NAME/FOLDER; empty: tubes",
          fixed=True),
)
# fmt: on
