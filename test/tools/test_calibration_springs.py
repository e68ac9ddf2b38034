# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What moments alone do not explain: cables across the joints, and motors that are weaker when warm."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.joint_spring import JointSpring
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings, robot_of
from exo_gravity.core.compensation.tracking import Observation
from exo_gravity.core.errors import DataError
from exo_gravity.lab.calibration.identification import identify
from exo_gravity.lab.calibration.poses import Itinerary
from exo_gravity.lab.calibration.record import observations_in
from exo_gravity.lab.calibration.tours import checked, moments_from
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.sim import ArmConfig, SimulatedArm

from ..support.calibration_device import LENGTH, PAPERS, Device, TourRun
from .test_calibration_solve import ARM, value

CABLES = {"spring_stiffness": (0.15,) * 4, "spring_rest": (0.2, 0.4, 0.3, 0.6)}
POSES = np.random.default_rng(3).uniform((-0.8, 0.3, -0.2, 0.2), (0.8, 1.3, 1.2, 1.4), (300, 4))


def worst_of_peak(result, truth: ArmConfig, tilt: Tilt) -> float:
    """Return the largest torque error of a result in poses that it has not seen, as a share of the largest torque."""
    found, device = result.identified, SimulatedArm(truth)
    device.move_base(np.multiply(9.80665, tilt.direction))
    robot = ArmModel.from_moments(LENGTH, found.moments[:4], found.moments[4:])
    given = {change.name: change.value for change in result.changes}
    spring = JointSpring(given.get("joint_spring.stiffness", (0.0,) * 4), given.get("joint_spring.rest", (0.0,) * 4))
    settings = Settings("right", robot, joint_spring=spring)
    true, held = [], []
    for theta in POSES:
        device.reset(theta)
        true.append(device.data.qfrc_bias - device.data.qfrc_passive)
        held.append(np.multiply(settings.torque(theta.tolist(), tilt)[0], 1.0 / found.scale))
    return float(np.abs(np.subtract(held, true)).max() / np.abs(true).max())


@pytest.mark.thorough
@pytest.mark.timeout(600)  # minutes of a tour, in virtual time
@pytest.mark.parametrize("cables", [CABLES, {}], ids=["cables", "none"])
def test_a_tour_of_an_arm_with_or_without_cables_holds_it_to_1_percent_of_peak(cables) -> None:
    truth = ArmConfig(**cables)
    run = TourRun(truth=truth)
    tour = run.run(Itinerary(run.limits, 12, 230.0))
    assert tour.trouble == ""
    assert tour.measured[0].temperature == (30.0,) * 4
    result = moments_from(ARM, tour.measured)
    assert worst_of_peak(result, truth, Tilt.of("right", *run.tilt)) < 0.01
    assert np.any(result.identified.stiffness > 0.0) == bool(cables)


def sprung(device: Device, stiffness: float, rest: float, **tour: int) -> list[Observation]:
    """A tour of a device with the same spring across each joint."""
    return [
        one._replace(effort=one.effort + stiffness * np.subtract(one.theta, rest) / device.scale)
        for one in device.tour(**tour)
    ]


def test_springs_are_found_where_there_are_some_and_nowhere_else() -> None:
    for seed in range(300, 306):
        device = Device(seed)
        found = identify(sprung(device, 0.15, 0.4, bare=8, weighed=8), PAPERS)
        np.testing.assert_allclose(found.stiffness[1:], 0.15, atol=0.02)
        assert np.all(np.abs(found.stiffness - 0.15)[1:] < 3.5 * found.stiffness_error[1:])
        assert not np.any(identify(device.tour(bare=8, weighed=8), PAPERS).stiffness)


def test_a_hand_on_the_arm_in_one_pose_is_no_spring() -> None:
    tour = Device(7).tour(bare=12, weighed=0)
    tour[5] = tour[5]._replace(effort=tour[5].effort + np.array((0.0, 0.0, 0.8, 0.0)))
    found = identify(tour, PAPERS)
    assert [index for index, _ in found.rejected] == [5]
    assert not np.any(found.stiffness)


def test_the_file_gets_the_springs_and_the_room_that_the_safety_machine_needs_for_them() -> None:
    device = Device(301)
    bridge = {**ARM.can_bridge, "largest_moment": [1.0] * 4, "largest_addition": [0.5] * 4}
    arm = replace(ARM, can_bridge=bridge)
    result = moments_from(arm, sprung(device, 0.15, 0.4, bare=8, weighed=8))
    stiffness, rest = value(result, "joint_spring.stiffness"), value(result, "joint_spring.rest")
    spring = JointSpring(stiffness, rest)
    most = np.add(0.5, spring.largest(arm.low.tolist(), arm.high.tolist()))
    np.testing.assert_allclose(value(result, "largest_addition"), most, atol=0.01)
    # Calibrated again, from the new file, nothing is added twice; and an arm without its cables loses them.
    values = {**arm.compensator, "joint_spring.stiffness": stiffness, "joint_spring.rest": rest}
    again = replace(arm, compensator=values, can_bridge={**bridge, "largest_addition": most.tolist()})
    bare = moments_from(again, device.tour(bare=8, weighed=8))
    assert value(bare, "joint_spring.stiffness") == [0.0] * 4
    np.testing.assert_allclose(value(bare, "largest_addition"), 0.5, atol=0.011)


def warmed(device: Device, temperature: float, slope: float) -> list[Observation]:
    """A tour with motors at this temperature in degC, that are as strong as drawn at 25 degC; slope: 1/K."""
    share = 1.0 + slope * (temperature - 25.0)
    return [
        one._replace(effort=one.effort / share, temperature=(temperature,) * 4)
        for one in device.tour(bare=8, weighed=0)
    ]


def test_a_cold_and_a_warm_tour_show_how_the_motors_weaken() -> None:
    device, slope = Device(8), -0.0012
    cold, warm = warmed(device, 25.0, slope), warmed(device, 55.0, slope)
    result = moments_from(ARM, cold + warm)
    np.testing.assert_allclose(value(result, "torque_scale_slope")[1:], slope, atol=0.0003)
    assert value(result, "torque_scale_temperature") == [40.0] * 4
    same = moments_from(ARM, [one._replace(temperature=(25.0,) * 4) for one in warmed(device, 25.0, 0.0)])
    assert not [change for change in same.changes if change.name == "torque_scale_slope"]


def test_a_file_with_slopes_keeps_its_torque_at_the_temperature_of_the_tour() -> None:
    bridge = {**ARM.can_bridge, "torque_scale_slope": [-0.001] * 4}
    tour = [one._replace(temperature=(45.0,) * 4) for one in warmed(Device(8), 25.0, 0.0)]
    plain, sloped = (moments_from(replace(ARM, can_bridge=b), tour) for b in (ARM.can_bridge, bridge))
    ratio = np.divide(value(sloped, "torque_scale"), value(plain, "torque_scale"))
    np.testing.assert_allclose(ratio, 1.0 - 0.001 * 20.0, atol=2e-4)
    np.testing.assert_allclose(value(sloped, "torque_scale_slope"), -0.001 / 0.98, atol=1e-5)


def test_a_check_says_which_joint_has_become_weaker_and_by_how_much() -> None:
    calibrated = moments_from(ARM, warmed(Device(9), 25.0, 0.0))
    values = {**ARM.compensator, **{c.name: c.value for c in calibrated.changes if c.node.endswith("compensator")}}
    bridge = {**ARM.can_bridge, **{c.name: c.value for c in calibrated.changes if c.node.endswith("can_bridge")}}
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
    (one,) = warmed(Device(8), 30.0, 0.0)[:1]
    record = tmp_path / "cold.jsonl"
    record.write_text(json.dumps({"observation": one._asdict()}, default=np.ndarray.tolist) + "\n")
    assert observations_in(record, 4)[0].temperature == [30.0] * 4
    with pytest.raises(DataError, match=r"must be the record \(.jsonl\) of a tour"):
        observations_in(packaged_config("sim.yaml"), 4)
    assert configured_arm(packaged_config("sim.yaml")).can_bridge["torque_scale_slope"] == [0.0] * 4
