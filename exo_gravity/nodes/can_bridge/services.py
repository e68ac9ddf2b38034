"""The services of `can_bridge`: enable, clear_fault and set_zero, each run on the control thread between two cycles."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TypeVar

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.hardware.control_loop import ControlLoop

ZERO_TOLERANCE = 0.02  # rad that a motor may report after set_zero
ZERO_TIMEOUT = 3.0  # s; motors are silent for up to 1.5 s while they write their memory
CALL_TIMEOUT = 2.0  # s that a service waits for the control thread

Response = TypeVar("Response", SetBool.Response, Trigger.Response)


class BridgeServices:
    """Creates the services on `node`. get_loop returns the present control loop, None while the node is inactive."""

    def __init__(
        self, node: Node, get_loop: Callable[[], ControlLoop | None], motors: Sequence[JointMotor], limits: Limits
    ) -> None:
        self._get_loop = get_loop
        self._motors = motors
        self._limits = limits
        node.create_service(SetBool, "~/enable", self._on_enable)
        node.create_service(Trigger, "~/clear_fault", self._on_clear_fault)
        node.create_service(Trigger, "~/set_zero", self._on_set_zero)

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        def switch(loop: ControlLoop) -> str:
            safety = loop.safety
            if not request.data:
                safety.disable(time.monotonic())
            elif not safety.enable(time.monotonic()):
                reason = f" ({safety.fault.reason})" if safety.fault else ""
                return f"refused: the arm is {safety.state.value}{reason}"
            return ""

        return self._on_control_thread(switch, response)

    def _on_clear_fault(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def clear(loop: ControlLoop) -> str:
            safety = loop.safety
            return "" if safety.clear(time.monotonic()) else f"no fault to clear: the arm is {safety.state.value}"

        return self._on_control_thread(clear, response)

    def _on_set_zero(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        since = time.monotonic()
        self._on_control_thread(self._set_zero, response)
        loop = self._get_loop()
        if response.success and loop is not None and not self._is_zeroed(loop, since):
            columns = zip(self._limits.joint_names, loop.samples, strict=True)
            positions = ", ".join(f"{name} at {joint.position:.3f} rad" for name, joint in columns)
            response.success, response.message = False, f"the motors did not set their zero: {positions}"
        return response

    def _is_zeroed(self, loop: ControlLoop, since: float) -> bool:
        """Wait until every motor has replied again; return whether all then report 0."""
        end = since + ZERO_TIMEOUT
        while time.monotonic() < end:
            if all(joint.time > since and abs(joint.position) <= ZERO_TOLERANCE for joint in loop.samples):
                return True
            time.sleep(0.005)
        return False

    def _set_zero(self, loop: ControlLoop) -> str:
        safety: SafetyMachine = loop.safety
        if any(motor.zero for motor in self._motors):
            return f"zero = {[motor.zero for motor in self._motors]}: must be all 0 when the motors store the zero"
        if safety.state is not State.DISABLED:
            return f"refused: the arm is {safety.state.value}, must be disabled"
        now = time.monotonic()
        if any(self._limits.is_silent(now, joint) for joint in loop.samples):
            return "refused: a motor does not reply"
        if not safety.settled(now):
            return "refused: the arm is not at rest"
        loop.set_zero()
        return ""

    def _on_control_thread(self, function: Callable[[ControlLoop], str], response: Response) -> Response:
        """Run `function` on the control thread; it returns an error text, or ''.

        A call that has timed out never runs later: an arm must not be enabled after its operator was refused.
        """
        loop = self._get_loop()
        if loop is None:
            response.success, response.message = False, "the node is not active"
            return response
        future = loop.call(lambda: function(loop))
        try:
            response.message = future.result(CALL_TIMEOUT)
        except BusError as error:
            response.message = str(error)
        except TimeoutError:
            future.cancel()
            response.message = "the control thread did not respond"
        response.success = not response.message
        return response
