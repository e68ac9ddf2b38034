# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Finding each joint's motor, direction and zero: in virtual time, and once through the command line on a bus."""

import math
import os
import re
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import can
import numpy as np
import pytest
import yaml

from exo_gravity.core.errors import DataError
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.frames import WireFormat
from exo_gravity.core.motors.joint_motor import JointMotor, channels_of
from exo_gravity.hardware.bus_lock import BusLock
from exo_gravity.lab.calibration import motors
from exo_gravity.lab.calibration.motors import BusScan, HandMotion, MotorAnswer, MotorSearch, positive_turns
from exo_gravity.lab.calibration.result import CalibrationResult
from exo_gravity.lab.calibration.tours import Person
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.sim import Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor

from ..support.simulated_device import SPECS
from .conftest import Ended

JOINTS = ("rotation", "abduction", "upper arm", "elbow")  # names of this test's joints
IDS = 31
CYCLE = 0.01  # s, of each poll
HANGING = (0.0,) * 4
UP = [[0.6 * (i == joint) for i in range(4)] for joint in range(4)]  # rad, where the hand moves each joint


def params_of(folder: Path, channel: str = "none", **firmware: object) -> Path:
    """Write a parameter file that knows neither IDs nor directions nor zeros; return its path.

    firmware: what it knows of the motors' firmware.
    """
    bridge = {"joint_names": list(JOINTS), "can": {"interface": "virtual", "channel": channel}, **firmware}
    content = {"/right/can_bridge": bridge, "/right/compensator": {"joint_names": list(JOINTS), "side": "right"}}
    text = yaml.safe_dump({node: {"ros__parameters": values} for node, values in content.items()})
    (folder / "params.yaml").write_text(text, encoding="utf-8")
    return folder / "params.yaml"


class Arm(BusScan):
    """Four motors with any IDs, directions and zeros, moved by a person's hand; each poll takes CYCLE.

    motions: pose (4,) rad to which the hand moves the arm, by the joint that a request names. power_up: rad by which
    each motor is off after the power was switched off and on; None: the person does not switch it. silent: joints
    whose motors do not answer. shaking: rad, of the
    elbow, while the arm should be still. requests, said: what the person was asked and shown.
    """

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.ids = [int(i) for i in rng.choice(np.arange(1, IDS), 4, replace=False)]
        self.directions = [int(d) for d in rng.choice((1, -1), 4)]
        self.zeros = rng.uniform(-3.0, 3.0, 4)
        self.pose = np.zeros(4)
        self.motions = dict(zip(JOINTS, UP, strict=True))
        self.power_up: Iterable[float] | None = None
        self.shaking = 0.0
        self.silent: Collection[int] = ()
        self.board = MIT
        self.problems: tuple[str, ...] = ()
        self.requests: list[str] = []
        self.said: list[object] = []
        self.detour: Iterable[float] | None = None  # rad, where the hand moves the arm once, before all else
        self._now = 0.0

    def scan(self, can_ids: Iterable[int] = ()) -> tuple[tuple[MotorAnswer, ...], tuple[str, ...]]:
        return tuple(sorted(self.poll(self.ids).values())), self.problems

    def poll(self, can_ids: Iterable[int]) -> dict[int, MotorAnswer]:
        self._now += CYCLE
        shaken = self.pose + np.array((0.0, 0.0, 0.0, self.shaking * math.sin(20.0 * self._now)))
        angles = dict(zip(self.ids, self.zeros + np.array(self.directions) * shaken, strict=True))
        answering = [i for joint, i in enumerate(self.ids) if i in can_ids and joint not in self.silent]
        return {i: MotorAnswer(i, i, 8, float(angles[i]), 25, 0, self.board) for i in answering}

    def _move(self, target: Iterable[float], watch: Callable[[], object]) -> None:
        start, end = self.pose, np.array(list(target))
        for share in np.linspace(0.1, 1.0, 10):
            self.pose = start + (end - start) * share
            watch()

    def wait(self, request: str, watch: Callable[[], object]) -> None:
        """Do what `request` says while the program watches; a joint is moved there and back."""
        self.requests.append(request)
        if "switch the motors' power off" in request and self.power_up is not None:
            for self.silent in (range(4), ()):
                for _ in range(20):
                    watch()
            self.zeros = self.zeros + np.array(list(self.power_up))
        elif request.partition(":")[0] in JOINTS:
            if self.detour is not None:
                self._move(self.detour, watch)
                self.detour = None
            self._move(self.motions[request.partition(":")[0]], watch)
            self._move(HANGING, watch)
        else:
            self._move(self.motions.get(request, HANGING), watch)

    def calibrate(self, folder: Path, pose: tuple[float, ...] = HANGING, **firmware: object) -> CalibrationResult:
        arm = configured_arm(params_of(folder, **firmware), "right")
        return MotorSearch([self], arm, self.wait, self.said.append, lambda: self._now).result(pose)


@pytest.fixture
def arm() -> Arm:
    return Arm(6)


def value(result: CalibrationResult, name: str) -> object:
    return next(change.value for change in result.changes if change.name == name)


SEEN = "turn it counter-clockwise, seen from {}".format


@pytest.mark.parametrize(
    ("file", "side", "told"),
    [
        ("exo.yaml", "left", [SEEN("below"), "move the hand to the left", *["move the hand to the front"] * 2]),
        ("exo.yaml", "right", [SEEN("above"), "move the hand to the right", *["move the hand to the front"] * 2]),
        (
            "seven_joints.yaml",
            "right",
            [
                *("move the hand to the front", "move the hand to the right", SEEN("above")),
                *("move the hand to the front", SEEN("above"), "move the hand to the left", "move the hand back"),
            ],
        ),
    ],
)
def test_a_person_is_told_which_way_is_positive(file: str, side: str, told: list[str]) -> None:
    assert list(positive_turns(configured_arm(packaged_config(file), side))) == told


@pytest.mark.parametrize("seed", range(4))
def test_every_id_direction_and_zero_is_found(tmp_path: Path, seed: int) -> None:
    arm = Arm(seed)
    arm.detour = [-0.5, 0.0, 0.0, 0.0]  # both ways at first
    result = arm.calibrate(tmp_path)
    assert result.refusals == () and {change.node for change in result.changes} == {"/right/can_bridge"}
    assert value(result, "can_id") == arm.ids
    assert value(result, "direction") == arm.directions
    assert value(result, "zero") == pytest.approx(arm.zeros, abs=0.001)
    assert "not checked after a power-up" in result.changes[3].note
    assert any("turned both ways: move the joint in one direction only" in str(line) for line in arm.said)


def test_a_jig_gives_the_zero_at_its_own_angles_and_another_position_range_scales_it(arm: Arm, tmp_path: Path) -> None:
    jig = (0.0, 30.0, 0.0, 90.0)
    arm.motions["bring the arm to 0 30 0 90 deg, hands off, until it is still"] = np.radians(jig).tolist()
    result = arm.calibrate(tmp_path, jig)
    assert value(result, "zero") == pytest.approx(arm.zeros, abs=0.001)
    assert "measured at 0 30 0 90 deg" in result.changes[3].note
    result = arm.calibrate(tmp_path, position_range=[12.56, 0.0, 12.5, 0.0])
    assert value(result, "zero") == pytest.approx(arm.zeros * (1.0048, 1.0, 1.0, 1.0), abs=0.001)


@pytest.mark.parametrize(("board", "is_told"), [(MIT, False), (MIT_V3, True)])
def test_a_board_in_servo_mode_cannot_be_told_from_a_v3_board_and_the_person_is_told_so(
    arm: Arm, tmp_path: Path, board: WireFormat, is_told: bool
) -> None:
    arm.board = board
    assert value(arm.calibrate(tmp_path), "wire_format") == [board.name] * 4
    assert (motors.SERVO_MODE in arm.said) is is_told


def moving_elbow(*pose: float) -> dict[str, object]:
    return {"motions": dict(zip(JOINTS, (*UP[:3], pose), strict=True))}


# What is wrong with the arm, how often the person is asked to move the elbow, and what is said.
REFUSED = {
    "a silent motor": (
        {"silent": (3,), "problems": ("ID 3: several replies to one command",)},
        0,
        r"ID 3: several replies to one command; IDs that answer: [\d, ]+\. An arm has 4 mot",
    ),
    "too little": (moving_elbow(0.0, 0.0, 0.0, 0.1), 3, r"elbow: no motor turned .*; motor {3} by 5\."),
    "two": (moving_elbow(0.0, 0.5, 0.0, 0.6), 3, "motors {3} and {1} both turned, by 34 and 29 degrees"),
    "another": (moving_elbow(0.0, 0.6, 0.0, 0.0), 3, "elbow: motor {1} turned, which is that of abduction"),
    "a swing": ({"shaking": 0.05}, 1, "^elbow moved by .* the arm must be still$"),
}


@pytest.mark.parametrize(("wrong", "asked", "sentence"), REFUSED.values(), ids=REFUSED)
def test_an_arm_that_shows_nothing_clear_is_refused_an_unclear_motion_after_three_requests(
    arm: Arm, tmp_path: Path, wrong: dict[str, object], asked: int, sentence: str
) -> None:
    vars(arm).update(wrong)
    with pytest.raises(DataError, match=sentence.format(*arm.ids)):
        arm.calibrate(tmp_path)
    assert sum(request.startswith("elbow") for request in arm.requests) == asked
    assert bool(arm.requests) == bool(asked)


def test_a_zero_that_survives_a_power_up_is_noted_and_one_that_does_not_is_refused(arm: Arm, tmp_path: Path) -> None:
    arm.power_up = np.radians((0.0, 40.0, 0.0, -60.0)).tolist()
    assert [refusal.partition(": store")[0] for refusal in arm.calibrate(tmp_path).refusals] == [
        "abduction: +40 degrees off after the power-up, +1 rotor turns",
        "elbow: -60 degrees off after the power-up, -1 rotor turns",
    ]
    arm.power_up = HANGING
    result = arm.calibrate(tmp_path)
    assert result.refusals == () and result.changes[3].note.endswith("the same after a power-up with the arm hanging")


@contextmanager
def device_on(channel: str, arm: Arm) -> Iterator[SimulatedDevice]:
    """Serve a device with the motors of `arm`, boards of both wire formats, on a virtual bus or on one for each."""
    formats = (MIT_V3, MIT, MIT, MIT_V3)
    specs = [each.ranged(spec) for each, spec in zip(formats, SPECS, strict=True)]
    columns = zip(specs, arm.ids, arm.directions, arm.zeros.tolist(), (1.0,) * 4, formats, strict=True)
    boards = [SimulatedMotor(JointMotor(*column), Firmware(status_rate=400.0)) for column in columns]
    device, stop = SimulatedDevice(SimulatedArm(), boards), threading.Event()
    with ExitStack() as opened:
        names = channels_of(channel, 4)
        buses = {name: opened.enter_context(can.Bus(interface="virtual", channel=name)) for name in set(names)}
        hold = lambda now: device.arm.reset(arm.pose.tolist())  # noqa: E731
        thread = threading.Thread(target=device.run, args=([buses[name] for name in names], stop.is_set, hold))
        thread.start()
        yield device
        stop.set()
        thread.join()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("given", "found"),
    [("near", "near"), ("near,far,far,far", "far,near,near,far")],
    ids=["one bus", "two buses"],
)
def test_the_command_line_describes_the_device_in_the_new_file_or_says_why_not(
    tmp_path: Path, run_tool: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch, given: str, found: str
) -> None:
    monkeypatch.setattr(BusScan.scan, "__defaults__", (range(1, IDS),))  # test_bus_scan.py scans all
    monkeypatch.setattr(motors, "HAND", HandMotion(silence=10.0))  # the computer may be busy
    arm, output = Arm(15), tmp_path / "new.yaml"
    monkeypatch.setattr(Person, "wait", lambda person, request, watch: arm.wait(request, watch))
    # The lock of a bus holds on the whole computer.
    given, found = (re.sub(r"\w+", lambda name: f"{name[0]}-{os.getpid()}", channels) for channels in (given, found))
    words = ("calibrate", "motors", "--params", params_of(tmp_path, given), "--output", output)
    with device_on(found, arm) as device:
        device.bus_silent = True
        silent = run_tool(*words)
        assert silent.code == 1 and not output.exists() and not output.with_suffix(".html").exists()
        assert "calibrate: not calibrated: IDs that answer: none." in silent.err
        lock = BusLock(("virtual", channels_of(given, 4)[0], {}), "/right/can_bridge (PID 4711)")
        held = run_tool(*words)
        assert held.code == 1 and "held by /right/can_bridge (PID 4711)" in held.err
        lock.release()
        device.bus_silent = False
        ended = run_tool(*words)
        assert ended.code == 0 and not device.powered
    new = configured_arm(output, "right")
    assert new.can_bridge["can.channel"] == found
    assert [motor.can_id for motor in new.motors] == arm.ids
    assert [motor.direction for motor in new.motors] == arm.directions
    assert [motor.zero for motor in new.motors] == pytest.approx(arm.zeros, abs=0.003)
    assert [motor.wire_format.name for motor in new.motors] == ["mit_v3", "mit", "mit", "mit_v3"]
    assert "measured hanging" in output.read_text(encoding="utf-8")
    assert "Calibrated." in output.with_suffix(".html").read_text(encoding="utf-8")
    assert f"elbow: motor {arm.ids[3]}, direction" in ended.out
    assert f"on {' and '.join(dict.fromkeys(given.split(',')))}" in ended.out
