"""What a recording shows of its arms: when each was carried, faults, changed parameters, parameters at the start."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.lab.bag.reader import read_bag

from ...support import synthetic_bags as made


def status(level, text, **values):
    """Topic, type and bytes of a bridge's diagnostics."""
    types = made.STORE.types
    pairs = [types["diagnostic_msgs/msg/KeyValue"](key=key, value=value) for key, value in values.items()]
    entry = types["diagnostic_msgs/msg/DiagnosticStatus"](level, "right/can_bridge", text, "", pairs)
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    message = types[kind](types["std_msgs/msg/Header"](stamp=stamp, frame_id=""), [entry])
    return "/diagnostics", kind, bytes(made.STORE.serialize_cdr(message, kind))


def test_an_arm_is_carried_from_the_first_to_the_last_carrying_state(content, tmp_path):
    states = ["checking", "ramping in", "active", "active", "letting down", "fault", "checking", "active", "active"]
    for tenth, state in enumerate(states):
        topic, kind, data = status(0, state, state=state)
        content = [*content, (topic, kind, made.START + tenth * 10**8, data)]
    content.sort(key=lambda item: item[2])
    arrival = 0.0002  # s, of the first joint state, at which time begins
    expected = [(0.1 - arrival, 0.3 - arrival), (0.7 - arrival, 0.8 - arrival)]
    np.testing.assert_allclose(made.only(made.write_bag(tmp_path / "bag", content)).carried, expected, atol=1e-9)


def with_states(content, *states):
    """The content with the bridge's state added every half second from 0.1 s on; None for no report."""
    for number, state in enumerate(states):
        if state:
            topic, kind, data = status(0, state, state=state)
            content = [*content, (topic, kind, made.START + 10**8 + number * 5 * 10**8, data)]
    return sorted(content, key=lambda item: item[2])


def until(content, seconds):
    return [item for item in content if item[2] < made.START + round(seconds * 1e9)]


def test_an_arm_that_is_carried_when_the_recording_ends_was_not_let_down_in_it(content, tmp_path):
    read = read_bag(made.write_bag(tmp_path / "bag", until(with_states(content, *["active"] * 20), 4.35)))
    (arm,) = read.recordings
    assert arm.carried == ((pytest.approx(0.0998), arm.time[-1]),)
    assert read.notes == (
        "right: the recording ends while the arm is carried: it does not show how the arm was let down",
    )


def test_a_recording_that_ends_in_the_descent_does_not_claim_that_the_arm_came_down(content, tmp_path):
    states = ["active"] * 6 + ["letting down"] * 3
    read = read_bag(made.write_bag(tmp_path / "bag", until(with_states(content, *states), 4.35)))
    assert read.notes == ("right: the recording ends before the arm was down",)


@pytest.mark.parametrize("last", ["disabled", "fault", None])
def test_an_arm_that_is_off_at_the_end_or_still_observed_gets_no_note(content, tmp_path, last):
    states = ["active"] * 4 + [last] * 5
    assert not read_bag(made.write_bag(tmp_path / "bag", until(with_states(content, *states), 4.35))).notes


def test_faults_changed_parameters_and_parameters_at_the_start_are_read(content, tmp_path):
    types = made.STORE.types
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)

    def change(name, value):
        nothing = {
            "bool_value": False,
            "integer_value": 0,
            "string_value": "",
            "byte_array_value": np.zeros(0, np.uint8),
        }
        nothing.update(bool_array_value=np.zeros(0, bool), integer_array_value=np.zeros(0, np.int64))
        nothing.update(double_array_value=np.zeros(0), string_array_value=[])
        value = types["rcl_interfaces/msg/ParameterValue"](type=3, double_value=value, **nothing)
        parameter = types["rcl_interfaces/msg/Parameter"](name=name, value=value)
        kind = "rcl_interfaces/msg/ParameterEvent"
        message = types[kind](stamp, "/right/compensator", [], [parameter], [])
        return "/parameter_events", kind, bytes(made.STORE.serialize_cdr(message, kind))

    snapshot = "/right/compensator:\n  ros__parameters: {law: exact}\n"
    messages = [
        (1.0, ("/recorder/parameters", "std_msgs/msg/String", made.string(snapshot))),
        (2.0, status(0, "fine")),
        (3.0, status(2, "motor 2 is silent")),
        (3.5, status(2, "motor 2 is silent")),
        (4.0, status(0, "fine")),
        (5.0, change("support", 0.5)),
    ]
    extra = [(topic, kind, made.START + 200_000 + round(s * 1e9), data) for s, (topic, kind, data) in messages]
    read = read_bag(made.write_bag(tmp_path / "bag", sorted([*content, *extra], key=lambda item: item[2])))
    assert [(round(event.time, 6), event.text) for event in read.events] == [
        (3.0, "right/can_bridge: motor 2 is silent"),
        (4.0, "right/can_bridge: OK, fine"),
        (5.0, "/right/compensator: support = 0.5"),
    ]
    assert read.parameters == {"/right/compensator": snapshot}
