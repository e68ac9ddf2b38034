"""The law `anfis` in the compensator: where it was not trained, the exact law replaces it."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core import gravity_torque
from exo_gravity.core.anfis import Anfis
from exo_gravity.core.anfis_law import AnfisLaw
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.tilt import Tilt

from ..support.compensator_run import ROBOT, THETA, CompensatorRun, settings_with


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
    run.compensator.set_tilt(run.now, pitch, 0.0)
    answer = run.cycle(1.2, theta)
    assert why in answer.fallback
    np.testing.assert_allclose(answer.effort, gravity_torque(ROBOT, theta, Tilt.of("left", pitch).direction))


def test_the_law_anfis_without_a_file_is_rejected():
    with pytest.raises(ParameterError, match="anfis_file"):
        settings_with(law="anfis")
