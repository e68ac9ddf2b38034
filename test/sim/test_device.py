# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The simulated device: arm, motors, trunk and wearer joined by frames, without a bus and on one."""

import contextlib
import socket
import threading
import time
from types import SimpleNamespace

import can
import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import unpack_reply
from exo_gravity.core.motors.frames import ENTER, EXIT
from exo_gravity.sim import VirtualWearer
from exo_gravity.sim import device as device_module
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_time import TAIL_BITS, Wire, frame_bits

from ..core.test_motors import stuffed_bits
from ..support.ports import own_ports
from ..support.simulated_device import SPECS, command, frame, make_device

PORTS = own_ports()


@pytest.fixture
def device():
    return make_device()


def perform(device, *steps):
    device.start(VirtualWearer(TrialScript.parse({"name": "test", "steps": list(steps)})))


@pytest.mark.parametrize(("fault", "of_joint_1"), [("bus_silent", True), ("cut_off", (True, False, False, False))])
def test_a_motor_that_no_frame_reaches_keeps_its_last_command(device, fault, of_joint_1):
    device.exchange(1, ENTER)
    device.exchange(1, command(0, 2.0))
    setattr(device, fault, of_joint_1)
    assert device.exchange(1, command(0, 0.0)) is None
    assert device.motors[0].torque(0.0, 0.0) == pytest.approx(2.0, abs=0.01)
    assert (device.exchange(3, ENTER) is None) is (fault == "bus_silent")


def test_the_trunk_bows_and_stays_bowed_and_a_new_script_ends_the_motion_of_the_old_one(device):
    device.pitch, device.roll = 0.1, -0.06
    perform(device, {"hold": 0.5}, {"bow": 0.5, "over": 1.0}, {"hold": 0.5})
    device.advance(1.0)
    assert device.trunk.pitch == device.pitch == pytest.approx(0.3, abs=0.001)
    device.advance(1.0)
    assert (device.pitch, device.roll) == pytest.approx((0.5, -0.06), abs=1e-6)
    perform(device, {"walk": 10.0})
    device.advance(2.3)
    assert any(device.trunk.acceleration)
    perform(device, {"hold": 1.0})
    device.advance(0.01)
    assert device.trunk == (device.pitch, device.roll, 0.0, 0.0, 0.0, 0.0, (0.0,) * 3)


# On a bus of python-can


@pytest.fixture(params=["virtual", "udp_multicast"])
def options(request):
    """The options of a bus that no other test uses."""
    port = next(PORTS)
    if request.param == "virtual":
        return {"interface": "virtual", "channel": f"device-{port}"}
    return {"interface": "udp_multicast", "channel": "239.74.163.2", "port": port, "hop_limit": 0}


@contextlib.contextmanager
def running(device, options):
    """Run `device` in a thread; yield the host's bus. What the device sends is echoed to it, marked or as it is."""
    stop, echo = threading.Event(), {"receive_own_messages": True} if options["interface"] == "virtual" else {}
    with can.Bus(**options) as host, can.Bus(**options, **echo) as bus:
        thread = threading.Thread(target=device.run, args=(bus, stop.is_set))
        thread.start()
        try:
            yield host
        finally:
            stop.set()
            thread.join()


def next_reply(host, timeout=5.0):
    """Return the next frame from a motor, or None; the first byte of the host's own commands is 0x7f or more."""
    deadline = time.monotonic() + timeout
    while (remaining := deadline - time.monotonic()) > 0:
        with contextlib.suppress(can.CanOperationError):  # noise that is no frame
            message = host.recv(remaining)
            if message is not None and message.data and message.data[0] < 0x7F and not message.is_extended_id:
                return message
    return None


def test_every_command_gets_one_reply_and_an_echo_of_a_reply_or_another_frame_is_no_command(device, options):
    with running(device, options) as host:
        for message in (
            *(frame(can_id, ENTER) for can_id in (0, 5)),
            frame(1, ENTER[:7]),
            frame(1, ENTER, is_extended_id=True),
            frame(1, None, is_remote_frame=True, dlc=8),
            frame(1, ENTER, is_error_frame=True),
            frame(1, ENTER, is_fd=True),
        ):
            host.send(message)
        if port := options.get("port"):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as noise:
                noise.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
                for data in (b"", b"no frame", b"\xc1", b"\x80"):
                    noise.sendto(data, (options["channel"], port))
        host.send(frame(1, command(0, 2.0)))
        assert next_reply(host).arbitration_id == 1
        assert device.motors[0].torque(0.0, 0.0) == 0.0  # none of them switched it on
        for joint in [0, 1, 2, 3] * 10:
            host.send(frame(joint + 1, command(joint)))
            reply = next_reply(host)
            assert (reply.arbitration_id, reply.data[0]) == (joint + 1, joint + 1)
        for data in (ENTER, command(0, 1.0)):
            host.send(frame(1, data))
            reply = next_reply(host)
        assert unpack_reply(SPECS[0], reply.data).torque == pytest.approx(1.0, abs=0.01)
        assert next_reply(host, timeout=0.05) is None
    assert device.motors[0].torque(0.0, 0.0) == pytest.approx(1.0, abs=0.01)


class ScriptedBus:
    """A bus on which each wait takes a time and ends with a frame, as `script` says: pairs of s and data, or None.

    sent: the time in s, the ID and the first byte of each frame that the device has sent.
    """

    channel_info = "a test"

    def __init__(self, script):
        self.now, self.script, self.sent = 0.0, list(script), []

    def recv(self, timeout):
        wait, data = self.script.pop(0)
        self.now += wait
        return data if data is None or isinstance(data, can.Message) else frame(1, data, timestamp=self.now)

    def send(self, message):
        self.sent.append((self.now, message.arbitration_id, message.data[0]))

    def run(self, device, monkeypatch, *aside):
        clock = SimpleNamespace(monotonic=lambda: self.now, time=lambda: self.now)
        monkeypatch.setattr(device_module, "time", clock)
        device.run(self, lambda: not self.script, *aside)


@pytest.mark.parametrize(
    ("waits", "simulated", "slip"),
    [([0.002] * 50, 0.1, 0.0), ([0.002, 0.04, 0.002], 0.044, 0.0), ([0.002, 0.3, 0.002], 0.054, 0.25)],
)
def test_physics_catches_up_after_a_late_wake_up_and_more_than_50_ms_are_slip(
    device, monkeypatch, waits, simulated, slip
):
    ScriptedBus((wait, None) for wait in waits).run(device, monkeypatch)
    assert device.time == pytest.approx(simulated, abs=1e-9)
    assert device.slip == pytest.approx(slip)


REGULAR = [(0.002, command(0))] * 5


@pytest.mark.parametrize(
    ("script", "stall", "silence"),
    [
        ([(0.3, None), (0.6, ENTER), *REGULAR], 0.002, 0.002),
        ([(0.0, ENTER), *REGULAR, (0.138, command(0)), *REGULAR], 0.138, 0.138),
        ([(0.0, ENTER), *REGULAR, *[(0.002, None)] * 39, (0.002, EXIT), (0.5, None)], 0.002, 0.08),
        ([(0.0, ENTER), *REGULAR, (0.3, EXIT), (0.4, ENTER), *REGULAR], 0.002, 0.002),
    ],
    ids=["regular", "stalled", "no commands", "switched on again"],
)
def test_stalls_and_silence_are_measured_while_the_motors_are_on(device, monkeypatch, script, stall, silence):
    ScriptedBus(script).run(device, monkeypatch)
    assert (device.longest_stall, device.longest_silence) == (pytest.approx(stall), pytest.approx(silence))


def test_a_failing_bus_ends_the_run_with_a_bus_error(device):
    bus = can.Bus(interface="virtual", channel=f"device-{next(PORTS)}")
    bus.shutdown()
    with pytest.raises(BusError, match="receiving"):
        device.run(bus, lambda: False)


# Frames on a wire with a bit rate: their time, their order, and what two senders with one ID do to each other


BITRATE = 1_000_000
HIGH, LOW = b"\x80" + bytes(7), bytes(8)  # data of two frames that differ in their first bit


@pytest.fixture
def wire():
    return Wire(bitrate=BITRATE)


@pytest.mark.parametrize(
    ("can_id", "data", "is_extended"),
    [
        (1, ENTER, False),
        (4, bytes(8), False),
        (0x7F, bytes(range(8)), False),
        (0x803, ENTER, True),
        (0x2904, LOW, True),
        (5, b"", False),
    ],
)
def test_the_bits_of_a_frame_are_those_of_the_specification(can_id, data, is_extended):
    message = can.Message(arbitration_id=can_id, data=data, is_extended_id=is_extended)
    assert len(frame_bits(message)) + TAIL_BITS == stuffed_bits(can_id, data, is_extended)


def test_frames_take_the_time_of_their_bits_and_the_lowest_waiting_id_is_next(wire):
    first, second, listener = wire.open(), wire.open(), wire.open()
    for can_id, bus in ((7, first), (9, first), (8, second), (1, second)):
        bus.send(frame(can_id, LOW))
        wire.clock.sleep(10e-6 if can_id == 9 else 0.0)
    arrived = []
    start = wire.clock.monotonic() - 10e-6
    while message := listener.recv(0.01):
        arrived.append((message.arbitration_id, wire.clock.monotonic() - start))
    assert [can_id for can_id, _ in arrived] == [7, 8, 1, 9]
    expected = stuffed_bits(7, LOW) / BITRATE
    assert arrived[0][1] == pytest.approx(expected, abs=1e-8)
    assert arrived[1][1] == pytest.approx(expected + stuffed_bits(8, LOW) / BITRATE, abs=1e-7)
    assert (wire.arbitration.collisions, wire.arbitration.tec) == (0, 0)


@pytest.mark.parametrize(
    ("second_data", "arrive", "collisions"),
    [
        (LOW, [LOW, HIGH], 16 + 1),  # the dominant bit goes through; 16 times 8 is 128; the next error flag is passive
        (HIGH, [HIGH], 0),
    ],
    ids=["until they are error passive", "frames that are equal do not collide"],
)
def test_two_senders_of_one_id_meet_again(wire, second_data, arrive, collisions):
    first, second, listener = wire.open(), wire.open(), wire.open()
    first.send(frame(1, HIGH))
    second.send(frame(1, second_data))
    wire.clock.sleep(0.02)
    assert [bytes(listener.recv(0.0).data) for _ in arrive] == arrive and listener.recv(0.01) is None
    assert (wire.arbitration.collisions, wire.arbitration.tec, wire.arbitration.bus_offs) == (
        collisions,
        8 * collisions,
        0,
    )
