# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The calibration of arms from URDFs, bare and worn: what MuJoCo needs of the true arm is the judge."""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from exo_gravity.core.arm.tilt import Tilt, gravity_in_trunk
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.hardware.urdf_arm import MOMENT_NAMES, TURN_NAMES, UrdfArm
from exo_gravity.lab.calibration.identification import identify, next_pose
from exo_gravity.lab.calibration.moment_model import DescribedModel
from exo_gravity.lab.calibration.moment_model import model_of as moments_of_values
from exo_gravity.lab.calibration.result import CalibrationResult, page_of, write_changes
from exo_gravity.lab.calibration.tour import TorqueGuess, candidates
from exo_gravity.lab.calibration.tours import (
    WEARER,
    WornArm,
    friction_from,
    model_of,
    moments_from,
    tour_parameters,
    wearer_from,
)
from exo_gravity.lab.calibration.tracking import Observation
from exo_gravity.lab.inputs.arms import ConfiguredArm, configured_arm, read_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config, text_of

from ...support.calibration_device import player_of
from ...support.chains import random_chain
from ...support.thorough import quick
from ...support.urdf_oracle import MujocoArm, WornMujocoArm

SHIPPED = quick(["three_joints"], ["elbow", "three_joints", "seven_joints"])

DOWN = gravity_in_trunk(0.0, 0.0)

MEDIAN, WORST = 0.01, 0.03  # of the peak torque

POSES = 12

NOISE = 0.004  # Nm, standard deviation of a pose's effort: half a code of an AK60-6

ZERO = 1.5  # deg, the largest error of an encoder's zero

ASKEW = 1.5  # deg, by which each axis lies otherwise than in the file's URDF

OFF = 0.2  # share by which each mass of the file's URDF is wrong

NO_WEIGHT = (0.0, 0.0)  # kg and m

BEST: dict[tuple[str, tuple[float, float]], list[np.ndarray]] = {}  # poses of a tour, by the file's name and the weight


def with_wrong_masses(text: str, seed: int) -> str:
    """Return a URDF in which each mass is 20 % too large or too small."""
    random, root = np.random.default_rng(seed), ElementTree.fromstring(text)
    for mass in root.iter("mass"):
        mass.set("value", str(float(mass.get("value", "")) * random.choice((1.0 - OFF, 1.0 + OFF))))
    return ElementTree.tostring(root, encoding="unicode")


def turned(text: str, joint: str, turn: np.ndarray) -> str:
    """Return a URDF in which the place of `joint` is turned by `turn` (3,) rad in the joint's frame."""
    root = ElementTree.fromstring(text)
    (origin,) = [one.find("origin") for one in root.findall("joint") if one.get("name") == joint]
    rpy = np.array([float(angle) for angle in origin.get("rpy", "0 0 0").split()])
    matrix = pin.rpy.rpyToMatrix(rpy) @ pin.exp3(turn)
    origin.set("rpy", " ".join(map(repr, pin.rpy.matrixToRpy(matrix).tolist())))
    return ElementTree.tostring(root, encoding="unicode")


@dataclass
class Bench:
    """An arm of config whose file has a wrong URDF. params: that file; text: the true URDF."""

    name: str
    params: Path
    arm: ConfiguredArm
    text: str
    off: np.ndarray  # (n,) rad by which each joint is farther than its encoder says

    @classmethod
    def of(cls, name: str, folder: Path) -> Bench:
        text = packaged_config(f"arms/{name}.urdf").read_text(encoding="utf-8")
        wrong, params = folder / "wrong.urdf", folder / "params.yaml"
        wrong.write_text(with_wrong_masses(text, 0))
        nodes = load(packaged_config(f"{name}.yaml"))
        nodes["/right/compensator"]["urdf.file"] = str(wrong)
        params.write_text(text_of(nodes))
        arm = configured_arm(params, "right")
        return cls(name, params, arm, text, np.zeros(len(arm.joint_names)))

    def true_arm(self, weight: tuple[float, float] = NO_WEIGHT) -> WornMujocoArm:
        """The true arm with a weight of some kg at some m from its last joint."""
        none = (0.0,) * (len(self.arm.joint_names) - 1)
        return WornMujocoArm(self.text, self.arm.joint_names, (*none, weight[0]), (*none, weight[1]))

    def poses(self, weight: tuple[float, float] = NO_WEIGHT) -> Sequence[np.ndarray]:
        """The best poses, which follow from the file alone."""
        if (self.name, weight) not in BEST:
            model = model_of(self.arm)
            poses, taken = candidates(self.arm.limits, model), [np.array(self.arm.limits.home)]
            while len(taken) < POSES:
                taken.append(poses[next_pose(taken, poses, DOWN, model.moments + model.load(*weight), model)])
            BEST[self.name, weight] = taken
        return BEST[self.name, weight]

    def observed(self, scales: np.ndarray, weight: tuple[float, float] = NO_WEIGHT) -> list[Observation]:
        """What a tour through the best poses would show of motors with these true torque scales (n,)."""
        truth, random = self.true_arm(weight), np.random.default_rng(4)
        seen = []
        for theta in self.poses(weight):
            effort = truth.torque(theta + self.off) / scales + random.normal(0.0, NOISE, len(theta))
            spread = np.full(len(theta), NOISE)
            seen.append(Observation(theta, DOWN, effort, spread, spread, *weight, temperature=(30.0,) * len(theta)))
        return seen

    def errors(self, params: Path, scales: np.ndarray) -> tuple[float, float]:
        """The median and the largest error of the true torque in 300 poses by the file `params`, of the peak."""
        new, random = read_arm(load(params), "/right"), np.random.default_rng(9)
        poses = random.uniform(self.arm.low, self.arm.high, (300, len(scales)))
        truth = self.true_arm()
        true = np.array([truth.torque(pose) for pose in poses])
        moved = np.multiply(
            self.arm.can_bridge["direction"], np.subtract(self.arm.can_bridge["zero"], new.can_bridge["zero"])
        )
        law = np.array([new.settings.torque(pose - self.off + moved, Tilt.of("left"))[0] for pose in poses])
        given = law / np.array(new.can_bridge["torque_scale"]) * scales
        off = np.abs(given - true).max(axis=1) / np.abs(true).max()
        return float(np.median(off)), float(off.max())

    def calibrated(self, observations: Sequence[Observation]) -> Path:
        """The file that these observations give."""
        result, output = moments_from(self.arm, observations), self.params.with_name("new.yaml")
        assert result.refusals == ()
        assert "Measured less predicted torque" in page_of(result, "gravity", str(self.params))
        write_changes(self.params, output, result.changes, "calibrate gravity")
        return output


@pytest.mark.parametrize("is_weighed", quick([True], [False, True]))
@pytest.mark.parametrize("name", SHIPPED)
def test_masses_a_fifth_off_are_found_and_with_a_known_weight_torque_scales_too(
    name: str, is_weighed: bool, tmp_path: Path
) -> None:
    bench, lever = Bench.of(name, tmp_path), {"seven_joints": 0.08}.get(name, 0.2)
    scales = np.ones(len(bench.arm.joint_names))
    assert bench.errors(bench.params, scales)[0] > 5.0 * MEDIAN
    if is_weighed:
        scales = np.resize((0.85, 1.1, 0.95), len(scales))
    seen = [*bench.observed(scales), *(bench.observed(scales, (1.0, lever)) if is_weighed else ())]
    median, worst = bench.errors(bench.calibrated(seen), scales)
    assert median < MEDIAN and worst < WORST


@pytest.mark.parametrize("name", SHIPPED[1:])  # those of a single joint look like a moment across its link
def test_zeros_and_axes_that_are_askew_are_found_where_the_poses_show_them(name: str, tmp_path: Path) -> None:
    bench, random = Bench.of(name, tmp_path), np.random.default_rng(3)
    for joint, (_, *across) in zip(
        bench.arm.joint_names, UrdfArm(bench.text, bench.arm.joint_names).turns, strict=True
    ):
        way = random.normal(size=2) @ across
        bench.text = turned(bench.text, joint, np.radians(ASKEW) * way / np.linalg.norm(way))
    right = np.ones(len(bench.arm.joint_names))
    bench.off = np.radians(np.resize((ZERO, -ZERO, ZERO), len(right)))
    median, worst = bench.errors(bench.calibrated(bench.observed(right)), right)
    assert median < 0.5 * MEDIAN and worst < 0.25 * WORST


@pytest.mark.parametrize("count", [1, 3, 6])
def test_the_derivatives_by_turns_of_the_joints_are_mujocos(count: int) -> None:
    text, names = random_chain(count, seed=20 + count)
    arm = UrdfArm(text, names, "hand")
    model, random, step = DescribedModel(arm, True), np.random.default_rng(count), 1e-4
    poses, down = random.uniform(-2.0, 2.0, (10, count)), gravity_in_trunk(0.3, -0.2)
    shown = np.einsum("mnkat,a,k->tmn", model.turned(poses), down, model.moments)
    beyond, without = (model.matrix(poses[0], (mass, 2.0)) for mass in (1.0, 0.0))  # m, from the last joint
    assert np.linalg.eigvalsh(beyond - without).max() > 0.1
    moments = model.rows(poses, down).reshape(-1, len(model.names))
    for number, (turn, derivative) in enumerate(zip(arm.turns.reshape(-1, 3), shown, strict=True)):
        arms = [MujocoArm(turned(text, names[number // 3], sign * step * turn), names) for sign in (1.0, -1.0)]
        ends = np.array([[one.torque(theta, 9.80665 * down) for theta in poses] for one in arms])
        wrong = (derivative - (ends[0] - ends[1]) / (2.0 * step)).ravel()
        if number % 3:  # a moment along the joint's axis turns, too, which looks like moments of the link before
            wrong -= moments @ np.linalg.lstsq(moments, wrong, rcond=None)[0]
        assert np.abs(wrong).max() < 1e-5


def test_two_leans_of_the_base_show_how_the_imu_is_mounted(tmp_path: Path) -> None:
    bench, turn = Bench.of("three_joints", tmp_path), np.array((0.03, -0.03, 0.04))
    arm = replace(bench.arm, compensator={**bench.arm.compensator, "use_imu": True})
    model, truth, seen = model_of(arm), MujocoArm(bench.text, arm.joint_names), []
    random = np.random.default_rng(4)
    leans = [gravity_in_trunk(pitch, 0.1) for pitch in (0.12, -0.12)]
    for down in leans:
        for theta in bench.poses():
            effort = truth.torque(theta, 9.80665 * down) + random.normal(0.0, NOISE, len(theta))
            spread = np.full(len(theta), NOISE)
            seen.append(Observation(theta, down - np.cross(turn, down), effort, spread, spread))
    found = identify(seen, model)
    for down in leans:
        measured = down - np.cross(turn, down)
        assert np.linalg.norm(measured + np.cross(found.value.tilt, measured) - down) < np.radians(0.3)


@pytest.mark.parametrize(
    ("name", "zero", "change", "said"),
    [
        ("three_joints", 12.0, lambda seen: seen, r"joint 1: its zero is \+\d+\.\d degrees off: must be within 6"),
        (
            "elbow",
            0.0,
            lambda seen: [one._replace(effort=-np.asarray(one.effort)) for one in seen],
            r"joint 1 needs -.* times the torque of the file: must be from 0\.3 to 3",
        ),
        ("three_joints", 0.0, lambda seen: seen[:1] * 4, r"4 poses do not show abduction 2.*: add the pose \["),
    ],
    ids=["a zero that no jig could have missed by so much", "the wrong way", "a moment that is not shown"],
)
def test_impossible_poses_are_refused_with_what_to_check(name, zero, change, said, tmp_path: Path) -> None:
    bench = Bench.of(name, tmp_path)
    bench.off[0] = np.radians(zero)
    with pytest.raises(DataError, match=said):
        moments_from(bench.arm, change(bench.observed(np.ones(len(bench.off)))))


def test_an_arm_whose_urdf_comes_from_a_topic_or_that_has_other_joints_is_refused(tmp_path: Path) -> None:
    bench = Bench.of("three_joints", tmp_path)
    values = {**bench.arm.compensator, "motor": bench.arm.can_bridge["motor"]}
    none = dict.fromkeys((*MOMENT_NAMES, *TURN_NAMES), [0.0] * 2)
    with pytest.raises(ParameterError, match=r"urdf\.file = '': must be a file: a calibration does not wait"):
        moments_of_values({**values, "urdf.file": ""})
    with pytest.raises(ParameterError, match=r"joint_names = .*: must be all joints that move the arm's links"):
        moments_of_values({**values, **none, "joint_names": ["abduction", "elbow"]})


def test_the_choice_of_poses_on_another_thread_does_not_change_the_torque(tmp_path: Path) -> None:
    model, tilt, theta = model_of(Bench.of("three_joints", tmp_path).arm), Tilt.of("left"), [0.3, 0.5, 0.7]
    torque = TorqueGuess(model).torque
    expected, done, interval = torque(theta, tilt), threading.Event(), sys.getswitchinterval()

    def choose() -> None:
        while not done.is_set():
            model.along_axes(model.suggested[:20])

    sys.setswitchinterval(1e-6)
    thread = threading.Thread(target=choose)
    thread.start()
    try:
        assert {torque(theta, tilt) for _ in range(500)} == {expected}
    finally:
        done.set()
        thread.join()
        sys.setswitchinterval(interval)


@pytest.mark.thorough
def test_a_tour_of_the_elbow_finds_its_moments_and_its_friction(tmp_path: Path) -> None:
    bench = Bench.of("elbow", tmp_path)
    for changes in ({"tour.poses": 6}, {"tour.friction": True}):
        player = player_of(tour_parameters(bench.params, bench.arm, changes), tmp_path / "nodes.yaml")
        assert player.play().fault is None and player.tour.trouble == "" and player.tour.done
        if "tour.poses" in changes:
            after, worst = bench.errors(bench.calibrated(player.tour.measured), np.ones(1))
            assert after < MEDIAN and worst < WORST
        else:
            (curve,) = friction_from(bench.arm, player.tour.measured).curves
            assert abs(curve.fitted[-1] - 0.4 - 0.05 * curve.speed[-1]) < 0.03


BODY_MASS = 75.0  # kg, by the table; the true arm differs

OFF_MASS, OFF_PLACE = 0.25, 0.02  # share, and m, by which each segment differs from the table

STIFFNESS = 1.0  # Nm/rad of some joints
BREATHING = 0.05  # Nm, standard deviation of a pose by the wearer

SEEDS = range(6)

NEW_POSES = 100


@cache
def relaxed_poses(name: str) -> list[np.ndarray]:
    """The poses of the tour for an arm of config, without the visits again."""
    arm = configured_arm(packaged_config(f"{name}.yaml"), "right")
    arm = replace(arm, compensator={**arm.compensator, "wearer.body_mass": BODY_MASS})
    model, (low, high) = model_of(arm), WornArm(arm).comfortable.tolist()
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
    arm: ConfiguredArm
    truth: WornMujocoArm
    bare: WornMujocoArm
    seed: int

    @classmethod
    def of(cls, name: str, seed: int, folder: Path, springs: bool = True) -> Person:
        params, text = folder / f"{seed}.yaml", packaged_config(f"arms/{name}.urdf").read_text(encoding="utf-8")
        nodes, random = load(packaged_config(f"{name}.yaml")), np.random.default_rng(seed)
        nodes["/right/compensator"] |= {"wearer.body_mass": BODY_MASS, "mode": "zero_g", "support": 1.0}
        params.write_text(text_of(nodes))
        arm = configured_arm(params, "right")
        settings, count = read_arm(load(params), "/right").settings, len(arm.joint_names)
        mass = np.array(settings.wearer_mass) * random.uniform(1.0 - OFF_MASS, 1.0 + OFF_MASS, count)
        place = np.array(settings.wearer_cog) + random.uniform(-OFF_PLACE, OFF_PLACE, count)
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
        settings = read_arm(load(output), "/right").settings
        poses = np.random.default_rng(99).uniform(*WornArm(self.arm).comfortable, (NEW_POSES, len(self.arm.low)))
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


def test_a_wearer_who_does_not_relax_and_one_who_is_not_there_are_refused(tmp_path: Path) -> None:
    person = Person.of("three_joints", 0, tmp_path)
    with pytest.raises(DataError, match=r"flexion: .* Nm between two visits of a pose: .* did the wearer relax"):
        wearer_from(person.arm, person.observed(varying=0.4))
    person.truth = person.bare
    with pytest.raises(DataError, match="is the arm relaxed, the robot calibrated"):
        wearer_from(person.arm, person.observed())
    light = replace(person.arm, compensator={**person.arm.compensator, "wearer.body_mass": 0.0})
    with pytest.raises(ParameterError, match=r"compensator wearer\.body_mass = 0.*: must be the wearer's, in kg"):
        WornArm(light)
