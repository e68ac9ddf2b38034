"""The look of all figures: plain axes, and the palette of Okabe and Ito (2008), told apart with any colour vision."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

JOINT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
INK, FAINT, GRID_LINE = "#222222", "#9AA3AB", "#D5DADF"
HOLD_COLOUR, PUSH_COLOUR = "#E8EEF4", "#F9E3B4"


def make_plain(axis: Axes) -> None:
    """Leave two spines and faint horizontal lines."""
    axis.spines[["top", "right"]].set_visible(False)
    axis.spines[["left", "bottom"]].set_color(FAINT)
    axis.tick_params(color=FAINT, labelcolor=INK, labelsize=9)
    axis.grid(axis="y", color=GRID_LINE, lw=0.5)
    axis.set_axisbelow(True)
