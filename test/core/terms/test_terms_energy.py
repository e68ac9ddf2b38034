# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The terms on the simulated arm: 12-bit frames, torques up to 10 ms late, random arms, frictions and wearers.

A passive term gives no more energy than it took plus what it may have stored. `friction` and `inertia` are fed by the
joints' own friction: what they give is bounded by what that takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.kinematics import least_inertia, links_of
from exo_gravity.core.compensation.terms.catalogue import (
    DELAY,
    INERTIA,
    Coupling,
    Damping,
    Friction,
    Inertia,
    SoftLimits,
    Spring,
)
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS

from ...support.terms_run import COULOMB, POSE, TermsRun, no_push, sines

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

    def pushed(self, settings: TermSettings, strength: float = 0.6) -> TermsRun:
        """Return a run in which a wearer pushes the arm about, and then leaves it alone until it rests."""
        settings = settings.on_arm(self.links)
        run = TermsRun(settings, self.config, self.links, period=self.period, delay=self.delay)
        wearer = sines(self.seed, PUSHED, strength)
        run.run(PUSHED, wearer)
        assert run.comes_to_rest(wearer)
        return run


@pytest.fixture
def case() -> Case:
    return Case(0)


def stiffest(links: ArmModel) -> tuple[float, ...]:
    """Return the stiffness (4,) in Nm/rad up to which springs are accepted."""
    return tuple((0.999 * np.array(least_inertia(links_of(links))) / (4.0 * DELAY**2)).tolist())


def test_friction_gives_less_than_the_joints_friction_takes(case):
    run = case.pushed(TermSettings(friction=Friction(0.85, case.identified, case.config.viscous_friction)))
    assert run.given > 0.3 * run.rubbed  # it does help
    assert run.worst_balance < 0.02


@pytest.mark.parametrize("friction_share", [0.0, 0.7])
def test_inertia_gives_no_more_than_its_tank_and_the_joints_friction(case, friction_share):
    chosen = TermSettings(inertia=Inertia(0.8), friction=Friction(friction_share, case.identified))
    run = case.pushed(chosen)
    assert run.worst_balance < 2.0 * INERTIA.tank


def test_inertia_10_ms_late_on_an_arm_with_little_friction_starts_no_limit_cycle():
    case = Case(2, smoothness=0.3)
    case.delay = 0.01
    run = case.pushed(TermSettings(inertia=Inertia(0.8), friction=Friction(0.0, case.identified)))
    assert run.worst_balance < 2.0 * INERTIA.tank


def test_inertia_without_an_identified_friction_lives_on_its_tank(case):
    run = case.pushed(TermSettings(inertia=Inertia(0.8)))
    assert 0.05 < run.most_given < 2.5 * INERTIA.tank
    assert run.worst_balance < 2.0 * INERTIA.tank


def test_the_strongest_damping_only_takes(case):
    least = np.array(least_inertia(links_of(case.links)))
    run = case.pushed(TermSettings(damping=Damping(tuple((0.999 * least / (2.0 * DELAY)).tolist()))))
    assert run.given < -0.02
    assert run.most_given < 0.01


def test_the_stiffest_spring_gives_no_more_than_it_stored(case):
    limit = (1.0, 2.0, 1.0, 1.0)
    run = case.pushed(TermSettings(spring=Spring(stiffest(case.links), (0.0, 0.4, 0.4, 0.5), limit)))
    stored = float(np.abs(np.subtract(POSE, (0.0, 0.4, 0.4, 0.5))) @ limit)
    assert run.most_given < stored


def test_the_stiffest_edges_of_a_workspace_return_no_more_than_they_took(case):
    edges = SoftLimits(np.subtract(POSE, 0.1), np.add(POSE, 0.1), stiffest(case.links))
    run = case.pushed(TermSettings(limits=edges))
    assert run.given < 0.0
    assert run.most_given < 0.05


def test_a_coupling_gives_no_more_than_it_stored(case):
    coupling = Coupling((0.0, 0.0, -1.5, 3.0))
    run = case.pushed(TermSettings(coupling=coupling))
    gap = abs(POSE[3] - 0.5 * POSE[2])
    assert run.most_given < 0.5 * 3.0 * gap**2 + 0.25


def test_all_terms_together_let_the_arm_come_to_rest(case):
    half = tuple(0.5 * k for k in stiffest(case.links))
    case.pushed(
        TermSettings(
            friction=Friction(0.8, case.identified),
            inertia=Inertia(0.8),
            damping=Damping((0.02,) * 4),
            spring=Spring(half, POSE),
            coupling=Coupling((0.0, 0.0, -0.5, 1.0)),
            limits=SoftLimits((-1.5, 0.0, -0.6, 0.0), (1.5, 1.6, 1.6, 2.5), half),
        )
    )


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
        run = TermsRun(chosen, case.config, case.links, pose, period=0.004, delay=0.008)
        run.device.arm.data.qvel[:] = 0.3
        run.run(4.0, no_push)
        assert run.travel(3.0) < 0.2 * 3.0 / 60.0, pose
        assert math.degrees(np.abs(np.subtract(run.positions[-1], pose)).max()) < 15.0
