# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A bus is bound to its adapter by the adapter's serial number, as Linux shows it."""

from __future__ import annotations

from pathlib import Path

import pytest

from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.hardware.can.adapter import check_serial, serial_of, serials_of


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
