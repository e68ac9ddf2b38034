"""Finding each joint's motor, direction and zero, on the simulated device with a hand that moves its arm."""

from __future__ import annotations

import argparse
import itertools
import math
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import can
import numpy as np
import pytest
import yaml
from rich.console import Console

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.wire_formats import MIT, MIT_V3, WireFormat
from exo_gravity.hardware.can.bus_scan import BusScan
from exo_gravity.hardware.ownership.bus_lock import BusLock
from exo_gravity.sim import Firmware, SimulatedArm, SimulatedDevice, simulated_motor
from exo_gravity.tools.calibrate import main
from exo_gravity.tools.calibration.live import Person
from exo_gravity.tools.calibration.motors import calibrate_motors
from exo_gravity.tools.calibration.result import CalibrationResult
from exo_gravity.tools.inputs.arms import configured_arm

from ..support.simulated_device import SPECS, frame

CHANNELS = itertools.count()
IDS = 31  # scanned here; test_bus_scan.py scans all
JOINTS = ("rotation", "abduction", "upper arm", "elbow")  # names of this test's joints
Watch = Callable[[], object]


class Bench:
    """A simulated device on a bus of its own, and a person's hand on its arm.

    ids, directions, zeros: true ones, which the parameter file does not know. motions: pose (4,) rad to which the hand
    moves the arm, by the word that begins the request. requests: what the person was asked.
    """

    def __init__(
        self,
        folder: Path,
        seed: int,
        firmware: Firmware | None = None,
        formats: Sequence[WireFormat] = (MIT,) * 4,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.ids = [int(i) for i in rng.choice(np.arange(1, IDS), 4, replace=False)]
        self.directions = [int(d) for d in rng.choice((1, -1), 4)]
        self.zeros = [float(z) for z in rng.uniform(-3.0, 3.0, 4)]
        specs = [each.ranged(spec) for each, spec in zip(formats, SPECS, strict=True)]
        columns = zip(specs, self.ids, self.directions, self.zeros, (1.0,) * 4, formats, strict=True)
        motors = [simulated_motor(JointMotor(*column), firmware) for column in columns]
        self.device = SimulatedDevice(SimulatedArm(), motors)
        self.pose = [0.0] * 4
        self.swing = 0.0  # rad, of the elbow, while the arm should be still
        self.motions = {name: [0.6 * (i == joint) for i in range(4)] for joint, name in enumerate(JOINTS)}
        self.requests: list[str] = []
        self.said: list[str] = []
        self.during: Callable[[str, int], None] = lambda request, step: None
        self.channel = f"motors-{os.getpid()}-{next(CHANNELS)}"
        self.params = folder / "params.yaml"
        bridge = {"joint_names": list(JOINTS), "can": {"interface": "virtual", "channel": self.channel}}
        compensator = {"joint_names": list(JOINTS), "side": "right"}
        content = {"/right/can_bridge": bridge, "/right/compensator": compensator}
        text = yaml.safe_dump({node: {"ros__parameters": values} for node, values in content.items()})
        self.params.write_text(text, encoding="utf-8")
        self._stop = threading.Event()
        self._bus = can.Bus(interface="virtual", channel=self.channel)
        self._thread = threading.Thread(target=self.device.run, args=(self._bus, self._stop.is_set, self._hold))
        self._thread.start()

    def _hold(self, now: float) -> None:
        swing = self.swing * math.sin(20.0 * now) if self.requests and "hands off" in self.requests[-1] else 0.0
        self.device.arm.reset([*self.pose[:3], self.pose[3] + swing])

    def wait(self, request: str, watch: Watch) -> None:
        """Do what `request` says, in steps, while the program watches; a joint is moved there and back."""
        self.requests.append(request)
        word = request.partition(":")[0]
        start, target = np.array(self.pose), np.array(self.motions.get(word, [0.0] * 4))
        shares = [*range(1, 11), *(range(9, -1, -1) if word in JOINTS else ())]
        for step, share in enumerate(shares, 1):
            self.pose = (start + (target - start) * share / 10).tolist()
            self.during(request, step)
            watch()

    def calibrate(self, pose: tuple[float, ...] = (0.0,) * 4) -> CalibrationResult:
        console = Console(width=120, record=True, file=open(os.devnull, "w"))  # noqa: SIM115
        arm = configured_arm(self.params, "right")
        options = argparse.Namespace(params=self.params, wait=self.wait, pose=pose)
        outcome = calibrate_motors(options, arm, console.print)
        self.said = console.export_text().splitlines()
        return outcome

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._bus.shutdown()


@pytest.fixture
def make_bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Bench]]:
    """A function that makes benches."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(BusScan.scan, "__defaults__", (range(1, IDS),))
    benches: list[Bench] = []

    def make_bench(seed: int = 0, firmware: Firmware | None = None, *formats: WireFormat) -> Bench:
        benches.append(Bench(tmp_path, seed, firmware, formats or (MIT,) * 4))
        return benches[-1]

    yield make_bench
    for bench in benches:
        bench.close()


@pytest.mark.parametrize(
    ("seed", "firmware"), [(0, Firmware()), (1, Firmware(reply_length=6)), (2, Firmware(True)), (3, Firmware(True, 6))]
)
def test_every_id_direction_and_zero_is_found(make_bench: Callable[..., Bench], seed: int, firmware: Firmware) -> None:
    bench = make_bench(seed, firmware)
    outcome = bench.calibrate()
    values = {change.name: change.value for change in outcome.changes}
    assert outcome.refusals == ()
    assert {change.node for change in outcome.changes} == {"/right/can_bridge"}
    assert values["can_id"] == bench.ids
    assert values["direction"] == bench.directions
    assert values["zero"] == pytest.approx(bench.zeros, abs=0.002)
    assert not bench.device.powered
    shown = [line.split()[1] for line in bench.said if f"{firmware.reply_length} bytes" in line]
    assert shown == sorted(map(str, bench.ids), key=int)


def test_motors_of_both_wire_formats_are_calibrated_on_one_bus(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(15, Firmware(status_rate=100.0), MIT_V3, MIT, MIT, MIT_V3)
    outcome = bench.calibrate()
    values = {change.name: change.value for change in outcome.changes}
    assert outcome.refusals == ()
    assert values["can_id"] == bench.ids and values["direction"] == bench.directions
    assert values["wire_format"] == ["mit_v3", "mit", "mit", "mit_v3"]
    assert values["zero"] == pytest.approx(bench.zeros, abs=0.003)
    assert not bench.device.powered


def test_a_jig_gives_the_zero_at_its_own_angles(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(4)
    jig = (0.0, 30.0, 0.0, 90.0)
    bench.motions["bring the arm to 0 30 0 90 deg, hands off, until it is still"] = [math.radians(a) for a in jig]
    outcome = bench.calibrate(jig)
    assert next(c.value for c in outcome.changes if c.name == "zero") == pytest.approx(bench.zeros, abs=0.002)
    assert "measured at 0 30 0 90 deg" in outcome.changes[3].note


def test_a_motor_that_does_not_answer_is_told_and_nothing_is_asked(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(5)
    bench.device.motors[3].unplugged = True
    outcome = bench.calibrate()
    others = ", ".join(map(str, sorted(bench.ids[:3])))
    assert outcome.refusals[0].startswith(f"IDs that answer: {others}. An arm has 4 motors: check power")
    assert outcome.changes == () and bench.requests == []


@pytest.mark.parametrize(
    ("motion", "sentence"),
    [
        ([0.0, 0.0, 0.0, 0.1], "elbow: no motor turned by 10 degrees; motor {ids[3]} by 5."),
        ([0.0, 0.5, 0.0, 0.6], "elbow: motors {ids[3]} and {ids[1]} both turned, by 34 and 29 degrees"),
        ([0.0, 0.6, 0.0, 0.0], "elbow: motor {ids[1]} turned, which is that of abduction"),
    ],
)
def test_an_unclear_motion_is_asked_for_again_and_then_refused(
    make_bench: Callable[..., Bench], motion: list[float], sentence: str
) -> None:
    bench = make_bench(6)
    bench.motions["elbow"] = motion
    (refusal,) = bench.calibrate().refusals
    assert refusal.startswith(sentence.format(ids=bench.ids))
    assert sum(request.startswith("elbow") for request in bench.requests) == 3


def test_a_joint_moved_both_ways_is_asked_for_again(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(7)

    def swing(request: str, step: int) -> None:
        if request.startswith("rotation") and len(bench.requests) == 1:
            bench.pose = [0.6 * math.sin(2.0 * math.pi * step / 19), 0.0, 0.0, 0.0]

    bench.during = swing
    outcome = bench.calibrate()
    assert any("turned both ways: move the joint in one direction only" in line for line in bench.said)
    assert outcome.changes[2].value == bench.directions


def test_an_arm_that_swings_gives_no_zero(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(8)
    bench.swing = 0.3
    (refusal,) = bench.calibrate().refusals
    assert refusal.startswith("elbow moved by") and refusal.endswith("the arm must be still")


def test_a_zero_that_does_not_survive_a_power_up_is_refused(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(9)

    def switch(request: str, step: int) -> None:
        if "switch the motors' power off" not in request:
            return
        for motor in bench.device.motors:
            motor.unplugged = 2 <= step < 6
        if step == 6:
            bench.device.encoder_error = (0.0, math.radians(40.0), 0.0, math.radians(-60.0))

    bench.during = switch
    outcome = bench.calibrate()
    turns = [direction * sign for direction, sign in zip(bench.directions[1::2], (1, -1), strict=True)]
    assert [refusal.partition(": call")[0] for refusal in outcome.refusals] == [
        f"abduction: {40 * turns[0]:+d} degrees off after the power-up, {turns[0]:+d} rotor turns",
        f"elbow: {60 * turns[1]:+d} degrees off after the power-up, {turns[1]:+d} rotor turns",
    ]


def test_a_zero_that_survives_a_power_up_is_noted(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(10)

    def switch(request: str, step: int) -> None:
        for motor in bench.device.motors:
            motor.unplugged = "switch the motors' power off" in request and 2 <= step < 6

    bench.during = switch
    outcome = bench.calibrate()
    assert outcome.refusals == ()
    assert outcome.changes[3].note.endswith("the same after a power-up with the arm hanging")


def test_a_bus_that_a_bridge_holds_is_refused(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(11)
    lock = BusLock(("virtual", bench.channel, {}), "/right/can_bridge (PID 4711)")
    with pytest.raises(BusError, match="held by /right/can_bridge"):
        bench.calibrate()
    lock.release()


def test_two_motors_with_one_id_are_refused(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(12)
    with can.Bus(interface="virtual", channel=bench.channel) as bus:
        shared = bench.ids[2]

        def answer(message: can.Message) -> None:
            if message.arbitration_id == shared and message.data[0] != shared:
                bus.send(frame(0, bytes((shared, 0x90, 0, 0x80, 8, 0))))

        notifier = can.Notifier(bus, [answer], timeout=0.01)
        outcome = bench.calibrate()
        notifier.stop()
    assert any(refusal.startswith(f"ID {shared}: several replies") for refusal in outcome.refusals)


def command_line(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> tuple[int, Path]:
    """Run `calibrate motors`, the person being the bench's; return the exit code and the path of the new file."""
    monkeypatch.setattr(Person, "wait", lambda person, request, watch: bench.wait(request, watch))
    output = bench.params.with_name("new.yaml")
    return main(["motors", "--params", str(bench.params), "--output", str(output)]), output


def test_the_command_line_writes_a_file_that_describes_the_device(
    make_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = make_bench(13)
    code, output = command_line(bench, monkeypatch)
    assert code == 0
    motors = configured_arm(output, "right").motors
    assert [motor.can_id for motor in motors] == bench.ids
    assert [motor.direction for motor in motors] == bench.directions
    assert [motor.zero for motor in motors] == pytest.approx(bench.zeros, abs=0.002)
    assert "measured hanging" in output.read_text(encoding="utf-8")
    assert "Calibrated." in output.with_suffix(".html").read_text(encoding="utf-8")
    assert f"elbow: motor {bench.ids[3]}, direction" in capsys.readouterr().out


def test_the_command_line_says_why_it_did_not_calibrate(
    make_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = make_bench(14)
    bench.device.bus_silent = True
    code, output = command_line(bench, monkeypatch)
    assert (code, output.exists(), output.with_suffix(".html").exists()) == (1, False, False)
    assert "calibrate: not calibrated: IDs that answer: none." in capsys.readouterr().err
    lock = BusLock(("virtual", bench.channel, {}), "/right/can_bridge (PID 4711)")
    assert command_line(bench, monkeypatch)[0] == 1
    assert "held by /right/can_bridge (PID 4711)" in capsys.readouterr().err
    lock.release()
