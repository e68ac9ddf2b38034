"""Where recordings and saved parameters go."""

import asyncio
from pathlib import Path

import yaml

from exo_gravity.panel.studio import Studio


class Device:
    """One compensator, no bridge."""

    def parameters(self):
        return {"/right/compensator": {"mode": "one_g", "robot.mass": [0.5] * 4, "anfis": []}}

    def states(self):
        return {}

    async def perform(self, script):
        return ""


def test_parameters_saved_twice_within_a_second_are_two_files(tmp_path):
    studio = Studio(str(tmp_path), None, Device(), print)
    paths = []
    for _ in range(3):
        assert asyncio.run(studio.save()) == ""
        paths.append(studio.state()["saved"])
    assert len(set(paths)) == 3
    expected = {"/right/compensator": {"ros__parameters": {"mode": "one_g", "robot": {"mass": [0.5] * 4}}}}
    assert [yaml.safe_load(Path(path).read_text()) for path in paths] == [expected] * 3


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "taken").write_text("")
    studio = Studio(str(tmp_path / "taken"), None, Device(), print)
    assert asyncio.run(studio.save()) == f"{tmp_path}/taken: Not a directory"
    assert str(tmp_path / "taken") in asyncio.run(studio.record())
