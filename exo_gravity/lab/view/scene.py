# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a viewer shows around the arms: gravity, the torque and the limits of each joint, and the state of each arm.

Every shape is given in the trunk's axes, so that a viewer needs no transforms for it. A joint's range is an arc around
its axis, and its torque a second, smaller arc, which spans `SIZES.torque_span` at the joint's torque limit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.numbers import Vector
from exo_gravity.core.safety.drive import CARRYING, State
from exo_gravity.core.safety.limits import WALL
from exo_gravity.lab.view.urdf import Described

Colour = tuple[float, float, float, float]

ARROW, LINE, TEXT, SPHERE = "arrow", "line", "text", "sphere"
GREEN, AMBER, RED = (0.20, 0.70, 0.30, 1.0), (0.95, 0.65, 0.10, 1.0), (0.85, 0.15, 0.15, 1.0)
GREY, BLUE = (0.60, 0.60, 0.60, 1.0), (0.20, 0.45, 0.85, 1.0)


@dataclass(frozen=True)
class Sizes:
    """How large each shape is."""

    range_radius: float = 0.11  #: m
    torque_radius: float = 0.075  #: m
    torque_span: float = math.radians(270.0)  #: rad, of the arc of a joint at its torque limit
    arc_step: float = math.radians(6.0)  #: rad between two points of an arc
    gravity_from: tuple[float, float, float] = (0.30, 0.0, 0.10)  #: m, in front of the chest
    gravity_length: float = 0.25  #: m
    state_height: float = 0.20  #: m above the shoulder
    limit_width: float = 0.004  #: m
    torque_width: float = 0.016  #: m
    arrow_width: float = 0.012  #: m
    text_height: float = 0.035  #: m
    sphere_size: float = 0.05  #: m, diameter


SIZES = Sizes()


RESTING = 0.05  # rad/s, below which a carried arm is held; twice the step of the motors' speed


class Shape(NamedTuple):
    """One thing to draw.

    group: 'gravity', 'torques', 'limits' or 'states'.
    kind: ARROW from the first point to the second, LINE through the points, TEXT or SPHERE at the first point.
    points: (n, 3) m.
    size: m, width of a line, height of a text, diameter.
    """

    group: str
    kind: str
    points: np.ndarray
    size: float
    colour: Colour
    text: str = ""


class ArmView(NamedTuple):
    """What is known of one arm now."""

    arm: Described
    theta: Sequence[float]  #: (n,) rad
    velocity: Sequence[float]  #: (n,) rad/s
    effort: Sequence[float]  #: (n,) Nm, as the motors report it
    state: str  #: of its bridge, '' if not known
    message: str = ""  #: of its bridge


def gravity_shapes(gravity: Vector | None) -> list[Shape]:
    """Return the arrow of gravity for its unit vector (3,) in the trunk's axes; None: the tilt is not known."""
    if gravity is None:
        return [Shape("gravity", TEXT, np.array([SIZES.gravity_from]), SIZES.text_height, RED, "no tilt")]
    points = np.array((SIZES.gravity_from, np.add(SIZES.gravity_from, np.multiply(SIZES.gravity_length, gravity))))
    return [Shape("gravity", ARROW, points, SIZES.arrow_width, BLUE)]


def arm_shapes(view: ArmView) -> list[Shape]:
    """Return what is drawn around one arm: range and torque of each joint, and what the arm's bridge does."""
    limits, shapes = view.arm.limits, []
    for n, (origin, axis, along) in enumerate(zip(*view.arm.pose(view.theta), strict=False)):
        low, high = limits.position_min[n] - view.theta[n], limits.position_max[n] - view.theta[n]
        colour = GREY if low + WALL.width <= 0.0 <= high - WALL.width else RED
        tip = origin + SIZES.range_radius * along
        shapes.append(
            Shape("limits", LINE, _arc(origin, axis, along, low, high, SIZES.range_radius), SIZES.limit_width, colour)
        )
        shapes.append(Shape("limits", LINE, np.array((origin, tip)), SIZES.limit_width, colour))
        effort, limit = view.effort[n], limits.max_effort[n]
        share = max(-1.0, min(1.0, effort / limit)) if limit > 0.0 else 0.0
        arc = _arc(origin, axis, along, 0.0, share * SIZES.torque_span, SIZES.torque_radius)
        strength = RED if abs(share) >= 1.0 else AMBER if abs(share) > 0.5 else GREEN
        shapes.append(Shape("torques", LINE, arc, SIZES.torque_width, strength))
        shapes.append(
            Shape("torques", TEXT, tip[None], SIZES.text_height, strength, f"{round(effort, 2) + 0.0:.2f} Nm")
        )
    colour, state = state_of(view)
    above = np.add([view.arm.base], (0.0, 0.0, SIZES.state_height))
    shapes.append(Shape("states", SPHERE, above, SIZES.sphere_size, colour))
    over = np.add(above, (0.0, 0.0, SIZES.sphere_size))
    return [*shapes, Shape("states", TEXT, over, SIZES.text_height, colour, f"{view.arm.side}: {state}")]


def state_of(view: ArmView) -> tuple[Colour, str]:
    """Return the colour and the words for what the arm's bridge does: 'active, holding' or the latched fault."""
    if view.state == State.ACTIVE.value:
        return GREEN, "active, holding" if max(map(abs, view.velocity)) < RESTING else "active, moving"
    if view.state == State.FAULT.value:
        return RED, view.message or view.state
    powered = view.state in {state.value for state in (*CARRYING, State.LETTING_DOWN)}
    return (AMBER if powered else GREY), view.state or view.message or "no state"


def _arc(
    origin: np.ndarray, axis: np.ndarray, along: np.ndarray, start: float, end: float, radius: float
) -> np.ndarray:
    """Return points (n, 3) on the arc around `axis` from angle `start` to `end` in rad from the direction `along`."""
    angles = np.linspace(start, end, 2 + int(abs(end - start) / SIZES.arc_step))[:, None]
    return np.asarray(origin + radius * (np.cos(angles) * along + np.sin(angles) * np.cross(axis, along)))
