"""Names that users import: where they are now, and where they were before, with a warning."""

from __future__ import annotations

import importlib
import sys

import pytest

from pop_fast.moved import MOVED


@pytest.mark.parametrize("old", MOVED)
def test_a_module_under_its_old_name_gives_what_its_successor_gives_and_warns(old, monkeypatch):
    monkeypatch.delitem(sys.modules, f"pop_fast.{old}", raising=False)
    successor = importlib.import_module(f"pop_fast.{MOVED[old]}")
    with pytest.warns(DeprecationWarning, match=rf"pop_fast\.{old} is now pop_fast\.{MOVED[old]}"):
        found = importlib.import_module(f"pop_fast.{old}")
    names = getattr(successor, "__all__", [name for name in vars(successor) if not name.startswith("_")])
    assert names
    assert all(getattr(found, name) is getattr(successor, name) for name in names)


@pytest.mark.parametrize(
    ("package", "old", "home", "new"),
    [
        ("pop_fast.data", "make_demo", "pop_fast.demo", "make_demo"),
        ("pop_fast.density", "StepEvent", "pop_fast.density", "DensificationStep"),
    ],
)
def test_a_name_in_its_old_package_warns(package, old, home, new):
    with pytest.warns(DeprecationWarning, match=rf"{package}\.{old} is now {home}\.{new}"):
        found = getattr(importlib.import_module(package), old)
    assert found is getattr(importlib.import_module(home), new)


def test_a_name_that_never_was_is_refused():
    for package in ("pop_fast.data", "pop_fast.density", "pop_fast.api"):
        with pytest.raises(AttributeError, match="nothing_of_this_name"):
            getattr(importlib.import_module(package), "nothing_of_this_name")  # noqa: B009  the name is not there
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("pop_fast.nothing_of_this_name")


def test_the_public_names_are_where_the_readme_says():
    from pop_fast.api import rasterization
    from pop_fast.density import POPStrategy

    assert callable(rasterization)
    assert POPStrategy().needs_dominance
