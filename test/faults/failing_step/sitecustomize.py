"""Imported by Python as it starts, where PYTHONPATH has this folder: lets the compensator's step fail on demand.

It fails once the file that EXO_TEST_FAILURE names exists: with the text `sleep` it never returns, with any other it
raises an exception.
"""

import os
import time
from pathlib import Path
from typing import Any

from exo_gravity.core.compensation.compensator import Compensation, Compensator

if path := os.environ.get("EXO_TEST_FAILURE"):
    file, step = Path(path), Compensator.step

    def failing_step(compensator: Compensator, *reading: Any) -> Compensation:
        """Fail if the file exists, else step."""
        if file.exists():
            if file.read_text() == "sleep":
                time.sleep(3600.0)
            raise ZeroDivisionError("division by zero")
        return step(compensator, *reading)

    setattr(Compensator, step.__name__, failing_step)
