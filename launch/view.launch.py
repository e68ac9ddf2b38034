# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Opens RViz for running arms: `ros2 launch exo_gravity view.launch.py params:=FILE`.

Starts robot_model, robot_state_publisher and RViz, and no arm. `rviz:=false` leaves RViz out, for other viewers.
"""

from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.tools.urdf import urdf_of


def _check_rviz() -> None:
    """Raise RuntimeError if RViz is not installed: a robot's computer does without it."""
    try:
        get_package_prefix("rviz2")
    except PackageNotFoundError:
        raise RuntimeError("RViz is not installed: apt install ros-jazzy-rviz2, or start with rviz:=false") from None


def _start(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    if LaunchConfiguration("rviz").perform(context).lower() in ("true", "1"):
        _check_rviz()
    meshes = LaunchConfiguration("meshes").perform(context)
    # Read before any node starts: a file that is refused leaves none behind.
    description = urdf_of(Path(LaunchConfiguration("params").perform(context)), meshes=meshes)
    return [
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            parameters=[{"robot_description": ParameterValue(description, value_type=str)}],
            remappings=[("robot_description", "/robot_state_publisher/robot_description")],  # robot_model has it
        ),
        Node(
            package="rviz2",
            executable="rviz2",
            arguments=["--display-config", str(packaged_config("rviz/exo.rviz"))],
            condition=IfCondition(LaunchConfiguration("rviz")),
        ),
        # Last: where one of the others is not installed, launch fails, and would leave it behind.
        Node(
            package="exo_gravity",
            executable="robot_model",
            parameters=[{"meshes": ParameterValue(meshes, value_type=str)}],
            output="screen",
        ),
    ]


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` runs."""
    arguments = (
        ("params", str(packaged_config("sim.yaml")), "parameter file of the arms, the one that they were started with"),
        ("meshes", "", "address of a folder with LINK.stl per link"),
        ("rviz", "true", "whether to start RViz"),
    )
    reach = EnvironmentVariable("EXO_GRAVITY_DISCOVERY_RANGE", default_value="LOCALHOST")
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value, description=text) for name, value, text in arguments),
            SetEnvironmentVariable("ROS_AUTOMATIC_DISCOVERY_RANGE", reach),  # as the arms' own nodes set it
            OpaqueFunction(function=_start),
        ]
    )
