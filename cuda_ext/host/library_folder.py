"""Where libraries are compiled that only tests load: beside the code, or in a cache that is this user's alone.

What is loaded from a library runs as whoever loads it. In a folder for everybody, such as that for temporary files,
whoever knows the name can put a library of their own there first.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def library_folder(package: Path = PACKAGE) -> Path:
    """Return the folder to compile into and to load from: `build` in the package's own, where that can be written to.

    Args:
        package: a folder with code of this project; whoever may write to it can change the code as well.

    Raises:
        RuntimeError: the cache that stands in for it is, or was, open to others; names it and what to do.
    """
    folder = package / "build"
    if os.access(folder if folder.exists() else package, os.W_OK):
        return folder
    given = os.environ.get("XDG_CACHE_HOME", "")
    cache = (Path(given) if os.path.isabs(given) else Path.home() / ".cache") / "pop-splatting"
    # made for this user alone from the first moment
    cache.parent.mkdir(parents=True, exist_ok=True)
    cache.mkdir(mode=0o700, exist_ok=True)
    _require_own(cache, others=0o077)
    for file in cache.iterdir():
        _require_own(file, others=0o022)
    return cache


def _require_own(path: Path, others: int) -> None:
    found = path.lstat()
    if stat.S_ISLNK(found.st_mode):
        problem = "is a link"
    elif found.st_uid != os.geteuid():
        problem = f"belongs to user {found.st_uid}, not to you"
    elif found.st_mode & others:
        problem = f"is open to others (mode {stat.S_IMODE(found.st_mode):03o})"
    else:
        return
    raise RuntimeError(f"{path}: {problem}, so nothing is loaded from it; remove it, or set XDG_CACHE_HOME elsewhere")
