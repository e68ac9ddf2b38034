# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A case: an arm, and what happens to it, drawn from a seed. It is data, so that a seed replays it.

Each kind of event belongs to a group: operator, hardware, computer, wearer, IMU. A case draws two kinds, mostly of
different groups, and often an operator who clears the fault and enables the arm afterwards.
"""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from exo_gravity.core.safety.descent import DESCENT
from exo_gravity.sim.judge import SLOW

from ..arms import ARMS, PlayedArm, Pose

RATES = (100.0, 250.0)  # Hz
BODY_MASS = 75.0  # kg, of a wearer
ENABLED, CARRIED = "enabled", "carried"  # what the times of a case's events count from
REARM = "rearm"  # clear and enable

Values = dict[str, Any]
Draw = Callable[[random.Random, PlayedArm], Values]  # of the values of an event of this arm


class Event(NamedTuple):
    """Something that happens `time` s after the case's `begin`."""

    time: float
    name: str
    values: Values


@dataclass(frozen=True)
class Case:
    """An arm and its events.

    arm: its name in ARMS.
    worn: with the passive arm of a wearer in it, which Zero-G carries; else One-G carries the bare arm.
    payload: kg in the hand, known to the compensator.
    friction: Nm, Coulomb's of a joint with an AK60-6.
    pose: (n,) rad, to which the wearer moves the carried arm.
    begin: ENABLED or CARRIED.
    """

    arm: str
    seed: int
    rate: float
    worn: bool
    payload: float
    friction: float
    pose: tuple[float, ...]
    begin: str
    events: tuple[Event, ...]


class Bound(NamedTuple):
    """What a motor may do to an arm: rad/s, and J in one stretch that are given faster than `slow` rad/s.

    turning: whether the trunk turns under the arm, so that what lifts it does not count.
    """

    speed: float = 0.6
    energy: float = 0.3
    slow: float = SLOW
    turning: bool = False


# A change of load that the operator asks for is a guided motion, whoever wears the arm. An arm that is lighter than
# configured rises: an elbow that carries the arm of a wearer of 75 kg, configured for 100 kg, takes 6.1 J from its
# motor, all but 0.03 J of it to gain height. Below the speed at which arms are let down, a hand 0.7 m from the shoulder
# moves at less than 0.25 m/s, the reduced speed of ISO 10218-1. Only energy that is given above that speed counts.
ASKED = Bound(slow=DESCENT.speed)
TURNING = Bound(turning=True)
# Faults that cannot be detected at once have bounds of their own; docs/safety_case.md gives the reasons.
CLAMPED, REPLIES_LOST, LOAD_LOST = Bound(1.9, math.inf), Bound(1.5, math.inf), Bound(2.9, math.inf)
# 2.1 Nm that held 1 kg accelerate a bare forearm of 0.006 kg m^2 by 3.5 rad/s a cycle, and the second cycle answers.
LOST_AT_100_HZ = Bound(7.0, math.inf)
TILT_JUMPED = Bound(1.0, math.inf)
TILT_CREPT = Bound(2.9, math.inf)  # no faster than people turn; or the arm is moved once it is no longer new
# A motor that no command reaches keeps its torque: only its own time-out ends what a lost load, or a trunk or a hand
# that moves, leaves (invariant 11).
UNREACHED, MOVED_UNREACHED = ("commands_lost", "bus_silent"), Bound(math.inf, math.inf)
# While torques are clamped or late, what carries the arm belongs to a tilt that the trunk has left. The arm then lags
# behind the trunk, which falls at 3.3 rad/s and more.
LATE, TURNED_AHEAD = ("efforts_late", "imu_silent", "imu_frozen"), Bound(2.9, math.inf, turning=True)
SLOWLY = 1.0  # s, from which on a wrong tilt turns no faster than people do


class Kind(NamedTuple):
    """A kind of event: its group, how its values are drawn, and its bound where its cause cannot be seen."""

    group: str
    draw: Draw = lambda random, arm: {}
    bound: Bound = Bound()


def lasting(shortest: float, longest: float) -> Draw:
    """Draw a duration in s, short ones as often as long ones."""
    return lambda random, arm: {"duration": span(random, shortest, longest)}


def span(random: random.Random, shortest: float, longest: float) -> float:
    """Draw a number between two, short ones as often as long ones."""
    return round(math.exp(random.uniform(math.log(shortest), math.log(longest))), 3)


def some_motors(shortest: float, longest: float) -> Draw:
    """Draw one motor or all of them, and a duration in s."""

    def draw(random: random.Random, arm: PlayedArm) -> Values:
        joints = range(len(arm.friction))
        motors = list(joints) if random.random() < 0.5 else [random.choice(joints)]
        return {"motors": motors, "duration": span(random, shortest, longest)}

    return draw


def slip(random: random.Random, arm: PlayedArm) -> Values:
    """Draw a joint and an error of its encoder in rad: a turn of the rotor, or 0.3 rad."""
    joint = random.choice(range(len(arm.friction)))
    turn = 2.0 * math.pi / arm.carried.motors[joint].spec.gear_ratio
    return {"joint": joint, "error": random.choice((-1.0, 1.0)) * random.choice((round(turn, 3), 0.3))}


def wrong_speed(random: random.Random, arm: PlayedArm) -> Values:
    """Draw a joint, the factor of its reported speed, and a duration in s."""
    factor = random.choice((-1.0, 0.0, 0.3, 3.0))
    return {"joint": random.choice(range(len(arm.friction))), "factor": factor, "duration": span(random, 0.1, 5.0)}


def on_joint(**choices: tuple[float, ...]) -> Draw:
    """Draw a joint, and one of the values of each name."""
    return lambda random, arm: {
        "joint": random.choice(range(len(arm.friction))),
        **{name: random.choice(values) for name, values in choices.items()},
    }


def one_of(**choices: tuple[Any, ...]) -> Draw:
    """Draw one of the values of each name."""
    return lambda random, arm: {name: random.choice(values) for name, values in choices.items()}


def reach(random: random.Random, arm: PlayedArm) -> Values:
    """Draw a pose (n,) rad and the time to reach it in s."""
    return {
        "pose": list(pose(random, arm.farthest, arm.nearest(arm.farthest))),
        "duration": round(random.uniform(1.0, 2.0), 2),
    }


def pose(random: random.Random, farthest: Pose, least: Pose) -> Pose:
    """Draw a pose (n,) rad between two."""
    return tuple(round(random.uniform(*ends), 2) for ends in zip(least, farthest, strict=True))


def push(random: random.Random, arm: PlayedArm) -> Values:
    """Draw torques (n,) N m and a duration in s."""
    torque = [round(random.uniform(-limit, limit), 2) for limit in arm.push]
    return {"torque": torque, "duration": round(random.uniform(0.2, 0.6), 2)}


KINDS = {
    "disable": Kind("operator"),
    "enable": Kind("operator"),
    "clear": Kind("operator"),
    "resume": Kind("operator"),
    "toggle": Kind("operator", lasting(0.1, 4.0)),
    "mode": Kind("operator", bound=ASKED),
    "support": Kind("operator", one_of(support=(0.0, 0.3, 0.7)), ASKED),
    "max_effort": Kind("operator", one_of(share=(0.2, 0.5)), CLAMPED),
    "body_mass": Kind("operator", one_of(mass=(50.0, 100.0)), ASKED),
    "supply_cut": Kind("hardware", some_motors(0.02, 5.0)),
    "commands_lost": Kind("hardware", some_motors(0.05, 5.0)),
    "replies_lost": Kind("hardware", some_motors(0.05, 5.0), REPLIES_LOST),
    "bus_silent": Kind("hardware", lasting(0.05, 5.0), REPLIES_LOST),
    "encoder_slip": Kind("hardware", slip),
    "wrong_speed": Kind("hardware", wrong_speed),
    "torque_reversed": Kind("hardware", on_joint()),
    "motor_error": Kind("hardware", on_joint(code=(5, 2))),
    "motor_warms": Kind("hardware", on_joint(most=(76.0, 90.0)), CLAMPED),
    "stall": Kind("computer", lasting(0.02, 0.5)),
    "efforts_late": Kind("computer", lasting(0.05, 2.0)),
    "efforts_withdrawn": Kind("computer", lasting(0.02, 2.0)),
    "efforts_nan": Kind("computer", lasting(0.005, 0.1)),
    "reach": Kind("wearer", reach),
    "limp": Kind("wearer"),
    "lap": Kind("wearer", lasting(5.0, 20.0)),
    "resist": Kind("wearer", lasting(1.0, 5.0)),
    "spasm": Kind("wearer", one_of(size=(1.0, 2.0))),
    "push": Kind("wearer", push),
    "payload_taken": Kind("wearer", one_of(mass=(0.2, 1.0), told=(0.0, 1.0, 2.0)), ASKED),
    "payload_dropped": Kind("wearer", bound=LOAD_LOST),
    "payload_flicked": Kind("wearer", bound=LOAD_LOST),
    "out_of_cuff": Kind("wearer", bound=LOAD_LOST),
    "imu_wrong": Kind(
        "imu", one_of(pitch=(-0.52, 0.0, 0.52), roll=(-0.52, 0.52), duration=(0.05, 0.2, 2.0)), TILT_JUMPED
    ),
    "imu_creeps": Kind("imu", one_of(pitch=(-3.1, 1.0, 3.1), roll=(0.0,), duration=(0.2, 0.6)), TILT_JUMPED),
    "imu_frozen": Kind("imu", lasting(0.1, 5.0)),
    "imu_silent": Kind("imu", lasting(0.05, 2.0)),
    "trunk_falls": Kind("wearer", one_of(bow=(-0.6, 0.8, 1.4), duration=(0.4, 0.8)), TURNING),
    "lean": Kind("wearer", one_of(lean=(-0.5, 0.5), duration=(0.5, 1.0)), TURNING),
    REARM: Kind("operator", lasting(0.1, 1.0)),
}
NEEDS_IMU = ("imu_wrong", "imu_creeps", "imu_frozen", "imu_silent", "trunk_falls", "lean")
NEEDS_WEARER = ("body_mass",)
STARTS = ("enable", "toggle", REARM)
AT_POWER_UP = ("torque_reversed",)  # wired so: they are there before the arm is enabled


def draw(seed: int, name: str) -> Case:
    """Return the case of `seed` for the arm called `name`, always the same one."""
    source, arm = random.Random(seed), ARMS[name]
    worn = source.random() < 0.5 and arm.worn is not None
    impossible = (*([] if arm.has_imu else NEEDS_IMU), *([] if arm.worn else NEEDS_WEARER))
    kinds = [name for name in KINDS if name not in impossible]
    first, second = pair(source, kinds)
    begin = ENABLED if {first, second} & set(AT_POWER_UP) or source.random() < 0.25 else CARRIED
    longest = 8.0 if begin == ENABLED else 1.0
    at = source.uniform(0.0, longest)
    apart = source.choice((span(source, 0.01, 0.5), span(source, 0.1, 6.0)))
    events = [event(source, arm, first, at), event(source, arm, second, at + apart)]
    if source.random() < 0.6:
        events.append(event(source, arm, REARM, at + apart + source.uniform(3.0, 14.0)))
        if source.random() < 0.3:
            last = source.choice(("reach", "limp", "push"))
            events.append(event(source, arm, last, events[-1].time + source.uniform(3.0, 9.0)))
    payload = source.choice((0.2, 1.0)) if {first, second} & {"payload_dropped", "payload_flicked"} else 0.0
    rate, farthest = source.choice(RATES), arm.farthest
    if worn and source.random() < 0.75 and arm.worn:
        farthest = arm.worn
    in_order = tuple(sorted(events, key=lambda event: event.time))
    friction = source.choice((0.05, 0.2))
    to = pose(source, farthest, arm.nearest(farthest))
    return Case(name, seed, rate, worn, payload, friction, to, begin, in_order)


def pair(random: random.Random, kinds: list[str]) -> tuple[str, str]:
    """Return two of these kinds of events, of different groups seven times in eight."""
    while True:
        first, second = random.choice(kinds), random.choice(kinds)
        if KINDS[first].group != KINDS[second].group or random.random() < 0.125:
            return first, second


def event(random: random.Random, arm: PlayedArm, name: str, time: float) -> Event:
    """Draw the values of an event; what is wired wrong happens at 0 s."""
    return Event(0.0 if name in AT_POWER_UP else round(time, 3), name, KINDS[name].draw(random, arm))


def bound_of(case: Case, clamped: bool) -> Bound:
    """Return what a motor may do in this case: the highest bound of its causes.

    clamped: whether the compensator or the bridge had to clamp a torque.
    """
    bounds = [KINDS[event.name].bound for event in case.events] + [CLAMPED] * clamped + [Bound()]
    for event in case.events:
        is_moved, is_tilt = is_moved_after(case, event), KINDS[event.name].bound is TILT_JUMPED
        if is_tilt and (is_moved or event.values["duration"] > SLOWLY):
            bounds.append(TILT_CREPT)
        if is_moved and tells_too_much(case, event):
            bounds.append(LOAD_LOST)
        # Who enables the arm after a slip vouches that it hangs as its angles say. If these are wrong by less than
        # `home_tolerance`, the arm rises as one that is lighter than they say.
        is_started = any(later.name in STARTS for later in case.events if later.time > event.time)
        if event.name == "encoder_slip" and is_started:
            bounds.append(ASKED)
    bounds += [MOVED_UNREACHED] * is_moved_unreached(case)
    bounds += [TURNED_AHEAD] * is_turned_ahead(case, clamped)
    bounds += [LOST_AT_100_HZ] * (case.rate == min(RATES) and any(bound is LOAD_LOST for bound in bounds))
    return Bound(*map(max, zip(*bounds, strict=True)))


def is_moved_after(case: Case, event: Event) -> bool:
    """Return whether a wearer may move the arm after this event.

    Once a wrong load or a wrong tilt is carried, nothing shows it while the arm stands. What moves the arm then, moves
    it as if a load of that mass had been lost, or into a pose in which the wrong tilt drives it.
    """
    return any(KINDS[later.name].group == "wearer" for later in case.events if later.time > event.time)


def is_turned_ahead(case: Case, clamped: bool) -> bool:
    """Return whether the trunk turns while torques are `clamped`, or come late."""
    is_late = clamped or any(event.name in LATE for event in case.events)
    return is_late and any(KINDS[event.name].bound == TURNING for event in case.events)


def is_moved_unreached(case: Case) -> bool:
    """Return whether a wearer begins or ends to act, or a load is lost, while commands do not reach a motor."""
    spans = [(each, each.time, each.time + each.values.get("duration", 0.0)) for each in case.events]
    gaps = [(begin, end) for each, begin, end in spans if each.name in UNREACHED]
    acts = [time for each, *ends in spans if KINDS[each.name].group == "wearer" for time in ends]
    return any(begin <= time <= end for begin, end in gaps for time in acts)


def tells_too_much(case: Case, event: Event) -> bool:
    """Return whether this event by itself lets the compensator carry more mass than there is."""
    if event.name == "mode":
        return not case.worn and ARMS[case.arm].worn is not None  # to Zero-G: the wearer's arm is not there
    if event.name == "body_mass":
        return case.worn and float(event.values["mass"]) > BODY_MASS
    return event.name == "payload_taken" and float(event.values["told"]) > 1.0
