"""Functions as pages show them: no wider than a page, and without docstrings, which the prose around them replaces."""

from __future__ import annotations

import ast
import re
from typing import Final

# in characters
PAGE: Final = 96
_SIGNATURE: Final = re.compile(r"^def (\w+)\(\s*(.*?),?\s*\)( -> [^\n]*)?:\n", re.DOTALL)
# what the oracle's files call an ambiguity of the papers
_AMBIGUITY: Final = re.compile(r"(?m)^( *#.*?) \(A\d+\)")


def as_wide_as_a_page(code: str) -> str:
    """Break a function's signature into a line an argument where a line of it is longer than a page is wide.

    Example:
        >>> as_wide_as_a_page("def f(x: int) -> int:\\n    return x")
        'def f(x: int) -> int:\\n    return x'
    """
    code = _AMBIGUITY.sub(r"\1", code)
    found = _SIGNATURE.match(code)
    if found is None or max(map(len, found[0].split("\n"))) <= PAGE:
        return code
    arguments = "".join(f"    {each},\n" for each in _arguments(found[2]))
    return f"def {found[1]}(\n{arguments}){found[3] or ''}:\n" + code[found.end() :]


def _arguments(text: str) -> list[str]:
    """Cut at the commas that stand in no bracket and no string."""
    cut, depth, quoted = [""], 0, False
    for letter in text:
        quoted ^= letter == '"'
        depth += (letter in "([{") - (letter in ")]}")
        if letter == "," and depth == 0 and not quoted:
            cut.append("")
        else:
            cut[-1] += letter
    return [" ".join(each.split()) for each in cut if each.strip()]


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
