# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A tour of `calibrate` without nodes: the tour carries the simulated device in virtual time.

`run_tour` takes the place of `lab.calibration.live.run_tour`, and reads the same parameters.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.motors.joint_motor import JointMotor, motors_of
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import CAN_BRIDGE, Limits, limits_of
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.lab.calibration.live import LiveTour
from exo_gravity.lab.calibration.record import line_of
from exo_gravity.lab.calibration.tour import Tour, TourController, calibrator_table, side_of, tour_of
from exo_gravity.lab.inputs.arms import node_values
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.lab.inputs.ros_yaml import text_of
from exo_gravity.sim import SimulatedDevice
from exo_gravity.sim.imu import SimulatedImu, measured_tilt
from exo_gravity.sim.params import device_of, imu_of, simulator_table
from exo_gravity.sim.virtual_arm import VirtualArm

LONGEST = 420.0  # s
SINKING = 5.0  # s


@dataclass
class Player:
    """Plays `tour` on `device`.

    motors, limits, rate: as the bridge assumes them.
    tilt: as the IMU measures it.
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
    content, node = load(path), f"{namespace}/calibrator"
    values = node_values(content, node, calibrator_table(content[node]))
    bridge = node_values(content, f"{namespace}/can_bridge", CAN_BRIDGE)
    simulated = f"{namespace}/simulator"
    simulator = node_values(content, simulated, simulator_table(content[simulated]))
    device = device_of(simulator)
    let_hang(device)
    tilt = (device.pitch, device.roll)
    if values["use_imu"]:
        imu = SimulatedImu(imu_of(simulator))
        tilt = measured_tilt(*tilt, imu, content["/imu"]["rotation_trunk_from_imu"])
    seen = Tilt.of(side_of(values), *tilt)
    return Player(tour_of(values), device, motors_of(bridge), limits_of(bridge), bridge["rate"], seen)


def let_hang(device: SimulatedDevice) -> None:
    """Let the arm sink to where it hangs; the clock of the device goes on."""
    device.advance(SINKING)


def run_tour(players: list[Player], prepare: Callable[[Player], None] = lambda player: None) -> Callable[..., LiveTour]:
    """Return a function that takes the place of `live.run_tour` and appends to `players`, after `prepare(player)`."""

    def run(options: argparse.Namespace, nodes: Mapping[str, Any], say: object, stopping: object = None) -> LiveTour:
        player = player_of(nodes, options.output.with_suffix(f".nodes{len(players)}.yaml"))
        players.append(player)
        prepare(player)
        fault, tour = player.play().fault, player.tour
        with options.record.open("a", encoding="utf-8") as file:
            file.writelines(f"{line_of(one)}\n" for one in tour.measured)
        trouble = tour.trouble or ("" if tour.done else fault.reason if fault else "the tour did not end")
        return LiveTour(list(tour.measured), trouble, tour.done)

    return run


def speed_quantiles(players: list[Player]) -> tuple[float, float]:
    """Return the 99.9th percentile and the largest of the fastest joint's true speeds in the tours, in rad/s."""
    speeds = np.concatenate([np.abs(np.array(player.log)[:, 5:9]).max(axis=1) for player in players])
    return float(np.quantile(speeds, 0.999)), float(speeds.max())
