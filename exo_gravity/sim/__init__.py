"""The simulated device: a MuJoCo arm, four AK motors that exchange real CAN frames, a trunk IMU and a virtual wearer.

It knows nothing of the compensator: CAN frames and IMU samples are the only connection.

    motors = [SimulatedMotor(JointMotor(MOTORS["AK60-6"], can_id=1)), ...]     four, shoulder to elbow
    device = SimulatedDevice(SimulatedArm(ArmConfig()), motors, side="right")
    device.start(VirtualWearer(script), delay=2.0)
    device.run(bus, stop.is_set)                                               real time, on any python-can bus
    device.exchange(can_id, data); device.advance(0.005)                       or without a bus, as fast as possible
"""

from exo_gravity.sim.arm import STEP, ArmConfig, SimulatedArm
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.imu import ImuConfig, SimulatedImu
from exo_gravity.sim.motor import Firmware, SimulatedMotor, SimulatedV3Motor, simulated_motor
from exo_gravity.sim.virtual_wearer import VirtualWearer

__all__ = [
    "STEP",
    "ArmConfig",
    "Firmware",
    "ImuConfig",
    "SimulatedArm",
    "SimulatedDevice",
    "SimulatedImu",
    "SimulatedMotor",
    "SimulatedV3Motor",
    "VirtualWearer",
    "simulated_motor",
]
