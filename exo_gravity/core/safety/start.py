# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A start: what must hold before the motors of an arm are switched on, how they are, and what they must show then."""

import math
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from statistics import fmean
from typing import NamedTuple

import numpy as np

from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.numbers import rate_limited
from exo_gravity.core.safety.command import Fault, FaultCode, Send
from exo_gravity.core.safety.limits import EQUIPMENT, MAX_EFFORT_RATE, Limits
from exo_gravity.core.vocabulary import NO_REASON, Status, Wait

# The gate waits for these to pass; other faults refuse the start.
TRANSIENT_FAULTS = frozenset(
    {FaultCode.MOTOR_SILENT, FaultCode.OVER_SPEED, FaultCode.OUTSIDE_LIMITS, FaultCode.READINGS_CONTRADICT}
)


@dataclass(frozen=True)
class StartGate:
    """What the readings must be before the motors are switched on."""

    at_rest: float = 0.1  #: rad/s; two to four codes of the 12-bit velocity
    calm: float = 1.0  #: s without a fault or late answers: middleware and machine stutter while nodes start
    efforts: float = 0.25  #: s of these with efforts: the tilt that they need reaches the bridge by another way


@dataclass(frozen=True)
class SwitchOn:
    """The pushes that show that motors are on."""

    torque: float = 0.4  #: Nm, each way
    time: float = 0.06  #: s, each way
    share: float = 0.5  #: of the test torque that must appear in the replies
    timeout: float = 0.48  #: s until every motor has shown that it is on: four pushes each way
    attempts: int = 6  #: to switch motors on again that show no torque in the sign check; each may miss 3 % of frames


@dataclass(frozen=True)
class SignPush:
    """The pushes that show which way a motor moves its joint."""

    #: Nm/s. A light joint (0.002 kg m^2) that breaks loose is read to be moving 35 ms later, after three cycles at 100
    #: Hz and a filter of 5 ms, and gains 0.5 rad/s by then
    rise: float = 0.5
    quick: float = 3.0  #: Nm/s, on a joint that is damped already, or where it cannot break loose:
    held: float = 0.7  #: of the largest push so far, below which friction held the joint
    fall: float = 10.0  #: Nm/s
    slow: float = 0.1  #: rad/s, beyond which the push is taken back; four codes of the velocity
    soonest: float = 0.07  #: s; a joint that has moved sooner was not moved by the push
    moved: float = 0.015  #: rad; forty codes of the position
    still: float = 0.003  #: rad within which a joint is still
    still_time: float = 0.2  #: s for which it must stay within `still`
    timeout: float = 0.5  #: s at full torque
    patience: float = 10.0  #: s for which a joint may move to and fro without going anywhere
    rest_timeout: float = 5.0  #: s for the joint to come to rest
    disturbed: int = 5  #: times at most that a joint may move without a push


@dataclass(frozen=True)
class HangingArm:
    """What an arm that hangs must show, and what its operator is asked, before a start from unknown zeros."""

    #: Nm asked for on a joint: gravity of a few degrees, the whole arm of a wearer of 75 kg included. Hanging, friction
    #: alone holds it. A trunk's IMU that is mounted otherwise than it is set asks for more
    torque: float = 1.5
    #: of `max_effort`, which counts where it is more. The arm of a wearer of 75 kg that rests against a trunk leaning
    #: by 0.12 rad needs 2.1 Nm in abduction
    share: float = 1.0 / 3.0
    moved: float = 0.06  #: rad that a joint may turn after it was confirmed: a wearer breathes, and hangs on
    valid: float = 10.0  #: s for which the confirmation holds
    patience: float = 60.0  #: s, longer than `enable_timeout`, that a start waits for it


START_GATE, SWITCH_ON, SIGN_PUSH, HANGING_ARM = StartGate(), SwitchOn(), SignPush(), HangingArm()


def turns_back(limits: Limits, joints: Sequence[JointSample]) -> dict[int, float]:
    """Return by how many rad each joint is to be turned to be within its limits, by index of those that are not."""
    columns = enumerate(zip(joints, limits.position_min, limits.position_max, strict=True))
    excess = {n: joint.position - max(low, min(high, joint.position)) for n, (joint, low, high) in columns}
    return {n: -beyond for n, beyond in excess.items() if beyond}


def missing_for_a_start(
    limits: Limits, joints: Sequence[JointSample], fault: Fault | None, zeros_are_trusted: bool
) -> Fault | Status:
    """Return the fault that refuses a start, or what the motors' readings `joints` lack for it.

    fault: what the readings show.
    """
    if fault and fault.code not in TRANSIENT_FAULTS:
        return fault
    if fault and fault.code is not FaultCode.OUTSIDE_LIMITS:
        return Status(fault.code, fault.reason)
    for n, turn in turns_back(limits, joints).items():
        low, high = math.degrees(limits.position_min[n]), math.degrees(limits.position_max[n])
        back = f"to be moved by {at_least(turn)} degrees, within its limits {low:.0f} to {high:.0f}"
        return Status(Wait.JOINT_LIMITS, f"{limits.joint_names[n]} {back}")
    # An arm that swings is not where it will hang.
    if any(abs(joint.velocity) > START_GATE.at_rest for joint in joints):
        return Status(Wait.REST, "the arm to be at rest")
    if not zeros_are_trusted:
        zeros = zip(limits.joint_names, joints, limits.home, limits.home_tolerance, strict=True)
        for name, joint, home, tolerance in zeros:
            if not abs(joint.position - home) <= tolerance:
                return Fault.of_joint(
                    FaultCode.IMPLAUSIBLE_ZERO,
                    name,
                    f"{joint.position:.3f} rad at the start, must be within {tolerance:g} of {home:g}: "
                    "bring the joint there by hand, or correct the parameter zero",
                )
    return NO_REASON


def missing_of_trunk(limits: Limits, tilt: float) -> Status:
    """Return what a trunk that is tilted by `tilt` rad from upright lacks for a start.

    While the arm hangs, gravity's torque is 0 on a trunk that is upside down too: nothing else shows it.
    """
    if tilt <= limits.start_tilt:
        return NO_REASON
    tilted = f"it is tilted by {math.degrees(tilt):.0f} degrees, at most {math.degrees(limits.start_tilt):.0f}"
    causes = "correct rotation_trunk_from_imu or the IMU's driver, or set start_tilt for a wearer who lies"
    return Status(Wait.TRUNK, f"a trunk near upright: {tilted}: {causes}")


def torque_while_hanging(limits: Limits, effort: Sequence[float]) -> Fault | None:
    """Return the fault that `effort` (n,) in Nm, asked for on an arm that hangs, shows, or None.

    What assistance and terms may add, `largest_addition`, they may add here too.
    """
    columns = zip(limits.joint_names, effort, limits.max_effort, limits.largest_addition, strict=True)
    for name, torque, permitted, addition in columns:
        most = max(HANGING_ARM.torque, HANGING_ARM.share * permitted) + addition
        if not abs(torque) <= most:
            return Fault.of_joint(
                FaultCode.TORQUE_WHILE_HANGING,
                name,
                f"{torque:.1f} Nm asked for on an arm that hangs, must be at most {most:g}: let "
                "the whole arm hang, or correct rotation_trunk_from_imu, can_id, joint_names, side or the masses",
            )
    return None


class PoseQuestion:
    """Asks the operator whether the arm hangs where it is drawn: angles that are wrong by a turn look as plausible.

    The answer is for one start. It lapses when the arm moves or time passes, and is asked for again.

    asked: (n,) rad, the pose in question; () while there is no question.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.asked: tuple[float, ...] = ()
        self._names = names
        self._confirmed: tuple[float, ...] = ()  # rad
        self._until = -math.inf  # s

    @property
    def text(self) -> str:
        """The pose in question, or the one that was confirmed, in degrees by joint; '' for none."""
        pose = self.asked or self._confirmed
        shown = zip(self._names, pose, strict=True) if pose else ()
        return ", ".join(f"{name} {round(math.degrees(angle))}" for name, angle in shown)

    def withdraw(self) -> None:
        """Forget question and answer."""
        self.asked = self._confirmed = ()

    def confirm(self, now: float) -> bool:
        """Take the operator's answer at `now` s; return False if nothing is asked."""
        if not self.asked:
            return False
        self._confirmed, self._until, self.asked = self.asked, now + HANGING_ARM.valid, ()
        return True

    def missing(self, now: float, joints: Sequence[JointSample], others: Status) -> Status:
        """Return what the start lacks at `now` s; others: what it lacks apart from the answer."""
        pose = tuple(joint.position for joint in joints)
        pairs = zip(pose, self._confirmed, strict=True) if self._confirmed else ()
        if now > self._until or any(not abs(angle - then) <= HANGING_ARM.moved for angle, then in pairs):
            self._confirmed = ()
        is_due = not (others or self._confirmed)
        self.asked = pose if is_due else ()
        return Status(Wait.POSE, f"the operator to confirm the pose (degrees): {self.text}") if is_due else others


def at_least(angle: float) -> str:
    """Return `angle` (rad) in degrees, rounded away from zero, so that a joint turned by it is far enough."""
    return f"{math.degrees(angle) + math.copysign(0.05, angle):+.1f}"


class SwitchingOn:
    """Switches an arm's motors on one after another, and first clears what they remember.

    ENTER resumes the last command that a motor had while it was on, also that of another tool. Some firmware ignores
    commands while it is off, so that a zero command before ENTER clears nothing there. So each motor gets ENTER and,
    at once, a command without torque; then EXIT. Only the next ENTER carries it. Every other frame waits for the
    reply to the one before: command and reply share an ID, and would collide.

    replies: (n,) whether a motor's board replies to commands; what a V3 board remembers, no frame carries out.

    done: whether each motor has been sent ENTER.
    """

    def __init__(self, replies: Sequence[bool]) -> None:
        self.done = False
        self._replies = replies
        self._sends = [Send.POLL if board else Send.NOTHING for board in replies]
        self._course = self._run()

    def step(self) -> tuple[Send, ...]:
        """Return what each motor (n,) is sent in the next cycle."""
        return next(self._course)

    def _run(self) -> Iterator[tuple[Send, ...]]:
        for i, board in enumerate(self._replies):
            if board:
                yield self._with(i, Send.CLEAR)
                yield self._with(i, Send.EXIT)
        for i, board in enumerate(self._replies):
            if board:
                yield self._with(i, Send.ENTER)
            self._sends[i] = Send.COMMAND
        self.done = True
        while True:
            yield tuple(self._sends)

    def _with(self, i: int, send: Send) -> tuple[Send, ...]:
        return (*self._sends[:i], send, *self._sends[i + 1 :])


class SwitchOnCheck:
    """Checks that all motors are on: short pushes each way, under damping, must appear in their replies.

    It is for motors whose signs are trusted. Those of others show in the sign check that they are on.

    A motor is on if the regression of its replied on its commanded torque is at least `SWITCH_ON.share`. Each pair of
    pushes separates 1 from 0 by nine standard deviations of a noise of 0.15 Nm at 100 Hz. A motor that has not shown it
    after a pair may have missed its ENTER: it gets another one, until the time-out.

    effort: (n,) Nm to apply now.
    enter: (n,) which motors to switch on again now.
    done: whether the check has ended.
    """

    def __init__(self, limits: Limits) -> None:
        self.done = False
        self._names = limits.joint_names
        self._torque = [min(SWITCH_ON.torque, most) for most in limits.max_effort]
        count = len(self._names)
        self.effort, self.enter = [0.0] * count, [False] * count
        self._last_time = [-math.inf] * count
        self._commanded = [0.0] * count  # Nm, as the replies show it
        self._products = [0.0] * count  # of replied and commanded torque, summed since the last pair of pushes
        self._squares = [0.0] * count  # of commanded torque
        self._is_on = [False] * count
        self._elapsed, self._pushes = 0.0, 0

    def step(self, dt: float, joints: Sequence[JointSample], damping: Sequence[float]) -> Fault | None:
        """Advance by `dt` s with the replies to the last commands; return the fault that they show, if any.

        damping: (n,) Nm s/rad, last sent; its torque is part of the replies, and a light joint moves.
        """
        self._elapsed += dt
        self.enter = [False] * len(self.enter)
        for i, joint in enumerate(joints):
            # Replies are one command old, and behind a current loop, a batch or a stall.
            self._commanded[i] += min(1.0, dt / EQUIPMENT.late) * (self.effort[i] - self._commanded[i])
            if joint.time > self._last_time[i]:
                self._last_time[i] = joint.time
                replied = joint.effort + damping[i] * joint.velocity
                self._products[i] += self._commanded[i] * replied
                self._squares[i] += self._commanded[i] ** 2
        pushes = int(self._elapsed / SWITCH_ON.time)
        if pushes > self._pushes and pushes % 2 == 0:
            for i, name in enumerate(self._names):
                share = self._products[i] / max(1e-9, self._squares[i])
                self._is_on[i] = self._is_on[i] or share >= SWITCH_ON.share
                self.enter[i] = not self._is_on[i]
                if self.enter[i] and self._elapsed >= SWITCH_ON.timeout - 1e-9:
                    reason = (
                        f"{name}: the motor did not switch on: {share * 100:.0f} % of the commanded torque replied; "
                        "a V3 board ignores commands while its configuration cable is plugged in, a V1 or V2 board "
                        "while it is in servo mode (set MIT mode with the vendor's tool)"
                    )
                    return Fault(FaultCode.TORQUE_NOT_DELIVERED, reason, name)
            self._products, self._squares = [0.0] * len(self._names), [0.0] * len(self._names)
        self._pushes = pushes
        for i, torque in enumerate(self._torque):
            target = 0.0 if all(self._is_on) else -torque if pushes % 2 else torque
            self.effort[i] = rate_limited(target, self.effort[i], MAX_EFFORT_RATE * dt)
        self.done = all(self._is_on) and not any(self.effort)
        return None


class SignCheck:
    """Checks that each motor pushes its joint the way that its encoder shows, while the arm hangs.

    Joint after joint, first one way, then the other: wait until the joint has been still, push it gently and slowly
    until it moves by about a degree. Whichever way it moves, the push is taken back while the joint is faster than
    `SIGN_PUSH.slow`: without damping, friction alone then stops it. A joint that moves backwards has its torque or its
    encoder reversed: gravity compensation would double its weight. A joint that does not move has no torque, or is
    held. A joint that moves before it is pushed is being moved by the wearer: it is pushed again, a few times. It
    cannot detect a `direction` that reverses torque and encoder alike: such a joint moves as expected.

    One joint is pushed at a time: a push turns others, too, so that two at once could prove a reversed motor right.

    How soon the joints move shows two with exchanged CAN IDs (`JointOrder`); they are pushed again before that is a
    fault.

    No joint is damped before it has moved the right way: a reversed motor that damps would drive it, without end.

    torque: (n,) Nm, the largest push on each joint; a joint with 0 is skipped.
    effort: (n,) Nm to apply now.
    damped: (n,) which joints have moved the right way: these may be damped.
    done: whether every joint has passed. pushes: whether it pushes any joint at all.
    hint: what the wearer should do. progress: 0..1, the share of the pushes that are done.
    """

    def __init__(self, names: Sequence[str], torque: Sequence[float]) -> None:
        self.effort = [0.0] * len(names)
        self.damped = [False] * len(names)
        self.pushes = any(torque)
        self.done = not any(torque)
        self.hint, self.progress = NO_REASON, float(self.done)
        self._names = names
        self._dt = 0.0
        self._joints: Sequence[JointSample] = ()  # the newest readings
        self._still_at, self._still_for = [math.inf] * len(names), [0.0] * len(names)  # rad, and s without a push
        self._order = JointOrder(names)
        self._course = self._check_all(torque)

    def step(self, dt: float, joints: Sequence[JointSample], asked: Sequence[float]) -> Fault | None:
        """Advance by `dt` s, until `done`; return the fault that the readings show, if any.

        joints: (n,) the newest readings.
        asked: (n,) Nm that the controller asks for in this pose.
        """
        self._dt, self._joints = dt, joints
        for i, joint in enumerate(joints):
            if self.effort[i] == 0.0 and abs(joint.position - self._still_at[i]) <= SIGN_PUSH.still:
                self._still_for[i] += dt
            else:
                self._still_at[i], self._still_for[i] = joint.position, 0.0
        self._order.note(joints, asked)
        return next(self._course, None)

    # Each of these yields once a step: a fault, or None.

    def _check_all(self, torque: Sequence[float]) -> Iterator[Fault | None]:
        joints: Sequence[int] = [i for i, most in enumerate(torque) if most]
        for _ in range(JOINT_ORDER.rounds):
            for i in joints:
                self.damped[i] = False
            pushes = [(i, sign) for sign in (1.0, -1.0) for i in joints]
            for n, (i, sign) in enumerate(pushes):
                self.progress = n / len(pushes)
                yield from self._check(i, sign, torque[i])
            if not (joints := self._order.exchanged):
                break
        if joints:
            yield self._order.fault
        while any(self.effort):
            self._take_back()
            yield None
        self.done, self.progress = True, 1.0

    def _check(self, i: int, sign: float, most: float) -> Iterator[Fault | None]:
        for _ in range(SIGN_PUSH.disturbed + 1):
            if (yield from self._push(i, sign, most)):
                break
            self.hint = Status(Wait.HOLD_STILL, f"{self._names[i]} moves without being pushed: hold still")
        else:
            yield self._fault(i, "it moves without being pushed: hold still and let it hang")
        self.hint = NO_REASON

    def _wait_for_rest(self, i: int) -> Iterator[Fault | None]:
        waited = 0.0
        while any(self.effort) or self._still_for[i] < SIGN_PUSH.still_time:
            self._take_back()
            waited += self._dt
            is_late = waited > SIGN_PUSH.rest_timeout
            yield self._fault(i, "it does not come to rest: hold still and let it hang") if is_late else None

    def _push(self, i: int, sign: float, most: float) -> Generator[Fault | None, None, bool]:
        """Return whether the joint moved under a push this way, False if it moved without one."""
        yield from self._wait_for_rest(i)
        if not self.damped[i]:
            self._order.begin(i)
        start, push, at_full, waited = self._joints[i].position, 0.0, 0.0, 0.0
        while not abs(moved := sign * (self._joints[i].position - start)) >= SIGN_PUSH.moved:
            if at_full > SIGN_PUSH.timeout:
                yield self._fault(i, f"{push:.2f} Nm did not move it: let it hang freely")
            if waited > SIGN_PUSH.patience:
                return False
            if abs(self._joints[i].velocity) > SIGN_PUSH.slow:
                self._approach(i, 0.0, SIGN_PUSH.fall)
            else:
                is_held = self.damped[i] or abs(self.effort[i]) < SIGN_PUSH.held * abs(push)
                self._approach(i, sign * most, SIGN_PUSH.quick if is_held else SIGN_PUSH.rise)
            push = max(push, self.effort[i], key=abs)
            at_full += self._dt if abs(self.effort[i]) >= most else 0.0
            waited += self._dt
            yield None
        if waited < SIGN_PUSH.soonest:
            return False
        if moved < 0.0:
            yield self._fault(
                i, f"{push:.2f} Nm moved it backwards: torque or encoder is reversed", FaultCode.WRONG_SIGN
            )
        if not self.damped[i]:
            self._order.end(i, SIGN_PUSH.slow)
        self.damped[i] = True
        return True

    def _take_back(self) -> None:
        for i in range(len(self.effort)):
            self._approach(i, 0.0, SIGN_PUSH.fall)

    def _approach(self, i: int, effort: float, rate: float) -> None:
        """Bring the push on joint `i` nearer to `effort` (Nm), by at most `rate` (Nm/s)."""
        self.effort[i] = rate_limited(effort, self.effort[i], rate * self._dt)

    def _fault(self, i: int, reason: str, code: FaultCode = FaultCode.SIGN_UNPROVEN) -> Fault:
        return Fault.of_joint(code, self._names[i], reason)


@dataclass(frozen=True)
class JointOrderTuning:
    """When joints are compared, and how often.

    The inner joint took at least 1.77 times as long as the outer one in 60 right arms, bare or with a wearer of 50 to
    110 kg who relaxes or holds it lightly (1 to 3 Nm/rad), and at most 0.51 times in 60 exchanged ones.
    """

    parallel: float = 0.25  #: of the outer joint's stiffness, by which turning the inner one may show another one
    left: float = 0.0015  #: rad from where it rested: the joint moves; four codes of the position
    sooner: float = 0.9  #: of the outer joint's time, below which the inner joint is the quicker one
    clear: float = 0.01  #: s more than that, a cycle at 100 Hz: the times of two light joints differ by less
    least: float = 0.05  #: Nm/rad of gravity's stiffness; a fifth of that of a bare forearm
    rounds: int = 2  #: of pushes: two joints that seem exchanged are pushed again, and the times averaged


JOINT_ORDER = JointOrderTuning()


class Extreme(NamedTuple):
    """Where a joint was farthest while it was pushed."""

    angle: float  #: rad
    pose: tuple[float, ...]  #: (n,) rad
    asked: tuple[float, ...]  #: (n,) Nm that the controller asked for there


class JointOrder:
    """Whether two motors with exchanged CAN IDs turn each other's joint, as the pushes of the sign check show.

    An exchange takes the encoder along with the motor: each joint still moves as it is pushed, and
    an arm that hangs asks for hardly any torque. What differs is the inertia. Of two joints with
    parallel axes, the one nearer to the base turns all that the other one turns, and the link
    between them, so under a push that rises at the same rate it gains speed later. Friction only
    delays when a joint breaks loose: the time counts from then on, until the push is taken back.

    The efforts that the controller asks for while joints are pushed tell which axes are parallel:
    the outer joint needs the same torque whichever of the two is turned. So no parameter describes
    the arm, and where gravity turns neither joint, nothing is compared. Of the paper's arm these
    are joints 3 and 4. Exchanges of joints whose axes are not parallel are not looked for.

    A wearer who holds the outer joint firmly makes it slow, too.

    names: of the joints (n,), from base to hand.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._joints: Sequence[JointSample] = ()  # the newest readings
        self._pushed: int | None = None
        self._path: list[JointSample] = []  # readings of the joint that is pushed
        self._times: list[list[float]] = [[] for _ in names]  # s, of each push
        self._ends: list[list[Extreme]] = [[] for _ in names]  # the two ends of each joint's motion while it was pushed

    def begin(self, i: int) -> None:
        """Note that joint `i` is pushed from now on, the first way."""
        self._pushed, self._path = i, [self._joints[i]]

    def note(self, joints: Sequence[JointSample], asked: Sequence[float]) -> None:
        """Take the newest readings (n,), and what the controller asks for, (n,) Nm."""
        self._joints = joints
        if self._pushed is None:
            return
        sample, ends = joints[self._pushed], self._ends[self._pushed]
        self._path.append(sample)
        if not all(map(math.isfinite, asked)):
            return
        here = [*ends, Extreme(sample.position, tuple(joint.position for joint in joints), tuple(asked))]
        ends[:] = min(here), max(here)

    def end(self, i: int, slow: float) -> None:
        """Note that the push has moved joint `i`, and was taken back once that was faster than `slow` rad/s."""
        start = self._path[0].position
        left = _reached([(sample.time, sample.position - start) for sample in self._path], JOINT_ORDER.left)
        quick = _reached([(sample.time, sample.velocity) for sample in self._path], slow)
        self._times[i].append(max(0.0, quick - left))
        self._pushed = None

    @property
    def exchanged(self) -> tuple[int, ...]:
        """An inner and an outer joint, from 0 on, of which the inner one is quicker; () if there is no such pair."""
        pushed = [i for i, (times, ends) in enumerate(zip(self._times, self._ends, strict=True)) if times and ends]
        stiffness = self._stiffness(pushed) if pushed else np.empty((0, 0))
        for inner, outer in combinations(pushed, 2):
            own, shared = stiffness[outer, outer], stiffness[outer, inner]
            are_parallel = own >= JOINT_ORDER.least and abs(shared - own) <= JOINT_ORDER.parallel * own
            latest = JOINT_ORDER.sooner * self._time(outer) - JOINT_ORDER.clear
            if are_parallel and self._time(inner) < latest:
                return inner, outer
        return ()

    @property
    def fault(self) -> Fault:
        """The fault of the two joints that are exchanged."""
        inner, outer = pair = self.exchanged
        times = [f"{1000.0 * self._time(i):.0f} ms" for i in pair]
        reason = (
            f"{self._names[inner]} moved sooner than {self._names[outer]}, which it carries: {' and '.join(times)} "
            "under the same push: let the arm hang freely and relaxed, or correct can_id of these two motors"
        )
        return Fault(FaultCode.JOINTS_EXCHANGED, reason)

    def _time(self, i: int) -> float:
        return fmean(self._times[i])

    def _stiffness(self, pushed: Sequence[int]) -> np.ndarray:
        """Return the torque (n, n) in Nm that each joint is asked for more for each rad of each other joint.

        A push moves others than its joint, too.
        """
        ends = [self._ends[i] for i in pushed]
        turned = [np.subtract(after.pose, before.pose) for before, after in ends]
        asked = [np.subtract(after.asked, before.asked) for before, after in ends]
        return np.asarray(np.linalg.lstsq(np.array(turned), np.array(asked), rcond=None)[0].T)


def _reached(course: Sequence[tuple[float, float]], level: float) -> float:
    """Return when `course`, times in s with a value each, first reached `level`; its last time if it never did."""
    for (earlier, before), (later, after) in pairwise(course):
        if after >= level:
            return earlier + (later - earlier) * max(0.0, level - before) / max(after - before, 1e-9)
    return course[-1][0]
