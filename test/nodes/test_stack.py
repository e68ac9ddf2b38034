# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Nodes as processes, over real DDS and a real CAN bus: how they start, carry an arm, and let it down whoever dies."""

import os
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import yaml
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from sensor_msgs.msg import JointState

from exo_gravity.core import Tilt, gravity_torque
from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.lab import processes
from exo_gravity.nodes.ros.messages import NO_POSE, POSE_TO_CONFIRM, to_nanoseconds

from ..support import DATA, ROBOT
from ..support.launched_nodes import CALM, NO_IMU, children, executable
from ..support.truth import Truth
from ..support.waiting import PATIENCE, wait_until

POSE = [0.1, 0.8, 0.7, 0.6]  # rad
RATE = CALM["can_bridge"]["rate"]  # Hz
TILT = Tilt.of("right", 0.10, -0.06).direction  # of the simulated trunk
HEAVIER = [1.0, 1.05, 1.0, 1.0]  # gain
NOISE = 0.02  # Nm, of efforts for an arm whose angles are quantized
WITHOUT_OTHERS = ("can_bridge", "simulator", "imu")


def is_down(truth: Truth, since: float) -> bool:
    """Return whether the motors are off, and no joint was fast since that time."""
    now = time.time()
    wait_until(truth.motors_are_off)  # the log is written every 20 ms
    records = truth.since(since)
    return records["time"][records["on"].any(axis=1)].max() < now and float(np.abs(records["velocity"]).max()) < 1.0


@pytest.mark.real_time
@pytest.mark.timeout(300)  # twelve processes start one after another
def test_an_arm_stays_follows_live_changes_and_is_let_down_whichever_node_dies(launch, probe, tmp_path):
    # Under its own launcher, the compensator's death does not stop the other nodes.
    nodes = launch(without=("compensator",), timing=CALM, truth=True)
    compensator = launch(without=WITHOUT_OTHERS, timing=CALM)
    truth, to_pose = Truth(nodes.truth_path()), tmp_path / "to_pose.yaml"
    to_pose.write_text(yaml.safe_dump({"name": "to_pose", "steps": [{"move": POSE, "over": 1.5}, {"hold": 60.0}]}))
    sent: list[tuple[float, float, float]] = []  # when the answered state was measured, and the answer sent, s; Nm

    def on_efforts(message: JointState, info: dict[str, int]) -> None:
        if message.effort:
            times = to_nanoseconds(message.header.stamp), info["source_timestamp"]
            sent.append((*(1e-9 * time for time in times), message.effort[1]))

    probe.node.create_subscription(JointState, "/right/effort_commands", on_efforts, 1000)
    probe.bring_to(to_pose)
    probe.states.clear()
    released, seen = probe.joint_angles(), len(probe.joint_states)
    probe.wait_until(lambda: len(probe.joint_states) > seen + 2.0 * RATE)
    pose, efforts = probe.joint_angles(), probe.effort_commands[-1].effort
    sent.clear()
    assert probe.set_parameters("compensator", gain=HEAVIER).successful
    target = gravity_torque(ROBOT, pose, TILT)[1] * HEAVIER[1]
    probe.wait_until(lambda: probe.state != "active" or (sent and abs(sent[-1][2] - target) < 0.01))
    assert set(probe.states) <= {"active"}
    assert np.degrees(np.abs(np.subtract(pose, released)).max()) < 0.5
    np.testing.assert_allclose(efforts, gravity_torque(ROBOT, pose, TILT), rtol=0.0, atol=0.03)
    # However long a process stood still: an answer is computed between the measurement that it answers and its
    # sending, so no two are further apart than the sending of the second one and the measurement of the first one.
    measured, answered, ramp = np.array(sent).T
    assert np.ptp(ramp) > 0.1
    rate = (abs(target - ramp[0]) + NOISE) / GUIDANCE.time
    assert np.all(np.abs(np.diff(ramp)) < rate * (answered[1:] - measured[:-1]) + NOISE)

    # No node maps another one's shared memory, on which it could block.
    for process in (*map(nodes.process, ("can_bridge", "simulator")), compensator.process("compensator")):
        maps = Path(f"/proc/{process.pid}/maps").read_text()
        assert "librmw_fastrtps" in maps and "fastrtps_port" not in maps

    # Without a compensator the arm is let down, and only the operator clears the fault.
    died = time.time()
    compensator.process("compensator").kill()
    probe.wait_until(lambda: probe.state == "fault")
    assert probe.fault == "command_stale"
    assert abs(probe.joint_angles()[2]) < 0.2 and is_down(truth, died)  # friction holds it there
    launch(without=WITHOUT_OTHERS, timing=CALM)
    probe.effort_commands.clear()
    probe.wait_until(lambda: len(probe.effort_commands) > 20)
    assert (probe.state, probe.fault) == ("fault", "command_stale")
    assert "refused" in probe.enable(True).message
    assert probe.trigger("clear_fault").success
    probe.wait_until(lambda: probe.state == "disabled")
    probe.get_carried()

    # Without the bridge and its watchdog, the launcher lets the arm down.
    bridge, died = nodes.pid("can_bridge"), time.time()
    for process in (*children(bridge), bridge):
        os.kill(process, signal.SIGKILL)
    wait_until(lambda: nodes.have_ended)
    assert nodes.ended_node == ("/right/can_bridge", -signal.SIGKILL)
    assert nodes.launcher.maybe_powered == []
    assert any("the arm is down, its motors are off" in line for line in nodes.log)
    assert is_down(truth, died)


@pytest.mark.real_time
@pytest.mark.thorough
def test_the_launcher_states_that_motors_may_still_be_powered(launch, probe, monkeypatch):
    monkeypatch.setattr(processes, "DESCENT_TIMEOUT", 5.0)
    monkeypatch.setattr(processes, "RECOVERY", {"EXO_GRAVITY_RECOVER": "2"})
    nodes = launch(without=("imu",), compensator=NO_IMU)
    probe.get_carried()
    (watchdog,) = children(nodes.pid("can_bridge"))
    assert probe.set_parameters("simulator", fault__bus_silent=True).successful
    nodes.stopping.set()
    wait_until(lambda: nodes.have_ended)
    assert nodes.launcher.maybe_powered == ["/right/can_bridge"]
    with suppress(ProcessLookupError):  # it ended once the launcher had asked for the bus
        os.kill(watchdog, signal.SIGKILL)


@pytest.mark.real_time
@pytest.mark.thorough
def test_a_file_of_a47959f4_starts_and_its_arm_is_carried_once_a_person_has_confirmed_the_pose(launch, probe):
    """The whole interface shows on the way."""
    launch(base=DATA / "a47959f4" / "sim.yaml", wearer=True)
    probe.wait_until(lambda: probe.state)
    for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
        if probe.state == "inactive":
            request = ChangeState.Request(transition=Transition(id=transition))
            assert probe.call(ChangeState, "/right/can_bridge/change_state", request).success
    probe.wait_until(lambda: probe.diagnostic("can_bridge", POSE_TO_CONFIRM) not in (None, NO_POSE))
    assert probe.diagnostic("can_bridge", "waiting for") == "pose"
    assert probe.trigger("confirm_pose").success
    probe.wait_until(lambda: probe.state in ("active", "fault"))
    keys = ("source", "motors", "fault", "waiting for", "request", "answer")
    expected = ["simulated", "on", "none", "none", "confirm_pose", "done"]
    probe.wait_until(lambda: [probe.diagnostic("can_bridge", key) for key in keys] == expected, timeout=10.0)
    probe.wait_until(lambda: probe.diagnostic("compensator", "state") == "compensating")
    probe.wait_until(lambda: probe.diagnostic("wearer", "state") == "estimating")
    assert probe.enable(False).success
    probe.wait_until(
        lambda: (probe.diagnostic("can_bridge", "motors"), probe.state in ("disabled", "fault")) == ("off", 1)
    )
    assert probe.diagnostic("can_bridge", "request") == "let_down"


def test_motors_that_were_left_on_are_let_down_where_no_log_file_can_be_opened(prepare):
    """Here no motor was left on: the recovery ends well."""
    given = {**os.environ, "EXO_GRAVITY_RECOVER": "2", "ROS_LOG_DIR": "/proc/none"}
    options = ["--ros-args", "-r", "__ns:=/right", "--params-file", str(prepare().path)]
    done = subprocess.run([executable("can_bridge"), *options], env=given, timeout=PATIENCE)
    assert done.returncode == 0


@pytest.mark.thorough
@pytest.mark.real_time
def test_in_one_process_both_nodes_have_their_own_names_carry_the_arm_and_let_it_down(launch, probe):
    nodes = launch(without=("imu",), timing=CALM, truth=True, compensator=NO_IMU, one_process=True)
    probe.get_carried()
    assert nodes.pid("compensator") == nodes.pid("can_bridge")
    probe.wait_until(lambda: probe.status_contains("compensator", "compensating"))
    assert probe.diagnostic("compensator", "mass carried (kg)") == "1.854"  # of the file
    assert probe.set_parameters("compensator", gain=[1.0, 1.05, 1.0, 1.0]).successful
    published = [probe.joint_states.copy(), probe.effort_commands.copy()]
    asked, answered = ({to_nanoseconds(each.header.stamp) for each in messages} for messages in published)
    assert len(asked & answered) > 10  # both topics are published
    assert any(line.startswith("/right/compensator: INFO compensating") for line in nodes.log)
    nodes.process("can_bridge").send_signal(signal.SIGINT)
    probe.wait_until(lambda: nodes.have_ended)
    assert nodes.ended_node == ("/right/can_bridge", 0)
    assert Truth(nodes.truth_path()).motors_are_off()


@pytest.mark.thorough
def test_real_time_threads_and_locked_memory_are_used_or_the_log_states_that_they_are_not_permitted(launch, probe):
    nodes = launch(without=WITHOUT_OTHERS, compensator={**NO_IMU, "thread_priority": 10})
    probe.wait_until(lambda: "waiting for joint_states" in "".join(nodes.log))
    process, log = Path(f"/proc/{nodes.pid('compensator')}"), "\n".join(nodes.log)
    threads = {path.name: (path / "comm").read_text() for path in (process / "task").iterdir()}
    real_time = {number for number in threads if os.sched_getscheduler(int(number)) == os.SCHED_FIFO}
    assert bool(real_time) != ("thread_priority 10 is not permitted" in log)
    is_locked = "VmLck:\t       0 kB" not in (process / "status").read_text()
    assert is_locked != ("locked memory is not permitted" in log)
    if real_time:
        assert process.name not in real_time  # the main thread, which serves parameters
        assert any(threads[number].startswith("dds.") for number in real_time)
