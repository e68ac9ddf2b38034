# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""CAN adapters: opened by the parameter file alone, at the motors' bit rate, and bound by their serial numbers.

A serial adapter (slcan) on a pseudo-terminal passes frames of both formats, and may be unplugged and come back.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import threading
import time
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
from exo_gravity.hardware.can.adapter import check_serial, serial_of, serials_of
from exo_gravity.hardware.can.can_port import CanPort, message_of, open_bus
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.sim import ArmConfig, Firmware, SimulatedDevice

from ..support.fake_slcan import FakeSlcan
from ..support.simulated_device import OFF, drive_of, joints_of, make_device, sending
from ..support.waiting import PATIENCE, pause, wait_until
from .test_motor_bus import WEIGHTLESS

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
    assert device.powered and adapter.kbit_s == 1000 and not motors.ignored
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
