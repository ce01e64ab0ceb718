"""Tell the code that draws from the code that a reader is here for."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import Final

_OPENS: Final = {"axes", "subplots", "figure"}
_CLOSES: Final = {"picture"}


@dataclass(frozen=True)
class Part:
    """A run of whole statements of a cell, and whether they draw."""

    text: str
    draws: bool


def parts(code: str) -> list[Part]:
    """Cut a cell where drawing begins and ends.

    Drawing begins with the statement that makes axes and ends with the one that calls `picture`; a function that makes
    axes, or takes them as `ax`, is drawing by itself. Comments right above a part belong to it.

    Args:
        code: a cell that Python can parse.

    Returns:
        The parts in order; together they are the code, but for blank lines between them.
    """
    lines = code.split("\n")
    cut: list[tuple[int, int]] = []
    start = None
    for node in ast.parse(code).body:
        called = _called(node)
        if start is None and (called & _OPENS or _takes_axes(node)):
            start = _with_comments(lines, node.lineno - 1)
            # drawing that goes on where drawing ended is one part
            if cut and not "".join(lines[cut[-1][1] : start]).strip():
                start = cut.pop()[0]
        defined = isinstance(node, ast.FunctionDef)
        if start is not None and (defined or called & _CLOSES):
            cut.append((start, node.end_lineno or node.lineno))
            start = None
    if start is not None:
        cut.append((start, len(lines)))
    found: list[Part] = []
    done = 0
    for first, last in [*cut, (len(lines), len(lines))]:
        found += [
            Part("\n".join(lines[done:first]).strip("\n"), False),
            Part("\n".join(lines[first:last]), True),
        ]
        done = last
    return [part for part in found if part.text]


def said_and_done(code: str) -> tuple[str, str]:
    """Part the comment that opens an answer, without its marks, from the code that proves it."""
    lines = code.split("\n")
    n_said = next(
        (i for i, line in enumerate(lines) if not line.startswith("#")), len(lines)
    )
    said = "\n".join(line.removeprefix("#").removeprefix(" ") for line in lines[:n_said])
    return said, "\n".join(lines[n_said:]).strip("\n")


def _called(node: ast.AST) -> set[str]:
    functions = [each.func for each in ast.walk(node) if isinstance(each, ast.Call)]
    named = {each.id for each in functions if isinstance(each, ast.Name)}
    return named | {each.attr for each in functions if isinstance(each, ast.Attribute)}


def _takes_axes(node: ast.stmt) -> bool:
    return isinstance(node, ast.FunctionDef) and any(
        each.arg == "ax" for each in node.args.args
    )


def _with_comments(lines: list[str], first: int) -> int:
    while first > 0 and lines[first - 1].startswith("#"):
        first -= 1
    return first
