"""What a line `{{name: argument}}` of a chapter's prose stands for: code and tables made from the package itself.

`{{source: pop_ref.alpha.falloff}}` is a function as it stands in its file, without its docstring; `{{bug: name}}` the
function with one of the kit's mutants in it; `{{glossary}}` and `{{stages}}` tables. All but `{{widget: name}}`, which
only a page can show, are expanded to markdown, so that pages, notebooks and slides have the same.
"""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path
from typing import Final

from pop_ref.learn.course import COURSE
from pop_ref.walkthrough.cells import MINUTES, chapter_files
from pop_ref.walkthrough.docstrings import as_wide_as_a_page, without_docstring

DIRECTIVE: Final = re.compile(r"^\{\{(\w+)(?:: ([^}]+))?\}\}$", re.MULTILINE)


def expanded(text: str, marked: bool = False) -> str:
    """Expand the directives of a prose cell to markdown; widgets stay.

    Args:
        text: of the cell.
        marked: say of a function that the course asks for in which stage it is, for a page that folds it.

    Raises:
        ValueError: a directive, or what it names, is not known.
    """
    return DIRECTIVE.sub(
        lambda found: _expanded(found[1], found[2] or "", found[0], marked), text
    )


def _expanded(name: str, argument: str, whole: str, marked: bool) -> str:
    if name == "widget":
        return whole
    if name == "source":
        return _quoted(*source_of(argument), _stage_of(argument) if marked else "")
    if name == "bug":
        from pop_ref.walkthrough.bugs import broken_function

        return _quoted(*broken_function(argument))
    if name == "glossary":
        from pop_ref.walkthrough.glossary import glossary

        return glossary()
    if name == "stages":
        from pop_ref.walkthrough.glossary import stages

        return stages()
    if name == "chapters":
        return chapters()
    raise ValueError(f"{whole} is not a directive")


def chapters() -> str:
    """List the chapters with their minutes, as a markdown table."""
    rows = []
    for path in chapter_files():
        text = path.read_text(encoding="utf-8")
        title, minutes = (
            re.search(r"^# # (.+)$", text, re.MULTILINE),
            re.search(MINUTES, text),
        )
        if title is not None and minutes is not None:
            rows.append(f"| [{title[1]}]({path.name}) | {minutes[1]} |")
    return "\n".join(["| chapter | minutes |\n|---|---|", *rows])


def source_of(path: str) -> tuple[str, str]:
    """Return a function's code without its docstring, and the file that it is in.

    Args:
        path: module and function, as `pop_ref.alpha.falloff`.

    Raises:
        ValueError: there is none such.
    """
    module, _, name = path.rpartition(".")
    spec = importlib.util.find_spec(module) if module else None
    if spec is None or spec.origin is None:
        raise ValueError(f"{path}: there is no such module")
    text = Path(spec.origin).read_text(encoding="utf-8")
    return function_in(text, name, path), f"{module.replace('.', '/')}.py"


def function_in(text: str, name: str, path: str) -> str:
    """Cut a function out of a module's text and leave its docstring out."""
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            return without_docstring(text, node)
    raise ValueError(f"{path}: there is no such function")


def _stage_of(path: str) -> str:
    """Name the stage of `pop learn` in which a reader writes this function, if there is one."""
    return next(
        (stage.name for stage in COURSE if path.rpartition(".")[2] in stage.names), ""
    )


def _quoted(code: str, file: str, stage: str = "") -> str:
    # a page folds what is marked so (`layout`)
    yours = f", yours to write first in `pop learn check {stage}`" if stage else ""
    return f"`{file}`{yours}:\n\n```python\n{as_wide_as_a_page(code)}\n```"
