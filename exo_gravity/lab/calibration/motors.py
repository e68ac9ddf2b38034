# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrate motors: which motor turns which joint, which way, and at which angle the arm hangs.

docs/calibration.md has the steps. The encoder is on the rotor: after power-up the angle is ambiguous by a turn of the
rotor. Whether `zero` survives is tried by switching the power off and on.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean

import numpy as np
from rich.table import Table

from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.motors.ak import FAMILY, MIT, MIT_V3
from exo_gravity.core.motors.joint_motor import MAX_CAN_ID, OPTIONS, JointMotor, buses_of
from exo_gravity.lab.calibration.bus_scan import SPEC, ArmScan, BusScan, MotorAnswer
from exo_gravity.lab.calibration.live import Say
from exo_gravity.lab.calibration.result import CalibrationResult, Change
from exo_gravity.lab.inputs.arms import ConfiguredArm
from exo_gravity.lab.inputs.parameter_file import can_options, load
from exo_gravity.lab.view import described

Clock = Callable[[], float]
Wait = Callable[[str, Callable[[], Table]], None]
"""(request, watch): shows the request and calls watch() for the table to show, until the person has done it."""

# Of the trunk's axes x, y and z: where a motion along -axis or +axis goes, and from where -axis or +axis points at one.
TOWARDS = (("back", "to the front"), ("to the right", "to the left"), ("down", "up"))
SEEN = (("from behind", "from the front"), ("from the right", "from the left"), ("from below", "from above"))
UNCHECKED = "not checked after a power-up"
SERVO_MODE = (
    "A V1 or V2 board in servo mode sends the same frames as a V3 board, and obeys none of our commands: read the "
    "labels of the boards that are shown as mit_v3. Set V1 and V2 boards to MIT mode with the vendor's tool, and begin "
    "again."
)
STORE_ZERO = "store a zero with the vendor's tool while the arm hangs, switch the power off and on, and begin again"


@dataclass(frozen=True)
class HandMotion:
    """What a person's motion of a joint must be like."""

    least: float = 10.0  #: deg by which the joint must be moved
    other: float = 0.5  #: of that turn, which another motor may turn meanwhile
    back: float = 0.5  #: of that turn, which the same motor may turn the other way
    attempts: int = 3  #: at each joint
    least_swing: float = 0.5  #: sine of the angle between joint and way to the hand, from which it shows a turn
    silence: float = 0.15  #: s without an answer: some replies in a row may be late on a busy computer


@dataclass(frozen=True)
class StillArm:
    """What an arm that hangs is like."""

    samples: int = 40  #: of each angle
    unrest: float = math.radians(0.5)  #: rad between two of these
    same: float = math.radians(5.0)  #: rad within which it hangs again after the power was off


HAND, STILL = HandMotion(), StillArm()


def calibrate_motors(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Calibrate the motors of `arm`. options.wait: a `Wait`; options.pose: (n,) deg, the arm's pose for `zero`.

    Without a pose the arm hangs, at the angles `home`. Raises BusError if the bus cannot be used, ParameterError if the
    pose has another number of angles.
    """
    names, pose = list(arm.joint_names), options.pose or np.degrees(arm.limits.home).tolist()
    if len(pose) != len(names):
        raise ParameterError("pose", list(pose), f"one angle in deg for each of {', '.join(names)}")
    node, interface = f"{arm.namespace}/can_bridge", arm.can_bridge["can.interface"]
    bus_options = can_options(load(options.params)[node])
    buses = buses_of(arm.can_bridge["can.channel"], bus_options, len(arm.motors))
    own = {name: each for name, (_, each) in buses.items()}
    with ArmScan((interface, name, each) for name, each in own.items()) as bus:
        say(f"Asking IDs 1 to {MAX_CAN_ID} on {bus.name}: nothing moves")
        search = MotorSearch(bus, arm, options.wait, say)
        result = search.result(pose)
        channels = [bus.channels[can_id] for can_id in search.found]
    if len(own) == 1:
        return result
    changes = [Change(node, "can.channel", ",".join(channels), "of the bus on which each motor answers")]
    for key in (key for key, value in bus_options.items() if isinstance(value, list)):
        changes.append(Change(node, f"{OPTIONS}.{key}", [own[name][key] for name in channels], "of these buses"))
    return replace(result, changes=(*result.changes, *changes))


def positive_turns(arm: ConfiguredArm) -> Iterator[str]:
    """Yield what turns each joint of an arm at `home` in its positive direction. Raises ParameterError."""
    places, axes, _ = described(arm.compensator, arm.can_bridge).pose(arm.limits.home)
    for axis, way in zip(axes, places[-1] - places[:-1], strict=True):
        swing = np.cross(axis, way)
        is_shown = np.linalg.norm(swing) > HAND.least_swing * np.linalg.norm(way)
        motion = "move the hand", swing, TOWARDS
        what, vector, words = motion if is_shown else ("turn it counter-clockwise, seen", axis, SEEN)
        component = int(np.argmax(np.abs(vector)))
        yield f"{what} {words[component][int(vector[component] > 0.0)]}"


class MotorSearch:
    """Leads the person through the joints of one arm. clock: s.

    found: name of the joint and direction of each motor, by ID, as far as known.
    """

    def __init__(
        self, bus: ArmScan | BusScan, arm: ConfiguredArm, wait: Wait, say: Say, clock: Clock = time.monotonic
    ) -> None:
        self.found: dict[int, tuple[str, int]] = {}
        self._bus, self._arm = bus, arm
        self._wait, self._say, self._clock = wait, say, clock
        self._last: dict[int, MotorAnswer] = {}
        # Since the person was asked: all angles in rad, when each motor answered last in s, and who was ever silent.
        self._angles: dict[int, list[float]] = {}
        self._answered: dict[int, float] = {}
        self._was_silent: set[int] = set()

    def result(self, pose: Sequence[float]) -> CalibrationResult:
        """Return the result; pose: (n,) deg in which `zero` is measured. Raises DataError if a motor is not found."""
        self._scan()
        for name, motion in zip(self._arm.joint_names, positive_turns(self._arm), strict=True):
            self._watch(f"{name}: from home {motion}, by 30 degrees or so, and back", partial(self._found_by, name))
        where = f"{' '.join(f'{angle:g}' for angle in pose)} deg" if any(pose) else ""
        rest = f"bring the arm to {where}" if where else "let the arm hang"
        self._watch(f"{rest}, hands off, until it is still", self._unrest)
        at_rest = [self._angles[can_id] for can_id in self.found]
        unrest = max(max(angles) - min(angles) for angles in at_rest)
        survival, refusals = self._after_power_up(list(map(fmean, at_rest)))
        exactly = f"rad, measured {f'at {where}' if where else 'hanging'}, ±{unrest:.4f} and as exact as that pose"
        zeros = []
        rows = zip(self.found.items(), self._arm.motors, at_rest, pose, strict=True)
        for (can_id, (name, direction)), motor, angles, angle in rows:
            found = self._last[can_id]
            # The scan decodes every reply in MIT mode with the usual position range.
            is_mit = found.wire_format == MIT.name
            scale = motor.spec.position_range / SPEC.position_range if is_mit else 1.0
            zero = scale * fmean(angles) - direction * math.radians(angle)
            zeros.append(round(zero, 4))
            try:
                JointMotor(motor.spec, can_id, direction, zero, wire_format=found.board, timeout=motor.timeout)
            except ParameterError as error:  # the angle would wrap, or the file names another motor
                refusals.append(f"{name}: {error}" + (f": {STORE_ZERO}" if error.name == "zero" else ""))
        node, directions = f"{self._arm.namespace}/can_bridge", [direction for _, direction in self.found.values()]
        formats = [self._last[can_id].wire_format for can_id in self.found]
        changes = (
            Change(node, "can_id", list(self.found), "found by moving each joint by hand"),
            Change(node, "wire_format", formats, "as each board answers"),
            *self._master_ids(node),
            Change(node, "direction", directions, "found by moving each joint by hand in its positive direction"),
            Change(node, "zero", zeros, f"{exactly}; {survival}"),
        )
        return CalibrationResult(changes, (), tuple(refusals), self._arm)

    def _master_ids(self, node: str) -> tuple[Change, ...]:
        """Return the change of `master_id`, if a motor has one that is its own choice."""
        answers = [self._last[can_id] for can_id in self.found]
        if all(answer.family == FAMILY for answer in answers):
            return ()
        master_ids = [0 if answer.family == FAMILY else answer.reply_id for answer in answers]
        return (Change(node, "master_id", master_ids, "on which each motor answers"),)

    def _scan(self) -> None:
        answers, problems = self._bus.scan()
        self._last = {answer.can_id: answer for answer in answers}
        self._say(self._table())
        if any(answer.wire_format == MIT_V3.name for answer in answers):
            self._say(SERVO_MODE)
        if len(answers) < len(self._arm.motors):
            listed = ", ".join(map(str, self._last)) or "none"
            count = f"IDs that answer: {listed}. An arm has {len(self._arm.motors)} motors"
            problems = (
                *problems,
                f"{count}: check power, plugs, terminators and the bit rate. A V1 or V2 board must be in MIT mode; "
                "a V3 board must report unasked, not in query-reply mode",
            )
        if problems:
            raise DataError("; ".join(problems))

    def _watch(self, request: str, unclear: Callable[[], str] = str) -> None:
        """Let the person do what is requested, and keep what all motors answer meanwhile.

        unclear: returns why that does not show what was asked for, or ''. Raises DataError after some attempts.
        """
        for left in reversed(range(HAND.attempts)):
            self._angles = {can_id: [] for can_id in self._last}
            self._answered, self._was_silent = dict.fromkeys(self._last, self._clock()), set()
            self._poll()
            self._wait(request, self._poll)
            self._poll()
            if not (why := unclear()):
                return
            if not left:
                raise DataError(why)
            self._say(f"{why}; once more, please")

    def _poll(self) -> Table:
        answers = self._bus.poll(list(self._last))
        self._last |= answers
        self._answered |= dict.fromkeys(answers, self._clock())
        for can_id, answer in answers.items():
            self._angles[can_id].append(answer.position)
        return self._table()

    def _table(self) -> Table:
        """Return what all motors answered last; remember who is silent."""
        now = self._clock()
        silent = {can_id for can_id, answered in self._answered.items() if now - answered > HAND.silence}
        self._was_silent |= silent
        state = "ID", "joint", "angle deg", "turned deg", "degC", "error"
        table = Table(*state, "reply", "reply ID", "family", "wire format", header_style="bold")
        for can_id, answer in sorted(self._last.items()):
            angles = self._angles.get(can_id) or [0.0]
            table.add_row(
                str(can_id),
                self.found.get(can_id, "?")[0],
                "silent" if can_id in silent else f"{math.degrees(answer.position):.1f}",
                f"{math.degrees(angles[-1] - angles[0]):+.1f}",
                "-" if answer.temperature is None else str(answer.temperature),
                "-"
                if answer.error is None
                else "none"
                if not answer.error
                else f"{answer.error} ({answer.board.error_text(answer.error)})",
                f"{answer.reply_length} bytes",
                hex(answer.reply_id) if answer.reply_id > MAX_CAN_ID else str(answer.reply_id),
                answer.family,
                answer.wire_format,
            )
        return table

    def _found_by(self, name: str) -> str:
        """Take the motor that turned most for that of the joint `name`; return why none can be taken, or ''."""
        ways = []
        for can_id, angles in self._angles.items():
            turns = [math.degrees(angle - angles[0]) for angle in angles] or [0.0]
            ways.append((max(turns, key=abs), min(max(turns), -min(turns)), can_id))
        (other, _, second), (turn, back, most) = sorted(ways, key=lambda way: abs(way[0]))[-2:]
        if self._was_silent:
            return f"{name}: motor {min(self._was_silent)} did not answer while the arm was moved: check its plug"
        if abs(turn) < HAND.least:
            return f"{name}: no motor turned by {HAND.least:g} degrees; motor {most} by {abs(turn):.1f}"
        if abs(other) > HAND.other * abs(turn):
            both = f"{abs(turn):.0f} and {abs(other):.0f} degrees"
            return f"{name}: motors {most} and {second} both turned, by {both}: move one joint alone"
        if back > HAND.back * abs(turn):
            return f"{name}: motor {most} turned both ways: move the joint in one direction only"
        if most in self.found:
            return f"{name}: motor {most} turned, which is that of {self.found[most][0]}"
        self.found[most] = name, 1 if turn > 0.0 else -1
        self._say(f"{name}: motor {most}, direction {self.found[most][1]:+d}")
        return ""

    def _sample(self) -> None:
        """Take the angles of `STILL.samples` polls from now on."""
        self._angles = {can_id: [] for can_id in self._last}
        for _ in range(STILL.samples):
            self._poll()

    def _unrest(self) -> str:
        """Sample the arm at rest; return why it is not at rest, or ''."""
        self._sample()
        for can_id, (name, _) in self.found.items():
            angles = self._angles[can_id]
            if len(angles) < STILL.samples // 2:
                return f"motor {can_id} did not answer: check its plug"
            if (moved := max(angles) - min(angles)) > STILL.unrest:
                return f"{name} moved by {math.degrees(moved):.1f} degrees: the arm must be still"
        return ""

    def _after_power_up(self, before: Sequence[float]) -> tuple[str, list[str]]:
        """Return whether the angles survive a power-up, as a note, and the reasons why not."""
        request = "let the arm hang as before, switch the motors' power off and on, and wait until all answer again"
        self._watch(f"{request} (or go on at once, without this check)")
        is_checked = set(self.found) <= self._was_silent
        self._sample()
        refusals = []
        for (can_id, (name, _)), motor, angle in zip(self.found.items(), self._arm.motors, before, strict=True):
            if not self._angles[can_id]:
                return UNCHECKED, [f"motor {can_id} does not answer after the power-up"]
            away, turn = self._angles[can_id][-1] - angle, motor.spec.rotor_turn
            if is_checked and abs(away) > STILL.same:
                turns = round(away / turn)
                is_turn = turns and abs(away - turns * turn) < STILL.same
                cause = f"{turns:+d} rotor turns" if is_turn else "no whole number of rotor turns"
                refusals.append(
                    f"{name}: {math.degrees(away):+.0f} degrees off after the power-up, {cause}: {STORE_ZERO}"
                )
        unchecked = f"{UNCHECKED}: hang the arm each time the motors are switched on"
        return "the same after a power-up with the arm hanging" if is_checked else unchecked, refusals
