# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The person of `calibrate motors` and `calibrate imu`: moves the arm by hand on a virtual bus, stands and bows."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import can
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import gravity_torque
from exo_gravity.lab.inputs.arms import ConfiguredArm
from exo_gravity.sim import SimulatedDevice
from exo_gravity.sim.imu import ImuConfig, SimulatedImu
from exo_gravity.sim.trunk_motion import TrunkState

TURN = (0.45, 0.7)  # rad, by which a joint is moved
CLUMSY = 0.25  # of it, by which the other joints move along
STEPS = 10  # of a motion
POSTURE = np.radians(0.7)  # of a person who stands upright, standard deviation of pitch and roll
BOW = np.radians((35.0, 60.0))
LEAN = np.radians(1.5)  # sideways at the end of the bow, standard deviation
RATE = 100.0  # Hz of the IMU
BOWS = 3
PHASES = 3.0, 1.5, 3.0, 1.5  # s: upright, down, bowed, up


class Hand:
    """Moves the arm of `device` on the bus of `arm`; a context manager.

    rest: (4,) rad, where the arm is when it hangs or lies in the jig. rotor_jump: (4,) rad by which the encoders are
    off once the power was switched off and on; None: the person goes on without that.
    """

    def __init__(
        self, device: SimulatedDevice, arm: ConfiguredArm, rng: np.random.Generator, rest: Sequence[float]
    ) -> None:
        self.rotor_jump: Sequence[float] | None = None
        self._device, self._rng = device, rng
        self._names, self._rest = arm.joint_names, np.array(rest)
        self._pose = np.zeros(4)
        self._stop = threading.Event()
        self._bus = can.Bus(interface="virtual", channel=arm.can_bridge["can.channel"])
        self._thread = threading.Thread(target=device.run, args=(self._bus, self._stop.is_set, self._hold))

    def __enter__(self) -> Hand:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()
        self._bus.shutdown()

    def _hold(self, now: float) -> None:
        self._device.arm.reset(self._pose.tolist())

    def wait(self, request: str, watch: Callable[[], object]) -> None:
        """Do what `request` says while the program watches."""
        if "by 30 degrees" in request:
            turn = self._rng.uniform(*TURN)
            target = turn * CLUMSY * self._rng.uniform(-1.0, 1.0, 4)
            target[self._names.index(request.partition(":")[0])] = turn
            self._move(target, watch)
            self._move(np.zeros(4), watch)
        elif "hands off" in request:
            self._move(self._rest, watch)
        elif self.rotor_jump is not None:
            self._switch_power(self.rotor_jump, watch)

    def _move(self, target: np.ndarray, watch: Callable[[], object]) -> None:
        start = self._pose
        for step in range(1, STEPS + 1):
            self._pose = start + (target - start) * step / STEPS
            watch()

    def _switch_power(self, rotor_jump: Sequence[float], watch: Callable[[], object]) -> None:
        for is_off in (True, False):
            for motor in self._device.motors:
                motor.unplugged = is_off
            if not is_off:
                self._device.encoder_error = rotor_jump
            for _ in range(STEPS):
                watch()


def hanging(links: ArmModel) -> np.ndarray:
    """Return the pose (4,) in rad in which the arm hangs without friction, on an upright trunk; joint 1 at 0."""
    theta = np.zeros(4)
    for _ in range(50):
        slope = np.array([gravity_torque(links, theta + step) for step in 1e-5 * np.eye(4)])[1:, 1:]
        torque = gravity_torque(links, theta)[1:]
        with suppress(np.linalg.LinAlgError):
            theta[1:] -= np.linalg.solve((slope - torque).T / 1e-5, torque)
    return theta


def write_bow(folder: Path, quaternion: np.ndarray, rng: np.random.Generator) -> Path:
    """Write a recording of an IMU on a person who stands and bows `BOWS` times, not perfectly; return its folder."""
    edges = np.cumsum((0.0, *PHASES * BOWS, PHASES[0]))
    time = np.arange(0.0, edges[-1], 1.0 / RATE)
    bow = (time / sum(PHASES)).astype(int).clip(max=BOWS - 1)
    share = np.interp(time, edges, (*(0.0, 0.0, 1.0, 1.0) * BOWS, 0.0, 0.0))
    share = share * share * (3.0 - 2.0 * share)
    upright = rng.normal(0.0, POSTURE, 2)
    pitch = upright[0] + rng.uniform(BOW[0], BOW[1], BOWS)[bow] * share
    roll = upright[1] + rng.normal(0.0, LEAN, BOWS)[bow] * share
    imu = SimulatedImu(ImuConfig(tuple(quaternion), RATE, seed=int(rng.integers(1000))))
    types = get_typestore(Stores.ROS2_JAZZY)
    vector, covariance = types.types["geometry_msgs/msg/Vector3"], np.zeros(9)
    no_orientation = types.types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0), np.full(9, -1.0)
    kind = "sensor_msgs/msg/Imu"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/imu/data_raw", kind, typestore=types)
        for row in zip(time, pitch, roll, np.gradient(pitch, time), np.gradient(roll, time), strict=True):
            rate, force = (vector(*map(float, values)) for values in imu.sample(TrunkState(*row[1:])))
            stamp = round(float(row[0]) * 1e9)
            seconds = types.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            header = types.types["std_msgs/msg/Header"](stamp=seconds, frame_id="imu")
            message = types.types[kind](header, *no_orientation, rate, covariance, force, covariance)
            writer.write(connection, stamp, types.serialize_cdr(message, kind))
    return folder
