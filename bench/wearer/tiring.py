# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A wearer who holds a pose and tires, with a support that adapts and with a fixed one.

They mean to hold the pose all the time. Their muscles give at most a share of their arm's weight, which falls from 60
to 20 % within a minute, stays there for 20 s, and comes back at once. Only their damping, with which a muscle yields,
is beyond that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.compensator import JOINTS, Compensation, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.support import NAME
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.observer.adaptation import SupportAdaptation
from exo_gravity.lab.observer.momentum import MomentumObserver
from exo_gravity.lab.trial.offline import ArmSetup, OfflineTrial
from exo_gravity.sim.script import TrialScript

from ..device_study import Row
from .devices import Worn
from .muscles import Muscles, Phase
from .study import DELAY, HIGH, LOW, RATE, WornImu

SUPPORT = 0.4
SHARES = (0.6, 0.2)  # of the weight of the wearer's arm, at the start and the end
MOVE, RESTED, TIRING, TIRED, RECOVERED = 3.0, 3.0, 60.0, 20.0, 30.0  # s
SPARE = 0.3  # Nm, with which the wearer guides joints that carry nothing
FASTEST = 0.3  # rad/s


class Tiring(Muscles):
    """Holds a pose with ever less strength. motion: s, and the speed in rad/s of each joint (4,), every 1 ms."""

    motion: list[tuple[float, ...]]

    def strength_at(self, elapsed: float, weight: float) -> float:
        """Return the largest torque in Nm at a joint where the weight of the wearer's arm takes `weight` Nm."""
        since = elapsed - MOVE - RESTED
        if since < 0.0:
            return super().strength_at(elapsed, weight)
        fresh, tired = SHARES
        share = fresh + (tired - fresh) * min(1.0, since / TIRING) if since < TIRING + TIRED else fresh
        return share * abs(weight) + SPARE

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> tuple[float, ...]:
        """Return the wearer's torque (4,) in Nm."""
        if MOVE + RESTED < elapsed < MOVE + RESTED + TIRING + TIRED:
            self.motion.append((elapsed, *velocity))
        return super().torque(elapsed, theta, velocity)


class Adapting(Compensator):
    """A compensator with the requests of an estimate of the wearer's torque, as from the node `wearer`.

    read: called for the joints' efforts (4,) Nm; trunk: for what the trunk feels. supports: s, and the support.
    """

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self.read: Callable[[], Sequence[float]] = lambda: ()
        self.trunk: Callable[[], Tilt] = lambda: Tilt.of(settings.side)
        self.supports: list[tuple[float, float]] = []
        self._observer, self._adaptation = MomentumObserver(settings), SupportAdaptation()

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Compensation:
        """Return the answer that the bridge gets."""
        assert velocity
        estimate = self._observer.update(now, (theta, velocity, self.read()), self.trunk())
        self._adaptation.update(now, (theta, velocity), estimate, self.settings)
        if (requested := self._adaptation.requested) is not None:
            self.support_request.receive(now, (NAME,), (requested,), now)
        self.supports.append((now, self.settings.support_now))
        return super().step(now, theta, velocity)


@dataclass(frozen=True, eq=False)
class Tired:
    """What became of one wearer. time, support: (n,) s from when they begin to tire, and 0..1.

    speed: rad/s, of the fastest joint until their strength comes back. sunk: rad, furthest of any joint from the pose
    until then. trouble: '' if the arm was carried to the end.
    """

    seed: int
    time: np.ndarray
    support: np.ndarray
    speed: float
    sunk: float
    trouble: str

    def mean(self, start: float, end: float) -> float:
        """Return the mean support between two times in s."""
        return float(self.support[(self.time > start) & (self.time < end)].mean())


def tire(worn: Worn, adapts: bool) -> Tired:
    """Play the wearer of `worn`."""
    length = RESTED + TIRING + TIRED + (RECOVERED if adapts else 0.0)
    pose = tuple(np.random.default_rng(worn.seed).uniform(LOW, HIGH).tolist())
    script = TrialScript.parse({"name": "tiring", "steps": [{"hold": MOVE + length}]})
    device, imu = worn.device(), WornImu(worn)
    wearer = Tiring(
        script, (Phase(pose, MOVE, length, (0.0, 0.0)),), worn.wearer,
        lambda: Tilt.of(worn.side, device.trunk.pitch, device.trunk.roll), worn.seed,
    )  # fmt: skip
    wearer.motion = []
    settings = replace(worn.settings, support=SUPPORT, support_adapts=adapts)
    limits = Limits(JOINTS, max_effort=settings.max_effort, max_velocity=(20.0,) * 4, sign_check_torque=0.0)
    compensator = Adapting(settings)
    setup = ArmSetup(worn.side, device, worn.motors, limits, settings, RATE, imu)
    trial = OfflineTrial(setup, script, DELAY, compensator, wearer)
    compensator.read = lambda: [joint.effort for joint in trial.samples]
    compensator.trunk = lambda: Tilt.of_felt(worn.side, imu.log[-2][4:7])
    recording = trial.run()
    start = recording.steps[0].start + MOVE + RESTED
    time, support = np.array(compensator.supports).T
    motion = np.array(wearer.motion)
    during = (recording.time > start) & (recording.time < start + TIRING + TIRED)
    sunk = np.abs(recording.position[during] - pose).max(initial=0.0)
    return Tired(worn.seed, time - start, support, float(np.abs(motion[:, 1:]).max()), float(sunk), trial.trouble)


def verdict(pairs: Sequence[tuple[Tired, Tired]]) -> list[Row]:
    """Return the rows of the table. pairs: of each device, with a support that adapts and with a fixed one."""
    tired = [one.mean(TIRING, TIRING + TIRED) for one, _ in pairs]
    back = [one.mean(TIRING + TIRED + RECOVERED - 5.0, TIRING + TIRED + RECOVERED) for one, _ in pairs]
    fastest = max(one.speed for one, _ in pairs)
    carried = sum(not one.trouble for pair in pairs for one in pair)
    rows = [
        Row("tiring from 60 to 20 %: support once they are tired, from 40 %", _percent(tired), "", True),
        Row("tiring from 60 to 20 %: 30 s after their strength came back", _percent(back), "", True),
        Row("tiring from 60 to 20 %: fastest joint", f"{fastest:.2f} rad/s", f"{FASTEST} rad/s", fastest < FASTEST),
    ]
    for number, name in enumerate(("support that adapts", "fixed support")):
        sunk = np.degrees([pair[number].sunk for pair in pairs])
        shown = f"{np.median(sunk):.0f} degrees in the median, {sunk.max():.0f} at most"
        rows.append(Row(f"tiring from 60 to 20 %: furthest joint from the pose, {name}", shown, "", True))
    held = carried == 2 * len(pairs)
    rows.append(Row("tiring from 60 to 20 %: arms carried to the end", f"{carried} of {2 * len(pairs)}", "all", held))
    return rows


def _percent(shares: Sequence[float]) -> str:
    return f"{100.0 * np.mean(shares):.0f} %, {100.0 * min(shares):.0f} to {100.0 * max(shares):.0f}"
