# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An arm carried with a motor, a term and a law that another distribution provides: test/support/our_lab.

Entry points are looked up once, and so forgotten before and after.
"""

from typing import Any

import numpy as np
import pytest

from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import COMPENSATOR, Settings, compensator_table, settings_of
from exo_gravity.core.motors.families import every_family
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


def test_a_laboratory_s_own_motor_term_and_law_need_no_fork_and_all_bounds_hold(
    monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    for found in (every_family, installed):
        found.cache_clear()
        request.addfinalizer(found.cache_clear)
    carry(motor=["AK60-6"] * 4)
    arm = {"use_imu": False, "max_effort": [9.0] * 4}
    assert push(**arm)[0] == []
    assert every_family.cache_info().misses == installed.cache_info().misses == 0  # our motors alone: none is looked up
    monkeypatch.syspath_prepend(ROOT / "test" / "support" / "our_lab")
    assert carry(motor=["OUR-1", "AK80-9", "OUR-1", "AK60-6"], wire_format=["ours", "mit", "ours", "mit_v3"]) == {
        "on": [True] * 4,
        "off": True,
        "ignored": {},
        # less than half a turn of the rotor at the output: 9 degrees
        "home_tolerance": pytest.approx((0.15, 0.34, 0.15, 0.50)),
        "peak": [50.0, 18.0, 50.0, 9.0],
        "rotors": [4.0e-3, 4.9e-3, 4.0e-3, 8.8e-4],
        "most": [100.0, 40.0, 100.0, 40.0],
        "simulated": ["OurSimulatedMotor", "SimulatedMotor", "OurSimulatedMotor", "SimulatedMotor"],
    }
    # within the bound of all terms together, 2 Nm
    assert push(**arm, **{"our_push.effort": [0.5, 0.0, 2.5, -1.0]}) == (
        ["our_push"],
        pytest.approx([0.5, 0.0, 2.0, -1.0]),
    )
    both = ({"use_imu": False, "law": law} for law in ("our_half", "exact"))
    arms = (Compensator(settings_of(values_of(COMPENSATOR, given))) for given in both)
    torques = [arm.step(1.0, (0.1, 0.2, 0.3, 0.4), (0.0,) * 4).effort for arm in arms]
    assert np.divide(*np.array(torques)[:, 1:]).tolist() == pytest.approx(
        [0.5] * 3
    )  # gravity does not turn the first joint
