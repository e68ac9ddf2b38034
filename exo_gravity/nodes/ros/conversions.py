"""ROS messages <-> plain values. Joints are looked up by name, never by index."""

from __future__ import annotations

import math
from collections.abc import Sequence

from builtin_interfaces.msg import Time
from sensor_msgs.msg import JointState

from exo_gravity.core.errors import ParameterError


def to_time(nanoseconds: int) -> Time:
    """Return a message stamp for nanoseconds."""
    return Time(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)


def to_nanoseconds(stamp: Time) -> int:
    """Return the nanoseconds of a message stamp."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def by_name(message: JointState, field: str, names: Sequence[str], exact: bool = True) -> tuple[float, ...]:
    """Return `message`'s position, velocity or effort (n,) in the order of `names`.

    Raises ParameterError unless the message has these names, each once, and one finite value for each; if `exact`, also
    if it has others. An absent joint is an error, never 0.
    """
    values, given = getattr(message, field), message.name
    if len(values) != len(given):
        raise ParameterError(field, list(values), f"{len(given)} values, one for each name")
    if given != list(names):
        if sorted(given) != sorted(names) if exact else any(given.count(name) != 1 for name in names):
            raise ParameterError("name", list(given), f"{'exactly ' if exact else ''}{', '.join(names)}, each once")
        values = [values[given.index(name)] for name in names]
    result = tuple(values)
    if not all(map(math.isfinite, result)):
        raise ParameterError(field, list(result), "finite numbers")
    return result


def velocity_of(message: JointState, names: Sequence[str], exact: bool = True) -> tuple[float, ...] | None:
    """Return `message`'s velocities (n,) in the order of `names`, None if they are missing or not finite."""
    try:
        return by_name(message, "velocity", names, exact)
    except ParameterError:
        return None
