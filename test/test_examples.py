"""The programs in examples/ run, and the physics of what they print is right."""

from __future__ import annotations

import json
import re
import runpy
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32MultiArray

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.wearer import Wearer

from .support import ROOT

LENGTH, COG, MASS = (0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203)
ROUNDING = 0.006  # Nm


def run(name: str, capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], str]:
    """Return the variables of an example and what it printed; its plot must have been drawn."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        plot = Path(folder, "plot.svg")
        patch.setattr(sys, "argv", [name, str(plot)])
        variables = runpy.run_path(str(ROOT / "examples" / name))
        assert plot.read_text(encoding="utf-8").count("<path") > 10
    return variables, capsys.readouterr().out


def potential_energy(theta: np.ndarray, arm: ArmModel, down: np.ndarray) -> float:
    """Return the potential energy in J, by the standard Denavit-Hartenberg frames of the paper's Table 1.

    down: unit vector of gravity in the base frame.
    """
    rotation, origin, energy = np.eye(3), np.zeros(3), 0.0
    offset, twist = (0.0, -np.pi / 2, 0.0, 0.0), (-np.pi / 2, np.pi / 2, 0.0, 0.0)
    for joint in range(4):
        angle, alpha = theta[joint] + offset[joint], twist[joint]
        link = np.array((np.cos(angle), np.sin(angle), 0.0))
        x, z = (
            rotation @ link,
            rotation @ np.array((np.sin(angle) * np.sin(alpha), -np.cos(angle) * np.sin(alpha), np.cos(alpha))),
        )
        energy -= arm.mass[joint] * arm.gravity * float(down @ (origin + arm.cog[joint] * x))
        origin = origin + arm.length[joint] * x
        rotation = np.column_stack((x, np.cross(z, x), z))
    return energy


def holding_torque(theta: np.ndarray, arm: ArmModel, down: np.ndarray) -> np.ndarray:
    """Return the derivative of the potential energy by each joint angle, (4,) Nm."""
    step = 1e-5
    steps = np.eye(4) * step
    return np.array(
        [(potential_energy(theta + d, arm, down) - potential_energy(theta - d, arm, down)) / (2 * step) for d in steps]
    )


def test_one_pose_prints_the_torques_that_the_potential_energy_gives(capsys):
    _, output = run("one_pose.py", capsys)
    rows = {line[:28].strip(): np.array(line[28:].split(), dtype=float) for line in output.splitlines()[1:]}
    robot = ArmModel(LENGTH, COG, MASS)
    wearer = Wearer(body_mass=75.0).on_links(LENGTH)
    arms = {"One-G": robot, "Zero-G": robot.with_wearer(*wearer)}
    pitch = np.radians(20.0)
    # Base axes of the right arm: x0 to the right, y0 forward, z0 down. A bow turns gravity forward.
    directions = {
        "upright": np.array((0.0, 0.0, 1.0)),
        "bowed by 20 degrees": np.array((0.0, np.sin(pitch), np.cos(pitch))),
    }
    assert list(rows) == [f"{mode}, {posture}" for mode in arms for posture in directions]
    for mode, arm in arms.items():
        for posture, down in directions.items():
            expected = holding_torque(np.radians((0.0, 30.0, 40.0, 30.0)), arm, down)
            np.testing.assert_allclose(rows[f"{mode}, {posture}"], expected, atol=ROUNDING)


def moved(output: str) -> float:
    """Return the movement in degrees that simulated_loop.py printed."""
    match = re.fullmatch(r"After 10 s each joint is within ([0-9.]+) degrees of where it was\.\n", output)
    assert match
    return float(match[1])


def test_the_simulated_loop_holds_the_arm(capsys):
    variables, output = run("simulated_loop.py", capsys)
    assert moved(output) < 0.2
    assert moved(output) == pytest.approx(
        np.degrees(np.abs(np.subtract(variables["device"].arm.positions, (0.3, 0.8, 0.7, 0.6)))).max(), abs=0.005
    )
    assert not any(motor.entered for motor in variables["device"].motors)


def test_without_torque_the_same_simulated_arm_falls(capsys, monkeypatch):
    monkeypatch.setattr("exo_gravity.core.gravity_torque", lambda arm, theta: [0.0] * 4)
    _, output = run("simulated_loop.py", capsys)
    assert moved(output) > 20.0


def test_the_simulated_arm_repeats_the_way_that_a_hand_taught_it(capsys):
    variables, output = run("teach_and_repeat.py", capsys)
    match = re.fullmatch(r"The arm repeats the way within ([0-9.]+) degrees, on average ([0-9.]+)\.\n", output)
    assert match and float(match[1]) < 15.0 and float(match[2]) < 6.0
    taught, repeated = np.degrees(variables["poses"]), np.degrees(variables["repeated"])
    assert np.ptp(taught, axis=0).min() > 15.0  # there was a way to repeat
    assert np.abs(repeated[-1] - taught[-1]).max() < 6.0


@pytest.mark.thorough
@pytest.mark.timeout(600)
def test_the_notebook_leads_to_drift_effort_and_the_share_that_was_set():
    cells = json.loads((ROOT / "examples" / "recording_to_figures.ipynb").read_text(encoding="utf-8"))["cells"]
    cells = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert all(cell["outputs"] for cell in cells[1:])
    lines = [line for cell in cells for line in "".join(cell["source"]).split("\n") if not line.startswith("%")]
    variables: dict[str, Any] = {}
    exec("\n".join(lines), variables)
    assert len(variables["share"]) == 2
    np.testing.assert_allclose(variables["share"]["measured"], 0.15, atol=0.02)
    assert np.abs(variables["drift"].to_numpy()[:, :4]).max() < 0.2
    # By another way than the law: the torque that holds the robot and 15 % of the wearer's arm in each pose.
    robot, load = ArmModel(LENGTH, COG, MASS), Wearer(body_mass=75.0).on_links(LENGTH)
    whole = robot.with_wearer(*load, 0.15)
    for row, hold in zip(variables["effort"].to_numpy(), variables["analysis"].holds, strict=True):
        torque = np.abs(holding_torque(hold.pose, whole, np.array((0.0, 0.0, 1.0))))
        np.testing.assert_allclose(row / 100.0 * (3.0, 9.0, 3.0, 3.0), torque, atol=0.05)


class EmgRig:
    """The node of emg_assistance.py, and one that publishes a synthetic EMG and hears the efforts for the elbow."""

    def __init__(self) -> None:
        rclpy.init()
        self.example = runpy.run_path(str(ROOT / "examples" / "emg_assistance.py"))
        self.node = self.example["EmgAssistance"]()
        self.user = rclpy.create_node("emg_driver")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.executor.add_node(self.user)
        self.elbow: list[float] = []
        self.user.create_subscription(JointState, "/right/assist_efforts", self._on_efforts, 10)
        self._publisher = self.user.create_publisher(Float32MultiArray, "/emg", 10)
        self._rng = np.random.default_rng(1)

    def _on_efforts(self, message: JointState) -> None:
        assert message.name[3] == "right_elbow_flexion" and not any(message.effort[:3])
        self.elbow.append(message.effort[3])

    def contract(self, biceps: float, triceps: float, seconds: float = 1.0) -> float:
        """Send EMG whose rectified means are given in mV, on an electrode offset; return the elbow's last effort."""
        deviation = np.array((biceps, triceps)) * 1e-3 * np.sqrt(np.pi / 2.0)
        for _ in range(round(seconds / 0.01)):
            volts = 1e-3 + self._rng.normal(size=(10, 2)) * deviation
            self._publisher.publish(Float32MultiArray(data=volts.ravel().tolist()))
            self.wait(0.01)
        return self.elbow[-1]

    def wait(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self.executor.spin_once(timeout_sec=left)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.user.destroy_node()
        rclpy.try_shutdown()


@pytest.fixture
def emg():
    rig = EmgRig()
    yield rig
    rig.close()


@pytest.mark.thorough
def test_the_elbow_is_assisted_in_proportion_to_the_biceps_and_against_the_triceps(emg):
    emg.contract(0.01, 0.01, 2.0)  # the offset of the electrodes is removed
    assert emg.contract(0.01, 0.01) == 0.0
    assert emg.contract(0.21, 0.01, 1.5) == pytest.approx(1.0, abs=0.25)
    assert emg.contract(0.9, 0.01, 1.5) == 2.0
    assert emg.contract(0.01, 0.21, 2.0) == pytest.approx(-1.0, abs=0.25)
    emg.wait(0.2)
    heard = len(emg.elbow)
    emg.wait(0.2)
    assert len(emg.elbow) == heard  # without a signal nothing is sent


@pytest.mark.thorough
def test_the_pretended_emg_bends_and_stretches_the_elbow_in_turn(emg):
    emg.example["pretend"](emg.node)
    for reached in (lambda effort: effort > 1.0, lambda effort: effort < -1.0):
        end = time.monotonic() + 30.0
        while not any(map(reached, emg.elbow)):
            assert time.monotonic() < end
            emg.wait(0.1)


def test_the_emg_example_says_what_it_waits_for(emg, capfd):
    emg.node.report()
    assert "waiting for /emg (std_msgs/Float32MultiArray" in capfd.readouterr().err
    emg.node.publisher = emg.node.create_publisher(JointState, "/right/nobody_listens", 1)
    emg.node.heard = emg.node.get_clock().now() + Duration(seconds=600)  # on a busy computer too, not long ago
    emg.node.report()
    assert "no compensator subscribes to /right/assist_efforts" in capfd.readouterr().err
