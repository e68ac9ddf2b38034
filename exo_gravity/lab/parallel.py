# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The same work on many items: in a process for each core, or on the workers of a Dask cluster.

Outcomes come in the order in which they are finished, one for each item. The function must be importable, and a pure
one: on a cluster, an item whose worker dies is worked on again.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from queue import SimpleQueue
from typing import Generic, TypeVar

from exo_gravity.core.errors import ParameterError

Item = TypeVar("Item")
Result = TypeVar("Result")

SPAWNED = get_context("spawn")  # a progress bar has a thread, which a forked process would lack
CONNECT = "10s"  # for which a scheduler may not answer
ENDED = "the process that worked on it was ended, perhaps for want of memory"


@dataclass(frozen=True)
class Outcome(Generic[Item, Result]):
    """What became of an item."""

    item: Item
    result: Result | None  #: None if it failed
    problem: str = ""  #: why it failed, or ''


def in_processes(
    work: Callable[[Item], Result], items: Sequence[Item], workers: int | None = None
) -> Iterator[Outcome[Item, Result]]:
    """Yield the outcome of each item, worked on in `workers` processes (default: one for each core).

    Each thread owns one process, and replaces it when it dies: this identifies the item that ended it.
    """
    idle = SimpleQueue[ProcessPoolExecutor]()

    def worked_on(item: Item) -> Outcome[Item, Result]:
        process = idle.get()
        outcome = _outcome(item, lambda: process.submit(work, item).result(), BrokenProcessPool)
        if outcome.problem == ENDED:
            process.shutdown()  # before it is forgotten: else its thread may wait for itself for ever
            process = ProcessPoolExecutor(1, SPAWNED)
        idle.put(process)
        return outcome

    count = min(workers or os.cpu_count() or 1, len(items) or 1)
    for _ in range(count):
        idle.put(ProcessPoolExecutor(1, SPAWNED))
    threads = ThreadPoolExecutor(count)
    try:
        for future in as_completed([threads.submit(worked_on, item) for item in dict.fromkeys(items)]):
            yield future.result()
    finally:
        threads.shutdown(cancel_futures=True)
        while not idle.empty():
            idle.get().shutdown()


def on_cluster(address: str, work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Outcome[Item, Result]]:
    """Yield the outcome of each item, worked on by the workers of the Dask scheduler at `address`.

    What a worker that dies was working on goes to another one; an item that ends several workers fails. Raises OSError
    if no scheduler answers, ParameterError for what is no address, ModuleNotFoundError without dask[distributed].
    """
    import distributed

    try:
        connected = distributed.Client(address, timeout=CONNECT)
    except ValueError as error:
        raise ParameterError("scheduler", address, f"an address as tcp://HOST:8786 ({error})") from None
    with connected as client:
        futures = {client.submit(work, item, pure=False): item for item in items}
        for future in distributed.as_completed(futures):
            yield _outcome(futures[future], future.result, distributed.KilledWorker)


def _outcome(item: Item, result: Callable[[], Result], ended: type[Exception]) -> Outcome[Item, Result]:
    """Return the outcome of an item. ended: what `result` raises if the item's process was ended."""
    try:
        return Outcome(item, result())
    except ended:
        return Outcome(item, None, ENDED)
    except Exception as error:  # of any kind: the others go on
        return Outcome(item, None, f"{type(error).__name__}: {error}")
