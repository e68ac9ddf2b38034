# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An arm whose compensator runs on another computer: carried over a fair wire.

`make study NAME=two-computers` has worse ones.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from ..support.launched_nodes import CALM
from .arm import PEERS
from .case import play
from .network import Wire

pytestmark = [pytest.mark.real_time, pytest.mark.thorough]

TIMEOUT = 1000.0 * CALM["can_bridge"]["command_timeout"]  # ms


def test_an_arm_is_carried_over_a_wire_with_delay_jitter_and_loss(tmp_path: Path):
    wire = Wire(delay=5.0, jitter=2.0, loss=0.02)
    result = play(wire, tmp_path, hold=2.0, timing=CALM)
    assert result.outcome == "carried"
    assert result.measured is not None
    assert result.measured.drift < 0.5  # deg
    assert 2.0 * wire.delay <= result.measured.age[0] < TIMEOUT
    assert result.measured.missed < 0.2  # test_network.py shows that the wire loses
    assert "ROS_STATIC_PEERS=10.77.0.2: other hosts can command this arm" in (tmp_path / "log.txt").read_text()
    assert (tmp_path / "bag_desk").is_dir()


def test_a_robot_that_names_no_peer_is_not_commanded_by_a_desk_that_names_it(tmp_path: Path):
    peers = {**PEERS, "robot": ""}
    timing = {**CALM, "can_bridge": {**CALM["can_bridge"], "enable_timeout": 5.0}}
    result = play(Wire(), tmp_path, hold=1.0, timing=timing, peers=peers)
    assert "waited for effort commands" in result.outcome
    assert "other hosts can command" not in (tmp_path / "log.txt").read_text()
