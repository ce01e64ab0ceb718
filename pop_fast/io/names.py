"""File names for pictures of views: whatever a capture calls its views, the pictures stay in one folder, one each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path, PureWindowsPath

from pop_fast.errors import PopError
from pop_fast.io.heif import HEIF_SUFFIXES
from pop_fast.io.images import IMAGE_SUFFIXES

__all__ = ["inside", "picture_names"]

_PICTURES = (*IMAGE_SUFFIXES, *HEIF_SUFFIXES)


def picture_names(views: Sequence[str], suffix: str = ".png") -> list[Path]:
    """Give every view a file name of its own, relative to the folder that the pictures go to.

    "images/a.jpg" becomes images/a.png. A suffix that is no image's is part of the name: "cam.00" becomes cam.00.png.
    What leads out of the folder is dropped: "..", and of absolute names the root and the folders that all of them
    share. Views that differ only in their suffix keep it (x.jpg.png, x.png.png), and what still meets is numbered.
    Names that differ only in case count as the same, because some file systems hold them to be.

    Args:
        views: names of views as their capture lists them.
        suffix: of the pictures, with its dot.

    Returns:
        Relative paths in the order of the views, all different. [len(views)]

    Example:
        >>> [path.as_posix() for path in picture_names(["/data/a/0.jpg", "/data/b/0.jpg", "../c/1.png"])]
        ['a/0.png', 'b/0.png', 'c/1.png']
    """
    whole = [Path(*parts) for parts in _inner_parts(views)]
    plain = [path.with_name((path.stem if path.suffix.lower() in _PICTURES else path.name) + suffix) for path in whole]
    wanted = Counter(map(_key, plain))
    taken: set[str] = set()
    names: list[Path] = []
    for path, short in zip(whole, plain, strict=True):
        first = short if wanted[_key(short)] == 1 else path.with_name(path.name + suffix)
        name, number = first, 2
        while _key(name) in taken:
            name, number = first.with_stem(f"{first.stem}_{number}"), number + 1
        taken.add(_key(name))
        names.append(name)
    return names


def inside(folder: Path, name: Path) -> Path:
    """Join a relative name to a folder.

    Raises:
        PopError: the file would lie outside the folder.
    """
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise PopError(f"{name}: leads out of {folder}; give it a name without '..' and without a root")
    return path


def _inner_parts(names: Sequence[str]) -> list[tuple[str, ...]]:
    # Windows' rules know both slashes and drives, so lists that were written there are understood everywhere
    paths = [PureWindowsPath(name) for name in names]
    rooted = [path.parts[1:-1] for path in paths if path.anchor]
    shared = 1 + sum(1 for _ in takewhile(lambda parts: len(set(parts)) == 1, zip(*rooted, strict=False)))
    parts = [path.parts[shared:] if path.anchor else path.parts for path in paths]
    return [tuple(part for part in some if part != "..") or ("view",) for some in parts]


def _key(path: Path) -> str:
    return path.as_posix().casefold()
