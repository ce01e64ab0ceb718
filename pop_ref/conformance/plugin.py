"""The pytest plugin: hands every law every backend, and writes down what it saw."""

from __future__ import annotations

from typing import Any

import pytest

from pop_ref.conformance.law import Law, missing


def parametrize_backends(metafunc: Any, backends: list[Any]) -> None:
    """Run a test that takes `backend` once for each; a law whose needs a backend lacks is skipped by name."""
    if "backend" not in metafunc.fixturenames:
        return
    stated: Law | None = getattr(metafunc.function, "law", None)
    cases = []
    for backend in backends:
        lacks = missing(backend, stated.needs) if stated else []
        marks = [pytest.mark.skip(reason=f"{backend.name} has no {', '.join(lacks)}")] if lacks else []
        cases.append(pytest.param(backend, id=backend.name, marks=marks))
    metafunc.parametrize("backend", cases)
