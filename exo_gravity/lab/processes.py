# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The processes of a parameter file: starts one per top-level key, watches them, and stops them.

    /right/can_bridge  ->  the executable `can_bridge`, as node `can_bridge` in the namespace /right

The bridges stop first, because they need the other nodes while they let the arms down. If this process dies, the nodes
stop by themselves: each watches its standard input, whose other end `Launcher` holds.

If a bridge dies, its watchdog lets the arm down. If both die, the bridge's executable is started once more, to let the
arm down and nothing else.
"""

import _thread
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from subprocess import PIPE, STDOUT

import exo_gravity
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import SIMULATED_BUSES
from exo_gravity.core.safety.descent import DESCENT_TIMEOUT
from exo_gravity.core.safety.limits import CONFIRM
from exo_gravity.lab.inputs.parameter_file import Nodes, load, stages, text_of
from exo_gravity.lab.packages import check_packages

NODES_PACKAGE = "exo_gravity.nodes."
ONE_PROCESS = f"{NODES_PACKAGE}can_bridge.one_process"  # runs can_bridge and compensator
WATCHDOG_TIMEOUT = 30.0  # s for the watchdog of a dead bridge to let the arm down
RECOVERY_TIMEOUT = WATCHDOG_TIMEOUT + DESCENT_TIMEOUT
STOP_TIMEOUT = 5.0  # s for any other node to end
SUPERVISED = {"EXO_GRAVITY_SUPERVISED": "1", "PYTHONUNBUFFERED": "1"}  # a node then ends with its standard input
# Starts can_bridge for one purpose: to let down an arm that was left behind, after that time for its watchdog.
RECOVERY = {"EXO_GRAVITY_RECOVER": f"{WATCHDOG_TIMEOUT:g}"}
ENDED_WELL = (0, 2)  # exit codes of a node that ended by itself: stopped, or with wrong parameters or no bus
CONFIRMING = (
    "the start of {0} asks whether the arm hangs as it is drawn; once you see it hang: "
    "ros2 service call {0}/confirm_pose std_srvs/srv/Trigger"
)
# A node that may end alone: the arm does not depend on it, and a full disk must not let the arm down.
OBSERVERS = ("/recorder", "/robot_model", "/panel", "/wearer")
# What no arm waits for, and no operator: it imports what it needs after the s in which an arm is checked and taken up.
LAST, DELAY = ("/wearer", "/robot_model"), {"EXO_GRAVITY_DELAY": "4"}
ABSOLUTE_TOPICS = ("/imu/data", "/imu/data_raw", "/imu/pitch_yaw")  # those that a namespace must be added to

Stopping = threading.Event


def node_modules() -> dict[str, str]:
    """Return the executables that are nodes, each with its module, from the entry points of the installed package."""
    try:
        scripts = distribution("exo_gravity").entry_points.select(group="console_scripts")
    except PackageNotFoundError:
        return {}
    return {script.name: script.module for script in sorted(scripts) if script.module.startswith(NODES_PACKAGE)}


def program(module: str, name: str) -> list[str]:
    """Return the command that runs `main` of a module of this package as `name`.

    It looks for no file in a folder: python-can installs an executable `can_bridge` too.
    """
    return [sys.executable, str(Path(exo_gravity.__file__).with_name("executable.py")), module, name]


def command_of(node: str, module: str = "") -> list[str]:
    """Return the command that runs `node` ('/right/can_bridge'). Raises ParameterError if this package has none.

    module: in place of the node's own.
    """
    name, modules = node.rpartition("/")[2], node_modules()
    if name not in modules:
        raise ParameterError("node name", node, f"/namespace/executable, with one of {', '.join(modules)}")
    return program(module or modules[name], name)


def chosen(nodes: Iterable[str], only: Sequence[str]) -> list[str]:
    """Return the `nodes` that match one of the shell patterns `only`; without patterns, all.

    A pattern is compared with the full name: `/right/*`, `*/compensator`. Raises ParameterError if one matches no node.
    """
    names = list(nodes)
    for pattern in only:
        if not any(fnmatchcase(node, pattern) for node in names):
            raise ParameterError("only", pattern, f"a pattern that matches one of {', '.join(names)}")
    return [node for node in names if not only or any(fnmatchcase(node, pattern) for pattern in only)]


@contextlib.contextmanager
def asking_on_terminal(bridges: Sequence[str], say: Callable[[str], None]) -> Iterator[None]:
    """Ask on this terminal whether the arms of `bridges` hang as they are drawn, when their starts wait for that.

    say: where there is no terminal, is called with each sentence that names the service to call.
    """
    if not (bridges and sys.stdin.isatty()):
        for bridge in bridges:
            say(CONFIRMING.format(bridge))
        yield
        return
    with subprocess.Popen([*program(f"{NODES_PACKAGE}pose_prompt", "pose_prompt"), *bridges]) as prompt:
        try:
            yield
        finally:
            prompt.terminate()


def wearers(nodes: Nodes) -> list[str]:
    """Return the nodes `wearer` to start with the compensators of a file that has no key for them.

    An arm of ros2_control has none.
    """
    own = [node for node, values in nodes.items() if values.get("command_interface") != "multi_array"]
    beside = [f"{node.rpartition('/')[0]}/wearer" for node in own if node.endswith("/compensator")]
    return [node for node in beside if node not in nodes]


def ended(process: "subprocess.Popen[str]", timeout: float) -> int:
    """Wait at most `timeout` s for the end of a process, then kill it; return its exit code."""
    try:
        return process.wait(max(0.0, timeout))
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


class Launcher:
    """The processes of one parameter file.

    on_line(node, line) is called with each line that a node prints. only: shell patterns of the nodes to start; ()
    starts all. more: nodes to start in addition to those of the file, with their default parameters. namespace: '/lab'
    in front of every node and of the IMU's topics. one_process: whether can_bridge and compensator of an arm share one.
    arguments: of ROS, for every node. check(nodes): may refuse the nodes that are to start, by an exception. Raises
    ParameterError, MissingPackageError.

    params: what the nodes read: a copy of the file as the tools have read it, so that nothing depends on two readers.
    asking: the bridges whose start asks a person whether the arm hangs as it is drawn.
    is_simulated: whether no bridge can reach a real arm.
    maybe_powered: after `stop`, the bridges whose motors may still be on.
    """

    def __init__(
        self,
        params: str | Path,
        on_line: Callable[[str, str], object],
        only: Sequence[str] = (),
        more: Sequence[str] = (),
        namespace: str = "",
        one_process: bool = False,
        arguments: Sequence[str] = (),
        check: Callable[[Nodes], object] = lambda nodes: None,
    ) -> None:
        nodes = {**{node: {} for node in more}, **load(params)}
        nodes |= {node: {} for node in wearers(nodes)}
        names = chosen(nodes, only)
        commands = {node: command_of(node) for node in names}
        check_packages(node.rpartition("/")[2] for node in names)
        check({node: nodes[node] for node in names})
        bridges = stages(names)[0]
        self.asking = [f"{namespace}{node}" for node in bridges if nodes[node].get("start_pose", CONFIRM) == CONFIRM]
        buses = {nodes[bridge].get("can.interface") for bridge in bridges}
        self.is_simulated = buses <= {*SIMULATED_BUSES} and bool(buses)
        self.maybe_powered: list[str] = []
        try:
            self._folder = tempfile.TemporaryDirectory(prefix="exo_gravity_")
            self.params = Path(self._folder.name, Path(params).name)
            self.params.write_text(text_of({f"{namespace}{node}": nodes[node] for node in nodes}), encoding="utf-8")
        except OSError as error:
            expected = f"a folder with room for a copy of the parameters ({error.strerror or error})"
            raise ParameterError("TMPDIR", os.environ.get("TMPDIR", "/tmp"), expected) from None
        self._namespace, self._arguments, self._on_line = namespace, arguments, on_line
        pairs = {bridge: f"{bridge.rpartition('/')[0]}/compensator" for bridge in bridges if one_process}
        # The compensator that shares the process of its can_bridge
        self._guests = {bridge: guest for bridge, guest in pairs.items() if guest in names}
        for bridge, guest in self._guests.items():
            commands[bridge] = [*command_of(bridge, ONE_PROCESS), *self._words(bridge), "--", *self._words(guest)]
            del commands[guest]
        alone = {node: [*commands[node], *self._words(node)] for node in commands if node not in self._guests}
        self._commands = commands | alone
        self._processes: dict[str, subprocess.Popen[str]] = {}
        self._readers: dict[str, threading.Thread] = {}
        self._ended_observers: set[str] = set()

    def _words(self, node: str) -> list[str]:
        """Return the arguments of a node's executable."""
        full = f"{self._namespace}{node}"
        space, name = full.rsplit("/", 1)
        topics = [f"{topic}:={self._namespace}{topic}" for topic in ABSOLUTE_TOPICS if self._namespace]
        rules = (f"__node:={name}", f"__ns:={space or '/'}", *topics)
        remaps = [word for rule in rules for word in ("-r", rule)]
        return ["--ros-args", *remaps, "--enclave", full, "--params-file", str(self.params), *self._arguments]

    def start(self) -> None:
        """Start every node."""
        for node in self._commands:
            late = DELAY if node.endswith(LAST) else {}
            self._processes[node], self._readers[node] = self._start(node, {**SUPERVISED, **late})

    def _start(self, node: str, variables: Mapping[str, str]) -> tuple[subprocess.Popen[str], threading.Thread]:
        """Start one node with more environment `variables`; return its process and the reader of its log."""
        log_format = f"{'{name} ' if node in self._guests else ''}{{severity}} {{message}}"
        environment = {"RCUTILS_CONSOLE_OUTPUT_FORMAT": log_format, **os.environ, **variables}
        process = subprocess.Popen(
            self._commands[node], env=environment, stdin=PIPE, stdout=PIPE, stderr=STDOUT, text=True, errors="replace",
            start_new_session=True,  # Ctrl-C in the terminal reaches only the launcher
        )  # fmt: skip
        reader = threading.Thread(target=self._read, args=(node, process), daemon=True)
        reader.start()
        return process, reader

    def _read(self, node: str, process: subprocess.Popen[str]) -> None:
        names = (node, self._guests[node]) if node in self._guests else ()
        loggers = {f"{self._namespace}{name}"[1:].replace("/", "."): name for name in names}
        for line in process.stdout or ():
            logger, _, rest = line.partition(" ")
            name, text = (loggers[logger], rest) if logger in loggers else (node, line)
            with contextlib.suppress(OSError):  # of a closed terminal: a node whose log is not read would block
                self._on_line(name, text.rstrip())

    def process(self, node: str) -> subprocess.Popen[str]:
        """Return the process of a node by its full name."""
        host = next((host for host, guest in self._guests.items() if guest == node), node)
        return self._processes[host]

    def exit_code(self, node: str) -> int | None:
        """Return the exit code of a node that was started and has ended, else None."""
        return self._processes[node].poll() if node in self._processes else None

    def dead(self) -> tuple[str, int] | None:
        """Return the name and exit code of a node that has ended, None while all run.

        An observer may end alone: that is said once.
        """
        for node in set(self._processes) - self._ended_observers:
            code = self.exit_code(node)
            if code is not None and not node.endswith(OBSERVERS):
                return node, code
            if code is not None:
                self._ended_observers.add(node)
                self._on_line(node, f"ended with exit code {code}; no arm depends on it, the other nodes run on")
        return None

    def run(self, stopping: Stopping) -> tuple[str, int] | None:
        """Run the nodes until `stopping` is set or one ends; return the name and exit code of the one that ended."""
        dead = None
        try:
            self.start()
            while not (dead or stopping.wait(0.05)):
                dead = self.dead()
            return dead
        finally:
            self.stop()

    def stop(self) -> None:
        """Stop every node: first the bridges, which let the arms down, then the rest, and the recorder last."""
        bridges, others, recorders = stages(self._processes)
        self._terminate(bridges, DESCENT_TIMEOUT)
        self.maybe_powered = [node for node in bridges if not self._is_off(node)]
        self._terminate(others, STOP_TIMEOUT)
        self._terminate(recorders, STOP_TIMEOUT)
        self._folder.cleanup()

    def _terminate(self, nodes: list[str], timeout: float) -> None:
        """Terminate `nodes` and wait for them; kill those that run for more than `timeout` s."""
        for node in nodes:
            self._processes[node].terminate()  # SIGTERM: SIGINT would print a traceback in a node that still imports
        deadline = time.monotonic() + timeout
        for node in nodes:
            if ended(self._processes[node], deadline - time.monotonic()) in ENDED_WELL:
                self._readers[node].join(STOP_TIMEOUT)

    def _is_off(self, node: str) -> bool:
        """Return whether the motors of a bridge that has ended are off; let its arm down if nothing else has.

        The bridge's executable waits for the watchdog of the dead bridge, and lets the arm down if that has died too.
        """
        if self.exit_code(node) in ENDED_WELL:
            return True
        recovery, reader = self._start(node, RECOVERY)
        is_off = ended(recovery, RECOVERY_TIMEOUT) == 0
        reader.join(STOP_TIMEOUT)
        return is_off


def stop_on_signals() -> Stopping:
    """Return an event that Ctrl-C, SIGTERM or a closed terminal sets; nohup keeps SIGHUP away."""
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            # On a thread, which waits where the handler interrupts a holder of the event's lock.
            signal.signal(number, lambda *_: _thread.start_new_thread(stopping.set, ()))
    return stopping
