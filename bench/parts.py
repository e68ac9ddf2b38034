# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Plays the parts of a study on all cores, says what is left, and keeps what is finished.

A study that was stopped goes on where it was, unless the code or an installed package has changed since.
"""

from __future__ import annotations

import importlib
import os
import pickle
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from hashlib import blake2b
from importlib.metadata import distributions
from pathlib import Path
from typing import TypeVar, cast

from rich.console import Console

from exo_gravity.lab.parallel import in_processes

ROOT = Path(__file__).parents[1]
KEPT = Path("build/parts")

Item = TypeVar("Item")
Result = TypeVar("Result")


class StudyError(Exception):
    """Parts of a study raised exceptions."""


def play(
    name: str,
    work: Callable[[Item], Result],
    items: Sequence[Item],
    told: Callable[[Result], str],
    workers: int | None = None,
    files: Sequence[Path] = (),
) -> list[Result]:
    """Return the result of `work` for each item, in their order.

    name: of the study, for its folder below build/parts.
    items: what `work` needs to know, with seeds; `repr` tells them apart.
    told: what to print of a result.
    workers: processes (default: one for each core).
    files: that `work` reads.

    Raises StudyError if a part raised an exception; the others are played first, and kept.
    """
    console = Console(width=None if Console().is_terminal else 180, highlight=False)
    folder = KEPT / name / _state(files)
    kept = {item: folder / blake2b(repr(item).encode(), digest_size=8).hexdigest() for item in items}
    results: dict[Item, Result] = {item: pickle.loads(f.read_bytes()) for item, f in kept.items() if f.exists()}
    left = [item for item in items if item not in results]
    if results:
        console.print(f"{len(results)} of {len(items)} parts were played before")
    folder.mkdir(parents=True, exist_ok=True)
    failed, begin = [], time.monotonic()
    try:
        for number, outcome in enumerate(in_processes(_importable(work), left, workers), 1):
            if outcome.problem:
                failed.append(f"{outcome.item}: {outcome.problem}")
                continue
            result = cast(Result, outcome.result)
            _keep(kept[outcome.item], result)
            results[outcome.item] = result
            rest = (time.monotonic() - begin) / number * (len(left) - number)
            head = f"{len(results)} of {len(items)}, {rest / 60.0:.0f} minutes left"
            console.print(f"{head}: {told(result)}", markup=False, soft_wrap=True)
    except KeyboardInterrupt:
        console.print("stopped: the next run goes on here")
        sys.exit(130)
    if failed:
        raise StudyError("; ".join(failed))
    shutil.rmtree(KEPT / name)
    return [results[item] for item in items]


def _keep(file: Path, result: object) -> None:
    whole = file.with_suffix(".new")
    whole.write_bytes(pickle.dumps(result))
    os.replace(whole, file)


def _importable(work: Callable[[Item], Result]) -> Callable[[Item], Result]:
    """Return `work` from its module's own name: other processes do not import the `__main__` of a package."""
    if work.__module__ != "__main__":
        return work
    spec = sys.modules["__main__"].__spec__
    return cast(Callable[[Item], Result], getattr(importlib.import_module(spec.name), work.__name__)) if spec else work


def _state(files: Sequence[Path]) -> str:
    """Return what stands for the code, the installed packages, and other files."""
    digest = blake2b(digest_size=8)
    code = (file for folder in ("bench", "config", "exo_gravity") for file in sorted((ROOT / folder).rglob("*")))
    for file in (*(file for file in code if file.suffix in (".py", ".yaml")), *files):
        digest.update(file.read_bytes())
    digest.update(repr(sorted(f"{one.name} {one.version}" for one in distributions())).encode())
    return digest.hexdigest()
