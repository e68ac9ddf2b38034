# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An arm carried with a motor that another distribution provides, test/support/our_lab.

    PYTHONPATH=test/support/our_lab python -m test.support.added_motor

It is a process of its own, because entry points are looked up once. Prints what came of it as JSON.
"""

from __future__ import annotations

import json
from typing import Any

from exo_gravity.core.arm.gravity import gravity_torque
from exo_gravity.core.motors.families import others
from exo_gravity.core.motors.joint_motor import motors_of
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.drive import Efforts, State
from exo_gravity.core.safety.limits import CAN_BRIDGE, check_bridge, limits_of
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.params import SIMULATOR, device_of
from exo_gravity.sim.virtual_arm import VirtualArm


def carried(given: dict[str, Any]) -> dict[str, Any]:
    """Carry the simulated arm that these parameters describe for a second, in virtual time, and let it down."""
    given = {"can.interface": "virtual", "can.channel": "wire", **given}
    values = values_of(
        CAN_BRIDGE, {**given, "rate": 100.0, "sign_check_torque": 0.0, "max_effort": [3.0, 9.0, 3.0, 3.0]}
    )
    motors, limits = motors_of(values), limits_of(values)
    check_bridge(values["rate"], motors, limits)
    device = device_of(values_of(SIMULATOR, given))

    config = device.arm.config
    assert isinstance(config, ArmConfig)
    links = config.links

    class Holding:
        """Asks for what holds the device where it is."""

        def efforts(self, latest: float) -> Efforts:
            held = gravity_torque(links, device.arm.positions)
            return Efforts(tuple(held), arm.now, damped=False, held=False)

        def take(self, now: float, samples: Any) -> None:
            pass

    arm = VirtualArm(device, Holding(), motors, limits, values["rate"])
    safety = arm.safety
    arm.enable()
    arm.run_until(lambda: safety.state is State.ACTIVE, 5.0)
    state, is_on = safety.state.value, [motor.entered for motor in device.motors]
    safety.disable(arm.now)
    arm.run_until(lambda: arm.loop.is_off, 20.0)
    arm.bus.stop()
    return {
        "state": state,
        "fault": safety.fault and safety.fault.reason,
        "on": is_on,
        "off": arm.loop.is_off and not device.powered,
        "ignored": dict(arm.bus.ignored),
        "home_tolerance": limits.home_tolerance,
        "peak": [motor.peak_effort for motor in motors],
        "rotors": list(device.arm.config.rotor_inertia),
        "most": list(limits.max_command),
        "simulated": [type(motor).__name__ for motor in device.motors],
    }


def main() -> None:
    """Print how an arm is carried with the motor, and how the families are found."""
    before = others.cache_info().misses
    carried({"motor": ["AK60-6"] * 4})
    is_lazy = others.cache_info().misses == before
    ours = {"motor": ["OUR-1", "AK80-9", "OUR-1", "AK60-6"], "wire_format": ["ours", "mit", "ours", "mit_v3"]}
    print(json.dumps({**carried(ours), "is_lazy": is_lazy}))


if __name__ == "__main__":
    main()
