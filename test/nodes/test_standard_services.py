# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Every standard service of every node, asked for wrong, random and repeated things while an arm is carried."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from type_description_interfaces.srv import GetTypeDescription

from ..support.launched_nodes import CALM
from ..support.ros_probe import RosProbe

pytestmark = [pytest.mark.real_time, pytest.mark.thorough]
ARM = ("can_bridge", "compensator", "simulator", "wearer")
NODES = ("/imu", "/recorder", "/robot_model", "/panel", *(f"/right/{name}" for name in ARM))
TYPES = (*range(10), 99, 255)  # of parameters; the last two do not exist
TEXTS = ("", "msispelt", "support", "can.channel", "robot.mass", "use_sim_time", "a b", "/x", "." * 300, "é")
# Of a transition: out of order while the arm is carried, or unknown. Those that let it down are left out.
TRANSITIONS = (
    Transition(id=Transition.TRANSITION_CONFIGURE),
    Transition(id=Transition.TRANSITION_CLEANUP),
    Transition(id=Transition.TRANSITION_ACTIVATE),
    Transition(id=Transition.TRANSITION_INACTIVE_SHUTDOWN),
    Transition(id=0),
    Transition(id=200),
    Transition(label="cleanup"),
    Transition(label="fly"),
)


def requests(seed: int) -> Iterator[tuple[type, str, object]]:
    """Yield a service's type, its name, and a request that is wrong or random."""
    chance = random.Random(seed)
    names = chance.choices(TEXTS, k=3)
    yield GetParameterTypes, "get_parameter_types", GetParameterTypes.Request(names=names)
    yield GetParameters, "get_parameters", GetParameters.Request(names=names)
    yield DescribeParameters, "describe_parameters", DescribeParameters.Request(names=names)
    yield ListParameters, "list_parameters", ListParameters.Request(prefixes=names, depth=chance.randrange(2**64))
    wrong = [Parameter(name=f"no_{name}", value=value(chance)) for name in names]
    wrong += [Parameter(name=name, value=ParameterValue(type=99)) for name in names]
    yield SetParameters, "set_parameters", SetParameters.Request(parameters=wrong)
    yield SetParametersAtomically, "set_parameters_atomically", SetParametersAtomically.Request(parameters=wrong)
    asked = GetTypeDescription.Request(type_name=names[0], type_hash=names[1])
    yield GetTypeDescription, "get_type_description", asked


def value(chance: random.Random) -> ParameterValue:
    """Return a random value of a random type."""
    numbers = [chance.choice((0.0, -1e308, float("nan"), float("inf"))) for _ in range(chance.randrange(6))]
    return ParameterValue(
        type=chance.choice(TYPES),
        bool_value=chance.random() < 0.5,
        integer_value=chance.choice((0, -(2**63), 2**63 - 1)),
        double_value=chance.choice((0.0, float("nan"), float("-inf"), 1e308)),
        string_value=chance.choice(TEXTS),
        double_array_value=numbers,
        string_array_value=chance.choices(TEXTS, k=2),
    )


@pytest.fixture
def nodes(prepare, tmp_path):
    """Every node of a simulated arm."""
    nodes = prepare(timing=CALM, wearer=True)
    nodes.add("/recorder", output=str(tmp_path / "bag"))
    nodes.add("/robot_model", rate=30.0)
    nodes.add_panel()
    nodes.start()
    yield nodes
    nodes.stop()
    print("\n".join(nodes.log))


def test_no_request_to_a_standard_service_ends_a_node_or_lets_the_arm_down(nodes, probe: RosProbe):
    probe.get_carried()
    probe.states.clear()
    for seed in range(6):
        for node in NODES:
            for kind, name, request in requests(seed):
                for _ in range(2):
                    response = probe.call(kind, f"{node}/{name}", request)
                    results = [*getattr(response, "results", ()), getattr(response, "result", None)]
                    assert not any(getattr(result, "successful", False) for result in results), (node, request)
    for transition in TRANSITIONS * 2:
        request = ChangeState.Request(transition=transition)
        assert not probe.call(ChangeState, "/right/can_bridge/change_state", request).success
    state = probe.call(GetState, "/right/can_bridge/get_state", GetState.Request()).current_state
    assert state.label == "active" and not nodes.have_ended
    probe.wait_for_report()
    assert set(probe.states) == {"active"}, probe.fault
