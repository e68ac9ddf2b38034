# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What is said of a Python package that is not installed: by which extra of this package it comes."""

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from exo_gravity import pip_install, with_extra
from exo_gravity.core.errors import ExoGravityError

# Ubuntu 24.04 has these as python3-NAME; all others come from PyPI only.
APT = ("matplotlib", "rich", "scipy", "sklearn", "threadpoolctl")
# No extra has these: what they do is rarely asked for.
ALONE = {"distributed": "dask[distributed]", "pandas": "pandas"}
# Nodes that need packages for which rosdep has no key, by executable: a module of each, and the extra that brings it.
NODES = {
    "panel": (("starlette", "report"), ("uvicorn", "report"), ("websockets", "report")),
    "recorder": (("rosbags", "report"), ("mcap", "report")),
    "simulator": (("mujoco", "sim"),),
}


class MissingPackageError(ExoGravityError):
    """A node that is to be started needs a Python package that is not installed."""


def missing(module: str, extra: str) -> str:
    """Return a sentence that names the missing `module` and how to install it; extra: e.g. 'report'."""
    module = module.partition(".")[0]
    command = pip_install(ALONE[module]) if module in ALONE else with_extra(extra)
    apt = f"apt install python3-{module}, or " if module in APT else ""
    return f"the Python package {module} is not installed: {apt}{command}"


def check_packages(executables: Iterable[str]) -> None:
    """Raise MissingPackageError that names the first package that one of these nodes needs and that is missing."""
    for executable in executables:
        for module, extra in NODES.get(executable, ()):
            if not find_spec(module):
                raise MissingPackageError(f"{executable} cannot start: {missing(module, extra)}")


@contextmanager
def extras(executable: str, extra: str) -> Iterator[None]:
    """End `executable` with exit code 2 and one line if an import inside the context finds a package missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if not error.name or error.name.startswith("exo_gravity"):
            raise  # not a package that an extra installs
        sys.stderr.write(f"{executable}: {missing(error.name, extra)}\n")
        raise SystemExit(2) from None
