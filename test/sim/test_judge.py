# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The judge sees each way in which an arm can be let down badly, in made records; the device's own are true."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.frames import ENTER
from exo_gravity.sim import device as device_module
from exo_gravity.sim.device import RECORD, TruthRecords
from exo_gravity.sim.judge import driven, measure

from ..support.simulated_device import joints_of, make_device
from ..support.truth import Truth

FAULT = 10.0  # s
PERIOD = 0.004  # s
END = 8.0  # s, after the last record
ALL = slice(None)
Change = tuple[str, Any, float, float, Any]  # field, joint, begin and end in s since the fault, value or function of it


def let_down(*changes: Change) -> np.ndarray:
    """Return 8 s of an arm that is carried, lowered under damping after a fault, and switched off after 4 s."""
    records = np.zeros(8000, RECORD)
    records["time"] = FAULT - 0.1 + 0.001 * np.arange(8000)
    since = records["time"] - FAULT
    records["on"] = (since < 4.0)[:, None]
    records["frames"] = (np.arange(8000) // 4)[:, None]
    records["damping"] = np.where((since >= 0.02) & (since < 4.0), 5.0, 0.0)[:, None]
    records["velocity"][:, 1] = np.where((since > 0.0) & (since < 3.0), -0.3, 0.0)
    records["torque"] = -records["damping"] * records["velocity"]
    records["torque"][:, 1] += 3.3 * np.clip(1.0 - np.maximum(since, 0.0) / 2.0, 0.0, 1.0)
    for field, joint, begin, end, value in changes:
        during = (since >= begin) & (since < end)
        records[field][during, joint] = value(since[during]) if callable(value) else value
    return records


RELEASED = ("wearer", 3, -1.0, 1.0, 1.0), ("velocity", 3, -1.0, 1.5, lambda s: np.clip(6.0 - 4.0 * s, 0.0, 2.0))
UNDAMPED = ("damping", 1, -1.0, END, 0.0)
STEP = ("torque", 1, 1.0, END, 0.0)  # of 1.65 Nm and 1.5 Nm of damping; a frame may change 0.2, and codes 0.02
MEASURED: dict[str, tuple[tuple[Change, ...], dict[str, Any], dict[str, Any]]] = {
    "let down well": (
        (), {}, {"reaction": 0.02, "off": 4.0, "top_speed": 0.3, "excess": 0.0, "energy": 0.0, "gap": 0.001},
    ),
    "a motor that does not react": ((UNDAMPED,), {}, {"reaction": 4.0}),
    "a motor that no frame reaches": ((UNDAMPED,), {"unreached": (1,)}, {"reaction": 0.02}),
    "no motor that a frame reaches": ((UNDAMPED,), {"unreached": range(4)}, {"reaction": None}),
    "switched off under torque": (
        tuple((field, ALL, 0.5, END, 0) for field in ("on", "torque", "damping")), {},
        {"largest_step": 2.475 + 1.5, "off": 0.5},
    ),
    "damping at the peak torque": (
        (("velocity", 0, 1.0, 1.2, 3.0), ("torque", 0, 1.0, 1.2, -9.0)), {}, {"excess": 0.0},
    ),
    "a step of torque": ((STEP,), {}, {"largest_step": 3.15, "excess": 3.15 - 0.2 - 0.0176}),
    "a step after many frames": (
        (STEP, ("frames", ALL, 1.0, END, lambda s: np.round(1000.0 * s)[:, None] // 4 + 65)), {}, {"excess": 0.0},
    ),
    "a step before torques count": ((STEP,), {"steps_from": 1.1}, {"excess": 0.0}),
    "speed before the fault": ((("velocity", 2, -1.0, -0.05, 3.0),), {}, {"top_speed": 0.3}),
    "a fall after the motors were off": ((("velocity", 3, 6.0, END, 2.5),), {}, {"top_speed": 2.5, "fastest": 4}),
    "a fall without power": ((("velocity", 3, 6.0, END, 2.5),), {"unpowered": (3,)}, {"top_speed": 0.3}),
    "speed that the wearer gave": (RELEASED, {}, {"top_speed": 0.0, "driven": 0.0, "energy": 0.0}),
    "speed that a motor gave": (
        (*RELEASED, ("velocity", 3, 1.6, 1.9, 0.9), ("torque", 3, 1.6, 1.9, 2.0)), {}, {"driven": 0.9},
    ),
    "speed that a motor brakes": (
        (*RELEASED, ("velocity", 3, 1.6, 1.9, 0.9), ("torque", 3, 1.6, 1.9, -2.0)), {},
        {"top_speed": 0.9, "driven": 0.0},
    ),
    "a motor that is on again": ((("on", 2, END - 0.2, END, True),), {}, {"off": None, "re_enabled": True}),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "given", "found"), MEASURED.values(), ids=MEASURED)
def test_each_way_of_letting_an_arm_down_badly_is_measured(changes, given, found):
    response = measure(let_down(*changes), FAULT, PERIOD, **given)
    assert {name: getattr(response, name) for name in found} == pytest.approx(found, abs=0.01)


def pushed(torque: float, speed: Any, begin: float = 1.0, end: float = 2.0, weight: float = 0.0) -> tuple[Change, ...]:
    """Return that motor 3 gives `torque` while its joint moves at `speed`."""
    values = {"torque": torque, "velocity": speed, "weight": weight}
    return tuple((field, 2, begin, end, value) for field, value in values.items())


SWUNG = (0.5, 0.9, 1.0, 1.2)
STOPS = {"stops": ((-1.0,) * 4, (1.0,) * 4)}
STRUCK = (  # joint 2 falls into its stop, which gives joint 3 its speed
    ("torque", 1, -1.0, END, 0.0), ("velocity", 1, -1.0, END, 0.0), ("velocity", 1, 1.0, 2.0, 3.0),
    ("position", 1, 1.99, 2.0, 1.0),
    *pushed(0.3, 2.0, 1.99, 2.2),
)  # fmt: skip
DRIVEN: dict[str, tuple[tuple[Change, ...], dict[str, Any], dict[str, Any]]] = {
    "a motor that drives": (pushed(2.0, 0.5), {}, {"energy": 1.0, "speed": 0.5, "power": 1.0, "joint": 3}),
    "a motor that brakes": (pushed(-2.0, 0.5), {}, {"energy": 0.0, "speed": 0.0}),
    "the longest of three stretches": (
        (*pushed(2.0, 0.5, 1.0, 1.5), *pushed(2.0, 0.4, 2.0, 3.0), *pushed(2.0, 0.09, 4.5, 6.5)), {}, {"energy": 0.8},
    ),
    "damping that drives": (
        (
            ("torque", 1, -1.0, END, 0.0), ("velocity", 1, -1.0, END, 0.0),
            ("torque", 1, 1.0, 1.5, -1.5), ("velocity", 1, 1.0, 1.5, -0.3),
        ),
        {},
        {"speed": 0.3, "energy": 0.5 * 1.5 * 0.3, "damping": 1.5 / 9.0, "joint": 2},
    ),
    "what a motor adds to a fall": (
        (*pushed(0.0, lambda s: 3.0 * (s - 1.0)), ("torque", 2, 1.5, 2.0, 1.0)), {}, {"speed": 1.5},
    ),
    "a throw": (pushed(*SWUNG), {}, {"speed": 0.9}),
    "less than the weight that others swing up": (pushed(*SWUNG, weight=0.6), {}, {"speed": 0.0}),
    "more than the weight": (pushed(*SWUNG, weight=0.4), {}, {"speed": 0.9}),
    "a motor that helps gravity": (pushed(*SWUNG, weight=-0.6), {}, {"speed": 0.9}),
    "energy below the speed that counts": (pushed(2.0, 0.3), {"slow": 0.35}, {"energy": 0.0, "speed": 0.3}),
    "the weight, on a trunk that turns": (pushed(2.0, 0.3, weight=1.9), {"turning": True}, {"energy": 0.03}),
    "a stop": (STRUCK, STOPS, {"speed": 0.0}),
    "a stop of which nothing is known": (STRUCK, {}, {"speed": 2.0}),
    "a stop into which a motor threw": ((*STRUCK, ("torque", 1, 1.0, 1.99, 3.0)), STOPS, {"speed": 3.0}),
    "throws and catches by turns": (
        (*pushed(1.0, lambda s: s - 1.0), ("torque", 2, 1.0, 2.0, lambda s: np.where(250.0 * s % 2 < 1.0, 1.0, -1.0))),
        {}, {"speed": 1.0, "energy": 0.25},
    ),
    "what the wearer moves": ((*RELEASED, ("torque", 3, -1.0, 1.0, 3.0)), {}, {"energy": 0.0}),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "given", "found"), DRIVEN.values(), ids=DRIVEN)
def test_what_motors_did_to_the_arm_is_told_from_what_a_hand_gravity_or_a_stop_did(changes, given, found):
    done = driven(let_down(*changes), **given)
    assert {name: getattr(done, name) for name in found} == pytest.approx(found, abs=0.02)


def test_every_physics_step_is_logged_with_wall_time_motion_torque_damping_and_motor_state(tmp_path, monkeypatch):
    monkeypatch.setattr(device_module, "time", SimpleNamespace(time=lambda: 5000.0))
    device, log = make_device(), Truth(tmp_path / "truth.bin")
    device.truth = TruthRecords(log.path)
    device.arm.reset((0.0, 1.0, 0.0, 0.0))
    device.exchange(2, joints_of((MIT,) * 4)[1].command(2.0, 1.5))
    device.exchange(2, ENTER)
    device.advance(0.5)
    records = log.since(0.0)
    assert len(records) >= 450
    np.testing.assert_allclose(np.diff(records["time"]), 0.001, atol=1e-5)
    assert records["on"][-1].tolist() == [False, True, False, False] and not log.motors_are_off()
    assert records["frames"][-1].tolist() == [0, 2, 0, 0]
    assert records["damping"][-1, 1] == pytest.approx(1.5, abs=0.01)
    effort = records["torque"][:, 1] + records["damping"][:, 1] * records["velocity"][:, 1]
    np.testing.assert_allclose(effort, 2.0, atol=0.02)
    np.testing.assert_allclose(records["weight"][-1], device.arm.weight, atol=0.02)
    with pytest.raises(ParameterError, match="truth"):
        TruthRecords(tmp_path / "missing" / "truth.bin")
