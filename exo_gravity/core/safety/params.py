"""The parameters of `can_bridge`, the limits that they describe, and the checks of one against another."""

from collections.abc import Mapping, Sequence
from typing import Any

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import MAX_STATUS_RATE, MOTOR_PARAMETERS, REPLY_SHARE, JointMotor
from exo_gravity.core.params import JOINT_NAMES, REAL_TIME_PARAMETERS, Param, params_of
from exo_gravity.core.safety.limits import HOME_TOLERANCE, REPLY_TIMEOUT, Limits
from exo_gravity.core.safety.monitors import MISSED

FROZEN = 0.08  # s without a drive from the control loop while the watchdog itself runs, after which it takes over
PERIODS = 2  # control periods that must fit into each time-out, so that one late cycle is not a fault

# fmt: off
LIMIT_PARAMETERS = params_of(Limits, fixed=True)
CAN_BRIDGE = (
    JOINT_NAMES,
    Param("autostart", True, "configure and activate once at the start, without an operator", fixed=True),
    Param("rate", 250.0, "control cycles per second, as far as the CAN bus allows", (20.0, 2000.0), "Hz",
          fixed=True),
    *MOTOR_PARAMETERS,
    *LIMIT_PARAMETERS,
    *REAL_TIME_PARAMETERS,
)
# fmt: on


def limits_of(values: Mapping[str, Any]) -> Limits:
    """Return the limits that `can_bridge`'s parameter values describe, or raise ParameterError."""
    given = {param.name: values[param.name] for param in LIMIT_PARAMETERS}
    given["home_tolerance"] = tuple(HOME_TOLERANCE[name] for name in values["motor"])
    given["reply_timeout"] = min(2.0 * REPLY_TIMEOUT, max(REPLY_TIMEOUT, MISSED / values["rate"]))
    return Limits(tuple(values["joint_names"]), **given)


def check_bridge(
    rate: float, motors: Sequence[JointMotor], limits: Limits, status_rate: float = MAX_STATUS_RATE
) -> None:
    """Check the parameters of a `can_bridge` with control rate `rate` (Hz) against each other.

    status_rate: status frames a second of V3 boards. Raises ParameterError that names both values.
    """
    timeouts = {"command_timeout": limits.command_timeout, "the watchdog's time-out": FROZEN}
    name, shortest = min(timeouts.items(), key=lambda item: item[1])
    if rate * shortest < PERIODS - 1e-9:
        expected = f"at least {PERIODS / shortest:g} Hz: {name} = {shortest:g} s must span {PERIODS} periods"
        raise ParameterError("rate", rate, expected)
    if rate > REPLY_SHARE * status_rate + 1e-9 and not all(motor.wire_format.replies for motor in motors):
        expected = f"at most {REPLY_SHARE * status_rate:g} Hz: each cycle waits for a status frame of a V3 board"
        raise ParameterError("rate", rate, f"{expected}, which sends {status_rate:g} a second")
    peak = [motor.peak_effort for motor in motors]
    if any(effort > most + 1e-9 for effort, most in zip(limits.max_effort, peak, strict=True)):
        shown = [round(effort, 2) for effort in peak]
        raise ParameterError("max_effort", list(limits.max_effort), f"at most the motors' peak torque, {shown} Nm")
