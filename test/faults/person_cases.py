# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows of the fault matrix about people and firmware between two mechanisms: each is safe only by an invariant.

Operators whose requests are late, abandoned or made on a wrong picture of the arm; hardware that is connected wrongly;
motors that hear without being heard, that refuse, or whose own time-out fires; a node that asks for too much.
"""

from __future__ import annotations

import itertools
import math
import os
import signal
import time
from pathlib import Path
from typing import Any, ClassVar

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from ..support.launched_nodes import Parameters
from .actions import CUT, RELEASE, in_turn, publish, simulator, stamped, wearer
from .fault_case import ALL_JOINTS, FaultCase
from .rig import Rig
from .rigs import WORN_COG, WORN_MASS, WearerRig
from .virtual_cases import stays_off

GAP = 4.0  # s for which the bridge stands still
BLIND = 30.0  # s, longer than a let-down waits for motors that do not reply
LAP = [0.1, 0.5, 0.5, 1.3]  # rad
ELBOW_TURN = 2.0 * math.pi / 6.0  # rad, of the output for one turn of the rotor
OBSERVED = 4.0  # s
SUPPORT = itertools.cycle((1.0, 0.0, math.nan, 50.0, -1.0))


class AskingRig(WearerRig):
    """The bridge asks an operator about the pose; one answers that the arm hangs, until `operator_answers` is False."""

    bridge: ClassVar[Parameters] = {"start_pose": "confirm"}

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        super().__init__(folder, shipped_timeouts)
        self.operator_answers = True
        self._confirm = self.probe.node.create_client(Trigger, "/right/can_bridge/confirm_pose")
        self.probe.node.create_timer(0.5, self._answer)
        self.probe.executor.wake()

    def _answer(self) -> None:
        if self.operator_answers and self.probe.state == "checking" and self._confirm.service_is_ready():
            self._confirm.call_async(Trigger.Request())


class AdaptiveRig(WearerRig):
    """Zero-G with a support that adapts, and the node `wearer`, which asks for it."""

    wearer = True
    compensator: ClassVar[Parameters] = {**WearerRig.compensator, "support": 0.5, "support_adapts": True}
    # The wearer carries half of their arm themselves, so that a support of one half holds it.
    simulator: ClassVar[Parameters] = {
        **WearerRig.simulator,
        "wearer": {"mass": (0.5 * WORN_MASS).tolist(), "cog": WORN_COG.tolist()},
    }


def ask(rig: Rig, service_type: Any, name: str, request: Any) -> None:
    """Call a service of the bridge, and do not wait for the answer."""
    client = rig.probe.node.create_client(service_type, f"/right/can_bridge/{name}")
    rig.probe.wait_until(client.service_is_ready)
    client.call_async(request)


def switch_off(rig: Rig) -> None:
    """Let the arm down, and wait until its motors are off."""
    assert rig.probe.enable(False).success
    rig.probe.wait_until(lambda: rig.truth.motors_are_off() and rig.probe.state == "disabled")


def enable_across_a_gap(rig: Rig) -> float:
    """Enable the arm while the bridge stands still, which then goes on."""
    switch_off(rig)
    start, bridge = time.time(), rig.pid("can_bridge")
    os.kill(bridge, signal.SIGSTOP)
    ask(rig, SetBool, "enable", SetBool.Request(data=True))
    time.sleep(GAP)
    os.kill(bridge, signal.SIGCONT)
    time.sleep(OBSERVED)
    return start


def activate_while_deactivating(rig: Rig) -> float:
    """Deactivate the bridge, and activate it meanwhile without waiting for either answer."""
    start = time.time()
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE):
        ask(rig, ChangeState, "change_state", ChangeState.Request(transition=Transition(id=transition)))
        time.sleep(0.3)
    rig.probe.wait_until(rig.truth.motors_are_off)
    time.sleep(OBSERVED)
    return start


def stop_in_the_lap(rig: AskingRig) -> float:
    """Press the emergency stop, lay the arm in the lap, release it, clear the fault and enable; the wearer relaxes.

    The elbow's encoder has lost a turn. The operator does not say again that the arm hangs.
    """
    start = time.time()
    rig.operator_answers = False
    CUT(rig)
    wearer(rig, [{"move": LAP, "over": 20.0}, {"hold": 600.0}])
    rig.probe.wait_until(lambda: rig.probe.state == "fault", BLIND)
    time.sleep(GAP)
    simulator(fault__encoder_error=[0.0, 0.0, 0.0, -ELBOW_TURN])(rig)
    RELEASE(rig)
    time.sleep(1.0)
    assert rig.probe.trigger("clear_fault").success
    rig.probe.enable(True)
    time.sleep(OBSERVED)
    wearer(rig, [{"hold": 600.0}])
    time.sleep(OBSERVED)
    return start


def hostile_support(rig: Rig) -> JointState:
    """Return a request for support that contradicts the one before it."""
    message: JointState = stamped(rig, JointState(name=["support"], position=[next(SUPPORT)]))
    return message


# fmt: off
REQUESTS = (
    FaultCase("enabled while can_bridge stands still for 4 s", enable_across_a_gap, limit=None,
        outcomes=("disabled", "stopped"), check=stays_off),
    FaultCase("activate, abandoned while can_bridge deactivates", activate_while_deactivating,
        outcomes=("disabled", "inactive", "stopped"), ends_rig=True),
    FaultCase("supply cut, the arm laid in the lap, then clear and enable", stop_in_the_lap, AskingRig,
        unpowered=ALL_JOINTS, steps_from=0.1, check=stays_off, ends_rig=True),
    FaultCase("hostile requests for support, Zero-G, 75 kg", in_turn(*[publish(JointState, "/right/support_request",
        hostile_support)] * 4), AdaptiveRig, limit=None, outcomes=("active",), speed_limit=0.6),
)
# fmt: on
