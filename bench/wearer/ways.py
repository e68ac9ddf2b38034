# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.wearer.ways [--devices 40]: ways to find a wearer's passive arm, on the same wearers. 2 minutes.

F. Just et al., J. NeuroEng. Rehabil. 17:13, 2020, compare three on ARMin (their Table 1):

    Average       the body-mass table: 4 parameters, a centre of gravity with 1 degree of freedom, nothing measured
    Full          2 resting poses: 8 parameters, two masses with centres of gravity anywhere; no passive joint torque
    Equilibrium   1 resting pose: 2 parameters, forces at two fixed places; passive joint torque as far as it acts there

ARMin measures forces at the cuffs; this device, like the paper's, has only the joints' torques: Full takes the arm
nearest to the table's that explains them. Two more are this package's: two masses at the table's places from four
poses, which `calibrate wearer` was, and moments and springs, which it is.

A relaxed wearer at full support would carry the difference to what holds their true arm, by MuJoCo.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

from exo_gravity.core.arm.gravity import moments_of
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Tissue, Wearer
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import COVER, Vector
from exo_gravity.lab.calibration.pose_fit import columns
from exo_gravity.lab.moments import regressor
from exo_gravity.lab.observer.momentum import MomentumObserver
from exo_gravity.lab.observer.share import WearerCurve, share_of

from ..calibration.random_device import LENGTH, UPRIGHT
from ..device_study import options_of
from ..parts import play as part_by_part
from .devices import BREATHING, EFFECTS, Worn, draw, holding, simulated, turned

WAYS = ("Average", "Full", "Equilibrium", "two masses", "moments and springs")
BEFORE, NOW = 3, 4
LOW, HIGH = (-0.5, 0.3, 0.1, 0.3), (0.7, 1.2, 1.0, 1.4)  # rad, of the poses
POSES = 200
FULL_POSES, EQUILIBRIUM_POSE, BEFORE_POSES = (1, 2), 1, 4  # of the relaxed ones
CUFFS = 0.5  # of the links, where Equilibrium's forces act
TABLE = 0.5  # standard error of the table's masses and places, as a share, where Full's poses leave them open
BREATHED = 1e-3  # Nm: least spread

Way = Callable[[np.ndarray], np.ndarray]  # poses (p, 4) rad -> torque (p, 4) Nm of the wearer's passive arm


class Seen(NamedTuple):
    """What was seen of a wearer with one effect, for each of WAYS or for before and now."""

    left: np.ndarray  #: (5,) share of the arm's weight that is left to a relaxed wearer, RMS over poses
    covered: np.ndarray  #: (2, 4), share of poses in which the 95 % band of each joint contains no torque
    share_covered: np.ndarray  #: (2,), whether the band of the share contains 0
    band: np.ndarray  #: (2,), half the width of that band
    refused: bool  #: whether the calibration was


def segment_columns(theta: np.ndarray) -> np.ndarray:
    """Return the torque per mass and per first moment along x, y and z of links 3 and 4, (p, 4, 8)."""
    rows = regressor(theta, UPRIGHT)
    shoulder = LENGTH[0] * rows[..., 0] + LENGTH[1] * rows[..., 1]
    upper = [shoulder, rows[..., 2], rows[..., 6], rows[..., 5]]
    lower = [shoulder + LENGTH[2] * rows[..., 2], rows[..., 3], rows[..., 7], rows[..., 5]]
    return np.stack([*upper, *lower], axis=-1)


def ways_of(worn: Worn) -> list[Way]:
    """Return each of WAYS as it finds the wearer's arm."""
    load = Wearer(worn.calibrated.compensator["wearer.body_mass"]).on_links(LENGTH)
    theta, direction, effort, _ = columns(worn.relaxed)
    measured = effort - regressor(theta, direction) @ moments_of(worn.calibrated.robot)
    mass, cog = load.mass[2:], load.cog[2:]
    table = np.array((mass[0], mass[0] * cog[0], 0.0, 0.0, mass[1], mass[1] * cog[1], 0.0, 0.0))

    def by(parameters: np.ndarray) -> Way:
        return lambda poses: segment_columns(poses) @ parameters

    def solved(matrix: np.ndarray, poses: Sequence[int], start: np.ndarray, error: Vector) -> np.ndarray:
        """Return the parameters nearest to `start`, within their standard errors, that explain what poses show."""
        rows = (segment_columns(theta[list(poses)]) @ matrix).reshape(-1, matrix.shape[1]) / BREATHING
        wanted = measured[list(poses)].ravel() / BREATHING
        whole = np.vstack((rows, np.diag(1.0 / np.asarray(error))))
        return matrix @ np.linalg.lstsq(whole, np.concatenate((wanted, start / error)), rcond=None)[0]

    along, cuffs = np.zeros((8, 2)), np.zeros((8, 2))
    along[[0, 1], 0], along[[4, 5], 1] = (1.0, cog[0]), (1.0, cog[1])
    cuffs[[0, 1], 0], cuffs[[4, 5], 1] = (1.0, CUFFS * LENGTH[2]), (1.0, CUFFS * LENGTH[3])
    beside = TABLE * np.array((*table[:2], table[1], table[1], *table[4:6], table[5], table[5]))
    s = worn.settings
    wearer = s.worn(s.robot.massless(s.robot.gravity))

    def now(poses: np.ndarray) -> np.ndarray:
        upright = Tilt.of(worn.side)
        return np.array([np.add(wearer.torque(pose, upright), s.tissue.torque(pose)) for pose in poses.tolist()])

    return [
        by(table),
        by(solved(np.eye(8), FULL_POSES, table, beside)),
        by(solved(cuffs, [EQUILIBRIUM_POSE], np.zeros(2), (1e3, 1e3))),
        by(solved(along, range(BEFORE_POSES), np.zeros(2), (1e3, 1e3))),
        now,
    ]


def two_masses(worn: Worn) -> Settings:
    """Return the settings as `calibrate wearer` had them before it found moments and springs."""
    theta, direction, effort, spread = columns(worn.relaxed[:BEFORE_POSES])
    cog = np.array(Wearer(worn.calibrated.compensator["wearer.body_mass"]).on_links(LENGTH).cog)
    rows = regressor(theta, direction)
    per_mass = np.zeros((8, 2))
    per_mass[:3, 0] = LENGTH[0], LENGTH[1], cog[2]
    per_mass[:4, 1] = *LENGTH[:3], cog[3]
    weight = 1.0 / np.hypot(np.maximum(spread, BREATHED), BREATHING).ravel()
    matrix = (rows @ per_mass).reshape(-1, 2) * weight[:, None]
    extra = (effort - rows @ moments_of(worn.calibrated.robot)).ravel() * weight
    covariance = np.linalg.inv(matrix.T @ matrix)
    mass = covariance @ matrix.T @ extra
    remainder = extra - matrix @ mass
    covariance *= max(1.0, float(remainder @ remainder) / (remainder.size - 2))
    moments = (per_mass @ mass)[2:4]
    error = float((np.sqrt(np.diag(per_mass @ covariance @ per_mass.T))[2:4] / moments).max())
    known = replace(worn.settings.model_error, wearer=min(1.0, error), wearer_torque=(0.0,) * 4)
    return replace(
        worn.settings, wearer_mass=(0.0, 0.0, *np.maximum(mass, 0.0).tolist()), wearer_cog=cog.tolist(),
        wearer_first_moment=(), wearer_off_axis=(), tissue=Tissue(), model_error=known,
    )  # fmt: skip


def seen_of(worn: Worn) -> Seen:
    """Return what each way leaves of the wearer's arm, and what the bands before and now contain."""
    rng = np.random.default_rng(worn.seed)
    poses = rng.uniform(LOW, HIGH, (POSES, 4))
    arm, bare, passive = simulated(worn.config, worn.is_strapped)
    hold, own, free = (np.array([holding(one, pose, UPRIGHT) for pose in poses]) for one in (arm, bare, passive))
    weight = free - own
    left = [np.sqrt(np.sum((way(poses) - (hold - own)) ** 2) / np.sum(weight**2)) for way in ways_of(worn)]
    friction = np.array(worn.config.coulomb_friction) * rng.uniform(-1.0, 1.0, hold.shape)
    found = np.array([motor.torque_scale for motor in worn.motors])
    efforts = (hold + friction) / worn.scale * found  # as the replies say
    tilt = Tilt.of(worn.side)._replace(direction=tuple(turned(UPRIGHT, -worn.mounting).tolist()))
    covered, share_covered, bands = [], [], []
    for settings in (two_masses(worn), worn.settings):
        rows = [
            MomentumObserver(settings).update(0.0, (pose, (0.0,) * 4, effort), tilt)
            for pose, effort in zip(poses.tolist(), efforts.tolist(), strict=True)
        ]
        curve = WearerCurve(
            np.arange(len(rows), dtype=float), *(np.array(column) for column in zip(*rows, strict=True))
        )
        covered.append(np.mean(np.abs(curve.torque) <= COVER * curve.deviation, axis=0))
        share = share_of(curve)
        bands.append(COVER * float(share.deviation))
        share_covered.append(abs(float(share.value)) <= bands[-1])
    return Seen(np.array(left), np.array(covered), np.array(share_covered), np.array(bands), bool(worn.refusals))


def seen_by_effect(seed: int) -> list[Seen | None]:
    """Return what was seen of the wearer of `seed` with each of EFFECTS; None where no calibration came of it."""
    return [_seen_with(seed, effect) for effect in EFFECTS]


def _seen_with(seed: int, effect: str) -> Seen | None:
    try:
        return seen_of(draw(seed, effect))
    except DataError:
        return None


def told(seen: Sequence[Seen | None]) -> str:
    """Return the line of one device."""
    return " ".join(f"{one.left[NOW]:.1%}" if one else "refused" for one in seen)


def tables(found: Sequence[Sequence[Seen | None]]) -> str:
    """Return both tables of all devices, with a row for each effect."""
    count = len(found)
    lines = [
        f"Torque left to a relaxed wearer at support 1, % of the arm's weight: median, worst of {count}", "",
        f"| wearer | {' | '.join(WAYS)} |", f"|---{'|---' * len(WAYS)}|",
    ]  # fmt: skip
    others = ["", "| wearer | | torque covered, joints 1 to 4, % | share covered | half its band, points | refused |"]
    others.append("|---|---|---|---|---|---|")
    for effect, wearers in zip(EFFECTS, zip(*found, strict=True), strict=True):
        column = [seen for seen in wearers if seen]
        left = 100.0 * np.array([seen.left for seen in column])
        cells = [f"{np.median(way):.1f}, {way.max():.1f}" for way in left.T]
        lines.append(f"| {effect} | {' | '.join(cells)} |")
        for number, when in enumerate(("before", "now")):
            covered = 100.0 * np.mean([seen.covered[number] for seen in column], axis=0)
            inside = sum(bool(seen.share_covered[number]) for seen in column)
            band = 100.0 * np.median([seen.band[number] for seen in column])
            refused = str(sum(seen is None or seen.refused for seen in wearers)) if number else ""
            shown = " ".join(f"{value:.0f}" for value in covered)
            others.append(f"| {effect} | {when} | {shown} | {inside} of {len(column)} | {band:.0f} | {refused} |")
    return "\n".join([*lines, *others])


def main() -> int:
    """Run the study; print its tables, and write them."""
    options = options_of("bench.wearer.ways", "Ways to find a wearer's passive arm.", Path("build/ways"))
    found = part_by_part("ways", seen_by_effect, options.seeds, told)
    text = tables(found)
    print(text)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.with_suffix(".md").write_text(f"{text}\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
