# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Each term alone, and the sum of all behind its shaper."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.core.arm.kinematics import least_inertia, links_of
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
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import values_of
from exo_gravity.sim.arm import DEFAULT_LINKS

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


def test_viscous_friction_in_another_unit_is_refused():
    with pytest.raises(ParameterError, match=r"^viscous = .* from 0 to 1 Nm s/rad"):
        Friction(0.5, (0.2, 0.4, 0.2, 0.2), (0.02, 0.05, 0.02, 2.0))


@pytest.mark.parametrize(
    "rows",
    [(), (0.0,) * 3, (0.0,) * 6, (0.0,) * 10, (1.0, *ZERO), (0.0, 0.0, 0.0, 0.0, math.nan),
     (0.0, *ZERO, 0.1, 3, 0, 0, 0), (0.0, *ZERO, math.nan, *ZERO), (0.0, *ZERO, math.inf, *ZERO),
     (0.0, *ZERO, 2.0, *ZERO, 1.0, *ZERO)],
)  # fmt: skip
def test_an_impossible_path_is_refused(rows):
    with pytest.raises(ParameterError, match=r"path|pose"):
        Spring((1.0,) * 4, rows)


def test_a_pose_is_four_angles():
    with pytest.raises(ParameterError, match=r"^spring.pose = .*4 angles"):
        Spring((1.0,) * 4, (0.0, 0.0, 0.0, math.nan))


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


def test_without_terms_nothing_is_added():
    driven = Driven(TermSettings())
    assert driven.run(1.0, velocity=(1.0,) * 4) == ZERO
    assert driven.terms.active == []


def test_what_the_terms_before_a_change_would_give_stays_known():
    driven = Driven(TermSettings(spring=Spring((2.0, 4.0, 2.0, 1.0), pose=(0.5, 0.3, 0.3, 0.4), max_effort=(1.0,) * 4)))
    expected = driven.run(0.1)
    before = driven.terms.in_force
    driven.terms.apply(TermSettings(), DEFAULT_LINKS)
    assert driven.run(0.002) == ZERO
    assert driven.terms.torque_of(before) == pytest.approx(expected)


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


@pytest.mark.parametrize(
    ("chosen", "name"),
    [
        (TermSettings(spring=Spring((50.0, 0.0, 0.0, 0.0))), "spring.stiffness"),
        (TermSettings(damping=Damping((0.0, 0.0, 0.0, 3.0))), "damping.viscosity"),
        (TermSettings(coupling=Coupling((0.0, -15.0, 30.0, 0.0))), "coupling.stiffness"),
    ],
)
def test_a_spring_or_damper_that_would_be_unstable_when_late_is_refused_with_the_most_that_is_stable(chosen, name):
    with pytest.raises(ParameterError, match=f"^{name} = .* at most .* late is stable"):
        chosen.on_arm(DEFAULT_LINKS)
    assert ALL.on_arm(DEFAULT_LINKS) == ALL


def test_soft_limits_are_no_stiffer_than_is_stable():
    stiff = TermSettings(limits=SoftLimits(LOWER, UPPER)).on_arm(DEFAULT_LINKS).limits.stiffness
    most = np.array(least_inertia(links_of(DEFAULT_LINKS))) / (4.0 * DELAY**2)
    assert stiff == pytest.approx(np.minimum(10.0, 0.8 * most))


def test_parameters_make_settings_and_name_their_group_in_errors():
    table = term_parameters()
    assert term_settings_of(values_of(table, {})) == TermSettings()
    coupling = [0.0, -1.0, 2.0, 0.0]
    values = values_of(table, {"friction.share": 0.5, "coupling.stiffness": coupling, "spring.pose": [0.1] * 4})
    built = term_settings_of(values)
    assert (built.friction.share, built.coupling.stiffness, built.spring.pose) == (0.5, tuple(coupling), (0.1,) * 4)
    with pytest.raises(ParameterError, match=r"^coupling.stiffness = .* two joints or more"):
        term_settings_of({**values, "coupling.stiffness": [0.0, 1.0, 0.0, 0.0]})
    with pytest.raises(ParameterError, match=r"^limits.lower = .* below limits.upper"):
        term_settings_of({**values, "limits.lower": [0.5] * 4, "limits.upper": [0.5] * 4})


@pytest.mark.parametrize("edge", [{"lower": (-3.15, 0.2, -3.15, -3.15)}, {"upper": (3.15, 3.15, 1.0, 3.15)}])
def test_one_edge_of_the_workspace_switches_the_limits_on(edge):
    assert SoftLimits(**edge).on and not SoftLimits().on
