# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""CAN adapters: opened by the parameter file alone, at the motors' bit rate, and bound by their serial numbers.

A serial adapter (slcan) on a pseudo-terminal passes frames of both formats, and may be unplugged and come back.
"""

from __future__ import annotations

import ast
import contextlib
import itertools
import threading
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import can
import pytest
from can.interfaces import BACKENDS

from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.frames import ID_BITS, MotorReply
from exo_gravity.core.motors.joint_motor import BITRATE, NEED_BITRATE
from exo_gravity.core.safety.drive import Send
from exo_gravity.hardware.can.adapter import check_serial, serial_of, serials_of
from exo_gravity.hardware.can.can_port import CanPort, open_bus
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.sim import ArmConfig, Firmware, SimulatedDevice

from ..support.fake_slcan import FakeSlcan
from ..support.simulated_device import OFF, drive_of, joints_of, make_device, sending
from ..support.waiting import PATIENCE, pause, wait_until
from .test_motor_bus import WEIGHTLESS

THEIRS = {name: where for name, where in BACKENDS.items() if where[0].startswith("can.interfaces.")}


def sources(module: str) -> list[ast.Module]:
    """Return the sources of a backend of python-can, whose driver need not be installed."""
    path = Path(can.__file__).parent.joinpath(*module.split(".")[1:])
    files = [path.with_suffix(".py")] if path.with_suffix(".py").is_file() else sorted(path.parent.glob("*.py"))
    files = sorted(path.glob("*.py")) if path.is_dir() else files
    return [ast.parse(file.read_text(encoding="utf-8")) for file in files]


def default_bit_rates(module: str) -> list[object]:
    """Return the bit rates at which a backend opens a bus that is given none; None: that of its adapter."""
    found: list[object] = []
    for node in (node for tree in sources(module) for node in ast.walk(tree)):
        if isinstance(node, ast.FunctionDef) and node.name == "__init__":
            named = node.args.args + node.args.kwonlyargs
            values = [None] * (len(node.args.args) - len(node.args.defaults)) + node.args.defaults
            values += node.args.kw_defaults
            pairs = zip(named, values, strict=True)
            found += [value and ast.literal_eval(value) for argument, value in pairs if argument.arg == "bitrate"]
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "kwargs.get":
            key, *rest = node.args
            found += [ast.literal_eval(rest[0]) if rest else None] if ast.unparse(key) == "'bitrate'" else []
    return found


def test_a_bit_rate_must_be_given_where_python_can_would_take_another_one():
    assert find_spec("can") and len(THEIRS) > 20
    others = {name for name, (module, _) in THEIRS.items() if set(default_bit_rates(module)) - {BITRATE}}
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


@pytest.mark.parametrize(("channel", "number"), [("0", 0), ("can0", "can0"), ("239.74.163.2", "239.74.163.2")])
def test_a_channel_that_is_a_number_reaches_the_backend_as_one(channel, number):
    bus = open_bus("virtual", channel, {})
    other = can.Bus(interface="virtual", channel=number, ignore_config=True)
    other.send(can.Message(arbitration_id=1))
    assert bus.recv(1.0) is not None
    bus.shutdown()
    other.shutdown()


# A bus is bound to its adapter by the serial number, as Linux shows it.


@pytest.fixture
def sysfs(tmp_path: Path) -> Path:
    """A tree of sysfs as Linux has it: can0 with a number, can1 without one, can2 on PCI, a serial adapter."""
    hub = tmp_path / "devices" / "pci0000:00" / "usb1"
    for name, number, kind, channel in (
        ("1-1", "ABC123", "net", "can0"),
        ("1-2", "", "net", "can1"),
        ("1-3", "TTY9", "tty", "ttyACM0"),
    ):
        device = hub / name / f"{name}:1.0"
        device.mkdir(parents=True)
        (hub / name / "idVendor").write_text("1d50\n")
        if number:
            (hub / name / "serial").write_text(f"{number}\n")
        link(tmp_path / "class" / kind / channel / "device", device)
    (hub / "idVendor").write_text("1d6b\n")
    (hub / "serial").write_text("0000:00:14.0\n")
    board = tmp_path / "devices" / "pci0000:00" / "0000:00:02.0"
    board.mkdir()
    link(tmp_path / "class" / "net" / "can2" / "device", board)
    return tmp_path


def link(path: Path, target: Path) -> None:
    path.parent.mkdir(parents=True)
    path.symlink_to(target)


@pytest.mark.parametrize(
    ("interface", "channel", "number"),
    [
        ("socketcan", "can0", "ABC123"),
        ("socketcan", "can1", ""),  # not that of its hub
        ("socketcan", "can2", ""),
        ("socketcan", "can7", ""),
        ("slcan", "/dev/ttyACM0@115200", "TTY9"),
        ("udp_multicast", "239.0.0.1", ""),
        ("no_such_interface", "x", ""),
    ],
)
def test_the_serial_number_is_that_of_the_adapter_itself(sysfs, interface, channel, number):
    assert serial_of(interface, channel, sysfs) == number


def test_exchanged_adapters_are_refused_by_their_numbers(sysfs):
    check_serial("socketcan", "can0", "ABC123", sysfs)
    check_serial("socketcan", "can1", "", sysfs)
    with pytest.raises(BusError, match=r"has the serial number ABC123, must be can\.serial = XYZ"):
        check_serial("socketcan", "can0", "XYZ", sysfs)
    with pytest.raises(BusError, match="no known serial number"):
        check_serial("socketcan", "can1", "ABC123", sysfs)


def test_two_buses_have_a_number_for_each_motor():
    assert serials_of("", "can0", 4) == ("",) * 4
    assert serials_of("A", "can0", 4) == ("A",) * 4
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


def in_1_s() -> float:
    return time.monotonic() + 1.0


def in_time() -> float:
    """When replies that must come are given up: that is no matter of how fast the machine is."""
    return time.monotonic() + PATIENCE


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


def test_frames_with_11_and_29_bit_ids_pass_the_adapter_both_ways(adapter, device, motors) -> None:
    motors.exchange(sending(Send.ENTER), in_1_s())
    assert motors.exchange(ON, in_time())
    assert motors.exchange(ON, in_time())
    assert [sample.position for sample in motors.samples] == pytest.approx(POSE, abs=0.01)
    assert [sample.effort for sample in motors.samples] == pytest.approx(ON.effort, abs=0.02)
    assert [motor.entered for motor in device.motors] == [True] * 4
    assert adapter.kbit_s == 1000
    assert not motors.ignored


def test_after_the_adapter_was_unplugged_and_plugged_in_again_the_motors_are_reached(adapter, device, motors) -> None:
    motors.exchange(sending(Send.ENTER), in_1_s())
    assert motors.exchange(ON, in_time())
    adapter.unplug()
    errors = [""]
    while "opening it again" not in errors[-1]:  # the first errors are not yet a failed bus
        with pytest.raises(BusError) as caught:
            motors.exchange(ON, in_1_s())
        errors.append(str(caught.value))
    assert all(error.startswith("CAN bus slcan ") and "ttyACM0: Could not" in error for error in errors[1:])
    assert device.powered  # the motors keep their last command
    adapter.plug_in()

    def switch_off() -> None:
        with contextlib.suppress(BusError):
            motors.exchange(sending(Send.EXIT), in_1_s())
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
            reply_id = joint.can_id if joint.wire_format is MIT else MIT_V3.reply_id(joint.can_id) & ID_BITS
            other.send(can.Message(arbitration_id=reply_id, data=data, is_extended_id=joint.wire_format is MIT_V3))
            lengths += 22 if joint.wire_format is MIT else 27  # characters
        wait_until(lambda: adapter.unread >= unread + lengths)
        assert not motors.exchange(OFF, time.monotonic())
    assert all(sample.time > 0.0 for sample in motors.samples)
