# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The parameters of a running compensator: what it refuses and how it describes them."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
import yaml
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import DescribeParameters, SetParametersAtomically
from rclpy.parameter import Parameter

from exo_gravity.core.compensation.settings import COMPENSATOR
from exo_gravity.lab.inputs.parameter_file import load

from ..support.launched_nodes import NO_IMU, LaunchedNodes
from ..support.ros_probe import RosProbe

NODE = "/right/compensator"
OTHER_NODES = ("can_bridge", "simulator", "imu")


@pytest.fixture(scope="module")
def compensator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosProbe]:
    """A probe of a compensator that no test changes."""
    probe = RosProbe()
    nodes = LaunchedNodes(tmp_path_factory.mktemp("compensator"), without=OTHER_NODES, compensator=NO_IMU).start()
    yield probe
    nodes.stop()
    probe.close()
    print("\n".join(nodes.log))


REFUSALS = [
    ({"robot.mass": [0.6, 0.5, 0.6]}, "robot.mass = [0.6, 0.5, 0.6]: must be 4 numbers from 0 to 20"),
    ({"support": math.nan}, "support out of range Min: 0.0, Max: 1.0"),
    ({"wearer.mass": [0.0, 0.0, 9.0, 9.0], "support": 1.0}, "total mass in kg = 19.85: must be at most 10 "),
    ({"use_imu": True}, "read-only parameter: use_imu"),
    ({"suport": 0.5}, "suport = 0.5: must be one of "),
    ({"mode": "two_g"}, "one of one_g, zero_g"),
    ({"gain": [1.0] * 4, "gravity": -1.0}, "gravity out of range"),
    ({"support": True}, "support"),
    ({"gain": []}, "gain = []: must be 4 numbers"),
    ({"gain": ["1.0"] * 4}, "gain"),
    ({"robot.mass": None}, "robot.mass"),
    ({"": 1.0}, "must be one of "),
    ({"law": "anfis"}, "anfis_file"),
    ({"anfis_file": "~nobody_here/model.json"}, "anfis_file = '~nobody_here/model.json': must be a file"),
    ({"anfis_file": "/dev/zero"}, "it must be a regular file"),
    ({"anfis_file": "/proc/kmsg"}, "it must be a regular file"),
]


def message_of(name: str, value: object) -> ParameterMessage:
    """Return the message that sets a parameter, None to delete it."""
    if value == []:  # rclpy cannot infer its type
        return Parameter(name, Parameter.Type.DOUBLE_ARRAY, []).to_parameter_msg()
    return Parameter(name, value=value).to_parameter_msg()


def test_an_invalid_value_is_refused_with_one_sentence_and_changes_nothing(compensator):
    before = compensator.dump_parameters([NODE])
    for values, sentence in REFUSALS:
        messages = [message_of(*item) for item in values.items()]
        request = SetParametersAtomically.Request(parameters=messages)
        result = compensator.call(SetParametersAtomically, f"{NODE}/set_parameters_atomically", request).result
        assert not result.successful
        assert sentence in result.reason
    assert compensator.dump_parameters([NODE]) == before


def test_its_own_dump_can_be_loaded_and_a_read_only_parameter_not_changed(compensator, tmp_path):
    path = tmp_path / "dump.yaml"
    path.write_text(yaml.safe_dump(compensator.dump_parameters([NODE])), encoding="utf-8")
    dumped = load(path)[NODE]
    assert {"link_length", "start_type_description_service"} <= set(dumped)
    for name, value in dumped.items():
        assert compensator.set_parameters("compensator", **{name: value}).successful, name
    assert not compensator.set_parameters("compensator", link_length=[0.05, 0.13, 0.3, 0.31]).successful


def test_an_integer_is_accepted_where_a_float_is_declared(compensator):
    assert compensator.set_parameters("compensator", support=0).successful


def test_parameter_descriptions_have_units_and_ranges(compensator):
    request = DescribeParameters.Request(names=[param.name for param in COMPENSATOR])
    response = compensator.call(DescribeParameters, f"{NODE}/describe_parameters", request)
    descriptors = {descriptor.name: descriptor for descriptor in response.descriptors}
    assert all(descriptor.description for descriptor in descriptors.values())
    time = descriptors["tilt_timeout"]
    assert "[s]" in time.description and not time.read_only
    assert (time.floating_point_range[0].from_value, time.floating_point_range[0].to_value) == (0.01, 0.5)
    assert descriptors["link_length"].read_only and "[m]" in descriptors["link_length"].description
    assert descriptors["wearer.mass"].additional_constraints == "4 numbers from 0 to 20 kg"
    assert descriptors["mode"].additional_constraints == "a string, one of one_g, zero_g"
