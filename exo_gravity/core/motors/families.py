# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The motor families: our own, and those that other distributions provide.

A laboratory's own motors need no fork: a distribution that names a `Family` under the entry point group GROUP in its
pyproject.toml or setup.cfg is found here, e.g. `our_motors = our_lab.motors:FAMILY`. Its simulated twin is named in a
second group (sim/motors/__init__.py). Entry points are looked up when a name is not one of ours, and listed from then
on: an ordinary start does not pay for them.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import TypeVar

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import AK
from exo_gravity.core.motors.damiao import DAMIAO
from exo_gravity.core.motors.frames import Family, MotorSpec, WireFormat
from exo_gravity.core.params import installed, loaded

GROUP = "exo_gravity.motor_families"
OURS = (AK, DAMIAO)
Item = TypeVar("Item")


class ByName(Mapping[str, Item]):
    """What the families provide, by name. Ours are known at once.

    of: returns what a family provides, by name. Where two families provide one name, the first one's counts.
    """

    def __init__(self, of: Callable[[Family], Mapping[str, Item]]) -> None:
        self._of = of
        self._ours = _joined(of, OURS)

    def __getitem__(self, name: str) -> Item:
        return self._ours[name] if name in self._ours else self._all[name]

    def __contains__(self, name: object) -> bool:
        return name in self._ours or name in self._all

    def __iter__(self) -> Iterator[str]:
        return iter(self._all if every_family.cache_info().currsize else self._ours)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    @property
    def _all(self) -> Mapping[str, Item]:
        return _joined(self._of, every_family())


def _joined(of: Callable[[Family], Mapping[str, Item]], families: tuple[Family, ...]) -> dict[str, Item]:
    items: dict[str, Item] = {}
    for family in families:
        items.update((name, item) for name, item in of(family).items() if name not in items)
    return items


@cache
def every_family() -> tuple[Family, ...]:
    """Return our own families, and those of other distributions. Raises ParameterError that names the entry point."""
    found = list(OURS)
    for name, entry in installed(GROUP).items():
        family: Family = loaded(GROUP, name, "motor family", Family)
        known = {name for other in found for name in (other.name, *other.motors)}
        if taken := {family.name, *family.motors} & known:
            raise ParameterError(
                "motor family", name, f"without {', '.join(sorted(taken))}, taken by another: {entry.value} of {GROUP}"
            )
        found.append(family)
    return tuple(found)


FAMILIES: Mapping[str, Family] = ByName(lambda family: {family.name: family})
MOTORS: Mapping[str, MotorSpec] = ByName(lambda family: family.motors)
FORMATS: Mapping[str, WireFormat] = ByName(lambda family: family.formats)  # of a name that several have, the first


def format_of(motor: str, name: str) -> WireFormat:
    """Return the wire format `name` of a motor. Raises ParameterError if its family has none of that name."""
    formats = FAMILIES[MOTORS[motor].family].formats
    if name not in formats:
        raise ParameterError("wire_format", name, f"{' or '.join(formats)} for a {motor}")
    return formats[name]
