# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The fault matrix on processes: the rows whose subject is a process, a signal, a lock, DDS or a watchdog.

The simulated device has its own launcher: it outlives the other nodes, so that the judge sees the arm after its motors
were switched off.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml
from geometry_msgs.msg import Quaternion, Vector3, Vector3Stamped
from sensor_msgs.msg import Imu, JointState

from exo_gravity.core.motors.joint_motor import JointMotor, motors_of
from exo_gravity.core.safety.limits import CAN_BRIDGE
from exo_gravity.hardware.clock import raise_priority
from exo_gravity.lab.inputs.arms import node_values
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.sim.judge import MAX_SPEED, measure

from ..support import CONFIG
from ..support.launched_nodes import REAL, LaunchedNodes, children, executable, full_name
from ..support.ros_probe import RosProbe
from ..support.truth import Truth
from .fault_case import BEFORE, PROCESS_REACTION, RECOVERY, Arm, FaultCase, Parameters, acting, in_turn, pause
from .virtual_cases import ON_V3, SEVEN, Steps

NEAR = 0.15  # rad from the pose, in which the arm need not be moved again
CARRY_LIMIT = 60.0  # s for the nodes to start and bring the arm to a stage
START_LIMIT = 20.0  # s for a process that must refuse to run
HELD = ("active",)
BOTH = Arm("sim_both.yaml", rate=100.0)  # faults strike the right arm
BY_LAUNCHER = Arm()  # its launcher is a process, as for users, which starts a simulation that died again
KILL, STOP, CONTINUE, HANG_UP = signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT, signal.SIGHUP


class LauncherProcess(LaunchedNodes):
    """The same, but the launcher is a process too, as for users."""

    def start(self) -> LauncherProcess:
        self.launcher_process = subprocess.Popen(
            [executable("launcher"), "--params", str(self.path), "--only", *self.names],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        return self

    def _read(self) -> None:
        for line in self.launcher_process.stdout or ():
            self.log.append(line.rstrip())

    @property
    def have_ended(self) -> bool:
        return self.launcher_process.poll() is not None

    def pid(self, node: str) -> int:
        """Return the ID of a node's process, which must run."""
        space, _, name = full_name(node).rpartition("/")
        for child in children(self.launcher_process.pid):
            words = Path(f"/proc/{child}/cmdline").read_bytes().decode().split("\0")
            if {f"__node:={name}", f"__ns:={space or '/'}"} <= set(words):
                return child
        raise LookupError(f"{node} does not run")

    def stop(self) -> None:
        self.launcher_process.terminate()
        try:
            self.launcher_process.wait(60)
        except subprocess.TimeoutExpired:
            self.launcher_process.kill()
            raise
        if self._thread is not None:
            self._thread.join(60)
        self._end_watchdogs()


class ProcessRig:
    """Nodes as processes that carry an arm, with a probe and the arm's true motion. End it with `close`.

    timing: rates and time-outs by node. left: probe and true motion of the left arm, where there is one.
    """

    timing: ClassVar[Mapping[str, Parameters]] = REAL
    run = staticmethod(time.sleep)

    def __init__(self, arm: Arm, folder: Path) -> None:
        raise_priority(5)  # what the probe receives is in time
        self.arm, self.folder = arm, folder
        self.script = self.write_script("pose", [{"move": list(arm.pose), "over": 1.0}, {"hold": 600.0}])
        home = [0.0, *[0.05] * (len(arm.pose) - 1)]
        self.probe = RosProbe()
        self.probe.home_script = self.write_script("home", [{"move": home, "over": over} for over in (2.0, 20.0)])
        kind = LauncherProcess if arm is BY_LAUNCHER else LaunchedNodes
        make = partial(kind, folder, arm.base, timing=self.timing)
        without = ("can_bridge", "compensator", "imu", "recorder")
        self.device = make(without=without, truth=True, simulator=arm.simulator)
        changes: dict[str, Any] = {"can_bridge": {**arm.can_bridge, "rate": arm.rate}, "compensator": arm.compensator}
        self.nodes = make(without=("simulator",), port=self.device.bus["port"], **changes)
        self.truth, self.left = Truth(self.device.truth_path(), len(arm.pose)), None
        if "/left/can_bridge" in load(self.nodes.path):
            self.left = RosProbe("/left"), Truth(self.device.truth_path("/left/simulator"))
        self.second: subprocess.CompletedProcess[str] | None = None  # the second bridge that was started last
        self._seen = 0  # lines of the log before the fault

    def start(self) -> None:
        """Start the nodes, the simulated device first."""
        self.device.start()
        self.nodes.start()

    @cached_property
    def joint_motors(self) -> tuple[JointMotor, ...]:
        """The motors of the configuration."""
        return motors_of(node_values(load(CONFIG / self.arm.base), "/right/can_bridge", CAN_BRIDGE))

    def write_script(self, name: str, steps: Steps) -> Path:
        """Write a trial script and return its path."""
        path = self.folder / f"{name}.yaml"
        path.write_text(yaml.safe_dump({"name": name, "steps": [*map(dict, steps)]}))
        return path

    def bring_to(self, stage: str) -> None:
        """Clear what the last fault left and bring the arm to `stage`: "active" or "letting down".

        Raises AssertionError after `CARRY_LIMIT`.
        """
        probe = self.probe
        if self.left is not None:
            self._carry(*self.left)
        with probe.time_limit(CARRY_LIMIT):
            probe.wait_until(lambda: self.have_ended or (probe.joint_states and probe.effort_commands))
            assert not self.have_ended, "nodes ended at the start"
            self._watchdog = children(self.pid("can_bridge"))[0]
        self._carry(probe, self.truth)
        if stage == "letting down":
            assert probe.enable(False).success
            probe.wait_until(lambda: abs(self._newest()["velocity"][self.arm.struck]) > 0.2)
        self._seen = len(self.nodes.log)

    def _carry(self, probe: RosProbe, truth: Truth) -> None:
        with probe.time_limit(CARRY_LIMIT):
            while not self.is_at_pose(probe, truth):
                probe.get_carried()
                probe.bring_to(self.script)
                probe.wait_for_report()

    def is_at_pose(self, probe: RosProbe, truth: Truth) -> bool:
        """Return whether the arm is carried in its pose."""
        newest = truth.newest()
        is_near = newest is not None and np.abs(newest["position"] - self.arm.pose).max() < NEAR
        return probe.state == "active" and bool(is_near)

    def _newest(self) -> np.ndarray:
        newest = self.truth.newest()
        assert newest is not None
        return newest

    def set(self, node: str, values: Parameters) -> None:
        """Set parameters of a node of the right arm together."""
        named = {name.replace(".", "__"): value for name, value in values.items()}
        result = self.probe.set_parameters(node, **named)
        assert result.successful, result.reason

    def pid(self, name: str) -> int:
        """Return the ID of a process: of a node, of `watchdog` or `launcher`."""
        if name == "watchdog":
            return self._watchdog
        if name == "launcher":
            assert isinstance(self.nodes, LauncherProcess)
            return self.nodes.launcher_process.pid
        return self.nodes.pid(name)

    @property
    def now(self) -> float:
        """The time in s on the clock of the truth."""
        return time.time()

    def run_until(self, condition: Callable[[], object], timeout: float) -> bool:
        """Wait until `condition()` holds; return whether it does within `timeout` s."""
        with contextlib.suppress(AssertionError):
            self.probe.wait_until(condition, timeout)
        return bool(condition())

    @property
    def state(self) -> str | None:
        """The state that the bridge reports."""
        return self.probe.state

    @property
    def outcome(self) -> str:
        """'stopped', the code of the latched fault, or the bridge's state."""
        if self.have_ended:
            return "stopped"
        return str(self.probe.fault if self.state == "fault" else self.state or "inactive")

    @property
    def have_ended(self) -> bool:
        """Whether a launcher has ended with its nodes, as it does when one of them ends."""
        return self.nodes.have_ended or self.device.have_ended

    def are_off(self) -> bool:
        """Return whether the motors are off; if the nodes have ended, those of both arms."""
        others = [self.left[1]] if self.left and self.have_ended else []
        return all(truth.motors_are_off() for truth in (self.truth, *others))

    def rests(self) -> bool:
        """Return False: a process may still do something."""
        return False

    def motion(self, since: float) -> np.ndarray:
        """Return the truth records since a time in s."""
        return self.truth.since(since)

    def trouble(self, since: float) -> list[str]:
        """Return what is unsafe whatever the motion of the struck arm was."""
        wrong = ["exception"] * any("Traceback" in line for line in self.nodes.log[self._seen :])
        wrong += ["empty log"] * (not self.nodes.log)
        if self.left is not None:
            left = self.left[1].since(since - BEFORE)
            response = measure(left, since, 1.0 / self.arm.rate) if len(left) else None
            wrong += ["left arm too fast"] * (response is None or response.top_speed > MAX_SPEED)
            wrong += ["torque step of the left arm"] * (response is not None and response.excess > 0.0)
        return wrong

    def close(self) -> None:
        with contextlib.ExitStack() as stack:  # each is done although another one fails; the last one first
            for probe in (self.probe, *(self.left or ())[:1]):
                stack.callback(probe.close)
            for nodes in (self.device, self.nodes):
                if nodes.has_started():
                    stack.callback(nodes.stop)


@acting
def send(rig: ProcessRig, number: int, *names: str) -> None:
    """Send a signal to processes."""
    for name in names:
        os.kill(rig.pid(name), number)


@acting
def publish(rig: ProcessRig, message_type: type, topic: str, make_message: Callable[[ProcessRig], Any]) -> float:
    """Publish the message for half a second, from a publisher that does not belong to the arm."""
    publisher = rig.probe.node.create_publisher(message_type, topic, 1)
    rig.probe.wait_until(lambda: publisher.get_subscription_count() > 0)
    start = time.time()
    for _ in range(50):  # a single message may be overwritten by the next regular one before it is read
        message = make_message(rig)
        if not message.header.stamp.sec:
            message.header.stamp = rig.probe.node.get_clock().now().to_msg()
        publisher.publish(message)
        time.sleep(0.01)
    rig.probe.node.destroy_publisher(publisher)
    return start


def states_at(rig: ProcessRig) -> JointState:
    """Return joint states at 1 rad, otherwise like the arm's newest."""
    newest = rig.probe.joint_states[-1]
    return JointState(header=newest.header, name=newest.name, position=[1.0] * len(newest.name))


@acting
def second_bridge(rig: ProcessRig, namespace: str) -> None:
    """Start another bridge on the same bus, and wait for its end; see `has_refused`."""
    content = yaml.safe_load(rig.nodes.path.read_text())["/right/can_bridge"]
    path = rig.folder / "second_bridge.yaml"
    path.write_text(yaml.safe_dump({f"{namespace}/can_bridge": content}))
    command = [executable("can_bridge"), "--ros-args", "-r", f"__ns:={namespace}", "--params-file", str(path)]
    rig.second = None
    with contextlib.suppress(subprocess.TimeoutExpired):
        rig.second = subprocess.run(command, capture_output=True, text=True, timeout=START_LIMIT)


def has_refused(rig: ProcessRig) -> None:
    """Check that the second bridge has refused to run, and has named the owner of the bus."""
    assert rig.second, "a second can_bridge ran on the same bus"
    said = rig.second.stdout + rig.second.stderr
    assert rig.second.returncode and "is held by" in said, f"a second can_bridge did not name the owner: {said[-200:]}"


def overload_processors(rig: ProcessRig) -> None:
    """Start four busy processes for each of two processors, for 3 s."""
    busy = [sys.executable, "-c", "while True: pass"]
    # In new sessions, and so in new autogroups, they do not run at the nodes' priority.
    processes = [subprocess.Popen(busy, start_new_session=True) for _ in range(8)]
    time.sleep(3.0)
    for process in processes:
        process.kill()
        process.wait()


KILL_BRIDGE = send(KILL, "can_bridge")
BOTH_OF_THEM = ("watchdog", "can_bridge")
# fmt: off
MESSAGES = (
    FaultCase("second publisher of joint states", publish(JointState, "/right/joint_states", states_at)),
    FaultCase("second publisher of the tilt",
        publish(Vector3Stamped, "/imu/pitch_yaw", lambda rig: Vector3Stamped(vector=Vector3(y=1.0)))),
    FaultCase("second publisher of the trunk's orientation",
        publish(Imu, "/imu/data", lambda rig: Imu(orientation=Quaternion(x=0.6, w=0.8)))),
    FaultCase("second publisher of efforts",
        publish(JointState, "/right/effort_commands", lambda rig: rig.probe.effort_commands[-1]),
        outcomes=("second_commander",)),
)
PROCESSES = (
    FaultCase("second can_bridge on the bus", second_bridge("/second"), limit=None, outcomes=HELD,
        afterwards=has_refused),
    FaultCase("processors overloaded", overload_processors, limit=None),
    FaultCase("imu frozen", send(STOP, "imu"), limit=PROCESS_REACTION, clear=send(CONTINUE, "imu")),
    FaultCase("compensator killed", send(KILL, "compensator"), limit=PROCESS_REACTION),
    FaultCase("can_bridge frozen", send(STOP, "can_bridge"), limit=PROCESS_REACTION),
    FaultCase("can_bridge terminated", send(signal.SIGTERM, "can_bridge"), limit=PROCESS_REACTION),
    FaultCase("can_bridge: SIGHUP", send(HANG_UP, "can_bridge"), limit=PROCESS_REACTION),
    FaultCase("launcher killed", send(KILL, "launcher"), BY_LAUNCHER, PROCESS_REACTION),
    FaultCase("launcher interrupted", send(signal.SIGINT, "launcher"), BY_LAUNCHER, PROCESS_REACTION),
    FaultCase("launcher's terminal closed", send(HANG_UP, "launcher"), BY_LAUNCHER, PROCESS_REACTION),
)
WATCHDOG = (
    FaultCase("watchdog frozen", send(STOP, "watchdog"), limit=0.6, clear=send(CONTINUE, "watchdog"),
        outcomes=("watchdog_dead",), ends_rig=True),
    FaultCase("watchdog killed", send(KILL, "watchdog"), limit=PROCESS_REACTION, outcomes=("watchdog_dead",),
        ends_rig=True),
    FaultCase("can_bridge and watchdog frozen for 1 s",
        in_turn(send(STOP, *BOTH_OF_THEM), pause(1.0), send(CONTINUE, *BOTH_OF_THEM)),
        limit=1.0 + PROCESS_REACTION, ends_rig=True),
    FaultCase("can_bridge and watchdog killed", send(KILL, *BOTH_OF_THEM), limit=RECOVERY),
    FaultCase("can_bridge killed", KILL_BRIDGE, limit=PROCESS_REACTION),
    FaultCase("can_bridge killed while let down", KILL_BRIDGE, limit=PROCESS_REACTION, stage="letting down"),
    FaultCase("can_bridge killed and started again at once", in_turn(KILL_BRIDGE, second_bridge("/right")),
        limit=PROCESS_REACTION, afterwards=has_refused),
    FaultCase("can_bridge killed, its watchdog frozen for 1 s",
        in_turn(send(STOP, "watchdog"), KILL_BRIDGE, pause(1.0), send(CONTINUE, "watchdog")),
        limit=1.0 + PROCESS_REACTION),
    FaultCase("can_bridge killed, the launcher frozen", in_turn(send(STOP, "launcher"), KILL_BRIDGE), BY_LAUNCHER,
        PROCESS_REACTION, clear=send(CONTINUE, "launcher"), ends_rig=True),
    FaultCase("can_bridge of the right of two arms killed", KILL_BRIDGE, BOTH, PROCESS_REACTION),
    FaultCase("V3 boards: can_bridge killed", KILL_BRIDGE, ON_V3, PROCESS_REACTION),
    FaultCase("seven Damiao joints: can_bridge killed", KILL_BRIDGE, SEVEN, PROCESS_REACTION),
)
# fmt: on
CASES = (*MESSAGES, *PROCESSES, *WATCHDOG)
