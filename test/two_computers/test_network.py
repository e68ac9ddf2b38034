# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The wire between the two computers, without ROS: what arrives, how late, and that there is no other way out."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from ..support.waiting import PATIENCE, wait_until
from .network import ADDRESSES, Network, Wire

pytestmark = pytest.mark.thorough
COUNT = 300
ECHO = [sys.executable, "-m", "test.two_computers.echo"]


def round_trips(wire: Wire) -> list[tuple[int, float]]:
    """Return number and round-trip time in s of the datagrams that come back of `COUNT`."""
    with Network(wire) as network:
        echo = network.start("desk", [*ECHO, "echo", ADDRESSES["desk"]], {})
        assert echo.stdout is not None and echo.stdout.readline() == "ready\n"
        counting = network.start("robot", [*ECHO, "count", ADDRESSES["desk"], str(COUNT)], {})
        output, _ = counting.communicate(timeout=PATIENCE)
        echo.kill()
    return [(number, time) for number, time in json.loads(output)]


def test_every_datagram_passes_in_order_and_none_is_earlier_than_the_delay_also_with_jitter():
    numbers, times = zip(*round_trips(Wire(delay=5.0, jitter=8.0)), strict=True)
    assert numbers == tuple(range(COUNT))
    assert min(times) >= 0.010  # s, both ways
    assert max(times) > 0.014  # jitter, both ways


def test_the_stated_share_is_lost_each_way():
    share = len(round_trips(Wire(loss=0.2))) / COUNT
    assert share == pytest.approx(0.8**2, abs=0.1)  # the seed is fixed; other packets draw from it too


def test_a_computer_has_no_interface_but_the_wire():
    with Network(Wire()) as network:
        listing = network.start("robot", ["ip", "-json", "link"], {})
        names = {link["ifname"] for link in json.loads(listing.communicate(timeout=PATIENCE)[0])}
        routes = network.start("robot", ["ip", "route"], {}).communicate(timeout=PATIENCE)[0]
    assert names == {"lo", "eth0"} and "default" not in routes


def test_every_process_in_the_namespaces_ends_with_the_network():
    with Network(Wire()) as network:
        left_behind = network.start("robot", ["sh", "-c", "trap '' TERM HUP; sleep 1000 & echo $!; wait"], {})
        assert left_behind.stdout is not None
        child = int(left_behind.stdout.readline())
        holders = dict(network._namespaces)
        assert len(holders) == 3
    for process in (*holders.values(), child):  # it may be a zombie until its parent notices
        wait_until(lambda path=Path(f"/proc/{process}/exe"): not path.exists())
