# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""CAN adapters: opened by the parameter file alone, at the motors' bit rate, and bound by their serial numbers.

A serial adapter (slcan) on a pseudo-terminal passes frames of both formats, and may be unplugged and come back.
"""

import contextlib
import os
import pty
import re
import termios
import tty
from pathlib import Path

import can
import pytest
from can.interfaces import BACKENDS

from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.frames import EXTENDED
from exo_gravity.core.motors.joint_motor import BITRATE, NEED_BITRATE
from exo_gravity.hardware.can_port import CanPort, check_serial, open_bus, serial_of, serials_of
from exo_gravity.hardware.clock import COMPUTER_CLOCK

from ..support.waiting import pause, wait_until

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
def test_a_channel_that_is_a_number_reaches_the_backend_as_one_and_no_wall_clock_delays_it(
    channel, number, monkeypatch
):
    monkeypatch.setattr(can.bus, "time", pytest.fail)  # of `recv`: set back by an hour, it would wait as long
    bus, other = open_bus("virtual", channel, {}), can.Bus(interface="virtual", channel=number, ignore_config=True)
    other.send(can.Message(arbitration_id=1))
    assert CanPort(bus, COMPUTER_CLOCK).receive(1.0) is not None
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

OPTIONS = {"bitrate": 1_000_000, "sleep_after_open": 0.01, "timeout": 0.0002}


def plug_in(path: Path) -> tuple[int, int]:
    """Let an adapter appear at `path` as a new device; return its end of the serial port, and the program's."""
    ends = pty.openpty()
    tty.setraw(ends[1], termios.TCSANOW)
    path.unlink(missing_ok=True)
    path.symlink_to(os.ttyname(ends[1]))
    return ends


def test_frames_pass_a_serial_adapter_both_ways_also_once_it_was_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    """Commands of LAWICEL end with a carriage return (Lawicel, CANUSB manual): S8 sets 1 Mbit/s, O opens.

    tiiildd.. and Tiiiiiiiildd.. send a frame with an 11-bit or a 29-bit ID and are acknowledged with z or Z; received
    frames arrive in the same form.
    """
    path, frames = tmp_path / "ttyACM0", ((3, b"\xab\xcd"), (EXTENDED | 0x803, b"\x01"))

    def reopen() -> can.BusABC:
        return open_bus("slcan", str(path), OPTIONS)

    ends = plug_in(path)
    port = CanPort(reopen(), COMPUTER_CLOCK, reopen)

    def is_sent() -> bool:
        with contextlib.suppress(BusError):
            port.send(*frames)
            return True
        return False

    for is_again in (False, True):
        wait_until(is_sent)
        said = b""
        while not said.endswith(b"t0032ABCD\rT00000803101\r"):
            said += os.read(ends[0], 4096)
        assert b"S8\r" in said and b"O\r" in said
        os.write(ends[0], b"z\rt0041EF\rZ\rT00002904110\r")  # an acknowledgement hides no frame
        heard = [(message.arbitration_id, message.is_extended_id, bytes(message.data)) for message in port.waiting()]
        assert heard == [(4, False, b"\xef"), (0x2904, True, b"\x10")]
        for end in ends * (not is_again):
            os.close(end)
        error = "opening it again" * is_again
        while "opening it again" not in error:  # the first errors are not yet a failed bus
            with pytest.raises(BusError, match=r"^CAN bus slcan .*ttyACM0: Could not") as caught:
                port.send(frames[0])
            error = str(caught.value)
            pause()
        ends = ends if is_again else plug_in(path)
    port.close()
