"""The options of structure from motion, and what it leaves beside its model.

It leaves a list of its files, and which photographs are to be turned. With the list, replacing a result never removes
anything else. It lies beside the model as `sparse/sfm.sha256`, in the format of `sha256sum`, with paths relative to the
capture.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from pop_fast.errors import CaptureError

MATCHERS: Final = ("auto", "exhaustive", "sequential")


@dataclass(frozen=True, kw_only=True)
class SfmOptions:
    """How cameras are found.

    Attributes:
        max_size: longest side at which features are looked for, px; cameras are always in full size.
        camera_model: COLMAP's name of the lens model.
        single_camera: all photographs share one camera; by default when they are all of one size.
        matcher: "exhaustive" matches all photographs with all, "sequential" each with its neighbours by name; "auto"
            matches up to 60 exhaustively.
        seed: of every random choice.
    """

    max_size: int = 1600
    camera_model: str = "SIMPLE_RADIAL"
    single_camera: bool | None = None
    matcher: Literal["auto", "exhaustive", "sequential"] = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.max_size < 64:
            raise CaptureError(f"max_size is {self.max_size}; it must be at least 64 px, or there are no features")
        if self.matcher not in MATCHERS:
            raise CaptureError(f"matcher is {self.matcher!r}; use one of {', '.join(MATCHERS)}")
        if not 0 <= self.seed < 2**31:
            raise CaptureError(f"seed is {self.seed}; it must be a whole number from 0 to {2**31 - 1}")


UPRIGHT = "upright.json"
_LIST = "sfm.sha256"


def write_list(sparse: Path, folder: Path, prefix: str = "") -> None:
    """List every file of a new result `folder` in its folder `sparse`, with `prefix` before their paths."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    lines = [f"{_sha256(path)}  {prefix}{path.relative_to(folder).as_posix()}\n" for path in files]
    (sparse / _LIST).write_text("".join(lines), encoding="utf-8", errors="surrogateescape")


def read_upright(sparse: Path) -> dict[str, int]:
    """Read by how many quarter turns clockwise photographs are to be turned, by name; others are absent."""
    path = sparse / UPRIGHT
    if not path.is_file():
        return {}
    fix = "run pop sfm again with --overwrite"
    try:
        turns = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise CaptureError(f"{path}: is not JSON ({error}); {fix}") from error
    if not isinstance(turns, dict) or not all(type(count) is int and 1 <= count <= 3 for count in turns.values()):
        raise CaptureError(f"{path}: must hold quarter turns, 1 to 3, by the photograph's name; {fix}")
    return turns


def recognise_result(capture: Path, target: Path) -> Callable[[Path], bool]:
    """Make a test of whether a file, by its path relative to the `target` to be replaced, is as it was written."""
    written = _read_list(capture / "sparse" / _LIST)

    def recognise(file: Path) -> bool:
        path = target / file
        if path.is_symlink():
            return False
        name = path.relative_to(capture).as_posix()
        return name == f"sparse/{_LIST}" or (name in written and written[name] == _sha256(path))

    return recognise


def _read_list(path: Path) -> dict[str, str]:
    if not path.is_file():
        return {}
    lines = path.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
