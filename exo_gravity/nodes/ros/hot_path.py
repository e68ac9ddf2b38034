"""Subscriptions, most of them outside the executor: on a thread with a wait set for one alone, or polled by its owner.

rclpy's executor rebuilds its wait set, services included, for every message. That is most of a message's cost
(measured, there and back at 500 Hz: 35 + 21 % of a core, against 14 + 11 % here; at 2,000 messages a second it is most
of a core). A flood is shed before Python sees it: the middleware keeps `qos.depth` messages, and a thread rests for
`pause` between two looks. `WaitSet` and `take_message` are inner interfaces of rclpy, which `wait_for_message` uses.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3Stamped
from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.rotation import unit_quaternion, up_in_body
from exo_gravity.core.trunk.tilt_input import STILL, TiltInput
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.nodes.ros.messages import to_nanoseconds

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # reliable
STOP_CHECK_PERIOD = 0.1  # s
PAUSE = 0.0004  # s, less than the shortest period of a control loop
MAX_PUBLISHERS = 4  # of one topic whose messages are counted
DISTRUST = 0.2  # s for which a topic is not trusted after a second publisher was seen
COUNT_PERIOD = 0.5  # s between two counts of the publishers
DATA, PITCH_YAW = "/imu/data", "/imu/pitch_yaw"
NOT_REPORTED = -1.0  # first entry of a covariance (REP-145)

Callback = Callable[[Any, dict[str, Any]], None]


class Unexecuted(CallbackGroup):
    """Keeps its subscriptions out of the executor's wait set."""

    def can_execute(self, entity: Any) -> bool:
        """Return that no entity may be executed."""
        return False

    beginning_execution = ending_execution = can_execute


class Repeated:
    """Calls `function` on a thread after `start`, with a rest of `pause` s after each call."""

    def __init__(self, name: str, function: Callable[[], None], pause: float) -> None:
        self.failure: Exception | None = None  #: raised by the function; ends the thread
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


class HotPath(Repeated):
    """Calls `callback(message, info)` for each message of `topic`: on a thread after `start`, or in each `poll`.

    pause: s for which the thread rests after each look; of what arrives meanwhile, it gets the last `qos.depth`.
    """

    def __init__(
        self, node: Node, msgtype: type, topic: str, callback: Callback, qos: QoSProfile = NEWEST, pause: float = PAUSE
    ) -> None:
        super().__init__(topic, lambda: self.poll(STOP_CHECK_PERIOD), pause)
        self._callback, self._depth = callback, qos.depth
        self._subscription = node.create_subscription(msgtype, topic, callback, qos, callback_group=Unexecuted())
        self._wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)

    def poll(self, timeout: float = 0.0) -> None:
        """Call back for each queued message, on the caller's thread; wait up to `timeout` s for the first one.

        It ends after as many as the queue holds, however many arrive meanwhile.
        """
        handle, msgtype = self._subscription.handle, self._subscription.msg_type
        if timeout > 0.0:
            with handle:
                self._wait_set.clear_entities()
                self._wait_set.add_subscription(handle)
                self._wait_set.wait(int(timeout * 1e9))
        for _ in range(self._depth):
            item = handle.take_message(msgtype, False)
            if item is None:
                return
            self._callback(*item)


class LossCounter:
    """Counts missing messages by the numbers that each publisher of a topic gives them, from 1. lost: so far."""

    def __init__(self) -> None:
        self.lost = 0
        self._newest: deque[int] = deque(maxlen=MAX_PUBLISHERS)  # number of each publisher's last message

    def count(self, number: int) -> None:
        """Count the message `number`, 0 if it has none.

        It continues the nearest lower number, or is the first of a new publisher.
        """
        previous = max((other for other in self._newest if other < number), default=0)
        if previous:
            self.lost += number - previous - 1
            self._newest.remove(previous)
        if number:
            self._newest.append(number)


class Drain(LossCounter):
    """A subscription to `topic` that queues up to `qos.depth` serialised messages until `take` is called.

    The middleware notes their time of arrival. counts_lost: whether to count the messages that did not arrive.
    """

    def __init__(self, node: Node, msgtype: type, topic: str, qos: QoSProfile, counts_lost: bool = False) -> None:
        super().__init__()
        self.topic = topic
        self._counts_lost = counts_lost
        self._subscription = node.create_subscription(
            msgtype, topic, lambda message: None, qos, raw=True, callback_group=Unexecuted()
        )

    def take(self) -> list[tuple[int, bytes]]:
        """Return the messages since the last call: time of arrival in ns since 1970, and bytes."""
        taken = []
        subscription = self._subscription
        with subscription.handle:
            while (item := subscription.handle.take_message(subscription.msg_type, subscription.raw)) is not None:
                data, about = item
                taken.append((about["received_timestamp"], bytes(data)))
                if self._counts_lost:
                    self.count(about.get("publication_sequence_number") or 0)
        return taken


class SolePublisher:
    """Detects a second publisher of `topic` by the `info` of each message, which rclpy passes on.

    Each publisher numbers its messages from 1, so from a single publisher the numbers rise. A second one shows at once,
    without discovery, which still lists a killed publisher for 20 s. Where the middleware does not number messages, the
    publishers that discovery lists are counted instead.
    """

    def __init__(self, node: Node, topic: str, clock: Clock = COMPUTER_CLOCK) -> None:
        self._node, self._clock = node, clock
        self._topic = node.resolve_topic_name(topic)
        self._number = 0
        self.missed = 0  #: messages that were published and not received, where the middleware numbers them
        self._count = 1
        self._counted = -math.inf  # monotonic s

    def is_another(self, info: dict[str, Any]) -> bool:
        """Return whether this message comes from a different publisher than the previous one."""
        number = info.get("publication_sequence_number")
        if number is None:
            return self._count_publishers() > 1
        previous, self._number = self._number, number
        if number <= previous:
            return True
        self.missed += number - previous - 1 if previous else 0
        return False

    def _count_publishers(self) -> int:
        """Return the number of publishers that discovery lists, at most COUNT_PERIOD old."""
        now = self._clock.monotonic()
        if self._counted == -math.inf:
            self._node.get_logger().warning(
                f"{self._topic}: the middleware does not number messages: a second publisher is detected up to "
                f"{COUNT_PERIOD:g} s late"
            )
        if now - self._counted > COUNT_PERIOD:
            self._counted, self._count = now, self._node.count_publishers(self._topic)
        return self._count


class TiltSubscription:
    """Passes the trunk's tilt on to `target`, under `lock`: `/imu/data`, and `/imu/pitch_yaw` of who sends that alone.

    on_refusal(topic, error): a message is impossible; the last tilt then grows old. on_intruder(topic): a second
    publisher sends on it. on_motion(now, specific force (3,) m/s^2, angular velocity (3,) rad/s, age in s): a sample
    of the trunk's motion, in its axes, under `lock` too. on_tilt(now): `target` has a message of `now`, in s.
    """

    def __init__(
        self,
        node: Node,
        target: TiltInput,
        lock: threading.Lock,
        on_refusal: Callable[[str, ParameterError], object] = lambda topic, error: None,
        on_intruder: Callable[[str], object] = lambda topic: None,
        on_motion: Callable[..., object] = lambda *sample: None,
        on_tilt: Callable[[float], object] = lambda now: None,
    ) -> None:
        self._node, self._target, self._lock = node, target, lock
        self._on_refusal, self._on_intruder, self._on_motion = on_refusal, on_intruder, on_motion
        self._on_tilt = on_tilt
        self._senders = {topic: SolePublisher(node, topic) for topic in (DATA, PITCH_YAW)}
        node.create_subscription(Imu, DATA, self._on_data, NEWEST)
        node.create_subscription(Vector3Stamped, PITCH_YAW, self._on_pitch_yaw, NEWEST)

    def _on_data(self, message: Imu, info: dict[str, Any]) -> None:
        if message.orientation_covariance[0] == NOT_REPORTED:
            return  # another driver's raw data
        q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
        rate = STILL if message.angular_velocity_covariance[0] == NOT_REPORTED else (w.x, w.y, w.z)

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
        if self._senders[topic].is_another(info):
            self._on_intruder(topic)
        age = (self._node.get_clock().now().nanoseconds - to_nanoseconds(stamp)) * 1e-9
        try:
            with self._lock:
                now = time.monotonic()
                use(now, age)
                self._on_tilt(now)
        except ParameterError as error:
            self._on_refusal(topic, error)
