"""The gravity torques of any serial arm, from its URDF, by Pinocchio (extra `urdf`).

A URDF gives each link's mass and centre of gravity and each joint's place and axis. With the joint velocities and
accelerations zero, recursive Newton-Euler leaves the torque that holds the arm (`computeGeneralizedGravity`). Gravity
comes as a vector in the root link's axes, so that the base may tilt. `urdf_checks` judges what the URDF leaves out.
"""

from collections.abc import Sequence

from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.urdf_checks import UrdfJoints, check_masses, usable_efforts


class UrdfArm:
    """The arm that `joint_names` (n,) move in the URDF `text`.

    A `GravityModel` of `core.compensation.laws`: max_effort (n,) Nm are the joints' effort limits in the URDF, 0 where
    it has none; mass in kg is that of all links that they move. Raises ParameterError if the text is not a URDF, its
    links have no mass, Pinocchio is missing, or a joint is missing or does not turn.
    """

    def __init__(self, text: str, joint_names: Sequence[str]) -> None:
        try:
            import pinocchio as pin
        except ImportError:
            raise ParameterError("law", "urdf", "used with Pinocchio: pip install 'exo_gravity[urdf]'") from None
        self.joints = joints = UrdfJoints(pin, text, joint_names)
        pin.computeSubtreeMasses(joints.model, joints.data)
        self.mass = max(joints.data.mass[joints.model.getJointId(name)] for name in joint_names)
        if not self.mass > 0.0:
            raise ParameterError("mass of the URDF's links", self.mass, "above 0 kg: it lacks inertial elements")
        self.max_effort, unused = usable_efforts(joints)
        #: sentences on what is doubtful in the URDF, for the log
        self.notes = (*check_masses(joints), *unused)
        if joints.others:
            names = ", ".join(other.name for other in joints.others)
            note = f"{names} change the torque and are not in joint_names: at 0, unless the joint states have them"
            self.notes += (note,)

    def torque(self, theta: Sequence[float], gravity: Sequence[float]) -> tuple[float, ...]:
        """Return the torque (n,) in Nm that holds the arm at `theta` (n,) rad.

        gravity: (3,) m/s^2 in the axes of the URDF's root link.

        Raises ParameterError while a joint on which it depends is not known (`follow`).
        """
        return tuple(self.joints.torque(theta, gravity).tolist())

    @property
    def fixed(self) -> tuple[str, ...]:
        """The joints on which the torque depends, and which are taken to be at 0 because none is reported."""
        return self.joints.fixed

    def follow(self, names: Sequence[str], positions: Sequence[float]) -> None:
        """Take the positions (m,) of all joints that are reported, by their names (m,); see `UrdfJoints.follow`."""
        self.joints.follow(names, positions)
