# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The parameters of a file, checked as the nodes check them at their start."""

from exo_gravity.core.compensation.settings import COMPENSATOR, compensator_table
from exo_gravity.core.errors import BusError, named
from exo_gravity.core.motors.joint_motor import buses_of, motors_of, traffic_of
from exo_gravity.core.safety.limits import CAN_BRIDGE, check_bridge, limits_of
from exo_gravity.core.trunk.checks import IMU
from exo_gravity.hardware.bus_lock import bridge_of
from exo_gravity.hardware.network import check_environment
from exo_gravity.hardware.trunk_estimator import TrunkEstimator
from exo_gravity.lab.inputs.arms import node_values, settings_from
from exo_gravity.lab.inputs.parameter_file import Nodes, can_options, stages


def check_nodes(nodes: Nodes) -> None:
    """Check the parameters of each node of an arm and of the IMU as the node does at its start.

    The URDF of `law: urdf` is left to the node if it comes from a topic. Raises ParameterError.
    """
    for node, given in nodes.items():
        name = node.rpartition("/")[2]
        if name == "can_bridge":
            values = node_values(nodes, node, CAN_BRIDGE)
            with named(f"{node} "):
                buses = traffic_of(values, can_options(given)).values()
                check_bridge(values["rate"], motors_of(values), limits_of(values), buses)
        elif name == "imu":
            values = node_values(nodes, node, IMU)
            settings = ("rotation_trunk_from_imu", "rate", "gyroscope_range", "accelerometer_range")
            with named(f"{node} "):
                TrunkEstimator(*(values[setting] for setting in settings))
        elif name == "compensator":
            table = compensator_table(given)
            ignored = {param.name for param in COMPENSATOR} - {param.name for param in table}  # of the paper's arm
            used = {name: value for name, value in given.items() if name not in ignored}
            values = node_values({node: used}, node, table)
            if values.get("urdf.file", True):
                with named(f"{node} "):
                    settings_from(values)


def check_start(nodes: Nodes) -> None:
    """Check what would keep one of `nodes` from its start: a parameter, ROS's environment, or a can_bridge on its bus.

    A second can_bridge would refuse to start. But its compensator would already have sent efforts, and two that send to
    one arm let it down. Raises ParameterError, BusError.
    """
    check_nodes(nodes)
    check_environment()
    for node in stages(nodes)[0]:
        values, options = node_values(nodes, node, CAN_BRIDGE), can_options(nodes[node])
        for channel, (_, own) in buses_of(values["can.channel"], options, len(values["joint_names"])).items():
            if holder := bridge_of((values["can.interface"], channel, own)):
                raise BusError(f"{node}: CAN bus {channel} is held by {holder}, which may carry an arm: stop it first")
