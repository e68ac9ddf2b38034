# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Draws docs/states.svg: the states of an arm, from the machine's table of transitions.

`python docs/states.py` renews it; with `--check` it only fails where the picture differs. A transition without a route,
a route without a transition, and an arrow that passes behind the box of another state are errors.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from exo_gravity.core.safety.command import TRANSITIONS, State

Point = tuple[float, float]
Arrow = tuple[State, State]
PICTURE = Path(__file__).with_name("states.svg")
LEFT, WIDTH, HEIGHT = -40.0, 1010.0, 460.0  # of the picture, px; its top is at 0
BOX = 130.0, 40.0
LINE = 15.0  # from line to line of a label
PLACE: dict[State, Point] = {
    State.DISABLED: (80.0, 120.0),
    State.CHECKING: (290.0, 120.0),
    State.PROVING: (500.0, 120.0),
    State.RAMPING_IN: (710.0, 120.0),
    State.ACTIVE: (890.0, 120.0),
    State.FAULT: (290.0, 330.0),
    State.LETTING_DOWN: (710.0, 330.0),
}
OFF, PROVING, CARRIED = "#e8e8e8", "#fff1cc", "#d5e8f7"
FILL = {
    State.PROVING: PROVING,
    State.RAMPING_IN: CARRIED,
    State.ACTIVE: CARRIED,
    State.LETTING_DOWN: CARRIED,
}
LEGEND = ((OFF, "motors off"), (PROVING, "any fault: motors off"), (CARRIED, "any fault: damped lowering"))


class Route(NamedTuple):
    """The way of an arrow, and where the first line of its label stands."""

    points: tuple[Point, ...]
    label: Point
    anchor: str = "middle"


ROUTES: dict[Arrow, Route] = {
    (State.DISABLED, State.CHECKING): Route(((145, 110), (225, 110)), (185, 103)),
    (State.CHECKING, State.DISABLED): Route(((225, 130), (145, 130)), (185, 146)),
    (State.CHECKING, State.PROVING): Route(((355, 120), (435, 120)), (395, 113)),
    (State.PROVING, State.RAMPING_IN): Route(((565, 120), (645, 120)), (605, 98)),
    (State.RAMPING_IN, State.ACTIVE): Route(((775, 120), (825, 120)), (800, 98)),
    (State.PROVING, State.DISABLED): Route(((500, 100), (500, 40), (80, 40), (80, 100)), (290, 33)),
    (State.DISABLED, State.FAULT): Route(((110, 140), (110, 320), (225, 320)), (167, 313)),
    (State.FAULT, State.DISABLED): Route(((225, 340), (80, 340), (80, 140)), (152, 356)),
    (State.CHECKING, State.FAULT): Route(((270, 140), (270, 310)), (264, 230), "end"),
    (State.PROVING, State.FAULT): Route(((480, 140), (480, 255), (320, 255), (320, 310)), (400, 248)),
    (State.CHECKING, State.LETTING_DOWN): Route(((310, 140), (310, 190), (670, 190), (670, 310)), (575, 183)),
    (State.DISABLED, State.LETTING_DOWN): Route(((40, 140), (40, 390), (690, 390), (690, 350)), (440, 383)),
    (State.LETTING_DOWN, State.DISABLED): Route(
        ((730, 350), (730, 430), (-15, 430), (-15, 120), (15, 120)), (440, 423)
    ),
    (State.LETTING_DOWN, State.FAULT): Route(((645, 320), (355, 320)), (500, 313)),
    (State.FAULT, State.LETTING_DOWN): Route(((355, 342), (645, 342)), (500, 357)),
    (State.RAMPING_IN, State.LETTING_DOWN): Route(((720, 140), (720, 310)), (727, 225), "start"),
    (State.ACTIVE, State.LETTING_DOWN): Route(((890, 140), (890, 330), (775, 330)), (897, 225), "start"),
}


def arrows() -> dict[Arrow, list[str]]:
    """Return the events of each arrow from one state to another."""
    events: dict[Arrow, list[str]] = defaultdict(list)
    for (state, event), following in TRANSITIONS.items():
        events[state, following].append(event.value)
    return events


def is_hidden(begin: Point, end: Point, centre: Point) -> bool:
    """Whether a horizontal or vertical line passes inside the box with this centre, not only along its edge."""
    spans = (sorted((begin[axis], end[axis])) for axis in (0, 1))
    return all(
        low < centre[axis] + BOX[axis] / 2.0 and high > centre[axis] - BOX[axis] / 2.0
        for axis, (low, high) in enumerate(spans)
    )


def check() -> None:
    """Raise ValueError if the routes do not fit the transitions, or one passes behind a box."""
    if odd := {*ROUTES} ^ {*arrows()}:
        raise ValueError(f"ROUTES: must have each transition once, wrong are {sorted(odd)}")
    for arrow, route in ROUTES.items():
        for begin, end in pairwise(route.points):
            for state, centre in PLACE.items():
                if is_hidden(begin, end, centre):
                    raise ValueError(f"the arrow {arrow} passes behind {state}")


def text(at: Point, lines: list[str], anchor: str = "middle", weight: str = "normal") -> str:
    """Return lines of text, the first with its baseline at this point."""
    spans = "".join(f'<tspan x="{at[0]:g}" dy="{LINE * (n > 0):g}">{line}</tspan>' for n, line in enumerate(lines))
    return f'<text x="{at[0]:g}" y="{at[1]:g}" text-anchor="{anchor}" font-weight="{weight}">{spans}</text>'


def drawing() -> str:
    """Return the picture as SVG."""
    check()
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{LEFT:g} 0 {WIDTH:g} {HEIGHT:g}" '
        f'font-family="sans-serif" font-size="13">',
        "<title>The states of an arm and the events that lead from one to another</title>",
        '<marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0 0L10 5L0 10z" fill="#444"/></marker>',
        f'<rect x="{LEFT:g}" width="{WIDTH:g}" height="{HEIGHT:g}" fill="white"/>',
    ]
    for arrow, events in arrows().items():
        route = ROUTES[arrow]
        way = " ".join(f"{x:g},{y:g}" for x, y in route.points)
        parts.append(f'<polyline points="{way}" fill="none" stroke="#444" stroke-width="1.3" marker-end="url(#head)"/>')
        lines = [line for event in events for line in event.replace(", ", ",\n").split("\n")]
        parts.append(text(route.label, lines, route.anchor))
    for state, (x, y) in PLACE.items():
        corner = f'x="{x - BOX[0] / 2.0:g}" y="{y - BOX[1] / 2.0:g}" width="{BOX[0]:g}" height="{BOX[1]:g}"'
        parts.append(f'<rect {corner} rx="7" fill="{FILL.get(state, OFF)}" stroke="#444"/>')
        parts.append(text((x, y + 5.0), [state.value], weight="bold"))
    for n, (colour, meaning) in enumerate(LEGEND):
        y = 385.0 + 24.0 * n
        parts.append(f'<rect x="765" y="{y:g}" width="18" height="14" rx="3" fill="{colour}" stroke="#444"/>')
        parts.append(text((791.0, y + 12.0), [meaning], "start"))
    return "\n".join([*parts, "</svg>", ""])


if __name__ == "__main__":
    if "--check" not in sys.argv:
        PICTURE.write_text(drawing(), encoding="utf-8")
    elif PICTURE.read_text(encoding="utf-8") != drawing():
        raise SystemExit("docs/states.svg differs from the transitions; run python docs/states.py")
