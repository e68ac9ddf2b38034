# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The terms: each alone, their sum, and on the simulated arm through 12-bit frames, up to 10 ms late.

A passive term gives no more energy than it took plus what it may have stored. `friction` and `inertia` are fed by the
joints' own friction: what they give is bounded by what that takes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.core import ArmModel, Tilt
from exo_gravity.core.arm.gravity import NO_TORQUE, exact_torque
from exo_gravity.core.arm.kinematics import least_inertia, links_of
from exo_gravity.core.compensation.compensator import JOINTS
from exo_gravity.core.compensation.terms.catalogue import (
    DELAY,
    FRICTION,
    INERTIA,
    Coupling,
    Damping,
    EnergyTank,
    Friction,
    Inertia,
    SoftLimits,
    Spring,
    TermState,
)
from exo_gravity.core.compensation.terms.terms import SUM, Terms, TermSettings, term_parameters, term_settings_of
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.frames import ENTER
from exo_gravity.core.params import values_of
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS

from ..support.active_wearer import Joints, attach
from ..support.simulated_device import joints_of, make_device

MOTORS_OF_ARM = joints_of((MIT,) * 4)
UPRIGHT = Tilt.of("right")
COULOMB = (0.2, 0.4, 0.2, 0.2)  # Nm of the simulated arm, by default
POSE = (0.2, 0.7, 0.6, 0.7)  # rad

Push = Callable[[float, Joints, Joints], Joints]  # time, angles, velocities -> (4,) Nm


def sines(seed: int, until: float, strength: float) -> Push:
    """Return random pushes on all joints, 0.2 to 3 Hz, that end at `until` s; a spring of 2 Nm/rad stays."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.2, 3.0, (3, 4)), rng.uniform(0.0, 6.0, (3, 4))
    size = strength * rng.uniform(0.1, 0.5, (3, 4)) * (1.0, 2.0, 1.0, 0.5)

    def push(time: float, theta: Joints, _velocity: Joints) -> Joints:
        wave = (size * np.sin(2.0 * math.pi * frequency * time + phase)).sum(axis=0) * (time <= until)
        return (2.0 * np.subtract(POSE, theta) + wave).tolist()

    return push


class TermsRun:
    """An arm under exact gravity compensation and `settings`, in cycles of `period` s.

    The torques act `delay` s after the reading, one period at least. config: the true arm; links: what the controller
    takes for it. given: J that the terms gave to the arm so far; its largest value so far is `most_given`. rubbed: J
    that the joints' friction took. worst_balance: the largest difference of the two so far.
    """

    def __init__(
        self,
        settings: TermSettings,
        config: ArmConfig,
        links: ArmModel,
        period: float,
        delay: float,
        pose: Sequence[float] = POSE,
    ) -> None:
        self.device = make_device(config=config)
        self.device.arm.reset(pose)
        self.terms, self.config, self.links, self.period = Terms(JOINTS, settings, links), config, links, period
        self.given = self.most_given = self.rubbed = self.worst_balance = 0.0
        self.positions: list[list[float]] = []
        self._sent = deque([(exact_torque(links, pose, UPRIGHT), NO_TORQUE)])
        self._late = max(1, round(delay / period))
        for motor in MOTORS_OF_ARM:
            self.device.exchange(motor.can_id, motor.command(0.0, 0.0))
            self.device.exchange(motor.can_id, ENTER)

    def push(self, push: Push) -> None:
        """Let a wearer push from now on."""
        attach(self.device, push)

    def run(self, seconds: float) -> None:
        """Advance."""
        for _ in range(round(seconds / self.period)):
            self._cycle()

    def _cycle(self) -> None:
        device, theta, velocity = self.device, [], []
        gravity, extra = self._sent[0]
        for motor, carried, added in zip(MOTORS_OF_ARM, gravity, extra, strict=True):
            answer = device.exchange(motor.can_id, motor.command(carried + added, 0.0))
            assert answer
            reply = motor.sample(answer[1], device.time)
            theta.append(reply.position)
            velocity.append(reply.velocity)
        added_next = self.terms.torque(100.0 + device.time, theta, velocity)
        self._sent.append((exact_torque(self.links, theta, UPRIGHT), tuple(added_next)))
        while len(self._sent) > self._late:
            self._sent.popleft()
        before = np.array(device.arm.positions)
        device.advance(self.period)
        moved = np.array(device.arm.positions) - before
        viscous = np.abs(moved) / self.period * self.config.viscous_friction
        self.given += float(np.array(extra) @ moved)
        self.rubbed += float(np.abs(moved) @ (viscous + self.config.coulomb_friction))
        self.most_given = max(self.most_given, self.given)
        self.worst_balance = max(self.worst_balance, self.given - self.rubbed)
        self.positions.append(device.arm.positions)

    def comes_to_rest(self) -> bool:
        """Return whether no joint moves by 0.05 degrees in half a second, at some time in the next 15 s."""
        for _ in range(30):
            self.run(0.5)
            if self.travel(0.5) < 0.05:
                return True
        return False

    def travel(self, seconds: float) -> float:
        """Return how far a joint moved to and fro in the last `seconds`, in degrees."""
        last = np.array(self.positions[-round(seconds / self.period) :])
        return float(np.degrees(np.ptp(last, axis=0).max()))


NAMES = ("rotation", "abduction", "flexion", "elbow")
ZERO = (0.0,) * 4
STATE = TermState(0.002, (0.2, 0.7, 0.6, 0.5), ZERO, ZERO, 0.0)
LOWER, UPPER = (-1.5, 0.0, -0.6, 0.0), (1.5, 1.6, 1.6, 2.5)
four = st.tuples(*[st.floats(-40.0, 40.0)] * 4)
ALL = TermSettings(
    friction=Friction(0.7, (0.2, 0.4, 0.2, 0.2), (0.02,) * 4),
    inertia=Inertia(0.7),
    damping=Damping((0.05, 0.1, 0.05, 0.05)),
    spring=Spring((2.0, 4.0, 2.0, 1.0)),
    coupling=Coupling((0.0, -0.75, 1.5, 0.0)),
    limits=SoftLimits(LOWER, UPPER, (2.0,) * 4),
)


@settings(deadline=None)
@given(four, st.floats(0.0, 0.85))
def test_friction_is_along_the_motion_and_below_what_the_joint_loses(velocity, share):
    friction = Friction(share, (0.2, 0.4, 0.2, 0.1), (0.02, 0.05, 0.02, 0.0))
    for v, tau, coulomb, viscous in zip(
        velocity, friction.torque(STATE._replace(velocity=velocity)), friction.coulomb, friction.viscous, strict=True
    ):
        assert tau * v >= 0.0
        assert abs(tau) <= share * (coulomb + viscous * min(abs(v), FRICTION.fastest))


def test_friction_is_zero_at_standstill_and_does_not_step():
    friction = Friction(0.8, (0.2,) * 4)
    speeds = np.linspace(-2.0 * FRICTION.sliding, 2.0 * FRICTION.sliding, 400)
    torque = np.array([friction.torque(STATE._replace(velocity=(v, 0.0, 0.0, 0.0)))[0] for v in speeds])
    one_code = 2.0 * 45.0 / 4095.0
    assert one_code < FRICTION.standstill  # standstill reads as half a code, and may flicker to the next
    assert not torque[np.abs(speeds) <= FRICTION.standstill].any()
    assert np.abs(np.diff(torque)).max() < 0.01
    assert torque[-1] == pytest.approx(0.16)


def test_coupling_pulls_both_joints_so_that_no_way_around_gives_energy():
    coupling = Coupling((0.0, -1.5, 0.0, 3.0), max_effort=0.4)
    angle = np.linspace(0.0, 2.0 * math.pi, 2001)
    way = np.stack((0.0 * angle, 0.8 + 0.5 * np.cos(angle), 0.0 * angle, 0.6 + 0.4 * np.sin(angle)), axis=1)
    torque = np.array([coupling.torque(STATE._replace(position=tuple(q))) for q in way])
    work = ((torque[1:] + torque[:-1]) / 2.0 * np.diff(way, axis=0)).sum()
    assert abs(work) < 1e-4
    assert np.abs(torque[:, 3]).max() == pytest.approx(0.4)


def test_the_workspace_is_free_inside_and_pushes_back_outside():
    limits = SoftLimits((-1.0, 0.2, 0.0, 0.0), (1.0,) * 4, (3.0,) * 4, (0.5,) * 4)
    inside = STATE._replace(position=(0.9, 0.3, 0.5, 0.99), velocity=(1.0,) * 4)
    assert limits.torque(inside) == ZERO
    outside = STATE._replace(position=(1.1, 0.1, 9.0, -0.1))
    assert limits.torque(outside) == pytest.approx((-0.3, 0.3, -0.5, 0.3))


def test_a_spring_follows_a_recorded_path_and_stays_at_its_end():
    path = (0.0, *ZERO, 1.0, 1.0, 0.0, 0.0, 0.5, 3.0, 1.0, 1.0, 0.0, 0.5)
    spring = Spring((2.0,) * 4, path, max_effort=(9.0 / 2,) * 4)
    halfway = {-1.0: ZERO, 0.5: (0.5, 0.0, 0.0, 0.25), 2.0: (1.0, 0.5, 0.0, 0.5), 9.0: path[-4:]}
    assert Spring((2.0,) * 4, path[:5]).torque(STATE) == Spring((2.0,) * 4, ZERO).torque(STATE)
    for elapsed, pose in halfway.items():
        torque = spring.torque(STATE._replace(position=ZERO, elapsed=elapsed))
        assert torque == pytest.approx(2.0 * np.array(pose))


def test_the_tank_gives_what_it_holds_and_no_more():
    tank, given = EnergyTank(), 0.0
    for _ in range(4000):
        given += tank.pass_on((1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.002, 0.0)[0] * 0.002
    assert 0.9 * INERTIA.tank < given <= INERTIA.tank
    taken = tank.pass_on((-1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.002, 0.0)
    assert taken[0] == -1.0  # a torque that takes energy always passes


class Driven:
    """Terms under a clock, at one state."""

    def __init__(self, chosen: TermSettings) -> None:
        self.terms, self.now, self.outputs = Terms(NAMES, chosen, DEFAULT_LINKS), 10.0, []

    def run(self, seconds: float, position=STATE.position, velocity=ZERO, period: float = 0.002):
        for _ in range(max(1, round(seconds / period))):
            self.now += period
            self.outputs.append(self.terms.torque(self.now, position, velocity))
        return self.outputs[-1]


def test_what_the_terms_before_a_change_would_give_stays_known():
    driven = Driven(TermSettings(spring=Spring((2.0, 4.0, 2.0, 1.0), pose=(0.5, 0.3, 0.3, 0.4), max_effort=(1.0,) * 4)))
    expected = driven.run(0.1)
    before = driven.terms.in_force
    driven.terms.apply(TermSettings(), DEFAULT_LINKS)
    assert driven.run(0.002) == ZERO and driven.terms.active == []
    assert driven.terms.torque_of(before) == pytest.approx(expected)
    assert driven.run(0.1, velocity=(1.0,) * 4) == ZERO


class Wild(NamedTuple):
    """A term that gives any torque, in place of a spring."""

    torques: list[tuple[float, ...]]
    on = True

    def torque(self, _state: TermState) -> tuple[float, ...]:
        return self.torques[0]


wild = st.one_of(st.floats(-30.0, 30.0), st.sampled_from([math.nan, math.inf, -math.inf, 1e308]))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.tuples(*[wild] * 4), st.sampled_from([0.0, 0.001, 0.002, 0.01, 0.05])), max_size=60))
def test_whatever_the_terms_give_their_sum_is_bounded(sums):
    given = [ZERO]
    terms, now = Terms(NAMES, TermSettings(spring=Wild(given)), DEFAULT_LINKS), 1.0
    for total, dt in sums:
        now, given[0] = now + dt, total
        after = terms.torque(now, STATE.position, ZERO)
        assert all(abs(tau) <= limit for tau, limit in zip(after, SUM.effort, strict=True))
        assert bool(terms.problem) is not math.isfinite(sum(total))


def test_soft_limits_are_no_stiffer_than_is_stable():
    stiff = TermSettings(limits=SoftLimits(LOWER, UPPER)).on_arm(DEFAULT_LINKS).limits.stiffness
    most = np.array(least_inertia(links_of(DEFAULT_LINKS))) / (4.0 * DELAY**2)
    assert ALL.on_arm(DEFAULT_LINKS) == ALL
    assert stiff == pytest.approx(np.minimum(10.0, 0.8 * most))


def test_parameters_make_settings():
    table = term_parameters()
    assert term_settings_of(values_of(table, {})) == TermSettings()
    coupling = [0.0, -1.0, 2.0, 0.0]
    values = values_of(table, {"friction.share": 0.5, "coupling.stiffness": coupling, "spring.pose": [0.1] * 4})
    built = term_settings_of(values)
    assert (built.friction.share, built.coupling.stiffness, built.spring.pose) == (0.5, tuple(coupling), (0.1,) * 4)


@pytest.mark.parametrize("edge", [{"lower": (-3.15, 0.2, -3.15, -3.15)}, {"upper": (3.15, 3.15, 1.0, 3.15)}])
def test_one_edge_of_the_workspace_switches_the_limits_on(edge):
    assert SoftLimits(**edge).on and not SoftLimits().on


PUSHED = 3.0  # s


@dataclass
class Case:
    """A random arm, what the controller knows of it, and the loop's period and delay in s."""

    seed: int
    smoothness: float = 1.0  # factor on the friction

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        mass, cog = DEFAULT_LINKS.mass * rng.uniform(0.97, 1.03, 4), DEFAULT_LINKS.cog * rng.uniform(0.97, 1.0, 4)
        self.links = ArmModel(DEFAULT_LINKS.length, cog, mass)
        self.friction = tuple((np.array(COULOMB) * self.smoothness * rng.uniform(0.5, 1.5)).tolist())
        self.config = ArmConfig(
            coulomb_friction=self.friction,
            viscous_friction=tuple(rng.uniform(0.0, 0.05, 4).tolist()),
            stribeck_friction=tuple((0.2 * np.array(self.friction) * rng.uniform(0.0, 1.0)).tolist()),
        )
        self.identified = (np.array(self.friction) * rng.uniform(0.8, 1.0)).tolist()
        self.period = float(rng.choice((0.002, 0.004, 0.005)))
        self.delay = float(rng.choice((0.0, 0.005, 0.01)))
        self.least = np.array(least_inertia(links_of(self.links)))
        #: Nm/rad up to which springs are accepted
        self.stiffest = tuple((0.999 * self.least / (4.0 * DELAY**2)).tolist())

    def pushed(self, settings: TermSettings, strength: float = 0.6) -> TermsRun:
        """Return a run in which a wearer pushes the arm about, and then leaves it alone until it rests."""
        settings = settings.on_arm(self.links)
        run = TermsRun(settings, self.config, self.links, self.period, self.delay)
        run.push(sines(self.seed, PUSHED, strength))
        run.run(PUSHED)
        assert run.comes_to_rest()
        return run


GAP = abs(POSE[3] - 0.5 * POSE[2])  # rad
STORED = float(np.abs(np.subtract(POSE, (0.0, 0.4, 0.4, 0.5))) @ (1.0, 2.0, 1.0, 1.0))  # J
ENERGIES: dict[str, tuple[Any, Any]] = {  # the terms on a case, and what must hold of its energies in J
    "friction gives less than the joints' friction takes, and does help": (
        lambda case: {"friction": Friction(0.85, case.identified, case.config.viscous_friction)},
        lambda run: run.given > 0.3 * run.rubbed and run.worst_balance < 0.02,
    ),
    "inertia gives no more than its tank and the joints' friction": (
        lambda case: {"inertia": Inertia(0.8), "friction": Friction(0.7, case.identified)},
        lambda run: run.worst_balance < 2.0 * INERTIA.tank,
    ),
    "inertia whose friction has no share": (
        lambda case: {"inertia": Inertia(0.8), "friction": Friction(0.0, case.identified)},
        lambda run: run.worst_balance < 2.0 * INERTIA.tank,
    ),
    "inertia without an identified friction lives on its tank": (
        lambda case: {"inertia": Inertia(0.8)},
        lambda run: 0.05 < run.most_given < 2.5 * INERTIA.tank and run.worst_balance < 2.0 * INERTIA.tank,
    ),
    "the strongest damping only takes": (
        lambda case: {"damping": Damping(tuple((0.999 * case.least / (2.0 * DELAY)).tolist()))},
        lambda run: run.given < -0.02 and run.most_given < 0.01,
    ),
    "the stiffest spring gives no more than it stored": (
        lambda case: {"spring": Spring(case.stiffest, (0.0, 0.4, 0.4, 0.5), (1.0, 2.0, 1.0, 1.0))},
        lambda run: run.most_given < STORED,
    ),
    "the stiffest edges of a workspace return no more than they took": (
        lambda case: {"limits": SoftLimits(np.subtract(POSE, 0.1), np.add(POSE, 0.1), case.stiffest)},
        lambda run: run.given < 0.0 and run.most_given < 0.05,
    ),
    "a coupling gives no more than it stored": (
        lambda case: {"coupling": Coupling((0.0, 0.0, -1.5, 3.0))},
        lambda run: run.most_given < 0.5 * 3.0 * GAP**2 + 0.25,
    ),
    "all terms together let the arm come to rest": (
        lambda case: {
            "friction": Friction(0.8, case.identified),
            "inertia": Inertia(0.8),
            "damping": Damping((0.02,) * 4),
            "spring": Spring(tuple(0.5 * k for k in case.stiffest), POSE),
            "coupling": Coupling((0.0, 0.0, -0.5, 1.0)),
            "limits": SoftLimits(LOWER, (1.5, 1.6, 1.6, 2.5), tuple(0.5 * k for k in case.stiffest)),
        },
        lambda run: True,
    ),
}


@pytest.mark.parametrize("name", ENERGIES)
def test_terms_give_no_more_energy_than_they_took_and_may_have_stored(name):
    chosen, holds = ENERGIES[name]
    case = Case(0)
    run = case.pushed(TermSettings(**chosen(case)))
    assert holds(run), (run.given, run.most_given, run.rubbed, run.worst_balance)


def test_inertia_10_ms_late_on_an_arm_with_little_friction_starts_no_limit_cycle():
    case = Case(2, smoothness=0.3)
    case.delay = 0.01
    run = case.pushed(TermSettings(inertia=Inertia(0.8), friction=Friction(0.0, case.identified)))
    assert run.worst_balance < 2.0 * INERTIA.tank


THIRTEEN = [
    (0.0, 0.3, 0.2, 0.3), (0.0, 0.3, 0.8, 1.2), (0.0, 0.3, 1.5, 0.4), (-0.6, 0.5, 1.1, 1.6), (0.6, 0.5, 1.1, 0.6),
    (0.0, 0.9, -0.3, 0.5), (0.0, 0.9, 0.5, 1.0), (-0.8, 0.9, 0.9, 0.4), (0.8, 0.9, 0.3, 1.8), (0.0, 1.4, 0.0, 0.3),
    (0.4, 1.4, 0.5, 1.4), (-0.4, 1.8, 0.3, 0.8), (0.0, 0.6, 2.0, 0.5),
]  # fmt: skip


def test_friction_and_inertia_let_no_held_pose_creep_or_cycle():
    """Each pose is left at 0.3 rad/s, as a hand that lets go leaves it; 0.2 degrees a minute is the limit."""
    case = Case(1)
    chosen = TermSettings(inertia=Inertia(0.8), friction=Friction(0.85, case.friction))
    for pose in THIRTEEN[::4]:
        run = TermsRun(chosen, case.config, case.links, 0.004, 0.008, pose)
        run.device.arm.data.qvel[:] = 0.3
        run.run(4.0)
        assert run.travel(3.0) < 0.2 * 3.0 / 60.0, pose
        assert math.degrees(np.abs(np.subtract(run.positions[-1], pose)).max()) < 15.0
