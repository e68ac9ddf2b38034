# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrate new: writes the parameter file of an arm from its URDF, its motors and their CAN IDs.

What the URDF and the motors' records tell is filled in: limits, torques, where the arm hangs. What only the arm itself
can tell, signs, zeros and torque scales, is marked MEASURE. The file is read back as the nodes read it.
"""

import argparse
import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.families import MOTORS, every_family
from exo_gravity.hardware.urdf_arm import UrdfArm, read_urdf
from exo_gravity.hardware.urdf_checks import robot_of
from exo_gravity.lab.inputs.arms import read_arm
from exo_gravity.lab.inputs.parameter_file import read, scalar

LARGEST_ANGLE = 3.1  # rad, of a joint without limits
POSES = 2000  # at random, for gravity's largest torque
STARTS = 12  # poses from which the arm is let fall
LITTLE = 0.02  # Nm of a joint at rest, and J, that count as none
INSIDE = 0.1  # rad by which the limits are inside the URDF's: a start moves each joint a little
SIMULATED_BUS = "interface: udp_multicast, channel: 239.74.163.9, options: {port: 43119, hop_limit: 0"
DAMIAO_TIMEOUT = 0.3  # s
SEGMENT = 0.12  # m, from which a link is one that an upper arm or a forearm lies along
PLAUSIBLE_ANGLE = 2.1 * math.pi  # rad; robots whose joints turn both ways have limits of ±2 pi
PLAIN = re.compile(r"[A-Za-z][\w./-]*", re.ASCII)


def _bus(options: argparse.Namespace) -> str:
    """Return the bus as YAML."""
    fd = "fd: true" * options.fd
    if options.simulate:
        return f"{{{', '.join(filter(None, (SIMULATED_BUS, fd)))}}}}}"
    options_of_bus = f", options: {{{fd}}}" * options.fd
    return f"{{interface: socketcan, channel: {_plain(options.channel)}{options_of_bus}}}"


class JointRange(NamedTuple):
    """The limits of a joint in a URDF, rad, as far as an arm's can be."""

    low: float
    high: float
    note: str = ""  #: what is doubtful in them, ''

    def inside(self, home: float) -> tuple[float, float]:
        """Return the limits of the file: INSIDE these, but no closer than that to where the arm hangs, rad."""
        low = max(self.low, min(self.low + INSIDE, home - INSIDE))
        return round(low, 4), round(min(self.high, max(self.high - INSIDE, home + INSIDE)), 4)


def turning_joints(text: str) -> dict[str, JointRange]:
    """Return the limits of each turning joint of a URDF that follows no other one, in its order.

    Raises ParameterError if it is no URDF, or a limit no number.
    """
    found = {}
    for joint in robot_of(text).findall("joint"):
        if joint.get("type") not in ("revolute", "continuous") or joint.find("mimic") is not None:
            continue
        name, note, limit = joint.get("name", ""), "", joint.find("limit")
        low, high = (math.nan if limit is None else float(limit.get(end, "nan")) for end in ("lower", "upper"))
        is_endless = joint.get("type") == "continuous"
        if is_endless or not low < high:
            if low == high and not is_endless:
                note = f"{name}: its limits, {low:g} to {high:g} rad, leave no room: as if it had none"
            low, high = -math.inf, math.inf
        elif max(-low, high) > PLAUSIBLE_ANGLE:
            note = f"{name}: its limits, {low:g} to {high:g} rad, are cut to ±{LARGEST_ANGLE:g}: are they in degrees?"
        found[name] = JointRange(max(low, -LARGEST_ANGLE), min(high, LARGEST_ANGLE), note)
    return found


def hanging(arm: UrdfArm, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the angles (n,) in rad in which the upright arm comes to rest within `low` and `high`, (n,) rad.

    Of several such poses the lowest one. A joint that gravity turns by LITTLE, less than its friction, is as near to 0
    as it can be.
    """
    count, down = len(low), Tilt.of("left").direction
    shares = np.linspace(0.01, 0.99, 50)[:, None]  # of the way from 0

    def torques(poses: np.ndarray) -> np.ndarray:
        return np.asarray(arm.torques(poses, np.tile(down, (len(poses), 1))))

    def energy(pose: np.ndarray) -> float:
        """Return the work of gravity's torque in J on the way from 0."""
        return float(np.mean(torques(shares * pose) @ pose))

    def fall(start: np.ndarray, within: np.ndarray) -> np.ndarray:
        return np.asarray(minimize(energy, start, jac=lambda pose: torques(pose[None])[0], bounds=within).x)

    within = np.stack((low, high), axis=1)
    best = min(
        (fall(start, within) for start in np.random.default_rng(0).uniform(low, high, (STARTS, count))), key=energy
    )
    for joint in range(count):
        nearer = within.copy()
        nearer[joint] = np.clip(0.0, low[joint], high[joint])
        simpler = fall(best, nearer)
        if energy(simpler) - energy(best) < 0.5 * LITTLE * max(LITTLE, abs(simpler[joint] - best[joint])):
            best, within = simpler, nearer
    return best


def on_stops(arm: UrdfArm, names: Sequence[str], home: np.ndarray) -> list[str]:
    """Return how the arm hangs, or which joints rest on their stops, in a sentence."""
    angles = ", ".join(f"{name} {math.degrees(angle) + 0.0:.0f}" for name, angle in zip(names, home, strict=True))
    torque = np.abs(arm.torque(home.tolist(), Tilt.of("left")))
    stopped = [name for name, one in zip(names, torque, strict=True) if one > LITTLE]
    if stopped:
        return [
            f"the arm cannot hang within its limits: {', '.join(stopped)} would rest on a stop, and no start begins "
            f"there: mount it so that it hangs, or measure home with the arm in a stand that lets it hang. "
            "In the URDF the root link's z axis points up"
        ]
    return [f"by its URDF the arm hangs at {angles} degrees, if the root link's z axis points up: compare"]


def write_new(new: argparse.Namespace) -> list[str]:
    """Write the parameter file; return what a person should know, a sentence each. Raises ParameterError.

    new: urdf, its path; motors (n,), types; ids (n,), CAN IDs; joints (n,) in this order, () for all turning joints in
    the order of the URDF; hand, the link that holds a load, '' for none; side; channel of the bus, and whether it is
    CAN FD (fd); whether the file gets a simulated device, on a simulated bus (simulate); output.
    """
    every_family()  # those of other distributions, too
    fit = [name for name, spec in MOTORS.items() if spec.can_fd or not new.fd]
    for motor in new.motors:
        if motor not in fit:
            raise ParameterError("motors", motor, f"one of {', '.join(fit)}{' on CAN FD' * new.fd}")
    text = read_urdf(new.urdf)
    known = turning_joints(text)
    names = list(new.joints or known)
    if not len(names) == len(new.motors) == len(new.ids):
        expected = f"one motor and one ID for each of the joints {', '.join(names) or '(none of the URDF turns)'}"
        raise ParameterError("motors and ids", [*new.motors, *new.ids], expected)
    in_order = [name for name in known if name in names]
    if new.simulate and names != in_order:
        raise ParameterError("joints", names, f"in the order of the URDF for a simulated arm: {', '.join(in_order)}")
    arm = UrdfArm(text, names, new.hand)
    ranges = [known[name] for name in names]
    low, high = np.transpose([(edge.low, edge.high) for edge in ranges])
    poses = np.random.default_rng(0).uniform(low, high, (POSES, len(names)))
    needed = np.max(np.abs(arm.torques(poses, np.tile(Tilt.of("left").direction, (POSES, 1)))), axis=0)
    efforts = [
        min(MOTORS[motor].rated_torque, own or math.inf) for motor, own in zip(new.motors, arm.max_effort, strict=True)
    ]
    home = hanging(arm, low, high)
    notes = [*arm.notes, *(edge.note for edge in ranges if edge.note), *on_stops(arm, names, home)]
    for name, effort, most in zip(names, efforts, needed.tolist(), strict=True):
        if most > effort:
            notes.append(f"{name}: gravity takes up to {most:.1f} Nm of it, max_effort is {effort:g} Nm")
    worn = [0, 0, *(n for n, length in enumerate(arm.length, start=1) if length > SEGMENT)][-2:]
    text = _file(new, names, ranges, efforts, needed.tolist(), home.round(3).tolist(), worn)
    read_arm(read(text, str(new.output)), f"/{new.side}")
    new.output.write_text(text, encoding="utf-8")
    return notes


def _file(
    new: argparse.Namespace,
    names: Sequence[str],
    ranges: Sequence[JointRange],
    efforts: Sequence[float],
    needed: Sequence[float],
    home: Sequence[float],
    worn: Sequence[int],
) -> str:
    """Return the text of the parameter file.

    worn: links that carry upper arm and forearm, from 1 on; 0 for none.
    """
    count, simulator = len(names), ""
    timeouts = [DAMIAO_TIMEOUT if MOTORS[motor].family == "damiao" else 0.0 for motor in new.motors]
    edges = [edge.inside(angle) for edge, angle in zip(ranges, home, strict=True)]
    # As nodes find it, wherever they are started.
    file = new.urdf if new.urdf.startswith("package://") else str(Path(new.urdf).absolute())
    urdf = f"{{file: {json.dumps(file, ensure_ascii=False)}, hand: {json.dumps(new.hand, ensure_ascii=False)}}}"
    start = "autostart: false  # an operator arms it\n    rate: 250.0"
    if new.simulate:
        start = (
            "autostart: true  # nobody wears a simulated arm\n    rate: 100.0\n    command_timeout: 2.0\n"
            "    frozen_timeout: 2.0\n    enable_timeout: 60.0\n"
            "    start_pose: hanging  # as the simulated arm does at the start"
        )
        simulator = f"""
/{new.side}/simulator:
  ros__parameters:
    side: {new.side}
    urdf: {urdf}
    joint_names: {_row(names)}
    can: {_bus(new)}
    motor: {_row(new.motors)}
    can_id: {_row(new.ids)}
    direction: {_row([1] * count)}
    zero: {_row([0.0] * count)}
    motor_timeout: {_row(timeouts)}
    home: {_row(home)}  # rad, where it begins
    friction: {{coulomb: {_row([0.1] * count)}, viscous: {_row([0.02] * count)}}}  # Nm, Nm s/rad
"""
    return f"""# Written by `calibrate new` from {" ".join(new.urdf.split())}.
# MEASURE marks what only the arm itself can tell: docs/first_arming.md.

/{new.side}/can_bridge:
  ros__parameters:
    joint_names: {_row(names)}
    {start}
    can: {_bus(new)}
    motor: {_row(new.motors)}
    can_id: {_row(new.ids)}
    direction: {_row([1] * count)}  # MEASURE: 1 or -1, so that a positive angle is that of the URDF
    zero: {_row([0.0] * count)}  # MEASURE: rad, the motor's angle where the joint's angle is 0
    torque_scale: {_row([1.0] * count)}  # MEASURE: real Nm per commanded Nm
    motor_timeout: {_row(timeouts)}  # s, as set in the motors
    position_min: {_row([low for low, _ in edges])}  # rad, {INSIDE:g} inside the URDF's where the arm hangs farther off
    position_max: {_row([high for _, high in edges])}
    max_effort: {_row(efforts)}  # Nm; gravity of the arm alone, upright: up to {_row([round(x, 1) for x in needed])}
    home: {_row(home)}  # rad, where the arm hangs by its URDF

/{new.side}/compensator:
  ros__parameters:
    law: urdf
    urdf: {urdf}
    joint_names: {_row(names)}
    use_imu: false  # true with an IMU on the trunk: docs/imu.md
    max_effort: {_row(efforts)}
    mode: one_g
    wearer: {{links: {_row(worn)}}}  # MEASURE: the links that carry upper arm, and forearm and hand; 0: none
{simulator}"""


def _row(values: Sequence[object]) -> str:
    return f"[{', '.join(map(_plain, values))}]"


def _plain(value: object) -> str:
    """Return the YAML of a value: a text in quotes that ROS would not read as the same text without them."""
    is_text = isinstance(value, str) and not (PLAIN.fullmatch(value) and scalar(value) == value)
    return json.dumps(value, ensure_ascii=False) if is_text else str(value)
