# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One device and its wearer through one trial, and how far what is estimated is from what the muscles did.

The trial has three parts: they lift what the device does not, then rest in full support, then tire from 60 to 20 %
while the support rises as much. Their trunk stands, bows and walks meanwhile. The observer gets what was recorded
through CAN frames and their 12 bits, and an IMU, once every 10 ms.
"""

import bisect
import itertools
import math
import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.paper import ArmModel
from exo_gravity.core.arm.tilt import Tilt, gravity_in_trunk, turning_in_base
from exo_gravity.core.compensation.compensator import Compensation, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import NO_TORQUE, Torque
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.observer import Share, WearerCurve, observed, shares_of
from exo_gravity.lab.trial.offline import ArmSetup, OfflineTrial
from exo_gravity.sim import STEP, SimulatedImu, VirtualWearer
from exo_gravity.sim.device import path_between
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.trunk_motion import ImuConfig, TrunkState
from exo_gravity.sim.virtual_arm import TrunkReading

from .devices import ARM, Worn, draw, turned

RATE = 100.0  # Hz, of the control loop and the IMU
DELAY = 2.0  # s until the wearer begins
SUPPORT = (0.4, 1.0, (0.4, 0.8))  # while the wearer lifts, rests and tires
LOW, HIGH = (-0.5, 0.3, 0.1, 0.3), (0.7, 1.2, 1.0, 1.4)  # rad, of the poses
TRUNK: tuple[dict[str, Any], ...] = (
    {"hold": 13.0}, {"bow": 0.4, "over": 1.2}, {"hold": 3.0}, {"bow": 0.0, "over": 1.2}, {"hold": 8.0}, {"walk": 8.0},
    {"hold": 9.6},
)  # fmt: skip
TILT_NOISE = math.radians(0.6)  # of the filter, as hardware/trunk_estimator.py has it; it stays for about
TILT_TIME = 3.0  # s
KINDS = ("reach", "hold", "rest", "trunk in motion")
STIFFNESS, DAMPING, INTEGRAL = (15.0, 25.0, 20.0, 8.0), (1.0, 2.0, 1.5, 0.5), (15.0, 25.0, 20.0, 8.0)
MUSCLE_DELAY = 0.05  # s from command to muscle
ACTIVATION = 0.04  # s, time constant
NOISE = 0.03  # of the torque,
NOISE_TIME = 0.05  # s, low-passed
STRENGTH = 30.0  # Nm


class Phase(NamedTuple):
    """A pose that is reached in `move` s and held for `hold` s.

    lifted: the shares of their arm that the wearer lifts at the start and the end. rests: they let go while it is held.
    """

    pose: tuple[float, ...]
    move: float
    hold: float
    lifted: tuple[float, float]
    rests: bool = False


class Muscles(VirtualWearer):
    """Goes through `phases`, whatever the trunk's `script` does meanwhile.

    Their torque is the sum of an impedance about the path that they mean to follow, which muscles and reflexes give at
    once, and of what they command: a share of their arm's weight, plus a slow correction. Commands come MUSCLE_DELAY
    late and through ACTIVATION, with noise in proportion to the torque (signal-dependent noise, Harris and Wolpert
    1998).

    arm: the wearer's own. tilt: called for the trunk's true tilt. log: s, torque (4,) Nm and weight (4,) Nm at every
    step.
    """

    def __init__(
        self, script: TrialScript, phases: Sequence[Phase], arm: ArmModel, tilt: Callable[[], Tilt], seed: int
    ) -> None:
        super().__init__(script, STRENGTH)
        self.phases, self._arm, self._tilt = phases, arm, tilt
        self.log: list[tuple[float, Torque, Torque]] = []
        self._random = random.Random(seed)
        self._late: deque[list[float]] = deque([[0.0] * 4] * round(MUSCLE_DELAY / STEP))
        self._active, self._noise, self._sum = [0.0] * 4, [0.0] * 4, [0.0] * 4
        self._from: Sequence[float] = NO_TORQUE
        self._index, self._end = -1, sum(phase.move + phase.hold for phase in phases)

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (4,) in Nm."""
        super().torque(elapsed, theta, velocity)  # follows the script's steps
        if elapsed < 0.0:
            self._from = tuple(theta)
        if not 0.0 <= elapsed < self._end:
            return NO_TORQUE
        index, since = phase_at(self.phases, elapsed)
        if index != self._index:
            self._from = self.phases[self._index].pose if index else self._from
            if index and self.phases[self._index].rests:
                self._from = tuple(theta)
            self._index = index
        phase = self.phases[index]
        held = min(1.0, max(0.0, since - phase.move - 0.3) / 0.5) if phase.rests else 0.0  # lets go
        lifted = phase.lifted[0] + (phase.lifted[1] - phase.lifted[0]) * min(1.0, since / (phase.move + phase.hold))
        weight = self._arm.torque(theta, self._tilt())
        path = path_between(self._from, phase.pose, since, phase.move)
        wanted, given = [], []
        for n, (position, speed) in enumerate(path):
            error = position - theta[n]
            total = (1.0 - held) * (self._sum[n] + INTEGRAL[n] * error * STEP)
            self._sum[n] = max(-STRENGTH, min(STRENGTH, total))
            wanted.append((1.0 - held) * (lifted * weight[n] + self._sum[n]))
            at_once = (1.0 - held) * STIFFNESS[n] * error
            self._active[n] += STEP / ACTIVATION * (self._late[0][n] - self._active[n])
            step = STEP / NOISE_TIME
            self._noise[n] += -step * self._noise[n] + math.sqrt(2.0 * step) * self._random.gauss(0.0, 1.0)
            whole = at_once + self._active[n] * (1.0 + NOISE * self._noise[n])
            yielding = (1.0 - held) * DAMPING[n] * (speed - velocity[n])  # also beyond their strength
            given.append(max(-STRENGTH, min(STRENGTH, whole)) + yielding)
        self._late.popleft()
        self._late.append(wanted)
        self.log.append((elapsed, tuple(given), weight))
        return tuple(given)


def phase_at(phases: Sequence[Phase], elapsed: float) -> tuple[int, float]:
    """Return the index of the phase at `elapsed` s, the last one after the end, and the time since it began."""
    ends = list(itertools.accumulate(phase.move + phase.hold for phase in phases))
    index = min(bisect.bisect_right(ends, elapsed), len(phases) - 1)
    return index, elapsed - (ends[index - 1] if index else 0.0)


class Trial(NamedTuple):
    """What one trial showed, at n times.

    error: Nm, estimate minus truth, and its standard deviation, (n, 4) each. kind: (n,) index in KINDS. share,
    true_share: over the trial. parts: of lifting, resting and tiring alike: (found, true). trouble: '' if the arm was
    carried to the end.
    """

    error: np.ndarray
    deviation: np.ndarray
    kind: np.ndarray
    share: Share
    true_share: float
    parts: tuple[tuple[Share, float], ...]
    trouble: str


class Therapist(Compensator):
    """A compensator whose support follows the parts of the trial."""

    def __init__(self, settings: Settings, times: Sequence[float]) -> None:
        self.own = replace(settings, support=SUPPORT[0])
        super().__init__(self.own)
        self._times, self._next = times, 0.0

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Compensation:
        """Return the answer that the bridge gets."""
        if now >= self._next:
            self._next = now + 2.0
            rests, tires, ends = self._times
            low, high = SUPPORT[2]
            risen = low + (high - low) * min(1.0, (now - tires) / (ends - tires))
            support = SUPPORT[0] if now < rests else SUPPORT[1] if now < tires else risen
            self.apply(replace(self.own, support=support))
        return super().step(now, theta, velocity)


class WornImu:
    """The IMU of a trunk: mounted a little wrong, its filter a little off; the accelerometer has noise and bias."""

    def __init__(self, worn: Worn) -> None:
        self._imu = SimulatedImu(ImuConfig(rate=RATE, seed=worn.seed))
        self._rng = np.random.default_rng(worn.seed)
        # Of gravity in the trunk's axes; `mounting` is in the base frame.
        x, y, z = worn.mounting
        self._mounting, self._drift = np.array((y, x, z)), np.zeros(3)
        self.log: list[tuple[float, ...]] = []  # s, angular velocity in rad/s, felt gravity in g, gravity

    def __call__(self, now: float, state: TrunkState) -> TrunkReading:
        """Return the reading."""
        share = 1.0 / (RATE * TILT_TIME)
        self._drift += -share * self._drift + math.sqrt(2.0 * share) * TILT_NOISE * self._rng.standard_normal(3)
        rate, force = map(np.asarray, self._imu.sample(state))
        force = np.linalg.norm(force) * turned(force / np.linalg.norm(force), self._mounting)
        gravity = turned(gravity_in_trunk(state.pitch, state.roll), self._mounting + self._drift)
        self.log.append((now, *rate, *(-force / STANDARD_GRAVITY), *gravity))
        return TrunkReading(gravity.tolist(), force.tolist(), rate.tolist())


def phases_of(seed: int) -> tuple[Phase, ...]:
    """Return the wearer's way: three poses while they lift, two while they rest, three while they tire."""
    rng = np.random.default_rng(seed)
    poses = [tuple(rng.uniform(LOW, HIGH).tolist()) for _ in range(8)]
    lifts = [Phase(pose, 1.5, 3.0, (1.0 - SUPPORT[0],) * 2) for pose in poses[:3]]
    rests = [Phase(pose, 2.0, 5.0, (0.0, 0.0), rests=True) for pose in poses[3:5]]
    share = np.linspace(0.6, 0.2, 4).tolist()
    tires = [Phase(pose, 1.5, 4.0, (share[n], share[n + 1])) for n, pose in enumerate(poses[5:])]
    return (*lifts, *rests, *tires)


def play(worn: Worn) -> Trial:
    """Play the trial of `worn`, and return what the estimates make of it, and how far they are off."""
    phases, device, imu = phases_of(worn.seed), worn.device(), WornImu(worn)
    ends = np.cumsum([phase.move + phase.hold for phase in phases])
    script = TrialScript.parse({"name": "wearer", "steps": list(TRUNK)})

    def tilt() -> Tilt:
        return Tilt.of(worn.side, device.trunk.pitch, device.trunk.roll)

    wearer = Muscles(script, phases, worn.wearer, tilt, worn.seed)
    limits = Limits(
        ARM.joint_names, max_effort=worn.settings.max_effort, max_velocity=(20.0,) * 4, sign_check_torque=0.0
    )
    compensator = Therapist(worn.settings, [DELAY + ends[2], DELAY + ends[4], DELAY + ends[7]])
    setup = ArmSetup(worn.side, device, worn.motors, limits, compensator.own, RATE, imu)
    trial = OfflineTrial(setup, script, DELAY, compensator, wearer)
    recording = trial.run()
    # Every 1 ms from the wearer's start: s, and Nm of their muscles, and that carry their arm.
    elapsed, torque, weight = (np.array(column) for column in zip(*wearer.log, strict=True))
    trunk = np.array(imu.log)

    def trunk_at(now: float) -> tuple[Tilt, tuple[float, float, float], Tilt]:
        row = trunk[np.searchsorted(trunk[:, 0], now - 0.5 / RATE) - 1, 1:].tolist()  # one cycle late
        felt, gravity = Tilt.of_felt(worn.side, row[3:6]), Tilt.of_gravity(worn.side, row[6:])
        return felt, turning_in_base(worn.side, row[:3]), gravity

    joints = (recording.position, recording.velocity, recording.effort)
    whole = observed(worn.settings, recording.time, joints, trunk_at)
    since = recording.time - recording.steps[0].start
    keep = (since > 1.0) & (since < ends[-1])
    curve, since = only(whole, keep), since[keep]
    index = np.searchsorted(elapsed, since).clip(max=len(elapsed) - 1)
    exact = np.zeros_like(curve.torque)
    truth = WearerCurve(curve.time, torque[index], exact, weight[index], exact)
    at = [phase_at(phases, now) for now in since.tolist()]
    kind = np.array([_kind(phases[n], passed) for n, passed in at])
    kind[_trunk_moves(since)] = KINDS.index("trunk in motion")
    part = np.searchsorted((3, 5), [n for n, _ in at], side="right")
    parts = tuple(
        (shares_of(only(curve, part == n)).whole, float(shares_of(only(truth, part == n)).whole.value))
        for n in range(3)
    )
    true_share = float(shares_of(truth).whole.value)
    error = curve.torque - truth.torque
    return Trial(error, curve.deviation, kind, shares_of(curve).whole, true_share, parts, trial.trouble)


def _kind(phase: Phase, since: float) -> int:
    if since < phase.move + 0.3:
        return KINDS.index("reach")
    if not phase.rests:
        return KINDS.index("hold")
    return KINDS.index("rest" if since > phase.move + 1.2 else "reach")


def _trunk_moves(elapsed: np.ndarray) -> np.ndarray:
    """Return whether the trunk moves at each time (n,) s, or moved within the last 0.3 s."""
    ends = np.cumsum([next(iter(step.values())) if "over" not in step else step["over"] for step in TRUNK])
    moving = np.array(["hold" not in step for step in (*TRUNK, {"hold": 1.0})])
    return (
        moving[np.searchsorted(ends, elapsed, side="right")]
        | moving[np.searchsorted(ends, elapsed - 0.3, side="right")]
    )


def only(curve: WearerCurve, keep: np.ndarray) -> WearerCurve:
    """Return the part of a curve where `keep` (n,) is true."""
    return WearerCurve(*(part[keep] for part in curve))


def judged(seed: int) -> Trial | str:
    """Play and judge one wearer; return the sentence that says why there was no calibration."""
    try:
        return play(draw(seed))
    except (DataError, RuntimeError) as error:
        return str(error)
