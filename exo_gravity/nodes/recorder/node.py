# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""recorder: writes a trial to a standard rosbag2 recording (MCAP), with the parameters of every node.

Twice a second it looks for new topics, and records those of all arms, the IMU, diagnostics and parameter changes, each
with the quality of service that its publisher offers and its time of arrival. Three topics exist in the recording only,
all std_msgs/String: `/recorder/session`, JSON of subject, protocol, note and version; `/recorder/parameters`, ROS 2
parameter YAML of each node at the start; and `/recorder/losses`, how many messages were lost, if any were. A
topic that fails is reported, and the others are recorded.
"""

import contextlib
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.msg import ParameterEvent
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String

from exo_gravity import version
from exo_gravity.core.safety.descent import DESCENT_TIMEOUT
from exo_gravity.lab.bag import content
from exo_gravity.lab.bag.content import PARAMETERS, STATES, Session, arm_of, leaf
from exo_gravity.lab.packages import extras
from exo_gravity.nodes.others import OtherNodes, status_values
from exo_gravity.nodes.ros.parameters import declare
from exo_gravity.nodes.ros.run import run
from exo_gravity.nodes.ros.subscriptions import PITCH_YAW, PolledSubscription, Publishers

with extras("recorder", "report"):
    from exo_gravity.lab.bag.writer import BagWriter, offered_qos

TYPES = {  # of each topic that is recorded, or of its last part in an arm's namespace
    STATES: JointState, content.COMMANDS: JointState, content.ASSIST: JointState, content.STEPS: String,
    **dict.fromkeys(content.WEARER, JointState),
    content.IMU: Imu, "/imu/data_raw": Imu, PITCH_YAW: Vector3Stamped, content.DIAGNOSTICS: DiagnosticArray,
    content.PARAMETER_EVENTS: ParameterEvent, content.MARKERS: String,
}  # fmt: skip
REPEATER = "robot_model"  # its joint states are those of the arms once more
UNNAMED = "_NODE_NAME_UNKNOWN_"  # what the RMW calls a publisher whose node it has not discovered yet


@dataclass(frozen=True)
class RecorderTiming:
    """When the recorder looks and writes, and what it keeps until then."""

    drain_period: float = 0.05  #: s between two writes of what has arrived
    discovery_period: float = 0.5  #: s between two searches for new topics
    live_period: float = 0.1  #: s between two lines of live state, and two searches for new nodes
    live_silence: float = 3.0  #: s without a status after which the live line has it no more: its node may have died
    loss_period: float = 5.0  #: s between two warnings of lost messages
    depth: int = 1000  #: queued messages per topic: two seconds at 500 Hz
    #: s without joint states, after which the arms are down: after the launcher's death a bridge lets its arm down, and
    #: this is recorded
    silence: float = 0.5


TIMING = RecorderTiming()


class Recorder(Node):
    """Subscribes, and passes messages to `BagWriter`, whose thread waits for the disk."""

    def __init__(self) -> None:
        super().__init__("recorder", automatically_declare_parameters_from_overrides=True)
        values = declare(self, content.RECORDER)
        self.failure: Exception | None = None  # ends the node, see run()
        session = {name: values[name] for name in ("subject", "protocol", "note")} | {"version": version()}
        Session(**session)
        self._writer = BagWriter(values["output"])
        for topic in (PARAMETERS, content.SESSION):
            self._writer.add_topic(topic, content.STRING, offered_qos(True, True, 1))
        self._write_text(content.SESSION, json.dumps(session))
        self._failed: set[str] = set()  # topics and nodes whose failure was reported
        self._last_states, self._orphaned = -math.inf, math.inf  # monotonic s
        self._losses = ""  # what was reported of them
        self._topics: dict[str, PolledSubscription] = {}
        # `launcher --namespace` renames these for every node: the recording has them by the names that tools know
        self._names = {self.resolve_topic_name(name): name for name in TYPES if name.startswith("/")}
        self._counted: list[Publishers] = []  # of joints and IMU; other topics have several
        self._taken: list[tuple[str, int, bytes]] = []  # topic, time of arrival in ns since 1970, serialised
        self._nodes = OtherNodes(self, on_read=partial(self._guarded, "parameters", self._write_parameters), once=True)
        self._live = LiveLine() if values["live"] else None
        self.create_timer(TIMING.drain_period, self._drain)
        self.create_timer(TIMING.discovery_period, self._discover)
        self.create_timer(TIMING.live_period, self._update_live)
        self.create_timer(TIMING.loss_period, self._report_losses)
        self._discover()
        self.get_logger().info(f"recording to {self._writer.path}")

    @property
    def needed(self) -> bool:
        """Whether an arm may still be on its way down. The node's owner asks only once its launcher has died."""
        now = time.monotonic()
        self._orphaned = min(self._orphaned, now)
        return now - self._last_states < TIMING.silence and now - self._orphaned < DESCENT_TIMEOUT

    def close(self) -> None:
        """Write what has arrived, and close the recording."""
        try:
            self._drain()
            self._report_losses()
            if self._losses:
                self._writer.add_topic(content.LOSSES, content.STRING, offered_qos(True, True, 1))
                self._write_text(content.LOSSES, self._losses)
        finally:
            self._writer.close()
        if self._writer.error:
            self.get_logger().error(str(self._writer.error))
        else:
            self.get_logger().info(f"{self._writer.count} messages in {self._writer.path}")

    def _drain(self) -> None:
        for topic, path in self._topics.items():
            self._guarded(topic, path.poll)
        self._writer.write(sorted(self._taken, key=lambda message: message[1]))
        self._taken.clear()
        self.failure = self._writer.error

    def _discover(self) -> None:
        """Subscribe to new topics."""
        for topic, _types in self.get_topic_names_and_types():
            name = self._names.get(topic, topic)
            msgtype = TYPES.get(name) or TYPES.get(leaf(name))
            if msgtype and topic not in self._topics:
                self._guarded(topic, self._subscribe, topic, name, msgtype)

    def _update_live(self) -> None:
        """Ask new nodes for their parameters, and print the live line."""
        self._guarded("parameters", self._nodes.update)
        if self._live:
            self._guarded("live state", self._live.write)

    def _guarded(self, name: str, function: Callable[..., object], *args: Any) -> None:
        """Call the function; an exception is logged, once for each `name`."""
        try:
            function(*args)
        except Exception as error:
            if name not in self._failed:
                self._failed.add(name)
                self.get_logger().error(f"{name}: {type(error).__name__}: {error}; the rest is recorded")

    @property
    def _missed(self) -> int:
        """How many messages of joints and IMU did not arrive."""
        return sum(publishers.missed for publishers in self._counted)

    def _report_losses(self) -> None:
        losses = f"{self._missed} did not arrive, {self._writer.lost} were not written"
        if self._missed + self._writer.lost and losses != self._losses:
            self._losses = losses
            self.get_logger().warning(f"messages lost so far: {losses}")

    def _subscribe(self, topic: str, name: str, msgtype: type) -> None:
        """Subscribe to a topic, which has that name in the recording."""
        found = self.get_publishers_info_by_topic(topic)
        named = [publisher for publisher in found if publisher.node_name not in (REPEATER, UNNAMED)]
        typed = [publisher for publisher in named if leaf(publisher.topic_type) == msgtype.__name__]
        if not typed:
            return  # a subscriber without a publisher, or a topic of another type; try again later
        offered = [publisher.qos_profile for publisher in typed]
        reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
        latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
        # A recorder must not make the control loops' publishers wait for acknowledgements.
        acknowledged = reliable and msgtype is not JointState
        qos = QoSProfile(
            depth=TIMING.depth,
            reliability=ReliabilityPolicy.RELIABLE if acknowledged else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        self._writer.add_topic(name, typed[0].topic_type, offered_qos(reliable, latched, offered[0].depth or 1))
        publishers = Publishers()
        self._counted += [publishers] if msgtype in (JointState, Imu, Vector3Stamped) else []
        self._topics[topic] = PolledSubscription(
            self, msgtype, topic, partial(self._on_message, name, publishers), qos, raw=True
        )

    def _on_message(self, topic: str, publishers: Publishers, data: bytes, info: dict[str, Any]) -> None:
        self._taken.append((topic, info["received_timestamp"], bytes(data)))
        if leaf(topic) == STATES:
            self._last_states = time.monotonic()
        if self._live:
            self._live.note(topic, data)
        publishers.note(info)

    def _write_parameters(self, node: str, values: dict[str, Any]) -> None:
        # ROS's parameter files have no empty lists.
        given = {name: value for name, value in values.items() if value != []}
        text = yaml.safe_dump({node: {"ros__parameters": given}}, default_flow_style=None, width=120)
        self._write_text(PARAMETERS, text)

    def _write_text(self, topic: str, text: str) -> None:
        now = self.get_clock().now().nanoseconds
        self._writer.write([(topic, now, serialize_message(String(data=text)))])


class LiveLine:
    """Keeps the latest state, and writes it as one line of JSON for `trial`.

    {"right": {"names": [4], "position": [4 rad], "effort": [4 Nm], "step": {...}},
    "status": {"right/can_bridge": {"level": 2, "message": "...", "state": "fault", ...}},
    "faults": ["right/can_bridge: ..."]}

    status: the newest of each node on /diagnostics that still reports, its values included. faults: those whose
    level is not OK.
    """

    def __init__(self) -> None:
        self._latest: dict[str, bytes] = {}
        self._status: dict[str, tuple[float, dict[str, Any]]] = {}  # monotonic s of its arrival, and its values

    def note(self, topic: str, data: bytes) -> None:
        """Keep the newest message of a topic, and the newest status of each node."""
        if leaf(topic) in (STATES, content.STEPS):
            self._latest[topic] = data
        elif topic == content.DIAGNOSTICS:
            for status in deserialize_message(data, DiagnosticArray).status:
                self._status[status.name] = time.monotonic(), status_values(status)

    def write(self) -> None:
        """Write the line to standard output."""
        line: dict[str, Any] = {}
        for topic, data in self._latest.items():
            name, arm = leaf(topic), line.setdefault(arm_of(topic), {})
            message = deserialize_message(data, TYPES[name])
            if name == content.STEPS:
                with contextlib.suppress(ValueError):  # the report states it
                    arm["step"] = json.loads(message.data)
            else:
                arm |= {"names": [*message.name], "position": [*message.position], "effort": [*message.effort]}
        oldest = time.monotonic() - TIMING.live_silence
        status = {name: values for name, (arrived, values) in self._status.items() if arrived > oldest}
        faults = [f"{name}: {values['message']}" for name, values in status.items() if values["level"]]
        line |= {"status": status, "faults": faults}
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


def main() -> None:
    """Entry point of the executable `recorder`."""
    raise SystemExit(run(Recorder, priority=5))  # below the control loop; what arrives is to be written
