"""A tour of `calibrate` without nodes: the tour, the bridge's safety machine and the device, cycle by cycle.

`run_tour` takes the place of `tools.calibration.live.run_tour`. It reads the same parameters, and torques and angles
pass through CAN frames with the motors of the file; only nothing is ever late.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from exo_gravity.core.arm.gravity import Torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.motors.joint_motor import JointMotor, motors_of
from exo_gravity.core.motors.specs import ENTER, EXIT
from exo_gravity.core.safety.drive import Drive, EffortCommand, State
from exo_gravity.core.safety.limits import CAN_BRIDGE, UNKNOWN, JointSample, Limits, limits_of
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.lab.calibration.live import LiveTour
from exo_gravity.lab.calibration.tour import CALIBRATOR, Tour, tour_of
from exo_gravity.lab.inputs.arms import node_values
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.sim import SimulatedDevice
from exo_gravity.sim.imu import SimulatedImu, measured_tilt
from exo_gravity.sim.params import SIMULATOR, device_of, imu_of

LONGEST = 420.0  # s
HANDS, SINKING = 1.0, 5.0  # Nm s/rad of the hands that let the arm hang, and s that it takes


@dataclass
class Player:
    """Plays `tour` on `device`; motors, limits: those of the parameter file. tilt: as the IMU measures it.

    speeds: rad/s, of the fastest joint in each cycle of the tour. acted: the bridge's limits that acted.
    """

    tour: Tour
    device: SimulatedDevice
    motors: tuple[JointMotor, ...]
    limits: Limits
    rate: float
    tilt: Tilt
    fault: str = ""
    speeds: list[float] = field(default_factory=list)
    _samples: list[JointSample] = field(default_factory=lambda: [UNKNOWN] * 4)
    _powered: bool = False

    def play(self) -> None:
        """Play until the motors are off."""
        safety = SafetyMachine(self.limits, 1.0 / self.rate, self.motors)
        safety.enable(0.0)
        effort: Torque | None = None
        answered, began = -math.inf, False
        for cycle in range(round(LONGEST * self.rate)):
            now = cycle / self.rate
            self._exchange(safety.step(now, tuple(self._samples), EffortCommand(effort, answered)), now)
            if not any(self.limits.is_silent(now, joint) for joint in self._samples):
                began = began or safety.state is State.ACTIVE
                effort = self._answer(now, began)
                answered = now
            if self.tour.done:
                safety.disable(now)
            if safety.state in (State.DISABLED, State.FAULT) and now > 1.0:
                break
            self.device.advance(1.0 / self.rate)
        self.fault = safety.fault.reason if safety.fault else ""

    def _answer(self, now: float, began: bool) -> Torque | None:
        position = [row.position for row in self._samples]
        if not began:
            return self.tour.wait(position, self.tilt)
        effort = self.tour.step(now, position, [row.velocity for row in self._samples], self.tilt)
        self.tour.plan()
        if effort is not None and not self.tour.done:
            self.speeds.append(max(map(abs, self.device.arm.velocities)))
        return effort

    def _exchange(self, drive: Drive, now: float) -> None:
        send = self.device.exchange
        for i, motor in enumerate(self.motors):
            if drive.powered and (drive.enter[i] or not self._powered):
                send(motor.can_id, motor.command(0.0, 0.0))
                send(motor.can_id, ENTER)
            reply = send(motor.can_id, motor.command(drive.effort[i], drive.damping[i]))
            if self._powered and not drive.powered:
                reply = send(motor.can_id, EXIT)
            if reply:
                self._samples[i] = JointSample(*motor.joint_reply(reply[1])[1:], now)
        self._powered = drive.powered


def player_of(nodes: Mapping[str, Any], path: Path, namespace: str = "/right") -> Player:
    """Return what plays the tour that `nodes`, the content of a parameter file, describe; `path`: where to write it."""
    path.write_text(yaml.safe_dump(dict(nodes), sort_keys=False), encoding="utf-8")
    content = load(path)
    values = node_values(content, f"{namespace}/calibrator", CALIBRATOR)
    bridge = node_values(content, f"{namespace}/can_bridge", CAN_BRIDGE)
    simulator = node_values(content, f"{namespace}/simulator", SIMULATOR)
    device = device_of(simulator)
    _let_hang(device)
    imu = SimulatedImu(imu_of(simulator))
    tilt = measured_tilt(device.pitch, device.roll, imu, content["/imu"]["rotation_trunk_from_imu"])
    side = values["side"]
    return Player(tour_of(values), device, motors_of(bridge), limits_of(bridge), bridge["rate"], Tilt.of(side, *tilt))


def _let_hang(device: SimulatedDevice) -> None:
    """Let the arm sink to where it hangs, as by hand; the clock of the device goes on."""
    damping = device.arm.model.dof_damping.copy()
    device.arm.model.dof_damping[:] = HANDS
    device.advance(SINKING)
    device.arm.model.dof_damping[:] = damping


def run_tour(players: list[Player], prepare: Callable[[Player], None] = lambda player: None) -> Callable[..., LiveTour]:
    """Return a function that takes the place of `live.run_tour` and appends to `players`, after `prepare(player)`."""

    def run(options: argparse.Namespace, nodes: Mapping[str, Any], say: object, stopping: object = None) -> LiveTour:
        player = player_of(nodes, options.output.with_suffix(f".nodes{len(players)}.yaml"))
        players.append(player)
        prepare(player)
        player.play()
        tour = player.tour
        trouble = tour.trouble or ("" if tour.done else player.fault or "the tour did not end")
        return LiveTour(list(tour.measured), trouble, tour.done)

    return run


def speed_quantiles(players: list[Player]) -> tuple[float, float]:
    """Return the 99.9th percentile and the largest of the joints' true speeds during the tours, in rad/s."""
    speeds = np.concatenate([player.speeds for player in players])
    return float(np.quantile(speeds, 0.999)), float(speeds.max())
