"""A calibration on the device: starts the arm's nodes with `calibrator` in the compensator's place, and follows it.

Every observation is written to the record as it comes, so that Ctrl-C and faults lose nothing. On Ctrl-C, after the
last pose and after any trouble the launcher stops the bridge first, which lets the arm down.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from exo_gravity.core.calibration.identification import Observation
from exo_gravity.core.calibration.tour import Measured
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.params import LIMIT_PARAMETERS
from exo_gravity.tools.inputs.arms import ConfiguredArm
from exo_gravity.tools.launcher import Launcher, Stopping, stop_on_signals

KEPT = ("can_bridge", "simulator")  # the arm's nodes that run during a calibration, with the shared /imu
POLL_PERIOD = 0.05  # s
STOPPED = "stopped by Ctrl-C"
ATTEMPTS = 3  # of a tour on the simulated device
# Parts of the lines of nodes on a busy computer: the simulated device itself is never late.
LATE = ("command_stale", "motor_silent", "no joint states for", "trunk tilt older", "was frozen for", "stalled for")

Say = Callable[[str], None]


@dataclass
class LiveTour:
    """What a tour measured so far. trouble: why it ended early, or ''. done: whether it is complete.

    was_late: whether this computer did not run the nodes in time.
    """

    measured: list[Measured] = field(default_factory=list)
    trouble: str = ""
    done: bool = False
    was_late: bool = False


def tour_parameters(params: Path, arm: ConfiguredArm, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a parameter file in which `calibrator` replaces the compensator of `arm`.

    changes: parameters of `calibrator` that differ from the arm's.
    """
    content = yaml.safe_load(params.read_text(encoding="utf-8"))
    own = [f"{arm.namespace}/{name}" for name in KEPT]
    nodes = {node: entry for node, entry in content.items() if node == "/imu" or node in own}
    limits = {param.name: arm.can_bridge[param.name] for param in LIMIT_PARAMETERS}
    most = [min(pair) for pair in zip(arm.can_bridge["max_effort"], arm.compensator["max_effort"], strict=True)]
    values = {**arm.compensator, **limits, "rate": arm.can_bridge["rate"], "max_effort": most, "law": "exact"}
    if list(arm.compensator["joint_names"]) != list(arm.can_bridge["joint_names"]):
        raise ParameterError("joint_names", arm.compensator["joint_names"], f"{arm.can_bridge['joint_names']}")
    nodes[f"{arm.namespace}/calibrator"] = {"ros__parameters": {**values, "anfis_file": "", **changes}}
    return nodes


def is_simulated(params: Path, arm: ConfiguredArm) -> bool:
    """Return whether the parameter file has a simulator for `arm`."""
    return f"{arm.namespace}/simulator" in yaml.safe_load(params.read_text(encoding="utf-8"))


def run_tour(
    options: argparse.Namespace, nodes: Mapping[str, Any], say: Say, stopping: Stopping | None = None
) -> LiveTour:
    """Run `nodes`, the content of a parameter file, until the tour is done or has failed; the arm is then down.

    options: output (the log is beside it) and record. A tour of the simulated device that this computer was too busy
    for is repeated. Raises ParameterError for a wrong file.
    """
    stopping = stopping or stop_on_signals()
    is_simulated = any(node.endswith("/simulator") for node in nodes)
    for attempt in range(1, ATTEMPTS + 1):
        tour = _run_once(options, nodes, say, stopping)
        if not (is_simulated and tour.trouble and tour.was_late) or stopping.is_set() or attempt == ATTEMPTS:
            break
        say(f"this computer was too busy ({tour.trouble}): attempt {attempt + 1} of {ATTEMPTS}")
    return tour


def _run_once(options: argparse.Namespace, nodes: Mapping[str, Any], say: Say, stopping: Stopping) -> LiveTour:
    tour, last_errors = LiveTour(), dict[str, str]()
    with tempfile.TemporaryDirectory() as folder, options.output.with_suffix(".log").open("a", 1) as log:
        path = Path(folder, "params.yaml")
        path.write_text(yaml.safe_dump(dict(nodes), sort_keys=False), encoding="utf-8")

        def on_line(node: str, line: str) -> None:
            if node.endswith("/calibrator") and line.startswith("{"):
                follow(tour, line, options.record, say)
                return
            log.write(f"{datetime.now():%H:%M:%S.%f} {node.lstrip('/')} {line}\n")
            tour.was_late = tour.was_late or any(sign in line for sign in LATE)
            if line.startswith(("FATAL ", "ERROR ")):
                last_errors[node] = line.partition(" ")[2]

        _run(Launcher(path, on_line), tour, stopping, last_errors)
    return tour


def _run(launcher: Launcher, tour: LiveTour, stopping: Stopping, last_errors: Mapping[str, str]) -> None:
    """Run the nodes until the tour has ended or `stopping` is set."""
    ending = threading.Event()
    dead: list[tuple[str, int] | None] = []
    nodes = threading.Thread(target=lambda: dead.append(launcher.run(ending)))
    nodes.start()
    while nodes.is_alive() and not (tour.done or tour.trouble) and not stopping.wait(POLL_PERIOD):
        pass
    if stopping.is_set() and not tour.done:
        tour.trouble = tour.trouble or STOPPED
    ending.set()
    nodes.join()
    if dead and dead[0]:
        node, code = dead[0]
        tour.trouble = f"{node.lstrip('/')} ended with exit code {code}: {last_errors.get(node, 'see the log')}"
    if launcher.maybe_powered:
        powered = f"the motors of {', '.join(launcher.maybe_powered)} may still be powered: cut their supply"
        tour.trouble = f"{tour.trouble}; {powered}" if tour.trouble else powered


def follow(tour: LiveTour, line: str, record: Path, say: Say) -> None:
    """Take one line of `calibrator`; ignore half a line, which a killed node leaves."""
    with contextlib.suppress(json.JSONDecodeError):
        event = json.loads(line)
        if "observation" in event:
            with record.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
            tour.measured.append(measured_of(event["observation"]))
        elif event.get("progress"):
            say(event["progress"])
        elif event.get("trouble") and not tour.done:
            tour.trouble = tour.trouble or event["trouble"]
            tour.was_late = tour.was_late or any(sign in line for sign in LATE)
        elif event.get("done"):
            tour.done = True


def measured_of(values: Mapping[str, Any]) -> Measured:
    """Return what was measured at a pose from its JSON values."""
    fields = dict(values)
    speed = fields.pop("speed")
    return Measured(Observation(**fields), speed)


def refusals_of(tour: LiveTour, record: Path) -> tuple[str, ...]:
    """Return why the tour did not complete, and where its observations are; () if it did."""
    if not tour.trouble:
        return ()
    kept = f"; {len(tour.measured)} observations are kept in {record}" if tour.measured else ""
    return (f"{tour.trouble}{kept}",)
