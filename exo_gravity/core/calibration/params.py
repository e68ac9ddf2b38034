"""The parameters of `calibrator`, and the tour that they describe.

`calibrator` stands in the compensator's place. It takes the compensator's parameters and the bridge's limits, so that a
parameter file for it follows from that of the arm.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from exo_gravity.core.calibration.guess import TorqueGuess
from exo_gravity.core.calibration.motion import MAX_SPEED, Station
from exo_gravity.core.calibration.poses import BestPoses, FixedStations, Itinerary, measurable
from exo_gravity.core.calibration.tour import Tour
from exo_gravity.core.compensation.params import COMPENSATOR, settings_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import MAX_LENGTH, MAX_MASS
from exo_gravity.core.model.moments import load_moments, moments_of
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.core.numbers import JOINT_COUNT, one_float
from exo_gravity.core.params import Param
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.params import CAN_BRIDGE, LIMIT_PARAMETERS, limits_of

_SHARED = {param.name for param in COMPENSATOR}
# fmt: off
CALIBRATOR = (
    *COMPENSATOR,
    *(param for param in LIMIT_PARAMETERS if param.name not in _SHARED),
    next(param for param in CAN_BRIDGE if param.name == "rate"),
    Param("tour.poses", 12, "number of poses that are chosen", (1, 100), fixed=True),
    Param("tour.duration", 230.0, "time that the poses are chosen for", (30.0, 3600.0), "s", fixed=True),
    Param("tour.stations", "", "JSON list of [[4 angles], speed, amplitude, cycles], in place of chosen poses",
          fixed=True),
    Param("tour.load_mass", 0.0, "weight that hangs on link 4", (0.0, MAX_MASS), "kg", fixed=True),
    Param("tour.load_lever", 0.0, "its distance from the elbow", (0.0, MAX_LENGTH), "m", fixed=True),
)
# fmt: on


def tour_of(values: Mapping[str, Any]) -> Tour:
    """Return the tour that parameter values describe. Raises ParameterError."""
    settings = settings_of({**values, "law": "exact"})
    limits = limits_of(values)
    load = values["tour.load_mass"], values["tour.load_lever"]
    moments = moments_of(settings.arm) + load_moments(settings.arm.length.tolist(), *load)
    guess = TorqueGuess(settings.arm.length, moments, Tilt.of(settings.side), settings.robot.gravity)
    return Tour(limits, guess, _itinerary(values, limits), values["rate"], load)


def _itinerary(values: Mapping[str, Any], limits: Limits) -> Itinerary:
    if not values["tour.stations"]:
        return BestPoses(limits, values["tour.poses"], values["tour.duration"])
    return FixedStations(stations_of(values["tour.stations"], limits))


def stations_of(text: str, limits: Limits) -> list[Station]:
    """Return the stations in the JSON `text`. Raises ParameterError if one leaves the limits or is too fast."""
    try:
        given = [Station(tuple(map(float, theta)), *rest) for theta, *rest in json.loads(text)]
    except (ValueError, TypeError):
        raise ParameterError("tour.stations", text, "JSON: [[[4 angles], speed, amplitude, cycles], ...]") from None
    for station in given:
        one_float("tour.stations speed", station.speed, 0.005, MAX_SPEED, "rad/s")
        one_float("tour.stations amplitude", station.amplitude, 0.01, 1.0, "rad")
        one_float("tour.stations cycles", station.cycles, 1, 20)
        low, high = measurable(limits, station.amplitude)
        if len(station.theta) != JOINT_COUNT or any(
            not below <= angle <= above for angle, below, above in zip(station.theta, low, high, strict=True)
        ):
            raise ParameterError("tour.stations", list(station.theta), f"from {low.tolist()} to {high.tolist()} rad")
    return given


def as_text(stations: Sequence[Station]) -> str:
    """Return stations as the parameter `tour.stations`."""
    return json.dumps([list(station) for station in stations])
