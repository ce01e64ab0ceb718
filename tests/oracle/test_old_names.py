"""Names that older code uses are there, with a warning that says the new one; none shadows the standard library."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import pop_ref
from pop_ref.margins import CloseDecision
from pop_ref.records import Camera


def test_records_are_found_under_their_old_module_with_a_warning() -> None:
    with pytest.warns(DeprecationWarning, match=r"pop_ref\.records"):
        from pop_ref.types import Camera as Old  # pyright: ignore[reportMissingImports]
    assert Old is Camera


def test_a_close_decision_is_found_under_its_old_name_with_a_warning() -> None:
    with pytest.warns(DeprecationWarning, match="CloseDecision"):
        assert pop_ref.Doubt is CloseDecision
    with pytest.raises(AttributeError, match="no attribute 'Doubts'"):
        _ = pop_ref.Doubts


def test_no_module_of_the_oracle_has_a_name_of_the_standard_library() -> None:
    names = {path.stem for path in Path(pop_ref.__path__[0]).glob("*.py")} - {"__init__"}
    assert not names & set(sys.stdlib_module_names)


def test_a_module_of_the_oracle_runs_as_a_script_from_its_own_folder() -> None:
    folder = Path(pop_ref.__path__[0])
    environment = {**os.environ, "PYTHONPATH": str(folder.parent)}
    subprocess.run([sys.executable, "camera.py"], cwd=folder, env=environment, check=True)
