"""calibrate motors: which motor turns which joint, which way, and at which angle the arm hangs.

The person moves one joint after another by hand, in its positive direction and back, with the motors off. The motor
that turns most is the joint's; the sign of its turn is `direction`. Then the arm hangs, or is in a jig, and the angles
that the motors report there become `zero`.

The encoder is on the rotor. After power-up the angle is ambiguous by a turn of the rotor: 60 degrees at the joint on an
AK60-6, 40 on an AK80-9. Whether `zero` survives is tried by switching the power off and on.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from statistics import fmean

from rich.table import Table

from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.motors.joint_motor import MAX_CAN_ID, OPTIONS, JointMotor
from exo_gravity.core.motors.specs import MOTOR_ERRORS
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.hardware.can.bus_scan import BusScan, MotorAnswer
from exo_gravity.tools.calibration.live import Say
from exo_gravity.tools.calibration.result import CalibrationResult, Change
from exo_gravity.tools.inputs.arms import ConfiguredArm
from exo_gravity.tools.inputs.parameter_file import load

Clock = Callable[[], float]
Wait = Callable[[str, Callable[[], Table]], None]
"""(request, watch): shows the request and calls watch() for the table to show, until the person has done it."""

MOTIONS = (
    "turn the whole arm about the vertical axis, a raised arm from the side to the front",
    "lift the arm to the side",
    "lift the upper arm to the front",
    "bend the elbow",
)
MIN_TURN = math.radians(10.0)  # by which a joint must be moved
MAX_OTHER = 0.5  # of that turn, which another motor may turn meanwhile
MAX_BACK = 0.5  # of that turn, which the same motor may turn the other way
ATTEMPTS = 3  # of each joint
REST_SAMPLES = 40
MAX_UNREST = math.radians(0.5)  # between two of these samples
SAME_ANGLE = math.radians(5.0)  # within which the arm hangs again after the power was off
MAX_SILENCE = 0.15  # s: some replies in a row may be late on a busy computer
UNCHECKED = "not checked after a power-up"


def calibrate_motors(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Calibrate the motors of `arm`. options.wait: a `Wait`; options.pose: (4,) deg, the arm's pose for `zero`.

    Raises BusError if the bus cannot be used.
    """
    given = load(options.params)[f"{arm.namespace}/can_bridge"]
    prefix = f"{OPTIONS}."
    can_options = {name.removeprefix(prefix): value for name, value in given.items() if name.startswith(prefix)}
    with BusScan((given["can.interface"], given["can.channel"], can_options)) as bus:
        say(f"Asking IDs 1 to {MAX_CAN_ID} on {given['can.channel']}: nothing moves")
        return MotorSearch(bus, arm, options.wait, say).result(options.pose)


class MotorWatch:
    """Polls the motors `can_ids` at each call, and keeps how far each has turned since the first.

    joints: names by ID, as far as known. was_silent: IDs that did not answer for MAX_SILENCE. clock: s.
    """

    def __init__(self, bus: BusScan, can_ids: Sequence[int], joints: dict[int, str], clock: Clock) -> None:
        self._bus = bus
        self._ids = can_ids
        self._joints = joints
        self._clock = clock
        self._first: dict[int, float] = {}
        self._last: dict[int, MotorAnswer] = {}
        self._answered = dict.fromkeys(can_ids, clock())  # s, when each answered last
        self.furthest: dict[int, float] = dict.fromkeys(can_ids, 0.0)  # rad, signed
        self.back: dict[int, float] = dict.fromkeys(can_ids, 0.0)  # rad, the largest turn the other way, 0 or more
        self.was_silent: set[int] = set()

    def __call__(self) -> Table:
        """Poll once, and return the table of all motors."""
        answers = self._bus.poll(self._ids)
        now = self._clock()
        self._answered |= dict.fromkeys(answers, now)
        silent = {can_id for can_id, answered in self._answered.items() if now - answered > MAX_SILENCE}
        self.was_silent |= silent
        self._last |= answers
        for can_id, answer in answers.items():
            turn = answer.position - self._first.setdefault(can_id, answer.position)
            furthest = self.furthest[can_id]
            if turn * furthest < 0.0:
                self.back[can_id] = max(self.back[can_id], min(abs(turn), abs(furthest)))
            if abs(turn) > abs(furthest):
                self.furthest[can_id] = turn
        turns = {can_id: answer.position - self._first[can_id] for can_id, answer in self._last.items()}
        return motor_table(self._last.values(), self._joints, turns, silent)


def motor_table(
    answers: Iterable[MotorAnswer], joints: Mapping[int, str], turns: Mapping[int, float], silent: Collection[int]
) -> Table:
    """Return the table of the motors that answer; turns: rad by ID, since the person was asked to move a joint."""
    columns = ("ID", "joint", "angle deg", "turned deg", "degC", "error", "reply", "reply ID", "wire format")
    table = Table(*columns, header_style="bold")
    for answer in sorted(answers):
        error = "-" if answer.error is None else MOTOR_ERRORS.get(answer.error, str(answer.error))
        table.add_row(
            str(answer.can_id),
            joints.get(answer.can_id, "?"),
            "silent" if answer.can_id in silent else f"{math.degrees(answer.position):.1f}",
            f"{math.degrees(turns.get(answer.can_id, 0.0)):+.1f}",
            "-" if answer.temperature is None else str(answer.temperature),
            error,
            f"{answer.reply_length} bytes",
            hex(answer.reply_id) if answer.reply_id > MAX_CAN_ID else str(answer.reply_id),
            answer.wire_format,
        )
    return table


class MotorSearch:
    """Leads the person through the joints of one arm. clock: s."""

    def __init__(self, bus: BusScan, arm: ConfiguredArm, wait: Wait, say: Say, clock: Clock = time.monotonic) -> None:
        self._bus = bus
        self._arm = arm
        self._wait = wait
        self._say = say
        self._clock = clock
        self._joints: dict[int, str] = {}
        self._ids: list[int] = []

    def result(self, pose: Sequence[float]) -> CalibrationResult:
        """Return the result; pose: (4,) deg in which `zero` is measured. Raises DataError if a motor is not found."""
        arm = self._arm
        answers, problems = self._bus.scan()
        self._say(motor_table(answers, {}, {}, ()))
        if len(answers) < JOINT_COUNT:
            listed = ", ".join(str(answer.can_id) for answer in answers) or "none"
            count = f"IDs that answer: {listed}. An arm has {JOINT_COUNT} motors"
            problems = (*problems, f"{count}: check power, plugs, terminators and the bit rate")
        if problems:
            raise DataError("; ".join(problems))
        self._ids = [answer.can_id for answer in answers]
        where = "" if not any(pose) else f"{' '.join(f'{angle:g}' for angle in pose)} deg"
        found = [self._motor_of(*joint) for joint in zip(arm.joint_names, MOTIONS, strict=True)]
        ids, directions = zip(*found, strict=True)
        angles, unrest = self._at_rest(f"bring the arm to {where}" if where else "let the arm hang", ids)
        zeros = [a - d * math.radians(p) for a, d, p in zip(angles, directions, pose, strict=True)]
        survival, jumps = self._after_power_up(ids, angles)
        node, formats = f"{arm.namespace}/can_bridge", {answer.can_id: answer.wire_format for answer in answers}
        exactly = f"rad, measured {f'at {where}' if where else 'hanging'}, ±{unrest:.4f} and as exact as that pose"
        changes = (
            Change(node, "can_id", list(ids), "found by moving each joint by hand"),
            Change(node, "wire_format", [formats[i] for i in ids], "as each board answers"),
            Change(node, "direction", list(directions), "found by moving each joint by hand in its positive direction"),
            Change(node, "zero", [round(zero, 4) for zero in zeros], f"{exactly}; {survival}"),
        )
        columns = zip(arm.joint_names, ids, directions, zeros, strict=True)
        lines = [f"{name}: motor {i}, direction {d:+d}, zero {zero:.4f} rad" for name, i, d, zero in columns]
        refusals = (*self._impossible(ids, directions, zeros), *jumps)
        return CalibrationResult(changes, (*lines, survival), refusals, arm)

    def _watch(self) -> MotorWatch:
        return MotorWatch(self._bus, self._ids, self._joints, self._clock)

    def _motor_of(self, name: str, motion: str) -> tuple[int, int]:
        """Return ID and direction of the motor of the joint `name`. Raises DataError if it was not found."""
        for _ in range(ATTEMPTS):
            watch = self._watch()
            watch()
            self._wait(f"{name}: {motion}, by 30 degrees or so, and back", watch)
            watch()
            why = self._unclear(watch)
            if not why:
                can_id = max(watch.furthest, key=lambda can_id: abs(watch.furthest[can_id]))
                direction = 1 if watch.furthest[can_id] > 0.0 else -1
                self._joints[can_id] = name
                self._say(f"{name}: motor {can_id}, direction {direction:+d}")
                return can_id, direction
            self._say(f"{name}: {why}; once more, please")
        raise DataError(f"{name}: {why}")

    def _unclear(self, watch: MotorWatch) -> str:
        """Return why the motion that was watched does not show which motor it is, or ''."""
        turns = {can_id: abs(turn) for can_id, turn in watch.furthest.items()}
        most, second = sorted(turns, key=lambda can_id: -turns[can_id])[:2]
        if silent := sorted(watch.was_silent):
            return f"motor {silent[0]} did not answer while the arm was moved: check its plug"
        if turns[most] < MIN_TURN:
            limit = math.degrees(MIN_TURN)
            return f"no motor turned by {limit:g} degrees; motor {most} by {math.degrees(turns[most]):.1f}"
        if turns[second] > MAX_OTHER * turns[most]:
            both = f"{math.degrees(turns[most]):.0f} and {math.degrees(turns[second]):.0f} degrees"
            return f"motors {most} and {second} both turned, by {both}: move one joint alone"
        if watch.back[most] > MAX_BACK * turns[most]:
            return f"motor {most} turned both ways: move the joint in one direction only"
        if most in self._joints:
            return f"motor {most} turned, which is that of {self._joints[most]}"
        return ""

    def _at_rest(self, request: str, ids: Sequence[int]) -> tuple[list[float], float]:
        """Return the motor angles (4,) of the arm at rest and their spread in rad. Raises DataError without rest."""
        for _ in range(ATTEMPTS):
            self._wait(f"{request}, hands off, until it is still", self._watch())
            samples = [self._bus.poll(ids) for _ in range(REST_SAMPLES)]
            angles = [[sample[i].position for sample in samples if i in sample] for i in ids]
            if silent := [i for i, column in zip(ids, angles, strict=True) if len(column) < REST_SAMPLES // 2]:
                why = f"motor {silent[0]} did not answer: check its plug"
            else:
                unrest = [max(column) - min(column) for column in angles]
                if max(unrest) <= MAX_UNREST:
                    return [fmean(column) for column in angles], max(unrest)
                joint = self._joints[ids[unrest.index(max(unrest))]]
                why = f"{joint} moved by {math.degrees(max(unrest)):.1f} degrees: the arm must be still"
            self._say(f"{why}; once more, please")
        raise DataError(why)

    def _impossible(self, ids: Sequence[int], directions: Sequence[int], zeros: Sequence[float]) -> Iterable[str]:
        """Yield which zero no motor can have: the angle would wrap."""
        for name, motor, can_id, direction, zero in zip(
            self._arm.joint_names, self._arm.motors, ids, directions, zeros, strict=True
        ):
            try:
                JointMotor(motor.spec, can_id, direction, zero)
            except ParameterError as error:
                yield f"{name}: {error}: call can_bridge's service set_zero with the arm hanging, and begin again"

    def _after_power_up(self, ids: Sequence[int], before: Sequence[float]) -> tuple[str, list[str]]:
        """Return whether the angles survive a power-up, as a note, and the reasons why not."""
        watch = self._watch()
        request = "let the arm hang as before, switch the motors' power off and on, and wait until all answer again"
        self._wait(f"{request} (or go on at once, without this check)", watch)
        answers: dict[int, MotorAnswer] = {}
        for _ in range(REST_SAMPLES):
            answers |= self._bus.poll(ids)
        if missing := [can_id for can_id in ids if can_id not in answers]:
            return UNCHECKED, [f"motor {missing[0]} does not answer after the power-up"]
        if not set(ids) <= watch.was_silent:
            return f"{UNCHECKED}: hang the arm each time the motors are switched on", []
        refusals = []
        for name, motor, can_id, angle in zip(self._arm.joint_names, self._arm.motors, ids, before, strict=True):
            away = answers[can_id].position - angle
            turn = 2.0 * math.pi / motor.spec.gear_ratio
            if abs(away) > SAME_ANGLE:
                turns = round(away / turn)
                is_turn = turns and abs(away - turns * turn) < SAME_ANGLE
                cause = f"{turns:+d} rotor turns" if is_turn else "no whole number of rotor turns"
                refusals.append(
                    f"{name}: {math.degrees(away):+.0f} degrees off after the power-up, {cause}: call can_bridge's "
                    "service set_zero with the arm hanging, and begin again"
                )
        return "the same after a power-up with the arm hanging", refusals
