"""The chapters as Jupyter notebooks: the same cells in the same order, and pictures where they are drawn."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Sequence
from html import escape
from typing import Any, Final

from pop_ref.walkthrough.cells import FOLDER, Cell, Chapter
from pop_ref.walkthrough.directives import expanded
from pop_ref.walkthrough.folding import names_in, parts, said_and_done

_WIDGET: Final = re.compile(r"^\{\{widget: (\w+)\}\}$", re.MULTILINE)
_LINK: Final = re.compile(r"\]\((chapter_\w+)\.py\)")
# what they return is nothing, so that Jupyter shows nothing
_SILENT: Final = ("print", "picture", "film")
_SHOWS_A_WIDGET: Final = """from IPython.display import HTML, display

from pop_ref.walkthrough.widgets import html

display(HTML(html("{name}")))"""


def notebook(chapter: Chapter) -> str:
    """Write a chapter as a notebook that has not been run, in nbformat 4.5.

    Imports, drawing, checks, fixtures and answers are code cells of their own whose source is folded; what they show
    stays in sight. Each code cell's metadata names the line of the chapter's file at which its chapter's cell begins.

    Args:
        chapter: as `read_chapter` gave it.

    Returns:
        JSON, the same for the same chapter.

    Raises:
        ValueError: a directive is not known.
    """
    about = (
        f"*Made from `pop_ref/walkthrough/{chapter.path.name}`. It runs where pop-splatting is installed: "
        "`pip install 'pop-ref[walkthrough]' jupyterlab`.*"
    )
    cells = [_prose(about)]
    for cell in chapter.cells:
        made = _told(cell) if cell.kind == "prose" else _done(chapter, cell)
        for each in made:
            if each["cell_type"] == "code":
                each["metadata"] |= {"chapter_line": cell.line}
        cells += made
    for i, each in enumerate(cells):
        each["id"] = f"cell-{i}"
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {
        "kernelspec": kernel,
        "language_info": {"name": "python"},
        "title": chapter.title,
    }
    whole = {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


def notebook_name(chapter: Chapter) -> str:
    """Name the file of the chapter's notebook."""
    return f"{chapter.path.stem}.ipynb"


def notebook_index(chapters: Sequence[Chapter]) -> str:
    """Write a page that lists the notebooks, for where a folder does not list itself."""
    items = "".join(
        f'<li><a href="{notebook_name(each)}" download>{each.number}. {escape(each.title)}</a></li>'
        for each in chapters
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Notebooks</title>'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<style>{(FOLDER / 'page.css').read_text(encoding='utf-8')}</style></head><body><main><h1>Notebooks</h1>"
        "<p>Every chapter as a Jupyter notebook, to be run where pop-splatting is installed: "
        "<code>pip install 'pop-ref[walkthrough]' jupyterlab</code>, then <code>jupyter lab</code>.</p>"
        f"<ul>{items}</ul></main></body></html>\n"
    )


def _told(cell: Cell) -> list[dict[str, Any]]:
    text = _LINK.sub(r"](\1.ipynb)", expanded(cell.text))
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
    return {"cell_type": "markdown", "metadata": {}, "source": _lines(text)}


def _code(text: str, folded: bool) -> dict[str, Any]:
    metadata: dict[str, Any] = {"jupyter": {"source_hidden": True}} if folded else {}
    empty = {"execution_count": None, "outputs": []}
    return {
        "cell_type": "code",
        "metadata": metadata,
        "source": _lines(_quiet(text)),
        **empty,
    }


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


def _lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)
