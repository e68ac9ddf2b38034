# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The law `anfis` in the compensator: where it was not trained, the exact law replaces it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.anfis import Anfis, AnfisLaw
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.compensator import FALLBACK_TIME
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.guidance import GUIDANCE

from ..support.compensator_run import PERIOD, ROBOT, THETA, CompensatorRun, settings_with


def learned(moments=ROBOT.first_moment[1:]):
    """An ANFIS of constant 0.5, 1.0 and 0.25 Nm on joints 2 to 4, in a box of 0 to 1 rad."""
    rules = np.zeros((3, 8, 4))
    rules[:, :, 0] = [[0.5], [1.0], [0.25]]
    model = Anfis(np.tile([-1.0, 1.0], (3, 3, 1)), np.ones((3, 3, 2)), rules)
    return AnfisLaw(model, (0.0,) * 3, (1.0,) * 3, moments, ROBOT.gravity, "made up", {})


def test_inside_its_box_the_anfis_gives_the_torque():
    run = CompensatorRun(law="anfis", anfis=learned())
    answer = run.cycle(1.2)
    assert answer.fallback == ""
    np.testing.assert_allclose(answer.effort, (0.0, 0.5, 1.0, 0.25), rtol=1e-9)


@pytest.mark.parametrize(
    ("theta", "pitch", "moments", "why"),
    [
        ((0.2, 1.2, 0.6, 0.5), 0.0, ROBOT.first_moment[1:], "theta_2 is outside"),
        (THETA, 0.1, ROBOT.first_moment[1:], "tilted"),
        (THETA, 0.0, (0.3, 0.2, 0.1), "another arm"),
    ],
)
def test_where_the_anfis_was_not_trained_the_exact_law_replaces_it_and_the_reason_is_given(theta, pitch, moments, why):
    run = CompensatorRun(law="anfis", anfis=learned(moments))
    run.compensator.tilt.set_tilt(run.now, pitch, 0.0)
    answer = run.cycle(1.2, theta)
    assert why in answer.fallback
    np.testing.assert_allclose(answer.effort, gravity_torque(ROBOT, theta, Tilt.of("left", pitch).direction))


def test_the_anfis_refuses_an_arm_given_by_its_moments():
    arm = ArmModel.from_moments(ROBOT.length, ROBOT.first_moment)
    with pytest.raises(ParameterError, match=r"robot.first_moment = .*must be 0 for law anfis"):
        settings_with(law="anfis", anfis=learned(), robot=arm)


@settings(max_examples=4, deadline=None)
@given(st.floats(0.001, 0.2), st.floats(0.1, 10.0))
def test_along_a_path_across_the_edge_of_the_box_the_torque_neither_steps_nor_chatters(width, hertz):
    run = CompensatorRun(law="anfis", anfis=learned())
    run.cycle(2.0)
    run.efforts.clear()
    theta_2 = 1.0 + width * np.sin(2 * math.pi * hertz * np.arange(0.0, 3.0, PERIOD))  # about the edge of the box
    replaced = [bool(run.cycle(theta=(0.2, angle, 0.6, 0.5)).fallback) for angle in theta_2.tolist()]
    # The exact law changes by up to 3 Nm/rad along the path.
    remainders = GUIDANCE.rate * PERIOD
    path = 3.0 * width * 2 * math.pi * hertz * PERIOD
    assert run.largest_step <= 2 * remainders + path
    switches = np.flatnonzero(np.diff(replaced))
    assert all(b - a >= FALLBACK_TIME / PERIOD - 1 for a, b in zip(switches[::2], switches[1::2], strict=False))


def test_a_change_of_settings_in_the_cycle_that_leaves_the_box_is_bridged_too():
    run = CompensatorRun(law="anfis", anfis=learned())
    run.cycle(2.0)
    before = run.efforts[-1]
    run.compensator.apply(settings_with(law="anfis", anfis=learned(), mode="zero_g"))
    run.cycle(theta=(0.2, 1.001, 0.6, 0.5))
    np.testing.assert_allclose(run.efforts[-1], before, atol=0.01)


def test_another_law_does_not_wait_for_the_anfis():
    run = CompensatorRun(law="anfis", anfis=learned())
    run.cycle(1.5, (0.2, 1.2, 0.6, 0.5))
    run.compensator.apply(settings_with(law="paper_static"))
    assert run.cycle(theta=(0.2, 1.2, 0.6, 0.5)).fallback == ""


def test_the_law_anfis_without_a_file_is_rejected():
    with pytest.raises(ParameterError, match="anfis_file"):
        settings_with(law="anfis")
