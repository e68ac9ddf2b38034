# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The supply of a carried arm is switched off and on, or its bus: what the motors truly do, in virtual time."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.frames import WireFormat
from exo_gravity.core.safety.drive import Drive, State

from ..support.thorough import quick
from .rig import QUICK, SAFE_SPEED, OnWatch, TwoBusRig, VirtualRig, raised_arm

FORMATS = pytest.mark.parametrize("wire_format", quick([MIT_V3], [MIT, MIT_V3]), ids=["mit", "mit_v3"])
CAUSED_SPEED = 0.6  # rad/s that motors may cause


def test_motors_on_two_buses_whose_supply_returns_stay_off_until_they_are_enabled() -> None:
    """On one bus: rows of the fault matrix."""
    arm = raised_arm(kind=TwoBusRig)
    arm.rig.switch_supply(False)
    arm.run(2.0)
    assert arm.safety.fault.code == "motor_silent"
    watch = OnWatch(arm.rig)
    arm.run(0.1)
    arm.rig.top_speed = 0.0
    arm.rig.switch_supply(True)
    arm.run(3.0)
    assert not watch.was_on
    assert arm.rig.top_speed < 0.05
    assert arm.loop.is_off
    watch.end()
    arm.rig.device.arm.reset(NO_TORQUE)
    arm.run(0.6)
    assert arm.safety.clear(arm.clock.monotonic()) or arm.safety.state is State.DISABLED
    assert arm.safety.enable(arm.clock.monotonic())
    arm.run_until(lambda: arm.safety.state is State.ACTIVE, 8.0)
    assert arm.rig.motors_on == [True] * 4


AWAY = [(wire_format, away) for wire_format in (MIT, MIT_V3) for away in (0.5, 6.0, 15.0)]


@pytest.mark.parametrize(("wire_format", "away"), quick([(MIT_V3, 0.5)], AWAY))
def test_a_single_motor_whose_power_returns_late_does_not_get_its_old_torque(
    wire_format: WireFormat, away: float
) -> None:
    """A command switches a V3 board on: while it does not reply, none is sent that would carry its joint."""
    arm = raised_arm(wire_format=wire_format)
    motor, device_arm = arm.rig.device.motors[1], arm.rig.device.arm
    motor.unplugged = True
    arm.run(away)
    arm.rig.top_speed, motor.unplugged = 0.0, False
    torques: list[float] = []
    for _ in range(10):
        arm.loop.cycle()
        torques.append(motor.torque(device_arm.positions[1], 0.0))
    assert max(map(abs, torques)) < 1.0 < arm.rig.carrying[1]
    arm.run_until(lambda: arm.loop.is_off)
    assert arm.rig.motors_on == [False] * 4
    assert arm.rig.top_speed < SAFE_SPEED


def test_the_last_resort_leaves_motors_off_whose_supply_returns() -> None:
    arm = raised_arm()

    def fail(*_: object) -> Drive:
        raise ZeroDivisionError

    arm.safety.step = fail  # type: ignore[method-assign]
    watches: list[OnWatch] = []

    def release() -> None:
        watches.append(OnWatch(arm.rig))
        arm.rig.switch_supply(True)

    arm.clock.later(1.0, lambda: arm.rig.switch_supply(False))
    arm.clock.later(3.0, release)
    while arm.loop.cycle():
        pass
    assert watches and not watches[0].was_on


@pytest.mark.parametrize(("wire_format", "silent_for"), [(MIT, 0.0), (MIT_V3, 3.0)], ids=["at once", "reached late"])
def test_motors_that_an_owner_without_notes_left_on_are_damped_and_let_down(
    wire_format: WireFormat, silent_for: float
) -> None:
    rig = VirtualRig(wire_format=wire_format)
    rig.device.bus_silent = silent_for > 0.0
    rig.clock.later(silent_for, lambda: setattr(rig.device, "bus_silent", False))
    arm = rig.loop_with()
    arm.bus.listen()
    arm.enable()  # refused: the arm does not hang
    arm.run(silent_for + 1.0)
    assert arm.run_until(lambda: arm.loop.is_off, 29.0)
    assert rig.motors_on == [False] * 4
    rig.clock.sleep(0.5)
    assert rig.top_speed < CAUSED_SPEED  # 5.3 rad/s where the first frame is zero torque


@FORMATS
@pytest.mark.parametrize("is_on", [False, True])
def test_a_loop_can_end_at_once_while_no_motor_was_ever_heard(wire_format: WireFormat, is_on: bool) -> None:
    rig = VirtualRig(pose=NO_TORQUE, carried=is_on, wire_format=wire_format)
    rig.device.bus_silent = True
    loop = rig.loop_with().loop
    loop.cycle()
    rig.device.bus_silent = False
    loop.stop()
    assert rig.motors_on == [is_on] * 4  # not known, so nothing was sent


@pytest.mark.parametrize("spoil", [lambda rig: rig.switch_supply(False), lambda rig: None], ids=["supply", "efforts"])
def test_an_enable_expires_and_says_what_was_missing(spoil: Callable[[VirtualRig], None]) -> None:
    rig = VirtualRig(pose=NO_TORQUE, carried=False)
    spoil(rig)
    arm = rig.loop_with(limits=QUICK)
    loop = arm.loop
    arm.enable()
    arm.run(QUICK.enable_timeout - 0.1)
    assert loop.safety.state is State.CHECKING
    arm.run(0.2)
    assert loop.safety.state is State.DISABLED and not loop.safety.fault
    missing = "no reply for more than 50 ms" if math.isnan(loop.samples[0].position) else "effort commands"
    assert loop.safety.refusal.startswith("not enabled within 10 s: waited for") and missing in loop.safety.refusal
    rig.switch_supply(True)
    watch = OnWatch(rig)
    arm.run(3.0)
    assert not watch.was_on
    assert loop.safety.enable(rig.clock.monotonic()) and not loop.safety.refusal
