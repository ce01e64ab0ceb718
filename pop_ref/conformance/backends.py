"""The adapters that come with the kit, by name, and why one cannot be had."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.constants import PAPER, Profile

# what this project's own tests judge, and what else the kit knows how to judge where it is installed
SHIPPED = ("oracle", "fast64", "fast32")
FOREIGN = ("gsplat", "gsplat-torch64", "gsplat-torch32")


class Unavailable(Exception):  # noqa: N818  a state of the machine, not a fault of the program
    """An adapter's implementation is not here; the message says what is missing."""


def function_named(path: str) -> Callable[..., Any]:
    """Import `my.module:rasterization`."""
    module_name, _, attribute = path.partition(":")
    if not attribute:
        raise ValueError(f"rasterizer {path!r} must be written module:function")
    module = importlib.import_module(module_name)
    function = getattr(module, attribute, None)
    if not callable(function):
        raise ValueError(f"module {module_name} has no function {attribute}")
    return function


def shipped(name: str) -> Any:
    """Return the adapter of that name.

    Raises:
        Unavailable: its implementation, or torch, is not installed.
        ValueError: the name is not one of SHIPPED or FOREIGN.
    """
    if name == "oracle":
        return OracleAdapter()
    if name in ("fast64", "fast32"):
        return adapter_for("pop_fast.rasterization:rasterization", name, "pop_fast", f"float{name[-2:]}")
    if name in FOREIGN:
        return _gsplat(name)
    raise ValueError(f"backend {name!r} is unknown; use one of {', '.join((*SHIPPED, *FOREIGN))}")


def _gsplat(name: str) -> Any:
    try:
        adapters = importlib.import_module("pop_ref.conformance.gsplat_adapter")
        if name == "gsplat":
            if not importlib.import_module("torch").cuda.is_available():
                raise Unavailable("gsplat's rasterizer needs a CUDA device; gsplat-torch64 judges its torch stages")
            return adapters.gsplat_cuda(name)
        return adapters.gsplat_torch(name, f"float{name[-2:]}")
    except ModuleNotFoundError as error:
        raise Unavailable(f"{name} needs {error.name}, which is not installed") from error


def adapter_for(
    path: str,
    name: str,
    package: str | None = None,
    dtype: str = "float32",
    device: str = "cpu",
    profile: Profile = PAPER,
) -> Any:
    """Return an adapter for a torch function with gsplat's signature, given as `module:function`, and for a package of
    stage functions."""
    try:
        from pop_ref.conformance.torch_adapter import TorchAdapter

        return TorchAdapter(name, function_named(path) if path else None, package, dtype, device, profile)
    except ModuleNotFoundError as error:
        raise Unavailable(f"{name} needs {error.name}, which is not installed") from error
