# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The bench acceptance: what the first real motors and the first unworn arm must show, step by step, as data.

The steps run over the control loop and the motor bus that carry a worn arm, without a watchdog: a person stands at the
emergency stop. The same steps judge the simulated device, and the record says which of the two it was.

The weight hangs on the last link of any arm, and the motor of that joint lifts it; the other joints hang. Torque, angle
and weight then balance. Friction adds to the weight on the way up and takes from it on the way down: the mean counts.
"""

import json
import math
import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, cast

import numpy as np

from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.core.motors.boards import CHECK
from exo_gravity.core.motors.joint_motor import JointMotor, JointSample, source_of_bus
from exo_gravity.core.numbers import rate_limited
from exo_gravity.core.safety.command import Efforts, State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.vocabulary import Source
from exo_gravity.hardware.bus_lock import BusLock
from exo_gravity.hardware.can_port import ArmOnBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.hardware.control_loop import ControlLoop
from exo_gravity.hardware.motor_bus import MotorBus
from exo_gravity.lab.calibration.moment_model import MomentModel
from exo_gravity.lab.calibration.tours import model_of
from exo_gravity.lab.inputs.arms import ConfiguredArm
from exo_gravity.lab.inputs.parameter_file import can_options, load
from exo_gravity.sim.controllers import SampleController


@dataclass(frozen=True)
class BenchAcceptance:
    """What each step needs and permits."""

    spread: int = 15  #: K between the coldest and the warmest of motors that rested in one room
    same: float = math.radians(5.0)  #: rad within which an arm hangs again after its supply was off
    silence: float = 0.3  #: s without a reply that show that the supply was off
    start: float = 20.0  #: s for the checks of a start to pass,
    push: float = 2.0  #: and as much more for each joint, which is pushed
    angle: float = math.radians(30.0)  #: rad to which the weight is lifted: enough for its torque, not far to fall
    least: float = 0.3  #: Nm that the last joint must need there: less is lost in friction and resolution
    rise: float = 0.3  #: Nm/s; an arm that is lifted so slowly is in balance all the time
    higher: float = 1.3  #: times that torque, from which the weight comes down again
    still: float = 0.5  #: s for which a joint must turn by less than
    unrest: float = 0.005  #: rad, to be at rest
    settle: float = 20.0  #: s for it to come to rest
    torque: float = 0.2  #: share by which torque and weight may differ: the arm's own moments are not known better
    dip: float = 0.05  #: rad that the weight falls if its motor lets go; held, it does not move
    pause: float = 0.7  #: s without a command, longer than any time-out that is permitted
    down: float = 30.0  #: s for a let-down
    fastest: float = 0.6  #: rad/s of any joint meanwhile


ACCEPTANCE = BenchAcceptance()


@dataclass(frozen=True)
class Weight:
    """The known weight: kg, and m from the last joint, on the way to the hand."""

    mass: float
    lever: float


@dataclass(frozen=True)
class BenchStep:
    """The result of one step."""

    name: str
    passed: bool
    sentence: str  #: what was seen, and what must be
    measured: dict[str, Any] = field(default_factory=dict)


class Lift(SampleController):
    """A controller that lifts the last link with a torque that rises slowly, and asks nothing of the other joints.

    goal: Nm, of the last joint. asked: Nm, at present. limits: of the arm. period: s of a cycle.
    """

    def __init__(self, limits: Limits, period: float) -> None:
        super().__init__(limits)
        self.goal = self.asked = 0.0
        self._step = ACCEPTANCE.rise * period

    def _efforts_for(self, now: float, samples: Sequence[JointSample]) -> Efforts:
        self.asked = rate_limited(self.goal, self.asked, self._step)
        effort = (*(0.0 for _ in samples[:-1]), self.asked)
        return Efforts(effort, min(sample.time for sample in samples), damped=True, held=False)


class Bench:
    """An arm on the bench, its loop, and the person beside it.

    loop: of the arm; its controller is a `Lift`.
    motors: as the file has them.
    model: the arm without the weight, as the file has it.
    advance: lets the loop run for some s.
    ask: shows the person a request, and calls a function many times a second until it is done.
    """

    def __init__(
        self,
        loop: ControlLoop,
        motors: Sequence[JointMotor],
        model: MomentModel,
        weight: Weight,
        advance: Callable[[float], None],
        ask: Callable[[str, Callable[[], str]], None],
    ) -> None:
        self.loop, self.motors, self.model, self.weight = loop, motors, model, weight
        self.lift, self.clock = cast(Lift, loop.controller), loop.bus.clock
        self.advance, self.ask = advance, ask
        self.moments = model.moments + model.load(weight.mass, weight.lever)

    def needed(self, angles: Sequence[float]) -> float:
        """Return the torque in Nm that the last joint needs to hold the weight at these angles (n,) in rad."""
        down = self.model.down(Tilt.of(SIDES[0]))  # the base is upright
        return float((self.model.rows(np.array([angles]), down)[0] @ self.moments)[-1])

    @property
    def lift_direction(self) -> float:
        """1 or -1: the direction in which the last joint has more room from `home`, and so lifts the weight."""
        limits = self.loop.safety.limits
        low, home, high = (column[-1] for column in (limits.position_min, limits.home, limits.position_max))
        return 1.0 if high - home >= home - low else -1.0

    @property
    def angles(self) -> list[float]:
        """The joint angles (n,) in rad."""
        return [sample.position for sample in self.loop.samples]

    def until(self, condition: Callable[[], object], timeout: float, watch: Callable[[], None] = lambda: None) -> bool:
        """Let the loop run until `condition()` holds; return whether it did within `timeout` s."""
        end = self.clock.monotonic() + timeout
        while not condition():
            if self.clock.monotonic() >= end:
                return False
            self.advance(0.02)
            watch()
        return True

    def carry(self) -> str:
        """Enable the arm; return why it is not carried, or ''."""
        safety, now = self.loop.safety, self.clock.monotonic
        if safety.state is State.FAULT:
            self.loop.call(lambda: safety.clear(now()))
        self.loop.call(lambda: safety.enable(now()))
        longest = ACCEPTANCE.start + ACCEPTANCE.push * len(self.motors)
        if self.until(lambda: safety.state is State.ACTIVE or safety.fault, longest) and not safety.fault:
            return ""
        why = (safety.refusal or safety.waiting_for).text or f"the start takes longer than {longest:g} s"
        return safety.fault.reason if safety.fault else why

    def lift_weight(self, share: float) -> str:
        """Let the last joint balance the weight with `share` of what holds it at `ACCEPTANCE.angle`, until it is still.

        Returns why it does not come to rest, or ''.
        """
        limits = self.loop.safety.limits
        lifted = [*limits.home[:-1], limits.home[-1] + self.lift_direction * ACCEPTANCE.angle]
        goal, most = share * self.needed(lifted), limits.max_effort[-1]
        if self.lift_direction * goal < ACCEPTANCE.least:
            expected = f"at least {ACCEPTANCE.least:g}: take a heavier one; the last joint must lift it"
            return f"the weight needs {self.lift_direction * goal:.2f} Nm, must be {expected}"
        if abs(goal) > most:
            return f"the weight needs {abs(goal):.2f} Nm, max_effort permits {most:g}: take a lighter one"
        self.lift.goal = goal
        still, since = self.angles[-1], self.clock.monotonic()

        def is_still() -> bool:
            nonlocal still, since
            now = self.clock.monotonic()
            if abs(self.angles[-1] - still) > ACCEPTANCE.unrest or self.lift.asked != self.lift.goal:
                still, since = self.angles[-1], now
            return self.loop.safety.state is not State.ACTIVE or now - since > ACCEPTANCE.still

        if not self.until(is_still, ACCEPTANCE.settle):
            return "the lifted weight does not come to rest"
        fault = self.loop.safety.fault
        return fault.reason if fault else ""


def cold(bench: Bench) -> BenchStep:
    """Check that motors that rested for an hour read the temperature of the room."""
    bench.ask("the motors have rested for an hour: let the arm hang and switch their supply on", lambda: "")
    bench.until(lambda: all(sample.time > -math.inf for sample in bench.loop.samples), ACCEPTANCE.start)
    read = [sample.temperature for sample in bench.loop.samples]
    known = [degrees for degrees in read if degrees is not None]
    shown = ", ".join("none" if degrees is None else str(degrees) for degrees in read)
    expected = f"must be {CHECK.coldest} to {CHECK.hottest} degC, and within {ACCEPTANCE.spread} K of each other"
    passed = (
        len(known) == len(read)
        and CHECK.coldest <= min(known) <= max(known) <= CHECK.hottest
        and max(known) - min(known) <= ACCEPTANCE.spread
    )
    return BenchStep("cold", passed, f"the motors read {shown} degC: {expected}", {"temperature_degC": read})


def zero(bench: Bench) -> BenchStep:
    """Check that a hanging arm is at its zero, also after its supply was off."""
    before, silent = bench.angles, set[int]()

    def watch() -> str:
        now = bench.clock.monotonic()
        ages = enumerate(now - sample.time for sample in bench.loop.samples)
        silent.update(joint for joint, age in ages if age > ACCEPTANCE.silence)
        return f"{len(silent)} of {len(bench.motors)} motors were silent"

    bench.ask("let the arm hang, hands off; switch the motors' supply off and on", watch)
    now = bench.clock.monotonic
    is_back = bench.until(lambda: all(now() - one.time < 0.1 for one in bench.loop.samples), ACCEPTANCE.start)
    after, limits = bench.angles, bench.loop.safety.limits
    moved = max(abs(angle - then) for angle, then in zip(after, before, strict=True))
    columns = zip(after, limits.home, limits.home_tolerance, strict=True)
    is_home = all(abs(angle - home) <= most for angle, home, most in columns)
    passed = len(silent) == len(bench.motors) and is_back and moved <= ACCEPTANCE.same and is_home
    sentence = (
        f"{len(silent)} motors were silent while their supply was off, must be {len(bench.motors)}"
        f"{'' if is_back else ', and not all of them reply again'}; the hanging arm "
        f"turned by {math.degrees(moved):.1f} degrees at most, must be within {math.degrees(ACCEPTANCE.same):g}; it is "
        f"{'near' if is_home else 'not near'} {'home' if any(limits.home) else 'zero'}"
    )
    return BenchStep("zero", passed, sentence, {"before_rad": before, "after_rad": after, "silent": sorted(silent)})


def sign(bench: Bench) -> BenchStep:
    """Check that every motor switches on, and pushes its joint the way that its encoder shows."""
    last, weight = bench.loop.safety.limits.joint_names[-1], bench.weight
    bench.ask(f"hang {weight.mass:g} kg at {weight.lever:g} m from the joint {last}; stand clear", lambda: "")
    why = bench.carry()
    return BenchStep("sign", not why, why or "every joint moved the way it was pushed")


def torque(bench: Bench) -> BenchStep:
    """Check that the torque that holds a known weight is what its mass, lever and angle need."""
    needed, angles = [], []
    for share in (1.0, ACCEPTANCE.higher, 1.0):  # up, higher, and down again
        if why := bench.lift_weight(share):
            return BenchStep("torque", False, why)
        angles.append(bench.angles)
        needed.append(bench.needed(bench.angles))
    asked, reported, held = bench.lift.asked, bench.loop.samples[-1].effort, 0.5 * (needed[0] + needed[-1])
    ratio = held / asked
    motor = bench.motors[-1]
    measured = {"asked_Nm": asked, "needed_Nm": needed, "reported_Nm": reported, "angles_rad": angles, "ratio": ratio}
    sentence = (
        f"{asked:.2f} Nm hold what needs {held:.2f} Nm: the ratio {ratio:.2f} must be 1 within {ACCEPTANCE.torque:g}"
    )
    if not motor.wire_format.replies and reported:
        constant = motor.spec.torque_per_ampere * asked / reported
        measured["torque_per_ampere"] = constant
        sentence += f"; the board reports {reported:.2f} Nm: torque_per_ampere of this motor is {constant:.3f}"
    return BenchStep("torque", abs(ratio - 1.0) <= ACCEPTANCE.torque, sentence, measured)


def let_down(bench: Bench) -> BenchStep:
    """Check that the arm comes down slowly, and that its motors are off then."""
    fastest = 0.0

    def watch() -> None:
        nonlocal fastest
        fastest = max(fastest, *(abs(sample.velocity) for sample in bench.loop.samples))

    begin = bench.clock.monotonic()
    bench.loop.call(lambda: bench.loop.safety.disable(bench.clock.monotonic()))
    bench.advance(0.1)
    is_down = bench.until(lambda: bench.loop.is_off, ACCEPTANCE.down, watch)
    lasted = bench.clock.monotonic() - begin
    bench.lift.goal = bench.lift.asked = 0.0
    sentence = (
        f"{'off' if is_down else 'not off'} after {lasted:.1f} s, must be within {ACCEPTANCE.down:g}; the fastest "
        f"joint turned at {fastest:.2f} rad/s, must be at most {ACCEPTANCE.fastest:g}"
    )
    return BenchStep(
        "let_down", is_down and fastest <= ACCEPTANCE.fastest, sentence, {"s": lasted, "rad_per_s": fastest}
    )


def time_out(bench: Bench) -> BenchStep:
    """Check that a motor without commands lets go if `motor_timeout` says so, and holds if that is 0."""
    if why := bench.carry() or bench.lift_weight(1.0):
        return BenchStep("time_out", False, why)
    timeout, before = bench.motors[-1].timeout, bench.angles[-1]
    paused = bench.loop.call(lambda: bench.clock.sleep(ACCEPTANCE.pause))
    bench.until(paused.done, 2.0 * ACCEPTANCE.pause)
    bench.advance(0.1)
    fallen = bench.lift_direction * (before - bench.angles[-1])
    has_let_go = fallen > ACCEPTANCE.dip
    expected = f"it must {'let go' if timeout else 'hold'}: motor_timeout = {timeout:g} s"
    sentence = (
        f"the weight fell by {math.degrees(fallen):.1f} degrees in {ACCEPTANCE.pause:g} s without a command: the motor "
        f"{'let go' if has_let_go else 'held'}; {expected}"
    )
    return BenchStep(
        "time_out", has_let_go is bool(timeout), sentence, {"fallen_rad": fallen, "motor_timeout_s": timeout}
    )


STEPS = (cold, zero, sign, torque, let_down, time_out)


def accept(bench: Bench, say: Callable[[str], None]) -> list[BenchStep]:
    """Run the steps until one does not pass; return their results. The arm is let down in the end."""
    results: list[BenchStep] = []
    try:
        for step in STEPS:
            result = step(bench)
            results.append(result)
            say(f"{'pass' if result.passed else 'FAIL'}  {result.name}: {result.sentence}")
            if not result.passed:
                break
    finally:
        bench.loop.call(lambda: bench.loop.safety.disable(bench.clock.monotonic()))
        if not bench.until(lambda: bench.loop.is_off, ACCEPTANCE.down):
            say("the motors may still be on: cut their supply")
    return results


def record(results: Sequence[BenchStep], arm: str, source: Source) -> dict[str, Any]:
    """Return the record of an acceptance, for a JSON file."""
    passed = [result.name for result in results if result.passed] == [step.__name__ for step in STEPS]
    date = datetime.now().astimezone().isoformat(timespec="seconds")
    steps = [asdict(result) for result in results]
    return {"arm": arm, "date": date, "source": source.value, "passed": passed, "steps": steps}


def accept_arm(params: Path, output: Path, arm: ConfiguredArm, weight: Weight, person: Any) -> bool:
    """Run the acceptance on the bus of `arm`, and write its record; return whether it passed.

    Raises BusError, and ParameterError if the weight cannot hang there.
    """
    model = model_of(arm)
    model.load(weight.mass, weight.lever)
    interface, channel = arm.can_bridge["can.interface"], arm.can_bridge["can.channel"]
    address = interface, channel, can_options(load(params)[f"{arm.namespace}/can_bridge"])
    period = 1.0 / arm.can_bridge["rate"]
    on_bus = ArmOnBus(address, arm.motors, arm.limits, period)
    with ExitStack() as held:
        for part in on_bus.parts:
            held.callback(BusLock(part.address, f"calibrate acceptance (PID {os.getpid()})").release)
        bus = MotorBus(on_bus.ports(COMPUTER_CLOCK), arm.motors)
        held.callback(bus.close)
        bus.listen()
        loop = ControlLoop(bus, arm.limits, period, Lift(arm.limits, period))
        loop.start()
        held.callback(loop.stop)
        bench = Bench(loop, arm.motors, model, weight, time.sleep, person.wait)
        results = accept(bench, person.say)
    written = record(results, arm.name, source_of_bus(interface, channel))
    output.write_text(json.dumps(written, indent=2, default=float) + "\n", encoding="utf-8")
    person.say(f"Written: {output}")
    return bool(written["passed"])
