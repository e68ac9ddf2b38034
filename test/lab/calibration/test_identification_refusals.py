# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What an identification leaves out, and what it refuses with the reason and the pose that is missing."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core.errors import DataError
from exo_gravity.lab.calibration.identification import check_physical, identify
from exo_gravity.lab.calibration.pose_fit import layout_of
from exo_gravity.lab.calibration.poses import missing_pose
from exo_gravity.lab.moments import regressor

from ...support.calibration_device import LEANING, PAPERS, Device, best

SLIPS = {
    "one pose": {2: (0, 0, 0.3, 0)},
    "two poses": {2: (0, 0, 0.3, 0), 5: (0, -0.5, 0, 0)},
    "weighed": {9: (0, 0, 0, 0.2)},
}


@pytest.mark.parametrize("slips", SLIPS.values(), ids=SLIPS)
def test_a_pose_with_a_slip_or_a_hand_is_left_out_and_named(slips):
    device = Device(6)
    observations = device.tour(bare=10)
    for index, error in slips.items():
        observations[index] = observations[index]._replace(effort=np.add(observations[index].effort, error))
    found = identify(observations, PAPERS)
    assert {index for index, _ in found.rejected} == set(slips)
    for index, reason in found.rejected:
        assert f"joint {int(np.argmax(np.abs(slips[index]))) + 1}" in reason
    assert np.all(np.abs(found.moments - device.moments) < 4.0 * found.error)


@pytest.mark.parametrize(
    ("bare", "spoilt", "words"), [(30, 12, r"pose 17: effort of joint 1 is"), (8, 6, "off in half of the poses")]
)
def test_poses_that_do_not_fit_one_arm_are_refused_together(bare, spoilt, words):
    observations = Device(7).tour(bare=bare)
    for k in range(spoilt):
        error = np.eye(4)[k % 4] * (-1) ** k  # Nm
        observations[2 * k] = observations[2 * k]._replace(effort=observations[2 * k].effort + error)
    with pytest.raises(DataError, match=rf"the poses do not fit one arm: .*{words}.*touched"):
        identify(observations, PAPERS)


def test_too_few_poses_are_refused_with_the_pose_that_is_missing_and_accepted_with_it():
    device = Device(8)
    observations = [device.observe(theta) for theta in best(LEANING, 2)]
    with pytest.raises(DataError, match="2 poses do not show"):
        identify(observations, PAPERS)
    for _ in range(4):
        try:
            found = identify(observations, PAPERS)
            break
        except DataError as error:
            assert "poses do not show" in str(error) or "is not known better than" in str(error)
            degrees = str(error).split("add the pose [")[1].split("]")[0].split(",")
            observations.append(device.observe(np.radians([float(angle) for angle in degrees])))
    assert np.all(np.abs(found.moments[1:4]) > found.error[1:4])


@pytest.mark.parametrize(("moment", "joint"), [(1, 1), (2, 2), (3, 3)])
def test_the_missing_pose_shows_the_moment_that_is_missing(moment, joint):
    hidden = np.arange(layout_of(PAPERS).count) == moment
    pose = missing_pose(hidden, LEANING, PAPERS)
    theta = np.radians([float(angle) for angle in pose.split("[")[1].split("]")[0].split(",")])
    assert np.abs(regressor(theta, LEANING, 9.8)[0, joint, moment]) > 0.8 * 9.8


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({2: (0.2, 0.3)}, r"M3 = 0.200 kg m is not known better than 0.300: add the pose \["),
        ({3: (-0.03, 0.001)}, "M4 = -0.030 kg m: must be positive: check direction and zero of joint 4"),
        ({7: (0.06, 0.001)}, "Y4 = 0.060 kg m exceeds M4: the zero of joint 4 seems 63 degrees off"),
        ({6: (-0.3, 0.001)}, "Y3 = -0.300 kg m exceeds M3: the zero of joint 3 seems -56 degrees off"),
    ],
)
def test_moments_that_no_arm_has_are_refused_with_what_to_check(changes, words):
    moments, error = np.array((0.1, 0.2, 0.2, 0.03, 0.0, 0.0, 0.0, 0.0)), np.full(8, 0.001)
    check_physical(moments, error, np.ones(4), np.array(LEANING), PAPERS)
    for index, (value, uncertain) in changes.items():
        moments[index], error[index] = value, uncertain
    with pytest.raises(DataError, match=words):
        check_physical(moments, error, np.ones(4), np.array(LEANING), PAPERS)


def scaled(factor):
    """Return observations of a joint with this factor in its efforts: reversed, silent, or of another firmware."""
    return lambda: [one._replace(effort=np.multiply(one.effort, (1, 1, factor, 1))) for one in Device(10).tour()]


def with_a_light_weight():
    device = Device(11)
    return device.tour(weighed=0) + [device.observe(t, weight=(0.002, 0.1)) for t in best(LEANING, 4)]


def with_nan():
    first, second, *others = Device(12).tour()
    return [first, second._replace(effort=(0.0, np.nan, 0.0, 0.0)), *others]


@pytest.mark.parametrize(
    ("observations", "words"),
    [
        *((scaled(f), r"scale 3|do not fit|not known better|must be positive") for f in (-1.0, 0.0, 0.2, 5.0)),
        (with_a_light_weight, "a heavier one"),
        (with_nan, "pose 2: effort"),
        (list, "no pose"),
    ],
)
def test_impossible_observations_are_refused_with_what_to_check(observations, words):
    with pytest.raises(DataError, match=words):
        identify(observations(), PAPERS)
