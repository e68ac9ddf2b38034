"""`ros2 launch exo_gravity exo.launch.py params:=FILE`: starts `launcher`, which starts everything else."""

from launch.actions import DeclareLaunchArgument, ExecuteProcess, Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare

from launch import LaunchDescription


def generate_launch_description():
    packaged = PathJoinSubstitution([FindPackageShare("exo_gravity"), "config", "exo.yaml"])
    launcher = ExecutableInPackage(package="exo_gravity", executable="launcher")
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=packaged, description="parameter file, one key a node"),
            ExecuteProcess(
                cmd=[launcher, "--params", LaunchConfiguration("params")],
                output="screen",
                sigterm_timeout="30",  # s: the arms come down gently before the launcher ends
                on_exit=Shutdown(),
            ),
        ]
    )
