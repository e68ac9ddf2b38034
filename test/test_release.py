"""What others build from: package.xml, the version, the changelog, and the commands of the workflows."""

import ast
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PACKAGE = ElementTree.parse(ROOT / "package.xml").getroot()
# Keys of rosdep's python.yaml that install Ubuntu's packages, each with the module it provides.
ROSDEP = {
    "can": "python3-can",
    "hypothesis": "python3-hypothesis",
    "numpy": "python3-numpy",
    "pytest": "python3-pytest",
    "serial": "python3-serial",
    "yaml": "python3-yaml",
}
# Needed although no module imports them: by a lifecycle node's services, python-can's udp_multicast, the launch files.
INDIRECT = {"lifecycle_msgs", "python3-msgpack", "robot_state_publisher", "ros2launch", "rviz2"}
PYTEST_TIMEOUT = "python3-pytest-timeout"
# From PyPI alone, by an extra of setup.py; a tool that misses one names it.
EXTRAS = {
    "PIL",
    "axe_playwright_python",
    "httpx",
    "imageio",
    "imufusion",
    "matplotlib",
    "mcap",
    "mcap_ros2",
    "mpl_toolkits",
    "mujoco",
    "pandas",
    "pinocchio",
    "playwright",
    "rich",
    "roboticstoolbox",
    "rtbdata",
    "rosbags",
    "scipy",
    "sklearn",
    "adafruit_extended_bus",
    "adafruit_icm20x",
    "adafruit_lsm6ds",
    "adafruit_mpu6050",
    "spatialmath",
    "starlette",
    "threadpoolctl",
    "uvicorn",
    "vqf",
    "websockets",
}


def third_parties(*folders: str) -> set[str]:
    """Return the packages that the Python files in these folders import, without ours and the standard library's."""
    roots = set()
    for folder in folders:
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Import):
                    roots |= {alias.name.partition(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and not node.level:
                    roots.add(str(node.module).partition(".")[0])
    return roots - set(sys.stdlib_module_names) - {"exo_gravity", "bench", "test", "_typeshed"}


def declared(kind: str) -> set[str]:
    return {str(element.text) for element in PACKAGE.iter(kind)}


def keys(packages: set[str]) -> set[str]:
    """Return the rosdep keys of imported packages: a ROS package is its own key."""
    return {ROSDEP.get(package, package) for package in packages - EXTRAS}


def test_package_xml_names_exactly_what_the_package_and_its_launch_files_import() -> None:
    assert declared("exec_depend") == keys(third_parties("exo_gravity", "launch")) | INDIRECT


def test_package_xml_names_exactly_what_the_tests_import_too() -> None:
    needed = keys(third_parties("test")) | {PYTEST_TIMEOUT}
    assert declared("test_depend") == needed - declared("exec_depend")


def test_the_distribution_and_the_citation_have_the_version_of_package_xml() -> None:
    version = str(PACKAGE.findtext("version"))
    command = [sys.executable, "setup.py", "--quiet", "--version"]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=True).stdout
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"]
    assert (printed.split()[-1], cited) == (version, version)


def test_the_changelog_has_the_form_that_catkin_tools_read() -> None:
    lines = (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8").splitlines()
    title = f"Changelog for package {PACKAGE.findtext('name')}"
    overline = [line for line in lines[:1] if set(line) == {"^"}]
    assert lines[len(overline)] == title
    underlined = pairwise(lines)
    sections = [name for name, rule in underlined if rule and set(rule) == {"-"} and len(rule) >= len(name)]
    assert sections
    assert all(re.fullmatch(r"Forthcoming|\d+\.\d+\.\d+ \(\d{4}-\d{2}-\d{2}\)", name) for name in sections)


@pytest.mark.parametrize("path", sorted((ROOT / ".github" / "workflows").glob("*.yml")), ids=lambda path: path.name)
def test_a_workflow_runs_commands_that_exist_by_actions_of_one_version(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    targets = set(re.findall(r"^(\w[\w-]*):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    run = re.findall(r"run: make (\S+)", text) + re.findall(r"[\w-]+", "".join(re.findall(r"target: \[(.*)\]", text)))
    assert set(run) <= targets
    assert all((ROOT / script).exists() for script in re.findall(r"run: (\.ci/\S+)", text))
    assert all(re.fullmatch(r"v\d+\.\d+\.\d+", version) for version in re.findall(r"uses: \S+@(\S+)", text))


def test_every_extra_is_explained() -> None:
    module = ast.parse((ROOT / "setup.py").read_text(encoding="utf-8"))
    extras = next(
        ast.literal_eval(node.value)
        for node in module.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "extras"
    )
    table = re.search(r"\| extra \|.*\n\|[-|]+\n((?:\|.*\n)+)", (ROOT / "docs" / "installation.md").read_text("utf-8"))
    assert table
    assert {name for row in table[1].splitlines() for name in re.findall(r"`(\w+)`", row.split("|")[1])} == set(extras)
