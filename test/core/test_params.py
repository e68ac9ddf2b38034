# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Parameters: live changes, names of earlier versions, and what follows from them for an arm and its motors."""

from __future__ import annotations

import math
import random
from pathlib import Path

import numpy as np
import pytest
import yaml

from exo_gravity.core.compensation.compensator import LONGEST_STEP, Compensator
from exo_gravity.core.compensation.settings import COMMAND_PARAMETERS, COMPENSATOR, MODEL_PARAMETERS, URDF, settings_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import motors_of
from exo_gravity.core.params import GONE, in_force, values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE, limits_of
from exo_gravity.core.trunk.params import IMU
from exo_gravity.lab.bag.content import RECORDER
from exo_gravity.lab.calibration.tour import CALIBRATOR
from exo_gravity.lab.view import ROBOT_MODEL
from exo_gravity.panel.view import PANEL
from exo_gravity.sim.params import SIMULATOR

THEN = Path(__file__).parents[1] / "data" / "parameters_a47959f4.yaml"
TABLES = {
    "can_bridge": CAN_BRIDGE,
    "imu": IMU,
    "simulator": SIMULATOR,
    "recorder": RECORDER,
    "robot_model": ROBOT_MODEL,
    "panel": PANEL,
    "calibrator": CALIBRATOR,
}
LIVE = [param for param in COMPENSATOR if not param.fixed]
WRONG = (-0.1, math.nan, math.inf, 900.0, "", "heavy", True, None, [], [0.1] * 3, [0.1] * 5, [0.1, math.nan, 0.1, 0.1])
WRONG += ([0.0, 0.0, 0.31, 0.0], [0.1, -1e-9, 0.1, 0.1], [1e308] * 4, ["0.1"] * 4, b"0.1", {}, 1e308)


def possible(param, rng):
    """Draw a value within the bounds of the parameter."""
    if param.choices or not param.bounds:
        return rng.choice(list(param.choices)) if param.choices else param.default
    low, high = (5.0, 10.0) if param.name == "gravity" else param.bounds  # m/s^2, which go with any gain
    high *= rng.choice([1.0, 0.1]) if low == 0.0 else 1.0
    if isinstance(param.default, list):
        return [rng.uniform(low, high) for _ in param.default]
    return rng.choice([low, rng.uniform(low, high)])


def test_hundreds_of_valid_and_invalid_changes_are_applied_or_rejected_and_never_step_the_torque():
    rng = random.Random(7)
    values = values_of(COMPENSATOR, {"use_imu": False})
    compensator = Compensator(settings_of(values))
    now, refused, moved = 100.0, 0, 0.0
    last = np.array(compensator.step(now, (0.0,) * 4).effort)
    for _ in range(200):
        changed = {p.name: possible(p, rng) for p in rng.sample(LIVE, rng.choice([1, 1, 2, 5]))}
        if rng.random() < 0.4:
            changed[rng.choice([*LIVE]).name if rng.random() < 0.9 else "suport"] = rng.choice(WRONG)
        try:
            checked = values_of(COMPENSATOR, {**values, **changed})
            compensator.apply(settings_of(checked))
            values = checked
        except ParameterError as error:
            assert len(str(error).split()) > 4
            refused += 1
        theta = [rng.uniform(-1.5, 1.5) for _ in range(4)]
        for _ in range(rng.randrange(8)):
            period = rng.choice([0.001, 0.002, 0.004, 0.009, 0.011, 0.03, 0.045])  # late ones too
            now += period
            effort = np.array(compensator.step(now, theta).effort)
            step = np.abs(effort - last).max()
            assert step <= values["max_effort_rate"] * min(period, LONGEST_STEP) * (1 + 1e-9)
            last, moved = effort, moved + step
    assert 60 < refused < 140
    assert moved > 60.0  # Nm; the torque followed the changes


def test_parameters_that_ros_declares_on_every_node_are_ignored():
    for name in ("use_sim_time", "start_type_description_service", "qos_overrides./tf.publisher.depth"):
        assert name not in values_of(COMPENSATOR, {name: True})


def test_every_name_of_a47959f4_is_still_declared_or_refused_with_what_to_write():
    optional = (*COMMAND_PARAMETERS, *MODEL_PARAMETERS)
    tables = {**TABLES, "compensator": (*COMPENSATOR, *URDF, *optional)}
    declared = {node: {param.name: param for param in table} for node, table in tables.items()}
    names_then = yaml.safe_load(THEN.read_text(encoding="utf-8"))
    for node, names in names_then.items():
        for name in set(names) - declared[node].keys():
            assert GONE.keys() >= {name} and in_force(name, [0.25] * 8).keys() <= declared[node].keys()
            with pytest.raises(ParameterError, match=f"^{name} = .*: must be written in other parameters: "):
                values_of(tables[node], {name: [0.25] * 8})
    every = {name for names in declared.values() for name in names}
    assert not every & GONE.keys()


def test_what_is_written_for_a_parameter_that_is_gone_has_its_value():
    edges = [-1.0, 1.0, -0.5, 1.5, 0.0, 2.0, 0.1, 2.1]
    with pytest.raises(
        ParameterError, match=r"limits.lower: \[-1.0, -0.5, 0.0, 0.1\], limits.upper: \[1.0, 1.5, 2.0, 2.1\]"
    ):
        values_of(COMPENSATOR, {"limits.range": edges})
    moments = in_force("robot.moments", [0.1, 0.2, 0.3, 0.4, 0.01, 0.02, 0.03, 0.04])
    robot = settings_of(values_of(COMPENSATOR, moments)).robot
    assert robot.first_moment == (0.1, 0.2, 0.3, 0.4) and robot.off_axis == (0.01, 0.02, 0.03, 0.04)
    assert in_force("friction.identified", [0.2] * 4 + [0.1] * 4) == {
        "friction.coulomb": [0.2] * 4,
        "friction.viscous": [0.1] * 4,
    }
    assert in_force("inertial.shoulder_from_imu", [0.0, 0.1, 0.0])["inertial"]
    assert not in_force("inertial.shoulder_from_imu", [0.0] * 3)["inertial"]


def test_first_moments_replace_masses_and_centres_of_gravity_and_the_body_mass_those_of_the_wearer():
    plain = settings_of(values_of(COMPENSATOR, {})).robot
    given = {"robot.first_moment": list(plain.first_moment), "robot.mass": [9.0] * 4}
    moments = settings_of(values_of(COMPENSATOR, given)).robot
    assert moments.by_moments and not plain.by_moments and moments.first_moment == plain.first_moment
    for support, mass in ((1.0, 5.559), (0.5, 3.707)):
        wearer = {"wearer.body_mass": 75.0, "mode": "zero_g", "support": support}
        assert settings_of(values_of(COMPENSATOR, wearer)).arm.total_mass == pytest.approx(mass, abs=1e-3)


ARM = {"can.interface": "virtual", "can.channel": "arm"}
ELBOW = {
    **ARM,
    "joint_names": ["elbow"],
    "motor": ["AK80-64"],
    "can_id": [7],
    "position_min": [-0.1],
    "position_max": [2.4],
    "max_effort": [12.0],
}


def test_an_arm_of_one_joint_has_the_defaults_that_are_the_same_for_all_joints():
    values = values_of(CAN_BRIDGE, ELBOW)
    assert values["direction"] == [1] and values["zero"] == values["home"] == values["largest_moment"] == [0.0]
    assert motors_of(values)[0].spec.gear_ratio == 64


@pytest.mark.parametrize(
    ("given", "tolerance"),
    [
        (ELBOW, (0.048,)),
        ({**ARM, "motor": ["AK80-9"] * 4}, (0.34,) * 4),
        ({**ARM, "motor": ["DM-J4310"] * 4, "motor_timeout": [0.2] * 4}, (0.5,) * 4),
    ],
)
def test_a_joint_that_is_off_by_a_turn_of_its_rotor_is_never_near_its_zero(given, tolerance):
    assert limits_of(values_of(CAN_BRIDGE, given)).home_tolerance == pytest.approx(tolerance, abs=1e-3)
    for motor in (motor for motor in MOTORS.values() if not motor.output_encoder):
        assert motor.home_tolerance < math.pi / motor.gear_ratio


@pytest.mark.parametrize(
    ("rate", "frozen", "timeout"),
    [(500.0, 0.08, 0.05), (250.0, 0.08, 0.05), (100.0, 0.2, 0.07), (50.0, 0.08, 0.1), (100.0, 2.0, 2.0)],
)
def test_a_motor_is_silent_after_50_ms_or_7_cycles_up_to_100_ms_or_as_long_as_a_simulated_bridge_may_freeze(
    rate, frozen, timeout
):
    values = values_of(CAN_BRIDGE, {**ARM, "rate": rate, "frozen_timeout": frozen})
    assert limits_of(values).reply_timeout == pytest.approx(timeout)
