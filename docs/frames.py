# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Draws docs/frames.png: the arm's frames and joint axes by Table 1 of the paper, hanging and in one pose.

`python docs/frames.py` renews it. Needs the extra `report`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

LENGTH = (0.05, 0.13, 0.30, 0.30)  # m
ALPHA = (-np.pi / 2, np.pi / 2, 0.0, 0.0)
OFFSET = (0.0, -np.pi / 2, 0.0, 0.0)
HANGING = (0.0, 0.0, 0.0, 0.0)
RAISED = (0.0, 1.1, 0.6, 0.9)
LABEL_OFFSET = {"x": np.array((0.0, 0.04, 0.0)), "z": np.array((0.0, -0.03, 0.0))}  # m from the arrow to its name
COLOURS = {"x": "#D55E00", "z": "#0072B2"}  # Okabe and Ito (2008)
# Columns: the base axes x0 (left), y0 (forward) and z0 (down) of a left arm in the picture's axes, in which z is up.
BASE = np.array(((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))


def link(theta: float, length: float, alpha: float, offset: float) -> np.ndarray:
    """Return frame n in frame n - 1, (4, 4), by standard Denavit-Hartenberg with d = 0."""
    c, s, ca, sa = np.cos(theta + offset), np.sin(theta + offset), np.cos(alpha), np.sin(alpha)
    return np.array(
        ((c, -s * ca, s * sa, length * c), (s, c * ca, -c * sa, length * s), (0.0, sa, ca, 0.0), (0.0, 0.0, 0.0, 1.0))
    )


def frames(theta: Sequence[float]) -> list[np.ndarray]:
    """Return the base frame and the frames of the four links, (4, 4) each, at theta (4,) rad, in the picture's axes."""
    base = np.eye(4)
    base[:3, :3] = BASE
    poses = [base]
    for joint in zip(theta, LENGTH, ALPHA, OFFSET, strict=True):
        poses.append(poses[-1] @ link(*joint))
    return poses


def draw_arm(axes: Axes3D, theta: Sequence[float], title: str) -> None:
    """Draw the links, the axes x_n and z_n of each frame, and gravity."""
    poses = frames(theta)
    for near, far in pairwise(poses):
        axes.plot(*np.stack((near[:3, 3], far[:3, 3]), axis=1), color="0.25", lw=4, solid_capstyle="round")
    for n, pose in enumerate(poses):
        origin = pose[:3, 3]
        axes.scatter(*origin, color="k", s=18)
        # x0 lies on link 1, and z4 is parallel to z3 and no joint's axis
        for name, column in (("x", 0),) if n == 4 else (("z", 2),) if n == 0 else (("x", 0), ("z", 2)):
            arrow = 0.12 * pose[:3, column]
            axes.quiver(*origin, *arrow, color=COLOURS[name], arrow_length_ratio=0.25, lw=1.6)
            axes.text(
                *(origin + 1.25 * arrow + LABEL_OFFSET[name]),
                f"${name}_{n}$",
                color=COLOURS[name],
                ha="center",
                va="center",
            )
    axes.quiver(0.0, -0.24, 0.0, 0.0, 0.0, -0.2, color="0.5", lw=2.5, arrow_length_ratio=0.2)
    axes.text(0.0, -0.24, -0.25, "gravity", color="0.4", ha="center")
    axes.set_title(title, fontsize=11, y=0.0)
    axes.set_box_aspect((1, 1, 1), zoom=1.35)
    axes.set(xlim=(-0.3, 0.5), ylim=(-0.2, 0.6), zlim=(-0.76, 0.04), xticks=[], yticks=[], zticks=[])
    axes.set_axis_off()
    axes.view_init(elev=18, azim=35)


def draw() -> Figure:
    """Return the figure."""
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    for place, theta in enumerate((HANGING, RAISED), 1):
        axes = figure.add_subplot(1, 2, place, projection="3d")
        assert isinstance(axes, Axes3D)
        draw_arm(axes, theta, f"$\\theta$ = ({', '.join(f'{angle:g}' for angle in theta)}) rad")
    return figure


if __name__ == "__main__":
    draw().savefig(Path(__file__).with_name("frames.png"), dpi=110)
