# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""`make study NAME=motion-monitor`: what the monitor of unexplained torque sees, and its cost, as in docs/safety.md.

Offline, with the simulated arm, its CAN frames, the safety machine with its own limits and the compensator, judged by
the arm's true motion. First compensators that are wrong, with a free arm; then an hour of wearers who
move as fast as `over_speed` permits, whose arm must not be let down once, for whatever reason.

    python -m bench.motion_monitor [--hours 1.0] [--addition 0.0]
"""

from __future__ import annotations

import argparse
import itertools
import math
import operator
import random
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from exo_gravity.core import paper_static_torque
from exo_gravity.core.arm.arm import ArmModel, papers
from exo_gravity.core.arm.arm_data import STANDARD_GRAVITY
from exo_gravity.core.arm.gravity import NO_TORQUE, Torque
from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import JOINTS, Compensation, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.terms.assist import Assist
from exo_gravity.core.compensation.terms.catalogue import Friction, Inertia, Spring
from exo_gravity.core.compensation.terms.terms import SUM, TermSettings
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.drive import FaultCode
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.motion_monitor import MOTION
from exo_gravity.lab.trial.offline import ArmSetup, OfflineTrial
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor, VirtualWearer
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.trunk_motion import TrunkState
from exo_gravity.sim.virtual_arm import TrunkReading
from exo_gravity.sim.virtual_wearer import path_between

from .parts import play

RATE = 100.0  # Hz
MOTOR_NAMES = ("AK60-6", "AK80-9", "AK60-6", "AK60-6")
LENGTH = (0.05, 0.13, 0.30, 0.30)
ROBOT = ArmModel(LENGTH, (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))  # as the compensator assumes it
TRUE_ROBOT = ArmModel(LENGTH, (0.045, 0.115, 0.235, 0.13), (0.60, 0.46, 0.61, 0.198))
BODY_MASS = 75.0  # kg
HANGING = (0.0, 0.05, 0.05, 0.05)  # rad
LOWEST, HIGHEST = (-1.2, 0.1, -0.5, 0.1), (1.2, 1.7, 1.9, 1.9)  # rad, where the wearer moves
IMPACT, STOP = (0.5, 15.0, 6.0, 1.5), 5.0  # Nm at most, and Nm s/rad, with which a clap ends a motion
FLESH, EDGE = 200.0, 0.1  # Nm/rad, and rad beyond LOWEST and HIGHEST, with which the body stops an arm that falls
FASTEST = 3.5  # rad/s, from which on the wearer brakes; 5 rad/s, of the elbow 6, trips over_speed
BRAKE = (12.0, 30.0, 10.0, 10.0)  # Nm s/rad; twice as much on the least inertia of a joint is unstable in steps of 1 ms
RAISED = (0.0, 0.9, 0.3, 0.3)  # rad
CALM = 0.6  # rad/s, to which a change of load is guided
RELEASE, WRONG = 2.0, 1.0  # s until the wearer lets go, and from then until a compensator becomes wrong
# What the trunk does while the arms move.
TRUNK: tuple[dict[str, Any], ...] = (
    {"hold": 20.0}, {"walk": 10.0}, {"bow": 0.7, "over": 1.2}, {"hold": 3.0}, {"lean": 0.25, "over": 0.8},
    {"hold": 2.0}, {"lean": 0.0, "over": 0.8}, {"bow": 0.0, "over": 1.2}, {"sit": 1.0},
)  # fmt: skip
TRUNK_TIME = 40.0  # s of all of it
Change = Callable[[float, Sequence[float], Sequence[float], Torque], Torque]


class TrueTrunk:
    """An IMU that is right, one cycle late."""

    def __call__(self, now: float, state: TrunkState) -> TrunkReading:
        """Return the truth."""
        gravity = gravity_in_trunk(state.pitch, state.roll)
        force = state.acceleration - STANDARD_GRAVITY * gravity
        return TrunkReading(gravity.tolist(), force.tolist(), state.angular_velocity)


class Passive(VirtualWearer):
    """A wearer who brings the arm to `pose`, and lets go at `release` s. motion: s and rad/s from then on."""

    def __init__(self, script: TrialScript, pose: Sequence[float] | None, release: float) -> None:
        super().__init__(script)
        self._release = release
        self.motion: list[tuple[float, float]] = []
        self._pose, self._taken, self._last = tuple(pose or HANGING), NO_TORQUE, 0.0

    def idle(self, elapsed: float, duration: float) -> bool:
        """Return False: the wearer may always move."""
        return False

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (4,) in Nm."""
        super().torque(elapsed, theta, velocity)  # follows the script's steps
        period, self._last = elapsed - self._last, elapsed
        if elapsed < 0.0:
            self._taken = tuple(theta)
        elif elapsed < self._release:
            return self.lead(
                path_between(self._taken, self._pose, elapsed, 0.7 * self._release), theta, velocity, period
            )
        else:
            self.motion.append((elapsed, max(map(abs, velocity))))
        return NO_TORQUE


class Fast(VirtualWearer):
    """A wearer who reaches, shakes, claps, throws, pushes down and rests, by chance and as fast as is permitted.

    They rest before and after. They brake every joint that is faster than FASTEST, whatever drives it.
    """

    def __init__(self, script: TrialScript, seed: int) -> None:
        super().__init__(script, strength=40.0)
        self._random = random.Random(seed)
        self._end = self._began = 0.0
        self._act: Callable[[float, Sequence[float], Sequence[float]], Torque] = lambda since, theta, v: NO_TORQUE
        self._last = 0.0
        self._period = 0.001
        self.counts: dict[str, int] = {}
        self.is_over: Callable[[], object] = lambda: False
        self.top = 0.0

    def idle(self, elapsed: float, duration: float) -> bool:
        """Return False: the wearer may always move."""
        return False

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (4,) in Nm."""
        if self.is_over():
            return NO_TORQUE
        torque = NO_TORQUE
        self.top = max(self.top, *map(abs, velocity))
        if 0.0 <= elapsed <= self.script.duration:
            super().torque(elapsed, theta, velocity)  # follows the script's steps
            self._period, self._last = elapsed - self._last, elapsed
            if elapsed >= self._end:
                self._begin(elapsed, tuple(theta))
            torque = self._act(elapsed - self._began, theta, velocity)
        return tuple([bounded(n, *column) for n, column in enumerate(zip(torque, theta, velocity, strict=True))])

    def _begin(self, elapsed: float, theta: tuple[float, ...]) -> None:
        chance = self._random
        name = chance.choice(("reach", "reach", "shake", "clap", "throw", "push", "rest"))
        self.counts[name] = self.counts.get(name, 0) + 1
        self._weight = [0.0] * JOINT_COUNT if name in ("rest", "push") else self._weight
        self._began = elapsed
        self._end = elapsed + getattr(self, f"_{name}")(theta)

    def _pose(self) -> tuple[float, ...]:
        return tuple(map(self._random.uniform, LOWEST, HIGHEST))

    def _reach(self, theta: tuple[float, ...], least: float = 0.3) -> float:
        to = self._pose()
        farthest = max(abs(b - a) for a, b in zip(theta, to, strict=True))
        duration = max(least, 1.875 * farthest / FASTEST) * self._random.uniform(1.0, 1.6)  # minimum jerk
        self._act = lambda since, q, v: self.lead(path_between(theta, to, since, duration), q, v, self._period)
        return duration + 0.1

    def _throw(self, theta: tuple[float, ...]) -> float:
        """Swing out at once, then let go in the middle of the motion."""
        whole = self._reach(theta, 0.2)
        return 0.6 * whole

    def _clap(self, theta: tuple[float, ...]) -> float:
        """Three times forth and back over 0.3 rad, against a hard stop of 15 ms."""
        beat, joints = self._random.uniform(0.25, 0.4), self._random.sample(range(JOINT_COUNT), 2)

        def act(since: float, q: Sequence[float], v: Sequence[float]) -> Torque:
            way = 0.15 * (1.0 - math.cos(2.0 * math.pi * since / beat))
            speed = 0.3 * math.pi / beat * math.sin(2.0 * math.pi * since / beat)
            path = [(a + way, speed) if n in joints else (a, 0.0) for n, a in enumerate(theta)]
            torque = self.lead(path, q, v, self._period)
            if (since / beat) % 1.0 > 0.5 and ((since / beat) % 1.0 - 0.5) * beat < 0.015:
                n = joints[0]
                stop = max(-IMPACT[n], min(IMPACT[n], STOP * v[n]))
                return (*torque[:n], torque[n] - stop, *torque[n + 1 :])
            return torque

        self._act = act
        return 3.0 * beat

    def _shake(self, theta: tuple[float, ...]) -> float:
        frequency, joints = self._random.uniform(2.0, 3.0), self._random.sample(range(JOINT_COUNT), 2)
        size = min(0.2, 0.7 * FASTEST / (2.0 * math.pi * frequency))

        def act(since: float, q: Sequence[float], v: Sequence[float]) -> Torque:
            turn = 2.0 * math.pi * frequency
            swing = size * math.sin(turn * since), size * turn * math.cos(turn * since)
            path = [(a + swing[0], swing[1]) if n in joints else (a, 0.0) for n, a in enumerate(theta)]
            return self.lead(path, q, v, self._period)

        self._act = act
        return self._random.uniform(1.0, 3.0)

    def _push(self, theta: tuple[float, ...]) -> float:
        """Push the arm down against its support, and let it come up again."""
        most = (1.0, 5.0, 3.0, 1.0)
        self._act = lambda since, q, v: tuple(
            -share * min(1.0, 4.0 * since) * math.copysign(1.0, angle - 0.3) - 1.0 * speed
            for share, angle, speed in zip(most, q, v, strict=True)
        )
        return self._random.uniform(0.5, 1.5)

    def _rest(self, theta: tuple[float, ...]) -> float:
        self._act = lambda since, q, v: tuple(-0.5 * speed for speed in v)
        return self._random.uniform(0.5, 2.0)


def bounded(joint: int, torque: float, angle: float, velocity: float) -> float:
    """Return the `torque` in Nm of a wearer who drives no joint beyond FASTEST, and brakes one that is faster.

    The wearer's body stops the arm softly at the edges of its range.
    """
    excess = max(0.0, abs(velocity) - FASTEST)
    driving = max(0.0, 1.0 - 2.0 * excess) if torque * velocity > 0.0 else 1.0
    depth = min(0.0, angle - LOWEST[joint] + EDGE) + max(0.0, angle - HIGHEST[joint] - EDGE)
    body = FLESH * depth + STOP * velocity if depth else 0.0
    return driving * torque - math.copysign(BRAKE[joint] * excess, velocity) - body


class Changed(Compensator):
    """A compensator that becomes `wrong` by `start`: other settings, or a change of its efforts.

    on_step is called before every step.
    """

    def __init__(self, settings: Settings, wrong: Settings | Change) -> None:
        super().__init__(settings)
        self.on_step: Callable[[], None] = lambda: None
        self._wrong, self._is_wrong = wrong, False

    def start(self) -> None:
        """Be wrong from now on."""
        if isinstance(self._wrong, Settings) and not self._is_wrong:
            self.apply(self._wrong)
        self._is_wrong = True

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Compensation:
        """Return the answer that the bridge gets."""
        self.on_step()
        answer = super().step(now, theta, velocity)
        if answer.effort is None or not self._is_wrong or isinstance(self._wrong, Settings):
            return answer
        return answer._replace(effort=self._wrong(now, theta, velocity or NO_TORQUE, answer.effort))


class Lively(Compensator):
    """A sound compensator with an outer loop that assists as far as it may, and in turn another load each 20 s.

    The assistance fades towards FASTEST: it is not to make the arm faster than the wearer may be.
    """

    def __init__(self, settings: Settings, others: Sequence[Settings]) -> None:
        super().__init__(settings)
        self._others, self._next = itertools.cycle((settings, *others)), 20.0

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Compensation:
        """Return the answer that the bridge gets."""
        if now >= self._next:
            self._next = now + 20.0
            self.apply(next(self._others))
        if self.terms is not None and velocity:
            pushed = [math.copysign(4.0 * max(0.0, 1.0 - abs(speed) / FASTEST), speed) for speed in velocity]
            self.terms.assist.receive(now, JOINTS, pushed, now)
        return super().step(now, theta, velocity)


def settings_of(body_mass: float = 0.0, **changes: Any) -> Settings:
    """Return the compensator's settings: One-G, or Zero-G for a wearer of `body_mass` kg."""
    load = Wearer(body_mass or BODY_MASS).on_links(LENGTH)
    load_of_wearer = {"wearer_mass": tuple(load.mass), "wearer_cog": tuple(load.cog)}
    worn = {"mode": "zero_g", "support": 1.0, **load_of_wearer} if body_mass else {}
    return replace(Settings("right", ROBOT), **{**worn, **changes})


def arm_of(settings: Any, worn: bool, moment: Sequence[float], addition: Sequence[float] = NO_TORQUE) -> ArmSetup:
    """Return the right arm that hangs; worn: with the passive arm of a wearer in it.

    moment, addition: (4,), `largest_moment` and `largest_addition`.
    """
    load = Wearer(BODY_MASS).on_links(LENGTH)
    wearer: dict[str, Any] = {"wearer_mass": load.mass, "wearer_cog": load.cog} if worn else {}
    arm = SimulatedArm(ArmConfig(TRUE_ROBOT, **wearer))
    arm.reset(HANGING)
    motors = [JointMotor(MOTORS[name], number + 1) for number, name in enumerate(MOTOR_NAMES)]
    device = SimulatedDevice(arm, [SimulatedMotor(motor) for motor in motors])
    limits = Limits(JOINTS, sign_check_torque=0.0, largest_moment=moment, largest_addition=addition)
    return ArmSetup("right", device, motors, limits, settings, RATE, TrueTrunk())


class Quiet(NamedTuple):
    """What `quiet` saw: s simulated, rad/s of the fastest joint, the largest share of the permitted impulse."""

    duration: float
    speed: float
    share: float
    trouble: str


def quiet(
    compensator: Compensator,
    duration: float,
    seed: int,
    moment: Sequence[float],
    addition: Sequence[float] = NO_TORQUE,
) -> Quiet:
    """Let a fast wearer of 75 kg, who also walks, bows, leans and sits down, use the arm for `duration` s."""
    count = int(duration / TRUNK_TIME * len(TRUNK))
    steps = list(itertools.islice(itertools.cycle(TRUNK), count)) or [{"hold": duration}]
    script = TrialScript.parse({"name": "fast wearer", "steps": steps})
    wearer = Fast(script, seed)
    trial = OfflineTrial(arm_of(compensator.settings, True, moment, addition), script, 2.0, compensator, wearer)
    monitor, share = trial.safety.motion, 0.0

    def is_over() -> bool:
        nonlocal share
        columns = zip(monitor.impulse, monitor.full, strict=True)
        share = max(share, *(impulse / (MOTION.patience * full or 1.0) for impulse, full in columns))
        return trial.safety.fault is not None

    wearer.is_over = is_over
    recording = trial.run()
    return Quiet(float(recording.time[-1]), wearer.top, share, trial.trouble)


def sound() -> Iterator[tuple[str, Compensator, Sequence[float], Sequence[float]]]:
    """Yield sound compensators: name, compensator, and `largest_moment` and `largest_addition` (4,) that suit it."""
    full, half = settings_of(BODY_MASS), settings_of(BODY_MASS, support=0.5)
    added = TermSettings(
        friction=Friction(0.8, (0.2, 0.4, 0.2, 0.2), (0.02, 0.05, 0.02, 0.02)),
        inertia=Inertia(0.6),
        spring=Spring((2.0, 4.0, 2.0, 1.0)),
        assist=Assist((2.0, 4.0, 2.0, 2.0)),
    )
    moment, everything = papers(full.arm).first_moment, Lively(replace(full, terms=added, inertial=True), ())
    addition = tuple(map(operator.add, SUM.effort, added.assist.max_effort))
    yield "One-G", Compensator(settings_of()), papers(settings_of().arm).first_moment, NO_TORQUE
    yield "Zero-G, 75 kg", Compensator(full), moment, NO_TORQUE
    yield "with changes of load", Lively(full, (half, settings_of())), moment, NO_TORQUE
    yield "with all terms, assistance, `inertial`", everything, moment, addition


def used(part: tuple[int, float, int]) -> Quiet:
    """Return what `quiet` sees. part: the number of a compensator among `sound`, for how many s, the seed."""
    number, duration, seed = part
    _, compensator, moment, addition = list(sound())[number]
    return quiet(compensator, duration, seed, moment, addition)


class Caught(NamedTuple):
    """What became of a wrong compensator."""

    fault: str  #: its code, '' for none
    time: float  #: s, from when it was wrong until the fault
    speed: float  #: rad/s, of the fastest joint from when it was wrong
    until: float  #: rad/s, until the fault


def caught(
    wrong: Settings | Change,
    pose: Sequence[float] | None = RAISED,
    lean: float = 0.0,
    watched: bool = True,
    addition: float = 0.0,
) -> Caught:
    """Let go of a bare arm at `pose`; WRONG s later the compensator has the settings `wrong`, or changes its efforts.

    pose: None to leave the arm hanging, with a compensator that is wrong from the start. lean: rad, of the trunk.
    watched: by the monitor; addition: Nm, its `largest_addition`.
    """
    release = RELEASE if pose else 0.0
    steps: list[dict[str, Any]] = [{"hold": RELEASE + WRONG}, {"lean": lean, "over": 1.0}, {"hold": 4.0}]
    script = TrialScript.parse({"name": "let go", "steps": steps})
    wearer = Passive(script, pose, release)
    sound = settings_of()
    compensator = Changed(wrong if isinstance(wrong, Settings) and not pose else sound, wrong)
    moment = papers(sound.arm).first_moment if watched else (0.0,) * 4
    trial = OfflineTrial(arm_of(sound, False, moment, (addition,) * 4), script, 1.0, compensator, wearer)
    tripped = math.inf

    def note() -> None:
        nonlocal tripped
        if pose and wearer.motion and wearer.motion[-1][0] >= release + WRONG:
            compensator.start()
        if trial.safety.fault and wearer.motion:
            tripped = min(tripped, wearer.motion[-1][0])

    compensator.on_step = note
    trial.run()
    since = release + WRONG if pose else 0.0
    speeds = [(when - since, speed) for when, speed in wearer.motion if when >= since]
    fault, until = trial.safety.fault, max((speed for at, speed in speeds if at <= tripped - since), default=0.0)
    return Caught(str(fault.code) if fault else "", tripped - since, max(speed for _, speed in speeds), until)


def wrong_rows(**monitor: Any) -> Iterator[tuple[str, Caught]]:
    """Yield what becomes of a free arm; monitor: `watched` and `addition`, as `caught` takes them."""
    by_mass = (ArmModel(LENGTH, ROBOT.cog, mass) for mass in (3.0 * ROBOT.mass, ROBOT.mass[::-1]))
    tripled, reversed_ = (settings_of(robot=robot) for robot in by_mass)
    yield "masses 3 times too large, from the start", caught(tripled, None, **monitor)
    yield "the same, set live while raised", caught(tripled, **monitor)
    yield "the same at once while raised", caught(multiplied, **monitor)
    yield "masses in reversed order, set live while raised", caught(reversed_, **monitor)
    yield "wrong side, hanging; the trunk leans by 0.3 rad", caught(settings_of(side="left"), None, 0.3, **monitor)
    yield "sign of joint 2", caught(flipped(1), **monitor)
    yield "sign of joint 3, flexed by 1.2 rad", caught(flipped(2), (0.0, 0.5, 1.2, 0.5), **monitor)
    yield "`paper_static` with the encoder's theta_1", caught(misread, (0.6, 0.9, 0.3, 0.3), **monitor)
    yield "8 Hz, 2 Nm on joint 2", caught(shaken((0.0, 2.0, 0.0, 0.0)), **monitor)
    yield "8 Hz, 2, 4, 2, 2 Nm", caught(shaken((2.0, 4.0, 2.0, 2.0)), **monitor)
    yield "positive feedback of velocity", caught(fed_back, **monitor)


def multiplied(now: float, theta: Sequence[float], v: Sequence[float], effort: Torque) -> Torque:
    """Ask for three times the torque, without the guided change of a load that is set live."""
    return tuple(3.0 * torque for torque in effort)


def flipped(joint: int) -> Change:
    """Return what reverses the effort of `joint` (0..3)."""
    return lambda now, theta, v, effort: tuple(-tau if n == joint else tau for n, tau in enumerate(effort))


def shaken(size: Sequence[float]) -> Change:
    """Return what adds `size` (4,) Nm at 8 Hz."""
    return lambda now, theta, v, effort: tuple(
        tau + most * math.sin(16.0 * math.pi * now) for tau, most in zip(effort, size, strict=True)
    )


def fed_back(now: float, theta: Sequence[float], v: Sequence[float], effort: Torque) -> Torque:
    """Add up to 6 Nm s/rad, and a push of 0.5 Nm each second, which starts the motion."""
    push = 0.5 if now % 1.0 < 0.1 else 0.0
    return tuple(tau + gain * speed + push for tau, gain, speed in zip(effort, (2.0, 6.0, 4.0, 1.0), v, strict=True))


def misread(now: float, theta: Sequence[float], v: Sequence[float], effort: Torque) -> Torque:
    """Return the paper's static law with the encoder's angle of joint 1 for that to gravity."""
    return tuple(paper_static_torque(ROBOT, theta).tolist())


def main() -> int:
    """Print both tables; return 1 if a sound arm was let down or a wrong one was not."""
    parser = argparse.ArgumentParser(prog="python -m bench.motion_monitor")
    parser.add_argument("--hours", type=float, default=1.0, help="simulated time of the fast wearer")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--addition", type=float, default=0.0, help="`largest_addition` with the wrong ones, in Nm")
    parser.add_argument("--only-quiet", action="store_true", help="the fast wearer alone")
    arguments = parser.parse_args()
    failed = 0
    print("| compensator | fault | after (s) | until then (rad/s) | afterwards | without the monitor |")
    rows = wrong_rows(addition=arguments.addition), wrong_rows(watched=False)
    wrong = () if arguments.only_quiet else zip(*rows, strict=True)
    for (name, seen), (_, alone) in wrong:
        failed += seen.fault != FaultCode.UNEXPLAINED_TORQUE and seen.speed > CALM
        without = f"{alone.speed:.2f}{', ' + alone.fault if alone.fault else ''}"
        print(
            f"| {name} | {seen.fault or 'none'} | {seen.time:.2f} | {seen.until:.2f} | {seen.speed:.2f} | {without} |",
            flush=True,
        )
    names = [name for name, *_ in sound()]
    parts = [(number, 900.0 * arguments.hours, arguments.seed + number) for number in range(len(names))]
    runs = play("motion-monitor", used, parts, lambda run: run.trouble or f"{run.duration:.0f} s, quiet")
    for name, run in zip(names, runs, strict=True):
        failed += bool(run.trouble)
        figures = f"{run.duration:.0f} s | {run.speed:.1f} rad/s | {100.0 * run.share:.0f} %"
        print(f"| {name} | {run.trouble or 'none'} | {figures} |", flush=True)
    return min(1, failed)


if __name__ == "__main__":
    sys.exit(main())
