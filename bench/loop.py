"""The loop from bus to bus, as an independent listener sees it: the nodes, one Python process without ROS, bare rclpy.

All three run on the same simulated device, which a virtual wearer leads to and fro, with the same law at the same rate.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from bench.arm import Arm
from bench.latency import Loop, analyse, cycles_of
from exo_gravity.tools.inputs.parameter_file import packaged_config
from exo_gravity.tools.launcher import Launcher

POSES = [0.5, 1.0, 0.9, 1.0], [-0.3, 0.4, 0.2, 0.3]  # rad; between them every cycle asks for other torques
MOVE = 1.0  # s
START = 60.0  # s until the wearer must move
SETTLING = 0.5  # s of movement before anything counts
OURS = {"nodes": 0, "fifo": 50}  # the kinds that are the package's nodes, and their `thread_priority`
TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Result:
    """One run. arms: what was seen of each. cpu: share of a core by process; stolen: the same, of what the hypervisor
    gave to others. start: s from launch to carried.
    """

    arms: list[Loop]
    cpu: dict[str, float]
    stolen: float
    start: float


def parameters(folder: Path, rate: float, both: bool, seconds: float, nodes: bool, priority: int) -> Path:
    """Write a parameter file: `nodes` False for the simulators alone (the other entries stay in params.yaml)."""
    protocol = folder / "to_and_fro.yaml"
    steps = [{"move": pose, "over": MOVE} for pose in POSES] * int((seconds + 5.0) / (2 * MOVE) + 1)
    protocol.write_text(yaml.safe_dump({"name": "to_and_fro", "steps": steps}), encoding="utf-8")
    content = yaml.safe_load(packaged_config("sim_both.yaml" if both else "sim.yaml").read_text(encoding="utf-8"))
    for name, entry in content.items():
        values = entry["ros__parameters"]
        if name.endswith("/can_bridge"):
            # Without the sign check, which takes as long as it takes.
            values.update(rate=float(rate), sign_check_torque=0.0, thread_priority=priority)
        elif name.endswith("/compensator"):
            # The IMU's noise would blur which answer belongs to which reply; `imu` runs on.
            values.update(use_imu=False, thread_priority=priority)
        elif name.endswith("/simulator"):
            # A second after the ramp: the motors are switched on when it begins.
            values.update(trial=str(protocol), trial_delay=2.0, trunk={"pitch": 0.0, "roll": 0.0})
    whole, simulators = folder / "params.yaml", folder / "simulators.yaml"
    whole.write_text(yaml.safe_dump(content), encoding="utf-8")
    alone = {name: entry for name, entry in content.items() if name.endswith("/simulator")}
    simulators.write_text(yaml.safe_dump(alone), encoding="utf-8")
    return whole if nodes else simulators


def run(
    kind: str, rate: float, both: bool, seconds: float, watch: Callable[[dict[str, int]], None] | None = None
) -> Result:
    """Run the `kind` of loop: 'nodes', the same with 'fifo' threads, 'python' or 'rclpy'.

    watch: called while it runs, with the process IDs, for `seconds`; by default that time just passes.
    Raises RuntimeError where the arm is not carried to the end.
    """
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        path = parameters(folder, rate, both, seconds, kind in OURS, OURS.get(kind, 0))
        whole = str(folder / "params.yaml")
        spaces = ["/right", "/left"] if both else ["/right"]
        arms = [Arm(whole, space) for space in spaces]
        files = [folder / f"{space.strip('/')}.npz" for space in spaces]
        listeners = [
            stack.enter_context(
                _process(None, "bench.listener", arm.address[1], str(arm.address[2]["port"]), str(file))
            )
            for arm, file in zip(arms, files, strict=True)
        ]
        news = _News()
        launcher = Launcher(path, news)
        stack.callback(launcher.stop)
        begin = time.monotonic()
        launcher.start()
        processes = {node.lstrip("/"): launcher.process(node).pid for node in yaml.safe_load(path.read_text())}
        for space in spaces:
            for part, *command in _parts(kind, whole, space, rate):
                process = stack.enter_context(_process(launcher, *command))
                processes[f"{space[1:]}/{part}"] = process.pid
        news.wait(launcher, "wearer: move (0", len(spaces))
        start = news.first(": active") - begin
        if refused := news.find("not permitted"):
            raise RuntimeError(refused)
        time.sleep(SETTLING)
        window = _window(processes, seconds, watch)
        if dead := launcher.dead():
            last = [line for _, line in news.lines if dead[0] in line][-5:]
            raise RuntimeError(f"{dead[0]} ended in mid-run: {last}")
        if fault := news.find("letting down"):
            raise RuntimeError(f"the arm was let down in mid-run: {fault}")
        stack.close()
        if any(listener.wait() for listener in listeners):
            raise RuntimeError("the listener lost frames: the machine is too busy to measure anything")
        loops = []
        for arm, file in zip(arms, files, strict=True):
            with np.load(file) as frames:
                cycles = cycles_of(dict(frames), arm.motors, *window[:2])
            loops.append(analyse(cycles, arm.motors, arm.law, 1.0 / rate))
        return Result(loops, *window[2:], start)


def _window(processes: dict[str, int], seconds: float, watch) -> tuple[float, float, dict[str, float], float]:
    """Let `seconds` pass; return begin and end (s since 1970), each process's share of a core, and what was stolen."""
    before, stolen, begin = {name: _cpu(pid) for name, pid in processes.items()}, _stolen(), time.time()
    if watch:
        watch(processes)
    else:
        time.sleep(seconds)
    end = time.time()
    shares = {name: (_cpu(pid) - before[name]) / (end - begin) for name, pid in processes.items()}
    return begin, end, shares, (_stolen() - stolen) / (end - begin)


def _parts(kind: str, params: str, space: str, rate: float) -> list[tuple[str, ...]]:
    if kind in OURS:
        return []
    if kind == "python":
        return [("python", "bench.floor", params, space, str(rate))]
    return [(part, "bench.relay", part, params, space, str(rate)) for part in ("answer", "bridge")]


@contextlib.contextmanager
def _process(launcher: Launcher | None, *command: str) -> Iterator[subprocess.Popen]:
    """Run a module; end it before the simulators, which it needs, are stopped."""
    process = subprocess.Popen([sys.executable, "-m", *command], cwd=Path(__file__).parents[1])
    try:
        yield process
    finally:
        process.terminate()
        process.wait(300.0)


def _cpu(pid: int) -> float:
    """Return the processor time in s that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def _stolen() -> float:
    """Return the processor time in s that a hypervisor has given to others, of all cores together."""
    return int(Path("/proc/stat").read_text().split("\n", 1)[0].split()[8]) / TICKS


class _News:
    """The nodes' log, and a way to wait for a line of it."""

    def __init__(self):
        self.lines: list[tuple[float, str]] = []
        self._changed = threading.Condition()

    def __call__(self, node: str, line: str) -> None:
        with self._changed:
            self.lines.append((time.monotonic(), f"{node}: {line}"))
            self._changed.notify()

    def first(self, text: str) -> float:
        """Return when a line that ends with `text` came, infinity if none did."""
        return next((when for when, line in self.lines if line.replace("INFO ", "").endswith(text)), float("inf"))

    def find(self, text: str) -> str:
        """Return the first line that has `text`, or ''."""
        return next((line for _, line in self.lines if text in line), "")

    def wait(self, launcher: Launcher, text: str, count: int) -> None:
        """Wait until `count` lines have `text`."""
        deadline = time.monotonic() + START
        with self._changed:
            while sum(text in line for _, line in self.lines) < count:
                self._changed.wait(0.5)
                if launcher.dead() or time.monotonic() > deadline:
                    raise RuntimeError(f"the arm was not carried: {[line for _, line in self.lines[-10:]]}")
