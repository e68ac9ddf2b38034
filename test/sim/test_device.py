"""The simulated device: arm, motors and wearer joined, by frames alone, with and without a bus."""

import contextlib
import itertools
import socket
import threading
import time
from types import SimpleNamespace

import can
import numpy as np
import pytest

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.joint_motor import JointMotor
from exo_gravity.core.motors import ENTER, MOTORS, SET_ZERO, pack_command, unpack_reply
from exo_gravity.core.trial_script import TrialScript
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor, VirtualWearer, can_link
from exo_gravity.sim import device as device_module

NAMES = ("AK60-6", "AK80-9", "AK60-6", "AK60-6")
SPECS = [MOTORS[name] for name in NAMES]
OUT = (0.3, 0.8, 0.7, 0.6)
GROUP = "239.74.163.2"
channels = itertools.count()


def make_device(firmware=None, ids=(1, 2, 3, 4), config=None):
    joints = [JointMotor(spec, can_id) for spec, can_id in zip(SPECS, ids, strict=True)]
    return SimulatedDevice(SimulatedArm(config), [SimulatedMotor(joint, firmware) for joint in joints])


def command(joint, torque=0.0, kd=0.0):
    return pack_command(SPECS[joint], 0.0, 0.0, 0.0, kd, torque)


def frame(can_id, data, **changes):
    return can.Message(**{"arbitration_id": can_id, "data": data, "is_extended_id": False, **changes})


# Without a bus


def test_motors_answer_to_their_own_id_alone():
    device = make_device(ids=(11, 12, 13, 14))
    assert device.exchange(1, ENTER) is None
    can_id, data = device.exchange(13, ENTER)
    assert (can_id, unpack_reply(SPECS[2], data).motor_id) == (13, 13)


def test_a_reply_tells_where_the_arm_is_now():
    device = make_device()
    device.arm.reset(OUT)
    device.advance(0.2)
    for joint in range(4):
        reply = unpack_reply(SPECS[joint], device.exchange(joint + 1, command(joint))[1])
        assert reply.position == pytest.approx(device.arm.positions[joint], abs=2e-4)
        assert reply.velocity == pytest.approx(device.arm.velocities[joint], abs=0.013)


def test_time_passes_in_whole_steps_and_the_rest_counts_next_time():
    device = make_device()
    device.advance(0.0104)
    assert device.time == pytest.approx(0.010)
    device.advance(0.0006)
    assert device.time == pytest.approx(0.011)


def test_gravity_torque_through_frames_holds_the_arm():
    device = make_device()
    device.arm.reset(OUT)
    for can_id in (1, 2, 3, 4):
        device.exchange(can_id, ENTER)
    for joint, torque in enumerate(gravity_torque(device.arm.config.links, OUT)):
        device.exchange(joint + 1, command(joint, torque))
    device.advance(10.0)
    np.testing.assert_allclose(np.degrees(device.arm.positions), np.degrees(OUT), atol=0.05)


def test_a_motors_damping_acts_at_every_step():
    links = SimulatedArm().config.links
    weightless = ArmModel(links.length, links.cog, links.mass, gravity=0.0)
    device = make_device(config=ArmConfig(weightless, coulomb_friction=(0,) * 4, viscous_friction=(0,) * 4))
    device.arm.data.qvel[:] = 2.0
    for joint in range(4):
        device.exchange(joint + 1, ENTER)
        device.exchange(joint + 1, command(joint, kd=2.0))
    device.advance(1.0)
    # At rest but for the wire's own: no code of 12 bits asks for exactly 0 rad/s.
    assert np.abs(device.arm.velocities).max() < 0.015


def test_tilting_the_trunk_live_moves_the_arm():
    device = make_device()
    device.advance(0.5)
    assert np.abs(device.arm.positions).max() < 1e-6
    device.pitch = 0.6
    device.advance(2.0)
    assert np.abs(device.arm.positions).max() > 0.2


def test_the_wearer_begins_after_the_delay_and_is_told_apart_by_time():
    device = make_device()
    assert device.elapsed is None
    device.advance(1.0)
    wearer = VirtualWearer(
        TrialScript.parse({"name": "test", "steps": [{"move": list(OUT), "over": 2.0}, {"hold": 1.0}]})
    )
    device.start(wearer, delay=0.5)
    device.advance(0.4)
    assert device.elapsed == pytest.approx(-0.1)
    assert wearer.step is None
    device.advance(2.0)
    assert wearer.step == 0
    np.testing.assert_allclose(device.arm.positions, OUT, atol=0.03)


def test_a_silent_bus_passes_nothing_and_the_motors_go_on():
    device = make_device()
    device.exchange(1, ENTER)
    device.exchange(1, command(0, 2.0))
    device.bus_silent = True
    assert device.exchange(1, command(0, 0.0)) is None
    assert device.motors[0].torque(0.0, 0.0) == pytest.approx(2.0, abs=0.01)


def test_a_motor_is_deaf_after_set_zero_for_a_time_of_the_simulated_clock():
    device = make_device(Firmware(zero_silence=0.7))
    assert device.exchange(1, SET_ZERO) is None
    device.advance(0.699)
    assert device.exchange(1, command(0)) is None
    device.advance(0.002)
    assert device.exchange(1, command(0)) is not None


@pytest.mark.parametrize("ids", [(1, 2, 3, 3), (1, 1, 1, 1)])
def test_two_motors_with_one_id_are_refused(ids):
    with pytest.raises(ParameterError, match="can_id"):
        make_device(ids=ids)


# On a bus


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return probe.getsockname()[1]


@pytest.fixture(params=["virtual", "udp_multicast"])
def options(request):
    """How to open a bus that no other test uses."""
    if request.param == "virtual":
        return {"interface": "virtual", "channel": f"device-{next(channels)}"}
    return {"interface": "udp_multicast", "channel": GROUP, "port": free_port(), "hop_limit": 0}


@contextlib.contextmanager
def running(device, options, **own):
    """Play `device` in a thread; yield the host's bus."""
    stop = threading.Event()
    with can.Bus(**options) as host, can.Bus(**options, **own) as bus:
        thread = threading.Thread(target=device.run, args=(bus, stop.is_set))
        thread.start()
        try:
            yield host
        finally:
            stop.set()
            thread.join()


def next_reply(host, timeout=5.0):
    """The next frame that a motor sent, or None: the host's own echoes begin with 0xff or with position 0."""
    deadline = time.monotonic() + timeout
    while (left := deadline - time.monotonic()) > 0:
        message = host.recv(left)
        if message is not None and message.data and message.data[0] < 0x7F and not message.is_extended_id:
            return message
    return None


def test_every_command_gets_one_reply(options):
    device = make_device()
    with running(device, options) as host:
        for joint in [0, 1, 2, 3] * 10:
            host.send(frame(joint + 1, command(joint)))
            reply = next_reply(host)
            assert (reply.arbitration_id, reply.data[0]) == (joint + 1, joint + 1)
        assert next_reply(host, timeout=0.05) is None


def test_commands_sent_at_once_are_all_answered(options):
    with running(make_device(), options) as host:
        for joint in range(4):
            host.send(frame(joint + 1, command(joint)))
        assert {next_reply(host).arbitration_id for _ in range(4)} == {1, 2, 3, 4}


def test_an_echo_of_an_own_reply_is_never_taken_for_a_command(options):
    device = make_device()
    with running(device, options) as host:
        host.send(frame(1, ENTER))
        next_reply(host)
        for _ in range(50):
            host.send(frame(1, command(0, 1.0)))
            reply = next_reply(host)
            assert unpack_reply(SPECS[0], reply.data).torque == pytest.approx(1.0, abs=0.01)
    assert device.motors[0].torque(0.0, 0.0) == pytest.approx(1.0, abs=0.01)


def test_an_echo_that_the_bus_marks_as_such_is_never_taken_for_a_command():
    options = {"interface": "virtual", "channel": f"device-{next(channels)}"}
    with running(make_device(), options, receive_own_messages=True) as host:
        host.send(frame(1, command(0)))
        assert next_reply(host) is not None
        assert next_reply(host, timeout=0.05) is None


def test_on_a_bus_that_does_not_echo_a_command_with_the_bytes_of_a_reply_is_carried_out():
    options = {"interface": "virtual", "channel": f"device-{next(channels)}"}
    with running(make_device(), options) as host:
        for _ in range(can_link.MAX_PENDING_ECHOES + 5):
            host.send(frame(1, command(0)))
            reply = next_reply(host)
        host.send(frame(1, bytes(reply.data)))
        assert next_reply(host) is not None


def test_frames_that_are_not_for_a_motor_are_ignored(options):
    device = make_device()
    strangers = [
        frame(0, ENTER),
        frame(5, ENTER),
        frame(0x7FF, b""),
        frame(1, b""),
        frame(1, ENTER[:7]),
        frame(1, ENTER, is_extended_id=True),
        frame(1, None, is_remote_frame=True, dlc=8),
        frame(1, ENTER, is_error_frame=True),
        frame(1, ENTER, is_fd=True),
    ]
    with running(device, options) as host:
        for message in strangers:
            host.send(message)
        host.send(frame(1, command(0, 2.0)))
        assert next_reply(host).arbitration_id == 1
        assert next_reply(host, timeout=0.05) is None
    assert device.motors[0].torque(0.0, 0.0) == 0.0  # none of them was an ENTER for it


def test_a_datagram_that_is_no_frame_does_no_harm():
    options = {"interface": "udp_multicast", "channel": GROUP, "port": free_port(), "hop_limit": 0}
    with running(make_device(), options) as host, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as noise:
        noise.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for data in (b"", b"no frame", b"\xc1", b"\x80"):
            noise.sendto(data, (GROUP, options["port"]))
        host.send(frame(1, command(0)))
        replies = []
        while not replies:
            with contextlib.suppress(can.CanOperationError):  # the host hears the noise too
                replies = [next_reply(host)]
        assert replies[0].arbitration_id == 1


def test_no_reply_comes_sooner_than_from_a_real_motor():
    options = {"interface": "virtual", "channel": f"device-{next(channels)}"}
    with running(make_device(), options) as host:
        for _ in range(20):
            sent = time.monotonic()
            host.send(frame(1, command(0)))
            next_reply(host)
            assert time.monotonic() - sent >= 200e-6


def test_replies_can_carry_the_masters_id_and_six_bytes(options):
    with running(make_device(Firmware(reply_to_master=True, reply_length=6)), options) as host:
        host.send(frame(3, command(2)))
        reply = next_reply(host)
        assert (reply.arbitration_id, reply.data[0], len(reply.data)) == (0, 3, 6)


def test_a_bus_that_fails_ends_the_run_with_a_bus_error():
    bus = can.Bus(interface="virtual", channel=f"device-{next(channels)}")
    bus.shutdown()
    with pytest.raises(BusError, match="receiving"):
        make_device().run(bus, lambda: False)


class BusyBus:
    """A bus on which four commands come at once; keeps the order of what happens."""

    def __init__(self):
        self.happened = []
        self._waiting = [frame(can_id, command(can_id - 1)) for can_id in (1, 2, 3, 4)]

    def recv(self, timeout):
        if self._waiting:
            return self._waiting.pop(0)
        time.sleep(timeout)

    def send(self, message):
        self.happened.append(message.data[0])

    def aside(self, now):
        self.happened.append("aside")


def test_what_else_is_to_do_waits_until_every_command_has_been_answered():
    bus = BusyBus()
    make_device().run(bus, lambda: "aside" in bus.happened, bus.aside)
    assert sorted(bus.happened[:-1]) == [1, 2, 3, 4]


# The clock, with one that the test turns


class LateBus:
    """A bus without frames, on which each wait takes as long as the test says."""

    def __init__(self, waits):
        self.now = 0.0
        self.waits = list(waits)

    def recv(self, timeout):
        self.now += self.waits.pop(0)

    def done(self):
        return not self.waits


@pytest.mark.parametrize(
    ("waits", "simulated", "slip"),
    [([0.002] * 50, 0.1, 0.0), ([0.002, 0.04, 0.002], 0.044, 0.0), ([0.002, 0.3, 0.002], 0.054, 0.25)],
)
def test_a_late_wake_up_is_made_up_for_and_beyond_50_ms_owned_up_to(monkeypatch, waits, simulated, slip):
    bus, device = LateBus(waits), make_device()
    monkeypatch.setattr(device_module, "time", SimpleNamespace(monotonic=lambda: bus.now))
    device.run(bus, bus.done)
    assert device.time == pytest.approx(simulated, abs=1e-9)
    assert device.slip == pytest.approx(slip)
