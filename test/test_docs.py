# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The documents' programs print what they show, and the documents' commands exist.

`.ci/house.py`, which `make lint` runs, checks links and paths; `docs/tables.py --check` the tables.
"""

import contextlib
import importlib
import io
import re
import shlex
from pathlib import Path

import pytest

from exo_gravity.lab.processes import node_modules

from .support.document_commands import DOCUMENTS, ELSEWHERE, ROOT, ROS2

EXAMPLE = re.compile(r"```python\n(.*?)```\s*```text\n(.*?)```", re.DOTALL)


def commands_of(path: Path) -> list[str]:
    """Return the commands in the shell blocks of a document, and those of `ros2` in its text, without comments."""
    text = path.read_text(encoding="utf-8")
    blocks = re.findall(r"^ *```sh\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL)
    lines = [line.strip() for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    prose = re.sub(r"^ *```.*?^ *```", "", text, flags=re.MULTILINE | re.DOTALL)
    lines += [code for code in re.findall(r"`(ros2 [^`]*)`", prose) if len(code.split()) > 3]
    found = (" ".join(re.sub(r"(^|\s+)#.*", "", line).split()) for line in lines)
    return [command for command in found if command]


def words_of(command: str) -> list[str]:
    """Return the words of a command of ours, without a workspace's prefix and the background's ampersand."""
    return shlex.split(command.removeprefix("ros2 run exo_gravity ").rstrip("& "))


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", [path for path in DOCUMENTS if EXAMPLE.search(path.read_text("utf-8"))], ids=name)
def test_the_programs_in_a_document_print_what_it_shows(path: Path) -> None:
    names: dict[str, object] = {}
    for code, shown in EXAMPLE.findall(path.read_text(encoding="utf-8")):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(code, names)
        assert printed.getvalue() == shown


@pytest.mark.parametrize("path", [path for path in DOCUMENTS if commands_of(path)], ids=name)
def test_every_command_is_one_that_exists(path: Path) -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    studies = re.findall(r"^([\w-]+)\) #", (ROOT / ".ci" / "study").read_text("utf-8"), re.MULTILINE)
    for command in commands_of(path):
        if command in ROS2 or command.startswith(tuple(ELSEWHERE)):
            continue
        tool, *words = words_of(command)
        if tool == "make":
            assert words[0] in targets, command
            assert {word[5:] for word in words if word.startswith("NAME=")} <= set(studies), command
        elif tool not in node_modules():
            importlib.import_module(f"exo_gravity.tools.{tool}")._arguments(words)  # SystemExit if it is wrong
