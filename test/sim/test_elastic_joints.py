# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Joints with stiffness and play between motor and link, against Pinocchio and SciPy."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest
from scipy.integrate import solve_ivp

from exo_gravity.core import gravity_torque
from exo_gravity.core.errors import ParameterError
from exo_gravity.sim import STEP, ArmConfig, SimulatedArm, SimulatedDevice
from exo_gravity.sim.arm import JOINT_LOSS
from exo_gravity.sim.urdf import UrdfConfig

from ..support.chains import random_chain
from ..support.simulated_device import make_device

RAISED = (0.3, 0.8, 0.7, 0.6)  # rad
STUCK = {"coulomb_friction": (10.0,) * 4, "viscous_friction": (0.0,) * 4}


@pytest.mark.parametrize(("count", "stiffness"), [(1, 1000.0), (3, 150.0), (3, 1000.0)])
def test_an_elastic_arm_moves_as_pinocchio_and_scipy_compute_it(count: int, stiffness: float) -> None:
    text, names = random_chain(count, count)
    rotor, play, k = np.full(count, 2e-3), np.full(count, 0.01), np.full(count, stiffness)
    loss, torque = JOINT_LOSS * k, np.linspace(0.5, -0.3, count)
    arm = SimulatedArm(
        UrdfConfig(
            text=text, joint_names=names, rotor_inertia=rotor.tolist(), joint_stiffness=k.tolist(),
            backlash=play.tolist(), coulomb_friction=(0.0,) * count, viscous_friction=(0.0,) * count,
        )
    )  # fmt: skip
    arm.move_base((0.0, 0.0, -9.81))
    start = np.linspace(0.2, 0.6, count)
    arm.reset(start)
    model = pinocchio.buildModelFromXML(text)
    model = pinocchio.buildReducedModel(
        model, [n for n in range(1, model.njoints) if model.names[n] not in names], pinocchio.neutral(model)
    )
    data = model.createData()

    def rates(_: float, state: np.ndarray) -> np.ndarray:
        link, motor, link_speed, motor_speed = state.reshape(4, count)
        twist = motor - link
        shaft = k * (twist - np.clip(twist, -play / 2.0, play / 2.0)) + loss * (motor_speed - link_speed)
        fall = pinocchio.aba(model, data, link, link_speed, shaft)
        return np.concatenate((link_speed, motor_speed, fall, (torque - shaft) / rotor))

    way = solve_ivp(rates, (0.0, 0.2), np.concatenate((start, start, np.zeros(2 * count))), rtol=1e-7, max_step=1e-3)
    for _ in range(round(0.2 / STEP)):
        arm.step(torque)
    link, motor = way.y[: 2 * count, -1].reshape(2, count)
    assert np.abs(link - start).max() > 0.05
    np.testing.assert_allclose(arm.positions, link, atol=3e-3)
    np.testing.assert_allclose(arm.motor_positions, motor, atol=3e-3)


@pytest.mark.parametrize(("stiffness", "play"), [(150.0, 0.0), (1000.0, 0.02)])
def test_behind_a_motor_that_stands_the_link_sags_by_its_torque_and_the_play(stiffness: float, play: float) -> None:
    arm = SimulatedArm(ArmConfig(joint_stiffness=(stiffness,) * 4, backlash=(play,) * 4, **STUCK))
    arm.reset(RAISED)
    for _ in range(3000):
        arm.step(np.multiply(arm.velocities, -0.5), of_motors=(0.0,) * 4)  # a hand stills the links
    np.testing.assert_allclose(arm.motor_positions, RAISED, atol=1e-3)
    torque = gravity_torque(arm.config.links, arm.positions)
    sag = np.subtract(arm.motor_positions, arm.positions)
    carrying = np.abs(torque) > 0.3
    np.testing.assert_allclose(sag[carrying], (torque / stiffness + np.sign(torque) * play / 2.0)[carrying], atol=2e-4)


def test_one_elastic_joint_leaves_the_others_rigid_and_a_motor_reports_its_own_angle() -> None:
    config = ArmConfig(joint_stiffness=(0.0, 0.0, 150.0, 0.0), **STUCK)
    device: SimulatedDevice = make_device(config=config)
    device.arm.reset(RAISED)
    device.advance(0.5)
    sag = np.subtract(device.arm.motor_positions, device.arm.positions)
    assert sag[2] > 0.005
    assert not np.any(np.delete(sag, 2))


def test_play_needs_a_stiffness() -> None:
    with pytest.raises(ParameterError, match="backlash"):
        ArmConfig(backlash=(0.0, 0.01, 0.0, 0.0))
