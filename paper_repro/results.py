"""The finished runs in a folder of results: one file a scale and row, one line a scene and seed.

A row's results lie in `<folder>/<scale>/<row>.jsonl`, sorted by scene and seed. Tables, figures, claims and the status
table are made from these files and from paper.toml alone. Two queues can write to a folder at once: a file is read,
changed and replaced as a whole under a lock, and one that git has merged from two branches holds the lines of both.
"""

from __future__ import annotations

import fcntl
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from paper_repro.record import SCHEMA, Result, from_line, to_line
from paper_repro.scenes import SCALES as _SCALES
from pop_fast.errors import PopError
from pop_fast.io.atomic import write_atomically

SCALES: Final = tuple(_SCALES)
RESULTS: Final = Path(__file__).resolve().parent / "results"
# what a line begins with, by which it is known without its curve
_HEAD: Final = re.compile(
    rf'\{{"schema":{SCHEMA},"scale":"(\w+)","row":"(\w+)","scene":"(\w+)","seed":(\d+),', flags=re.ASCII
)


def path_of(scale: str, row: str, folder: Path = RESULTS) -> Path:
    """Give the file of a row's results in a folder of results."""
    return folder / scale / f"{row}.jsonl"


def existing_folder(folder: Path) -> Path:
    """Return a folder of results that is to be read; the package's own may be absent, as it is where pip has put it.

    Raises:
        PopError: it is not there: a name that was typed wrong would else be a folder without results.
    """
    if folder != RESULTS and not folder.is_dir():
        raise PopError(f"{folder}: no such folder; name the one that holds the results with --results")
    return folder


def kept(scale: str, row: str, folder: Path = RESULTS) -> frozenset[tuple[str, int]]:
    """List the scenes and seeds of which a row has a result; their values are not looked at.

    Raises:
        PopError: the file holds something else than results of the row, or two of one scene and seed.
    """
    return frozenset(_lines(path_of(scale, row, folder)))


def find(scale: str, row: str, scene: str, seed: int, folder: Path = RESULTS) -> Result | None:
    """Read one result, or return None where there is none.

    Raises:
        PopError: as `read`, for this result.
    """
    path = path_of(scale, row, folder)
    number, line = _lines(path).get((scene, seed), (0, None))
    return None if line is None else from_line(line, f"{path}: line {number}")


def read(path: Path) -> tuple[Result, ...]:
    """Read a row's results, by scene and seed.

    Raises:
        PopError: the file cannot be read, or a line is not a result, not one of this row and scale, or not what its
            own fields say; names the line and the field.
    """
    lines = _lines(path)
    return tuple(from_line(line, f"{path}: line {number}") for _, (number, line) in sorted(lines.items()))


def read_all(scale: str, folder: Path = RESULTS) -> tuple[Result, ...]:
    """Read every result of a scale, by row, scene and seed; none is fine.

    Raises:
        PopError: the scale is unknown, or as `read`.
    """
    if scale not in SCALES:
        raise PopError(f"scale is '{scale}'; it must be one of {', '.join(SCALES)}")
    return tuple(result for path in sorted((folder / scale).glob("*.jsonl")) for result in read(path))


def write(result: Result, folder: Path = RESULTS) -> Path:
    """Put a result into its row's file, in place of an older one of its scene and seed, and return the file.

    Raises:
        PopError: a field is not what it must be, or the file is damaged or cannot be written.
    """
    path, line = path_of(result.scale, result.row, folder), to_line(result)
    with _alone(path.parent):
        lines = {key: text for key, (_, text) in _lines(path).items()} | {(result.scene, result.seed): line}
        text = "".join(f"{lines[key]}\n" for key in sorted(lines))
        write_atomically(path, lambda file: file.write(text.encode("utf-8")))
    return path


def _lines(path: Path) -> dict[tuple[str, int], tuple[int, str]]:
    """Read the lines of a file by scene and seed, each with its number; none where the file is absent."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise PopError(f"{path}: cannot be read ({error})") from None
    lines: dict[tuple[str, int], tuple[int, str]] = {}
    for number, line in enumerate(text.split("\n"), 1):
        if not line:
            continue
        head = _HEAD.match(line)
        if head is None:
            raise PopError(
                f"{path}: line {number}: must begin with schema {SCHEMA}, scale, row, scene and seed, and begins with "
                f"{line[:60]!r}; remove the line and train its row again"
            )
        scale, row, scene, seed = head.groups()
        if (scale, row) != (path.parent.name, path.stem):
            raise PopError(f"{path}: line {number}: is of {row} at scale {scale}; its place is {scale}/{row}.jsonl")
        key = scene, int(seed)
        if key in lines:
            raise PopError(f"{path}: lines {lines[key][0]} and {number} are both of {scene}, seed {seed}; remove one")
        lines[key] = number, line
    return lines


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, waiting for another process that writes there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise PopError(f"{folder}: cannot be written to ({error.strerror}); choose another folder") from None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        # the lock ends with the handle
        os.close(handle)
