# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""From what tours and recordings show to the values of the new file, or the reason for having none.

Moments, torque scales, cables across the joints, motors that are weaker when warm, friction, and the wearer.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.springs import Springs
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import robot_of, settings_of
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import COVER
from exo_gravity.core.params import values_of
from exo_gravity.lab.calibration import recorded, tours
from exo_gravity.lab.calibration.identification import identify
from exo_gravity.lab.calibration.tour import Itinerary, calibrator_table, friction_stations, observations_in, tour_of
from exo_gravity.lab.calibration.tours import WornArm, checked, friction_from, moments_from, wearer_from
from exo_gravity.lab.calibration.tracking import Observation
from exo_gravity.lab.inputs.arms import configured_arm, read_arm
from exo_gravity.lab.inputs.parameter_file import load, text_of
from exo_gravity.lab.trial.analysis import Recording
from exo_gravity.sim import ArmConfig, SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS

from ..support import CONFIG
from ..support.calibration_device import MOTORS_AS_MOUNTED, PAPERS, Device, TourRun, fixed, run_tour
from ..support.ports import own_ports
from ..support.synthetic_bags import messages, tilt, write_bag
from ..support.urdf_oracle import WornMujocoArm

SIM = CONFIG / "sim.yaml"
ARM = configured_arm(SIM)
STILL = (0.0,) * 4


def value(result, name):
    (found,) = [change.value for change in result.changes if change.name == name]
    return found


def holding(arm, theta, tilt=None):
    """Return the torque (4,) in Nm that holds an arm, upright or at this tilt, by MuJoCo."""
    arm.move_base(np.multiply(9.80665, (tilt or Tilt.of("right")).direction))
    arm.reset(theta)
    return arm.data.qfrc_bias - arm.data.qfrc_passive


# Moments and torque scales


def test_the_old_torque_scale_and_law_and_gain_of_the_file_are_taken_over_and_an_impossible_scale_is_refused():
    device = Device(8)
    tour = device.tour(bare=8, weighed=8)
    compensator = {**ARM.compensator, "law": "paper_static", "gain": [1.1, 1.0, 1.0, 1.0]}
    for scale, refused in ((0.5, ""), (2.0, "right_shoulder_abduction")):
        bridge = {**ARM.can_bridge, "torque_scale": [1.0, scale, 1.0, 1.0]}
        result = moments_from(replace(ARM, can_bridge=bridge, compensator=compensator), tour)
        assert value(result, "torque_scale")[1] == pytest.approx(scale * device.scale[1], rel=0.02)
        assert value(result, "law") == "exact" and value(result, "gain") == [1.0] * 4
        said = [re.search(r"^(\w+): torque_scale.*from 0\.2 to 2", line) for line in result.refusals]
        assert [match[1] for match in said] == [refused] * bool(refused)


def test_the_calibrator_replaces_the_compensator_and_the_tour_takes_its_parameters():
    nodes = tours.tour_parameters(SIM, ARM, {"tour.poses": 3})
    assert set(nodes) == {"/imu", "/right/can_bridge", "/right/simulator", "/right/calibrator"}
    given = nodes["/right/calibrator"]
    assert given["max_effort"] == list(ARM.limits.max_effort) and given["tour.poses"] == 3
    assert np.all(
        np.isfinite(tour_of(values_of(calibrator_table({}), given)).wait((0.1, 0.2, 0.3, 0.4), Tilt.of("right")))
    )


# Cables across the joints

CABLES = {"spring_stiffness": (0.15,) * 4, "spring_rest": (0.2, 0.4, 0.3, 0.6)}
POSES = np.random.default_rng(3).uniform((-0.8, 0.3, -0.2, 0.2), (0.8, 1.3, 1.2, 1.4), (300, 4))


@pytest.mark.thorough
@pytest.mark.timeout(600)  # minutes of a tour, in virtual time
@pytest.mark.parametrize("cables", [CABLES, {}], ids=["cables", "none"])
def test_a_tour_of_an_arm_with_or_without_cables_holds_it_to_1_percent_of_peak_in_poses_that_it_has_not_seen(
    cables,
) -> None:
    truth = ArmConfig(**cables)
    run = TourRun(truth=truth)
    tour, seen = run.run(Itinerary(run.limits, 12)), Tilt.of("right", *run.tilt)
    assert tour.trouble == "" and tour.measured[0].temperature == (30.0,) * 4
    result = moments_from(ARM, tour.measured)
    assert np.any(result.identified.value.spring > 0.05) == bool(cables)
    found = {change.name: change.value for change in result.changes}
    settings, device = settings_of({**ARM.compensator, "use_imu": True, **found}), SimulatedArm(truth)
    true = np.array([holding(device, theta, seen) for theta in POSES])
    held = np.array([settings.torque(theta, seen)[0] for theta in POSES.tolist()]) / result.identified.value.scale
    assert np.abs(held - true).max() < 0.01 * np.abs(true).max()


def sprung(device: Device) -> list[Observation]:
    """A tour of a device with the same spring across each joint."""
    tour = device.tour(bare=8, weighed=8)
    return [one._replace(effort=one.effort + 0.15 * np.subtract(one.theta, 0.4) / device.scale) for one in tour]


def test_springs_are_found_where_there_are_some_and_nowhere_else() -> None:
    found = identify(sprung(Device(300)), PAPERS)
    np.testing.assert_allclose(found.value.spring[1:], 0.15, atol=0.02)
    assert np.all(np.abs(found.value.spring - 0.15)[1:] < 3.5 * found.error.spring[1:])
    assert np.max(identify(Device(300).tour(bare=8, weighed=8), PAPERS).value.spring) < 0.01


def test_the_file_gets_the_springs_and_the_room_that_the_safety_machine_needs_for_them() -> None:
    device, bridge = Device(301), {**ARM.can_bridge, "largest_moment": [1.0] * 4, "largest_addition": [0.5] * 4}
    result = moments_from(replace(ARM, can_bridge=bridge), sprung(device))
    given = {name: value(result, name) for name in ("joint_spring.stiffness", "joint_spring.rest")}
    most = np.add(0.5, Springs(*given.values()).largest(ARM.low.tolist(), ARM.high.tolist()))
    np.testing.assert_allclose(value(result, "largest_addition"), most, atol=0.01)
    # Calibrated again, from the new file, nothing is added twice; and an arm without its cables loses them.
    again = {**bridge, "largest_addition": most.tolist()}
    arm = replace(ARM, compensator={**ARM.compensator, **given}, can_bridge=again)
    bare = moments_from(arm, device.tour(bare=8, weighed=8))
    assert value(bare, "joint_spring.stiffness") == pytest.approx([0.0] * 4, abs=0.01)
    np.testing.assert_allclose(value(bare, "largest_addition"), 0.5, atol=0.03)


# Warm motors


def warmed(device: Device, temperature: float, slope: float) -> list[Observation]:
    """A tour with motors at this temperature in degC, that are as strong as drawn at 25 degC; slope: 1/K."""
    share, at = 1.0 + slope * (temperature - 25.0), (temperature,) * 4
    return [one._replace(effort=one.effort / share, temperature=at) for one in device.tour(bare=8, weighed=0)]


def test_a_cold_and_a_warm_tour_show_how_the_motors_weaken() -> None:
    device, slope = Device(8), -0.0012
    result = moments_from(ARM, warmed(device, 25.0, slope) + warmed(device, 55.0, slope))
    np.testing.assert_allclose(value(result, "torque_scale_slope")[1:], slope, atol=0.0003)
    assert value(result, "torque_scale_temperature") == [40.0] * 4
    same = moments_from(ARM, warmed(device, 25.0, 0.0))
    assert not [change for change in same.changes if change.name == "torque_scale_slope"]


def test_a_file_with_slopes_keeps_its_torque_at_the_temperature_of_the_tour() -> None:
    bridge, tour = {**ARM.can_bridge, "torque_scale_slope": [-0.001] * 4}, warmed(Device(8), 45.0, 0.0)
    plain, sloped = (moments_from(replace(ARM, can_bridge=b), tour) for b in (ARM.can_bridge, bridge))
    ratio = np.divide(value(sloped, "torque_scale"), value(plain, "torque_scale"))
    np.testing.assert_allclose(ratio, 1.0 - 0.001 * 20.0, atol=2e-4)
    np.testing.assert_allclose(value(sloped, "torque_scale_slope"), -0.001 / 0.98, atol=1e-5)


def test_a_check_says_which_joint_has_become_weaker_and_by_how_much() -> None:
    calibrated = moments_from(ARM, warmed(Device(9), 25.0, 0.0))
    values, bridge = (
        {**old, **{change.name: change.value for change in calibrated.changes if change.node.endswith(node)}}
        for old, node in ((ARM.compensator, "compensator"), (ARM.can_bridge, "can_bridge"))
    )
    arm = replace(ARM, compensator=values, can_bridge=bridge, robot=robot_of(values))
    # By the new file, a command of 1 Nm is `torque_scale` Nm of the old file's commands.
    scale = np.array(bridge["torque_scale"])
    same = [one._replace(effort=one.effort * scale) for one in warmed(Device(9), 25.0, 0.0)[2:5]]
    assert checked(arm, same).refusals == ()
    sure = replace(arm, compensator={**values, "model_error.torque": [0.003] * 4})
    assert checked(sure, same).refusals == ()  # 1.2 % beyond the band, but no reason to stay at home
    weak = [one._replace(effort=one.effort / (1.0, 1.0, 0.9, 1.0), temperature=(45.0,) * 4) for one in same]
    (refusal,) = checked(arm, weak).refusals
    found = re.match(r"right_shoulder_flexion: ([\d.]+) \+- [\d.]+ % less torque .* 25 degC, its motor has 45", refusal)
    assert found is not None and abs(float(found[1]) - 10.0) < 1.5


def test_a_record_of_an_earlier_tour_is_read_and_another_file_is_refused(tmp_path) -> None:
    (one, record) = warmed(Device(8), 30.0, 0.0)[0], tmp_path / "cold.jsonl"
    record.write_text(json.dumps({"observation": one._asdict()}, default=np.ndarray.tolist) + "\n")
    assert observations_in(record, 4)[0].temperature == [30.0] * 4
    with pytest.raises(DataError, match=r"must be the record \(.jsonl\) of a tour"):
        observations_in(SIM, 4)


# Recordings and friction

TRUTH = ArmModel(DEFAULT_LINKS.length, DEFAULT_LINKS.cog * 0.9, DEFAULT_LINKS.mass * (1.2, 0.8, 1.15, 0.85))
SCALES = (0.85, 1.15, 0.9, 1.0)


def recorded_by(run, folder, torque_scale=1.0):
    """Write what the nodes would have published during `run` as a bag; return its folder.

    torque_scale: that of the bridge, which divides the efforts by it.
    """
    table = np.array(run.log)
    unknown = np.full((len(table), 4), np.nan)
    columns = table[:, 0], table[:, 1:5], unknown, unknown, table[:, 9:13] * torque_scale
    states = Recording("right", ARM.joint_names, *columns)
    return write_bag(folder, [*messages(states), *(tilt(now, *run.tilt) for now in table[::10, 0])])


@pytest.mark.thorough
def test_recordings_without_and_with_the_weight_give_kilograms_and_true_scales(tmp_path, run_tool):
    files = [SIM, tmp_path / "1.yaml", tmp_path / "2.yaml"]
    motors = [replace(motor, torque_scale=scale) for motor, scale in zip(MOTORS_AS_MOUNTED, SCALES, strict=True)]
    for number, (command, mass, lever) in enumerate((("gravity", 0.0, 0.0), ("scale", 0.5, 0.25))):
        loaded = ArmConfig(TRUTH, wearer_mass=(0.0, 0.0, 0.0, mass), wearer_cog=(0.0, 0.0, 0.0, lever))
        run = TourRun(truth=loaded, motors=motors, load=(mass, lever))
        run.run(Itinerary(run.limits, 8))
        bag = recorded_by(run, tmp_path / command, configured_arm(files[number]).can_bridge["torque_scale"])
        words = ["calibrate", command, "--params", files[number], "--output", files[number + 1], "--bag", bag]
        assert run_tool(*words, *["--mass", mass, "--lever", lever] * bool(mass)).code == 0
    found = configured_arm(files[2])
    np.testing.assert_allclose(found.can_bridge["torque_scale"][1:], SCALES[1:], rtol=0.04)
    np.testing.assert_allclose(found.robot.first_moment[1:], TRUTH.first_moment[1:], rtol=0.04)


def test_friction_of_each_joint_is_fitted_and_noted_in_the_file():
    (one, *_), slide = Device(8).tour(bare=1, weighed=0), np.array((0.2, 0.4, 0.1, 0.3))
    speeds = (0.02, 0.05, 0.1, 0.18, 0.3)
    measured = [one._replace(friction=slide + 0.05 * speed, spread=np.full(4, 0.003), speed=speed) for speed in speeds]
    result = friction_from(ARM, measured)
    assert result.refusals == () and len(result.curves) == 4
    assert [change.name for change in result.changes] == [""] * 4
    assert "Coulomb 0.400" in result.changes[1].note and "viscous 0.050" in result.changes[1].note


@pytest.mark.thorough
def test_sweeps_at_five_speeds_give_the_friction_of_each_joint_live_and_recorded(tmp_path):
    truth = ArmConfig(TRUTH, coulomb_friction=(0.25, 0.35, 0.18, 0.22), viscous_friction=(0.1, 0.2, 0.1, 0.1))
    run = TourRun(truth=truth)
    tour = run.run(fixed(friction_stations(run.limits)))
    assert tour.trouble == ""
    for measured in (
        tour.measured,
        recorded.observations_of(recorded_by(run, tmp_path / "bag"), ARM, PAPERS),
    ):
        result = friction_from(ARM, measured)
        assert result.refusals == ()
        for coulomb, viscous, curve in zip(truth.coulomb_friction, truth.viscous_friction, result.curves, strict=True):
            steady = curve.speed >= 0.05
            np.testing.assert_allclose(curve.fitted[steady], coulomb + viscous * curve.speed[steady], atol=0.02)


# The wearer

WORN = replace(ARM, compensator={**ARM.compensator, "wearer.body_mass": 70.0})
# Upper arm and forearm 3 and 2 cm beside the links, springs in joints 1, 3 and 4.
PERSON = ArmConfig(
    ArmModel(ARM.robot.length, ARM.robot.cog, ARM.robot.mass), wearer_mass=(0.0, 0.0, 2.1, 1.5),
    wearer_cog=(0.0, 0.0, 0.15, 0.2), wearer_cog_y=(0.0, 0.0, 0.03, -0.02), wearer_cog_z=(0.0, 0.0, -0.02, 0.02),
    wearer_stiffness=(1.5, 0.0, 0.8, 1.0), wearer_rest=(0.2, 0.0, 0.3, 0.9),
)  # fmt: skip
RANGE = (-0.3, 0.0, -0.4, 0.0), (0.5, 1.1, 1.2, 1.6)
WORN_POSES = np.random.default_rng(6).uniform(*RANGE, (8, 4))
OTHER_POSES = np.random.default_rng(7).uniform(*RANGE, (30, 4))


def relaxed(config, carried=0.0):
    """Observations of a worn arm by MuJoCo, whose wearer carries a share of their arm."""
    arms = (config, replace(config, wearer_mass=STILL, wearer_stiffness=STILL), replace(config, wearer_stiffness=STILL))
    worn, bare, passive = (SimulatedArm(one) for one in arms)
    seen = []
    for number, theta in enumerate((*WORN_POSES, *WORN_POSES[:2])):
        weight, noise = holding(passive, theta) - holding(bare, theta), np.random.default_rng(number)
        effort = holding(worn, theta) - carried * weight + noise.normal(0.0, 0.05, 4)
        seen.append(Observation(theta, np.array((0.0, 0.0, 1.0)), effort, np.full(4, 0.2), np.full(4, 0.003)))
    return seen


def test_the_wearers_moments_and_springs_hold_their_arm_in_poses_that_were_not_measured():
    result, arm = wearer_from(WORN, relaxed(PERSON), 0.0), SimulatedArm(PERSON)
    found = {change.name: change.value for change in result.changes}
    settings = settings_of({**WORN.compensator, "mode": "zero_g", "support": 1.0, **found})
    assert result.refusals == () and found["model_error.wearer"] == 0.0
    assert "largest_moment [" in result.lines[-1] and "largest_addition " in result.lines[-1]
    unsure, largest = np.hypot(0.05, found["model_error.wearer_torque"]), np.abs(holding(arm, OTHER_POSES[0])).max()
    for pose in OTHER_POSES:
        off = settings.torque(pose, Tilt.of("right"))[0] - holding(arm, pose)
        assert np.all(np.abs(off) < 3.0 * unsure) and np.abs(off).max() < 0.04 * largest
    stiffness = found["wearer.joint_stiffness"]
    assert stiffness[:2] == pytest.approx((1.5, 0.0), abs=0.2) and stiffness[3] == pytest.approx(1.0, abs=0.3)


def test_a_wearer_who_carries_a_constant_share_looks_lighter_and_the_band_contains_it():
    result, relaxed_one = (wearer_from(WORN, relaxed(PERSON, share)) for share in (0.18, 0.0))
    assert result.refusals == ()  # nothing shows it
    light, true = (np.array(value(one, "wearer.first_moment"))[2:] for one in (result, relaxed_one))
    assert light == pytest.approx(0.82 * true, rel=0.05)
    assert np.all(true - light < COVER * value(result, "model_error.wearer") * light)


def test_an_implausible_wearer_and_too_few_poses_are_refused():
    with pytest.raises(DataError, match="4 different poses were measured, must be at least 5"):
        wearer_from(WORN, relaxed(PERSON)[:4])
    for forearm, which in ((3.3, "torque at right_shoulder_abduction"), (0.4, "torque at right_elbow")):
        refusals = wearer_from(WORN, relaxed(replace(PERSON, wearer_mass=(0.0, 0.0, 3.8, forearm)))).refusals
        assert any(re.match(rf"implausible: .*% of .*{which}", refusal) for refusal in refusals)


HEAVIER, NEARER = 1.2, 0.95  # shares: the wearer's segments against the table's
STIFFNESS, REST = 0.8, 0.5  # Nm/rad and rad, of their last joint
LEFT = 0.02  # of the largest torque that the wearer's arm needs
PORTS = own_ports()


def settings_in(params: Path):
    return read_arm(load(params), "/right").settings


def left_by_calibration(name: str, folder: Path, run_tool) -> tuple[float, float]:
    """Run `calibrate wearer` on a file of an arm of config that a person wears, from file to file.

    Return what the file leaves before and after of the torque of the wearer's arm in new poses, of its largest.
    """
    nodes, files, port = load(CONFIG / f"{name}.yaml"), (folder / "params.yaml", folder / "new.yaml"), next(PORTS)
    simulator = nodes["/right/simulator"]
    nodes["/right/compensator"] |= {"wearer.body_mass": 75.0, "mode": "zero_g", "support": 1.0}
    files[0].write_text(text_of(nodes))
    table = settings_in(files[0])
    mass, cog = HEAVIER * np.array(table.wearer_mass), NEARER * np.array(table.wearer_cog)
    last = np.eye(len(mass))[-1]
    names = ("wearer.mass", "wearer.cog", "wearer.joint_stiffness", "wearer.joint_rest")
    simulator |= {key: one.tolist() for key, one in zip(names, (mass, cog, STIFFNESS * last, REST * last), strict=True)}
    simulator["can.options.port"] = nodes["/right/can_bridge"]["can.options.port"] = port
    files[0].write_text(text_of(nodes))
    assert run_tool("calibrate", "wearer", "--params", files[0], "--output", files[1], "--carried", 0).code == 0
    described = (CONFIG / "arms" / f"{name}.urdf").read_text(encoding="utf-8"), simulator["joint_names"]
    truth = WornMujocoArm(*described, mass, cog, stiffness=STIFFNESS * last, rest=REST * last)
    without = WornMujocoArm(*described, 0.0 * mass, cog)
    poses = np.random.default_rng(8).uniform(*WornArm(configured_arm(files[0], "right")).comfortable, (50, len(mass)))
    true, bare = (np.array([one.torque(pose) for pose in poses]) for one in (truth, without))
    given = ([settings_in(file).torque(pose, Tilt.of("left"))[0] for pose in poses.tolist()] for file in files)
    before, after = (float(np.abs(torque - true).max() / np.abs(true - bare).max()) for torque in given)
    return before, after


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["elbow", "three_joints"])
def test_a_tour_of_a_worn_arm_finds_its_wearer(name, tmp_path, monkeypatch, without_pictures, run_tool) -> None:
    monkeypatch.setattr(tours, "run_tour", run_tour)
    before, after = left_by_calibration(name, tmp_path, run_tool)
    assert after < LEFT < 0.1 < before


@pytest.mark.real_time
@pytest.mark.thorough
@pytest.mark.timeout(500)  # minutes of a tour
def test_nodes_move_a_worn_arm_of_three_joints_and_find_its_wearer(tmp_path: Path, run_tool) -> None:
    assert left_by_calibration("three_joints", tmp_path, run_tool)[1] < LEFT
