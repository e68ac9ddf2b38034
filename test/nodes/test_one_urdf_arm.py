# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Compensator, wearer and the tools make the same arm of a URDF whose chain has joints that are not the arm's."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import urdf_table
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import values_of
from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.lab.inputs.arms import carried_arm
from exo_gravity.nodes.compensator.arm import declared
from exo_gravity.nodes.wearer.node import WearerNode

from ..support.chains import random_chain
from ..support.urdf_oracle import MujocoArm

keep_to_this_machine()
PANDA = Path(__file__).parents[1] / "data" / "arms" / "panda.urdf"
GRAVITY = (0.0, 0.0, -9.80665)


@pytest.fixture
def wearer() -> Iterator[WearerNode]:
    rclpy.init()
    node = WearerNode()
    yield node
    node.close()
    node.destroy_node()
    rclpy.shutdown()


def given_of(urdf: Path, names: list[str], hand: str = "") -> dict[str, Any]:
    own = {"joint_names": names, "urdf.file": str(urdf), "urdf.hand": hand, "max_effort": [30.0] * len(names)}
    return {"law": "urdf", "use_imu": False, **own}


def compensator(given: dict[str, Any]) -> Node:
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    with_them: dict[str, Any] = {"automatically_declare_parameters_from_overrides": True}
    return rclpy.create_node("compensator", parameter_overrides=overrides, **with_them)


def files(given: dict[str, Any]) -> dict[str, dict[str, Any]]:
    count = len(given["joint_names"])
    of_joints = {"motor": ["AK80-9"] * count, "can_id": list(range(1, count + 1)), "max_effort": [9.0] * count}
    ranges = {"position_min": [-1.0] * count, "position_max": [1.0] * count}
    bus = {"can.interface": "virtual", "can.channel": "one_urdf_arm"}
    bridge = {"joint_names": given["joint_names"], **bus, **of_joints, **ranges}
    return {"/right/can_bridge": bridge, "/right/compensator": given}


def test_a_joint_that_is_not_listed_is_at_0_for_compensator_wearer_and_tools(
    wearer: WearerNode, tmp_path: Path
) -> None:
    text, names = random_chain(3, seed=5)
    urdf, listed, random = tmp_path / "chain.urdf", [names[0], names[2]], np.random.default_rng(0)
    urdf.write_text(text)
    given = given_of(urdf, listed, "hand")
    node = compensator(given)
    _, values, read, arm = declared(node)
    assert arm is not None and arm.fixed == (names[1],)
    watched = wearer._read(values)
    assert watched is not None
    made = (read(values), watched, carried_arm(files(given), "/right").settings)
    oracle = MujocoArm(text, listed)
    for theta in random.uniform(-2.0, 2.0, (10, 2)):
        for settings in made:
            torque, _ = settings.torque(theta.tolist(), Tilt.of("left"))
            np.testing.assert_allclose(torque, oracle.torque(theta, GRAVITY), rtol=0.0, atol=1e-10)
    node.destroy_node()


def test_a_joint_that_is_not_listed_and_cannot_be_at_0_is_refused_by_all_three(wearer: WearerNode) -> None:
    given = given_of(PANDA, [f"panda_joint{n}" for n in (1, 2, 3)])
    node, values = compensator(given), values_of(urdf_table(given), given)
    for make in (lambda: declared(node), lambda: wearer._read(values), lambda: carried_arm(files(given), "/right")):
        with pytest.raises(ParameterError, match="position of panda_joint4 = None: must be in the joint states"):
            make()
    node.destroy_node()
