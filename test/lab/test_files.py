# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Files of arms that ship and that once did, each carried without ROS; sessions, sources, and work in processes."""

import threading
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from exo_gravity.core.compensation.settings import compensator_table
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import OPTIONS
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE, CONFIRM
from exo_gravity.core.trunk.checks import IMU
from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.bag.content import Session
from exo_gravity.lab.inputs.arms import configured_arms, read_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.lab.parallel import ENDED, Outcome, in_processes
from exo_gravity.lab.trial.offline import simulated_trials
from exo_gravity.lab.trial.scripted import read_script
from exo_gravity.lab.vocabulary import of_all, source_of
from exo_gravity.sim.params import SIMULATOR
from exo_gravity.sim.script import TrialScript

from ..support import DATA
from ..support.urdf_oracle import MujocoArm

POSES = {
    "elbow": [1.2],
    "three_joints": [0.6, 0.5, 0.8],
    "seven_joints": [0.5, 0.5, 0.3, 0.8, 0.2, 0.3, -0.2],
}

HELD = 0.05  # rad that a joint may turn while nobody touches the arm

FRICTION = 0.1  # Nm: the torque command has codes, and the trial's efforts those of the motors' replies


def script_to(pose: list[float]) -> TrialScript:
    return TrialScript.parse({"name": "raise", "steps": [{"move": pose, "over": 3.0}, {"hold": 3.0}]})


@pytest.mark.thorough  # `make test` carries one in test_motors.py, and plays a script of another one below
@pytest.mark.parametrize("name", POSES)
def test_an_arm_that_ships_is_raised_by_its_wearer_and_stays(name: str) -> None:
    params, script = packaged_config(f"{name}.yaml"), script_to(POSES[name])
    (trial,) = simulated_trials(params, script)
    recording = trial.run()
    assert not trial.trouble and not trial.events
    released = next(step.start for step in recording.steps if step.action == "hold")
    during = (recording.time > released + 0.5) & (recording.time < released + 2.9)
    positions, commands = recording.position[during], recording.command[during]
    assert np.ptp(positions, axis=0).max() < HELD
    assert np.abs(positions[0] - POSES[name]).max() < 0.2
    arm = read_arm(load(params), "/right")
    text = Path(packaged_config(f"arms/{name}.urdf")).read_text(encoding="utf-8")
    oracle = MujocoArm(text, arm.limits.joint_names)
    needed = oracle.torque(positions[-1], (0.0, 0.0, -9.80665))
    assert np.abs(commands[-1] - needed).max() < 1e-9
    assert np.abs(recording.effort[during][-1] - needed).max() < FRICTION
    assert not trial.arm.device.powered


THEN = DATA / "a47959f4"

TABLES = {"can_bridge": CAN_BRIDGE, "imu": IMU, "simulator": SIMULATOR}


def test_a_script_bends_the_elbow_and_one_for_another_number_of_joints_or_a_tool_for_another_arm_is_refused() -> None:
    (trial,) = simulated_trials(packaged_config("elbow.yaml"), read_script("elbow")[1])
    assert trial.run().position.max() > 1.1 and not trial.trouble
    with pytest.raises(ParameterError, match=r"steps\[0\]\.move = .*: must be 3 numbers, one per joint"):
        simulated_trials(packaged_config("three_joints.yaml"), script_to([0.1, 0.2]))
    with pytest.raises(ParameterError, match="law = 'urdf': must be exact: this is for the paper's arm"):
        read_arm(load(packaged_config("elbow.yaml")), "/right").paper_arm  # noqa: B018


# What docs/topics.md promises: the files of a47959f4 work unchanged, except that a person confirms the pose


@pytest.mark.parametrize(("file", "arms"), [("exo", 2), ("sim", 1), ("sim_both", 2)])
def test_every_node_takes_its_parameters_and_every_arm_is_made_of_them(file: str, arms: int) -> None:
    nodes = load(THEN / f"{file}.yaml")
    for name, given in nodes.items():
        executable = name.rpartition("/")[2]
        table = compensator_table(given) if executable == "compensator" else TABLES[executable]
        values = values_of(table, given, OPTIONS)
        assert {key: values[key] for key in given if key in values} == {
            key: value for key, value in given.items() if not key.startswith(f"{OPTIONS}.")
        }
    found = configured_arms(THEN / f"{file}.yaml")
    assert len(found) == arms
    for arm in found:
        assert arm.settings.side == arm.side
        assert arm.can_bridge["start_pose"] == CONFIRM  # the one thing that is new to them
    assert TrialScript.read(THEN / "home.yaml").steps


SIMULATED, REAL, UNKNOWN = Source.SIMULATED, Source.REAL, Source.UNKNOWN


@pytest.mark.parametrize(
    ("interface", "channel", "has_simulator", "source"),
    [
        ("udp_multicast", "239.74.163.2", False, SIMULATED),
        ("socketcan", "can0", False, REAL),
        ("socketcan", "can0,can0,can1,can1", False, REAL),
        ("socketcan", "vcan0", False, UNKNOWN),
        ("socketcan", "vcan0", True, SIMULATED),
        ("socketcan", "", False, UNKNOWN),
        ("", "", False, UNKNOWN),
        (None, None, False, UNKNOWN),
    ],
)
def test_an_arm_is_real_only_if_its_file_names_a_bus_that_leads_to_motors(interface, channel, has_simulator, source):
    bridge = {} if interface is None else {"can.interface": interface, "can.channel": channel}
    assert source_of(bridge, has_simulator) is source
    assert of_all([REAL, REAL]) is REAL and of_all([REAL, UNKNOWN]) is of_all([]) is UNKNOWN
    assert of_all([REAL, SIMULATED]) is of_all([SIMULATED, UNKNOWN]) is SIMULATED


NO_CODES = ("Anna Meier", "../P01", "a/b", ".", "-P01", "Jörg", "P01\n", "A" * 33, "P.1", "CON:")
# An emoji that a field's maxlength has cut; and a string of C, which ends at its 0.
NO_TEXTS = ({"note": "x" * 1001}, {"note": "calm \ud83d"}, {"protocol": "a\0"}, {"protocol": 1}, {"subject": None})


@pytest.mark.parametrize("wrong", [*({"subject": code} for code in NO_CODES), *NO_TEXTS])
def test_a_code_names_a_folder_and_what_is_none_and_no_whole_text_of_this_length_is_refused_by_name(wrong):
    for code in ("P01", "0042", "pilot-3_b", "A" * 32):
        assert Session(code).folder(date(2026, 3, 14)) == f"{code}/2026-03-14" and not Session().folder(date.today())
    ((name, value),) = wrong.items()
    with pytest.raises(ParameterError, match="subject = .*: must be a code" if value in NO_CODES else name):
        Session(**wrong)


def test_every_item_has_one_outcome_also_when_a_process_dies():
    values = {f"{number} * {number}": number * number for number in range(6)}
    failed = {"__import__('os')._exit(1)": ENDED, "1 / 0": "ZeroDivisionError: division by zero"}
    found = in_processes(eval, [*values, *failed], workers=2)
    expected = [Outcome(item, value) for item, value in values.items()]
    expected += [Outcome(item, None, failure) for item, failure in failed.items()]
    assert sorted(found, key=lambda one: one.item) == sorted(expected, key=lambda one: one.item)
    # No thread waits for the dead process, and keeps this one from ending.
    assert "_ExecutorManagerThread" not in [type(thread).__name__ for thread in threading.enumerate()]
