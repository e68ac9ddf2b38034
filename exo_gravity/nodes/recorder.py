"""recorder: writes a trial to a standard rosbag2 recording (MCAP), with the parameters of every node.

Twice a second it looks for new topics, and records those of all arms, the IMU, diagnostics and parameter changes, each
with the quality of service that its publisher offers and its time of arrival. The parameters at the start go to the
topic `/recorder/parameters`, which exists in the recording only: one std_msgs/String of ROS 2 parameter YAML per node.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.task import Future
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String

from exo_gravity.bag.writer import BagWriter, offered_qos
from exo_gravity.core.control_params import RECORDER
from exo_gravity.nodes.declare import declare
from exo_gravity.nodes.drain import Drain
from exo_gravity.nodes.run import run

ARM_TOPICS = {"joint_states": JointState, "effort_commands": JointState, "wearer_step": String}
SHARED_TOPICS = {
    "/imu/pitch_yaw": Vector3Stamped,
    "/imu/data": Imu,
    "/imu/data_raw": Imu,
    "/diagnostics": DiagnosticArray,
    "/parameter_events": ParameterEvent,
}
PARAMETERS_TOPIC = "/recorder/parameters"
DRAIN_PERIOD = 0.05  # s between two writes of what has arrived
DISCOVERY_PERIOD = 0.5  # s between two searches for new topics and nodes
LIVE_PERIOD = 0.1  # s between two lines of live state
DEPTH = 1000  # queued messages per topic: two seconds at 500 Hz


class Recorder(Node):
    """Subscribes, and passes messages to `BagWriter`, whose thread waits for the disk."""

    def __init__(self) -> None:
        super().__init__("recorder", automatically_declare_parameters_from_overrides=True)
        values = declare(self, RECORDER)
        self.failure: Exception | None = None  # ends the node, see run()
        self._writer = BagWriter(values["output"])
        self._writer.add_topic(PARAMETERS_TOPIC, "std_msgs/msg/String", offered_qos(True, True, 1))
        self._drains: list[Drain] = []
        self._snapshots: set[str] = set()
        self._live = Live() if values["live"] else None
        self.create_timer(DRAIN_PERIOD, self._drain)
        self.create_timer(DISCOVERY_PERIOD, self._discover)
        if self._live:
            self.create_timer(LIVE_PERIOD, self._live.write)
        self._discover()
        self.get_logger().info(f"recording to {self._writer.path}")

    def close(self) -> None:
        """Write what has arrived, and close the recording."""
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

    def _discover(self) -> None:
        """Subscribe to new topics, and request the parameters of new nodes."""
        known = {drain.topic for drain in self._drains}
        for topic, types in self.get_topic_names_and_types():
            msgtype = SHARED_TOPICS.get(topic) or ARM_TOPICS.get(topic.rpartition("/")[2])
            if msgtype and topic not in known and type_name(msgtype) in types:
                self._subscribe(topic, msgtype)
        for name, namespace in self.get_node_names_and_namespaces():
            node = f"{namespace.rstrip('/')}/{name}"
            if node not in self._snapshots and node != self.get_fully_qualified_name() and not name.startswith("_"):
                Snapshot(self, node)
                self._snapshots.add(node)

    def _subscribe(self, topic: str, msgtype: type) -> None:
        offered = [publisher.qos_profile for publisher in self.get_publishers_info_by_topic(topic)]
        if not offered:
            return  # a subscriber without a publisher; try again later
        reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
        latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
        # A recorder must not make the control loops' publishers wait for acknowledgements.
        acknowledged = reliable and msgtype is not JointState
        qos = QoSProfile(
            depth=DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if acknowledged else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        self._writer.add_topic(topic, type_name(msgtype), offered_qos(reliable, latched, offered[0].depth or 1))
        self._drains.append(Drain(self, msgtype, topic, qos))

    def write_parameters(self, node: str, values: dict[str, Any]) -> None:
        """Write the parameters of a node."""
        text = yaml.safe_dump({node: {"ros__parameters": values}}, default_flow_style=None, width=120)
        now = self.get_clock().now().nanoseconds
        self._writer.write([(PARAMETERS_TOPIC, now, serialize_message(String(data=text)))])


class Snapshot:
    """Requests all parameters of one node, by the services that `ros2 param dump` uses."""

    def __init__(self, recorder: Recorder, node: str) -> None:
        self._recorder = recorder
        self._node = node
        self._names: list[str] = []
        self._list = recorder.create_client(ListParameters, f"{node}/list_parameters")
        self._get = recorder.create_client(GetParameters, f"{node}/get_parameters")
        self._timer = recorder.create_timer(LIVE_PERIOD, self._request)

    def _request(self) -> None:
        if self._list.service_is_ready() and self._get.service_is_ready():
            self._recorder.destroy_timer(self._timer)
            self._list.call_async(ListParameters.Request()).add_done_callback(self._on_names)

    def _on_names(self, future: Future) -> None:
        self._names = list(future.result().result.names)
        self._get.call_async(GetParameters.Request(names=self._names)).add_done_callback(self._on_values)

    def _on_values(self, future: Future) -> None:
        values = (_plain(parameter_value_to_python(value)) for value in future.result().values)
        # ROS's parameter files have neither empty lists nor unset values.
        given = {name: value for name, value in zip(self._names, values, strict=True) if value not in (None, [])}
        self._recorder.write_parameters(self._node, given)
        for client in (self._list, self._get):
            self._recorder.destroy_client(client)


class Live:
    """The latest state as one line of JSON, for the program that started the recorder: `trial`.

    {"right": {"position": [4 rad], "velocity": [...], "effort": [...], "command": [...], "names": [...],
    "step": {...}}, "status": {"right/can_bridge": {"level": 2, "message": "...", "state": "fault", ...}},
    "faults": ["right/can_bridge: ..."]}

    status: the newest of each node on /diagnostics, its values included. faults: those whose level is not OK, as text.
    """

    def __init__(self) -> None:
        self._latest: dict[str, bytes] = {}
        self._status: dict[str, dict[str, Any]] = {}

    def note(self, topic: str, messages: list[bytes]) -> None:
        """Keep the newest message of a topic, and the newest status of each node."""
        if topic != "/diagnostics":
            self._latest[topic] = messages[-1]
            return
        for data in messages:
            for status in deserialize_message(data, DiagnosticArray).status:
                values = {pair.key: pair.value for pair in status.values}
                level = int.from_bytes(status.level, "big")
                self._status[status.name] = values | {"level": level, "message": status.message}

    def write(self) -> None:
        """Write the line to standard output."""
        line: dict[str, Any] = {}
        for topic, data in self._latest.items():
            namespace, _, leaf = topic.rpartition("/")
            if leaf in ARM_TOPICS:
                arm = line.setdefault(namespace.strip("/") or "arm", {})
                arm.update(_summary(leaf, deserialize_message(data, ARM_TOPICS[leaf])))
        line["status"] = self._status
        line["faults"] = [f"{name}: {status['message']}" for name, status in self._status.items() if status["level"]]
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
