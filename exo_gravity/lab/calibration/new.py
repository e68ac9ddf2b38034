# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrate new: writes the parameter file of an arm from its URDF, its motors and their CAN IDs.

What the URDF and the motors' records tell is filled in: limits, torques, where the arm hangs. What only the arm itself
can tell, signs, zeros and torque scales, is marked MEASURE. The file is read back as the nodes read it.
"""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.hardware.urdf_arm import UrdfArm, read_urdf
from exo_gravity.hardware.urdf_checks import robot_of
from exo_gravity.lab.inputs.arms import carried_arm
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.lab.inputs.ros_yaml import scalar

LARGEST_ANGLE = 3.1  # rad, of a joint without limits
POSES = 2000  # at random, for gravity's largest torque
FALL, STEPS = 0.05, 4000  # rad per Nm and step, by which the arm is let fall; it hangs after so many
DAMIAO_TIMEOUT = 0.3  # s
MEASURE = "MEASURE"
PLAUSIBLE_ANGLE = 2.1 * math.pi  # rad; robots whose joints turn both ways have limits of ±2 pi
PLAIN = re.compile(r"[A-Za-z][\w./-]*", re.ASCII)


@dataclass(frozen=True)
class NewArm:
    """What the user says of an arm. Raises ParameterError."""

    urdf: str  #: path of the URDF
    motors: Sequence[str]  #: (n,) types
    ids: Sequence[int]  #: (n,) CAN IDs
    joints: Sequence[str] = ()  #: (n,) in this order; () for all turning joints in the order of the URDF
    hand: str = ""  #: the link that holds a load, '' for none
    side: str = "right"
    channel: str = "can0"

    def __post_init__(self) -> None:
        for motor in self.motors:
            if motor not in MOTORS:
                raise ParameterError("motors", motor, f"one of {', '.join(MOTORS)}")


class JointRange(NamedTuple):
    """The limits of a joint in a URDF, rad, as far as an arm's can be."""

    low: float
    high: float
    note: str = ""  #: what is doubtful in them, ''


def turning_joints(text: str) -> dict[str, JointRange]:
    """Return the limits of each turning joint of a URDF that follows no other one, in its order.

    Raises ParameterError if it is no URDF, or a limit no number.
    """
    found = {}
    for joint in robot_of(text).findall("joint"):
        if joint.get("type") not in ("revolute", "continuous") or joint.find("mimic") is not None:
            continue
        name, note, limit = joint.get("name", ""), "", joint.find("limit")
        low, high = (_edge(name, limit, end) for end in ("lower", "upper"))
        is_endless = joint.get("type") == "continuous"
        if is_endless or not low < high:
            if low == high and not is_endless:
                note = f"{name}: its limits, {low:g} to {high:g} rad, leave no room: as if it had none"
            low, high = -math.inf, math.inf
        elif max(-low, high) > PLAUSIBLE_ANGLE:
            note = f"{name}: its limits, {low:g} to {high:g} rad, are cut to ±{LARGEST_ANGLE:g}: are they in degrees?"
        found[name] = JointRange(max(low, -LARGEST_ANGLE), min(high, LARGEST_ANGLE), note)
    return found


def _edge(joint: str, limit: Element | None, end: str) -> float:
    """Return one end of a joint's limits in rad, NaN where it has none. Raises ParameterError if it is no number."""
    text = "" if limit is None else limit.get(end, "")
    try:
        return float(text) if text else math.nan
    except ValueError:
        raise ParameterError(f"limit {end} of {joint}", text, "a number of rad") from None


def hanging(arm: UrdfArm, ranges: Sequence[JointRange]) -> np.ndarray:
    """Return the angles (n,) in rad in which the upright arm comes to rest within its limits when it falls from 0."""
    low, high = np.transpose([(edge.low, edge.high) for edge in ranges])
    theta, upright = np.clip(np.zeros(len(low)), low, high), Tilt.of("left")
    for _ in range(STEPS):
        theta = np.clip(theta - FALL * np.array(arm.torque(theta.tolist(), upright)), low, high)
    return theta


def write_new(new: NewArm, output: Path) -> list[str]:
    """Write the parameter file; return what a person should know, a sentence each. Raises ParameterError."""
    text = read_urdf(new.urdf)
    known = turning_joints(text)
    names = list(new.joints or known)
    if not len(names) == len(new.motors) == len(new.ids):
        expected = f"one motor and one ID for each of the joints {', '.join(names) or '(none of the URDF turns)'}"
        raise ParameterError("motors and ids", [*new.motors, *new.ids], expected)
    arm = UrdfArm(text, names, new.hand)
    ranges = [known[name] for name in names]
    low, high = np.transpose([(edge.low, edge.high) for edge in ranges])
    poses = np.random.default_rng(0).uniform(low, high, (POSES, len(names)))
    upright = Tilt.of("left")
    needed = np.max(np.abs(arm.torques(poses, np.tile(upright.direction, (POSES, 1)))), axis=0)
    rated = [MOTORS[motor].rated_torque for motor in new.motors]
    efforts = [min(most, own or most) for most, own in zip(rated, arm.max_effort, strict=True)]
    home = hanging(arm, ranges)
    notes = [*arm.notes, *(edge.note for edge in ranges if edge.note)]
    for name, effort, most in zip(names, efforts, needed.tolist(), strict=True):
        if most > effort:
            notes.append(f"{name}: gravity takes up to {most:.1f} Nm of it, max_effort is {effort:g} Nm")
    output.write_text(_file(new, names, ranges, efforts, needed.tolist(), home.tolist()), encoding="utf-8")
    try:
        carried_arm(load(output), f"/{new.side}")
    except ParameterError:
        output.unlink()
        raise
    return notes


def _file(
    new: NewArm,
    names: Sequence[str],
    ranges: Sequence[JointRange],
    efforts: Sequence[float],
    needed: Sequence[float],
    home: Sequence[float],
) -> str:
    """Return the text of the parameter file."""
    count = len(names)
    timeouts = [0.0 if MOTORS[motor].family == "ak" else DAMIAO_TIMEOUT for motor in new.motors]
    listed = _row(names)
    return f"""# Written by `calibrate new` from {" ".join(new.urdf.split())}.
# {MEASURE} marks what only the arm itself can tell: docs/first_arming.md.

/{new.side}/can_bridge:
  ros__parameters:
    joint_names: {listed}
    autostart: false  # an operator arms it
    rate: 250.0
    can: {{interface: socketcan, channel: {_plain(new.channel)}}}
    motor: {_row(new.motors)}
    can_id: {_row(new.ids)}
    direction: {_row([1] * count)}  # {MEASURE}: 1 or -1, so that a positive angle is that of the URDF
    zero: {_row([0.0] * count)}  # {MEASURE}: rad, the motor's angle where the joint's angle is 0
    torque_scale: {_row([1.0] * count)}  # {MEASURE}: real Nm per commanded Nm
    motor_timeout: {_row(timeouts)}  # s, as set in the motors
    position_min: {_row([edge.low for edge in ranges])}  # rad, the URDF's
    position_max: {_row([edge.high for edge in ranges])}
    max_effort: {_row(efforts)}  # Nm; gravity of the arm alone, upright: up to {_row([round(x, 1) for x in needed])}
    home: {_row([round(angle, 3) for angle in home])}  # rad, where the arm hangs by its URDF

/{new.side}/compensator:
  ros__parameters:
    law: urdf
    urdf: {{file: {json.dumps(new.urdf, ensure_ascii=False)}, hand: {json.dumps(new.hand, ensure_ascii=False)}}}
    joint_names: {listed}
    use_imu: false  # true with an IMU on the trunk: docs/imu.md
    max_effort: {_row(efforts)}
    mode: one_g
"""


def _row(values: Sequence[object]) -> str:
    return f"[{', '.join(map(_plain, values))}]"


def _plain(value: object) -> str:
    """Return the YAML of a value: a text in quotes that ROS would not read as the same text without them."""
    is_text = isinstance(value, str) and not (PLAIN.fullmatch(value) and scalar(value) == value)
    return json.dumps(value, ensure_ascii=False) if is_text else str(value)
