# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Finds the motors of all families on a bus without moving any.

Each ID is asked what a motor of each family answers with its state (`WireFormat.questions`), those first that can have
few IDs: who has answered is not asked again.

V1 and V2 boards of AK motors: a motor that is off still answers a command frame. The scan sends each ID a command with
damping alone, whose bytes are the same for every motor type: the gains' ranges are, and the other ranges are symmetric.
ENTER is never sent, so torque never flows; a motor that was left on lowers its joint under damping. IDs above
`MAX_CAN_ID` are not scanned: there, an echoed command could be taken for a reply.

V3 boards of AK motors: they are found by their status frames, and are never sent anything, because a command switches
them on. V1 and V2 boards in servo mode send the same frames. Only their rate tells them apart: 50 a second as
delivered, where a V3 board must be set to 200 at least.

Damiao motors: they have a question of their own, which commands nothing.
"""

import contextlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import can

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import FAMILY, MIT
from exo_gravity.core.motors.families import FAMILIES, MOTORS, every_family
from exo_gravity.core.motors.frames import COMMAND, EXTENDED, OTHER, REPLY, WireFormat
from exo_gravity.core.motors.joint_motor import MAX_CAN_ID, MAX_STATUS_RATE, Address, is_fd
from exo_gravity.hardware.bus_lock import BusLock
from exo_gravity.hardware.can_port import CanPort, open_bus
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.hardware.motor_bus import LISTEN_TIME

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
    wire_format: str = MIT.name  #: Name of the board's format.
    family: str = FAMILY  #: Of the motor.

    @property
    def board(self) -> WireFormat:
        """The motor's wire format."""
        return FAMILIES[self.family].formats[self.wire_format]


class ArmScan(contextlib.ExitStack):
    """The scans of all buses of an arm, as one. addresses: of the buses. Raises BusError like `BusScan`."""

    def __init__(self, addresses: Iterable[Address]) -> None:
        super().__init__()
        self.channels: dict[int, str] = {}  #: of each motor that has answered, by ID
        self._scans: dict[str, BusScan] = {}
        try:
            for address in addresses:
                self._scans[address[1]] = self.enter_context(BusScan(address))
        except BaseException:
            self.close()
            raise
        self.name = " and ".join(self._scans)

    def scan(self) -> tuple[tuple[MotorAnswer, ...], tuple[str, ...]]:
        """Ask every ID on each bus; return who answers, by ID, and what is wrong. Raises BusError."""
        answers: dict[int, MotorAnswer] = {}
        problems: list[str] = []
        for channel, scan in self._scans.items():
            found, own = scan.scan()
            twice = (answer.can_id for answer in found if answer.can_id in answers)
            problems += [*own, *(f"ID {can_id}: on two buses; give one motor another ID" for can_id in twice)]
            answers |= {answer.can_id: answer for answer in found}
            self.channels |= dict.fromkeys((answer.can_id for answer in found), channel)
        return tuple(answers[can_id] for can_id in sorted(answers)), tuple(problems)

    def poll(self, can_ids: Iterable[int]) -> dict[int, MotorAnswer]:
        """Return the newest answer of each of these motors; a silent one is missing. Raises BusError."""
        wanted, found = list(can_ids), dict[int, MotorAnswer]()
        for channel, scan in self._scans.items():
            found |= scan.poll([can_id for can_id in wanted if self.channels[can_id] == channel])
        return found


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
        self._gaps: dict[int, float] = {}  # s, the shortest between two of their status frames
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
            heard_at: dict[int, float] = {}
            for message, kind, answer in self._frames(LISTEN_TIME):
                if answer and message.is_extended_id:
                    now, last = self._now(), heard_at.get(answer.can_id, -math.inf)
                    self._gaps[answer.can_id] = min(now - last, self._gaps.get(answer.can_id, math.inf))
                    heard_at[answer.can_id] = now
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
        problems: dict[str, None] = {}
        asked = [(board, can_id) for can_id in sorted(can_ids) for board in self._asked if can_id <= board.last_id]
        for board, can_id in asked:
            for sent in range(1, COMMANDS + 1):
                if can_id in found and sent == 1:
                    break
                angles = []
                for message, answer in self._ask(board, can_id):
                    if answer is None:
                        what = f"a frame with ID {message.arbitration_id} [{message.data.hex(' ')}]"
                        problems[f"ID {can_id}: {what} follows a command, and is no motor's reply"] = None
                        continue
                    found.setdefault(answer.can_id, answer)  # also late replies
                    if answer.can_id == can_id:
                        angles.append(f"{answer.position:.2f} rad")
                if len(angles) > sent:  # a late reply to the first command may arrive after the second
                    problems[
                        f"ID {can_id}: several replies to one command: two motors share it "
                        f"({' and '.join(sorted(set(angles)))}); give one of them another ID with the vendor's tool, "
                        "alone on the bus"
                    ] = None
                if angles:
                    break
        for can_id in sorted(can_id for can_id in self._v3 if can_id > MAX_CAN_ID):
            problems[f"ID {can_id}: a V3 board; its ID must be from 1 to {MAX_CAN_ID}"] = None
        for can_id, gap in sorted(self._gaps.items()):
            if (rate := 1.0 / max(gap, 1e-6)) < SERVO_RATE:
                problems[
                    f"ID {can_id}: about {rate:.0f} status frames a second: a V1 or V2 board in servo mode, to be "
                    f"set to MIT mode with the vendor's tool, or a V3 board, to be set to {MAX_STATUS_RATE:g} a second"
                ] = None
        return tuple(found[can_id] for can_id in sorted(found)), tuple(problems)

    def poll(self, can_ids: Iterable[int]) -> dict[int, MotorAnswer]:
        """Return the newest answer of each of these motors; a silent one is missing. Raises BusError."""
        reporting = set(can_ids) & set(self._v3)
        found: dict[int, MotorAnswer] = {}
        for can_id in set(can_ids).intersection(self._boards) - reporting:
            for _, answer in self._ask(self._boards[can_id], can_id):
                if answer:
                    found[answer.can_id] = answer
                    if answer.can_id == can_id:
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
                answer = MotorAnswer(can_id, message.arbitration_id, len(data), *state, board.name, board.family)
                self._boards[can_id] = board
                if board in self._reporting:
                    self._v3[can_id] = answer
                return kind, answer
            kinds.add(kind)
        return (COMMAND if COMMAND in kinds else OTHER), None
