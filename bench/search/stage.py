# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arm of a case in virtual time, what can happen to it beyond sim/events, and the judgement of its true motion."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

from exo_gravity.core.arm.interface import Payload
from exo_gravity.core.safety.command import State
from exo_gravity.sim import SimulatedDevice
from exo_gravity.sim.judge import Driven, driven
from exo_gravity.sim.motors import simulated
from exo_gravity.sim.rig import ACTS as SHARED
from exo_gravity.sim.rig import IMU_PERIOD, Act, Change, Rig, imu_wrong, payload_dropped

from ..arms import ARMS, Friction
from .case import BODY_MASS, CARRIED, Bound, Case, bound_of, draw

TILT_TIMEOUT = 0.08  # s, that of a real arm
MOVE, SETTLE = 1.6, 0.8  # s in which the wearer moves the arm to its pose, and then leaves it alone
START = 30.0  # s within which an arm without a fault is carried
AFTERWARDS, DESCENT = 5.0, 15.0  # s after the last event, and after the operator has disabled the arm then


class Stage(Rig):
    """The arm of `case`, hanging, with its motors off. played: the arm of config that it is."""

    def __init__(self, case: Case) -> None:
        self.played = ARMS[case.arm]
        configured = self.played.carried
        settings = replace(configured.settings, tilt_timeout=TILT_TIMEOUT, payload=Payload(case.payload))
        load = self.played.load_of(BODY_MASS) if self.played.worn else None
        worn = {"wearer_mass": load.mass.tolist(), "wearer_cog": load.cog.tolist()} if load else {}
        settings = replace(settings, mode="zero_g" if case.worn else "one_g", support=1.0, **worn)
        device_arm = self.played.device_arm(Friction(case.friction), load if case.worn else None)
        device_arm.carry(case.payload)
        device = SimulatedDevice(device_arm, [simulated(joint) for joint in configured.motors])
        limits = self.played.limits(case.rate)
        if case.begin == CARRIED:  # its signs are as good as proven, which takes 5 s
            limits = replace(limits, sign_check_torque=0.0)
        super().__init__(device, settings, configured.motors, limits, case.rate)
        self.clock.run(2.0 * IMU_PERIOD)


def body_mass(stage: Stage, mass: float) -> None:
    """Set the mass of the wearer's body, in kg, as the operator would."""
    load = stage.played.load_of(mass)
    stage.change(wearer_mass=load.mass.tolist(), wearer_cog=load.cog.tolist())


def lap(stage: Stage, duration: float) -> None:
    """Let the wearer lay their arm in their lap within `duration` s."""
    stage.act({"move": list(stage.played.lap), "over": duration})


def spasm(stage: Stage, size: float) -> None:
    """Shake the arm: eight pushes of 0.15 s, to and fro."""
    torque = [size * most for most in stage.played.spasm]
    stage.act(*({"push": [sign * each for each in torque], "over": 0.15} for sign in (1.0, -1.0) * 4))


def payload_flicked(stage: Stage) -> None:
    """Let the wearer throw upwards what they carry."""
    stage.act({"push": list(stage.played.flick), "over": 0.2})
    stage.clock.later(0.15, partial(payload_dropped, stage))


OWN: Mapping[str, Act] = {
    "support": SHARED["settings"],
    "body_mass": body_mass,
    "lap": lap,
    "spasm": spasm,
    "payload_flicked": payload_flicked,
    "imu_creeps": imu_wrong,
    "trunk_falls": SHARED["bow"],
}
ACTS: Mapping[str, Act] = {**SHARED, **OWN}


@dataclass(frozen=True)
class Played:
    """What became of a case."""

    case: Case
    driven: Driven
    bound: Bound
    states: tuple[Change, ...]
    begin: float  #: s, from which the times of the events count
    error: str = ""  #: an exception of the code under test

    @property
    def share(self) -> float:
        """By how much the worst figure uses its bound up; above 1 it is beyond."""
        speed = self.driven.speed / self.bound.speed
        return 10.0 if self.error else max(speed, self.driven.energy / self.bound.energy)


def play(seed: int, arm: str) -> Played:
    """Return what becomes of the case of `seed` for the arm called `arm`."""
    case = draw(seed, arm)
    stage, begin, error = Stage(case), 0.0, ""
    try:
        begin = _play(stage, case)
    except Exception as caught:
        error = f"{type(caught).__name__}: {caught}"
    stage.bus.close()
    bound = bound_of(case, stage.direct.was_clamped)
    config = stage.device.arm.config
    stops = config.position_min, config.position_max
    done = driven(stage.truth.records, [motor.joint.spec for motor in stage.motors], stops, bound.slow, bound.turning)
    return Played(case, done, bound, tuple(stage.changes), begin, error)


def _play(stage: Stage, case: Case) -> float:
    stage.run(0.2)
    if case.begin == CARRIED:
        stage.between_cycles(stage.safety.enable)
        stage.run_until(lambda: stage.state is State.ACTIVE, START)
        stage.raise_to(case.pose, MOVE, SETTLE)
    begin = stage.now
    for time, name, values in case.events:
        stage.clock.later(time, partial(ACTS[name], stage, **values))
    if case.begin != CARRIED:
        stage.run(0.05)
        stage.between_cycles(stage.safety.enable)
    stage.run(case.events[-1].time + AFTERWARDS)
    stage.let_down(DESCENT)
    stage.run(1.0)
    stage.catch_up()
    stage.check_controller()
    return begin
