# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The text of the file `anfis_file`, read by the compensator and by every tool that checks its parameters."""

import os
from pathlib import Path

# Bytes. The compensator may read the file while it carries the arm, and takes no tilt meanwhile: a million take 14 ms.
# train_anfis writes 20,000.
LARGEST = 1_000_000


def read_model(path: str) -> str:
    """Return the text of an ANFIS model. Raises OSError, also for a device, a pipe, and a file that is too large."""
    file = Path(os.path.expanduser(path))
    if not (file.is_file() and 0 < file.stat().st_size <= LARGEST):  # the files of /proc tell no size
        raise OSError(f"it must be a regular file of 1 to {LARGEST} bytes")
    return file.read_text(encoding="utf-8")
