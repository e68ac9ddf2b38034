"""calibrate gravity, scale, friction and wearer: what slow tours of the arm show, live or from a recording.

gravity    the robot's moments and the ratio of its motors' torque scales
scale      the real torque per commanded torque of each motor, from a known weight on the last link: two tours, without
           and with it. It is hung while the arm is down and its motors are off. If the stand then leans otherwise, the
           IMU's heading shows too. A recording (`--bag`) is one with the weight, of an arm that `calibrate gravity` has
           calibrated: what it holds without is known.
friction   Coulomb, viscous and Stribeck friction of each joint, from sweeps at several slow speeds
wearer     the weight of the wearer's relaxed arm, from supported poses: what the calibrated robot needs beyond its own
           moments. Two masses explain it, one on link 3 and one on link 4, at the centres of gravity of the body-mass
           table: torque shows only mass times distance.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.calibration.friction import FrictionCurve, fit_friction
from exo_gravity.core.calibration.identification import Identified, Observation, columns, identify
from exo_gravity.core.calibration.poses import candidates, next_pose
from exo_gravity.core.compensation.params import wearer_of
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.model.gravity import gravity_torque
from exo_gravity.core.model.moments import MOMENTS, load_moments, moments_of, regressor
from exo_gravity.core.model.wearer import Wearer
from exo_gravity.core.motors.joint_motor import TORQUE_SCALE_BOUNDS
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.tools.calibration import live
from exo_gravity.tools.calibration.live import Say, tour_parameters
from exo_gravity.tools.calibration.recorded import observations_of
from exo_gravity.tools.calibration.result import CalibrationResult, Change, Curve
from exo_gravity.tools.inputs.arms import ConfiguredArm
from exo_gravity.tools.launcher import stop_on_signals

SCALE_POSES = 8  # of each tour of `calibrate scale`
LEAN = "Lean the stand forward or back by about 10 degrees (12 at most from upright): this shows the IMU's heading"
LEAST_MOMENT = 0.03  # kg m: a lighter weight is lost in the torque's resolution
WEARER_POSES = 4  # the hanging arm and three others
BREATHING = 0.1  # Nm: standard deviation by which a relaxed, breathing person differs from pose to pose
TYPICAL_BODY_MASS = 70.0  # kg
# rad: a comfortable part of the joints' ranges.
COMFORTABLE = ((-0.4, -0.17, -0.5, -0.17), (0.6, 1.2, 1.3, 1.7))
LARGEST_ERROR = 0.25  # of a mass, as a standard error
MOST = 15.0  # kg of a person's arm
TABLE_RATIO = (0.6, 1.6)  # measured to tabled moments that are plausible


def calibrate_gravity(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Measure the poses, or take them from `options.bag`, and solve for the moments. Raises ParameterError."""
    return moments_from(arm, _observations(options, arm, say, {"tour.poses": options.poses}))


def _observations(
    options: argparse.Namespace, arm: ConfiguredArm, say: Say, changes: Mapping[str, Any]
) -> Sequence[Observation]:
    """Return what a tour measures, or what `options.bag` shows; changes: as for `tour_parameters`."""
    if options.bag:
        return observations_of(options.bag, arm, with_held="tour.friction" not in changes)
    nodes = tour_parameters(options.params, arm, changes)
    return live.run_tour(options, nodes, say).complete(options.record)


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
    bare = without.complete(options.record)
    load = {"tour.load_mass": options.mass, "tour.load_lever": options.lever}
    nodes = tour_parameters(options.params, arm, {**poses, **load})
    if (simulator := f"{arm.namespace}/simulator") in nodes:
        # The simulated device cannot be reached by hand: it carries the weight as a wearer's forearm would.
        wearer = {"mass": [0.0, 0.0, 0.0, options.mass], "cog": [0.0, 0.0, 0.0, options.lever]}
        nodes[simulator]["ros__parameters"]["wearer"] = wearer
    else:
        options.ask(f"Hang {options.mass:g} kg on link 4, {options.lever:g} m from the elbow. {LEAN}")
    return moments_from(arm, bare + live.run_tour(options, nodes, say, stopping).complete(options.record))


def moments_from(arm: ConfiguredArm, observations: Sequence[Observation]) -> CalibrationResult:
    """Return moments and torque scales of `arm` as `observations` show them. Raises DataError as `identify` does."""
    identified = identify(observations, arm.robot.length, arm.robot.gravity)
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
        impossible,
        arm,
        tuple(observations),
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
    rows = zip(arm.joint_names, found.scale, found.scale_error, found.friction, found.offset, strict=True)
    lines += [
        f"{name}: {new:.3f} +- {e:.3f} Nm per commanded Nm, friction {slide:.2f} Nm, offset {offset:+.3f} Nm"
        for name, new, e, slide, offset in rows
    ]
    worst = float(np.nanmax(np.abs(found.held_out), initial=0.0))
    lines.append(f"largest torque error of a pose that was left out: {worst:.3f} Nm")
    lines += [f"pose {index + 1} was not used: {reason}" for index, reason in found.rejected]
    return tuple(lines)


def _row(values: np.ndarray) -> str:
    return " ".join(f"{value:.2g}" if np.isfinite(value) else "unknown" for value in values)


def calibrate_friction(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Sweep all joints of the hanging arm, and fit the friction of each. Raises ParameterError."""
    return friction_from(arm, _observations(options, arm, say, {"tour.friction": True}))


def friction_from(arm: ConfiguredArm, observations: Sequence[Observation]) -> CalibrationResult:
    """Return the friction of each joint that `observations` show. Raises DataError as `fit_friction` does."""
    speed = np.array([np.broadcast_to(one.speed, JOINT_COUNT) for one in observations]).reshape(-1, JOINT_COUNT)
    torque = np.array([one.friction for one in observations]).reshape(-1, JOINT_COUNT)
    fits = [fit_friction(*joint) for joint in zip(speed.T, torque.T, strict=True)]
    named = list(zip(arm.joint_names, fits, strict=True))
    lines = tuple(f"{name}: {_sentence(fit)}" for name, fit in named)
    negative = tuple(
        f"{name}: friction of {fit.coulomb:.3f} Nm: must be above 0: was the arm touched?"
        for name, fit in named
        if fit.coulomb <= 0.0
    )
    changes = tuple(Change(f"{arm.namespace}/can_bridge", "", 0, f"friction of {line}") for line in lines)
    curves = tuple(Curve(v, slide, fit.at(v)) for v, slide, fit in zip(speed.T, torque.T, fits, strict=True))
    return CalibrationResult(changes, lines, negative, arm, tuple(observations), curves=curves)


def _sentence(fit: FrictionCurve) -> str:
    coulomb, viscous, stribeck = fit.error
    text = f"Coulomb {fit.coulomb:.3f} +- {coulomb:.3f} Nm, viscous {fit.viscous:.3f} +- {viscous:.3f} Nm s/rad"
    if not fit.stribeck:
        return f"{text}, no Stribeck friction"
    return f"{text}, Stribeck {fit.stribeck:.3f} +- {stribeck:.3f} Nm below {fit.stribeck_speed:.2f} rad/s"


class WornArm(NamedTuple):
    """The masses that explain the torque beyond the robot's."""

    mass: np.ndarray  #: (2,) kg on links 3 and 4
    error: np.ndarray  #: (2,) kg, standard errors
    remainder: np.ndarray  #: (n, 4) Nm of each pose


def calibrate_wearer(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Measure the wearer's relaxed arm, or take it from `options.bag`. Raises ParameterError."""
    if options.bag:
        return wearer_from(arm, observations_of(options.bag, arm))
    # Few poses, in a comfortable range, with the weight that the table expects.
    low, high = np.maximum(arm.low, COMFORTABLE[0]), np.minimum(arm.high, COMFORTABLE[1])
    changes = {"tour.poses": WEARER_POSES, "position_min": low.tolist(), "position_max": high.tolist()}
    moments = moments_of(arm.robot.with_wearer(*_expected_wearer(arm)))
    nodes = tour_parameters(options.params, arm, changes, moments)
    if f"{arm.namespace}/simulator" not in nodes:
        options.ask("Wear the arm, sit upright and relax: it will be moved slowly. Pull to stop it")
    return wearer_from(arm, live.run_tour(options, nodes, say).complete(options.record))


def wearer_from(arm: ConfiguredArm, observations: Sequence[Observation]) -> CalibrationResult:
    """Return the wearer's masses that `observations` show. Raises DataError as `worn_arm` does."""
    cog = np.array(_expected_wearer(arm)[1][2:])
    worn = worn_arm(arm, observations, cog)
    node = f"{arm.namespace}/compensator"
    mass = [0.0, 0.0, *np.round(worn.mass, 3).tolist()]
    note = f"kg, +-{worn.error[0]:.2f} and {worn.error[1]:.2f}"
    changes = (
        Change(node, "wearer.mass", mass, note),
        Change(node, "wearer.cog", [0.0, 0.0, *np.round(cog, 4).tolist()], "m, of the body-mass table"),
    )
    lines = (
        f"upper arm: {worn.mass[0]:.2f} +- {worn.error[0]:.2f} kg, M3 {_moment(arm, worn.mass, cog)[0]:.3f} kg m",
        f"forearm and hand: {worn.mass[1]:.2f} +- {worn.error[1]:.2f} kg, M4 {worn.mass[1] * cog[1]:.3f} kg m",
        f"largest remainder of a pose: {np.abs(worn.remainder).max():.2f} Nm",
    )
    comparison, implausible = _compared(arm, worn.mass, cog)
    return CalibrationResult(changes, (*lines, comparison), implausible, arm, tuple(observations))


def worn_arm(arm: ConfiguredArm, observations: Sequence[Observation], cog: np.ndarray) -> WornArm:
    """Return the masses on links 3 and 4, at `cog` (2,) m, that explain what the robot alone does not.

    Raises DataError if the poses do not show them.
    """
    if len(observations) < 3:
        raise DataError(f"{len(observations)} poses were measured, must be at least 3")
    theta, direction, effort, spread = columns(observations)
    rows = regressor(theta, direction, arm.robot.gravity)
    length = arm.robot.length
    per_mass = np.zeros((8, 2))
    per_mass[:3, 0] = length[0], length[1], cog[0]
    per_mass[:4, 1] = *length[:3], cog[1]
    extra = effort - rows @ moments_of(arm.robot)
    weight = 1.0 / np.hypot(spread, BREATHING).ravel()
    matrix = (rows @ per_mass).reshape(-1, 2) * weight[:, None]
    covariance = np.linalg.pinv(matrix.T @ matrix)
    mass = covariance @ matrix.T @ (extra.ravel() * weight)
    remainder = extra - rows @ per_mass @ mass
    chi = float(np.sum((remainder.ravel() * weight) ** 2)) / (remainder.size - 2)
    error = np.sqrt(np.diag(covariance) * max(1.0, chi))
    for name, own, deviation in zip(("upper arm", "forearm and hand"), mass, error, strict=True):
        if not 0.0 < own < MOST:
            raise DataError(
                f"{name}: {own:.2f} kg: must be from 0 to {MOST:g}: is the arm relaxed, the robot calibrated?"
            )
        if deviation > LARGEST_ERROR * own:
            raise DataError(f"{name}: {own:.2f} +- {deviation:.2f} kg: add a pose with the arm further forward")
    return WornArm(mass, error, remainder)


def _expected_wearer(arm: ConfiguredArm) -> tuple[Sequence[float], Sequence[float]]:
    """Return mass (4,) in kg and cog (4,) in m on each link: of the file's wearer, or else of a typical one."""
    mass, cog = wearer_of(arm.compensator)
    if mass[2] and mass[3]:
        return mass, cog
    return wearer_of({**arm.compensator, "wearer.mass": (0.0,) * 4, "wearer.body_mass": TYPICAL_BODY_MASS})


def _moment(arm: ConfiguredArm, mass: np.ndarray, cog: np.ndarray) -> tuple[float, float]:
    """Return M3 and M4 in kg m of masses (2,) on links 3 and 4."""
    return float(mass[0] * cog[0] + mass[1] * arm.robot.length[2]), float(mass[1] * cog[1])


def _compared(arm: ConfiguredArm, mass: np.ndarray, cog: np.ndarray) -> tuple[str, tuple[str, ...]]:
    """Return how the masses compare with the body-mass table, and why they would be implausible."""
    given, body_mass = arm.compensator, arm.compensator["wearer.body_mass"]
    person = Wearer(body_mass or TYPICAL_BODY_MASS, given["wearer.sex"], segment_length=given["wearer.segment_length"])
    load = person.on_links(arm.robot.length)
    tabled = np.array(_moment(arm, load.mass[2:], load.cog[2:]))
    ratio = np.array(_moment(arm, mass, cog)) / tabled
    if not body_mass:
        return f"a person of {TYPICAL_BODY_MASS * ratio[0]:.0f} kg has this M3 by the table {person.table}", ()
    sentence = f"{ratio[0]:.0%} of M3 and {ratio[1]:.0%} of M4 by the table {person.table} for {body_mass:g} kg"
    low, high = TABLE_RATIO
    is_plausible = np.all((ratio >= low) & (ratio <= high))
    return sentence, () if is_plausible else (f"implausible: {sentence}: must be from {low:.0%} to {high:.0%}",)
