# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Parameters: live changes, names of earlier versions, what follows from them, and values that nothing has."""

import json
import math
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from exo_gravity.core import ArmModel, paper_mobile_torque, paper_static_torque
from exo_gravity.core.arm.springs import Springs
from exo_gravity.core.arm.tilt import Tilt, pitch_roll, rotation_matrix
from exo_gravity.core.arm.wearer import MAX_TISSUE, Wearer
from exo_gravity.core.compensation.compensator import LONGEST_STEP, Compensator
from exo_gravity.core.compensation.settings import (
    COMMAND_PARAMETERS,
    COMPENSATOR,
    MODEL_PARAMETERS,
    URDF,
    Settings,
    compensator_table,
    settings_of,
)
from exo_gravity.core.compensation.terms.catalogue import Coupling, Damping, Friction, Spring
from exo_gravity.core.compensation.terms.terms import TermSettings, term_parameters, term_settings_of
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.motors.ak import pack_reply
from exo_gravity.core.motors.families import MOTORS, format_of
from exo_gravity.core.motors.frames import pack_command
from exo_gravity.core.motors.joint_motor import JointMotor, Traffic, buses_of, motors_of, traffic_of
from exo_gravity.core.params import GONE, in_force, values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE, Limits, check_bridge, limits_of
from exo_gravity.core.trunk.checks import IMU
from exo_gravity.core.trunk.inputs import FeltMotion
from exo_gravity.hardware.motor_bus import MotorBus
from exo_gravity.hardware.trunk_estimator import TrunkEstimator
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.lab.anfis import Anfis, AnfisLaw, text_of
from exo_gravity.lab.bag.content import RECORDER
from exo_gravity.lab.calibration.moment_model import MomentModel
from exo_gravity.lab.calibration.tour import calibrator_table
from exo_gravity.lab.view import ROBOT_MODEL
from exo_gravity.panel.control import PANEL
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.params import SIMULATOR
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.trunk_motion import ImuConfig
from exo_gravity.sim.virtual_time import Wire

from ..support import ROBOT
from ..support.chains import random_chain
from ..support.compensator_run import settings_with
from ..support.safety_run import LIMITS
from ..support.simulated_device import make_device
from .test_anfis import law, learned, random_model

THEN = Path(__file__).parents[1] / "data" / "parameters_a47959f4.yaml"
TABLES = {
    "can_bridge": CAN_BRIDGE,
    "imu": IMU,
    "simulator": SIMULATOR,
    "recorder": RECORDER,
    "robot_model": ROBOT_MODEL,
    "panel": PANEL,
    "calibrator": calibrator_table({}),
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
    rng, now, refused, efforts, bounds = random.Random(7), 100.0, 0, [], []
    values = values_of(COMPENSATOR, {"use_imu": False})
    compensator = Compensator(settings_of(values))
    for _ in range(200):
        changed = {p.name: possible(p, rng) for p in rng.sample(LIVE, rng.choice([1, 1, 2, 5]))}
        if rng.random() < 0.4:
            changed[rng.choice([*LIVE]).name if rng.random() < 0.9 else "suport"] = rng.choice(WRONG)
        try:
            checked = values_of(COMPENSATOR, {**values, **changed})
            compensator.apply(settings_of(checked))
            values = checked
        except ParameterError:
            refused += 1
        theta = [rng.uniform(-1.5, 1.5) for _ in range(4)]
        for _ in range(rng.randrange(8)):
            period = rng.choice([0.001, 0.002, 0.004, 0.009, 0.011, 0.03, 0.045])  # late ones too
            now += period
            efforts.append(compensator.step(now, theta).effort)
            bounds.append(values["max_effort_rate"] * min(period, LONGEST_STEP))  # Nm
    steps = np.abs(np.diff(efforts, axis=0)).max(axis=1)
    assert np.all(steps <= np.array(bounds[1:]) * (1 + 1e-9))
    assert 60 < refused < 140 and steps.sum() > 60.0  # Nm; the torque followed the changes


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


# Values that no arm, person, motor or bus has: each is refused with its name, and with what would be right.

NAN, INF, ZERO = math.nan, math.inf, (0.0,) * 4
LENGTH, COG, MASS = (0.05, 0.13, 0.30, 0.30), (0.02, 0.05, 0.1, 0.2), (0.5, 0.4, 0.6, 0.2)
OFF_AXIS = (0.01, -0.02, 0.003, 0.002)
V3 = ["mit_v3"] * 4


def row(make: Callable[..., object], words: str, *args: Any, **given: Any) -> Any:
    """Return a case: `make` is called with `args` and `given`, and its error has `words`, a regular expression."""
    return pytest.param(make, args, given, words, id=words)


def arm(**given):
    return ArmModel(**{"length": LENGTH, "cog": COG, "mass": MASS, **given})


def by_moments(**given):
    return ArmModel.from_moments(**{"length": LENGTH, "first_moment": (0.05, 0.2, 0.2, 0.04), **given})


ARMS = [
    row(arm, "^length = ", length=(0.05, 0.13, 0.30)),
    row(arm, "^length = ", length=(50, 130, 300, 300)),
    row(arm, "^cog = ", cog=(0.06, 0.05, 0.1, 0.2)),
    row(arm, "^cog = ", cog=(0.02, 0.05, NAN, 0.2)),
    row(arm, "^mass = ", mass=(0.5, 0.4, 900.0, 0.2)),
    row(arm, "^mass = ", mass=(0.5, 0.4, -0.1, 0.2)),
    row(arm, "^mass = ", mass="heavy"),
    row(arm, "^gain = ", gain=(1.0, 1.0, 1.0, -1.0)),
    row(arm, "^gravity = ", gravity=INF),
    row(arm, "^gravity = ", gravity=None),
    row(by_moments, "^first_moment = ", first_moment=(50, 200, 200, 40)),
    row(by_moments, "^first_moment = ", first_moment=(0.05, 0.2, 0.2, -0.04)),
    row(by_moments, "^first_moment = ", first_moment=(0.05, 0.2, 0.2, NAN)),
    row(by_moments, "^off_axis = ", off_axis=(0.01, -0.02, 0.003)),
    row(by_moments, "^off_axis = ", off_axis=(0.01, -20.0, 0.003, 0.0)),
    row(MomentModel(arm(), True).load, "^load_mass = ", 1000, 0.3),
    row(MomentModel(arm(), True).load, "^load_lever = ", 1, 300),
    row(MomentModel(arm(), True).load, "lever", 1, -0.1),
]
for known, why in ((by_moments(), "needs mass and cog"), (arm(off_axis=OFF_AXIS), "knows no moments across")):
    words = rf"robot.(first_moment|off_axis) = .*must be 0 for paper_.*which {why}"
    ARMS += [row(paper_static_torque, words, known, ZERO), row(paper_mobile_torque, words, known, ZERO, 0.0, 0.0)]

SHORT = (0.06, 0.1, 0.18, 0.09, 0.15, 0.04, 0.1)  # m, links of an arm whose forearm begins after link 4
MAN = Wearer(75.0, "male", "de_leva", (0.28, 0.27, 0.086))
BEYOND = r"link_length.*{} is at .* m, beyond link {}"
PEOPLE = [
    row(Wearer, "body_mass", NAN),
    row(Wearer, "body_mass", 75_000),
    row(Wearer, "body_mass", "heavy"),
    row(Wearer, "sex", 75, "other"),
    row(Wearer, "table", 75, "male", "dempster"),
    row(Wearer, "segment_length", 75, "male", "winter", (0.28, 0.27)),
    row(Wearer, "segment_length", 75, "male", "winter", (280, 270, 86)),
    row(Wearer, "segment_length", 75, "male", "winter", 0.28),
    row(Wearer, "segment_length", 75, "male", "winter", (0.28, NAN, 0.086)),
    row(Wearer(75.0).on_links, BEYOND.format("upper arm", 3), (0.05, 0.13, 0.15, 0.30)),
    row(Wearer(75.0).on_links, BEYOND.format("forearm and hand", 4), (0.05, 0.13, 0.30, 0.15)),
    row(MAN.on_links, BEYOND.format("upper arm", 3), (0.06, 0.1, 0.15, *SHORT[3:]), (3, 4)),  # link 4 is the forearm's
    row(MAN.on_links, r"forearm and hand is at 0\.338 m, beyond link 5", SHORT[:5], (3, 4)),
]

NAMED = (rotation_matrix, "rotation_trunk_from_imu")
TILTS = [
    *(row(make, "gravity_in_trunk", (0, 0, 0)) for make in (pitch_roll, lambda g: Tilt.of_gravity("left", g))),
    *(row(make, "gravity_in_trunk", (NAN, 0, 1)) for make in (pitch_roll, lambda g: Tilt.of_gravity("left", g))),
    *(row(make, "gravity_in_trunk", (INF, 0, 1)) for make in (pitch_roll, lambda g: Tilt.of_gravity("left", g))),
    row(Tilt.of, "side", "middle", 0, 0),
    row(Tilt.of, "pitch", "left", NAN, 0),
    row(Tilt.of, "roll", "left", 0, 4.0),
    row(Tilt.of, "pitch", "left", None, 0),
    row(*NAMED, (0, 0, 0, 0), NAMED[1]),
    row(*NAMED, (0, 0, 0, 1.1), NAMED[1]),
    row(*NAMED, (NAN, 0, 0, 1), NAMED[1]),
    row(*NAMED, (0, 0, 1), NAMED[1]),
    row(*NAMED, (1, 1, 1, 1), NAMED[1]),
    row(FeltMotion().add, "linear_acceleration", 0.0, (0.0, 0.0, NAN), (0.0, 0.0, 0.0)),
]


def gained(gain, gravity):
    return settings_with(robot=ArmModel(ROBOT.length, ROBOT.cog, ROBOT.mass, (1.0, gain, 1.0, 1.0), gravity))


def compensator(**given):
    return settings_of(values_of(COMPENSATOR, {name.replace("__", "."): value for name, value in given.items()}))


HEAVY, WHOLE = (0.0, 0.0, 5.0, 4.0), {"support": 1.0, "mode": "zero_g"}  # kg, with 1.854 kg of robot
ADAPTIVE = {"mode": "zero_g", "support": 0.4, "support_adapts": True}
BY_MOMENTS = ArmModel.from_moments(ROBOT.length, ROBOT.first_moment)
SETTINGS = [
    row(settings_with, "^side = ", side="both"),
    row(settings_with, "^law = .*one of exact, paper_static, paper_mobile, anfis, urdf", law="newton"),
    row(settings_with, "^mode = ", mode="half_g"),
    row(settings_with, "^support = ", support=1.1),
    row(settings_with, "^wearer.mass = ", wearer_mass=(0.0, 0.0, 900.0, 0.0)),
    row(settings_with, "^wearer.cog = ", wearer_cog=(0.0, 0.0, 0.31, 0.0)),
    row(settings_with, "^max_effort = ", max_effort=(1.0, 2.0, 3.0)),
    row(settings_with, "^max_effort_rate = ", max_effort_rate=NAN),
    row(settings_with, r"total mass in kg = 10.85: must be at most 10 \(robot 1.85, ", mode="one_g", wearer_mass=HEAVY),
    row(settings_with, r"total mass in kg = 10.85: must be at most 10 \(robot", mode="zero_g", wearer_mass=HEAVY),
    *(
        row(gained, r"gain times gravity = .*: must be at most 20 m/s\^2", gain, gravity)
        for gain, gravity in ((2.0, 25.0), (2.0, 10.01), (0.9, 25.0), (1.3, 16.0))
    ),
    row(settings_with, "total mass", **ADAPTIVE, wearer_mass=(0.0, 0.0, 5.4, 4.2)),  # at full support
    row(settings_with, "anfis_file", law="anfis"),
    row(settings_with, "robot.first_moment = .*0 for law anfis", law="anfis", trained=learned(), robot=BY_MOMENTS),
    row(Settings, "joint_stiffness", "left", DEFAULT_LINKS, joint_stiffness=(0.0, 2.6, 0.0, 0.0)),  # Nm per degree
    row(compensator, r"joint_spring.stiffness", joint_spring__stiffness=[0.0, -0.1, 0.0, 0.0]),
    row(compensator, r"joint_spring.stiffness", joint_spring__stiffness=[2.1] * 4),
    row(compensator, r"joint_spring.stiffness", joint_spring__stiffness=[0.1] * 3),
    row(compensator, r"joint_spring.rest", joint_spring__rest=[4.0] * 4),
    row(compensator, "gravity = 0.0: must be a number from 1 to 25 m/s", gravity=0.0),
    row(compensator, "max_effort = .* from 0.1 to 500 Nm", max_effort=[0.0] * 4),
    row(compensator, "payload.mass = 5.5: must be a number from 0 to 5 kg", payload__mass=5.5),
    row(compensator, "payload.cog = .* from -0.5 to 0.5 m", payload__cog=[0.0, 0.6, 0.0]),
    row(compensator, "payload.mass = 1.0: must be 0 for law paper_static", payload__mass=1.0, law="paper_static"),
    row(compensator, "payload.mass 4.00", payload__mass=4.0, wearer__body_mass=140.0, **WHOLE),
    *(
        row(compensator, rf"robot.{name} = .*0 for law {law}", law=law, **{f"robot__{name}": [0.1, 0.2, 0.2, 0.03]})
        for name in ("first_moment", "off_axis")
        for law in ("paper_static", "paper_mobile")
    ),
    row(compensator, r"total mass in kg = 20.0: must be at most 10 ", robot__first_moment=[0.1, 0.2, 6.0, 0.03]),
    row(compensator, r"^law = 'urdf': must be chosen at the start", law="urdf"),
]


def path(*rows):
    return Spring((1.0,) * 4, rows)


def on_arm(**terms):
    return TermSettings(**terms).on_arm(DEFAULT_LINKS)


def terms(**given):
    table = {name.replace("__", "."): value for name, value in given.items()}
    return term_settings_of({**values_of(term_parameters(), {}), **table})


STABLE = "^{} = .* at most .* late is stable"
TERMS = [
    row(Friction, r"^viscous = .* from 0 to 1 Nm s/rad", 0.5, (0.2, 0.4, 0.2, 0.2), (0.02, 0.05, 0.02, 2.0)),
    *(row(path, r"path|pose", *values) for values in ((), (0.0,) * 3, (0.0,) * 6, (0.0,) * 10, (1.0, *ZERO))),
    row(path, r"path", 0.0, *ZERO, 0.1, 3, 0, 0, 0),
    row(path, r"path", 0.0, *ZERO, NAN, *ZERO),
    row(path, r"path", 0.0, *ZERO, INF, *ZERO),
    row(path, r"path", 0.0, *ZERO, 2.0, *ZERO, 1.0, *ZERO),
    row(path, r"^spring.pose = .*4 angles", 0.0, 0.0, 0.0, NAN),
    row(path, r"path|pose", 0.0, 0.0, 0.0, 0.0, NAN),
    row(on_arm, STABLE.format("spring.stiffness"), spring=Spring((50.0, 0.0, 0.0, 0.0))),
    row(on_arm, STABLE.format("damping.viscosity"), damping=Damping((0.0, 0.0, 0.0, 3.0))),
    row(on_arm, STABLE.format("coupling.stiffness"), coupling=Coupling((0.0, -15.0, 30.0, 0.0))),
    row(terms, r"^coupling.stiffness = .* two joints or more", coupling__stiffness=[0.0, 1.0, 0.0, 0.0]),
    row(terms, r"^limits.lower = .* below limits.upper", limits__lower=[0.5] * 4, limits__upper=[0.5] * 4),
]


def bridge(usual: Any = (), **given: Any) -> tuple[JointMotor, ...]:
    wanted = {"can.interface": "virtual", "can.channel": "arm", **dict(usual), **given}
    values = values_of(CAN_BRIDGE, {name.replace("__", "."): value for name, value in wanted.items()})
    motors, limits = motors_of(values), limits_of(values)
    check_bridge(values["rate"], motors, limits)
    return motors


def limited(**given):
    return Limits(**{**vars(LIMITS), **given})


def elbow(without: str = "", **given: Any) -> tuple[JointMotor, ...]:
    one = {"joint_names": ["elbow"], "motor": ["AK80-64"], "can_id": [7], "max_effort": [12.0]}
    one |= {"position_min": [-0.1], "position_max": [2.4]}
    return bridge({name: value for name, value in one.items() if name != without}, **given)


SOCKETCAN = {"can__interface": "socketcan", "can__channel": "vcan0"}
PEAK = r"max_effort = .*: must be at most the motors' peak torque, \[{}"
BRIDGE = [
    row(bridge, r"max_efort = \[3.0, 9.0, 3.0, 3.0\]: must be one of", max_efort=[3.0, 9.0, 3.0, 3.0]),
    row(bridge, r"can_id = \[1, 2, 2, 4\]: must be 4 different IDs", can_id=[1, 2, 2, 4]),
    row(bridge, "4 strings, one of AK10-9, AK60-6", motor=["AK60-6", "AK80-9", "AK60-6", "AK99-9"]),
    row(bridge, "at most 400 Hz: each cycle waits", rate=401.0, wire_format=["mit", "mit", "mit_v3", "mit"]),
    row(bridge, PEAK.format("9.0,"), max_effort=[18.0] * 4),
    row(bridge, PEAK.format("9.0, 16.2, 9.0"), max_effort=[3.0, 18.0, 3.0, 3.0], torque_scale=[1.0, 0.9, 1.0, 1.0]),
    row(bridge, PEAK.format("5.0, 18.0, 9.0"), max_effort=[6.0, 9.0, 3.0, 3.0], torque_range=[5.0, 18.0, 15.0, 15.0]),
    row(bridge, "max_effort = .*: must be above 0 Nm", max_effort=[3.0, 0.0, 3.0, 3.0]),
    row(bridge, "rate = 39.0: must be at least 40 Hz: command_timeout = 0.05 s must span 2 periods", rate=39.0),
    row(bridge, "25 Hz: frozen_timeout = 0.08 s must span 2 periods", rate=20.0, command_timeout=0.1),
    row(bridge, "command_timeout = 0.2: must be at most 0.1 s on a real bus", **SOCKETCAN, command_timeout=0.2),
    row(bridge, "frozen_timeout = 0.3: must be at most 0.2 s on a real bus", **SOCKETCAN, frozen_timeout=0.3),
    row(limited, "^max_effort", max_effort=(3.0, 9.0, 3.0)),
    row(limited, "^position_max", position_max=ZERO),
    row(limited, "^driven_speed", driven_speed=INF),
    row(limited, "^command_timeout", command_timeout=5.1),
    row(limited, "^frozen_timeout", frozen_timeout=0.04),
    row(limited, "^sign_check_torque", sign_check_torque=NAN),
    row(limited, "^joint_names", joint_names=("a", "a", "b", "c")),
    *(
        row(elbow, rf"^{name} = \[\]: must be set to 1 ", without=name)
        for name in ("motor", "can_id", "position_min", "position_max", "max_effort")
    ),
    row(elbow, r"^zero = .*: must be 1 number", zero=[0.0] * 4),
    row(elbow, r"^joint_names = \[\]: must be 4 strings", joint_names=[]),
    row(elbow, r"^home of elbow = 2\.9: must be within its limits, -0\.1 to 2\.4 rad", home=[2.9]),
    row(elbow, r"^largest_moment = \[0\.3\]: must be zeros without axis_x", largest_moment=[0.3]),
    row(elbow, r"^can\.channel = 'a,b': must be one channel for all motors, or 1", can__channel="a,b"),
]


def damiao(**given):
    usual = {"motor": ["DM-J8009", "DM-J8009", "DM-J4340", "DM-J4310"], "motor_timeout": [0.2] * 4}
    return bridge(usual, **given)


def one_motor(name: str, value: float) -> tuple[JointMotor, ...]:
    return bridge(**{name: [0.0, value, 0.0, 0.0]})


TIMEOUT = r"motor_timeout = .*must be 0 \(never\) or from 0\.15 to 0\.5 s"
TIMEOUTS = {"motor": ["AK80-64"] * 4, "motor_timeout": [0.0] * 4}
AK60 = MOTORS["AK60-6"]
FAR = [540.0, 0.0, 0.0, 0.0]
MOTOR = [
    row(JointMotor, "^can_id", AK60, 0),
    row(JointMotor, "^can_id", AK60, 127),
    row(JointMotor, "^direction", AK60, 1, direction=0),
    row(JointMotor, "^zero", AK60, 1, zero=11.0),
    row(JointMotor, "^zero", AK60, 1, zero=NAN),
    row(JointMotor, "^torque_scale", AK60, 1, torque_scale=0.0),
    *(row(pack_reply, "^position", AK60, 1, value, 0.0, 0.0) for value in (NAN, INF, 99.0)),
    *(
        row(pack_command, f"^{name} = ", AK60, *np.where(np.arange(5) == n, wrong, 0.0))
        for n, name in enumerate(("position", "velocity", "kp", "kd", "torque"))
        for wrong in (NAN, -99.0, 1e30)
    ),
    *(row(one_motor, TIMEOUT, "motor_timeout", value) for value in (0.1, 3.0, NAN)),
    row(one_motor, r"must be 0, the usual one of the motor, or from 12\.4 to 12\.6", "position_range", 10.0),
    row(one_motor, "must be 0 with wire_format = mit, whose replies carry the", "torque_per_ampere", 0.3),
    row(
        bridge, r"torque_range = 15\.0: must be 12 or 0 for an AK60", wire_format=V3, torque_range=[15.0, 0.0, 0.0, 0.0]
    ),
    row(damiao, r"motor_timeout = 0\.0: must be from 0\.15 to 0\.5 s", motor_timeout=[0.0] * 4),
    row(damiao, "can_id = 16: must be a whole number from 1 to 15", can_id=[1, 2, 3, 16]),
    row(damiao, "wire_format = 'mit_v3': must be mit for a DM-J8009", wire_format=V3),
    row(damiao, "master_id = 257: must be .* without the last two hexadecimal", master_id=[0x101, 0, 0, 0]),
    row(damiao, "master_id = 2: must be without the lowest 8 bits of motor 2", master_id=[2, 0, 0, 0]),
    row(damiao, r"torque_range = 540\.0: must be 0, the .*, or from 18 to 162", torque_range=FAR),
    row(damiao, r"torque_range = -54\.0", torque_range=[-54.0, 0.0, 0.0, 0.0]),
    row(damiao, "master_id = 18: must be 0 for a motor with wire", **TIMEOUTS, master_id=[0x12, 0, 0, 0]),
    *(
        row(format_of(name, "mit_v3").ranged, f"another format for an {name}", MOTORS[name])
        for name in ("AK70-10", "AK80-6", "AK80-64")
    ),
]


def traffic(options: dict[str, Any], **given: Any) -> dict[str, Traffic]:
    usual = {"can.interface": "slcan", "can.channel": "c", "motor": ["AK60-6"] * 4, "wire_format": ["mit"] * 4}
    return traffic_of({**usual, **{name.replace("__", "."): value for name, value in given.items()}}, options)


def fd(options: dict[str, Any], last: str = "DM-J4310") -> dict[str, Traffic]:
    return traffic(
        {"fd": True, **options}, can__interface="socketcan", motor=["DM-J8009", "DM-J8009", "DM-J4340", last]
    )


BUS = [
    row(Traffic(8).check, r"rate = 600\.0: must be at most 516 Hz", 600.0),
    row(Traffic(8, bitrate=250_000).check, r"at most 129 Hz.*: 8 motors need 968 kbit/s of its 250", 500.0),
    row(Traffic(8, data_bitrate=5_000_000).check, r"8 motors need 1\d\d% of its time", 1300.0),
    *(
        row(traffic, f"can.options.bitrate = None: must be set for {name}", {}, can__interface=name)
        for name in ("gs_usb", "slcan")
    ),
    row(traffic, r"can.options.bitrate = 5: must be a whole number from 10000", {"bitrate": 5}),
    row(fd, r"can\.options\.fd = True: must be false: a AK80-9", {}, "AK80-9"),
    row(fd, r"can\.options\.fd = True: must be false: a DM-J6006", {}, "DM-J6006"),
    row(fd, "data_bitrate = 9000000", {"data_bitrate": 9_000_000}),
    row(fd, "data_bitrate = '5M'", {"data_bitrate": "5M"}),
    row(JointMotor, "^torque_scale = 1000", MOTORS["AK60-6"], 1, torque_scale=10**400),
    row(ArmModel, "^mass", *[[0.3] * 4] * 2, [10**400] * 4),
    row(values_of, "can.optionsfd = True: must be one of", CAN_BRIDGE, {"can.optionsfd": True}, "can.options"),
    row(buses_of, "can.channel = 'can0,can1': must be one channel for all motors, or 4", "can0,can1", {}, 4),
    row(buses_of, "can.channel", "can0,can0,,can1", {}, 4),
    row(buses_of, "can.options.port = .*one value, or 4", "a,a,b,b", {"port": [1, 2]}, 4),
    row(buses_of, "the same for all motors on a", "a,a,b,b", {"port": [1, 2, 3, 3]}, 4),
]


def learnt(part: str, value: object) -> Anfis:
    model = random_model()
    return Anfis(**{**{name: getattr(model, name) for name in ("centre", "sigma", "consequent")}, part: value})


def file_with(flaw: Callable[[Any], object]) -> AnfisLaw:
    content = json.loads(text_of(law()))
    flaw(content)
    return AnfisLaw.load(json.dumps(content))


LEARNT = [
    row(learnt, "sigma", "sigma", np.zeros((3, 3, 2))),
    row(learnt, "sigma", "sigma", np.ones((3, 3, 3))),
    row(learnt, "centre", "centre", np.full((3, 3, 2), NAN)),
    row(learnt, "centre", "centre", np.ones((3, 2))),
    row(learnt, "consequent", "consequent", np.ones((3, 7, 4))),
    row(learnt, "consequent", "consequent", "many"),
    row(Anfis, "rules", np.zeros((1, 10, 5)), np.ones((1, 10, 5)), np.zeros((1, 1, 11))),
    row(file_with, "box", lambda c: c.pop("box")),
    row(file_with, "3", lambda c: c["joints"].pop("3")),
    row(file_with, "another", lambda c: c.update(format="another")),
    row(file_with, "theta_3", lambda c: c["box"].update(theta_3=[1.0, 0.0])),
    row(file_with, "theta_2", lambda c: c["box"].update(theta_2=[0.0, NAN])),
    row(file_with, "gravity", lambda c: c["arm"].update(gravity=0.0)),
    row(file_with, "first_moment", lambda c: c["arm"].update(first_moment=[1.0])),
    row(file_with, "sigma", lambda c: c["joints"]["2"].update(sigma=[[1.0]])),
    row(file_with, "small", lambda c: c["joints"]["4"].update(training_rmse="small")),
    row(file_with, "train_anfis", lambda c: c.update(joints=[])),
    *(
        row(AnfisLaw.load, "must be a file from train_anfis", text)
        for text in ("", "no JSON", "[" * 100_000, "[1, 2]", "3")
    ),
]


ALIGNED, SCRIPT = (0.0, 0.0, 0.0, 1.0), [{"hold": 1}]
TEXT, JOINTS = random_chain(2, seed=2)
TWO_JOINTS = UrdfArm(TEXT, JOINTS)


def without_hand(words: str, **given: object) -> Any:
    values = {"law": "urdf", "joint_names": JOINTS, "use_imu": False, "max_effort": [30.0, 30.0]}
    values |= {name.replace("__", "."): value for name, value in given.items()}
    return row(lambda: settings_of(values_of(compensator_table(values), values), TWO_JOINTS), words)


def script(refused: str, *steps: object, **given: object) -> Any:
    return row(TrialScript.parse, f"^{re.escape(refused)} = ", {"name": "x", "steps": [*steps], **given})


ONES = {"axis_x": (1.0, 0.0, 0.0, 1.0), "axis_y": (0.0, 0.0, 1.0, 0.0)}
URDFS = [
    without_hand(r"payload\.mass = 1\.0: must be 0 without urdf\.hand", payload__mass=1.0),
    without_hand(
        r"wearer\.mass = .*: must be 0 on link 2, which has no length",
        mode="zero_g", support=1.0, wearer__mass=[0.5, 0.5],
    ),
    without_hand(r"wearer\.links = \[3, 4\]: must be 2 different links from 1 to 2", wearer__body_mass=70.0),
    without_hand(r"gain = \[1\.0\]: must be 2 numbers", gain=[1.0]),
    without_hand(r"wearer.joint_stiffness", mode="zero_g", wearer__joint_stiffness=[1.0] * 4),
    row(limited, r"axis_x, _y, _z of b = .*must be a vector of length 1", **ONES),
    row(
        limited, r"largest_moment of a = .*must be 0 for a link without",
        **ONES, axis_z=(0.0, 1.0, 0.0, 0.0), largest_moment=(0.1, 0.0, 0.0, 0.0),
    ),
]  # fmt: skip
WORN = {"mode": "zero_g", "support": 1.0, "wearer__first_moment": [0.18, 0.468, 0.8, 0.272]}
MOMENTS = r"^wearer\.{} = .*{}"
WEARERS = [
    row(compensator, r"exact with wearer\.first_moment", **WORN, law="paper_static"),
    row(compensator, r"wearer\.first_moment.* at most 10 kg, not 1[0-9]",
        **{**WORN, "wearer__first_moment": [0.2, 0.6, 2.0, 2.0]}),
    *(row(settings_with, MOMENTS.format("first_moment", wrong), wearer_moments=((0.0, 0.0, wrong, 0.1), ZERO))
      for wrong in (4.1, -0.1)),
    *(row(settings_with, MOMENTS.format("off_axis", wrong), wearer_moments=(ZERO, (0.0, 0.0, wrong, 0.1)))
      for wrong in (0.6, NAN)),
    row(settings_with, "wearer.joint_stiffness", tissue=Springs((0.0, 0.0, MAX_TISSUE + 0.1, 0.0))),
    row(settings_with, "wearer.joint_rest", tissue=Springs((1.0,) * 4, (4.0,) * 4)),
]  # fmt: skip
SIMULATED = [
    row(ArmConfig, "^coulomb_friction", coulomb_friction=(0.2, 0.2, 0.2)),
    row(ArmConfig, "^viscous_friction", viscous_friction=(-0.1, 0, 0, 0)),
    row(ArmConfig, "^rotor_inertia", rotor_inertia=(NAN, 0, 0, 0)),
    row(ArmConfig, "^wearer_mass", wearer_mass=(0, 0, 2000, 0)),
    row(ArmConfig, "^wearer_cog", wearer_cog=(0, 0, 0.31, 0)),
    row(ArmConfig, "^position_min", position_min=(2.0, 0, 0, 0)),
    row(ArmConfig, "^cog_y", cog_y=(0, 0, 0.2, 0)),
    row(ArmConfig, "^stribeck_friction", stribeck_friction=(0, 0, -0.1, 0)),
    row(ArmConfig, "^robot.first_moment", links=ArmModel.from_moments(LENGTH, (0.1,) * 4)),
    row(ArmConfig, "^links.mass", links=ArmModel(LENGTH, (0,) * 4, (0.5, 0.5, 0.0, 0.2))),
    row(ArmConfig, "^backlash", backlash=(0.0, 0.01, 0.0, 0.0)),  # play needs a stiffness
    row(ImuConfig, "^rotation_trunk_from_imu", rotation_trunk_from_imu=(0, 0, 0, 2)),
    row(ImuConfig, "^rate", rate=0.0),
    row(ImuConfig, "^gravity", gravity=-1.0),
    row(ImuConfig, "^delay", delay=-0.1),
    row(make_device, "^can_id", ids=(1, 2, 3, 3)),
    row(TrialScript.parse, "^script = ", None),
    script("script", *SCRIPT, extra=1),
    *(script("name", *SCRIPT, name=name) for name in ("/tmp/x", "../x", "", None, "a\nb", "x" * 101)),
    script("steps"),
    script("steps[0]", {"hold": 1, "over": 1}),
    script("steps[0].hold", {"hold": "long"}),
    script("steps[1].move", {"move": [0, 0, 0, 0], "over": 1}, {"move": [0, 0, 0], "over": 1}),
    script("steps[0].move", {"move": [0, 0, 0, 90], "over": 1}),
    script("steps[0].over", {"push": [0, 0, 0, 1], "over": -1}),
    script("steps[0].bow", {"bow": 45, "over": 3}),
    script("steps[0]", {"bow": 0.5}),
    script("steps[0].walk", {"walk": 0.5}),
    script("steps[0].load", {"load": 200, "over": 1}),
]
PORTS = r"ports = .*must be the port or None for each of 4 motors"
HARDWARE = [
    row(TrunkEstimator, "rotation_trunk_from_imu", (0, 0, 0, 0)),
    row(TrunkEstimator, "gyroscope_range", ALIGNED, gyroscope_range=0.0),
    row(TrunkEstimator, "accelerometer_range", ALIGNED, accelerometer_range=9.0),
    *(row(MotorBus, PORTS, ports, bridge()) for ports in (Wire().open(), [None])),
]


@pytest.mark.parametrize(
    ("make", "args", "given", "words"),
    [
        *ARMS,
        *PEOPLE,
        *TILTS,
        *SETTINGS,
        *TERMS,
        *BRIDGE,
        *MOTOR,
        *BUS,
        *LEARNT,
        *URDFS,
        *WEARERS,
        *SIMULATED,
        *HARDWARE,
    ],
)
def test_an_impossible_value_is_refused_with_its_name_and_what_would_be_right(make, args, given, words):
    with pytest.raises((ParameterError, DataError), match=words):
        make(*args, **given)


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"max_effort": [9.0, 18.0, 9.0, 9.0]},  # peak torque
        {"max_effort": [6.75, 18.0, 9.0, 9.0], "torque_scale": [0.75, 1.0, 1.0, 1.0]},
        {"rate": 40.0},
        {"rate": 25.0, "command_timeout": 0.08},
        {"rate": 200.0, "command_timeout": 0.01},
    ],
)
def test_consistent_parameters_are_accepted(given):
    bridge(**given)


@pytest.mark.parametrize(("gain", "gravity"), [(2.0, 9.83), (1.3, 9.81), (0.8, 25.0), (1.0, 1.62), (0.0, 25.0)])
def test_calibrated_gains_and_other_planets_are_accepted(gain, gravity):
    scaled = ArmModel(ROBOT.length, ROBOT.cog, ROBOT.mass, [gain] * 4, gravity)
    assert settings_with(robot=scaled).arm.scale == pytest.approx([gain * gravity] * 4)
