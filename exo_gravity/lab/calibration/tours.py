# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrate gravity, scale, friction, check and wearer: what slow tours of the arm show, live or from a recording.

docs/calibration.md describes each. Live, the arm's nodes run with `calibrator` for the compensator; every observation
is written to the record as it comes, so that Ctrl-C and faults lose nothing. On Ctrl-C, after the last pose and after
any trouble the launcher stops the bridge first, which lets the arm down. `scale` makes two tours, without the weight
and with it. A recording (`--bag`) is one with the weight, of an arm that `calibrate gravity` has calibrated: what it
holds without is known.

A relaxed wearer's arm is what it adds to a calibrated robot. The fit is that of the robot (`identification.solve`),
with other things known before: the robot's moments and torque scales are exact, the moments of the wearer's arm those
of the body-mass table, widely. Relaxed joints have springs, which stay where the poses ask for them. What neither
explains, such as a shoulder that rises with the arm, widens the error of the torque. Two more moments, which grow with
elevation, were tried: ten poses do not tell them from springs.

What varies of the wearer's own activity shows when a pose is visited again. What does not vary is not visible: a person
who carries a constant share of their arm looks like one with a lighter arm.
"""

import argparse
import contextlib
import itertools
import json
import math
import select
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import IO, Any

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from exo_gravity.core.arm.springs import MAX_REST, Springs, link_angles
from exo_gravity.core.arm.wearer import MAX_TISSUE, TISSUE_REACH
from exo_gravity.core.compensation.laws import LAWS
from exo_gravity.core.compensation.settings import ModelError, joint_spring_of, wearer_of
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.motors.joint_motor import TORQUE_SCALE_BOUNDS, scale_at
from exo_gravity.core.numbers import COVER, for_joints, one_float
from exo_gravity.hardware.urdf_arm import TURN_NAMES
from exo_gravity.lab.calibration import moment_model
from exo_gravity.lab.calibration.identification import (
    AS_USUAL,
    EXACT,
    Identified,
    Places,
    Unknowns,
    columns,
    fit_friction,
    identify,
    known_of,
    rows_at,
    solve,
    temperatures,
    torque_error,
)
from exo_gravity.lab.calibration.moment_model import MOMENT_PARAMETERS, MomentModel
from exo_gravity.lab.calibration.recorded import observations_of
from exo_gravity.lab.calibration.result import CalibrationResult, Change
from exo_gravity.lab.calibration.tour import BRIDGE, observations_in, of_arm
from exo_gravity.lab.calibration.tracking import Observation
from exo_gravity.lab.inputs.arms import ConfiguredArm
from exo_gravity.lab.inputs.node_checks import check_start
from exo_gravity.lab.inputs.parameter_file import load, text_of
from exo_gravity.lab.processes import Launcher, asking_on_terminal, stop_on_signals

REFRESH_PERIOD = 0.1  # s, of what the person is shown

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
        """Take one line of `calibrator`; ignore half a line, which a killed node leaves.

        A pose that cannot be recorded counts all the same, and is said.
        """
        with contextlib.suppress(json.JSONDecodeError):
            event = json.loads(line)
            if "observation" in event:
                self.measured.append(Observation(**event["observation"]))
                try:
                    with record.open("a", encoding="utf-8") as file:
                        file.write(line + "\n")
                except OSError as error:
                    say(f"pose {len(self.measured)} is used, but is missing in {record}: {error.strerror}")
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
    kept = ("/imu", *(f"{arm.namespace}/{name}" for name in ("can_bridge", "simulator")))
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
        tour.trouble = tour.trouble or "stopped by Ctrl-C"
    if launcher.maybe_powered:
        powered = f"the motors of {', '.join(launcher.maybe_powered)} may still be powered: cut their supply"
        tour.trouble = f"{tour.trouble}; {powered}" if tour.trouble else powered
    return tour


SCALE_POSES = 8  # of each tour of `calibrate scale`
LEAN = (
    "Lean the stand about 5 degrees forward if it leant back before, or else back, and as far to the side as before: "
    "this shows the IMU's heading"
)
MOST_OFF = 5.0  # deg, standard error of a zero or an axis that can be assumed
LEAST_MOMENT = 0.03  # kg m: a lighter weight is lost in the torque's resolution


@dataclass(frozen=True)
class CheckTour:
    """The tour that checks a calibration."""

    poses: int = 3  #: the hanging arm and two others
    widest: float = 10.0  #: %, of the band of a joint that is judged
    least: float = 2.0  #: % of a difference that is refused: magnets that are 20 K warmer, at 0.1 % per K


CHECK = CheckTour()


def calibrate_gravity(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Measure the poses, or take them from `options.bag`, and solve for the moments. Raises ParameterError."""
    earlier = observations_in(options.earlier, len(arm.joint_names)) if options.earlier else []
    places = places_of(options)
    changes = {"tour.poses": options.poses, **_knowing(options.earlier)}
    return moments_from(arm, earlier + tour_observations(options, arm, say, changes), places)


def _knowing(record: Path | None) -> dict[str, Any]:
    """Return the parameters of a tour of an arm that an earlier one has shown."""
    return {"tour.earlier": str(record.absolute())} if record else {}


def places_of(options: argparse.Namespace) -> Places:
    """Return how exactly zeros and axes are known, as usual where no option says it. Raises ParameterError."""
    known = zip(("zeros", "axes"), (options.zeros, options.axes), AS_USUAL, strict=True)
    return Places(*(
        usual if given is None else math.radians(one_float(name, given, 0.0, MOST_OFF, "degrees"))
        for name, given, usual in known
    ))  # fmt: skip


def tour_observations(
    options: argparse.Namespace, arm: ConfiguredArm, say: Say, changes: Mapping[str, Any], request: str = ""
) -> list[Observation]:
    """Return what a tour measures, or what `options.bag` shows.

    changes: as for `tour_parameters`.
    request: what a person does first; they cannot reach a simulated device.
    """
    if options.bag:
        return observations_of(options.bag, arm, model_of(arm))
    nodes = tour_parameters(options.params, arm, changes)
    if request and f"{arm.namespace}/simulator" not in nodes:
        options.wait(request)
    return run_tour(options, nodes, say).complete(options.record)


def calibrate_scale(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Measure the poses without and with the weight, and solve for scales and moments. Raises ParameterError."""
    mass, lever, model = options.mass, options.lever, model_of(arm)
    model.load(mass, lever)
    if mass * lever < LEAST_MOMENT:
        raise ParameterError("mass times lever", mass * lever, f"at least {LEAST_MOMENT:g} kg m")
    places = places_of(options)
    earlier = observations_in(options.earlier, len(arm.joint_names)) if options.earlier else []
    poses = {"tour.poses": SCALE_POSES}
    bare = tour_observations(options, arm, say, {**poses, **_knowing(options.earlier)})
    if options.bag:
        weighed = [one._replace(load_mass=mass, load_lever=lever) for one in bare]
        needed = _needed(arm, model, bare)
        bare = [one._replace(effort=effort) for one, effort in zip(bare, needed, strict=True)]
    else:
        where = f"on the last link, {lever:g} m from {arm.joint_names[-1]}, on the way to the hand"
        hang = f"Hang {mass:g} kg {where}" + (f". {LEAN}" if arm.compensator["use_imu"] else "")
        changes = {**poses, "tour.load_mass": mass, "tour.load_lever": lever, **_knowing(options.record)}
        weighed = tour_observations(options, arm, say, changes, hang)
    return moments_from(arm, earlier + bare + weighed, places)


def model_of(arm: ConfiguredArm) -> MomentModel:
    """Return the moments of an arm as configured. Raises ParameterError."""
    return moment_model.model_of({**arm.compensator, "motor": arm.can_bridge["motor"]})


def _needed(arm: ConfiguredArm, model: MomentModel, poses: Sequence[Observation]) -> np.ndarray:
    """Return the torque (m, n) in Nm that the file's arm needs in the poses."""
    theta, direction, _, _ = columns(poses)
    gravity = model.rows(theta, direction) @ model.moments * np.array(arm.compensator["gain"])
    return np.asarray(gravity + joint_spring_of(arm.compensator).torques(theta))


def moments_from(
    arm: ConfiguredArm, observations: Sequence[Observation], places: Places = AS_USUAL
) -> CalibrationResult:
    """Return moments and torque scales of `arm` as `observations` show them. Raises DataError as `identify` does.

    places: how exactly its zeros and axes are known.
    """
    model, (low, high), observations = model_of(arm), TORQUE_SCALE_BOUNDS, at_links(arm, observations)
    found = identify(observations, model, places)
    scale = np.round(found.value.scale * _scale_before(arm, found), 4).tolist()
    impossible = tuple(
        f"{name}: torque_scale = {value:g}: must be from {low:g} to {high:g}: check torque_range of its firmware"
        for name, value in zip(arm.joint_names, scale, strict=True)
        if not low <= value <= high
    )
    changes, lines = tuple(_changes(arm, model, found, scale)), tuple(_lines(arm, found))
    return CalibrationResult(changes, lines, impossible, arm, model, tuple(observations), found)


def at_links(arm: ConfiguredArm, observations: Sequence[Observation]) -> Sequence[Observation]:
    """Return `observations` with the angles of the links, where the file gives a `joint_stiffness`."""
    stiffness = arm.compensator["joint_stiffness"]
    if not any(stiffness):
        return observations
    return [one._replace(theta=link_angles(tuple(one.theta), tuple(one.effort), stiffness)) for one in observations]


def _scale_before(arm: ConfiguredArm, found: Identified) -> np.ndarray:
    """Return the file's torque scales (n,) at the temperatures of the poses."""
    bridge = arm.can_bridge
    columns = (bridge[name] for name in ("torque_scale", "torque_scale_slope", "torque_scale_temperature"))
    motors = zip(*columns, found.temperature.tolist(), strict=True)
    return np.array([scale_at(*motor) if math.isfinite(motor[-1]) else motor[0] for motor in motors])


def _changes(arm: ConfiguredArm, model: MomentModel, found: Identified, scale: list[float]) -> Iterator[Change]:
    """Yield the new values of the parameter file; scale: (n,), the torque scales."""
    compensator, bridge = f"{arm.namespace}/compensator", f"{arm.namespace}/can_bridge"
    value, error, old = found.value, found.error, arm.can_bridge
    unit = "as commanded; in kg m once a weight was hung" if found.relative else "kg m"
    known = np.max(error.moment, where=np.isfinite(error.moment), initial=0.0)
    for name, values in model.in_file(value.moment, value.turn).items():
        if part := MOMENT_PARAMETERS.get(name):
            note = f"{' '.join(model.names[part])} {unit}, +-{row(error.moment[part])}, was {row(model.moments[part])}"
        else:
            kind = "rad" if name in TURN_NAMES else f"{unit}, +-{known:.2g} at most"
            note = f"{kind}, was {row(np.array(arm.compensator[name]))}"
        yield Change(compensator, name, (values.round(5) + 0.0).tolist(), note)
    yield Change(bridge, "torque_scale", scale, f"+-{row(error.scale)}")
    zero, degrees = value.turn[:, 0], np.degrees((value.turn[:, 0], error.turn[:, 0]))
    # A zero that no pose shows keeps the value of the file, and its error means nothing.
    shown = row(np.where(degrees[1] > 1e-3, degrees[1], np.nan))
    note = f"rad; the joints are {row(degrees[0])} degrees farther than the file said, +-{shown} degrees"
    zeros = np.array(old["zero"]) - np.array(old["direction"]) * zero
    yield Change(bridge, "zero", (zeros.round(5) + 0.0).tolist(), note)
    if np.all(np.isfinite(found.temperature)):
        yield Change(bridge, "torque_scale_temperature", found.temperature.round(1).tolist(), "degC, mean of the tours")
        given = np.array(old["torque_scale_slope"])
        if np.any(given) or np.any(value.slope):
            slope = given * old["torque_scale"] / _scale_before(arm, found) + value.slope
            note = f"1/K, +-{row(error.slope)}; 0: the poses show none, the file's is kept"
            yield Change(bridge, "torque_scale_slope", slope.round(5).tolist(), note)
    yield from _spring_changes(arm, found)
    note = "Nm, in poses that no tour visited"
    yield Change(compensator, "model_error.torque", found.torque_error.round(4).tolist(), note)
    if not found.relative:
        is_known = np.isfinite(error.scale)
        share = np.where(is_known, error.scale / value.scale, for_joints(ModelError().scale, len(scale), max))
        yield Change(compensator, "model_error.scale", share.round(4).tolist(), "share of torque_scale")
    yield from exact_law(arm)
    if any(gain != 1.0 for gain in arm.compensator["gain"]):
        yield Change(compensator, "gain", [1.0] * len(scale), "now part of the moments and of torque_scale")


def exact_law(arm: ConfiguredArm) -> Iterator[Change]:
    """Yield the change to the exact law where the file has one that moments alone do not serve."""
    if arm.compensator["law"] not in LAWS.by_moments:
        node = f"{arm.namespace}/compensator"
        yield Change(node, "law", "exact", "the other laws need masses and centres of gravity")


def _spring_changes(arm: ConfiguredArm, found: Identified) -> Iterator[Change]:
    """Yield the device's own springs, and the torque that they may add beyond gravity, where the file states one."""
    node, before, value = f"{arm.namespace}/compensator", joint_spring_of(arm.compensator), found.value
    stiffness = value.spring.round(4)
    if not (np.any(stiffness) or before.on):
        return
    slack = value.turn[:, 0] - value.offset * value.scale / np.maximum(value.spring, EXACT)
    rest = np.where(stiffness > 0.0, np.clip(slack, -MAX_REST, MAX_REST), 0.0)
    new = Springs(stiffness.tolist(), rest.round(4).tolist())
    note = f"Nm/rad, +-{row(found.error.spring)}"
    yield Change(node, "joint_spring.stiffness", list(new.stiffness), note)
    yield Change(node, "joint_spring.rest", list(new.rest), "rad, with the offset of the motor")
    bridge = arm.can_bridge
    if any(bridge["largest_moment"]):
        low, high = arm.low.tolist(), arm.high.tolist()
        own = np.subtract(bridge["largest_addition"], before.largest(low, high))
        addition = np.ceil(100.0 * (np.maximum(own, 0.0) + new.largest(low, high)) - 1e-6) / 100.0
        note = "Nm, with the largest torque of the joints' own springs"
        yield Change(f"{arm.namespace}/can_bridge", "largest_addition", addition.tolist(), note)


def _lines(arm: ConfiguredArm, found: Identified) -> Iterator[str]:
    """Yield what the parameter file does not hold, in sentences."""
    for name, slide, offset in zip(arm.joint_names, found.friction, found.value.offset, strict=True):
        yield f"{name}: friction {slide:.2f} Nm, offset {offset:+.3f} Nm"
    pose, joint = np.unravel_index(np.argmax(np.abs(found.held_out)), found.held_out.shape)
    worst = f"{found.held_out[pose, joint]:+.3f} Nm at {arm.joint_names[joint]} in pose {pose + 1}"
    yield f"largest difference to what the other poses predict: {worst}: if it is large, was the arm touched?"
    yield from (f"Not shown by these poses: {what}" for what in found.unknown)


def row(values: np.ndarray) -> str:
    """Return numbers with three digits, none below 1e-9, and 'unknown' for those that are not finite."""
    return " ".join(f"{round(value, 9):.3g}" if np.isfinite(value) else "unknown" for value in values.tolist())


def calibrate_check(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Compare the torque that a few poses need with the file's. Raises ParameterError."""
    return checked(arm, tour_observations(options, arm, say, {"tour.poses": CHECK.poses}))


def checked(arm: ConfiguredArm, observations: Sequence[Observation]) -> CalibrationResult:
    """Return in sentences how much torque each joint gives for a command, by that when it was calibrated.

    A joint that differs by more than `CHECK.least`, and than the band of this tour and `model_error.torque`, is a
    refusal.
    """
    observations = at_links(arm, observations)
    held, (*_, effort, spread) = _needed(arm, model_of(arm), observations), columns(observations)
    size = np.sqrt(np.mean(held**2, axis=0))
    noise = np.sqrt(np.sum((held * spread) ** 2, axis=0)) / np.maximum(len(held) * size, 1e-9)  # Nm, of this tour
    stated = arm.compensator.get("model_error.torque", ModelError().torque)
    error = np.hypot(for_joints(stated, len(arm.joint_names), max), noise)
    share = np.sum(held * effort, axis=0) / np.maximum(np.sum(held**2, axis=0), 1e-12)  # of the command that was enough
    band = 100.0 * COVER * error / np.maximum(size, 1e-9)
    now, then = temperatures(observations).mean(axis=0), arm.can_bridge["torque_scale_temperature"]
    lines, refusals = list[str](), list[str]()
    for n, name in enumerate(arm.joint_names):
        if band[n] > CHECK.widest:
            lines.append(f"{name}: these poses show too little of its torque: {held[:, n].round(2).tolist()} Nm")
            continue
        less = 100.0 * (1.0 - 1.0 / share[n])
        warmth = f", its motor has {now[n]:.0f} degC" if math.isfinite(now[n]) else ""
        what = f"{abs(less):.1f} +- {band[n]:.1f} % {'less' if less > 0.0 else 'more'} torque"
        sentence = f"{name}: {what} than when it was calibrated, at {then[n]:g} degC{warmth}"
        (refusals if abs(less) > max(band[n], CHECK.least) else lines).append(sentence)
    return CalibrationResult((), tuple(lines), tuple(refusals), arm, observations=tuple(observations))


def calibrate_friction(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Sweep all joints of the hanging arm, and fit the friction of each. Raises ParameterError."""
    return friction_from(arm, tour_observations(options, arm, say, {"tour.friction": True}))


def friction_from(arm: ConfiguredArm, observations: Sequence[Observation]) -> CalibrationResult:
    """Return the friction of each joint that `observations` show. Raises DataError as `fit_friction` does."""
    speed = np.array([np.broadcast_to(one.speed, len(one.theta)) for one in observations])
    effort, friction, spread = (np.array([one[field] for one in observations]).T for field in (2, 3, 4))
    curves = tuple(map(fit_friction, speed.T, friction, spread, effort))
    changes, refusals = [], []
    for name, fit in zip(arm.joint_names, curves, strict=True):
        coulomb, viscous, stribeck, load = fit.error
        text = f"Coulomb {fit.coulomb:.3f} +- {coulomb:.3f} Nm, viscous {fit.viscous:.3f} +- {viscous:.3f} Nm s/rad"
        more = f"Stribeck {fit.stribeck:.3f} +- {stribeck:.3f} Nm at rest"
        more = more if fit.stribeck else "no Stribeck friction"
        share = f"{fit.load:.3f} +- {load:.3f} of what it carries" if fit.load else "none that grows with the torque"
        note = f"friction of {name}: {text}, {more}, {share}"
        changes.append(Change(f"{arm.namespace}/can_bridge", "", 0, note))
        if fit.coulomb <= 0.0:
            refusals.append(f"{name}: friction of {fit.coulomb:.3f} Nm: must be above 0: was the arm touched?")
    return CalibrationResult(tuple(changes), (), tuple(refusals), arm, observations=tuple(observations), curves=curves)


MOST_CARRIED = 0.5  # share of their arm that a person can hold who means to relax


@dataclass(frozen=True)
class WearerTour:
    """The tour of a worn arm, and what is known of a person's relaxed arm."""

    poses: int = 8  #: the hanging arm and seven others
    again: int = 2  #: of them, visited again at the end
    least_poses: int = 5  #: different ones: fewer do not tell springs from weight
    least_of_one: int = 4  #: of a single joint, which has two moments, and a spring with two numbers
    #: share of their arm's weight that a relaxed person may hold throughout, unseen: it looks like a lighter arm
    carried: float = 0.2
    unrest: float = 0.5  #: Nm by which what holds the arm may differ between two visits of a pose: breathing, 3.5 times
    samples: int = 200  #: poses of the comfortable range in which the error of the torque is taken
    same_pose: float = 0.05  #: rad, within which two poses are visits of one
    # Before a pose is measured, as standard errors; and what is plausible.
    share: float = 0.5  #: of a moment by the table: masses and places of segments
    moment: float = 0.03  #: kg m, in addition: 1.5 kg whose centre lies 2 cm off the link's axis
    stiffness: float = 1.5  #: Nm/rad, of a relaxed shoulder or elbow
    middle: float = 1.0  #: Nm, of its torque in the middle of the poses
    asked: float = 2.2  #: standard errors beyond which a spring is one; its square is ln of 120 efforts
    breathing: float = 0.1  #: Nm: standard deviation by which a relaxed, breathing person differs from pose to pose
    body_mass: float = 70.0  #: kg, where the file has none
    judged: float = 0.2  #: of the largest torque by the table, from which a joint's is compared with it
    largest_error: float = 0.25  #: of that torque
    table_ratio: tuple[float, float] = (0.6, 1.6)  #: measured to tabled torque that is plausible
    of_range: float = 0.6  #: of the way from `home` to a limit of a joint of which no comfortable range is known
    reach: tuple[float, float] = (0.2, 1.2)  #: rad, least and most of that way


WEARER = WearerTour()


class WornArm:
    """A wearer on those links of an arm on which the file or the table places mass, before a pose is measured.

    Raises ParameterError if the file of an arm from a URDF says nothing of the wearer: the mass also gives the inertia.

    model: of the robot, of n joints and k moments.
    expected: (k,) kg m, what the wearer adds to these by file or table; whose: of which wearer, in words.
    is_known: whether the file says who it is.
    known: what is known before of the unknowns of a fit, of robot and wearer.
    comfortable: (2, n) rad, lowest and highest angles.
    changes: parameters of `calibrator`, so that its tour expects this wearer.
    """

    def __init__(self, arm: ConfiguredArm) -> None:
        values, self.model = arm.compensator, model_of(arm)
        model, robot = self.model, self.model.arm
        given = (*values["wearer.mass"], values["wearer.body_mass"], *values.get("wearer.first_moment", ()))
        self.is_known = any(given)
        if not self.is_known and model.is_described:
            expected = "the wearer's, in kg, or wearer.mass and wearer.cog: they also give the inertia"
            raise ParameterError(f"{arm.namespace}/compensator wearer.body_mass", values["wearer.body_mass"], expected)
        self.whose = "the file's wearer" if self.is_known else f"a wearer of {WEARER.body_mass:g} kg"
        assumed = {} if self.is_known else {"wearer.body_mass": WEARER.body_mass}
        mass, cog = (np.array(part) for part in wearer_of({**values, **assumed}, robot.length))
        self.changes = {"tour.wearer_mass": mass.tolist(), "tour.wearer_cog": cog.tolist()}
        self.expected = model.moments_of(robot.with_wearer(mass, cog)) - model.moments
        self.known = known_of(model, None, False)
        error, count = Unknowns.of(self.known.error, model), len(self.expected)
        self.known.start[:count] += self.expected
        self.known.least[:count], self.known.error[:] = -np.inf, EXACT
        error.spring[:], error.offset[:] = WEARER.stiffness, WEARER.middle
        error.moment[:] = WEARER.share * np.abs(self.expected) + WEARER.moment
        home, low, high = np.array(arm.limits.home), arm.low, arm.high
        down, up = (np.clip(WEARER.of_range * way, *WEARER.reach) for way in (home - low, high - home))
        self.comfortable = np.array(model.comfortable or (np.maximum(low, home - down), np.minimum(high, home + up)))


def calibrate_wearer(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Measure the wearer's relaxed arm, or take it from `options.bag`. Raises ParameterError."""
    carried = WEARER.carried if options.carried is None else one_float("carried", options.carried, 0.0, MOST_CARRIED)
    worn = WornArm(arm)
    # Few poses, in a comfortable range, with the weight that the table expects.
    low, high = np.maximum(arm.low, worn.comfortable[0]), np.minimum(arm.high, worn.comfortable[1])
    changes = {"tour.poses": WEARER.poses, "tour.again": WEARER.again, **worn.changes}
    changes |= {"position_min": low.tolist(), "position_max": high.tolist()}
    request = "Wear the arm, sit upright and relax: it will be moved slowly. Pull to stop it"
    return wearer_from(arm, tour_observations(options, arm, say, changes, request), carried)


def wearer_from(
    arm: ConfiguredArm, observations: Sequence[Observation], carried: float = WEARER.carried
) -> CalibrationResult:
    """Return moments and springs of the wearer's arm: what the robot alone does not explain.

    carried: share 0..MOST_CARRIED of their arm's weight that they may hold throughout. Raises DataError if the poses do
    not show an arm.
    """
    worn, observations = WornArm(arm), at_links(arm, observations)
    model, count = worn.model, len(arm.joint_names)
    theta, direction, effort, spread = columns(observations)
    of_two = itertools.combinations(range(len(theta)), 2)
    visits = [pair for pair in of_two if np.ptp(theta[list(pair)], axis=0).max() < WEARER.same_pose]
    again = len({other for _, other in visits})
    least = min(WEARER.least_poses, WEARER.least_of_one + count - 1)
    if len(observations) - again < least:
        raise DataError(f"{len(observations) - again} different poses were measured, must be at least {least}")
    middle, spread = (theta.min(axis=0) + theta.max(axis=0)) / 2.0, np.hypot(spread, WEARER.breathing)
    rows = rows_at(model, theta, direction)._replace(theta=theta - middle)
    own = joint_spring_of(arm.compensator)
    seen, before = effort - own.torques(theta), Unknowns.of(worn.known.error, model)
    first = solve(rows, worn.known, seen, spread)
    absent = Unknowns.of(first.unknowns / first.error, model).spring < WEARER.asked
    before.spring[absent] = before.offset[absent] = EXACT
    solution = solve(rows, worn.known, seen, spread)
    changes_between = [np.ptp(solution.residual[list(pair)], axis=0) for pair in visits]
    change = np.max([np.zeros(count), *changes_between], axis=0)
    restless = [
        f"{name}: {off:.2f} Nm between two visits of a pose: must be at most {WEARER.unrest:g}: did the wearer relax?"
        for name, off in zip(arm.joint_names, change, strict=True)
        if off > WEARER.unrest
    ]
    if restless:
        raise DataError("; ".join(restless))
    low, high = worn.comfortable
    poses = np.random.default_rng(0).uniform(low, high, (WEARER.samples, count))
    new = rows_at(model, poses, np.tile(direction[0], (len(poses), 1)))._replace(theta=poses - middle)
    misfit = np.sqrt(np.maximum(solution.sigma**2 - spread**2, 0.0).mean(axis=0))
    unsure = torque_error(new, solution, misfit)
    value, error = (Unknowns.of(part, model) for part in (solution.unknowns, solution.error))
    moments, stiffness = value.moment - model.moments, value.spring
    rest = middle - np.where(stiffness > 0.0, value.offset / np.maximum(stiffness, EXACT), 0.0)
    compared, refusals = _compared(arm, worn, moments, model.rows(theta, direction), unsure)
    refusals += [
        f"{name}: a spring of {one:.1f} Nm/rad: must be at most {MAX_TISSUE:g}: was the arm touched?"
        for name, one in zip(arm.joint_names, stiffness, strict=True)
        if one > MAX_TISSUE
    ]
    skeleton, nothing = model.holding(model.moments + moments).skeleton(), np.zeros(count)
    largest, beside = (skeleton.moments, model.gravity * skeleton.beside) if skeleton else (nothing, nothing)
    way = np.minimum(np.maximum(np.abs(arm.low - rest), np.abs(arm.high - rest)), TISSUE_REACH)
    added = beside + own.largest(arm.low.tolist(), arm.high.tolist()) + stiffness * way
    lines = (
        f"largest remainder of a pose: {np.abs(solution.residual).max():.2f} Nm", compared,
        f"{again} poses were visited again, and differed by {change.max():.2f} Nm at most",
        f"a wearer who holds up to {carried:.0%} of their arm throughout looks like one with a lighter arm: "
        "the band contains that, and nothing shows it",
        f"can_bridge, for this wearer at support 1: largest_moment [{_rounded_up(largest, 2)}] kg m, "
        f"largest_addition {_rounded_up(added, 1)} Nm or more",
    )  # fmt: skip
    node, noted = f"{arm.namespace}/compensator", f"kg m, +-{row(error.moment)}"
    # Any share up to `carried` is as likely to be held unseen. Two of these errors cover 95 % of them.
    unseen = 0.95 * carried / (1.0 - 0.95 * carried) / COVER
    changes = [
        *(
            Change(node, name, (part.round(5) + 0.0).tolist(), noted)
            for name, part in model.worn_in_file(moments).items()
        ),
        *exact_law(arm),
        Change(node, "wearer.joint_stiffness", stiffness.round(3).tolist(), f"Nm/rad, +-{row(error.spring)}"),
        Change(node, "wearer.joint_rest", rest.round(3).tolist(), "rad"),
        Change(node, "model_error.wearer_torque", unsure.round(3).tolist(), "Nm, of the wearer's passive arm"),
        Change(node, "model_error.wearer", round(unseen, 3), "share that the wearer may have held"),
    ]
    if "model_error.torque" not in arm.compensator:
        assumed = list(for_joints(ModelError().torque, count, max))
        note = "Nm of the robot, assumed: `calibrate gravity` measures it"
        changes.append(Change(node, "model_error.torque", assumed, note))
    return CalibrationResult(tuple(changes), lines, tuple(refusals), arm, observations=tuple(observations))


def _compared(
    arm: ConfiguredArm, worn: WornArm, moments: np.ndarray, rows: np.ndarray, unsure: np.ndarray
) -> tuple[str, list[str]]:
    """Return how the torque of the wearer's arm compares with the table's, and what of it no person's arm has.

    moments: (k,) kg m of the wearer. rows: (m, n, k), of the poses. unsure: (n,) Nm. Raises DataError if it is no arm.
    """
    torque, table = rows @ moments, rows @ worn.expected
    size, (low, high) = np.sqrt(np.mean(table**2, axis=0)), WEARER.table_ratio
    said, refusals = [], []
    for n in np.flatnonzero(size > WEARER.judged * size.max()):
        share = float((torque[:, n] * table[:, n]).sum() / (table[:, n] ** 2).sum())
        needs = f"{share * size[n]:.2f} +- {unsure[n]:.2f} Nm at {arm.joint_names[n]}"
        if not share * size[n] > unsure[n] / WEARER.largest_error:
            raise DataError(f"the wearer's arm needs {needs}: is the arm relaxed, the robot calibrated?")
        said.append(f"{share:.0%} of the torque at {arm.joint_names[n]}")
        if worn.is_known and not low <= share <= high:
            refusals.append(f"implausible: {said[-1]} that {worn.whose} needs: must be from {low:.0%} to {high:.0%}")
    return f"{', '.join(said)} that {worn.whose} needs", refusals


def _rounded_up(values: np.ndarray, digits: int) -> str:
    """Return numbers with so many digits after the point, none less than it is."""
    return ", ".join(f"{math.ceil(10.0**digits * value) / 10.0**digits:g}" for value in values)
