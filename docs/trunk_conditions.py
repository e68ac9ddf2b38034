# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Prints what the benefit of `inertial` depends on: the figures at the end of docs/imu.md.

`python docs/trunk_conditions.py` takes about ten minutes and does not need ROS.
"""

from __future__ import annotations

import math
from dataclasses import replace
from unittest.mock import patch

import numpy as np
from trunk_motion import LAWS, LOW, MOUNTING, POSES, USUAL, Law, simulate

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.sim import ImuConfig
from exo_gravity.sim.trunk_motion import TrunkState, Walk

INERTIAL, DEFAULT = LAWS[:2]
IMU = ImuConfig(MOUNTING)
WALK = {"walk": 15.0}
PLACES = {"0.15 m to the side of the shoulder": (0.0, -0.15, 0.0), "on the back": (-0.12, 0.2, -0.1)}  # m
VIBRATIONS = (8.0, 15.0, 25.0)  # Hz
VIBRATION = 0.1 * STANDARD_GRAVITY  # m/s^2, vertical


def walked(law: Law, imu: ImuConfig = IMU, friction: tuple[float, ...] = LOW) -> str:
    """Return how far the arm moves while its wearer walks."""
    return simulate(law, WALK, POSES[0], friction, imu).text


def shaken(law: Law, frequency: float, friction: tuple[float, ...]) -> str:
    """Return how far the arm moves if the trunk of a walking wearer also vibrates at `frequency` in Hz."""
    steady = Walk.at

    def at(walk: Walk, elapsed: float) -> TrunkState:
        state = steady(walk, elapsed)
        share = min(1.0, elapsed, max(0.0, walk.duration - elapsed))
        x, y, z = state.acceleration
        z += share * VIBRATION * math.sin(2.0 * math.pi * frequency * elapsed)
        return state._replace(acceleration=(x, y, z))

    with patch.object(Walk, "at", at):
        return walked(law, friction=friction)


def show(what: str, *results: str) -> None:
    """Print a line."""
    print(f"{what}: {'; '.join(results)}", flush=True)


def main() -> None:
    """Simulate and print all conditions; degrees where no unit is given."""
    show("without inertial; with it", walked(DEFAULT), walked(INERTIAL))
    show("IMU at 250 Hz; 50 Hz", *(walked(INERTIAL, replace(IMU, rate=rate)) for rate in (250.0, 50.0)))
    show("delay of 10 ms", walked(INERTIAL, replace(IMU, delay=0.010)))
    noise = {name: 10.0 * getattr(IMU, name) for name in ("gyroscope_noise", "accelerometer_noise")}
    show("ten times the noise", walked(INERTIAL, replace(IMU, **noise)))
    for name, place in PLACES.items():
        placed = INERTIAL._replace(settings={"inertial": True, "shoulder_from_imu": tuple(-x for x in place)})
        imu = replace(IMU, position=place)
        show(f"IMU {name}, taken to be at joint 1; with its place", walked(INERTIAL, imu), walked(placed, imu))
    for friction in (LOW, USUAL):
        for law in (INERTIAL, DEFAULT):
            results = (shaken(law, frequency, friction) for frequency in VIBRATIONS)
            show(f"{law.name}, vibrations, friction {friction[0]:g} Nm", *results)
    for seed in range(1, 5):
        imu = replace(IMU, seed=seed)
        rest = (simulate(law, {"hold": 20.0}, POSES[0], LOW, imu).text for law in (DEFAULT, INERTIAL))
        walk = simulate(INERTIAL, {"walk": 30.0}, POSES[0], LOW, imu).text
        show(f"biases {seed}: at rest for 20 s, without inertial; with it; walking 30 s, with it", *rest, walk)
    for law in (INERTIAL, DEFAULT):
        noise_of = np.std(simulate(law, {"hold": 5.0}, POSES[0], USUAL).command, axis=0)
        show(f"{law.name}, standard deviation of the commanded torque at rest in Nm", str(noise_of.round(4)))


if __name__ == "__main__":
    main()
