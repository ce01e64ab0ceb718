"""Functions as pages show them, without their docstrings, which the prose around them replaces."""

from __future__ import annotations

import ast


def without_docstring(text: str, node: ast.FunctionDef) -> str:
    """Return a function's lines but for its docstring."""
    lines = text.split("\n")
    told = node.body[0] if ast.get_docstring(node) is not None else None
    first, last = node.lineno - 1, node.end_lineno or node.lineno
    if told is None:
        return "\n".join(lines[first:last])
    return "\n".join(
        [*lines[first : told.lineno - 1], *lines[told.end_lineno or told.lineno : last]]
    )
