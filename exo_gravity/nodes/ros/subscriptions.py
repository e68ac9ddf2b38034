"""Subscriptions, most of them outside the executor: on a thread with a wait set for one alone, or polled by its owner.

rclpy's executor rebuilds its wait set, services included, for every message. That is most of a message's cost
(measured, there and back at 500 Hz: 35 + 21 % of a core, against 14 + 11 % here; at 2,000 messages a second it is most
of a core). A flood is shed before Python sees it: the middleware keeps `qos.depth` messages, and a thread rests for
`pause` between two looks. `WaitSet` and `take_message` are inner interfaces of rclpy, which `wait_for_message` uses.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3Stamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from exo_gravity.core.arm.rotation import unit_quaternion, up_in_body
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trunk.inputs import NO_ROTATION, NOT_REPORTED, TiltInput
from exo_gravity.nodes.ros.messages import to_nanoseconds

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
# For who reads between other work: the depth lets it notice a second publisher.
SEVERAL = QoSProfile(depth=8, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # reliable
STOP_CHECK_PERIOD = 0.1  # s
PAUSE = 0.0004  # s, less than the shortest period of a control loop
MAX_PUBLISHERS = 4  # publishers of one topic that a node can distinguish
DISTRUST = 0.2  # s for which a topic is not trusted after a second publisher was seen
DATA, PITCH_YAW = "/imu/data", "/imu/pitch_yaw"

Callback = Callable[[Any, dict[str, Any]], None]


class Unexecuted(ReentrantCallbackGroup):
    """Keeps its subscriptions out of the executor's wait set."""

    def can_execute(self, entity: Any) -> bool:
        """Return that no entity may be executed."""
        return False


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

    pause: s for which the thread rests after each look; of what arrives meanwhile, it gets the last `qos.depth`. raw:
    whether the messages are passed on as bytes.
    """

    def __init__(
        self,
        node: Node,
        msgtype: type,
        topic: str,
        callback: Callback,
        qos: QoSProfile = NEWEST,
        pause: float = PAUSE,
        raw: bool = False,
    ) -> None:
        super().__init__(topic, lambda: self.poll(STOP_CHECK_PERIOD), pause)
        self._callback, self._depth = callback, qos.depth
        self._subscription = node.create_subscription(
            msgtype, topic, callback, qos, callback_group=Unexecuted(), raw=raw
        )
        self._wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)

    def poll(self, timeout: float = 0.0) -> None:
        """Call back for each queued message, on the caller's thread; wait up to `timeout` s for the first one.

        It ends after as many as the queue holds, however many arrive meanwhile.
        """
        handle, msgtype, raw = self._subscription.handle, self._subscription.msg_type, self._subscription.raw
        if timeout > 0.0:
            with handle:
                self._wait_set.clear_entities()
                self._wait_set.add_subscription(handle)
                self._wait_set.wait(int(timeout * 1e9))
        for _ in range(self._depth):
            item = handle.take_message(msgtype, raw)
            if item is None:
                return
            self._callback(*item)


class Latest:
    """The newest message of `topic`, or what `use` makes of it. The topic is looked at only in `within`."""

    def __init__(
        self, node: Node, msgtype: type, topic: str, use: Callable[[Any], Any] = lambda message: message
    ) -> None:
        self._use, self._content, self._arrived = use, None, -math.inf
        self._path = HotPath(node, msgtype, topic, self._on_message)

    def within(self, timeout: float) -> Any:
        """Return it; None if it is older than `timeout` s."""
        self._path.poll()
        return self._content if time.monotonic() - self._arrived < timeout else None

    def _on_message(self, message: Any, _info: dict[str, Any]) -> None:
        self._content, self._arrived = self._use(message), time.monotonic()


class Publishers:
    """The publishers of one topic. Each numbers its messages from 1, and rclpy passes the numbers on.

    So a second publisher shows at once, without discovery, which still lists a killed publisher for 20 s. missed:
    messages that were published and not received.
    """

    def __init__(self) -> None:
        self.missed = 0
        self._newest: deque[int] = deque(maxlen=MAX_PUBLISHERS)  # number of each publisher's last message
        self._changed = -math.inf  # monotonic s

    def is_another(self, info: dict[str, Any]) -> bool:
        """Return whether this message comes from a different publisher than the previous one: its number is no higher.

        It continues the nearest lower number, or is the first of a new publisher.
        """
        number = info["publication_sequence_number"]
        if number is None:
            raise RuntimeError("the middleware does not number messages: set RMW_IMPLEMENTATION=rmw_fastrtps_cpp")
        last = self._newest[-1] if self._newest else 0
        if previous := max((other for other in self._newest if other < number), default=0):
            self.missed += number - previous - 1
            self._newest.remove(previous)
        self._newest.append(number)
        if is_another := bool(number <= last):
            self._changed = time.monotonic()
        return is_another

    @property
    def are_several(self) -> bool:
        """Whether a message came from another publisher than the one before, within DISTRUST s."""
        return time.monotonic() - self._changed < DISTRUST


def crowded(sources: Mapping[str, Publishers]) -> str:
    """Return the sentence that a topic of `sources` has more than one publisher, '' if none has."""
    topics = [topic for topic, publishers in sources.items() if publishers.are_several]
    return f"more than one publisher of {topics[-1]}" if topics else ""


class TiltSubscription:
    """Passes the trunk's tilt on to `target`, under `lock`: `/imu/data`, and `/imu/pitch_yaw` of who sends that alone.

    on_refusal(topic, error): a message is impossible; the last tilt then grows old. on_motion(now, specific force (3,)
    m/s^2, angular velocity (3,) rad/s, age in s): a sample of the trunk's motion, in its axes, under `lock` too.
    on_tilt(now): `target` has a message of `now`, in s. senders: the publishers by topic. is_polled: messages are taken
    in `poll`, not by the executor.
    """

    def __init__(
        self,
        node: Node,
        target: TiltInput,
        lock: threading.Lock,
        on_refusal: Callable[[str, ParameterError], object] = lambda topic, error: None,
        on_motion: Callable[..., object] = lambda *sample: None,
        on_tilt: Callable[[float], object] = lambda now: None,
        is_polled: bool = False,
    ) -> None:
        self._node, self._target, self._lock = node, target, lock
        self._on_refusal, self._on_motion, self._on_tilt = on_refusal, on_motion, on_tilt
        self.senders = {topic: Publishers() for topic in (DATA, PITCH_YAW)}
        self._polled: list[HotPath] = []
        for msgtype, topic, callback in ((Imu, DATA, self._on_data), (Vector3Stamped, PITCH_YAW, self._on_pitch_yaw)):
            if is_polled:
                self._polled.append(HotPath(node, msgtype, topic, callback))
            else:
                node.create_subscription(msgtype, topic, callback, NEWEST)

    def poll(self) -> None:
        """Take the newest message of each topic, if it is new."""
        for path in self._polled:
            path.poll()

    def _on_data(self, message: Imu, info: dict[str, Any]) -> None:
        if message.orientation_covariance[0] == NOT_REPORTED:
            return  # another driver's raw data
        q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
        rate = NO_ROTATION if message.angular_velocity_covariance[0] == NOT_REPORTED else (w.x, w.y, w.z)

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
        self.senders[topic].is_another(info)
        age = (self._node.get_clock().now().nanoseconds - to_nanoseconds(stamp)) * 1e-9
        try:
            with self._lock:
                now = time.monotonic()
                use(now, age)
                self._on_tilt(now)
        except ParameterError as error:
            self._on_refusal(topic, error)
