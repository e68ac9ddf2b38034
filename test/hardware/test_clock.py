# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a process may ask of Linux's scheduler."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

FAVOURED = """
import os
from exo_gravity.hardware.clock import favour
favour(15)
print(os.getpriority(os.PRIO_PROCESS, 0))
"""
AUTOGROUP = Path("/proc/self/autogroup")


def test_a_favoured_process_runs_before_other_sessions_processes_if_permitted():
    read = f"print(open({str(AUTOGROUP)!r}).read())" if AUTOGROUP.exists() else ""
    command = [sys.executable, "-c", FAVOURED + read]
    result = subprocess.run(command, start_new_session=True, capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (0, "")
    nice, *session = result.stdout.split("\n", 1)
    if os.geteuid():
        assert int(nice) <= 0
    else:
        assert int(nice) == -15
        assert not read or session[0].strip().endswith(" nice -15")
