# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The commands as a user runs them, within the test's process, on packaged parameter files that a test changes."""

import copy
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import Mock

import pytest
import yaml

from exo_gravity.lab.report import html
from exo_gravity.tools import budget

from ..support import CONFIG


class Ended(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def text(self) -> str:
        return self.out + self.err


@pytest.fixture
def run_tool(capsys: pytest.CaptureFixture[str]) -> Callable[..., Ended]:
    """A function that runs a command with these words."""

    def run(tool: str, *words: object) -> Ended:
        try:
            code = import_module(f"exo_gravity.tools.{tool}").main([*map(str, words)])
        except SystemExit as ended:
            code = ended.code
        return Ended(code or 0, *capsys.readouterr())

    return run


@pytest.fixture
def params_with(tmp_path: Path) -> Callable[..., Path]:
    """A function that writes a packaged file with other values, {node: {parameter: value}}, and without some nodes."""

    def write(name: str, changes: Mapping[str, Mapping[str, Any]] | None = None, without: Iterable[str] = ()) -> Path:
        content = yaml.safe_load((CONFIG / name).read_text())
        for node, values in copy.deepcopy(dict(changes or {})).items():  # ROS reads no YAML aliases
            content.setdefault(node, {"ros__parameters": {}})["ros__parameters"].update(values)
        path = tmp_path / "params.yaml"
        path.write_text(
            yaml.safe_dump({node: entry for node, entry in content.items() if node not in without}, sort_keys=False)
        )
        return path

    return write


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures take longest: leave them empty in tests that do not look at them."""
    monkeypatch.setattr(html, "png_of", lambda *_: b"")
    monkeypatch.setattr(budget, "joint_figure", Mock())
