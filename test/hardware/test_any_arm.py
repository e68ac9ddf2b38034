# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Arms of any number of joints, from a URDF, on the whole path of a torque: compensator, safety machine, bus, motors.

Torque that gravity cannot account for is a fault there, too.

MuJoCo's model of the same URDF says what gravity needs, and the simulated device what the motors did.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence

import mujoco
import numpy as np
import pytest

from exo_gravity.core.arm.interface import NO_LOAD, Payload
from exo_gravity.core.arm.tilt import SIDES, Tilt, gravity_in_trunk
from exo_gravity.core.compensation.settings import Settings, compensator_table, settings_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor, JointSample
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.drive import Drive, FaultCode, Send
from exo_gravity.core.safety.explain import GRAVITY, MotionMonitor
from exo_gravity.core.safety.limits import DAMPING, Limits
from exo_gravity.hardware.bus_lock import ArmNotes, DriveNotes
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.sim.arm import SimulatedArm
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.motors import simulated
from exo_gravity.sim.trunk_motion import TrunkState
from exo_gravity.sim.urdf import UrdfConfig

from ..support.chains import random_chain
from ..support.thorough import quick
from ..support.urdf_oracle import MujocoArm
from .arms import DRIVEN, JudgedArm
from .test_urdf_arm import ARMS

COUNTS = (1, 2, 3, 5, 6, 7, 9)
ANSWERED = 1e-10  # Nm, of what gravity needs
SPEC = MOTORS["AK80-9"]
CODE = 2.0 * SPEC.torque_range / 4095  # Nm
RATE = 125.0  # Hz
LIFT = 0.35  # rad, by which the wearer moves each joint
LIFTED, HOLD = 4.0, 3.0  # s of that, and after it
FREE = 2.5  # rad from zero, so that the stops are far
UPRIGHT, TILTED = TrunkState(), TrunkState(0.4, -0.3)


def settings_for(text: str, names: Sequence[str], **given: object) -> Settings:
    given = {"law": "urdf", "joint_names": list(names), "use_imu": False, **given}
    return settings_of(values_of(compensator_table(given), given), UrdfArm(text, names, "hand"))


def chain_config(count: int, zero: Sequence[float]) -> UrdfConfig:
    """Return the arm at random with `count` joints. zero: of `random_chain`."""
    text, names = random_chain(count, count, zero)
    mechanics = {"coulomb_friction": (0.1,) * count, "rotor_inertia": (0.005,) * count}
    return UrdfConfig(text=text, joint_names=names, hand="hand", **mechanics)


def hanging_chain(count: int, trunk: TrunkState) -> tuple[UrdfConfig, list[float]]:
    """Return an arm at random with `count` joints that hangs off its stops on `trunk`, and its angles there."""
    config, home = chain_config(count, ()), np.random.default_rng(count).uniform(-FREE, FREE, count)
    model, _ = config.models()
    model.dof_frictionloss[:], model.dof_damping[:], model.jnt_limited[:] = 0.0, 0.2, 0
    model.opt.gravity = config.felt("left", trunk)[0]
    data = mujoco.MjData(model)
    while data.time == 0.0 or np.abs(data.qvel).max() > 1e-4:  # it falls under damping, past its stops
        mujoco.mj_step(model, data, 5_000)
    return chain_config(count, (data.qpos - home).tolist()), home.tolist()


PLAYED = [(count, UPRIGHT) for count in COUNTS] + [(3, TILTED)]


@pytest.mark.parametrize(("count", "trunk"), quick([(1, UPRIGHT), (3, TILTED)], PLAYED))
def test_an_arm_is_proven_carried_raised_and_let_down_by_its_own_gravity(count: int, trunk: TrunkState) -> None:
    config, home = hanging_chain(count, trunk)
    joints = [JointMotor(SPEC, 1 + n, wire_format=MIT) for n in range(count)]
    device = SimulatedDevice(SimulatedArm(config), [simulated(joint) for joint in joints])
    device.arm.reset(home)
    device.pitch, device.roll = trunk.pitch, trunk.roll
    low, high = np.clip(home, -2.1, 3.1) - 1.0, np.clip(home, -3.1, 2.1) + 1.0
    most, names = (SPEC.peak_torque,) * count, tuple(config.joint_names)
    settings = settings_for(config.text, names, max_effort=list(most), use_imu=trunk is not UPRIGHT)
    arm = JudgedArm(device, settings, joints, Limits(names, low, high, max_effort=most, home=tuple(home)), RATE)
    arm.carry()
    assert arm.fastest < DRIVEN
    arm.raise_to([angle - math.copysign(LIFT, angle) for angle in home], LIFTED, HOLD)  # away from the stops
    effort, gravity = arm.direct.answer.effort, gravity_in_trunk(trunk.pitch, trunk.roll)
    needed = MujocoArm(config.text, names).torque([joint.position for joint in arm.loop.samples], 9.80665 * gravity)
    assert np.abs(effort - needed).max() < ANSWERED
    arm.cycle()  # with which they leave
    assert np.abs([motor.torque(0.0, 0.0) for motor in arm.motors] - needed).max() <= 0.5 * CODE + 1e-9
    assert arm.let_down()


def test_notes_of_an_arm_with_another_number_of_joints_are_no_torque_for_this_one() -> None:
    notes = DriveNotes.from_buffer(bytearray(ctypes.sizeof(DriveNotes)))
    assert not ArmNotes([notes] * 2).drive.powered
    notes.note(Drive((1.0, 2.0, 3.0), (0.5,) * 3, (Send.COMMAND,) * 3, True))
    assert ArmNotes([notes] * 3).drive == notes.drive
    assert ArmNotes([notes] * 2).drive == Drive((0.0,) * 2, (DAMPING,) * 2, (Send.COMMAND,) * 2, True)


@pytest.mark.parametrize("held", [{}, {"payload.mass": 1.5, "payload.cog": [0.02, -0.03, 0.05]}])
@pytest.mark.parametrize("pitch", [0.0, 0.6])
def test_a_wearer_and_a_load_are_carried_on_any_links_under_any_tilt(held: dict[str, object], pitch: float) -> None:
    count = 5
    text, names = random_chain(count, seed=11)
    arm = UrdfArm(text, names, "hand")
    mass, cog = [0.0, 1.1, 0.0, 0.7, 0.3], [0.0, 0.5 * arm.length[1], 0.0, 0.9 * arm.length[3], 0.2 * arm.length[4]]
    worn = {"wearer.mass": mass, "wearer.cog": cog, "mode": "zero_g", "support": 0.6}
    settings = settings_for(text, names, max_effort=[1000.0] * count, **worn, **held)
    config = UrdfConfig(
        text=text, joint_names=names, hand="hand", wearer_mass=[0.6 * m for m in mass], wearer_cog=cog, gravity=9.80665
    )
    load = Payload(held["payload.mass"], held["payload.cog"]) if held else NO_LOAD
    model, _ = config.models(load)
    random, tilt = np.random.default_rng(5), Tilt.of("left", pitch, -0.5 * pitch)
    model.opt.gravity = 9.80665 * np.array(tilt.gravity_in_trunk)
    data = mujoco.MjData(model)
    for _ in range(20):
        data.qpos[:] = random.uniform(-3.0, 3.0, count)
        mujoco.mj_forward(model, data)
        torque, reason = settings.torque(data.qpos.tolist(), tilt)
        assert reason == "" and np.abs(torque - data.qfrc_bias).max() < 1e-9
    bare = settings.robot
    assert settings.mass == pytest.approx(bare.total_mass + 0.6 * sum(mass) + load[0])


def test_inertia_and_momentum_agree_with_mujocos() -> None:
    count = 6
    text, names = random_chain(count, seed=3)
    arm = UrdfArm(text, names, "hand").with_payload(0.8, (0.05, 0.0, 0.02))
    config = UrdfConfig(text=text, joint_names=names, hand="hand", rotor_inertia=(0.0,) * count)
    model, _ = config.models(Payload(0.8, (0.05, 0.0, 0.02)))
    model.opt.gravity = np.zeros(3)
    model.dof_damping[:] = model.dof_frictionloss[:] = 0.0
    data, random = mujoco.MjData(model), np.random.default_rng(4)
    whole = np.zeros((count, count))
    for _ in range(20):
        theta, velocity, acceleration = (random.uniform(-1.5, 1.5, count) for _ in range(3))
        data.qpos[:], data.qvel[:] = theta, velocity
        mujoco.mj_forward(model, data)
        for row, one in zip(whole, np.eye(count), strict=True):
            mujoco.mj_mulM(model, data, row, one)
        np.testing.assert_allclose(
            arm.links.matrix(theta), whole, rtol=0.0, atol=1e-6
        )  # a point of mass has some inertia
        expected = whole @ acceleration + data.qfrc_bias
        np.testing.assert_allclose(arm.links.torque(theta, velocity, acceleration), expected, rtol=0.0, atol=1e-5)
        momentum, _ = arm.links.momentum(theta, velocity)
        np.testing.assert_allclose(momentum, whole @ velocity, rtol=0.0, atol=1e-5)
        assert np.all(1.0 / np.diag(np.linalg.inv(whole)) > 0.9 * np.array(arm.links.least))


def test_the_exact_momentum_balance_holds() -> None:
    """With p = M v: p' = tau + C^T v - g along any motion, which is what the observer relies on."""
    text, names = random_chain(4, seed=8)
    links = UrdfArm(text, names).links
    at = [lambda t, n=n: 0.4 * math.sin(t + n) for n in range(4)]
    rate = [lambda t, n=n: 0.4 * math.cos(t + n) for n in range(4)]
    t, step = 0.7, 1e-5
    theta, velocity = [q(t) for q in at], [v(t) for v in rate]
    acceleration = [-q for q in theta]
    before, after = (links.momentum([q(s) for q in at], [v(s) for v in rate])[0] for s in (t - step, t + step))
    change = (np.array(after) - before) / (2.0 * step)
    torque = links.torque(theta, velocity, acceleration)
    np.testing.assert_allclose(change, np.add(torque, links.momentum(theta, velocity)[1]), atol=1e-6)


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"payload.mass": 1.0}, r"payload\.mass = 1\.0: must be 0 without urdf\.hand"),
        (
            {"mode": "zero_g", "support": 1.0, "wearer.mass": [0.5, 0.5]},
            r"wearer\.mass = .*: must be 0 on link 2, which has no length",
        ),
        ({"wearer.body_mass": 70.0}, r"wearer\.links = \[3, 4\]: must be 2 different links from 1 to 2"),
        ({"gain": [1.0]}, r"gain = \[1\.0\]: must be 2 numbers"),
    ],
)
def test_what_an_arm_without_a_hand_cannot_hold_is_refused(given: dict[str, object], problem: str) -> None:
    text, names = random_chain(2, seed=2)
    values = {"law": "urdf", "joint_names": names, "use_imu": False, "max_effort": [30.0, 30.0], **given}
    with pytest.raises(ParameterError, match=problem):
        settings_of(values_of(compensator_table(values), values), UrdfArm(text, names))


# Torque that gravity cannot account for.

CYCLE = 0.004


def limits_of(arm: UrdfArm, **changes: object) -> Limits:
    """What `budget` prints for the arm."""
    found, count = arm.skeleton(), len(arm.names)
    rows = {f"{name}_{axis}": tuple(column.round(4)) for name, of in (("axis", found.axes), ("link", found.ways))
            for axis, column in zip("xyz", of.T, strict=True)}  # fmt: skip
    addition = np.minimum(10.0, GRAVITY * found.beside)
    limits = {"max_effort": (500.0,) * count, "position_min": (-3.0,) * count, "position_max": (3.0,) * count}
    moments = {"largest_moment": tuple(found.moments), "largest_addition": tuple(addition)}
    return Limits(arm.names, **{**limits, **moments, **rows, "max_command": (500.0,) * count, **changes})


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("count", [1, 2, 3, 5, 6, 7, 9])
def test_what_mujoco_needs_of_any_chain_is_explained_in_any_pose_at_any_tilt(count: int, side: str) -> None:
    text, names = random_chain(count, seed=count)
    arm, truth, random = UrdfArm(text, names, "hand"), MujocoArm(text, names), np.random.default_rng(count)
    monitor, beside = MotionMonitor(limits_of(arm)), GRAVITY * arm.skeleton().beside
    for _ in range(50):
        theta, (pitch, roll) = random.uniform(-3.0, 3.0, count), random.uniform(-1.0, 1.0, 2)
        tilt = Tilt.of(side, pitch, roll)
        monitor.follow(tilt, None)
        low, high = monitor.explained(theta.tolist())
        torque = truth.torque(theta, 9.80665 * np.array(tilt.gravity_in_trunk))
        assert np.all(low - beside - 0.01 <= torque) and np.all(torque <= high + beside + 0.01)


@pytest.mark.parametrize("name", ["elbow", "three_joints", "seven_joints"])
def test_the_torque_of_a_shipped_arm_is_no_fault_and_its_opposite_is(name: str) -> None:
    text, names = ARMS[name][0].read_text(encoding="utf-8"), ARMS[name][1]
    arm, theta = UrdfArm(text, names, "hand"), [0.5 + 0.1 * n for n in range(len(names))]
    torque = MujocoArm(text, names).torque(theta, (0.0, 0.0, -9.80665))
    samples = tuple(JointSample(angle, 0.0, 0.0, None, None, 0.0) for angle in theta)
    for share, is_fault in ((1.0, False), (0.3, False), (-1.0, True), (3.0, True)):
        monitor, fault = MotionMonitor(limits_of(arm)), None
        for _ in range(100):
            fault = fault or monitor.step(CYCLE, samples, (share * torque).tolist())[1]
        assert bool(fault) is is_fault
        assert fault is None or fault.code is FaultCode.UNEXPLAINED_TORQUE


NO = dict.fromkeys("xyz", (0.0,) * 3)
AXIS, LINK = ({f"{name}_{axis}": NO[axis] for axis in NO} for name in ("axis", "link"))


@pytest.mark.parametrize(("given", "words"), [
    (AXIS, r"largest_moment = .*must be zeros without axis_x"),
    ({"axis_x": (1.0, 0.0, 0.0), "axis_y": (0.0, 0.0, 1.0), "axis_z": (0.0, 0.0, 0.0)},
     r"axis_x, _y, _z of joint_1 = .*must be a vector of length 1"),
    (LINK, r"largest_moment of joint_0 = .*must be 0 for a link without"),
])  # fmt: skip
def test_axes_that_are_no_directions_and_moments_without_a_link_are_refused(given, words) -> None:
    with pytest.raises(ParameterError, match=words):
        limits_of(UrdfArm(*random_chain(3, seed=3), "hand"), **given)
