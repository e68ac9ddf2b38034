# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes `compensator` and `wearer` in this process, over real DDS.

Inputs, parameters, services and both kinds of output of the one; what the other estimates, asks for and warns of.
"""

import math
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.time import Time
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger

from exo_gravity.core import gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation import load_change
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import COMPENSATOR
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety import guidance
from exo_gravity.hardware.network import restrict_to_localhost
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.lab.inputs.arms import read_arm
from exo_gravity.lab.vocabulary import Budget
from exo_gravity.nodes.compensator import arm
from exo_gravity.nodes.compensator.node import CompensatorNode
from exo_gravity.nodes.ros import inner
from exo_gravity.nodes.ros.inner import NodeExecutor
from exo_gravity.nodes.ros.messages import to_nanoseconds
from exo_gravity.nodes.ros.subscriptions import LATCHED
from exo_gravity.nodes.wearer import BRIDGE_PARAMETERS, BudgetWatch, WearerNode

from ..support import CONFIG, PARTS, ROBOT
from ..support.chains import random_chain
from ..support.node_thread import NodeRig
from ..support.waiting import each_closed, pause, wait_until

restrict_to_localhost()
NAMES = [f"right_{part}" for part in PARTS]
POSE = (0.2, 0.9, 0.7, 0.6)  # rad
STILL = [0.0] * 4
GRAVITY = gravity_torque(ROBOT, POSE)
ASSIST = [0.5, -0.5, 0.25, 0.0]

ARMS = Path(__file__).parents[1] / "data" / "arms"
UR5 = [f"{part}_joint" for part in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]
UR5_POSE = (0.3, -0.8, 1.1, 0.4, -0.6, 0.2)
EXPECTED = UrdfArm((ARMS / "ur5.urdf").read_text(), UR5).torque(UR5_POSE, Tilt.of("left"))
WITH_URDF = {
    "law": "urdf",
    "joint_names": f"[{','.join(UR5)}]",
    "urdf.file": ARMS / "ur5.urdf",
    "use_imu": "false",
    "command_interface": "multi_array",
    "multi_array.timeout": 0.15,
    "max_effort": [200.0] * 6,
    "max_effort_rate": 1000.0,
    "side": "left",  # of the exoskeleton's own arm: ignored
}


class CompensatorRig(NodeRig):
    """The compensator in `namespace`, with `parameters` as in a parameter file, on its own thread once it is started.

    user: the node that plays its environment; waiting spins it. It publishes joint states of `names`, `pose`,
    `velocity` and `effort`, stamped `lag` s late, while `is_feeding`; and then calls `on_cycle` with their stamp.
    commands: (n,) Nm each, all so far. estimates: the wearer's torques and their deviations. is_stopped: whether no
    node is spun.
    """

    def __init__(
        self, namespace: str, parameters: Mapping[str, object], names: Sequence[str], pose: Sequence[float]
    ) -> None:
        lines = (f"{name}: {value}" for name, value in {"side": "right", **parameters}.items())
        with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
            file.write("\n    ".join((f"{namespace}/compensator:\n  ros__parameters:", *lines)) + "\n")
            file.flush()
            super().__init__("-r", f"__ns:={namespace}", "--params-file", file.name)
        self.names, self.pose = list(names), list(pose)
        self.velocity, self.effort = [0.0] * len(self.names), [0.0] * len(self.names)
        self.lag, self.is_feeding, self.is_stopped = 0.0, True, False
        self.on_cycle: Callable[[Time], object] = lambda stamp: None
        self.commands: list[tuple[float, ...]] = []
        subscribe = self.user.create_subscription
        subscribe(JointState, "effort_commands", lambda message: self.commands.append(tuple(message.effort)), 100)
        controller = "effort_controller/commands"
        subscribe(Float64MultiArray, controller, lambda message: self.commands.append(tuple(message.data)), 100)
        self.estimates: dict[str, list[JointState]] = {"": [], "_std": []}
        for part, messages in self.estimates.items():
            subscribe(JointState, f"wearer_efforts{part}", messages.append, 100)
        self._joint_states = self.user.create_publisher(JointState, "joint_states", 1)
        self.user.create_timer(0.01, self._cycle)
        self.node: Any = None
        self.wearer: Any = None
        self._closing = False
        self._thread = threading.Thread(target=self._spin)  # so that neither node keeps the other from sending

    def start(self, with_wearer: bool = False) -> "CompensatorRig":
        self.node = self.add(CompensatorNode(), is_spun=False)
        self.wearer = self.add(WearerNode(), is_spun=False) if with_wearer else None
        self._thread.start()
        return self

    def _spin(self) -> None:
        executor = NodeExecutor()
        for node in filter(None, (self.node, self.wearer)):
            executor.add_node(node)
        while not self._closing:
            pause() if self.is_stopped else executor.spin_once(timeout_sec=0.05)
        executor.shutdown()

    def _cycle(self) -> None:
        if self.is_feeding and self.node is not None:
            stamp = Time(nanoseconds=time.time_ns() - round(self.lag * 1e9)).to_msg()
            message = JointState(name=self.names, position=self.pose, velocity=self.velocity, effort=self.effort)
            message.header.stamp = stamp
            self._joint_states.publish(message)
            self.on_cycle(stamp)

    @property
    def status(self) -> DiagnosticStatus:
        return self.statuses["compensator"]

    @property
    def values(self) -> Mapping[str, str]:
        return self.values_of("compensator")

    def set(self, **values: object) -> list[str]:
        """Set parameters (`__` for a dot) and return why each was refused, '' if it was not."""
        changes = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
        return [result.reason for result in self.node.set_parameters(changes)]

    def found(self, key: str) -> str:
        return self.values_of("wearer")[key]

    @property
    def torques(self) -> list[str]:
        return [self.found(f"right_{part} wearer (Nm)") for part in PARTS]

    def wait_for(self, values: dict[str, str], node: str = "compensator") -> None:
        self.wait_until(lambda: values.items() <= self.values_of(node).items())

    def close(self) -> None:
        self._closing = True
        with suppress(RuntimeError):  # it was not started
            self._thread.join()
        for node in filter(None, (self.wearer, self.node)):
            node.close()
        super().close()


@pytest.fixture
def make_rig(monkeypatch) -> Iterator[Callable[..., CompensatorRig]]:
    """A function that makes a rig, with shorter ramps and fades, which test_compensator.py times."""
    monkeypatch.setattr(guidance, "GUIDANCE", replace(guidance.GUIDANCE, time=0.2, rate=100.0))
    monkeypatch.setattr(load_change, "LAST_FADE", 0.4)
    yield from each_closed(CompensatorRig)


@pytest.fixture
def rig(make_rig) -> CompensatorRig:
    return make_rig("/right", {"use_imu": "false"}, NAMES, POSE).start()


@pytest.fixture
def make_urdf_rig(make_rig) -> Callable[..., CompensatorRig]:
    """A function that makes an arm of six joints among others, in another order, with these parameters."""
    return lambda **changes: make_rig(
        "/arm", {**WITH_URDF, **changes}, ["gripper", *UR5[::-1]], (math.nan, *UR5_POSE[::-1])
    )


@pytest.fixture
def called() -> Iterator[Callable[..., CompensatorNode]]:
    """A function that makes the compensator of a right arm which can_bridge calls in its own process."""
    context, nodes = rclpy.Context(), []

    def make(*parameters: str) -> CompensatorNode:
        given = [word for parameter in ("use_imu:=false", *parameters) for word in ("-p", parameter)]
        params = ("--params-file", str(CONFIG / "sim.yaml"))
        rclpy.init(args=["--ros-args", "-r", "__ns:=/right", *params, *given], context=context)
        nodes.append(CompensatorNode(context))
        return nodes[-1]

    yield make
    for node in nodes:
        node.close()
        node.destroy_node()
    rclpy.try_shutdown(context=context)


def adds(rig: CompensatorRig, torque: list[float]) -> bool:
    """Return whether the newest efforts are those of gravity and `torque` (4,) in Nm."""
    return bool(rig.commands and rig.commands[-1]) and np.allclose(rig.commands[-1] - GRAVITY, torque, atol=1e-6)


def loop_that_sends(rig: CompensatorRig, topic: str = "assist_efforts", **fields: list[Any]):
    """Return what publishes a message of these fields, as of a stamp, and the message."""
    publisher, message = rig.user.create_publisher(JointState, topic, 1), JointState(**{"name": NAMES, **fields})

    def send(stamp: Time) -> None:
        message.header.stamp = stamp
        publisher.publish(message)

    return send, message


@pytest.mark.real_time  # efforts that are 50 ms late are faded, as they must be
def test_efforts_of_one_outer_loop_are_added_and_the_arm_stays_carried_without_them(rig):
    ours, message = loop_that_sends(rig, effort=ASSIST)
    other, _ = loop_that_sends(rig, effort=[0.0, 1.0, 0.0, 0.0])
    rig.on_cycle = ours
    rig.wait_until(lambda: adds(rig, STILL) and rig.values.get("assist") == "off")
    assert rig.set(assist__max_effort=[1.0] * 4) == [""]
    rig.wait_until(lambda: adds(rig, ASSIST))
    rig.wait_until(lambda: rig.values["assist"] == "assisting" and rig.values["terms"] == "assist")
    rig.on_cycle = lambda stamp: (ours(stamp), other(stamp))
    rig.wait_until(lambda: adds(rig, STILL) and "more than one publisher" in rig.status.message)
    rig.on_cycle = ours
    rig.wait_until(lambda: adds(rig, ASSIST))
    message.effort = [math.nan, 0.0, 0.0, 0.0]  # other refusals: test/core/test_terms.py
    said = "gravity compensation alone: assist_efforts must be numbers"
    rig.wait_until(lambda: adds(rig, STILL) and rig.status.message.startswith(said))
    assert (rig.values["assist reason"], rig.values["warnings"]) == ("invalid", "terms_refused")
    message.effort = ASSIST
    rig.wait_until(lambda: adds(rig, ASSIST) and rig.status.message == "compensating")
    rig.on_cycle = lambda stamp: None
    rig.wait_until(lambda: adds(rig, STILL))
    rig.wait_until(lambda: (rig.values["assist"], rig.values["assist reason"]) == ("waiting", "stopped"))
    rig.wait_until(lambda: rig.status.message == "compensating" and rig.values["warnings"] == "none")


def test_terms_are_set_live_and_need_velocities(rig):
    rig.velocity = [0.15, -0.15, 0.0, 0.0]  # a change of load waits for slow joints
    rig.wait_until(lambda: adds(rig, STILL))
    assert rig.set(friction__coulomb=[0.2, 0.4, 0.2, 0.2], friction__share=0.5) == ["", ""]
    rig.wait_until(lambda: adds(rig, [0.1, -0.2, 0.0, 0.0]) and rig.values["terms"] == "friction")
    rig.velocity = []
    rig.wait_until(lambda: adds(rig, STILL))


def test_a_tilt_is_believed_by_its_stamp_and_gravitys_vector_goes_before_pitch_and_roll(make_rig):
    rig = make_rig("/right", {}, NAMES, POSE)
    angles, vector, lag = Vector3Stamped(), Imu(), [0.0]
    by_angles = rig.user.create_publisher(Vector3Stamped, "/imu/pitch_yaw", 1)
    by_vector = rig.user.create_publisher(Imu, "/imu/data", 1)
    angles.vector.y = 0.3
    vector.orientation.y, vector.orientation.w = math.sin(0.18), math.cos(0.18)

    def send(_stamp: Time, has_vector: bool = False) -> None:
        now = rig.user.get_clock().now().nanoseconds
        angles.header.stamp = vector.header.stamp = Time(nanoseconds=now - round(lag[0] * 1e9)).to_msg()
        by_angles.publish(angles)
        if has_vector:
            by_vector.publish(vector)

    def is_compensated(bow: float) -> bool:
        expected = gravity_torque(ROBOT, POSE, Tilt.of("right", bow).direction)
        return bool(rig.commands and rig.commands[-1]) and np.allclose(rig.commands[-1], expected, atol=1e-9)

    rig.on_cycle = send
    rig.start().wait_until(lambda: is_compensated(0.3))
    rig.on_cycle = lambda stamp: send(stamp, has_vector=True)
    rig.wait_until(lambda: is_compensated(0.36))
    rig.on_cycle = send
    rig.wait_until(lambda: is_compensated(0.3))
    for lag[0], word, sentence in (
        (0.7, "late_tilt_stamp", "older than 80 ms by its stamp: the IMU driver lags"),
        (
            3600.0,
            "refused_tilt",
            "age of the trunk tilt by its stamp must be from -0.05 to 1 s: synchronise the clocks",
        ),
    ):
        rig.wait_until(lambda word=word: rig.values["reason"] == word)
        assert sentence in rig.values["reason text"]
        rig.wait_until(lambda: not rig.commands[-1])  # the status may overtake it
        lag[0] = 0.0
        rig.wait_until(lambda: rig.status.message == "compensating")


REFUSALS = [
    ({"link_length": [0.05, 0.13, 0.3, 0.31]}, "read-only parameter: link_length"),
    ({"robot.mass": [0.6, 0.5, 0.6]}, "robot.mass = [0.6, 0.5, 0.6]: must be 4 numbers from 0 to 20"),
    ({"support": math.nan}, "support out of range Min: 0.0, Max: 1.0"),
    ({"wearer.mass": [0.0, 0.0, 9.0, 9.0], "support": 1.0}, "total mass in kg = 19.85: must be at most 10 "),
    ({"use_imu": True}, "read-only parameter: use_imu"),
    ({"suport": 0.5}, "suport = 0.5: must be one of "),
    ({"mode": "two_g"}, "one of one_g, zero_g"),
    ({"gain": [1.0] * 4, "gravity": -1.0}, "gravity out of range"),
    ({"support": True}, "support"),
    ({"gain": ["1.0"] * 4}, "gain"),
    ({"robot.mass": None}, "robot.mass"),
    ({"": 1.0}, "must be one of "),
    ({"law": "anfis"}, "anfis_file"),
    ({"anfis_file": "~nobody_here/model.json"}, "anfis_file = '~nobody_here/model.json': must be a file"),
    ({"anfis_file": "/dev/zero"}, "it must be a regular file"),
    ({"anfis_file": "/proc/kmsg"}, "it must be a regular file"),
]


def call(rig: CompensatorRig, kind: Any, name: str, request: Any) -> Any:
    client = rig.user.create_client(kind, f"compensator/{name}")
    rig.wait_until(client.service_is_ready)
    future = client.call_async(request)
    rig.wait_until(future.done)
    return future.result()


def clear(rig: CompensatorRig) -> bool:
    return call(rig, Trigger, "clear_fault", Trigger.Request()).success


def test_parameters_are_refused_with_one_sentence_and_change_nothing_and_are_described_with_units_and_ranges(rig):
    names = [param.name for param in COMPENSATOR]
    before = [parameter.to_parameter_msg() for parameter in rig.node.get_parameters(names)]
    for values, sentence in REFUSALS:
        result = rig.node.set_parameters_atomically([Parameter(name, value=value) for name, value in values.items()])
        assert not result.successful and sentence in result.reason
    assert [parameter.to_parameter_msg() for parameter in rig.node.get_parameters(names)] == before
    again = call(rig, SetParameters, "set_parameters", SetParameters.Request(parameters=before)).results
    assert not [result.reason for result in again if not result.successful]  # a dump can be loaded again
    assert rig.set(support=0) == [""]  # an integer, where a float is declared
    descriptors = {descriptor.name: descriptor for descriptor in rig.node.describe_parameters(names)}
    assert all(descriptor.description for descriptor in descriptors.values())
    (bounds,) = descriptors["tilt_timeout"].floating_point_range
    assert (bounds.from_value, bounds.to_value) == (0.01, 0.5)
    assert "[m]" in descriptors["link_length"].description and descriptors["link_length"].read_only
    assert descriptors["mode"].additional_constraints == "a string, one of one_g, zero_g"


WORN = {"use_imu": "false", "max_effort": [9.0, 18.0, 9.0, 9.0], "wearer.body_mass": 75.0}
ADAPTIVE = {**WORN, "mode": "zero_g", "support": 0.4, "support_adapts": "true", "model_error.wearer": 0.03}


@pytest.mark.thorough
def test_a_load_is_weighed_on_request_and_one_that_is_dropped_is_no_longer_a_parameter(make_rig, monkeypatch):
    rig = make_rig("/right", {**WORN, "support": 0.5}, NAMES, POSE).start()

    def weigh() -> Trigger.Response:
        return call(rig, Trigger, "weigh", Trigger.Request())

    rig.wait_until(lambda: rig.commands)
    refused = weigh()
    assert not refused.success and "support 1" in refused.message
    rig.wait_for({"weigh refused": "support", "weighing number": "0"})
    assert rig.set(mode="zero_g", support=1.0) == ["", ""]
    rig.wait_until(lambda: rig.values["changing load"] == "none" and weigh().success)
    rig.wait_for({"weighing": "taking_over", "weighing number": "1"})
    assert rig.set(payload__mass=6.0) != [""]
    assert rig.set(payload__mass=2.0) == [""]
    rig.wait_for({"weighing": "failed", "weighing trouble": "settings_changed"})
    rig.velocity, rig.effort = [0.0, 0.0, 1.5, 2.0], []  # whether the motors carry it is not known
    rig.wait_for({"payload mass (kg)": "0.000"})
    assert rig.node.get_parameter("payload.mass").value == 0.0
    monkeypatch.setattr(inner, "REQUEST_LIFE", -1.0)
    assert "s old" in weigh().message


@pytest.mark.thorough
def test_a_second_sender_of_requests_raises_no_support(make_rig):
    rig = make_rig("/right", ADAPTIVE, NAMES, POSE).start()
    ask, other = (
        loop_that_sends(rig, topic="support_request", name=["support"], position=[share])[0] for share in (0.8, 0.9)
    )
    rig.on_cycle = ask
    rig.wait_for({"support in use": "0.8"})
    rig.on_cycle = lambda stamp: (ask(stamp), other(stamp))
    rig.wait_for({"support in use": "0.4", "support request": "second_publisher"})


def is_zero(rig: CompensatorRig) -> bool:
    return bool(rig.commands) and not any(rig.commands[-1])


def is_carried(rig: CompensatorRig) -> bool:
    return bool(rig.commands) and np.allclose(rig.commands[-1], EXPECTED, rtol=0.0, atol=1e-9)


def carried(rig: CompensatorRig, condition: Callable[[], object] | None = None) -> CompensatorRig:
    """Return the rig once the arm is carried, or `condition()` holds; a fault, as of a busy machine, is cleared."""
    condition = condition or (lambda: is_carried(rig))
    while not condition():
        rig.wait_until(lambda: condition() or rig.values.get("output") == "zero")
        if not condition():
            clear(rig)
    return rig


def test_the_description_may_come_from_a_latched_topic_and_the_torque_begins_from_what_the_joints_apply(make_urdf_rig):
    rig = make_urdf_rig(**{"urdf.file": '""', "urdf.topic": "robot_description"})
    description = String(data=(ARMS / "ur5.urdf").read_text())
    rig.user.create_publisher(String, "robot_description", LATCHED).publish(description)
    rig.effort = []
    rig.start().wait_until(lambda: "joint_states: effort must be 7 values" in rig.status.message)
    assert rig.commands == [] and rig.status.level == DiagnosticStatus.ERROR
    rig.effort = [0.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0]
    rig.wait_until(lambda: rig.commands)
    assert rig.commands[0] == pytest.approx(rig.node._control.applied) == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    carried(rig)


def test_a_missing_description_is_an_error_at_the_start(make_urdf_rig, monkeypatch):
    monkeypatch.setattr(arm, "DESCRIPTION_TIMEOUT", 0.2)
    with pytest.raises(ParameterError, match=r"urdf\.topic = '/robot_description': must be published, latched"):
        make_urdf_rig(**{"urdf.file": '""'}).start()


def test_the_positions_of_other_joints_come_from_the_joint_states_or_there_is_no_torque(make_urdf_rig):
    own = [f"panda_joint{n}" for n in (1, 2, 3)]
    panda = {"urdf.file": ARMS / "panda.urdf", "joint_names": f"[{','.join(own)}]", "max_effort": [87.0] * 3}
    rig = make_urdf_rig(**panda)
    rig.names, rig.pose, rig.velocity, rig.effort = own, [0.0, 0.6, 0.0], [0.0] * 3, [0.0] * 3
    rig.start().wait_until(lambda: "position of panda_joint4 must be in the joint states" in rig.status.message)
    assert "cannot be at 0 (limits -3.0718 to -0.0698)" in rig.status.message and rig.commands == []
    rig.names = [f"panda_joint{n}" for n in (4, 5, 6, 7, 1, 2, 3)]
    rig.pose, rig.velocity, rig.effort = [-1.57, 0.0, 1.57, 0.78, 0.0, 0.6, 0.0], [0.0] * 7, [0.0] * 7
    # -44.9 Nm by differentiating the potential energy; -32.0 with the other joints at 0
    carried(rig, lambda: rig.commands and abs(rig.commands[-1][1] + 44.92) < 0.01)
    assert rig.values["joints taken to be at 0"] == "none"


def test_six_joints_among_others_are_carried_with_live_gains_until_joint_states_are_missing_or_old(make_urdf_rig):
    rig = make_urdf_rig().start()
    carried(rig, lambda: rig.status.message == "compensating" and rig.values["output"] == "active")
    carried(rig)
    assert rig.values["law"] == "urdf" and rig.values["mass carried (kg)"] == "16.994"
    accepted, refused = rig.set(gain=[0.9] * 6, law="exact")
    assert accepted == "" != refused
    carried(rig, lambda: np.allclose(rig.commands[-1], np.multiply(0.9, EXPECTED), rtol=0.0, atol=1e-9))
    assert rig.set(gain=[1.0] * 6) == [""]
    carried(rig)
    rig.is_feeding = False
    rig.commands.clear()
    rig.wait_until(lambda: is_zero(rig))
    assert np.all(np.diff(np.abs(rig.commands), axis=0) <= 1e-12)
    rig.wait_until(lambda: "no joint_states younger than 150 ms: zero, call clear_fault" in rig.status.message)
    assert rig.status.level == DiagnosticStatus.ERROR
    rig.is_feeding = True
    count = len(rig.commands)
    rig.wait_until(lambda: len(rig.commands) > count + 20)
    assert not np.any(rig.commands[count:])
    assert clear(rig)
    carried(rig)
    rig.lag = 1.0
    rig.wait_until(lambda: is_zero(rig))
    rig.wait_until(lambda: "no joint_states younger than 150 ms" in rig.status.message)
    assert rig.values["refused message"] == "joint_states" and "age by its stamp" in rig.values["refused message text"]
    rig.lag = 0.0
    carried(rig)
    complete = rig.names, rig.pose, rig.velocity, rig.effort
    rig.names, rig.pose, rig.velocity, rig.effort = (values[:-1] for values in complete)
    rig.wait_until(lambda: is_zero(rig))
    carried(rig, lambda: f"joint_states: name must be {UR5[0]}" in rig.status.message)
    rig.names, rig.pose, rig.velocity, rig.effort = complete
    carried(rig).node.close()  # the torque fades to zero before the node ends
    rig.wait_until(lambda: is_zero(rig))


# In one process with can_bridge, which calls it with each joint state


def states() -> JointState:
    return JointState(name=NAMES, position=POSE, velocity=STILL, effort=STILL)


def settled(compensator: CompensatorNode) -> JointState:
    """Return the answer once the torque has ramped in."""
    is_there = lambda: np.allclose(compensator.answer(states()).effort, GRAVITY, rtol=0.0, atol=1e-9)  # noqa: E731
    wait_until(is_there)
    return compensator.answer(states())


def test_a_called_compensator_answers_publishes_it_withdraws_for_two_publishers_and_ends_with_an_exception(
    called, node, monkeypatch
):
    received, compensator = [], called()
    node.create_subscription(JointState, "effort_commands", received.append, 10)
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    answer = settled(compensator)  # the first ones may precede the discovery of the subscription
    is_received = lambda: compensator.answer(states()) and answer in received  # noqa: E731
    wait_until(is_received, lambda: executor.spin_once(0.01))
    bridge, other = (node.create_publisher(JointState, "joint_states", 1) for _ in range(2))
    wait_until(lambda: other.get_subscription_count() == bridge.get_subscription_count() == 1)
    for _ in range(20):
        bridge.publish(states())
        assert compensator.answer(states()).effort
    # One message of the other may be lost between two of ours: the middleware keeps few.
    both = lambda: (other.publish(states()), bridge.publish(states()))  # noqa: E731
    wait_until(lambda: both() and not compensator.answer(states()).effort)
    monkeypatch.setattr(Compensator, "step", lambda *_: 1 / 0)
    wait_until(lambda: compensator.answer(states()) is None)
    monkeypatch.undo()
    assert compensator.answer(states()) is None and isinstance(compensator.failure, ZeroDivisionError)
    executor.shutdown()


def test_efforts_for_an_effort_controller_are_refused_in_one_process(called):
    with pytest.raises(ParameterError, match="command_interface = 'multi_array': must be joint_state in one process"):
        called("command_interface:=multi_array")


# The node `wearer`

LOAD = Wearer(75.0).on_links(ROBOT.length)
NEEDED = gravity_torque(ROBOT.with_wearer(LOAD.mass, LOAD.cog), POSE)
GIVEN = np.array((0.0, 4.0, 1.5, 0.0))  # Nm, of the wearer
WEIGHT = NEEDED - gravity_torque(ROBOT, POSE)  # Nm, that carries the wearer's arm
NONE = ["0.0"] * len(PARTS)  # Nm


def test_what_the_motors_do_not_carry_is_published_as_the_wearers_and_follows_the_compensators_parameters(make_rig):
    rig = make_rig("/right", WORN, NAMES, POSE)
    rig.effort = []
    rig.start(with_wearer=True)
    torques, deviations = rig.estimates.values()
    rig.wait_until(lambda: rig.found("reason") == "incomplete_joint_states")
    assert not torques  # without the motors' efforts nothing is known of the wearer
    rig.effort = (NEEDED - GIVEN).tolist()
    rig.wait_until(lambda: len(torques) > 100 and len(deviations) > 100)
    assert list(torques[-1].name) == NAMES
    assert torques[-1].effort == pytest.approx(GIVEN, abs=1e-6)
    assert all(0.05 < std < 2.5 for std in deviations[-1].effort)
    stamps = [{to_nanoseconds(message.header.stamp) for message in messages[:50]} for messages in (torques, deviations)]
    assert stamps[0] & stamps[1]  # a torque and its deviation have the same stamp
    rig.wait_until(lambda: rig.torques == [f"{torque:.1f}" for torque in GIVEN])
    share = f"{100.0 * (GIVEN @ WEIGHT) / (WEIGHT @ WEIGHT):.0f}"
    rig.wait_until(lambda: rig.found("share of the wearer (%)") == share)
    rig.velocity = [1e200] * len(NAMES)  # it would end the node, and 1e150 would be remembered for minutes
    rig.wait_until(lambda: rig.found("reason") == "incomplete_joint_states")
    rig.velocity, rig.effort = STILL, NEEDED.tolist()
    rig.wait_until(lambda: rig.torques == NONE and rig.found("share of the wearer (%)") == "0")
    assert (rig.found("contacts"), rig.found("contact joint")) == ("0", "none")

    def strike(_stamp: object) -> None:  # again, for a node that was late at the first one
        rig.effort = np.add(NEEDED, (0.0, 0.0, 0.0, 5.0 * (len(torques) // 100 % 2))).tolist()

    rig.on_cycle = strike
    rig.wait_until(lambda: rig.found("contact joint") == "right_elbow_flexion")
    rig.on_cycle = lambda stamp: None
    assert rig.set(payload__mass=2.0) == [""]
    loaded = ROBOT.with_payload(2.0, (0.0, 0.0, 0.0)).with_wearer(LOAD.mass, LOAD.cog)
    rig.effort = gravity_torque(loaded, POSE).tolist()
    rig.wait_until(lambda: rig.torques == NONE)


def test_beside_a_compensator_that_hangs_nothing_is_known_of_the_wearer(make_rig):
    rig = make_rig("/right", WORN, NAMES, POSE)
    rig.effort = NEEDED.tolist()
    rig.start(with_wearer=True)
    torques = rig.estimates[""]
    rig.wait_until(lambda: rig.torques == NONE and torques)
    rig.is_stopped = True  # the wearer's own thread goes on
    rig.wait_until(lambda: time.time_ns() - to_nanoseconds(torques[-1].header.stamp) > 0.5e9)
    rig.is_stopped = False
    rig.wait_until(lambda: time.time_ns() - to_nanoseconds(torques[-1].header.stamp) < 0.2e9 and rig.torques == NONE)


@pytest.fixture
def alone() -> Iterator[NodeRig]:
    """A rig with a wearer, `alone.wearer`."""
    alone = NodeRig()
    alone.wearer = alone.add(WearerNode())
    yield alone
    alone.wearer.close()
    alone.close()


def test_a_node_of_another_program_with_the_compensators_name_does_not_end_the_node_and_is_refused(alone):
    other = alone.add(rclpy.create_node("compensator"))
    publisher = other.create_publisher(DiagnosticArray, "/diagnostics", 10)
    values = [KeyValue(key="answers", value="many")]
    report = DiagnosticArray(status=[DiagnosticStatus(name="compensator", values=values)])
    other.create_timer(0.05, lambda: publisher.publish(report))
    alone.wait_until(lambda: alone.statuses["wearer"].message == "the compensator has no parameter 'link_length'")
    assert alone.wearer.failure is None


@pytest.mark.thorough
def test_the_support_follows_an_arm_that_sinks_and_returns_when_the_node_ends_while_the_arm_is_carried_on(make_rig):
    rig = make_rig("/right", ADAPTIVE, NAMES, POSE)
    rig.effort = gravity_torque(ROBOT.with_wearer(LOAD.mass, LOAD.cog, 0.4), POSE).tolist()
    sinking = [0.0]  # rad in each cycle, of the second joint

    def sink(_stamp: object) -> None:
        rig.pose[1] -= sinking[0]

    in_use = lambda: float(rig.values["support in use"] or 0.0)  # noqa: E731
    asked = lambda: float(rig.found("support asked for").replace("none", "") or 0.0)  # noqa: E731
    rig.on_cycle = sink
    rig.start(with_wearer=True)
    rig.wait_until(lambda: rig.found("support adapts") == "on" and asked() == 0.4)
    sinking[0] = 0.0004
    rig.wait_until(lambda: asked() > 0.4 and in_use() > 0.4)
    sinking[0] = 0.0
    assert rig.values["support"] == "0.4"
    state = DiagnosticStatus(name="right/can_bridge", values=[KeyValue(key="state", value="letting down")])
    bridge = rig.user.create_publisher(DiagnosticArray, "/diagnostics", 10)
    rig.wait_until(
        lambda: (
            bridge.publish(DiagnosticArray(status=[state]))
            or (asked() == 0.4 and rig.found("support adapts text") == "the arm is not carried")
        )
    )
    sinking[0] = 0.0004
    rig.wait_until(lambda: in_use() > 0.42)
    rig.wearer.close()
    rig.wait_until(lambda: in_use() == 0.4 and rig.values["support request"] == "none")
    count = len(rig.commands)
    rig.wait_until(lambda: len(rig.commands) > count + 50 and rig.commands[-1])


# Compensator, wearer and the tools make the same arm of a URDF whose chain has joints that are not the arm's


def test_a_joint_that_is_not_listed_is_at_0_for_compensator_wearer_and_tools(alone, tmp_path):
    text, names = random_chain(3, seed=5)
    urdf, listed = tmp_path / "chain.urdf", [names[0], names[2]]
    urdf.write_text(text)
    given = {"law": "urdf", "use_imu": False, "joint_names": listed, "urdf.file": str(urdf), "urdf.hand": "hand"}
    given["max_effort"] = [30.0] * 2
    bridge = {
        "joint_names": listed, "can.interface": "virtual", "can.channel": "one_urdf_arm", "motor": ["AK80-9"] * 2,
        "can_id": [1, 2], "max_effort": [9.0] * 2, "position_min": [-1.0] * 2, "position_max": [1.0] * 2,
    }  # fmt: skip
    own = [Parameter(name, value=value) for name, value in given.items()]
    has = {"parameter_overrides": own, "automatically_declare_parameters_from_overrides": True}
    node = alone.add(rclpy.create_node("compensator", **has), is_spun=False)
    _, values, read, made = arm.declared(node)
    assert made.fixed == (names[1],)
    of_tools = read_arm({"/right/can_bridge": bridge, "/right/compensator": given}, "/right")
    all_of_them = read(values), alone.wearer._read(values), of_tools.settings
    expected = UrdfArm(text, listed)
    for theta in np.random.default_rng(0).uniform(-2.0, 2.0, (10, 2)):
        for settings in all_of_them:
            torque, _ = settings.torque(theta.tolist(), Tilt.of("left"))
            assert torque == pytest.approx(expected.torque(theta.tolist(), Tilt.of("left")), abs=1e-10)
    has["parameter_overrides"] = [
        Parameter(name, value=of_tools.can_bridge[name]) for name in ("joint_names", *BRIDGE_PARAMETERS)
    ]
    alone.add(rclpy.create_node("can_bridge", **has))
    watch = BudgetWatch(alone.wearer)
    alone.wait_until(lambda: watch.update(listed, of_tools.settings) or watch.result.code != Budget.UNKNOWN)
    assert watch.result.code == Budget.WITHIN_RATED
    watch.update(names, replace(of_tools.settings, use_imu=True))  # a compensator of another arm than the bridge's
    assert watch.result.code == Budget.UNKNOWN and "must be 3 motors" in watch.result.text
    for hand in ("", "hand"):  # of another arm than that which is estimated
        alone.wearer._on_parameters("", {**values, "urdf.hand": hand})
    assert alone.wearer._refusal.code == "refused_parameters"
