# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Guided motion: how a torque gets from what a joint has to what is wanted, whatever the cause.

Where a torque begins or its law changes, the torque moves only as fast as the joint stays calm. With f what the joint
had and w what is wanted, both in the present pose:

    torque = w + share * (f - w)

The share falls from 1 to 0, more slowly the faster the joint moves along the change. Beyond `calm` it rises again: then
the change itself may drive the joint. So an arm that becomes heavy sinks at about that speed until it hangs, and a
torque that nothing balances, in an empty cuff or by a wrong tilt, moves the arm no faster. Where the joint is thrown
against the change, by a torque that is to go (a load that has left the hand), the share falls faster. The torque always
lies between the two in this pose, wherever the arm has moved meanwhile: it cannot wind up.

`SafetyMachine` guides the begin of every torque, from nothing to what is asked for. It alone knows when it begins to
carry, and nothing that it is asked for can bypass it there. Where the torque changes later, only who computes it knows
what the old load would need in the new pose, so the compensator guides the change, by the same rule. What a faulty
compensator could then do is bounded at the end of the path (limits.py).

Meanwhile the motors damp a joint beyond `calm`, without the delay of a loop: without friction the share alone would let
an arm above the shoulder swing (measured: 1.6 rad/s in place of 0.4).
"""

from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.safety.limits import DAMPING


@dataclass(frozen=True)
class Guidance:
    """How fast a guided motion is."""

    time: float = 1.0  #: s, the least from the old torque to the new one: a change that is felt as gradual
    rate: float = 4.0  #: Nm/s of a joint that is calm: a wearer follows it without effort
    longest: float = 10.0  #: s, of larger arms; and always where the velocity is not known
    calm: float = 0.25  #: rad/s along the change, above the noise of a motor's velocity
    thrown: float = 1.0  #: rad/s against the change: below, wearers who move on would feel their support come and go
    gain: float = 20.0  #: Nm/rad, of the way beyond `calm`: back; more makes a light joint swing at 100 Hz
    release: float = 40.0  #: Nm/rad, of the way beyond `thrown`: on; it ends there, so it cannot swing
    brake: float = 1.5  #: Nm at most, by which the motors damp beyond `calm`: a wearer feels 0.5 kg in the hand
    watch: float = 1.0  #: s after its end in which a joint that begins to move is still guided
    small: float = 0.05  #: Nm; a smaller difference needs no guiding
    light: float = 0.5  #: Nm; a smaller one goes back no faster than this one, or a hanging arm that swings had no end


GUIDANCE = Guidance()


class GuidedMotion:
    """The guided motion of `count` joints; none is under way at first.

    shares: (n,) what is left of the way, 0 at the end.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self.stop()

    def begin(self, shares: Sequence[float]) -> None:
        """Begin where this is left of the way, (n,); 1 is the old torque."""
        self.shares, self._calm = tuple(shares), 0.0

    def stop(self) -> None:
        """Be at the new torque."""
        self.shares, self._calm = (0.0,) * self._count, GUIDANCE.watch

    @property
    def is_over(self) -> bool:
        """Whether no motion is under way."""
        return self._calm >= GUIDANCE.watch

    def step(
        self, dt: float, velocity: Sequence[float] | None, before: Sequence[float], wanted: Sequence[float]
    ) -> tuple[float, ...]:
        """Return the torque (n,) in Nm after `dt` s more.

        velocity: (n,) rad/s, None if not known.
        before, wanted: (n,) Nm, the old and the new torque in this pose.
        """
        speeds = (None,) * self._count if velocity is None else velocity
        columns = zip(self.shares, speeds, before, wanted, strict=True)
        self.shares = tuple([
            max(0.0, min(1.0, share - dt * pace(speed, new - old))) for share, speed, old, new in columns
        ])  # fmt: skip
        self._calm = 0.0 if any(self.shares) else self._calm + dt
        return self.between(before, wanted)

    def between(self, before: Sequence[float], wanted: Sequence[float]) -> tuple[float, ...]:
        """Return the torque (n,) in Nm at the present shares; before, wanted: as in `step`."""
        return tuple([new + share * (old - new) for share, old, new in zip(self.shares, before, wanted, strict=True)])


def pace(velocity: float | None, change: float) -> float:
    """Return how fast the share of a joint falls, in 1/s; below 0 it rises.

    velocity: rad/s, None if not known.
    change: Nm, the new torque less the old one.
    """
    g, size = GUIDANCE, max(GUIDANCE.small, abs(change))
    if velocity is None:
        return 1.0 / g.longest
    along = velocity if change > 0.0 else -velocity
    if along > g.calm:
        return -g.gain * (along - g.calm) / max(g.light, size)
    calm = min(1.0 / g.time, max(g.rate / size, 1.0 / g.longest))
    return calm * (1.0 - max(0.0, along) / g.calm) + g.release * max(0.0, -along - g.thrown) / size


def guide_damping(velocity: float) -> float:
    """Return the damping in Nm s/rad of a joint at `velocity` rad/s while its torque is guided."""
    speed = max(GUIDANCE.calm, abs(velocity))
    return min(DAMPING * (speed - GUIDANCE.calm), GUIDANCE.brake) / speed
