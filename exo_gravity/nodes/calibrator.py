# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrator: moves the arm through the poses of a calibration, in the compensator's place.

It answers joint states with efforts as `compensator` does. While the bridge starts, it answers with the expected weight
of the hanging arm; once the bridge reports `active`, the tour (lab/calibration/tour.py) begins. After trouble it
withdraws, so that the bridge lets the arm down. It prints one line of JSON for each event:

    {"progress": "pose 3 of 12: ..."}   {"observation": {"theta": [4 rad], ..., "speed": 0.1}}
    {"trouble": "elbow: ..."}           {"done": true}
"""

import json
import sys
import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import Torque
from exo_gravity.core.safety.command import State
from exo_gravity.core.trunk.inputs import TiltInput
from exo_gravity.core.vocabulary import UNKNOWN
from exo_gravity.lab.calibration.tour import calibrator_table, line_of, side_of, tour_of
from exo_gravity.lab.vocabulary import NodeState
from exo_gravity.nodes.others import status_values
from exo_gravity.nodes.ros.messages import ERROR, OK, WARN, Diagnostics, by_name
from exo_gravity.nodes.ros.parameters import declare, given_to
from exo_gravity.nodes.ros.run import run
from exo_gravity.nodes.ros.subscriptions import (
    NEWEST_ONLY,
    SHORT_QUEUE,
    PeriodicThread,
    PolledSubscription,
    Publishers,
    ThreadedNode,
    TiltSubscription,
    second_publisher,
)

REPORT_PERIOD = 0.1  # s
PLAN_PERIOD = 0.05  # s


class CalibratorNode(ThreadedNode):
    """The ROS shell around `lab.calibration.tour.Tour`."""

    def __init__(self) -> None:
        super().__init__("calibrator", automatically_declare_parameters_from_overrides=True)
        values = declare(self, calibrator_table(given_to(self)))
        self._names, self._uses_imu = values["joint_names"], values["use_imu"]
        self._tour = tour_of(values)
        self._tilt = TiltInput(side_of(values), values["tilt_timeout"])
        self._bridge = f"{self.get_namespace().strip('/')}/can_bridge".lstrip("/")
        self._bridge_state, self._bridge_message = "", "no can_bridge has reported"
        self._began = False
        self._reported: dict[str, Any] = {"progress": "", "trouble": "", "done": False}  # printed last
        self._printed = 0  # observations
        self._diagnostics = Diagnostics(self)
        self._sources = {"joint_states": Publishers()}  # of what the torque depends on
        self._publisher = self.create_publisher(JointState, "effort_commands", 1)
        self._command = JointState(name=self._names)  # one message, reused
        self._lock = threading.Lock()  # guards tilt and state: joint states arrive on another thread
        self._joint_states = PolledSubscription(self, JointState, "joint_states", self._on_joint_states, NEWEST_ONLY)
        if self._uses_imu:
            self._trunk = TiltSubscription(self, self._tilt, self._lock, self._on_refused_tilt, qos=SHORT_QUEUE)
            self._sources |= self._trunk.senders
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.create_timer(REPORT_PERIOD, self._report)
        # Poses are chosen on a thread of their own: neither joint states nor tilts may wait for it.
        self.threads += [self._joint_states, PeriodicThread("plan", self._tour.plan, PLAN_PERIOD)]
        for thread in self.threads:
            thread.start()

    def close(self) -> None:
        """Stop answering joint states, and report what is still unreported."""
        super().close()
        self._report()

    def _on_joint_states(self, message: JointState, info: dict[str, Any]) -> None:
        self._command.header.stamp = message.header.stamp
        try:
            self._sources["joint_states"].note(info)
            self._tour.trouble = self._tour.trouble or second_publisher(self._sources)
            effort = self._effort(by_name(message, "position", self._names), by_name(message, "velocity", self._names))
        except ParameterError as error:
            self._tour.trouble, effort = f"joint_states: {error}", None
        self._command.effort = effort or ()
        self._publisher.publish(self._command)
        if self._uses_imu:
            self._trunk.poll()

    def _effort(self, position: tuple[float, ...], velocity: tuple[float, ...]) -> Torque | None:
        """Return the effort (n,) in Nm, None to withdraw."""
        now = time.monotonic()
        with self._lock:
            tilt, state = self._tilt.at(now), self._bridge_state
            problem = self._tilt.problem(now).text if self._uses_imu else ""
        if problem and self._began:
            self._tour.trouble = self._tour.trouble or problem
        if problem or self._tour.trouble:
            return None
        self._began = self._began or state == State.ACTIVE.value
        return self._tour.step(now, position, velocity, tilt) if self._began else self._tour.wait(position, tilt)

    def _on_refused_tilt(self, topic: str, error: ParameterError) -> None:
        self.get_logger().error(f"{topic}: {error}", throttle_duration_sec=1.0)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._bridge:
                values = status_values(status)
                state, has_fault = values.get("state", ""), values.get("fault", "none") != "none"
                with self._lock:
                    self._bridge_state, self._bridge_message = state, status.message
                readings = [values.get(f"{name} temperature (degC)", UNKNOWN) for name in self._names]
                self._tour.temperature = () if UNKNOWN in readings else tuple(map(float, readings))
                has_left = self._began and not self._tour.done and state != State.ACTIVE.value
                if (has_fault or has_left) and not self._tour.trouble:
                    self._tour.trouble = status.message if has_fault else f"the bridge stopped carrying: {state}"

    def _report(self) -> None:
        tour, trouble = self._tour, self._tour.trouble
        lines = [line_of(one) for one in tour.measured[self._printed :]]
        self._printed += len(lines)
        progress = tour.progress if self._began else f"waiting for the arm to be carried: {self._bridge_message}"
        reported = {"progress": progress, "trouble": trouble, "done": tour.done}
        lines += [json.dumps({key: value}) for key, value in reported.items() if value != self._reported[key]]
        self._reported = reported
        sys.stdout.writelines(f"{line}\n" for line in lines)
        sys.stdout.flush()
        level = ERROR if trouble else OK if self._began else WARN
        working = NodeState.MEASURING if self._began else NodeState.WAITING
        state = NodeState.WITHDRAWN if trouble else NodeState.DONE if tour.done else working
        self._diagnostics.report(
            level,
            f"withdrawn: {trouble}" if trouble else progress,
            {"state": state, "poses": len(tour.measured)},
        )


def main() -> None:
    """Entry point of the executable `calibrator`."""
    raise SystemExit(run(CalibratorNode, priority=15))
