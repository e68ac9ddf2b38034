# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Whether an arm is simulated: as its device says, else as its parameter file does, else nobody knows."""

from __future__ import annotations

import pytest

from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.source import of_all, source_of

SIMULATED, REAL, UNKNOWN = Source.SIMULATED, Source.REAL, Source.UNKNOWN


@pytest.mark.parametrize(
    ("interface", "channel", "has_simulator", "source"),
    [
        ("udp_multicast", "239.74.163.2", False, SIMULATED),
        ("socketcan", "can0", False, REAL),
        ("socketcan", "can0,can0,can1,can1", False, REAL),
        ("socketcan", "vcan0", False, UNKNOWN),
        ("socketcan", "vcan0", True, SIMULATED),
        ("socketcan", "", False, UNKNOWN),
        ("", "", False, UNKNOWN),
        (None, None, False, UNKNOWN),
    ],
)
def test_an_arm_is_real_only_if_its_file_names_a_bus_that_leads_to_motors(interface, channel, has_simulator, source):
    bridge = {} if interface is None else {"can.interface": interface, "can.channel": channel}
    assert source_of(bridge, has_simulator) is source


def test_several_arms_are_real_only_together():
    assert of_all([REAL, REAL]) is REAL
    assert of_all([REAL, SIMULATED]) is of_all([SIMULATED, UNKNOWN]) is SIMULATED
    assert of_all([REAL, UNKNOWN]) is of_all([]) is UNKNOWN
