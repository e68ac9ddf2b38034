# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An arm of three joints on two buses, known by its URDF, with all nodes as processes."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from exo_gravity.lab.inputs.parameter_file import packaged_config

from ..support.urdf_oracle import MujocoArm

pytestmark = [pytest.mark.real_time, pytest.mark.thorough]

POSE = [0.5, 0.4, 0.7]  # rad


def test_an_arm_of_three_joints_on_two_buses_is_carried_raised_and_let_down(launch, probe, tmp_path):
    script = tmp_path / "raise.yaml"
    script.write_text(yaml.safe_dump({"name": "raise", "steps": [{"move": POSE, "over": 2.0}, {"hold": 60.0}]}))
    launch(base="three_joints.yaml")
    probe.get_carried()
    probe.bring_to(script)
    seen = len(probe.joint_states)
    probe.wait_until(lambda: len(probe.joint_states) > seen + 100)
    text = packaged_config("arms/three_joints.urdf").read_text(encoding="utf-8")
    names = ["abduction", "flexion", "elbow"]
    oracle = MujocoArm(text, names)
    states = {(m.header.stamp.sec, m.header.stamp.nanosec): m for m in probe.joint_states[-50:]}
    answers = [command for command in probe.effort_commands if command.effort][-20:]
    pairs = [(states[stamp], command) for command in answers if (stamp := _stamp(command)) in states]
    assert pairs
    for state, command in pairs:
        assert list(command.name) == names
        needed = oracle.torque(state.position, (0.0, 0.0, -9.80665))
        np.testing.assert_allclose(command.effort, needed, rtol=0.0, atol=1e-10)
    assert np.abs(np.subtract(probe.joint_angles(), POSE)).max() < 0.2
    assert probe.enable(False).success
    probe.wait_until(lambda: probe.state == "disabled")


def _stamp(message):
    return message.header.stamp.sec, message.header.stamp.nanosec
