# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One device, all the way that a user goes: motors, imu, gravity, scale, and the arm let go before and after.

Each step is the command line of `calibrate`. What differs from a real arm: the person is `hand.Hand`, the nodes are
`tour.Player`, and the recording of the bow is synthetic.
"""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml

from exo_gravity.core.arm.gravity import gravity_torque
from exo_gravity.core.arm.tilt import rotation_matrix
from exo_gravity.lab.calibration import live, motors, tours
from exo_gravity.lab.calibration.identification import Identified
from exo_gravity.lab.calibration.live import LiveTour, Person
from exo_gravity.lab.calibration.result import CalibrationResult
from exo_gravity.lab.inputs.arms import ConfiguredArm, configured_arm, node_values
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.sim.params import SIMULATOR, device_of
from exo_gravity.tools import calibrate

from . import demo
from .device import SIMULATOR as SIMULATOR_NODE
from .device import Device
from .hand import Hand, hanging, write_bow
from .tour import Player, run_tour, speed_quantiles

JIG = (0.0, 90.0, 0.0, 90.0)  # deg
ZEROS = "--zeros", "0"  # of the jig: kept
MASS, LEVER = 1.0, (0.25, 0.30)  # kg, m
POSES = (np.array((-0.8, 0.3, -0.2, 0.2)), np.array((0.8, 1.3, 1.2, 1.4)))  # rad, of the poses of the last step
TRUNK = {"pitch": 0.1, "roll": -0.06}  # rad, of the wearer
NEW_POSES = 300  # in which the new file's torque is compared with the true one


@dataclass(frozen=True, eq=False)
class Result:
    """What the way of one device showed; lengths (8,) in the order of MOMENTS, (4,) by joint.

    hanging_error: deg, (4,), of the zero if the arm hangs. turns_told: whether a jump by turns of the rotor at power-up
    was refused, and nothing else. imu_error: deg, after the bow and at the end. moments, true_moments, error: kg m;
    error: one standard error. scale_ratio: found by true. held_out: Nm, (n, 4). peak: Nm, the largest torque of
    gravity. new_pose: Nm, largest error in poses not visited. poses, minutes: of `calibrate gravity`. speed: rad/s,
    99.9th percentile and maximum. creep: deg/min, before and after.
    """

    seed: int
    motors_right: tuple[bool, bool, bool]
    zero_error: np.ndarray
    hanging_error: np.ndarray
    turns_told: bool
    imu_error: tuple[float, float]
    moments: np.ndarray
    true_moments: np.ndarray
    error: np.ndarray
    scale_ratio: np.ndarray
    scale_error: np.ndarray
    held_out: np.ndarray
    peak: float
    new_pose: float
    poses: int
    minutes: float
    speed: tuple[float, float]
    creep: tuple[float, float]


class WayError(Exception):
    """A step of the way did not end with exit code 0."""


def go(device: Device, folder: Path, fewer_poses: int = 0) -> Result:
    """Return what the whole way of `device` shows; its files are written to `folder`.

    fewer_poses: than `calibrate` takes by default. Raises WayError.
    """
    rng = np.random.default_rng(1000 + device.seed)
    turns_told, hanging_error = _hanging(device, rng)
    _motors(device, folder, rng)
    bow = write_bow(folder / "bow", device.quaternion, rng)
    _calibrate("imu", folder, 1, "--bag", str(bow))
    players: list[Player] = []
    with _offline(players):
        _calibrate("gravity", folder, 2, *ZEROS, "--poses", str(12 - fewer_poses))
    tour = players[0].tour
    results: list[CalibrationResult] = []
    lever = rng.uniform(*LEVER)
    with _offline(players, device.leant), _noted(results):
        _calibrate("scale", folder, 3, *ZEROS, "--mass", f"{MASS:g}", "--lever", f"{lever:.4f}")
    old, new = configured_arm(folder / "2.yaml"), configured_arm(folder / "4.yaml")
    found = results[0].identified
    assert found is not None
    right = [new.can_bridge["can_id"] == device.can_id, new.can_bridge["direction"] == device.direction]
    zero_error = np.degrees(np.subtract(new.can_bridge["zero"], device.zero))
    creeps = (_creep(folder / "2.yaml"), _creep(folder / "4.yaml"))
    return Result(
        device.seed, (right[0], right[1], bool(np.abs(zero_error).max() < 0.2)), zero_error, hanging_error, turns_told,
        _imu_errors(device, folder), found.moments, device.moments, found.error, *_scales(device, new, found),
        found.held_out, _peak(device), _new_pose(device, old, new, rng), len(tour.measured), tour.elapsed / 60.0,
        speed_quantiles(players), creeps,
    )  # fmt: skip


def _calibrate(command: str, folder: Path, step: int, *more: str) -> None:
    """Run a command of `calibrate` from the file of `step` to the next one. Raises WayError."""
    params, output = folder / f"{step}.yaml", folder / f"{step + 1}.yaml"
    arguments = [command, "--params", str(params), "--output", str(output), *more]
    log = folder / f"{command}.txt"
    with log.open("w") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
        code = calibrate.main(arguments)
    if code:
        last = log.read_text(encoding="utf-8").splitlines()[-1]
        raise WayError(f"calibrate {command}: exit code {code}: {last}")


@contextlib.contextmanager
def _offline(players: list[Player], leant: Sequence[float] = ()) -> Iterator[None]:
    """Let tours run without nodes; leant: pitch and roll in rad of the stand while the weight hangs."""
    play = run_tour(players)

    def run(options: argparse.Namespace, nodes: Mapping[str, Any], *more: object) -> LiveTour:
        simulator = nodes[SIMULATOR_NODE]
        if leant and "wearer.mass" in simulator:
            simulator["trunk.pitch"], simulator["trunk.roll"] = leant
        return play(options, nodes, *more)

    with patch.object(live, "run_tour", run):
        yield


@contextlib.contextmanager
def _noted(results: list[CalibrationResult]) -> Iterator[None]:
    """Append the results of `calibrate scale` to `results`."""
    calibrate_scale = tours.calibrate_scale

    def noting(options: argparse.Namespace, arm: ConfiguredArm, say: Callable[[object], None]) -> CalibrationResult:
        results.append(calibrate_scale(options, arm, say))
        return results[-1]

    with patch.object(tours, "calibrate_scale", noting):
        yield


def _motors(device: Device, folder: Path, rng: np.random.Generator) -> None:
    """Calibrate the motors of the arm in a jig."""
    with _hand(device, rng, np.radians(JIG)) as hand, patch.object(Person, "wait", lambda _, *task: hand.wait(*task)):
        _calibrate("motors", folder, 0, "--pose", *(f"{angle:g}" for angle in JIG))


def _hanging(device: Device, rng: np.random.Generator) -> tuple[bool, np.ndarray]:
    """Calibrate the motors of the hanging arm, and switch the power off and on; return Result's figures."""
    arm = configured_arm(device.params)
    turns = rng.integers(-1, 2, 4)
    with _hand(device, rng, hanging(device.links)) as hand:
        hand.rotor_jump = [2.0 * math.pi / m.spec.gear_ratio * t for m, t in zip(arm.motors, turns, strict=True)]
        options = argparse.Namespace(params=device.params, wait=hand.wait, pose=(0.0,) * 4)
        found = motors.calibrate_motors(options, arm, lambda what: None)
    signed = turns * device.direction
    jumped = {name: f"{turn:+d} rotor turns" for name, turn in zip(arm.joint_names, signed, strict=True) if turn}
    names = [refusal.partition(":")[0] for refusal in found.refusals]
    is_named = names == list(jumped) and all(jumped[n] in r for n, r in zip(names, found.refusals, strict=True))
    zero = next(change.value for change in found.changes if change.name == "zero")
    return is_named, np.degrees(np.subtract(zero, device.zero))


def _hand(device: Device, rng: np.random.Generator, rest: np.ndarray) -> Hand:
    simulated = device_of(node_values(load(device.params), SIMULATOR_NODE, SIMULATOR))
    return Hand(simulated, configured_arm(device.params), rng, rest.tolist())


def _creep(params: Path) -> float:
    """Return the creep in deg/min of the arm of `params`, let go on a trunk that is tilted otherwise than the stand.

    Raises WayError if it did not come to that.
    """
    content = yaml.safe_load(params.read_text(encoding="utf-8"))
    content[SIMULATOR_NODE]["ros__parameters"]["trunk"] = TRUNK
    worn = params.with_suffix(".worn.yaml")
    worn.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    recordings = demo.held(worn)
    if not all(any(step.action == "hold" for step in recording.steps) for recording in recordings):
        raise WayError(f"{params.name}: the arm was not held in every pose")
    return demo.creep(recordings)


def _imu_errors(device: Device, folder: Path) -> tuple[float, float]:
    """Return the angle in degrees between the mounting and the true one, after the bow and after all."""
    true = rotation_matrix(device.quaternion.tolist())
    found = [rotation_matrix(load(folder / name)["/imu"]["rotation_trunk_from_imu"]) for name in ("2.yaml", "4.yaml")]
    bow, end = (math.degrees(math.acos(min(1.0, (float(np.trace(one @ true.T)) - 1.0) / 2.0))) for one in found)
    return bow, end


def _scales(device: Device, new: ConfiguredArm, found: Identified) -> tuple[np.ndarray, np.ndarray]:
    """Return the torque scales found as shares of the true ones, and their standard errors."""
    return np.divide(new.can_bridge["torque_scale"], device.scale), found.scale_error / found.scale


def _peak(device: Device) -> float:
    """Return the largest torque in Nm that gravity needs at any joint within the device's range."""
    rng = np.random.default_rng(0)
    poses = rng.uniform((-1.6, 0.0, -0.7, 0.0), (1.6, 1.9, 1.9, 2.0), (2000, 4))
    return float(np.abs(gravity_torque(device.links, poses)).max())


def _new_pose(device: Device, old: ConfiguredArm, new: ConfiguredArm, rng: np.random.Generator) -> float:
    """Return the largest torque error in Nm of the new file, in true Nm, in poses that were not visited."""
    poses = rng.uniform(*POSES, (NEW_POSES, 4))
    scales = np.divide(device.scale, new.can_bridge["torque_scale"])
    given = gravity_torque(new.robot, poses) * scales
    return float(np.abs(given - gravity_torque(device.links, poses)).max())
