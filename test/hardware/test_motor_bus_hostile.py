# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A bus full of foreign frames: only the motors' replies are read.

A reply has 6, 7 or 8 bytes, of which only the first, the motor's ID, is known in advance. A foreign frame of that
length, with that first byte and the arbitration ID of that motor or of the master, looks like a reply. Of random frames
with random IDs these are 3/9 x 4/256 x 2/2048, five in a million; of random 8-byte frames with ID 0, one in 64. The
last test shows how the safety limits treat them.
"""

from __future__ import annotations

import random
from collections import Counter

import can
import pytest

from exo_gravity.core.motors.frames import ENTER, EXIT, SET_ZERO
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.trust import Readings
from exo_gravity.sim.virtual_time import Wire

from ..support.simulated_device import OFF
from ..support.thorough import quick
from .test_motor_bus import MOTORS_OF_ARM as JOINTS
from .wires import motor_bus

IDS = {joint.can_id for joint in JOINTS}
MASTER = 0
POSE = (0.1, 0.2, 0.3, 0.4)
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
FRAMES, BURST = 5_000, 10  # in total, and in a cycle: half of them wait for it
LIMITS = Limits(tuple("1234"), (-1.65, -0.17, -0.78, -0.17), (1.65, 3.14, 2.53, 3.14), (5.0,) * 4, (3.0, 9.0, 3.0, 3.0))


def foreign_frame(rng: random.Random) -> can.Message:
    """Return a frame of any kind; half of them resemble what a motor sends or receives."""
    near = rng.random() < 0.5
    can_id = rng.choice((MASTER, *IDS, 5, 127)) if near else rng.randrange(2048)
    data = rng.randbytes(rng.choice((5, 6, 7, 8)) if near else rng.randrange(9))
    if near and rng.random() < 0.3:
        data = bytes((rng.choice((*IDS, 5)),)) + data[1:]
    kind = rng.choice(("classic", "classic", "command", "extended", "remote", "error", "fd"))
    if kind == "command":
        joint = rng.choice(JOINTS)
        special = rng.choice((ENTER, EXIT, SET_ZERO, joint.command(rng.uniform(-3, 3), rng.uniform(0, 5))))
        return can.Message(arbitration_id=joint.can_id, data=special, is_extended_id=False)
    if kind == "remote":
        return can.Message(arbitration_id=can_id, dlc=rng.randrange(9), is_remote_frame=True, is_extended_id=False)
    if kind == "fd":
        data = rng.randbytes(rng.choice(FD_LENGTHS))
        return can.Message(arbitration_id=can_id, data=data, is_fd=True, is_extended_id=False)
    if kind == "extended":
        can_id |= rng.getrandbits(18) << 11
    return can.Message(
        arbitration_id=can_id, data=data, is_extended_id=kind == "extended", is_error_frame=kind == "error"
    )


def looks_like_reply(message: can.Message) -> bool:
    """Return whether the frame has the layout of a motor's reply in the manual."""
    if message.is_extended_id or message.is_remote_frame or message.is_error_frame or message.is_fd:
        return False
    data = bytes(message.data)
    return len(data) in (6, 7, 8) and data[0] in IDS and message.arbitration_id in (MASTER, data[0])


def test_among_frames_of_every_kind_exactly_those_with_the_layout_of_a_reply_are_read() -> None:
    """The manual's layout is the independent reference."""
    wire, rng, found = Wire(), random.Random(3), Counter()
    bus = motor_bus(wire, JOINTS)
    for _ in range(FRAMES // BURST):
        burst = [foreign_frame(rng) for _ in range(BURST)]
        before = list(bus.samples)
        for message in burst[: BURST // 2]:
            wire.carry(None, message)
        bus.exchange(OFF, wire.clock.monotonic())
        for message in burst[BURST // 2 :]:
            wire.carry(None, message)
        bus.receive_until(wire.clock.monotonic() + 0.001)
        replies = [message for message in burst if looks_like_reply(message)]
        changed = {joint + 1 for joint in range(4) if bus.samples[joint] is not before[joint]}
        assert changed == {message.data[0] for message in replies}
        found.update(reply=len(replies), foreign=BURST - len(replies))
        assert sum(bus.ignored.values()) == found["foreign"]
    assert found["reply"] > 20
    assert set(bus.ignored) == {"foreign command", "error frame", "FD frame", "foreign frame", "malformed reply"}


@pytest.mark.parametrize(("length", "most"), quick([(8, 0.0001)], [(8, 0.0001), (6, 0.005)]))
def test_a_forged_reply_with_random_values_is_nearly_always_a_fault(length, most):
    """At 250 cycles a second, with the arm at rest in `POSE`."""
    rng, count, unseen = random.Random(5), 20_000, 0
    before = [JointSample(angle, 0.0, 0.0, 30, 0, 1.0) for angle in POSE]
    for _ in range(count):
        joint = rng.randrange(4)
        sample = JOINTS[joint].sample(bytes((joint + 1,)) + rng.randbytes(length - 1), 1.004)
        readings = Readings(LIMITS)
        for time in (0.996, 1.0):
            readings.step(time, [known._replace(time=time) for known in before], (False,) * 4)
        readings.step(1.004, [sample if n == joint else known for n, known in enumerate(before)], (False,) * 4)
        unseen += readings.joints[joint] is sample
    assert unseen / count <= most
