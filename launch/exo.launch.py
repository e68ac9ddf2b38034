"""Starts `launcher`, which starts one process per node: `ros2 launch exo_gravity exo.launch.py params:=FILE`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` runs: the launcher, with 30 s to let the arms down when it is stopped."""
    packaged = PathJoinSubstitution([FindPackageShare("exo_gravity"), "config", "exo.yaml"])
    launcher = ExecutableInPackage(package="exo_gravity", executable="launcher")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params", default_value=packaged, description="parameter file: one top-level key per node"
            ),
            ExecuteProcess(
                cmd=[launcher, "--params", LaunchConfiguration("params")],
                output="screen",
                sigterm_timeout="30",  # s: the launcher lets the arms down before it ends
                on_exit=Shutdown(),
            ),
        ]
    )
