# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The compensator's node with an outer loop and terms, over real DDS in this process."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.safety import guidance
from exo_gravity.hardware.network import keep_to_this_machine

from ..support.compensator_rig import CompensatorRig
from ..support.joint_state_feeder import PARTS, POSE

keep_to_this_machine()
pytestmark = pytest.mark.real_time  # efforts that are 50 ms late are faded, as they must be
NAMES = [f"right_{part}" for part in PARTS]
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
GRAVITY = gravity_torque(ROBOT, POSE)
ASSIST = (0.5, -0.5, 0.25, 0.0)
STILL = (0.0,) * 4


class Rig(CompensatorRig):
    """A compensator, and a node that plays the bridge and the outer loop. added: (4,) Nm beyond gravity, the newest."""

    def __init__(self) -> None:
        super().__init__("/right", {"use_imu": "false"})
        self.joint_states = self.user.create_publisher(JointState, "joint_states", 1)
        self.assist = self.user.create_publisher(JointState, "assist_efforts", 1)
        self.added, self.velocity, self.efforts = np.full(4, np.nan), STILL, ASSIST
        self.user.create_subscription(JointState, "effort_commands", self._on_command, 1)
        self.assisted = False
        self.user.create_timer(0.005, self._send)
        self.start()

    @property
    def message(self) -> str:
        return self.status.message

    def _send(self) -> None:
        stamp = self.user.get_clock().now().to_msg()
        states = JointState(name=NAMES, position=POSE, velocity=self.velocity)
        states.header.stamp = stamp
        self.joint_states.publish(states)
        if self.assisted:
            efforts = JointState(name=NAMES, effort=self.efforts)
            efforts.header.stamp = stamp
            self.assist.publish(efforts)

    def _on_command(self, message: JointState) -> None:
        self.added = np.subtract(message.effort, GRAVITY) if message.effort else np.full(4, np.nan)

    def adds(self, torque: tuple[float, ...], tolerance: float = 1e-6) -> bool:
        return bool(np.allclose(self.added, torque, atol=tolerance))


@pytest.fixture(scope="module")
def running() -> Iterator[Rig]:
    """A node that changes its load sooner than a wearer may feel, which test_compensator.py times."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guidance, "GUIDANCE", replace(guidance.GUIDANCE, time=0.2))
        rig = Rig()
        yield rig
        rig.close()


@pytest.fixture
def rig(running: Rig) -> Iterator[Rig]:
    """The node of this module, without terms and without efforts of the outer loop."""
    yield running
    running.assisted, running.velocity = False, STILL
    running.set(assist__max_effort=[0.0] * 4, friction__share=0.0)
    running.wait_until(lambda: running.adds(STILL))


def test_efforts_of_the_outer_loop_are_added_and_the_arm_stays_carried_without_them(rig):
    rig.assisted = True
    rig.wait_until(lambda: rig.adds(STILL) and rig.values.get("assist") == "off")
    assert rig.set(assist__max_effort=[1.0] * 4) == [""]
    rig.wait_until(lambda: rig.adds(ASSIST))
    rig.wait_until(lambda: rig.values["assist"] == "assisting" and rig.values["terms"] == "assist")
    rig.assisted = False
    rig.wait_until(lambda: rig.adds(STILL))
    rig.wait_until(lambda: (rig.values["assist"], rig.values["assist reason"]) == ("waiting", "stopped"))
    rig.wait_until(lambda: rig.message == "compensating" and rig.values["warnings"] == "none")


@pytest.mark.thorough
def test_wrong_efforts_are_withdrawn_and_reported_while_gravity_compensation_goes_on(rig):
    rig.assisted = True
    rig.set(assist__max_effort=[1.0] * 4)
    rig.wait_until(lambda: rig.adds(ASSIST))
    rig.efforts = (math.nan, 0.0, 0.0, 0.0)  # other refusals: test/core/terms/test_assist.py
    rig.wait_until(lambda: rig.adds(STILL))
    rig.wait_until(lambda: rig.message.startswith("gravity compensation alone: assist_efforts must be numbers"))
    assert (rig.values["assist reason"], rig.values["warnings"]) == ("invalid", "terms_refused")
    rig.efforts = ASSIST
    rig.wait_until(lambda: rig.adds(ASSIST) and rig.message == "compensating")


def test_a_second_outer_loop_ends_the_assistance_of_both(rig):
    rig.assisted = True
    rig.set(assist__max_effort=[1.0] * 4)
    rig.wait_until(lambda: rig.adds(ASSIST))
    other = rig.user.create_publisher(JointState, "assist_efforts", 1)
    message = JointState(name=NAMES, effort=(0.0, 1.0, 0.0, 0.0))

    def send() -> None:
        message.header.stamp = rig.user.get_clock().now().to_msg()
        other.publish(message)

    timer = rig.user.create_timer(0.007, send)
    rig.wait_until(lambda: rig.adds(STILL) and "more than one publisher" in rig.message)
    timer.cancel()
    rig.wait_until(lambda: rig.adds(ASSIST))


@pytest.mark.thorough
def test_terms_are_set_live_and_need_velocities(rig):
    rig.velocity = (0.15, -0.15, 0.0, 0.0)  # a change of load waits for slow joints
    rig.wait_until(lambda: rig.adds(STILL))
    assert rig.set(friction__coulomb=[0.2, 0.4, 0.2, 0.2], friction__share=0.5) == ["", ""]
    rig.wait_until(lambda: rig.adds((0.1, -0.2, 0.0, 0.0)))
    rig.wait_until(lambda: rig.values["terms"] == "friction")
    rig.velocity = ()
    rig.wait_until(lambda: rig.adds(STILL))
