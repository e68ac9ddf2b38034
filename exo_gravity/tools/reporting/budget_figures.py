"""The picture of a joint's torque budget: how much of the workspace asks for how much torque, and where."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from exo_gravity.core.budget import torque_at

if TYPE_CHECKING:
    from exo_gravity.tools.budget import Arm

# Okabe and Ito (2008): told apart with any colour vision.
ALONE, CARRYING, RATED, PEAK, INK = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#222222"
CELLS = 31
REST = 60  # random settings of the angles that a map does not show, beside their ends and zeros; the same for each cell
# Beside the joint's own angle a map shows the one that matters most to it, by joint.
OTHER = (1, 2, 3, 2)


def joint_figure(arm: Arm, joint: int, name: str) -> Figure:
    """Return the picture of one joint (0..3), called `name`."""
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    figure.suptitle(f"{arm.name} joint {joint + 1}, {name}: {arm.motors[joint]}", x=0.01, ha="left", weight="bold")
    shares, where = figure.subplots(1, 2, width_ratios=(1.1, 1.0))
    _shares(shares, arm, joint)
    _where(figure, where, arm, joint)
    return figure


def _shares(axis: Axes, arm: Arm, joint: int) -> None:
    """Draw the share of the workspace that needs at most a torque, for the robot alone and at the support asked for."""
    points = arm.workspace.points()
    carrying = arm.robot.with_wearer(*arm.load, arm.support)
    percent = np.linspace(0.0, 100.0, len(points))
    for model, colour, label in (
        (arm.robot, ALONE, "robot alone (One-G)"),
        (carrying, CARRYING, f"with the wearer's arm at support {arm.support:g}"),
    ):
        axis.plot(np.sort(np.abs(torque_at(model, points)[:, joint])), percent, color=colour, lw=1.8, label=label)
    for limit, colour, label in ((arm.joints[joint].rated, RATED, "rated"), (arm.joints[joint].peak, PEAK, "peak")):
        axis.axvline(limit, color=colour, lw=1.2, ls="--", label=f"{label}: {limit:g} Nm")
    axis.set_xlim(0.0, 1.05 * max(arm.joints[joint].torque, arm.joints[joint].peak))
    axis.set_ylim(0.0, 102.0)
    axis.set_xlabel("Torque (Nm)")
    axis.set_ylabel("Share of the workspace that needs at most this (%)")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(loc="lower right", edgecolor="none", framealpha=0.9)


def _where(figure: Figure, axis: Axes, arm: Arm, joint: int) -> None:
    """Map the largest torque over two joint angles, whatever the other angles and the trunk do."""
    other = OTHER[joint]
    low, high = arm.workspace.bounds
    across, up = (np.linspace(low[n], high[n], CELLS) for n in (joint, other))
    ends = np.array(list(product(*(sorted({a, min(max(0.0, a), b), b}) for a, b in zip(low, high, strict=True)))))
    ends = ends[(ends[:, joint] == low[joint]) & (ends[:, other] == low[other])]
    rest = np.vstack((arm.workspace.points(REST), ends, arm.joints[joint].worst))
    points = np.tile(rest, (CELLS * CELLS, 1))
    grid = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
    points[:, [joint, other]] = np.repeat(grid, len(rest), axis=0)
    torque = np.abs(torque_at(arm.robot.with_wearer(*arm.load, arm.support), points)[:, joint])
    largest = torque.reshape(CELLS, CELLS, len(rest)).max(axis=-1)
    mesh = axis.pcolormesh(np.degrees(across), np.degrees(up), largest, cmap="cividis", vmin=0.0, shading="gouraud")
    figure.colorbar(mesh, ax=axis, label=f"Largest torque at support {arm.support:g} (Nm)")
    for limit, style in ((arm.joints[joint].rated, "-"), (arm.joints[joint].peak, ":")):
        if largest.min() < limit < largest.max():
            lines = axis.contour(np.degrees(across), np.degrees(up), largest, [limit], colors="white", linestyles=style)
            outline = [withStroke(linewidth=2.5, foreground=INK)]
            lines.set_path_effects(outline)
            for text in axis.clabel(lines, fmt=f"{limit:g} Nm"):
                text.set_path_effects(outline)
    axis.set_title("whatever the other joints and the trunk do", fontsize=10)
    axis.set_xlabel(f"Joint {joint + 1} (deg)")
    axis.set_ylabel(f"Joint {other + 1} (deg)")
