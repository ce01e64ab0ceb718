"""Write files and folders whole or not at all: beside the target first, flushed to the disk, then renamed over it.

A rename within one folder is atomic on POSIX and Windows, so a reader, or a run resumed after SIGKILL, sees the old
content or the new content and never a mixture. What a killed writer left beside the target carries its process id in
its name and is swept away by the next write to the same target.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from pop_fast.errors import PopError

__all__ = ["folder_atomically", "write_atomically"]

_REASONS = {
    errno.ENOSPC: "the disk is full; free some space or choose another output folder",
    errno.EDQUOT: "the disk quota is used up; free some space or choose another output folder",
    errno.EFBIG: "the file is larger than the system allows here; raise the limit or choose another output folder",
    errno.EACCES: "permission denied; choose a folder that you may write to",
    errno.EPERM: "permission denied; choose a folder that you may write to",
    errno.EROFS: "the file system is read-only; choose another output folder",
    errno.ENOTDIR: "a part of this path is a file, not a folder; choose another path",
    errno.EEXIST: "a file is in the place of this folder; choose another path",
    errno.EISDIR: "a folder of this name is in the way; remove it or choose another name",
    errno.ENAMETOOLONG: "the name is too long for this file system; choose a shorter one",
}


def write_atomically(path: str | os.PathLike[str], writer: Callable[[BinaryIO], object]) -> None:
    """Write one file whole or not at all.

    Args:
        path: the file to make or to replace; missing parent folders are made.
        writer: called once with a binary file open for writing (`torch.save(x, file)`, `file.write(data)`, ...).

    Raises:
        PopError: the operating system refused (disk full, no permission, ...); names the file and what to do. The
            target is then as it was, and nothing is left beside it. Errors of `writer` itself pass through, likewise.
    """
    path = Path(path)
    with _os_errors_name(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        _sweep(path)
        partial = _partial(path)
        try:
            with open(partial, "wb") as file:
                writer(file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
        _sync_folder(path.parent)


@contextmanager
def folder_atomically(path: str | os.PathLike[str], overwrite: bool = False) -> Iterator[Path]:
    """Fill a folder under another name and rename it to `path` only when the block ends without an error.

    Args:
        path: the folder to make; missing parents are made.
        overwrite: replace an existing folder; it stays untouched until the new one is complete.

    Yields:
        The folder to fill, beside `path`.

    Raises:
        PopError: `path` exists, is not an empty folder and `overwrite` is not set; or the operating system refused.
            `path` is then as it was. Errors of the block pass through, likewise.
    """
    path = Path(path)
    with _os_errors_name(path):
        if path.exists() and not path.is_dir():
            raise PopError(f"{path}: a file of this name is in the way; remove it or choose another output folder")
        if path.exists() and any(path.iterdir()) and not overwrite:
            raise PopError(f"{path}: the folder exists and is not empty; choose another or pass --overwrite")
        path.parent.mkdir(parents=True, exist_ok=True)
        _sweep(path)
        partial = _partial(path)
        partial.mkdir()
        try:
            yield partial
            for file in sorted(partial.rglob("*")):
                _sync(file)
            _swap_in(partial, path)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        _sync_folder(path.parent)


def _swap_in(partial: Path, path: Path) -> None:
    if not path.exists():
        os.replace(partial, path)
        return
    # a folder with content cannot be renamed over: the old one steps aside first and comes back if that fails
    old = path.with_name(f".{path.name}.{os.getpid()}.old")
    os.replace(path, old)
    try:
        os.replace(partial, path)
    except BaseException:
        os.replace(old, path)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _partial(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


def _sweep(path: Path) -> None:
    """Remove what writers of `path` that are no longer alive left beside it."""
    prefix = f".{path.name}."
    for left in path.parent.iterdir():
        parts = left.name.removeprefix(prefix).split(".")
        if left.name.startswith(prefix) and parts[0].isdigit() and parts[1:] == ["partial"]:
            pid = int(parts[0])
            if pid == os.getpid() or not _alive(pid):
                shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)


def _alive(pid: int) -> bool:
    if os.name == "nt":  # there, signal 0 is a console event that would end the process
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def _sync(path: Path) -> None:
    if path.is_file():
        with open(path, "rb") as file:
            os.fsync(file.fileno())


def _sync_folder(path: Path) -> None:
    """Make the rename itself durable, where folders can be opened (not on Windows)."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    except OSError:
        pass
    finally:
        os.close(handle)


@contextmanager
def _os_errors_name(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = _REASONS.get(error.errno or 0)
        if reason is None:
            raise
        where = str(error.filename or path).replace(_partial(path).name, path.name)
        raise PopError(f"{where}: could not be written: {reason}") from error
