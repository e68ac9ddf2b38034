# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Prints the permissions of each node for `ros2 security create_permission`: `python3 policy.py > policy.xml`.

An access control policy of version 0.2.0: each node has one enclave with its name, and what is not allowed is denied.
Names are of each arm unless they begin with /. Needs Python alone. test/nodes/test_sros2_policy.py compares the tables
with the running nodes; docs/topics.md shows the topics.
"""

from xml.etree import ElementTree

ARMS = ("/right", "/left")
NODES = (
    "/imu",
    "can_bridge",
    "compensator",
    "wearer",
    "outer_loop",
    "simulator",
    "/panel",
    "/recorder",
    "/robot_model",
)
# Who publishes a topic, and who subscribes to it. Only a compensator may publish efforts.
TOPICS = {
    "/diagnostics": (
        {"/imu", "can_bridge", "compensator", "wearer", "simulator", "/panel", "/robot_model"},
        {"wearer", "outer_loop", "/panel", "/recorder", "/robot_model"},
    ),
    "/event_marker": ({"/panel"}, {"/recorder"}),
    "/imu/data": ({"/imu"}, {"can_bridge", "compensator", "wearer", "/recorder"}),
    "/imu/data_raw": ({"/right/simulator"}, {"/imu", "/recorder"}),
    "/imu/pitch_yaw": ({"/imu"}, {"can_bridge", "compensator", "wearer", "/panel", "/recorder", "/robot_model"}),
    "/joint_states": ({"/robot_model"}, set()),
    "/parameter_events": ({*NODES}, {"wearer", "/panel", "/recorder"}),
    "/robot_description": ({"/robot_model"}, set()),
    "/robot_model/markers": ({"/robot_model"}, set()),
    "/rosout": ({*NODES}, set()),
    "assist_efforts": ({"outer_loop"}, {"compensator", "/recorder"}),
    "can_bridge/control": ({"/panel"}, {"can_bridge"}),
    "can_bridge/transition_event": ({"can_bridge"}, set()),
    "effort_commands": ({"compensator"}, {"can_bridge", "/recorder"}),
    "joint_states": ({"can_bridge"}, {"compensator", "wearer", "outer_loop", "/panel", "/recorder", "/robot_model"}),
    "support_request": ({"wearer"}, {"compensator", "/recorder"}),
    "wearer_efforts": ({"wearer"}, {"outer_loop", "/recorder"}),
    "wearer_efforts_std": ({"wearer"}, {"outer_loop", "/recorder"}),
    "wearer_step": ({"simulator"}, {"/recorder"}),
}
READ = {"get_parameters", "list_parameters"}
EVERY_NODES = READ | {
    "describe_parameters", "get_parameter_types", "get_type_description", "set_parameters", "set_parameters_atomically"
}  # fmt: skip
LIFECYCLE = {
    "change_state", "get_available_states", "get_available_transitions", "get_state", "get_transition_graph"
}  # fmt: skip
OPERATION = {"clear_fault", "confirm_pose", "enable", "resume"}
# What a node serves beside EVERY_NODES, and what it calls of others.
SERVICES = {"can_bridge": LIFECYCLE | OPERATION | {"set_zero"}, "compensator": {"weigh"}}
CALLS = {
    "wearer": {"can_bridge": READ, "compensator": READ},
    "/robot_model": {"can_bridge": READ, "compensator": READ},
    "/recorder": {node: READ for node in NODES if node != "/recorder"},
    "/panel": {
        **{node: READ for node in NODES if node != "/panel"},
        "can_bridge": READ | OPERATION | {"change_state"},
        "compensator": READ | {"set_parameters_atomically", "weigh"},
        "simulator": READ | {"set_parameters_atomically"},
    },
}
RULES = {"publish": "topic", "subscribe": "topic", "reply": "service", "request": "service"}


def of_arms(name, arms=ARMS):
    """Return the full names of a node, topic or service."""
    return {name} if name.startswith("/") else {f"{arm}/{name}" for arm in arms}


def rules_of(node, arms):
    """Return the full names that a node may use, by the keys of RULES. arms: that of the node, or both."""
    own = {node, *of_arms(node, arms)}
    served = EVERY_NODES | SERVICES.get(node, set())
    calls = CALLS.get(node, {})
    return {
        "publish": {full for topic, (by, _) in TOPICS.items() if own & by for full in of_arms(topic, arms)},
        "subscribe": {full for topic, (_, by) in TOPICS.items() if own & by for full in of_arms(topic, arms)},
        "reply": {full for service in served for full in of_arms(f"{node}/{service}", arms)},
        "request": {full for of in calls for service in calls[of] for full in of_arms(f"{of}/{service}", arms)},
    }


def policy():
    """Return the rules of each enclave by its path; `/operator`, a person, reads and calls all, but sends no torque."""
    shared = {node: rules_of(node, ARMS) for node in NODES if node.startswith("/")}
    others = [node for node in NODES if node not in shared]
    enclaves = shared | {f"{arm}/{node}": rules_of(node, [arm]) for arm in ARMS for node in others}
    enclaves["/operator"] = {
        "publish": {"/parameter_events", "/rosout", *of_arms("can_bridge/control")},
        "subscribe": set().union(*(rules["publish"] for rules in enclaves.values())),
        "reply": set(),
        "request": set().union(*(rules["reply"] for rules in enclaves.values())),
    }
    return enclaves


def text_of(enclaves):
    """Return the policy as XML."""
    root = ElementTree.Element("policy", version="0.2.0")
    parent = ElementTree.SubElement(root, "enclaves")
    for path, rules in enclaves.items():
        namespace, _, node = path.rpartition("/")
        profiles = ElementTree.SubElement(ElementTree.SubElement(parent, "enclave", path=path), "profiles")
        profile = ElementTree.SubElement(profiles, "profile", ns=namespace or "/", node=node)
        for rule, names in rules.items():
            if names:
                group = ElementTree.SubElement(profile, f"{RULES[rule]}s", {rule: "ALLOW"})
                for name in sorted(names):
                    ElementTree.SubElement(group, RULES[rule]).text = name
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


if __name__ == "__main__":
    print(text_of(policy()), end="")
