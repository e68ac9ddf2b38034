# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Starts the nodes of a parameter file: `ros2 launch exo_gravity exo.launch.py params:=FILE`.

Each node is a `Node` action of its own: PushRosNamespace, SetRemap and the like of a file that includes this one reach
it as usual. They stop in the launcher's order: first the bridges, which need the others while they let the arms down,
then the rest, recorders last. `ros2 launch` itself would interrupt all at once; so all but the bridges wait for its
SIGTERM, which comes when the bridges have ended. If `ros2 launch` is killed, each node ends by itself: it watches its
standard input.
"""

import asyncio
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from launch import Action, LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    ExecuteProcess,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit, OnProcessStart, OnShutdown
from launch.events import Shutdown, matches_action
from launch.events.process import ProcessExited, SignalProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from exo_gravity.core.safety.descent import DESCENT_TIMEOUT
from exo_gravity.hardware.network import RANGE
from exo_gravity.lab.inputs.node_checks import check_start
from exo_gravity.lab.inputs.parameter_file import packaged_config, stages
from exo_gravity.lab.inputs.ros_yaml import text_of
from exo_gravity.lab.processes import (
    ABSOLUTE_TOPICS,
    CONFIRMING,
    ENDED_WELL,
    OBSERVERS,
    ONE_PROCESS,
    RECOVERY,
    RECOVERY_TIMEOUT,
    STOP_TIMEOUT,
    SUPERVISED,
    command_of,
    node_arguments,
    planned,
)

# s. A bridge may take the first to let its arm down; the others wait until the last bridge has, or was given up.
BRIDGE_TIMEOUT = DESCENT_TIMEOUT + STOP_TIMEOUT
LAST_TIMEOUT = BRIDGE_TIMEOUT + RECOVERY_TIMEOUT + 2 * STOP_TIMEOUT
WAITS = {"EXO_GRAVITY_WAITS_FOR_BRIDGES": "1"}
ARGUMENTS = (  # name, default, description
    ("params", str(packaged_config("sim.yaml")), "parameter file: a top-level key per node; default: a simulated arm"),
    ("namespace", "", "namespace in front of every node of the file, and of the topics /imu/..."),
    ("only", "", "start only the nodes whose full names match one of these shell patterns"),
    ("one_process", "false", "true: run can_bridge and compensator of an arm in one process"),
    ("panel", "false", "true: also start the operator's panel, where the file has none"),
    ("log_level", "info", "debug, info, warn, error or fatal, for every node"),
)


class Recovery(Action):
    """Lets down an arm that a dead bridge and its dead watchdog left, as the launcher does; then calls `done`.

    It also runs while `launch` shuts down, which starts no process any more.
    """

    def __init__(self, command: Sequence[str], bridge: str, done: Any) -> None:
        super().__init__()
        self._command, self._bridge, self._done = command, bridge, done

    def execute(self, context: LaunchContext) -> None:
        """Start the bridge's executable once more, to let its arm down and nothing else."""
        self._task = context.asyncio_loop.create_task(self._run(context))

    def get_asyncio_future(self) -> "asyncio.Future[None]":
        """Return what `launch` waits for."""
        return self._task

    async def _run(self, context: LaunchContext) -> None:
        process = await asyncio.create_subprocess_exec(
            *self._command, env={**os.environ, **RECOVERY}, stdin=asyncio.subprocess.DEVNULL, start_new_session=True
        )
        try:
            is_off = await asyncio.wait_for(process.wait(), RECOVERY_TIMEOUT) == 0
        except asyncio.TimeoutError:
            process.kill()
            is_off = False
        for event in self._done(self._bridge, is_off):
            await context.emit_event(event)


class Stopping:
    """Ends the nodes in their order.

    params: the parameter file of each node by its name in the file.
    namespace: '/lab' in front of every node.
    problem: why this launch fails, '' while it does not.
    """

    def __init__(self, params: Mapping[str, Path], namespace: str, log_level: str) -> None:
        self.problem = ""
        self._params, self._namespace, self._log_level = params, namespace, log_level
        self._running: dict[str, Action] = {}
        self._told: set[str] = set()  # to end
        self._recovering: set[str] = set()

    def follow(self, node: str, process: Action) -> list[LaunchDescriptionEntity]:
        """Return what follows a node's process from its start to its end."""

        def on_start(_event: Any, context: LaunchContext) -> list[LaunchDescriptionEntity]:
            self._running[node] = process
            return [EmitEvent(event=event) for event in self._next()] if context.is_shutdown else []

        def on_exit(event: ProcessExited, context: LaunchContext) -> list[LaunchDescriptionEntity]:
            return self._on_exit(node, event.returncode, context)

        return [
            RegisterEventHandler(OnProcessStart(target_action=process, on_start=on_start)),
            RegisterEventHandler(OnProcessExit(target_action=process, on_exit=on_exit)),
        ]

    def on_shutdown(self, _event: Any, _context: LaunchContext) -> list[LaunchDescriptionEntity]:
        """End the first stage. An interrupt of `launch` alone reaches no node, so each gets a SIGTERM."""
        return [EmitEvent(event=event) for event in self._next()]

    def _on_exit(self, node: str, code: int, context: LaunchContext) -> list[LaunchDescriptionEntity]:
        self._running.pop(node, None)
        entities: list[LaunchDescriptionEntity] = []
        if node in stages([node])[0] and code not in ENDED_WELL:
            self._recovering.add(node)
            full = f"{self._namespace}{node}"
            words = node_arguments(full, self._params[node], self._namespace, self._log_level)
            entities.append(Recovery([*command_of(node), *words], node, self._on_recovered))
        if not context.is_shutdown and node.endswith(OBSERVERS):
            return [LogInfo(msg=f"{node} ended with exit code {code}; no arm depends on it, the other nodes run on")]
        if not context.is_shutdown and not self.problem:
            self.problem = f"{node.lstrip('/')} ended with exit code {code}; all nodes were stopped"
            return [*entities, EmitEvent(event=Shutdown(reason=self.problem))]
        return [*entities, *(EmitEvent(event=event) for event in self._next())]

    def _on_recovered(self, bridge: str, is_off: bool) -> list[Any]:
        self._recovering.discard(bridge)
        if not is_off:
            self.problem = f"the motors of {bridge} may still be powered: cut their supply"
        return self._next()

    def _next(self) -> list[Any]:
        """Return the signals that end the first stage that still runs, once the one before it has ended."""
        if not self._running and not self._recovering:
            self._finish()
        first = next((stage for stage in stages(self._running) if stage), [])
        if self._recovering and first and not stages(first)[0]:
            return []  # the others stay until that arm is down
        told, self._told = self._told, self._told.union(first)
        return [
            SignalProcess(signal_number=signal.SIGTERM, process_matcher=matches_action(self._running[node]))
            for node in first
            if node not in told
        ]

    def _finish(self) -> None:
        for folder in {path.parent for path in self._params.values()}:
            shutil.rmtree(folder, ignore_errors=True)
        if self.problem:
            raise RuntimeError(self.problem)  # which makes the exit code of `ros2 launch` 1


def _check(words: list[str]) -> None:
    """Raise RuntimeError if a word names no argument of this file. `ros2 launch` would ignore it."""
    names = [name for name, *_ in ARGUMENTS]
    unknown = sorted({word.partition(":=")[0] for word in words if ":=" in word}.difference(names))
    if unknown:
        raise RuntimeError(f"{', '.join(unknown)}: not an argument of exo.launch.py; it has {', '.join(names)}")


def _written(nodes: dict[str, dict[str, Any]], names: list[str]) -> dict[str, Path]:
    """Return a parameter file for each node: whatever namespace it is pushed into, it has its parameters."""
    folder = Path(tempfile.mkdtemp(prefix="exo_gravity_"))
    paths = {node: folder / f"{node.strip('/').replace('/', '_')}.yaml" for node in names}
    for node, path in paths.items():
        path.write_text(text_of({"/**": nodes[node]}), encoding="utf-8")
    return paths


def _start(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    def argument(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    if any(word.endswith("exo.launch.py") for word in sys.argv):  # else another launch file includes this one
        _check(context.argv)
    more = ["/panel"] if argument("panel") == "true" else []
    nodes, names, asking = planned(argument("params"), argument("only").split(), more)
    check_start({node: nodes[node] for node in names})
    params, log_level = _written(nodes, names), argument("log_level")
    pushed = context.launch_configurations.get("ros_namespace", "")
    own = "/".join(filter(None, (pushed.strip("/"), argument("namespace").strip("/"))))
    namespace = f"/{own}" if own else ""
    stopping = Stopping(params, namespace, log_level)
    guests = {bridge: f"{bridge.rpartition('/')[0]}/compensator" for bridge in stages(names)[0]}
    guests = {bridge: guest for bridge, guest in guests.items() if argument("one_process") == "true" and guest in names}
    entities: list[LaunchDescriptionEntity] = [RegisterEventHandler(OnShutdown(on_shutdown=stopping.on_shutdown))]
    for node in names:
        if node in guests.values():
            continue
        is_bridge = bool(stages([node])[0])
        how = {
            "additional_env": SUPERVISED if is_bridge else {**SUPERVISED, **WAITS},
            "output": "screen",
            "sigterm_timeout": str(BRIDGE_TIMEOUT if is_bridge else LAST_TIMEOUT),
            "sigkill_timeout": str(STOP_TIMEOUT),
        }
        space, name = node.rsplit("/", 1)
        if guest := guests.get(node):  # two nodes in one process: remappings of a file that includes this one miss it
            words = [node_arguments(f"{namespace}{n}", params[n], namespace, log_level) for n in (node, guest)]
            process: Action = ExecuteProcess(
                cmd=[*command_of(node, ONE_PROCESS), *words[0], "--", *words[1]], name=name, **how
            )
        else:
            process = Node(
                package="exo_gravity",
                executable=name,
                name=name,
                namespace="/".join(filter(None, (argument("namespace").strip("/"), space.strip("/")))),
                parameters=[params[node]],
                remappings=[(topic, f"{namespace}{topic}") for topic in ABSOLUTE_TOPICS if namespace],
                ros_arguments=["--enclave", f"{namespace}{node}", "--log-level", log_level],
                **how,
            )
        entities += [*stopping.follow(node, process), process]
    said = [CONFIRMING.format(f"{namespace}{bridge}") for bridge in asking]
    if not os.environ.get(RANGE):
        said.insert(0, f"other computers do not see these nodes; {RANGE}=SUBNET admits them")
    return [*entities, *(LogInfo(msg=sentence) for sentence in said)]


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` runs."""
    declared = [DeclareLaunchArgument(name, default_value=value, description=text) for name, value, text in ARGUMENTS]
    return LaunchDescription([*declared, OpaqueFunction(function=_start)])
