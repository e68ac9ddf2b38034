# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A calibration on the device: the person at the terminal, and the arm's nodes with `calibrator` for the compensator.

Every observation is written to the record as it comes, so that Ctrl-C and faults lose nothing. On Ctrl-C, after the
last pose and after any trouble the launcher stops the bridge first, which lets the arm down.
"""

import argparse
import contextlib
import json
import select
import signal
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import IO, Any

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.lab.calibration.tour import BRIDGE, of_arm
from exo_gravity.lab.calibration.tracking import Observation
from exo_gravity.lab.inputs.arms import ConfiguredArm
from exo_gravity.lab.inputs.node_checks import check_start
from exo_gravity.lab.inputs.parameter_file import load, text_of
from exo_gravity.lab.processes import Launcher, asking_on_terminal, stop_on_signals

KEPT = ("can_bridge", "simulator")  # the arm's nodes that run during a calibration, with the shared /imu
REFRESH_PERIOD = 0.1  # s, of what the person is shown
STOPPED = "stopped by Ctrl-C"

Say = Callable[[Any], None]


class Person:
    """The person at the terminal: talks through `console` and reads `keys`, by default the terminal."""

    def __init__(self, console: Console | None = None, keys: IO[str] | None = None) -> None:
        self._console = console or Console(highlight=False)
        self._keys = keys or sys.stdin

    def say(self, what: RenderableType) -> None:
        """Print a line or a table."""
        self._console.print(what, markup=False, soft_wrap=isinstance(what, str))

    def wait(self, request: str, watch: Callable[[], RenderableType] = str) -> None:
        """Print `request`, and show what `watch()` returns until Enter is pressed.

        Raises DataError if standard input has ended.
        """
        self._console.print(Text(f"{request}; then press Enter", style="bold"))
        with Live(console=self._console, auto_refresh=False, transient=True) as live:
            while not select.select([self._keys], [], [], REFRESH_PERIOD)[0]:
                live.update(Group(watch()), refresh=self._console.is_terminal)
        if not self._keys.readline():
            raise DataError("standard input has ended: a person must press Enter")


@dataclass
class LiveTour:
    """What a tour measured so far."""

    measured: list[Observation] = field(default_factory=list)
    trouble: str = ""  #: why it ended early, or ''
    done: bool = False  #: whether it is complete

    def follow(self, line: str, record: Path, say: Say) -> None:
        """Take one line of `calibrator`; ignore half a line, which a killed node leaves."""
        with contextlib.suppress(json.JSONDecodeError):
            event = json.loads(line)
            if "observation" in event:
                with record.open("a", encoding="utf-8") as file:
                    file.write(line + "\n")
                self.measured.append(Observation(**event["observation"]))
            elif event.get("progress"):
                say(event["progress"])
            elif not self.done:
                self.trouble = self.trouble or event.get("trouble", "")
                self.done = event.get("done", False)

    def complete(self, record: Path) -> list[Observation]:
        """Return what was measured. Raises DataError if the tour ended early, with the reason."""
        if self.trouble:
            raise DataError(self.trouble + (f"; what was measured is kept in {record}" if self.measured else ""))
        return self.measured


def tour_parameters(params: Path, arm: ConfiguredArm, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the nodes of a file in which `calibrator` replaces the compensator of `arm`, each with its parameters.

    changes: parameters of `calibrator` that differ from the arm's. Raises ParameterError.
    """
    bridge, compensator = arm.can_bridge, arm.compensator
    if list(compensator["joint_names"]) != list(bridge["joint_names"]):
        raise ParameterError("joint_names", compensator["joint_names"], f"{bridge['joint_names']}")
    kept = ("/imu", *(f"{arm.namespace}/{name}" for name in KEPT))
    nodes = {node: values for node, values in load(params).items() if node in kept}
    simulator = nodes.get(f"{arm.namespace}/simulator")
    if simulator and (mass := changes.get("tour.load_mass")):
        # The simulated device cannot be reached by hand: it carries the weight as a wearer's forearm would.
        none = [0.0] * (len(arm.joint_names) - 1)
        simulator["wearer.mass"] = [*none, mass]
        simulator["wearer.cog"] = [*none, changes["tour.load_lever"]]
    values = {name: value for name, value in compensator.items() if of_arm(name)}
    values |= {name: bridge[name] for name in BRIDGE}
    strongest, own = np.array(bridge["max_effort"]), np.array(compensator["max_effort"])
    values["max_effort"] = np.where(own > 0.0, np.minimum(own, strongest), strongest).tolist()
    return {**nodes, f"{arm.namespace}/calibrator": values | dict(changes)}


def run_tour(options: argparse.Namespace, nodes: Mapping[str, Any], say: Say) -> LiveTour:
    """Run `nodes`, each with its parameters, until the tour is done or has failed; the arm is then down.

    options: output (the log goes into the same folder) and record. Raises ParameterError for a wrong file, and
    BusError while another can_bridge holds the bus.
    """
    tour, last_errors = LiveTour(), dict[str, str]()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    ending = stop_on_signals()

    def on_line(node: str, line: str) -> None:
        if node.endswith("/calibrator") and line.startswith("{"):
            tour.follow(line, options.record, say)
            if tour.done or tour.trouble:
                ending.set()
            return
        log.write(f"{datetime.now():%H:%M:%S.%f} {node.lstrip('/')} {line}\n")
        if line.startswith(("FATAL ", "ERROR ")):
            last_errors[node] = line.partition(" ")[2]

    with contextlib.ExitStack() as stack:
        for number, handler in handlers.items():
            stack.callback(signal.signal, number, handler)
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        log = stack.enter_context(options.output.with_suffix(".log").open("a", 1))
        path = Path(folder, "params.yaml")
        path.write_text(text_of(nodes), encoding="utf-8")
        launcher = Launcher(path, on_line, check=check_start)
        with asking_on_terminal(launcher.asking, say):
            dead = launcher.run(ending)
    if dead:
        node, code = dead
        tour.trouble = f"{node.lstrip('/')} ended with exit code {code}: {last_errors.get(node, 'see the log')}"
    elif not tour.done:
        tour.trouble = tour.trouble or STOPPED
    if launcher.maybe_powered:
        powered = f"the motors of {', '.join(launcher.maybe_powered)} may still be powered: cut their supply"
        tour.trouble = f"{tour.trouble}; {powered}" if tour.trouble else powered
    return tour
