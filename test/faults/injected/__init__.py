# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What goes wrong inside the nodes. It is injected as they start: Python imports sitecustomize from this folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def injected(**variables: str) -> Iterator[None]:
    """Let the processes that start meanwhile have what these environment variables ask for: see sitecustomize.py."""
    before = dict(os.environ)
    path = (str(Path(__file__).parent), os.environ.get("PYTHONPATH", ""))
    os.environ |= {"PYTHONPATH": os.pathsep.join(filter(None, path)), **variables}
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
