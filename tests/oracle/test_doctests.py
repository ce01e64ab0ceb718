"""Examples in docstrings run, the notation table is complete, and names that older code uses are there."""

from __future__ import annotations

import doctest
import importlib
import inspect
import os
import pkgutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import pop_ref
from pop_ref.notation import AXES, SYMBOLS, symbol_named
from pop_ref.records import Camera, Gaussians, Render, Splats

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
        untold = [each for each in public_functions(module) if "Example:" not in getattr(module, each).__doc__]
        assert not untold


# The notation table is complete and says what the value types say.

# containers, not symbols
_CONTAINERS = {"splats"}


def test_no_symbol_stands_twice() -> None:
    names = [s.name for s in SYMBOLS]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("kind", [Gaussians, Camera, Splats, Render], ids=lambda k: k.__name__)
def test_every_field_of_a_value_type_is_in_the_table_with_the_same_shape(kind: type) -> None:
    for field in fields(kind):
        if field.name in _CONTAINERS:
            continue
        shape = symbol_named(field.name).shape
        annotation = str(field.type)
        if '"' in annotation:
            assert annotation.split('"')[1].split() == shape.strip("[]").replace(",", "").split(), field.name


def test_every_axis_in_a_shape_is_explained() -> None:
    for symbol in SYMBOLS:
        if symbol.shape.startswith("["):
            for axis in symbol.shape.strip("[]").split(", "):
                assert axis.isdigit() or axis in AXES, symbol.name


def test_an_unknown_symbol_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="'rotation' is not in the notation table"):
        symbol_named("rotation")


def test_no_module_of_the_oracle_has_a_name_of_the_standard_library() -> None:
    names = {path.stem for path in Path(pop_ref.__path__[0]).glob("*.py")} - {"__init__"}
    assert not names & set(sys.stdlib_module_names)


def test_a_module_of_the_oracle_runs_as_a_script_from_its_own_folder() -> None:
    folder = Path(pop_ref.__path__[0])
    environment = {**os.environ, "PYTHONPATH": str(folder.parent)}
    subprocess.run([sys.executable, "camera.py"], cwd=folder, env=environment, check=True)
