"""Starts the nodes of a parameter file: `ros2 launch exo_gravity exo.launch.py params:=FILE`.

When a node ends on which the arm depends, or on Ctrl-C, all stop, with SIGTERM: first the bridges, which need the
others while they let the arms down, then the others, the recorders last. A terminal sends Ctrl-C to every node at once;
so all but the bridges ignore SIGINT. If `ros2 launch` itself is killed, each node stops with its standard input.

The nodes are no `LifecycleNode` actions: with those, `ros2 launch` would be one more DDS participant while an arm
is worn. `can_bridge` activates itself if `autostart` is set; `ros2 lifecycle` works as with any lifecycle node.
"""

import asyncio
import os
import signal
import sys
from pathlib import Path

from launch import Event, EventHandler, LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit, OnProcessStart, OnShutdown
from launch.events import matches_action
from launch.events.process import ProcessExited, ProcessStarted, SignalProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from exo_gravity.core.safety.descent import DESCENT_TIMEOUT
from exo_gravity.tools.inputs.parameter_file import (
    ABSOLUTE_TOPICS,
    ENDED_WELL,
    OBSERVERS,
    RECOVERY,
    RECOVERY_TIMEOUT,
    STOP_TIMEOUT,
    SUPERVISED,
    check_buses,
    chosen,
    executable,
    in_namespace,
    load,
    packaged_config,
    stages,
)

LONGEST_STOP = DESCENT_TIMEOUT + RECOVERY_TIMEOUT  # s until the last bridge is done; `launch` then ends the others


class Recovered(Event):
    """The recovery of a dead bridge's arm has ended."""

    name = "exo_gravity.Recovered"

    def __init__(self, bridge: str, returncode: int) -> None:
        self.bridge, self.returncode = bridge, returncode


class Stopping:
    """Stops `nodes` in order. Its methods are event handlers, which return the actions that follow."""

    def __init__(self, nodes: dict[str, Node]) -> None:
        self._nodes = nodes
        self._stages = stages(nodes)
        self._running: set[str] = set()
        self._terminated: set[str] = set()
        self._is_stopping = False

    def handlers(self) -> list[RegisterEventHandler]:
        """Return the actions that register the handlers."""
        recovered = OpaqueFunction(function=lambda context: self._on_recovered(context.locals.event))
        return [
            RegisterEventHandler(OnProcessStart(on_start=self._on_start)),
            RegisterEventHandler(OnProcessExit(on_exit=self._on_exit)),
            RegisterEventHandler(OnShutdown(on_shutdown=self._on_shutdown)),
            RegisterEventHandler(EventHandler(matcher=lambda e: isinstance(e, Recovered), entities=recovered)),
        ]

    def _name(self, action: object) -> str:
        """Return the full name of the node that an action starts, '' for another action."""
        return next((name for name, node in self._nodes.items() if node is action), "")

    def _on_start(self, event: ProcessStarted, _context: LaunchContext) -> None:
        self._running.update(filter(None, [self._name(event.action)]))

    def _on_exit(self, event: ProcessExited, context: LaunchContext) -> list[LaunchDescriptionEntity]:
        name = self._name(event.action)
        if name in self._stages[0] and event.returncode not in ENDED_WELL:
            # Not a process action, because `launch` starts none once it is stopping.
            task = context.asyncio_loop.create_task(_recover(event))
            task.add_done_callback(lambda _: context.emit_event_sync(Recovered(name, event.returncode)))
            context.add_completion_future(task)
            return []
        return self._ended(name, event.returncode) if name else []

    def _on_recovered(self, event: Recovered) -> list[LaunchDescriptionEntity]:
        return self._ended(event.bridge, event.returncode)

    def _on_shutdown(self, _event: Event, _context: LaunchContext) -> list[LaunchDescriptionEntity]:
        self._is_stopping = True
        return self._stop_next()

    def _ended(self, name: str, code: int) -> list[LaunchDescriptionEntity]:
        """Note that a node has ended. Raises RuntimeError, which stops everything with exit code 1, if none should."""
        self._running.discard(name)
        if self._is_stopping:
            return self._stop_next()
        if name.endswith(OBSERVERS):
            return []
        raise RuntimeError(f"{name} ended with exit code {code}; all nodes stop")

    def _stop_next(self) -> list[LaunchDescriptionEntity]:
        """Return the actions that stop the first stage of which a node runs."""
        stage = next((running for names in self._stages if (running := self._running.intersection(names))), set())
        fresh = stage - self._terminated  # a second SIGTERM would end a node that is closing
        self._terminated |= fresh
        return [EmitEvent(event=_terminate(self._nodes[name])) for name in sorted(fresh)]


async def _recover(dead: ProcessExited) -> None:
    """Let the arm of a dead bridge down if its watchdog does not, with the bridge's own executable."""
    environment = {**(dead.env or os.environ), **RECOVERY}
    process = await asyncio.create_subprocess_exec(*dead.cmd, env=environment, start_new_session=True)
    try:
        is_off = await asyncio.wait_for(process.wait(), RECOVERY_TIMEOUT) == 0
    except asyncio.TimeoutError:
        process.kill()
        is_off = False
    if not is_off:
        print(f"launch: the motors of {dead.process_name} may still be powered: cut their supply", file=sys.stderr)


def _terminate(node: Node) -> SignalProcess:
    return SignalProcess(signal_number=signal.SIGTERM, process_matcher=matches_action(node))


def _node(full_name: str, params: Path, namespace: str, log_level: str) -> Node:
    parent, name = f"{namespace}{full_name}".rsplit("/", 1)
    is_bridge = name == "can_bridge"
    return Node(
        executable=executable(full_name),
        name=name,
        namespace=parent or "/",
        parameters=[str(params)],
        remappings=[(topic, f"{namespace}{topic}") for topic in ABSOLUTE_TOPICS if namespace],
        ros_arguments=["--enclave", f"{parent}/{name}", "--log-level", log_level],
        additional_env=SUPERVISED if is_bridge else {**SUPERVISED, "EXO_GRAVITY_IGNORE_SIGINT": "1"},
        output="screen",
        sigterm_timeout=str(DESCENT_TIMEOUT if is_bridge else LONGEST_STOP),
        sigkill_timeout=str(STOP_TIMEOUT),
    )


def _start(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    def argument(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    params, namespace = Path(argument("params")).resolve(), argument("namespace").strip("/")
    namespace = f"/{namespace}" if namespace else ""
    content = load(params)
    if argument("panel") == "true":
        content.setdefault("/panel", {})
    check_buses(content)
    path = in_namespace(params, namespace)
    names = chosen(content, argument("only").split())
    nodes = {name: _node(name, path, namespace, argument("log_level")) for name in names}
    return [*Stopping(nodes).handlers(), *nodes.values()]


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` runs."""
    arguments = (
        ("params", str(packaged_config("exo.yaml")), "parameter file: one top-level key per node"),
        ("namespace", "", "namespace in front of every node of the file, and of the topics /imu/..."),
        ("only", "", "start only the nodes whose full names match one of these shell patterns"),
        ("panel", "false", "true: also start the operator's panel, where the file has none"),
        ("log_level", "info", "debug, info, warn, error or fatal, for every node"),
    )
    declared = [DeclareLaunchArgument(name, default_value=value, description=text) for name, value, text in arguments]
    return LaunchDescription([*declared, OpaqueFunction(function=_start)])
