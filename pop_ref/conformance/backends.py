"""The adapters that come with the kit, by name, and why one cannot be had."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Callable
from functools import partial, reduce
from types import ModuleType
from typing import Any

import numpy as np

from pop_ref.conformance.adapter import STAGE_MODULES, Adapter, OracleAdapter
from pop_ref.conformance.capabilities import RENDER
from pop_ref.constants import PAPER, Profile

# what this project's own tests judge everywhere, and what else the kit knows how to judge where it can run
SHIPPED = ("oracle", "fast64", "fast32")
ELSEWHERE = (
    "compiled64",
    "compiled32",
    "cuda",
    "gsplat",
    "gsplat-torch64",
    "gsplat-torch32",
    "diff-gaussian-rasterization",
)


# imports torch, and gsplat or Inria's package when it is asked for one
FOREIGN = "pop_ref.conformance.foreign_adapters"


class Unavailable(Exception):  # noqa: N818  a state of the machine, not a fault of the program
    """An adapter's implementation is not here; the message says what is missing."""


def function_named(path: str) -> Callable[..., Any]:
    """Import `my.module:rasterization`; the working folder is looked into first, as `python -m` does."""
    module_name, _, attribute = path.partition(":")
    if not attribute:
        raise ValueError(f"{path!r} must be written module:name, as my.module:rasterization")
    module = _imported(module_name, path)
    # also of a backend or renderer that is a value of the module, as my.module:renderer.rasterization
    function: Any = reduce(lambda found, name: getattr(found, name, None), attribute.split("."), module)
    if not callable(function):
        raise ValueError(f"module {module_name} has no function {attribute}")
    return function


def _imported(module_name: str, path: str) -> ModuleType:
    if "" not in sys.path and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise Unavailable(f"{path} needs {error.name}, which is not installed and not in {os.getcwd()}") from error


def _require_stages(package: str) -> None:
    """Raise Unavailable or ValueError, in one line, where a package cannot be imported or has no stage modules."""
    places = getattr(_imported(package, package), "__path__", None)
    if not places or not any(importlib.util.find_spec(f"{package}.{name}") for name in STAGE_MODULES):
        raise ValueError(f"{package} has no stage modules, which carry the oracle's names, as {package}.compositing")


def usual(path: str, dtype: str = "float32") -> tuple[str, str]:
    """Return the constants that a rasterizer has as far as its name says, and the device that it draws on.

    Args:
        path: of the function; gsplat's own says by its version which constants it has.
        dtype: that it is judged in.

    Returns:
        The profile's name; "cpu", or "cuda" where torch has a GPU and the CPU is refused.
    """
    function = function_named(path)
    profile = "paper"
    if path.partition(":")[0].split(".")[0] == "gsplat":
        version = getattr(importlib.import_module("gsplat"), "__version__", "1.5")
        profile = importlib.import_module(FOREIGN).constants_of(version).name
    try:
        torch = importlib.import_module("torch")
    except ModuleNotFoundError as error:
        raise Unavailable(f"{path} needs torch, which is not installed") from error
    if not torch.cuda.is_available():
        return profile, "cpu"
    from pop_ref.conformance.torch_adapter import TorchAdapter

    return profile, "cpu" if TorchAdapter(path, function, dtype=dtype).first_error() is None else "cuda"


def require_a_picture(adapter: Any) -> None:
    """Raise ValueError where a rasterizer draws nothing, in which case every law of pictures would say so at length."""
    error = adapter.first_error() if adapter.has(RENDER) else None
    if error is not None:
        words = str(error).splitlines()[0] if str(error) else "no words"
        hint = "; backend gsplat-torch32 judges gsplat's stages in plain torch" if "gsplat" in adapter.name else ""
        raise ValueError(
            f"{adapter.name} draws nothing on {adapter.device}: a first small picture raises "
            f"{type(error).__name__}: {words}; mend that, or name another --device{hint}"
        )


def made_by(path: str) -> Adapter:
    """Make the adapter whose class, or any function that returns one, stands at `my.module:Mine`."""
    made = function_named(path)()
    lacks = [
        name for name in ("name", "dtype", "has", "stage", "sees", "render", "gradients") if not hasattr(made, name)
    ]
    if lacks:
        raise ValueError(
            f"{path} makes no adapter: it has no {', '.join(lacks)}; derive it from pop_ref.conformance.Adapter"
        )
    # the word "float64" equals no np.float64, and would be judged by the tolerances of another precision
    if made.dtype not in (np.float32, np.float64):
        raise ValueError(f"{path} has dtype {made.dtype!r}; it must be np.float32 or np.float64")
    return made


def strategy_named(path: str, dtype: str = "float32") -> Any:
    """Return the adapter of somebody's density strategy, the class or function that makes it at `my.module:Mine`."""
    make = function_named(path)
    try:
        from pop_ref.conformance.torch_strategy import StrategyAdapter

        return StrategyAdapter(path, make, dtype)
    except ModuleNotFoundError as error:
        raise Unavailable(f"{path} needs {error.name}, which is not installed") from error


def shipped(name: str) -> Any:
    """Return the adapter of that name.

    Raises:
        Unavailable: its implementation, or torch, is not installed.
        ValueError: the name is not one of SHIPPED or ELSEWHERE.
    """
    if name == "oracle":
        return OracleAdapter()
    if name not in (*SHIPPED, *ELSEWHERE):
        raise ValueError(f"backend {name!r} is unknown; use one of {', '.join((*SHIPPED, *ELSEWHERE))}")
    try:
        return program(name, "pop_fast", "fast", _dtype(name)) if name.startswith("fast") else _elsewhere(name)
    except ModuleNotFoundError as error:
        raise Unavailable(f"{name} needs {error.name}, which is not installed") from error


def _elsewhere(name: str) -> Any:
    if name.startswith("compiled"):
        reason = importlib.import_module("pop_fast.compiled").why_not()
        if reason is not None:
            raise Unavailable(reason)
        return program(name, "pop_fast", "compiled", _dtype(name))
    if name == "cuda":
        reason = importlib.import_module("cuda_ext").why_not()
        if reason is not None:
            raise Unavailable(reason)
        return adapter_for("pop_fast.cuda:rasterization", name, None, "float32", "cuda")
    if name.startswith("gsplat-torch"):
        return importlib.import_module(FOREIGN).gsplat_torch(name, _dtype(name))
    # the packages first: what is not installed cannot run anywhere
    importlib.import_module("gsplat" if name == "gsplat" else name.replace("-", "_"))
    if not importlib.import_module("torch").cuda.is_available():
        hint = "; gsplat-torch64 judges its torch stages" if name == "gsplat" else ""
        raise Unavailable(f"{name} needs a CUDA device, and torch finds none{hint}")
    if name == "gsplat":
        return importlib.import_module(FOREIGN).gsplat_cuda(name)
    return importlib.import_module(FOREIGN).inria(name)


def _dtype(name: str) -> str:
    return f"float{name[-2:]}"


def program(name: str, package: str, backend: str, dtype: str) -> Any:
    """Return the adapter of a CPU backend of this program, or of a copy of it: what renders, and what trains with it.

    Args:
        name: how reports call it.
        package: "pop_fast", or a copy's name.
        backend: of its `rasterization`: "fast", or "compiled", whose own stages stand in the package of that name.
        dtype: "float64" or "float32".
    """
    from pop_ref.conformance.torch_adapter import TorchAdapter
    from pop_ref.conformance.torch_short_training import photograph_stages
    from pop_ref.conformance.torch_training import training_stages

    rasterization = partial(function_named(f"{package}.api.rasterize:rasterization"), backend=backend)
    stages = f"{package}.stages" if backend == "fast" else f"{package}.{backend}"
    own_adam = {}
    if backend == "compiled" and dtype == "float32":
        # what trains in this precision is the native step, which has an Adam of its own
        native = importlib.import_module(f"{package}.compiled.native_step")
        own_adam = {name: getattr(native, name) for name in ("adam_step", "adam_steps")}
    trains = training_stages(package, own_adam.get("adam_step")) | own_adam | photograph_stages(package, backend, dtype)
    if backend == "compiled":
        # one module of its own holds the passes over views
        scores = importlib.import_module(f"{package}.compiled.compositing")
        passes = ("contributions", "sensitivities", "screen_moments", "fisher_blocks", "dominant_points")
        trains |= {name: getattr(scores, name) for name in passes}
    return TorchAdapter(name, rasterization, stages, dtype, stages=trains)


class Absent:
    """Stands for a backend that is not here, so that its laws are skipped with the reason."""

    def __init__(self, name: str, reason: str) -> None:
        self.name = name
        self.reason = reason

    def has(self, need: str) -> bool:
        """Tell that nothing can be judged."""
        return False


def shipped_or_absent(name: str) -> Any:
    """Return the adapter of that name, or the reason why there is none as an `Absent`."""
    try:
        return shipped(name)
    except Unavailable as error:
        return Absent(name, str(error))


def adapter_for(
    path: str,
    name: str,
    package: str | None = None,
    dtype: str = "float32",
    device: str = "cpu",
    profile: Profile = PAPER,
    deterministic: bool = True,
) -> Any:
    """Return an adapter for a torch function with gsplat's signature, given as `module:function`, and for a package of
    stage functions; `deterministic` says whether its sums are taken in the same order on every run."""
    try:
        from pop_ref.conformance.torch_adapter import TorchAdapter

        function = function_named(path) if path else None
        if package:
            _require_stages(package)
        return TorchAdapter(name, function, package, dtype, device, profile, deterministic=deterministic)
    except ModuleNotFoundError as error:
        raise Unavailable(f"{name} needs {error.name}, which is not installed") from error
