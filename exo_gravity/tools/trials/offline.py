"""trial --offline: the simulated arms of a parameter file carry out a script without ROS, faster than real time.

Of all tools this one alone imports `sim`: without ROS there are no nodes to start by their names.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import yaml
from rich.console import Console
from rich.progress import Progress

from exo_gravity.bag.content import Bag, Event
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.recording import Recording
from exo_gravity.core.trial_script import TrialScript
from exo_gravity.sim.device_params import SIMULATOR, device_of, imu_of, set_faults
from exo_gravity.sim.imu import SimulatedImu, measured_tilt
from exo_gravity.sim.offline import ArmSetup, OfflineTrial
from exo_gravity.tools.inputs.arms import named, node_values, read_arm
from exo_gravity.tools.inputs.parameter_file import Nodes, load


def simulated_trials(params: Path, script: TrialScript) -> list[OfflineTrial]:
    """Return a trial of each simulated arm of a parameter file, ready to run.

    Raises ParameterError that names the node and the parameter.
    """
    nodes = load(params)
    spaces = [node.removesuffix("/simulator") for node in nodes if node.endswith("/simulator")]
    if not spaces:
        raise ParameterError("params", str(params), "a file with a simulator: --offline is for the simulated device")
    tilt = _tilt(nodes, spaces)
    return [_trial(nodes, space, script, tilt) for space in spaces]


def run_offline(
    trials: Sequence[OfflineTrial], params: Path, console: Console, should_stop: Callable[[], bool]
) -> tuple[Bag, str]:
    """Return what a recording of the trials would hold, and what went wrong, or ''; params: file in their folder.

    Raises DataError where nothing moved.
    """
    start = time.time_ns()
    recordings = tuple(_played(trial, console, should_stop) for trial in trials)
    events = sorted(Event(*event) for trial in trials for event in trial.events)
    texts = {
        node: yaml.safe_dump({node: {"ros__parameters": values}}, default_flow_style=None, width=120)
        for node, values in load(params).items()
    }
    notes = ("simulated offline: there is no recording beside this report",)
    troubles = (trial.trouble for trial in trials if trial.trouble)
    return Bag(params.parent, start, recordings, tuple(events), texts, notes, ()), next(troubles, "")


def _played(trial: OfflineTrial, console: Console, should_stop: Callable[[], bool]) -> Recording:
    name, script = trial.arm.name, trial.script
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(name, total=script.duration)

        def on_second(now: float) -> bool:
            pose = sum(step.action == "move" for step in script.steps[: (trial.step or 0) + 1])
            progress.update(task, completed=now, description=f"{name}: pose {pose} of {script.pose_count}")
            return should_stop()

        begin = time.perf_counter()
        recording = trial.run(on_second)
        taken = time.perf_counter() - begin
    length = float(recording.time[-1])
    console.print(f"{name}: {length:.0f} s simulated in {taken:.1f} s, {length / taken:.0f} times real time")
    return recording


def _trial(nodes: Nodes, namespace: str, script: TrialScript, tilt: tuple[float, float] | None) -> OfflineTrial:
    """Return the trial of the arm in `namespace`."""
    arm = read_arm(nodes, namespace)
    simulator = node_values(nodes, f"{namespace}/simulator", SIMULATOR)
    with named(f"{namespace}/simulator"):
        device = device_of(simulator)
        set_faults(device, simulator)
    setup = ArmSetup(arm.name, device, arm.motors, arm.limits, arm.settings(), arm.can_bridge["rate"], tilt)
    return OfflineTrial(setup, script, simulator["trial_delay"])


def _tilt(nodes: Nodes, spaces: list[str]) -> tuple[float, float] | None:
    """Return the trunk's pitch and roll (rad) as its IMU tells them, None without an IMU."""
    for space in spaces:
        simulator = node_values(nodes, f"{space}/simulator", SIMULATOR)
        if simulator["imu.topic"] and "/imu" in nodes:
            with named("/imu"):
                believed = nodes["/imu"].get("rotation_trunk_from_imu", [])
                trunk = simulator["trunk.pitch"], simulator["trunk.roll"]
                return measured_tilt(*trunk, SimulatedImu(imu_of(simulator)), believed)
    return None
