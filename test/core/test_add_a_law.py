# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""CONTRIBUTING's "Add a law", step by step: a class with `torque` and `outside`, and its entry in LAWS."""

import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.compensation.compensator import FALLBACK_TIME, Compensator
from exo_gravity.core.compensation.laws import LAWS
from exo_gravity.core.compensation.settings import COMPENSATOR, Settings, settings_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.guidance import GUIDANCE

ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
INSIDE, OUTSIDE = (0.1, 0.2, 0.3, 0.4), (0.1, 1.2, 0.3, 0.4)
PERIOD = 0.01  # s


class Springs:
    """Holds the arm as springs do, up to 1 rad of abduction."""

    def __init__(self, arm):
        self._arm = arm

    def outside(self, theta, tilt):
        return "the springs reach to 1 rad" if theta[1] > 1.0 else ""

    def torque(self, theta, tilt):
        return tuple(0.5 * angle for angle in theta)


@pytest.fixture(autouse=True)
def springs(monkeypatch):
    monkeypatch.setitem(LAWS, "springs", lambda settings: Springs(settings.arm))


def held(compensator, start, theta, seconds):
    answers = [compensator.step(start + n * PERIOD, theta, (0.0,) * 4) for n in range(round(seconds / PERIOD))]
    return start + seconds, answers[-1]


def test_a_law_of_ones_own_is_a_value_of_the_parameter_and_carries_the_arm():
    settings = settings_of(values_of(COMPENSATOR, {"law": "springs", "use_imu": False}))
    _, answer = held(Compensator(settings), 1.0, INSIDE, 0.1)
    assert answer.effort == pytest.approx([0.5 * angle for angle in INSIDE]) and not answer.fallback


def test_where_it_does_not_apply_the_exact_law_carries_the_arm_until_it_does_again():
    compensator = Compensator(Settings("right", ROBOT, "springs", use_imu=False))
    now, _ = held(compensator, 1.0, INSIDE, 0.1)
    now, answer = held(compensator, now, OUTSIDE, GUIDANCE.longest)
    assert answer.fallback == "the springs reach to 1 rad"
    exact, _ = compensator.settings.torque(OUTSIDE, compensator.tilt.at(now), exact=True)
    assert answer.effort == pytest.approx(exact)
    now, answer = held(compensator, now, INSIDE, FALLBACK_TIME - 2 * PERIOD)
    assert answer.fallback == "the springs reach to 1 rad"
    now, answer = held(compensator, now, INSIDE, 4 * PERIOD)
    assert not answer.fallback
    _, answer = held(compensator, now, INSIDE, GUIDANCE.longest)
    assert answer.effort == pytest.approx([0.5 * angle for angle in INSIDE])


def test_a_law_that_does_not_exist_is_refused_with_those_that_do():
    with pytest.raises(ParameterError, match="one of exact, paper_static, paper_mobile, anfis, urdf, springs"):
        Settings("right", ROBOT, "weights")
