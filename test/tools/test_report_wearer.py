# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a report says of the wearer, from recordings of an arm whose wearer gives a known share."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import yaml

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.lab.report import trial_report, wearer_share
from exo_gravity.lab.trial.recording import Recording

from ..support.synthetic_bags import bag_of
from ..support.thorough import quick
from ..support.urdf_oracle import WornMujocoArm

pytest.importorskip("matplotlib")
LENGTH = (0.05, 0.13, 0.30, 0.30)
ROBOT = ArmModel(LENGTH, (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
LOAD = Wearer(75.0).on_links(LENGTH)
POSE, BOW = (0.2, 0.9, 0.7, 0.6), 0.3
JOINTS = tuple(f"right_{n}" for n in range(4))
TIME = np.arange(0.0, 8.0, 0.01)
TRUNK = np.array([(0.0, 0.0, 0.0, 0.0, *gravity_in_trunk(BOW, 0.0)), (8.0, 0.0, 0.0, 0.0, *gravity_in_trunk(BOW, 0.0))])


def recorded(share: float) -> Recording:
    """Return the recording of a still arm, whose trunk bows; the wearer gives `share` of what their own arm needs."""
    down, own = Tilt.of("right", BOW).direction, ArmModel(LENGTH, LOAD.cog, LOAD.mass)
    effort = gravity_torque(ROBOT, POSE, down) + (1.0 - share) * gravity_torque(own, POSE, down)
    rows = [np.tile(row, (len(TIME), 1)) for row in (POSE, (0.0,) * 4, effort, effort)]
    return Recording("right", JOINTS, TIME, *rows, carried=((1.0, 7.0),))


def parameters(**changes: object) -> dict[str, str]:
    values = {"side": "right", "joint_names": list(JOINTS), "wearer.body_mass": 75.0, "model_error.wearer": 0.02,
              "model_error.torque": [0.02] * 4, "model_error.scale": [0.005] * 4, **changes}  # fmt: skip
    return {"/right/compensator": yaml.safe_dump({"/right/compensator": {"ros__parameters": values}})}


@pytest.mark.parametrize("share", quick([0.4], [0.0, 0.4, 1.0]))
def test_the_share_of_the_recording_is_found_and_said(share, tmp_path):
    report = trial_report.analyse(bag_of(recorded(share), parameters=parameters(), trunk=TRUNK))
    part = report.wearers["right"]
    assert part.whole.value == pytest.approx(share, abs=0.005)
    assert part.curve.time[0] >= 1.0 and part.curve.time[-1] <= 7.0  # while the arm was carried
    said = wearer_share.sentence(part, Source.REAL)
    assert wearer_share.sentence(part, Source.SIMULATED) == f"In the simulation, t{said[1:]}"
    assert f"{100 * share:.0f} % of their arm's weight" in said
    assert ("not distinguishable from zero" in said) == (share == 0.0)
    written = trial_report.write(report, tmp_path)
    assert "right_wearer.png" in [path.name for path in written]
    said = wearer_share.sentence(part, Source.UNKNOWN)  # as this recording has it
    page = (tmp_path / "report.html").read_text(encoding="utf-8").replace("&#x27;", "'")
    assert said.split("(")[0] in page
    assert all(f"{name} {100 * share:.0f} % (±" in page for name in JOINTS[1:])  # of each joint


def test_without_a_wearer_in_the_parameters_nothing_is_said_of_one():
    for given in ({}, parameters(**{"wearer.body_mass": 0.0})):
        report = trial_report.analyse(bag_of(recorded(0.4), parameters=given, trunk=TRUNK))
        assert not report.wearers and not any("wearer" in note for note in report.notes)


def test_without_the_imu_a_note_says_why_the_torque_is_not_known():
    report = trial_report.analyse(bag_of(recorded(0.4), parameters=parameters()))
    assert not report.wearers and any("no /imu/data" in note for note in report.notes)
    upright = dataclasses.replace(recorded(0.4), carried=None)
    report = trial_report.analyse(bag_of(upright, parameters=parameters(use_imu=False)))
    assert report.wearers["right"].curve.time[0] == 0.0


def test_a_hanging_arm_has_nothing_to_carry():
    still = np.zeros((len(TIME), 4))
    hanging = Recording("right", JOINTS, TIME, still, still, still, still)
    report = trial_report.analyse(bag_of(hanging, parameters=parameters(use_imu=False)))
    assert "nothing to carry" in wearer_share.sentence(report.wearers["right"], Source.UNKNOWN)


@pytest.mark.parametrize("share", quick([0.3], [0.3, 1.0]))
def test_the_share_of_each_joint_of_a_seven_joint_arm_is_found_and_its_page_shows_all_joints(share, tmp_path):
    nodes = load(packaged_config("seven_joints.yaml"))
    given = nodes["/right/compensator"]
    names, text = given["joint_names"], packaged_config("arms/seven_joints.urdf").read_text(encoding="utf-8")
    mass, cog = [0.0, 0.0, 1.5, 0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.12, 0.0, 0.1, 0.0, 0.0]
    pose = [0.6, 0.5, 0.3, 0.9, 0.2, 0.3, -0.2]

    effort = WornMujocoArm(text, names, [(1.0 - share) * m for m in mass], cog).torque(pose)
    rows = [np.tile(row, (len(TIME), 1)) for row in (pose, [0.0] * 7, effort, effort)]
    recording = Recording("right", tuple(names), TIME, *rows, carried=((1.0, 7.0),))
    values = {**given, "wearer.mass": mass, "wearer.cog": cog, "mode": "zero_g", "support": 1.0}
    recorded_values = {"/right/compensator": yaml.safe_dump({"/right/compensator": {"ros__parameters": values}})}
    report = trial_report.analyse(bag_of(recording, parameters=recorded_values))
    part = report.wearers["right"]
    assert part.whole.value == pytest.approx(share, abs=0.005)
    known = np.isfinite(part.joints.value)
    assert known.sum() >= 3
    np.testing.assert_allclose(part.joints.value[known], share, atol=0.005)
    trial_report.write(report, tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert all(name.replace("_", " ") in page for name in names)
