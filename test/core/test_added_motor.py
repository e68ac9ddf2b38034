# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An arm carried with a motor, and with a term, that another distribution provides: test/support/our_lab.

    PYTHONPATH=test/support/our_lab python -m test.core.test_added_motor

It is a process of its own, because entry points are looked up once. Prints what came of it as JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import COMPENSATOR, Settings, compensator_table, settings_of
from exo_gravity.core.motors.families import others
from exo_gravity.core.motors.joint_motor import motors_of
from exo_gravity.core.params import installed, values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE, check_bridge, limits_of
from exo_gravity.sim.params import SIMULATOR, device_of
from exo_gravity.sim.rig import Rig

from ..support import ROOT


def carry(**given: Any) -> dict[str, Any]:
    """Carry the simulated arm that these parameters describe for a second, in virtual time, and let it down."""
    given |= {"can.interface": "virtual", "can.channel": "wire"}
    bridge = {"rate": 100.0, "sign_check_torque": 0.0, "max_effort": [3.0, 9.0, 3.0, 3.0]}
    values = values_of(CAN_BRIDGE, given | bridge)
    motors, limits = motors_of(values), limits_of(values)
    check_bridge(values["rate"], motors, limits)
    device = device_of(values_of(SIMULATOR, given))
    settings = Settings(device.side, device.arm.config.links, max_effort=bridge["max_effort"])
    arm = Rig(device, settings, motors, limits, values["rate"])
    arm.carry()
    return {
        "on": [motor.entered for motor in device.motors],
        "off": arm.let_down(),
        "ignored": dict(arm.bus.ignored),
        "home_tolerance": limits.home_tolerance,
        "peak": [motor.peak_effort for motor in motors],
        "rotors": list(device.arm.config.rotor_inertia),
        "most": list(limits.max_command),
        "simulated": [type(motor).__name__ for motor in device.motors],
    }


def push(**given: Any) -> tuple[list[str], list[float]]:
    """Return the terms of a compensator with these parameters, and by how many Nm it differs from one without any."""
    values = values_of(compensator_table(given), given)
    arms = [Compensator(settings_of(each)) for each in (values, values_of(COMPENSATOR, {"use_imu": False}))]
    torques = [arm.step(1.0, (0.1, 0.2, 0.3, 0.4), (0.0,) * 4).effort for arm in arms]
    return arms[0].terms.active, np.subtract(*torques).tolist()


def test_a_laboratory_s_own_motor_and_term_need_no_fork_and_all_bounds_hold() -> None:
    path = os.pathsep.join((str(ROOT / "test" / "support" / "our_lab"), os.environ.get("PYTHONPATH", "")))
    command, environment = [sys.executable, "-m", __name__], {**os.environ, "PYTHONPATH": path}
    output = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True).stdout
    assert json.loads(output) == {
        "on": [True] * 4,
        "off": True,
        "ignored": {},
        # less than half a turn of the rotor at the output: 9 degrees
        "home_tolerance": pytest.approx([0.15, 0.34, 0.15, 0.50]),
        "peak": [50.0, 18.0, 50.0, 9.0],
        "rotors": [4.0e-3, 4.9e-3, 4.0e-3, 8.8e-4],
        "most": [100.0, 40.0, 100.0, 40.0],
        "simulated": ["OurSimulatedMotor", "SimulatedMotor", "OurSimulatedMotor", "SimulatedMotor"],
        "is_lazy": True,  # a start with our motors alone looks up no entry point
        # within the bound of all terms together, 2 Nm
        "pushed": [["our_push"], [0.5, 0.0, 2.0, pytest.approx(-1.0)]],
    }


if __name__ == "__main__":
    before = others.cache_info().misses
    carry(motor=["AK60-6"] * 4)
    arm = {"use_imu": False, "max_effort": [9.0] * 4}
    is_lazy = push(**arm)[0] == [] and others.cache_info().misses == before and not installed.cache_info().misses
    ours = carry(motor=["OUR-1", "AK80-9", "OUR-1", "AK60-6"], wire_format=["ours", "mit", "ours", "mit_v3"])
    print(json.dumps({**ours, "is_lazy": is_lazy, "pushed": push(**arm, **{"our_push.effort": [0.5, 0.0, 2.5, -1.0]})}))
