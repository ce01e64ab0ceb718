"""Projection, harmonics, tile lists, blend and D-SSIM of `pop_fast` in C++, where they have been compiled.

Everything else of the backend "compiled" is that of "fast". Importing this package imports neither torch nor the
library, and compiles nothing: `pop build-cpu` (`python -m pop_fast.compiled.build`, and `make setup` where there is a
compiler) does that, when it is asked to.
"""

from __future__ import annotations

_loaded: set[str] = set()


def available() -> bool:
    """Tell whether backend "compiled" can run here."""
    return why_not() is None


def why_not() -> str | None:
    """Return one sentence on why backend "compiled" cannot run here and what to do, or None where it can."""
    from pop_fast.compiled.build import library_path

    path = library_path()
    # what is loaded stays, also when an update has removed its file under a training that continues
    if str(path) in _loaded:
        return None
    if not path.exists():
        return "the CPU kernels are not compiled for this version and this processor; run `pop build-cpu`"
    from pop_fast.compiled.library import load_library

    try:
        load_library(str(path))
    except OSError as error:
        return f"the compiled CPU kernels do not load ({error}); compile them again: `pop build-cpu`"
    _loaded.add(str(path))
    return None
