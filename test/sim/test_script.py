# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A trial script is parsed completely, or rejected with the name of the invalid entry."""

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.sim.script import Step, TrialScript

GOOD = {
    "name": "short",
    "steps": [{"move": [0, 0.5, 0.6, 0.5], "over": 2.0}, {"hold": 10}, {"push": [0, 1, 1, 0], "over": 0.5}],
}


def test_a_script_returns_the_active_step_and_the_time_since_its_start():
    script = TrialScript.parse(GOOD)
    assert script.duration == 12.5
    assert script.at(1.9)[0] == 0
    index, since = script.at(2.5)
    assert (script.steps[index].action, since) == ("hold", 0.5)
    assert script.at(13.0)[0] == len(script.steps)


def test_steps_of_the_trunk_have_an_angle_or_only_a_duration_and_one_of_the_hand_a_mass():
    steps = [{"bow": 0.5, "over": 3}, {"lean": -0.3, "over": 2.0}, {"walk": 60.0}, {"sit": 2}, {"load": 2, "over": 1}]
    bow, lean, *others = TrialScript.parse({"name": "trunk", "steps": steps}).steps
    assert (bow, lean) == (Step("bow", 3.0, (0.5,)), Step("lean", 2.0, (-0.3,)))
    assert others == [Step("walk", 60.0), Step("sit", 2.0), Step("load", 1.0, (2.0,))]


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (None, "script"),
        ({"name": "x", "steps": [], "extra": 1}, "script"),
        *(({"name": name, "steps": [{"hold": 1}]}, "name") for name in ("/tmp/x", "../x", "", None, "a\nb", "x" * 101)),
        ({"name": "x", "steps": []}, "steps"),
        ({"name": "x", "steps": [{"hold": 1, "over": 1}]}, "steps[0]"),
        ({"name": "x", "steps": [{"hold": "long"}]}, "steps[0].hold"),
        ({"name": "x", "steps": [{"move": [0, 0, 0, 0], "over": 1}, {"move": [0, 0, 0], "over": 1}]}, "steps[1].move"),
        ({"name": "x", "steps": [{"move": [0, 0, 0, 90], "over": 1}]}, "steps[0].move"),
        ({"name": "x", "steps": [{"push": [0, 0, 0, 1], "over": -1}]}, "steps[0].over"),
        ({"name": "x", "steps": [{"bow": 45, "over": 3}]}, "steps[0].bow"),
        ({"name": "x", "steps": [{"bow": 0.5}]}, "steps[0]"),
        ({"name": "x", "steps": [{"walk": 0.5}]}, "steps[0].walk"),
        ({"name": "x", "steps": [{"load": 200, "over": 1}]}, "steps[0].load"),
    ],
)
def test_an_invalid_entry_is_named(content, name):
    with pytest.raises(ParameterError) as caught:
        TrialScript.parse(content)
    assert caught.value.name == name


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (b"name: x\nsteps:\n  - {hold: 1.0}\nsteps:\n  - {hold: 2.0}\n", "steps is given twice"),
        (b"name: x\nsteps: [{hold: 1.0, hold: 30.0}]\n", "hold is given twice"),
        (b"\xff\xfe", "decode"),
        (b"[" * 5000, "depth"),
        (None, "No such file"),
    ],
)
def test_a_file_that_says_something_twice_or_cannot_be_read_is_refused(text, why, tmp_path):
    path = tmp_path / "trial.yaml"
    if text is not None:
        path.write_bytes(text)
    with pytest.raises(ParameterError, match=why) as caught:
        TrialScript.read(path)
    assert caught.value.name == "trial" and str(path) in str(caught.value)
