# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Subscriptions, most of them outside the executor: on a thread with a wait set for one alone, or polled by its owner.

rclpy's executor rebuilds its wait set, services included, for every message. That is most of a message's cost
(measured, there and back at 500 Hz: 35 + 21 % of a core, against 14 + 11 % here; at 2,000 messages a second it is most
of a core). A flood is shed before Python sees it: the middleware keeps `qos.depth` messages, and a thread sleeps for
`pause` between two polls.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3Stamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from exo_gravity.core.arm.rotation import ZERO, unit_quaternion, up_in_body
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trunk.inputs import NOT_REPORTED, TiltInput
from exo_gravity.nodes.ros.messages import to_nanoseconds

NEWEST_ONLY = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
# For a reader that polls between other work: a deeper queue lets it notice a second publisher.
SHORT_QUEUE = QoSProfile(depth=8, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # reliable
# Of a service and its clients. By default 10 requests wait, and an eleventh pushes the oldest out: of 100 that came at
# once 10 to 30 were answered, and a request to let the arm down was lost among them. An executor answers 256 in 0.3 s.
MANY_REQUESTS = QoSProfile(depth=256)
STOP_CHECK_PERIOD = 0.1  # s
POLL_PAUSE = 0.0004  # s, less than the shortest period of a control loop
MAX_PUBLISHERS = 4  # publishers of one topic that a node can distinguish
DISTRUST_TIME = 0.2  # s for which a topic is not trusted after a second publisher was seen
DATA, PITCH_YAW = "/imu/data", "/imu/pitch_yaw"

Callback = Callable[[Any, dict[str, Any]], None]


class PeriodicThread:
    """A thread that calls `function` again and again after `start`, and sleeps for `pause` s after each call.

    failure: the exception of `function` that ended the thread, or None.
    """

    def __init__(self, name: str, function: Callable[[], None], pause: float) -> None:
        self.failure: Exception | None = None
        self._function, self._pause = function, pause
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread, before the node is destroyed."""
        self._stopping = True
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._function()
                time.sleep(self._pause)
        except Exception as error:
            self.failure = error


class ThreadedNode(Node):
    """A node that also works on `threads` of its own; `run` ends it when one of them fails."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.threads: list[PeriodicThread] = []

    @property
    def failure(self) -> Exception | None:
        """The exception that ended one of the threads, or None."""
        return next((thread.failure for thread in self.threads if thread.failure), None)

    def close(self) -> None:
        """End the threads, the last one first."""
        for thread in reversed(self.threads):
            thread.stop()


class PolledSubscription(PeriodicThread):
    """Calls `callback(message, info)` for each message of `topic`: on a thread after `start`, or in each `poll`.

    pause: s for which the thread sleeps after each poll; of what arrives meanwhile it gets the last `qos.depth`.
    raw: whether the callback gets the messages as bytes.
    """

    def __init__(
        self,
        node: Node,
        msgtype: type,
        topic: str,
        callback: Callback,
        qos: QoSProfile = NEWEST_ONLY,
        pause: float = POLL_PAUSE,
        raw: bool = False,
    ) -> None:
        super().__init__(topic, lambda: self.poll(STOP_CHECK_PERIOD), pause)
        self._callback, self._depth = callback, qos.depth
        self._wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)
        group = MutuallyExclusiveCallbackGroup()
        self._subscription = node.create_subscription(
            msgtype, topic, lambda message: None, qos, callback_group=group, raw=raw
        )
        group.beginning_execution(self._subscription)  # which never ends: the executor handles none of its messages

    def poll(self, timeout: float = 0.0) -> None:
        """Call back for each queued message, on the caller's thread; wait up to `timeout` s for the first one.

        At most as many messages as the queue holds are taken, however many arrive meanwhile.
        """
        handle = self._subscription.handle
        if timeout > 0.0:
            with handle:
                self._wait_set.clear_entities()
                self._wait_set.add_subscription(handle)
                self._wait_set.wait(int(timeout * 1e9))
        for _ in range(self._depth):
            item = handle.take_message(self._subscription.msg_type, self._subscription.raw)
            if item is None:
                return
            self._callback(*item)


class Publishers:
    """Tells the publishers of one topic apart. Each numbers its messages from 1, and rclpy passes the numbers on.

    So a second publisher shows at once. Discovery would still list a killed publisher for 20 s.

    missed: how many messages were published and not received.
    """

    def __init__(self) -> None:
        self.missed = 0
        self._newest: deque[int] = deque(maxlen=MAX_PUBLISHERS)  # number of each publisher's last message
        self._changed = -math.inf  # monotonic s

    def note(self, info: dict[str, Any]) -> bool:
        """Note a message; return whether its publisher is not that of the message before: its number is no higher.

        A message continues the nearest lower number, or is the first of a new publisher.

        info: of the message, as rclpy passes it to a callback.

        Raises RuntimeError if the middleware does not number messages.
        """
        number = info["publication_sequence_number"]
        if number is None:
            raise RuntimeError("the middleware does not number messages: set RMW_IMPLEMENTATION=rmw_fastrtps_cpp")
        last = self._newest[-1] if self._newest else 0
        if previous := max((other for other in self._newest if other < number), default=0):
            self.missed += number - previous - 1
            self._newest.remove(previous)
        self._newest.append(number)
        if has_changed := bool(number <= last):
            self._changed = time.monotonic()
        return has_changed

    @property
    def are_several(self) -> bool:
        """Whether, within DISTRUST_TIME, a message came from another publisher than the one before."""
        return time.monotonic() - self._changed < DISTRUST_TIME


def second_publisher(sources: Mapping[str, Publishers]) -> str:
    """Return which topic of `sources` has more than one publisher, as a sentence; '' if none has."""
    topics = [topic for topic, publishers in sources.items() if publishers.are_several]
    return f"more than one publisher of {topics[-1]}" if topics else ""


class TiltSubscription:
    """Passes the trunk's tilt on to `target`: from `/imu/data`, or from `/imu/pitch_yaw` where only that is published.

    lock: held while `target`, on_motion and on_tilt are called.
    on_refusal(topic, error): a message is impossible; the last tilt then grows old.
    on_motion(now, force, rate, age): the trunk's motion, in its axes: s, m/s^2 (3,), rad/s (3,), s.
    on_tilt(now): `target` has a message of `now`, s.
    Messages are taken in `poll` alone. qos: a deeper queue lets `senders`, the publishers by topic, tell two apart.
    """

    def __init__(
        self,
        node: Node,
        target: TiltInput,
        lock: threading.Lock,
        on_refusal: Callable[[str, ParameterError], object] = lambda topic, error: None,
        on_motion: Callable[..., object] = lambda *sample: None,
        on_tilt: Callable[[float], object] = lambda now: None,
        qos: QoSProfile = NEWEST_ONLY,
    ) -> None:
        self._node, self._target, self._lock = node, target, lock
        self._on_refusal, self._on_motion, self._on_tilt = on_refusal, on_motion, on_tilt
        self.senders = {topic: Publishers() for topic in (DATA, PITCH_YAW)}
        self._topics = (
            PolledSubscription(node, Imu, DATA, self._on_data, qos),
            PolledSubscription(node, Vector3Stamped, PITCH_YAW, self._on_pitch_yaw, qos),
        )

    def poll(self) -> None:
        """Take the newest messages of each topic, on the caller's thread."""
        for topic in self._topics:
            topic.poll()

    def _on_data(self, message: Imu, info: dict[str, Any]) -> None:
        if message.orientation_covariance[0] == NOT_REPORTED:
            return  # another driver's raw data
        q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
        rate = ZERO if message.angular_velocity_covariance[0] == NOT_REPORTED else (w.x, w.y, w.z)

        def set_gravity(now: float, age: float) -> None:
            x, y, z = up_in_body(unit_quaternion("orientation", (q.x, q.y, q.z, q.w)))
            self._target.set_gravity(now, (-x, -y, -z), rate, age)
            if message.linear_acceleration_covariance[0] != NOT_REPORTED:
                self._on_motion(now, (a.x, a.y, a.z), rate, age)

        self._pass_on(DATA, message.header.stamp, info, set_gravity)

    def _on_pitch_yaw(self, message: Vector3Stamped, info: dict[str, Any]) -> None:
        pitch, roll = message.vector.y, message.vector.x
        self._pass_on(
            PITCH_YAW, message.header.stamp, info, lambda now, age: self._target.set_tilt(now, pitch, roll, age)
        )

    def _pass_on(self, topic: str, stamp: Time, info: dict[str, Any], use: Callable[[float, float], None]) -> None:
        """Call `use` with the present monotonic time in s, and the age of the stamp in s by the node's clock."""
        self.senders[topic].note(info)
        age = (self._node.get_clock().now().nanoseconds - to_nanoseconds(stamp)) * 1e-9
        try:
            with self._lock:
                now = time.monotonic()
                use(now, age)
                self._on_tilt(now)
        except ParameterError as error:
            self._on_refusal(topic, error)
