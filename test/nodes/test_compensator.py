"""The compensator as a process of its own, fed with joint states by the test: whatever is set live, and both arms."""

import math
import os
import random
import threading
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter, parameter_value_to_python
from sensor_msgs.msg import JointState

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.compensator import LONGEST_STEP
from exo_gravity.core.control_params import CAN_BRIDGE, COMPENSATOR
from exo_gravity.core.trial_script import TrialScript
from exo_gravity.core.wearer import Wearer
from exo_gravity.nodes.conversions import to_nanoseconds, to_time
from exo_gravity.tools.trials.offline import simulated_trials

pytestmark = pytest.mark.real_time

PARTS = ("shoulder_rotation", "shoulder_abduction", "shoulder_flexion", "elbow_flexion")
SCRIPT = TrialScript.parse({"name": "hold", "steps": [{"hold": 1.0}]})
SEATED = {"use_imu": False}
ALONE = ("can_bridge", "simulator", "imu")  # what the test stands in for
POSE = (0.2, 0.9, 0.7, 0.6)
PERIOD = 0.004  # s
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
LOAD = Wearer(75.0).on_links(ROBOT.length)


class Feeder:
    """Publishes joint states of an arm at rest at a steady rate; their stamps count them."""

    def __init__(self, node, side):
        message = JointState(name=[f"{side}_{part}" for part in PARTS], position=POSE)
        publisher = node.create_publisher(JointState, f"/{side}/joint_states", 1)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._feed, args=(publisher, message))
        self._thread.start()

    def _feed(self, publisher, message):
        number = 0
        while not self._stop.wait(PERIOD):
            number += 1
            message.header.stamp = to_time(number)
            publisher.publish(message)

    def close(self):
        self._stop.set()
        self._thread.join()


@pytest.fixture
def feed(watcher):
    """Feed the arm of a side."""
    feeders = []
    yield lambda side="right": feeders.append(Feeder(watcher.node, side))
    for feeder in feeders:
        feeder.close()


class Service:
    """A service's client that is kept, for many calls."""

    def __init__(self, watcher, kind, name):
        self._client = watcher.node.create_client(kind, name)
        assert self._client.wait_for_service(60.0)
        self._kind = kind

    def __call__(self, **request):
        done = threading.Event()
        future = self._client.call_async(self._kind.Request(**request))
        future.add_done_callback(lambda _: done.set())
        assert done.wait(60.0)
        return future.result()


def changes(count, seed=5):
    """Yield {name: value} of parameters to be set together, and whether that must be refused."""
    rng = random.Random(seed)

    def four(low, high):
        return [rng.uniform(low, high) for _ in range(4)]

    possible = {
        "law": lambda: rng.choice(["exact", "paper_static", "paper_mobile"]),
        "mode": lambda: rng.choice(["one_g", "zero_g"]),
        "support": lambda: rng.choice([0, 1, rng.random()]),
        "gain": lambda: four(0.0, 2.0),
        "gravity": lambda: rng.uniform(0.0, 20.0),
        "robot.mass": lambda: four(0.0, 1.0),
        "robot.cog": lambda: [rng.uniform(0.0, length) for length in ROBOT.length.tolist()],
        "wearer.mass": lambda: [0.0, 0.0, *four(0.0, rng.choice([2.5, 9.0]))[2:]],  # or beyond max_total_mass
        "wearer.cog": lambda: [0.0, 0.0, *four(0.0, 0.3)[2:]],
        "wearer.body_mass": lambda: rng.uniform(40.0, 110.0),
        "wearer.table": lambda: rng.choice(["de_leva", "winter"]),
        "max_effort": lambda: four(0.0, 18.0),
        "max_effort_rate": lambda: rng.choice([1, 50, rng.uniform(1.0, 50.0)]),
        "transition_time": lambda: rng.choice([1, rng.uniform(0.2, 5.0)]),
    }
    numbers = ["support", "gravity", "wearer.body_mass", "max_effort_rate", "transition_time"]
    lists = ["gain", "robot.mass", "robot.cog", "wearer.mass", "wearer.cog", "max_effort"]
    impossible = (
        lambda: (rng.choice(numbers), rng.choice([-0.1, math.nan, math.inf, -math.inf, 1e6, "much", True, [0.5]])),
        lambda: (rng.choice(lists), rng.choice([[0.1] * 3, [0.1] * 5, [], 0.1, "heavy", [True] * 4, ["0.1"] * 4])),
        lambda: (rng.choice(lists), [0.1, 0.1, rng.choice([-1e-9, math.nan, math.inf, 900.0]), 0.1]),
        lambda: ("robot.cog", [0.0, 0.0, 0.31, 0.0]),  # outside the link
        lambda: (rng.choice(["law", "mode", "wearer.sex", "wearer.table"]), rng.choice(["", "newton", 1, []])),
        lambda: (rng.choice(["side", "link_length", "max_total_mass", "joint_names", "use_imu"]), "left"),
        lambda: (rng.choice(["suport", "", "robot", "robot.", "wearer.mass.0", "a" * 300]), 1.0),
        lambda: (rng.choice([*numbers, *lists, "law"]), None),
        lambda: ("anfis_file", rng.choice(["/nowhere.json", "/", "\n"])),
        lambda: ("law", "anfis"),
    )
    for _ in range(count):
        chosen = dict((name, possible[name]()) for name in rng.sample(sorted(possible), rng.choice([1, 1, 2, 4])))
        refused = rng.random() < 0.5
        if refused:
            name, value = rng.choice(impossible)()
            chosen[name] = value
        yield chosen, refused


def message_of(name, value):
    if value == [] and type(value) is list:
        return Parameter(name, Parameter.Type.DOUBLE_ARRAY, []).to_parameter_msg()
    return Parameter(name, value=value).to_parameter_msg()


SENTENCES = [
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


def test_what_is_impossible_is_refused_with_a_sentence_and_nothing_is_changed(start, watcher):
    start(without=ALONE, compensator=SEATED)
    at_once = Service(watcher, SetParametersAtomically, "/right/compensator/set_parameters_atomically")
    before = dumped(watcher, ["/right/compensator"])
    for values, sentence in SENTENCES:
        result = at_once(parameters=[message_of(*item) for item in values.items()]).result
        assert not result.successful
        assert sentence in result.reason
    assert dumped(watcher, ["/right/compensator"]) == before
    assert watcher.set("compensator", support=0).successful  # a whole number is a number


def test_real_time_threads_and_locked_memory_are_had_where_they_are_permitted_and_told_where_not(start, watcher):
    stack = start(without=ALONE, compensator={**SEATED, "thread_priority": 10, "lock_memory": True})
    watcher.until(lambda: watcher.said("compensator", "waiting for joint_states"))
    process = Path(f"/proc/{stack.launcher.process('/right/compensator').pid}")
    named = {
        thread.name: (thread / "comm").read_text()
        for thread in (process / "task").iterdir()
        if os.sched_getscheduler(int(thread.name)) == os.SCHED_FIFO
    }
    locked = "VmLck:\t       0 kB" not in (process / "status").read_text()
    told = "\n".join(stack.log)
    assert bool(named) != ("thread_priority 10 is not permitted" in told)
    assert not named or (process.name not in named and any(name.startswith("dds.") for name in named.values()))
    assert locked != ("lock_memory is not permitted" in told)


def largest_excess(commands, rate):
    """Return by how many Nm a step of torque exceeded `rate` (Nm/s), and how many steps were looked at.

    The compensator may have missed joint states, and the test commands: `n` numbers are at most `n` steps. All zero is
    a compensator that starts anew after 50 ms in which this machine gave it no joint state.
    """
    efforts = np.array([command.effort for command in commands])
    numbers = np.array([to_nanoseconds(command.header.stamp) for command in commands])
    steps = np.abs(np.diff(efforts, axis=0)).max(axis=1)
    anew = ~efforts[1:].any(axis=1)
    excess = steps - rate * LONGEST_STEP * np.diff(numbers)
    return excess[~anew].max(), np.count_nonzero(~anew)


def test_a_thousand_changes_possible_and_not_neither_step_the_torque_nor_stop_the_node(start, watcher, feed):
    stack = start(without=ALONE, compensator={**SEATED, "max_effort": [3.0, 18.0, 9.0, 9.0]})
    feed()
    watcher.until(lambda: watcher.said("compensator", "compensating") and len(watcher.efforts) > 300)
    one_by_one = Service(watcher, SetParameters, "/right/compensator/set_parameters")
    at_once = Service(watcher, SetParametersAtomically, "/right/compensator/set_parameters_atomically")
    taken = 0
    for number, (values, refused) in enumerate(changes(1000)):
        request = [message_of(*item) for item in values.items()]
        results = [at_once(parameters=request).result] if number % 2 else one_by_one(parameters=request).results
        assert all(result.successful or len(result.reason.split()) > 3 for result in results)
        assert not (refused and all(result.successful for result in results)), values
        taken += sum(result.successful for result in results)
    assert stack.launcher.dead() is None
    answered = len(watcher.efforts)
    watcher.until(lambda: len(watcher.efforts) > answered + 20)
    assert taken > 400
    assert all(len(command.effort) == 4 for command in watcher.efforts)
    excess, looked_at = largest_excess(watcher.efforts, rate=50.0)
    assert excess <= 1e-9 and looked_at > 300
    assert np.ptp([command.effort for command in watcher.efforts], axis=0).max() > 2.0  # it did follow


def arms(path, supports):
    """Write a file of compensators alone, one for each side, which carry different shares of a 75 kg wearer."""
    content = {}
    for side, support in supports.items():
        own = {"side": side, "joint_names": [f"{side}_{part}" for part in PARTS], "support": support}
        same = {"mode": "zero_g", "wearer": {"body_mass": 75.0}, "max_effort": [18.0] * 4, "use_imu": False}
        content[f"/{side}/compensator"] = {"ros__parameters": {**own, **same}}
    path.write_text(yaml.safe_dump(content))
    return path


def test_both_arms_carry_their_own_share_of_the_wearer_from_one_file(tmp_path, start, watcher, feed):
    supports = {"right": 0.8, "left": 0.3}
    start(base=arms(tmp_path / "arms.yaml", supports))
    efforts = {"right": watcher.efforts, "left": []}
    watcher.node.create_subscription(JointState, "/left/effort_commands", efforts["left"].append, 1000)
    for side, support in supports.items():
        feed(side)
        expected = gravity_torque(ROBOT.with_wearer(*LOAD, support), POSE)
        watcher.until(lambda e=efforts[side], x=expected: e and np.allclose(e[-1].effort, x, atol=1e-9))
        values = {item.key: item.value for item in watcher.diagnostics[f"/{side}/compensator"].values}
        assert values["support"] == str(support)
        assert values["wearer mass (kg)"] == "0, 0, 2.032, 1.672"


def test_settings_beyond_the_motors_are_warned_of_with_what_would_fit_and_the_clamp_holds(start, watcher, feed):
    stack = start(without=ALONE, compensator=SEATED)
    bridge = rclpy.create_node("can_bridge", namespace="/right", context=watcher.context)
    for param in CAN_BRIDGE:
        bridge.declare_parameter(param.name, param.default)
    watcher.executor.add_node(bridge)
    feed()

    def budget():
        status = watcher.diagnostics.get("/right/compensator")
        return next((item.value for item in status.values if item.key == "budget"), "") if status else ""

    try:
        watcher.until(lambda: budget() == "within rated torque everywhere")
        assert watcher.set("compensator", atomically=True, mode="zero_g", wearer__body_mass=75).successful
        watcher.until(lambda: budget().startswith("beyond"))
    finally:
        watcher.executor.remove_node(bridge)
        bridge.destroy_node()
    needs = "right_shoulder_abduction needs 19.6 Nm in its worst pose (rated 9, peak 18)"
    assert needs in budget() and "the largest support that fits is" in budget()
    watcher.until(lambda: watcher.said("compensator", ", right_shoulder_flexion"))
    watcher.until(lambda: watcher.efforts[-1].effort[2] == 3.0)
    watcher.until(lambda: [line for line in stack.log if needs in line and "WARN" in line])
    watcher.diagnostics.clear()
    watcher.until(budget)  # a report later, it has not been said again
    assert len([line for line in stack.log if needs in line]) == 1


def dumped(watcher, nodes):
    """Return what `ros2 param dump` writes of the nodes."""
    content = {}
    for node in nodes:
        names = Service(watcher, ListParameters, f"{node}/list_parameters")().result.names
        values = Service(watcher, GetParameters, f"{node}/get_parameters")(names=names).values
        tree = content[node] = {"ros__parameters": {}}
        for name, value in zip(names, values, strict=True):
            *branches, leaf = name.split(".")
            twig = tree["ros__parameters"]
            for branch in branches:
                twig = twig.setdefault(branch, {})
            twig[leaf] = parameter_value_to_python(value)
    return content


def test_the_launcher_starts_from_what_param_dump_writes_unchanged(tmp_path, make, start, watcher):
    first = start(compensator={"wearer": {"body_mass": 70.0}})
    nodes = list(yaml.safe_load(first.path.read_text()))
    assert watcher.set("compensator", support=0.3, transition_time=2, atomically=True).successful
    dump = dumped(watcher, nodes)
    first.stop()
    for node in nodes:  # what a dump also has where a publisher's quality of service can be set
        dump[node]["ros__parameters"]["qos_overrides"] = {"/parameter_events": {"publisher": {"depth": 1000}}}
    path = tmp_path / "dump.yaml"
    path.write_text(yaml.dump(dump, default_flow_style=False))
    assert dump["/right/compensator"]["ros__parameters"]["use_sim_time"] is False
    second = make()
    second.path = path
    second.start()
    try:
        assert dumped(watcher, nodes) == dump
        assert simulated_trials(path, SCRIPT)  # and so do the tools
    finally:
        second.stop()
    assert second.dead is None


def test_what_rqt_shows_of_a_parameter_has_its_unit_and_range(start, watcher):
    start(without=ALONE, compensator=SEATED)
    names = [param.name for param in COMPENSATOR]
    told = Service(watcher, DescribeParameters, "/right/compensator/describe_parameters")(names=names).descriptors
    about = {descriptor.name: descriptor for descriptor in told}
    assert all(descriptor.description for descriptor in told)
    time = about["transition_time"]
    assert "in s" in time.description and not time.read_only
    assert (time.floating_point_range[0].from_value, time.floating_point_range[0].to_value) == (0.2, 30.0)
    mass = about["max_total_mass"]
    assert "kg" in mass.description and mass.read_only and mass.floating_point_range[0].to_value == 40.0
    assert about["wearer.mass"].additional_constraints == "4 numbers from 0 to 20"
    assert about["mode"].additional_constraints == "one of one_g, zero_g"
