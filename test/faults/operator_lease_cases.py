"""Rows of the fault matrix of people who leave: who holds control of the arm, and who wrote the outer loop.

python -m test.faults.operator_lease_cases: a process that holds control of the right arm until its parent has ended.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import KeyValue
from rclpy.signals import SignalHandlerOptions

from exo_gravity.hardware.network import keep_to_this_machine

from ..support import ROOT
from .actions import send_signal
from .fault_case import FaultCase
from .outer_loop import BE_SOUND, FLOOD
from .outer_loop_cases import MAX_MOTION, AssistedRig, only_the_assistance_ends
from .rig import Rig

NAME, PERIOD = "the operator", 0.3  # s
LET_DOWN = 1.5  # s from the death of who holds control


class HeldRig(Rig):
    """A separate process holds control of the arm."""

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        super().__init__(folder, shipped_timeouts)
        self._holder: subprocess.Popen[bytes] | None = None

    def pid(self, node: str) -> int:
        if node == "holder":
            assert self._holder is not None
            return self._holder.pid
        return super().pid(node)

    def bring_to(self, stage: str) -> None:
        if self._holder is None or self._holder.poll() is not None:
            self._holder = subprocess.Popen([sys.executable, "-m", __name__], cwd=ROOT)
        super().bring_to(stage)
        self.probe.wait_until(lambda: self.probe.diagnostic("can_bridge", "control held by") == NAME)

    def close(self) -> None:
        if self._holder is not None:
            self._holder.kill()
            self._holder.wait()
        super().close()


class SuccessorRig(AssistedRig):
    """A second outer loop, which asks for nothing, waits while the first one assists the arm."""

    _successor: subprocess.Popen[bytes] | None = None

    def replace_outer_loop(self) -> float:
        """Kill the outer loop; once its torque has gone, let the other one begin. Return when it died (wall clock)."""
        died = time.time()
        os.kill(self.pid("outer_loop"), signal.SIGKILL)
        self._wait_for("waiting")
        assert self._successor is not None
        self._successor.send_signal(BE_SOUND)
        self._wait_for("assisting")
        return died

    def _wait_for(self, state: str) -> None:
        self.probe.wait_until(lambda: (self.probe.diagnostic("compensator", "assist") or "").startswith(state))

    def bring_to(self, stage: str) -> None:
        self._end_successor()
        self._successor = subprocess.Popen([sys.executable, "-m", "test.faults.outer_loop", "0"], cwd=ROOT)
        super().bring_to(stage)

    def close(self) -> None:
        self._end_successor()
        super().close()

    def _end_successor(self) -> None:
        if self._successor is not None:
            self._successor.kill()
            self._successor.wait()


def the_arm_rests(records: np.ndarray) -> str:
    """Return what is wrong unless the arm rests."""
    motion = np.abs(records["position"] - records["position"][0]).max()
    return f"the arm moved by {motion:.2f} rad" if motion > MAX_MOTION else ""


# fmt: off
LEASES = (
    FaultCase("who holds control killed", send_signal("holder", signal.SIGKILL), HeldRig, LET_DOWN,
        outcomes=("control_lost",)),
    FaultCase("outer loop killed, the next one asks for 0 Nm", SuccessorRig.replace_outer_loop, SuccessorRig, None,
        outcomes=("active",), check=partial(only_the_assistance_ends, until=math.inf)),
    FaultCase("outer loop floods", send_signal("outer_loop", FLOOD), AssistedRig, None, outcomes=("active",),
        check=the_arm_rests),
)
# fmt: on


def main() -> None:
    """Hold control until the parent process has ended."""
    keep_to_this_machine()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("holder")
    publisher, parent = node.create_publisher(KeyValue, "/right/can_bridge/control", 1), os.getppid()
    while os.getppid() == parent:
        publisher.publish(KeyValue(key=NAME, value="hold"))
        time.sleep(PERIOD)


if __name__ == "__main__":
    main()
