"""The wearer's torque of a running compensator, which the test feeds with joint states."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from functools import partial
from typing import cast

import numpy as np
import pytest
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.nodes.compensator.watches import WearerWatch
from exo_gravity.nodes.ros.messages import to_nanoseconds

from ..support.joint_state_feeder import PARTS, POSE
from ..support.launched_nodes import NO_IMU

OTHER_NODES = ("can_bridge", "simulator", "imu")
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
LOAD = Wearer(75.0).on_links(ROBOT.length)
STRONG = {"max_effort": [9.0, 18.0, 9.0, 9.0]}  # Nm
NEEDED = gravity_torque(ROBOT.with_wearer(LOAD.mass, LOAD.cog), POSE)
GIVEN = np.array((0.0, 4.0, 1.5, 0.0))  # Nm, of the wearer
WEIGHT = NEEDED - gravity_torque(ROBOT, POSE)  # Nm, that carries the wearer's arm


class StillArm:
    """Publishes the joint states of a still arm every 5 ms; `effort` of its motors in Nm. Stamps count them in ns."""

    def __init__(self, node: Node) -> None:
        self.effort: Sequence[float] = ()
        self.velocity: Sequence[float] = (0.0,) * 4
        self.sinking = 0.0  # rad every 5 ms, of the abduction
        self._publisher = node.create_publisher(JointState, "/right/joint_states", 1)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _publish(self) -> None:
        message, number = JointState(name=[f"right_{part}" for part in PARTS], position=POSE, velocity=[0.0] * 4), 0
        while not self._stopping.wait(0.005):
            number += 1
            message.header.stamp = Time(nanoseconds=number).to_msg()
            message.effort, message.velocity = self.effort, self.velocity
            message.position[1] -= self.sinking
            self._publisher.publish(message)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()


@pytest.fixture
def arm(probe) -> Iterator[StillArm]:
    still = StillArm(probe.node)
    yield still
    still.close()


def test_what_the_motors_do_not_carry_is_published_as_the_wearers_with_its_deviation(launch, probe, arm):
    found: dict[str, list[JointState]] = {"": [], "_std": []}
    for part, messages in found.items():
        probe.node.create_subscription(JointState, f"/right/wearer_efforts{part}", messages.append, 100)
    launch(without=OTHER_NODES, compensator={**NO_IMU, "wearer.body_mass": 75.0})
    commands = probe.effort_commands
    probe.wait_until(lambda: len(commands) > 50)
    assert not found[""]  # without the motors' efforts nothing is known of the wearer
    arm.effort = (NEEDED - GIVEN).tolist()
    probe.wait_until(lambda: len(found[""]) > 100 and len(found["_std"]) > 100)
    newest, deviation = found[""][-1], found["_std"][-1]
    assert list(newest.name) == [f"right_{part}" for part in PARTS]
    assert newest.effort == pytest.approx(GIVEN, abs=1e-6)
    assert all(0.05 < value < 2.5 for value in deviation.effort)
    stamps = [[to_nanoseconds(message.header.stamp) for message in messages[:50]] for messages in found.values()]
    assert set(stamps[0]) & set(stamps[1])  # a torque and its deviation have the same stamp
    probe.wait_until(
        lambda: "right_shoulder_abduction +4.0 +-" in (probe.diagnostic("compensator", "wearer (Nm)") or "")
    )
    assert "elbow" not in (probe.diagnostic("compensator", "wearer (Nm)") or "")
    share = f"{100.0 * (GIVEN @ WEIGHT) / (WEIGHT @ WEIGHT):.0f} +- "
    probe.wait_until(lambda: (probe.diagnostic("compensator", "share of the wearer (%)") or "").startswith(share))
    arm.effort = NEEDED.tolist()
    probe.wait_until(lambda: probe.diagnostic("compensator", "wearer (Nm)") == "not distinguishable from zero")
    probe.wait_until(lambda: (probe.diagnostic("compensator", "share of the wearer (%)") or "").startswith("0 +- "))


def test_a_blow_is_a_contact_in_diagnostics(launch, probe, arm):
    launch(without=OTHER_NODES, compensator={**NO_IMU, "wearer.body_mass": 75.0})
    arm.effort = NEEDED.tolist()
    probe.wait_until(lambda: probe.diagnostic("compensator", "wearer (Nm)") == "not distinguishable from zero")
    assert probe.diagnostic("compensator", "contact") == "none"
    arm.effort = np.add(NEEDED, (0.0, 0.0, 0.0, 5.0)).tolist()
    probe.wait_until(lambda: "right_elbow_flexion -" in (probe.diagnostic("compensator", "contact") or ""))
    assert "1 in all" in probe.diagnostic("compensator", "contact")


def test_a_load_is_weighed_on_request_and_one_that_is_dropped_is_no_longer_a_parameter(launch, probe, arm):
    launch(without=OTHER_NODES, compensator={**NO_IMU, **STRONG, "wearer.body_mass": 75.0, "support": 0.5})
    probe.wait_until(lambda: probe.effort_commands)

    def weigh() -> Trigger.Response:
        return probe.call(Trigger, "/right/compensator/weigh", Trigger.Request())

    refused = weigh()
    assert not refused.success and "support 1" in refused.message
    assert probe.set_parameters("compensator", mode="zero_g", support=1.0).successful
    probe.wait_until(lambda: probe.diagnostic("compensator", "changing load") == "none" and weigh().success)
    probe.wait_until(lambda: probe.diagnostic("compensator", "weighing") == "relax: the motors take the load over")
    assert not probe.set_parameters("compensator", payload__mass=6.0).successful
    assert probe.set_parameters("compensator", payload__mass=2.0).successful
    settings_changed = "not weighed: the settings changed"
    probe.wait_until(lambda: probe.diagnostic("compensator", "weighing") == settings_changed)
    arm.velocity = (0.0, 0.0, 1.5, 2.0)
    probe.wait_until(lambda: probe.diagnostic("compensator", "payload mass (kg)") == "0.000")
    values = probe.dump_parameters(["/right/compensator"])["/right/compensator"]
    assert values["ros__parameters"]["payload"]["mass"] == 0.0


def test_the_support_of_a_wearer_whose_arm_sinks_adapts_where_his_share_is_known(launch, probe, arm):
    worn = {"wearer.body_mass": 75.0, "mode": "zero_g", "support": 0.4, "support_adapts": True}
    launch(without=OTHER_NODES, compensator={**NO_IMU, **STRONG, **worn, "model_error.wearer": 0.03})
    carried = gravity_torque(ROBOT.with_wearer(LOAD.mass, LOAD.cog, 0.4), POSE)
    arm.effort = carried.tolist()
    adapts = partial(probe.diagnostic, "compensator", "support adapts")
    probe.wait_until(lambda: adapts() == "40 %")
    arm.sinking = 0.0002
    probe.wait_until(lambda: "40 -> " in (adapts() or ""))
    arm.sinking = 0.0
    assert float(probe.diagnostic("compensator", "mass carried (kg)")) > ROBOT.total_mass + 0.4 * sum(LOAD.mass) + 0.01
    assert probe.diagnostic("compensator", "support") == "0.4"
    assert probe.set_parameters("compensator", model_error__wearer=0.3).successful
    probe.wait_until(lambda: "40 -> " not in (adapts() or "") and "cannot rise: the wearer's share" in (adapts() or ""))
    assert probe.set_parameters("compensator", support_adapts=False).successful
    probe.wait_until(lambda: adapts() == "off")


def test_an_estimate_that_fails_says_so_in_diagnostics(probe):
    control = Compensator(Settings("right", ROBOT, use_imu=False))
    watch = WearerWatch(probe.node, [f"right_{part}" for part in PARTS], control, threading.Lock())
    watch.newest = 1.0, cast("JointState", "no message")
    watch.start()
    probe.wait_until(lambda: watch.failure is not None)
    assert watch.values["wearer (Nm)"].startswith("failed: AttributeError: 'str' object has no attribute")
    watch.stop()
