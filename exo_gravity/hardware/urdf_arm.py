"""The gravity torques of any serial arm, from its URDF, by Pinocchio (extra `urdf`).

A URDF gives each link's mass and centre of gravity and each joint's place and axis. With the joint velocities and
accelerations zero, recursive Newton-Euler leaves the torque that holds the arm (`computeGeneralizedGravity`). Gravity
comes as a vector in the root link's axes, so that the base may tilt.
"""

import math
from collections.abc import Sequence

import numpy as np

from exo_gravity.core.errors import ParameterError

TURNING = "JointModelR"  # how Pinocchio's names of revolute and continuous joints begin


class UrdfArm:
    """The arm that `joint_names` (n,) move in the URDF `text`; the URDF's other joints are fixed at 0.

    A `GravityModel` of `core.compensation.laws`: max_effort (n,) Nm are the joints' effort limits in the URDF, 0 where
    it has none; mass in kg is that of all links that they move. Raises ParameterError if the text is not a URDF, its
    links have no mass, Pinocchio is missing, or a joint is missing or does not turn.
    """

    def __init__(self, text: str, joint_names: Sequence[str]) -> None:
        try:
            import pinocchio as pin
        except ImportError:
            raise ParameterError("law", "urdf", "used with Pinocchio: pip install 'exo_gravity[urdf]'") from None
        try:
            self._model = pin.buildModelFromXML(text)
        except (RuntimeError, ValueError) as error:
            expected = f"a URDF that Pinocchio reads, without xacro elements: run xacro first ({error})"
            raise ParameterError("urdf", f"{text[:60].strip()} ...", expected) from None
        self._data = self._model.createData()
        self._pin, self._neutral = pin, pin.neutral(self._model)
        numbers = dict(zip(self._model.names, range(self._model.njoints), strict=True))
        turning = [name for name, n in numbers.items() if n and self._model.joints[n].shortname().startswith(TURNING)]
        for name in joint_names:
            if name not in turning:
                expected = f"turning joints of the URDF ({', '.join(turning) or 'it has none'})"
                raise ParameterError("joint_names", name, expected)
        self._order = [self._model.joints[numbers[name]].idx_v for name in joint_names]
        limits = (float(self._model.effortLimit[index]) for index in self._order)
        self.max_effort = tuple(limit if 0.0 < limit < math.inf else 0.0 for limit in limits)
        pin.computeSubtreeMasses(self._model, self._data)
        self.mass = max(self._data.mass[numbers[name]] for name in joint_names)
        if not self.mass > 0.0:
            raise ParameterError("mass of the URDF's links", self.mass, "above 0 kg: it lacks inertial elements")

    def torque(self, theta: Sequence[float], gravity: Sequence[float]) -> tuple[float, ...]:
        """Return the torque (n,) in Nm that holds the arm at `theta` (n,) rad.

        gravity: (3,) m/s^2 in the axes of the URDF's root link.
        """
        moved = np.zeros(self._model.nv)
        moved[self._order] = theta
        q = self._pin.integrate(self._model, self._neutral, moved)
        self._model.gravity.linear = np.array(gravity)
        torque = self._pin.computeGeneralizedGravity(self._model, self._data, q)
        return tuple(float(torque[index]) for index in self._order)
