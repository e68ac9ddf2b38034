"""node_set: which nodes of a parameter file start, in which order they stop, and a namespace in front of all."""

from pathlib import Path

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.tools.inputs.parameter_file import Stages, chosen, in_namespace, load

SIM = Path(__file__).parents[2] / "config" / "sim.yaml"
NODES = ["/recorder", "/imu", "/left/can_bridge", "/left/compensator", "/right/can_bridge"]


def test_bridges_stop_first_and_recorders_last():
    assert Stages.of(NODES) == (["/left/can_bridge", "/right/can_bridge"], ["/imu", "/left/compensator"], ["/recorder"])


@pytest.mark.parametrize(
    ("only", "names"),
    [
        ((), NODES),
        (("/left/*",), ["/left/can_bridge", "/left/compensator"]),
        (("*/can_bridge", "/imu"), ["/imu", "/left/can_bridge", "/right/can_bridge"]),
        (("/IMU",), None),
        (("can_bridge",), None),
    ],
)
def test_patterns_are_compared_with_full_names(only, names):
    if names is None:
        with pytest.raises(ParameterError, match="only = "):
            chosen(NODES, only)
    else:
        assert chosen(NODES, only) == names


def test_a_namespace_is_put_in_front_of_every_node_and_changes_no_parameter():
    nodes = load(SIM)
    moved = load(in_namespace(SIM, "/lab"))
    assert moved == {f"/lab{node}": parameters for node, parameters in nodes.items()}
    assert in_namespace(SIM, "") == SIM
