# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""`calibrate wearer` on arms from URDFs: what it leaves to a relaxed arm in new poses, by MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from exo_gravity.core.arm.tilt import Tilt, gravity_in_trunk
from exo_gravity.core.compensation.settings import WORN_MOMENTS
from exo_gravity.core.compensation.tracking import Observation
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.lab.calibration.poses import candidates, next_pose
from exo_gravity.lab.calibration.result import CalibrationResult, write_changes
from exo_gravity.lab.calibration.tours import model_of
from exo_gravity.lab.calibration.wearer import WEARER, wearer_from
from exo_gravity.lab.calibration.worn_arm import worn_arm
from exo_gravity.lab.inputs.arms import AnyArm, any_arm, carried_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.lab.inputs.ros_yaml import text_of

from ...support.thorough import quick
from ...support.urdf_oracle import WornMujocoArm

DOWN = gravity_in_trunk(0.0, 0.0)
BODY_MASS = 75.0  # kg, by the table; the true arm differs
MASS, PLACE = 0.25, 0.02  # share, and m, by which each segment differs from the table
STIFFNESS = 1.0  # Nm/rad of some joints
BREATHING, NOISE = 0.05, 0.004  # Nm, standard deviations of a pose: of the wearer, and of the motors
SEEDS = range(6)
NEW_POSES = 100


@cache
def relaxed_poses(name: str) -> list[np.ndarray]:
    """The poses of the tour for an arm of config, without the visits again."""
    arm = any_arm(packaged_config(f"{name}.yaml"), "right")
    arm = replace(arm, compensator={**arm.compensator, "wearer.body_mass": BODY_MASS})
    model, (low, high) = model_of(arm), worn_arm(arm).comfortable.tolist()
    limits = replace(arm.limits, position_min=low, position_max=high)
    poses, taken = candidates(limits, model), [np.array(limits.home)]
    while len(taken) < WEARER.poses:
        best = next_pose(taken, poses, DOWN, model.moments, model)
        taken.append(poses[best])
        poses = np.delete(poses, best, axis=0)
    return taken


@dataclass
class Person:
    """A relaxed wearer of an arm of config, drawn at random."""

    name: str
    params: Path
    arm: AnyArm
    truth: WornMujocoArm
    bare: WornMujocoArm
    seed: int

    @classmethod
    def of(cls, name: str, seed: int, folder: Path, springs: bool = True) -> Person:
        params, text = folder / f"{seed}.yaml", packaged_config(f"arms/{name}.urdf").read_text(encoding="utf-8")
        nodes, random = load(packaged_config(f"{name}.yaml")), np.random.default_rng(seed)
        nodes["/right/compensator"] |= {"wearer.body_mass": BODY_MASS, "mode": "zero_g", "support": 1.0}
        params.write_text(text_of(nodes))
        arm = any_arm(params, "right")
        settings, count = carried_arm(load(params), "/right").settings, len(arm.joint_names)
        mass = np.array(settings.wearer_mass) * random.uniform(1.0 - MASS, 1.0 + MASS, count)
        place = np.array(settings.wearer_cog) + random.uniform(-PLACE, PLACE, count)
        place = np.clip(place, 0.0, arm.robot.length) * (mass > 0.0)
        stiffness = STIFFNESS * springs * random.integers(0, 2, count)
        rest = random.uniform(0.0, 0.8, count)
        worn = WornMujocoArm(text, arm.joint_names, mass, place, stiffness=stiffness, rest=rest)
        return cls(name, params, arm, worn, WornMujocoArm(text, arm.joint_names, 0.0 * mass, 0.0 * mass), seed)

    def observed(self, varying: float = 0.0) -> list[Observation]:
        """What the tour shows. varying: share of the weight that they carry until the poses are visited again."""
        random, taken = np.random.default_rng(10 + self.seed), relaxed_poses(self.name)
        seen, count = [], len(self.arm.joint_names)
        for number, theta in enumerate([*taken, *taken[: WEARER.again]]):
            bare = self.bare.torque(theta)
            effort = self.truth.torque(theta) + random.normal(0.0, np.hypot(BREATHING, NOISE), count)
            effort = effort - varying * (number < len(taken)) * (self.truth.torque(theta) - bare)
            seen.append(Observation(theta, DOWN, effort, np.full(count, 0.2), np.full(count, NOISE)))
        return seen

    def left(self, result: CalibrationResult) -> tuple[float, np.ndarray]:
        """What the new file leaves to the wearer in new poses: the median of their arm's weight, and by joint in Nm.

        By joint it is the root mean square, which `model_error.wearer_torque` states.
        """
        output = self.params.with_suffix(".new.yaml")
        write_changes(self.params, output, result.changes, "calibrate wearer")
        settings = carried_arm(load(output), "/right").settings
        poses = np.random.default_rng(99).uniform(*worn_arm(self.arm).comfortable, (NEW_POSES, len(self.arm.low)))
        true = np.array([self.truth.torque(pose) for pose in poses])
        given = np.array([settings.torque(pose, Tilt.of("left"))[0] for pose in poses])
        weight = np.abs(true - [self.bare.torque(pose) for pose in poses]).max()
        off = given - true
        return float(np.median(np.abs(off).max(axis=1)) / weight), np.sqrt(np.mean(off**2, axis=0))


def value_of(result: CalibrationResult, name: str) -> Sequence[float]:
    (found,) = [change.value for change in result.changes if change.name == name]
    return found


@pytest.mark.parametrize("name", quick(["three_joints"], ["elbow", "three_joints", "seven_joints"]))
def test_a_relaxed_arm_keeps_little_of_its_weight_and_the_band_says_how_much(name: str, tmp_path: Path) -> None:
    left, covered = [], []
    for seed in SEEDS:
        person = Person.of(name, seed, tmp_path)
        result = wearer_from(person.arm, person.observed(), 0.0)
        assert result.refusals == ()
        share, off = person.left(result)
        left.append(share)
        band = 2.0 * np.array(value_of(result, "model_error.wearer_torque"))
        covered += (off <= band).tolist()
    assert np.median(left) < 0.02 and max(left) < 0.04
    assert np.mean(covered) > 0.9


def test_the_masses_of_the_table_alone_leave_more(tmp_path: Path) -> None:
    shares = []
    for seed in SEEDS[:3]:
        person = Person.of("three_joints", seed, tmp_path, springs=False)
        result = wearer_from(person.arm, person.observed(), 0.0)
        no_moments = {name: [0.0] * len(person.arm.low) for name in WORN_MOMENTS}
        tabled = [c._replace(value=no_moments.get(c.name, c.value)) for c in result.changes]
        found, _ = person.left(result)
        person.params = person.params.rename(person.params.with_suffix(".table.yaml"))
        table, _ = person.left(replace(result, changes=tuple(tabled)))
        shares.append(found / table)
    assert np.median(shares) < 0.5


def test_a_wearer_who_does_not_relax_and_one_who_is_not_there_are_refused(tmp_path: Path) -> None:
    person = Person.of("three_joints", 0, tmp_path)
    with pytest.raises(DataError, match=r"flexion: .* Nm between two visits of a pose: .* did the wearer relax"):
        wearer_from(person.arm, person.observed(varying=0.4))
    person.truth = person.bare
    with pytest.raises(DataError, match="is the arm relaxed, the robot calibrated"):
        wearer_from(person.arm, person.observed())
    light = replace(person.arm, compensator={**person.arm.compensator, "wearer.body_mass": 0.0})
    with pytest.raises(ParameterError, match=r"compensator wearer\.body_mass = 0.*: must be the wearer's, in kg"):
        worn_arm(light)
