# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Judges what an arm did, by the simulated arm's true motion, not by the frames on its bus.

`measure` judges one fault, for the fault matrix. `Driven` is what motors did to an arm at any time, for the search too.

Wearers may move the arm as fast as they like. While they touch it, its speed is theirs. Afterwards only the speed that
a joint gains is judged: by how much it exceeds the least that it has had since. `driven` is the part of it that a motor
causes, from the moment of release on: the largest such speed of a joint in the direction of its motor's torque. A motor
that brakes causes none. When the hand lets go and the arm falls, the first HAND_OFF s are the wearer's. A stop that a
joint hits touches the arm, too: one that fell into it at 3 rad/s turned its shoulder at 15.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.motors.ak import USUAL_MOTORS
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import MotorSpec

MAX_SPEED = 1.0  # rad/s, of every joint
MAX_EFFORT_RATE = 50.0  # Nm/s
HAND_OFF = 0.1  # s after the wearer lets go
MAX_ENERGY = 0.3  # J that one motor may give its joint in one stretch
MAX_DAMPING = 1.5  # by the rated torque: `max_effort` bounds it by the newest speed, which changes until the next
SLOW = 0.1  # rad/s, below which a motor that moves a joint does not throw it
COAST = 0.02  # s for which a motor may stop driving within a stretch: a light arm is thrown and caught by turns
NEAR = 0.01  # rad before a mechanical stop, at which a joint that is faster than HIT rad/s hits it
HIT = 0.5
LITTLE = 0.005  # J, of a stretch: as much as a bare elbow has at 0.8 rad/s
WEAK = 0.1  # Nm, below which a motor drives nothing: half of a joint's friction
CODES = 2  # of a command, by which a torque may differ from what is meant
USUAL = tuple(MOTORS[name] for name in USUAL_MOTORS)  # the motors of the paper's arm
MAX_GAP = 0.2  # s between two records: a longer gap means that the simulated device did not run


@dataclass(frozen=True)
class Driven:
    """What motors did to an arm on which no hand was, each by the motor that did most.

    In a stretch a joint moves faster than SLOW in the direction of its motor's whole torque, that of damping included;
    gaps of up to COAST belong to it. A WEAK torque drives nothing.

    speed: rad/s gained within a stretch; 0 where the motor gave LITTLE energy beyond what lifts the joint's weight: a
    joint that a falling forearm swings upwards is not thrown by a motor that carries less than its weight.
    energy: J in one stretch.
    power: W in a stretch.
    damping: torque of damping alone as a multiple of the motor's rated torque, also while a hand is on the arm.
    joint, time: which joint (1..n) gained that speed, and when, as in the records.
    """

    speed: float = 0.0
    energy: float = 0.0
    power: float = 0.0
    damping: float = 0.0
    joint: int = 0
    time: float = 0.0


def resolution(motors: Sequence[MotorSpec] = USUAL) -> float:
    """Return the torque in Nm of CODES of the motor that has the coarsest."""
    return CODES * 2 * max(motor.torque_range for motor in motors) / 0xFFF


def driven(
    records: np.ndarray,
    motors: Sequence[MotorSpec] = USUAL,
    stops: tuple[Sequence[float], Sequence[float]] | None = None,
    slow: float = SLOW,
    turning: bool = False,
) -> Driven:
    """Return what the motors did in these records (sim/device.py); at least one.

    motors: of the joints (n,), by default those of the paper's arm.
    stops: the lower and upper mechanical stops, (n,) rad each; None if none is hit.
    slow: rad/s up to which no energy counts.
    turning: whether the trunk turns under the arm: then only energy beyond what lifts the joints' weight counts. An arm
        that stays behind a trunk leaning by 0.5 rad took 0.57 J from its motors, sank by 0.50 J, and gave both back to
        the trunk.
    """
    is_free, _, gained = _gained(records, stops)
    torque, velocity = records["torque"], records["velocity"]
    power = np.maximum(0.0, torque * velocity) * is_free[:, None]
    power[np.abs(torque) < WEAK] = 0.0
    is_moved = (power > 0.0) & (gained > SLOW)
    time = records["time"][:, None]
    in_stretch = time - np.maximum.accumulate(np.where(is_moved, time, -np.inf), axis=0) <= COAST
    # A time in which the device did not run counts as MAX_GAP.
    lasting = np.minimum(MAX_GAP, np.diff(records["time"], append=records["time"][-1:]))[:, None]
    beyond_weight = np.clip((torque - records["weight"]) * velocity, 0.0, power)
    counted = beyond_weight if turning else power
    energy = _sum_in(in_stretch, np.where(is_moved & (gained > slow), counted, 0.0) * lasting)
    threw = _sum_in(in_stretch, np.where(is_moved, beyond_weight, 0.0) * lasting) > LITTLE
    speed = np.where(threw, _gained_in(in_stretch, gained), 0.0)
    when, joint = np.unravel_index(np.argmax(speed), speed.shape)
    rated = [motor.rated_torque for motor in motors]
    return Driven(
        speed=float(speed[when, joint]),
        energy=float(energy.max()),
        power=float(power[is_moved].max(initial=0.0)),
        damping=float(np.abs(records["damping"] * records["velocity"] / rated).max()),
        joint=int(joint) + 1,
        time=float(records["time"][when]),
    )


def _sum_in(in_stretch: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the sum (n, joints) of the values since the begin of each joint's stretch."""
    total = np.cumsum(values, axis=0)
    return np.asarray(total - np.maximum.accumulate(np.where(in_stretch, 0.0, total), axis=0))


def _gained_in(in_stretch: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return the speed (n, joints) in rad/s by which each joint exceeds the least that it has had in its stretch.

    A joint that had at most twice SLOW before it counts as at rest then.
    """
    gained = np.zeros_like(speed)
    for joint, flags in enumerate(in_stretch.T):
        edges = np.flatnonzero(np.diff(flags, prepend=False, append=False))
        for first, end in zip(edges[::2], edges[1::2], strict=True):
            before = speed[max(0, first - 1), joint]
            least = np.minimum(np.minimum.accumulate(speed[first:end, joint]), before if before > 2.0 * SLOW else 0.0)
            gained[first:end, joint] = speed[first:end, joint] - least
    return gained


@dataclass
class Response:
    """What the arm did since the fault.

    reaction: s until every motor that can be reached is off or applies damping, None if one never does. top_speed:
    rad/s of `fastest` (joint 1..n), and driven: rad/s, both without the wearer's part. largest_step: Nm of a motor's
    torque within 1 ms, apart from damping times speed; switching off counts. excess: Nm by which the worst step exceeds
    what `MAX_EFFORT_RATE` allows for the frames that the motor received in that time. energy: J in one stretch, power:
    W, and damping, as in `Driven`. off: s until the last motor was off, None if one is on at the end. re_enabled:
    whether a motor was switched on after all had been off. gap: s, the longest time without a record.
    """

    reaction: float | None = None
    top_speed: float = 0.0
    driven: float = 0.0
    fastest: int = 0
    largest_step: float = 0.0
    excess: float = 0.0
    energy: float = 0.0
    power: float = 0.0
    damping: float = 0.0
    off: float | None = None
    re_enabled: bool = False
    gap: float = 0.0


def measure(
    records: np.ndarray,
    fault_time: float,
    period: float,
    unreached: Collection[int] = (),
    unpowered: Collection[int] = (),
    steps_from: float = 0.0,
    motors: Sequence[MotorSpec] = USUAL,
) -> Response:
    """Return the response to a fault at `fault_time` (wall clock, s) of a control loop with `period` s.

    records: of sim/device.py, from shortly before the fault on; at least one. unreached: joints (0..) whose motors no
    frame can reach. unpowered: joints that fall because their motors have no power; their speed does not count.
    steps_from: s after the fault from which on torque steps count, where the fault itself is a step.
    motors: as in `driven`.
    """
    since = records["time"] - fault_time
    after = since >= 0.0
    on = records["on"] & after[:, None]
    _, speed, gained = _gained(records)
    for of_joints in (speed, gained):
        of_joints[~after] = 0.0
        of_joints[:, list(unpowered)] = 0.0
    step, excess = _steps(records, period, motors)
    step, excess = step[since[1:] >= steps_from], excess[since[1:] >= steps_from]
    reached = [joint for joint in range(records["on"].shape[1]) if joint not in unreached]
    safe = (~records["on"] | (records["damping"] > 0.0))[:, reached].all(axis=1) & after
    powered = np.flatnonzero(on.any(axis=1))
    whole = driven(records[after], motors) if after.any() else Driven()
    off_at = powered[-1] + 1 if len(powered) else 0
    dark = np.flatnonzero(after & ~records["on"].any(axis=1))
    return Response(
        reaction=float(since[np.argmax(safe)]) if reached and safe.any() else None,
        top_speed=float(speed.max(initial=0.0)),
        driven=float(gained[records["torque"] * records["velocity"] > 0.0].max(initial=0.0)),
        fastest=int(np.argmax(speed.max(axis=0, initial=0.0))) + 1,
        largest_step=float(step.max(initial=0.0)),
        excess=float(excess.max(initial=0.0)),
        energy=whole.energy,
        power=whole.power,
        damping=whole.damping,
        off=None if off_at >= len(records) else max(0.0, float(since[off_at])),
        re_enabled=bool(len(dark) and len(powered) and powered[-1] > dark[0]),
        gap=float(np.diff(records["time"]).max(initial=0.0)),
    )


def _gained(
    records: np.ndarray, stops: tuple[Sequence[float], Sequence[float]] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return when nothing touched the arm (n,), and the speed (n, 4) in rad/s gained HAND_OFF s later and at once."""
    time, touched = records["time"], records["wearer"].any(axis=1)
    if stops:
        low, high = stops
        at_stop = (records["position"] < np.add(low, NEAR)) | (records["position"] > np.subtract(high, NEAR))
        touched |= (at_stop & (np.abs(records["velocity"]) > HIT)).any(axis=1)
    since = time - np.maximum.accumulate(np.where(touched, time, -np.inf))
    return ~touched, _gained_while(records, since > HAND_OFF), _gained_while(records, since > 0.0)


def _gained_while(records: np.ndarray, is_free: np.ndarray) -> np.ndarray:
    speed = np.abs(records["velocity"])
    speed[~is_free] = 0.0
    released = 1 + np.flatnonzero(is_free[1:] & ~is_free[:-1])
    for part in np.split(speed, released)[1:]:
        part -= np.minimum.accumulate(part)
    return speed


def _steps(records: np.ndarray, period: float, motors: Sequence[MotorSpec]) -> tuple[np.ndarray, np.ndarray]:
    """Return the torque steps (n - 1, joints) between records in Nm, and by how much each exceeds what is allowed."""
    torque = records["torque"]
    effort = torque + records["damping"] * records["velocity"]  # the part that damping does not explain
    step = np.minimum(np.abs(np.diff(effort, axis=0)), np.abs(np.diff(torque, axis=0)))
    peak, codes = np.array([motor.peak_torque for motor in motors]), resolution(motors)
    at_peak = np.abs(torque) > peak - codes  # there, damping explains less than its share
    step[at_peak[1:] | at_peak[:-1]] = 0.0
    on = records["on"]
    switched_off = on[:-1] & ~on[1:]
    step[switched_off] = np.abs(records["torque"][:-1])[switched_off]
    frames = np.maximum(1, np.diff(records["frames"].astype(int), axis=0))
    return step, step - (MAX_EFFORT_RATE * period * frames + codes)
