# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""CAN adapters: opened by the parameter file alone, at the motors' bit rate, and bound by their serial numbers.

A serial adapter (slcan) on a pseudo-terminal passes frames of both formats, and may be unplugged and come back.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import pty
import re
import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from can.interfaces import BACKENDS

from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.frames import MotorReply
from exo_gravity.core.motors.joint_motor import BITRATE, NEED_BITRATE
from exo_gravity.core.safety.drive import Send
from exo_gravity.hardware.can_port import CanPort, check_serial, message_of, open_bus, serial_of, serials_of
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.hardware.motor_bus import MotorBus
from exo_gravity.sim import ArmConfig, Firmware, SimulatedDevice

from ..support.simulated_device import OFF, drive_of, joints_of, make_device, sending
from ..support.waiting import PATIENCE, pause, wait_until
from .test_motor_bus import WEIGHTLESS

FRAME_SENT = (b"z\r", b"Z\r")  # with an 11-bit or a 29-bit ID


class FakeSlcan:
    """A LAWICEL adapter, plugged in at `path` until `close`; `bus` is its wire.

    Commands end with a carriage return (Lawicel, CANUSB manual): S0 to S8 set the bit rate, 1 Mbit/s last, O opens, C
    closes; each is acknowledged with a carriage return. tiiildd.. and Tiiiiiiiildd.. send a frame with an 11-bit or a
    29-bit ID and are acknowledged with z or Z; received frames arrive in the same form.

    bit_rate: the command that set it. is_open: whether O was received. passed: frames of the program that were sent.
    """

    def __init__(self, path: Path, bus: can.BusABC) -> None:
        self.bit_rate, self.passed = "", 0
        self.acknowledges = True
        self._path = path
        self._bus = bus
        self.is_open = False
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.plug_in()

    def plug_in(self) -> None:
        """Appear at `path` as a new device."""
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave, termios.TCSANOW)
        with contextlib.suppress(FileNotFoundError):
            self._path.unlink()
        self._path.symlink_to(os.ttyname(self._slave))
        self.is_open = False
        self._stop.clear()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def unplug(self) -> None:
        """Vanish: the program's next access fails."""
        if self._thread is None:
            return
        self._stop.set()
        self._thread.join()
        self._thread = None
        self._path.unlink()
        os.close(self._slave)
        os.close(self._master)

    close = unplug

    @property
    def unread(self) -> int:
        """Characters that the program has not yet read."""
        return int.from_bytes(fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4)), sys.byteorder)

    def _run(self) -> None:
        rest = b""
        while not self._stop.is_set():
            if select.select([self._master], [], [], 0.0)[0]:
                *lines, rest = (rest + os.read(self._master, 4096)).split(b"\r")
                for line in lines:
                    answer = self._obey(line.decode())
                    self._write(answer)
                    self.passed += answer in FRAME_SENT
            message = self._bus.recv(0.0005)
            if message is not None and self.is_open and not message.is_error_frame and not message.is_fd:
                self._write(_line(message))

    def _write(self, data: bytes) -> None:
        if self.acknowledges or data not in FRAME_SENT:
            os.write(self._master, data)

    def _obey(self, line: str) -> bytes:
        self.bit_rate = line if line.startswith("S") else self.bit_rate
        self.is_open = line == "O" or (self.is_open and line != "C")
        if line[:1] not in ("t", "T"):
            return b"\r"
        digits = 3 if line[0] == "t" else 8
        frame_id, data = int(line[1 : digits + 1], 16), bytes.fromhex(line[digits + 2 :])
        self._bus.send(can.Message(arbitration_id=frame_id, data=data, is_extended_id=digits == 8))
        return FRAME_SENT[digits == 8]


def _line(message: can.Message) -> bytes:
    head = f"T{message.arbitration_id:08X}" if message.is_extended_id else f"t{message.arbitration_id:03X}"
    return f"{head}{message.dlc}{bytes(message.data).hex().upper()}\r".encode()


THEIRS = {name: where for name, where in BACKENDS.items() if where[0].startswith("can.interfaces.")}


def default_bit_rates(module: str) -> set[str]:
    """Return the bit rates at which a backend opens a bus that is given none, by its source; '': not known there."""
    path = Path(can.__file__).parent.joinpath(*module.split(".")[1:])
    own = [path.with_suffix(".py")] if path.with_suffix(".py").is_file() else []
    files = own or sorted((path if path.is_dir() else path.parent).glob("*.py"))
    text = "".join(file.read_text(encoding="utf-8") for file in files)
    given = "".join(re.findall(r"def __init__\((.*?)\)(?: ->[^:]*)?:\n", text, re.DOTALL))
    found = re.findall(r"\bbitrate\b(?:\s*:[^=,]*)?(?:\s*=\s*(\w+))?,?", given)
    found += re.findall(r"""kwargs\.get\(["']bitrate["'](?:,\s*(\w+))?\)""", text)
    return {value.replace("_", "") for value in found}


def test_a_bit_rate_must_be_given_where_python_can_would_take_another_one():
    assert len(THEIRS) > 20
    others = {name for name, (module, _) in THEIRS.items() if default_bit_rates(module) - {str(BITRATE)}}
    assert others == set(NEED_BITRATE)


CONFIGURED = "[default]\ninterface = slcan\nchannel = /dev/ttyUSB0\nbitrate = 500000\nreceive_own_messages = True\n"


def test_settings_of_another_project_do_not_reach_a_motor_bus(tmp_path, monkeypatch):
    (tmp_path / ".canrc").write_text(CONFIGURED)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("CAN_CONFIG", '{"receive_own_messages": true}')
    monkeypatch.setitem(can.rc, "receive_own_messages", True)
    bus = open_bus("virtual", "not_theirs", {})
    plain = can.Bus(interface="virtual", channel="not_theirs")
    assert plain.receive_own_messages and not bus.receive_own_messages  # python-can's own way takes them
    bus.shutdown()
    plain.shutdown()


@pytest.mark.parametrize(("channel", "number"), [("0", 0), ("can0", "can0")])
def test_a_channel_that_is_a_number_reaches_the_backend_as_one(channel, number):
    bus, other = open_bus("virtual", channel, {}), can.Bus(interface="virtual", channel=number, ignore_config=True)
    other.send(can.Message(arbitration_id=1))
    assert bus.recv(1.0) is not None
    bus.shutdown()
    other.shutdown()


def test_the_error_for_a_bus_that_cannot_be_opened_names_it():
    with pytest.raises(BusError, match="CAN bus nonsense can9"):
        open_bus("nonsense", "can9", {})


# A bus is bound to its adapter by the serial number, as Linux shows it.


HUB = "devices/pci0000:00/usb1"
SYSFS = {  # as Linux has it: files, and the device of each channel
    f"{HUB}/serial": "0000:00:14.0", f"{HUB}/idVendor": "1d6b",
    f"{HUB}/1-1/serial": "ABC123", f"{HUB}/1-1/idVendor": "1d50", "class/net/can0": f"{HUB}/1-1/1-1:1.0",
    f"{HUB}/1-2/idVendor": "1d50", "class/net/can1": f"{HUB}/1-2/1-2:1.0",  # an adapter without a number
    "class/net/can2": "devices/pci0000:00/0000:00:02.0",
    f"{HUB}/1-3/serial": "TTY9", f"{HUB}/1-3/idVendor": "1d50", "class/tty/ttyACM0": f"{HUB}/1-3/1-3:1.0",
}  # fmt: skip


@pytest.fixture
def sysfs(tmp_path: Path) -> Path:
    for name, content in SYSFS.items():
        path = tmp_path / name
        if name.startswith("class"):
            path.mkdir(parents=True)
            (tmp_path / content).mkdir(parents=True)
            (path / "device").symlink_to(tmp_path / content)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{content}\n")
    return tmp_path


@pytest.mark.parametrize(
    ("interface", "channel", "number"),
    [
        ("socketcan", "can0", "ABC123"),
        ("socketcan", "can1", ""),  # not that of its hub
        ("socketcan", "can2", ""),
        ("socketcan", "can7", ""),
        ("slcan", "/dev/ttyACM0@115200", "TTY9"),
        ("no_such_interface", "x", ""),
    ],
)
def test_the_serial_number_is_that_of_the_adapter_itself_and_another_is_refused(sysfs, interface, channel, number):
    assert serial_of(interface, channel, sysfs) == number
    check_serial(interface, channel, number, sysfs)
    told = f"has the serial number {number}, must be can.serial = XYZ" if number else "no known serial number"
    with pytest.raises(BusError, match=told):
        check_serial(interface, channel, "XYZ", sysfs)


def test_two_buses_have_a_number_for_each_motor():
    assert serials_of("", "can0", 4) == ("",) * 4
    assert serials_of("A,A,B, B", "can0,can0,can1,can1", 4) == ("A", "A", "B", "B")
    for wrong in ("A,B", "A,B,A,B"):
        with pytest.raises(ParameterError, match=r"can\.serial"):
            serials_of(wrong, "can0,can0,can1,can1", 4)


# A serial adapter.

MIXED = (MIT, MIT_V3, MIT_V3, MIT)
OPTIONS = {"bitrate": 1_000_000, "sleep_after_open": 0.01, "timeout": 0.0002}
POSE = (0.1, 0.2, 0.3, 0.4)
FIRST_FRAMES = 2  # to motors that are off: a command for those that reply to one
ON = drive_of((0.0, 0.5, 0.4, 0.0))
CHANNELS = itertools.count()


def within(seconds: float = PATIENCE) -> float:
    """When replies are given up; those that must come are awaited however slow the machine is."""
    return time.monotonic() + seconds


@pytest.fixture
def channel() -> str:
    return f"slcan-{next(CHANNELS)}"


@pytest.fixture
def adapter(tmp_path: Path, channel: str) -> Iterator[FakeSlcan]:
    with can.Bus(interface="virtual", channel=channel) as wire:
        adapter = FakeSlcan(tmp_path / "ttyACM0", wire)
        yield adapter
        adapter.close()


@pytest.fixture
def device(channel: str) -> Iterator[SimulatedDevice]:
    config = ArmConfig(links=WEIGHTLESS, coulomb_friction=(5.0,) * 4)
    device = make_device(Firmware(status_rate=50.0), config=config, formats=MIXED)
    device.arm.reset(POSE)
    stop = threading.Event()
    with can.Bus(interface="virtual", channel=channel) as bus:
        thread = threading.Thread(target=device.run, args=(bus, stop.is_set))
        thread.start()
        yield device
        stop.set()
        thread.join()


@pytest.fixture
def motors(adapter: FakeSlcan, tmp_path: Path) -> Iterator[MotorBus]:
    def reopen() -> can.BusABC:
        return open_bus("slcan", str(tmp_path / "ttyACM0"), OPTIONS)

    bus = MotorBus([CanPort(reopen(), COMPUTER_CLOCK, reopen)] * len(MIXED), joints_of(MIXED))
    wait_until(lambda: adapter.is_open)  # python-can does not wait for it
    yield bus
    bus.close()


def test_frames_pass_the_adapter_both_ways_also_once_it_was_unplugged_and_plugged_in_again(
    adapter, device, motors
) -> None:
    motors.exchange(sending(Send.ENTER), within(1.0))
    for _ in range(2):
        assert motors.exchange(ON, within())
    assert [sample.position for sample in motors.samples] == pytest.approx(POSE, abs=0.01)
    assert [sample.effort for sample in motors.samples] == pytest.approx(ON.effort, abs=0.02)
    assert device.powered and adapter.bit_rate == "S8" and not motors.ignored
    adapter.unplug()
    error = ""
    while "opening it again" not in error:  # the first errors are not yet a failed bus
        with pytest.raises(BusError, match=r"^CAN bus slcan .*ttyACM0: Could not") as caught:
            motors.exchange(ON, within(1.0))
        error = str(caught.value)
    assert device.powered  # the motors keep their last command
    adapter.plug_in()

    def switch_off() -> None:
        with contextlib.suppress(BusError):
            motors.exchange(sending(Send.EXIT), within(1.0))
        pause()

    wait_until(lambda: not device.powered, switch_off)


@pytest.mark.parametrize("acknowledges", [True, False])
def test_an_acknowledgement_does_not_hide_late_replies_which_are_not_taken_for_new_ones(
    adapter, motors, channel, acknowledges
) -> None:
    adapter.acknowledges = acknowledges
    motors.exchange(OFF, time.monotonic())
    wait_until(lambda: adapter.passed == FIRST_FRAMES)
    unread, lengths = adapter.unread, 0
    with can.Bus(interface="virtual", channel=channel) as other:
        for joint in joints_of(MIXED):
            data = joint.wire_format.pack_reply(joint.spec, MotorReply(joint.can_id, 0.0, 0.0, 0.0, 30, 0))
            reply = message_of((joint.wire_format.reply_id(joint.can_id), data))
            other.send(reply)
            lengths += 27 if reply.is_extended_id else 22  # characters
        wait_until(lambda: adapter.unread >= unread + lengths)
        assert not motors.exchange(OFF, time.monotonic())
    assert all(sample.time > 0.0 for sample in motors.samples)
