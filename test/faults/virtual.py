# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The fault matrix in virtual time: the arm that is struck, and how faults are caused by the events of the rig."""

from __future__ import annotations

import functools
import random
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import can
import numpy as np

from exo_gravity.core.motors.damiao import DAMIAO_MIT
from exo_gravity.core.safety.command import Efforts, FaultCode, State
from exo_gravity.core.safety.lease import Lease
from exo_gravity.lab.inputs.arms import node_values, read_arm
from exo_gravity.lab.inputs.parameter_file import Nodes, load
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.params import device_of, simulator_table
from exo_gravity.sim.rig import ACTS, HOLD, Rig

from ..support import CONFIG
from ..support.copies import copied
from . import fault_case
from .fault_case import BEFORE, Action, Arm, FaultCase, Parameters, Played, acting, in_turn, pause

TIMEOUTS: dict[str, Parameters] = {  # those of a real device
    "can_bridge": {"command_timeout": 0.05, "frozen_timeout": 0.08, "enable_timeout": 10.0, "sign_check_torque": 0.0},
    "compensator": {"tilt_timeout": 0.08},
}
STEADY = 1.25  # s after a move in which the arm comes to rest
GYRO_BIAS = 1e-3  # rad/s, as an ordinary IMU has at least
FALLING = 0.2  # rad/s of the struck joint, from which on an arm is on its way down
RESTS = 1e-3  # rad/s
AK_ERROR, DAMIAO_ERROR = 5, 0xB


class OuterLoop:
    """Assists an arm by `efforts` (n,) Nm every 0.01 s, until it is `silent`, as node compensator takes the messages.

    others: efforts of a second one, whose messages come between, None without one.
    """

    def __init__(self, rig: StruckArm, efforts: Sequence[float]) -> None:
        self.efforts, self.silent = efforts, False
        self.others: Sequence[float] | None = None
        self._rig = rig
        rig.clock.every(0.01, self._send)

    def _send(self) -> None:
        rig, names = self._rig, self._rig.names
        if not self.silent:
            rig.assist.receive(rig.now, names, self.efforts, rig.now, self.others is not None)
        if self.others is not None:
            rig.assist.receive(rig.now, names, self.others, rig.now, True)


def parameters_of(arm: Arm) -> dict[str, dict[str, Any]]:
    """Return the parameters of the right arm's nodes."""
    nodes = {name: dict(values) for name, values in load(CONFIG / arm.base).items()}
    for node in ("can_bridge", "compensator", "simulator"):
        nodes[f"/right/{node}"] |= {**TIMEOUTS.get(node, {}), **getattr(arm, node)}
    nodes["/right/can_bridge"]["rate"] = arm.rate
    return nodes


def device_from(nodes: Nodes) -> SimulatedDevice:
    """Return the simulated device of the right arm."""
    name = "/right/simulator"
    return device_of(node_values(nodes, name, simulator_table(nodes[name])))


class StruckArm(Rig):
    """An arm of the matrix."""

    def __init__(self, arm: Arm) -> None:
        self.arm, self.struck, self.nodes = arm, arm.struck, parameters_of(arm)
        carried = read_arm(self.nodes, "/right")
        self.joint_motors = carried.motors
        super().__init__(device_from(self.nodes), carried.settings, carried.motors, carried.limits, arm.rate)
        self.names = carried.limits.joint_names
        self.assist = self.compensator.terms.assist
        self.outer_loop = OuterLoop(self, arm.assisted) if arm.assisted else None
        self.gyro_bias = GYRO_BIAS
        self.run(0.2)

    def set_parameters(self, values: Parameters) -> None:
        """Set parameters of the compensator together, as the operator would. Raises ParameterError."""
        nodes = {**self.nodes, "/right/compensator": {**self.nodes["/right/compensator"], **values}}
        self.settings = read_arm(nodes, "/right").settings
        self.compensator.apply(self.settings)
        self.nodes = nodes

    def bring_to(self, stage: str) -> None:
        """Bring the hanging arm to a state of its bridge."""
        if stage == "started":
            return
        if stage in ("active", "letting down"):
            self.take_home()  # on a tilted trunk a light or worn arm swings, or hangs beyond its limits
            self.carry()
            over = max(1.0, max(map(abs, self.arm.pose)) / 2.0)  # s: slower than is a fault
            self.act({"move": list(self.arm.pose), "over": over}, {"hold": HOLD})
            self.run(over + STEADY)
            assert self.state is State.ACTIVE, self.fault
        else:
            self.between_cycles(self.safety.enable)
            is_there = self.run_until(lambda: self.state.value == stage, 30.0)
            assert is_there, f"{self.state}, not {stage}: {self.safety.fault or self.safety.waiting_for}"
        if stage == "proving signs":  # which begins with motors that are still off
            assert self.run_until(lambda: all(motor.entered for motor in self.motors), 5.0)

    def take_home(self) -> None:
        """Let the wearer bring the arm near to hanging, and keep it there."""
        home = [0.0, *[0.05] * (len(self.motors) - 1)]
        self.act(*({"move": home, "over": over} for over in (1.0, 20.0)))
        self.run(1.2)

    def are_off(self) -> bool:
        """Return whether every motor is off."""
        return not self.device.powered

    def rests(self) -> bool:
        """Return whether every motor is off, and nothing moves."""
        self.catch_up()
        return self.are_off() and max(map(abs, self.device.arm.velocities)) < RESTS

    @property
    def outcome(self) -> str:
        """The code of the latched fault, or the bridge's state."""
        return self.fault if self.state is State.FAULT else self.state.value

    def motion(self, since: float) -> np.ndarray:
        """Return the truth records since a time in s."""
        self.catch_up()
        records = self.truth.records
        return records[records["time"] >= since]

    def trouble(self, _since: float) -> list[str]:
        """Return what is unsafe whatever the motion was."""
        return [f"exception: {self.loop.failure}"] * (self.loop.failure is not None)


def brought(arm: Arm, stage: str) -> StruckArm:
    """Return an arm that was brought to a stage."""
    rig = StruckArm(arm)
    rig.bring_to(stage)
    rig.forget()
    return rig


carried = functools.cache(partial(brought, stage="active"))


def struck_arm(arm: Arm, stage: str, is_fresh: bool = False) -> StruckArm:
    """Return an arm at a stage; those that are carried begin as copies of one, unless one is to be fresh."""
    if stage not in ("active", "letting down"):
        return brought(arm, stage)
    rig = brought(arm, "active") if is_fresh else copied(carried(arm))
    if stage == "letting down":
        rig.between_cycles(rig.safety.disable)
        assert rig.run_until(lambda: abs(rig.device.arm.velocities[rig.struck]) > FALLING, 10.0)
    else:
        rig.run(BEFORE)
    return rig


def play(case: FaultCase, is_fresh: bool = False) -> Played:
    """Play a row, on a fresh arm if asked."""
    rig = struck_arm(case.arm, case.stage, is_fresh)
    try:
        return fault_case.play(case, rig)
    finally:
        rig.bus.close()


def happens(name: str, **values: Any) -> Action:
    """Let an event of the shared vocabulary happen; a value may be a function of the rig."""
    return lambda rig: ACTS[name](rig, **{key: each(rig) if callable(each) else each for key, each in values.items()})


def struck(rig: StruckArm) -> int:
    """Return the joint that is struck."""
    return rig.struck


def error_code(rig: StruckArm) -> int:
    """Return the code of an error of the struck motor."""
    return DAMIAO_ERROR if rig.motors[rig.struck].joint.spec.family == DAMIAO_MIT.family else AK_ERROR


@acting
def power(rig: StruckArm, on: bool, *joints: int) -> None:
    """Switch the supply of these motors, by default of all; the encoders keep their turns."""
    rig.catch_up()
    for joint in joints or range(len(rig.motors)):
        rig.motors[joint].unplugged = not on


def freeze(rig: StruckArm) -> None:
    """Let the compensator answer no more: its last efforts grow old."""
    last = rig.direct.efforts(rig.now)
    rig.controller.change = lambda answer: last


def resume(rig: StruckArm) -> None:
    """Let it answer again."""
    rig.controller.change = None


@acting
def change_efforts(rig: StruckArm, change: Callable[[float, Sequence[float]], Sequence[float]]) -> None:
    """Spoil all efforts: change(now, efforts) gets s and (n,) Nm."""

    def changed(answer: Efforts) -> Efforts:
        return answer._replace(effort=tuple(change(rig.now, answer.effort))) if answer.effort else answer

    rig.controller.change = changed


def exit_frame(rig: StruckArm) -> None:
    """Send the frame that switches the struck motor off, as another host would."""
    rig.send(rig.motors[rig.struck].joint.exit[-1])


def foreign(torque: float) -> Action:
    """Command the struck motor as another host would: `torque` Nm, 500 times a second for 2 s."""
    return in_turn(happens("foreign_torque", joint=struck, torque=torque, rate=500.0, duration=2.0), pause(2.0))


@acting
def random_frames(rig: StruckArm, ids: Iterable[int], count: int = 6000, rate: float = 3000.0) -> None:
    """Send frames of random length and content under random `ids`, `rate` a second."""
    dice, known = random.Random(1), list(ids)
    for number in range(count):
        data, is_long = dice.randbytes(dice.randrange(9)), dice.random() < 0.2
        message = can.Message(arbitration_id=dice.choice(known), data=data, is_extended_id=is_long)
        rig.clock.later(number / rate, partial(rig.wire.carry, None, message))


def control_dies(rig: StruckArm) -> None:
    """Let someone hold control for 1 s, who then dies; node can_bridge watches the lease."""
    lease, end = Lease(), rig.now + 1.0

    def watch() -> None:
        if rig.now < end:
            lease.request(rig.now, "the operator", "hold")
        elif reason := lease.lost(rig.now):
            rig.safety.trip(FaultCode.CONTROL_LOST, reason, rig.now)

    rig.clock.every(0.1, watch)
    rig.run(1.0)


CUT_OFF = happens("cut_off", motors=lambda rig: [rig.struck])
CONNECT = happens("cut_off", motors=())
RESTART, SHORT_RESTART = (happens("unplugged", joint=struck, duration=duration) for duration in (0.03, 0.015))
CUT, RELEASE = power(False), power(True)
SILENCE, END_SILENCE = (lambda rig, on=on: setattr(rig.device, "bus_silent", on) for on in (True, False))
ERROR, NO_ERROR = (happens("motor_error", joint=struck, code=code) for code in (error_code, 0))
JUMP = happens("encoder_jump", joint=struck)


def enabled_in_vain(rig: StruckArm, wait: Action) -> None:
    """Clear the fault and enable the arm, whose cause is still there: its motors must stay off while `wait(rig)`."""
    clear(rig)
    start = rig.now
    assert rig.run_until(lambda: rig.state is State.DISABLED, 10.0), rig.state
    rig.between_cycles(rig.safety.enable)
    wait(rig)
    assert not rig.motion(start)["on"].any(), "a motor was switched on"


def refused_on_the_wrong_angle(rig: StruckArm) -> None:
    """Check that clear and enable do not switch on the motors of an arm whose encoder is still wrong."""
    enabled_in_vain(rig, lambda rig: rig.run_until(lambda: rig.fault, 10.0))
    assert rig.fault == "implausible_zero", rig.fault


def carries_again(rig: StruckArm) -> None:
    """Check that clear and enable carry the arm again, once the wearer has brought it down."""
    rig.take_home()
    if rig.state is State.FAULT:
        rig.between_cycles(rig.safety.clear)
        rig.run_until(lambda: rig.state is State.DISABLED, 10.0)
    rig.carry()
    rig.act()
    rig.run(1.0)
    assert rig.state is State.ACTIVE, f"enabled again, the arm is {rig.state}"


def resumed(rig: StruckArm) -> None:
    """Carry the arm again with one request."""
    assert rig.run_until(lambda: rig.state is State.FAULT, 10.0), rig.state
    rig.between_cycles(rig.safety.resume)
    assert rig.run_until(lambda: rig.state is State.ACTIVE, 10.0), rig.safety.why_not_resumed


def clear(rig: StruckArm) -> None:
    """Clear the fault; the motors may still be letting down, as far as the bridge knows."""
    assert rig.run_until(lambda: rig.state is State.FAULT, 10.0), rig.state
    rig.between_cycles(rig.safety.clear)
