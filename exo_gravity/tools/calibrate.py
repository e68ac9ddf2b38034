# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrate COMMAND --params FILE --output NEW.yaml: finds what differs between an arm and its parameter file.

`calibrate new` writes the first file of an arm from its URDF, its motors and their IDs.

The new file is the old one with new values, their uncertainty and the date. Beside it are a page (NEW.html) and
what was measured (NEW.jsonl). No existing file is ever overwritten.

Exit code 0: calibrated. 1: not calibrated, and why. 2: wrong use or wrong file.
"""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

# Before NumPy is imported, here and in the nodes of a tour: its threads gain nothing on matrices this small, and would
# wait for each other on the cores that carry the arm.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from exo_gravity import require_ros
from exo_gravity.core.arm.tilt import SIDES
from exo_gravity.core.errors import ExoGravityError, ParameterError
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.tools.cli import extras

if TYPE_CHECKING:
    from exo_gravity.lab.calibration.result import CalibrationResult

ACCEPTANCE, NEW = "acceptance", "new"
# Module in lab/calibration, and what the command finds.
COMMANDS = {
    "motors": ("motors", "each joint's motor, direction and zero, found by moving the joints by hand"),
    "gravity": ("tours", "the robot's first moments, from a slow tour of poses"),
    "friction": ("tours", "friction of each joint, from slow sweeps"),
    "scale": ("tours", "torque scale of each motor, from a known weight on the last link"),
    "wearer": ("tours", "the moments of the wearer's relaxed arm"),
    "check": ("tours", "whether a few poses still need the torque of the last calibration"),
    "imu": ("imu", "the mounting of the IMU, from standing upright and bowing"),
    ACCEPTANCE: ("", "a record (JSON) of what the first real, unworn arm shows on the bench, step by step"),
    NEW: ("", "the first parameter file of an arm, from its URDF, its motors and their CAN IDs"),
}


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="calibrate", description="Find what differs between an arm and its file.")
    parser.set_defaults(bag=None, rests=None, earlier=None, axes=None, zeros=None)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (_, description) in COMMANDS.items():
        command = commands.add_parser(name, help=description, description=f"calibrate {name}: {description}.")
        option = command.add_argument
        option("--output", required=True, type=Path, metavar="NEW.yaml", help="new file to write")
        if name != NEW:
            option("--params", required=True, type=Path, metavar="FILE", help="ROS 2 parameter file of the device")
        if name != "imu":
            option("--side", choices=SIDES, default="right", help="which arm (default: %(default)s)")
        if name in (ACCEPTANCE, "scale"):
            option("--mass", type=float, required=True, metavar="KG", help="of the weight")
            option("--lever", type=float, required=True, metavar="M", help="from the last joint to the weight")
        if name == "motors":
            option(
                "--pose", type=float, nargs="+", default=(), metavar="DEG",
                help="joint angles at which zero is measured, if the arm is in a jig (default: home, it hangs)",
            )  # fmt: skip
        elif name not in (ACCEPTANCE, NEW):
            option("--bag", type=Path, metavar="FOLDER", help="use this recording instead of the device")
        if name == "imu":
            option("--rests", type=Path, metavar="FOLDER", help="recording of the IMU resting on each of its six sides")
        if name == "gravity":
            option("--poses", type=int, default=12, metavar="N", help="largest number of poses (%(default)s)")
        if name == "wearer":
            option(
                "--carried", type=float, metavar="SHARE",
                help="share of their arm that the wearer may have held throughout (0.2); 0 where EMG was silent",
            )  # fmt: skip
        if name in ("gravity", "scale"):
            option(
                "--earlier", type=Path, metavar="TOUR.jsonl",
                help="record of an earlier tour of this arm by the same file, its motors colder or warmer: "
                "shows how torque_scale depends on the temperature",
            )  # fmt: skip
            option(
                "--zeros", type=float, metavar="DEG",
                help="assumed standard error of the encoders' zeros (0.86); 0 keeps those of a jig",
            )  # fmt: skip
            option(
                "--axes", type=float, metavar="DEG",
                help="assumed standard error of each joint's axis in each direction across it, by CAD or "
                "brackets (0.61); of an arm from a URDF",
            )  # fmt: skip
    option = commands.choices[NEW].add_argument
    option("--urdf", required=True, metavar="FILE", help="description of the arm, or package://NAME/PATH")
    option("--motors", required=True, nargs="+", metavar="TYPE", help="of each joint, as AK80-64")
    option("--ids", required=True, nargs="+", type=int, metavar="ID", help="CAN ID of each motor")
    option("--joints", nargs="+", default=(), metavar="NAME", help="in this order (default: all turning ones)")
    option("--hand", default="", metavar="LINK", help="link of the URDF that holds a load")
    option("--channel", default="can0", metavar="BUS", help="SocketCAN interface (default: %(default)s)")
    option("--fd", action="store_true", help="the bus is CAN FD")
    option("--simulate", action="store_true", help="with a simulated device, on a simulated bus: to try it")
    return parser.parse_args(args)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    options = _arguments(args)
    try:
        with extras("calibrate", "report"):
            return _run(options)
    except KeyboardInterrupt:
        print("calibrate: stopped; nothing was written", file=sys.stderr)
        return 1
    except ParameterError as error:
        print(f"calibrate: {error}", file=sys.stderr)
        return 2
    except (ExoGravityError, OSError) as error:
        print(f"calibrate: not calibrated: {error}", file=sys.stderr)
        return 1


def _run(options: argparse.Namespace) -> int:
    from exo_gravity.lab.calibration.imu import with_mounting
    from exo_gravity.lab.calibration.result import check_output, page_of, write_changes
    from exo_gravity.lab.calibration.tours import Person

    command: str = options.command
    check_output(options.output)
    if command == NEW:
        from exo_gravity.lab.calibration.new import write_new

        notes = write_new(options)
        print(*notes, f"Written: {options.output}; MEASURE in it marks what is still to be measured", sep="\n")
        return 0
    if command == ACCEPTANCE:
        from exo_gravity.lab.acceptance import Weight, accept_arm

        bench = configured_arm(options.params, options.side), Weight(options.mass, options.lever), Person()
        return 0 if accept_arm(options.params, options.output, *bench) else 1
    options.record, page = options.output.with_suffix(".jsonl"), options.output.with_suffix(".html")
    for path in (options.record, page):
        check_output(path)
    for path in (options.bag, options.rests, options.earlier):
        if path is not None and not path.exists():
            raise ParameterError("bag", str(path), "a recording that exists")
    person = Person()
    options.wait = person.wait
    arm = None if command == "imu" else configured_arm(options.params, options.side)
    if options.bag is None and command != "motors":
        require_ros("calibrate")
    module = import_module(f"exo_gravity.lab.calibration.{COMMANDS[command][0]}")
    calibrate: Callable[..., CalibrationResult] = getattr(module, f"calibrate_{command}")
    result = with_mounting(calibrate(options, arm, person.say), options.params)
    for line in (*(change.text for change in result.changes), *result.lines):
        person.say(line)
    if result.changes and not result.refusals:
        write_changes(options.params, options.output, result.changes, f"calibrate {command}")
        person.say(f"Written: {options.output}, to use in place of {options.params}")
    if not result.refusals or result.observations:
        page.write_text(page_of(result, command, str(options.params)), encoding="utf-8")
        person.say(f"Written: {page}")
    for refusal in result.refusals:
        print(f"calibrate: not calibrated: {refusal}", file=sys.stderr)
    return 1 if result.refusals else 0
