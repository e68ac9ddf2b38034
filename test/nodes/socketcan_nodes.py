# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes as processes on vcan0, and on vcan0 and vcan1, where SocketCAN exists: `.ci/socketcan`.

The test observes the frames on the bus and the nodes' log. An emulated machine is 10 to 20 times slower than a real
one, so the nodes' clock is slowed down in proportion: the limits stay those of a worn arm.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import can
import pytest
import yaml

from exo_gravity.core.motors.ak import unpack_reply
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT, unpack_command
from exo_gravity.hardware.can.can_port import open_bus
from exo_gravity.lab import processes
from exo_gravity.lab.processes import Launcher

from ..support import CONFIG
from ..support.waiting import wait_until

VCAN = ("socketcan", "vcan0")
AK60 = MOTORS["AK60-6"]
IDS = (1, 2, 3, 4)
SLOWER = 10
# Python imports it at the start of every process that has its folder in PYTHONPATH.
SITECUSTOMIZE = f"""
import os, select, time
def refuse(*_): raise PermissionError  # on two slow cores a higher priority would starve the other processes
os.setpriority = refuse
monotonic, sleep, wait = time.monotonic, time.sleep, select.select
time.monotonic = lambda: monotonic() / {SLOWER}
time.sleep = lambda duration: sleep(duration * {SLOWER})
select.select = lambda r, w, x, timeout=None: wait(r, w, x, timeout and timeout * {SLOWER})
"""
TRIAL = {"name": "short", "steps": [{"move": [0.1, 0.8, 0.7, 0.6], "over": 0.5}, {"hold": 0.6}]}
CHANGES = {
    "can_bridge": {"rate": 50.0, "command_timeout": 0.1, "sign_check_torque": 0.0},
    "compensator": {"use_imu": False},
    "simulator": {"imu": {"rate": 10.0}, "trunk": {"pitch": 0.0, "roll": 0.0}, "trial_delay": 3.0},
}


@pytest.fixture
def frames() -> Iterator[list[can.Message]]:
    """All frames on vcan0 and vcan1 so far."""
    frames: list[can.Message] = []
    with (
        open_bus(*VCAN, {}) as bus,
        open_bus("socketcan", "vcan1", {}) as other,
        can.Notifier([bus, other], [frames.append]),
    ):
        yield frames


@pytest.fixture(params=["vcan0", "vcan0,vcan0,vcan1,vcan1"])
def nodes(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[Launcher, list[str]]]:
    """Bridge, compensator and simulator as processes on these channels with a slow clock, and their log so far."""
    (tmp_path / "sitecustomize.py").write_text(SITECUSTOMIZE)
    (tmp_path / "trial.yaml").write_text(yaml.safe_dump(TRIAL))
    content = yaml.safe_load((CONFIG / "sim.yaml").read_text())
    del content["/imu"]
    for node, changes in CHANGES.items():
        content[f"/right/{node}"]["ros__parameters"].update(changes)
    for node in ("can_bridge", "simulator"):
        content[f"/right/{node}"]["ros__parameters"]["can"] = {"interface": VCAN[0], "channel": request.param}
    content["/right/simulator"]["ros__parameters"]["trial"] = str(tmp_path / "trial.yaml")
    params = tmp_path / "params.yaml"
    params.write_text(yaml.safe_dump(content))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(processes, "DESCENT_TIMEOUT", processes.DESCENT_TIMEOUT * SLOWER)
    monkeypatch.setattr(processes, "RECOVERY_TIMEOUT", processes.RECOVERY_TIMEOUT * SLOWER)
    log: list[str] = []
    nodes = Launcher(params, lambda node, line: log.append(f"{node}: {line}"))
    nodes.start()
    yield nodes, log
    nodes.stop()
    print("\n".join(log))


def wait_for(text: str, nodes: Launcher, log: list[str]) -> None:
    """Wait until a line of the log contains `text`."""
    wait_until(lambda: nodes.dead() or any(text in line for line in log), timeout=120.0, seen=lambda: text)
    assert nodes.dead() is None


def angles(frames: list[can.Message]) -> list[float]:
    """Return the angle in rad from the newest reply of each motor."""
    newest = {frame.arbitration_id: frame.data for frame in frames[-100:] if frame.data[0] == frame.arbitration_id}
    return [unpack_reply(AK60, newest[can_id]).position for can_id in IDS]


def commanded_torque(frames: list[can.Message], can_id: int) -> float:
    """Return the torque in Nm of the newest command to a motor."""
    return [unpack_command(AK60, frame.data).torque for frame in frames[-100:] if is_command(frame, can_id)][-1]


def is_command(frame: can.Message, can_id: int) -> bool:
    return frame.arbitration_id == can_id and frame.data[0] in (0x7F, 0x80)


def test_the_nodes_carry_the_arm_and_switch_the_motors_off(nodes, frames):
    nodes, log = nodes
    wait_for("can_bridge: INFO active", nodes, log)
    wait_for("wearer: hold", nodes, log)
    released = angles(frames)
    wait_for("wearer: done", nodes, log)
    assert angles(frames) == pytest.approx(released, abs=0.01)
    assert abs(commanded_torque(frames, 3)) > 1.0  # five times the friction

    bridge = nodes.process("/right/can_bridge")
    bridge.terminate()
    assert bridge.wait(120.0) == 0
    for can_id in IDS:
        special = [bytes(f.data) for f in frames if f.arbitration_id == can_id and bytes(f.data) in (ENTER, EXIT)]
        assert ENTER in special
        assert special[-1] == EXIT
    assert not any("Traceback" in line for line in log)
