# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The compensator of another arm than the paper's: a pendulum of two joints."""

import math

import numpy as np
import pytest

from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import urdf_settings_of, urdf_table
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.hardware.urdf_arm import UrdfArm

PERIOD = 0.004  # s
POSE = (0.4, -0.7)


# Two joints about y in one place, each with 1 kg m; it hangs along -z.
LINK = """<link name="{0}"><inertial><origin xyz="0 0 -1"/><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><axis xyz="0 -1 0"/>
<limit lower="-3" upper="3" effort="{3}" velocity="5"/></joint>"""
PARTS = (
    LINK.format("upper"),
    JOINT.format("a", "base", "upper", 30),
    LINK.format("lower"),
    JOINT.format("b", "upper", "lower", 0),
)
PENDULUM = UrdfArm(f'<robot name="pendulum"><link name="base"/>{"".join(PARTS)}</robot>', ["a", "b"])


def torque_of(theta, gravity):
    """Return the torque (2,) in Nm that holds the pendulum; gravity: (3,) m/s^2."""
    (first, second), (x, _, z) = theta, gravity
    lower = -z * math.sin(first + second) - x * math.cos(first + second)
    return lower - z * math.sin(first) - x * math.cos(first), lower


def settings(**changes):
    given = {"joint_names": ["a", "b"], "max_effort": [0.0, 20.0], "use_imu": False, **changes}
    return urdf_settings_of(values_of(urdf_table(given), given), PENDULUM)


def steps(arm, start, seconds):
    return [arm.step(start + n * PERIOD, POSE, (0.0, 0.0)).effort for n in range(round(seconds / PERIOD))]


def test_it_gives_the_models_torque_times_the_gain():
    arm = Compensator(settings(gain=[1.0, 0.5]))
    first, second = torque_of(POSE, (0.0, 0.0, -9.80665))
    assert arm.step(5.0, POSE, (0.0, 0.0)).effort == pytest.approx((first, 0.5 * second), abs=1e-12)


def test_gravity_comes_from_the_tilt_in_the_root_links_axes():
    arm = Compensator(settings(use_imu=True, max_effort_rate=1000.0, tilt_timeout=0.5))
    assert arm.step(1.0, POSE).reason == "no trunk tilt yet"
    for n in range(300):
        arm.tilt.set_gravity(2.0 + n * PERIOD, (0.6, 0.0, -0.8))
        answer = arm.step(2.0 + n * PERIOD, POSE)
    assert answer.effort == pytest.approx(torque_of(POSE, (0.6 * 9.80665, 0.0, -0.8 * 9.80665)), abs=1e-9)
    assert arm.step(4.0, POSE).reason == "trunk tilt older than 500 ms"


def test_a_change_of_settings_fades_in_without_a_step():
    arm = Compensator(settings(max_effort_rate=1000.0))
    before = steps(arm, 1.0, 1.5)[-1]
    arm.apply(settings(gain=[2.0, 2.0], max_effort_rate=1000.0))
    efforts = [before, *steps(arm, 2.5, max(GUIDANCE.time, np.abs(before).max() / GUIDANCE.rate) + 0.1)]
    assert np.allclose(efforts[-1], np.multiply(2.0, before), rtol=0.0, atol=1e-12)
    assert np.abs(np.diff(efforts, axis=0)).max() <= GUIDANCE.rate * PERIOD + 1e-9


def test_torque_beyond_the_limit_of_the_urdf_is_clamped_and_named():
    arm = Compensator(settings(max_effort=[3.0, 20.0], max_effort_rate=1000.0))
    for n in range(300):
        answer = arm.step(1.0 + n * PERIOD, (1.5, 0.0))
    assert answer.effort[0] == 3.0 and answer.clamped == (0,)


@pytest.mark.parametrize("theta", [(0.0,), (0.0, 0.0, 0.0), (math.nan, 0.0), (0.0, 30.0)])
def test_impossible_angles_are_refused(theta):
    assert "are not 2 numbers within 26 rad" in Compensator(settings()).step(1.0, theta).reason


def test_a_joint_without_any_effort_limit_is_refused():
    with pytest.raises(ParameterError, match=r"max_effort of b = 0\.0: must be greater than 0"):
        settings(max_effort=[0.0, 0.0])


def test_a_list_must_have_one_entry_per_joint():
    with pytest.raises(ParameterError, match="gain"):
        settings(gain=[1.0] * 3)
