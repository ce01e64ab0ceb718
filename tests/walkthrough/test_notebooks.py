"""The notebooks: they hold the chapter, run in Jupyter, and every picture appears; the first nine need no torch."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy
import pytest

import pop_ref
from pop_ref.learn.course import COURSE
from pop_ref.walkthrough.builder.chapter import Chapter, chapter_number, read_chapter
from pop_ref.walkthrough.builder.notebooks import notebook
from tests.walkthrough.ran import CHAPTERS, MISSING, executed, run_of

runs = pytest.mark.skipif(bool(MISSING), reason=f"{', '.join(MISSING)} not installed")

GOOD = """# minutes: 5

# %% [markdown]
# # 1. Title
#
# What the reader will know; see [the next](chapter_02_space_to_screen.py).
#
# {{widget: splat2d}}
#
# And on.

# %%
import matplotlib.pyplot as plt

from pop_ref.walkthrough.pages import picture

fig, ax = plt.subplots()
ax.plot([0, 1])
picture(fig, "A line with $y$.")
x = 2
x + 1

# %% [markdown]
# ### Exercise 1: predict
# What is two?

# %% answer
# It is 2.
print("two")
assert x == 2
"""


def _small(text: str = GOOD) -> Chapter:
    return read_chapter(Path("chapter_01_small.py"), text)


def _pictures(outputs: list[dict[str, Any]]) -> int:
    return sum("image/png" in output.get("data", {}) for output in outputs)


def test_a_notebook_folds_the_functions_that_the_course_asks_for() -> None:
    for path in CHAPTERS:
        chapter = read_chapter(path)
        told = ["".join(c["source"]) for c in json.loads(notebook(chapter))["cells"] if c["cell_type"] == "markdown"]
        # what is left once the folded parts are taken out
        left = re.sub(r"<details>.*?</details>", "", "\n".join(told), flags=re.DOTALL)
        assert "yours to write first" not in left
        for name in (name for stage in COURSE for name in stage.names):
            assert f"def {name}(" not in left, (path.name, name)


def test_a_notebook_holds_the_chapter_and_folds_what_a_page_folds() -> None:
    written = json.loads(notebook(_small()))
    cells = [(c["cell_type"], c["metadata"].get("jupyter", {}).get("source_hidden", False)) for c in written["cells"]]
    texts = ["".join(c["source"]) for c in written["cells"]]
    assert cells[2:] == [
        ("markdown", False),
        ("code", True),
        ("markdown", False),
        ("code", True),
        ("code", True),
        ("code", False),
        ("markdown", False),
        ("markdown", False),
        ("code", True),
    ]
    assert "(chapter_02_space_to_screen.ipynb)" in texts[2]
    assert 'html("splat2d")' in texts[3]
    assert texts[4] == "And on."
    assert texts[7] == "x = 2\nx + 1;"
    assert texts[9] == "<details><summary>Answer</summary>\n\nIt is 2.\n\n</details>"
    assert texts[10] == 'print("two")\nassert x == 2'
    assert len({c["id"] for c in written["cells"]}) == len(cells)
    assert notebook(_small()) == notebook(_small())


@runs
def test_a_small_notebook_shows_its_picture_caption_widget_and_print_and_nothing_else() -> None:
    # a port that the kernel is to take may be taken before it does
    no_port = 'import ipykernel; assert ipykernel.get_connection_info(unpack=True)["transport"] == "ipc"'
    outputs = [output for cell in executed(notebook(_small()), behind=no_port) for output in cell["outputs"]]
    assert _pictures(outputs) == 1
    data = [output["data"] for output in outputs if "data" in output]
    assert ["text/html" in each for each in data] == [True, False, False]
    assert data[2]["text/markdown"] == "A line with $y$."
    assert [output["text"] for output in outputs if output["output_type"] == "stream"] == ["two\n"]
    assert len(outputs) == 4


def _first_cell(place: Path, path: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a notebook's first cell in a Python that has these folders on its path and nothing installed."""
    cells = [each for each in json.loads(notebook(_small()))["cells"] if each["cell_type"] == "code"]
    code = f"import sys; sys.path += {path!r}\n" + "".join(cells[0]["source"]) + "\nimport pop_ref"
    return subprocess.run([sys.executable, "-ISc", code], cwd=place, capture_output=True, text=True)


def test_the_first_cell_finds_the_clone_that_the_notebook_lies_in(tmp_path: Path) -> None:
    below = tmp_path / "clone" / "out" / "notebooks"
    below.mkdir(parents=True)
    (tmp_path / "clone" / "pop_ref").symlink_to(Path(pop_ref.__file__).parent)
    packages = [str(Path(numpy.__file__).parents[1])]
    done = _first_cell(below, packages)
    assert done.returncode == 0, done.stderr
    # where there is no clone, one line says what to do
    done = _first_cell(tmp_path, packages)
    assert "ImportError: pop_ref missing. Start Jupyter inside the clone of pop-splatting, or" in done.stderr
    done = _first_cell(below, [])
    assert "matplotlib missing. Start Jupyter inside the clone" in done.stderr
    assert f"{sys.executable} -m pip install matplotlib" in done.stderr
    # chapter 0 reads a capture, for which the clone's other package must be installed
    cells = json.loads(notebook(read_chapter(CHAPTERS[0])))["cells"]
    first = "".join(next(each for each in cells if each["cell_type"] == "code")["source"])
    code = f"import sys; sys.path += {[str(tmp_path / 'clone')]!r}\n{first}"
    done = subprocess.run([sys.executable, "-ISc", code], cwd=below, capture_output=True, text=True)
    assert "cv2, matplotlib, numpy, pop_fast missing" in done.stderr
    assert "-m pip install ./pop_ref . matplotlib numpy\n" in done.stderr


# the first nine chapters are read without torch; from the last on, so that two workers seldom wait for one chapter
@runs
@pytest.mark.slow
@pytest.mark.parametrize("path", CHAPTERS[::-1], ids=lambda path: path.stem)
def test_every_picture_of_a_chapter_appears_in_its_notebook(path: Path) -> None:
    chapter, run = read_chapter(path), run_of(path)
    assert run.outputs is not None
    if int(chapter_number(path).rstrip("b")) <= 9:
        assert "pop_ref" in run.modules
        assert "torch" not in run.modules
    outputs = [output for each in run.outputs for output in each]
    drawn = sum(cell.text.count("\npicture(") + cell.text.count("\nfilm(") for cell in chapter.cells)
    assert _pictures(outputs) == drawn > 0
    assert [output for output in outputs if output["output_type"] == "error" or output.get("name") == "stderr"] == []
