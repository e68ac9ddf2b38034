"""Measured and predicted torque of each pose, before and after the calibration, and what friction makes of the rest.

An arm whose torque is wrong by less than the friction of a joint stays where it is. Beyond it creeps, until a viscous
torque balances the rest.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from exo_gravity.core.model.gravity import gravity_torque
from exo_gravity.core.model.moments import load_moments, regressor
from exo_gravity.tools.calibration.outcome import Outcome

SMALL_FRICTION = 0.2  # of the friction that was measured: a well-run-in gear


class TorqueTable(NamedTuple):
    """One row per pose, n in all, one column per joint, in Nm as commanded.

    theta: (n, 4) rad. measured: the effort that holds the arm, (n, 4). spread: its standard error. before, after: as
    predicted by the old and by the new file, which cannot hold the motors' constant offset. held_out: measured minus
    predicted by a result that was found without that pose. friction: (4,). used: (n,), false for poses left out.
    """

    theta: np.ndarray
    measured: np.ndarray
    spread: np.ndarray
    before: np.ndarray
    after: np.ndarray
    held_out: np.ndarray
    friction: np.ndarray
    used: np.ndarray

    @property
    def peak(self) -> np.ndarray:
        """Largest measured torque of each joint, (4,) Nm."""
        return np.asarray(np.abs(self.measured).max(axis=0))

    @property
    def margin(self) -> np.ndarray:
        """Friction divided by the torque that remains, (n, 4): above 1 the arm stays."""
        with np.errstate(divide="ignore"):
            return np.asarray(self.friction / np.abs(self.held_out))

    def creeping(self, share: float = 1.0) -> tuple[int, int]:
        """Return in how many poses the arm creeps before and after, if friction is `share` of the measured one."""
        limit = share * self.friction
        wrong = (self.measured - self.before, self.held_out)
        before, after = (int(np.any(np.abs(error[self.used]) > limit, axis=1).sum()) for error in wrong)
        return before, after


def torque_table(outcome: Outcome) -> TorqueTable | None:
    """Return the table of an outcome, None if it has no poses or no result."""
    identified, arm, poses = outcome.identified, outcome.arm, outcome.observations
    if identified is None or arm is None or not poses:
        return None
    theta, direction, measured, spread = (
        np.array([getattr(pose, name) for pose in poses], dtype=float)
        for name in ("theta", "direction", "effort", "spread")
    )
    loads = np.array([load_moments(arm.robot.length, pose.load_mass, pose.load_lever) for pose in poses])
    weight = np.einsum("ijk,ik->ij", regressor(theta, direction, arm.robot.gravity), loads)
    used = np.ones(len(poses), dtype=bool)
    used[[index for index, _ in identified.rejected]] = False
    before = gravity_torque(arm.robot, theta, direction) + weight
    after = measured - identified.residual - identified.offset
    held_out = identified.held_out + identified.offset
    return TorqueTable(theta, measured, spread, before, after, held_out, identified.friction, used)
