# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The torque budget of what an arm carries at present: whether its motors can hold it in every pose.

It takes about 0.2 s of arithmetic on the executor's thread; the estimate of the wearer's torque has its own.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rclpy.node import Node

from exo_gravity.core.arm.interface import Arm
from exo_gravity.core.arm.springs import Springs
from exo_gravity.core.compensation.laws import URDF_LAW
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.vocabulary import NONE, UNKNOWN, Reason
from exo_gravity.lab.budget import USUAL_TILT, budget, largest_support, motor_torques, overload, workspace
from exo_gravity.lab.inputs.arms import fitting
from exo_gravity.lab.vocabulary import Budget
from exo_gravity.nodes.ros.parameters import NodeParameters

WITHIN = "within rated torque everywhere"
BRIDGE_PARAMETERS = {
    "motor", "torque_scale", "torque_scale_slope", "torque_scale_temperature", "position_min", "position_max",
}  # fmt: skip
# robot, the same with the wearer's whole arm, springs of device and wearer, support 0..1, largest tilt in rad
Request = tuple[Arm, Arm, tuple[Springs, Springs], float, float]


class BudgetWatch:
    """Checks the newest settings. Call `update` regularly.

    Motors and joint limits are parameters of `can_bridge`, which are read once.
    """

    def __init__(self, node: Node) -> None:
        #: the result for the settings checked last
        self.result = Reason(Budget.UNKNOWN, "unknown: waiting for can_bridge's parameters")
        #: share 0..1 of the wearer's arm within rated torque everywhere, 0 if none is, 'none' without a wearer
        self.largest_support = UNKNOWN
        self._logger = node.get_logger()
        self._bridge = NodeParameters(node, "can_bridge", once=True, fitting=fitting)
        self._request: Request | None = None

    def update(self, names: Sequence[str], settings: Settings) -> None:
        """Check `settings` if they are new; names: of the joints (n,)."""
        if settings.law == URDF_LAW:
            self.result = Reason(Budget.UNKNOWN, "unknown: it is watched for the paper's arm alone")
            return
        self._bridge.update()
        request = request_of(settings)
        if self._bridge.values.keys() >= BRIDGE_PARAMETERS and request != self._request:
            self._request = request
            self.result, self.largest_support = compute(names, request, self._bridge.values)
            if self.result.word != Budget.WITHIN_RATED:
                self._logger.warning(f"{self.result}; efforts stay clamped to max_effort")


def request_of(s: Settings) -> Request:
    """Return what the motors must be able to hold with these settings."""
    support = (1.0 if s.support_adapts else s.support) if s.mode == "zero_g" else 0.0
    tilt = math.radians(USUAL_TILT) if s.use_imu else 0.0
    return s.loaded, s.worn(s.loaded), (s.joint_spring, s.tissue), support, tilt


def compute(names: Sequence[str], request: Request, bridge: Mapping[str, Any]) -> tuple[Reason, str]:
    """Return `result` and `largest_support` of `BudgetWatch`.

    names: of the joints (n,).
    bridge: its parameter values.
    """
    robot, full, springs, support, tilt = request
    try:
        bounds = workspace(bridge["position_min"], bridge["position_max"], tilt)
        rated, peak = motor_torques(bridge)
        joints = budget(robot, full, springs, support, bounds, rated, peak)
    except ParameterError as error:
        return Reason(Budget.UNKNOWN, f"unknown: can_bridge has {error}"), UNKNOWN
    overloaded = overload(names, joints)
    result = Reason(Budget.ABOVE_RATED, overloaded) if overloaded else Reason(Budget.WITHIN_RATED, WITHIN)
    return result, f"{largest_support(joints) or 0.0:g}" if full != robot else NONE
