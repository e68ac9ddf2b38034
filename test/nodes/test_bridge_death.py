"""Who commands the motors when bridges die or meet: real processes, started by the launcher."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator

import pytest

from exo_gravity.tools import launcher

from ..support.launched_nodes import NO_IMU, LaunchedNodes, children, executable
from ..support.ros_probe import RosProbe

pytestmark = pytest.mark.real_time


@pytest.fixture
def nodes(launch: Callable[..., LaunchedNodes], probe: RosProbe) -> Iterator[LaunchedNodes]:
    """Nodes that carry an arm without an IMU."""
    nodes = launch(without=("imu",), compensator=NO_IMU)
    probe.wait_until_carried()
    yield nodes


def test_a_second_bridge_on_the_bus_ends_with_the_owners_name_and_the_arm_stays_carried(nodes, probe, listen):
    listener = listen(nodes)
    command = [executable("can_bridge"), "--ros-args", "-r", "__ns:=/second", "--params-file", str(nodes.path)]
    bus = ["can.interface:=udp_multicast", f"can.channel:={nodes.bus['channel']}"]
    bus += [f"can.options.port:={nodes.bus['port']}", "can.options.hop_limit:=0"]
    second = subprocess.run(
        [*command, *(word for text in bus for word in ("-p", text))], capture_output=True, text=True, timeout=60
    )
    assert second.returncode == 2
    owner = f"is held by /right/can_bridge (PID {nodes.process('can_bridge').pid})"
    assert owner in second.stdout + second.stderr
    assert probe.state == "active"
    assert not any(frame.data[0] == 0xFF for frame in listener.frames)


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


def test_the_launcher_states_that_motors_may_still_be_powered(nodes, probe, monkeypatch):
    monkeypatch.setattr(launcher, "DESCENT_TIMEOUT", 10.0)
    monkeypatch.setattr(launcher, "RECOVERY", {"EXO_GRAVITY_RECOVER": "2"})
    (watchdog,) = children(nodes.process("can_bridge").pid)
    assert probe.set_parameters("simulator", fault__bus_silent=True).successful
    nodes.stopping.set()
    wait_until(lambda: nodes.have_ended)
    assert nodes.launcher.maybe_powered == ["/right/can_bridge"]
    os.kill(watchdog, signal.SIGKILL)  # it would try without end


def wait_until(condition: Callable[[], object], timeout: float = 90.0) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "the condition did not hold in time"
        time.sleep(0.05)
