# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A serial adapter (slcan) on a pseudo-terminal: frames of both formats pass, and it may be unplugged and come back."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.frames import ID_BITS, MotorReply
from exo_gravity.core.safety.drive import Send
from exo_gravity.hardware.can.can_port import CanPort, open_bus
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.sim import ArmConfig, Firmware, SimulatedDevice

from ..support.fake_slcan import FakeSlcan
from ..support.simulated_device import OFF, drive_of, joints_of, make_device, sending
from ..support.waiting import pause, wait_until
from .test_motor_bus import WEIGHTLESS

MIXED = (MIT, MIT_V3, MIT_V3, MIT)
OPTIONS = {"bitrate": 1_000_000, "sleep_after_open": 0.01, "timeout": 0.0002}
POSE = (0.1, 0.2, 0.3, 0.4)
FIRST_FRAMES = 2  # to motors that are off: a command for those that reply to one
ON = drive_of((0.0, 0.5, 0.4, 0.0))
CHANNELS = itertools.count()


def in_1_s() -> float:
    return time.monotonic() + 1.0


@pytest.fixture
def channel() -> str:
    return f"slcan-{next(CHANNELS)}"


@pytest.fixture
def adapter(tmp_path: Path, channel: str) -> Iterator[FakeSlcan]:
    with can.Bus(interface="virtual", channel=channel) as wire:
        adapter = FakeSlcan(tmp_path / "ttyACM0", wire)
        yield adapter
        adapter.close()


@pytest.fixture
def device(channel: str) -> Iterator[SimulatedDevice]:
    config = ArmConfig(links=WEIGHTLESS, coulomb_friction=(5.0,) * 4)
    device = make_device(Firmware(status_rate=50.0), config=config, formats=MIXED)
    device.arm.reset(POSE)
    stop = threading.Event()
    with can.Bus(interface="virtual", channel=channel) as bus:
        thread = threading.Thread(target=device.run, args=(bus, stop.is_set))
        thread.start()
        yield device
        stop.set()
        thread.join()


@pytest.fixture
def motors(adapter: FakeSlcan, tmp_path: Path) -> Iterator[MotorBus]:
    def reopen() -> can.BusABC:
        return open_bus("slcan", str(tmp_path / "ttyACM0"), OPTIONS)

    bus = MotorBus([CanPort(reopen(), COMPUTER_CLOCK, reopen)] * len(MIXED), joints_of(MIXED))
    wait_until(lambda: adapter.is_open)  # python-can does not wait for it
    yield bus
    bus.close()


def test_frames_with_11_and_29_bit_ids_pass_the_adapter_both_ways(adapter, device, motors) -> None:
    motors.exchange(sending(Send.ENTER), in_1_s())
    assert motors.exchange(ON, in_1_s())
    assert motors.exchange(ON, in_1_s())
    assert [sample.position for sample in motors.samples] == pytest.approx(POSE, abs=0.01)
    assert [sample.effort for sample in motors.samples] == pytest.approx(ON.effort, abs=0.02)
    assert [motor.entered for motor in device.motors] == [True] * 4
    assert adapter.kbit_s == 1000
    assert not motors.ignored


def test_after_the_adapter_was_unplugged_and_plugged_in_again_the_motors_are_reached(adapter, device, motors) -> None:
    motors.exchange(sending(Send.ENTER), in_1_s())
    assert motors.exchange(ON, in_1_s())
    adapter.unplug()
    errors = [""]
    while "opening it again" not in errors[-1]:  # the first errors are not yet a failed bus
        with pytest.raises(BusError) as caught:
            motors.exchange(ON, in_1_s())
        errors.append(str(caught.value))
    assert all(error.startswith("CAN bus slcan ") and "ttyACM0: Could not" in error for error in errors[1:])
    assert device.powered  # the motors keep their last command
    adapter.plug_in()

    def switch_off() -> None:
        with contextlib.suppress(BusError):
            motors.exchange(sending(Send.EXIT), in_1_s())
        pause()

    wait_until(lambda: not device.powered, switch_off)


@pytest.mark.parametrize("acknowledges", [True, False])
def test_an_acknowledgement_does_not_hide_late_replies_which_are_not_taken_for_new_ones(
    adapter, motors, channel, acknowledges
) -> None:
    adapter.acknowledges = acknowledges
    motors.exchange(OFF, time.monotonic())
    wait_until(lambda: adapter.passed == FIRST_FRAMES)
    unread, lengths = adapter.unread, 0
    with can.Bus(interface="virtual", channel=channel) as other:
        for joint in joints_of(MIXED):
            data = joint.wire_format.pack_reply(joint.spec, MotorReply(joint.can_id, 0.0, 0.0, 0.0, 30, 0))
            reply_id = joint.can_id if joint.wire_format is MIT else MIT_V3.reply_id(joint.can_id) & ID_BITS
            other.send(can.Message(arbitration_id=reply_id, data=data, is_extended_id=joint.wire_format is MIT_V3))
            lengths += 22 if joint.wire_format is MIT else 27  # characters
        wait_until(lambda: adapter.unread >= unread + lengths)
        assert not motors.exchange(OFF, time.monotonic())
    assert all(sample.time > 0.0 for sample in motors.samples)
