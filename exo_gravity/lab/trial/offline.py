# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A trial without ROS and in virtual time: a compensator carries the simulated device, as fast as possible.

The loop, the bus and the safety machine are those of `can_bridge` (sim/virtual_arm.py); the compensator answers the
samples of each cycle at once. Nothing is ever late: only a run in real time shows the delays and lost frames of a busy
computer. `trial --offline` is the only tool that imports `sim`: without ROS it cannot start the simulator as a node.
"""

import itertools
import json
import math
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.console import Console
from rich.progress import Progress, TaskID

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.tilt import pitch_roll
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import DataError, ParameterError, named
from exo_gravity.core.motors.joint_motor import JointMotor, JointSample
from exo_gravity.core.safety.command import CARRYING, Efforts, Fault, State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.vocabulary import NONE, TEXT, Source
from exo_gravity.hardware.trunk_estimator import VQF, ImuSample, TrunkEstimator
from exo_gravity.lab.bag import content
from exo_gravity.lab.bag.content import BRIDGE, JOINT_STATE, STRING, Event, NodeStatus, Session
from exo_gravity.lab.bag.storage import TYPES
from exo_gravity.lab.bag.writer import BagWriter, Message, offered_qos
from exo_gravity.lab.inputs.arms import node_values, read_arm
from exo_gravity.lab.inputs.parameter_file import load, node_of
from exo_gravity.lab.trial.analysis import ARRAYS, CARRIED, Recording, ScriptedStep, Span
from exo_gravity.lab.trial.run import GRACE, STOPPED, Trial
from exo_gravity.sim.controllers import DirectController
from exo_gravity.sim.device import SimulatedDevice, VirtualWearer
from exo_gravity.sim.params import device_of, imu_of, set_faults, simulator_table
from exo_gravity.sim.script import IDLE, TRUNK_ACTIONS, TrialScript
from exo_gravity.sim.trunk_motion import ImuConfig, SimulatedImu, TrunkState, measured_tilt
from exo_gravity.sim.virtual_arm import TrunkReading, TrunkSensor, VirtualArm, resting

NOT_OK = 2  # the level of an event, as diagnostic_msgs/DiagnosticStatus has it


@dataclass(frozen=True)
class ArmSetup:
    """One arm: `device` is the truth; motors, limits and settings are the controller's parameters."""

    name: str
    device: SimulatedDevice
    motors: Sequence[JointMotor]
    limits: Limits
    settings: Settings
    rate: float  #: control cycles per s
    trunk: TrunkSensor | None  #: None without an IMU


class OfflineTrial:
    """One arm, its controller, and a wearer who performs a script once, `delay` s after the motors are switched on.

    compensator: by default one with the arm's settings.
    wearer: by default one who performs the script. Raises ParameterError if the script is for another arm.

    events: everything that went wrong. trouble: why the trial ended before the script, or ''.
    """

    def __init__(
        self,
        arm: ArmSetup,
        script: TrialScript,
        delay: float,
        compensator: Compensator | None = None,
        wearer: VirtualWearer | None = None,
    ) -> None:
        script.check(len(arm.motors))
        self.arm, self.script, self.wearer = arm, script, wearer or VirtualWearer(script)
        self._no_effort = (math.nan,) * len(arm.motors)
        self.events: list[Event] = []
        self.trouble = ""
        self.compensator = compensator or Compensator(arm.settings, arm.limits.joint_names)
        self._controller = DirectController(self.compensator, arm.limits)
        self._delay = delay
        self._start = math.inf  # s, of the script
        self._carried: tuple[Span, ...] = ()  # from the first to the last time at which the motors carried the arm
        self._reason = ""  # why the compensator has withdrawn
        self._rows = array("d")
        self.trunk: list[tuple[float, TrunkReading]] = []  #: each reading that differs from the one before, and its s
        self._carrier = VirtualArm(arm.device, self, arm.motors, arm.limits, arm.rate)
        self.safety = self._carrier.safety
        if arm.settings.use_imu and arm.trunk:
            self._carrier.add_imu(self._read_trunk, self.compensator, 1.0 / arm.rate)

    def run(self, should_stop: Callable[[float], bool] = lambda now: False) -> Recording:
        """Run the script, let the arm down, and return what `recorder` would have recorded.

        should_stop(now) is called once per simulated second, `now` in s. Raises DataError if nothing was recorded.
        """
        carrier, safety = self._carrier, self.safety
        carrier.enable()
        second = 0.0
        while safety.state not in (State.DISABLED, State.FAULT):
            now = carrier.now
            carrier.loop.cycle()
            carrier.check_controller()
            if safety.state in CARRIED:
                self._carried = ((self._carried[0][0] if self._carried else now, now),)
            if now >= second:
                second += 1.0
                if should_stop(now) and not self.trouble:
                    self._abort(now, STOPPED)
            if self._start == math.inf and safety.state in CARRYING:  # the motors are on
                self.arm.device.start(self.wearer, self._delay)
                self._start = now + self._delay
            elif now > self._start + self.script.duration + GRACE:
                safety.disable(now)
        carrier.bus.stop()
        if safety.refusal:
            self._abort(now, f"the arm was never carried: {safety.refusal}")
        if safety.fault:
            self._abort(now, f"fault: {safety.fault.code}: {safety.fault.reason}", safety.fault)
        return self._recording()

    def efforts(self, latest: float) -> Efforts:
        """Return the compensator's newest efforts."""
        return self._controller.efforts(latest)

    def take(self, now: float, samples: Sequence[JointSample]) -> None:
        """Give the samples to the compensator, and record them with the efforts that they follow."""
        effort = self._controller.efforts(now).effort
        if not any(self.arm.limits.is_silent(now, sample) for sample in samples):
            position, velocity, measured, _, _, times, *_ = zip(*samples, strict=True)
            for values in ((min(times),), position, velocity, measured, effort or self._no_effort):
                self._rows.extend(values)
        self._controller.take(now, samples)
        reason = self._controller.answer.reason.text
        if reason and reason != self._reason:
            self._note(now, "compensator", f"withdrawn: {reason}", None)
        self._reason = reason

    def _read_trunk(self, now: float, state: TrunkState) -> TrunkReading | None:
        assert self.arm.trunk
        reading = self.arm.trunk(now, state)
        if reading and not (self.trunk and self.trunk[-1][1] is reading):
            self.trunk.append((now, reading))
        return reading

    def _abort(self, now: float, why: str, fault: Fault | None = None) -> None:
        why = f"{why} ({self._reason})" if self._reason else why
        self._note(now, BRIDGE, why, fault)
        self.trouble = self.trouble or f"{self.arm.name}: {why}"
        self.arm.device.start(VirtualWearer(IDLE))
        self.safety.disable(now)

    def _note(self, now: float, executable: str, message: str, fault: Fault | None) -> None:
        code, reason, _ = fault or (NONE, "", "")
        status = NodeStatus(node_of(self.arm.name, executable).lstrip("/"), NOT_OK, message, str(code), reason)
        self.events.append(Event(now, f"{status.node}: {message}", status=status))

    def _recording(self) -> Recording:
        table = np.array(self._rows).reshape(-1, 1 + len(ARRAYS) * len(self._no_effort))
        if len(table) < 2:
            raise DataError(self.trouble or f"{self.arm.name}: nothing was recorded")
        position, velocity, effort, command = np.split(table[:, 1:], len(ARRAYS), axis=1)
        steps = self.script.steps
        starts = itertools.accumulate((step.duration for step in steps), initial=self._start)
        end = float(table[-1, 0])
        script = tuple(
            ScriptedStep(step.action, start, min(start + step.duration, end))
            for step, start in zip(steps, starts, strict=False)
            if start < end
        )
        name, joint_names = self.arm.name, self.arm.limits.joint_names
        return Recording(name, joint_names, table[:, 0], position, velocity, effort, command, script, self._carried)


def simulated_trials(params: Path, script: TrialScript) -> list[OfflineTrial]:
    """Return a trial of each simulated arm of a parameter file.

    Raises ParameterError that names the node and the parameter.
    """
    nodes = load(params)
    simulators = {
        node: node_values(nodes, node, simulator_table(values))
        for node, values in nodes.items()
        if node.endswith("/simulator")
    }
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


def record_offline(trial: Trial, console: Console, should_stop: Callable[[], bool]) -> str:
    """Prepare and run a trial on the simulated arms of its parameter file, and record it in the folder `bag`.

    Returns '' or why one ended before its script. Raises ParameterError for a wrong parameter, DataError if nothing was
    recorded or it cannot be written.
    """
    assert trial.params is not None, "arms that are carried already are not simulated here"
    simulated = simulated_trials(trial.params, trial.script)
    nodes = load(trial.prepare(with_recorder=False))
    recordings = list[Recording]()
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        for one in simulated:
            if recordings and should_stop():
                break  # of an arm that is stopped at once nothing is recorded
            task = progress.add_task(one.arm.name, total=one.script.duration)

            def on_second(now: float, task: TaskID = task) -> bool:
                progress.update(task, completed=now)
                return should_stop()

            recordings.append(one.run(on_second))
    events = sorted((event for one in simulated for event in one.events), key=lambda event: event.time)
    texts = {
        node: yaml.safe_dump({node: {"ros__parameters": values}}, default_flow_style=None, width=120)
        for node, values in nodes.items()
    }
    trunk = next((one.trunk for one in simulated if one.trunk), [])  # both arms hang on one
    write_recordings(trial.folder / "bag", recordings, events, texts, trial.session, trunk)
    return next((one.trouble for one in simulated if one.trouble), "")


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


Unsent = tuple[str, float, str, tuple[Any, ...]]  # topic, s, type, and the message's fields after its header, if any


def write_recordings(
    path: Path,
    arms: Sequence[Recording],
    events: Iterable[Event],
    parameters: Mapping[str, str],
    session: Session,
    trunk: Iterable[tuple[float, TrunkReading]] = (),
) -> None:
    """Write simulated arms to a new recording `path`, as `recorder` writes real ones; time 0 is now.

    events: what went wrong.
    parameters: YAML text by node.
    trunk: what its IMU reads, each with its time in s.

    Raises DataError if it cannot be written.
    """
    start = time.time_ns()
    messages: list[Unsent] = [
        *((content.PARAMETERS, 0.0, STRING, (text,)) for text in parameters.values()),
        (content.SESSION, 0.0, STRING, (json.dumps(asdict(session)),)),
        *(
            _status(event.time, s.level, s.node, s.message, **{"fault": s.fault, f"fault{TEXT}": s.fault_text})
            for event in events
            if (s := event.status)
        ),
        *(message for arm in arms for message in _of_arm(arm)),
        *(message for now, reading in trunk for message in _of_trunk(now, reading)),
    ]
    messages.sort(key=lambda message: message[1])
    writer = BagWriter(path)
    for topic, kind in {topic: kind for topic, _, kind, _ in messages}.items():
        writer.add_topic(topic, kind, offered_qos(True, topic in (content.PARAMETERS, content.SESSION), 1))
    writer.write([_serialised(start, *message) for message in messages])
    writer.close()
    if writer.error:
        raise writer.error


def _of_arm(arm: Recording) -> Iterator[Unsent]:
    """Yield the states of an arm and its bridge, the commands, and the steps of the script."""
    carried = [(now, State.ACTIVE) for span in arm.carried or () for now in span]
    for now, state in (*carried, (float(arm.time[-1]), State.DISABLED)):
        yield _status(now, 0, f"{arm.name}/can_bridge", state.value, state=state.value, source=Source.SIMULATED.value)
    for index, step in enumerate(arm.steps):
        text = json.dumps({"step": index, "action": step.action, "duration": step.end - step.start})
        yield f"/{arm.name}/{content.STEPS}", step.start, STRING, (text,)
    names, none, last = list(arm.joint_names), np.empty(0), float(arm.time[0])
    measured = (np.asarray(column, float) for column in (arm.position, arm.velocity, arm.effort, arm.command))
    for now, position, velocity, effort, command in zip(arm.time.tolist(), *measured, strict=True):
        if now > last:  # the command in force answers the joint state before
            wanted = none if np.isnan(command).any() else command
            yield f"/{arm.name}/{content.COMMANDS}", last, JOINT_STATE, (names, none, none, wanted)
        yield f"/{arm.name}/{content.STATES}", now, JOINT_STATE, (names, position, velocity, effort)
        last = now


def _of_trunk(now: float, reading: TrunkReading) -> Iterator[Unsent]:
    """Yield what the node `imu` publishes of a reading: tilt and, in the trunk's axes, what its sensor measures."""
    made: dict[str, Any] = TYPES.types
    vector, none = made["geometry_msgs/msg/Vector3"], np.zeros(9)
    pitch, roll = pitch_roll(reading.gravity)
    felt = reading.specific_force or [-STANDARD_GRAVITY * x for x in reading.gravity]
    turning, at_rest = vector(*map(float, reading.angular_velocity)), made["geometry_msgs/msg/Quaternion"](0, 0, 0, 1)
    yield content.TILT_TOPIC, now, content.TILT_TYPE, (vector(roll, pitch, 0.0),)
    yield content.IMU, now, content.READ[content.IMU], (at_rest, none, turning, none, vector(*felt), none)


def _status(now: float, level: int, name: str, text: str, **values: str) -> Unsent:
    """Return the status of a node at `now` s."""
    pairs = [TYPES.types["diagnostic_msgs/msg/KeyValue"](*pair) for pair in values.items()]
    status = TYPES.types["diagnostic_msgs/msg/DiagnosticStatus"](level, name, text, "", pairs)
    return content.DIAGNOSTICS, now, content.READ[content.DIAGNOSTICS], ([status],)


def _serialised(start: int, topic: str, now: float, kind: str, fields: tuple[Any, ...]) -> Message:
    """Return a message of `now` s with its header. start: ns since 1970, of time 0."""
    made: dict[str, Any] = TYPES.types
    at = start + round(now * 1e9)
    if kind != STRING:
        stamp = made["builtin_interfaces/msg/Time"](*divmod(at, 10**9))
        fields = (made["std_msgs/msg/Header"](stamp, ""), *fields)
    return topic, at, bytes(TYPES.serialize_cdr(made[kind](*fields), kind))
