# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A device with known errors: what a slow tour of it would measure, and tours of simulated arms in virtual time."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.joint_motor import JointMotor, motors_of
from exo_gravity.core.numbers import NO_TORQUE, Vector
from exo_gravity.core.safety.command import State
from exo_gravity.core.safety.limits import CAN_BRIDGE, Limits, limits_of
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.lab.calibration.identification import next_pose
from exo_gravity.lab.calibration.moment_model import MomentModel
from exo_gravity.lab.calibration.tour import (
    Itinerary,
    Tour,
    TourController,
    calibrator_table,
    line_of,
    side_of,
    tour_of,
)
from exo_gravity.lab.calibration.tours import LiveTour
from exo_gravity.lab.calibration.tracking import Observation, Station
from exo_gravity.lab.inputs.arms import node_values
from exo_gravity.lab.inputs.parameter_file import load, text_of
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.params import device_of, simulator_table
from exo_gravity.sim.virtual_arm import VirtualArm

from .active_wearer import attach
from .simulated_device import joints_of

LENGTH = (0.05, 0.13, 0.30, 0.30)
TYPICAL_MOMENTS = (0.08, 0.15, 0.2, 0.026, 0.0, 0.0, 0.0, 0.0)  # kg m, of a robot arm with the motors of this package
PAPERS = MomentModel(ArmModel.from_moments(LENGTH, TYPICAL_MOMENTS[:4]), True)
LEANING = Tilt.of("right", 0.30, 0.25).direction  # the stand, so that joint 1 carries something
UPRIGHT = (0.0, 0.0, 1.0)
Direction = tuple[float, float, float]
Weight = tuple[float, float]
NO_WEIGHT: Weight = (0.0, 0.0)
WEIGHT: Weight = (1.0, 0.25)  # kg, m from the elbow
CODE = 30.0 / 4095.0  # Nm, one step of an AK60-6's 12-bit torque
SAMPLES = 50  # of the effort in each direction
CANDIDATES = np.radians(
    list(itertools.product((-60, -30, 0, 30, 60), (10, 40, 70, 100, 130), (-30, 0, 30, 60, 90), (0, 30, 60, 90, 120)))
)
NAMES = ("rotation", "abduction", "flexion", "elbow")
MOTORS_AS_MOUNTED = joints_of((MIT,) * 4)
LONGEST = 420.0  # s of a tour
SINKING = 5.0  # s until an arm hangs


def off_axis_of(mass: Vector, cog_y: Vector, cog_z: Vector) -> Vector:
    """Return (W, Z, Y3, Y4) in kg m; the centres of gravity lie off the links, by (4,) m along y_n and z_n."""
    return mass[0] * cog_z[0] + mass[1] * cog_y[1], np.dot(mass[1:], cog_z[1:]), mass[2] * cog_y[2], mass[3] * cog_y[3]


class Device:
    """An arm whose masses, centres of gravity, torque scales, friction and offsets are drawn at random."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        mass = np.array((0.60, 0.46, 0.61, 0.20)) * rng.uniform(0.7, 1.3, 4)
        cog = np.minimum(np.array((0.045, 0.115, 0.235, 0.13)) * rng.uniform(0.7, 1.3, 4), LENGTH)
        off_axis = off_axis_of(mass, *rng.uniform(-0.015, 0.015, (2, 4)))
        self.moments = ArmModel(LENGTH, cog, mass, off_axis=off_axis).moments
        self.scale = rng.uniform(0.7, 1.3, 4)
        self.friction = rng.uniform(0.1, 0.4, 4)
        self.offset = rng.normal(0.0, 0.02, 4)

    def effort(self, theta: Vector, direction: Vector, added: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the commands (n, 4) in Nm that hold the arm without friction."""
        return (
            PAPERS.rows(np.atleast_2d(theta), np.asarray(direction)) @ (self.moments + added) / self.scale + self.offset
        )

    def observe(self, theta: Vector, direction: Vector = LEANING, weight: Weight = NO_WEIGHT) -> Observation:
        """Pass the pose in both directions: current noise of 2 %, 12 bits."""
        effort = self.effort(theta, direction, PAPERS.load(*weight))[0]
        mean, spread = [], []
        for way in (1.0, -1.0):
            one_way = effort + way * self.friction / self.scale
            noise = self.rng.normal(size=(SAMPLES, 4)) * (0.02 * np.abs(one_way) + 0.01)
            codes = np.round((one_way + noise) / CODE) * CODE
            mean.append(codes.mean(axis=0))
            spread.append(codes.std(axis=0, ddof=1) / np.sqrt(SAMPLES))
        half = (mean[0] - mean[1]) / 2.0
        return Observation(theta, direction, (mean[0] + mean[1]) / 2.0, half, np.hypot(*spread) / 2.0, *weight)

    def tour(self, direction: Direction = LEANING, bare: int = 8, weighed: int = 4) -> list[Observation]:
        """Observe the best `bare` poses without, and the best `weighed` with the weight."""
        return [
            *(self.observe(theta, direction) for theta in best(direction, bare)),
            *(self.observe(theta, direction, WEIGHT) for theta in best(direction, weighed, WEIGHT)),
        ]


@cache
def best(direction: Direction, count: int, weight: Weight = NO_WEIGHT) -> tuple[tuple[float, ...], ...]:
    """Return the `count` best poses; with a weight on the arm, without any before."""
    moments = np.array(TYPICAL_MOMENTS) + PAPERS.load(*weight)
    taken: list[tuple[float, ...]] = []
    while len(taken) < count:
        taken.append(tuple(CANDIDATES[next_pose(taken, CANDIDATES, direction, moments, PAPERS)]))
    return tuple(taken)


@dataclass
class Player:
    """Plays `tour` on `device`.

    motors, limits, rate: as the bridge assumes them. tilt: as the IMU measures it.
    on_carried: called once the bridge carries the arm.

    safety: the bridge's, once played. log: rows of s, true angles (4,) in rad, true speeds (4,) in rad/s, and the
    efforts (4,) in Nm that answer them, in each cycle in which the tour moves the arm.
    """

    tour: Tour
    device: SimulatedDevice
    motors: Sequence[JointMotor]
    limits: Limits
    rate: float
    tilt: Tilt
    on_carried: Callable[[], object] = lambda: None
    log: list[tuple[float, ...]] = field(default_factory=list)

    def play(self) -> SafetyMachine:
        """Play until the motors are off; return the bridge's safety machine."""
        controller = TourController(self.tour, self.limits, self.tilt, lambda: self.safety.state is State.ACTIVE)
        arm = VirtualArm(self.device, controller, self.motors, self.limits, self.rate)
        self.safety = arm.safety
        arm.enable()
        arm.run_until(lambda: self._is_over(arm.now, controller.efforts(arm.now).effort), LONGEST)
        arm.check_controller()
        return self.safety

    def _is_over(self, now: float, effort: Sequence[float] | None) -> bool:
        if self.safety.state is State.ACTIVE and effort and not self.tour.done:
            if not self.log:
                self.on_carried()
            self.log.append((now, *self.device.arm.positions, *self.device.arm.velocities, *effort))
        if self.tour.done:
            self.safety.disable(now)
        return self.safety.state in (State.DISABLED, State.FAULT)


def player_of(nodes: Mapping[str, Any], path: Path, namespace: str = "/right") -> Player:
    """Return what plays the tour that `nodes`, each with its parameters, describe; `path`: where to write them."""
    path.write_text(text_of(nodes), encoding="utf-8")
    content, calibrator, simulator = load(path), f"{namespace}/calibrator", f"{namespace}/simulator"
    values = node_values(content, calibrator, calibrator_table(content[calibrator]))
    bridge = node_values(content, f"{namespace}/can_bridge", CAN_BRIDGE)
    device = device_of(node_values(content, simulator, simulator_table(content[simulator])))
    device.advance(SINKING)
    seen = Tilt.of(side_of(values), device.pitch, device.roll)
    return Player(tour_of(values), device, motors_of(bridge), limits_of(bridge), bridge["rate"], seen)


def run_tour(options: argparse.Namespace, nodes: Mapping[str, Any], say: object, stopping: object = None) -> LiveTour:
    """Take the place of `lab.calibration.tours.run_tour`, without nodes."""
    player = player_of(nodes, options.output.with_suffix(".nodes.yaml"))
    fault, tour = player.play().fault, player.tour
    with options.record.open("a", encoding="utf-8") as file:
        file.writelines(f"{line_of(one)}\n" for one in tour.measured)
    trouble = tour.trouble or ("" if tour.done else fault.reason if fault else "the tour did not end")
    return LiveTour(list(tour.measured), trouble, tour.done)


Disturb = Callable[[float, SimulatedDevice], Sequence[float] | None]


@dataclass
class TourRun:
    """A tour of the paper's arm.

    truth: the device's arm; assumed: the file's. motors: the true ones; the controller assumes MOTORS_AS_MOUNTED.
    disturb(time, device): called each physics step from the first carried one; may set faults, and returns torques.
    """

    truth: ArmConfig = field(default_factory=ArmConfig)
    assumed: ArmModel = DEFAULT_LINKS
    motors: Sequence[JointMotor] = MOTORS_AS_MOUNTED
    limits: Limits = field(default_factory=lambda: Limits(NAMES, sign_check_torque=0.0))
    tilt: tuple[float, float] = (0.1, -0.06)
    rate: float = 100.0
    load: Weight = NO_WEIGHT
    disturb: Disturb | None = None

    def run(self, itinerary: Itinerary | None = None) -> Tour:
        """Run a tour of twelve best poses, or another one, until the motors are off; return it."""
        device = SimulatedDevice(SimulatedArm(self.truth), [SimulatedMotor(motor) for motor in self.motors])
        device.pitch, device.roll = self.tilt
        tilt = Tilt.of("right", *self.tilt)
        model, chosen = MomentModel(self.assumed, True), itinerary or Itinerary(self.limits, 12)
        tour = Tour(self.limits, model, chosen, self.rate, self.load)
        player = Player(tour, device, MOTORS_AS_MOUNTED, self.limits, self.rate, tilt, self._disturb)
        self.device, self.log = device, player.log
        self.safety = player.play()
        self.fastest = float(np.abs(np.array(player.log)[:, 5:9]).max())
        return tour

    def _disturb(self) -> None:
        if disturb := self.disturb:
            attach(self.device, lambda time, *_: disturb(time, self.device) or NO_TORQUE)


def fixed(stations: Sequence[Station]) -> Itinerary:
    """Return the itinerary of `stations` alone."""
    return Itinerary(Limits(NAMES), 0, stations)
