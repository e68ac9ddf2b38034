# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""compensator: joint states and trunk tilt in, effort commands out, at the rate at which joint states arrive.

It answers each joint state at once, with the joint state's stamp, so that `can_bridge` can tell how old the reading is.
Where there is no safe answer it withdraws: it sends a command without efforts, and puts the reason on /diagnostics. To
`can_bridge` silence means the same, a little later.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rclpy.context import Context
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from exo_gravity.core.compensation.compensator import CLIENTS, Compensation, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.support import TOPIC as SUPPORT_REQUEST
from exo_gravity.core.compensation.terms.terms import Terms
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import Rate
from exo_gravity.core.params import installed, loaded
from exo_gravity.core.vocabulary import NO_REASON, NONE, CompensatorState, Status, Withdrawal, words
from exo_gravity.hardware.clock import set_realtime_priority
from exo_gravity.nodes.compensator.arm import (
    JointStateInterface,
    MultiArrayInterface,
    check_side,
    declared,
    report,
    sentence,
    warnings_of,
)
from exo_gravity.nodes.ros.inner import why_too_old
from exo_gravity.nodes.ros.messages import ERROR, OK, STALE, WARN, Diagnostics, known, milliseconds, row, to_nanoseconds
from exo_gravity.nodes.ros.parameters import accept_changes
from exo_gravity.nodes.ros.run import run
from exo_gravity.nodes.ros.subscriptions import (
    NEWEST_ONLY,
    SHORT_QUEUE,
    PolledSubscription,
    Publishers,
    ThreadedNode,
    TiltSubscription,
    second_publisher,
)

SILENCE = 0.5  # s without joint states until diagnostics report it
REPORT_PERIOD = 0.5  # s
# s between two looks, so that a sender that floods its topic does not slow the answers down
ASSIST_PAUSE, REQUEST_PAUSE = 0.002, 0.1
MAX_CHANGES = 16  # answers whose reason is new, waiting for the report


class CompensatorNode(ThreadedNode):
    """The ROS shell around a compensator.

    context: of a compensator in can_bridge's process, which calls `answer`. Otherwise joint states come by their topic.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__("compensator", context=context, automatically_declare_parameters_from_overrides=True)
        self._lock = threading.Lock()  # guards the control: joint states arrive on another thread
        table, values, read, self._urdf = declared(self)
        self._side = values.get("side", "")
        check_side(self.get_namespace(), self._side)
        self._names = values["joint_names"]
        settings = read(values)
        self._control = Compensator(settings, self._names)
        self._serve_wearer(self._control.terms)
        is_called = context is not None  # by can_bridge: then the topic is polled in `answer`
        self._interface = self._open_interface(values, is_called)
        self._diagnostics = Diagnostics(self)
        self._answer = Compensation(None, NO_REASON)
        self._changes: deque[Compensation] = deque(maxlen=MAX_CHANGES)
        self._last_answer = -math.inf
        self._answers = self._rides = 0
        self._rate = Rate()
        self._refused_topic, self._refusal = NONE, ""
        topic = self._interface.topic
        self._source = Publishers()
        self._sources = {topic: self._source}  # of what the torque depends on
        self._joint_states = PolledSubscription(
            self, JointState, topic, self._on_joint_states, SHORT_QUEUE if is_called else NEWEST_ONLY, raw=is_called
        )
        self.threads.append(self._joint_states)
        self._poll_tilt: Callable[[], None] = lambda: None
        if values["use_imu"]:
            tilt = TiltSubscription(
                self, self._control.tilt, self._lock, self._refused, self._on_motion, qos=SHORT_QUEUE
            )
            self._sources |= tilt.senders
            self._poll_tilt = tilt.poll
        accept_changes(self, table, read, self._apply)
        # Only the executor's thread reports: diagnostics are not for two threads.
        self._changed = self.create_guard_condition(self._report_changes)
        self.create_timer(REPORT_PERIOD, self._report_current)
        self.get_logger().info(sentence(settings, self._side))
        for thread in self.threads:
            if not is_called or thread is not self._joint_states:
                thread.start()
        set_realtime_priority(values["thread_priority"], self.get_logger().warning)

    def _serve_wearer(self, terms: Terms) -> None:
        """Add assistance, support on request, and the services of clients, such as `weigh`."""
        self._assist = terms.assist
        self._assistant, self._requester = Publishers(), Publishers()
        self.threads += [
            PolledSubscription(self, JointState, "assist_efforts", self._on_assist_efforts, pause=ASSIST_PAUSE),
            PolledSubscription(
                self, JointState, SUPPORT_REQUEST, self._on_support_request, SHORT_QUEUE, pause=REQUEST_PAUSE
            ),
        ]
        makers = {name: loaded(CLIENTS, name, "client") for name in installed(CLIENTS)}
        self._movers = {name: make(self._control, self._names) for name, make in makers.items()}
        for name, client in self._movers.items():
            self.create_service(Trigger, f"~/{name}", partial(self._begin, client))

    def _open_interface(self, values: Mapping[str, Any], is_called: bool) -> JointStateInterface | MultiArrayInterface:
        """Return the way in and out; is_called: by can_bridge in the same process. Raises ParameterError."""
        if values.get("command_interface") != "multi_array":
            return JointStateInterface(self, self._names)
        if is_called:
            raise ParameterError("command_interface", "multi_array", "joint_state in one process with can_bridge")
        interface = MultiArrayInterface(self, self._names, values)
        self.threads.append(interface)
        return interface

    def answer(self, message: JointState) -> JointState | None:
        """Return the efforts for a joint state of can_bridge, on its control thread; None once this has failed.

        Of the topic, only other publishers are noticed.
        """
        try:
            if self._joint_states.failure is None:
                self._joint_states.poll()
                return self._answer_to(message)
        except Exception as error:
            self._joint_states.failure = error
        return None

    def _on_joint_states(self, message: JointState | bytes, info: dict[str, Any]) -> None:
        self._source.note(info)
        if not isinstance(message, bytes):
            self._answer_to(message)

    def _answer_to(self, message: JointState) -> JointState | None:
        now = time.monotonic()
        try:
            theta, velocity = self._interface.read(message)
            if self._urdf:
                self._urdf.follow(message.name, message.position)
            if self._interface.problem:  # no step: there is no torque to change
                answer = Compensation(None, Status(Withdrawal.OUTPUT_FAULT, self._interface.problem))
            else:
                with self._lock:
                    self._control.applied = known(message, "effort", self._names, exact=False)
                    answer = self._control.step(now, theta, velocity)
        except ParameterError as error:
            refused = self._refused(self._interface.topic, error)
            answer = Compensation(None, Status(Withdrawal.INVALID_JOINT_STATES, refused))
        if problem := second_publisher(self._sources):
            answer = Compensation(None, Status(Withdrawal.SECOND_PUBLISHER, problem))
        efforts = self._interface.send(now, message, answer)
        self._answers += answer.effort is not None
        self._rides += bool(answer.held and not self._answer.held)
        changed = answer.reason != self._answer.reason or bool(answer.held) != bool(self._answer.held)
        self._answer, self._last_answer = answer, now
        if changed:
            self._changes.append(answer)
        if changed or self._control.lost:
            self._changed.trigger()
        self._poll_tilt()  # the answer does not wait for it: a tilt is turned on by its angular velocity
        return efforts

    def _on_assist_efforts(self, message: JointState, info: dict[str, Any]) -> None:
        now, stamp = self._times_of(message)
        from_another = self._assistant.note(info)
        with self._lock:
            self._assist.receive(now, message.name, message.effort, stamp, from_another)

    def _on_support_request(self, message: JointState, info: dict[str, Any]) -> None:
        now, stamp = self._times_of(message)
        from_another = self._requester.note(info)
        with self._lock:
            self._control.support_request.receive(now, message.name, message.position, stamp, from_another)

    def _times_of(self, message: JointState) -> tuple[float, float]:
        """Return the present time and that of the message's stamp, both in monotonic s."""
        now = time.monotonic()
        return now, now - (self.get_clock().now().nanoseconds - to_nanoseconds(message.header.stamp)) * 1e-9

    def _on_motion(self, *sample: Any) -> None:
        if self._control.settings.inertial:  # each sample takes a fit, under the lock
            self._control.motion.add(*sample)

    def _refused(self, topic: str, error: ParameterError) -> str:
        """Note an impossible message. Its value goes to /diagnostics only: a hostile sender could fill the log."""
        self._refused_topic, self._refusal = topic, str(error)
        return f"{topic}: {error.name} must be {error.expected}"

    def _apply(self, settings: Settings, _changed: set[str]) -> None:
        with self._lock:
            self._control.apply(settings)
        self.get_logger().info(sentence(settings, self._side))

    def _begin(self, client: Any, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._lock:
            problem = why_too_old(self) or client.begin(self._rate.value)
        response.success, response.message = not problem, str(problem) or client.help
        return response

    def _values(self, now: float, answer: Compensation) -> dict[str, object]:
        return {
            "reason": answer.reason.code,
            "reason text": answer.reason,
            "warnings": words(*warnings_of(self._control, answer, self._names)),
            **self._interface.values,
            **({"joints taken to be at 0": words(*self._urdf.fixed)} if self._urdf else {}),
            "limits acting": words(*[f"max_effort ({self._names[joint]})" for joint in answer.clamped]),
            "rate (Hz)": row([self._rate.update(now, self._answers)], 1),
            "age of joint states (ms)": milliseconds(now - self._last_answer),
            "age of tilt (ms)": milliseconds(self._control.tilt.age(now)),
            "answers": self._answers,
            "rides": self._rides,
            "joint states missed": self._source.missed,
            "effort (Nm)": row(answer.effort) if answer.effort else NONE,
            **report(self._control, answer, self._names),
            **{key: value for client in self._movers.values() for key, value in client.values.items()},
            "refused message": self._refused_topic,
            "refused message text": self._refusal,
        }

    def _report_changes(self) -> None:
        if self._control.lost:
            lost, self._control.lost = self._control.lost, {}
            where = "the cuff: is an arm in it?" if "mode" in lost else "the hand:"
            self.get_logger().warning(f"the load has left {where} Set now: {lost}")
            self.set_parameters([Parameter(name, value=value) for name, value in lost.items()])
        while self._changes:
            self._report(self._changes.popleft())

    def _report_current(self) -> None:
        self._report_changes()
        self._report(self._answer)

    def _report(self, answer: Compensation) -> None:
        now = time.monotonic()
        level, state, message = self._headline(now, answer)
        self._diagnostics.report(level, message, {"state": state, **self._values(now, answer)})

    def _headline(self, now: float, answer: Compensation) -> tuple[bytes, CompensatorState, str]:
        if self._interface.problem:
            return ERROR, CompensatorState.FAULTED, self._interface.problem
        if now - self._last_answer > SILENCE:
            level, state = (STALE, CompensatorState.STOPPED) if self._answers else (WARN, CompensatorState.WAITING)
            return level, state, f"waiting for {self._interface.topic}"
        if answer.effort is None:
            return ERROR, CompensatorState.WITHDRAWN, f"withdrawn: {answer.reason}"
        warnings = warnings_of(self._control, answer, self._names).values()
        return WARN if warnings else OK, CompensatorState.COMPENSATING, "; ".join(warnings) or "compensating"


def main() -> None:
    """Entry point of the executable `compensator`."""
    raise SystemExit(run(CompensatorNode, priority=15))
