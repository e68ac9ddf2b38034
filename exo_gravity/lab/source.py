"""Whether the numbers of an arm are simulated or real, for all that shows them: page, report, CSV files, recordings.

An arm is simulated if its device says so: a simulator plays it, or its bus leads to no motor. It is real if its
parameter file names a bus that leads to motors. Otherwise its source is unknown, and is said to be.
"""

from collections.abc import Iterable, Mapping
from enum import Enum
from typing import Any

from exo_gravity.core.motors.joint_motor import SIMULATED_BUSES

VIRTUAL_CAN = "vcan"  # how Linux names CAN interfaces that lead to no motor; a simulator may play behind one


class Source(str, Enum):
    """Where the numbers of an arm come from."""

    SIMULATED = "simulated"
    REAL = "real"
    UNKNOWN = "unknown"

    def __str__(self) -> str:
        return str(self.value)


# What a report says of it, of several arms together.
STATEMENTS = {
    Source.SIMULATED: "Simulated: programs made these numbers, not a person and not a motor.",
    Source.REAL: "Recorded on a real arm.",
    Source.UNKNOWN: "The recording does not say whether the arm was real or simulated.",
}


def source_of(bridge: Mapping[str, Any], has_simulator: bool) -> Source:
    """Return the source of an arm.

    bridge: the parameters of its `can_bridge`, {} if they are not known.
    has_simulator: whether a simulator reports on this arm.
    """
    interface = bridge.get("can.interface", "")
    if has_simulator or interface in SIMULATED_BUSES:
        return Source.SIMULATED
    is_virtual = VIRTUAL_CAN in str(bridge.get("can.channel", ""))
    return Source.REAL if interface and not is_virtual else Source.UNKNOWN


def of_all(sources: Iterable[Source]) -> Source:
    """Return the source of several arms: simulated if one of them is, real if all are, otherwise unknown."""
    found = set(sources)
    if Source.SIMULATED in found:
        return Source.SIMULATED
    return Source.REAL if found == {Source.REAL} else Source.UNKNOWN
