"""Starts the nodes of a parameter file: `ros2 launch exo_gravity exo.launch.py params:=FILE`.

It runs `launcher`, which starts the nodes as its own processes and stops the bridges first. If `ros2 launch` itself is
killed, the launcher stops them too: it watches its standard input.
"""

import signal
import sys

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, EmitEvent, ExecuteProcess, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnShutdown
from launch.events import matches_action
from launch.events.process import ProcessExited, SignalProcess
from launch.substitutions import LaunchConfiguration

from exo_gravity.core.safety.descent import DESCENT_TIMEOUT
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.processes import RECOVERY_TIMEOUT, STOP_TIMEOUT, SUPERVISED

LONGEST_STOP = DESCENT_TIMEOUT + RECOVERY_TIMEOUT + 2 * STOP_TIMEOUT  # s, of the launcher
ARGUMENTS = (  # name, default, description
    ("params", str(packaged_config("sim.yaml")), "parameter file: a top-level key per node; default: a simulated arm"),
    ("namespace", "", "namespace in front of every node of the file, and of the topics /imu/..."),
    ("only", "", "start only the nodes whose full names match one of these shell patterns"),
    ("one_process", "false", "true: run can_bridge and compensator of an arm in one process"),
    ("panel", "false", "true: also start the operator's panel, where the file has none"),
    ("log_level", "info", "debug, info, warn, error or fatal, for every node"),
)
RUN = "from exo_gravity.tools.launcher import main; main()"


def _on_exit(event: ProcessExited, _context: LaunchContext) -> None:
    """Raise RuntimeError, which makes the exit code 1, if a node ended that should not, or motors may be powered."""
    if event.returncode:
        raise RuntimeError(f"the launcher ended with exit code {event.returncode}")


def _check(words: list[str]) -> None:
    """Raise RuntimeError if a word names no argument of this file. `ros2 launch` would ignore it."""
    names = [name for name, *_ in ARGUMENTS]
    unknown = sorted({word.partition(":=")[0] for word in words if ":=" in word}.difference(names))
    if unknown:
        raise RuntimeError(f"{', '.join(unknown)}: not an argument of exo.launch.py; it has {', '.join(names)}")


def _start(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    def argument(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    if any(word.endswith("exo.launch.py") for word in sys.argv):  # else another launch file includes this one
        _check(context.argv)
    words = ["--params", argument("params"), "--log-level", argument("log_level"), "--namespace", argument("namespace")]
    words += ["--only", *argument("only").split()] if argument("only") else []
    words += [f"--{name.replace('_', '-')}" for name in ("one_process", "panel") if argument(name) == "true"]
    process = ExecuteProcess(
        cmd=[sys.executable, "-c", RUN, *words],
        name="launcher",
        additional_env=SUPERVISED,
        output="screen",
        on_exit=_on_exit,
        sigterm_timeout=str(LONGEST_STOP),
        sigkill_timeout=str(STOP_TIMEOUT),
    )
    # `launch` itself sends no signal after an interrupt: a terminal has sent it to all, but `kill` has not.
    stop = EmitEvent(event=SignalProcess(signal_number=signal.SIGTERM, process_matcher=matches_action(process)))
    return [RegisterEventHandler(OnShutdown(on_shutdown=[stop])), process]


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` runs."""
    declared = [DeclareLaunchArgument(name, default_value=value, description=text) for name, value, text in ARGUMENTS]
    return LaunchDescription([*declared, OpaqueFunction(function=_start)])
