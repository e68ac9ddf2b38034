"""calibrate gravity: the robot's moments and the ratio of its motors' torque scales, from a slow tour of poses."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from exo_gravity.core.calibration.identification import Identified, Observation, identify, next_pose
from exo_gravity.core.calibration.poses import candidates
from exo_gravity.core.errors import DataError
from exo_gravity.core.model.moments import MOMENTS, moments_of
from exo_gravity.core.motors.joint_motor import TORQUE_SCALE_BOUNDS
from exo_gravity.tools.calibration.live import Say, refusals_of, run_tour, tour_parameters
from exo_gravity.tools.calibration.outcome import Change, Outcome
from exo_gravity.tools.inputs.arms import ConfiguredArm


def run(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> Outcome:
    """Measure the poses, or take them from `options.bag`, and solve for the moments. Raises ParameterError."""
    refusals: tuple[str, ...] = ()
    if options.bag:
        from exo_gravity.tools.calibration.recorded import observations_of

        observations = observations_of(options.bag, arm)
    else:
        changes = {"mode": "one_g", "tour.poses": options.poses}
        tour = run_tour(options, tour_parameters(options.params, arm, changes), say)
        observations = [measured.observation for measured in tour.measured]
        refusals = refusals_of(tour, options.record)
    return solve(arm, observations, refusals)


def solve(arm: ConfiguredArm, observations: Sequence[Observation], refusals: tuple[str, ...] = ()) -> Outcome:
    """Return what `observations` tell of `arm`; refusals: why they are incomplete."""
    try:
        identified = identify(observations, arm.robot.length, arm.robot.gravity)
    except DataError as error:
        reasons = (*refusals, str(error)) if observations or not refusals else refusals
        return Outcome((), (), reasons, arm, tuple(observations))
    changes, impossible = changes_of(arm, identified)
    suggestion = _suggestion(arm, observations)
    lines = (*lines_of(arm, identified), *identified.unknown)
    return Outcome(changes, lines, refusals + impossible, arm, tuple(observations), identified, suggestion)


def changes_of(arm: ConfiguredArm, identified: Identified) -> tuple[tuple[Change, ...], tuple[str, ...]]:
    """Return the new values of the parameter file, and why it could not have them. What is unknown keeps its value."""
    node, error = f"{arm.namespace}/compensator", identified.error
    unit = "as commanded; in kg m once a weight was hung" if identified.relative else "kg m"
    known = np.where(np.isfinite(error), identified.moments, moments_of(arm.robot))
    moments = [round(float(value), 5) for value in known]
    factor = np.where(np.isfinite(identified.scale_error), identified.scale, 1.0)
    scale = [round(old * float(new), 4) for old, new in zip(arm.can_bridge["torque_scale"], factor, strict=True)]
    changes = [
        Change(node, "robot.first_moment", moments[:4], f"{unit}, +-{_row(error[:4])}"),
        Change(node, "robot.off_axis", moments[4:], f"W Z Y3 Y4 {unit}, +-{_row(error[4:])}"),
        Change(f"{arm.namespace}/can_bridge", "torque_scale", scale, f"+-{_row(identified.scale_error)}"),
    ]
    if arm.compensator["law"] != "exact":
        changes.append(Change(node, "law", "exact", "the other laws need masses and centres of gravity"))
    if any(gain != 1.0 for gain in arm.compensator["gain"]):
        changes.append(Change(node, "gain", [1.0] * 4, "now part of the moments and of torque_scale"))
    low, high = TORQUE_SCALE_BOUNDS
    impossible = tuple(
        f"{name}: torque_scale = {value:g}: must be from {low:g} to {high:g}: check torque_range of its firmware"
        for name, value in zip(arm.joint_names, scale, strict=True)
        if not low <= value <= high
    )
    return tuple(changes), impossible


def lines_of(arm: ConfiguredArm, identified: Identified) -> tuple[str, ...]:
    """Return the result in sentences."""
    before, after, error = moments_of(arm.robot), identified.moments, identified.error
    lines = [
        f"{name}: {new:.4f} +- {e:.4f} kg m (was {old:.4f})" if np.isfinite(e) else f"{name}: not told (was {old:.4f})"
        for name, old, new, e in zip(MOMENTS, before, after, error, strict=True)
    ]
    lines += [
        f"{name}: {new:.3f} +- {e:.3f} Nm per commanded Nm, friction {slide:.2f} Nm"
        for name, new, e, slide in zip(
            arm.joint_names, identified.scale, identified.scale_error, identified.friction, strict=True
        )
    ]
    worst = float(np.nanmax(np.abs(identified.held_out), initial=0.0))
    lines.append(f"largest torque error of a pose that was left out: {worst:.3f} Nm")
    lines += [f"pose {index + 1} was not used: {reason}" for index, reason in identified.rejected]
    return tuple(lines)


def _suggestion(arm: ConfiguredArm, observations: Sequence[Observation]) -> tuple[float, ...]:
    """Return the pose (4,) in rad that would add the most to `observations`."""
    poses = candidates(arm.limits)
    taken = [observation.theta for observation in observations]
    direction = observations[-1].direction
    return tuple(poses[next_pose(taken, poses, direction, moments_of(arm.robot), gravity=arm.robot.gravity)].tolist())


def _row(values: np.ndarray) -> str:
    return " ".join(f"{value:.2g}" if np.isfinite(value) else "unknown" for value in values)
