# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A copy of an arm in virtual time, with all that runs it: tests that begin alike bring one arm there, once."""

import copy
import copyreg
import functools
from collections.abc import Callable
from queue import SimpleQueue
from threading import Thread
from types import GeneratorType, MappingProxyType, ModuleType
from typing import Any, ParamSpec, TypeVar, cast
from unittest.mock import patch

from exo_gravity.core.motors.joint_motor import UNKNOWN
from exo_gravity.hardware.urdf_arm import UrdfArm

Arm = TypeVar("Arm")
Given = ParamSpec("Given")

# What `copy` cannot copy. The loop's thread is not started in virtual time, its queue is empty between two cycles, and
# of the checks before a start none is under way while an arm is carried, or is off. What has a name here is shared.
UNCOPIED: dict[type, Any] = {
    MappingProxyType: lambda proxy: (MappingProxyType, (dict(proxy),)),
    SimpleQueue: lambda queue: (SimpleQueue, ()),
    Thread: lambda thread: (Thread, ()),
    GeneratorType: lambda course: (iter, ((),)),
    ModuleType: lambda module: "shared",
    UrdfArm: lambda arm: "shared",
}


def copied(arm: Arm) -> Arm:
    """Return a copy of `arm`, or of a tuple of an arm and what belongs to it, that runs on independently.

    Functions that are bound to a part of the arm go along; a nested function or a lambda that captured a part does not.
    """
    with patch.dict(copyreg.dispatch_table, UNCOPIED):
        return copy.deepcopy(arm, {id(UNKNOWN): UNKNOWN})


def prepared(make: Callable[Given, Arm]) -> Callable[Given, Arm]:
    """Return a function that gives arms as `make` does, each a copy of the first one with the same arguments."""
    first = cast(Callable[Given, Arm], functools.cache(make))

    def another(*args: Given.args, **kwargs: Given.kwargs) -> Arm:
        return copied(first(*args, **kwargs))

    return another
