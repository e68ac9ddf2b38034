# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes as processes on vcan0, and on vcan0 and vcan1, where SocketCAN exists: `make study NAME=socketcan`.

The test observes the frames on the bus and the nodes' log. An emulated machine is 10 to 20 times slower than a real
one, so the nodes' clock is slowed down in proportion: the limits stay those of a worn arm.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import can
import pytest
import yaml

from exo_gravity.core.motors.frames import ENTER, EXIT
from exo_gravity.hardware.can.can_port import open_bus
from exo_gravity.lab import processes
from exo_gravity.lab.processes import Launcher

from ..support import CONFIG
from ..support.waiting import wait_until

VCAN = ("socketcan", "vcan0")
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
CHANGES = {
    "can_bridge": {"rate": 50.0, "command_timeout": 0.1, "frozen_timeout": 0.08, "sign_check_torque": 0.0},
    "compensator": {"use_imu": False},
    "simulator": {"imu": {"rate": 10.0}, "trunk": {"pitch": 0.0, "roll": 0.0}},
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
    content = yaml.safe_load((CONFIG / "sim.yaml").read_text())
    del content["/imu"]
    for node, changes in CHANGES.items():
        content[f"/right/{node}"]["ros__parameters"].update(changes)
    for node in ("can_bridge", "simulator"):
        content[f"/right/{node}"]["ros__parameters"]["can"] = {"interface": VCAN[0], "channel": request.param}
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


def test_the_nodes_carry_the_arm_and_switch_the_motors_off(nodes, frames):
    nodes, log = nodes
    wait_for("can_bridge: INFO active", nodes, log)

    bridge = nodes.process("/right/can_bridge")
    bridge.terminate()
    assert bridge.wait(120.0) == 0
    for can_id in IDS:
        special = [bytes(f.data) for f in frames if f.arbitration_id == can_id and bytes(f.data) in (ENTER, EXIT)]
        assert ENTER in special
        assert special[-1] == EXIT
    assert not any("Traceback" in line for line in log)
