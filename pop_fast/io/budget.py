"""How much memory a file may ask for: what it states is held against its size and what is free, before it is unpacked.

A few kilobytes can state any size, and deflate makes a thousand bytes of one. What a reader will need is known from
headers: counts, widths and heights, sizes of members. It may be a little at any rate, and beyond that so many times
the file as no real one needs; and it must be free.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Final

from pop_fast.errors import PopError
from pop_fast.machine import free_bytes

__all__ = ["PICTURE", "check_members", "check_memory"]

# what any file may need, bytes, and any picture: one of a single colour packs well, and 89 million pixels are read
_ANY: Final = 2**26
PICTURE: Final = 2**29
# times the file's size; splats that pack well need 60
_MOST_TIMES: Final = 200


def check_memory(path: Path | str, needed: int, packed: int, what: str, fix: str, floor: int = _ANY) -> None:
    """Refuse what needs more memory than its file makes likely, or than there is.

    Args:
        path: the file, for the error.
        needed: bytes, by what the file states.
        packed: the file's own bytes.
        what: states it, for the error.
        fix: what to do, for the error.
        floor: bytes that are always likely.

    Raises:
        PopError: names the file, what it states, and both sizes in MB.
    """
    if needed <= _ANY:
        return
    if needed > max(floor, _MOST_TIMES * packed):
        raise PopError(
            f"{path}: {what} would take {_mb(needed)} of memory to read, and the file has {_mb(packed)}, "
            f"which holds no such content; {fix}"
        )
    free = free_bytes()
    if free is not None and needed > free:
        raise PopError(f"{path}: {what} would take {_mb(needed)} of memory to read, and {_mb(free)} are free; {fix}")


def check_members(path: Path | str, archive: zipfile.ZipFile, packed: int, fix: str, times: int = 1) -> None:
    """Refuse a zip whose members would come to too much; see `check_memory`.

    Args:
        path: the file, for the error.
        archive: opened; no member is read.
        packed: the file's own bytes.
        fix: what to do, for the error.
        times: bytes that are needed for one of a member.

    Raises:
        PopError: names the file and the largest member.
    """
    members = archive.infolist()
    if members:
        largest = max(members, key=lambda member: member.file_size)
        needed = times * sum(member.file_size for member in members)
        check_memory(path, needed, packed, f"{largest.filename[:80]!r} and what else is in it", fix)


def _mb(size: int) -> str:
    return f"{size / 1e6:,.1f} MB"
