# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One run of a loop from bus to bus, timed by an independent listener.

The kinds of loop: the package's nodes, can_bridge and compensator of an arm in one process, one Python process without
ROS, and bare rclpy. All run on the same simulated device, which a virtual
wearer moves to and fro, with the same law and rate. The arms are those of a file in config.
"""

import contextlib
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.lab.processes import Launcher

from .peers import DirectArm
from .timing import LoopTiming, analyse, split_cycles

ONE_ARM, BOTH_ARMS, SEVEN_JOINTS = "sim.yaml", "sim_both.yaml", "seven_joints.yaml"
PAPERS = [0.5, 1.0, 0.9, 1.0], [-0.3, 0.4, 0.2, 0.3]
POSES = {  # rad; on the way between them the torque changes every cycle
    ONE_ARM: PAPERS,
    BOTH_ARMS: PAPERS,
    SEVEN_JOINTS: ([0.7, 0.9, 0.5, 1.0, 0.6, 0.4, 0.4], [0.2, 0.3, -0.3, 0.3, -0.5, -0.3, -0.3]),
}
MOVE = 2.0  # s from one pose to the other: slow enough that the safety machine adds no damping
START_LIMIT = 60.0  # s until the wearer must move
SETTLING = 0.5  # s of movement before the measurement
OURS = ("nodes", "one process")  # the kinds that run the package's nodes
PEERS = {"python": ("python",), "rclpy": ("compensator", "bridge")}  # the processes that take their place
TICKS = os.sysconf("SC_CLK_TCK")


class NodeLog:
    """The log of all nodes as it grows; the launcher calls it with each line."""

    def __init__(self) -> None:
        self.lines: list[tuple[float, str]] = []  #: monotonic s

    def __call__(self, node: str, line: str) -> None:
        """Take one line of the log of `node`."""
        self.lines.append((time.monotonic(), f"{node}: {line}"))

    def matching(self, expression: str) -> list[tuple[float, str]]:
        """Return the lines in which a regular expression is found, each with its time in monotonic s."""
        return [(when, line) for when, line in self.lines if re.search(expression, line)]


@dataclass(frozen=True)
class LoopRun:
    """One run.

    arms: the timing of each. cpu: share of a core by process. start: s from launch to carried.
    """

    arms: list[LoopTiming]
    cpu: dict[str, float]
    start: float


def run_loop(kind: str, rate: float, file: str, seconds: float) -> LoopRun:
    """Run one `kind` of loop: 'nodes', 'one process', 'python' or 'rclpy'.

    file: of the arms, one of POSES. Raises RuntimeError if the arm is not carried to the end.
    """
    with tempfile.TemporaryDirectory() as folder_name, contextlib.ExitStack() as stack:
        folder = Path(folder_name)
        params, simulators = write_parameters(folder, rate, file, seconds)
        namespaces = [node.removesuffix("/simulator") for node in load(simulators)]
        arms = [DirectArm(params, namespace) for namespace in namespaces]
        recordings = [folder / f"{namespace.strip('/')}.npz" for namespace in namespaces]
        listeners = [
            stack.enter_context(_listener(arm, recording)) for arm, recording in zip(arms, recordings, strict=True)
        ]
        log = NodeLog()
        launched = params if kind in OURS else simulators
        launcher = Launcher(launched, log, one_process=kind == "one process")
        stack.callback(launcher.stop)
        begin = time.monotonic()
        launcher.start()
        nodes = [node for node in load(launcher.params) if kind != "one process" or not node.endswith("/compensator")]
        pids = {node.lstrip("/"): launcher.process(node).pid for node in nodes}
        for namespace in namespaces:
            for part in PEERS.get(kind, ()):
                peer = _process("bench.peers", part, str(params), namespace, str(rate))
                pids[f"{namespace[1:]}/{part}"] = stack.enter_context(peer).pid
        while len(log.matching(r"wearer: move \(0")) < len(namespaces):
            time.sleep(0.05)
            if launcher.dead() or time.monotonic() > begin + START_LIMIT:
                raise RuntimeError(f"the arm was not carried: {[line for _, line in log.lines[-10:]]}")
        start = min(when for when, _ in log.matching(r": (INFO|WARN) active\b")) - begin if kind in OURS else math.nan
        time.sleep(SETTLING)
        window, cpu = _measure(pids, seconds)
        if (dead := launcher.dead()) or (let_down := log.matching("letting down")):
            raise RuntimeError(f"the arm was not carried to the end: {dead[0] if dead else let_down[0][1]}")
        stack.close()
        if any(listener.wait() for listener in listeners):
            raise RuntimeError("the listener lost frames: the machine is too busy to measure anything")
        timings = [_timing(arm, recording, window, rate) for arm, recording in zip(arms, recordings, strict=True)]
        return LoopRun(timings, cpu, start)


def _timing(arm: DirectArm, recording: Path, window: tuple[float, float], rate: float) -> LoopTiming:
    """Return the timing of an arm between two times in s since 1970."""
    with np.load(recording) as frames:
        cycles = split_cycles(dict(frames), arm.motors, *window)
    return analyse(cycles, arm.motors, arm.law, 1.0 / rate)


def write_parameters(folder: Path, rate: float, file: str, seconds: float) -> tuple[Path, Path]:
    """Write a parameter file of all nodes, and one of the simulators alone; return their paths."""
    script = folder / "to_and_fro.yaml"
    steps = [{"move": pose, "over": MOVE} for pose in POSES[file]] * int((seconds + 5.0) / (2 * MOVE) + 1)
    script.write_text(yaml.safe_dump({"name": "to_and_fro", "steps": steps}), encoding="utf-8")
    content = yaml.safe_load(packaged_config(file).read_text(encoding="utf-8"))
    for name, entry in content.items():
        values = entry["ros__parameters"]
        if name.endswith("/can_bridge"):
            # The duration of the sign check varies: leave it out.
            values.update(rate=float(rate), sign_check_torque=0.0)
        elif name.endswith("/compensator"):
            # With the IMU's noise an answer could not be matched to its reply. The node `imu` still runs.
            values.update(use_imu=False)
        elif name.endswith("/simulator"):
            # The delay ends after the torque has risen: it starts when the motors are switched on.
            values.update(trial=str(script), trial_delay=3.5, trunk={"pitch": 0.0, "roll": 0.0})
    all_nodes, simulators = folder / "params.yaml", folder / "simulators.yaml"
    all_nodes.write_text(yaml.safe_dump(content), encoding="utf-8")
    content = {name: entry for name, entry in content.items() if name.endswith("/simulator")}
    simulators.write_text(yaml.safe_dump(content), encoding="utf-8")
    return all_nodes, simulators


def _measure(pids: dict[str, int], seconds: float) -> tuple[tuple[float, float], dict[str, float]]:
    """Let `seconds` pass; return when that was, and each process's share of a core."""
    before, begin = {name: cpu_time(pid) for name, pid in pids.items()}, time.time()
    time.sleep(seconds)
    end = time.time()
    return (begin, end), {name: (cpu_time(pid) - before[name]) / (end - begin) for name, pid in pids.items()}


def _listener(arm: DirectArm, recording: Path) -> contextlib.AbstractContextManager[subprocess.Popen[bytes]]:
    return _process("bench.listener", arm.channel, str(arm.options["port"]), str(recording))


@contextlib.contextmanager
def _process(module: str, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a module in the context, and terminate it at the end."""
    process = subprocess.Popen([sys.executable, "-m", module, *arguments], cwd=Path(__file__).parents[1])
    try:
        yield process
    finally:
        process.terminate()
        process.wait(300.0)


def cpu_time(pid: int) -> float:
    """Return the processor time in s that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS
