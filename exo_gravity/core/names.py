# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Names of a package that are imported when they are used (PEP 562)."""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def imported_when_used(package: str, modules: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package whose names are those of its `modules`, each with its names."""
    module_of = {name: module for module, names in modules.items() for name in names}

    def get(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package} has no attribute {name}")
        return getattr(import_module(f"{package}.{module_of[name]}"), name)

    return get
