# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Runs `main` of a module as an executable: `python exo_gravity/executable.py MODULE NAME [ARGUMENTS]`.

EXO_GRAVITY_DELAY: s to wait before.
"""

import os
import sys
import time
from importlib import import_module

if __name__ == "__main__":
    time.sleep(float(os.environ.get("EXO_GRAVITY_DELAY", "0")))
    if not getattr(sys.flags, "safe_path", False):  # new in Python 3.11
        del sys.path[0]  # this folder
    module, *sys.argv = sys.argv[1:]
    sys.exit(import_module(module).main())
