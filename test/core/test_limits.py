# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The limits of a worn arm, as parameters."""

from __future__ import annotations

import math

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.limits import Limits

from ..support.safety_run import LIMITS


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("max_effort", (3.0, 9.0, 3.0)),
        ("position_max", (0.0,) * 4),
        ("driven_speed", math.inf),
        ("command_timeout", 5.0),
        ("sign_check_torque", math.nan),
        ("joint_names", ("a", "a", "b", "c")),
    ],
)
def test_an_impossible_limit_is_rejected_by_name(field, value):
    with pytest.raises(ParameterError) as caught:
        Limits(**{**vars(LIMITS), field: value})
    assert caught.value.name == field
