# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""launcher: starts one process per top-level key of the parameter file, and stops them all when one ends.

A file with a parameter that a node of an arm or the IMU would refuse is refused before any starts, and one whose arm a
running can_bridge may carry.

A simulation that dies is started again, up to three times in ten minutes; a real arm never is.

With --one-process, can_bridge and compensator of an arm share a process, which counts as that of can_bridge.

Exit code 0: stopped by Ctrl-C, SIGTERM or a closed terminal. 1: a node ended, or motors may still be powered. 2: wrong
use or wrong file.
"""

import argparse
import math
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from datetime import datetime
from functools import partial

from exo_gravity import require_ros
from exo_gravity.core.errors import ExoGravityError
from exo_gravity.hardware.network import localhost_notice, restrict_to_localhost
from exo_gravity.lab.inputs.node_checks import check_start
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.processes import (
    ENDED_WELL,
    Launcher,
    Stopping,
    asking_on_terminal,
    node_modules,
    stop_on_signals,
)
from exo_gravity.tools.cli import print_any_character


def print_line(node: str, line: str) -> None:
    """Print one line of a node's log, with the time of day and the node's name."""
    print(f"{datetime.now().time().isoformat('milliseconds')} {node.lstrip('/'):<18} {line}", flush=True)


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="launcher",
        description="Start every node of a parameter file, and stop them all when one ends.",
        epilog="Each top-level key of the file is a node to start, /namespace/executable: /right/can_bridge starts the "
        f"executable can_bridge in the namespace /right, /imu starts imu. Executables: {', '.join(node_modules())}.",
    )
    parser.add_argument("--params", metavar="FILE", help="ROS 2 parameter file (default: the packaged sim.yaml)")
    parser.add_argument(
        "--only", metavar="PATTERN", nargs="+", action="extend", default=[],
        help="start only the nodes whose full names match a shell pattern: '*/can_bridge' /imu",
    )  # fmt: skip
    parser.add_argument(
        "--one-process", action="store_true",
        help="run can_bridge and compensator of an arm in one process, see docs/performance.md",
    )  # fmt: skip
    parser.add_argument("--panel", action="store_true", help="also start the operator's panel, where the file has none")
    parser.add_argument("--namespace", metavar="NAME", default="", help="in front of every node and of /imu/...")
    parser.add_argument(
        "--remap", metavar="FROM:=TO", action="append", default=[],
        help="let every node use another topic, as the -r of ROS does",
    )  # fmt: skip
    levels = "debug", "info", "warn", "error", "fatal"
    parser.add_argument("--log-level", default="info", choices=levels, help="of every node (default: info)")
    return parser.parse_args(args)


def _stop_with_parent(stopping: Stopping) -> None:
    sys.stdin.read()
    stopping.set()


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of the executable `launcher`."""
    options = _arguments(args)
    require_ros("launcher")
    print_any_character()  # one that raised would end the reader of a node's log, and block the node
    stopping = stop_on_signals()
    if os.environ.get("EXO_GRAVITY_SUPERVISED"):  # by `ros2 launch`, which holds our standard input open
        threading.Thread(target=_stop_with_parent, args=(stopping,), daemon=True).start()
    space, restarts = options.namespace.strip("/"), deque([-math.inf] * 3, maxlen=3)  # the latter in monotonic s
    restrict_to_localhost()
    try:
        while True:
            launcher = Launcher(
                options.params or packaged_config("sim.yaml"),
                print_line,
                options.only,
                ["/panel"] if options.panel else [],
                f"/{space}" if space else "",
                options.one_process,
                ["--log-level", options.log_level, *(word for rule in options.remap for word in ("-r", rule))],
                check_start,
            )
            if sentence := localhost_notice():
                print_line("launcher", sentence)
            with asking_on_terminal(launcher.asking, partial(print_line, "launcher")):
                dead = launcher.run(stopping)
            if not dead or dead[1] in ENDED_WELL or not launcher.is_simulated or time.monotonic() - restarts[0] < 600.0:
                break
            restarts.append(time.monotonic())
            print_line("launcher", f"{dead[0].lstrip('/')} ended with exit code {dead[1]}: the simulation starts again")
    except ExoGravityError as error:
        print(f"launcher: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    if dead:
        print(
            f"launcher: {dead[0].lstrip('/')} ended with exit code {dead[1]}; all nodes were stopped", file=sys.stderr
        )
    for node in launcher.maybe_powered:
        print(f"launcher: the motors of {node} may still be powered: cut their supply", file=sys.stderr)
    if dead or launcher.maybe_powered:
        raise SystemExit(1)
