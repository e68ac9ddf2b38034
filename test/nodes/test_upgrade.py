# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A parameter file of a47959f4 starts unchanged; a person confirms the pose. The whole interface shows on the way."""

from __future__ import annotations

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState

from exo_gravity.nodes.ros.messages import NO_POSE, POSE_TO_CONFIRM

from ..support import DATA

pytestmark = [pytest.mark.real_time, pytest.mark.thorough]
ARMING = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)


def test_a_file_of_then_starts_and_its_arm_is_carried_once_a_person_has_confirmed_the_pose(launch, probe):
    launch(base=DATA / "a47959f4" / "sim.yaml", wearer=True)
    probe.wait_until(lambda: probe.state)
    for transition in ARMING if probe.state == "inactive" else ():
        request = ChangeState.Request(transition=Transition(id=transition))
        assert probe.call(ChangeState, "/right/can_bridge/change_state", request).success
    probe.wait_until(lambda: probe.diagnostic("can_bridge", POSE_TO_CONFIRM) not in (None, NO_POSE))
    assert probe.diagnostic("can_bridge", "waiting for") == "pose"
    assert probe.trigger("confirm_pose").success
    probe.wait_until(lambda: probe.state == "active")
    probe.wait_until(lambda: probe.diagnostic("can_bridge", "waiting for") == "none")
    keys = ("source", "motors", "fault", "request", "answer")
    expected = ["simulated", "on", "none", "confirm_pose", "done"]
    probe.wait_until(lambda: [probe.diagnostic("can_bridge", key) for key in keys] == expected)
    probe.wait_until(lambda: probe.diagnostic("compensator", "state") == "compensating")
    probe.wait_until(lambda: probe.diagnostic("wearer", "state") == "estimating")
    assert {f"/right/{node}" for node in ("can_bridge", "compensator", "wearer", "simulator")} <= probe.statuses.keys()
    assert probe.enable(False).success
    probe.wait_until(lambda: (probe.state, probe.diagnostic("can_bridge", "motors")) == ("disabled", "off"))
    assert probe.diagnostic("can_bridge", "request") == "let_down"
