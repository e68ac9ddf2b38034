# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""can_bridge and compensator in one process: answers without a message, all else as between two processes."""

from __future__ import annotations

import signal
import time
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.nodes.can_bridge.effort_exchange import EffortExchange
from exo_gravity.nodes.compensator.node import CompensatorNode
from exo_gravity.nodes.ros.messages import to_nanoseconds

from ..hardware.arms import LIMITS, raised_arm
from ..support import CONFIG
from ..support.launched_nodes import CALM, NO_IMU
from ..support.truth import Truth
from ..support.waiting import wait_until

PARAMETERS = load(CONFIG / "sim.yaml")["/right/compensator"]
ROBOT = ArmModel(*(PARAMETERS[name] for name in ("link_length", "robot.cog", "robot.mass")))
NAMES = PARAMETERS["joint_names"]
POSE = (0.1, 0.7, 0.6, 0.5)  # rad
NO_EFFORT = (0.0,) * 4


class Bridge:
    """can_bridge's end, with a compensator that answers with `efforts`, published too; None: it does not answer."""

    def __init__(self, node, limits):
        self.efforts, self.answered, self.trips = (0.0, 1.0, 2.0, 3.0), [], []
        self.loop = SimpleNamespace(
            safety=SimpleNamespace(state=State.ACTIVE), trip=lambda code, reason: self.trips.append(code)
        )
        self._names = list(limits.joint_names)
        self.publisher = node.create_publisher(JointState, "effort_commands", 1)
        self.exchange = EffortExchange(node, limits, lambda: self.loop, self._answer)
        wait_until(lambda: self.publisher.get_subscription_count() == 1)

    def _answer(self, message):
        self.answered.append(message)
        if self.efforts is None:
            return None
        answer = JointState(header=message.header, name=self._names, effort=self.efforts)
        self.publisher.publish(answer)
        return answer

    def cycle(self, now=100.0):
        """Publish a joint state; return the efforts that are there before the topic is looked at, and after."""
        self.exchange.take(now, [JointSample(0.5, 0.0, 0.0, 40, 0, now)] * 4)
        return self.exchange.newest, self.exchange.efforts(time.monotonic())


def test_efforts_are_there_at_once_are_not_taken_again_from_the_topic_and_another_publisher_is_noticed(node):
    bridge = Bridge(node, Limits(tuple(NAMES)))
    command, later = bridge.cycle(100.0)
    assert (tuple(command.effort), command.answered) == ((0.0, 1.0, 2.0, 3.0), 100.0) and later is command
    bridge.efforts = None
    for now in (100.004, 100.008, 100.012):  # the first answer has arrived by its topic meanwhile
        time.sleep(0.02)
        assert bridge.cycle(now) == (command, command) and bridge.exchange.newest is command
    assert [list(message.position) for message in bridge.answered] == [[0.5] * 4] * 4
    assert not bridge.trips and not bridge.exchange.refusal
    other = node.create_publisher(JointState, "effort_commands", 1)
    wait_until(lambda: other.get_subscription_count() == 1)
    other.publish(JointState(name=NAMES, effort=NO_EFFORT))
    wait_until(lambda: bridge.trips, bridge.cycle)
    assert bridge.trips[0] == "second_commander" and bridge.exchange.refusal.word == "second_publisher"


@pytest.mark.parametrize("failure", ["answers no more", "raises"])
def test_an_arm_whose_compensator_has_failed_is_let_down_as_one_whose_compensator_has_died(node, failure):
    torque, arm = [], None

    def answer(message):
        if torque[-1] is None:
            if failure == "raises":
                raise ZeroDivisionError
            return None
        return JointState(header=message.header, name=message.name, effort=torque[-1])

    exchange = EffortExchange(node, LIMITS, lambda: arm and arm.loop, answer)
    arm = raised_arm()
    torque.append(arm.notes.drive.effort)
    exchange.take(arm.clock.monotonic(), arm.loop.samples)
    arm.loop.controller = exchange
    arm.run(1.0)
    assert arm.safety.state is State.ACTIVE
    torque.append(None)
    arm.run(0.3)
    assert arm.safety.fault.code == "command_stale"
    arm.assert_let_down()
    assert arm.loop.failure is None


@pytest.fixture
def compensator():
    """A function that starts a compensator whose `answer` the test calls, with parameters in ROS's own form."""
    nodes, context = [], rclpy.Context()

    def start(*parameters):
        given = [word for parameter in ("use_imu:=false", *parameters) for word in ("-p", parameter)]
        params = ("--params-file", str(CONFIG / "sim.yaml"))
        rclpy.init(args=["--ros-args", "-r", "__ns:=/right", *params, *given], context=context)
        nodes.append(CompensatorNode(context))
        return nodes[-1]

    yield start
    for node in nodes:
        node.close()
        node.destroy_node()
    rclpy.try_shutdown(context=context)


def states():
    return JointState(name=NAMES, position=POSE, velocity=NO_EFFORT, effort=NO_EFFORT)


def settled(node):
    """Return the answer once the torque has ramped in."""
    wait_until(lambda: np.abs(np.subtract(node.answer(states()).effort, gravity_torque(ROBOT, POSE))).max() < 1e-9)
    return node.answer(states())


def test_the_compensator_answers_with_what_gravity_needs_publishes_it_and_withdraws_it_for_two_publishers(
    compensator, node
):
    received, running = [], compensator()
    node.create_subscription(JointState, "effort_commands", received.append, 10)
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    assert settled(running).name == NAMES

    def is_received():
        answer = running.answer(states())  # the first ones may precede the discovery of this subscription
        return received and received[-1] == answer

    wait_until(is_received, lambda: executor.spin_once(0.01))
    bridge, other = (node.create_publisher(JointState, "joint_states", 1) for _ in range(2))
    wait_until(lambda: other.get_subscription_count() == bridge.get_subscription_count() == 1)

    def cycle():
        bridge.publish(states())
        return running.answer(states())

    for _ in range(20):
        assert cycle().effort
    # One message of the other may be lost between two of ours: the middleware keeps few.
    wait_until(lambda: other.publish(states()) or not cycle().effort)


def test_an_exception_of_the_step_ends_the_answers_for_good_and_is_kept(compensator, monkeypatch):
    running = compensator()
    settled(running)
    with monkeypatch.context() as patched:
        patched.setattr(Compensator, "step", lambda *_: 1 / 0)
        assert running.answer(states()) is None
    assert running.answer(states()) is None and isinstance(running.failure, ZeroDivisionError)


def test_efforts_for_an_effort_controller_are_refused(compensator):
    with pytest.raises(ParameterError, match="command_interface = 'multi_array': must be joint_state in one process"):
        compensator("command_interface:=multi_array")


@pytest.mark.thorough
@pytest.mark.real_time
def test_both_nodes_run_under_their_own_names_carry_the_arm_and_let_it_down(launch, probe):
    nodes = launch(without=("imu",), timing=CALM, truth=True, compensator=NO_IMU, one_process=True)
    probe.wait_until_carried()
    assert nodes.pid("compensator") == nodes.pid("can_bridge")
    probe.wait_until(lambda: probe.status_contains("compensator", "compensating"))
    both = ("/right/can_bridge", "/right/compensator")
    dumped, given = probe.dump_parameters(both), load(nodes.path)
    assert [dumped[node]["ros__parameters"]["joint_names"] for node in both] == [NAMES, NAMES]
    assert dumped[both[1]]["ros__parameters"]["link_length"] == given[both[1]]["link_length"]
    assert probe.set_parameters("compensator", gain=[1.0, 1.05, 1.0, 1.0]).successful
    published = [probe.joint_states.copy(), probe.effort_commands.copy()]
    asked, answered = ({to_nanoseconds(each.header.stamp) for each in messages} for messages in published)
    assert len(asked & answered) > 10  # both topics are published
    assert any(line.startswith("/right/compensator: INFO compensating") for line in nodes.log)
    nodes.process("can_bridge").send_signal(signal.SIGINT)
    probe.wait_until(lambda: nodes.have_ended)
    assert nodes.ended_node == ("/right/can_bridge", 0)
    assert Truth(nodes.truth_path()).motors_are_off()
