"""calibrate gravity, scale and friction: what slow tours of the bare arm show, live or from a recording.

gravity    the robot's moments and the ratio of its motors' torque scales
scale      the real torque per commanded torque of each motor, from a known weight on the last link: two tours, without
           and with it. It is hung while the arm is down and its motors are off. If the stand then leans otherwise, the
           IMU's heading shows too. A recording (`--bag`) is one with the weight, of an arm that `calibrate gravity` has
           calibrated: what it holds without is known.
friction   Coulomb, viscous and Stribeck friction of each joint, from sweeps at several slow speeds
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from exo_gravity.core.calibration.friction import FrictionCurve, fit_friction
from exo_gravity.core.calibration.identification import Identified, Observation, identify
from exo_gravity.core.calibration.poses import candidates, next_pose
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.model.gravity import gravity_torque
from exo_gravity.core.model.moments import MOMENTS, load_moments, moments_of
from exo_gravity.core.motors.joint_motor import TORQUE_SCALE_BOUNDS
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.tools.calibration import live
from exo_gravity.tools.calibration.live import Say, is_simulated, tour_parameters
from exo_gravity.tools.calibration.recorded import observations_of, sweeps_of
from exo_gravity.tools.calibration.result import CalibrationResult, Change, Curve
from exo_gravity.tools.inputs.arms import ConfiguredArm
from exo_gravity.tools.launcher import stop_on_signals

SCALE_POSES = 8  # of each tour of `calibrate scale`
LEAN = "Lean the stand forward or back by about 10 degrees (12 at most from upright): this shows the IMU's heading"
LEAST_MOMENT = 0.03  # kg m: a lighter weight is lost in the torque's resolution


def calibrate_gravity(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Measure the poses, or take them from `options.bag`, and solve for the moments. Raises ParameterError."""
    if options.bag:
        return moments_from(arm, observations_of(options.bag, arm))
    tour = live.run_tour(options, tour_parameters(options.params, arm, {"tour.poses": options.poses}), say)
    return moments_from(arm, tour.measured, tour.refusals(options.record))


def calibrate_scale(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Measure the poses without and with the weight, and solve for scales and moments. Raises ParameterError."""
    load_moments(arm.robot.length.tolist(), options.mass, options.lever)
    if options.mass * options.lever < LEAST_MOMENT:
        raise ParameterError("mass times lever", options.mass * options.lever, f"at least {LEAST_MOMENT:g} kg m")
    if options.bag:
        weighed = observations_of(options.bag, arm)
        bare = [one._replace(effort=gravity_torque(arm.robot, one.theta, one.direction)) for one in weighed]
        loaded = [one._replace(load_mass=options.mass, load_lever=options.lever) for one in weighed]
        return moments_from(arm, [*bare, *loaded])
    stopping, poses = stop_on_signals(), {"tour.poses": SCALE_POSES}
    without = live.run_tour(options, tour_parameters(options.params, arm, poses), say, stopping)
    if refusals := without.refusals(options.record):
        return moments_from(arm, without.measured, refusals)
    load = {"tour.load_mass": options.mass, "tour.load_lever": options.lever}
    nodes = tour_parameters(options.params, arm, {**poses, **load})
    if is_simulated(options.params, arm):
        # The simulated device cannot be reached by hand: it carries the weight as a wearer's forearm would.
        wearer = {"mass": [0.0, 0.0, 0.0, options.mass], "cog": [0.0, 0.0, 0.0, options.lever]}
        nodes[f"{arm.namespace}/simulator"]["ros__parameters"]["wearer"] = wearer
    else:
        options.ask(f"Hang {options.mass:g} kg on link 4, {options.lever:g} m from the elbow. {LEAN}")
    tour = live.run_tour(options, nodes, say, stopping)
    return moments_from(arm, without.measured + tour.measured, tour.refusals(options.record))


def moments_from(
    arm: ConfiguredArm, observations: Sequence[Observation], refusals: tuple[str, ...] = ()
) -> CalibrationResult:
    """Return moments and torque scales of `arm` as `observations` show them; refusals: why they are incomplete."""
    observations = tuple(observations)
    try:
        identified = identify(observations, arm.robot.length, arm.robot.gravity)
    except DataError as error:
        reasons = (*refusals, str(error)) if observations or not refusals else refusals
        return CalibrationResult(refusals=reasons, arm=arm, observations=observations)
    factor = np.where(np.isfinite(identified.scale_error), identified.scale, 1.0)
    scale = [round(old * float(new), 4) for old, new in zip(arm.can_bridge["torque_scale"], factor, strict=True)]
    low, high = TORQUE_SCALE_BOUNDS
    impossible = tuple(
        f"{name}: torque_scale = {value:g}: must be from {low:g} to {high:g}: check torque_range of its firmware"
        for name, value in zip(arm.joint_names, scale, strict=True)
        if not low <= value <= high
    )
    poses, robot = candidates(arm.limits), arm.robot
    taken, direction = [one.theta for one in observations], observations[-1].direction
    suggestion = poses[next_pose(taken, poses, direction, moments_of(robot), gravity=robot.gravity)]
    return CalibrationResult(
        _changes(arm, identified, scale),
        (*_lines(arm, identified), *identified.unknown),
        refusals + impossible,
        arm,
        observations,
        identified,
        tuple(suggestion.tolist()),
    )


def _changes(arm: ConfiguredArm, identified: Identified, scale: list[float]) -> tuple[Change, ...]:
    """Return the new values of the parameter file. What is unknown keeps its value."""
    node, error = f"{arm.namespace}/compensator", identified.error
    unit = "as commanded; in kg m once a weight was hung" if identified.relative else "kg m"
    moments = np.where(np.isfinite(error), identified.moments, moments_of(arm.robot)).round(5).tolist()
    changes = [
        Change(node, "robot.first_moment", moments[:4], f"{unit}, +-{_row(error[:4])}"),
        Change(node, "robot.off_axis", moments[4:], f"W Z Y3 Y4 {unit}, +-{_row(error[4:])}"),
        Change(f"{arm.namespace}/can_bridge", "torque_scale", scale, f"+-{_row(identified.scale_error)}"),
    ]
    if arm.compensator["law"] != "exact":
        changes.append(Change(node, "law", "exact", "the other laws need masses and centres of gravity"))
    if any(gain != 1.0 for gain in arm.compensator["gain"]):
        changes.append(Change(node, "gain", [1.0] * 4, "now part of the moments and of torque_scale"))
    return tuple(changes)


def _lines(arm: ConfiguredArm, identified: Identified) -> tuple[str, ...]:
    """Return the result in sentences."""
    found = identified
    lines = [
        f"{name}: {new:.4f} +- {e:.4f} kg m (was {old:.4f})" if np.isfinite(e) else f"{name}: unknown, still {old:.4f}"
        for name, old, new, e in zip(MOMENTS, moments_of(arm.robot), found.moments, found.error, strict=True)
    ]
    columns = zip(arm.joint_names, found.scale, found.scale_error, found.friction, strict=True)
    lines += [
        f"{name}: {new:.3f} +- {e:.3f} Nm per commanded Nm, friction {slide:.2f} Nm" for name, new, e, slide in columns
    ]
    worst = float(np.nanmax(np.abs(found.held_out), initial=0.0))
    lines.append(f"largest torque error of a pose that was left out: {worst:.3f} Nm")
    lines += [f"pose {index + 1} was not used: {reason}" for index, reason in found.rejected]
    return tuple(lines)


def _row(values: np.ndarray) -> str:
    return " ".join(f"{value:.2g}" if np.isfinite(value) else "unknown" for value in values)


def calibrate_friction(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Sweep all joints of the hanging arm, and fit the friction of each. Raises ParameterError."""
    if options.bag:
        return friction_from(arm, sweeps_of(options.bag, arm))
    tour = live.run_tour(options, tour_parameters(options.params, arm, {"tour.friction": True}), say)
    return friction_from(arm, tour.measured, tour.refusals(options.record))


def friction_from(
    arm: ConfiguredArm, observations: Sequence[Observation], refusals: tuple[str, ...] = ()
) -> CalibrationResult:
    """Return the friction of each joint that `observations` show; refusals: why they are incomplete."""
    observations = tuple(observations)
    speed = np.array([np.broadcast_to(one.speed, JOINT_COUNT) for one in observations]).reshape(-1, JOINT_COUNT)
    torque = np.array([one.friction for one in observations]).reshape(-1, JOINT_COUNT)
    try:
        fits = [fit_friction(*joint) for joint in zip(speed.T, torque.T, strict=True)]
    except DataError as error:
        return CalibrationResult(refusals=(*refusals, str(error)), arm=arm, observations=observations)
    named = list(zip(arm.joint_names, fits, strict=True))
    lines = tuple(f"{name}: {_sentence(fit)}" for name, fit in named)
    negative = tuple(
        f"{name}: friction of {fit.coulomb:.3f} Nm: must be above 0: was the arm touched?"
        for name, fit in named
        if fit.coulomb <= 0.0
    )
    changes = tuple(Change(f"{arm.namespace}/can_bridge", "", 0, f"friction of {line}") for line in lines)
    curves = tuple(Curve(v, slide, fit.at(v)) for v, slide, fit in zip(speed.T, torque.T, fits, strict=True))
    return CalibrationResult(changes, lines, refusals + negative, arm, observations, curves=curves)


def _sentence(fit: FrictionCurve) -> str:
    coulomb, viscous, stribeck = fit.error
    text = f"Coulomb {fit.coulomb:.3f} +- {coulomb:.3f} Nm, viscous {fit.viscous:.3f} +- {viscous:.3f} Nm s/rad"
    if not fit.stribeck:
        return f"{text}, no Stribeck friction"
    return f"{text}, Stribeck {fit.stribeck:.3f} +- {stribeck:.3f} Nm below {fit.stribeck_speed:.2f} rad/s"
