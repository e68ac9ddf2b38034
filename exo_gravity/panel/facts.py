"""What changes rarely: limits, settings, the picture of the arms, and the largest support that the motors allow.

A torque budget takes about 0.2 s of arithmetic, and depends on the wearer but not on the support. It runs on a
thread that pauses after each millisecond, so that the web server answers meanwhile.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from exo_gravity.core.compensation.params import COMPENSATOR, robot_of, wearer_of
from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.model.budget import USUAL_TILT, Workspace, budget, largest_support, motor_torques
from exo_gravity.core.motors.joint_motor import OPTIONS
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.params import CAN_BRIDGE
from exo_gravity.core.view.arm_description import described
from exo_gravity.core.view.urdf import urdf
from exo_gravity.panel.scene import scene_of
from exo_gravity.panel.view import arm_setup

PAUSE = 0.005  # s
Values = Mapping[str, Any]
WITHOUT_SUPPORT = frozenset({"support", "mode"})  # which the budget does not depend on


class Facts:
    """Collects parameters by node, and returns `news` for the pages when something has changed."""

    def __init__(self, own: Mapping[str, Any]) -> None:
        """Take `own`: settings of the panel that the pages get too."""
        self._own = own
        self._values: dict[str, dict[str, Any]] = {}  # of each node
        self._arms: Collection[str] = ()
        self._limits: dict[str, float | None] = {}  # largest support of each arm
        self._jobs: dict[str, tuple[str, Future[float | None]]] = {}
        self._checked: dict[str, str] = {}
        self._changed = True
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="budget")

    def note(self, node: str, values: Mapping[str, Any]) -> None:
        """Take the parameters of a node by its full name."""
        self._changed |= self._values.get(node) != values
        self._values[node] = dict(values)

    def discover(self, arms: Collection[str]) -> None:
        """Take the names of the arms."""
        self._changed |= tuple(arms) != tuple(self._arms)
        self._arms = tuple(arms)

    def news(self) -> dict[str, Any] | None:
        """Return everything if anything has changed since the last call, else None. Starts budgets where due."""
        for arm in self._arms:
            self._update_budget(arm)
        if not self._changed:
            return None
        self._changed = False
        arms = {arm: arm_setup(*self._pair(arm), self._limits.get(arm)) for arm in self._arms}
        return {**self._own, "arms": arms, "scene": self._scene()}

    def close(self) -> None:
        """End the budgets."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _pair(self, arm: str) -> tuple[dict[str, Any], dict[str, Any]]:
        return self._values.get(f"/{arm}/can_bridge", {}), self._values.get(f"/{arm}/compensator", {})

    def _scene(self) -> dict[str, Any] | None:
        pairs = [pair for arm in self._arms if all(pair := self._pair(arm))]
        try:
            return scene_of(urdf([described(compensator, bridge) for bridge, compensator in pairs])) if pairs else None
        except (ExoGravityError, KeyError):
            return None

    def _update_budget(self, arm: str) -> None:
        if arm in self._jobs and self._jobs[arm][1].done():
            self._checked[arm], job = self._jobs.pop(arm)
            self._limits[arm] = job.result()
            self._changed = True
        bridge, compensator = self._pair(arm)
        if arm in self._jobs or not (bridge and compensator):
            return
        work = repr([bridge, {key: value for key, value in compensator.items() if key not in WITHOUT_SUPPORT}])
        if self._checked.get(arm) != work:
            self._jobs[arm] = work, self._pool.submit(support_limit, bridge, compensator)


def support_limit(bridge: Values, compensator: Values) -> float | None:
    """Return the largest support 0..1 within rated torque in the whole workspace, None if it is not known.

    0 if the robot alone needs more. None without a wearer.
    """
    try:
        values = values_of(COMPENSATOR, compensator)
        load = wearer_of(values)
        if not any(load[0]):
            return None
        limits = values_of(CAN_BRIDGE, bridge, free_prefix=OPTIONS)
        tilt = math.radians(USUAL_TILT) if values["use_imu"] else 0.0
        workspace = Workspace(limits["position_min"], limits["position_max"], tilt)
        torques = motor_torques(limits["motor"], limits["torque_scale"])
        joints = budget(robot_of(values), load, 1.0, workspace, *torques, lambda: time.sleep(PAUSE))
    except ExoGravityError:
        return None
    return largest_support(joints) or 0.0
