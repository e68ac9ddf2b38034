# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""trial --offline: the simulated arms of a parameter file perform a script without ROS, faster than real time.

It is the only tool that imports `sim`: without ROS it cannot start the simulator as a node.
"""

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import yaml
from rich.console import Console
from rich.progress import Progress, TaskID

from exo_gravity.core.errors import ParameterError, named
from exo_gravity.hardware.trunk_estimator import VQF, ImuSample, TrunkEstimator
from exo_gravity.lab.bag.simulated import write_recordings
from exo_gravity.lab.inputs.arms import node_values, read_arm
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.lab.trial.offline import ArmSetup, OfflineTrial
from exo_gravity.lab.trial.run import Trial, TrialEnd
from exo_gravity.sim.imu import ImuConfig, SimulatedImu, measured_tilt
from exo_gravity.sim.params import device_of, imu_of, set_faults, simulator_table
from exo_gravity.sim.script import TRUNK_ACTIONS, TrialScript
from exo_gravity.sim.trunk_motion import TrunkState
from exo_gravity.sim.virtual_arm import TrunkReading, TrunkSensor, resting


def simulated_trials(params: Path, script: TrialScript) -> list[OfflineTrial]:
    """Return a trial of each simulated arm of a parameter file.

    Raises ParameterError that names the node and the parameter.
    """
    nodes = load(params)
    found = [node for node in nodes if node.endswith("/simulator")]
    simulators = {node: node_values(nodes, node, simulator_table(nodes[node])) for node in found}
    if not simulators:
        raise ParameterError("params", str(params), "a file with a simulator: --offline runs the simulated device only")
    with_imu = next((values for values in simulators.values() if values["imu.topic"] and "/imu" in nodes), None)
    rotation = nodes.get("/imu", {}).get("rotation_trunk_from_imu", [])
    moves = any(step.action in TRUNK_ACTIONS for step in script.steps)
    trials: list[OfflineTrial] = []
    trunk: TrunkSensor | None = None
    if with_imu and not moves:
        with named("/imu "):
            true = with_imu["trunk.pitch"], with_imu["trunk.roll"]
            trunk = resting(*measured_tilt(*true, SimulatedImu(imu_of(with_imu)), rotation))
    for node, simulator in simulators.items():
        arm = read_arm(nodes, node.removesuffix("/simulator"))
        with named(f"{node} "):
            device = device_of(simulator)
            set_faults(device, simulator)
        rate = arm.can_bridge["rate"]
        if with_imu and moves:
            trunk = trunk_imu(imu_of(with_imu), rotation, rate)
        setup = ArmSetup(arm.name, device, arm.motors, arm.limits, arm.settings, rate, trunk)
        trials.append(OfflineTrial(setup, script, simulator["trial_delay"]))
    return trials


def record_offline(trial: Trial, console: Console, should_stop: Callable[[], bool]) -> TrialEnd:
    """Prepare and run a trial on the simulated arms of its parameter file, and record it in the folder `bag`.

    Raises ParameterError for a wrong parameter, DataError if nothing was recorded or it cannot be written.
    """
    assert trial.params is not None, "arms that are carried already are not simulated here"
    simulated = simulated_trials(trial.params, trial.script)
    nodes = load(trial.prepare(with_recorder=False))
    recordings = []
    for one in simulated:
        name = one.arm.name
        with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
            task = progress.add_task(name, total=one.script.duration)

            def on_second(now: float, progress: Progress = progress, task: TaskID = task) -> bool:
                progress.update(task, completed=now)
                return should_stop()

            begin = time.perf_counter()
            recordings.append(one.run(on_second))
            taken = time.perf_counter() - begin
        length = float(recordings[-1].time[-1])
        console.print(
            f"{one.arm.name}: {length:.0f} s simulated in {taken:.1f} s, {length / taken:.0f} times real time"
        )
    events = sorted((event for one in simulated for event in one.events), key=lambda event: event.time)
    texts = {
        node: yaml.safe_dump({node: {"ros__parameters": values}}, default_flow_style=None, width=120)
        for node, values in nodes.items()
    }
    write_recordings(trial.folder / "bag", recordings, events, texts, trial.session)
    trouble = next((one.trouble for one in simulated if one.trouble), "")
    return TrialEnd(trouble, int(bool(trouble)))


def trunk_imu(config: ImuConfig, rotation_trunk_from_imu: Sequence[float], cycle_rate: float) -> TrunkSensor:
    """Return the simulated IMU `config`, and the estimator that follows it, in every n-th of `cycle_rate` cycles per s.

    rotation_trunk_from_imu: the mounting that the controller assumes. Raises ParameterError.
    """
    if VQF is None:
        raise ParameterError("vqf", None, "installed (extra imu) for a trial in which the trunk moves")
    cycles = max(1, round(cycle_rate / config.rate))
    rate = cycle_rate / cycles
    imu = SimulatedImu(replace(config, rate=rate))
    estimator = TrunkEstimator(rotation_trunk_from_imu, rate, config.gyroscope_range, config.accelerometer_range)
    due = itertools.cycle((True, *[False] * (cycles - 1)))

    def measure(now: float, state: TrunkState) -> TrunkReading | None:
        if not next(due):
            return None
        angular_velocity, acceleration = imu.sample(state)
        try:
            answer = estimator.update(ImuSample(now, angular_velocity.tolist(), acceleration.tolist()))
        except ParameterError:  # refused samples are not published
            return None
        if answer is None:
            return None
        force, turning = estimator.rotation @ acceleration, estimator.rotation @ angular_velocity
        return TrunkReading(answer.gravity.tolist(), force.tolist(), turning.tolist())

    return measure
