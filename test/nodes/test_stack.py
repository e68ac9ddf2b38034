"""All nodes as separate processes over real DDS and a real CAN bus: the arm is carried, and comes down gently."""

import math
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.motors import ENTER
from exo_gravity.tools import train_anfis

from ..faults.stage import GENTLE, SEATED, Listener

pytestmark = pytest.mark.real_time

CONFIG = Path(__file__).parents[2] / "config" / "sim.yaml"
POSE = [0.1, 0.8, 0.7, 0.6]
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))


@pytest.fixture
def to_pose(tmp_path):
    path = tmp_path / "to_pose.yaml"
    path.write_text(yaml.safe_dump({"name": "to_pose", "steps": [{"move": POSE, "over": 2.0}, {"hold": 60.0}]}))
    return str(path)


@pytest.fixture
def listen():
    listeners = []

    def listen(stack):
        listeners.append(Listener(stack.bus))
        return listeners[-1]

    yield listen
    for listener in listeners:
        listener.close()


def test_the_arm_stays_where_it_is_let_go_follows_live_changes_and_comes_down_gently(start, watcher, to_pose, listen):
    stack = start(can_bridge=GENTLE)
    listener = listen(stack)
    watcher.bring_to(to_pose)
    left = watcher.position()
    seen = len(watcher.joints)
    watcher.until(lambda: len(watcher.joints) > seen + 750)
    drift = np.degrees(np.subtract(watcher.position(), left))
    assert np.abs(drift).max() < 0.5
    tilt = Tilt.of("right", 0.10, -0.06)
    expected = gravity_torque(ROBOT, watcher.position(), tilt.direction)
    np.testing.assert_allclose(watcher.efforts[-1].effort, expected, atol=0.03)

    # Refused, with a sentence, and the arm does not notice.
    for name, value, why in (
        ("robot__mass", [0.6, 0.5, 0.6], "must be 4 numbers"),
        ("robot__mass", [0.6, 0.5, 900.0, 0.2], "from 0 to 20"),
        ("robot__cog", [0.0, 0.0, 0.4, 0.0], "within its link"),
        ("law", "magic", "one of exact"),
        ("side", "left", "read-only"),
    ):
        result = watcher.set("compensator", **{name: value})
        assert not result.successful
        assert why in result.reason

    # Taken, and reaches the arm without a step.
    watcher.efforts.clear()
    assert watcher.set("compensator", gain=[1.0, 1.0, 1.05, 1.0]).successful
    heavier = ArmModel(ROBOT.length, ROBOT.cog, ROBOT.mass, gain=(1.0, 1.0, 1.05, 1.0))
    target = gravity_torque(heavier, watcher.position(), tilt.direction)[2]
    watcher.until(lambda: abs(watcher.efforts[-1].effort[2] - target) < 0.01)
    steps = np.diff([message.effort[2] for message in watcher.efforts])
    assert np.abs(steps).max() <= 50.0 * 0.004 * 1.5

    # Stopped, it comes down gently before the motors are switched off.
    watcher.joints.clear()
    stack.stop()
    assert max(max(map(abs, message.velocity)) for message in watcher.joints) < 1.0
    assert abs(watcher.position()[2]) < 0.2  # what friction holds
    assert listener.switched_off()


def test_without_the_compensator_the_same_arm_falls(start, watcher, to_pose):
    start(without=("compensator", "imu"))
    watcher.until(lambda: watcher.said("can_bridge", "waiting for effort commands"))
    assert watcher.set("simulator", trial=to_pose).successful
    watcher.until(lambda: watcher.wearer_does("hold"))
    left = watcher.position()
    watcher.until(lambda: max(abs(a - b) for a, b in zip(watcher.position(), left, strict=True)) > math.radians(20))


def test_ctrl_c_to_the_bridge_switches_the_motors_off_and_stops_everything(start, watcher, listen):
    stack = start(**SEATED)
    listener = listen(stack)
    watcher.carry()
    # Meanwhile: none of the nodes has mapped another one's shared memory, which it might wait for.
    for node in ("can_bridge", "compensator", "simulator"):
        maps = Path(f"/proc/{stack.launcher.process(f'/right/{node}').pid}/maps").read_text()
        assert "librmw_fastrtps" in maps
        assert "fastrtps_port" not in maps
    stack.launcher.process("/right/can_bridge").send_signal(signal.SIGINT)
    watcher.until(lambda: stack.dead is not None)
    assert stack.dead == ("/right/can_bridge", 0)
    assert listener.switched_off()


def test_a_dead_compensator_is_a_fault_that_only_the_operator_clears(start, watcher):
    # Two launchers, so that the compensator's death does not stop the rest.
    start(without=("compensator", "imu"))
    other = start(without=("can_bridge", "simulator", "imu"), **SEATED)
    watcher.carry()
    other.launcher.process("/right/compensator").send_signal(signal.SIGKILL)
    watcher.until(lambda: watcher.said("can_bridge", "letting down: command_stale"))
    watcher.until(lambda: watcher.said("can_bridge", "fault: command_stale"))
    start(without=("can_bridge", "simulator", "imu"), **SEATED)
    watcher.efforts.clear()
    watcher.until(lambda: len(watcher.efforts) > 100)
    assert watcher.said("can_bridge", "fault: command_stale")
    assert "refused" in watcher.enable(True).message
    assert watcher.trigger("clear_fault").success
    watcher.until(lambda: watcher.said("can_bridge", "disabled"))
    watcher.carry()


def test_set_zero_makes_the_present_pose_zero_and_is_refused_while_the_arm_is_carried(start, watcher):
    start(simulator={"zero": [0.3, 0.0, 0.0, 0.2]}, can_bridge={"zero": [0.0] * 4}, **SEATED)
    watcher.carry()
    assert not watcher.trigger("set_zero").success
    assert watcher.enable(False).success
    watcher.until(lambda: watcher.said("can_bridge", "disabled"))
    assert watcher.position()[0] == pytest.approx(0.3, abs=0.01)
    watcher.until(lambda: watcher.trigger("set_zero").success)  # refused while the arm still creeps
    watcher.until(lambda: np.abs(watcher.position()).max() < 0.02)


BAD = [
    ("can_bridge", {"max_efort": [3.0, 9.0, 3.0, 3.0]}, "max_efort", "must be one of"),
    ("can_bridge", {"can_id": [1, 2, 2, 4]}, "can_id = [1, 2, 2, 4]", "4 different IDs"),
    ("can_bridge", {"motor": ["AK60-6", "AK80-9", "AK60-6", "AK10-9"]}, "AK10-9", "AK60-6, AK80-9"),
    ("can_bridge", {"rate": 1100.0}, "rate = 1100.0", "at most 1033 Hz"),
    ("compensator", {"robot": {"mass": [0.6, 0.5, 0.6]}}, "robot.mass = [0.6, 0.5, 0.6]", "4 numbers"),
    ("compensator", {"robot": {"mass": [0.6, -0.5, 0.6, 0.2]}}, "robot.mass", "from 0 to 20"),
    ("compensator", {"robot": {"mass": [0.6, 1, 0.6, 0.2]}}, "robot.mass", "a list of one type"),
    ("compensator", {"mode": "two_g"}, "mode = 'two_g'", "one_g, zero_g"),
    ("imu", {"rotation_trunk_from_imu": [1.0, 1.0, 0.0, 0.0]}, "rotation_trunk_from_imu", "unit quaternion"),
]


@pytest.mark.parametrize(("node", "change", "thing", "right"), BAD, ids=[thing for _, _, thing, _ in BAD])
def test_a_bad_parameter_file_ends_with_one_sentence_and_nothing_moves(make, listen, node, change, thing, right):
    stack = make(**{node: change})
    listener = listen(stack)
    command = [str(Path(sys.executable).with_name("launcher")), "--params", str(stack.path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode in (1, 2)
    told = [line for line in (done.stdout + done.stderr).splitlines() if thing in line]
    assert len(told) == 1
    assert right in told[0]
    assert "Traceback" not in done.stdout + done.stderr
    assert ENTER not in [data for _, _, data in listener.frames]


def test_the_compensator_starts_alone_on_packaged_defaults_and_answers(watcher):
    process = subprocess.Popen([str(Path(sys.executable).with_name("compensator")), "--ros-args", "-r", "__ns:=/right"])
    try:
        watcher.until(lambda: watcher.said("compensator", "waiting for joint_states"))
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 0


def test_the_law_anfis_runs_from_its_file_and_gives_way_to_the_exact_law_where_it_was_not_trained(
    start, watcher, tmp_path
):
    path = str(tmp_path / "anfis.json")
    assert train_anfis.main(["--params", str(CONFIG), "--output", path]) is None
    start(**SEATED)
    watcher.carry()
    assert "anfis_file" in watcher.set("compensator", law="anfis").reason
    assert watcher.set("compensator", atomically=True, law="anfis", anfis_file=path).successful
    watcher.until(lambda: watcher.value("compensator", "law") == "anfis")
    watcher.until(lambda: watcher.said("compensator", "compensating"))
    assert watcher.set("compensator", wearer__body_mass=75.0, mode="zero_g", atomically=True).successful
    watcher.until(
        lambda: watcher.said("compensator", "exact law in use instead of anfis: the ANFIS was trained for another")
    )
