# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The load in the hand: its torque against MuJoCo, its inertia against Pinocchio, its change, and its loss."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.gravity import moments_of
from exo_gravity.core.arm.kinematics import links_of
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import JOINTS, Compensator
from exo_gravity.core.compensation.guidance import DropWatch
from exo_gravity.core.compensation.settings import COMPENSATOR, settings_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.trial.offline import ArmSetup, OfflineTrial
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.script import TrialScript

from ..support.compensator_run import THETA, CompensatorRun, settings_with
from .test_gravity_oracles import random_arm
from .test_kinematics import NO_ROTORS, ROUNDING, with_rods

NAMES = ("AK60-6", "AK80-9", "AK60-6", "AK60-6")
MOST = (9.0, 18.0, 9.0, 9.0)  # Nm
LOAD = Wearer(75.0).on_links(DEFAULT_LINKS.length)
WORN = {"wearer_mass": tuple(LOAD.mass), "wearer_cog": tuple(LOAD.cog)}


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
        before = links_of(ArmModel.from_moments(arm.length, arm.first_moment) if by_moments else arm)
        bare = model.copy()
        model.appendBodyToJoint(4, pin.Inertia(mass, np.zeros(3), np.zeros((3, 3))), _at(pin, arm.length[3] + x))
        known = ArmModel.from_moments(arm.length, arm.first_moment) if by_moments else arm
        loaded = links_of(known.with_payload(mass, (x, 0.0, 0.0)))._replace(rotors=NO_ROTORS)
        for theta in rng.uniform(-3.0, 3.0, (5, 4)):
            added = [np.triu(pin.crba(each, each.createData(), theta)) for each in (model, bare)]
            found = loaded.matrix(theta) - before._replace(rotors=NO_ROTORS).matrix(theta)
            assert np.triu(found) == pytest.approx(added[0] - added[1], abs=ROUNDING)


def _at(pin: Any, x: float) -> Any:
    return pin.SE3(np.eye(3), np.array((x, 0.0, 0.0)))


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


def test_a_load_that_is_set_live_comes_and_goes_as_a_guided_change():
    run = CompensatorRun()
    run.cycle(1.5)
    for mass in (2.0, 0.0):
        run.compensator.apply(settings_with(payload_mass=mass))
        assert run.cycle().damped
        first = np.array(run.efforts[-1])
        run.cycle(0.5)
        assert np.abs(np.array(run.efforts[-1]) - first).max() <= 0.5 * GUIDANCE.rate + 1e-6
        run.cycle(9.0)
        assert run.efforts[-1] == pytest.approx(gravity_torque(settings_with(payload_mass=mass).arm, THETA))


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


def drop(mass: float, pose: tuple[float, ...]) -> tuple[OfflineTrial, Compensator, np.ndarray]:
    """Drop a load of a relaxed wearer; return trial, compensator, and s, angles (4,) and speeds (4,) since then."""
    arm = SimulatedArm(ArmConfig(wearer_mass=WORN["wearer_mass"], wearer_cog=WORN["wearer_cog"]))
    arm.carry(mass)
    arm.reset((0.0, 0.05, 0.05, 0.05))
    motors = [JointMotor(MOTORS[name], n + 1) for n, name in enumerate(NAMES)]
    device = SimulatedDevice(arm, [SimulatedMotor(motor, Firmware()) for motor in motors], "right")
    settings = settings_with(side="right", robot=DEFAULT_LINKS, mode="zero_g", payload_mass=mass, **WORN)
    steps = [{"move": list(pose), "over": 3.0}, {"hold": 1.0}, {"load": 0.0, "over": 3.0}]
    script = TrialScript.parse({"name": "drop", "steps": steps})
    compensator = Compensator(settings)
    setup = ArmSetup(
        "right", device, motors, Limits(JOINTS, max_effort=MOST, sign_check_torque=0.0), settings, 125.0, None
    )
    trial = OfflineTrial(setup, script, 4.0, compensator)
    recording = trial.run()
    start = recording.steps[2].start
    keep = (recording.time > start - 0.01) & (recording.time < start + 3.0)
    rows = np.column_stack((recording.time - start, recording.position, recording.velocity))[keep]
    return trial, compensator, rows


@pytest.mark.thorough
def test_a_load_of_2_kg_that_is_dropped_moves_the_arm_little_and_its_torque_goes(monkeypatch):
    trial, compensator, rows = drop(2.0, (0.0, 0.4, 0.2, 0.5))
    assert trial.trouble == "" and compensator.dropped == 2.0
    assert compensator.settings.arm.payload[0] == 0.0
    assert np.abs(rows[:, 5:]).max() < 4.0
    assert np.abs(rows[-1, 1:5] - rows[0, 1:5]).max() < 0.8
    assert np.abs(rows[-1, 5:]).max() < GUIDANCE.calm
    monkeypatch.setattr(DropWatch, "step", lambda *_: False)
    _, _, unwatched = drop(2.0, (0.0, 0.4, 0.2, 0.5))
    assert np.abs(unwatched[:, 1:5] - unwatched[0, 1:5]).max() > np.abs(rows[:, 1:5] - rows[0, 1:5]).max() + 0.3


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
