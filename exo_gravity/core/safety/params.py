"""The parameters of `can_bridge`, and the limits that they describe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from exo_gravity.core.motors.params import MOTOR_PARAMETERS
from exo_gravity.core.params import JOINT_NAMES, REAL_TIME_PARAMETERS, Param, params_of
from exo_gravity.core.safety.limits import Limits

# fmt: off
LIMIT_PARAMETERS = params_of(Limits, fixed=True)
CAN_BRIDGE = (
    JOINT_NAMES,
    Param("autostart", True, "configure and activate at start without an operator", fixed=True),
    Param("rate", 250.0, "control cycles per second, as far as the CAN bus allows", (20.0, 2000.0), "Hz",
          fixed=True),
    *MOTOR_PARAMETERS,
    *LIMIT_PARAMETERS,
    *REAL_TIME_PARAMETERS,
)
# fmt: on


def limits_of(values: Mapping[str, Any]) -> Limits:
    """Return the limits that `can_bridge`'s parameter values describe, or raise ParameterError."""
    return Limits(tuple(values["joint_names"]), **{param.name: values[param.name] for param in LIMIT_PARAMETERS})
