# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The load in the hand: its torque against MuJoCo, its inertia against Pinocchio, its change, and its loss."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.gravity import moments_of
from exo_gravity.core.arm.kinematics import links_of
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.guidance import DropWatch
from exo_gravity.core.compensation.settings import COMPENSATOR, settings_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import values_of
from exo_gravity.sim import SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS

from ..support.compensator_run import THETA, CompensatorRun, settings_with
from .test_gravity_oracles import random_arm
from .test_kinematics import ROUNDING, with_rods

LOAD = Wearer(75.0).on_links(DEFAULT_LINKS.length)


def test_the_gravity_torque_of_an_arm_with_a_load_agrees_with_mujoco():
    rng, arm = np.random.default_rng(1), SimulatedArm()
    for _ in range(50):
        mass, cog, direction = rng.uniform(0.0, 5.0), rng.uniform(-0.3, 0.3, 3), rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        theta = rng.uniform(-1.5, 1.5, 4)
        arm.carry(mass, cog.tolist())
        arm.move_base((DEFAULT_LINKS.gravity * direction).tolist())
        arm.reset(theta)
        mujoco.mj_forward(arm.model, arm.data)
        expected = gravity_torque(DEFAULT_LINKS.with_payload(mass, cog), theta, direction)
        assert arm.data.qfrc_bias == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("by_moments", [False, True])
def test_the_mass_matrix_gets_that_of_a_point_of_mass_as_pinocchio_computes_it(by_moments):
    rng = np.random.default_rng(2)
    for _ in range(5):
        arm = random_arm(rng)
        pin, model, _ = with_rods(arm)
        mass, x = rng.uniform(0.1, 5.0), rng.uniform(-0.1, 0.3)
        known = ArmModel.from_moments(arm.length, arm.first_moment) if by_moments else arm
        bare = model.copy()
        at = pin.SE3(np.eye(3), np.array((arm.length[3] + x, 0.0, 0.0)))
        model.appendBodyToJoint(4, pin.Inertia(mass, np.zeros(3), np.zeros((3, 3))), at)
        loaded, before = links_of(known.with_payload(mass, (x, 0.0, 0.0))), links_of(known)
        for theta in rng.uniform(-3.0, 3.0, (5, 4)):
            added = [np.triu(pin.crba(each, each.createData(), theta)) for each in (model, bare)]
            assert np.triu(loaded.matrix(theta) - before.matrix(theta)) == pytest.approx(
                added[0] - added[1], abs=ROUNDING
            )


def test_a_load_and_a_wearer_add_up_in_any_order_and_the_load_is_carried_in_full():
    load = 1.5, (0.05, 0.01, -0.02)
    for arm in (DEFAULT_LINKS, ArmModel.from_moments(DEFAULT_LINKS.length, DEFAULT_LINKS.first_moment)):
        one = arm.with_payload(*load).with_wearer(LOAD.mass, LOAD.cog, 0.4)
        other = arm.with_wearer(LOAD.mass, LOAD.cog, 0.4).with_payload(*load)
        assert moments_of(one) == pytest.approx(moments_of(other))
        assert moments_of(one.with_payload(0.0)) == pytest.approx(moments_of(arm.with_wearer(LOAD.mass, LOAD.cog, 0.4)))
    alone = moments_of(DEFAULT_LINKS.with_payload(*load)) - moments_of(DEFAULT_LINKS)
    for mode, support in (("one_g", 1.0), ("zero_g", 0.0), ("zero_g", 0.3), ("zero_g", 1.0)):
        loads = ((load[0], load[1]), (0.0, load[1]))
        given, without = (
            settings_with(mode=mode, support=support, payload_mass=mass, payload_cog=cog).arm for mass, cog in loads
        )
        assert moments_of(given) - moments_of(without) == pytest.approx(alone)
        assert given.total_mass - without.total_mass == pytest.approx(load[0])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"payload.mass": 5.5}, "payload.mass = 5.5: must be a number from 0 to 5 kg"),
        ({"payload.cog": [0.0, 0.6, 0.0]}, "payload.cog = .* from -0.5 to 0.5 m"),
        ({"payload.mass": 1.0, "law": "paper_static"}, "payload.mass = 1.0: must be 0 for law paper_static"),
        ({"payload.mass": 4.0, "wearer.body_mass": 140.0, "support": 1.0, "mode": "zero_g"}, "payload.mass 4.00"),
    ],
)
def test_an_impossible_load_is_refused_with_the_reason(values, message):
    with pytest.raises(ParameterError, match=message):
        settings_of(values_of(COMPENSATOR, values))


def speeds(acceleration: float, top: float, period: float = 0.01) -> bool:
    """Return whether a load is seen as dropped while the hand speeds up to `top` m/s, and stays so fast."""
    watch = DropWatch()
    up = [min(top, acceleration * period * n) for n in range(100)]
    return max(watch.step(period, speed, 1.0) for speed in up)


def test_a_dropped_load_is_known_by_the_hands_acceleration_and_a_light_one_by_its_speed():
    assert speeds(20.0, 0.6)
    assert speeds(3.0, 0.9)
    assert not speeds(3.0, 0.75)
    assert not speeds(5.0, 0.5)
    falling = DropWatch()
    assert not max(falling.step(0.01, -0.2 * n, 1.0) for n in range(20))


def test_the_lifting_of_a_load_is_no_drop():
    rise = 0.4  # m/s of the hand
    run = CompensatorRun(payload_mass=2.0)
    run.cycle(1.5)
    per_mass = gravity_torque(
        ArmModel.from_moments(DEFAULT_LINKS.length, (0.0,) * 4, gravity=1.0).with_payload(1.0), THETA
    )
    velocity = per_mass * rise / (per_mass @ per_mass)
    for share in np.linspace(0.0, 1.0, 100):  # in 0.2 s
        run.cycle(velocity=(share * velocity).tolist())
    run.cycle(0.2, velocity=velocity.tolist())
    fast = (2.5 * velocity).tolist()
    run.compensator.applied = (0.0,) * 4  # motors that are off carry nothing
    run.cycle(0.1, velocity=fast)
    assert run.compensator.dropped == 0.0
    run.compensator.applied = run.efforts[-1]
    run.cycle(0.1, velocity=fast)
    assert run.compensator.dropped == 2.0
    assert math.isclose(run.compensator.settings.arm.total_mass, settings_with().arm.total_mass)
