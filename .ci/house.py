# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rules of this repository that no linter knows: prints what breaks them, and exits with 1 if anything does.

Documents: links, paths and quoted messages exist; tables, safety case and site are complete. Code: a docstring in every
module, no class name twice. What others build from: package.xml, versions, changelog, workflows.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import yaml

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

import states  # noqa: E402
import tables  # noqa: E402

from exo_gravity.core.safety.drive import FaultCode  # noqa: E402
from test.faults.cases import CASES  # noqa: E402
from test.support.document_commands import DOCUMENTS, ROS2, commands_of  # noqa: E402

FOLDERS = "bench|config|docs|examples|exo_gravity|launch|test|core|hardware|sim|lab|panel|nodes|tools|.ci|.github"
CORE_ENTRIES = 12  # at most, in the first floor of core
COPYRIGHT = "# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0"
PACKAGE = ElementTree.parse(ROOT / "package.xml").getroot()
# Keys of rosdep's python.yaml that install Ubuntu's packages, each with the module it provides.
ROSDEP = {
    "can": "python3-can",
    "hypothesis": "python3-hypothesis",
    "matplotlib": "python3-matplotlib",
    "numpy": "python3-numpy",
    "pytest": "python3-pytest",
    "rich": "python3-rich",
    "scipy": "python3-scipy",
    "serial": "python3-serial",
    "yaml": "python3-yaml",
}
# Needed although no module imports them: by python-can's udp_multicast, the launch files.
INDIRECT = {"python3-msgpack", "robot_state_publisher", "ros2launch"}
# From PyPI alone, by an extra of setup.py; a tool that misses one names it.
FROM_PYPI = {
    "PIL", "axe_playwright_python", "distributed", "httpx", "imageio", "imufusion", "lz4", "mcap", "mcap_ros2",
    "mpl_toolkits", "mujoco", "pandas", "pinocchio", "playwright", "roboticstoolbox", "rosbags", "rtbdata",
    "sklearn",
    "adafruit_extended_bus", "adafruit_icm20x", "adafruit_lsm6ds", "adafruit_mpu6050", "spatialmath", "starlette",
    "threadpoolctl", "uvicorn", "vqf", "websockets", "zstandard",
}  # fmt: skip


def text_of(path: str | Path) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


def trees(*folders: str) -> dict[Path, ast.Module]:
    """Return the parsed Python files below these folders."""
    paths = (path for folder in folders for path in sorted((ROOT / folder).rglob("*.py")))
    return {path.relative_to(ROOT): ast.parse(text_of(path)) for path in paths}


def first_column(document: str, heading: str) -> list[str]:
    """Return what is in backticks in the first column of the tables with this heading."""
    found = re.findall(rf"\| {heading} \|.*\n\|[-|]+\n((?:\|.*\n)+)", document)
    rows = [line.split("|")[1] for table in found for line in table.splitlines()]
    return [code for row in rows for code in re.findall("`([^`]+)`", row)]


def anchors(document: str) -> set[str]:
    """Return the anchors of a document's headings, as GitHub forms them."""
    headings = re.findall(r"^#+ (.*)$", document, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def links_and_paths() -> Iterator[str]:
    """Yield each link, and each path in backticks, that leads nowhere."""
    for path in DOCUMENTS:
        document, name = text_of(path), path.relative_to(ROOT)
        for link in re.findall(r"\]\((?!https?:)([^)]+)\)", document):
            file, _, anchor = link.partition("#")
            target = path.parent / file if file else path
            if not target.exists() or (anchor and anchor not in anchors(text_of(target))):
                yield f"{name}: the link {link} leads nowhere"
        for text in re.findall(rf"`((?:{FOLDERS})/[\w./]*)`", document):
            if not (ROOT / text).exists() and not (ROOT / "exo_gravity" / text).exists():
                yield f"{name}: `{text}` does not exist"


def generated_tables() -> Iterator[str]:
    """Yield each generated table, and the picture of the states, that differs from the code or has no place."""
    places: set[str] = set()
    for path in DOCUMENTS:
        document = text_of(path)
        places |= {found[2] for found in tables.TABLE.finditer(document)}
        for table in tables.stale_tables(document):
            yield f"{path.relative_to(ROOT)}: table {table} differs from the code; run {tables.COMMAND}"
    if missing := {*tables.PARAMETERS, "faults", "firmwares", "motors", "topics"} - places:
        yield f"no document has a place for the tables {', '.join(sorted(missing))}"
    if text_of(states.PICTURE) != states.drawing():
        yield "docs/states.svg differs from the transitions; run python docs/states.py"


def commands_and_site() -> Iterator[str]:
    """Yield each command with a prefix, each known command that is not shown, and each unlisted document."""
    shown = {command for path in DOCUMENTS for command in commands_of(path)}
    yield from (f"a document shows {command}, with its folder" for command in shown if command.startswith(".venv/"))
    yield from (f"no document shows {command}" for command in set(ROS2) - shown)
    with_run = {path.name for path in DOCUMENTS if "ros2 run exo_gravity" in text_of(path)}
    if with_run != {"README.md", "installation.md"}:  # the example of a workspace, and the rule
        yield f"`ros2 run exo_gravity` belongs before no command, see docs/installation.md: {', '.join(with_run)}"
    unpublished = {path.name for path in DOCUMENTS if re.search(r"pip install '?exo_gravity\b(?!-)", text_of(path))}
    yield from (f"{name}: nothing on PyPI is ours: name a wheel, or a folder" for name in unpublished)
    trees_of_site = re.findall(r"```{toctree}\n(.*?)```", text_of("docs/index.md"), re.DOTALL)
    listed = {line for tree in trees_of_site for line in tree.splitlines()}
    for path in sorted((ROOT / "docs").glob("*.md")):
        if path.stem not in {*listed, "index"}:
            yield f"docs/index.md does not list {path.stem}"


def safety_case() -> Iterator[str]:
    """Yield each row of the fault matrix that the safety case does not name once, and each name that is no row's.

    An asterisk in a name stands for any text.
    """
    found = re.findall(r"\| cause \|.*?\| rows \|\n\|[-|]+\n((?:\|.*\n)+)", text_of("docs/safety_case.md"))
    cells = (line.split(" | ")[-1] for table in found for line in table.splitlines())
    names = [name for cell in cells for name in re.findall(r"`([^`]+)`", cell)]
    rows = [case.name for case in CASES]
    for row in rows:
        if (times := sum(fnmatchcase(row, name) for name in names)) != 1:
            yield f"docs/safety_case.md must name the row {row} once, not {times} times"
    for name in names:
        if not any(fnmatchcase(row, name) for row in rows):
            yield f"docs/safety_case.md: no row is called {name}"


def troubleshooting() -> Iterator[str]:
    """Yield each message and fault code that Troubleshooting quotes and the code does not have."""
    document = text_of("docs/troubleshooting.md")
    # Adjacent string literals, as the formatter splits long messages, become one.
    source = "\n".join(re.sub(r'"\s*\n\s*f?"', "", text_of(path)) for path in trees("exo_gravity"))
    codes = {str(code) for code in FaultCode}
    for message in first_column(document, "message"):
        if message not in source and message not in codes:
            yield f"docs/troubleshooting.md: no message of ours is {message!r}"
    for code in first_column(document, "fault"):
        if code not in codes:
            yield f"docs/troubleshooting.md: no fault is {code!r}"


def modules() -> Iterator[str]:
    """Yield each module without a docstring, class name used twice, and a first floor of core that is too full."""
    where: dict[str, list[str]] = {}
    for path, tree in trees("exo_gravity").items():
        if tree.body and not ast.get_docstring(tree):
            yield f"{path}: no docstring"
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                where.setdefault(node.name, []).append(str(path))
    yield from (f"class {name} in {' and '.join(paths)}" for name, paths in where.items() if len(paths) > 1)
    entries = {path.name for path in (ROOT / "exo_gravity" / "core").iterdir() if path.suffix in ("", ".py")}
    if len(entries - {"__init__.py", "__pycache__"}) > CORE_ENTRIES:
        yield f"exo_gravity/core has more than {CORE_ENTRIES} entries"


def copyright_lines() -> Iterator[str]:
    """Yield each source file without the copyright line near its top."""
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for path in filter(lambda path: (ROOT / path).is_file(), tracked.splitlines()):
        with (ROOT / path).open("rb") as file:
            first = [next(file, b"").decode(errors="replace").rstrip() for _ in range(2)]
        if (path.endswith(".py") or re.match(r"#!.*\b(ba|da)?sh\b", first[0])) and COPYRIGHT not in first:
            yield f"{path}: no copyright line; run .ci/headers"


def package_xml() -> Iterator[str]:
    """Yield each dependency that package.xml misses, or names without need."""

    def needed(*folders: str) -> set[str]:
        roots: set[str] = set()
        for tree in trees(*folders).values():
            for node in ast.walk(tree):
                if isinstance(node, ast.Import):
                    roots |= {alias.name.partition(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and not node.level:
                    roots.add(str(node.module).partition(".")[0])
        ours = {"exo_gravity", "bench", "test", "_typeshed"}
        return {ROSDEP.get(root, root) for root in roots - set(sys.stdlib_module_names) - ours - FROM_PYPI}

    run = needed("exo_gravity", "launch") | INDIRECT
    wanted = {"exec_depend": run, "test_depend": needed("test") - run | {"python3-pytest-timeout"}}
    for kind, packages in wanted.items():
        declared = {str(element.text) for element in PACKAGE.iter(kind)}
        yield from (f"package.xml: {kind} {package} is missing" for package in packages - declared)
        yield from (f"package.xml: {kind} {package} is not needed" for package in declared - packages)


def release_files() -> Iterator[str]:
    """Yield what is wrong with versions, changelog, workflows and the table of extras."""
    version = PACKAGE.findtext("version")
    printed = subprocess.run(
        [sys.executable, "setup.py", "--quiet", "--version"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    if {printed.split()[-1], yaml.safe_load(text_of("CITATION.cff"))["version"]} != {version}:
        yield f"setup.py and CITATION.cff must have the version of package.xml, {version}"
    lines = text_of("CHANGELOG.rst").splitlines()
    titles = [name for name, rule in pairwise(lines) if rule and set(rule) == {"-"} and len(rule) >= len(name)]
    form = r"Forthcoming|\d+\.\d+\.\d+ \(\d{4}-\d{2}-\d{2}\)"  # as catkin's tools read it
    if lines[0] != f"Changelog for package {PACKAGE.findtext('name')}" or not titles:
        yield "CHANGELOG.rst: no title, or no version"
    undated = (title for title in titles if not re.fullmatch(form, title))
    yield from (f"CHANGELOG.rst: {title} is not a version with its date" for title in undated)
    targets = set(re.findall(r"^([\w-]+):", text_of("Makefile"), re.MULTILINE))
    studies = set(re.findall(r"^([\w-]+)\) #", text_of(".ci/study"), re.MULTILINE))
    for path in sorted((ROOT / ".github" / "workflows").glob("*.yml")):
        text = text_of(path)
        unknown = set(re.findall(r"\bmake ([\w-]+)", text)) - targets
        unknown |= set(re.findall(r"NAME=([\w-]+)", text)) - studies
        yield from (f"{path.name}: nothing is called {name}" for name in unknown)
        scripts = re.findall(r"(?:run:|-) (\.ci/\S+)", text)
        yield from (f"{path.name}: {script} does not exist" for script in scripts if not (ROOT / script).exists())
        inexact = re.findall(r"uses: (\S+@(?!v\d+\.\d+\.\d+$)\S+)", text, re.MULTILINE)
        yield from (f"{path.name}: {action} is no exact version" for action in inexact)
    (extras,) = (
        set(ast.literal_eval(node.value))
        for node in ast.parse(text_of("setup.py")).body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "extras"
    )
    if different := extras ^ set(first_column(text_of("docs/installation.md"), "extra")):
        yield f"docs/installation.md: setup.py and the table of extras differ in {', '.join(sorted(different))}"


RULES = (
    links_and_paths,
    generated_tables,
    commands_and_site,
    safety_case,
    troubleshooting,
    modules,
    copyright_lines,
    package_xml,
    release_files,
)

if __name__ == "__main__":
    problems = [problem for rule in RULES for problem in rule()]
    print(*problems, sep="\n", end="\n" if problems else "")
    raise SystemExit(1 if problems else 0)
