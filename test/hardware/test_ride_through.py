# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Late efforts, in virtual time: the arm is carried on under rising damping, judged by the arm's true motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from exo_gravity.core.arm.gravity import gravity_torque
from exo_gravity.core.safety.drive import NO_EFFORTS, Efforts, FaultCode, State
from exo_gravity.sim import VirtualWearer
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.script import TrialScript

from ..support.copies import prepared
from .compensated_arm import CYCLE, WEARER, CompensatedArm

RAISED, ZERO_G = (0.0, 1.3, 0.0, 0.3), (0.3, 0.45, 0.10, 0.4)  # rad
SPEED = 0.6  # rad/s
STEP = 0.35  # Nm within 2 ms: a frame may change the torque by 0.2, and the hand moves the damped joint


class RidingArm(CompensatedArm):
    """An arm that the loop carries in `pose`; `gap` makes its efforts late.

    positions: rad, (4,) at each step of the device, with the `torques`.
    """

    def __init__(self, pose: Sequence[float] = RAISED, wearer: bool = False) -> None:
        self.is_late = self.is_withdrawn = self.is_held = False
        self.positions: list[list[float]] = []
        self._last = NO_EFFORTS
        self.links = DEFAULT_LINKS.with_wearer(*WEARER) if wearer else DEFAULT_LINKS
        super().__init__(pose, has_wearer=wearer, mode="zero_g" if wearer else "one_g")
        self.run(1.0)
        self.forget()

    def forget(self) -> None:
        """Forget what was seen."""
        self.top_speed = 0.0
        self.positions.clear()
        self.torques.clear()

    def move(self, pose: Sequence[float], duration: float) -> None:
        """Let the wearer's hand move the arm."""
        steps = [{"move": list(pose), "over": duration}]
        self.device.start(VirtualWearer(TrialScript.parse({"name": "move", "steps": steps})))

    def gap(self, duration: float) -> None:
        self.is_late = True
        self.run(duration)
        self.is_late = False

    def efforts(self, latest: float) -> Efforts:
        if not self.is_late:
            self._last = super().efforts(latest)._replace(held=self.is_held)
        return self._last._replace(effort=None) if self.is_withdrawn else self._last

    def _look(self) -> None:
        super()._look()
        self.positions.append(self.device.arm.positions)

    @property
    def largest_step(self) -> float:
        """Nm of a motor between two looks, 2 ms."""
        return float(np.abs(np.diff(self.torques, axis=0)).max())

    @property
    def felt(self) -> float:
        """The largest torque beyond what gravity takes, in Nm."""
        return float(np.abs(self.torques - gravity_torque(self.links, np.array(self.positions))).max())


riding_arm = prepared(RidingArm)


def test_a_gap_while_the_arm_is_held_moves_nothing_and_one_too_long_lets_it_down():
    arm = RidingArm(pose=ZERO_G, wearer=True)
    arm.gap(0.15)
    arm.run(0.3)
    assert arm.safety.state is State.ACTIVE and arm.safety.ride.rides == 1
    assert arm.top_speed < 0.02 and arm.felt < 0.05 and arm.largest_step < 0.05
    arm.gap(0.25)
    assert (arm.safety.state, arm.safety.fault.code) == (State.LETTING_DOWN, FaultCode.COMMAND_STALE)


def test_a_wearer_who_moves_is_slowed_gently_while_efforts_are_late():
    arm = riding_arm()
    position = arm.device.arm.positions
    arm.move(np.add(position, (0.0, -0.5, 0.0, 0.5)).tolist(), 1.25)
    arm.run(0.45)
    assert max(map(abs, arm.device.arm.velocities)) > 0.9
    arm.forget()
    arm.gap(0.1)
    arm.run(0.4)
    assert arm.safety.state is State.ACTIVE and arm.safety.ride.rides == 1
    assert arm.top_speed < 1.1 and arm.felt < 1.8 and arm.largest_step < STEP


def test_efforts_of_a_late_tilt_are_damped_at_once_and_withdrawn_ones_let_the_arm_down_at_once():
    arm = riding_arm()
    arm.is_held = True
    arm.run(2 * CYCLE)
    assert arm.safety.state is State.ACTIVE
    assert all(motor.damping > 0.0 for motor in arm.device.motors)
    arm.is_held = False
    arm.run(0.5)
    assert not any(motor.damping for motor in arm.device.motors)
    arm.is_withdrawn = True
    arm.run(2 * CYCLE)
    assert arm.safety.state is State.LETTING_DOWN
    assert all(motor.damping > 0.0 for motor in arm.device.motors)


def test_a_bus_that_is_silent_for_a_moment_lets_the_arm_down_and_one_press_carries_it_on():
    arm = riding_arm()
    arm.device.bus_silent = True
    arm.run(0.08)
    arm.device.bus_silent = False
    arm.run(0.1)
    assert (arm.safety.state, arm.safety.fault.code) == (State.LETTING_DOWN, FaultCode.MOTOR_SILENT)
    assert arm.run_until(lambda: arm.safety.state is not State.LETTING_DOWN)
    assert arm.top_speed < SPEED
    arm.forget()
    assert arm.safety.resume(arm.clock.monotonic()), arm.safety.why_not_resumed
    assert arm.run_until(lambda: arm.safety.state is State.ACTIVE, 6.0)
    assert arm.top_speed < SPEED and arm.largest_step < STEP


def test_a_loop_that_stood_still_for_longer_than_the_time_out_carries_on():
    arm = riding_arm()
    for _ in range(4):
        arm.clock.stall(0.06)
        arm.run(0.3)
    assert arm.safety.state is State.ACTIVE
    assert arm.top_speed < 0.02
