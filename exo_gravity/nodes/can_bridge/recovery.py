"""can_bridge for one purpose: let down an arm that a dead bridge and its dead watchdog left with its motors on."""

from __future__ import annotations

import os

import rclpy
from rclpy.signals import SignalHandlerOptions

from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.motors.params import OPTIONS, motors_of
from exo_gravity.core.safety.params import CAN_BRIDGE, limits_of
from exo_gravity.hardware.ownership.handover import ArmOnBus
from exo_gravity.hardware.ownership.owned_bus import recover
from exo_gravity.nodes.ros.parameters import bus_of, declare
from exo_gravity.nodes.ros.run import keep_to_this_machine

# Set by launcher and launch file: the time in s for the watchdog of the dead bridge to let the arm down.
RECOVER = "EXO_GRAVITY_RECOVER"


def is_requested() -> bool:
    """Whether this process was started for the recovery."""
    return bool(os.environ.get(RECOVER))


def run_recovery() -> int:
    """Let the arm down, if one was left behind; return the exit code, 0 if its motors are off."""
    keep_to_this_machine()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("can_bridge", automatically_declare_parameters_from_overrides=True)
    try:
        values = declare(node, CAN_BRIDGE, free_prefix=OPTIONS)
        arm = ArmOnBus(bus_of(node, values), motors_of(values), limits_of(values), 1.0 / values["rate"])
        owner = f"{node.get_fully_qualified_name()} (PID {os.getpid()})"
        return 0 if recover(arm, owner, node.get_logger().error, float(os.environ[RECOVER])) else 1
    except ExoGravityError as error:
        node.get_logger().error(str(error))
        return 1
