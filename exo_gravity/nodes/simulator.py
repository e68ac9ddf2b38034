# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""simulator: a simulated arm behind a CAN bus, a trunk IMU, and a virtual wearer who performs a trial.

CAN frames and an IMU topic are its only connection to the other nodes. It also publishes `wearer_step`, the step that
the virtual wearer performs.
"""

import json
import threading
from collections import deque
from functools import partial
from typing import Any

import numpy as np
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu
from std_msgs.msg import String

from exo_gravity.core.motors.joint_motor import OPTIONS, buses_of, channels_of, is_fd
from exo_gravity.core.trunk.checks import ImuSample
from exo_gravity.core.vocabulary import words
from exo_gravity.hardware.can_port import open_bus
from exo_gravity.lab.packages import extras
from exo_gravity.lab.vocabulary import NodeState, SimulatorWarning
from exo_gravity.nodes.ros.imu_messages import message_of
from exo_gravity.nodes.ros.messages import OK, WARN, Diagnostics
from exo_gravity.nodes.ros.parameters import accept_changes, bus_of, declare, given_to
from exo_gravity.nodes.ros.run import run
from exo_gravity.nodes.ros.subscriptions import LATCHED, PeriodicThread, ThreadedNode

with extras("simulator", "sim"):
    from exo_gravity.sim import SimulatedImu, VirtualWearer
    from exo_gravity.sim.device import MAX_CATCH_UP
    from exo_gravity.sim.params import device_of, imu_of, set_faults, simulator_table
    from exo_gravity.sim.script import IDLE, Step, TrialScript
    from exo_gravity.sim.trunk_motion import TrunkState

TRUNK_SPEED = 0.5  # rad/s at which the trunk turns to a new tilt


class Simulator(ThreadedNode):
    """The ROS shell around `sim.SimulatedDevice`, which runs on a thread of its own.

    That thread also publishes, while no motor has a reply to send. Another thread that publishes would hold the
    interpreter's lock when a command arrives, and a late reply looks like a silent motor.
    """

    def __init__(self) -> None:
        super().__init__("simulator", automatically_declare_parameters_from_overrides=True)
        table = simulator_table(given_to(self))
        values = declare(self, table, free_prefix=OPTIONS)
        self._device = device_of(values)
        set_faults(self._device, values)
        # The script that starts next, and how many s after the motors are on; None for one that is set live: at once.
        self._queued = deque[tuple[TrialScript, float | None]](maxlen=1)
        if script := self._script_of(values["trial"]):
            self._queued.append((script, values["trial_delay"]))
        self._trunk_target = (values["trunk.pitch"], values["trunk.roll"])
        self._published_step: int | None = None
        self._diagnostics = Diagnostics(self)
        self._step_publisher = self.create_publisher(String, "wearer_step", LATCHED)
        self._imu = SimulatedImu(imu_of(values))
        topic = values["imu.topic"]
        self._imu_publisher = self.create_publisher(Imu, topic, qos_profile_sensor_data) if topic else None
        self._trunk_period = 1.0 / self._imu.config.rate
        self._trunk_due = 0.0  # monotonic s
        accept_changes(self, table, lambda values: (values, self._script_of(values["trial"])), self._apply)
        self._stopping = threading.Event()
        (interface, channel, options), count = bus_of(self, values), len(self._device.motors)
        of_bus = {name: own for name, (_, own) in buses_of(channel, options, count).items()}
        buses = {name: open_bus(interface, name, own) for name, own in of_bus.items()}
        channels = channels_of(channel, count)
        self._buses = [buses[name] for name in channels]  # of each motor
        self._device.is_fd = [is_fd(of_bus[name]) for name in channels]
        names = " and ".join(str(bus.channel_info) for bus in buses.values())
        self.get_logger().info(f"simulated {values['side']} arm on {names}")
        play = partial(self._device.run, self._buses, self._stopping.is_set, self._on_idle)
        self.threads.append(PeriodicThread("device", play, 0.0))
        self.threads[0].start()

    @property
    def needed(self) -> bool:
        """Whether a motor is on: a real device would not vanish while its bridge lets the arm down."""
        return self._device.powered

    def close(self) -> None:
        """Stop the device and close its buses."""
        self._stopping.set()
        super().close()
        for bus in set(self._buses):
            bus.shutdown()

    def _script_of(self, path: str) -> TrialScript | None:
        """Return the script in a file for this arm, None if `path` is empty. Raises ParameterError."""
        script = TrialScript.read(path) if path else None
        if script:
            script.check(len(self._device.motors))
        return script

    def _on_idle(self, now: float) -> None:
        if now >= self._trunk_due:
            self._trunk_due = max(self._trunk_due, now - self._trunk_period) + self._trunk_period
            self._follow_wearer()
            self._move_trunk()
            self._report()

    def _move_trunk(self) -> None:
        device, largest = self._device, TRUNK_SPEED * self._trunk_period
        state = device.trunk
        if device.trunk_motion:  # by the script: the trunk stays where that leaves it
            self._trunk_target = state.pitch, state.roll
        else:
            away = np.subtract(self._trunk_target, (device.pitch, device.roll))
            bow, lean = np.clip(away, -largest, largest).tolist()
            device.pitch, device.roll = device.pitch + bow, device.roll + lean
            state = TrunkState(device.pitch, device.roll, bow / self._trunk_period, lean / self._trunk_period)
        if self._imu_publisher:
            time = self.get_clock().now().nanoseconds * 1e-9
            sample = ImuSample(time, *self._imu.sample(state).tolist())
            self._imu_publisher.publish(message_of(sample))

    def _follow_wearer(self) -> None:
        """Start the wearer when it is time, and publish each new step."""
        device = self._device
        while self._queued and (self._queued[0][1] is None or all(motor.entered for motor in device.motors)):
            script, delay = self._queued.popleft()
            device.start(VirtualWearer(script), delay or 0.0)
            self._published_step = None
        number, steps = device.wearer.step, device.wearer.script.steps
        if number is None or number == self._published_step:
            return
        self._published_step = number
        step = steps[number] if number < len(steps) else Step("done", 0.0)
        content = {"step": number, "of": len(steps), "action": step.action, "duration": step.duration}
        self._step_publisher.publish(String(data=json.dumps(content)))
        self.get_logger().info(f"wearer: {step.action} ({number} of {len(steps)})")

    def _report(self) -> None:
        device = self._device
        warnings: dict[SimulatorWarning, str] = {}
        if device.longest_stall > MAX_CATCH_UP:
            stalled = f"stalled for {1000.0 * device.longest_stall:.0f} ms: this computer is too busy"
            warnings[SimulatorWarning.STALLED] = stalled
        if device.disconnected:
            warnings[SimulatorWarning.DISCONNECTED] = "a simulated fault disconnects a motor"
        values: dict[str, object] = {
            "state": NodeState.RUNNING,
            "warnings": words(*warnings),
            "motors": "on" if device.powered else "off",
            "longest stall (ms)": f"{1000.0 * device.longest_stall:.0f}",
            "longest silence (ms)": f"{1000.0 * device.longest_silence:.0f}",
            "time lost (ms)": f"{1000.0 * device.slip:.0f}",
            "disconnected": "yes" if device.disconnected else "no",
        }
        self._diagnostics.report(WARN if warnings else OK, "; ".join(warnings.values()) or "running", values)

    def _apply(self, accepted: tuple[dict[str, Any], TrialScript | None], changed: set[str]) -> None:
        values, script = accepted
        self._trunk_target = (values["trunk.pitch"], values["trunk.roll"])
        set_faults(self._device, values, changed)
        if "trial" in changed:
            self._queued.append((script or IDLE, None))


def main() -> None:
    """Entry point of the executable `simulator`."""
    raise SystemExit(run(Simulator, priority=20))  # no motor waits for a processor
