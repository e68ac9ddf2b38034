"""What rarely changes on the pages: limits, settings, the picture of the arms, the support that the motors allow."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from typing import Any

from exo_gravity.core.compensation.params import COMPENSATOR, robot_of, wearer_of
from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.model.budget import BudgetRequest, largest_support
from exo_gravity.core.motors.joint_motor import OPTIONS
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.params import CAN_BRIDGE
from exo_gravity.core.view.urdf import described, urdf
from exo_gravity.nodes.ros.budget_thread import BudgetThread
from exo_gravity.panel.view import arm_setup, scene_of

WITHOUT_SUPPORT = frozenset({"support", "mode"})  # which the budget does not depend on
Values = Mapping[str, Any]


class Setup:
    """The messages of type `setup`. own: settings of the panel that the pages get too."""

    def __init__(self, own: Values) -> None:
        self._own = own
        self._limits: defaultdict[str, SupportLimit] = defaultdict(SupportLimit)
        self._sent: Any = None

    def news(self, arms: Collection[str], parameters: Mapping[str, Values]) -> dict[str, Any] | None:
        """Return the message if anything has changed since the last call, else None. Starts budgets where due.

        arms: their names. parameters: the newest of each node by its full name.
        """
        nodes = {
            arm: (parameters.get(f"/{arm}/can_bridge", {}), parameters.get(f"/{arm}/compensator", {})) for arm in arms
        }
        limits = {arm: self._limits[arm].update(*both) for arm, both in nodes.items()}
        if self._sent == (nodes, limits):
            return None
        self._sent = nodes, limits
        setups = {arm: arm_setup(*both, limits[arm]) for arm, both in nodes.items()}
        return {**self._own, "arms": setups, "scene": _scene([both for both in nodes.values() if all(both)])}

    def close(self) -> None:
        """Start no further budget."""
        for limit in self._limits.values():
            limit.thread.close()


class SupportLimit:
    """The largest support 0..1 of one arm within rated torque in the whole workspace."""

    def __init__(self) -> None:
        self.thread = BudgetThread()
        self._checked: Any = None
        self._request: BudgetRequest | None = None
        self._support: float | None = None

    def update(self, bridge: Values, compensator: Values) -> float | None:
        """Return the support, 0 if the robot alone needs more; None without a wearer, and while it is not known."""
        relevant = bridge, {name: value for name, value in compensator.items() if name not in WITHOUT_SUPPORT}
        if self._checked != relevant:
            self._checked, self._request = relevant, _request(bridge, compensator)
        if self._request is None:
            self._support = None
        elif self.thread.update(self._request):
            budgets = self.thread.result
            self._support = (largest_support(budgets) or 0.0) if isinstance(budgets, tuple) else None
        return self._support


def _request(bridge: Values, compensator: Values) -> BudgetRequest | None:
    """Return the budget with the wearer's whole arm, None without a wearer or with invalid parameters."""
    try:
        values = values_of(COMPENSATOR, compensator)
        load = wearer_of(values)
        if not any(load[0]):
            return None
        limits = values_of(CAN_BRIDGE, bridge, free_prefix=OPTIONS)
        return BudgetRequest.of(robot_of(values), load, 1.0, limits, values["use_imu"])
    except ExoGravityError:
        return None


def _scene(nodes: Collection[tuple[Values, Values]]) -> dict[str, Any] | None:
    try:
        return scene_of(urdf([described(compensator, bridge) for bridge, compensator in nodes])) if nodes else None
    except (ExoGravityError, KeyError):
        return None
