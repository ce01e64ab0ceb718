"""The blend of `pop_fast.compositing` in C++, several times as fast, where it has been compiled.

Everything else of the backend "compiled" is that of "fast". Importing this package imports neither torch nor the
library, and compiles nothing: `pop build-cpu` (`python -m pop_fast.compiled.build`, and `make setup` where there is a
compiler) does that, when it is asked to.
"""

from __future__ import annotations

from functools import cache


def available() -> bool:
    """Tell whether backend "compiled" can run here."""
    return why_not() is None


def why_not() -> str | None:
    """Return one sentence on why backend "compiled" cannot run here and what to do, or None where it can."""
    from pop_fast.compiled.build import library_path

    path = library_path()
    if not path.exists():
        return "the CPU blend is not compiled for this version and this processor; run `pop build-cpu`"
    return _why_not_loaded(str(path))


@cache
def _why_not_loaded(path: str) -> str | None:
    from pop_fast.compiled.library import open_library

    try:
        open_library(path)
    except OSError as error:
        return f"the compiled CPU blend does not load ({error}); compile it again: `pop build-cpu`"
    return None
