"""A serial adapter (slcan) on a pseudo-terminal: frames of both formats pass, and it may be unplugged and come back."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.motors.specs import pack_reply
from exo_gravity.core.motors.wire_formats import MIT, MIT_V3
from exo_gravity.core.safety.drive import NOTHING, OFF, Drive
from exo_gravity.hardware.can.motor_bus import MotorBus, open_bus
from exo_gravity.sim import ArmConfig, Firmware, SimulatedDevice

from ..support.fake_slcan import FakeSlcan
from ..support.simulated_device import SPECS, joints_of, make_device

MIXED = (MIT, MIT_V3, MIT_V3, MIT)
OPTIONS = {"bitrate": 1_000_000, "sleep_after_open": 0.01, "timeout": 0.0002}
POSE = (0.1, 0.2, 0.3, 0.4)
ON = Drive((0.0, 0.5, 0.4, 0.0), NOTHING, True)
LINKS = ArmConfig().links
WEIGHTLESS = ArmModel(LINKS.length, LINKS.cog, LINKS.mass, gravity=0.0)
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

    bus = MotorBus(reopen(), joints_of(MIXED), reopen=reopen)
    wait_until(lambda: adapter.is_open)  # python-can does not wait for it
    yield bus
    bus.close()


def test_frames_with_11_and_29_bit_ids_pass_the_adapter_both_ways(adapter, device, motors) -> None:
    assert motors.exchange(ON, in_1_s())
    assert motors.exchange(ON, in_1_s())
    assert [sample.position for sample in motors.samples] == pytest.approx(POSE, abs=0.01)
    assert [sample.effort for sample in motors.samples] == pytest.approx(ON.effort, abs=0.02)
    assert [motor.entered for motor in device.motors] == [True] * 4
    assert adapter.kbit_s == 1000
    assert not motors.ignored


def test_after_the_adapter_was_unplugged_and_plugged_in_again_the_motors_are_reached(adapter, device, motors) -> None:
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
    end = time.monotonic() + 20.0
    while motors.may_be_powered and time.monotonic() < end:
        try:
            motors.exchange(OFF, in_1_s())
        except BusError:
            time.sleep(0.02)
    assert not motors.may_be_powered and not device.powered


@pytest.mark.parametrize("acknowledges", [True, False])
def test_an_acknowledgement_does_not_hide_a_late_reply(adapter, motors, channel, acknowledges) -> None:
    adapter.acknowledges = acknowledges
    motors.exchange(OFF, time.monotonic())
    with can.Bus(interface="virtual", channel=channel) as other:
        for spec, can_id in zip(SPECS, (1, 4), strict=False):
            data = pack_reply(spec, can_id, 0.0, 0.0, 0.0)
            other.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        port = motors._port._bus.serialPortOrig
        wait_until(lambda: port.in_waiting >= 36)  # both replies, of 18 characters each
        assert not motors.exchange(OFF, time.monotonic())
    assert [sample.time > 0.0 for sample in motors.samples] == [True, False, False, True]
    assert not motors._answered


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)
