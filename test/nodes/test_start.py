"""How nodes start: a bad parameter file ends them with one sentence, and packaged defaults are enough for one."""

from __future__ import annotations

import signal
import subprocess

import pytest

from exo_gravity.core.motors import ENTER

from ..support.launched_nodes import executable

pytestmark = pytest.mark.real_time

BAD_PARAMETERS = [
    ("can_bridge", {"max_efort": [3.0, 9.0, 3.0, 3.0]}, "max_efort", "must be one of"),
    ("can_bridge", {"can_id": [1, 2, 2, 4]}, "can_id = [1, 2, 2, 4]", "4 different IDs"),
    ("can_bridge", {"motor": ["AK60-6", "AK80-9", "AK60-6", "AK10-9"]}, "AK10-9", "AK60-6, AK80-9"),
    ("can_bridge", {"rate": 1100.0}, "rate = 1100.0", "at most 1033 Hz"),
    ("can_bridge", {"rate": 20.0}, "rate = 20.0", "must span 2 periods"),
    ("can_bridge", {"max_effort": [18.0] * 4}, "max_effort = [18.0", "peak torque"),
    ("can_bridge", {"home_tolerance": [6.3] * 4}, "home_tolerance = [6.3", "half a turn of each motor's rotor"),
    ("compensator", {"gravity": 25.0}, "gain times gravity = [25.0", "twice the Earth's"),
    ("compensator", {"robot": {"mass": [0.6, 0.5, 0.6]}}, "robot.mass = [0.6, 0.5, 0.6]", "4 numbers"),
    ("compensator", {"robot": {"mass": [0.6, -0.5, 0.6, 0.2]}}, "robot.mass", "from 0 to 20"),
    ("compensator", {"robot": {"mass": [0.6, 1, 0.6, 0.2]}}, "robot.mass", "a list of one type"),
    ("compensator", {"mode": "two_g"}, "mode = 'two_g'", "one_g, zero_g"),
    ("imu", {"rotation_trunk_from_imu": [1.0, 1.0, 0.0, 0.0]}, "rotation_trunk_from_imu", "unit quaternion"),
]


@pytest.mark.parametrize(
    ("node", "change", "value", "requirement"), BAD_PARAMETERS, ids=[value for _, _, value, _ in BAD_PARAMETERS]
)
def test_a_bad_parameter_ends_the_launcher_with_one_sentence_and_no_motor_is_enabled(
    prepare, listen, node, change, value, requirement
):
    nodes = prepare(**{node: change})
    listener = listen(nodes)
    command = [executable("launcher"), "--params", str(nodes.path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode in (1, 2)
    output = done.stdout + done.stderr
    sentences = [line for line in output.splitlines() if value in line]
    assert len(sentences) == 1
    assert requirement in sentences[0]
    assert "Traceback" not in output
    assert ENTER not in [frame.data for frame in listener.frames]


def test_a_compensator_without_a_parameter_file_starts_and_waits_for_joint_states(probe):
    process = subprocess.Popen([executable("compensator"), "--ros-args", "-r", "__ns:=/right"])
    try:
        probe.wait_until(lambda: probe.status_contains("compensator", "waiting for joint_states"))
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 0
