# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rows of the loop from bus to bus, timed by an independent listener.

The kinds of loop: the package's nodes, can_bridge and compensator of an arm in one process, one Python process without
ROS, and bare rclpy. All run on the same simulated device, which a virtual wearer moves to and fro, with the same law
and rate. The arms are those of a file in config. The kinds take turns, so that other load on the machine affects all of
them alike; a row compares run by run.
"""

import contextlib
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.core.safety.start import START_GATE
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.lab.processes import Launcher

from .peers import DirectArm
from .table import Row
from .timing import LoopTiming, analyse, percentile, split_cycles

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
RATES = (
    *(("one arm", ONE_ARM, rate) for rate in (200, 500, 1000)),
    *(("both arms", BOTH_ARMS, rate) for rate in (200, 500)),
    ("seven joints on CAN FD", SEVEN_JOINTS, 500),
)
QUICK_RATES = (RATES[1], RATES[3])
KINDS = ("nodes", "one process", "python", "rclpy")
OTHERS = {"python": "Python without ROS", "rclpy": "bare rclpy"}
TURNS, SECONDS, QUICK_SECONDS = 3, 10.0, 5.0


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
            stack.enter_context(_process("bench.listener", arm.channel, str(arm.options["port"]), str(recording)))
            for arm, recording in zip(arms, recordings, strict=True)
        ]
        log: list[tuple[float, str]] = []  # monotonic s, and a line of a node
        note = lambda node, line: log.append((time.monotonic(), f"{node}: {line}"))  # noqa: E731
        launcher = Launcher(params if kind in OURS else simulators, note, one_process=kind == "one process")
        stack.callback(launcher.stop)
        begin = time.monotonic()
        launcher.start()
        nodes = [node for node in load(launcher.params) if kind != "one process" or not node.endswith("/compensator")]
        pids = {node.lstrip("/"): launcher.process(node).pid for node in nodes}
        for namespace in namespaces:
            for part in PEERS.get(kind, ()):
                peer = _process("bench.peers", part, str(params), namespace, str(rate))
                pids[f"{namespace[1:]}/{part}"] = stack.enter_context(peer).pid
        carried = r": (INFO|WARN) active\b"
        while len(matching(log, r"wearer: move \(0")) < len(namespaces) or (
            kind in OURS and not matching(log, carried)
        ):
            time.sleep(0.05)
            if launcher.dead() or time.monotonic() > begin + START_LIMIT:
                raise RuntimeError(f"the arm was not carried: {[line for _, line in log[-10:]]}")
        start = min(when for when, _ in matching(log, carried)) - begin if kind in OURS else math.nan
        time.sleep(SETTLING)
        window, cpu = _measure(pids, seconds)
        if (dead := launcher.dead()) or (let_down := matching(log, "letting down")):
            raise RuntimeError(f"the arm was not carried to the end: {dead[0] if dead else let_down[0][1]}")
        stack.close()
        if any(listener.wait() for listener in listeners):
            raise RuntimeError("the listener lost frames: the machine is too busy to measure anything")
        timings = []
        for arm, recording in zip(arms, recordings, strict=True):
            with np.load(recording) as frames:
                cycles = split_cycles(dict(frames), arm.motors, *window)
            timings.append(analyse(cycles, arm.motors, arm.law, 1.0 / rate))
        return LoopRun(timings, cpu, start)


def matching(log: list[tuple[float, str]], expression: str) -> list[tuple[float, str]]:
    """Return the lines in which a regular expression is found."""
    return [(when, line) for when, line in log if re.search(expression, line)]


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


# The rows

Turn = dict[str, LoopRun]  # a run of each kind that carried the arm
Figure = Callable[[LoopRun], float]
Progress = Callable[[str], None]


def measure_loops(quick: bool, progress: Progress) -> Iterator[Row]:
    """Yield the rows of every rate, then of the start."""
    starts: list[float] = []
    for arms, file, rate in QUICK_RATES if quick else RATES:
        name, turns = f"loop, {arms}, {rate} Hz", []
        for number in range(1 if quick else TURNS):
            progress(f"{name}, turn {number + 1}")
            turns.append(run_turn(rate, file, QUICK_SECONDS if quick else SECONDS, progress))
        yield from rows_of(name, rate, turns, "nodes")
        yield from rows_of(f"{name}, one process", rate, turns, "one process")
        starts += [turn["nodes"].start for turn in turns if "nodes" in turn]
    if starts:
        least = START_GATE.calm + GUIDANCE.time + GUIDANCE.watch
        what = "start, launch to active: the checks and the begin of the torque"
        yield Row.of_values(what, starts, [least] * len(starts), "s")


def run_turn(rate: int, file: str, seconds: float, progress: Progress) -> Turn:
    """Run every kind of loop once; one that does not carry the arm is left out."""
    turn: Turn = {}
    for kind in KINDS:
        try:
            turn[kind] = run_loop(kind, rate, file, seconds)
        except RuntimeError as error:
            progress(f"  {kind}: {error}")
    return turn


def rows_of(name: str, rate: int, turns: Sequence[Turn], kind: str) -> Iterator[Row]:
    """Yield the table's rows of the loop `name` at `rate` (Hz): runs of `kind` next to those of its peers."""
    allowed = 1.0 if rate == 1000 else 0.1  # % of the cycles
    ran = [turn for turn in turns if kind in turn]
    if not ran:
        yield Row(f"{name}, missed (it did not run): limit", 100.0, allowed, "%")
        return

    def limited(what: str, figure: Figure, limit: float, unit: str) -> Row:
        return Row.of_values(f"{name}, {what}", [figure(turn[kind]) for turn in ran], [limit] * len(ran), unit)

    def compared(what: str, figure: Figure, unit: str, of: str, theirs: Figure | None = None) -> Iterator[Row]:
        both = [turn for turn in ran if of in turn]
        if both:
            peer = [(theirs or figure)(turn[of]) for turn in both]
            yield Row.of_values(f"{name}, {what}", [figure(turn[kind]) for turn in both], peer, unit)

    peers = OTHERS | ({"nodes": "two processes"} if kind == "one process" else {})
    for share in (50, 99, 99.9):
        for of, peer in peers.items():
            yield from compared(f"p{share:g}: {peer}", shared("latency", share), "ms", of)
    yield limited("p99: one period", shared("latency", 99), 1e3 / rate, "ms")
    for share in (99, 99.9):
        yield limited(f"spacing p{share:g}: one period", shared("spacing", share), 1e3 / rate, "ms")
    for what in ("missed", "late", "incomplete", "lost"):
        yield limited(f"{what}: limit", percent(what), allowed, "%")
        for of, peer in peers.items():
            yield from compared(f"{what}: {peer}", percent(what), "%", of)
    bridge = ("bridge", "compensator") if kind == "one process" else ("bridge",)
    counterparts = {"can_bridge": bridge, "compensator": ("compensator",)}
    for node in sorted({full_name.rpartition("/")[2] for full_name in ran[0][kind].cpu}):
        if node in counterparts:
            theirs = cpu(*counterparts[node])
            yield from compared(f"CPU of {node}: bare rclpy", cpu(node), "%", "rclpy", theirs)
        else:
            yield limited(f"CPU of {node}: a core", cpu(node), 100.0, "%")


def shared(what: str, share: float) -> Figure:
    """Return the figure: the percentile of the latency or the spacing in ms over all arms."""
    return lambda run: percentile(np.concatenate([getattr(arm, what) for arm in run.arms]), share) * 1e3


def percent(what: str) -> Figure:
    """Return the figure: the share of the cycles in percent that were `what`: missed, late, incomplete or lost."""
    return lambda run: float(np.mean([100.0 * getattr(arm, what) / arm.cycles for arm in run.arms]))


def cpu(*parts: str) -> Figure:
    """Return the figure: percent of a core of the processes with these names, of one arm or two."""
    return lambda run: 100.0 * sum(share for name, share in run.cpu.items() if name.rpartition("/")[2] in parts)
