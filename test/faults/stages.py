"""The stages on which faults are played: which nodes run, in which processes, and who commands."""

import math
import subprocess
import sys
import time
from pathlib import Path

import yaml
from builtin_interfaces.msg import Time
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.tools.inputs.parameter_file import load

from ..faults.stage import CONFIG, GENTLE, SEATED, Listener, Stack, Watcher

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
HORIZONTAL = {"name": "horizontal", "steps": [{"move": [0.0, 1.5, 0.0, 0.3], "over": 2.0}, {"hold": 600.0}]}

UPRIGHT = {"trunk": {"pitch": 0.0, "roll": 0.0}}


class Stage:
    """Nodes that carry the arm in a horizontal pose, seen from outside. Ended with `close`.

    punctual: whether they have the time-outs that they are shipped with, or patience with a busy machine.
    """

    rate = 250.0

    def __init__(self, folder, punctual=True):
        self.folder, self.punctual = Path(folder), punctual
        self.pose = self.folder / "horizontal.yaml"
        self.pose.write_text(yaml.safe_dump(HORIZONTAL))
        self.watcher = Watcher()
        self.stacks = self._stacks()
        self.listener = Listener(self.stacks[0].bus)
        for stack in self.stacks:
            stack.start()

    def _stacks(self):
        return [self._stack(can_bridge=GENTLE)]

    def _stack(self, **changes):
        return Stack(self.folder, punctual=self.punctual, **changes)

    def carry(self):
        """Bring the arm to the pose, from whatever the last fault left. On a busy machine it may take a second try."""
        watcher = self.watcher
        watcher.until(lambda: watcher.joints and watcher.efforts)
        while not self._carried():
            watcher.until(lambda: watcher.said("can_bridge", "fault:"))

    def _carried(self):
        watcher = self.watcher
        watcher.bring_to(self.pose)
        self.listener.frames.clear()
        seen = len(watcher.joints)
        watcher.until(lambda: len(watcher.joints) > seen + self.rate / 4)
        return watcher.said("can_bridge", "active")

    def process(self, node):
        """Return the process of a node by the last part of its name."""
        stacks = [stack for stack in self.stacks if any(n.endswith(node) for n in load(stack.path))]
        return stacks[0].launcher.process("/imu" if node == "imu" else f"/right/{node}")

    @property
    def over(self):
        """Whether the nodes have ended."""
        return self.stacks[0].over

    @property
    def log(self):
        return [line for stack in self.stacks for line in stack.log]

    def close(self):
        for stack in self.stacks:
            stack.stop()
        self.listener.close()
        self.watcher.close()


class Split(Stage):
    """The compensator under a launcher of its own: its end does not end the rest."""

    def _stacks(self):
        rest = self._stack(without=("compensator", "imu"), can_bridge=GENTLE, simulator=UPRIGHT)
        return [rest, self._stack(without=("can_bridge", "simulator", "imu"), port=rest.bus["port"], **SEATED)]


class Commanded(Stage):
    """This process commands the arm, at 100 Hz, perhaps nonsense: `spoil` changes each message before it leaves."""

    rate = 100.0

    def __init__(self, *given):
        super().__init__(*given)
        self.spoil = lambda message: None
        node = self.watcher.node
        parameters = load(CONFIG / "sim.yaml")["/right/compensator"]
        self._arm = ArmModel(*(parameters[name] for name in ("link_length", "robot.cog", "robot.mass")))
        self._publisher = node.create_publisher(JointState, "/right/effort_commands", 1)
        node.create_subscription(JointState, "/right/joint_states", self._answer, NEWEST)
        self.watcher.executor.wake()

    def _stacks(self):
        bridge = GENTLE | {"rate": self.rate}
        return [self._stack(without=("compensator", "imu"), can_bridge=bridge, simulator=UPRIGHT)]

    def _answer(self, state):
        message = JointState(header=state.header, name=state.name)
        message.effort = gravity_torque(self._arm, state.position).tolist()
        self.spoil(message)
        self._publisher.publish(message)

    def carry(self):
        self.spoil = lambda message: None
        super().carry()


class OtherClock(Stage):
    """The bridge's and the compensator's clock is ours: /clock, which goes wherever we set it."""

    def __init__(self, *given):
        super().__init__(*given)
        self.shift = 0.0
        self._publisher = self.watcher.node.create_publisher(Clock, "/clock", 10)
        self.watcher.node.create_timer(0.002, self._tick)
        self.watcher.executor.wake()

    def _stacks(self):
        clock = {"use_sim_time": True}
        changes = {"compensator": clock | {"use_imu": False}, "can_bridge": clock | GENTLE, "simulator": UPRIGHT}
        return [self._stack(without=("imu",), **changes)]

    def _tick(self):
        fraction, seconds = math.modf(time.time() + self.shift)
        self._publisher.publish(Clock(clock=Time(sec=int(seconds), nanosec=int(fraction * 1e9))))


class Launched(Stage):
    """The launcher is a process of its own."""

    def _stacks(self):
        return [_Process(self._stack(can_bridge=GENTLE))]


class _Process:
    """A launcher's process, with what the stages want of a stack."""

    def __init__(self, stack):
        self.bus, self.path, self.log = stack.bus, stack.path, []

    def start(self):
        command = [str(Path(sys.executable).with_name("launcher")), "--params", str(self.path)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    @property
    def over(self):
        return self.process.poll() is not None

    def stop(self):
        self.process.terminate()
        self.log += self.process.communicate(timeout=60)[0].splitlines()
