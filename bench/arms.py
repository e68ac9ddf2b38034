# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arms that come with the package, as studies play them in virtual time: their files, and what a wearer does.

The simulated arm is the one that the compensator assumes. Its friction is the study's, and its motors are of the
study's kind.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple, TypeVar

from exo_gravity.core.arm.wearer import LinkLoad, Wearer
from exo_gravity.core.motors.ak import V3_RANGES
from exo_gravity.core.safety.limits import Limits, limits_of
from exo_gravity.lab.inputs.arms import ConfiguredArm, node_values, read_arm
from exo_gravity.lab.inputs.parameter_file import Nodes, load, packaged_config
from exo_gravity.sim import SimulatedArm, SimulatedMotor
from exo_gravity.sim.motors import class_of
from exo_gravity.sim.params import device_of, simulator_table

USUAL_FRICTION = 0.2  # Nm, Coulomb's of an AK60-6
COMMAND_TIMEOUT, ENABLE_TIMEOUT = 0.05, 10.0  # s, those of a real arm
KNOWN = ("link_length", "robot.mass", "robot.cog")  # of the paper's arm, as the compensator knows them

Motor = TypeVar("Motor", bound=SimulatedMotor)
Pose = tuple[float, ...]


class Friction(NamedTuple):
    """Of every joint, in Nm of one with an AK60-6."""

    coulomb: float
    stribeck: float = 0.0  #: at standstill, beyond Coulomb's


@dataclass(frozen=True)
class PlayedArm:
    """An arm of config, and what its wearer does with it; one entry per joint."""

    file: str  #: in config
    friction: tuple[float, ...]  #: Nm, of motors like these, where an AK60-6 has USUAL_FRICTION
    poses: tuple[Pose, Pose, Pose, Pose]  #: rad, of a day: the last one is near to hanging
    shove: tuple[float, ...]  #: Nm, with which the wearer pushes it within that day
    back: tuple[float, ...]  #: share of its farthest angle by which a joint is bent the other way at most,
    least: Pose  #: rad, on top of it
    farthest: Pose  #: rad, of a bare arm
    worn: Pose | None  #: the same with a wearer's arm, which the rated torques carry; None: it carries none
    push: tuple[float, ...]  #: Nm, the hardest push
    spasm: tuple[float, ...]  #: Nm
    flick: tuple[float, ...]  #: Nm, which throws up what is in the hand
    lap: Pose  #: rad, of an arm that lies in the lap

    @cached_property
    def nodes(self) -> Nodes:
        """The parameters of its nodes."""
        return load(packaged_config(self.file))

    @cached_property
    def carried(self) -> ConfiguredArm:
        """What carries it."""
        return read_arm(self.nodes, "/right")

    @property
    def has_v3(self) -> bool:
        """Whether its motors also come with V3 boards."""
        return all(motor.spec.name in V3_RANGES for motor in self.carried.motors)

    @property
    def has_imu(self) -> bool:
        """Whether an IMU on the trunk belongs to it."""
        return self.carried.settings.use_imu

    def nearest(self, farthest: Pose) -> Pose:
        """Return the pose (n,) in rad that is farthest from `farthest`."""
        return tuple(least - back * far for least, back, far in zip(self.least, self.back, farthest, strict=True))

    def limits(self, rate: float) -> Limits:
        """Return its limits in a loop with `rate` (Hz), with the time-outs of a real arm."""
        timeouts = {"command_timeout": COMMAND_TIMEOUT, "enable_timeout": ENABLE_TIMEOUT}
        return limits_of({**self.carried.can_bridge, "rate": rate, **timeouts})

    def load_of(self, body_mass: float) -> LinkLoad:
        """Return what the arm of a wearer of `body_mass` kg adds to each link."""
        values = self.nodes["/right/compensator"]
        links = {"links": values["wearer.links"]} if "wearer.links" in values else {}
        return Wearer(body_mass).on_links(self.carried.settings.robot.length, **links)

    def device_arm(self, friction: Friction, load: LinkLoad | None = None) -> SimulatedArm:
        """Return the simulated arm, with the passive arm of a wearer in it if there is a `load`."""
        given: dict[str, Any] = dict(self.nodes["/right/simulator"])
        compensator = self.nodes["/right/compensator"]
        given |= {name: compensator[name] for name in KNOWN if name in given}
        for name, most in friction._asdict().items():
            given[f"friction.{name}"] = [most * own / USUAL_FRICTION for own in self.friction]
        if load:
            given |= {"wearer.mass": load.mass.tolist(), "wearer.cog": load.cog.tolist()}
        return device_of(node_values({"/right/simulator": given}, "/right/simulator", simulator_table(given))).arm


@cache
def of_family(kind: type[Motor], family: str) -> type[Motor]:
    """Return a `kind` of simulated motor for motors of a family."""
    own = class_of(family)
    return kind if issubclass(kind, own) else type(f"{kind.__name__} {own.__name__}", (kind, own), {})


PAPER = PlayedArm(
    file="sim.yaml",
    friction=(0.2, 0.2, 0.2, 0.2),
    poses=((0.1, 0.5, 0.5, 0.6), (-0.2, 0.8, 0.2, 1.2), (0.2, 0.4, 0.9, 0.4), (0.0, 0.2, 0.2, 0.3)),
    shove=(0.2, 1.0, 0.6, 0.2),
    back=(1.0, 0.0, 0.5, 0.0),
    least=(0.0, 0.2, 0.0, 0.1),
    farthest=(0.4, 1.35, 0.8, 1.5),
    worn=(0.2, 0.5, 0.2, 0.5),
    push=(2.0, 4.0, 1.5, 0.5),
    spasm=(0.0, 2.5, 1.2, 0.6),
    flick=(0.0, 3.0, 1.0, 1.0),
    lap=(0.1, 0.45, 0.5, 1.3),
)
ARMS: Mapping[str, PlayedArm] = {
    "paper": PAPER,
    "elbow": PlayedArm(
        file="elbow.yaml",
        friction=(0.4,),
        poses=((0.6,), (1.2,), (0.4,), (0.3,)),
        shove=(0.8,),
        back=(0.0,),
        least=(0.2,),
        farthest=(1.5,),
        worn=(1.2,),
        push=(2.5,),
        spasm=(2.0,),
        flick=(3.0,),
        lap=(1.3,),
    ),
    "three joints": PlayedArm(
        file="three_joints.yaml",
        friction=(0.3, 0.3, 0.2),
        poses=((0.5, 0.5, 0.6), (0.8, 0.2, 1.2), (0.4, 0.9, 0.4), (0.2, 0.2, 0.3)),
        shove=(1.0, 0.6, 0.2),
        back=(0.0, 0.5, 0.0),
        least=(0.1, 0.0, 0.1),
        farthest=(1.2, 1.0, 1.5),
        worn=(0.4, 0.3, 0.5),
        push=(4.0, 2.0, 0.5),
        spasm=(2.5, 1.2, 0.6),
        flick=(2.0, 2.0, 1.0),
        lap=(0.4, 0.5, 1.3),
    ),
    "seven joints": PlayedArm(
        file="seven_joints.yaml",
        friction=(0.4, 0.4, 0.25, 0.25, 0.1, 0.1, 0.1),
        poses=(
            (0.5, 0.4, 0.1, 0.6, 0.2, 0.1, -0.1),
            (0.2, 0.7, -0.2, 1.2, -0.2, 0.2, 0.2),
            (0.9, 0.3, 0.2, 0.4, 0.1, -0.2, 0.1),
            (0.2, 0.2, 0.0, 0.3, 0.0, 0.0, 0.0),
        ),
        shove=(1.0, 0.6, 0.2, 0.2, 0.0, 0.0, 0.0),
        back=(0.3, 0.0, 1.0, 0.0, 1.0, 1.0, 1.0),
        least=(0.0, 0.1, 0.0, 0.1, 0.0, 0.0, 0.0),
        farthest=(0.8, 1.2, 0.4, 1.5, 0.5, 0.4, 0.4),
        worn=None,  # its links are shorter than a wearer's
        push=(4.0, 3.0, 1.0, 1.0, 0.2, 0.2, 0.2),
        spasm=(2.5, 2.5, 0.6, 1.0, 0.1, 0.1, 0.1),
        flick=(3.0, 2.0, 0.0, 1.0, 0.0, 0.0, 0.2),
        lap=(0.5, 0.3, 0.0, 1.3, 0.0, 0.0, 0.0),
    ),
}
