# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What an arm from a URDF holds: a load in its hand, and a wearer's arm on its links.

Both are points of mass. A wearer's segment lies on the line from its link's joint to the next joint, or from the last
joint to the hand. First moments of a wearer's arm, as `calibrate wearer` finds them, take the place of its points in
all but the inertia: they move the links' centres of gravity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.arm.arm_data import NO_PAYLOAD
from exo_gravity.core.errors import ParameterError


class Bodies(NamedTuple):
    """The links of an arm in models of Pinocchio."""

    pin: Any  #: the module pinocchio
    joints: Sequence[int]  #: (n,) numbers of their joints
    names: Sequence[str]  #: (n,) of the joints
    ways: Sequence[np.ndarray]  #: (n,) the way (3,) in m to the next joint or the hand, in the frame of each joint
    hand: str  #: link that holds the load; '' for none

    def shifted(self, model: Any, moments: np.ndarray, what: str) -> Any:
        """Return a copy of `model` whose links have these `moments` (n, 3) kg m more: their centres of gravity move.

        Raises ParameterError that names `what` if a link without mass has one.
        """
        shifted = model.copy()
        for joint, name, own in zip(self.joints, self.names, moments, strict=True):
            link = shifted.inertias[joint]
            if any(own) and not link.mass:
                raise ParameterError(f"{what} of {name}", own.tolist(), "0: its link has no mass in the URDF")
            if any(own):
                shifted.inertias[joint] = self.pin.Inertia(link.mass, link.lever + own / link.mass, link.inertia)
        return shifted

    def add(self, model: Any, joint: int, mass: float, place: np.ndarray) -> None:
        """Add a point of `mass` kg to the link of `joint`, at `place` (3,) m in the joint's frame."""
        point = self.pin.Inertia(mass, place, np.zeros((3, 3)))
        model.appendBodyToJoint(joint, point, self.pin.SE3.Identity())


@dataclass(frozen=True)
class Held:
    """What an arm of n joints holds."""

    payload: tuple[float, float, float, float] = NO_PAYLOAD  #: kg, and its centre of gravity in m in the hand's frame
    worn: tuple[tuple[float, float], ...] = ()  #: (n,) kg of the wearer's segment, and m from the link's joint
    moments: tuple[tuple[float, ...], ...] = ()  #: (n, 3) kg m of the wearer's arm, in place of `worn`

    @property
    def mass(self) -> float:
        """Kg of load and wearer."""
        return self.payload[0] + sum(mass for mass, _ in self.worn)

    def on(self, bodies: Bodies, bare: Any) -> tuple[Any, Any]:
        """Return Pinocchio's model `bare` with all that is held: for the inertia, and for gravity."""
        model = bare.copy()
        mass, *place = self.payload
        if mass:
            frame = model.frames[model.getBodyId(bodies.hand)]
            bodies.add(model, frame.parentJoint, mass, frame.placement.act(np.array(place)))
        for joint, (worn, cog), way in zip(bodies.joints, self.worn, bodies.ways, strict=False):
            if worn:
                bodies.add(model, joint, worn, way * (cog / np.linalg.norm(way)))
        if not any(map(any, self.moments)):
            return model, model
        return model, bodies.shifted(model, np.array(self.moments), "wearer.moment")
