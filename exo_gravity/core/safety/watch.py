# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""All that is known of each motor of an arm: its readings, its silences, its power, its torque.

Readings. After power-up a motor knows its angle modulo a turn of its rotor only: 60 degrees at the joint of an AK60-6,
40 at an AK80-9. So zeros and signs are proven while the arm hangs. A proof holds for as long as the angles are
continuous, and that is judged here alone, whichever fault lets the arm down. They are no longer continuous when

- a motor may have lost its power: it was silent for long enough to restart, the loop stood still for a second, or the
  motor has come back from a shorter silence at an angle that its velocity does not explain;
- an angle jumps, or a joint turns faster than `max_velocity`: an encoder that slips looks like a joint that is thrown;
- angle and velocity contradict each other: a wrong `velocity_range` or sign, a frozen angle, a slow slip;
- a motor reports an error;
- another part calls `require_sign_check`: a motor was found off, or another sender commanded one.

What no reading shows: an encoder that slips by less than `CONTINUITY.jump` at a time while its velocity follows, and a
motor that repeats one angle with a velocity of 0. The proof of signs, at the next start, finds the second.

Power. No frame of an AK motor says whether it is on. What is known follows from what it was sent, whether it has
replied, and what torque it shows. The replies of other families say it (`JointSample.on`), and are believed. `NEXT` has
the transitions of a motor, `SENT` what it receives in each state; where two families differ, they are what is safe on
both.

- Only an operator's enable switches a motor on. There is one exception: a motor that is found off while it carries its
  joint, and was never silent for long, has restarted or obeyed a foreign EXIT. It is switched on again once, and comes
  back with damping and without torque.
- A motor that is silent is taken to obey: it may hear what it is sent. Its command cannot switch a V1 or V2 board on. A
  command switches a V3 board on, so it gets none once its power may have been cut.
- A motor is off once it has replied to EXIT. A late reply to the command before must not count: the second EXIT's does.

Torque. A motor that has been switched off, has restarted, missed its ENTER, or obeys another commander still replies,
but with another torque. An ordinary reply is one command old, behind a current loop of up to 8 ms, late by a batch of
its adapter or a stall of the computer, or answers the command before a lost one: it lies between the least and the most
that the commands of the last `DELIVERY.span` asked for. What exceeds these by more than a tolerance is evidence; it is
summed over the replies, so that noise of 0.15 Nm cancels and a lost frame adds nothing.

A pause of the loop. A motor's firmware may let go of its joint if no command comes for a while, without damping and
without a word, and the next command brings the torque back at once (docs/wiring.md). A reply only follows that command:
the readings after it tell whether a joint fell.

Chosen against ordinary equipment: 3 % of the frames lost each way, a computer that is late by 20 ms in one cycle of
ten, adapters that deliver in batches of 1 ms, velocities of 12 bits without a code for 0 that lag by 20 ms, knocks at
5 rad/s, and a motor that reports one wrong reading now and then.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from exo_gravity.core.motors.joint_motor import UNKNOWN, JointMotor, JointSample
from exo_gravity.core.safety.command import Fault, FaultCode, Send
from exo_gravity.core.safety.limits import EQUIPMENT, HEAT, READING, Limits


@dataclass(frozen=True)
class ContinuityLimits:
    """How far readings may differ from a continuous motion."""

    #: s of silence after which a motor may have restarted while it held the arm; a forearm whose motor has lost its
    #: power has fallen by 0.3 rad by then. Until then its angle shows whether it has: a lost turn is at least twice
    #: `home_tolerance`
    restart: float = 0.1
    restart_off: float = 0.3  #: s, of motors that are off: only a person moves an arm that is down
    pause: float = 1.0  #: s for which the loop stood still, and knows nothing; a busy computer makes less
    jump: float = 0.05  #: rad between two readings, in addition to what `max_velocity` allows
    #: s, time constant with which angle and integrated velocity forget their difference; a velocity that is wrong by
    #: half a code of an AK80-9 (0.012 rad/s) adds 0.024 rad
    memory: float = 2.0
    #: rad of difference: knocks at 5 rad/s, a velocity that lags by 20 ms, lost frames and a late computer together
    #: make 0.09 (test/core/test_readings.py)
    slip: float = 0.15
    #: of the way that the velocity shows, in addition: a `velocity_range` of 50 in place of 45 rad/s is wrong by 0.11,
    #: which no arm feels
    share: float = 0.25


@dataclass(frozen=True)
class PowerTuning:
    """What in its replies shows a motor on or off.

    A motor that is off may report 0.15 Nm of noise (standard deviation); smoothed at 100 Hz that is 0.05 Nm, so one
    read in ten thousand takes such a motor for one that is on.
    """

    torque: float = 0.2  #: Nm, smoothed, from which on it is on; less cannot throw an arm when it is switched off
    smoothing: float = 0.05  #: s, time constant
    read_time: float = 0.2  #: s without torque that show a motor off; an arm that sinks under damping shows it sooner
    #: s of silence after which an operator may have cut its power: nobody releases an emergency stop sooner, and a
    #: brownout is over by then
    cut: float = 0.2
    off_share: float = 0.25  #: of the torque asked for, less of which a motor gives that does not deliver: it is off
    reports_off: int = 2  #: replies in a row that say that a motor is off; one may be wrong, or older than its ENTER
    exit_period: float = 0.5  #: s between two EXIT frames to a motor that is off, in case it was switched on unseen


@dataclass(frozen=True)
class Delivery:
    """How much a replied torque may differ from the commanded one."""

    least: float = 0.25  #: Nm
    share: float = 0.25  #: of the expected torque, in addition
    span: float = 0.03  #: s of the loop before the last reply, whose commands a reply may answer
    #: Nm s, excess times the period of a reply; one reply adds at most half. No false alarm in 2 hours at 0.15 Nm of
    #: noise and 100 Hz: docs/safety_case.md
    evidence: float = 0.0075
    noted: int = 256  #: commands, at most, while a motor is silent


@dataclass(frozen=True)
class Stall:
    """What a fall in a pause of the loop looks like."""

    late: float = 1.5 * EQUIPMENT.late  #: s beyond the period of the loop
    least: float = 0.5  #: Nm that a motor must have applied: a joint that carries nothing falls nowhere
    #: rad/s that a joint gains against that torque: a fall of 20 ms under gravity alone, or a wearer's hard push
    gained: float = 0.3


CONTINUITY, POWER, DELIVERY, STALL = ContinuityLimits(), PowerTuning(), Delivery(), Stall()
REST_TURN = 0.005  # rad that a joint at rest may turn
# Readings after which the angles are no longer continuous.
BREAKS = frozenset(
    {FaultCode.MOTOR_ERROR, FaultCode.OVER_SPEED, FaultCode.POSITION_JUMP, FaultCode.READINGS_CONTRADICT}
)


class Power(str, Enum):
    """The state of one motor."""

    UNKNOWN = "unknown"  #: at the start of a process; nothing that it sent can have switched it on
    OFF = "off"
    ENTERING = "entering"  #: is being switched on; not shown yet
    ON = "on"
    SILENT = "silent"  #: was on, does not reply
    UNSURE = "unsure"  #: may be on: another process left it, or it was silent for long
    LEAVING = "leaving"  #: is being switched off; not confirmed yet


class PowerChange(str, Enum):
    """What changes a motor's state: an order of the safety machine, or what its replies show."""

    SWITCH_ON = "order: switch on"
    SWITCH_OFF = "order: switch off"
    TAKEN_OVER = "left on by another process"
    PROBED = "start of the process"
    SHOWN_ON = "torque shown"
    SILENT = "no reply"
    CUT = "no reply for long"
    REPLIES = "replies again"
    CONFIRMED = "replied to EXIT"


NEXT: dict[tuple[Power, PowerChange], Power] = {
    (Power.OFF, PowerChange.SWITCH_ON): Power.ENTERING,
    (Power.UNKNOWN, PowerChange.SWITCH_ON): Power.ENTERING,  # that another process was switching on
    (Power.ENTERING, PowerChange.SHOWN_ON): Power.ON,
    (Power.ON, PowerChange.SILENT): Power.SILENT,
    (Power.SILENT, PowerChange.REPLIES): Power.ON,
    (Power.SILENT, PowerChange.CUT): Power.UNSURE,
    (Power.UNSURE, PowerChange.SHOWN_ON): Power.ON,
    (Power.UNKNOWN, PowerChange.SHOWN_ON): Power.ON,
    (Power.LEAVING, PowerChange.CONFIRMED): Power.OFF,
    **{(state, PowerChange.SWITCH_OFF): Power.LEAVING for state in Power if state is not Power.OFF},
    **{(state, PowerChange.TAKEN_OVER): Power.UNSURE for state in Power},
    **{(state, PowerChange.PROBED): Power.UNKNOWN for state in Power},
}
# What a motor is sent: on V1 and V2 boards, and on V3 boards, which a command switches on.
SENT: dict[Power, tuple[Send, Send]] = {
    Power.UNKNOWN: (Send.COMMAND, Send.NOTHING),
    Power.OFF: (Send.POLL, Send.NOTHING),
    Power.ENTERING: (Send.COMMAND, Send.COMMAND),
    Power.ON: (Send.COMMAND, Send.COMMAND),
    Power.SILENT: (Send.COMMAND, Send.COMMAND),
    Power.UNSURE: (Send.COMMAND, Send.NOTHING),
    Power.LEAVING: (Send.EXIT, Send.EXIT),
}


def expected_torque(effort: float, damping: float, velocity: float) -> float:
    """Return the torque in Nm of a motor with this command (Nm, Nm s/rad), at `velocity` rad/s of its joint."""
    return effort - damping * velocity


def excess_torque(replied: float, expected: float) -> float:
    """Return by how much in Nm a replied torque differs from the expected one beyond the tolerance; NaN if unknown."""
    return abs(replied - expected) - DELIVERY.least - DELIVERY.share * abs(expected)


class JointWatch:
    """What is known of joint `i` of an arm and its motor.

    replies: whether its board replies to commands (V1, V2), or reports on its own timer (V3). peak: Nm at most.

    sample: the newest reading. One that shows a fault is left out until the next one shows a fault too.
    is_silent: no reply for `reply_timeout`, nor to `missed` commands. A loop that stood still has sent none.
    missed: commands without a reply.
    power: whether the motor is on. can_reenable: whether it may be switched on again, once, if it is found off while it
    carries. is_clearing: whether it has yet to forget its error: its last reply still shows it. is_heard: whether it
    replies, since `power` last became unsure. undelivered: Nm s, the evidence that it does not deliver its torque.
    """

    def __init__(self, limits: Limits, i: int, replies: bool = True, peak: float = math.inf) -> None:
        self.name, self.channel = limits.joint_names[i], limits.channels[i]
        self._limits, self._i, self._board, self._peak = limits, i, 0 if replies else 1, peak
        self.sample, self.is_silent, self.missed = UNKNOWN, True, READING.missed
        self._newest = self._asked = -math.inf  # s, of the last reply; `sample` was taken later than asked
        self._slow_at = -math.inf  # s, of the last reply within `max_velocity`
        self._is_suspect = False
        # rad, forgotten over CONTINUITY.memory: turned by the angle; of that, not explained by the velocity; way to
        # and fro by the velocity
        self._turned = self._slip = self._way = 0.0
        self.power, self.can_reenable, self.is_clearing = Power.OFF, False, False
        self._silent_for = self._heard_for = 0.0  # s
        self._torque = 0.0  # Nm, smoothed since it replies
        self._off_replies = 0  # in a row
        self._exits: list[float] = []  # s, of the last two
        self._judged = -math.inf  # s, of the last reply whose torque was judged
        self.reset_delivery()

    @property
    def may_be_on(self) -> bool:
        """Whether the motor was switched on or left on, and has not confirmed that it is off."""
        return self.power not in (Power.OFF, Power.UNKNOWN)

    @property
    def is_heard(self) -> bool:
        """Whether it replies."""
        return self._heard_for > 0.0

    @property
    def is_quiet(self) -> bool:
        """Whether it has shown no torque for long enough to be off, or its replies say that it is."""
        return self._heard_for >= POWER.read_time or self.reports_off

    @property
    def reports_off(self) -> bool:
        """Whether its replies say that it is off."""
        return self._off_replies >= POWER.reports_off

    @property
    def is_missing(self) -> bool:
        """Whether it does not deliver its torque."""
        return self.undelivered >= DELIVERY.evidence

    def change(self, change: PowerChange) -> None:
        """Go to the state that `NEXT` has for this change; stay where it has none."""
        before, self.power = self.power, NEXT.get((self.power, change), self.power)
        if self.power is before:
            return
        if self.power is Power.ENTERING:
            self.can_reenable, self.is_clearing = True, False
        elif self.power in (Power.UNSURE, Power.UNKNOWN):
            self.can_reenable = False
            self._forget_replies()
        elif self.power is Power.LEAVING:
            self._exits = []

    def clear_error(self) -> None:
        """Let the motor forget its error, once, while it is off: an operator has cleared the fault."""
        self.is_clearing = self._board == 0

    def read(
        self, now: float, dt: float, sample: JointSample, asked: float, held_back: bool, restart: float, is_known: bool
    ) -> list[Fault]:
        """Take the newest reading of a cycle; return the faults that it shows.

        now, asked: s, of this cycle and of the one before.
        dt: s that the loop has run since.
        held_back: whether the motor was sent nothing in the last cycle on purpose.
        restart: s of silence after which it may have restarted.
        is_known: whether its angle must be continuous.
        """
        found: list[Fault] = []
        if is_new := sample.time > self._newest:
            self._newest, self.missed = sample.time, 0
            period = sample.time - self.sample.time
            expected = 0.5 * (self.sample.velocity + sample.velocity) * period
            faults = self._faults(sample, expected, restart, is_known)
            is_confirmed, self._is_suspect = self._is_suspect, bool(faults)
            if not faults or is_confirmed or self.sample is UNKNOWN:
                found = [*(faults if is_confirmed else ()), *self._follow(sample, expected, not faults)]
                self.sample, self._asked = sample, asked
        else:
            self.missed += not held_back
        self.is_silent = self.missed >= READING.missed and self._limits.is_silent(now, sample)
        self.note_power(dt, sample, is_new)
        return found

    def _faults(self, sample: JointSample, expected: float, restart: float, is_known: bool) -> list[Fault]:
        """Return what a new reading shows by itself, and compared with the last one that counts.

        expected: rad by which the velocities say that the joint has turned since.
        """
        limits, last = self._limits, self.sample
        low, high, fastest = limits.position_min[self._i], limits.position_max[self._i], limits.max_velocity[self._i]
        found: dict[FaultCode, str] = {}
        if sample.error:
            found[FaultCode.MOTOR_ERROR] = f"the motor reports error {sample.error} ({sample.trouble})"
        if sample.temperature is not None and sample.temperature >= HEAT.most:
            found[FaultCode.OVER_TEMPERATURE] = f"{sample.temperature} degC, the limit is {HEAT.most:g}"
        speed = abs(sample.velocity)
        if speed <= fastest:
            self._slow_at = sample.time
        elif not (speed <= 1.5 * fastest and sample.time - self._slow_at <= READING.shock):
            found[FaultCode.OVER_SPEED] = f"{sample.velocity:.2f} rad/s, the limit is {fastest:g}"
        turned, silence = sample.position - last.position, sample.time - last.time
        is_jump = abs(turned) > CONTINUITY.jump + fastest * (sample.time - self._asked)
        is_turn = abs(turned - expected) > limits.home_tolerance[self._i]
        if is_jump or (is_turn and limits.reply_timeout < silence and (is_known or silence <= restart)):
            what = f"from {last.position:.3f} to {sample.position:.3f} rad in {1000.0 * silence:.0f} ms"
            found[FaultCode.POSITION_JUMP] = what
        if not low - READING.overshoot <= sample.position <= high + READING.overshoot:  # what a jump explains
            found[FaultCode.OUTSIDE_LIMITS] = f"{sample.position:.3f} rad, the limits are {low:g} to {high:g}"
        return [Fault.of_joint(code, self.name, reason) for code, reason in found.items()]

    def _follow(self, sample: JointSample, expected: float, is_sound: bool) -> list[Fault]:
        """Compare the angle with the integrated velocity; return the fault if no ordinary motor differs so much."""
        if not is_sound or not sample.time - self.sample.time <= self._limits.reply_timeout:
            self._turned = self._slip = self._way = 0.0
            return []
        turned = sample.position - self.sample.position
        kept = math.exp((self.sample.time - sample.time) / CONTINUITY.memory)
        self._turned = kept * self._turned + turned
        self._slip = kept * self._slip + turned - expected
        self._way = kept * self._way + abs(expected)
        if not abs(self._slip) > CONTINUITY.slip + CONTINUITY.share * self._way:
            return []
        reason = (
            f"its angle has turned by {self._turned:+.2f} rad, but its velocity says "
            f"{self._turned - self._slip:+.2f}: check velocity_range, and whether the encoder slips"
        )
        return [Fault.of_joint(FaultCode.READINGS_CONTRADICT, self.name, reason)]

    def note_power(self, dt: float, sample: JointSample, is_new: bool) -> None:
        """Take what the newest reading, or a silence, shows of the motor's power."""
        if self.is_silent:
            self._silent_for += dt
            self._forget_replies()
            self.change(PowerChange.SILENT)
            if self._silent_for >= POWER.cut:
                self.change(PowerChange.CUT)
            return
        self._silent_for = 0.0
        self.change(PowerChange.REPLIES)
        if is_new:
            self._torque += min(1.0, dt / POWER.smoothing) * (sample.effort - self._torque)
            self._heard_for += dt
            self._off_replies = self._off_replies + 1 if sample.on is False else 0
            is_answer = len(self._exits) == 2 and sample.time >= self._exits[1]
            lets_go = self._board == 0 or abs(sample.effort) < POWER.torque  # a V3 board also reports unasked
            if is_answer and (lets_go if sample.on is None else not sample.on):
                self.change(PowerChange.CONFIRMED)
        shows_torque = sample.on is None and abs(self._torque) > POWER.torque
        if (sample.on or shows_torque) and self.power in (Power.UNSURE, Power.UNKNOWN):
            self.change(PowerChange.SHOWN_ON)

    def _forget_replies(self) -> None:
        self._torque = self._heard_for = 0.0
        self._off_replies = 0

    def send(self, now: float) -> Send:
        """Return what the motor is sent at `now` s."""
        send = SENT[self.power][self._board]
        if send is Send.POLL and self.is_clearing:
            self.is_clearing = False
            return Send.CLEAR_ERROR
        if self.power is Power.OFF and (not self._exits or now - self._exits[-1] >= POWER.exit_period):
            send = Send.EXIT
        if send is Send.EXIT:
            self._exits = [*self._exits[-1:], now]
        return send

    def reset_delivery(self) -> None:
        """Forget which torques were asked for and replied, for example while the motor is off."""
        self.undelivered = 0.0
        self._replied = 0.0  # s that the loop has run, at the last reply
        self._expected_torques: deque[tuple[float, float]] = deque(maxlen=DELIVERY.noted)  # Nm, and s likewise

    def judge_torque(self, time: float, dt: float, effort: float, damping: float) -> str:
        """Take the reply to the last command (Nm, Nm s/rad); return what is wrong if the motor does not deliver it.

        Without a new reply the evidence stays.

        time: s that the loop has run. dt: s of it since the last replies.
        """
        sample, asked = self.sample, self._expected_torques
        torque = expected_torque(effort, damping, sample.velocity)
        asked.append((max(-self._peak, min(self._peak, torque)), time))
        if not sample.time > self._judged:
            return ""
        while asked[0][1] < self._replied - DELIVERY.span:
            asked.popleft()
        self._judged, self._replied = sample.time, time
        least, most = min(asked)[0], max(asked)[0]
        nearest = max(least, min(most, sample.effort))
        added = min(DELIVERY.evidence / 2, excess_torque(sample.effort, nearest) * dt)
        self.undelivered = max(0.0, min(DELIVERY.evidence, self.undelivered + added))
        return (
            f"{nearest:.2f} Nm commanded, {sample.effort:.2f} Nm replied"
            if self.undelivered >= DELIVERY.evidence
            else ""
        )

    def is_found_off(self, effort: float, damping: float) -> bool:
        """Return whether the motor is off, by its replies to this command (Nm, Nm s/rad)."""
        asked = expected_torque(effort, damping, self.sample.velocity)
        return self.reports_off or (self.is_missing and abs(self.sample.effort) < POWER.off_share * abs(asked))


class ArmWatch:
    """Watches the motors of an arm, cycle by cycle.

    period: s of the loop.

    joints: of each (n,) what is known. replies: (n,) whether a board replies to commands. samples: (n,) the newest
    readings that count. silent: (n,) whether a motor is.
    fault: what the newest readings show, or None. is_late: whether a motor has not replied to some commands.
    trusted: whether zeros and signs were proven, and the angles have been continuous since.
    is_being_proven: whether the arm was seen to hang and its signs are being proven, set from outside: the angles must
    be continuous from then on.
    """

    def __init__(self, limits: Limits, period: float = 0.0, motors: Sequence[JointMotor] = ()) -> None:
        count = len(limits.joint_names)
        self.replies = [motor.wire_format.replies for motor in motors] or [True] * count
        peak = [motor.peak_effort for motor in motors] or limits.max_effort
        self.joints = tuple(JointWatch(limits, i, self.replies[i], peak[i]) for i in range(count))
        self.samples: tuple[JointSample, ...] = (UNKNOWN,) * count
        self.silent: Sequence[bool] = (True,) * count
        self.fault: Fault | None = None
        self.trusted = self.is_being_proven = False
        self.is_late = True
        self.rest = RestTracker(count)
        self._timeout, self._longest = limits.reply_timeout, period + STALL.late
        self._now, self._ran = -math.inf, 0.0  # s, of the last cycle, and for which the loop has run
        self._last = self._resumed = math.inf  # s, of the last command, and of the first one after a pause
        self._before: Sequence[JointSample] = ()  # the readings before a pause, until the ones after it are judged
        self._held: Sequence[float] = ()  # Nm
        self._gap = 0.0  # s

    def require_sign_check(self) -> None:
        """Note that the angles may no longer be continuous, for a reason that no reading shows."""
        self.trusted = False

    def change_power(self, change: PowerChange) -> None:
        """Change the power of all motors."""
        for joint in self.joints:
            joint.change(change)

    def read(
        self, now: float, samples: Sequence[JointSample], held_back: Sequence[bool], powered: bool = True,
        dt: float = 0.0,
    ) -> None:  # fmt: skip
        """Take the newest readings (n,) of a cycle.

        now: s. dt: s that the loop has run since the last call.
        held_back: (n,) whether the motor was sent nothing in the last cycle on purpose.
        powered: whether the motors are on.
        """
        restart = CONTINUITY.restart if powered else CONTINUITY.restart_off
        found: list[Fault] = []
        for joint, sample, is_held_back in zip(self.joints, samples, held_back, strict=True):
            is_known = self.trusted or self.is_being_proven
            found += joint.read(now, dt, sample, self._now, is_held_back, restart, is_known)
            self.trusted &= joint.missed < READING.missed or now - sample.time <= restart
        self.trusted &= now - self._now <= CONTINUITY.pause and not any(fault.code in BREAKS for fault in found)
        self.samples = tuple([joint.sample for joint in self.joints])
        self.silent = [joint.is_silent for joint in self.joints]
        self.is_late = max([joint.missed for joint in self.joints]) >= READING.late
        self.fault = self._silence() if any(self.silent) else next(iter(found), None)
        self.rest.step(now, self.samples, self.silent)
        self._now = now

    def _silence(self) -> Fault:
        name = self.joints[self.silent.index(True)].name
        replying = {joint.channel for joint in self.joints if joint.missed < READING.missed}
        buses = {joint.channel for joint in self.joints}
        reason = f"no reply for more than {self._timeout * 1000:.0f} ms"
        if len(buses) > 1 and (dead := buses - replying):
            reason += f"; no motor on {' and '.join(sorted(dead))} replies: the bus is lost, or the supply is cut"
        return Fault.of_joint(FaultCode.MOTOR_SILENT, name, reason)

    def reset_delivery(self) -> None:
        """Forget which torques were asked for and replied."""
        self._ran = 0.0
        for joint in self.joints:
            joint.reset_delivery()

    def judge_torques(self, dt: float, effort: Sequence[float], damping: Sequence[float]) -> Fault | None:
        """Take the replies to the last commands; return a fault if a joint does not deliver its torque.

        dt: s that the loop ran since the last replies. effort, damping: (n,) Nm and (n,) Nm s/rad, commanded.
        """
        self._ran += dt
        fault = None
        for joint, torque, own in zip(self.joints, effort, damping, strict=True):
            reason = joint.judge_torque(self._ran, dt, torque, own)
            if reason and not fault:
                fault = Fault.of_joint(FaultCode.TORQUE_NOT_DELIVERED, joint.name, reason)
        return fault

    def judge_pause(self, now: float, effort: Sequence[float], is_carried: bool) -> Fault | None:
        """Return the fault that the readings of a carried arm show after its loop has stood still.

        effort: (n,) Nm, of the last command.
        """
        gap, self._last = now - self._last, now if is_carried else math.inf
        if not is_carried:
            self._before = ()
        elif gap > self._longest:
            self._before, self._held, self._resumed, self._gap = self.samples, effort, now, gap
            return None
        if not self._before or not all(sample.time >= self._resumed for sample in self.samples):
            return None
        before, self._before = self._before, ()
        for joint, old, torque in zip(self.joints, before, self._held, strict=True):
            gained = (joint.sample.velocity - old.velocity) * math.copysign(1.0, torque)
            if abs(torque) >= STALL.least and gained < -STALL.gained and old is not UNKNOWN:
                reason = (
                    f"{joint.name} fell while the loop stood still for {1000.0 * self._gap:.0f} ms: "
                    "its motor's own time-out is shorter; set it to 0.15 to 0.5 s"
                )
                return Fault(FaultCode.TORQUE_DIPPED, reason, joint.name)
        return None


class RestTracker:
    """Whether an arm of `count` joints is at rest, judged by position: a damped arm can creep at less than one code.

    since: s, the time since which no replying joint has turned by more than `REST_TURN`.
    """

    def __init__(self, count: int) -> None:
        self.since = -math.inf
        self._reference: Sequence[JointSample] = (UNKNOWN,) * count

    def step(self, now: float, samples: Sequence[JointSample], silent: Sequence[bool]) -> None:
        """Take the newest readings at `now` s. silent: (n,) whether the joint's motor does not reply."""
        columns = zip(samples, self._reference, silent, strict=True)
        if any(not is_silent and not abs(new.position - old.position) <= REST_TURN for new, old, is_silent in columns):
            self.since, self._reference = now, samples
        if any(silent):  # a silent joint may have moved by the time it replies again
            known = zip(self._reference, silent, strict=True)
            self._reference = [UNKNOWN if is_silent else last for last, is_silent in known]
