# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""ANFIS inference against Jang's five layers written out, and the law that uses it only inside its training box."""

import json
import math
from itertools import product

import numpy as np
import pytest

from exo_gravity.core import ArmModel, Tilt
from exo_gravity.core.arm.anfis import Anfis, AnfisLaw, grades
from exo_gravity.core.errors import DataError
from exo_gravity.lab.anfis_file import text_of

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


def test_a_grid_of_4_functions_on_3_inputs_has_64_rules_and_280_parameters():
    model = random_model(1, 3, 4)
    assert (model.rules, model.parameters) == (64, 64 * 4 + 2 * 3 * 4)


def test_normalised_memberships_sum_to_1_even_far_from_all_centres():
    model = random_model()
    share = grades(model.centre, model.sigma, np.array(((0.1, 0.2, 0.3), (1e6, -1e6, 50.0))))
    assert share.sum(axis=-1) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("sigma", np.zeros((3, 3, 2))),
        ("sigma", np.ones((3, 3, 3))),
        ("centre", np.full((3, 3, 2), math.nan)),
        ("centre", np.ones((3, 2))),
        ("consequent", np.ones((3, 7, 4))),
        ("consequent", "many"),
    ],
)
def test_invalid_arrays_are_rejected_by_name(part, value):
    parts = {name: getattr(random_model(), name) for name in ("centre", "sigma", "consequent")}
    with pytest.raises(DataError, match=part):
        Anfis(**{**parts, part: value})


def test_too_many_rules_are_rejected():
    with pytest.raises(DataError, match="rules"):
        Anfis(np.zeros((1, 10, 5)), np.ones((1, 10, 5)), np.zeros((1, 1, 11)))


def test_a_law_read_back_from_its_file_gives_the_same_torques():
    before, theta = law(), np.random.default_rng(3).uniform(0, 2, (50, 3))
    after = AnfisLaw.load(text_of(before))
    assert np.array_equal(after.torques(theta), before.torques(theta))
    assert (after.low, after.high, after.first_moment) == (before.low, before.high, before.first_moment)
    assert (after.source, after.error) == (before.source, before.error)


def test_the_file_has_one_line_per_rule():
    lines = text_of(law()).splitlines()
    assert sum(line.strip().startswith("[") and line.count(",") >= 3 for line in lines) == 3 * 8


@pytest.mark.parametrize(
    ("flaw", "named"),
    [
        (lambda c: c.pop("box"), "box"),
        (lambda c: c["joints"].pop("3"), "3"),
        (lambda c: c.update(format="another"), "another"),
        (lambda c: c["box"].update(theta_3=[1.0, 0.0]), "theta_3"),
        (lambda c: c["box"].update(theta_2=[0.0, math.nan]), "theta_2"),
        (lambda c: c["arm"].update(gravity=0.0), "gravity"),
        (lambda c: c["arm"].update(first_moment=[1.0]), "first_moment"),
        (lambda c: c["joints"]["2"].update(sigma=[[1.0]]), "sigma"),
        (lambda c: c["joints"]["4"].update(training_rmse="small"), "small"),
        (lambda c: c.update(joints=[]), "train_anfis"),
    ],
)
def test_an_error_in_a_file_is_rejected_and_named(flaw, named):
    content = json.loads(text_of(law()))
    flaw(content)
    with pytest.raises(DataError, match=named):
        AnfisLaw.load(json.dumps(content))


@pytest.mark.parametrize("text", ["", "no JSON", "[1, 2]", "3"])
def test_text_that_is_not_a_law_is_rejected(text):
    with pytest.raises(DataError):
        AnfisLaw.load(text)


def test_a_single_pose_agrees_with_the_arrays_scaled_by_the_arms_gravity_and_gain():
    arm = ArmModel(ARM.length, ARM.cog, ARM.mass, (1.0, 0.5, 1.5, 2.0), 4.9)
    expected = law().torques(np.array((INSIDE[1:],)))[0] * (0.5, 1.5, 2.0) * 0.5
    assert law().torque(arm, INSIDE, UPRIGHT)[1:] == pytest.approx(tuple(expected))


@pytest.mark.parametrize(
    ("arm", "theta", "tilt"),
    [
        (ARM, INSIDE, UPRIGHT),
        (ARM, (3.0, *INSIDE[1:]), UPRIGHT),
        (ARM, INSIDE, Tilt.of("right", math.radians(0.49), 0.0)),
        (ArmModel(ARM.length, ARM.cog, ARM.mass, (0.5,) * 4, 1.6), INSIDE, UPRIGHT),
    ],
    ids=["in its box", "any angle of joint 1", "tilted by half a degree", "another gain and gravity"],
)
def test_in_its_box_for_its_arm_and_upright_the_law_applies(arm, theta, tilt):
    assert law().outside(arm, theta, tilt) == ""


WORN = ARM.with_wearer((0, 0, 1.0, 0.5), (0, 0, 0.1, 0.1))
OUTSIDE = [(ARM, INSIDE, Tilt.of("right", *tilt), "tilted") for tilt in ((0.02, 0.0), (0.0, -0.02), (0.3, 0.3))]
OUTSIDE += [
    (ARM, (*INSIDE[:joint], angle, *INSIDE[joint + 1 :]), UPRIGHT, f"theta_{joint + 1}")
    for joint in (1, 2, 3)
    for angle in (-1.0, 3.5, math.nan)
]


@pytest.mark.parametrize(("arm", "theta", "tilt", "reason"), [*OUTSIDE, (WORN, INSIDE, UPRIGHT, "another arm")])
def test_elsewhere_the_law_names_the_reason(arm, theta, tilt, reason):
    assert reason in law().outside(arm, theta, tilt)


def test_the_sentence_stays_the_same_as_long_as_the_reason_does():
    sentences = {law().outside(ARM, (0, angle, 0.5, 0.5), UPRIGHT) for angle in (-0.2, -0.3, -0.4)}
    assert len(sentences) == 1
