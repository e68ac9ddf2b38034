"""Whether the motors can give what the compensator's settings ask for: looked at beside the control loop, never in it.

The motors and the joint limits are those of `can_bridge`, which is asked for its parameters once. A budget takes about
0.2 s of arithmetic, so it is made in a thread of its own, with a pause after each millisecond: in one go, at whatever
priority, it kept threads of the loop from their processor for up to 0.1 s (measured, Linux 6.18, two busy cores). While
one is made, newer settings wait, and only the newest of them is looked at next.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import rclpy
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from exo_gravity.core.arm import ArmModel
from exo_gravity.core.budget import Workspace, budget, motor_torques, overload
from exo_gravity.core.compensator import Settings
from exo_gravity.core.control_params import CAN_BRIDGE
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.param_table import values_of
from exo_gravity.core.wearer import LinkLoad

WITHIN = "within rated torque everywhere"
PAUSE = 0.005  # s, some 500 times a budget
ASKED = ("motor", "torque_scale", "position_min", "position_max")


class BudgetWatch:
    """Call `update` regularly; `text` says how the newest settings looked at stand."""

    def __init__(self, node: Node, joint_names: Sequence[str], max_tilt: float):
        self.text = "unknown: can_bridge has not told its motors yet"
        self._node = node
        self._names = tuple(joint_names)
        self._max_tilt = max_tilt
        self._client = node.create_client(GetParameters, "can_bridge/get_parameters")
        self._asked: rclpy.Future | None = None
        self._bridge: Sequence[ParameterValue] | None = None
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="budget")
        self._job: Future | None = None
        self._looked_at: tuple | None = None

    def update(self, settings: Settings) -> None:
        """Take up what is ready, and begin what is to be done for `settings`; never waits."""
        if self._bridge is None:
            self._ask()
        elif self._job is not None and self._job.done():
            self.text, self._job = self._job.result(), None
            if self.text != WITHIN:
                self._node.get_logger().warning(f"{self.text}; the clamp to max_effort holds")
        elif self._job is None:
            support = settings.support if settings.mode == "zero_g" else 0.0
            work = settings.robot, tuple(settings.wearer_mass), tuple(settings.wearer_cog), support
            if work != self._looked_at:
                self._looked_at = work
                self._job = self._pool.submit(self._sentence, *work)

    def _ask(self) -> None:
        """Get motors and joint limits, a bit further with each call."""
        if self._asked is None:
            if self._client.service_is_ready():
                self._asked = self._client.call_async(GetParameters.Request(names=list(ASKED)))
        elif self._asked.done():
            self._bridge = self._asked.result().values
            self._node.destroy_client(self._client)  # one thing less for the executor to wait on

    def _sentence(self, robot: ArmModel, mass: Sequence[float], cog: Sequence[float], support: float) -> str:
        try:
            told = dict(zip(ASKED, map(parameter_value_to_python, self._bridge), strict=False))
            bridge = values_of([param for param in CAN_BRIDGE if param.name in ASKED], told)
            workspace = Workspace(bridge["position_min"], bridge["position_max"], self._max_tilt)
            torques = motor_torques(bridge["motor"], bridge["torque_scale"])
            joints = budget(robot, LinkLoad(mass, cog), support, workspace, *torques, lambda: time.sleep(PAUSE))
            return overload(self._names, joints) or WITHIN
        except ParameterError as error:
            return f"unknown: can_bridge tells {error}"
