# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""budget: from a parameter file to a table, a verdict, figures and an exit code."""

import re

import matplotlib.image
import pytest
import yaml
from matplotlib.figure import Figure

from exo_gravity.tools.budget import main

from ..support import CONFIG

BRIDGE, COMPENSATOR = "/right/can_bridge", "/right/compensator"
SIM = CONFIG / "sim.yaml"


@pytest.fixture
def run(tmp_path, capsys):
    """Run budget on the packaged simulated arm with `changes` {node: {parameter: value}}; return its code and text."""

    def run(*arguments, changes=None, without=()):
        content = {node: entry for node, entry in yaml.safe_load(SIM.read_text()).items() if node not in without}
        for node, values in (changes or {}).items():
            content[node]["ros__parameters"].update(values)
        params = tmp_path / "params.yaml"
        params.write_text(yaml.safe_dump(content))
        code = main(["--params", str(params), "--output", str(tmp_path / "out"), *map(str, arguments)])
        output = capsys.readouterr()
        return code, output.out + output.err

    return run


@pytest.fixture
def plain(monkeypatch):
    """Figures take longest: draw blank ones in tests that do not look at them."""
    blank = Figure(figsize=(1, 1))
    monkeypatch.setattr("exo_gravity.tools.budget.joint_figure", lambda *_: blank)


def abduction(text):
    """Return the words of joint 2's row."""
    (row,) = (line.split() for line in text.splitlines() if "2 shoulder abduction" in line)
    return row


@pytest.mark.usefixtures("plain")
def test_full_zero_g_of_75_kg_is_reported_as_beyond_the_papers_motors_and_by_how_much(run):
    code, text = run("--body-mass", 75)
    assert code == 1 and "75 kg is beyond the motors of /right" in text
    assert (abduction(text)[3:7], abduction(text)[-1]) == (["AK80-9", "9", "18", "19.63"], "AK80-64")
    assert "within rated torque everywhere is 0.068" in text
    _, text = run("--body-mass", 75, changes={BRIDGE: {"torque_scale": [1.0, 0.75, 1.0, 1.0]}})
    assert abduction(text)[3:6] == ["AK80-9", "6.75", "13.5"]  # a motor that gives three quarters of its torque
    _, text = run("--body-mass", 75, changes={COMPENSATOR: {"robot": {"mass": [1.0, 1.0, 3.0, 1.0]}}})
    assert "The robot alone needs more than rated torque" in text


@pytest.mark.usefixtures("plain")
def test_a_load_in_the_hand_is_part_of_the_torques_and_of_the_moments_that_can_bridge_gets(run):
    _, bare = run("--body-mass", 40, "--support", 0.5)
    _, loaded = run("--body-mass", 40, "--support", 0.5, "--payload", 1.5)
    assert "of a wearer of 40 kg with 1.5 kg in the hand is beyond" in loaded
    moments = [re.search(r"largest_moment: \[(.*?)\]", text)[1].split(", ") for text in (bare, loaded)]
    added = [float(new) - float(old) for old, new in zip(*moments, strict=True)]
    assert added == pytest.approx([1.5 * length for length in (0.05, 0.13, 0.30, 0.30)], abs=0.0011)


def test_every_joint_gets_a_figure(run, tmp_path):
    run("--body-mass", 40, "--support", 0.5)
    pictures = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in pictures] == [f"right_joint_{number}.png" for number in (1, 2, 3, 4)]
    assert all(matplotlib.image.imread(path).std() > 0.05 for path in pictures)


@pytest.mark.usefixtures("plain")
def test_mirrored_arms_share_one_table(tmp_path, capsys):
    both = ["--params", str(SIM.with_name("sim_both.yaml")), "--output", str(tmp_path), "--body-mass", "60"]
    assert main(both) == 1
    text = capsys.readouterr().out
    assert "/right and /left at support 1" in text and text.count("joint                 motor") == 1


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"changes": {COMPENSATOR: {"link_length": [0.05, 0.13, 0.3, 0.15]}}}, COMPENSATOR),  # shorter than the forearm
        ({"without": (BRIDGE,)}, BRIDGE),
    ],
)
def test_a_wearer_who_does_not_fit_and_an_arm_without_a_bridge_are_refused_by_the_node(run, given, named):
    code, text = run("--body-mass", 75, **given)
    assert code == 2 and text.startswith("budget: ") and named in text and text.count("\n") == 1
