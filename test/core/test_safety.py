# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The safety machine on one pure run: rows of what happens to an arm, and of what the machine must do then."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.numbers import NO_TORQUE, Rate
from exo_gravity.core.safety.command import CARRYING, Fault, FaultCode, Send, State
from exo_gravity.core.safety.explain import STALE
from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.core.safety.lease import LEASE_TIME, Lease
from exo_gravity.core.safety.limits import DAMPING, DAMPING_RATE, MAX_EFFORT_RATE
from exo_gravity.core.safety.shape import STILLNESS
from exo_gravity.core.safety.start import SWITCH_ON, SignCheck
from exo_gravity.core.vocabulary import NO_REASON, Status, Wait

from ..support.copies import prepared
from ..support.safety_run import EFFORT, LIMITS, PERIOD, SafetyRun, reading
from ..support.simulated_device import OFF

Step = Callable[[SafetyRun], object]
TURN = math.radians(40.0)  # of an AK80-9's rotor, at the joint
LATE = LIMITS.command_timeout + PERIOD  # s


def enable(arm: SafetyRun) -> None:
    arm.machine.enable(arm.now)


def disable(arm: SafetyRun) -> None:
    arm.machine.disable(arm.now)


def clear(arm: SafetyRun) -> None:
    assert arm.machine.clear(arm.now)


def confirm(arm: SafetyRun) -> None:
    assert arm.machine.confirm_pose(arm.now) == ""


carried_arm = prepared(lambda: SafetyRun().until_active())


def carried(arm: SafetyRun) -> None:
    """Carry an arm of which nothing was changed."""
    vars(arm).update(vars(carried_arm()), steps=[])


def wait(seconds: float = PERIOD) -> Step:
    return lambda arm: arm.cycle(seconds)


def until(state: State, limit: float = 10.0) -> Step:
    return lambda arm: arm.until(state, limit)


def let(**inputs: Any) -> Step:
    """Set inputs of the machine from now on."""
    return lambda arm: vars(arm).update(inputs)


def reads(joint: int, **change: Any) -> Step:
    return lambda arm: arm.changes.__setitem__(joint, change)


def trip(code: FaultCode, reason: str = "test", later: float = 0.0) -> Step:
    return lambda arm: arm.machine.trip(code, reason, arm.now + later)


def stall(seconds: float) -> Step:
    """Let the loop stand still, and run it once."""

    def go_on(arm: SafetyRun) -> None:
        arm.now += seconds
        arm.cycle()

    return go_on


def move(joint: int, angle: float, speed: float, is_felt: bool = True) -> Step:
    """Move a joint from 0 to `angle` rad. is_felt: its motor's velocity says so."""

    def turn(arm: SafetyRun) -> None:
        for position in np.arange(0.0, angle, math.copysign(speed * PERIOD, angle)):
            arm.changes[joint] = {"position": float(position), "velocity": speed * is_felt}
            arm.cycle()
        arm.changes[joint] = {"position": angle}

    return turn


def see(state: State | None = None, fault: str | None = None, words: str = "") -> Step:
    """Assert the state, the fault's code ('' for none), and what the machine tells people."""

    def check(arm: SafetyRun) -> None:
        machine = arm.machine
        assert state is None or machine.state is state
        assert fault is None or (arm.fault_code or "") == fault
        assert words in f"{machine.waiting_for}; {machine.fault}; {machine.why_not_resumed}; {machine.pose.text}"

    return check


def has(holds: Callable[[SafetyRun], bool]) -> Step:
    def check(arm: SafetyRun) -> None:
        assert holds(arm), (arm.machine.state, arm.machine.fault, arm.command)

    return check


def never_entered(seconds: float) -> Step:
    """Run for `seconds`, in which the second motor is never switched on."""
    return has(lambda arm: Send.ENTER not in [arm.cycle().command.send[1] for _ in range(round(seconds / PERIOD))])


def leans(pitch: float, roll: float = 0.0) -> Step:
    """Tilt the trunk, in rad."""
    return lambda arm: arm.machine.motion.follow(arm.now, Tilt.of("right", pitch, roll), None)


SMOOTH = has(lambda arm: max(arm.steps) <= MAX_EFFORT_RATE * PERIOD * 1.0001)
ALL_OFF = has(lambda arm: arm.machine.is_off and not arm.command.powered and arm.command[:2] == OFF[:2])
DISABLED_AGAIN = (disable, wait(8.0), see(State.DISABLED))
STILL = (0.0, *(abs(torque) / STILLNESS.speed for torque in EFFORT[1:]))  # Nm s/rad, of joints that are still
FRESH, TOO_LATE = {"effort_age": 0.002, "held": False}, {"effort_age": LATE, "held": True}


def let_down_by(code: FaultCode) -> tuple[Step, ...]:
    """Let an arm down as a One-G descent leaves a shoulder that no gravity turns back."""
    return (carried, trip(code), move(0, 0.64, 0.4), until(State.FAULT), wait(0.1), ALL_OFF)


def late_by_turns(count: int, fresh: float, **late: Any) -> list[Step]:
    return [let(**late), wait(0.056), let(**FRESH), wait(fresh)] * count


RESUMABLE = [code for code in FaultCode if code.is_resumable][::2]
FINAL = [code for code in FaultCode if not code.is_resumable][::4]
LIMITS_OF_ROW = {"confirm": {"start_pose": "confirm"}, "lying": {"start_tilt": 1.8}}
FAULTS: list[tuple[FaultCode, Step]] = [
    (FaultCode.MOTOR_SILENT, let(silent={3})),
    (FaultCode.MOTOR_ERROR, reads(0, error=2)),
    (FaultCode.OVER_TEMPERATURE, reads(0, temperature=81)),
    (FaultCode.OVER_SPEED, reads(1, velocity=5.2)),
    (FaultCode.TORQUE_NOT_DELIVERED, let(off={1})),
    (FaultCode.POSITION_JUMP, reads(1, position=0.2)),
    (FaultCode.COMMAND_STALE, let(effort_age=LIMITS.command_timeout + 0.001)),
    (FaultCode.COMMAND_WITHDRAWN, let(effort=None)),
    (FaultCode.COMMAND_IMPOSSIBLE, let(effort=(0.0, math.nan, 0.0, 0.0))),
    (FaultCode.COMMAND_IMPOSSIBLE, let(effort=(0.0, 1e308, 0.0, 0.0))),
    (FaultCode.BUS_ERROR, trip(FaultCode.BUS_ERROR)),
]
ROWS: dict[str, Sequence[Step]] = {
    "a new machine keeps the motors off, and torque begins slowly and without a step": [
        wait(1.0), see(State.DISABLED), has(lambda arm: arm.command == OFF),
        enable, wait(0.75), see(State.RAMPING_IN), has(lambda arm: abs(arm.command.effort[1] + 2.0) < 0.15),
        wait(1.0), has(lambda arm: arm.command.effort == pytest.approx(EFFORT)), SMOOTH,
    ],
    "the checks require a whole second without trouble, which passes before the arm is enabled, too": [
        wait(2.0), let(silent={1}), wait(0.1), let(silent=set()), enable,
        *[wait(0.9), let(silent={1}), wait(0.1), let(silent=set())] * 5, see(State.CHECKING),
    ],
    "efforts may be late for a moment in the checks as while the arm is carried": [
        enable, *[let(effort_age=0.06), wait(0.02), let(effort_age=0.002), wait(0.23)] * 6,
        has(lambda arm: arm.machine.state is not State.CHECKING),
    ],
    "an error in the checks is latched": [
        reads(2, error=5), enable, wait(1.0), see(State.FAULT, "motor_error", "c:"),
    ],
    "heat in the checks is latched": [
        reads(2, temperature=95), enable, wait(1.0), see(State.FAULT, "over_temperature", "c:"),
    ],
    "an arm away from home is refused": [
        reads(1, position=TURN), enable, wait(1.0), see(State.FAULT, "implausible_zero", "b: 0.698 rad at the start"),
    ],
    "an arm that was carried once may start away from home until a supply was interrupted": [
        carried, *DISABLED_AGAIN, move(1, 0.6, 1.0), enable, until(State.ACTIVE), *DISABLED_AGAIN,
        let(silent={2}), wait(0.4), let(silent=set()), enable, wait(1.0), see(fault="implausible_zero"),
    ],
    "a jump while the arm is off has its zeros checked again": [
        carried, *DISABLED_AGAIN, reads(1, position=TURN), wait(2 * PERIOD), enable, wait(1.0),
        see(fault="implausible_zero"),
    ],
    "a motor that is found off is switched on again, once, with damping and without torque": [
        carried, let(off={1}),
        has(lambda arm: any(Send.ENTER in arm.cycle().command.send for _ in range(15))),  # in 60 ms
        has(lambda arm: arm.command.send == (Send.COMMAND, Send.ENTER, Send.COMMAND, Send.COMMAND)),
        see(fault="torque_not_delivered", words="b: -4.00 Nm commanded"),
        has(lambda arm: abs(arm.command.effort[1]) < 0.1),
        reads(1, velocity=1.0), wait(0.3),  # it sinks
        has(lambda arm: arm.command.damping[1] > 3.0 and arm.command.effort[1] < -3.0),
        lambda arm: arm.off.add(1), never_entered(2.0),
    ],
    "a motor with an error is not switched on again": [
        carried, let(off={1}), reads(1, error=5), never_entered(10.0), see(fault="motor_error"),
    ],
    "a start is refused in time while a motor is not off whose error is to be cleared": [
        carried, let(silent={1}), until(State.FAULT, 30.0), clear, enable, wait(LIMITS.enable_timeout + 1.0),
        see(State.DISABLED), has(lambda arm: bool(arm.machine.refusal)),
    ],
    "a motor that does not switch on is refused at every start": [
        carried, *DISABLED_AGAIN, reads(3, effort=0.02), enable, wait(1.6), see(fault="torque_not_delivered"),
        see(words="d: the motor did not switch on: -1 % of the commanded torque replied"), see(words="in servo mode"),
    ],
    "a motor that missed its ENTER gets another one": [
        let(off={0, 3}), enable, wait(1.2), has(lambda arm: not arm.off), until(State.ACTIVE),
    ],
    "a silent motor is damped and faded, and lowered from what it applies when it replies again": [
        carried, let(silent={1}), wait(0.5), see(State.LETTING_DOWN, "motor_silent"),
        has(lambda arm: arm.command.damping[1] == DAMPING and arm.command.effort[1] == -4.0),
        wait(5.0), has(lambda arm: arm.command.damping[1] == DAMPING and -3.0 < arm.command.effort[1] < -2.0),
        wait(12.0), see(State.FAULT), has(lambda arm: arm.machine.is_unreached and arm.command.powered),
        has(lambda arm: arm.command.send[1] is Send.COMMAND and arm.command.effort == NO_TORQUE),
        let(silent=set()), wait(0.05), see(State.LETTING_DOWN), until(State.FAULT, 20.0), wait(0.1), ALL_OFF,
        see(fault="motor_silent"),
    ],
    "a motor that lost its power while silent is not pushed when it replies again": [
        carried, let(silent={1}), wait(1.0), let(silent=set()), lambda arm: arm.applied.__setitem__(1, 0.0), wait(1.0),
        has(lambda arm: max(map(abs, (arm.applied[1], arm.command.effort[1]))) < 0.01),
    ],
    "only the operator clears a fault, and clearing enables nothing": [
        carried, trip(FaultCode.BUS_ERROR), wait(8.0), has(lambda arm: not arm.machine.enable(arm.now)),
        clear, wait(5.0), see(State.DISABLED), has(lambda arm: arm.machine.enable(arm.now)),
    ],
    "a fault with a later time than the next cycle does no harm": [
        carried, trip(FaultCode.BUS_ERROR, later=10 * PERIOD), wait(),
        has(lambda arm: arm.command.effort == pytest.approx(EFFORT)), see(State.LETTING_DOWN),
    ],
    "the first fault stays": [
        carried, trip(FaultCode.BUS_ERROR), trip(FaultCode.MOTOR_SILENT), wait(8.0), see(fault="bus_error"),
    ],
    "torque exceeds neither its limit nor its rate": [
        carried, let(effort=(39.0, -39.0, 39.0, -39.0)), wait(1.0),
        has(lambda arm: arm.command.effort == (3.0, -9.0, 3.0, -3.0) and "max_effort (b)" in arm.machine.acted), SMOOTH,
    ],
    "a hot motor gets less torque": [
        carried, let(effort=(3.0, 9.0, 3.0, 3.0)), reads(1, temperature=75), wait(1.0),
        has(lambda arm: arm.command.effort[1] == pytest.approx(6.75) and "derating (b)" in arm.machine.acted),
    ],
    "an arm that moves off as if it were empty is let down, and can be carried again": [
        carried, wait(0.5), has(lambda arm: arm.command.damping == STILL and "still joint (b)" in arm.machine.damped),
        move(2, 0.25, 0.9),
        see(State.LETTING_DOWN, "load_missing"), until(State.FAULT), clear, enable, until(State.ACTIVE), see(fault=""),
    ],
    "the motors are switched off once nothing holds the arm and it rests": [
        carried, disable, move(2, -0.12, 0.02, is_felt=False),  # for 6 s, slower than the velocity's resolution
        has(lambda arm: arm.command.powered and arm.command[:2] == OFF[:2]),
        wait(2.1), see(State.DISABLED), wait(0.1), ALL_OFF,
    ],
    "stale efforts are used under rising damping, which falls again": [
        carried, wait(0.3), has(lambda arm: arm.command.damping == STILL), let(effort_age=LATE), wait(),
        has(lambda arm: 0.0 < min(arm.command.damping) < 0.2),
        wait(0.1), see(State.ACTIVE),
        has(lambda arm: arm.machine.stale.count == 1 and "late efforts (a)" in arm.machine.damped),
        has(lambda arm: min(arm.command.damping) == pytest.approx(0.104 * DAMPING_RATE)),
        has(lambda arm: arm.command.effort == pytest.approx(EFFORT)),
        let(**FRESH), wait(0.12), see(State.ACTIVE), has(lambda arm: arm.command.damping == STILL),
        has(lambda arm: max(arm.steps) <= 1e-6),
    ],
    **{
        f"stale efforts on {name} end": [
            carried, let(**late), wait(STALE.longest - PERIOD), see(State.ACTIVE),
            wait(2 * PERIOD), see(State.LETTING_DOWN, "command_stale"),
        ]
        for name, late in {"a late tilt": {"held": True}, "late efforts": TOO_LATE}.items()
    },
    **{
        f"who is late more often than once in ten is let down: {name}": [
            carried, *late_by_turns(20, 0.6, **late), see(State.ACTIVE), has(lambda arm: arm.machine.stale.count == 20),
            *late_by_turns(4, 0.2, **late), see(fault="command_stale"),
        ]
        for name, late in {"a late tilt": {"held": True}, "late efforts": TOO_LATE}.items()
    },
    "after a pause of the loop itself only the age of the efforts counts": [
        carried, let(effort_age=0.1), stall(0.1), see(State.ACTIVE),  # no motor was asked; it has only begun
        let(effort_age=STALE.longest_age + PERIOD), wait(), see(fault="command_stale"),
    ],
    **{
        f"after {code} resume carries the arm from where it is": [
            *let_down_by(code), has(lambda arm: arm.machine.resume(arm.now)), until(State.ACTIVE, 3.3), see(fault=""),
        ]
        for code in RESUMABLE
    },
    **{
        f"resume is refused after {code}": [
            *let_down_by(code), has(lambda arm: not arm.machine.resume(arm.now)), see(State.FAULT, code),
            has(lambda arm, code=code: code in arm.machine.why_not_resumed.text),
        ]
        for code in FINAL
    },
    "resume is refused in any other state, and after a silence": [
        has(lambda arm: not arm.machine.resume(arm.now)), carried, has(lambda arm: not arm.machine.resume(arm.now)),
        trip(FaultCode.COMMAND_STALE), wait(), has(lambda arm: not arm.machine.resume(arm.now)), until(State.FAULT),
        let(silent={1}), wait(0.5), let(silent=set()), wait(0.1), has(lambda arm: not arm.machine.resume(arm.now)),
        has(lambda arm: "zeros" in arm.machine.why_not_resumed.text),
    ],
    **{
        f"a silence of {seconds} s with a turn by {turned} keeps zeros {'trusted' if is_trusted else 'in doubt'}": [
            *let_down_by(FaultCode.COMMAND_STALE), let(silent={1}), wait(seconds), let(silent=set()),
            reads(1, position=turned), wait(0.1),
            has(lambda arm, is_trusted=is_trusted: (not arm.machine.why_not_resumed) == is_trusted),
        ]
        for seconds, turned, is_trusted in (
            (0.08, 0.0, True), (0.08, TURN, False), (0.2, 0.0, True), (0.2, -TURN, False), (0.4, 0.0, False),
        )
    },
    "who takes over while signs are not proven takes the push back without damping": [
        lambda arm: arm.machine.probe(arm.now), wait(), let(applied=[0.0, 1.0, 0.0, 0.0]),
        lambda arm: arm.machine.take_over(arm.applied, (0.0,) * 4, arm.now, True), wait(),
        has(lambda arm: arm.command.effort[1] == pytest.approx(1.0 - MAX_EFFORT_RATE * PERIOD)),
        has(lambda arm: arm.command.damping == OFF.damping), wait(0.2), ALL_OFF, see(State.DISABLED, ""),
    ],
    "the notes say that signs are not proven until they are": [
        enable, until(State.PROVING), has(lambda arm: arm.command.is_unproven),
        until(State.RAMPING_IN), has(lambda arm: not arm.command.is_unproven),
    ],
    "a loop that stood still for long leaves zeros in doubt": [
        *let_down_by(FaultCode.COMMAND_STALE), stall(0.9), wait(), has(lambda arm: not arm.machine.why_not_resumed),
        stall(1.1), wait(), see(words="zeros"),
    ],
    "an arm that is carried on after stale efforts may wait for late ones again": [
        carried, let(**TOO_LATE), until(State.FAULT), let(**FRESH), has(lambda arm: arm.machine.resume(arm.now)),
        until(State.RAMPING_IN), let(effort_age=LATE), wait(0.08), see(State.RAMPING_IN, ""),
    ],
    **{
        f"the checks wait: {cause}": [spoil, enable, wait(2.0), see(State.CHECKING, words=words), ALL_OFF]
        for cause, (spoil, words) in {
            "a silent motor": (let(silent={2}), "c: no reply"),
            "an arm that moves": (reads(1, velocity=0.15), "at rest"),
            "a setup error": (
                lambda arm: setattr(arm.machine, "setup_error", "the watchdog to start"), "the watchdog to start",
            ),
            "no efforts": (let(effort=None), "effort commands"),
            "old efforts": (let(effort_age=0.06), "effort commands"),
            "a joint beyond its limits": (
                reads(2, position=2.6), "c to be moved by -5.8 degrees, within its limits -46",
            ),
        }.items()
    },
    "the calm second passes while the watchdog starts": [
        lambda arm: setattr(arm.machine, "setup_error", Status(Wait.WATCHDOG, "the watchdog to start")),
        enable, wait(2.0), see(State.CHECKING), lambda arm: setattr(arm.machine, "setup_error", NO_REASON),
        until(State.PROVING, 0.1),
    ],
    "the calm second passes while efforts are withheld, but for its end, which each gap restarts": [
        let(effort=None), enable, wait(2.0), let(effort=EFFORT), wait(0.2), see(State.CHECKING),
        let(effort=None), wait(), let(effort=EFFORT), wait(0.2), see(State.CHECKING), until(State.PROVING, 0.06),
    ],
    "without answers in time the calm second does not pass": [
        let(effort=None, **TOO_LATE), enable, wait(2.0), let(effort=EFFORT, **FRESH), wait(0.9), see(State.CHECKING),
        until(State.PROVING, 0.15),
    ],
    "an arm that swings beyond where it should hang is waited for, and no fault until it rests there": [
        reads(1, position=0.7, velocity=0.15), enable, wait(2.0), see(State.CHECKING, words="at rest"),
        reads(1, position=0.7), wait(0.1), see(fault="implausible_zero"),
    ],
    "no signs are proven before a start, and all of them in one that needs no proof": [
        has(lambda arm: arm.machine.signs.progress == 0.0), enable, until(State.PROVING),
        has(lambda arm: arm.machine.signs.progress == 1.0),
    ],
    "a trunk whose tilt arrives soon after the first efforts is still waited for": [
        let(effort=None), enable, wait(2.0), let(effort=EFFORT), wait(0.2), leans(-1.57), wait(2.0),
        see(State.CHECKING, words="near upright"),
    ],
    **{
        f"a turn that an encoder loses while the loop stands still for {seconds} s in the proof is a fault": [
            enable, until(State.PROVING), wait(0.05), reads(1, position=TURN), stall(seconds), wait(0.1),
            see(fault="position_jump"), wait(0.1), ALL_OFF,
        ]
        for seconds in (0.004, 0.09, 0.2, 2.0)
    },
    **{
        f"after {code}, which may have moved them, zeros are checked again": [
            carried, trip(FaultCode(code)), wait(10.0), clear, reads(1, position=TURN), wait(2 * PERIOD), enable,
            wait(1.0), see(fault="implausible_zero"),
        ]
        for code in ("position_jump", "motor_error", "outside_limits", "torque_not_delivered")
    },
    "a jump ends trust although heat wins": [
        carried, reads(1, position=0.7, temperature=90), wait(0.02), see(State.LETTING_DOWN, "over_temperature"),
        reads(1, position=0.7), until(State.FAULT, 20.0), clear, enable, wait(1.0), see(fault="implausible_zero"),
    ],
    "a jump out of the limits ends trust": [
        carried, reads(1, position=3.3), wait(0.02), see(State.LETTING_DOWN, "position_jump"), reads(1, position=0.6),
        until(State.FAULT, 20.0), clear, enable, wait(1.5), see(State.FAULT, "implausible_zero"),
    ],
    # issue 42: over_speed hid position_jump; clear and enable carried the arm 40 degrees wrong
    "after a slip with a filtered velocity the arm is not carried again from wrong angles": [
        carried,
        *(
            step
            for n in range(25)  # the velocity follows the slip within 20 ms
            for step in (reads(1, position=TURN, velocity=TURN / 0.02 * math.exp(-n * PERIOD / 0.02)), wait())
        ),
        reads(1, position=TURN), has(lambda arm: arm.fault_code in ("over_speed", "position_jump")),
        until(State.FAULT), clear, enable, wait(1.5), see(State.FAULT, "implausible_zero"),
    ],
    "a hanging arm for which much torque is asked is refused at an untrusted start only": [
        let(while_hanging=(0.0, 3.8, 0.0, 0.0)),  # of the robot alone, by an IMU that is mounted 90 degrees otherwise
        enable, wait(3.0), see(State.FAULT, "torque_while_hanging"),
        let(while_hanging=(0.0, 1.0, 0.0, 0.0)), clear, enable, until(State.ACTIVE),
    ],
    "confirm: a restart of the motors after an emergency stop asks the operator again": [
        enable, wait(1.0), confirm, until(State.ACTIVE), wait(0.1),
        let(silent={0, 1, 2, 3}), wait(0.5), let(off={0, 1, 2, 3}, silent=set()),
        reads(3, position=0.4),  # in the lap, off by a turn of its rotor: within the gate's tolerance
        until(State.FAULT), clear, enable, wait(5.0), see(State.CHECKING, words="the operator to confirm the pose"),
        see(words="d 23"),
    ],
    **{
        f"after {code} ({n}) the arm is let down gently, and the fault stays latched": [
            carried, spoil, wait(0.15), see(State.LETTING_DOWN, code), has(lambda arm: arm.command.powered),
            has(lambda arm, code=code: min(arm.command.damping) > 0.0 or code == "motor_silent"),
            *map(reads, range(4)), let(silent=set(), effort=EFFORT, **FRESH), until(State.FAULT, 20.0), wait(0.1),
            ALL_OFF, SMOOTH, wait(1.0), see(State.FAULT, code),
        ]
        for n, (code, spoil) in enumerate(FAULTS)
    },
    **{
        f"damping times speed stays within max_effort in an arm that is {state}": [
            carried, *steps, *(reads(n, velocity=3.6, position=LIMITS.position_max[n] - 0.02) for n in range(4)),
            wait(2 * PERIOD), has(lambda arm: any(arm.command.damping)),
            has(lambda arm: np.all(3.6 * np.array(arm.command.damping) <= np.array(LIMITS.max_effort) + 1e-9)),
        ]
        for state, steps in (("carried", ()), ("let down", (disable, wait(0.5))))
    },
    "a person who bows, or sits back, may start": [leans(0.9), enable, until(State.ACTIVE)],
    **{
        f"{name}, is waited for, and a carried arm is not": [
            leans(pitch, roll), enable, wait(2.0), see(State.CHECKING, words="near upright"),
            leans(0.0), until(State.ACTIVE, 20.0), leans(pitch, roll), wait(1.0), see(State.ACTIVE),
        ]
        for name, pitch, roll in (("a trunk on its back", -1.57, 0.0), ("one by a wrong IMU upside down", 0.0, 3.1))
    },
    "lying: a person who lies may start, as the parameters say": [leans(-1.57), enable, until(State.ACTIVE)],
    "confirm: the calm second passes while the operator looks at the arm": [
        enable, wait(1.5), see(State.CHECKING), confirm, wait(0.05), see(State.PROVING),
    ],
    "confirm: there is nothing to confirm while the arm is disabled": [
        has(lambda arm: arm.machine.confirm_pose(arm.now).startswith("nothing to confirm: the arm is disabled")),
    ],
    **{
        f"confirm: a confirmation lapses and is asked for again when {name}": [
            enable, wait(0.5), has(lambda arm: arm.machine.pose.asked), confirm,
            has(lambda arm: not arm.machine.pose.asked),
            lambda arm, setup_error=setup_error: setattr(arm.machine, "setup_error", setup_error),
            reads(3, position=moved, velocity=0.0), wait(waited),
            lambda arm: setattr(arm.machine, "setup_error", NO_REASON), wait(2.0),
            see(State.CHECKING), has(lambda arm: arm.machine.pose.asked),
        ]
        for name, moved, waited, setup_error in (
            ("the arm moves", 0.1, 0.02, NO_REASON),
            ("time passes", 0.0, 11.0, Status(Wait.WATCHDOG, "the watchdog to start")),
        )
    },
}  # fmt: skip


@pytest.mark.parametrize("name", ROWS)
def test_the_machine_does_what_the_row_says(name):
    arm = SafetyRun(**LIMITS_OF_ROW.get(name.split(":")[0], {}))
    for step in ROWS[name]:
        step(arm)


SET = {  # of an event, what its value sets
    "off": lambda arm, joint: arm.off.add(joint),
    "silent": lambda arm, joint: arm.silent.add(joint),
    "replies": lambda arm, joint: arm.silent.discard(joint),
    "effort": lambda arm, effort: setattr(arm, "effort", effort),
    "age": lambda arm, age: setattr(arm, "effort_age", age),
    "reading": lambda arm, change: arm.changes.__setitem__(0, change),
    "trip": lambda arm, _: arm.machine.trip(FaultCode.BUS_ERROR, "test", arm.now),
    **{name: lambda arm, _, name=name: getattr(arm.machine, name)(arm.now) for name in ("enable", "disable", "clear")},
    "time": lambda arm, _: None,
}
VALUES = {
    **dict.fromkeys(("off", "silent", "replies"), st.integers(0, 3)),
    **dict.fromkeys(("enable", "disable", "clear", "trip"), st.none()),
    "effort": st.lists(st.floats(width=32), min_size=4, max_size=4) | st.none(),
    "age": st.floats(0.0, 0.2),
    "reading": st.dictionaries(st.sampled_from(["position", "velocity"]), st.floats(-9, 9)),
    "time": st.floats(0.004, 3.0),
}
EVENTS = st.one_of(*(st.tuples(st.just(name), values) for name, values in VALUES.items()))


@settings(max_examples=60, deadline=None)
@given(st.lists(EVENTS, max_size=25), st.sampled_from([0.0, 1.5]))
@example([("enable", None), ("time", 1.125), ("disable", None)], 0.0)  # a push of 0.4 Nm ended in one cycle
@example([("enable", None), ("time", 1.9), ("trip", None)], 1.5)
def test_no_sequence_of_events_lets_torque_flow_without_fresh_input_or_step(events, sign_check_torque):
    arm = SafetyRun(0.004, sign_check_torque=sign_check_torque)
    for event, value in events:
        SET[event](arm, value)
        had_fault = arm.machine.fault
        arm.cycle(value if event == "time" else arm.period)
        check(arm, had_fault if event != "clear" else None)
    assert max(arm.steps, default=0.0) <= MAX_EFFORT_RATE * arm.period * 1.0001


def check(arm: SafetyRun, had_fault: Fault | None) -> None:
    """Assert what must hold after every cycle; `had_fault`: a fault latched before it."""
    machine, command = arm.machine, arm.command
    assert all(map(math.isfinite, command.effort))
    assert all(abs(e) <= limit for e, limit in zip(command.effort, LIMITS.max_effort, strict=True))
    if machine.state in CARRYING:
        assert arm.effort is not None
        assert arm.effort_age <= STALE.longest_age + 1e-9
        is_damped = machine.state is State.PROVING or min(command.damping) > 0.0
        assert arm.effort_age <= LIMITS.command_timeout + 1e-9 or is_damped
        assert all(arm.now - joint.time <= LIMITS.reply_timeout + 1e-9 for joint in arm.joints)
        assert machine.fault is None
    elif machine.is_off:
        assert not command.powered and command.effort == command.damping == OFF.effort
    elif machine.state is not State.LETTING_DOWN and not machine.is_unreached:
        assert not any(send in (Send.ENTER, Send.CLEAR) for send in command.send)
    if had_fault:
        assert machine.fault == had_fault


def test_while_the_load_changes_only_a_joint_that_moves_is_damped_and_damping_neither_steps_nor_stays():
    run = SafetyRun().until_active()
    run.effort = NO_TORQUE  # under which no joint is damped because it is still
    run.cycle(0.5)
    run.damped, speeds = True, (0.0, GUIDANCE.calm, -1.0, 0.4)
    dampings = [run.command.damping]
    for step in range(100):
        if step == 50:
            assert run.command.damping[:2] == (0.0, 0.0)
            assert run.command.damping[2] == pytest.approx(GUIDANCE.brake) and "guided motion (c)" in run.machine.damped
            assert 0.5 < 0.4 * run.command.damping[3] < GUIDANCE.brake
            run.damped = False
        moved = min(49, step) * PERIOD
        run.changes = [{"position": v * moved, "velocity": v * run.damped} for v in speeds]
        dampings.append(run.cycle().command.damping)
    assert run.command.damping == NO_TORQUE
    assert np.abs(np.diff(dampings, axis=0)).max() <= DAMPING_RATE * PERIOD * 1.001
    assert run.machine.state is State.ACTIVE


class YieldingArm(SafetyRun):
    """An arm whose joints yield to torque: by `mobility` (4,) rad/s per Nm beyond 0.45 Nm of friction.

    parallel: joints (0..) whose angles add up to the one by which the last of them is asked to lift; () for none.
    largest_effort: Nm of each joint so far.
    """

    def __init__(self, mobility: Sequence[float], parallel: Sequence[int] = ()) -> None:
        super().__init__(sign_check_torque=1.5)
        self.mobility, self.parallel = mobility, parallel
        self.position = [0.0] * 4
        self.largest_effort = [0.0] * 4
        self.effort = NO_TORQUE

    def cycle(self, seconds: float = PERIOD) -> YieldingArm:
        for _ in range(max(1, round(seconds / PERIOD))):
            for i, (effort, mobility) in enumerate(zip(self.command.effort, self.mobility, strict=True)):
                self.largest_effort[i] = max(self.largest_effort[i], effort)
                excess = effort - max(-0.45, min(0.45, effort))
                self.position[i] += excess * mobility * PERIOD
                self.changes[i] = {"position": self.position[i]}
            if self.parallel:
                lift = 3.6 * sum(self.position[i] for i in self.parallel)
                self.effort = [lift if i == self.parallel[-1] else 0.0 for i in range(4)]
            super().cycle()
        return self

    def proven(self) -> YieldingArm:
        """Enable the machine and run it until the signs are proven or a fault is found."""
        self.machine.enable(self.now)
        self.cycle()
        while self.machine.state in (State.CHECKING, State.PROVING):
            self.cycle()
        return self


def test_each_joints_sign_is_checked_once_and_gently_before_the_arm_is_carried():
    arm = YieldingArm((0.5, 0.2, 0.5, 0.5))
    for step in (
        enable, wait(1.5), see(State.PROVING), until(State.ACTIVE, 16.0), SMOOTH,
        has(lambda arm: all(-0.05 < position < 0.06 for position in arm.position)),
        *DISABLED_AGAIN, let(largest_effort=[0.0] * 4), enable, until(State.ACTIVE),
        has(lambda arm: arm.largest_effort == [SWITCH_ON.torque] * 4),  # the check that the motors are on
    ):  # fmt: skip
        step(arm)


SLOWER, FASTER = (0.5, 0.2, 0.2, 0.5), (0.5, 0.2, 0.5, 0.2)  # the third joint than the fourth, which it carries
ARMS = {  # mobility, joints with parallel axes, the fault, and how its reason begins
    "a joint that moves backwards": ((0.5, 0.2, -0.5, 0.5), (), "wrong_sign", "c: "),
    "a joint that does not move": ((0.5, 0.2, 0.0, 0.5), (), "sign_unproven", "c: "),
    "of two parallel joints the one nearer to the base is slower": (SLOWER, (2, 3), None, ""),
    "it is faster": (FASTER, (2, 3), "joints_exchanged", "c moved sooner than d, which it carries: "),
    "no axis is parallel to that of the last joint, which gravity turns": (FASTER, (3,), None, ""),
    "gravity turns none": (FASTER, (), None, ""),
}


@pytest.mark.parametrize(("mobility", "parallel", "code", "reason"), ARMS.values(), ids=ARMS)
def test_signs_and_the_order_of_joints_are_proven_before_the_arm_is_carried(mobility, parallel, code, reason):
    arm = YieldingArm(mobility, parallel).proven()
    assert arm.fault_code == code
    assert code is None or arm.machine.fault.reason.startswith(reason)
    assert code in (None, "joints_exchanged") or arm.largest_effort[3] == 0.0


def test_efforts_that_are_nan_while_signs_are_proven_compare_no_joints_and_are_refused_before_they_are_applied():
    arm = YieldingArm(FASTER)
    arm.effort = (math.nan,) * 4
    assert arm.proven().fault_code == "command_impossible"
    assert max(map(abs, arm.command.effort)) < 0.1


HANDS = {  # joint speed (rad/s) over time (s), friction (Nm), and the message to the wearer
    "moves it before it is pushed": (lambda now: 0.5 if 0.2 < now < 0.3 else 0.0, 10.0, ""),
    "keeps moving it": (lambda now: 1.0 if now % 0.5 > 0.25 else 0.0, 10.0, "hold still"),
    "shakes it": (lambda now: (0.2 if now % 0.04 < 0.02 else -0.2) if now > 0.3 else 0.0, 0.3, ""),
    "drags it up": (lambda now: 0.04 if now > 0.4 else 0.0, 10.0, ""),
    "drags it down": (lambda now: -0.04 if now > 0.4 else 0.0, 10.0, ""),
}


@pytest.mark.parametrize(("hand", "friction", "told"), HANDS.values(), ids=HANDS)
def test_a_hand_that_moves_a_joint_proves_no_sign_and_the_joint_is_not_pushed_on_and_on(hand, friction, told):
    """The first joint alone yields at 0.2 rad/s per Nm beyond `friction`, and to the hand."""
    check, pushes, position, now, fault = SignCheck(("a", "b", "c", "d"), (1.5, 0.0, 0.0, 0.0)), [], 0.0, 0.0, None
    while now < 60.0 and not (fault or check.done):
        effort = check.effort[0]
        pushes.append(abs(effort))
        velocity = 0.2 * (effort - max(-friction, min(friction, effort))) + hand(now)
        position, now = position + 0.004 * velocity, now + 0.004
        sample = reading(position=position, velocity=velocity, effort=effort, time=now)
        fault = check.step(0.004, (sample,) * 4, NO_TORQUE)
    assert not check.done
    assert fault is not None and fault.code in ("sign_unproven", "wrong_sign") and told in fault.reason
    assert max(pushes) < friction


# Who holds control, and for how long; and rates of counters

NAMELESS = "control: needs a name of 1 to 64 letters and hold, take or release"
REQUESTS = {  # (s, name, kind, sentence) after anna holds control at 100 s; without a kind it is asked what was lost
    "a lease lasts as long as it is renewed, and is lost once": [
        *((100.0 + 0.9 * LEASE_TIME * n, "anna", "hold", "") for n in range(1, 10)),
        (108.1 + LEASE_TIME, "", None, ""),
        (108.1 + 1.01 * LEASE_TIME, "", None, "anna held control and has not renewed it for 1 s"),
        (160.0, "", None, ""),
        (160.0, "ben", "hold", "ben holds control"),
        (160.1, "ben", "release", "ben has released control"),
        (1e6, "", None, ""),
    ],
    "another name neither holds nor renews nor releases, and is named once": [
        (100.2, "ben", "hold", "ben may not hold control: anna does"),
        (100.8, "ben", "hold", ""),
        (100.9, "ben", "release", ""),
        (101.1, "", None, "anna held control and has not renewed it for 1 s"),
    ],
    "who had it does not get it back by holding on": [
        (100.1, "ben", "take", "ben has taken control from anna"),
        (100.2, "anna", "hold", "anna may not hold control: ben does"),
        (100.9, "ben", "take", ""),
        (101.8, "", None, ""),
        (102.0, "", None, "ben held control and has not renewed it for 1 s"),
    ],
    **{
        f"the name {name!r} and the kind {kind!r} do nothing": [
            (100.1, name, kind, NAMELESS), (100.2, name, kind, ""), (100.3, "anna", "hold", ""),
        ]
        for name, kind in (("", "hold"), ("x" * 65, "take"), ("an\nna", "take"), ("ben", "seize"), ("ben", ""))
    },
}  # fmt: skip


@pytest.mark.parametrize("requests", REQUESTS.values(), ids=REQUESTS)
def test_one_name_holds_control_for_as_long_as_it_is_renewed(requests):
    lease = Lease()
    for now, name, kind, sentence in [(99.0, "", None, ""), (100.0, "anna", "hold", "anna holds control"), *requests]:
        assert (lease.lost(now) if kind is None else lease.request(now, name, kind)) == sentence


def test_a_rate_is_averaged_over_a_second_or_more_and_restarts_with_its_counter():
    rate = Rate()
    counts = (10.0, 0), (10.5, 250), (11.0, 500), (11.1, 540), (12.0, 3), (14.0, 203)
    assert [rate.update(now, count) for now, count in counts] == [0.0, 0.0, 500.0, 500.0, 0.0, 100.0]
