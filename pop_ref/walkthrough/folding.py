"""Tell the code that a reader is here for from imports, checks and the code that draws."""

from __future__ import annotations

import ast
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final, Literal

Role = Literal["plain", "imports", "checks", "draws"]

_OPENS: Final = {"axes", "subplots", "figure"}
_CLOSES: Final = {"picture", "film"}


@dataclass(frozen=True)
class Part:
    """A run of whole statements of a cell, and what they are there for."""

    text: str
    role: Role


def parts(code: str, used_later: Collection[str] | None = None) -> list[Part]:
    """Cut a cell by what its statements are there for.

    Drawing begins with the statement that makes axes and ends with the one that calls `picture` or `film`; a function
    that makes axes, or takes them as `ax`, is drawing by itself. Outside of drawing, imports are imports, and an
    assertion, or a loop that does nothing but assert, is a check, and so is an assignment of what only checks look at.
    Comments right above a statement belong to it.

    Args:
        code: a cell that Python can parse.
        used_later: names that later cells look at, by default any.

    Returns:
        The parts in order; together they are the code, but for blank lines between them.
    """
    lines = code.split("\n")
    body = ast.parse(code).body
    roles = _roles(body)
    if used_later is not None:
        roles = _with_what_only_checks_need(body, roles, set(used_later))
    cut: list[tuple[int, int, Role]] = []
    for i, (node, role) in enumerate(zip(body, roles, strict=True)):
        first, last = _with_comments(lines, node.lineno - 1), node.end_lineno or node.lineno
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.decorator_list:
            first = _with_comments(lines, node.decorator_list[0].lineno - 1)
        # what follows the last statement on lines of its own is a comment, and belongs to it
        last = len(lines) if i == len(body) - 1 else last
        if cut and cut[-1][2] == role:
            cut[-1] = (cut[-1][0], last, role)
        else:
            cut.append((first, last, role))
    found = [
        Part("\n".join(lines[first:last]).strip("\n"), role) for first, last, role in cut
    ]
    return found or [Part(code, "plain")]


def names_in(codes: Sequence[str]) -> set[str]:
    """Collect the names that cells look at."""
    return set().union(*(_looked_at(ast.parse(code)) for code in codes))


def said_and_done(code: str) -> tuple[str, str]:
    """Part the comment that opens an answer, without its marks, from the code that proves it."""
    lines = code.split("\n")
    n_said = next(
        (i for i, line in enumerate(lines) if not line.startswith("#")), len(lines)
    )
    said = "\n".join(line.removeprefix("#").removeprefix(" ") for line in lines[:n_said])
    return said, "\n".join(lines[n_said:]).strip("\n")


def _roles(body: list[ast.stmt]) -> list[Role]:
    roles: list[Role] = []
    drawing = False
    for node in body:
        called = _called(node)
        function = isinstance(node, ast.FunctionDef)
        if function and not drawing:
            roles.append("draws" if called & _OPENS or _takes_axes(node) else "plain")
            continue
        drawing = drawing or bool(called & (_OPENS | _CLOSES))
        roles.append("draws" if drawing else _role(node))
        if called & _CLOSES:
            drawing = False
    return roles


def _role(node: ast.stmt) -> Role:
    if isinstance(node, ast.Import | ast.ImportFrom):
        return "imports"
    return "checks" if _only_asserts(node) else "plain"


def _with_what_only_checks_need(
    body: list[ast.stmt], roles: list[Role], needed: set[str]
) -> list[Role]:
    found, checked = list(roles), set[str]()
    for i in reversed(range(len(body))):
        targets = _assigned(body[i])
        if roles[i] == "plain" and targets & checked and not targets & needed:
            found[i] = "checks"
        (checked if found[i] == "checks" else needed).update(_looked_at(body[i]))
    return found


def _assigned(node: ast.stmt) -> set[str]:
    """Return what an assignment binds, and nothing where it also changes something."""
    if not isinstance(node, ast.Assign):
        return set()
    places = [each for target in node.targets for each in ast.walk(target)]
    if any(isinstance(each, ast.Subscript | ast.Attribute) for each in places):
        return set()
    return {each.id for each in places if isinstance(each, ast.Name)}


def _looked_at(node: ast.AST) -> set[str]:
    return {
        each.id
        for each in ast.walk(node)
        if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Load)
    }


def _only_asserts(node: ast.stmt) -> bool:
    if isinstance(node, ast.Assert):
        return True
    if isinstance(node, ast.For):
        # names that a loop binds on the way to its assertion are of use to nothing else
        return _only_asserts(node.body[-1]) and all(
            _only_asserts(n) or isinstance(n, ast.Assign) for n in node.body
        )
    called = (
        node.value.func
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        else None
    )
    return isinstance(called, ast.Attribute) and called.attr.startswith("assert_")


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
