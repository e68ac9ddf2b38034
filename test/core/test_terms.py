# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The terms: each alone, their sum, and on the simulated arm through 12-bit frames; and the outer loop's input.

A passive term gives no more energy than it took plus what it may have stored. `friction` and `inertia` are fed by the
joints' own friction: what they give is bounded by what that takes. The outer loop is followed while it is sound, and
faded within 100 ms when it is not.
"""

import math
import random
import timeit
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.core import ArmModel, Tilt
from exo_gravity.core.arm.chain import least_inertia
from exo_gravity.core.compensation.terms.assist import ASSIST as TUNING
from exo_gravity.core.compensation.terms.assist import Assist, AssistInput
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
from exo_gravity.core.motors.frames import ENTER
from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.core.params import values_of
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS

from ..support.active_wearer import Joints, attach
from ..support.simulated_device import make_device

UPRIGHT = Tilt.of("right")
POSE = (0.2, 0.7, 0.6, 0.7)  # rad
# What the controller knows of the arm: masses and centres of gravity are wrong by 2 %.
LINKS = ArmModel(DEFAULT_LINKS.length, 0.98 * DEFAULT_LINKS.cog, 1.02 * DEFAULT_LINKS.mass)
LEAST = np.array(least_inertia(LINKS.links))
STIFFEST = tuple((0.999 * LEAST / (4.0 * DELAY**2)).tolist())  # Nm/rad up to which springs are accepted
COULOMB, VISCOUS = np.array((0.2, 0.4, 0.2, 0.2)), (0.02, 0.05, 0.01, 0.03)  # Nm and Nm s/rad of the true joints
IDENTIFIED = tuple(0.9 * COULOMB)
PUSHED, PERIOD = 3.0, 0.004  # s of a wearer's pushes, and of a cycle
RANDOM = np.random.default_rng(0)
FREQUENCY, PHASE = RANDOM.uniform(0.2, 3.0, (3, 4)), RANDOM.uniform(0.0, 6.0, (3, 4))  # Hz, rad
SIZE = 0.6 * RANDOM.uniform(0.1, 0.5, (3, 4)) * (1.0, 2.0, 1.0, 0.5)  # Nm


def pushes(time: float, theta: Joints, _velocity: Joints) -> Joints:
    """Push all joints about (4,) Nm for PUSHED s; a spring of 2 Nm/rad stays."""
    wave = (SIZE * np.sin(2.0 * math.pi * FREQUENCY * time + PHASE)).sum(axis=0) * (time <= PUSHED)
    return (2.0 * np.subtract(POSE, theta) + wave).tolist()


class TermsRun:
    """An arm under exact gravity compensation and `settings`, whose torques act `delay` s after the reading.

    smoothness: factor on the joints' Coulomb friction. energy: of each cycle so far, J that the terms gave to the arm,
    and J that the joints' friction took. positions: so far.
    """

    def __init__(
        self, settings: TermSettings, smoothness: float = 1.0, delay: float = 0.01, pose: Joints = POSE
    ) -> None:
        self.friction = smoothness * COULOMB
        config = ArmConfig(
            coulomb_friction=tuple(self.friction),
            viscous_friction=VISCOUS,
            stribeck_friction=tuple(0.1 * self.friction),
        )
        self.device = make_device(config=config)
        self.device.arm.reset(pose)
        self.terms = Terms("abcd", settings.on_arm(LINKS), LINKS)
        self.energy: list[tuple[float, float]] = []
        self.positions = [self.device.arm.positions]
        self._sent = deque([(LINKS.torque(pose, UPRIGHT), NO_TORQUE)], max(1, round(delay / PERIOD)))
        for motor in self.device.motors:
            self.device.exchange(motor.joint.can_id, motor.joint.command(0.0, 0.0))
            self.device.exchange(motor.joint.can_id, ENTER)

    def run(self, seconds: float) -> None:
        """Advance."""
        device = self.device
        for _ in range(round(seconds / PERIOD)):
            carried, extra = self._sent[0]
            torques = zip((motor.joint for motor in device.motors), np.add(carried, extra).tolist(), strict=True)
            frames = [(joint, device.exchange(joint.can_id, joint.command(torque, 0.0))) for joint, torque in torques]
            replies = [joint.sample(frame[1], device.time) for joint, frame in frames]
            theta, velocity = [reply.position for reply in replies], [reply.velocity for reply in replies]
            added = self.terms.torque(100.0 + device.time, theta, velocity)
            self._sent.append((LINKS.torque(theta, UPRIGHT), tuple(added)))
            device.advance(PERIOD)
            moved = np.subtract(device.arm.positions, self.positions[-1])
            self.positions.append(device.arm.positions)
            rubbed = np.abs(moved) @ (np.abs(moved) / PERIOD * VISCOUS + self.friction)
            self.energy.append((float(np.array(extra) @ moved), float(rubbed)))

    def travel(self, seconds: float) -> float:
        """Return how far a joint moved to and fro in the last `seconds`, in degrees."""
        return float(np.degrees(np.ptp(self.positions[-round(seconds / PERIOD) :], axis=0).max()))


def pushed(settings: TermSettings, smoothness: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Let a wearer push the arm about and leave it alone until it rests; return the energies so far, (n,) J each."""
    run = TermsRun(settings, smoothness)
    attach(run.device, pushes)
    run.run(PUSHED + 0.5)
    while run.travel(0.5) > 0.05:
        run.run(0.5)
        assert len(run.energy) * PERIOD < 18.0
    given, rubbed = np.cumsum(run.energy, axis=0).T
    return given, rubbed


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
    # Standstill reads as half a code, and may flicker to the next.
    assert FRICTION.standstill > 2.0 * 45.0 / 4095.0
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


WORKSPACE = SoftLimits((-1.0, 0.2, 0.0, 0.0), (1.0,) * 4, (3.0,) * 4, (0.5,) * 4)
PATH = (0.0, *ZERO, 1.0, 1.0, 0.0, 0.0, 0.5, 3.0, 1.0, 1.0, 0.0, 0.5)  # s and rad
SPRING = Spring((2.0,) * 4, PATH, max_effort=(9.0 / 2,) * 4)
GIVEN = {  # a term, its input, and its torque
    "the workspace is free inside": (WORKSPACE, {"position": (0.9, 0.3, 0.5, 0.99), "velocity": (1.0,) * 4}, ZERO),
    "and pushes back outside": (WORKSPACE, {"position": (1.1, 0.1, 9.0, -0.1)}, (-0.3, 0.3, -0.5, 0.3)),
    "without an edge it is free beyond half a turn, too": (
        SoftLimits((-1.0, -3.15, -3.15, -3.15)),
        {"position": (0.0, 4.0, -4.0, 9.0)},
        ZERO,
    ),
    **{
        f"a spring on a recorded path, {elapsed} s after its start": (
            SPRING,
            {"position": ZERO, "elapsed": elapsed},
            to,
        )
        for elapsed, to in (
            (-1.0, ZERO),
            (0.5, (1.0, 0.0, 0.0, 0.5)),
            (2.0, (2.0, 1.0, 0.0, 1.0)),
            (9.0, (2.0, 2.0, 0.0, 1.0)),
        )
    },
    "a path of one pose": (Spring((2.0,) * 4, PATH[:5]), {}, Spring((2.0,) * 4, ZERO).torque(STATE)),
}


@pytest.mark.parametrize(("term", "state", "torque"), GIVEN.values(), ids=GIVEN)
def test_a_term_gives_the_torque_of_its_row(term, state, torque):
    assert term.torque(STATE._replace(**state)) == pytest.approx(torque)


def test_the_tank_gives_what_it_holds_and_no_more():
    tank, given = EnergyTank(), 0.0
    for _ in range(4000):
        given += tank.pass_on((1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.002, 0.0)[0] * 0.002
    assert 0.9 * INERTIA.tank < given <= INERTIA.tank
    assert tank.pass_on((-1.0, *[0.0] * 3), (1.0, *[0.0] * 3), 0.002, 0.0)[0] == -1.0  # what takes energy always passes


def test_what_the_terms_before_a_change_would_give_stays_known():
    spring = Spring((2.0, 4.0, 2.0, 1.0), pose=(0.5, 0.3, 0.3, 0.4), max_effort=(1.0,) * 4)
    terms = Terms(NAMES, TermSettings(spring=spring), DEFAULT_LINKS)
    expected, before = terms.torque(10.0, STATE.position, ZERO), terms.in_force
    terms.apply(TermSettings(), DEFAULT_LINKS)
    assert terms.torque(10.002, STATE.position, ZERO) == ZERO and terms.active == []
    assert terms.torque_of(before) == pytest.approx(expected) and any(expected)


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
    most = np.array(least_inertia(DEFAULT_LINKS.links)) / (4.0 * DELAY**2)
    assert ALL.on_arm(DEFAULT_LINKS) == ALL
    assert stiff == pytest.approx(np.minimum(10.0, 0.8 * most))


def test_parameters_make_settings_and_a_path_of_a_minute_holds_no_cycle_up():
    given = {
        "friction.share": 0.5,
        "coupling.stiffness": [0.0, -1.0, 2.0, 0.0],
        "spring.pose": np.ravel([(0.01 * row, *[0.1] * 4) for row in range(6000)]).tolist(),
    }
    assert term_settings_of(values_of(term_parameters(), {})) == TermSettings()
    built = term_settings_of(values_of(term_parameters(), given))
    assert (built.friction.share, [*built.coupling.stiffness], [*built.spring.pose]) == tuple(given.values())
    assert min(timeit.repeat(lambda: built.spring.torque(STATE), number=1, repeat=9)) < 0.0005  # s


@pytest.mark.parametrize("edge", [{"lower": (-3.15, 0.2, -3.15, -3.15)}, {"upper": (3.15, 3.15, 1.0, 3.15)}])
def test_one_edge_of_the_workspace_switches_the_limits_on(edge):
    assert SoftLimits(**edge).on and not SoftLimits().on


GAP = abs(POSE[3] - 0.5 * POSE[2])  # rad
STORED = float(np.abs(np.subtract(POSE, (0.0, 0.4, 0.4, 0.5))) @ (1.0, 2.0, 1.0, 1.0))  # J


def within_its_tank(given: np.ndarray, rubbed: np.ndarray) -> bool:
    return float(np.max(given - rubbed)) < 2.0 * INERTIA.tank


ENERGIES: dict[str, tuple[dict[str, Any], Callable[[np.ndarray, np.ndarray], bool]]] = {
    # the terms; and what must hold of J that they gave and that friction took, as they grew
    "friction gives less than the joints' friction takes, and does help": (
        {"friction": Friction(0.85, IDENTIFIED, VISCOUS)},
        lambda given, rubbed: given[-1] > 0.3 * rubbed[-1] and np.max(given - rubbed) < 0.02,
    ),
    "inertia gives no more than its tank and the joints' friction": (
        {"inertia": Inertia(0.8), "friction": Friction(0.7, IDENTIFIED)}, within_its_tank,
    ),
    "inertia without an identified friction lives on its tank": (
        {"inertia": Inertia(0.8)},
        lambda given, rubbed: 0.05 < given.max() < 2.5 * INERTIA.tank and within_its_tank(given, rubbed),
    ),
    "the strongest damping only takes": (
        {"damping": Damping(tuple((0.999 * LEAST / (2.0 * DELAY)).tolist()))},
        lambda given, rubbed: given[-1] < -0.02 and given.max() < 0.01,
    ),
    "the stiffest spring gives no more than it stored": (
        {"spring": Spring(STIFFEST, (0.0, 0.4, 0.4, 0.5), (1.0, 2.0, 1.0, 1.0))},
        lambda given, rubbed: given.max() < STORED,
    ),
    "the stiffest edges of a workspace return no more than they took": (
        {"limits": SoftLimits(np.subtract(POSE, 0.1), np.add(POSE, 0.1), STIFFEST)},
        lambda given, rubbed: given[-1] < 0.0 and given.max() < 0.05,
    ),
    "a coupling gives no more than it stored": (
        {"coupling": Coupling((0.0, 0.0, -1.5, 3.0))}, lambda given, rubbed: given.max() < 0.5 * 3.0 * GAP**2 + 0.25,
    ),
    "all terms together let the arm come to rest": (
        {
            "friction": Friction(0.8, IDENTIFIED),
            "inertia": Inertia(0.8),
            "damping": Damping((0.02,) * 4),
            "spring": Spring(tuple(0.5 * k for k in STIFFEST), POSE),
            "coupling": Coupling((0.0, 0.0, -0.5, 1.0)),
            "limits": SoftLimits(LOWER, (1.5, 1.6, 1.6, 2.5), tuple(0.5 * k for k in STIFFEST)),
        },
        lambda given, rubbed: True,
    ),
}  # fmt: skip


@pytest.mark.parametrize(("terms", "holds"), ENERGIES.values(), ids=ENERGIES)
def test_terms_give_no_more_energy_than_they_took_and_may_have_stored(terms, holds):
    given, rubbed = pushed(TermSettings(**terms))
    assert holds(given, rubbed), (given[-1], given.max(), rubbed[-1], np.max(given - rubbed))


def test_inertia_10_ms_late_on_an_arm_with_little_friction_starts_no_limit_cycle():
    settings = TermSettings(inertia=Inertia(0.8), friction=Friction(0.0, tuple(0.3 * COULOMB)))
    assert within_its_tank(*pushed(settings, smoothness=0.3))


HELD = [(0.0, 0.3, 0.2, 0.3), (0.6, 0.5, 1.1, 0.6), (0.8, 0.9, 0.3, 1.8), (0.0, 0.6, 2.0, 0.5)]


def test_friction_and_inertia_let_no_held_pose_creep_or_cycle():
    """Each pose is left at 0.3 rad/s, as a hand that lets go leaves it; 0.2 degrees a minute is the limit."""
    for pose in HELD:
        run = TermsRun(TermSettings(inertia=Inertia(0.8), friction=Friction(0.85, tuple(COULOMB))), 1.0, 0.008, pose)
        run.device.arm.data.qvel[:] = 0.3
        run.run(4.0)
        assert run.travel(3.0) < 0.2 * 3.0 / 60.0, pose
        assert math.degrees(np.abs(np.subtract(run.positions[-1], pose)).max()) < 15.0


ASSIST = Assist((1.0, 2.0, 1.0, 1.0))
EFFORTS = (0.5, -1.0, 5.0, 0.0)
FOLLOWED = (0.5, -1.0, 1.0, 0.0)
CYCLE = 0.002  # s
RATES = (10, 25, 100, 500)


class OuterLoop:
    """A sender at `rate` Hz, an input that is asked every 2 ms, and all `torques` so far."""

    def __init__(self, rate: float = 100.0, jitter: float = 0.0, lag: float = 0.0) -> None:
        self.input = AssistInput(NAMES, ASSIST)
        self.now, self.rate, self.lag, self.publisher, self.last = 20.0, rate, lag, 1, 1
        self.names, self.efforts = NAMES, EFFORTS
        self.sending = True
        self.torques: list[tuple[float, ...]] = []
        self.states: list[str] = []
        self._due, self._jitter, self._random = self.now, jitter, random.Random(1)

    def send(self, names=None, efforts=None, stamp=None, publisher=None):
        stamp = self.now - self.lag if stamp is None else stamp
        last, self.last = self.last, publisher or self.publisher
        self.input.receive(self.now, names or self.names, efforts or self.efforts, stamp, self.last != last)

    def run(self, seconds: float) -> tuple[float, ...]:
        for _ in range(round(seconds / CYCLE)):
            self.now += CYCLE
            if self.sending and self.now >= self._due:
                self._due += (1.0 + self._jitter * self._random.uniform(-1.0, 1.0)) / self.rate
                self.send()
            self.torques.append(self.input.torque(self.now))
            self.states.append(self.input.state)
        return self.torques[-1]


def assisting(rate: float = 100.0, **changes: float) -> OuterLoop:
    loop = OuterLoop(rate, **changes)
    loop.run(2.0)
    assert loop.input.state == "assisting"
    loop.torques.clear()
    return loop


@pytest.mark.parametrize("rate", RATES)
def test_at_any_rate_sound_efforts_are_ramped_in_clamped_and_followed_without_a_gap(rate):
    loop = OuterLoop(rate, jitter=0.3)
    loop.names, loop.efforts = NAMES[::-1], EFFORTS[::-1]  # whose order does not matter
    loop.run(TUNING.ramp)
    assert np.abs(loop.torques[round(0.5 * TUNING.ramp / CYCLE)]).max() < 0.6
    assert loop.run(0.3) == pytest.approx(FOLLOWED)
    loop.torques.clear()
    loop.run(3.0)
    assert loop.torques == [pytest.approx(FOLLOWED)] * len(loop.torques)


@pytest.mark.parametrize("rate", RATES)
def test_a_lost_message_costs_no_torque_for_long_and_when_they_stop_it_is_zero_100_ms_after_the_next_was_due(rate):
    loop = assisting(rate)
    for stops in (False, True):
        loop.sending = False
        loop.run(1.0 / rate)  # the last message was up to a period ago
        loop.sending = not stops
        loop.run(0.1 + 2 * CYCLE if stops else 1.0)
        assert loop.torques[-1] == (NO_TORQUE if stops else pytest.approx(FOLLOWED))
        assert stops or rate < 40 or loop.torques == [pytest.approx(FOLLOWED)] * len(loop.torques)  # effort is valid
    assert loop.input.state == "waiting" and loop.input.reason.text == "assist_efforts stopped"


WRONG = {
    "nan": ({"efforts": (0.0, math.nan, 0.0, 0.0)}, "must be numbers within 40 Nm"),
    "infinite": ({"efforts": (math.inf, 0.0, 0.0, 0.0)}, "must be numbers within 40 Nm"),
    "huge": ({"efforts": (0.0, 0.0, 41.0, 0.0)}, "must be numbers within 40 Nm"),
    "misnamed": ({"names": [*NAMES[:3], "wrist"]}, "must name rotation, abduction, flexion, elbow"),
    "more names than joints, of which some cannot be sorted": ({"names": [*NAMES, 5]}, "must name"),
    "a name twice": ({"names": [*NAMES[:3], "flexion"]}, "must name"),
    "a joint missing": ({"names": NAMES[:3], "efforts": (0.0,) * 3}, "must name"),
    "too few efforts": ({"efforts": (0.0,) * 3}, "must name"),
    "another publisher": ({"publisher": 2}, "more than one publisher"),
    "a stamp of yesterday": ({"stamp": -86400.0}, "late by their stamp"),
    "a stamp of tomorrow": ({"stamp": 86400.0}, "late by their stamp"),
    "a stamp that is not a number": ({"stamp": math.nan}, "late by their stamp"),
}


@pytest.mark.parametrize("count", [1, 20])
@pytest.mark.parametrize(("changes", "reason"), WRONG.values(), ids=WRONG)
def test_wrong_messages_fade_the_torque_at_once_and_sound_ones_bring_it_back(changes, reason, count):
    loop = assisting()
    for _ in range(count):
        loop.now += CYCLE / 2
        loop.send(**changes)
        loop.run(0.1)
        assert loop.torques[-1] == NO_TORQUE
        assert loop.input.state == "refused" and reason in loop.input.reason.text
    loop.run(TUNING.recovery - 0.1)
    assert not np.any(loop.torques[round(0.1 / CYCLE) :])
    assert loop.run(2.0) == pytest.approx(FOLLOWED)


@pytest.mark.parametrize("is_late", [False, True])
def test_a_frozen_sender_that_repeats_its_last_stamp_is_refused_and_so_is_a_late_one(is_late):
    loop = assisting()
    stamp, loop.sending, loop.lag = loop.now - 0.005, False, 0.06
    for _ in range(20):
        loop.send(stamp=None if is_late else stamp)
        loop.run(0.004)
    assert loop.run(0.03) == NO_TORQUE
    assert loop.input.state == "refused"
    assert not is_late or "late by their stamp" in loop.input.reason.text


@pytest.mark.parametrize("pause", [0.3, 120.0])
@pytest.mark.parametrize("goes_on", [True, False], ids=["the arm is carried on", "the arm is let down meanwhile"])
def test_the_torque_of_an_outer_loop_that_died_never_returns_and_another_node_may_take_over(goes_on, pause):
    loop = assisting()
    loop.sending = False
    loop.run(0.3 if goes_on else CYCLE)
    loop.now += pause
    loop.torques.clear()
    loop.efforts, loop.sending, loop.publisher = NO_TORQUE, True, 2
    loop.run(3.0)
    assert not np.any(loop.torques) and "refused" not in loop.states
    loop.efforts = EFFORTS
    assert loop.run(1.5) == pytest.approx(FOLLOWED)


@pytest.mark.parametrize(
    ("bound", "torque", "state"), [(1.0, (1.0, -1.0, 0.0, 0.0), "assisting"), (0.0, NO_TORQUE, "off")]
)
def test_a_lower_bound_holds_for_the_efforts_that_are_followed_already_and_with_zero_they_are_ignored(
    bound, torque, state
):
    loop = OuterLoop()
    assert AssistInput(NAMES).reason.code == "off"  # before the first message, too
    loop.input.assist, loop.efforts = Assist((10.0,) * 4), (5.0, -5.0, 0.0, 0.0)
    loop.run(2.0)
    loop.input.assist, loop.sending = Assist((bound,) * 4), False
    assert loop.run(0.04) == torque  # the newest message is still valid
    loop.sending = True
    assert loop.run(1.0) == torque and loop.input.state == state
