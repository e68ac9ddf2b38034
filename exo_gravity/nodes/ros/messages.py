# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""ROS messages <-> plain values: stamps, joints by name and never by index, and a node's status on /diagnostics.

Levels of a status:

    OK     works
    WARN   works within a limit, or waits
    ERROR  does not work
    STALE  had input that no longer arrives
"""

import math
import time
from collections.abc import Iterable, Mapping, Sequence

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from sensor_msgs.msg import JointState

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.vocabulary import INTERFACE

OK, WARN, ERROR, STALE = (getattr(DiagnosticStatus, level) for level in ("OK", "WARN", "ERROR", "STALE"))
HELD_BY, NOBODY = "control held by", "nobody"  # key in can_bridge's status; value without an operator
# Key in can_bridge's status: the pose that a start asks the operator about, in degrees; value without a question.
POSE_TO_CONFIRM, NO_POSE = "pose to confirm (deg)", "none"
LATE_TILT = "late tilt"  # frame_id of efforts that are computed from one

REPEAT_PERIOD = 0.45  # s; a little less than a multiple of the nodes' timer periods, which jitter


def to_nanoseconds(stamp: Time) -> int:
    """Return a stamp in ns."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def by_name(message: JointState, field: str, names: Sequence[str], exact: bool = True) -> tuple[float, ...]:
    """Return `message`'s position, velocity or effort (n,) in the order of `names`.

    field: 'position', 'velocity' or 'effort'.
    exact: whether the message may have no other joints.

    Raises ParameterError unless the message has these names, each once, and one finite value for each: an absent joint
    is an error, never 0.
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


def known(message: JointState, field: str, names: Sequence[str], exact: bool = True) -> tuple[float, ...] | None:
    """Return what `by_name` does, None where that raises: if values are missing or not finite."""
    try:
        return by_name(message, field, names, exact)
    except ParameterError:
        return None


class Diagnostics:
    """Publishes a DiagnosticStatus: a change at once, otherwise twice a second. Logs level and message on a change."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._last: tuple[bytes, str] | None = None
        self._sent = -math.inf

    def report(self, level: bytes, message: str, values: Mapping[str, object]) -> None:
        """Publish a status if it is due; log its level and message if they changed.

        level: OK, WARN, ERROR or STALE.
        message: for people.
        values: for programs, by key; `state` is among them (docs/keys.md).
        """
        now, changed = time.monotonic(), (level, message) != self._last
        if not changed and now - self._sent < REPEAT_PERIOD:
            return
        self._sent = now
        status = DiagnosticStatus(
            level=level,
            name=self._name,
            message=message,
            hardware_id=self._node.get_namespace().lstrip("/"),
            values=[KeyValue(key=key, value=str(value)) for key, value in {"interface": INTERFACE, **values}.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
        if changed:
            self._last = (level, message)
            logger = self._node.get_logger()
            # One call site per severity: rclpy refuses a call site whose severity changes.
            if level == OK:
                logger.info(message)
            elif level in (WARN, STALE):
                logger.warning(message)
            else:
                logger.error(message)


def row(values: Iterable[float], digits: int = 3) -> str:
    """Return numbers as text, with at most `digits` decimals, no trailing zeros and no negative zero."""
    return ", ".join(f"{round(float(value), digits) + 0.0:.12g}" for value in values)


def milliseconds(seconds: float) -> str:
    """Return a duration as text in ms with one decimal, 'none' if it is infinite."""
    return f"{1000.0 * seconds:.1f}" if math.isfinite(seconds) else "none"
