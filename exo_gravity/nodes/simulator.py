"""simulator: a simulated arm behind a CAN bus, a trunk IMU, and a virtual wearer who carries out a trial.

CAN frames and an IMU topic are all that joins it to the other nodes. Beside them it publishes `wearer_step`, what the
virtual wearer is doing, as the person at a real arm would know it.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from pathlib import Path

import yaml
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Imu
from std_msgs.msg import String

from exo_gravity.core.control_params import OPTIONS
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trial_script import TrialScript
from exo_gravity.hardware.motor_bus import open_bus
from exo_gravity.nodes.declare import bus_of, declare, values_after
from exo_gravity.nodes.run import run
from exo_gravity.sim import SimulatedImu, VirtualWearer
from exo_gravity.sim.device_params import SIMULATOR, device_of, imu_of, set_faults

TRUNK_SPEED = 0.5  # rad/s at which the trunk goes to the tilt that was set


def script_of(path: str) -> TrialScript:
    """Return the script of a YAML file, or raise ParameterError."""
    try:
        return TrialScript.parse(yaml.safe_load(Path(path).read_text(encoding="utf-8")))
    except (OSError, yaml.YAMLError) as error:
        raise ParameterError("trial", path, f"a readable script file ({error})") from None


class Simulator(Node):
    """The ROS shell around `sim.SimulatedDevice`, which runs in a thread of its own.

    What it publishes it publishes from that thread, while no motor has anything to answer: from another one it would
    hold the interpreter's lock when a command comes, and motors that answer late are none.
    """

    def __init__(self):
        super().__init__("simulator", automatically_declare_parameters_from_overrides=True)
        values = declare(self, SIMULATOR, free_prefix=OPTIONS)
        self._device = device_of(values)
        self._script = script_of(values["trial"]) if values["trial"] else None
        self._delay = values["trial_delay"]
        self._trunk = (values["trunk.pitch"], values["trunk.roll"])
        self._wearer: VirtualWearer | None = None
        self._ordered: deque[TrialScript] = deque()  # by a parameter, for the device's thread to begin
        self._told = None
        self._slip = 0.0
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._step_publisher = self.create_publisher(String, "wearer_step", latched)
        self._start_trunk(values)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self.failure: Exception | None = None  # run() ends the node for it
        self._stopping = threading.Event()
        self._bus = open_bus(*bus_of(self, values))
        self.get_logger().info(f"simulated {values['side']} arm on {self._bus.channel_info}")
        self._thread = threading.Thread(target=self._play, name="device", daemon=True)
        self._thread.start()

    @property
    def needed(self) -> bool:
        """Whether a motor is on: a real device does not vanish from under a bridge that lets its arm down."""
        return any(motor.entered for motor in self._device.motors)

    def close(self) -> None:
        """Stop the device and close its bus."""
        self._stopping.set()
        self._thread.join()
        self._bus.shutdown()

    def _play(self) -> None:
        try:
            self._device.run(self._bus, self._stopping.is_set, self._aside)
        except Exception as error:
            self.failure = error

    def _start_trunk(self, values: dict) -> None:
        rate = values["imu.rate"]
        self._imu = SimulatedImu(imu_of(values))
        topic = values["imu.topic"]
        self._imu_publisher = self.create_publisher(Imu, topic, qos_profile_sensor_data) if topic else None
        self._trunk_period = 1.0 / rate
        self._trunk_due = 0.0

    def _aside(self, now: float) -> None:
        if now >= self._trunk_due:
            self._trunk_due = max(self._trunk_due, now - self._trunk_period) + self._trunk_period
            self._follow()
            self._move_trunk()

    def _move_trunk(self) -> None:
        device, most = self._device, TRUNK_SPEED * self._trunk_period
        pitch_step, roll_step = (
            max(-most, min(most, target - now))
            for target, now in zip(self._trunk, (device.pitch, device.roll), strict=True)
        )
        device.pitch += pitch_step
        device.roll += roll_step
        if self._imu_publisher:
            self._publish_imu(pitch_step / self._trunk_period, roll_step / self._trunk_period)

    def _publish_imu(self, pitch_rate: float, roll_rate: float) -> None:
        device = self._device
        angular_velocity, acceleration = self._imu.sample(device.pitch, device.roll, pitch_rate, roll_rate)
        message = Imu()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = "imu"
        message.orientation_covariance[0] = -1.0  # REP-145: no orientation reported
        vectors = (message.angular_velocity, angular_velocity), (message.linear_acceleration, acceleration)
        for vector, value in vectors:
            vector.x, vector.y, vector.z = value.tolist()
        self._imu_publisher.publish(message)

    def _follow(self) -> None:
        """Let the wearer begin once the arm is on, tell what he does, and whether the simulation keeps up."""
        device = self._device
        if device.slip > self._slip:
            self.get_logger().warning(f"fell {(device.slip - self._slip) * 1000:.0f} ms behind real time")
            self._slip = device.slip
        while self._ordered:
            self._begin(self._ordered.popleft(), 0.0)
        if self._script and self._wearer is None and all(motor.entered for motor in device.motors):
            self._begin(self._script, self._delay)
        if self._wearer is None or self._wearer.step == self._told:
            return
        step, steps = self._wearer.step, self._wearer.script.steps
        self._told = step
        content = {"step": step, "of": len(steps), "action": "done", "duration": 0.0}
        if step < len(steps):
            content.update(action=steps[step].action, duration=steps[step].duration)
        self._step_publisher.publish(String(data=json.dumps(content)))
        self.get_logger().info(f"wearer: {content['action']} ({step} of {len(steps)})")

    def _begin(self, script: TrialScript, delay: float) -> None:
        self._script, self._told = script, None
        self._wearer = VirtualWearer(script)
        self._device.start(self._wearer, delay)

    def _check_parameters(self, changes) -> SetParametersResult:
        try:
            values = values_after(self, SIMULATOR, changes)
            if values["trial"]:
                script_of(values["trial"])
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, changes) -> None:
        values = values_after(self, SIMULATOR)
        self._trunk = (values["trunk.pitch"], values["trunk.roll"])
        set_faults(self._device, values)
        if any(change.name == "trial" for change in changes) and values["trial"]:
            self._ordered.append(script_of(values["trial"]))


def main() -> None:
    """Entry point of the executable `simulator`."""
    raise SystemExit(run(Simulator, priority=15))
