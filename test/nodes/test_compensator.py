# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The torque of a running compensator, which the test feeds with joint states."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import Vector3Stamped
from rclpy.time import Time
from sensor_msgs.msg import Imu

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.safety.limits import CAN_BRIDGE

from ..support.joint_state_feeder import POSE, Feeder, JointStateFeeder
from ..support.launched_nodes import NO_IMU
from ..support.ros_probe import RosProbe

OTHER_NODES = ("can_bridge", "simulator", "imu")
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
WEARER = Wearer(75.0).on_links(ROBOT.length)


@pytest.fixture
def feed(probe: RosProbe) -> Iterator[Callable[..., None]]:
    """A function that starts to publish the joint states of one arm at rest in `POSE`."""
    feeders: list[JointStateFeeder] = []
    yield lambda side="right": feeders.append(JointStateFeeder(probe.node, side))
    for feeder in feeders:
        feeder.close()


class TiltFeeder(Feeder):
    """Publishes every 10 ms pitch and roll of a trunk that bows by 0.3 rad.

    lag: age of the stamps in s. vector_bow: rad, of which gravity's vector is published too; None for none.
    """

    def __init__(self, node: Any) -> None:
        self.lag = 0.0
        self.vector_bow: float | None = None
        self._vectors = node.create_publisher(Imu, "/imu/data", 1)
        self._publisher = node.create_publisher(Vector3Stamped, "/imu/pitch_yaw", 1)
        super().__init__(0.01)

    def send(self, number: int) -> None:
        angles, vector = Vector3Stamped(), Imu()
        angles.vector.y = 0.3
        angles.header.stamp = vector.header.stamp = Time(nanoseconds=time.time_ns() - round(self.lag * 1e9)).to_msg()
        self._publisher.publish(angles)
        if (bow := self.vector_bow) is not None:
            vector.orientation.y, vector.orientation.w = math.sin(bow / 2.0), math.cos(bow / 2.0)
            self._vectors.publish(vector)


@pytest.fixture
def tilt(probe: RosProbe) -> Iterator[TiltFeeder]:
    """A feeder of the tilt of a trunk that bows by 0.3 rad."""
    feeder = TiltFeeder(probe.node)
    yield feeder
    feeder.close()


def test_a_tilt_is_believed_by_its_stamp_and_gravitys_vector_goes_before_pitch_and_roll(launch, probe, feed, tilt):
    launch(without=OTHER_NODES)
    feed()
    by_angles, by_vector = (gravity_torque(ROBOT, POSE, Tilt.of("right", bow).direction) for bow in (0.3, 0.36))
    commands = probe.effort_commands

    def is_compensated(expected):
        return commands and commands[-1].effort and np.allclose(commands[-1].effort, expected, atol=1e-9)

    probe.wait_until(lambda: is_compensated(by_angles))
    for bow, expected in ((0.36, by_vector), (None, by_angles)):
        tilt.vector_bow = bow
        probe.wait_until(lambda expected=expected: is_compensated(expected))
    for lag, word, sentence in (
        (0.7, "late_tilt_stamp", "older than 500 ms by its stamp: the IMU driver lags"),
        (
            3600.0,
            "refused_tilt",
            "age of the trunk tilt by its stamp must be from -0.05 to 1 s: synchronise the clocks",
        ),
    ):
        tilt.lag = lag
        probe.wait_until(lambda word=word: probe.diagnostic("compensator", "reason") == word)
        assert sentence in probe.diagnostic("compensator", "reason text")
        probe.wait_until(lambda: not commands[-1].effort)  # the status may overtake it
        tilt.lag = 0.0
        probe.wait_until(lambda: probe.status_contains("compensator", "compensating"))


@pytest.mark.thorough
def test_a_load_beyond_the_motors_is_clamped_and_one_warning_states_the_support_that_fits(launch, probe, feed):
    nodes = launch(without=OTHER_NODES, compensator=NO_IMU, wearer=True)
    bridge = rclpy.create_node("can_bridge", namespace="/right", context=probe.context)
    for param in CAN_BRIDGE:
        bridge.declare_parameter(param.name, param.default)
    probe.executor.add_node(bridge)
    feed()

    def budget() -> str:
        return probe.diagnostic("wearer", "budget text") or ""

    probe.wait_until(lambda: probe.diagnostic("wearer", "budget") == "within_rated")
    worn = {"mode": "zero_g", "support": 1.0, "wearer__body_mass": 75}
    assert probe.set_parameters("compensator", atomically=True, **worn).successful
    needs = "right_shoulder_abduction needs 19.6 Nm in its worst pose (rated 9, peak 18)"
    probe.wait_until(lambda: needs in budget())
    assert probe.diagnostic("wearer", "budget") == "above_rated"
    assert f"the largest support that fits is {probe.diagnostic('wearer', 'largest support')}" in budget()
    probe.wait_until(lambda: probe.status_contains("compensator", ", right_shoulder_flexion"))
    probe.wait_until(lambda: probe.effort_commands[-1].effort[2] == 3.0)
    probe.wait_until(lambda: [line for line in nodes.log if needs in line and "WARN" in line])
    probe.statuses.clear()
    probe.wait_until(budget)  # the next report does not repeat the warning
    assert len([line for line in nodes.log if needs in line]) == 1
