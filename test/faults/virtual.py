# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows of the fault matrix in virtual time: the arm of a parameter file, what is done to it, and how a row is played.

Bridge, bus, safety machine and compensator are those of the nodes; the processes, DDS and the watchdog are not there.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

from exo_gravity.core.motors.damiao import DAMIAO_MIT
from exo_gravity.core.safety.drive import Efforts, FaultCode, State
from exo_gravity.core.safety.lease import Lease
from exo_gravity.lab.inputs.arms import node_values, read_arm
from exo_gravity.lab.inputs.parameter_file import Nodes, load
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.events import ACTS, HOLD
from exo_gravity.sim.judge import Response
from exo_gravity.sim.params import device_of, simulator_table
from exo_gravity.sim.rig import Rig

from ..support import CONFIG
from ..support.copies import copied
from .fault_case import AFTER_EXIT, BEFORE, CARRYING, DESCENT, OBSERVATION, Action, FaultCase, in_turn

RAISED = (0.0, 1.3, 0.0, 0.3)  # rad, nearly horizontal
TIMEOUTS: Mapping[str, Mapping[str, Any]] = {  # those of a real device
    "can_bridge": {"command_timeout": 0.05, "frozen_timeout": 0.08, "enable_timeout": 10.0, "sign_check_torque": 0.0},
    "compensator": {"tilt_timeout": 0.08},
}
STEADY = 1.25  # s after a move in which the arm comes to rest
GYRO_BIAS = 1e-3  # rad/s, as an ordinary IMU has at least
FALLING = 0.2  # rad/s of the struck joint, from which on an arm is on its way down
AT_LEAST, RESTS = 0.5, 1e-3  # s after the last motor was switched off, and rad/s: nothing more can happen to the arm
AK_ERROR, DAMIAO_ERROR = 5, 0xB

Parameters = Mapping[str, Any]


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


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm of a file in config, carried in `pose` (n,) rad at `rate` Hz.

    struck: the joint (0..) whose motor is the one that fails; it carries much of the arm's weight.
    can_bridge, compensator, simulator: parameters that are not as in the file.
    assisted: Nm (n,) of an outer loop, none without one.
    """

    base: str = "sim.yaml"
    pose: tuple[float, ...] = RAISED
    struck: int = 1
    rate: float = 250.0
    can_bridge: Parameters = field(default_factory=dict)
    compensator: Parameters = field(default_factory=dict)
    simulator: Parameters = field(default_factory=dict)
    assisted: tuple[float, ...] = ()

    def nodes(self) -> dict[str, dict[str, Any]]:
        """Return the parameters of the right arm's nodes."""
        nodes = {name: dict(values) for name, values in load(CONFIG / self.base).items()}
        for node in ("can_bridge", "compensator", "simulator"):
            nodes[f"/right/{node}"] |= {**TIMEOUTS.get(node, {}), **getattr(self, node)}
        nodes["/right/can_bridge"]["rate"] = self.rate
        return nodes


def device_from(nodes: Nodes) -> SimulatedDevice:
    """Return the simulated device of the right arm."""
    name = "/right/simulator"
    return device_of(node_values(nodes, name, simulator_table(nodes[name])))


class StruckArm(Rig):
    """An arm of the matrix."""

    def __init__(self, arm: Arm) -> None:
        self.arm, self.struck, self.nodes = arm, arm.struck, arm.nodes()
        carried = read_arm(self.nodes, "/right")
        device = device_from(self.nodes)
        super().__init__(device, carried.settings, carried.motors, carried.limits, arm.rate)
        self.names = carried.limits.joint_names
        self.assist = self.compensator.terms.assist
        self.outer_loop = OuterLoop(self, arm.assisted) if arm.assisted else None
        self.lease = Lease()
        self.gyro_bias = GYRO_BIAS
        self.run(0.2)

    @property
    def joints(self) -> range:
        """All joints."""
        return range(len(self.motors))

    def hold_control(self, duration: float) -> None:
        """Let someone hold control for `duration` s, who then dies; node can_bridge watches the lease."""
        end = self.now + duration
        self.clock.every(0.1, partial(self._watch_lease, end))

    def _watch_lease(self, end: float) -> None:
        if self.now < end:
            self.lease.request(self.now, "the operator", "hold")
        elif reason := self.lease.lost(self.now):
            self.safety.trip(FaultCode.CONTROL_LOST, reason, self.now)

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
            self.act({"move": list(self.arm.pose), "over": 1.0}, {"hold": HOLD})
            self.run(1.0 + STEADY)
            assert self.state is State.ACTIVE, self.fault
        else:
            self.between_cycles(self.safety.enable)
            is_there = self.run_until(lambda: self.state.value == stage, 30.0)
            assert is_there, f"{self.state}, not {stage}: {self.safety.fault or self.safety.waiting_for}"
        if stage == "proving signs":  # which begins with motors that are still off
            assert self.run_until(lambda: all(motor.entered for motor in self.motors), 5.0)

    def take_home(self) -> None:
        """Let the wearer bring the arm near to hanging, and keep it there."""
        home = [0.0, *[0.05] * (len(self.joints) - 1)]
        self.act(*({"move": home, "over": over} for over in (2.0, 20.0)))
        self.run(2.5)

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


class Played(NamedTuple):
    """What became of a row. unsafe: '' or what was wrong."""

    outcome: str
    response: Response
    unsafe: str


def play(case: FaultCase, is_fresh: bool = False) -> Played:
    """Play a row, on a fresh arm if asked, and judge it by the arm's true motion as rows with processes are."""
    rig = struck_arm(case.rig, case.stage, is_fresh)
    start = rig.now
    injected = case.inject(rig)
    start = injected if isinstance(injected, float) else start
    _observe(case, rig)
    case.clear(rig)
    if rig.are_off():
        rig.run_until(lambda: rig.outcome not in CARRYING, DESCENT)
    if rig.outcome not in CARRYING and not case.must_stay_off:
        rig.run_until(rig.are_off, DESCENT)
        rig.run(AT_LEAST)
        rig.run_until(rig.rests, AFTER_EXIT - AT_LEAST)
    outcome = rig.outcome
    rig.catch_up()
    records = rig.truth.records
    records = records[records["time"] >= start - BEFORE]
    specs = [motor.joint.spec for motor in rig.motors]
    response = case.response(records, start, 1.0 / case.rig.rate, specs)
    failures = case.failures(outcome, records, start, response, len(specs))
    if not failures:
        try:
            case.afterwards(rig)
        except AssertionError as error:
            failures.append(f"afterwards: {str(error).splitlines()[0]}")
    rig.bus.close()
    failures += [f"exception: {rig.loop.failure}"] * (rig.loop.failure is not None)
    return Played(outcome, response, ", ".join(failures))


def _observe(case: FaultCase, rig: StruckArm) -> None:
    """Run until the arm is let down, or for OBSERVATION if it may stay as it is."""
    if case.limit is None or case.must_stay_off:
        rig.run_until(lambda: rig.state is State.FAULT, OBSERVATION)
        if rig.state not in (State.LETTING_DOWN, State.FAULT):
            return
    rig.run_until(lambda: rig.state is State.FAULT or rig.are_off(), DESCENT)


def pause(seconds: float) -> Action:
    """Let time pass."""
    return lambda rig: rig.run(seconds)


def happens(name: str, **values: Any) -> Action:
    """Let an event of the shared vocabulary happen; a value may be a function of the rig."""
    return lambda rig: ACTS[name](rig, **{key: each(rig) if callable(each) else each for key, each in values.items()})


def struck(rig: StruckArm) -> int:
    """Return the joint that is struck."""
    return rig.struck


def only_struck(rig: StruckArm) -> list[int]:
    """Return it as the only one of several."""
    return [rig.struck]


def error_code(rig: StruckArm) -> int:
    """Return the code of an error of the struck motor."""
    family = rig.motors[rig.struck].joint.spec.family
    return DAMIAO_ERROR if family == DAMIAO_MIT.family else AK_ERROR


def power(on: bool, *joints: int) -> Action:
    """Switch the supply of these motors, by default of all; the encoders keep their turns."""

    def inject(rig: StruckArm) -> None:
        rig.catch_up()
        for joint in joints or rig.joints:
            rig.motors[joint].unplugged = not on

    return inject


def no_error(rig: StruckArm) -> None:
    """End the errors of all motors."""
    for motor in rig.motors:
        motor.error = 0


def no_jump(rig: StruckArm) -> None:
    """Let every encoder read the right angle again."""
    rig.device.encoder_error = (0.0,) * len(rig.joints)


def freeze(rig: StruckArm) -> None:
    """Let the compensator answer no more: its last efforts grow old."""
    rig.controller.change = partial(_constant, rig.direct.efforts(rig.now))


def resume(rig: StruckArm) -> None:
    """Let it answer again."""
    rig.controller.change = None


def _constant(last: Efforts, _answer: Efforts) -> Efforts:
    return last


def raises(_rig: StruckArm) -> None:
    """Let each step of the compensator raise an exception."""

    def fail(_answer: Efforts) -> Efforts:
        raise ZeroDivisionError("division by zero")

    _rig.controller.change = fail


def change_efforts(change: Callable[[float, Sequence[float]], Sequence[float]]) -> Action:
    """Spoil all efforts: change(now, efforts) gets s and (n,) Nm."""

    def inject(rig: StruckArm) -> None:
        def changed(answer: Efforts) -> Efforts:
            return answer._replace(effort=tuple(change(rig.now, answer.effort))) if answer.effort else answer

        rig.controller.change = changed

    return inject


def exit_frame(rig: StruckArm) -> None:
    """Send the frame that switches the struck motor off, as another host would."""
    rig.send(rig.motors[rig.struck].joint.exit[-1])


def foreign(torque: float) -> Action:
    """Command the struck motor as another host would: `torque` Nm, 500 times a second for 2 s."""
    return in_turn(happens("foreign_torque", joint=struck, torque=torque, rate=500.0, duration=2.0), pause(2.0))


CUT_OFF = happens("cut_off", motors=only_struck)
CONNECT = happens("cut_off", motors=())
RESTART, SHORT_RESTART = (happens("unplugged", joint=struck, duration=duration) for duration in (0.03, 0.015))
CUT, RELEASE = power(False), power(True)
SILENCE, END_SILENCE = (lambda rig, on=on: setattr(rig.device, "bus_silent", on) for on in (True, False))
ERROR = happens("motor_error", joint=struck, code=error_code)
JUMP = happens("encoder_jump", joint=struck)


def enabled_in_vain(rig: StruckArm, wait: Action) -> None:
    """Clear the fault and enable the arm, whose cause is still there: its motors must stay off while `wait(rig)`."""
    assert rig.run_until(lambda: rig.state is State.FAULT, 10.0), rig.state
    start = rig.now
    rig.between_cycles(rig.safety.clear)
    assert rig.run_until(lambda: rig.state is State.DISABLED, 10.0), rig.state
    rig.between_cycles(rig.safety.enable)
    wait(rig)
    rig.catch_up()
    records = rig.truth.records
    assert not records["on"][records["time"] > start].any(), "a motor was switched on"


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
    """Clear the fault while the supply is off: the motors may still be letting down, as far as the bridge knows."""
    assert rig.run_until(lambda: rig.state is State.FAULT, 10.0), rig.state
    rig.between_cycles(rig.safety.clear)
