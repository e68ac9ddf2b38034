"""Draws docs/states.svg: the states of an arm, from the machine's table of transitions.

`python docs/states.py` renews it. Needs the extra `report`. A state or a transition that has no place here is an error.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.transitions import TRANSITIONS

PLACE = {
    State.DISABLED: (0.0, 0.0),
    State.CHECKING: (3.6, 0.0),
    State.PROVING: (7.2, 0.0),
    State.RAMPING_IN: (10.8, 0.0),
    State.ACTIVE: (14.4, 0.0),
    State.LETTING_DOWN: (10.8, -3.6),
    State.FAULT: (3.6, -3.6),
}
OFF, PROVING, CARRIED = "#e8e8e8", "#fff1cc", "#d5e8f7"
COLOUR = {
    State.PROVING: PROVING,
    State.RAMPING_IN: CARRIED,
    State.ACTIVE: CARRIED,
    State.LETTING_DOWN: CARRIED,
}
WIDTH, HEIGHT = 2.0, 0.7
BEND = 0.12  # of two arrows between the same states
BENT = {
    (State.PROVING, State.DISABLED): 0.38,
    (State.DISABLED, State.LETTING_DOWN): 0.6,
    (State.LETTING_DOWN, State.DISABLED): -0.09,
    (State.DISABLED, State.CHECKING): 0.8,
    (State.CHECKING, State.DISABLED): 0.8,
}
Arrow = tuple[State, State]


def arrows() -> dict[Arrow, list[str]]:
    """Return the events of each arrow from one state to another."""
    events: dict[Arrow, list[str]] = defaultdict(list)
    for (state, event), following in TRANSITIONS.items():
        events[state, following].append(event.value)
    return events


def draw_state(axes: Axes, state: State) -> None:
    """Draw the box of a state."""
    x, y = PLACE[state]
    corner = x - WIDTH / 2.0, y - HEIGHT / 2.0
    style = "round,pad=0.02,rounding_size=0.12"
    axes.add_patch(FancyBboxPatch(corner, WIDTH, HEIGHT, boxstyle=style, facecolor=COLOUR.get(state, OFF), zorder=2))
    axes.text(x, y, state.value, ha="center", va="center", fontsize=10, weight="bold", zorder=3)


def draw_arrow(axes: Axes, arrow: Arrow, events: list[str], has_opposite: bool) -> None:
    """Draw an arrow with its events."""
    bend = BENT.get(arrow, BEND if has_opposite else 0.0)
    (x, y), (x_to, y_to) = (PLACE[state] for state in arrow)
    begin, end = edge((x, y), (x_to, y_to)), edge((x_to, y_to), (x, y))
    axes.add_patch(
        FancyArrowPatch(
            begin, end, connectionstyle=f"arc3,rad={bend}", arrowstyle="-|>", mutation_scale=13, color="0.3", lw=1.1
        )
    )
    # The middle of a quadratic curve whose control point is offset from the middle of the chord.
    middle = (begin[0] + end[0]) / 2.0, (begin[1] + end[1]) / 2.0
    across = end[1] - begin[1], begin[0] - end[0]
    at = middle[0] + 0.5 * bend * across[0], middle[1] + 0.5 * bend * across[1]
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.9}
    axes.text(*at, ",\n".join(events).replace(", ", ",\n"), ha="center", va="center", fontsize=8, zorder=4, bbox=box)


def edge(box: tuple[float, float], towards: tuple[float, float]) -> tuple[float, float]:
    """Return the point on the edge of the box at `box` that faces `towards`."""
    dx, dy = towards[0] - box[0], towards[1] - box[1]
    scale = 1.0 / max(abs(dx) / (WIDTH / 2.0 + 0.06), abs(dy) / (HEIGHT / 2.0 + 0.06))
    return box[0] + scale * dx, box[1] + scale * dy


def draw() -> Figure:
    """Return the figure."""
    figure = Figure(figsize=(11.0, 5.2), layout="constrained")
    axes = figure.add_subplot()
    shown = arrows()
    for arrow, events in shown.items():
        draw_arrow(axes, arrow, events, arrow[::-1] in shown)
    for state in State:
        draw_state(axes, state)
    for n, (colour, text) in enumerate(
        ((OFF, "motors off"), (PROVING, "any fault: motors off"), (CARRIED, "any fault: damped lowering"))
    ):
        axes.text(13.3, -2.9 - 0.6 * n, text, fontsize=9, bbox={"facecolor": colour, "boxstyle": "round"})
    axes.set(xlim=(-1.2, 16.4), ylim=(-6.0, 1.9))
    axes.set_axis_off()
    axes.set_aspect("equal")
    return figure


if __name__ == "__main__":
    matplotlib.rcParams["svg.hashsalt"] = "states"  # the same picture is the same file
    path = Path(__file__).with_name("states.svg")
    draw().savefig(path, metadata={"Date": None})
