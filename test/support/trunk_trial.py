# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An offline trial of an arm on a trunk that moves, with little friction: device, controller, IMU and estimator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from exo_gravity.core import ArmModel
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.trial.from_file import trunk_imu
from exo_gravity.lab.trial.offline import ArmSetup, OfflineTrial
from exo_gravity.lab.trial.recording import Recording
from exo_gravity.sim import ArmConfig, ImuConfig
from exo_gravity.sim.script import TrialScript

from .simulated_device import joints_of, make_device

FRICTION = 0.03  # Nm in each joint
POSE = (0.0, 0.4, 0.5, 1.0)  # rad
LENGTH = (0.05, 0.13, 0.30, 0.30)
ROBOT = ArmModel(LENGTH, (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))  # of config/exo.yaml
TRUE = ArmModel(LENGTH, (0.045, 0.115, 0.235, 0.13), (0.60, 0.46, 0.61, 0.198))  # of config/sim.yaml
MOUNTING = (0.0, 0.0, 0.5**0.5, 0.5**0.5)
RATE = 250.0  # Hz, that of exo.yaml
JOINTS = ("rotation", "abduction", "flexion", "elbow")


def trunk_trial(*steps: dict[str, Any], seed: int = 0, **settings: Any) -> OfflineTrial:
    """Return a trial: the arm is brought to POSE and let go, and 1 s later `steps` begin."""
    rated = (3.0, 9.0, 3.0, 3.0)
    limits = Limits(
        JOINTS,
        (-1.65, -0.17, -0.78, -0.17),
        (1.65, 3.14, 2.53, 3.14),
        (5.0, 5.0, 5.0, 6.0),
        rated,
        sign_check_torque=0.0,
    )
    device = make_device(config=ArmConfig(TRUE, coulomb_friction=(FRICTION,) * 4))
    trunk = trunk_imu(ImuConfig(MOUNTING, seed=seed), MOUNTING, RATE)
    script = TrialScript.parse({"name": "trunk", "steps": [{"move": list(POSE), "over": 2.0}, {"hold": 1.0}, *steps]})
    setup = ArmSetup("right", device, joints_of((MIT,) * 4), limits, Settings("right", ROBOT, **settings), RATE, trunk)
    return OfflineTrial(setup, script, 3.0)


def moved(recording: Recording, steps: Sequence[str]) -> float:
    """Return by how many degrees a joint moved at most while the `steps` (actions) lasted, from their start."""
    spans = [step for step in recording.steps if step.action in steps]
    during = (recording.time >= spans[0].start) & (recording.time <= spans[-1].end)
    position = np.degrees(recording.position[during])
    return float(np.abs(position - position[0]).max())
