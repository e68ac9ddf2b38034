"""An IMU that the `imu` node reads itself: a thread polls it and passes each sample on as a message.

The messages also go out on the topic that a driver would use, so that recordings and `calibrate imu` have them.
"""

import threading
from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import Vector3
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import Imu

from exo_gravity.core.trunk.imu_checks import ImuSample
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.hardware.imu_sources import Reopening, open_source
from exo_gravity.nodes.ros.subscriptions import Callback

POLLS_A_SAMPLE = 2.0
MIN_PERIOD = 0.002  # s between two polls
DEPTH = 50


class ImuDevice:
    """Calls `callback(message, info)` for each sample: on a thread after `start`, or in each `poll`, as `HotPath`."""

    def __init__(
        self, node: Node, values: Mapping[str, Any], topic: str, callback: Callback, clock: Clock = COMPUTER_CLOCK
    ) -> None:
        """Open the device that the parameter values name; if it is missing, it is looked for again and again.

        topic: gets the messages too. clock: of the pauses between attempts; the stamps are by the node's. Raises
        ParameterError if a parameter does not suit the device.
        """
        self.failure: Exception | None = None  # ends the thread
        self._node = node
        self._callback = callback
        self._publisher = node.create_publisher(Imu, topic, DEPTH)
        self._period = max(MIN_PERIOD, 1.0 / (POLLS_A_SAMPLE * values["rate"]))
        self._clock, stamps = clock, node.get_clock()
        self._reopening = Reopening(
            lambda self_test: open_source(values, lambda: stamps.now().nanoseconds * 1e-9, self_test, wait=clock.sleep)
        )
        self._number = 0  # of the last message
        self._lost = 0  # samples, as last logged
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=values["source"], daemon=True)
        self.poll()

    @property
    def problem(self) -> str:
        """Why there are no samples; '' while there are."""
        return self._reopening.problem

    @property
    def values(self) -> dict[str, object]:
        """What is known of the device, for /diagnostics."""
        source = self._reopening.source
        if source is None:
            return {"device": "closed", "opened": self._reopening.openings}
        return {
            "device": source.name,
            "opened": self._reopening.openings,
            "lost samples": f"{source.lost} {source.loss}".rstrip(),
            "temperature (degC)": "unknown" if source.temperature is None else f"{source.temperature:.1f}",
        }

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the device."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._reopening.close()

    def _run(self) -> None:
        try:
            while not self._stopping.wait(self._period):
                self.poll()
        except Exception as error:
            self.failure = error

    def poll(self) -> None:
        """Pass on the samples since the last call; raises ParameterError as the constructor does."""
        for sample in self._reopening.read(self._clock.monotonic()):
            message = message_of(sample)
            self._publisher.publish(message)
            self._number += 1
            self._callback(message, {"publication_sequence_number": self._number})
        source = self._reopening.source
        lost = source.lost if source else 0
        if source and lost > self._lost:
            self._node.get_logger().warning(f"{source.name}: {lost - self._lost} samples lost: {source.loss}")
        self._lost = lost


def message_of(sample: ImuSample) -> Imu:
    """Return the sample's message, in the IMU's axes; what was not measured has the covariance -1 (REP-145)."""
    message = Imu()
    message.header.stamp, message.header.frame_id = Time(nanoseconds=round(sample.time * 1e9)).to_msg(), "imu"
    if sample.orientation is None:
        message.orientation_covariance[0] = -1.0
    else:
        q = message.orientation
        q.x, q.y, q.z, q.w = sample.orientation
    _fill(message.angular_velocity, message.angular_velocity_covariance, sample.angular_velocity)
    _fill(message.linear_acceleration, message.linear_acceleration_covariance, sample.acceleration)
    return message


def _fill(vector: Vector3, covariance: Any, values: Any) -> None:
    if values is None:
        covariance[0] = -1.0
    else:
        vector.x, vector.y, vector.z = values
