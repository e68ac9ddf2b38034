# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How nodes start: with a bad parameter, without a file, from a parameter dump, and with real-time threads."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import pytest
import yaml

from exo_gravity.core.motors.frames import ENTER
from exo_gravity.lab.trial.from_file import simulated_trials
from exo_gravity.sim.script import TrialScript

from ..support.launched_nodes import NO_IMU, executable
from ..support.waiting import PATIENCE

OTHER_NODES = ("can_bridge", "simulator", "imu")
SCRIPT = TrialScript.parse({"name": "hold", "steps": [{"hold": 1.0}]})


@pytest.mark.thorough
def test_a_bad_parameter_ends_the_launcher_with_one_sentence_and_no_motor_is_enabled(prepare, listen):
    nodes = prepare(can_bridge={"homes": [0.2] * 4})  # test_validation.py has the other refusals
    listener = listen(nodes)
    command = [executable("launcher"), "--params", str(nodes.path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode in (1, 2)
    output = done.stdout + done.stderr
    (sentence,) = [line for line in output.splitlines() if "homes = [0.2" in line]
    assert "must be one of" in sentence
    assert "Traceback" not in output
    assert ENTER not in [frame.data for frame in listener.frames]


def test_motors_that_were_left_on_are_let_down_where_no_log_file_can_be_opened(prepare):
    """Here no motor was left on: the recovery ends well."""
    given = {**os.environ, "EXO_GRAVITY_RECOVER": "2", "ROS_LOG_DIR": "/proc/none"}
    options = ["--ros-args", "-r", "__ns:=/right", "--params-file", str(prepare().path)]
    done = subprocess.run([executable("can_bridge"), *options], env=given, timeout=PATIENCE)
    assert done.returncode == 0


def test_a_compensator_without_a_parameter_file_starts_and_waits_for_joint_states(probe):
    process = subprocess.Popen([executable("compensator"), "--ros-args", "-r", "__ns:=/right"])
    try:
        probe.wait_until(lambda: probe.status_contains("compensator", "waiting for joint_states"))
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0


@pytest.mark.thorough
def test_a_parameter_dump_starts_the_same_nodes_without_changes(tmp_path, prepare, launch, probe):
    first = launch(compensator={"wearer": {"body_mass": 70.0}})
    nodes = list(yaml.safe_load(first.path.read_text()))
    assert probe.set_parameters("compensator", support=0.3, max_effort_rate=40, atomically=True).successful
    dumped = probe.dump_parameters(nodes)
    first.stop()
    for node in nodes:  # a dump also has these if a publisher's quality of service can be set
        dumped[node]["ros__parameters"]["qos_overrides"] = {"/parameter_events": {"publisher": {"depth": 1000}}}
    assert dumped["/right/compensator"]["ros__parameters"]["use_sim_time"] is False
    second = prepare()
    second.path = tmp_path / "dump.yaml"
    second.path.write_text(yaml.dump(dumped, default_flow_style=False))
    second.start()
    try:
        assert probe.dump_parameters(nodes) == dumped
        assert simulated_trials(second.path, SCRIPT)  # the tools read it too
    finally:
        second.stop()
    assert second.ended_node is None


@pytest.mark.thorough
def test_real_time_threads_and_locked_memory_are_used_or_the_log_states_that_they_are_not_permitted(launch, probe):
    nodes = launch(without=OTHER_NODES, compensator={**NO_IMU, "thread_priority": 10})
    probe.wait_until(lambda: "waiting for joint_states" in "".join(nodes.log))
    process = Path(f"/proc/{nodes.process('compensator').pid}")
    real_time_threads = {
        thread.name: (thread / "comm").read_text()
        for thread in (process / "task").iterdir()
        if os.sched_getscheduler(int(thread.name)) == os.SCHED_FIFO
    }
    memory_is_locked = "VmLck:\t       0 kB" not in (process / "status").read_text()
    log = "\n".join(nodes.log)
    assert bool(real_time_threads) != ("thread_priority 10 is not permitted" in log)
    assert memory_is_locked != ("locked memory is not permitted" in log)
    if real_time_threads:
        assert process.name not in real_time_threads  # the main thread, which serves parameters
        assert any(name.startswith("dds.") for name in real_time_threads.values())
