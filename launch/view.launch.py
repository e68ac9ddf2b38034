"""Opens RViz for running arms: `ros2 launch exo_gravity view.launch.py params:=FILE`.

Starts robot_model, robot_state_publisher and RViz, and no arm. `rviz:=false` leaves RViz out, for other viewers.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import Command, EnvironmentVariable, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` runs."""
    config = PathJoinSubstitution([FindPackageShare("exo_gravity"), "config"])
    urdf = ExecutableInPackage(package="exo_gravity", executable="urdf")
    meshes = LaunchConfiguration("meshes")
    description = Command([urdf, " --params '", LaunchConfiguration("params"), "' --meshes '", meshes, "'"])
    reach = EnvironmentVariable("ROS_AUTOMATIC_DISCOVERY_RANGE", default_value="LOCALHOST")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params",
                default_value=PathJoinSubstitution([config, "exo.yaml"]),
                description="parameter file of the arms, the one that they were started with",
            ),
            DeclareLaunchArgument("meshes", default_value="", description="address of a folder with LINK.stl per link"),
            DeclareLaunchArgument("rviz", default_value="true", description="whether to start RViz"),
            SetEnvironmentVariable("ROS_AUTOMATIC_DISCOVERY_RANGE", reach),  # as the arms' own nodes set it
            Node(
                package="exo_gravity",
                executable="robot_model",
                parameters=[{"meshes": ParameterValue(meshes, value_type=str)}],
                output="screen",
            ),
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                parameters=[{"robot_description": ParameterValue(description, value_type=str)}],
                remappings=[("robot_description", "/robot_state_publisher/robot_description")],  # robot_model has it
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["--display-config", PathJoinSubstitution([config, "rviz", "exo.rviz"])],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
