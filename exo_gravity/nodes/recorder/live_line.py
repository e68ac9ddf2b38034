"""The latest state of all arms as a line of JSON, which the `recorder` prints for the program that started it."""

from __future__ import annotations

import json
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String

ARM_TOPICS = {"joint_states": JointState, "effort_commands": JointState, "wearer_step": String}


class LiveLine:
    """Keeps the latest state, and writes it as one line of JSON for `trial`.

    {"right": {"position": [4 rad], "velocity": [...], "effort": [...], "command": [...], "names": [...],
    "step": {...}}, "status": {"right/can_bridge": {"level": 2, "message": "...", "state": "fault", ...}},
    "faults": ["right/can_bridge: ..."], "recorder": {"messages": 1000, "lost": 0}}

    status: the newest of each node on /diagnostics, its values included. faults: those whose level is not OK, as text.
    recorder: the number of messages that it wrote and lost.
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

    def write(self, recorder: dict[str, int]) -> None:
        """Write the line to standard output."""
        line: dict[str, Any] = {}
        for topic, data in self._latest.items():
            namespace, _, leaf = topic.rpartition("/")
            if leaf in ARM_TOPICS:
                arm = line.setdefault(namespace.strip("/") or "arm", {})
                arm.update(_summary(leaf, deserialize_message(data, ARM_TOPICS[leaf])))
        line["recorder"] = recorder
        line["status"] = self._status
        line["faults"] = [f"{name}: {status['message']}" for name, status in self._status.items() if status["level"]]
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


def _summary(leaf: str, message: JointState | String) -> dict[str, Any]:
    if leaf == "wearer_step":
        try:
            return {"step": json.loads(message.data)}
        except ValueError:  # the report states it
            return {}
    if leaf == "effort_commands":
        return {"command": list(message.effort)}
    fields = {field: list(getattr(message, field)) for field in ("position", "velocity", "effort")}
    return {"names": list(message.name), **fields}
