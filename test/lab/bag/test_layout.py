# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages decoded in bulk, against rosbags, which decodes them one by one: the same numbers, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.lab.bag.layout import Batch, Decoder

from ...support import synthetic_bags as made

TYPES = made.STORE.types
ANY = st.floats(width=64)
NAME = st.text("abcü_1", min_size=1, max_size=9)


def vector(kind, *numbers):
    return TYPES[f"geometry_msgs/msg/{kind}"](*numbers)


def header(draw):
    seconds, nanoseconds = draw(st.integers(-(2**31), 2**31 - 1)), draw(st.integers(0, 2**32 - 1))
    stamp = TYPES["builtin_interfaces/msg/Time"](seconds, nanoseconds)
    return TYPES["std_msgs/msg/Header"](stamp, draw(st.text("abcü/", max_size=9)))


def array(draw, count):
    return np.array(draw(st.lists(ANY, min_size=count, max_size=count)), float)


def joint_state(draw):
    names = draw(st.lists(NAME, max_size=6))
    arrays = (array(draw, len(names) if draw(st.booleans()) else draw(st.integers(0, 3))) for _ in range(3))
    return TYPES[made.JOINT_STATE](header(draw), names, *arrays)


def imu(draw):
    numbers, fields = iter(array(draw, 10).tolist()), []
    for kind, count in (("Quaternion", 4), ("Vector3", 3), ("Vector3", 3)):
        fields += [vector(kind, *(next(numbers) for _ in range(count))), array(draw, 9)]
    return TYPES["sensor_msgs/msg/Imu"](header(draw), *fields)


MAKERS = {
    made.JOINT_STATE: joint_state,
    "sensor_msgs/msg/Imu": imu,
    "geometry_msgs/msg/Vector3Stamped": lambda draw: TYPES["geometry_msgs/msg/Vector3Stamped"](
        header(draw), vector("Vector3", *array(draw, 3).tolist())
    ),
    "std_msgs/msg/Float64": lambda draw: TYPES["std_msgs/msg/Float64"](draw(ANY)),
}


def batch_of(messages):
    length = np.array([len(message) for message in messages])
    data = np.frombuffer(b"".join(messages), np.uint8)
    return Batch(data, np.cumsum(length) - length, length, np.arange(len(messages)))


def field(message, path):
    for name in path.split("."):
        message = getattr(message, name)
    return message


@pytest.mark.parametrize("kind", MAKERS)
@settings(deadline=None, max_examples=30)
@given(st.data())
def test_numbers_and_texts_are_those_that_rosbags_decodes(kind, data):
    written = [MAKERS[kind](data.draw) for _ in range(data.draw(st.integers(1, 4)))]
    messages = [
        bytes(made.STORE.serialize_cdr(message, kind, little_endian=data.draw(st.booleans())))
        for message in written
        for _ in range(data.draw(st.integers(1, 3)))
    ]
    order = data.draw(st.permutations(messages))
    decoder, seen = Decoder(kind), []
    for index, layout, values in decoder.decode(batch_of(order)):
        seen += index.tolist()
        for at, row in zip(index.tolist(), values, strict=True):
            expected = made.STORE.deserialize_cdr(order[at], kind)
            for path in layout.numbers.names or ():
                found, true = np.asarray(row[path]), np.asarray(field(expected, path))
                assert found.astype(true.dtype).tobytes() == true.tobytes()
            for path, texts in layout.texts.items():
                true = field(expected, path)
                assert list(texts) == ([true] if isinstance(true, str) else true)
    assert sorted(seen) == list(range(len(order))) and not decoder.damaged


def test_messages_whose_layout_changes_every_time_are_decoded_one_by_one():
    poses = np.random.default_rng(3).normal(size=(200, 2))
    messages = [made.joint_state(k, ("a", "b"), pose, frame=f"{k:04d}") for k, pose in enumerate(poses)]
    found = np.full_like(poses, np.nan)
    for index, _, values in Decoder(made.JOINT_STATE).decode(batch_of(messages)):
        found[index] = values["position"]
    np.testing.assert_array_equal(found, poses)


@given(st.binary(max_size=40), st.integers(0, 100))
def test_a_damaged_message_is_left_out_and_counted(noise, at):
    whole = [made.joint_state(k, ("a",), [float(k)]) for k in range(3)]
    damaged = (whole[0][: at % len(whole[0])] + noise)[: len(whole[0]) - 1]
    decoder, found = Decoder(made.JOINT_STATE), {}
    for index, _, values in decoder.decode(batch_of([whole[0], damaged, *whole[1:]])):
        found |= {
            at: values["position"][row, 0] for row, at in enumerate(index) if "position" in (values.dtype.names or ())
        }
    assert [found[at] for at in (0, 2, 3)] == [0.0, 1.0, 2.0]
    assert decoder.damaged <= 1
