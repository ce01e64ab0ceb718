"""Packages that give names of their modules without importing those modules before a name is used."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import Any


def given_by(
    package: str, modules: Mapping[str, tuple[str, ...]], moved: Mapping[str, str] | None = None
) -> Callable[[str], Any]:
    """Make the `__getattr__` of a package (PEP 562).

    Args:
        package: the package's name.
        modules: which names each of its modules gives.
        moved: the package that now gives a name which this one used to give; using it here warns.
    """
    homes = {name: f"{package}.{module}" for module, names in modules.items() for name in names}
    moved = moved or {}

    def find(name: str) -> Any:
        if name in moved:
            warnings.warn(f"{package}.{name} is now {moved[name]}.{name}", DeprecationWarning, stacklevel=2)
            return getattr(importlib.import_module(moved[name]), name)
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(homes[name]), name)

    return find
