"""recorder: writes a trial down as a standard rosbag2 recording (MCAP), with the parameters of every node.

It looks for topics twice a second and records those of all arms, of the IMU, faults and changes of parameters, each
with the quality of service that its publisher offers and the time of its arrival. The parameters at the start are on
`/recorder/parameters`: a std_msgs/String of ROS 2's own parameter YAML for each node, in the recording alone.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String

from exo_gravity.bag.writer import BagWriter, offered_qos
from exo_gravity.core.param_table import Param
from exo_gravity.nodes.declare import declare
from exo_gravity.nodes.drain import Drain
from exo_gravity.nodes.run import run

PARAMETERS = (
    Param("output", "", "new folder for the recording", fixed=True, required=True),
    Param("live", False, "ten times a second, one line of JSON on standard output with what the arms do", fixed=True),
)
OF_AN_ARM = {"joint_states": JointState, "effort_commands": JointState, "wearer_step": String}
OF_ALL = {
    "/imu/pitch_yaw": Vector3Stamped,
    "/imu/data": Imu,
    "/imu/data_raw": Imu,
    "/diagnostics": DiagnosticArray,
    "/parameter_events": ParameterEvent,
}
SNAPSHOT = "/recorder/parameters"
DRAIN_PERIOD, LOOK_PERIOD, LIVE_PERIOD = 0.05, 0.5, 0.1  # s
DEPTH = 1000  # messages that may wait: two seconds at 500 Hz


class Recorder(Node):
    """Subscribes, and hands on to `BagWriter`, whose own thread waits for the disk."""

    def __init__(self):
        super().__init__("recorder", automatically_declare_parameters_from_overrides=True)
        values = declare(self, PARAMETERS)
        self.failure: Exception | None = None  # run() ends the node for it
        self._writer = BagWriter(values["output"])
        self._writer.add_topic(SNAPSHOT, "std_msgs/msg/String", offered_qos(True, True, 1))
        self._drains: list[Drain] = []
        self._asked: set[str] = set()
        self._live = Live() if values["live"] else None
        self.create_timer(DRAIN_PERIOD, self._drain)
        self.create_timer(LOOK_PERIOD, self._look)
        if self._live:
            self.create_timer(LIVE_PERIOD, self._live.write)
        self._look()
        self.get_logger().info(f"recording to {self._writer.path}")

    def close(self) -> None:
        """Write down what has arrived, and end the recording properly."""
        try:
            self._drain()
        finally:
            self._writer.close()
        if self._writer.error:
            self.get_logger().error(str(self._writer.error))
        else:
            self.get_logger().info(f"{self._writer.count} messages in {self._writer.path}")

    def _drain(self) -> None:
        messages = []
        for drain in self._drains:
            taken = drain.take()
            messages += [(drain.topic, stamp, data) for stamp, data in taken]
            if taken and self._live:
                self._live.note(drain.topic, [data for _, data in taken])
        messages.sort(key=lambda message: message[1])
        self._writer.write(messages)
        self.failure = self._writer.error

    def _look(self) -> None:
        """Subscribe to what is new, and ask new nodes for their parameters."""
        known = {drain.topic for drain in self._drains}
        for topic, types in self.get_topic_names_and_types():
            msgtype = OF_ALL.get(topic) or OF_AN_ARM.get(topic.rpartition("/")[2])
            if msgtype and topic not in known and type_name(msgtype) in types:
                self._subscribe(topic, msgtype)
        for name, namespace in self.get_node_names_and_namespaces():
            node = f"{namespace.rstrip('/')}/{name}"
            if node not in self._asked and node != self.get_fully_qualified_name() and not name.startswith("_"):
                Snapshot(self, node)
                self._asked.add(node)

    def _subscribe(self, topic: str, msgtype: type) -> None:
        offered = [publisher.qos_profile for publisher in self.get_publishers_info_by_topic(topic)]
        if not offered:
            return  # somebody only listens; look again later
        reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
        latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
        # The control loops' publishers must owe a recorder no acknowledgement, nor wait for one.
        acknowledged = reliable and msgtype is not JointState
        qos = QoSProfile(
            depth=DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if acknowledged else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        self._writer.add_topic(topic, type_name(msgtype), offered_qos(reliable, latched, offered[0].depth or 1))
        self._drains.append(Drain(self, msgtype, topic, qos))

    def write_parameters(self, node: str, values: dict[str, Any]) -> None:
        """Write down the parameters of a node."""
        text = yaml.safe_dump({node: {"ros__parameters": values}}, default_flow_style=None, width=120)
        now = self.get_clock().now().nanoseconds
        self._writer.write([(SNAPSHOT, now, serialize_message(String(data=text)))])


class Snapshot:
    """Asks one node for all its parameters, by the services that `ros2 param dump` uses."""

    def __init__(self, recorder: Recorder, node: str):
        self._recorder = recorder
        self._node = node
        self._names: list[str] = []
        self._list = recorder.create_client(ListParameters, f"{node}/list_parameters")
        self._get = recorder.create_client(GetParameters, f"{node}/get_parameters")
        self._timer = recorder.create_timer(LIVE_PERIOD, self._ask)

    def _ask(self) -> None:
        if self._list.service_is_ready() and self._get.service_is_ready():
            self._recorder.destroy_timer(self._timer)
            self._list.call_async(ListParameters.Request()).add_done_callback(self._on_names)

    def _on_names(self, future) -> None:
        self._names = list(future.result().result.names)
        self._get.call_async(GetParameters.Request(names=self._names)).add_done_callback(self._on_values)

    def _on_values(self, future) -> None:
        values = (_plain(parameter_value_to_python(value)) for value in future.result().values)
        # ROS's own reader has no empty list, and none that is not set.
        given = {name: value for name, value in zip(self._names, values, strict=True) if value not in (None, [])}
        self._recorder.write_parameters(self._node, given)
        for client in (self._list, self._get):
            self._recorder.destroy_client(client)


class Live:
    """The latest of each arm as one line of JSON, for whoever started the recorder: `trial`.

    {"right": {"position": [4 rad], "velocity": [...], "effort": [...], "command": [...], "names": [...],
    "step": {...}}, "faults": ["right/can_bridge: motor 2 is silent"]}
    """

    def __init__(self):
        self._latest: dict[str, bytes] = {}
        self._faults: dict[str, str] = {}

    def note(self, topic: str, messages: list[bytes]) -> None:
        """Keep the newest message of a topic, and of faults the newest of each node."""
        if topic != "/diagnostics":
            self._latest[topic] = messages[-1]
            return
        for data in messages:
            for status in deserialize_message(data, DiagnosticArray).status:
                self._faults[status.name] = "" if status.level == DiagnosticStatus.OK else status.message

    def write(self) -> None:
        """Write the line to standard output."""
        line: dict[str, Any] = {}
        for topic, data in self._latest.items():
            namespace, _, leaf = topic.rpartition("/")
            if leaf in OF_AN_ARM:
                arm = line.setdefault(namespace.strip("/") or "arm", {})
                arm.update(_summary(leaf, deserialize_message(data, OF_AN_ARM[leaf])))
        line["faults"] = [f"{name}: {text}" for name, text in self._faults.items() if text]
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


def type_name(msgtype: type) -> str:
    """Return 'sensor_msgs/msg/JointState' for that class."""
    package, kind, *_ = msgtype.__module__.split(".")
    return f"{package}/{kind}/{msgtype.__name__}"


def _summary(leaf: str, message: JointState | String) -> dict[str, Any]:
    if leaf == "wearer_step":
        return {"step": json.loads(message.data)}
    if leaf == "effort_commands":
        return {"command": list(message.effort)}
    fields = {field: list(getattr(message, field)) for field in ("position", "velocity", "effort")}
    return {"names": list(message.name), **fields}


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, list | tuple) or hasattr(value, "tolist") else value


def main() -> None:
    """Entry point of the executable `recorder`."""
    raise SystemExit(run(Recorder))
