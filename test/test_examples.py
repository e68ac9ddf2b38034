# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The programs in examples/ run, and the physics of what they print is right."""

import json
import re
import runpy
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from sensor_msgs.msg import JointState

from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.lab.inputs.arms import read_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.lab.inputs.references import pinocchio

from .support import ROBOT, ROOT
from .support.node_thread import NodeThread
from .support.waiting import wait_until

LOAD = Wearer(body_mass=75.0).on_links(ROBOT.length)
ROUNDING = 0.006  # Nm


def run(name: str, capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], str]:
    """Return the variables of an example and what it printed; its plot must have been drawn."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        plot = Path(folder, "plot.svg")
        patch.setattr(sys, "argv", [name, str(plot)])
        variables = runpy.run_path(f"{ROOT}/examples/{name}")
        assert plot.read_text(encoding="utf-8").count("<path") > 10
    return variables, capsys.readouterr().out


def test_one_pose_prints_the_torques_of_pinocchio(capsys):
    _, output = run("one_pose.py", capsys)
    rows = {line[:28].strip(): np.array(line[28:].split(), dtype=float) for line in output.splitlines()[1:]}
    arms = {"One-G": ROBOT, "Zero-G": ROBOT.with_wearer(*LOAD)}
    pitch = np.radians(20.0)
    # Base axes of the right arm: x0 to the right, y0 forward, z0 down. A bow turns gravity forward.
    directions = {"upright": (0.0, 0.0, 1.0), "bowed by 20 degrees": (0.0, np.sin(pitch), np.cos(pitch))}
    assert list(rows) == [f"{mode}, {posture}" for mode in arms for posture in directions]
    for mode, arm in arms.items():
        for posture, down in directions.items():
            expected = pinocchio(arm)(np.radians([(0.0, 30.0, 40.0, 30.0)]), np.array([down]))
            np.testing.assert_allclose(rows[f"{mode}, {posture}"], expected[0], atol=ROUNDING)


def test_the_simulated_loop_holds_the_arm(capsys):
    variables, output = run("simulated_loop.py", capsys)
    match = re.fullmatch(r"After 10 s each joint is within ([0-9.]+) degrees of where it was\.\n", output)
    moved = np.degrees(np.abs(np.subtract(variables["device"].arm.positions, (0.3, 0.8, 0.7, 0.6)))).max()
    assert match and float(match[1]) == pytest.approx(moved, abs=0.005) and moved < 0.2
    assert not any(motor.entered for motor in variables["device"].motors)


@pytest.mark.thorough
def test_the_simulated_arm_repeats_the_path_that_a_hand_taught_it(capsys):
    variables, output = run("teach_and_repeat.py", capsys)
    match = re.fullmatch(r"The arm repeats the path within ([0-9.]+) degrees, on average ([0-9.]+)\.\n", output)
    assert match and float(match[1]) < 15.0 and float(match[2]) < 6.0
    assert np.ptp(np.degrees(variables["poses"]), axis=0).min() > 15.0  # there was a path to repeat


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
    torque = pinocchio(ROBOT.with_wearer(*LOAD, 0.15))
    for row, hold in zip(variables["effort"].to_numpy(), variables["analysis"].holds, strict=True):
        expected = np.abs(torque(np.array([hold.pose]), np.array([(0.0, 0.0, 1.0)]))[0])
        np.testing.assert_allclose(row / 100.0 * (3.0, 9.0, 3.0, 3.0), expected, atol=0.05)


@pytest.mark.thorough
def test_the_cascade_takes_work_off_a_wearer_who_reaches_and_lets_the_arm_go_where_they_lead_it():
    variables = runpy.run_path(f"{ROOT}/examples/admittance.py")
    (_, led, alone), (_, poses, assisted) = (map(np.array, variables["reach"](is_on)) for is_on in (False, True))
    assert variables["effort_of"](assisted) < 0.8 * variables["effort_of"](alone)
    steps = min(len(poses), len(led))
    assert np.degrees(np.abs(poses[:steps] - led[:steps])).max() < 10.0


def test_the_cascade_follows_what_is_surely_the_wearers_within_its_bounds_and_damps_what_moves_by_itself():
    variables, still = runpy.run_path(f"{ROOT}/examples/admittance.py"), [0.0] * 4
    robot, worn = ROBOT.links, ROBOT.worn_links(*LOAD)

    def after(seconds: float, velocity: list[float], wearer: list[float], deviation: float) -> np.ndarray:
        loop = variables["Admittance"](robot, worn)
        for _ in range(round(seconds / variables["PERIOD"])):
            efforts = loop.step([0.3] * 4, velocity, wearer, [deviation] * 4)
        return np.array(efforts)

    push = [1.0, -1.0, 1.0, -1.0]
    assert not after(1.0, still, push, deviation=0.6).any()  # perhaps an error of the model
    assert np.all(after(0.02, still, push, deviation=0.0) * push > 0.5)
    assert np.all(after(0.5, push, still, deviation=0.0) * push < 0.0)
    assert after(9.0, still, [99.0, -99.0, 99.0, 99.0], deviation=0.0).tolist() == [1.0, -2.0, 1.0, 1.0]  # as a spring


@pytest.fixture
def around():
    """A node that plays what is around an example's node, and the efforts that it heard."""
    rclpy.init()  # for the example
    thread, heard = NodeThread("environment", namespace="/right"), list[JointState]()
    thread.nodes[0].create_subscription(JointState, "assist_efforts", heard.append, 10)
    thread.start()
    yield thread.nodes[0], heard
    thread.close()
    rclpy.shutdown()


def assert_silent(heard: list[JointState], spin: Callable[[], object]) -> None:
    """Assert that no efforts come any more, but for those on their way."""
    for seconds in (0.5, 0.3):
        count, end = len(heard), time.monotonic() + seconds
        wait_until(lambda end=end: time.monotonic() > end, spin)
    assert len(heard) == count


@pytest.mark.thorough
def test_the_cascade_node_assists_an_arm_of_three_joints_only_while_the_wearers_torque_is_known(around):
    carried = read_arm(load(packaged_config("three_joints.yaml")), "/right")
    names = carried.limits.joint_names
    parts = {
        "joint_states": JointState(name=names[::-1], position=[0.1] * 3, velocity=[0.0] * 3),
        "wearer_efforts": JointState(name=names, effort=[0.0, 2.0, 0.0]),
        "wearer_efforts_std": JointState(name=names, effort=[0.1] * 3),
    }
    node, heard = around
    cascade = runpy.run_path(f"{ROOT}/examples/admittance.py")["AdmittanceNode"]("/right", names, carried.settings)
    spin = partial(rclpy.spin_once, cascade, timeout_sec=0.1)
    publishers = {topic: node.create_publisher(JointState, topic, 1) for topic in parts}
    timers = [node.create_timer(0.01, partial(publishers[topic].publish, parts[topic])) for topic in parts]
    wait_until(lambda: any(message.effort[1] > 0.5 for message in heard), spin)
    newest = heard[-1]
    assert list(newest.name) == list(names) and newest.effort[0] == newest.effort[2] == 0.0
    timers[1].cancel()
    assert_silent(heard, spin)


@pytest.mark.parametrize(("volts", "activation"), [(0.01e-3, 0.0), (0.21e-3, 0.5), (0.9e-3, 1.0)])
def test_a_muscle_is_as_active_as_its_mean_rectified_signal_on_whatever_offset(volts: float, activation: float):
    muscle = runpy.run_path(f"{ROOT}/examples/emg_assistance.py")["Envelope"]()
    for noise in np.random.default_rng(1).normal(size=3000) * np.sqrt(np.pi / 2.0):
        muscle.add(1e-3 + volts * noise)
    assert muscle.activation == pytest.approx(activation, abs=0.12)


@pytest.mark.thorough
def test_the_biceps_bends_and_the_triceps_stretches_the_elbow_and_without_emg_nothing_is_sent(around, capfd):
    variables = runpy.run_path(f"{ROOT}/examples/emg_assistance.py")
    (_, heard), muscles = around, variables["EmgAssistance"]()
    spin = partial(rclpy.spin_once, muscles, timeout_sec=0.1)
    muscles.report()
    assert "waiting for /emg (std_msgs/Float32MultiArray" in capfd.readouterr().err
    before = set(muscles.timers)
    variables["pretend"](muscles)
    for sign in (1.0, -1.0):
        wait_until(lambda sign=sign: any(sign * message.effort[3] > 1.0 for message in heard), spin)
    assert heard[-1].name[3] == "right_elbow_flexion"
    assert not any(any(message.effort[:3]) for message in heard)
    for timer in set(muscles.timers) - before:
        timer.cancel()
    assert_silent(heard, spin)
