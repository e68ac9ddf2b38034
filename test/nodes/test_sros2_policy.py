# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""config/sros2/policy.py against the running nodes: what each publishes, subscribes to, serves and calls.

The nodes are those of config/sim_both.yaml with a wearer for each arm, a recorder, robot_model, the panel, and an outer
loop for each arm; the bridges are not enabled.
These tests do not show that DDS enforces the policy, which takes a middleware built with security.
"""

import runpy
import time
import xml.etree.ElementTree as ElementTree
from contextlib import suppress

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import NodeNameNonExistentError
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.storage import Storage

from ..support import CONFIG
from ..support.launched_nodes import LaunchedNodes
from ..support.node_thread import NodeThread, own_node

SCRIPT = runpy.run_path(str(CONFIG / "sros2" / "policy.py"))
POLICY = SCRIPT["policy"]()
NODES = [enclave for enclave in POLICY if enclave != "/operator"]
NO_RULES = {"publish": set(), "subscribe": set(), "reply": set(), "request": set()}


def reads(nodes):
    return {f"{node}/{service}" for node in nodes for service in ("get_parameters", "list_parameters")}


def graph_of(node, name):
    """Return the same for the running node `name`, as `node` observes it."""
    namespace, _, leaf = name.rpartition("/")
    kinds = ("publisher", "subscriber", "service", "client")
    queries = [getattr(node, f"get_{kind}_names_and_types_by_node") for kind in kinds]
    try:
        found = [{item for item, _ in query(leaf, namespace or "/") if "/observer/" not in item} for query in queries]
    except NodeNameNonExistentError:
        return NO_RULES
    return dict(zip(NO_RULES, found, strict=True))


def outer_loop(arm):
    """Return a node of an arm, as a user's own controller might be."""
    thread = NodeThread("outer_loop", namespace=arm)
    (node,) = thread.nodes
    node.create_publisher(JointState, "assist_efforts", 1)
    for topic in ("joint_states", "wearer_efforts", "wearer_efforts_std"):
        node.create_subscription(JointState, topic, lambda message: None, 1)
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda message: None, 1)
    return thread


def lasting_rules(rules_of):
    """Return the rules of each node, without the requests of clients that exist for a moment only."""
    brief = ("/recorder", "/left/wearer", "/right/wearer")
    return {node: {**rules_of(node), **({"request": set()} if node in brief else {})} for node in NODES}


def nodes_with_recorded_parameters(bag):
    """Yield the nodes whose parameters are in a recording, which may still grow."""
    with suppress(DataError):  # while it is empty
        for rows in Storage(bag).rows(lambda topic, _: topic == "/recorder/parameters"):
            for data in rows.data:
                message = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(data, "std_msgs/msg/String")
                yield message.data.partition(":")[0].strip()


@pytest.mark.thorough
@pytest.mark.parametrize("one_process", [False, True])
def test_a_node_may_do_exactly_what_it_does(tmp_path, one_process):
    loops = [outer_loop("left"), outer_loop("right")]
    bridge = {"autostart": False, "largest_moment": [0.1] * 4}  # with a moment it reads the trunk's tilt, too
    nodes = LaunchedNodes(tmp_path, base="sim_both.yaml", one_process=one_process, wearer=True, can_bridge=bridge)
    nodes.add("/recorder", output=str(tmp_path / "bag"))
    nodes.add("/robot_model", rate=30.0)
    nodes.add_panel()
    for started in (nodes, *loops):
        started.start()
    expected, end = (lasting_rules(POLICY.get), set(NODES) - {"/recorder"}), time.monotonic() + 90.0
    found = None
    with own_node("observer") as (observer, _):
        while found != expected and time.monotonic() < end:
            time.sleep(0.2)
            recorded = set(nodes_with_recorded_parameters(tmp_path / "bag")) & set(NODES)
            found = lasting_rules(lambda node: graph_of(observer, node)), recorded
    nodes.stop()
    for loop in loops:
        loop.close()
    assert found == expected
    # What the recorder calls is known by what it recorded.
    assert POLICY["/recorder"]["request"] == reads(found[1])
    for node in NODES:
        assert not POLICY[node]["request"] or node.endswith(("wearer", "panel", "recorder", "robot_model"))


SOURCES = {"effort_commands": "compensator", "assist_efforts": "outer_loop", "support_request": "wearer"}


@pytest.mark.parametrize("arm", ["left", "right"])
def test_only_one_node_of_an_arm_may_publish_what_its_torque_depends_on_and_its_wearer_reads_its_own_arm(arm):
    for topic, node in SOURCES.items():
        publishers = [name for name, rules in POLICY.items() if f"/{arm}/{topic}" in rules["publish"]]
        assert publishers == [f"/{arm}/{node}"]
    assert POLICY[f"/{arm}/wearer"]["request"] == reads([f"/{arm}/compensator", f"/{arm}/can_bridge"])


def test_the_text_is_an_access_control_policy_of_version_0_2_0_with_these_rules():
    root = ElementTree.fromstring(SCRIPT["text_of"](POLICY))
    assert (root.tag, root.attrib, [child.tag for child in root]) == ("policy", {"version": "0.2.0"}, ["enclaves"])
    read, items = {}, {"publish": "topic", "subscribe": "topic", "reply": "service", "request": "service"}
    for enclave in root.iterfind("enclaves/enclave"):
        (profile,) = enclave.iterfind("profiles/profile")
        assert f"{profile.get('ns').rstrip('/')}/{profile.get('node')}" == enclave.get("path")
        read[enclave.get("path")] = {
            kind: {child.text for child in profile.iterfind(f"{item}s[@{kind}='ALLOW']/{item}")}
            for kind, item in items.items()
        }
    assert read == POLICY
    names = [name for rules in read.values() for kind in rules.values() for name in kind]
    assert all(name.startswith("/") and not set(name) & set("*?[]~ \n") for name in names)
