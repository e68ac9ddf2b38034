"""calibrate friction: Coulomb, viscous and Stribeck friction of each joint, from sweeps at several slow speeds."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from exo_gravity.core.calibration.friction import Friction, fit_friction, friction_stations
from exo_gravity.core.calibration.params import as_text
from exo_gravity.core.calibration.tour import Measured
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.tools.calibration.live import Say, refusals_of, run_tour, tour_parameters
from exo_gravity.tools.calibration.outcome import Change, Curve, Outcome
from exo_gravity.tools.inputs.arms import ConfiguredArm

if TYPE_CHECKING:
    from exo_gravity.tools.calibration.recorded import Swept


def run(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> Outcome:
    """Sweep all joints of the hanging arm, and fit the friction of each. Raises ParameterError."""
    if options.bag:
        from exo_gravity.tools.calibration.recorded import sweeps_of

        return solve(arm, sweeps_of(options.bag, arm))
    changes = {"mode": "one_g", "tour.stations": as_text(friction_stations(arm.limits))}
    tour = run_tour(options, tour_parameters(options.params, arm, changes), say)
    return solve(arm, tour.measured, refusals_of(tour, options.record))


def solve(arm: ConfiguredArm, measured: Sequence[Measured | Swept], refusals: tuple[str, ...] = ()) -> Outcome:
    """Return the friction of each joint that `measured` shows; refusals: why it is incomplete."""
    observations = tuple(one.observation for one in measured)
    speed = np.array([np.broadcast_to(one.speed, JOINT_COUNT) for one in measured]).reshape(-1, JOINT_COUNT)
    torque = np.array([one.friction for one in observations]).reshape(-1, JOINT_COUNT)
    try:
        fits = [fit_friction(speed[:, joint], torque[:, joint]) for joint in range(JOINT_COUNT)]
    except DataError as error:
        return Outcome((), (), (*refusals, str(error)), arm, observations)
    lines = tuple(f"{name}: {_sentence(fit)}" for name, fit in zip(arm.joint_names, fits, strict=True))
    negative = tuple(
        f"{name}: friction of {fit.coulomb:.3f} Nm: must be above 0: was the arm touched?"
        for name, fit in zip(arm.joint_names, fits, strict=True)
        if fit.coulomb <= 0.0
    )
    changes = tuple(Change(f"{arm.namespace}/can_bridge", "", 0, f"friction of {line}") for line in lines)
    curves = tuple(Curve(speed[:, joint], torque[:, joint], fit.at(speed[:, joint])) for joint, fit in enumerate(fits))
    return Outcome(changes, lines, refusals + negative, arm, observations, curves=curves)


def _sentence(fit: Friction) -> str:
    coulomb, viscous, stribeck = fit.error
    text = f"Coulomb {fit.coulomb:.3f} +- {coulomb:.3f} Nm, viscous {fit.viscous:.3f} +- {viscous:.3f} Nm s/rad"
    if not fit.stribeck:
        return f"{text}, no Stribeck friction"
    return f"{text}, Stribeck {fit.stribeck:.3f} +- {stribeck:.3f} Nm below {fit.stribeck_speed:.2f} rad/s"
