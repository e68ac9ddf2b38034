"""The parameters of a running compensator: what it refuses, what it describes, and what a dump of them starts."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
import yaml
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParametersAtomically
from rclpy.parameter import parameter_value_to_python

from exo_gravity.core.control_params import COMPENSATOR
from exo_gravity.core.trial_script import TrialScript
from exo_gravity.tools.trials.offline import simulated_trials

from ..support.launched_nodes import NO_IMU, LaunchedNodes
from ..support.random_parameters import parameter_message
from ..support.ros_probe import RosProbe

pytestmark = pytest.mark.real_time

NODE = "/right/compensator"
OTHER_NODES = ("can_bridge", "simulator", "imu")
SCRIPT = TrialScript.parse({"name": "hold", "steps": [{"hold": 1.0}]})


@pytest.fixture(scope="module")
def compensator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosProbe]:
    """A probe beside a compensator that no test changes."""
    probe = RosProbe()
    nodes = LaunchedNodes(tmp_path_factory.mktemp("compensator"), without=OTHER_NODES, compensator=NO_IMU).start()
    yield probe
    nodes.stop()
    probe.close()
    print("\n".join(nodes.log))


def dump(probe: RosProbe, nodes: Iterable[str]) -> dict[str, dict]:
    """Return what `ros2 param dump` writes for the nodes."""
    content: dict[str, dict] = {}
    for node in nodes:
        names = probe.call(ListParameters, f"{node}/list_parameters", ListParameters.Request()).result.names
        values = probe.call(GetParameters, f"{node}/get_parameters", GetParameters.Request(names=names)).values
        content[node] = {"ros__parameters": {}}
        for name, value in zip(names, values, strict=True):
            *branches, leaf = name.split(".")
            parameters = content[node]["ros__parameters"]
            for branch in branches:
                parameters = parameters.setdefault(branch, {})
            parameters[leaf] = parameter_value_to_python(value)
    return content


REFUSALS = [
    ({"robot.mass": [0.6, 0.5, 0.6]}, "robot.mass = [0.6, 0.5, 0.6]: must be 4 numbers from 0 to 20"),
    ({"robot.mass": [0.6, 0.5, 900.0, 0.2]}, "must be 4 numbers from 0 to 20"),
    ({"robot.cog": [0.0, 0.0, 0.31, 0.0]}, "within its link"),
    ({"support": math.nan}, "support out of range Min: 0.0, Max: 1.0"),
    ({"wearer.body_mass": 0.9}, "wearer.body_mass = 0.9: must be a number from 10 to 300 kg"),
    ({"wearer.mass": [0.0, 0.0, 9.0, 9.0]}, "total mass in kg = 19.85: must be at most max_total_mass = 10"),
    ({"max_total_mass": 40.0}, "read-only parameter: max_total_mass"),
    ({"suport": 0.5}, "undeclared parameter(s): ['suport']"),
    ({"mode": "two_g"}, "one of one_g, zero_g"),
    ({"gain": [1.0] * 4, "gravity": -1.0}, "gravity out of range"),
]


def test_an_invalid_value_is_refused_with_one_sentence_and_changes_nothing(compensator):
    before = dump(compensator, [NODE])
    for values, sentence in REFUSALS:
        messages = [parameter_message(*item) for item in values.items()]
        request = SetParametersAtomically.Request(parameters=messages)
        result = compensator.call(SetParametersAtomically, f"{NODE}/set_parameters_atomically", request).result
        assert not result.successful
        assert sentence in result.reason
    assert dump(compensator, [NODE]) == before


def test_an_integer_is_accepted_where_a_float_is_declared(compensator):
    assert compensator.set_parameters("compensator", support=0).successful


def test_parameter_descriptions_have_units_and_ranges(compensator):
    request = DescribeParameters.Request(names=[param.name for param in COMPENSATOR])
    response = compensator.call(DescribeParameters, f"{NODE}/describe_parameters", request)
    descriptors = {descriptor.name: descriptor for descriptor in response.descriptors}
    assert all(descriptor.description for descriptor in descriptors.values())
    time = descriptors["transition_time"]
    assert "[s]" in time.description and not time.read_only
    assert (time.floating_point_range[0].from_value, time.floating_point_range[0].to_value) == (0.2, 30.0)
    mass = descriptors["max_total_mass"]
    assert "[kg]" in mass.description and mass.read_only and mass.floating_point_range[0].to_value == 40.0
    assert descriptors["wearer.mass"].additional_constraints == "4 numbers from 0 to 20 kg"
    assert descriptors["mode"].additional_constraints == "one of one_g, zero_g"


def test_a_parameter_dump_starts_the_same_nodes_without_changes(tmp_path, prepare, launch, probe):
    first = launch(compensator={"wearer": {"body_mass": 70.0}})
    nodes = list(yaml.safe_load(first.path.read_text()))
    assert probe.set_parameters("compensator", support=0.3, transition_time=2, atomically=True).successful
    dumped = dump(probe, nodes)
    first.stop()
    for node in nodes:  # a dump also has these if a publisher's quality of service can be set
        dumped[node]["ros__parameters"]["qos_overrides"] = {"/parameter_events": {"publisher": {"depth": 1000}}}
    assert dumped["/right/compensator"]["ros__parameters"]["use_sim_time"] is False
    second = prepare()
    second.path = tmp_path / "dump.yaml"
    second.path.write_text(yaml.dump(dumped, default_flow_style=False))
    second.start()
    try:
        assert dump(probe, nodes) == dumped
        assert simulated_trials(second.path, SCRIPT)  # the tools read it too
    finally:
        second.stop()
    assert second.ended_node is None


def test_real_time_threads_and_locked_memory_are_used_or_the_log_states_that_they_are_not_permitted(launch, probe):
    nodes = launch(without=OTHER_NODES, compensator={**NO_IMU, "thread_priority": 10, "lock_memory": True})
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
    assert memory_is_locked != ("lock_memory is not permitted" in log)
    if real_time_threads:
        assert process.name not in real_time_threads  # the main thread, which serves parameters
        assert any(name.startswith("dds.") for name in real_time_threads.values())
