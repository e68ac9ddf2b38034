"""Checks of parameters against each other: each value is possible alone, but not together with the others."""

from __future__ import annotations

import math
from collections.abc import Sequence

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.bus_load import MAX_STATUS_RATE, REPLY_SHARE
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.limits import Limits

FROZEN = 0.08  # s without a drive from the control loop while the watchdog itself runs, after which it takes over
PERIODS = 2  # control periods that must fit into each time-out, so that one late cycle is not a fault


def check_bridge(
    rate: float, motors: Sequence[JointMotor], limits: Limits, status_rate: float = MAX_STATUS_RATE
) -> None:
    """Check the parameters of a `can_bridge` with control rate `rate` (Hz) against each other.

    status_rate: Hz, of V3 boards. Raises ParameterError that names both values.
    """
    _check_rate(rate, limits)
    if rate > REPLY_SHARE * status_rate + 1e-9 and not all(motor.wire_format.replies for motor in motors):
        expected = f"at most {REPLY_SHARE * status_rate:g} Hz: each cycle awaits a status frame, status_rate"
        raise ParameterError("rate", rate, f"{expected} = {status_rate:g} Hz")
    peak = [motor.peak_effort for motor in motors]
    if any(effort > most + 1e-9 for effort, most in zip(limits.max_effort, peak, strict=True)):
        shown = [round(effort, 2) for effort in peak]
        raise ParameterError("max_effort", list(limits.max_effort), f"at most the motors' peak torque, {shown} Nm")
    # A single encoder does not know in which turn of the rotor the motor was switched on.
    ambiguity = [math.pi / motor.spec.gear_ratio for motor in motors]
    if any(tolerance > half for tolerance, half in zip(limits.home_tolerance, ambiguity, strict=True)):
        shown = [math.floor(half * 1000.0) / 1000.0 for half in ambiguity]
        expected = f"at most half a turn of each motor's rotor, {shown} rad at the joint"
        raise ParameterError("home_tolerance", list(limits.home_tolerance), expected)


def _check_rate(rate: float, limits: Limits) -> None:
    timeouts = {
        "command_timeout": limits.command_timeout,
        "reply_timeout": limits.reply_timeout,
        "the watchdog's time-out": FROZEN,
    }
    name, shortest = min(timeouts.items(), key=lambda item: item[1])
    if rate * shortest < PERIODS - 1e-9:
        least = PERIODS / shortest
        expected = f"at least {least:g} Hz: {name} = {shortest:g} s must span {PERIODS} periods"
        raise ParameterError("rate", rate, expected)
