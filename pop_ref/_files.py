"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file next to its place and rename it, so that a stop or a full disk leaves what was there.

    Args:
        path: its folder is made where there is none; a link is followed. What is no regular file, as a terminal, is
            written to as it is.
        content: text is written as UTF-8.

    Raises:
        OSError: it cannot be written; nothing is left.
    """
    data = content.encode() if isinstance(content, str) else content
    if path.exists() and not path.is_file():
        path.write_bytes(data)
        return
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.write_bytes(data)
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
