# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.calibration.effects [--devices 20]: what `calibrate` leaves of what the moments do not explain.

Random simulated devices in MuJoCo, with tours in virtual time as `calibrate scale` makes them: without a weight, the
stand leant back, and with one, leant forward. Half of the devices, at random, have cables across their joints; half
have motors that are weaker when warm; half have elastic joints, encoders whose zeros are off, axes askew. On warm
motors `calibrate gravity` follows, with `--earlier` the cold record.

Judged by the torque that holds MuJoCo's arm in 300 poses that no tour visited, on a trunk that leans: the largest
error of any joint, as a share of the largest torque, and the share of the poses within the 95 % band that
`model_error.torque` gives. The error of the scales is one of what a wearer adds: what holds the bare arm does not show
it. `before` is the same without springs and slopes in the identification, and without `joint_stiffness`, which is known
to 10 %. On elastic joints the poses are those of the motors, behind which the links rest.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

os.environ["OMP_NUM_THREADS"] = "1"

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.arm_data import STANDARD_GRAVITY
from exo_gravity.core.arm.joint_spring import JointSpring
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.tracking import Observation
from exo_gravity.core.errors import DataError
from exo_gravity.core.motors.ak import USUAL_MOTORS
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import SCALE_TEMPERATURE, JointMotor, scale_at
from exo_gravity.core.numbers import COVER
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.calibration import identification
from exo_gravity.lab.calibration.imu import mounting_turn
from exo_gravity.lab.calibration.moment_model import GRID, PapersMoments
from exo_gravity.lab.calibration.poses import Itinerary, guess_for
from exo_gravity.lab.calibration.result import CalibrationResult
from exo_gravity.lab.calibration.tour import DURATION, Tour
from exo_gravity.lab.calibration.tours import SCALE_POSES, moments_from
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS

from ..device_study import Row, as_markdown, options_of
from ..parts import play
from ..resting import resting_torque
from .device import COULOMB, LARGEST_OFFSET, SPREAD, VISCOUS
from .tour import Player, let_hang

RATE = 100.0  # Hz
WEIGHT = (1.0, 0.28)  # kg, m from the elbow
MAX_EFFORT = (4.5, 13.5, 4.5, 4.5)  # Nm, half as much again as rated: motors may be 30 % weaker, links 30 % heavier
COLD, WARM = 25.0, 50.0  # degC
WEAKER = 0.03  # share of its torque that a warm motor lacks at most
CABLES = 0.15  # Nm/rad at most
JOINTS = (600.0, 3000.0)  # Nm/rad
OFF = ASKEW = np.radians(1.5)  # rad, the largest error of a zero, and of the direction of an axis
# rad by which the stand leans back, and with the weight forward; and to the side. Joint 1 follows the lean: with more
# forward it hangs over 0.5 rad from home, where no start begins; with more to the side joint 2 over 0.34.
BACK_AND_FORTH, SIDEWAYS = (0.05, 0.09), (0.19, 0.22)
REST = (-0.3, 0.8)  # rad, where a cable is slack
STIFFNESS_ERROR = 0.1  # standard error of `joint_stiffness`, as a share of it
LOW, HIGH = np.radians([(angles[0], angles[-1]) for angles in GRID]).T  # rad, poses for which the band is stated
NEW_POSES = 300
LEAN = 0.15  # rad, standard deviation of the trunk's pitch and roll in these
MEDIAN, LARGE = 0.01, 0.025  # of peak: limits of the median and of the 95th percentile
WITHIN = 0.95  # share of the errors that the band should contain
ARM = configured_arm(packaged_config("sim.yaml"))
ASSUMED = tuple(JointMotor(MOTORS[kind], n) for n, kind in enumerate(USUAL_MOTORS, 1))


EFFECTS = ("cables", "warm motors", "elastic joints", "zeros off", "axes askew")
OF_GEOMETRY = EFFECTS[3:]
Z_99 = 2.58  # standard errors on either side of a 99 % interval


class Judged(NamedTuple):
    """How a result holds the arm in new poses."""

    error: float  #: the largest of any joint, as a share of the largest torque
    cover: np.ndarray  #: (4,), share of the poses in which each joint's error is within its band


class Outcome(NamedTuple):
    """One device. trouble: why its tours gave nothing, or ''; then there is no `before` and `after`."""

    seed: int
    effects: tuple[str, ...]
    trouble: str
    before: Judged | None = None
    after: Judged | None = None
    chosen: tuple[int, int] = (0, 0)  #: joints with springs, and with slopes, in the new file


class Device:
    """A device drawn at random. effects: those of EFFECTS that it has; drawn, too, unless they are given."""

    def __init__(self, seed: int, effects: Sequence[str] | None = None) -> None:
        self.rng = rng = np.random.default_rng(seed)
        low, high, count = 1.0 - SPREAD, 1.0 + SPREAD, len(ASSUMED)
        drawn = tuple(name for name in EFFECTS if rng.random() < 0.5)
        self.effects = drawn if effects is None else tuple(effects)
        size = {name: float(name in self.effects) for name in EFFECTS}
        nominal = DEFAULT_LINKS
        mass = nominal.mass * rng.uniform(low, high, count)
        cog = np.minimum(nominal.cog * rng.uniform(low, high, count), nominal.length)
        beside = rng.uniform(-LARGEST_OFFSET, LARGEST_OFFSET, (2, count))
        stiffness = size["elastic joints"] * np.exp(rng.uniform(math.log(JOINTS[0]), math.log(JOINTS[1]), count))
        self.mechanics = {
            "links": ArmModel(nominal.length, cog, mass), "cog_y": beside[0], "cog_z": beside[1],
            "coulomb_friction": rng.uniform(*COULOMB, count), "viscous_friction": rng.uniform(*VISCOUS, count),
            "spring_rest": rng.uniform(*REST, count),
            "spring_stiffness": size["cables"] * rng.uniform(0.0, CABLES, count),
            "joint_stiffness": stiffness,
        }  # fmt: skip
        weaker = size["warm motors"] * rng.uniform(0.0, WEAKER, count)
        self.zero = size["zeros off"] * rng.uniform(-OFF, OFF, count)  # rad
        scales = rng.uniform(low, high, count).tolist()
        slope, zero = (-weaker / (WARM - COLD)).tolist(), self.zero.tolist()
        self.motors = [
            replace(motor, zero=zero[n], torque_scale=scales[n], scale_slope=slope[n])
            for n, motor in enumerate(ASSUMED)
        ]
        way, far = rng.uniform(0.0, 2.0 * np.pi, count), size["axes askew"] * rng.uniform(0.0, ASKEW, count)
        self.turn = np.column_stack((far * np.cos(way), far * np.sin(way)))  # rad, about x and y of each joint
        (back, ahead), sideways = rng.uniform(*BACK_AND_FORTH, 2).tolist(), rng.uniform(*SIDEWAYS, 2).tolist()
        self.stand, self.leant = (-back, sideways[0]), (ahead, sideways[1])
        self.measured = stiffness * (1.0 + STIFFNESS_ERROR * rng.standard_normal(count))  # Nm/rad

    def arm(self, **worn: Any) -> SimulatedArm:
        """Return the arm, with its axes askew."""
        arm = SimulatedArm(ArmConfig(**self.mechanics, **worn))
        for joint, turn in enumerate(self.turn):
            body = arm.model.body_quat[arm.model.jnt_bodyid[joint]]
            askew = Rotation.from_rotvec((*turn, 0.0)).as_quat(scalar_first=True)
            mujoco.mju_mulQuat(body, body.copy(), askew)
        mujoco.mj_setConst(arm.model, arm.data)
        arm.reset(np.zeros(len(self.turn)))
        return arm

    def tours(
        self, poses: int, temperature: float, loaded: bool, earlier: Sequence[Observation] = ()
    ) -> list[Observation]:
        """Return what tours show of the arm with motors at `temperature` degC.

        loaded: also one with the weight. earlier: what others have shown.
        """
        found = self._tour(poses, temperature, (0.0, 0.0), self.stand, earlier)
        return found + self._tour(poses, temperature, WEIGHT, self.leant, found) if loaded else found

    def _tour(
        self, poses: int, temperature: float, load: tuple[float, float], stand: tuple[float, float],
        earlier: Sequence[Observation],
    ) -> list[Observation]:  # fmt: skip
        mass, lever = load
        worn: dict[str, Any] = {"wearer_mass": (0.0, 0.0, 0.0, mass), "wearer_cog": (0.0, 0.0, 0.0, lever)}
        device = SimulatedDevice(self.arm(**worn), [SimulatedMotor(motor) for motor in self.motors])
        for motor in device.motors:
            motor.temperature = motor.ambient = temperature
        device.pitch, device.roll = stand
        let_hang(device)
        limits = Limits(ARM.joint_names, max_effort=MAX_EFFORT, sign_check_torque=0.0)
        tilt = Tilt.of(device.side, *stand)
        guess = guess_for(PapersMoments(DEFAULT_LINKS, keeps_tilt=True), tilt, load, earlier)
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
        error, true = self.errors(result, temperature, joints)
        found, given = result.identified, {change.name: change.value for change in result.changes}
        assert found is not None
        cover = (np.abs(error) <= COVER * np.array(given["model_error.torque"])).mean(axis=0)
        springs, slopes = np.count_nonzero(found.stiffness), np.count_nonzero(found.slope)
        return Judged(float(np.abs(error).max() / np.abs(true).max()), cover), (int(springs), int(slopes))

    def errors(
        self, result: CalibrationResult, temperature: float, joints: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return error and truth, both (NEW_POSES, n) Nm, of what holds the arm by the file of a result."""
        assert result.identified is not None
        given: dict[str, Any] = {change.name: change.value for change in result.changes}
        none = [0.0] * len(ASSUMED)
        spring = JointSpring(given.get("joint_spring.stiffness", none), given.get("joint_spring.rest", none))
        slope = given.get("torque_scale_slope", none)
        robot = ArmModel.from_moments(DEFAULT_LINKS.length, given["robot.first_moment"], given["robot.off_axis"])
        settings = Settings("right", robot, joint_spring=spring, joint_stiffness=joints.tolist())
        at = given.get("torque_scale_temperature", [SCALE_TEMPERATURE] * len(ASSUMED))
        assumed = [scale_at(*motor, temperature) for motor in zip(given["torque_scale"], slope, at, strict=True)]
        strength = np.divide([motor.scale_at(temperature) for motor in self.motors], assumed)
        device, random, bridge = self.arm(), np.random.default_rng(1000), ARM.can_bridge
        poses = random.uniform(LOW, HIGH, (NEW_POSES, len(ASSUMED)))
        shown = poses + self.zero - np.multiply(bridge["direction"], np.subtract(given["zero"], bridge["zero"]))
        mounting = Rotation.from_rotvec(mounting_turn(result.identified)[2])
        needed = resting_torque if device.config.elastic else _needed
        wanted, true = np.empty_like(poses), np.empty_like(poses)
        for number, lean in enumerate(random.normal(0.0, LEAN, (NEW_POSES, 2)).tolist()):
            tilt = Tilt.of("right", *lean)
            device.move_base(np.multiply(STANDARD_GRAVITY, tilt.direction).tolist())
            wanted[number] = settings.torque(shown[number].tolist(), _seen(tilt, mounting))[0]
            true[number] = needed(device, poses[number])
        return wanted * strength - true, true


def _needed(device: SimulatedArm, theta: np.ndarray) -> np.ndarray:
    """Return the torque (4,) in Nm that holds MuJoCo's rigid arm."""
    device.reset(theta)
    return np.asarray(device.data.qfrc_bias - device.data.qfrc_passive)


def _seen(tilt: Tilt, mounting: Rotation) -> Tilt:
    """Return the tilt of a trunk as an IMU shows it whose `mounting` was corrected by what was found."""
    across, forward, down = mounting.apply(tilt.direction)
    return Tilt.of_gravity("right", (forward, -across, -down))


def outcome(seed: int) -> Outcome:
    """Return what is left on the device of a seed."""
    device = Device(seed)
    temperature, warm = COLD, []
    try:
        cold = device.tours(SCALE_POSES, COLD, loaded=True)
        if "warm motors" in device.effects:
            temperature, warm = WARM, device.tours(SCALE_POSES, WARM, loaded=False, earlier=cold)
        with patch.object(identification, "possible_extras", lambda rows: ()):
            before, _ = device.judged(cold, temperature, np.zeros(len(ASSUMED)))
        return Outcome(seed, device.effects, "", before, *device.judged(cold + warm, temperature, device.measured))
    except (RuntimeError, DataError) as error:
        return Outcome(seed, device.effects, str(error))


def told(found: Outcome) -> str:
    """Return the line of one device."""
    head = f"device {found.seed}, {', '.join(found.effects) or 'no effect'}"
    if found.before is None or found.after is None:
        return f"{head}: {found.trouble}"
    left = f"{found.before.error:.2%} before, {found.after.error:.2%} after"
    cover = " ".join(f"{share:.2f}" for share in found.after.cover)
    return f"{head}: {left}, covered {cover}; {found.chosen[0]} springs, {found.chosen[1]} slopes"


def rows_of(found: list[Outcome]) -> list[Row]:
    """Return the table: error of peak (median, 95th percentile, worst) and cover of each joint."""
    refused = sum(one.after is None for one in found)
    rows = [Row("devices that could not be calibrated", str(refused), "0", not refused)]
    groups = {"all devices": found}
    for name in EFFECTS:
        groups[name] = [one for one in found if name in one.effects]
    groups["neither zeros off nor axes askew"] = [one for one in found if not set(OF_GEOMETRY) & set(one.effects)]
    for name, own in groups.items():
        for when, judged in (("before", [one.before for one in own]), ("after", [one.after for one in own])):
            kept = [one for one in judged if one is not None]
            if len(kept) < 2:
                continue
            error = np.array([one.error for one in kept])
            large = float(np.quantile(error, 0.95))
            shown = f"{np.median(error):.2%}, {large:.2%}, {error.max():.2%}; covered {_cover(kept)}"
            held = when == "before" or bool(np.median(error) <= MEDIAN and large <= LARGE and _is_covered(kept))
            limit = "" if when == "before" else f"{MEDIAN:.0%}, {LARGE:.1%}; {WITHIN:g} in each interval"
            what = f"{name} ({len(kept)}), {when}: error of peak (median, 95 %, worst)"
            rows.append(Row(what, shown, limit, held))
    return rows


def _cover(judged: list[Judged]) -> str:
    """Return the cover of each joint with its 99 % interval; the poses of a device count as one."""
    return " ".join(f"{share:.3f}+-{width:.3f}" for share, width in zip(*_interval(judged), strict=True))


def _is_covered(judged: list[Judged]) -> bool:
    """Return whether the intervals of all joints contain what the band should contain."""
    mean, wide = _interval(judged)
    return bool(np.all(np.abs(mean - WITHIN) <= wide))


def _interval(judged: list[Judged]) -> tuple[np.ndarray, np.ndarray]:
    """Return the cover of each joint (4,), and half the width of its 99 % interval (4,)."""
    cover = np.array([one.cover for one in judged])
    return cover.mean(axis=0), Z_99 * cover.std(axis=0, ddof=1) / np.sqrt(len(cover))


def main() -> int:
    """Run the study; return the exit code."""
    description = "What calibrate leaves of effects that the moments do not explain."
    options = options_of("bench.calibration.effects", description, Path("build/calibration_effects"))
    rows = rows_of(play("calibration_effects", outcome, options.seeds, told))
    text = f"{as_markdown(rows)}\n"
    print(text)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.with_suffix(".md").write_text(text, encoding="utf-8")
    return 0 if all(row.held for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
