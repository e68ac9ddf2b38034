# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.elastic [--devices 10]: laws for an arm with elastic joints, known and learned.

The paper proposes learned laws where links or joints give way. Random upright arms in MuJoCo, each with joints of one
stiffness, are held in HOLDS random poses: what a laboratory measures in two hours. The torque is that with which
MuJoCo's links rest behind the motors; the encoders show the motors, and a measured torque has noise. Judged in HELD_OUT
other poses of the same box, and with the trunk bowed by BOW, which no learned law has seen.

- rigid: the exact law, of moments that are known to within MOMENT_ERROR;
- deflection: the same, with the deflection of joints whose stiffness is known to within STIFFNESS_ERROR;
- ANFIS: the package's, of as many functions as the holds determine; bowed, the compensator uses the rigid law;
- each of the first two, and a Gaussian process on what it leaves of the measured torques, joint by joint.

Errors in mNm, over joints 2 to 4. Cover: share of held-out torques within twice the Gaussian process's own standard
deviation, which should be 95 %.
"""

from __future__ import annotations

import math
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.arm_data import STANDARD_GRAVITY
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.numbers import COVER, Vector
from exo_gravity.lab.anfis_training import Samples, train_law
from exo_gravity.sim import ArmConfig, SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS

from .calibration.device import SPREAD
from .device_study import options_of
from .parts import play
from .resting import resting_torque

HOLDS, HELD_OUT, BOWED = 120, 300, 100
LOW, HIGH = np.array((0.0, 0.0, -0.3, 0.0)), np.array((0.0, 1.6, 1.5, 1.6))  # rad; the ANFIS has no joint 1
NOISE = 0.02  # Nm, of a held torque: friction on both sides of it, averaged
MOMENT_ERROR, STIFFNESS_ERROR = 0.005, 0.1  # shares
WORN = {"wearer_mass": (0.0, 0.0, 2.0, 1.5), "wearer_cog": (0.0, 0.0, 0.16, 0.18)}
BOW = math.radians(15.0)
FUNCTIONS, RIDGE = 2, 1e-2  # of the ANFIS: 3 functions have 108 consequents, too many for as many holds
ANGLES = (-math.pi,) * 4, (math.pi,) * 4
LAWS = ("rigid", "deflection", "ANFIS", "rigid + GP", "deflection + GP")


class Joint(NamedTuple):
    """What every joint of a device is like."""

    stiffness: float  #: Nm/rad
    play: float = 0.0  #: rad


JOINTS = {
    "150 Nm/rad": Joint(150.0),
    "500 Nm/rad": Joint(500.0),
    "1,000 Nm/rad": Joint(1000.0),
    "500 Nm/rad, play 1 degree": Joint(500.0, math.radians(1.0)),
}


class Judged(NamedTuple):
    """Errors of a law: root mean square and largest in held-out poses, and root mean square bowed, in Nm."""

    rms: float
    largest: float
    bowed: float


class Outcome(NamedTuple):
    """One device."""

    seed: int
    joints: str
    laws: dict[str, Judged]
    cover: dict[str, tuple[float, float]]  #: of each Gaussian process, upright and bowed


class Device:
    """An elastic arm drawn at random."""

    def __init__(self, seed: int, joint: Joint) -> None:
        self.rng = rng = np.random.default_rng(seed)
        nominal, low, high = DEFAULT_LINKS, 1.0 - SPREAD, 1.0 + SPREAD
        mass = nominal.mass * rng.uniform(low, high, len(nominal.mass))
        cog = np.minimum(nominal.cog * rng.uniform(low, high, len(nominal.mass)), nominal.length)
        links = ArmModel(nominal.length, cog, mass)
        own = {"joint_stiffness": (joint.stiffness,) * len(mass), "backlash": (joint.play,) * len(mass)}
        stops = dict(zip(("position_min", "position_max"), ANGLES, strict=True))
        self.arm = SimulatedArm(ArmConfig(links, **own, **stops, **WORN))
        wrong = mass * (1.0 + MOMENT_ERROR * rng.standard_normal(len(mass)))
        known = joint.stiffness * (1.0 + STIFFNESS_ERROR * rng.standard_normal(len(mass)))
        assumed = ArmModel(nominal.length, cog, wrong)
        worn: dict[str, Any] = {"mode": "zero_g", "support": 1.0, "max_effort": (18.0,) * len(mass), **WORN}
        self.rigid = Settings("right", assumed, **worn)
        self.deflection = Settings("right", assumed, joint_stiffness=known.tolist(), **worn)

    def poses(self, count: int) -> np.ndarray:
        """Return `count` random angles of the motors (n, 4) in rad."""
        return self.rng.uniform(LOW, HIGH, (count, len(LOW)))

    def needed(self, poses: np.ndarray, tilt: Tilt) -> np.ndarray:
        """Return the torque (n, 3) in Nm that joints 2 to 4 carry behind motors at `poses` (n, 4) rad, by MuJoCo."""
        self.arm.move_base(np.multiply(STANDARD_GRAVITY, tilt.direction).tolist())
        return np.array([resting_torque(self.arm, motors)[1:] for motors in poses])


def by(settings: Settings) -> Callable[[np.ndarray, Tilt], np.ndarray]:
    """Return the law of the settings for motors at (n, 4) rad: (n, 3) Nm of joints 2 to 4."""
    return lambda poses, tilt: np.array([settings.torque(pose, tilt)[0][1:] for pose in poses.tolist()])


def outcome(part: tuple[int, str]) -> Outcome:
    """Return how each law holds the device of a seed."""
    seed, name = part
    device, upright, bowed = Device(seed, JOINTS[name]), Tilt.of("right"), Tilt.of("right", BOW)
    holds, held_out, bent = device.poses(HOLDS), device.poses(HELD_OUT), device.poses(BOWED)
    measured = device.needed(holds, upright)
    measured += NOISE * device.rng.standard_normal(measured.shape)
    true, true_bent = device.needed(held_out, upright), device.needed(bent, bowed)
    laws, cover = dict[str, Judged](), dict[str, tuple[float, float]]()

    def judge(law: str, errors: np.ndarray, errors_bent: np.ndarray) -> None:
        laws[law] = Judged(_rms(errors), float(np.abs(errors).max()), _rms(errors_bent))

    for law, settings in (("rigid", device.rigid), ("deflection", device.deflection)):
        own = by(settings)
        errors, errors_bent = own(held_out, upright) - true, own(bent, bowed) - true_bent
        judge(law, errors, errors_bent)
        mean, spread = _process(holds, measured - own(holds, upright), (held_out, bent))
        left = errors + mean[0], errors_bent + mean[1]
        judge(f"{law} + GP", *left)
        within = [float(np.mean(np.abs(off) <= COVER * std)) for off, std in zip(left, spread, strict=True)]
        cover[f"{law} + GP"] = (within[0], within[1])
    samples = Samples(holds[:, 1:], measured, held_out[:, 1:], true, LOW[1:], HIGH[1:], "holds of an elastic arm")
    anfis, _ = train_law(samples, device.rigid.arm, FUNCTIONS, RIDGE)  # type: ignore[arg-type]  # the paper's arm
    judge("ANFIS", anfis.torques(held_out[:, 1:]) - true, by(device.rigid)(bent, bowed) - true_bent)
    return Outcome(seed, name, laws, cover)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _process(
    holds: np.ndarray, residual: np.ndarray, asked: Sequence[np.ndarray]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return mean and standard deviation in Nm at each of `asked` (n, 4) rad of processes that learn `residual`."""
    means: list[list[np.ndarray]] = [[] for _ in asked]
    spreads: list[list[np.ndarray]] = [[] for _ in asked]
    for column in residual.T:
        size = float(np.std(column)) or 1.0
        noise = WhiteKernel((NOISE / size) ** 2, (1e-4, 10.0))
        kernel = ConstantKernel(1.0, (1e-3, 1e3)) * RBF(np.ones(3), (0.2, 20.0)) + noise
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a residual of noise alone has no length
            process = GaussianProcessRegressor(kernel, normalize_y=True).fit(holds[:, 1:], column)
        own = process.kernel_.k2.noise_level * process._y_train_std**2  # of the measurement, not of the torque
        for poses, mean, spread in zip(asked, means, spreads, strict=True):
            predicted, deviation = process.predict(poses[:, 1:], return_std=True)
            mean.append(predicted)
            spread.append(np.sqrt(np.maximum(deviation**2 - own, 0.0)))
    return list(map(np.column_stack, means)), list(map(np.column_stack, spreads))


def told(found: Outcome) -> str:
    """Return the line of one device."""
    return f"device {found.seed}, {found.joints}: " + ", ".join(
        f"{law} {1000.0 * found.laws[law].rms:.0f}" for law in LAWS
    )


def table(found: Sequence[Outcome]) -> str:
    """Return the medians over the devices, in Markdown."""
    lines = ["| joints | law | RMS, mNm | largest, mNm | bowed, RMS, mNm | cover, bowed |", "|---|---|---|---|---|---|"]
    for name in JOINTS:
        own = [one for one in found if one.joints == name]
        for law in LAWS:
            rms, largest, bowed = (_median([one.laws[law][n] for one in own]) for n in range(3))
            cover = [one.cover[law] for one in own if law in one.cover]
            shown = ", ".join(f"{share:.0%}" for share in np.mean(cover, axis=0)) if cover else ""
            lines.append(f"| {name} | {law} | {rms:.0f} | {largest:.0f} | {bowed:.0f} | {shown} |")
    return "\n".join(lines)


def _median(values: Vector) -> float:
    return float(1000.0 * np.median(values))


def main() -> int:
    """Run the study; return the exit code."""
    options = options_of("bench.elastic", "Laws for an arm with elastic joints.", Path("build/elastic"))
    found = play("elastic", outcome, [(seed, name) for name in JOINTS for seed in options.seeds], told)
    text = f"{table(found)}\n"
    print(text)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.with_suffix(".md").write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
