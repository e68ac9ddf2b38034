# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Imported by each Python process as it starts, where PYTHONPATH has this folder: injects what the tests ask for.

EXO_TEST_DEFECT: the name of a defect. What cannot be injected ends the process: a row must not be played without its
defect.
"""

import importlib
import os
import traceback

try:
    defects = importlib.import_module("defects")
    if name := os.environ.get("EXO_TEST_DEFECT"):
        defects.by_name(name).inject()
except Exception:  # of which Python would only print a line
    traceback.print_exc()
    os._exit(3)
