# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A wearer who acts on the simulated arm: lifts, shakes, reaches, throws. `attach` lets them act.

A behaviour is a function of the time in s since it began and of the arm's true angles and velocities, (4,) rad and
rad/s; it returns the wearer's torque (4,) in Nm on the joints. A behaviour remembers: make a new one for each arm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.sim import SimulatedDevice
from exo_gravity.sim.script import Step, TrialScript
from exo_gravity.sim.virtual_wearer import Path, VirtualWearer, path_between

Joints = Sequence[float]
Behaviour = Callable[[float, Joints, Joints], Joints]
Lead = Callable[[float, Joints], Path]  # where the hand is, from the time in s and the pose at which it took hold

ALL = (0, 1, 2, 3)
ANY = TrialScript("active wearer", (Step("hold", 3600.0),))


class ActiveWearer(VirtualWearer):
    """Behaves as `behaviour` says, for as long as the device runs."""

    def __init__(self, behaviour: Behaviour) -> None:
        super().__init__(ANY)
        self._behaviour = behaviour

    def torque(self, elapsed: float, theta: Joints, velocity: Joints) -> tuple[float, ...]:
        return tuple(self._behaviour(elapsed, theta, velocity)) if elapsed >= 0.0 else NO_TORQUE

    def idle(self, elapsed: float, duration: float) -> bool:
        return False


def attach(device: SimulatedDevice, behaviour: Behaviour, delay: float = 0.0) -> None:
    """Let a wearer act on the arm of `device` in `delay` s, in place of any other."""
    device.start(ActiveWearer(behaviour), delay)


def lift(joint: int, speed: float, duration: float) -> Behaviour:
    """A hand that leads `joint` at `speed` rad/s, down if it is negative, for `duration` s, and lets go."""

    def path(since: float, start: Joints) -> Path:
        return [(start[n] + speed * since, speed) if n == joint else (start[n], 0.0) for n in ALL]

    return hand(path, duration, (joint,))


def throw(joint: int, speed: float = 3.0, duration: float = 0.25) -> Behaviour:
    """A hand that moves `joint` fast and lets go while it moves."""
    return lift(joint, speed, duration)


def reach(there: Joints, duration: float, period: float = 1.6) -> Behaviour:
    """Reach to the pose `there` (4,) rad and back, again and again, for `duration` s; period: s of both ways."""

    def path(since: float, start: Joints) -> Path:
        half, rest = divmod(since, period / 2)
        ends = (start, there) if half % 2 == 0 else (there, start)
        return path_between(*ends, rest, period / 2)

    return hand(path, duration)


def shake(torque: Joints, duration: float, frequency: float = 2.0) -> Behaviour:
    """Shake the arm with `torque` (4,) Nm times a sine for `duration` s."""

    def behave(since: float, theta: Joints, velocity: Joints) -> Joints:
        share = math.sin(2 * math.pi * frequency * since) if since < duration else 0.0
        return [share * each for each in torque]

    return behave


def hand(lead: Lead, duration: float, joints: Sequence[int] = ALL) -> Behaviour:
    """A hand, compliant as a human one, that leads `joints` along a path for `duration` s and lets go."""
    wearer, last = VirtualWearer(ANY), [0.0]
    start: list[float] = []

    def behave(since: float, theta: Joints, velocity: Joints) -> Joints:
        start.extend(theta if not start else ())
        period, last[0] = since - last[0], since
        if since >= duration:
            return NO_TORQUE
        torque = wearer.lead(lead(since, start), theta, velocity, period)
        return [torque[n] if n in joints else 0.0 for n in ALL]

    return behave
