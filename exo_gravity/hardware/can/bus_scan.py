"""Finds the AK motors on a bus without moving any, whatever the wire formats of their boards.

V1 and V2 boards: a motor that is off still answers a command frame. The scan sends each ID a command with zero gains
and zero torque, whose bytes are the same for every motor type: all ranges but those of the gains are symmetric. ENTER
is never sent, so torque never flows. IDs above `MAX_CAN_ID` are not scanned: there, an echoed command could be taken
for a reply.

V3 boards: they are found by their status frames, and are never sent anything, because a command switches them on.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import can

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.joint_motor import MAX_CAN_ID
from exo_gravity.core.motors.specs import MOTORS, pack_command, unpack_reply
from exo_gravity.core.motors.wire_formats import COMMAND, EXTENDED, MASTER_ID, MIT, MIT_V3, REPLY, Frame
from exo_gravity.hardware.can.can_port import CanPort, open_bus
from exo_gravity.hardware.can.motor_bus import LISTEN_TIME, MAX_STALE_FRAMES
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.hardware.ownership.bus_lock import Address, BusLock

SPEC = next(iter(MOTORS.values()))  # the position range is the same for all
NOTHING = pack_command(SPEC, 0.0, 0.0, 0.0, 0.0, 0.0)
ALL_IDS = range(1, MAX_CAN_ID + 1)
REPLY_TIME = 0.01  # s: a motor replies within 0.4 ms; a USB adapter and a busy computer add some
ATTEMPTS = 2  # for each ID, in case a frame is lost
STATUS_TIME = 0.12  # s in which the next status frame of a V3 board is awaited
V3_IDS = frozenset(range(1, 256))


class MotorAnswer(NamedTuple):
    """What a motor replied."""

    can_id: int
    reply_id: int  #: Arbitration ID: the motor's own or 0, or that of a V3 board's status frames.
    reply_length: int  #: 6 or 8 bytes.
    position: float  #: Motor angle in rad.
    temperature: int | None  #: degC; None from 6-byte firmware.
    error: int | None  #: Code of MOTOR_ERRORS; None from 6-byte firmware.
    wire_format: str = MIT.name  #: Name of the board's format.


class Scan(NamedTuple):
    """Who answered on a bus."""

    answers: tuple[MotorAnswer, ...]  #: One per motor, by ID.
    problems: tuple[str, ...]  #: Sentences on what is wrong with the bus or an ID.


class BusScan:
    """Owns the bus at `address` until `close`, so that no bridge can start meanwhile.

    open_bus: opens the bus. Raises BusError if a bridge holds the bus, with its name; if another host commands the
    motors; if a dead bridge left them on; or if the bus cannot be opened.
    """

    def __init__(
        self,
        address: Address,
        clock: Clock = COMPUTER_CLOCK,
        open_bus: Callable[[str, str, Mapping[str, Any]], can.BusABC] = open_bus,
    ) -> None:
        self._now = clock.monotonic
        self.name = address[1]
        self._v3: dict[int, MotorAnswer] = {}  # the newest status of each V3 board
        with contextlib.ExitStack() as held:
            lock = BusLock(address, f"calibrate motors (PID {os.getpid()})", clock=clock)
            held.callback(lock.release)
            if lock.notes.drive.powered:
                raise BusError(
                    f"CAN bus {self.name}: the last can_bridge died and may have left the motors on: start can_bridge, "
                    "which lets the arm down, and stop it"
                )
            self._port = CanPort(open_bus(*address), clock)
            held.callback(self._port.close)
            self._listen()
            self._held = held.pop_all()

    def close(self) -> None:
        """Release the bus."""
        self._held.close()

    def __enter__(self) -> BusScan:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def scan(self, can_ids: Iterable[int] = ALL_IDS) -> Scan:
        """Ask every ID; return who answers, and what is wrong. Raises BusError if the bus fails."""
        found = {can_id: self._v3[can_id] for can_id in can_ids if can_id in self._v3}
        problems: dict[str, None] = {}
        for can_id in sorted(set(can_ids) - set(found)):
            for sent in range(1, ATTEMPTS + 1):
                replies, others = self._ask(can_id)
                for reply_id, data in others:
                    if problem := _problem(can_id, reply_id, data):
                        problems[problem] = None
                    elif data[0] < can_id:
                        found.setdefault(data[0], _answer(reply_id, data))  # a late reply
                if len(replies) > sent:  # a late reply to the first command may arrive after the second
                    angles = " and ".join(sorted({f"{reply.position:.2f} rad" for reply in replies}))
                    problems[
                        f"ID {can_id}: several replies to one command: two motors share it ({angles}); give one of "
                        "them another ID with the vendor's tool, alone on the bus"
                    ] = None
                if replies:
                    found[can_id] = replies[0]
                    break
        for can_id in sorted(can_id for can_id in self._v3 if can_id > MAX_CAN_ID):
            problems[f"ID {can_id}: a V3 board; its ID must be from 1 to {MAX_CAN_ID}"] = None
        return Scan(tuple(found[can_id] for can_id in sorted(found)), tuple(problems))

    def poll(self, can_ids: Iterable[int]) -> dict[int, MotorAnswer]:
        """Return the newest answer of each of these motors; a silent one is missing. Raises BusError."""
        reporting = set(can_ids) & set(self._v3)
        replies = {i: self._ask(i, is_alone=False)[0] for i in can_ids if i not in reporting}
        return {i: found[-1] for i, found in replies.items() if found} | self._statuses(reporting)

    def _listen(self) -> None:
        end = self._now() + LISTEN_TIME
        while (remaining := end - self._now()) > 0.0:
            message = self._port.receive(remaining)
            if message is None or message.is_error_frame or message.is_remote_frame:
                continue
            heard = message.arbitration_id
            if (heard > MAX_CAN_ID) if not message.is_extended_id else self._note_status(message) != COMMAND:
                continue
            raise BusError(
                f"CAN bus {self.name} is in use: a frame with ID {heard} was heard; stop the other host; if there is "
                "none, two motors with one ID answer each other: switch their power off"
            )

    def _statuses(self, can_ids: set[int]) -> dict[int, MotorAnswer]:
        """Return the next status of each of these V3 boards; a silent one is missing."""
        self._drain()
        before = dict(self._v3)
        end = self._now() + STATUS_TIME
        while (remaining := end - self._now()) > 0.0 and any(self._v3[i] is before[i] for i in can_ids):
            message = self._port.receive(remaining)
            if message is not None and message.is_extended_id:
                self._note_status(message)
        return {i: self._v3[i] for i in can_ids if self._v3[i] is not before[i]}

    def _note_status(self, message: can.Message) -> str:
        """Note the status in a frame with a 29-bit ID, if it is one; return what the frame is."""
        frame_id = message.arbitration_id | EXTENDED
        kind, can_id = MIT_V3.classify(frame_id, message.data, V3_IDS)
        if kind == REPLY:
            reply = MIT_V3.unpack_reply(SPEC, can_id, message.data)
            state = reply.position, reply.temperature, reply.error
            self._v3[can_id] = MotorAnswer(can_id, message.arbitration_id, 8, *state, MIT_V3.name)
        return kind

    def _drain(self) -> None:
        """Read the frames that have arrived, but not forever: two motors with one ID may keep answering each other."""
        for _ in range(MAX_STALE_FRAMES):
            if self._port.waiting() is None:
                break

    def _ask(self, can_id: int, is_alone: bool = True) -> tuple[list[MotorAnswer], list[Frame]]:
        """Send one command; return the replies of this motor, and other short frames.

        is_alone: whether to wait for further replies after the first.
        """
        self._drain()
        self._port.send((can_id, NOTHING))
        replies: list[MotorAnswer] = []
        others: list[Frame] = []
        end = self._now() + REPLY_TIME
        while (remaining := end - self._now()) > 0.0 and (is_alone or not replies):
            message = self._port.receive(remaining)
            if message is None or message.is_extended_id or message.is_error_frame or message.is_remote_frame:
                continue
            frame = message.arbitration_id, bytes(message.data)
            if frame[1] == NOTHING:
                continue  # our own command, echoed by the bus
            if frame[1][:1] == bytes((can_id,)) and not _problem(can_id, *frame):
                replies.append(_answer(*frame))
            else:
                others.append(frame)
        self._port.confirm()
        return replies, others


def _problem(can_id: int, reply_id: int, data: bytes) -> str:
    """Return what is wrong with a frame that came after a command to `can_id`; '' for a motor's reply."""
    if len(data) not in (6, 8):
        return f"ID {can_id}: a reply of {len(data)} bytes, must be 6 or 8"
    if data[0] > can_id or (reply_id == can_id and data[0] != can_id):
        return f"ID {can_id}: the reply says that it is from motor {data[0]}"
    if reply_id not in (MASTER_ID, data[0]):
        return f"ID {can_id}: a reply with ID {reply_id}, must be {can_id} or {MASTER_ID}"
    return ""


def _answer(reply_id: int, data: bytes) -> MotorAnswer:
    reply = unpack_reply(SPEC, data)
    return MotorAnswer(reply.motor_id, reply_id, len(data), reply.position, reply.temperature, reply.error)
