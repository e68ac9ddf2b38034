# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The serial number of a CAN adapter: whether a bus is still the one that its name meant.

Names such as can0 are given in the order in which adapters are found. Of two exchanged adapters, motors with the same
IDs would receive each other's torques. Linux shows the number of a USB adapter in sysfs; of others python-can may know
it. An adapter with several channels has one number for all: their cables can still be exchanged.
"""

import contextlib
from pathlib import Path

import can

from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.joint_motor import channels_of

SYSFS = Path("/sys")
CLASSES = {"socketcan": "net", "slcan": "tty"}  # in sysfs, of the channels of an interface


def serial_of(interface: str, channel: str, sysfs: Path = SYSFS) -> str:
    """Return the serial number of a bus's adapter, '' if it has none or it is not known."""
    if interface in CLASSES:
        name = Path(channel.partition("@")[0]).resolve().name  # slcan's may end with the serial port's speed
        device = (sysfs / "class" / CLASSES[interface] / name / "device").resolve()
        for folder in (device, *device.parents):
            if (folder / "idVendor").is_file():  # the adapter; above it are hubs, which have numbers, too
                with contextlib.suppress(OSError):
                    return (folder / "serial").read_text().strip()
                return ""
        return ""
    with contextlib.suppress(Exception):  # a backend without its driver raises errors of every type
        for config in can.detect_available_configs([interface]):
            if str(config["channel"]) == channel:
                return str(config.get("serial", ""))
    return ""


def check_serial(interface: str, channel: str, expected: str, sysfs: Path = SYSFS) -> None:
    """Raise BusError unless the adapter of a bus has the number `expected`; '' for any."""
    if expected and (found := serial_of(interface, channel, sysfs)) != expected:
        shown = f"the serial number {found}" if found else "no known serial number"
        raise BusError(
            f"CAN bus {interface} {channel}: its adapter has {shown}, must be can.serial = {expected}: "
            "are two adapters exchanged?"
        )


def serials_of(serial: str, channel: str, count: int) -> tuple[str, ...]:
    """Return the number of the adapter of each of `count` motors that the value of `can.serial` names.

    channel: the value of `can.channel`. Raises ParameterError.
    """
    names, channels = [name.strip() for name in serial.split(",")], channels_of(channel, count)
    if len(names) == 1:
        names *= count
    if len(names) != len(channels) or len(set(zip(channels, names, strict=True))) != len(set(channels)):
        raise ParameterError("can.serial", serial, f"one number, or one for each motor, as can.channel = {channel}")
    return tuple(names)
