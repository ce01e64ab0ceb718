"""The chapters as Jupyter notebooks: the same cells in the same order, and pictures where they are drawn."""

from __future__ import annotations

import ast
import json
import re
from typing import Any, Final

from pop_ref.walkthrough.builder.chapter import Cell, Chapter, expanded, names_in, parts, said_and_done

_WIDGET: Final = re.compile(r"^\{\{widget: (\w+)\}\}$", re.MULTILINE)
# what they return is nothing, so that Jupyter shows nothing
_SILENT: Final = ("print", "picture", "film")
_SHOWS_A_WIDGET: Final = """from IPython.display import HTML, display

from pop_ref.walkthrough.widgets import html

display(HTML(html("{name}")))"""
# the first cell: it runs in a clone where nothing is installed, and where the package is
_FINDS: Final = """# the package is installed, or this notebook lies in its clone
import importlib.util
import sys
from pathlib import Path

if importlib.util.find_spec("pop_ref") is None:
    here = Path.cwd().resolve()
    sys.path[:0] = [str(p) for p in (here, *here.parents) if (p / "pop_ref" / "notation.py").is_file()][:1]
missing = [name for name in {needed} if importlib.util.find_spec(name) is None]
if missing:
    # the two packages of the clone are installed from its folder, and what pop_fast needs with it
    of_the_clone = {{"cv2": "./pop_ref .", "pop_fast": "./pop_ref .", "pop_ref": "./pop_ref"}}
    asked = dict.fromkeys(of_the_clone.get(name, name) for name in missing)
    raise ImportError(
        f"{{', '.join(missing)}} missing. Start Jupyter inside the clone of pop-splatting, or run in the clone, with "
        f"this Python: {{sys.executable}} -m pip install {{' '.join(asked)}}"
    )"""


def notebook_name(chapter: Chapter) -> str:
    """Name the file of the chapter's notebook."""
    return f"{chapter.path.stem}.ipynb"


def notebook(chapter: Chapter) -> str:
    """Write a chapter as a notebook that has not been run, in nbformat 4.5.

    Imports, drawing, checks, fixtures and answers are code cells of their own whose source is folded; what they show
    stays in sight. Each code cell's metadata names the line of the chapter's file at which its chapter's cell begins,
    but for the first, which finds the package.

    Args:
        chapter: as `read_chapter` gave it.

    Returns:
        JSON, the same for the same chapter.

    Raises:
        ValueError: a directive is not known.
    """
    finds = _code(_FINDS.format(needed=_needed(chapter)), folded=True)
    finds["metadata"] |= {"added": True}
    cells = [_prose(f"*Made from `pop_ref/walkthrough/{chapter.path.name}`.*"), finds]
    for cell in chapter.cells:
        made = _told(cell) if cell.kind == "prose" else _done(chapter, cell)
        for each in made:
            if each["cell_type"] == "code":
                each["metadata"] |= {"chapter_line": cell.line}
        cells += made
    for i, each in enumerate(cells):
        each["id"] = f"cell-{i}"
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}, "title": chapter.title}
    whole = {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


def _needed(chapter: Chapter) -> tuple[str, ...]:
    trees = [ast.parse(cell.text) for cell in chapter.cells if cell.kind != "prose"]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    taken = {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
    taken |= {each.name for node in nodes if isinstance(node, ast.Import) for each in node.names}
    # the kit, which judges the mistakes that readers look for, draws its examples with hypothesis
    needs = {"hypothesis"} if "pop_ref.walkthrough.bugs" in taken else set()
    needs |= {name.partition(".")[0] for name in taken}
    # a clone whose packages are not installed has pop_fast and not what its readers of captures import
    needs |= {"cv2"} if "pop_fast" in needs else set()
    return tuple(sorted(needs & _ABSENT))


# what a chapter imports and a Python need not have
_ABSENT: Final = {"cv2", "hypothesis", "matplotlib", "numpy", "pop_fast", "pop_ref", "torch"}


# a printed function that the course asks the reader to write, as `expanded` marks it
_YOURS: Final = re.compile(
    r"`([\w/., ]+)`, yours to write first in (`pop learn check \w+`):\n\n(```python\n.*?def (\w+)\(.*?\n```)", re.DOTALL
)
_FOLDED: Final = (
    r"<details><summary>The oracle's \4, \1: yours to write first</summary>\n\nJudge yours with \2.\n\n\3\n\n</details>"
)


def _told(cell: Cell) -> list[dict[str, Any]]:
    text = re.sub(r"\]\((chapter_\w+)\.py\)", r"](\1.ipynb)", expanded(cell.text, marked=True))
    text = _YOURS.sub(_FOLDED, text)
    cells: list[dict[str, Any]] = []
    # every second piece is the name of a widget
    for i, piece in enumerate(_WIDGET.split(text)):
        if i % 2:
            cells.append(_code(_SHOWS_A_WIDGET.format(name=piece), folded=True))
        elif piece.strip():
            cells.append(_prose(piece.strip("\n")))
    return cells


def _done(chapter: Chapter, cell: Cell) -> list[dict[str, Any]]:
    if cell.kind == "answer":
        said, code = said_and_done(cell.text)
        told = f"<details><summary>Answer</summary>\n\n{expanded(said)}\n\n</details>"
        return [*([_prose(told)] if said else []), _code(code, folded=True)]
    if cell.kind == "setup":
        return [_code(cell.text, folded=True)]
    cut = parts(cell.text, names_in(chapter.code_after(cell)))
    return [_code(part.text, folded=part.role != "plain") for part in cut]


def _prose(text: str) -> dict[str, Any]:
    return {"cell_type": "markdown", "metadata": {}, "source": text.splitlines(keepends=True)}


def _code(text: str, folded: bool) -> dict[str, Any]:
    metadata: dict[str, Any] = {"jupyter": {"source_hidden": True}} if folded else {}
    source = _quiet(text).splitlines(keepends=True)
    return {"cell_type": "code", "metadata": metadata, "source": source, "execution_count": None, "outputs": []}


def _quiet(code: str) -> str:
    """End a cell with a semicolon where its last line has a value that Jupyter would show."""
    body = ast.parse(code).body
    last = body[-1] if body else None
    if not isinstance(last, ast.Expr) or code.rstrip().endswith(";"):
        return code
    called = last.value.func if isinstance(last.value, ast.Call) else None
    name = getattr(called, "id", getattr(called, "attr", ""))
    # a comment behind the last line would swallow the semicolon
    ends = code.split("\n")[(last.end_lineno or 1) - 1]
    return code if name in _SILENT or "#" in ends else f"{code};"
