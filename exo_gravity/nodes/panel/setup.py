"""What rarely changes on the pages: limits, settings, the picture of the arms, the support that the motors allow."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from typing import Any

from exo_gravity.core.compensation.params import COMPENSATOR, robot_of, wearer_of
from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.model.budget import BudgetRequest, largest_support
from exo_gravity.core.motors.params import OPTIONS
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.params import CAN_BRIDGE
from exo_gravity.core.view.arm_description import described
from exo_gravity.core.view.urdf import urdf
from exo_gravity.nodes.ros.budget_thread import BudgetThread
from exo_gravity.panel.view import arm_setup, scene_of

BRIDGE, COMPENSATOR_NODE = "can_bridge", "compensator"
WITHOUT_SUPPORT = frozenset({"support", "mode"})  # which the budget does not depend on


class Setup:
    """Collects the parameters of the nodes, and returns `news` for the pages when something has changed."""

    def __init__(self, own: Mapping[str, Any]) -> None:
        """Take `own`: settings of the panel that the pages get too."""
        self._own = own
        self._arms: defaultdict[str, ArmParameters] = defaultdict(ArmParameters)
        self._shown: Collection[str] = ()
        self._changed = True

    def note(self, node: str, values: Mapping[str, Any]) -> None:
        """Take the parameters of a node by its full name."""
        arm, _, leaf = node.strip("/").rpartition("/")
        if leaf in (BRIDGE, COMPENSATOR_NODE):
            self._changed |= self._arms[arm].take(leaf, values)

    def discover(self, arms: Collection[str]) -> None:
        """Take the names of the arms."""
        self._changed |= tuple(arms) != tuple(self._shown)
        self._shown = tuple(arms)

    def news(self) -> dict[str, Any] | None:
        """Return everything if anything has changed since the last call, else None. Starts budgets where due."""
        shown = {name: self._arms[name] for name in self._shown}
        self._changed |= any([arm.update_budget() for arm in shown.values()])
        if not self._changed:
            return None
        self._changed = False
        arms = {name: arm_setup(arm.bridge, arm.compensator, arm.support_limit) for name, arm in shown.items()}
        return {**self._own, "arms": arms, "scene": _scene(shown.values())}

    def close(self) -> None:
        """Start no further budget."""
        for arm in self._arms.values():
            arm.budget.close()


class ArmParameters:
    """The parameters of the two nodes of one arm, and the support that follows from them."""

    def __init__(self) -> None:
        self.bridge: dict[str, Any] = {}
        self.compensator: dict[str, Any] = {}
        #: the largest support 0..1 within rated torque in the whole workspace, 0 if the robot alone needs more; None
        #: without a wearer, and while it is not known
        self.support_limit: float | None = None
        self.budget = BudgetThread()
        self._request: BudgetRequest | None = None

    def take(self, leaf: str, values: Mapping[str, Any]) -> bool:
        """Take the values of one node; return whether they are new."""
        before = self.bridge if leaf == BRIDGE else self.compensator
        if values == before:
            return False
        changed = {name for name in {**before, **values} if before.get(name) != values.get(name)}
        before.clear()
        before.update(values)
        if self.bridge and self.compensator and not changed <= WITHOUT_SUPPORT:
            self._request = budget_request(self.bridge, self.compensator)
        return True

    def update_budget(self) -> bool:
        """Collect a finished budget or start one; return whether `support_limit` is new."""
        if self._request is None:
            is_new, self.support_limit = self.support_limit is not None, None
            return is_new
        if not self.budget.update(self._request):
            return False
        result = self.budget.result
        self.support_limit = (largest_support(result) or 0.0) if isinstance(result, tuple) else None
        return True


def budget_request(bridge: Mapping[str, Any], compensator: Mapping[str, Any]) -> BudgetRequest | None:
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


def _scene(arms: Collection[ArmParameters]) -> dict[str, Any] | None:
    complete = [arm for arm in arms if arm.bridge and arm.compensator]
    try:
        return scene_of(urdf([described(arm.compensator, arm.bridge) for arm in complete])) if complete else None
    except (ExoGravityError, KeyError):
        return None
