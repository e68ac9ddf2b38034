# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The learned law: as Jang's five layers, only where it was trained, and one's own law in its place."""

import math
from importlib.metadata import EntryPoint
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.compensation import laws
from exo_gravity.core.compensation.compensator import FALLBACK_TIME, Compensator
from exo_gravity.core.compensation.settings import COMPENSATOR, settings_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import installed, values_of
from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.lab.anfis import Anfis, AnfisLaw, grades, text_of

from ..support import ROBOT
from ..support.compensator_run import PERIOD, THETA, CompensatorRun, settings_with

ARM = ArmModel((0.05, 0.13, 0.30, 0.30), (0.04, 0.10, 0.2, 0.12), (0.5, 0.4, 0.6, 0.2))
UPRIGHT = Tilt.of("right")
INSIDE = (0.7, 1.0, 0.5, 1.5)


def random_model(models=3, inputs=3, functions=2, seed=1):
    rng = np.random.default_rng(seed)
    consequent = rng.normal(size=(models, functions**inputs, inputs + 1))
    return Anfis(
        rng.uniform(-1, 1, (models, inputs, functions)), rng.uniform(0.3, 1.5, (models, inputs, functions)), consequent
    )


def law():
    error = {"training": [1e-3] * 3, "held_out": [2e-3] * 3}
    box = (-0.17, -0.78, -0.17), (3.14, 2.53, 3.14)
    return AnfisLaw(random_model(), *box, ARM.first_moment[1:], 9.8, "made up", error)


def five_layers(model, which, u):
    """Jang 1993, section III: memberships, firing strengths, their normalisation, consequents, and their sum."""
    centre, sigma = model.centre[which], model.sigma[which]
    dimension, functions = centre.shape
    membership = [
        [math.exp(-0.5 * ((u[i] - centre[i, j]) / sigma[i, j]) ** 2) for j in range(functions)]
        for i in range(dimension)
    ]
    strength = [
        math.prod(membership[i][j] for i, j in enumerate(rule)) for rule in product(range(functions), repeat=dimension)
    ]
    normalised = [w / sum(strength) for w in strength]
    consequent = [p[0] + sum(a * b for a, b in zip(p[1:], u, strict=True)) for p in model.consequent[which]]
    return sum(w * f for w, f in zip(normalised, consequent, strict=True))


@pytest.mark.parametrize(("inputs", "functions"), [(1, 3), (2, 2), (3, 4), (4, 2)])
def test_the_output_equals_that_of_jangs_five_layers(inputs, functions):
    model = random_model(2, inputs, functions)
    samples = np.random.default_rng(2).uniform(-1.2, 1.2, (20, inputs))
    expected = [[five_layers(model, which, u) for which in range(2)] for u in samples]
    assert model.output(samples) == pytest.approx(np.array(expected), abs=1e-12)


def test_normalised_memberships_sum_to_1_even_far_from_all_centres():
    model = random_model()
    share = grades(model.centre, model.sigma, np.array(((0.1, 0.2, 0.3), (1e6, -1e6, 50.0))))
    assert share.sum(axis=-1) == pytest.approx(1.0)


def test_a_law_read_back_from_its_file_gives_the_same_torques():
    before, theta = law(), np.random.default_rng(3).uniform(0, 2, (50, 3))
    lines = text_of(before).splitlines()
    assert sum(line.strip().startswith("[") and line.count(",") >= 3 for line in lines) == 3 * 8  # one a rule
    after = AnfisLaw.load(text_of(before))
    assert np.array_equal(after.torques(theta), before.torques(theta))
    assert (after.low, after.high, after.first_moment) == (before.low, before.high, before.first_moment)
    assert (after.source, after.error) == (before.source, before.error)


def test_a_single_pose_agrees_with_the_arrays_scaled_by_the_arms_gravity_and_gain():
    arm = ArmModel(ARM.length, ARM.cog, ARM.mass, (1.0, 0.5, 1.5, 2.0), 4.9)
    expected = law().torques(np.array((INSIDE[1:],)))[0] * (0.5, 1.5, 2.0) * 0.5
    assert law().torque(arm, INSIDE, UPRIGHT)[1:] == pytest.approx(tuple(expected))


WORN = ARM.with_wearer((0, 0, 1.0, 0.5), (0, 0, 0.1, 0.1))
APPLIES = [  # the arm, its angles, the tilt, and why the law does not apply; '' where it does
    (ARM, INSIDE, UPRIGHT, ""),
    (ARM, (3.0, *INSIDE[1:]), UPRIGHT, ""),  # any angle of joint 1
    (ARM, INSIDE, Tilt.of("right", math.radians(0.49), 0.0), ""),
    (ArmModel(ARM.length, ARM.cog, ARM.mass, (0.5,) * 4, 1.6), INSIDE, UPRIGHT, ""),  # another gain and gravity
    (WORN, INSIDE, UPRIGHT, "another arm"),
    *((ARM, INSIDE, Tilt.of("right", *tilt), "tilted") for tilt in ((0.02, 0.0), (0.0, -0.02), (0.3, 0.3))),
    *(
        (ARM, (*INSIDE[:joint], angle, *INSIDE[joint + 1 :]), UPRIGHT, f"theta_{joint + 1}")
        for joint in (1, 2, 3)
        for angle in (-1.0, 3.5, math.nan)
    ),
]


@pytest.mark.parametrize(("arm", "theta", "tilt", "reason"), APPLIES)
def test_in_its_box_for_its_arm_and_upright_the_law_applies_and_elsewhere_it_names_the_reason(arm, theta, tilt, reason):
    found = law().outside(arm, theta, tilt)
    assert reason in found and bool(reason) is bool(found)


def learned(moments=ROBOT.first_moment[1:]):
    """The file of an ANFIS of constant 0.5, 1.0 and 0.25 Nm on joints 2 to 4, in a box of 0 to 1 rad."""
    rules = np.zeros((3, 8, 4))
    rules[:, :, 0] = [[0.5], [1.0], [0.25]]
    model = Anfis(np.tile([-1.0, 1.0], (3, 3, 1)), np.ones((3, 3, 2)), rules)
    error = {"training": [0.0] * 3, "held_out": [0.0] * 3}
    return text_of(AnfisLaw(model, (0.0,) * 3, (1.0,) * 3, moments, ROBOT.gravity, "made up", error))


@pytest.mark.parametrize(
    ("theta", "pitch", "moments", "why"),
    [
        ((0.2, 1.2, 0.6, 0.5), 0.0, ROBOT.first_moment[1:], "theta_2 is outside"),
        (THETA, 0.1, ROBOT.first_moment[1:], "tilted"),
        (THETA, 0.0, (0.3, 0.2, 0.1), "another arm"),
        (THETA, 0.0, ROBOT.first_moment[1:], ""),  # in its box
    ],
)
def test_where_the_anfis_was_not_trained_the_exact_law_replaces_it_and_the_reason_is_given(theta, pitch, moments, why):
    run = CompensatorRun(law="anfis", trained=learned(moments))
    run.compensator.tilt.set_tilt(run.now, pitch, 0.0)
    answer = run.cycle(1.2, theta)
    exact = gravity_torque(ROBOT, theta, Tilt.of("left", pitch).direction)
    assert why in answer.fallback and bool(why) is bool(answer.fallback)
    np.testing.assert_allclose(answer.effort, exact if why else (0.0, 0.5, 1.0, 0.25), rtol=1e-9)


@settings(max_examples=4, deadline=None)
@given(st.floats(0.001, 0.2), st.floats(0.1, 10.0))
def test_along_a_path_across_the_edge_of_the_box_the_torque_neither_steps_nor_chatters(width, hertz):
    run = CompensatorRun(law="anfis", trained=learned())
    run.cycle(2.0)
    run.efforts.clear()
    theta_2 = 1.0 + width * np.sin(2 * math.pi * hertz * np.arange(0.0, 3.0, PERIOD))  # about the edge of the box
    replaced = [bool(run.cycle(theta=(0.2, angle, 0.6, 0.5)).fallback) for angle in theta_2.tolist()]
    # The exact law changes by up to 3 Nm/rad along the path.
    remainders = GUIDANCE.rate * PERIOD
    assert run.largest_step <= 2 * remainders + 3.0 * width * 2 * math.pi * hertz * PERIOD
    switches = np.flatnonzero(np.diff(replaced))
    assert all(b - a >= FALLBACK_TIME / PERIOD - 1 for a, b in zip(switches[::2], switches[1::2], strict=False))


def test_a_change_of_settings_in_the_cycle_that_leaves_the_box_is_bridged_too():
    run = CompensatorRun(law="anfis", trained=learned())
    run.cycle(2.0)
    before = run.efforts[-1]
    run.compensator.apply(settings_with(law="anfis", trained=learned(), mode="zero_g"))
    run.cycle(theta=(0.2, 1.001, 0.6, 0.5))
    np.testing.assert_allclose(run.efforts[-1], before, atol=0.01)
    run.compensator.apply(settings_with(law="paper_static"))  # which does not wait for the ANFIS
    assert run.cycle(theta=(0.2, 1.001, 0.6, 0.5)).fallback == ""


NEAR, FAR = (0.1, 0.2, 0.3, 0.4), (0.1, 1.2, 0.3, 0.4)
CYCLE = 0.01  # s


class Springs:
    """Holds the arm as springs do, up to 1 rad of abduction."""

    def __init__(self, given):
        self._arm = given.arm

    def outside(self, theta, tilt):
        return "the springs reach to 1 rad" if theta[1] > 1.0 else ""

    def torque(self, theta, tilt):
        return tuple(0.5 * angle for angle in theta)


@pytest.fixture(autouse=True)
def other_laws(monkeypatch):
    """Another distribution has the law `springs`, and one that is not there."""
    entries = {"springs": f"{__name__}:Springs", "gone": "gone:law"}
    others = {name: EntryPoint(name, value, laws.GROUP) for name, value in entries.items()} | installed(laws.GROUP)
    for module in ("compensation.laws", "params"):
        monkeypatch.setattr(f"exo_gravity.core.{module}.installed", lambda _group: others)


def test_a_law_of_ones_own_carries_the_arm_and_where_it_does_not_apply_the_exact_law_until_a_while_later():
    with pytest.raises(ParameterError, match=r"^law = .*gone.*: must be a law that can be loaded: gone:law"):
        settings_of(values_of(COMPENSATOR, {"law": "gone"}))
    compensator = Compensator(settings_of(values_of(COMPENSATOR, {"law": "springs", "use_imu": False})))
    times = CYCLE * np.arange(round((3.0 * GUIDANCE.longest + FALLBACK_TIME) / CYCLE))
    begin, end = GUIDANCE.longest, 2.0 * GUIDANCE.longest
    poses = [FAR if begin <= time < end else NEAR for time in times]
    answers = [compensator.step(1.0 + time, pose, (0.0,) * 4) for time, pose in zip(times, poses, strict=True)]
    replaced = np.array([answer.fallback == "the springs reach to 1 rad" for answer in answers])
    assert times[replaced][[0, -1]] == pytest.approx((begin, end + FALLBACK_TIME), abs=2.5 * CYCLE)
    exact, _ = compensator.settings.torque(FAR, compensator.tilt.at(1.0), exact=True)
    held = poses.index(FAR) - 1, round(end / CYCLE) - 2, -1
    for answer, expected in zip(held, (0.5 * np.array(NEAR), exact, 0.5 * np.array(NEAR)), strict=True):
        assert answers[answer].effort == pytest.approx(expected)
