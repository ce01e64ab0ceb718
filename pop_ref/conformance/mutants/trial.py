"""Mutants on trial: does a law kill a mutant, and which laws kill which."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.errors import HypothesisException

from pop_ref.conformance import laws
from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.hypothesis_profiles import EXAMPLES
from pop_ref.conformance.law import Law, missing
from pop_ref.conformance.mutants.black_box import BlackBox
from pop_ref.conformance.mutants.copies import Mutant, living


def law_named(path: str) -> Law:
    """Return the law written as `test_alpha:a_negative_exponent_is_skipped`."""
    module_name, _, name = path.partition(":")
    module = importlib.import_module(f"{laws.__name__}.{module_name}")
    return getattr(module, f"test_{name}").law


def every_law() -> dict[str, Law]:
    """Return all laws by path, in the order of the modules' names."""
    found = {}
    for each in sorted(m.name for m in pkgutil.iter_modules(laws.__path__)):
        module = importlib.import_module(f"{laws.__name__}.{each}")
        for value in vars(module).values():
            stated = getattr(value, "law", None)
            if isinstance(stated, Law):
                found[f"{each}:{stated.name}"] = stated
    return found


def obeys(stated: Law, backend: Any, examples: int = EXAMPLES["ci"]) -> str | None:
    """Try a law on a backend with the examples of the ci profile; return None, or the first line of what breaks it.

    Args:
        stated: the law.
        backend: that is judged.
        examples: how many are drawn; 0 tries what the law is tried on first, and nothing else.
    """
    try:
        _tried(stated, examples)(backend)
    except HypothesisException:
        raise
    except Exception as error:
        return f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
    return None


def _tried(stated: Law, examples: int) -> Callable[[Any], None]:
    if not stated.strategies:
        return stated.sentence
    # one counterexample is enough, the shortest is not needed
    chosen = settings(
        max_examples=max(1, examples),
        derandomize=True,
        database=None,
        deadline=None,
        phases=(Phase.explicit, Phase.generate)[: 1 + (examples > 0)],
        report_multiple_bugs=False,
        suppress_health_check=[HealthCheck(check) for check in HealthCheck],
    )

    def run(backend: Any) -> None:
        chosen(stated.quantified(_bound(stated, backend)))()

    return run


def _bound(stated: Law, backend: Any) -> Callable[..., None]:
    names = ", ".join(stated.strategies)
    # given() reads argument names, so the bound sentence needs them spelled out
    scope: dict[str, Any] = {"sentence": stated.sentence, "backend": backend}
    source = f"lambda {names}: sentence(backend, {', '.join(f'{n}={n}' for n in stated.strategies)})"
    function: Callable[..., None] = eval(source, scope)
    function.__name__ = stated.sentence.__name__
    return function


def alive(mutant: Mutant | BlackBox, dtype: str = "float32") -> AbstractContextManager[Any]:
    """Return a context in which the mutant lives, which gives its adapter, in a precision if it has several."""
    return nullcontext(mutant.adapter(dtype)) if isinstance(mutant, BlackBox) else living(mutant, dtype)


def killed_by(mutant: Mutant | BlackBox, dtype: str = "float32") -> str | None:
    """Return how the mutant's named law breaks on it in a precision, None if the mutant survives."""
    stated = law_named(mutant.law)
    with alive(mutant, dtype) as backend:
        return noticed(stated, backend)


def killers(mutant: Mutant | BlackBox, examples: int = EXAMPLES["ci"]) -> list[str]:
    """Return the paths of every law that breaks on a mutant."""
    found = []
    with alive(mutant) as backend:
        for path, stated in every_law().items():
            if noticed(stated, backend, examples) is not None:
                found.append(path)
    return found


def noticed(stated: Law, backend: Any, examples: int = EXAMPLES["ci"]) -> str | None:
    """Return how a law breaks; None where it holds, and where it is skipped, before it is tried or by its answer."""
    try:
        return None if missing(backend, stated.needs) else obeys(stated, backend, examples)
    except pytest.skip.Exception:
        return None


def sound(path: str) -> str | None:
    """Return how a law breaks on the oracle itself, None if it holds, as it must."""
    return obeys(law_named(path), OracleAdapter())
