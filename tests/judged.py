"""Which laws are run here, over which backends, and with allocations whose numbers show where nobody writes them."""

from __future__ import annotations

import functools
import importlib
import os
import pkgutil
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from pop_ref.conformance import laws
from pop_ref.conformance.backends import SHIPPED, Absent, shipped, shipped_or_absent
from pop_ref.conformance.law import missing
from pop_ref.conformance.plugin import parametrize_backends

# what is dear is judged in one precision, every night in both (.github/workflows/nightly.yml)
EVERY_PRECISION = os.environ.get("POP_EVERY_PRECISION") == "1"
# test_alpha is written alpha
LAW_MODULES = tuple(sorted(m.name.removeprefix("test_") for m in pkgutil.iter_modules(laws.__path__)))


def law_classes(modules: Iterable[str]) -> dict[str, type]:
    """Return a class for each module of laws, as TestAlpha, which holds the laws as its tests."""
    found = {}
    for name in modules:
        module = importlib.import_module(f"{laws.__name__}.test_{name}")
        tests = {key: staticmethod(value) for key, value in vars(module).items() if hasattr(value, "law")}
        assert tests, f"test_{name} holds no law"
        title = "Test" + "".join(word.capitalize() for word in name.split("_"))
        found[title] = type(title, (), {"__doc__": module.__doc__, **tests})
    return found


def judge_own_backends(metafunc: pytest.Metafunc) -> None:
    """Run a law over the oracle and `pop_fast`, in torch and, where a compiled stage is in it, in C++, too.

    What trains counts among those; every other stage is the same code there, so that its laws have nothing to judge.
    That a stage is the oracle's says nothing of the oracle.
    """
    stated = getattr(metafunc.function, "law", None)
    everywhere, compiled = own_backends()
    name = "" if metafunc.cls is None else metafunc.cls.__name__
    left_out = {"oracle"} if name in ("TestAgreement", "TestSignaturePairs") else set[str]()
    if name == "TestSignaturePairs" and not EVERY_PRECISION:
        # most of the time is the oracle's, once for each precision
        left_out |= {"fast64", "compiled32"}
    everywhere, compiled = ([b for b in of if b.name not in left_out] for of in (everywhere, compiled))
    concerned = [b for b in compiled if isinstance(b, Absent) or not (stated and missing(b, stated.needs))]
    # `make test` judges what is not left out in one precision, too
    second = {"compiled64"} if name == "TestSignaturePairs" else {"fast32", "compiled64"}
    parametrize_backends(metafunc, [*everywhere, *concerned], dict.fromkeys(second, pytest.mark.slow))


def here(name: str) -> Any:
    """Return a shipped backend, or skip the test with the reason why it cannot run here."""
    backend = shipped_or_absent(name)
    if isinstance(backend, Absent):
        pytest.skip(backend.reason)
    return backend


@functools.cache
def own_backends() -> tuple[list[Any], list[Any]]:
    """Return the adapters of what is judged everywhere, and of the compiled stages.

    An adapter asks its program once what it offers; made anew for each law, it would ask for each.
    """
    return [shipped(name) for name in SHIPPED], [shipped_or_absent(name) for name in ("compiled64", "compiled32")]


ALLOCATORS = ("empty", "empty_like", "empty_strided")
ALLOCATING_METHODS = ("new_empty", "new_empty_strided")
# an index nobody means, far outside every array
POISONED_INTEGER = -(2**30)


@contextmanager
def poisoned_allocations(package: str) -> Iterator[None]:
    """Fill uninitialised tensors that a package asks for with NaN, integers with a wild index, truths with True."""
    torch = importlib.import_module("torch")
    places = [(torch, name) for name in ALLOCATORS] + [(torch.Tensor, name) for name in ALLOCATING_METHODS]
    originals = {(owner, name): getattr(owner, name) for owner, name in places}
    for (owner, name), original in originals.items():
        setattr(owner, name, _poisoning(original, package, torch))
    try:
        yield
    finally:
        for (owner, name), original in originals.items():
            setattr(owner, name, original)


def _poisoning(original: Callable[..., Any], package: str, torch: Any) -> Callable[..., Any]:
    @functools.wraps(original)
    def allocate(*args: Any, **kwargs: Any) -> Any:
        tensor = original(*args, **kwargs)
        caller = sys._getframe(1).f_globals.get("__name__", "")
        if caller.split(".")[0] == package:
            _fill(tensor, torch)
        return tensor

    return allocate


def _fill(tensor: Any, torch: Any) -> None:
    with torch.no_grad():
        if tensor.is_floating_point():
            tensor.fill_(float("nan"))
        elif tensor.dtype == torch.bool:
            tensor.fill_(True)
        elif tensor.dtype in (torch.int32, torch.int64):
            tensor.fill_(POISONED_INTEGER)
        else:
            tensor.fill_(1)
