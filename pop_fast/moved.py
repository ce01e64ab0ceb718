"""Modules under the names that they had before: importing one warns, and gives what its successor gives."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.util
import sys
import warnings
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, Final

MOVED: Final = {
    "backends": "api.registry",
    "cli.splat": "train.load_result",
    "conformance_door": "pytest_entry",
    "data.demo": "demo.make",
    "explain": "view.explain",
    "losses": "stages.losses",
    "passes": "density.passes",
    "paths": "view.paths",
    "polarization": "stages.polarization",
    "rasterization": "api.rasterize",
    "report": "view.report",
    "ssim": "stages.ssim",
    "strategies": "density",
    "strategies.base": "density.protocol",
    "train.on_device": "train.gpu_proxy",
}


class _OldModule(ModuleType):
    """A module whose name is also that of a function that the package gives: it can be called as that."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return getattr(self, self.__name__.rpartition(".")[2])(*args, **kwargs)


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def __init__(self, package: str) -> None:
        self._new = {f"{package}.{old}": f"{package}.{new}" for old, new in MOVED.items()}

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Answer for the old names only."""
        if fullname not in self._new:
            return None
        return importlib.util.spec_from_loader(fullname, self, is_package=True)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Make the empty module."""
        return _OldModule(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Fill the module with the names of its successor."""
        new = self._new[module.__name__]
        warnings.warn(f"{module.__name__} is now {new}", DeprecationWarning, stacklevel=2)
        successor = importlib.import_module(new)
        module.__dict__.update({k: v for k, v in vars(successor).items() if not k.startswith("__") or k == "__doc__"})

        def find(name: str) -> object:
            # what the successor itself gives only when it is asked for
            return getattr(successor, name)

        module.__dict__["__getattr__"] = find


def keep_old_names(package: str) -> None:
    """Make the old names of a package's modules importable."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.append(_Finder(package))
