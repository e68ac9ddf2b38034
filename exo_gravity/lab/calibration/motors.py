# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrate motors: which motor turns which joint, which way, and at which angle the arm hangs.

docs/calibration.md has the steps. The encoder is on the rotor: after power-up the angle is ambiguous by a turn of the
rotor. Whether `zero` survives is tried by switching the power off and on.

`BusScan` finds the motors of all families without moving any. Each ID is asked what a motor of each family answers with
its state (`WireFormat.questions`), those first that can have few IDs: who has answered is not asked again.

V1 and V2 boards of AK motors: a motor that is off still answers a command frame. The scan sends each ID a command with
damping alone, whose bytes are the same for every motor type: the gains' ranges are, and the other ranges are symmetric.
ENTER is never sent, so torque never flows; a motor that was left on lowers its joint under damping. IDs above
`MAX_CAN_ID` are not scanned: there, an echoed command could be taken for a reply.

V3 boards of AK motors: they are found by their status frames, and are never sent anything, because a command switches
them on. V1 and V2 boards in servo mode send the same frames. Only their rate tells them apart: 50 a second as
delivered, where a V3 board must be set to 200 at least.

Damiao motors: they have a question of their own, which commands nothing.
"""

import argparse
import contextlib
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean
from typing import Any, NamedTuple

import can
import numpy as np
from rich.table import Table

from exo_gravity.core.errors import BusError, DataError, ParameterError
from exo_gravity.core.motors.ak import FAMILY, MIT, MIT_V3
from exo_gravity.core.motors.families import MOTORS, every_family
from exo_gravity.core.motors.frames import COMMAND, EXTENDED, OTHER, REPLY, WireFormat
from exo_gravity.core.motors.joint_motor import (
    MAX_CAN_ID,
    MAX_STATUS_RATE,
    OPTIONS,
    Address,
    JointMotor,
    buses_of,
    is_fd,
)
from exo_gravity.hardware.bus_lock import BusLock
from exo_gravity.hardware.can_port import CanPort, open_bus
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.hardware.motor_bus import LISTEN_TIME
from exo_gravity.lab.calibration.result import CalibrationResult, Change
from exo_gravity.lab.calibration.tours import Say
from exo_gravity.lab.inputs.arms import ConfiguredArm
from exo_gravity.lab.inputs.parameter_file import can_options, load
from exo_gravity.lab.view import described

SPEC = MOTORS["AK60-6"]  # it scales positions alone, with the usual range
ALL_IDS = range(1, MAX_CAN_ID + 1)
REPLY_TIME = 0.01  # s: a motor replies within 0.4 ms; a USB adapter and a busy computer add some
COMMANDS = 2  # to each ID, in case a frame is lost
SERVO_RATE = 75.0  # status frames a second below which a board is no V3 board that an arm can use
STATUS_TIME = 0.12  # s in which the next status frame of a V3 board is awaited
IDS = dict.fromkeys(range(1, 256), 0)  # that boards which report by themselves may have, and any reply ID


class MotorAnswer(NamedTuple):
    """What a motor replied."""

    can_id: int
    reply_id: int  #: Arbitration ID: the motor's own or 0, another one, or that of a V3 board's status frames.
    reply_length: int  #: 6, 7 or 8 bytes.
    position: float  #: Motor angle in rad, with a wire range of 12.5 rad.
    temperature: int | None  #: degC; None from firmware that replies with 6 or 7 bytes.
    error: int | None  #: The board's code of an error; None likewise.
    board: WireFormat = MIT  #: Its format, and with it its family.
    bus: str = ""  #: On which it answered.


class BusScan(contextlib.ExitStack):
    """Owns the bus at `address` until `close`, so that no bridge can start meanwhile.

    Raises BusError if a bridge holds the bus, with its name; if another host commands the motors; if a dead bridge left
    them on; or if the bus cannot be opened.

    open_bus: opens the bus.
    """

    def __init__(
        self,
        address: Address,
        clock: Clock = COMPUTER_CLOCK,
        open_bus: Callable[[str, str, Mapping[str, Any]], can.BusABC] = open_bus,
    ) -> None:
        super().__init__()
        self._now = clock.monotonic
        self.name = address[1]
        boards = [board for family in every_family() for board in family.formats.values()]
        self._asked = sorted((board for board in boards if board.questions(1)), key=lambda board: board.last_id)
        self._reporting = [board for board in boards if not board.questions(1)]
        self._boards: dict[int, WireFormat] = {}  # of each motor that has answered or reported
        self._v3: dict[int, MotorAnswer] = {}  # the newest status of each board that reports by itself
        self._reports: dict[int, int] = {}  # status frames of each within LISTEN_TIME
        lock = BusLock(address, f"calibrate motors (PID {os.getpid()})", clock=clock)
        self.callback(lock.release)
        try:
            if lock.notes.command.powered:
                raise BusError(
                    f"CAN bus {self.name}: the last can_bridge died and may have left the motors on: start can_bridge, "
                    "which lets the arm down, and stop it"
                )
            self._port = CanPort(open_bus(*address), clock, is_fd=is_fd(address[2]))
            self.callback(self._port.close)
            for message, kind, answer in self._frames(LISTEN_TIME):
                if answer and message.is_extended_id:
                    self._reports[answer.can_id] = self._reports.get(answer.can_id, 0) + 1
                heard = message.arbitration_id
                if (kind == COMMAND) if message.is_extended_id else (heard <= MAX_CAN_ID):
                    raise BusError(
                        f"CAN bus {self.name} is in use: a frame with ID {heard} was heard; stop the other host. "
                        "Without another host, two motors share an ID and answer each other: switch off their power"
                    )
        except BaseException:
            self.close()
            raise

    def scan(self, can_ids: Iterable[int] = ALL_IDS) -> tuple[tuple[MotorAnswer, ...], tuple[str, ...]]:
        """Ask every ID; return who answers, by ID, and what is wrong with the bus or an ID. Raises BusError."""
        found = {can_id: self._v3[can_id] for can_id in can_ids if can_id in self._v3}
        problems: list[str] = []
        asked = [(board, can_id) for can_id in sorted(can_ids) for board in self._asked if can_id <= board.last_id]
        for board, can_id in asked:
            if can_id in found:
                continue
            heard = [each for _ in range(COMMANDS) for each in self._ask(board, can_id)]
            answers = [answer for _, answer in heard if answer]
            found = {answer.can_id: answer for answer in answers} | found  # also late replies
            for frame in dict.fromkeys(f"{m.arbitration_id} [{m.data.hex(' ')}]" for m, answer in heard if not answer):
                problems.append(f"ID {can_id}: a frame with ID {frame} follows a command, and is no motor's reply")
            angles = [f"{answer.position:.2f} rad" for answer in answers if answer.can_id == can_id]
            if len(angles) > COMMANDS:
                problems.append(
                    f"ID {can_id}: several replies to one command: two motors share it "
                    f"({' and '.join(sorted(set(angles)))}); give one of them another ID with the vendor's tool, "
                    "alone on the bus"
                )
        for can_id in sorted(can_id for can_id in self._v3 if can_id > MAX_CAN_ID):
            problems.append(f"ID {can_id}: a V3 board; its ID must be from 1 to {MAX_CAN_ID}")
        for can_id, count in sorted(self._reports.items()):
            if (rate := count / LISTEN_TIME) < SERVO_RATE:
                problems.append(
                    f"ID {can_id}: about {rate:.0f} status frames a second: a V1 or V2 board in servo mode, to be "
                    f"set to MIT mode with the vendor's tool, or a V3 board, to be set to {MAX_STATUS_RATE:g} a second"
                )
        return tuple(found[can_id] for can_id in sorted(found)), tuple(problems)

    def poll(self, can_ids: Iterable[int]) -> dict[int, MotorAnswer]:
        """Return the newest answer of each of these motors; a silent one is missing. Raises BusError."""
        reporting = set(can_ids) & set(self._v3)
        asked = set(can_ids).intersection(self._boards) - reporting
        found: dict[int, MotorAnswer] = {}
        for can_id in asked:
            for _, answer in self._ask(self._boards[can_id], can_id):
                if answer and answer.can_id == can_id:
                    found[can_id] = answer
                    break
        list(self._port.waiting())  # read: what came before is no answer
        for _, _, answer in self._frames(STATUS_TIME if reporting else 0.0):
            if answer and answer.can_id in reporting:
                found[answer.can_id] = answer
            if reporting <= set(found):
                break
        return found

    def _ask(self, board: WireFormat, can_id: int) -> Iterator[tuple[can.Message, MotorAnswer | None]]:
        """Ask one motor; yield the frames with 11-bit IDs that arrive within REPLY_TIME, each with its answer."""
        list(self._port.waiting())  # read: what came before is no answer
        questions = board.questions(can_id)
        self._port.send(*questions)
        sent = [data for _, data in questions]
        for message, _, answer in self._frames(REPLY_TIME, board):
            if not message.is_extended_id and message.data not in sent:  # our own frame, echoed by the bus
                yield message, answer

    def _frames(
        self, duration: float, asked: WireFormat | None = None
    ) -> Iterator[tuple[can.Message, str, MotorAnswer | None]]:
        """Yield the data frames that arrive within `duration` s, what each is, and the answer in it.

        asked: whose answers are expected, besides those of motors that have answered before, and of boards that report
            by themselves.
        """
        end = self._now() + duration
        while (remaining := end - self._now()) > 0.0:
            message = self._port.receive(remaining)
            if message is None or message.is_error_frame or message.is_remote_frame:
                continue
            yield message, *self._sort(message, asked)

    def _sort(self, message: can.Message, asked: WireFormat | None) -> tuple[str, MotorAnswer | None]:
        """Return what a frame is, and the answer in it; `asked` as for `_frames`."""
        data, kinds = bytes(message.data), set()
        for board in dict.fromkeys((*([asked] if asked else ()), *self._reporting, *self._asked)):
            ids = IDS if board in self._reporting else dict.fromkeys(range(1, board.last_id + 1), 0)
            frame_id = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
            kind, can_id = board.classify(frame_id, message.data, ids)
            if kind == REPLY and (board in (asked, *self._reporting) or self._boards.get(can_id) is board):
                reply = board.unpack_reply(SPEC, can_id, data)
                state = reply.position, reply.temperature, reply.error
                answer = MotorAnswer(can_id, message.arbitration_id, len(data), *state, board, self.name)
                self._boards[can_id] = board
                if board in self._reporting:
                    self._v3[can_id] = answer
                return kind, answer
            kinds.add(kind)
        return (COMMAND if COMMAND in kinds else OTHER), None


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
    with contextlib.ExitStack() as stack:
        scans = [stack.enter_context(BusScan((interface, name, each))) for name, each in own.items()]
        say(f"Asking IDs 1 to {MAX_CAN_ID} on {' and '.join(own)}: nothing moves")
        search = MotorSearch(scans, arm, options.wait, say)
        result = search.result(pose)
    if len(own) == 1:
        return result
    channels = [search.answers[can_id].bus for can_id in search.found]
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
    """Leads the person through the joints of one arm. buses: on which its motors answer. clock: s.

    found: name of the joint and direction of each motor, by ID, as far as known.
    answers: the newest of each motor, by ID.
    """

    def __init__(
        self,
        buses: Sequence[BusScan],
        arm: ConfiguredArm,
        wait: Wait,
        say: Say,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.found: dict[int, tuple[str, int]] = {}
        self.answers: dict[int, MotorAnswer] = {}
        self._buses, self._arm = buses, arm
        self._wait, self._say, self._clock = wait, say, clock
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
            found = self.answers[can_id]
            # The scan decodes every reply in MIT mode with the usual position range.
            scale = motor.spec.position_range / SPEC.position_range if found.board is MIT else 1.0
            zero = scale * fmean(angles) - direction * math.radians(angle)
            zeros.append(round(zero, 4))
            try:
                JointMotor(motor.spec, can_id, direction, zero, wire_format=found.board, timeout=motor.timeout)
            except ParameterError as error:  # the angle would wrap, or the file names another motor
                refusals.append(f"{name}: {error}" + (f": {STORE_ZERO}" if error.name == "zero" else ""))
        node, directions = f"{self._arm.namespace}/can_bridge", [direction for _, direction in self.found.values()]
        found_answers = [self.answers[can_id] for can_id in self.found]
        formats = [answer.board.name for answer in found_answers]
        # A reply ID is a motor's own choice in other families than ours.
        replies = [0 if answer.board.family == FAMILY else answer.reply_id for answer in found_answers]
        master_ids = (Change(node, "master_id", replies, "on which each motor answers"),) if any(replies) else ()
        changes = (
            Change(node, "can_id", list(self.found), "found by moving each joint by hand"),
            Change(node, "wire_format", formats, "as each board answers"),
            *master_ids,
            Change(node, "direction", directions, "found by moving each joint by hand in its positive direction"),
            Change(node, "zero", zeros, f"{exactly}; {survival}"),
        )
        return CalibrationResult(changes, (), tuple(refusals), self._arm)

    def _scan(self) -> None:
        problems: list[str] = []
        for bus in self._buses:
            found, own = bus.scan()
            twice = [answer.can_id for answer in found if answer.can_id in self.answers]
            problems += [*own, *(f"ID {can_id}: on two buses; give one motor another ID" for can_id in twice)]
            self.answers |= {answer.can_id: answer for answer in found}
        self._say(self._table())
        if any(answer.board is MIT_V3 for answer in self.answers.values()):
            self._say(SERVO_MODE)
        if len(self.answers) < len(self._arm.motors):
            listed = ", ".join(map(str, sorted(self.answers))) or "none"
            count = f"IDs that answer: {listed}. An arm has {len(self._arm.motors)} motors"
            problems.append(
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
            self._angles = {can_id: [] for can_id in self.answers}
            self._answered, self._was_silent = dict.fromkeys(self.answers, self._clock()), set()
            self._poll()
            self._wait(request, self._poll)
            self._poll()
            if not (why := unclear()):
                return
            if not left:
                raise DataError(why)
            self._say(f"{why}; once more, please")

    def _poll(self) -> Table:
        for bus in self._buses:
            found = bus.poll(list(self.answers))
            self.answers |= found
            self._answered |= dict.fromkeys(found, self._clock())
            for can_id, answer in found.items():
                self._angles[can_id].append(answer.position)
        return self._table()

    def _table(self) -> Table:
        """Return what all motors answered last; remember who is silent."""
        now = self._clock()
        silent = {can_id for can_id, answered in self._answered.items() if now - answered > HAND.silence}
        self._was_silent |= silent
        state = "ID", "joint", "angle deg", "turned deg", "degC", "error"
        table = Table(*state, "reply", "reply ID", "family", "wire format", header_style="bold")
        for can_id, answer in sorted(self.answers.items()):
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
                answer.board.family,
                answer.board.name,
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
        self._angles = {can_id: [] for can_id in self.answers}
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
