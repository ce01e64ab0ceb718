"""What can be said of the installed torch without importing it, which takes a second."""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Final

# holds all of torch that Python calls, and needs the rest of it
_LIBRARIES: Final = ("libtorch_python.so", "libtorch_python.dylib", "torch_python.dll")


def why_torch_fails() -> str | None:
    """Tell whether torch can be imported, from whether its library loads; None where it does.

    Where the library does not load by itself, torch is imported: it knows more places to look for what it needs.

    Returns:
        The error, with its type's name, or None.
    """
    try:
        if not _loads():
            importlib.import_module("torch")
    except Exception as error:  # a broken install raises anything: OSError for a shared library, for one
        return f"{type(error).__name__}: {error}"
    return None


def cuda_version() -> str | None:
    """Return the version of CUDA that torch was built with, None for a CPU build.

    Raises:
        ImportError: torch does not say.
    """
    spec = importlib.util.spec_from_file_location("torch_version", _folder() / "version.py")
    if spec is None or spec.loader is None:
        raise ImportError("torch has no version.py")
    version = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(version)
    return version.cuda


def _folder() -> Path:
    spec = PathFinder.find_spec("torch")
    if spec is None or spec.origin is None:
        raise ImportError("torch is not where packages are installed")
    return Path(spec.origin).parent


def _loads() -> bool:
    try:
        (path,) = (path for name in _LIBRARIES if (path := _folder() / "lib" / name).exists())
        ctypes.CDLL(str(path))
    except (ImportError, ValueError, OSError):
        return False
    return True
