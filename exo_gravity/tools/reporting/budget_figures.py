"""The figure of a joint's torque budget: how much of the workspace needs how much torque, and where."""

from __future__ import annotations

from itertools import product

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import AbstractPathEffect, withStroke

from exo_gravity.core.model.budget import torque_at
from exo_gravity.tools.reporting.budget_table import JOINTS, ArmBudget
from exo_gravity.tools.reporting.colours import ALONE_COLOUR, CARRYING_COLOUR, INK, PEAK_COLOUR, RATED_COLOUR

CELLS = 31  # of a map, along each axis
REST = 60  # random settings of the angles that a map does not show, the same for each cell
OTHER = (1, 2, 3, 2)  # the second axis of each joint's map: the angle that affects it most


def joint_figure(arm: ArmBudget, joint: int) -> Figure:
    """Return the figure of one joint (0..3)."""
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    title = f"{arm.name} joint {joint + 1}, {JOINTS[joint]}: {arm.motors[joint]}"
    figure.suptitle(title, x=0.01, ha="left", weight="bold")
    shares, where = figure.subplots(1, 2, width_ratios=(1.1, 1.0))
    _shares(shares, arm, joint)
    _where(figure, where, arm, joint)
    return figure


def _shares(axis: Axes, arm: ArmBudget, joint: int) -> None:
    """Draw the share of the workspace that needs at most a torque, for the robot alone and at the chosen support."""
    points = arm.workspace.points()
    carrying = arm.robot.with_wearer(*arm.load, arm.support)
    percent = np.linspace(0.0, 100.0, len(points))
    for model, colour, label in (
        (arm.robot, ALONE_COLOUR, "robot alone (One-G)"),
        (carrying, CARRYING_COLOUR, f"with the wearer's arm at support {arm.support:g}"),
    ):
        axis.plot(np.sort(np.abs(torque_at(model, points)[:, joint])), percent, color=colour, lw=1.8, label=label)
    rated, peak = arm.joints[joint].rated, arm.joints[joint].peak
    for limit, colour, label in ((rated, RATED_COLOUR, "rated"), (peak, PEAK_COLOUR, "peak")):
        axis.axvline(limit, color=colour, lw=1.2, ls="--", label=f"{label}: {limit:g} Nm")
    axis.set_xlim(0.0, 1.05 * max(arm.joints[joint].torque, peak))
    axis.set_ylim(0.0, 102.0)
    axis.set_xlabel("Torque (Nm)")
    axis.set_ylabel("Share of the workspace that needs at most this (%)")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(loc="lower right", edgecolor="none", framealpha=0.9)


def _where(figure: Figure, axis: Axes, arm: ArmBudget, joint: int) -> None:
    """Map the largest torque over two joint angles, the maximum over the other angles and the trunk's tilt."""
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
            outline: list[AbstractPathEffect] = [withStroke(linewidth=2.5, foreground=INK)]
            lines.set_path_effects(outline)
            for text in axis.clabel(lines, fmt=f"{limit:g} Nm"):
                text.set_path_effects(outline)
    axis.set_title("maximum over the other joints and the trunk's tilt", fontsize=10)
    axis.set_xlabel(f"Joint {joint + 1} (deg)")
    axis.set_ylabel(f"Joint {other + 1} (deg)")
