"""The parameters of `calibrator`, and the tour that they describe.

`calibrate` writes its parameter file: what the arm is expected to be, and the tour. Its limits are the arm's own.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from exo_gravity.core.calibration.poses import BestPoses, FixedStations, Itinerary, friction_stations
from exo_gravity.core.calibration.tour import Tour
from exo_gravity.core.calibration.tracking import TorqueGuess
from exo_gravity.core.compensation.params import COMPENSATOR
from exo_gravity.core.model.arm import MAX_LENGTH, MAX_MASS, MAX_MOMENT
from exo_gravity.core.model.moments import load_moments
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.core.params import Param
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.params import CAN_BRIDGE

ARM = ("side", "joint_names", "link_length", "gravity", "use_imu", "tilt_timeout")  # as the compensator's
LIMITS = ("position_min", "position_max", "max_effort")
BRIDGE = ("rate", *LIMITS)  # as can_bridge's
DURATION = 230.0  # s of a tour, for which the poses are chosen
# fmt: off
CALIBRATOR = (
    *(replace(param, fixed=True) for param in COMPENSATOR if param.name in ARM),
    Param("first_moment", [0.0] * 4, "M1 to M4 as far as known, with the wearer", (0.0, MAX_MOMENT), "kg m",
          fixed=True),
    Param("off_axis", [0.0] * 4, "W, Z, Y3, Y4 as far as known", (-MAX_MOMENT, MAX_MOMENT), "kg m", fixed=True),
    *(param for param in CAN_BRIDGE if param.name in BRIDGE),
    Param("tour.poses", 12, "number of poses that are chosen", (1, 100), fixed=True),
    Param("tour.friction", False, "sweep the hanging arm at several speeds, in place of chosen poses", fixed=True),
    Param("tour.load_mass", 0.0, "weight that hangs on link 4", (0.0, MAX_MASS), "kg", fixed=True),
    Param("tour.load_lever", 0.0, "its distance from the elbow", (0.0, MAX_LENGTH), "m", fixed=True),
)
# fmt: on


def tour_of(values: Mapping[str, Any]) -> Tour:
    """Return the tour that parameter values describe. Raises ParameterError."""
    limits = Limits(tuple(values["joint_names"]), **{name: values[name] for name in LIMITS})
    load = values["tour.load_mass"], values["tour.load_lever"]
    moments = np.array((*values["first_moment"], *values["off_axis"])) + load_moments(values["link_length"], *load)
    guess = TorqueGuess(values["link_length"], moments, Tilt.of(values["side"]), values["gravity"])
    itinerary: Itinerary = BestPoses(limits, values["tour.poses"], DURATION)
    if values["tour.friction"]:
        itinerary = FixedStations(friction_stations(limits))
    return Tour(limits, guess, itinerary, values["rate"], load)
