# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.calibration.effects [--devices 20]: what `calibrate` leaves of cables, warm motors, elastic joints.

Random simulated devices in MuJoCo, with tours in virtual time as `calibrate scale` makes them: without and with a
weight, the stand leant otherwise. Each device is played without any effect, with cables, with motors that are 3 %
weaker when warm, and with elastic joints. On warm motors `calibrate gravity` follows, with `--earlier` the cold record.

Judged by the torque that holds MuJoCo's arm in 300 poses that no tour visited: the largest error of any joint, as a
share of the largest torque, and the share of the poses within the 95 % band that `model_error` gives. `before`
is the same without springs and slopes in the identification, and without `joint_stiffness`, which is known to 10 %.
On elastic joints the poses are those of the motors, behind which the links rest.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import moments_of
from exo_gravity.core.arm.joint_spring import JointSpring
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.tracking import Observation
from exo_gravity.core.motors.ak import USUAL_MOTORS
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import SCALE_TEMPERATURE, JointMotor, scale_at
from exo_gravity.core.numbers import COVER
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.calibration import identification
from exo_gravity.lab.calibration.moment_model import PapersMoments
from exo_gravity.lab.calibration.poses import Itinerary, TorqueGuess
from exo_gravity.lab.calibration.tour import DURATION, Tour
from exo_gravity.lab.calibration.tours import SCALE_POSES, moments_from
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.moments import load_moments
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS

from ..device_study import Row, as_markdown, options_of
from ..parts import play
from ..resting import resting_torque
from .device import COULOMB, LARGEST_OFFSET, LEANT, SPREAD, STAND, VISCOUS
from .tour import Player, let_hang

RATE = 250.0  # Hz
WEIGHT = (1.0, 0.28)  # kg, m from the elbow
COLD, WARM = 25.0, 50.0  # degC
WEAKER = 0.03  # share of its torque that a warm motor lacks
CABLES = 0.15  # Nm/rad
REST = (-0.3, 0.8)  # rad, where a cable is slack
STIFFNESS_ERROR = 0.1  # standard error of `joint_stiffness`, as a share of it
POSES = np.array((-0.8, 0.3, -0.2, 0.2)), np.array((0.8, 1.3, 1.2, 1.4))  # rad
NEW_POSES = 300
MEDIAN, LARGE = 0.01, 0.025  # of peak: limits of the median and of the 95th percentile
ARM = configured_arm(packaged_config("sim.yaml"))
ASSUMED = tuple(JointMotor(MOTORS[kind], n) for n, kind in enumerate(USUAL_MOTORS, 1))


class Effect(NamedTuple):
    """What the moments do not explain."""

    stiffness: float = 0.0  #: Nm/rad of the cables across each joint
    slope: float = 0.0  #: 1/K of the torque scales
    joints: float = 0.0  #: Nm/rad of each joint; 0: rigid


EFFECTS = {
    "none": Effect(),
    f"cables {CABLES:g} Nm/rad": Effect(stiffness=CABLES),
    f"motors {WEAKER:.0%} weaker when warm": Effect(slope=-WEAKER / (WARM - COLD)),
    "joints of 1,000 Nm/rad": Effect(joints=1000.0),
}


class Judged(NamedTuple):
    """How a result holds the arm in new poses."""

    error: float  #: the largest of any joint, as a share of the largest torque
    cover: np.ndarray  #: (4,), share of the poses in which each joint's error is within its band


class Outcome(NamedTuple):
    """One device with one effect."""

    seed: int
    effect: str
    before: Judged
    after: Judged
    chosen: tuple[int, int]  #: joints with springs, and with slopes, in the new file


class Device:
    """A device drawn at random, with an effect."""

    def __init__(self, seed: int, effect: Effect) -> None:
        self.rng = rng = np.random.default_rng(seed)
        low, high, count = 1.0 - SPREAD, 1.0 + SPREAD, len(ASSUMED)
        nominal = DEFAULT_LINKS
        mass = nominal.mass * rng.uniform(low, high, count)
        cog = np.minimum(nominal.cog * rng.uniform(low, high, count), nominal.length)
        beside = rng.uniform(-LARGEST_OFFSET, LARGEST_OFFSET, (2, count))
        self.mechanics = {
            "links": ArmModel(nominal.length, cog, mass), "cog_y": beside[0], "cog_z": beside[1],
            "coulomb_friction": rng.uniform(*COULOMB, count), "viscous_friction": rng.uniform(*VISCOUS, count),
            "spring_rest": rng.uniform(*REST, count), "spring_stiffness": (effect.stiffness,) * count,
            "joint_stiffness": (effect.joints,) * count,
        }  # fmt: skip
        scales = rng.uniform(low, high, count).tolist()
        self.motors = [
            JointMotor(motor.spec, motor.can_id, torque_scale=scale, scale_slope=effect.slope)
            for motor, scale in zip(ASSUMED, scales, strict=True)
        ]
        pitch = float(rng.uniform(*STAND[0]))
        self.stand = pitch, float(rng.uniform(*STAND[1]))
        self.leant = pitch - float(np.copysign(rng.uniform(*LEANT), pitch)), float(rng.uniform(*STAND[1]))
        self.measured = effect.joints * (1.0 + STIFFNESS_ERROR * rng.standard_normal(count))  # Nm/rad

    def tours(self, poses: int, temperature: float, loaded: bool) -> list[Observation]:
        """Return what a tour shows of the arm with motors at `temperature` degC; loaded: and one with the weight."""
        found = self._tour(poses, temperature, (0.0, 0.0), self.stand)
        return found + self._tour(poses, temperature, WEIGHT, self.leant) if loaded else found

    def _tour(
        self, poses: int, temperature: float, load: tuple[float, float], stand: tuple[float, float]
    ) -> list[Observation]:
        mass, lever = load
        worn: dict[str, Any] = {"wearer_mass": (0.0, 0.0, 0.0, mass), "wearer_cog": (0.0, 0.0, 0.0, lever)}
        arm = SimulatedArm(ArmConfig(**self.mechanics, **worn))
        device = SimulatedDevice(arm, [SimulatedMotor(motor) for motor in self.motors])
        for motor in device.motors:
            motor.temperature = motor.ambient = temperature
        device.pitch, device.roll = stand
        let_hang(device)
        limits, tilt = Limits(ARM.joint_names, sign_check_torque=0.0), Tilt.of(device.side, *stand)
        expected = moments_of(DEFAULT_LINKS) + load_moments(DEFAULT_LINKS.length.tolist(), mass, lever)
        guess = TorqueGuess(PapersMoments(DEFAULT_LINKS), expected, tilt)
        tour = Tour(limits, guess, Itinerary(limits, poses, DURATION), RATE, load)
        fault = Player(tour, device, ASSUMED, limits, RATE, tilt).play().fault
        if not tour.done:
            raise RuntimeError(tour.trouble or (fault.reason if fault else "the tour did not end"))
        return tour.measured

    def judged(
        self, observations: list[Observation], temperature: float, joints: np.ndarray
    ) -> tuple[Judged, tuple[int, int]]:
        """Return how the file that these give holds the arm with motors at `temperature` degC, and what it has.

        joints: (n,) Nm/rad, the file's `joint_stiffness`.
        """
        result = moments_from(replace(ARM, compensator={**ARM.compensator, "joint_stiffness": joints}), observations)
        given: dict[str, Any] = {change.name: change.value for change in result.changes}
        none = [0.0] * len(ASSUMED)
        spring = JointSpring(given.get("joint_spring.stiffness", none), given.get("joint_spring.rest", none))
        slope = given.get("torque_scale_slope", none)
        robot = ArmModel.from_moments(DEFAULT_LINKS.length, given["robot.first_moment"], given["robot.off_axis"])
        settings = Settings("right", robot, joint_spring=spring, joint_stiffness=joints.tolist())
        upright = Tilt.of("right")
        at = given.get("torque_scale_temperature", [SCALE_TEMPERATURE] * len(ASSUMED))
        assumed = [scale_at(*motor, temperature) for motor in zip(given["torque_scale"], slope, at, strict=True)]
        strength = np.divide([motor.scale_at(temperature) for motor in self.motors], assumed)
        device = SimulatedArm(ArmConfig(**self.mechanics))
        poses = np.random.default_rng(1000).uniform(*POSES, (NEW_POSES, len(ASSUMED)))
        wanted = np.array([settings.torque(theta, upright)[0] for theta in poses.tolist()])
        needed = resting_torque if device.config.elastic else _needed
        true = np.array([needed(device, theta) for theta in poses])
        error = np.abs(wanted * strength - true)
        band = COVER * np.hypot(given["model_error.torque"], wanted * given["model_error.scale"])
        judged = Judged(float(error.max() / np.abs(true).max()), (error <= band).mean(axis=0))
        return judged, (int(np.count_nonzero(spring.stiffness)), int(np.count_nonzero(slope)))


def _needed(device: SimulatedArm, theta: np.ndarray) -> np.ndarray:
    """Return the torque (4,) in Nm that holds MuJoCo's rigid arm on an upright trunk."""
    device.reset(theta)
    return np.asarray(device.data.qfrc_bias - device.data.qfrc_passive)


def outcome(part: tuple[int, str]) -> Outcome:
    """Return what is left of an effect on the device of a seed."""
    seed, name = part
    effect = EFFECTS[name]
    device = Device(seed, effect)
    cold = device.tours(SCALE_POSES, COLD, loaded=True)
    temperature = WARM if effect.slope else COLD
    warm = device.tours(SCALE_POSES, WARM, loaded=False) if effect.slope else []
    with patch.object(identification, "possible_extras", lambda rows: ()):
        before, _ = device.judged(cold, temperature, np.zeros(len(ASSUMED)))
    return Outcome(seed, name, before, *device.judged(cold + warm, temperature, device.measured))


def told(found: Outcome) -> str:
    """Return the line of one device."""
    left = f"{found.before.error:.2%} before, {found.after.error:.2%} after"
    return f"device {found.seed}, {found.effect}: {left}, {found.chosen[0]} springs, {found.chosen[1]} slopes"


def rows_of(found: list[Outcome]) -> list[Row]:
    """Return the table: error of peak (median, 95th percentile, worst) and cover of each joint."""
    rows = []
    for name in EFFECTS:
        own = [one for one in found if one.effect == name]
        for when, judged in (("before", [one.before for one in own]), ("after", [one.after for one in own])):
            error = np.array([one.error for one in judged])
            cover = " ".join(f"{share:.2f}" for share in np.mean([one.cover for one in judged], axis=0))
            large = float(np.quantile(error, 0.95))
            shown = f"{np.median(error):.2%}, {large:.2%}, {error.max():.2%}; covered {cover}"
            held = when == "before" or bool(np.median(error) <= MEDIAN and large <= LARGE)
            limit = "" if when == "before" else f"{MEDIAN:.0%}, {LARGE:.1%}"
            rows.append(Row(f"{name}, {when}: error of peak (median, 95 %, worst)", shown, limit, held))
    return rows


def main() -> int:
    """Run the study; return the exit code."""
    description = "What calibrate leaves of cables, warm motors and elastic joints."
    options = options_of("bench.calibration.effects", description, Path("build/calibration_effects"))
    parts = [(seed, name) for name in EFFECTS for seed in options.seeds]
    rows = rows_of(play("calibration_effects", outcome, parts, told))
    text = f"{as_markdown(rows)}\n"
    print(text)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.with_suffix(".md").write_text(text, encoding="utf-8")
    return 0 if all(row.held for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
