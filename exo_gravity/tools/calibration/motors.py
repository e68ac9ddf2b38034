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
from collections.abc import Callable, Iterable, Sequence
from statistics import fmean

from rich.table import Table

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import OPTIONS, JointMotor
from exo_gravity.core.motors.specs import MOTOR_ERRORS
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.hardware.can.bus_scan import Answer, BusScan
from exo_gravity.tools.calibration.motor_watch import Watch, motor_table
from exo_gravity.tools.calibration.outcome import Change, Outcome
from exo_gravity.tools.inputs.arms import ConfiguredArm
from exo_gravity.tools.inputs.parameter_file import load

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


def run(options: argparse.Namespace, arm: ConfiguredArm, say: Callable[[object], None]) -> Outcome:
    """Calibrate the motors of `arm`. options.wait: a `Wait`; options.pose: (4,) deg, the arm's pose for `zero`.

    Raises BusError if the bus cannot be used.
    """
    given = load(options.params)[f"{arm.namespace}/can_bridge"]
    prefix = f"{OPTIONS}."
    can_options = {name.removeprefix(prefix): value for name, value in given.items() if name.startswith(prefix)}
    address = given["can.interface"], given["can.channel"], can_options
    with BusScan(address) as bus:
        say(f"Asking IDs 1 to 126 on {address[1]}: nothing moves")
        answers, problems = bus.scan()
        say(motor_table(answers))
        if len(answers) < JOINT_COUNT:
            ids = ", ".join(str(answer.can_id) for answer in answers) or "none"
            count = f"IDs that answer: {ids}. An arm has {JOINT_COUNT} motors"
            problems = (*problems, f"{count}: check power, plugs, terminators and the bit rate")
        if problems:
            return Outcome((), (), problems, arm)
        return _Search(bus, arm, answers, options.wait, say).outcome(options.pose)


class _Search:
    """Leads the person through the joints of one arm."""

    def __init__(
        self, bus: BusScan, arm: ConfiguredArm, answers: Sequence[Answer], wait: Wait, say: Callable[[object], None]
    ) -> None:
        self._bus, self._arm, self._wait, self._say = bus, arm, wait, say
        self._ids = [answer.can_id for answer in answers]
        self._formats = {answer.can_id: answer.wire_format for answer in answers}
        self._joints: dict[int, str] = {}
        self._errors = tuple(
            f"motor {answer.can_id} reports the error {MOTOR_ERRORS.get(answer.error, answer.error)}"
            for answer in answers
            if answer.error
        )

    def outcome(self, pose: Sequence[float]) -> Outcome:
        """Return the result; pose: (4,) deg in which `zero` is measured."""
        found: list[tuple[int, int]] = []
        for name, motion in zip(self._arm.joint_names, MOTIONS, strict=True):
            motor = self._motor_of(name, motion)
            if isinstance(motor, str):
                return Outcome((), self._errors, (motor,), self._arm)
            found.append(motor)
            self._joints[motor[0]] = name
            self._say(f"{name}: motor {motor[0]}, direction {motor[1]:+d}")
        ids, directions = [motor[0] for motor in found], [motor[1] for motor in found]
        rest = self._at_rest(pose, ids)
        if isinstance(rest, str):
            return Outcome((), self._errors, (rest,), self._arm)
        angles, unrest = rest
        zeros = [a - d * math.radians(p) for a, d, p in zip(angles, directions, pose, strict=True)]
        refusals = [*self._impossible(ids, directions, zeros)]
        survival = self._after_power_up(ids, angles)
        refusals += survival[1]
        node = f"{self._arm.namespace}/can_bridge"
        where = "hanging" if not any(pose) else f"at {' '.join(f'{angle:g}' for angle in pose)} deg"
        exactly = f"rad, measured {where}, ±{unrest:.4f} and as exact as that pose; {survival[0]}"
        changes = (
            Change(node, "can_id", ids, "found by moving each joint by hand"),
            Change(node, "wire_format", [self._formats[i] for i in ids], "as each board answers"),
            Change(node, "direction", directions, "found by moving each joint by hand in its positive direction"),
            Change(node, "zero", [round(zero, 4) for zero in zeros], exactly),
        )
        columns = zip(self._arm.joint_names, ids, directions, zeros, strict=True)
        lines = [f"{name}: motor {i}, direction {d:+d}, zero {zero:.4f} rad" for name, i, d, zero in columns]
        return Outcome(changes, (*lines, survival[0], *self._errors), tuple(refusals), self._arm)

    def _motor_of(self, name: str, motion: str) -> tuple[int, int] | str:
        """Return ID and direction of the motor of the joint `name`, or why it was not found."""
        why = ""
        for _ in range(ATTEMPTS):
            watch = Watch(self._bus, self._ids, self._joints)
            watch()
            self._wait(f"{name}: {motion}, by 30 degrees or so, and back", watch)
            watch()
            why = self._unclear(watch)
            if not why:
                can_id = max(watch.furthest, key=lambda can_id: abs(watch.furthest[can_id]))
                return can_id, 1 if watch.furthest[can_id] > 0.0 else -1
            self._say(f"{name}: {why}; once more, please")
        return f"{name}: {why}"

    def _unclear(self, watch: Watch) -> str:
        """Return why the motion that was watched does not tell a motor, or ''."""
        ranked = sorted(watch.furthest, key=lambda can_id: -abs(watch.furthest[can_id]))
        turns = {can_id: abs(watch.furthest[can_id]) for can_id in ranked}
        most, second = ranked[:2]
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

    def _at_rest(self, pose: Sequence[float], ids: Sequence[int]) -> tuple[list[float], float] | str:
        """Return the motor angles (4,) of the arm at rest and their spread in rad, or why there are none."""
        hanging = "let the arm hang" if not any(pose) else f"bring the arm to {' '.join(f'{a:g}' for a in pose)} deg"
        why = ""
        for _ in range(ATTEMPTS):
            self._wait(f"{hanging}, hands off, until it is still", Watch(self._bus, self._ids, self._joints))
            samples = [self._bus.poll(ids) for _ in range(REST_SAMPLES)]
            silent = [i for i in ids if sum(i in sample for sample in samples) < REST_SAMPLES // 2]
            if silent:
                why = f"motor {silent[0]} did not answer: check its plug"
                continue
            angles = [[sample[i].position for sample in samples if i in sample] for i in ids]
            unrest = [max(column) - min(column) for column in angles]
            if max(unrest) <= MAX_UNREST:
                return [fmean(column) for column in angles], max(unrest)
            joint = self._joints[ids[unrest.index(max(unrest))]]
            why = f"{joint} moved by {math.degrees(max(unrest)):.1f} degrees: the arm must be still"
            self._say(f"{why}; once more, please")
        return why

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
        watch = Watch(self._bus, self._ids, self._joints)
        request = "let the arm hang as before, switch the motors' power off and on, and wait until all answer again"
        self._wait(f"{request} (or go on at once, without this check)", watch)
        answers: dict[int, Answer] = {}
        for _ in range(REST_SAMPLES):
            answers |= self._bus.poll(ids)
        missing = [can_id for can_id in ids if can_id not in answers]
        if missing:
            return "not checked after a power-up", [f"motor {missing[0]} does not answer after the power-up"]
        if not set(ids) <= watch.was_silent:
            return "not checked after a power-up: hang the arm each time the motors are switched on", []
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
