# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Command-line tools: one file per command, one folder per family of helpers."""

import sys
from importlib.util import find_spec

from exo_gravity.lab.packages import missing

if not find_spec("yaml"):  # the core was installed alone; every tool reads parameter files
    print(f"exo_gravity: {missing('yaml', 'report')}", file=sys.stderr)
    raise SystemExit(2)
