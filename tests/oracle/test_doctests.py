"""Every example in every docstring of the oracle runs, and every public function has one."""

from __future__ import annotations

import doctest
import importlib
import inspect
import pkgutil
from types import ModuleType

import numpy as np
import pytest

import pop_ref

# the kit, the course and the chapters are programs about the oracle
NOT_THE_ORACLE = ("conformance", "walkthrough", "pop_ref.learn")


def module_names() -> list[str]:
    found = pkgutil.walk_packages(pop_ref.__path__, "pop_ref.", onerror=lambda _: None)
    # pytest imports a plugin by itself, and only where it is installed
    # and chapters are scripts, which tests/walkthrough runs
    left_out = ("pytest_plugin", "__main__", "walkthrough.chapter_")
    return sorted(m.name for m in found if not any(part in m.name for part in left_out))


def public_functions(module: ModuleType) -> list[str]:
    return [
        name
        for name, function in vars(module).items()
        if inspect.isfunction(function) and function.__module__ == module.__name__ and not name.startswith("_")
    ]


@pytest.mark.parametrize("name", module_names())
def test_every_example_runs(name: str) -> None:
    module = importlib.import_module(name)
    with np.printoptions(legacy=False):
        result = doctest.testmod(module, extraglobs={"np": np})
    assert result.failed == 0
    if public_functions(module) and not any(folder in name for folder in NOT_THE_ORACLE):
        assert result.attempted > 0, f"{name} has public functions and no example"


@pytest.mark.parametrize("name", [n for n in module_names() if not any(folder in n for folder in NOT_THE_ORACLE)])
def test_every_public_function_names_its_source_its_departures_and_shows_an_example(name: str) -> None:
    module = importlib.import_module(name)
    for function in public_functions(module):
        text = inspect.getdoc(getattr(module, function)) or ""
        for heading in ("Source:", "Departs:", "Example:"):
            assert heading in text, f"{name}.{function} has no {heading}"
