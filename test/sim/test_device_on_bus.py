# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The simulated device in real time on a bus."""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
import time
from types import SimpleNamespace

import can
import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import unpack_reply
from exo_gravity.core.motors.damiao import DAMIAO_MIT
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.hardware.can.can_port import CanPort
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.sim import SimulatedArm, SimulatedDevice
from exo_gravity.sim import device as device_module
from exo_gravity.sim.motors import simulated

from ..support.simulated_device import OFF, SPECS, command, frame, make_device

GROUP = "239.74.163.2"
channels = itertools.count()


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return probe.getsockname()[1]


@pytest.fixture(params=["virtual", "udp_multicast"])
def options(request):
    """The options of a bus that no other test uses."""
    if request.param == "virtual":
        return {"interface": "virtual", "channel": f"device-{next(channels)}"}
    return {"interface": "udp_multicast", "channel": GROUP, "port": free_port(), "hop_limit": 0}


@contextlib.contextmanager
def running(device, options, **own):
    """Run `device` in a thread; yield the host's bus."""
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
    """Return the next frame from a motor, or None; the first byte of the host's own commands is 0x7f or more."""
    deadline = time.monotonic() + timeout
    while (remaining := deadline - time.monotonic()) > 0:
        message = host.recv(remaining)
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


def test_an_echo_of_a_reply_is_not_taken_for_a_command(options):
    device = make_device()
    with running(device, options) as host:
        host.send(frame(1, ENTER))
        next_reply(host)
        for _ in range(50):
            host.send(frame(1, command(0, 1.0)))
            reply = next_reply(host)
            assert unpack_reply(SPECS[0], reply.data).torque == pytest.approx(1.0, abs=0.01)
    assert device.motors[0].torque(0.0, 0.0) == pytest.approx(1.0, abs=0.01)


def test_an_echo_that_the_bus_marks_is_not_taken_for_a_command():
    options = {"interface": "virtual", "channel": f"device-{next(channels)}"}
    with running(make_device(), options, receive_own_messages=True) as host:
        host.send(frame(1, command(0)))
        assert next_reply(host) is not None
        assert next_reply(host, timeout=0.05) is None


def test_frames_that_are_not_for_a_motor_are_ignored(options):
    device = make_device()
    foreign_frames = [
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
        for message in foreign_frames:
            host.send(message)
        host.send(frame(1, command(0, 2.0)))
        assert next_reply(host).arbitration_id == 1
        assert next_reply(host, timeout=0.05) is None
    assert device.motors[0].torque(0.0, 0.0) == 0.0  # none of them switched it on


def test_a_datagram_that_is_not_a_frame_is_ignored():
    options = {"interface": "udp_multicast", "channel": GROUP, "port": free_port(), "hop_limit": 0}
    with running(make_device(), options) as host, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as noise:
        noise.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for data in (b"", b"no frame", b"\xc1", b"\x80"):
            noise.sendto(data, (GROUP, options["port"]))
        host.send(frame(1, command(0)))
        replies = []
        while not replies:
            with contextlib.suppress(can.CanOperationError):  # the host receives the noise too
                replies = [next_reply(host)]
        assert replies[0].arbitration_id == 1


def test_no_reply_is_faster_than_a_real_motors():
    options = {"interface": "virtual", "channel": f"device-{next(channels)}"}
    with running(make_device(), options) as host:
        for _ in range(20):
            sent = time.monotonic()
            host.send(frame(1, command(0)))
            next_reply(host)
            assert time.monotonic() - sent >= 200e-6


def test_a_failing_bus_ends_the_run_with_a_bus_error():
    bus = can.Bus(interface="virtual", channel=f"device-{next(channels)}")
    bus.shutdown()
    with pytest.raises(BusError, match="receiving"):
        make_device().run(bus, lambda: False)


class BusyBus:
    """A bus on which four commands arrive at once, and its clock; `events`: the order of replies and other work."""

    def __init__(self):
        self.now, self.events = 0.0, []
        self._waiting = [frame(can_id, command(can_id - 1)) for can_id in (1, 2, 3, 4)]

    def recv(self, timeout):
        if self._waiting:
            return self._waiting.pop(0)
        self.now += timeout

    def send(self, message):
        self.events.append(message.data[0])

    def aside(self, now):
        self.events.append("aside")


def test_other_work_waits_until_every_command_has_been_answered(monkeypatch):
    bus = BusyBus()
    monkeypatch.setattr(device_module, "time", SimpleNamespace(monotonic=lambda: bus.now, time=lambda: bus.now))
    make_device().run(bus, lambda: "aside" in bus.events, bus.aside)
    assert sorted(bus.events[:-1]) == [1, 2, 3, 4]


class ScriptedBus:
    """A bus on which each wait takes a time and ends with a frame, as `script` says: pairs of s and data, or None."""

    def __init__(self, script):
        self.now, self.script = 0.0, list(script)

    def recv(self, timeout):
        wait, data = self.script.pop(0)
        self.now += wait
        return None if data is None else frame(1, data, timestamp=self.now)

    def send(self, message):
        pass

    def run(self, device, monkeypatch):
        clock = SimpleNamespace(monotonic=lambda: self.now, time=lambda: self.now)
        monkeypatch.setattr(device_module, "time", clock)
        device.run(self, lambda: not self.script)


@pytest.mark.parametrize(
    ("waits", "simulated", "slip"),
    [([0.002] * 50, 0.1, 0.0), ([0.002, 0.04, 0.002], 0.044, 0.0), ([0.002, 0.3, 0.002], 0.054, 0.25)],
)
def test_physics_catches_up_after_a_late_wake_up_and_more_than_50_ms_are_slip(monkeypatch, waits, simulated, slip):
    device = make_device()
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
def test_stalls_and_silence_are_measured_while_the_motors_are_on(monkeypatch, script, stall, silence):
    device = make_device()
    ScriptedBus(script).run(device, monkeypatch)
    assert (device.longest_stall, device.longest_silence) == (pytest.approx(stall), pytest.approx(silence))


@pytest.mark.parametrize("is_fd", [False, True], ids=["classic", "fd"])
def test_damiao_motors_tell_their_state_and_settings_on_the_buses_of_python_can(options, is_fd):
    joints = [JointMotor(MOTORS["DM-J4310"], can_id, wire_format=DAMIAO_MIT, timeout=0.2) for can_id in (1, 2, 3, 4)]
    device = SimulatedDevice(SimulatedArm(), [simulated(joint) for joint in joints])
    device.is_fd = (is_fd,) * len(joints)
    with running(device, options) as host:
        bus = MotorBus([CanPort(host, COMPUTER_CLOCK, is_fd=is_fd)] * len(joints), joints)
        bus.exchange(OFF, time.monotonic() + 0.01)
        assert bus.boards.hindrance(time.monotonic(), 100.0) == "motor 1 to tell its CTRL_MODE"
        end = time.monotonic() + 5.0
        while bus.boards.hindrance(time.monotonic(), 100.0) and time.monotonic() < end:
            bus.exchange(OFF, time.monotonic() + 0.01)
        assert not bus.boards.hindrance(time.monotonic(), 100.0)
    assert [sample.on for sample in bus.samples] == [False] * len(joints)
    assert not device.powered and bus.foreign_commands == 0
