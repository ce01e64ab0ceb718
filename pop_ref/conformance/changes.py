"""Source with a change marked in it, as «before→after»: how mutants and students' mistakes are written down."""

from __future__ import annotations
import __future__

import functools
import inspect
import re
from collections.abc import Callable
from typing import Any, Final

_CHANGE: Final = re.compile("«([^→]*)→([^»]*)»")


def sides(text: str) -> tuple[str, str]:
    """Return a text before and after its changes.

    Example:
        >>> sides("s_xy + «C2→C1»")
        ('s_xy + C2', 's_xy + C1')
    """
    return _CHANGE.sub(r"\1", text), _CHANGE.sub(r"\2", text)


@functools.cache
def otherwise(function: Callable[..., Any], text: str) -> Callable[..., Any]:
    """Return a function with pieces of its source changed.

    Args:
        function: of a module, with its source beside it.
        text: the changed pieces, with " ... " between them; each stands once in the source.

    Example:
        >>> from pop_ref.alpha import falloff
        >>> otherwise(falloff, "math.exp(«-→»sigma)")(0.0)
        1.0
    """
    plain = inspect.unwrap(function)
    source = inspect.getsource(plain)
    for before, after in map(sides, text.split(" ... ")):
        if source.count(before) != 1:
            raise ValueError(f"{before!r} stands {source.count(before)} times in {plain.__name__}")
        source = source.replace(before, after)
    names = dict(plain.__globals__)
    flags = __future__.annotations.compiler_flag
    exec(compile(source, f"<{plain.__name__}, otherwise>", "exec", flags, dont_inherit=True), names)
    return names[plain.__name__]
