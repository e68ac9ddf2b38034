"""The motor bus with simulated motors: the order of its frames, and which frames count as replies.

Runs on python-can's virtual bus, or on the one that EXO_TEST_CAN_INTERFACE and EXO_TEST_CAN_CHANNEL name.
"""

import os
import threading
import time
from itertools import count

import can
import pytest

from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.specs import ENTER, EXIT, MOTORS, SET_ZERO, pack_reply, unpack_command
from exo_gravity.core.safety.drive import NOTHING, OFF, Drive
from exo_gravity.hardware.can.motor_bus import MotorBus, open_bus
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor

AK60 = MOTORS["AK60-6"]
MOUNTED = (("AK60-6", 1, 0.0), ("AK80-9", -1, 0.4), ("AK60-6", 1, -0.2), ("AK60-6", 1, 0.0))
MOTORS_OF_ARM = tuple(JointMotor(MOTORS[name], n, *mounted) for n, (name, *mounted) in enumerate(MOUNTED, 1))
LINKS = ArmConfig().links
WEIGHTLESS = ArmModel(LINKS.length, LINKS.cog, LINKS.mass, gravity=0.0)  # stays in place, however slow the machine is
INTERFACE = os.environ.get("EXO_TEST_CAN_INTERFACE", "virtual")
CHANNELS = (os.environ.get("EXO_TEST_CAN_CHANNEL", f"test_motor_bus_{n}") for n in count())
ON = Drive(NOTHING, NOTHING, True)


def in_1_s() -> float:
    return time.monotonic() + 1.0


@pytest.fixture
def wires():
    """Two ends of one bus: one for the motor bus, one for the test. Both pass FD frames."""
    channel = next(CHANNELS)
    ours, other = (can.Bus(interface=INTERFACE, channel=channel, fd=True) for _ in range(2))
    yield ours, other
    ours.shutdown()
    other.shutdown()


@pytest.fixture(params=[(False, 8), (False, 6), (True, 8), (True, 6)], ids=["own-8", "own-6", "master-8", "master-6"])
def device(request, wires):
    arm = SimulatedArm(ArmConfig(links=WEIGHTLESS))
    arm.reset((0.1, 0.2, 0.3, 0.4))
    motors = [SimulatedMotor(joint, Firmware(*request.param)) for joint in MOTORS_OF_ARM]
    device = SimulatedDevice(arm, motors)
    stop = threading.Event()
    thread = threading.Thread(target=device.run, args=(wires[1], stop.is_set))
    thread.start()
    yield device
    stop.set()
    thread.join()


def received(bus: can.BusABC) -> list[tuple[int, bytes]]:
    frames = []
    while (message := bus.recv(0.0)) is not None:
        frames.append((message.arbitration_id, bytes(message.data)))
    return frames


def test_every_motor_is_read_in_joint_coordinates(wires, device):
    bus = MotorBus(wires[0], MOTORS_OF_ARM)
    assert bus.exchange(OFF, in_1_s())
    for sample, angle in zip(bus.samples, (0.1, 0.2, 0.3, 0.4), strict=True):
        assert sample.position == pytest.approx(angle, abs=0.01)


def test_an_exchange_moves_the_simulated_arm(wires, device):
    bus = MotorBus(wires[0], MOTORS_OF_ARM)
    before = device.arm.positions[3]
    end = time.monotonic() + 5.0
    while device.arm.positions[3] < before + 0.2 and time.monotonic() < end:
        bus.exchange(Drive((0.0, 0.0, 0.0, 2.0), NOTHING, True), in_1_s())
    assert device.arm.positions[3] > before + 0.2


def test_a_zero_torque_command_precedes_switching_on_and_switching_off(wires):
    bus = MotorBus(wires[0], MOTORS_OF_ARM)
    bus.exchange(ON, time.monotonic())
    frames = [data for can_id, data in received(wires[1]) if can_id == 1]
    assert frames.index(ENTER) == 1
    assert unpack_command(AK60, frames[0]).torque == pytest.approx(0.0, abs=0.004)
    bus.exchange(OFF, time.monotonic())
    frames = [data for can_id, data in received(wires[1]) if can_id == 1]
    assert frames[-1] == EXIT
    assert unpack_command(AK60, frames[-2]).torque == pytest.approx(0.0, abs=0.004)


def test_stop_switches_every_motor_off_twice(wires):
    bus = MotorBus(wires[0], MOTORS_OF_ARM)
    bus.exchange(ON, time.monotonic())
    received(wires[1])
    bus.stop()
    assert [can_id for can_id, data in received(wires[1]) if data == EXIT] == [1, 2, 3, 4, 1, 2, 3, 4]


def test_set_zero_is_refused_while_the_motors_are_on(wires):
    bus = MotorBus(wires[0], MOTORS_OF_ARM)
    bus.exchange(ON, time.monotonic())
    with pytest.raises(BusError, match="motors are on"):
        bus.set_zero()
    assert SET_ZERO not in [data for _, data in received(wires[1])]


def frame(can_id: int, data: bytes, **kind) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **kind})


REPLY = pack_reply(AK60, 1, 0.25, 0.0, 0.0, 30, 0)


@pytest.mark.parametrize(
    ("message", "kind"),
    [
        (frame(1, MOTORS_OF_ARM[0].command(1.0, 0.0)), "foreign command"),
        (frame(1, ENTER), "foreign command"),
        (frame(1, b""), "foreign frame"),
        (frame(2, REPLY), "foreign command"),
        (frame(9, REPLY), "foreign frame"),
        (frame(1, REPLY[:5]), "foreign frame"),
        (frame(0, b"\x09" + REPLY[1:]), "foreign frame"),
        (frame(1, REPLY, is_extended_id=True), "extended, remote or FD frame"),
        (frame(1, REPLY, is_fd=True), "extended, remote or FD frame"),
        (
            can.Message(arbitration_id=1, dlc=8, is_remote_frame=True, is_extended_id=False),
            "extended, remote or FD frame",
        ),
        (frame(1, REPLY, is_error_frame=True), "error frame"),
    ],
)
def test_a_frame_that_is_not_a_reply_is_counted_and_ignored(wires, message, kind):
    bus = MotorBus(wires[0], MOTORS_OF_ARM)
    wires[1].send(message)
    bus.exchange(OFF, time.monotonic())
    assert bus.samples[0].time == float("-inf")
    assert bus.ignored == {kind: 1}


@pytest.mark.parametrize("can_id", [0, 1])
@pytest.mark.parametrize("length", [6, 8])
def test_a_reply_may_have_the_motors_id_or_the_masters(wires, can_id, length):
    bus = MotorBus(wires[0], MOTORS_OF_ARM)
    wires[1].send(frame(can_id, REPLY[:length]))
    bus.exchange(OFF, time.monotonic())
    assert bus.samples[0].position == pytest.approx(0.25, abs=0.0004)
    assert not bus.ignored


def test_a_late_reply_does_not_count_for_the_next_cycle(wires):
    bus = MotorBus(wires[0], MOTORS_OF_ARM)
    for can_id in (1, 2, 3, 4):
        wires[1].send(frame(can_id, bytes((can_id,)) + REPLY[1:]))
    assert not bus.exchange(OFF, time.monotonic())


def test_two_joints_with_the_same_id_are_refused(wires):
    with pytest.raises(ParameterError, match="4 different IDs"):
        MotorBus(wires[0], [JointMotor(AK60, 1)] * 4)


def test_the_error_for_a_bus_that_cannot_be_opened_names_it():
    with pytest.raises(BusError, match="CAN bus nonsense can9"):
        open_bus("nonsense", "can9", {})
