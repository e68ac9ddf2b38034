"""Who lets the arm down when a bridge and its watchdog die: real processes, started by the launcher."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest

from exo_gravity.tools import launcher

from ..support.launched_nodes import NO_IMU, LaunchedNodes, children
from ..support.ros_probe import RosProbe
from ..support.waiting import wait_until

pytestmark = pytest.mark.real_time


@pytest.fixture
def nodes(launch: Callable[..., LaunchedNodes], probe: RosProbe) -> Iterator[LaunchedNodes]:
    """Nodes that carry an arm without an IMU."""
    nodes = launch(without=("imu",), compensator=NO_IMU)
    probe.wait_until_carried()
    yield nodes


def test_an_arm_whose_bridge_and_watchdog_were_killed_is_let_down_by_the_launcher(nodes, listen):
    listener = listen(nodes)
    bridge = nodes.process("can_bridge").pid
    (watchdog,) = children(bridge)
    os.kill(watchdog, signal.SIGKILL)
    os.kill(bridge, signal.SIGKILL)
    wait_until(lambda: nodes.have_ended)
    assert nodes.ended_node == ("/right/can_bridge", -signal.SIGKILL)
    assert nodes.launcher.maybe_powered == []
    assert any("the arm is down, its motors are off" in line for line in nodes.log)
    assert listener.motors_are_off()


@pytest.mark.thorough
def test_the_launcher_states_that_motors_may_still_be_powered(nodes, probe, monkeypatch):
    monkeypatch.setattr(launcher, "DESCENT_TIMEOUT", 5.0)
    monkeypatch.setattr(launcher, "RECOVERY", {"EXO_GRAVITY_RECOVER": "2"})
    (watchdog,) = children(nodes.process("can_bridge").pid)
    assert probe.set_parameters("simulator", fault__bus_silent=True).successful
    nodes.stopping.set()
    wait_until(lambda: nodes.have_ended)
    assert nodes.launcher.maybe_powered == ["/right/can_bridge"]
    with suppress(ProcessLookupError):  # it ended once the launcher had asked for the bus
        os.kill(watchdog, signal.SIGKILL)
