# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Waiting for a condition as long as a busy machine may take."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any

PATIENCE = 100.0  # s, after which a process or a condition is taken for stuck; pytest ends a test after 120 s
PAUSE = 0.005  # s between two looks


def pause() -> None:
    time.sleep(PAUSE)


def wait_until(
    condition: Callable[[], object],
    meanwhile: Callable[[], object] = pause,
    timeout: float = PATIENCE,
    seen: Callable[[], object] = lambda: "",
) -> None:
    """Do `meanwhile` again and again until `condition()` holds; if it does not in `timeout` s, fail with `seen()`."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, f"the condition did not hold in {timeout:.0f} s; {seen()}"
        meanwhile()


def each_closed(make: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    """Yield a function that makes what `make` does; all of it is closed at the end of the test."""
    with ExitStack() as made:
        yield lambda *given: made.enter_context(closing(make(*given)))
