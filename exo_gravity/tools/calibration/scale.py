"""calibrate scale: the real torque per commanded torque of each motor, from a known weight on the last link.

Two tours, without and with the weight. The weight hangs while the arm is down and its motors are off. If the stand then
leans otherwise, the IMU's heading shows too. A recording (`--bag`) is one with the weight, of an arm that `calibrate
gravity` has calibrated: what it holds without is known.
"""

from __future__ import annotations

import argparse
from typing import Any

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.gravity import gravity_torque
from exo_gravity.core.model.moments import load_moments
from exo_gravity.tools.calibration.gravity import solve
from exo_gravity.tools.calibration.live import LiveTour, Say, is_simulated, refusals_of, run_tour, tour_parameters
from exo_gravity.tools.calibration.outcome import Outcome
from exo_gravity.tools.inputs.arms import ConfiguredArm
from exo_gravity.tools.launcher import Stopping, stop_on_signals

POSES = 8  # of each tour
LEAN = "Lean the stand forward or back by about 10 degrees (12 at most from upright): this shows the IMU's heading"
LEAST_MOMENT = 0.03  # kg m: a lighter weight is lost in the torque's resolution


def run(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> Outcome:
    """Measure the poses without and with the weight, and solve for scales and moments. Raises ParameterError."""
    load_moments(arm.robot.length.tolist(), options.mass, options.lever)
    if options.mass * options.lever < LEAST_MOMENT:
        raise ParameterError("mass times lever", options.mass * options.lever, f"at least {LEAST_MOMENT:g} kg m")
    if options.bag:
        return _recorded(options, arm)
    stopping = stop_on_signals()
    without = _tour(options, arm, say, stopping, {})
    refusals = refusals_of(without, options.record)
    measured = without.measured
    if not refusals:
        load = {"tour.load_mass": options.mass, "tour.load_lever": options.lever}
        if not is_simulated(options.params, arm):
            options.ask(f"Hang {options.mass:g} kg on link 4, {options.lever:g} m from the elbow. {LEAN}")
        loaded = _tour(options, arm, say, stopping, load)
        refusals = refusals_of(loaded, options.record)
        measured = without.measured + loaded.measured
    return solve(arm, [one.observation for one in measured], refusals)


def _recorded(options: argparse.Namespace, arm: ConfiguredArm) -> Outcome:
    """Solve for scales and moments from a recording with the weight, and the file's arm in the same poses without."""
    from exo_gravity.tools.calibration.recorded import observations_of

    observations = observations_of(options.bag, arm)
    bare = [one._replace(effort=gravity_torque(arm.robot, one.theta, one.direction)) for one in observations]
    loaded = [one._replace(load_mass=options.mass, load_lever=options.lever) for one in observations]
    return solve(arm, [*bare, *loaded])


def _tour(
    options: argparse.Namespace, arm: ConfiguredArm, say: Say, stopping: Stopping, load: dict[str, Any]
) -> LiveTour:
    nodes = tour_parameters(options.params, arm, {"mode": "one_g", "tour.poses": POSES, **load})
    if load and f"{arm.namespace}/simulator" in nodes:
        # The simulated device cannot be reached by hand: it carries the weight as a wearer's forearm would.
        simulator = nodes[f"{arm.namespace}/simulator"]["ros__parameters"]
        simulator["wearer"] = {"mass": [0.0, 0.0, 0.0, options.mass], "cog": [0.0, 0.0, 0.0, options.lever]}
    return run_tour(options, nodes, say, stopping)
