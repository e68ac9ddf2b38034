# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Runs the package's launcher: `ros2 launch exo_gravity exo.launch.py params:=FILE`.

A namespace and remappings that a file pushes which includes this one (PushRosNamespace, SetRemap) reach every node. If
`ros2 launch` is killed the launcher lets the arms down: it watches its standard input.
"""

import signal
import sys

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, EmitEvent, ExecuteProcess, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnShutdown
from launch.events import Shutdown, matches_action
from launch.events.process import ProcessExited, SignalProcess
from launch.substitutions import LaunchConfiguration

from exo_gravity.core.safety.descent import DESCENT_TIMEOUT
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.processes import RECOVERY_TIMEOUT, STOP_TIMEOUT, SUPERVISED, program

# s for the launcher to let the arms down, also those that a bridge and its watchdog have left
TIMEOUT = DESCENT_TIMEOUT + RECOVERY_TIMEOUT + 4 * STOP_TIMEOUT
ARGUMENTS = (  # name, default, description
    ("params", str(packaged_config("sim.yaml")), "parameter file: a top-level key per node; default: a simulated arm"),
    ("namespace", "", "namespace in front of every node of the file, and of the topics /imu/..."),
    ("only", "", "start only the nodes whose full names match one of these shell patterns"),
    ("one_process", "false", "true: run can_bridge and compensator of an arm in one process"),
    ("panel", "false", "true: also start the operator's panel, where the file has none"),
    ("log_level", "info", "debug, info, warn, error or fatal, for every node"),
)


def _check(words: list[str]) -> None:
    """Raise RuntimeError if a word names no argument of this file. `ros2 launch` would ignore it."""
    names = [name for name, *_ in ARGUMENTS]
    unknown = sorted({word.partition(":=")[0] for word in words if ":=" in word}.difference(names))
    if unknown:
        raise RuntimeError(f"{', '.join(unknown)}: not an argument of exo.launch.py; it has {', '.join(names)}")


def _on_exit(event: ProcessExited, _context: LaunchContext) -> list[LaunchDescriptionEntity]:
    if event.returncode:
        raise RuntimeError(f"the launcher ended with exit code {event.returncode}")  # that of `ros2 launch` is then 1
    return [EmitEvent(event=Shutdown(reason="the launcher has ended"))]


def _start(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    if any(word.endswith("exo.launch.py") for word in sys.argv):  # else another launch file includes this one
        _check(context.argv)
    given = {name: LaunchConfiguration(name).perform(context) for name, *_ in ARGUMENTS}
    pushed = context.launch_configurations
    spaces = (pushed.get("ros_namespace", "").strip("/"), given["namespace"].strip("/"))
    words = [
        "--params",
        given["params"],
        "--log-level",
        given["log_level"],
        "--namespace",
        "/".join(filter(None, spaces)),
    ]
    words += ["--one-process"] * (given["one_process"] == "true") + ["--panel"] * (given["panel"] == "true")
    for option, values in (
        ("--only", given["only"].split()),
        ("--remap", map(":=".join, pushed.get("ros_remaps", ()))),
    ):
        words += [word for value in values for word in (option, value)]
    launcher = ExecuteProcess(
        cmd=[*program("exo_gravity.tools.launcher", "launcher"), *words],
        name="launcher",
        output="screen",
        additional_env=SUPERVISED,
        sigterm_timeout=str(TIMEOUT),
        sigkill_timeout=str(TIMEOUT),
        on_exit=_on_exit,
    )
    # An interrupt of `ros2 launch` alone reaches no process.
    end = EmitEvent(event=SignalProcess(signal_number=signal.SIGTERM, process_matcher=matches_action(launcher)))
    return [RegisterEventHandler(OnShutdown(on_shutdown=[end])), launcher]


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` runs."""
    declared = [DeclareLaunchArgument(name, default_value=value, description=text) for name, value, text in ARGUMENTS]
    return LaunchDescription([*declared, OpaqueFunction(function=_start)])
