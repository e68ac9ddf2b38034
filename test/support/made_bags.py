"""Recordings of known content for the tests of the tools: a synthetic arm, and bags written of it with rosbags."""

from __future__ import annotations

import json
import math

import numpy as np
from rosbags.rosbag2 import CompressionFormat, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.recording import Recording, ScriptedStep

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
START = 1_700_000_000_000_000_000  # ns
NAMES = ("right_joint_1", "right_joint_2", "right_joint_3", "right_joint_4")
ARM = ArmModel((0.05, 0.13, 0.3, 0.3), (0.03, 0.07, 0.15, 0.15), (0.6, 0.7, 0.6, 0.4))
POSITION_CODE, VELOCITY_CODE, TORQUE_CODE = 25 / 65535, 90 / 4095, 30 / 4095


def smooth(begin, end, seconds, rate=500.0):
    s = np.arange(round(seconds * rate))[:, None] / (seconds * rate)
    return begin + (np.asarray(end) - begin) * (10 * s**3 - 15 * s**4 + 6 * s**5)


def trial(poses, hold=10.0, push=None, drift=0.0, rate=500.0, seed=1, fall_after=math.inf):
    """An arm brought to each pose in 2 s and left alone, pushed by `push` (4,) rad in 0.4 s after the first hold.

    drift: rad/s in every hold. It falls after `fall_after` s.
    """
    rng = np.random.default_rng(seed)
    pieces, steps, here, now = [], [], np.zeros(4), 0.0

    def add(action, piece):
        nonlocal here, now
        pieces.append(piece)
        here, begin = piece[-1], now
        now += len(piece) / rate
        steps.append(ScriptedStep(action, begin, now))

    def left_alone():
        return here + drift * np.arange(round(hold * rate))[:, None] / rate

    for number, pose in enumerate(poses):
        add("move", smooth(here, pose, 2.0, rate))
        add("hold", left_alone())
        if push is not None and number == 0:
            add("push", smooth(here, here + np.asarray(push), 0.4, rate))
            add("hold", left_alone())
    exact = np.concatenate(pieces)
    time = np.arange(len(exact)) / rate
    exact = exact * np.exp(-2.0 * np.maximum(time - fall_after, 0.0))[:, None]
    position = np.round((exact + 2e-4 * rng.standard_normal(exact.shape)) / POSITION_CODE) * POSITION_CODE
    velocity = (np.round(np.gradient(exact, 1 / rate, axis=0) / VELOCITY_CODE - 0.5) + 0.5) * VELOCITY_CODE
    command = gravity_torque(ARM, exact)
    noisy = command + 0.02 * rng.standard_normal(command.shape)
    effort = (np.round(noisy / TORQUE_CODE - 0.5) + 0.5) * TORQUE_CODE
    return Recording("right", NAMES, time, position, velocity, effort, command, tuple(steps))


def joint_state(stamp, names, position=(), velocity=(), effort=(), frame=""):
    """A serialised sensor_msgs/JointState."""
    types = STORE.types
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=frame
    )
    fields = (np.ascontiguousarray(values, dtype=float) for values in (position, velocity, effort))
    return bytes(STORE.serialize_cdr(types[JOINT_STATE](header, list(names), *fields), JOINT_STATE))


def string(text):
    """A serialised std_msgs/String."""
    return bytes(STORE.serialize_cdr(STORE.types["std_msgs/msg/String"](data=text), "std_msgs/msg/String"))


def messages(recording, command_names=None, script=True):
    """Yield (topic, type, time of arrival in ns, bytes) in order, as the recorder sees them."""
    prefix = f"/{recording.name}"
    steps = [(START + round(step.start * 1e9), index, step) for index, step in enumerate(recording.steps)]
    for k, time in enumerate(recording.time):
        stamp = START + round(float(time) * 1e9)
        while script and steps and steps[0][0] <= stamp:
            at, index, step = steps.pop(0)
            told = {"step": index, "action": step.action, "duration": step.end - step.start}
            yield f"{prefix}/wearer_step", "std_msgs/msg/String", at, string(json.dumps(told))
        arrays = (recording.position[k], recording.velocity[k], recording.effort[k])
        state = joint_state(stamp, recording.joint_names, *arrays)
        yield f"{prefix}/joint_states", JOINT_STATE, stamp + 200_000, state
        command = joint_state(stamp, command_names or recording.joint_names, effort=recording.command[k])
        yield f"{prefix}/effort_commands", JOINT_STATE, stamp + 500_000, command


def write_bag(folder, content, plugin=StoragePlugin.MCAP, compression=None, topics=()):
    """Write (topic, type, time, bytes) with rosbags; `topics` (topic, type) exist in any case. Return the folder."""
    writer = Writer(folder, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=STORE) for topic, kind in topics}
        for topic, kind, stamp, data in content:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], stamp, data)
    return folder
