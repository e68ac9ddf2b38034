# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The simulated device: a MuJoCo arm, motors that exchange real CAN frames, a trunk IMU and a virtual wearer.

It knows nothing of the compensator: CAN frames and IMU samples are the only connection. `SimulatedDevice.run` plays it
in real time on any python-can bus. `virtual_arm.VirtualArm` carries it in virtual time, with the loop of a real arm.

The names are imported when they are used: `sim.script` is read by trials and reports of real arms too, on computers
without MuJoCo.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from exo_gravity.sim.arm import STEP, ArmConfig, SimulatedArm
    from exo_gravity.sim.device import SimulatedDevice, VirtualWearer
    from exo_gravity.sim.motors.ak import FIRMWARES, Firmware, SimulatedMotor
    from exo_gravity.sim.trunk_motion import ImuConfig, SimulatedImu

__all__ = [
    "FIRMWARES",
    "STEP",
    "ArmConfig",
    "Firmware",
    "ImuConfig",
    "SimulatedArm",
    "SimulatedDevice",
    "SimulatedImu",
    "SimulatedMotor",
    "VirtualWearer",
]
MODULES = {
    "arm": ("STEP", "ArmConfig", "SimulatedArm"),
    "device": ("SimulatedDevice", "VirtualWearer"),
    "motors.ak": ("FIRMWARES", "Firmware", "SimulatedMotor"),
    "trunk_motion": ("ImuConfig", "SimulatedImu"),
}


def __getattr__(name: str) -> Any:
    module = next((module for module, names in MODULES.items() if name in names), None)
    if module is None:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return getattr(import_module(f"{__name__}.{module}"), name)
