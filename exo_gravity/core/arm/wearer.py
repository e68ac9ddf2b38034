# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The wearer's arm: body mass and segment lengths -> the mass that each link of the robot carries.

Body segment tables give a segment's mass as a share of body mass, and its centre of gravity as a share of the segment's
length from the proximal joint. Mass and centre always come from the same table:

    de_leva   P. de Leva, J. Biomech. 29 (1996): scans of young adults; the hand ends at the third metacarpal
    winter    D. A. Winter, Biomechanics and Motor Control of Human Movement: cadavers, same values for both sexes

Of the paper's arm, link 3 carries the upper arm and link 4 the forearm and hand; its joints 3 and 4 turn about the
wearer's shoulder and elbow. On another arm the user says which links do. A table is an average: a person's arm can
differ from it by more than 10 %.

Skin, muscles and capsule of a relaxed joint pull it towards a rest angle, in the middle of its range nearly as a spring
(`springs.Springs`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import Vector, floats, one_float

SEX = ("female", "male")
_WINTER = ((0.028, 0.436), (0.016, 0.430), (0.006, 0.506))
# Table -> sex -> upper arm, forearm, hand: mass as a share of body mass, centre of gravity as a share of the length.
TABLES = {
    "de_leva": {
        "female": ((0.0255, 0.5754), (0.0138, 0.4559), (0.0056, 0.7474)),
        "male": ((0.0271, 0.5772), (0.0162, 0.4574), (0.0061, 0.7900)),
    },
    "winter": {"female": _WINTER, "male": _WINTER},
}
# m, rounded values of an adult man: shoulder to elbow, elbow to wrist, wrist to third knuckle. Prefer measured lengths.
TYPICAL_LENGTH = (0.28, 0.27, 0.086)
PAPER_LINKS = (3, 4)
TYPICAL_PLACE = (0.55, 0.6)  # share of link 3 and of link 4 at which the table has the centres of gravity
TISSUE_REACH = 2.0  # rad from the rest angle, beyond which a spring that was found in the middle says nothing
MAX_TISSUE = 4.0  # Nm/rad; the motors push a joint away from its rest angle with what the tissue does not have of it


class LinkLoad(NamedTuple):
    """The wearer's mass on each link of the robot."""

    mass: np.ndarray  #: (n,) kg
    cog: np.ndarray  #: (n,) m from joint n along link n


def load_by_moments(length: Vector, first_moment: Vector) -> LinkLoad:
    """Return the masses at typical places of links 3 and 4 that have the moments M3 and M4, for the inertia alone.

    length: (4,) m. first_moment: M1..M4 in kg m that the wearer's arm adds.
    """
    (_, _, upper, lower), (_, _, whole, outer) = length, first_moment
    places = TYPICAL_PLACE[0] * upper, TYPICAL_PLACE[1] * lower
    forearm = outer / places[1] if lower else 0.0
    arm = max(0.0, whole - forearm * upper) / places[0] if upper else 0.0
    return LinkLoad(np.array((0.0, 0.0, arm, forearm)), np.array((0.0, 0.0, *places)))


@dataclass(frozen=True)
class Wearer:
    """The body data that determine the weight of a wearer's arm. Raises ParameterError that names the invalid value."""

    body_mass: float  #: kg
    sex: str = "male"  #: 'female' or 'male'
    table: str = "de_leva"  #: or 'winter'
    segment_length: Sequence[float] = TYPICAL_LENGTH  #: (3,) m, upper arm, forearm, hand (wrist to third knuckle)

    def __post_init__(self) -> None:
        object.__setattr__(self, "body_mass", one_float("body_mass", self.body_mass, 10.0, 300.0, "kg"))
        for name, value, choices in (("sex", self.sex, SEX), ("table", self.table, tuple(TABLES))):
            if value not in choices:
                raise ParameterError(name, value, f"one of {', '.join(choices)}")
        lengths = floats("segment_length", self.segment_length, 3, 0.0, 0.6, "m")
        object.__setattr__(self, "segment_length", tuple(lengths.tolist()))

    def on_links(self, link_length: Vector, links: Sequence[int] = PAPER_LINKS) -> LinkLoad:
        """Return the load of this wearer's arm on a robot with links of `link_length` (n,) m.

        links: which of them, from 1 on, carry the upper arm, and forearm and hand; 0: the robot does not carry it. What
        lies beyond its link is on the links that follow, up to that of the next segment; forearm and hand then each at
        their own place.

        Raises ParameterError if there is no such link, or if the centre of gravity of a segment lies beyond them all.
        """
        upper_arm, forearm, hand = self.segments
        elbow_to_wrist = self.segment_length[1]
        lower = forearm[0] + hand[0]
        moment = forearm[0] * forearm[1] + hand[0] * (elbow_to_wrist + hand[1])  # about the elbow
        length, count = [*map(float, link_length)], len(link_length)
        load = LinkLoad(np.zeros(count), np.zeros(count))
        if len(links) != 2 or not all(0 <= link <= count for link in links) or links[0] == links[1]:
            raise ParameterError(
                "wearer.links", [*links], f"2 different links from 1 to {count}, or 0; body mass 0: no wearer"
            )
        first, second = links
        if first:
            _place(load, length, first, second - 1 if second > first else count, "the upper arm", upper_arm)
        if second:
            last = first - 1 if first > second else count
            whole, what = (lower, moment / lower), "the forearm and hand"
            is_split = whole[1] > length[second - 1] and last > second
            parts = (forearm, (hand[0], elbow_to_wrist + hand[1])) if is_split else (whole,)
            for part in parts:
                _place(load, length, second, last, what, part)
        return load

    @property
    def segments(self) -> tuple[tuple[float, float], ...]:
        """Mass in kg and centre of gravity in m from the proximal joint of the upper arm, forearm and hand."""
        rows = zip(TABLES[self.table][self.sex], self.segment_length, strict=True)
        return tuple((self.body_mass * mass, length * cog) for (mass, cog), length in rows)


def _place(
    load: LinkLoad, length: Sequence[float], first: int, last: int, what: str, part: tuple[float, float]
) -> None:
    """Add a part, kg and m from the joint of link `first`, to one of the links up to `last`. Raises ParameterError."""
    (mass, centre), link = part, first
    while centre > length[link - 1] and link < last:
        centre, link = centre - length[link - 1], link + 1
    if centre > length[link - 1]:
        beyond = f"the centre of gravity of {what} is at {part[1]:.3f} m, beyond link {link}"
        raise ParameterError("link_length", [*length], f"long enough for the wearer: {beyond}; body mass 0: no wearer")
    moment = load.mass[link - 1] * load.cog[link - 1] + mass * centre
    load.mass[link - 1] += mass
    load.cog[link - 1] = moment / load.mass[link - 1]
