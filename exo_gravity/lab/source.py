# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Whether the numbers of an arm are simulated or real, for all that shows them: page, report, CSV files, recordings.

An arm is simulated if its device says so: a simulator plays it, or its bus leads to no motor. It is real if its
parameter file names a bus that leads to motors. Otherwise its source is unknown, and is said to be.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import source_of_bus
from exo_gravity.core.vocabulary import Source

# What a report says of it, of several arms together.
STATEMENTS = {
    Source.SIMULATED: "Simulated: programs made these numbers, not a person and not a motor.",
    Source.REAL: "Recorded on a real arm.",
    Source.UNKNOWN: "The recording does not say whether the arm was real or simulated.",
}


def source_of(bridge: Mapping[str, Any], has_simulator: bool) -> Source:
    """Return the source of an arm.

    bridge: the parameters of its `can_bridge`, {} if they are not known.
    has_simulator: whether a simulator plays this arm.
    """
    if has_simulator:
        return Source.SIMULATED
    interface = bridge.get("can.interface")
    try:
        return source_of_bus(interface, bridge.get("can.channel", "")) if interface else Source.UNKNOWN
    except ParameterError:  # a channel that this version does not know
        return Source.UNKNOWN


def of_all(sources: Iterable[Source]) -> Source:
    """Return the source of several arms: simulated if one of them is, real if all are, otherwise unknown."""
    found = set(sources)
    if Source.SIMULATED in found:
        return Source.SIMULATED
    return Source.REAL if found == {Source.REAL} else Source.UNKNOWN
