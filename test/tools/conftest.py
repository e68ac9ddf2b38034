"""The report of a trial in which the arm held."""

import pytest

from exo_gravity.tools.reporting.trial_report import analyse

from ..support import synthetic_bags as made


@pytest.fixture(scope="module")
def held():
    return analyse(made.bag_of(made.trial(made.POSES, hold=4.0, push=made.PUSH)))
