# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A copy of an arm in virtual time, with all that runs it: tests that begin alike bring one arm there, once."""

from __future__ import annotations

import copy
import copyreg
import functools
from collections.abc import Callable
from queue import SimpleQueue
from threading import Thread
from types import GeneratorType, MappingProxyType
from typing import Any, ParamSpec, TypeVar
from unittest.mock import patch

from exo_gravity.core.motors.joint_motor import UNKNOWN

Arm = TypeVar("Arm")
Given = ParamSpec("Given")

# What `copy` cannot copy. The loop's thread is not started in virtual time, its queue is empty between two cycles, and
# of the start gate no course is under way once the arm is carried.
UNCOPIED: dict[type, Any] = {
    MappingProxyType: lambda proxy: (MappingProxyType, (dict(proxy),)),
    SimpleQueue: lambda queue: (SimpleQueue, ()),
    Thread: lambda thread: (Thread, ()),
    GeneratorType: lambda course: (iter, ((),)),
}


def copied(arm: Arm) -> Arm:
    """Return a carried arm in the state of `arm`, which goes on apart from it.

    Functions that are bound to a part of the arm go along; a nested function or a lambda that captured a part does not.
    """
    with patch.dict(copyreg.dispatch_table, UNCOPIED):
        return copy.deepcopy(arm, {id(UNKNOWN): UNKNOWN})


def prepared(make: Callable[Given, Arm]) -> Callable[Given, Arm]:
    """Return a function that gives arms as `make` does, each a copy of the first one with the same arguments."""
    first = functools.cache(make)

    @functools.wraps(make)
    def another(*args: Given.args, **kwargs: Given.kwargs) -> Arm:
        return copied(first(*args, **kwargs))

    return another
