"""Chapters, each run once in a session however many tests and workers look at what it did; and a browser.

Where Jupyter is installed a chapter runs there, as the notebook that a reader gets, and what `picture` and `film` are
handed is kept for the page as well: one run gives the page's outcomes and the notebook's outputs.
"""

from __future__ import annotations

import fcntl
import functools
import importlib.util
import os
import pickle
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from pop_ref.walkthrough.builder.chapter import Chapter, chapter_files, read_chapter
from pop_ref.walkthrough.builder.notebooks import notebook
from pop_ref.walkthrough.pages import Outcome, Picture, run_chapter
from tests.browser import Page, opened

CHAPTERS = chapter_files()
MISSING = [name for name in ("nbclient", "ipykernel") if importlib.util.find_spec(name) is None]
# where the workers of a session share what ran
shared: Path | None = None

# before the first cell: what a page would show is kept, and then shown as Jupyter shows it
_KEEP = """
from pop_ref.walkthrough import pages as _pages
_kept, _inside = [], []
def _both(show):
    def shown(*given, **named):
        # a film that Jupyter shows calls `picture`, which is then a part of it
        if not _inside:
            _pages._walls.append(_kept)
            try:
                show(*given, **named)
            finally:
                _pages._walls.pop()
        _inside.append(show)
        try:
            show(*given, **named)
        finally:
            _inside.pop()
    return shown
_pages.picture, _pages.film = _both(_pages.picture), _both(_pages.film)
"""
# behind the last cell
_HAND_OVER = """
import pickle as _pickle, sys as _sys
with open({place!r}, "wb") as _file:
    _pickle.dump((_kept, sorted({{name.partition(".")[0] for name in _sys.modules}})), _file)
"""


@pytest.fixture(scope="session", autouse=True)
def _shared_runs(tmp_path_factory: pytest.TempPathFactory) -> None:
    global shared
    base = tmp_path_factory.getbasetemp()
    # a worker of xdist has a folder of its own in that of the session
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "chapters-that-ran"
    shared.mkdir(exist_ok=True)


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with opened() as page:
        yield page


@dataclass(frozen=True)
class Run:
    """What a chapter did.

    Attributes:
        outcomes: one a cell of the chapter, for its page.
        outputs: of every code cell of its notebook; None where Jupyter is not installed.
        modules: the packages that were imported when the notebook had run.
    """

    outcomes: list[Outcome]
    outputs: list[list[dict[str, Any]]] | None
    modules: list[str]


def ran(path: Path) -> tuple[Chapter, list[Outcome]]:
    """Read a chapter and run it."""
    return read_chapter(path), run_of(path).outcomes


@functools.cache
def run_of(path: Path) -> Run:
    """Run a chapter, or read what another worker's run of it gave."""
    assert shared is not None
    kept = shared / f"{path.stem}.pickle"
    with (shared / f"{path.stem}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            kept.write_bytes(pickle.dumps(_run(read_chapter(path), shared)))
        run = pickle.loads(kept.read_bytes())
    if isinstance(run, str):
        raise AssertionError(run)
    return run


def _run(chapter: Chapter, folder: Path) -> Run | str:
    """Run a chapter; return what failed, if it failed, so that no other test runs it again."""
    try:
        if MISSING:
            return Run(run_chapter(chapter), None, [])
        return _run_in_jupyter(chapter, folder)
    except Exception as error:
        return f"{chapter.path.name}: {type(error).__name__}: {error}"


def _run_in_jupyter(chapter: Chapter, folder: Path) -> Run:
    place = folder / f"{chapter.path.stem}.kept"
    cells = executed(notebook(chapter), _KEEP, _HAND_OVER.format(place=str(place)))
    kept, modules = pickle.loads(place.read_bytes())
    outcomes = _outcomes(chapter, cells, kept)
    return Run(outcomes, [cell["outputs"] for cell in cells], modules)


def _outcomes(chapter: Chapter, cells: Sequence[dict[str, Any]], kept: list[Picture]) -> list[Outcome]:
    """Give each cell of the chapter what the cells of the notebook that it became have printed and drawn."""
    found = {cell.line: Outcome(cell) for cell in chapter.cells}
    rest = iter(kept)
    for cell in cells:
        line = cell["metadata"]["chapter_line"]
        text = "".join(each["text"] for each in cell["outputs"] if each.get("name") == "stdout")
        drawn = tuple(next(rest) for each in cell["outputs"] if "image/png" in each.get("data", {}))
        before = found[line]
        found[line] = replace(before, printed=before.printed + text, pictures=before.pictures + drawn)
    assert next(rest, None) is None, "a picture was not shown"
    return list(found.values())


def executed(written: str, before: str = "", behind: str = "") -> list[dict[str, Any]]:
    """Execute a notebook in a kernel of its own, with a cell before the first and one behind the last.

    Returns:
        The notebook's own code cells, with their outputs.
    """
    import nbclient
    import nbformat
    from traitlets.config import Config

    whole = nbformat.reads(written, as_version=4)
    nbformat.validate(whole)
    first, last = (nbformat.v4.new_code_cell(text, metadata={"added": True}) for text in (before, behind))
    whole.cells = [first, *whole.cells, last]
    with tempfile.TemporaryDirectory() as place:
        # sockets in a folder: of ports, the kernel is told five that are free, and binds them a second later, when a
        # server of another test may have one of them (ZMQError: Address already in use)
        ours = Config(KernelManager={"transport": "ipc", "connection_file": f"{place}/kernel.json"})
        nbclient.NotebookClient(whole, timeout=600, kernel_name="python3", config=ours).execute()
    return [cell for cell in whole.cells if cell.cell_type == "code" and "added" not in cell.metadata]
