"""Rows of the fault matrix in which the user's outer loop fails: gravity compensation goes on without it."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import numpy as np
from sensor_msgs.msg import JointState

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.lab.inputs.parameter_file import load

from ..support import CONFIG, ROOT
from ..support.launched_nodes import NO_IMU, LaunchedNodes, Parameters
from .actions import publish, send_signal
from .fault_case import PROCESS_REACTION, Action, FaultCase
from .outer_loop import BE_SOUND, EFFORTS, GO_WRONG, NAMES, TOPIC
from .rig import Rig
from .rigs import UPRIGHT

GONE_FOR = 0.45  # s from the fault, in which the assistance is out; that of a sound stream may then return
TOLERANCE = 0.08  # Nm
MAX_MOTION = 0.02  # rad
OTHER_EFFORTS = (0.0, 0.0, 0.0, 0.5)  # Nm


class AssistedRig(Rig):
    """A separate process assists the arm by `EFFORTS`."""

    simulator: ClassVar[Parameters] = UPRIGHT

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        super().__init__(folder, shipped_timeouts)
        parameters = load(CONFIG / "sim.yaml")["/right/compensator"]
        self._arm = ArmModel(*(parameters[name] for name in ("link_length", "robot.cog", "robot.mass")))
        self._outer_loop: subprocess.Popen[bytes] | None = None

    def _make_nodes(self, port: int) -> list[LaunchedNodes]:
        bridge = {"rate": self.rate}
        compensator = {**NO_IMU, "assist": {"max_effort": [1.0] * 4}}
        return [self._nodes(without=("imu", "simulator"), port=port, can_bridge=bridge, compensator=compensator)]

    def pid(self, node: str) -> int:
        if node == "outer_loop":
            assert self._outer_loop is not None
            return self._outer_loop.pid
        return super().pid(node)

    def bring_to(self, stage: str) -> None:
        """Bring the arm to `stage`, with the outer loop's efforts in full."""
        if self._outer_loop is None or self._outer_loop.poll() is not None:
            command = [sys.executable, "-m", "test.faults.outer_loop"]
            self._outer_loop = subprocess.Popen(command, cwd=ROOT)
        else:
            for number in (signal.SIGCONT, BE_SOUND):
                self._outer_loop.send_signal(number)
        super().bring_to(stage)
        self.probe.wait_until(self._is_assisted)

    def _is_assisted(self) -> bool:
        gravity = gravity_torque(self._arm, self.probe.joint_states[-1].position)
        effort = self.probe.effort_commands[-1].effort
        return len(effort) == 4 and bool(np.allclose(effort, gravity + EFFORTS, atol=TOLERANCE / 4))

    def close(self) -> None:
        if self._outer_loop is not None:
            self._outer_loop.kill()
            self._outer_loop.wait()
        super().close()


def only_the_assistance_ends(records: np.ndarray, until: float = GONE_FOR) -> str:
    """Return what is wrong unless every motor keeps its torque without the assistance, and the arm rests.

    until: s after the fault in which the assistance must not return.
    """
    since = records["time"] - records["time"][0]
    gone = (since > PROCESS_REACTION) & (since < until)
    wrong = np.abs(records["torque"][gone] - (records["torque"][0] - EFFORTS))
    motion = np.abs(records["position"] - records["position"][0]).max()
    if wrong.max(initial=0.0) > TOLERANCE:
        return f"{wrong.max():.2f} Nm on top of gravity compensation, {1000 * PROCESS_REACTION:.0f} ms after the fault"
    return f"the arm moved by {motion:.2f} rad" if motion > MAX_MOTION else ""


def reported(text: str) -> Action:
    """Check that the compensator reports `text` of the outer loop."""

    def check(rig: Rig) -> None:
        found = rig.probe.diagnostic("compensator", "assist") or "nothing"
        assert found.startswith(text), f"reported: {found}"

    return check


def other_efforts(rig: Rig) -> JointState:
    """Return efforts of a second outer loop."""
    message = JointState(name=NAMES, effort=OTHER_EFFORTS)
    message.header.stamp = rig.probe.node.get_clock().now().to_msg()
    return message


def outer_loop_case(name: str, inject: Action, report: str) -> FaultCase:
    return FaultCase(
        name,
        inject,
        AssistedRig,
        limit=None,
        outcomes=("active",),
        check=only_the_assistance_ends,
        afterwards=reported(report),
    )


# fmt: off
OUTER_LOOP = (
    outer_loop_case("outer loop killed", send_signal("outer_loop", signal.SIGKILL), "waiting: assist_efforts stopped"),
    outer_loop_case("outer loop frozen", send_signal("outer_loop", signal.SIGSTOP), "waiting: assist_efforts stopped"),
    outer_loop_case("outer loop sends NaN", send_signal("outer_loop", GO_WRONG), "refused: assist_efforts must be num"),
    outer_loop_case("second outer loop for half a second", publish(JointState, TOPIC, other_efforts), "assisting"),
)
# fmt: on
