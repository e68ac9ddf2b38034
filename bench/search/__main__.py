# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.search [--minutes 60] [--arm ARM] [--seed S]: search for unlisted events that throw an arm.

Plays random cases in virtual time on every core, judges each by the truth, and prints those that come closest to what
is permitted, or beyond. build/search_ARM.jsonl keeps every case by its seed: the next run goes on where this one ended.
With --seed one case is replayed: a table of what happened. Exit code 1 if a case was beyond.
"""

import argparse
import json
import os
import signal
import sys
import time
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from ..arms import ARMS
from .case import Event
from .stage import Played, play

SHOWN = 20
AHEAD = 2  # cases that wait for each process

Row = dict[str, Any]


def row_of(played: Played) -> Row:
    """Return what is kept of a case."""
    return {
        "seed": played.case.seed,
        "share": round(played.share, 3),
        "bound": list(played.bound),
        "driven": {name: round(value, 3) for name, value in asdict(played.driven).items()},
        "events": [list(event) for event in played.case.events],
        "begin": played.case.begin,
        "worn": played.case.worn,
        "fault": next((text for _, _, text in played.states if text), ""),
        "error": played.error,
    }


def kept(path: Path) -> dict[int, Row]:
    """Return the rows of earlier runs by their seeds; a line that was cut off is left out."""
    rows: dict[int, Row] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        rows[row["seed"]] = row
    return rows


def search(arm: str, path: Path, minutes: float, workers: int, console: Console) -> dict[int, Row]:
    """Play cases of an arm for so many minutes, or until Ctrl-C; return all rows, also those of earlier runs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = kept(path)
    begin, seed = time.monotonic(), 0
    bar = Progress(TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), console=console)
    with ProcessPoolExecutor(workers) as pool, path.open("a", encoding="utf-8") as file, bar:
        task = bar.add_task("", total=60.0 * minutes)
        waiting: set[Future[Played]] = set()
        try:
            while (passed := time.monotonic() - begin) < 60.0 * minutes or waiting:
                while passed < 60.0 * minutes and len(waiting) < AHEAD * workers:
                    if seed not in rows:
                        waiting.add(pool.submit(play, seed, arm))
                    seed += 1
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in done:
                    row = row_of(future.result())
                    rows[row["seed"]] = row
                    file.write(json.dumps(row) + "\n")
                file.flush()
                beyond = sum(row["share"] > 1.0 for row in rows.values())
                bar.update(task, completed=passed, description=f"{len(rows)} cases, {beyond} beyond a bound")
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
    return rows


def text_of(events: list[Any]) -> str:
    """Return the events of a case in one line."""
    return "; ".join(
        " ".join((f"{time_:g} s: {name}", *(f"{key} {value}" for key, value in values.items())))
        for time_, name, values in events
    )


def show(rows: dict[int, Row], console: Console) -> None:
    """Print the cases that use most of their bounds."""
    table = Table("seed", "share", "rad/s", "bound", "J", "bound", "W", "damping", "joint", "events", box=None)
    for row in sorted(rows.values(), key=lambda row: -row["share"])[:SHOWN]:
        done, (speed, energy, *_) = row["driven"], row["bound"]
        figures = (row["share"], done["speed"], speed, done["energy"], energy, done["power"], done["damping"])
        became = row["error"] or row["fault"] or "no fault"
        text = f"{row['begin']}{', worn' * row['worn']}: {text_of(row['events'])} | {became}"
        table.add_row(str(row["seed"]), *(f"{figure:.2f}" for figure in figures), str(done["joint"]), text)
    console.print(table)
    beyond = [seed for seed, row in rows.items() if row["share"] > 1.0]
    console.print(f"{len(rows)} cases; {len(beyond)} beyond a bound; replay one with --seed")


def replay(seed: int, arm: str, console: Console) -> float:
    """Play one case, and print what happened; return its share of the bound."""
    played = play(seed, arm)
    case = played.case
    console.print(
        f"seed {seed}: {case.rate:g} Hz, pose {case.pose}, friction {case.friction:g} Nm, payload {case.payload:g} kg"
    )
    table = Table("s", "", "", box=None)
    happened = [
        (played.begin + time_, name, str(values or "")) for time_, name, values in map(Event._make, case.events)
    ]
    for when, name, text in sorted([*happened, *played.states]):
        table.add_row(f"{when:.3f}", name, text)
    console.print(table)
    console.print(row_of(played))
    return played.share


def main() -> int:
    """Search or replay; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench.search", description="Search for ways to throw an arm.")
    parser.add_argument("--minutes", type=float, default=60.0, help="(%(default)g)")
    parser.add_argument("--seed", type=int, help="replay this case alone")
    parser.add_argument("--arm", choices=ARMS, default="paper", help="one of those of config (%(default)s)")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes (default: one per core)")
    parser.add_argument("--file", type=Path, help="of the cases so far (build/search_ARM.jsonl)")
    options = parser.parse_args()
    console = Console(width=None if Console().is_terminal else 200, highlight=False)
    if options.seed is not None:
        return int(replay(options.seed, options.arm, console) > 1.0)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    path = options.file or Path(f"build/search_{options.arm.replace(' ', '_')}.jsonl")
    rows = search(options.arm, path, options.minutes, options.workers, console)
    show(rows, console)
    return int(any(row["share"] > 1.0 for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main())
