# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The study of the wearer's torque: its virtual muscles, its tables and their limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration.random_device import UPRIGHT
from bench.wearer import payload, tiring, ways
from bench.wearer.devices import draw, holding, simulated
from bench.wearer.muscles import ACTIVATION, DELAY, Muscles, Phase, phase_at
from bench.wearer.report import verdict
from bench.wearer.strapped_arm import RHYTHM, StrappedArm
from bench.wearer.study import KINDS, Trial
from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.weighing import Weighed
from exo_gravity.core.numbers import COVER
from exo_gravity.lab.observer.share import Share, WearerCurve
from exo_gravity.sim import STEP, ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.script import TrialScript

LENGTH = (0.05, 0.13, 0.30, 0.30)
LOAD = Wearer(75.0).on_links(LENGTH)
ARM = ArmModel(LENGTH, LOAD.cog, LOAD.mass)
POSE = (0.2, 0.9, 0.7, 0.6)
STILL = (0.0,) * 4


def torques(phases: tuple[Phase, ...], seconds: float) -> np.ndarray:
    """Return the torque (n, 4) of a wearer at every step, whose arm does not move from POSE."""
    script = TrialScript.parse({"name": "still", "steps": [{"hold": seconds}]})
    muscles = Muscles(script, phases, ARM, lambda: Tilt.of("right"), 1)
    muscles.torque(-STEP, POSE, STILL)
    return np.array([muscles.torque(n * STEP, POSE, STILL) for n in range(round(seconds / STEP))])


def test_a_commanded_share_of_the_weight_comes_late_and_noisy():
    torque = torques((Phase(POSE, 1.0, 3.0, (0.5, 0.5)),), 3.0)
    weight = gravity_torque(ARM, POSE)
    late = round(DELAY / STEP)
    assert not np.any(torque[: late - 1])
    assert torque[late + round(ACTIVATION / STEP), 1] == pytest.approx(0.63 * 0.5 * weight[1], rel=0.15)
    assert torque[1000:].mean(axis=0) == pytest.approx(0.5 * weight, rel=0.05, abs=0.01)
    assert 0.01 < torque[1000:, 1].std() / torque[1000:, 1].mean() < 0.06


def test_a_wearer_who_rests_gives_nothing_and_one_who_tires_gives_less():
    assert np.abs(torques((Phase(POSE, 1.0, 3.0, (0.5, 0.5), rests=True),), 3.5)[2500:]).max() < 1e-6
    tired = torques((Phase(POSE, 1.0, 7.0, (0.6, 0.2)),), 8.5)[:, 1] / gravity_torque(ARM, POSE)[1]
    assert tired[900:1100].mean() == pytest.approx(0.55, abs=0.05)
    assert tired[7800:8000].mean() == pytest.approx(0.21, abs=0.03)
    assert not np.any(tired[8001:])  # after the last phase


def test_the_phases_follow_each_other():
    phases = (Phase(POSE, 1.0, 2.0, (0.5, 0.5)), Phase(POSE, 0.5, 1.0, (0.5, 0.5)))
    assert phase_at(phases, 2.5) == (0, 2.5)
    assert phase_at(phases, 3.25) == (1, 0.25)
    assert phase_at(phases, 9.0) == (1, 6.0)


def test_a_band_that_is_too_narrow_and_a_share_that_is_wrong_miss_their_limits():
    trial = judge_of_constant(0.0)
    dice = np.random.default_rng(1)
    share = Share(np.array(0.52), np.array(0.1))
    trial = replace(
        trial,
        error=dice.normal(size=trial.error.shape),
        kind=np.arange(len(trial.kind)) % len(KINDS),
        share=share,
        parts=((share, 0.5),) * 3,
    )
    assert all(row.held for row in verdict([trial]))
    narrow = replace(trial, curve=trial.curve._replace(deviation=0.5 * trial.curve.deviation))
    assert [row.what for row in verdict([narrow]) if not row.held] == ["all: within the 95 % band"]
    assert [row.what for row in verdict([replace(trial, true_share=0.6)]) if not row.held] == [
        "share over a trial, largest error"
    ]
    assert not all(row.held for row in verdict([replace(trial, trouble="let down")]))


def test_a_load_that_is_weighed_wrongly_misses_its_limit_and_one_that_is_refused_is_counted():
    results: payload.Weighings = [Weighed(mass, 0.0, np.ones(4)) for mass in (0.02, 0.22, 1.1, 2.02)]
    rows = {row.what: row for row in payload.verdict([results])}
    assert rows["load of 0.2 kg, error"].held and not rows["load of 1 kg, error"].held
    assert rows["load of 1 kg, error"].shown == "80 g at most; 0 of 1 within, 0 refused"
    results[1] = None
    refused = payload.verdict([results])[0]
    assert "1 refused" in refused.shown and not refused.held


def test_a_wearer_who_tires_has_the_strength_that_the_study_says():
    script = TrialScript.parse({"name": "still", "steps": [{"hold": 200.0}]})
    wearer = tiring.Tiring(script, (Phase(POSE, 1.0, 199.0, (0.0, 0.0)),), ARM, lambda: Tilt.of("right"), 1)
    begin = tiring.MOVE + tiring.RESTED
    shares = [(wearer.strength_at(begin + since, -5.0) - tiring.SPARE) / 5.0 for since in (0.0, 30.0, 60.0, 79.0, 81.0)]
    assert shares == pytest.approx([0.6, 0.4, 0.2, 0.2, 0.6])
    assert wearer.strength_at(begin - 1.0, 5.0) > 20.0


def test_a_joint_that_is_too_fast_and_an_arm_that_is_let_down_miss_their_limits():
    time = np.linspace(0.0, 110.0, 1101)
    calm = tiring.Tired(0, time, np.where(time < 60.0, 0.4, 0.75), 0.1, 0.2, "")
    rows = tiring.verdict([(calm, replace(calm, sunk=1.0))])
    assert all(row.held for row in rows) and rows[0].shown == "75 %, 75 to 75"
    assert [row.shown.split(" in")[0] for row in rows if "furthest" in row.what] == ["11 degrees", "57 degrees"]
    missed = tiring.verdict([(replace(calm, speed=0.31), replace(calm, trouble="let down"))])
    assert [row.what for row in missed if not row.held] == [
        "tiring from 60 to 20 %: fastest joint", "tiring from 60 to 20 %: arms carried to the end",
    ]  # fmt: skip


def test_torques_measured_in_poses_know_an_arm_better_than_a_table():
    plain, sprung, carried = (ways.seen_of(draw(3, effect)) for effect in ("none", "springs", "carries"))
    assert plain.left[ways.NOW] < 0.03 < plain.left[0] and sprung.left[ways.NOW] < 0.03
    assert np.all(sprung.left[: ways.NOW] > 2.0 * sprung.left[ways.NOW])  # no other way knows springs
    assert carried.left[ways.NOW] > 0.05  # which no torque shows,
    assert carried.share_covered[1] and np.all(carried.covered[1] > 0.9) and carried.band[1] > 0.2  # but its band says
    assert ways.tables([[plain, plain, sprung, carried, carried, plain]]).count("\n") == 24


def test_a_shoulder_that_rises_is_within_the_error_of_a_calibration_that_has_seen_it():
    worn, poses = draw(4, "shoulder"), np.random.default_rng(4).uniform(ways.LOW, ways.HIGH, (60, 4))
    arm, bare, _ = simulated(worn.config, worn.is_strapped)
    needed = [holding(arm, pose, UPRIGHT) - holding(bare, pose, UPRIGHT) for pose in poses]
    error = np.abs(ways.ways_of(worn)[ways.NOW](poses) - needed)
    assert np.all(np.mean(error <= COVER * np.array(worn.settings.model_error.wearer_torque), axis=0) > 0.9)


def test_a_strapped_arm_is_held_by_the_torque_of_both_arms_and_its_shoulder_rises_with_it():
    config = ArmConfig(
        DEFAULT_LINKS, wearer_mass=LOAD.mass.tolist(), wearer_cog=LOAD.cog.tolist(), coulomb_friction=(0.0,) * 4
    )
    torque = gravity_torque(DEFAULT_LINKS.with_wearer(LOAD.mass, LOAD.cog), POSE).tolist()
    for rhythm, within in ((0.0 * RHYTHM, 0.05), (RHYTHM, 0.15)):
        arm = StrappedArm(config, rhythm)
        arm.reset(POSE)
        arm.step(torque, 250)
        assert arm.positions[:4] == pytest.approx(POSE, abs=within)
        assert 0.001 < arm.gap < 0.04
        at_rest = arm.data.qpos[4:7] - rhythm * (1.0 - np.diff(arm.data.xpos[8:10], axis=0)[0, 2] / LENGTH[2])
        assert np.abs(at_rest).max() < 0.015
    arm = StrappedArm(config, 0.0 * RHYTHM)
    arm.reset(POSE)
    arm.data.qfrc_applied[7:] = (0.0, 3.0, 0.0, 0.0)  # the wearer's muscles lift both arms by the straps
    arm.step(torque, 250)
    assert arm.positions[1] > POSE[1] + 0.05


def judge_of_constant(error: float) -> Trial:
    """Return a trial whose estimate is off by `error` Nm everywhere."""
    ones = np.ones((1000, 4))
    curve = WearerCurve(np.arange(1000.0), ones, ones, ones, ones)
    share = Share(np.array(0.5), np.array(0.1))
    return Trial(0, curve, curve, np.full((3, 1000, 4), error), np.zeros(1000, int), share, 0.5, (), "")
