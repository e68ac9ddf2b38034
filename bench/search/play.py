# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Plays a case, and judges it by the truth of the simulated device."""

from dataclasses import dataclass

from exo_gravity.core.safety.drive import State
from exo_gravity.sim.judge import Driven, driven
from exo_gravity.sim.rig import Change

from .case import CARRIED, Bound, Case, bound_of, draw
from .stage import ACTS, Stage

MOVE, SETTLE = 1.6, 0.8  # s in which the wearer moves the arm to its pose, and then leaves it alone
START = 30.0  # s within which an arm without a fault is carried
AFTERWARDS, DESCENT = 5.0, 15.0  # s after the last event, and after the operator has disabled the arm then


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
    specs = [motor.joint.spec for motor in stage.motors]
    done = driven(stage.truth.records, specs, stops, bound.slow, bound.turning)
    return Played(case, done, bound, tuple(stage.changes), begin, error)


def _play(stage: Stage, case: Case) -> float:
    stage.run(0.2)
    if case.begin == CARRIED:
        stage.between_cycles(stage.safety.enable)
        stage.run_until(lambda: stage.state is State.ACTIVE, START)
        stage.raise_to(case.pose, MOVE, SETTLE)
    begin = stage.now
    stage.schedule(case.events, ACTS)
    if case.begin != CARRIED:
        stage.run(0.05)
        stage.between_cycles(stage.safety.enable)
    stage.run(case.events[-1].time + AFTERWARDS)
    stage.let_down(DESCENT)
    stage.run(1.0)
    stage.catch_up()
    stage.check_controller()
    return begin
