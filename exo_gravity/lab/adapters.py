# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Whether the CAN interfaces of a parameter file open: python-can's backend, the adapter's driver, the bus itself."""

from importlib import import_module, metadata

from can.interfaces import BACKENDS

from exo_gravity.core.errors import BusError
from exo_gravity.hardware.bus_lock import borrowed
from exo_gravity.hardware.can_port import ArmOnBus
from exo_gravity.lab.findings import Finding, Level


def of_opening(name: str, bus: ArmOnBus) -> Finding:
    """Import python-can's backend of a bus, and open the bus for a moment, without a frame, unless a bridge holds it.

    name: of the bridge. bus: the part of its arm on this bus.
    """
    interface, channel, _ = bus.address
    what, wanted = f"{name} {channel}: opens", f"yes, with {interface}"
    if interface not in BACKENDS:
        others = f"can.interface: one of {', '.join(sorted(BACKENDS))}"
        return Finding(what, f"python-can has no interface {interface}", wanted, Level.FAULT, others)
    try:
        import_module(BACKENDS[interface][0])
    except Exception as error:  # drivers of makers raise errors of every type
        return Finding(what, f"no driver: {_one_line(error)}", wanted, Level.FAULT, _driver(interface))
    with borrowed(bus.address) as holder:
        if holder:
            return Finding(what, f"not tried: held by {holder}", wanted, Level.UNKNOWN)
        try:
            bus.open(bus.address).shutdown()
        except BusError as error:
            reason = _one_line(error.__cause__ or error)
            return Finding(what, reason, wanted, Level.FAULT, f"plug the adapter in; {_driver(interface)}")
    return Finding(what, "yes", wanted)


def _one_line(error: BaseException) -> str:
    return " ".join(f"{error}".split()) or type(error).__name__


def _driver(interface: str) -> str:
    """Return what installs the driver of a python-can interface, as python-can's own metadata names it."""
    extras = {extra.replace("-", "_") for extra in metadata.metadata("python-can").get_all("Provides-Extra") or ()}
    if interface in extras:
        return f"pip install 'python-can[{interface}]'"
    return f"install the driver of {interface}: https://python-can.readthedocs.io/en/stable/interfaces.html"
