# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""`calibrate wearer` as a user runs it on arms from URDFs: a tour of a worn simulated arm, from file to file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.lab.calibration import live
from exo_gravity.lab.calibration.worn_arm import worn_arm
from exo_gravity.lab.inputs.arms import any_arm, carried_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.lab.inputs.ros_yaml import text_of
from exo_gravity.tools import calibrate

from ..support.calibration_device import run_tour
from ..support.ports import own_ports
from ..support.urdf_oracle import WornMujocoArm

BODY_MASS = 75.0  # kg, by the table
HEAVIER, NEARER = 1.2, 0.95  # shares: the wearer's segments against the table's
STIFFNESS, REST = 0.8, 0.5  # Nm/rad and rad, of their last joint
LEFT = 0.02  # of the largest torque that the wearer's arm needs
PORTS = own_ports()


@dataclass
class Worn:
    """A file of an arm of config that a person wears, and the true torque of both."""

    params: Path
    truth: WornMujocoArm
    bare: WornMujocoArm

    @classmethod
    def of(cls, name: str, folder: Path, **compensator: object) -> Worn:
        nodes, params = load(packaged_config(f"{name}.yaml")), folder / "params.yaml"
        simulator, port = nodes["/right/simulator"], next(PORTS)
        nodes["/right/compensator"] |= {"wearer.body_mass": BODY_MASS, "mode": "zero_g", "support": 1.0, **compensator}
        params.write_text(text_of(nodes))
        settings = carried_arm(load(params), "/right").settings
        mass, cog = HEAVIER * np.array(settings.wearer_mass), NEARER * np.array(settings.wearer_cog)
        last = np.eye(len(mass))[-1]
        worn = mass, cog, STIFFNESS * last, REST * last
        names = ("wearer.mass", "wearer.cog", "wearer.joint_stiffness", "wearer.joint_rest")
        simulator |= {name: value.tolist() for name, value in zip(names, worn, strict=True)}
        for node in ("/right/can_bridge", "/right/simulator"):
            nodes[node]["can.options.port"] = port
        params.write_text(text_of(nodes))
        text = packaged_config(f"arms/{name}.urdf").read_text(encoding="utf-8")
        joints = simulator["joint_names"]
        truth = WornMujocoArm(text, joints, mass, cog, stiffness=worn[2], rest=worn[3])
        return cls(params, truth, WornMujocoArm(text, joints, 0.0 * mass, cog))

    def left(self, output: Path) -> float:
        """What a file leaves of the torque of the wearer's arm in new poses, of its largest."""
        settings, arm = settings_in(output), any_arm(self.params, "right")
        poses = np.random.default_rng(8).uniform(*worn_arm(arm).comfortable, (50, len(arm.joint_names)))
        true, bare = (np.array([one.torque(pose) for pose in poses]) for one in (self.truth, self.bare))
        given = np.array([settings.torque(pose, Tilt.of("left"))[0] for pose in poses.tolist()])
        return float(np.abs(given - true).max() / np.abs(true - bare).max())


def settings_in(params: Path) -> Settings:
    return carried_arm(load(params), "/right").settings


def command(worn: Worn, output: Path) -> Sequence[str]:
    return "wearer", "--params", str(worn.params), "--output", str(output), "--carried", "0"


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["elbow", "three_joints"])
def test_a_tour_of_a_worn_arm_finds_its_wearer(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, without_pictures: None
) -> None:
    worn, output = Worn.of(name, tmp_path), tmp_path / "new.yaml"
    monkeypatch.setattr(live, "run_tour", run_tour)
    assert calibrate.main(command(worn, output)) == 0
    assert worn.left(output) < LEFT < 0.1 < worn.left(worn.params)


@pytest.mark.real_time
@pytest.mark.thorough
@pytest.mark.timeout(500)  # minutes of a tour
def test_nodes_move_a_worn_arm_of_three_joints_and_find_its_wearer(tmp_path: Path) -> None:
    worn, output = Worn.of("three_joints", tmp_path), tmp_path / "new.yaml"
    assert calibrate.main(command(worn, output)) == 0
    assert worn.left(output) < LEFT
