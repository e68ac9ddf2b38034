# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rows of starts: how long a person waits for `--help` of a tool, against the limit."""

import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from importlib.metadata import distribution
from statistics import median

from .table import Row, race, range_of

LIMIT = 0.3  # s
TOOLS = "exo_gravity.tools."
PROGRAM = "import sys; sys.argv = ['tool', '--help']; from {module} import main; main()"


def measure_starts(quick: bool) -> Iterator[Row]:
    """Yield a row for each tool."""
    scripts = distribution("exo_gravity").entry_points.select(group="console_scripts")
    tools = {script.name: script.module for script in scripts if script.module.startswith(TOOLS)}
    programs = [[sys.executable, "-c", PROGRAM.format(module=module)] for module in tools.values()]
    calls = [partial(subprocess.run, program, check=True, stdout=subprocess.DEVNULL) for program in programs]
    for call in calls:
        call()  # compiles what it imports
    for name, seconds in zip(tools, race([(call, 1) for call in calls], 3 if quick else 5), strict=True):
        yield Row(f"{name} --help: limit", median(seconds), LIMIT, "s", range_of(seconds))
