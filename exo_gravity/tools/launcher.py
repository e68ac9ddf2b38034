"""launcher: starts one process per top-level key of the parameter file, and stops them all when one ends.

    /right/can_bridge  ->  the executable `can_bridge`, as node `can_bridge` in the namespace /right

Bridges are stopped first, and waited for: they let the arms down, and nothing they need may vanish under them. The
nodes stop by themselves, too, if the launcher dies: it holds the other end of their standard input.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from exo_gravity.core.errors import ExoGravityError, ParameterError
from exo_gravity.tools.inputs.parameter_file import load, packaged_config

DESCENT = 30.0  # s that a bridge may take to let its arm down before it is killed
FAREWELL = 5.0  # s that any other node may take to end
LOG_FORMAT = "{severity} {message}"

OnLine = Callable[[str, str], None]


def print_line(node: str, line: str) -> None:
    """Print one line of a node's log, with the time of day and the node's name."""
    now = time.time()
    clock = time.strftime("%H:%M:%S", time.localtime(now))
    print(f"{clock}.{int(now % 1 * 1000):03d} {node.lstrip('/'):<18} {line}", flush=True)


class Launcher:
    """The processes of one parameter file."""

    def __init__(self, params: str | Path, on_line: OnLine = print_line):
        self._path = Path(params).resolve()
        nodes = load(self._path)
        _check_buses(nodes)
        self._commands = {node: self._command(node) for node in nodes}
        self._processes: dict[str, subprocess.Popen] = {}
        self._readers: dict[str, threading.Thread] = {}
        self._on_line = on_line

    def start(self) -> None:
        """Start every node."""
        environment = dict(os.environ, PYTHONUNBUFFERED="1", EXO_GRAVITY_SUPERVISED="1")
        environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        environment.setdefault("RCUTILS_CONSOLE_OUTPUT_FORMAT", LOG_FORMAT)
        for node, command in self._commands.items():
            process = subprocess.Popen(
                command,
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                start_new_session=True,  # a Ctrl-C in the terminal reaches the launcher alone
            )
            self._processes[node] = process
            reader = threading.Thread(target=self._read, args=(node, process), daemon=True)
            reader.start()
            self._readers[node] = reader

    def process(self, node: str) -> subprocess.Popen:
        """Return the process of a node by its full name."""
        return self._processes[node]

    def dead(self) -> tuple[str, int] | None:
        """Return the name and exit code of a node that has ended, or None while all run.

        A recorder does not count: a full disk must not let the arm down.
        """
        for node, process in self._processes.items():
            code = process.poll()
            if code is not None and not node.endswith("/recorder"):
                return node, code
        return None

    def stop(self) -> None:
        """Stop every node: bridges first, gently, then the rest."""
        bridges = [node for node in self._processes if node.endswith("/can_bridge")]
        others = [node for node in self._processes if node not in bridges]
        self._end(bridges, DESCENT)
        self._end(others, FAREWELL)

    def _end(self, nodes: list[str], patience: float) -> None:
        """Ask `nodes` to end and wait until they have, and all they started; kill those that do not."""
        processes = [self._processes[node] for node in nodes]
        for process in processes:
            if process.poll() is None:
                process.terminate()  # SIGTERM: unlike SIGINT it leaves no traceback in a node that is still importing
        deadline = time.monotonic() + patience
        for process in processes:
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for node in nodes:  # a dead bridge's watchdog may still be letting the arm down: it has the same output
            self._readers[node].join(max(FAREWELL, deadline - time.monotonic()))

    def run(self, stopping: StopFlag | threading.Event) -> tuple[str, int] | None:
        """Start all, wait until `stopping` is set or a node ends, stop all; return the node that ended, if any."""
        try:
            self.start()
            while not stopping.wait(0.05):
                dead = self.dead()
                if dead:
                    return dead
            return None
        finally:
            self.stop()

    def _command(self, node: str) -> list[str]:
        namespace, name = node.rsplit("/", 1)
        remaps = ("-r", f"__node:={name}", "-r", f"__ns:={namespace or '/'}")
        return [executable(node, name), "--ros-args", *remaps, "--enclave", node, "--params-file", str(self._path)]

    def _read(self, node: str, process: subprocess.Popen) -> None:
        for line in process.stdout:
            self._on_line(node, line.rstrip())


def executable(node: str, name: str) -> str:
    """Return the path of the executable `name` of this package, or raise ParameterError that names the YAML's key."""
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(":"))
    folders = (
        Path(sys.argv[0]).resolve().parent,
        Path(sys.executable).parent,
        *(Path(prefix, "lib", "exo_gravity") for prefix in prefixes),
    )
    found = shutil.which(name, path=os.pathsep.join(map(str, folders)))
    if found is None or name not in ("can_bridge", "imu", "compensator", "simulator", "recorder"):
        raise ParameterError("node name", node, "one that ends in can_bridge, imu, compensator, simulator or recorder")
    return found


def _check_buses(nodes: dict[str, dict]) -> None:
    """Raise ParameterError where two bridges would command the same motor."""
    owner: dict[tuple, str] = {}
    for node, parameters in nodes.items():
        if not node.endswith("/can_bridge"):
            continue
        bus = tuple(sorted((k, str(v)) for k, v in parameters.items() if k.startswith("can.")))
        ids = parameters.get("can_id", [1, 2, 3, 4])
        for can_id in ids if isinstance(ids, list) else ():
            other = owner.setdefault((bus, can_id), node)
            if other != node:
                raise ParameterError(f"{node} can_id", ids, f"other IDs than {other} has on the same bus")


class StopFlag:
    """Set once and for all. Unlike threading.Event it may be set by a signal that interrupts its own setting."""

    def __init__(self):
        self._set = False

    def set(self, *_: object) -> None:
        """Set the flag; fits as a signal handler."""
        self._set = True

    def is_set(self) -> bool:
        """Return whether the flag is set."""
        return self._set

    def wait(self, timeout: float) -> bool:
        """Sleep for `timeout` s, or until a signal; return whether the flag is set."""
        if not self._set:
            time.sleep(timeout)
        return self._set


def stop_on_signals() -> StopFlag:
    """Return a flag that Ctrl-C or SIGTERM sets."""
    stopping = StopFlag()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stopping.set)
    return stopping


def main() -> None:
    """Entry point of the executable `launcher`."""
    parser = argparse.ArgumentParser(prog="launcher", description="Start every node of a parameter file.")
    parser.add_argument("--params", metavar="FILE", help="ROS 2 parameter file (default: the packaged sim.yaml)")
    arguments = parser.parse_args()
    stopping = stop_on_signals()
    try:
        dead = Launcher(arguments.params or packaged_config("sim.yaml")).run(stopping)
    except ExoGravityError as error:
        print(f"launcher: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    if dead:
        node, code = dead
        print(f"launcher: {node.lstrip('/')} ended with exit code {code}; everything was stopped", file=sys.stderr)
        raise SystemExit(1)
