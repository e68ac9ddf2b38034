"""The simulated device: a MuJoCo arm, four AK motors that exchange real CAN frames, a trunk IMU and a virtual wearer.

It knows nothing of the compensator: CAN frames and IMU samples are the only connection.

    motors = [SimulatedMotor(JointMotor(MOTORS["AK60-6"], can_id=1)), ...]     four, shoulder to elbow
    device = SimulatedDevice(SimulatedArm(ArmConfig()), motors, side="right")
    device.start(VirtualWearer(script), delay=2.0)     progress: wearer.step
    device.run(bus, stop.is_set)                                               real time, on any python-can bus

or without a bus, as fast as possible:

    reply = device.exchange(can_id, data)                                      (ID, data) of the reply, or None
    device.advance(0.005)

Faults and tilt may be set from any thread: `device.pitch`, `device.roll`, `device.bus_silent`,
`device.motors[n].unplugged`, `.temperature`, `.error`. The true state: `device.time`, `device.arm.positions`,
`.velocities`. A script moves the trunk, too: `device.trunk` is its motion, and `SimulatedImu(ImuConfig(...)).sample_of`
what its IMU measures.
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
