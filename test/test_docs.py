"""The documents agree with the code: generated tables, links, paths, and the library example of the README."""

import contextlib
import importlib
import io
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from exo_gravity.core.safety.drive import FaultCode
from exo_gravity.lab.processes import node_modules

from .support.document_commands import DOCUMENTS, ELSEWHERE, ROOT, ROS2, commands_of, words_of
from .support.waiting import PATIENCE

TABLES = ROOT / "docs" / "tables.py"
NODES = ("can_bridge", "compensator", "imu", "simulator", "recorder", "robot_model", "calibrator", "panel")
EXAMPLE = re.compile(r"```python\n(.*?)```\s*```text\n(.*?)```", re.DOTALL)
FOLDERS = "bench|config|docs|examples|exo_gravity|launch|test|core|hardware|sim|bag|panel|nodes|tools"


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def run_tables(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(TABLES), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)


def anchors(path: Path) -> set[str]:
    """Return the anchors of a document's headings, as GitHub forms them."""
    headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_the_tables_in_docs_equal_the_declarations() -> None:
    checked = run_tables("--check")
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_every_table_has_its_place_in_a_document() -> None:
    places = {n for path in DOCUMENTS for n in re.findall(r"<!-- table: (\w+) -->", path.read_text(encoding="utf-8"))}
    assert places == {*NODES, "urdf_arm", "faults", "topics"}


def test_a_document_that_differs_from_the_code_is_reported_with_the_command_that_renews_it(tmp_path: Path) -> None:
    copy = Path(shutil.copy(TABLES.with_name("safety.md"), tmp_path))
    text = copy.read_text(encoding="utf-8")
    declared = f"| {FaultCode.MOTOR_SILENT.meaning} |"
    assert declared in text
    copy.write_text(text.replace(declared, "| a motor is quiet |"), encoding="utf-8")
    checked = run_tables("--check", copy)
    assert checked.returncode == 1
    assert "table faults differs from the code; run python docs/tables.py" in checked.stdout
    run_tables(copy)
    assert copy.read_text(encoding="utf-8") == text


@pytest.mark.parametrize("path", DOCUMENTS, ids=name)
def test_every_link_leads_to_a_file_and_a_heading(path: Path) -> None:
    for link in re.findall(r"\]\((?!https?:)([^)]+)\)", path.read_text(encoding="utf-8")):
        file, _, anchor = link.partition("#")
        target = path.parent / file if file else path
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("path", DOCUMENTS, ids=name)
def test_every_path_in_backticks_exists(path: Path) -> None:
    for text in re.findall(rf"`((?:{FOLDERS})/[\w./]*)`", path.read_text(encoding="utf-8")):
        assert (ROOT / text).exists() or (ROOT / "exo_gravity" / text).exists(), text


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
    rules = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    for command in commands_of(path):
        if command in ROS2 or command.startswith(tuple(ELSEWHERE)):
            continue
        tool, *words = words_of(command)
        if tool == "make":
            assert words[0] in rules, command
        elif tool not in node_modules():
            importlib.import_module(f"exo_gravity.tools.{tool}")._arguments(words)  # SystemExit if it is wrong


def test_commands_of_ros2_are_in_the_documents() -> None:
    shown = {command for path in DOCUMENTS for command in commands_of(path)}
    assert set(ROS2) <= shown


def test_a_command_of_ours_has_no_prefix() -> None:
    assert not [command for path in DOCUMENTS for command in commands_of(path) if command.startswith(".venv/")]
    assert {name(path) for path in DOCUMENTS if "ros2 run exo_gravity" in path.read_text("utf-8")} == {
        "README.md",  # in its example of a workspace
        "docs/installation.md",  # which states the rule
    }


def test_the_site_has_every_document() -> None:
    toctrees = re.findall(r"```{toctree}\n(.*?)```", (ROOT / "docs" / "index.md").read_text("utf-8"), re.DOTALL)
    listed = {line for tree in toctrees for line in tree.splitlines() if line and not line.startswith(":")}
    assert {path.stem for path in (ROOT / "docs").glob("*.md")} - {"index"} <= listed
