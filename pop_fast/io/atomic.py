"""Write files and folders whole or not at all: next to the target first, flushed to the disk, then renamed over it.

A rename within one folder is atomic on POSIX and Windows, so a reader, or a run resumed after SIGKILL, sees the old
content or the new content and never a mixture. A folder with content is exchanged for another in one step where the
system can, as Linux does. What a killed writer left next to the target carries its process id in its name and is swept
away by the next write to the same target.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import json
import math
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

from pop_fast.errors import PopError

# of renameat2(2)
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
_NAMED = 3  # files of somebody else that a message names
_LITTER = {".DS_Store", "Thumbs.db", "desktop.ini"}  # what file browsers leave in every folder that they show

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


def check_file(path: str | os.PathLike[str]) -> None:
    """Refuse a file that cannot be written (PopError), before the work whose result it is to hold."""
    path = Path(path)
    if path.is_dir():
        raise PopError(f"{path}: {_REASONS[errno.EISDIR]}")
    _check_ordinary(path)
    check_place(path)


def _check_ordinary(path: Path) -> None:
    """Refuse a pipe or a device such as /dev/null, in whose place a file would be put, and all that lies in /dev."""
    special = path.exists() and not path.is_file() and not path.is_dir()
    if special or path.absolute().parent == Path("/dev"):
        raise PopError(f"{path}: is a pipe or a device, which no file may replace; choose the name of a file")


def check_folder(
    path: str | os.PathLike[str],
    overwrite: bool = False,
    *,
    keeps: Iterable[Path] = (),
    recognise: Callable[[Path], bool] | None = None,
) -> None:
    """Refuse a folder that `folder_atomically` would not make, before the work whose result it is to hold.

    Raises:
        PopError: as `folder_atomically`, or a part of the path is a file, or its parent may not be written to.
    """
    path = Path(path)
    path = path.resolve() if path.is_symlink() or path.name in ("", "..") else path
    check_place(path)
    _check_replaceable(path, overwrite, keeps, recognise)


def check_place(path: Path) -> None:
    """Refuse a place in which nothing new can be made, as the nearest folder over it that exists does not allow it."""
    parent = next((parent for parent in path.absolute().parents if parent.exists()), None)
    if parent is not None and not parent.is_dir():
        raise PopError(f"{path}: could not be written: {_REASONS[errno.ENOTDIR]}")
    if parent is not None and not os.access(parent, os.W_OK | os.X_OK):
        raise PopError(f"{path}: could not be written: {_REASONS[errno.EACCES]}")


def write_atomically(path: str | os.PathLike[str], writer: Callable[[BinaryIO], object]) -> None:
    """Write one file whole or not at all; missing parents are made, and `writer` is called once with a binary file.

    Raises:
        PopError: the operating system refused (disk full, no permission, ...); names the file and what to do. The
            target is then as it was, and nothing is left next to it. Errors of `writer` itself pass through too.
    """
    path = Path(path)
    with _beside(path) as partial:
        with open(partial, "wb") as file:
            writer(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)


def write_file(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write one file whole or not at all, text as UTF-8; see `write_atomically`."""
    data = content.encode() if isinstance(content, str) else content
    write_atomically(path, lambda file: file.write(data))


def json_text(content: Any, indent: int | None = None) -> str:
    """Return the JSON of a value for every parser, which has no NaN and no infinity: they become null."""
    return json.dumps(_finite(content), indent=indent, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: str | os.PathLike[str], content: Any, indent: int | None = 2) -> None:
    """Write one file of JSON whole or not at all; see `write_atomically` and `json_text`."""
    write_file(path, json_text(content, indent))


@contextmanager
def file_atomically(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Let a library that opens its file by name write one file whole or not at all; see `write_atomically`.

    Yields:
        Where to write: a file of the same name in a hidden folder next to `path`, for libraries that read the ending.
    """
    path = Path(path)
    with _beside(path) as partial:
        partial.mkdir()
        yield partial / path.name
        _sync(partial / path.name)
        os.replace(partial / path.name, path)


@contextmanager
def folder_atomically(
    path: str | os.PathLike[str],
    overwrite: bool = False,
    *,
    keeps: Iterable[str | os.PathLike[str]] = (),
    recognise: Callable[[Path], bool] | None = None,
) -> Iterator[Path]:
    """Fill a folder under another name and rename it to `path` only when the block ends without an error.

    Args:
        path: the folder to make; missing parents are made, and a link to a folder is followed.
        overwrite: replace an existing folder; it stays untouched until the new one is complete.
        keeps: files and folders that the block reads: a folder that is one of them or holds one is never replaced.
        recognise: tells of a file of an existing folder, by its path relative to `path`, whether the caller wrote it. A
            folder with any other file in it is never replaced, and that is said before the block begins. Without it, a
            folder is replaced when all of its files are written anew, which is known only when the block has ended.

    Yields:
        The folder to fill, next to `path`.

    Raises:
        PopError: `path` exists, is not an empty folder, and `overwrite` is not set or the folder must not be replaced;
            or the operating system refused. `path` is then as it was. Errors of the block pass through too.

    Example:
        with folder_atomically(out, overwrite, keeps=[photos], recognise=lambda file: file.suffix == ".png") as folder:
            write_png(folder / "a.png", picture)
    """
    path = Path(path)
    # renamed is the folder itself and not a link to it, and ".." has no name to put a partial next to
    path = path.resolve() if path.is_symlink() or path.name in ("", "..") else path
    inputs = [Path(kept) for kept in keeps]
    if path.parent.is_dir():
        # a folder that another writer had set aside when it was killed is seen again
        with os_errors_name(path):
            _sweep(path)
    _check_replaceable(path, overwrite, inputs, recognise)
    with _beside(path) as partial:
        partial.mkdir()
        yield partial
        for file in sorted(partial.rglob("*")):
            _sync(file)
        # once more: others may have put files there while the block ran
        _check_replaceable(path, overwrite, inputs, recognise or (lambda file: (partial / file).is_file()))
        _swap_in(partial, path)


def _check_replaceable(
    path: Path, overwrite: bool, inputs: Iterable[Path], recognise: Callable[[Path], bool] | None
) -> None:
    """Raise PopError where a folder may not be put at `path`: what is there is not this caller's to remove."""
    if not path.exists():
        return
    if not path.is_dir():
        raise PopError(f"{path}: a file of this name is in the way; remove it or choose another output folder")
    real = path.resolve()
    if Path.cwd().is_relative_to(real):
        raise PopError(f"{path}: is or holds the folder that this command runs in; choose another output folder")
    if not any(path.iterdir()):
        return
    for kept in inputs:
        if kept.resolve().is_relative_to(real):
            what = "is" if kept.resolve() == real else f"holds {kept}, which is"
            raise PopError(f"{path}: {what} read by this command, so it is not replaced; choose another output folder")
    foreign = [] if recognise is None else list(islice((f for f in _files(path) if not recognise(f)), _NAMED + 1))
    if foreign:
        names = ", ".join(file.as_posix() for file in foreign[:_NAMED]) + (", ..." if len(foreign) > _NAMED else "")
        raise PopError(
            f"{path}: holds what this command did not write ({names}), so it is not replaced; "
            "choose another output folder, or move these files away"
        )
    if not overwrite:
        limit = ", which replaces only files that are written anew" if recognise is None else ""
        raise PopError(f"{path}: the folder exists and is not empty; choose another or pass --overwrite{limit}")


def _files(folder: Path) -> Iterator[Path]:
    """List everything under a folder but folders and litter, links too, relative to it and in order."""

    def unreadable(error: OSError) -> None:
        raise error  # what cannot be looked into must not count as empty

    for here, folders, files in os.walk(folder, onerror=unreadable):
        folders.sort()
        links = [name for name in folders if os.path.islink(os.path.join(here, name))]
        yield from (Path(here, name).relative_to(folder) for name in sorted({*files, *links} - _LITTER))


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """Name a partial next to `path` for the block to make and rename; nothing of it is left, whatever happens."""
    with os_errors_name(path):
        _check_ordinary(path)
        made = [parent for parent in path.absolute().parents if not parent.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)
        _sweep(path)
        partial = _partial(path)
        try:
            yield partial
        finally:
            _remove(partial)
            # what was written, or others write, is not empty and stays
            with contextlib.suppress(OSError):
                for parent in made:
                    parent.rmdir()
        _sync_folder(path.parent)


def _swap_in(partial: Path, path: Path) -> None:
    if not path.exists():
        os.replace(partial, path)
        return
    if _exchange(partial, path):
        # what stands in the place of the partial now is the old folder, and is removed with it
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


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two names in one step; False, and nothing happens, where the system or the file system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    # relative to the working folder, as any other name: absolute ones are taken as they are
    return rename(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0


def _partial(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


def _sweep(path: Path) -> None:
    """Remove what writers of `path` that are no longer alive left next to it."""
    prefix = f".{path.name}."
    for left in path.parent.iterdir():
        parts = left.name.removeprefix(prefix).split(".")
        if not (left.name.startswith(prefix) and parts[0].isdecimal() and parts[1:] in (["partial"], ["old"])):
            continue
        pid = int(parts[0])
        if pid != os.getpid() and _alive(pid):
            continue
        if parts[1] == "old" and not path.exists():
            # its writer ended between two renames: the folder comes back
            os.replace(left, path)
        else:
            _remove(left)


def is_left_behind(path: Path) -> bool:
    """Tell by its name whether a file is what a writer that is no longer alive began; the next write removes it."""
    parts = path.name.split(".")
    if len(parts) < 4 or parts[0] or parts[-1] != "partial" or not parts[-2].isdecimal():
        return False
    pid = int(parts[-2])
    return pid == os.getpid() or not _alive(pid)


def _remove(left: Path) -> None:
    if left.is_dir() and not left.is_symlink():
        shutil.rmtree(left, ignore_errors=True)
    else:
        left.unlink(missing_ok=True)


def _alive(pid: int) -> bool:
    if os.name == "nt":  # there, signal 0 is a console event that would end the process
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):  # no process has so large a number
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
def os_errors_name(path: Path) -> Iterator[None]:
    """Turn what the system refuses in the block into a PopError that names the file and what to do."""
    try:
        yield
    except OSError as error:
        reason = _REASONS.get(error.errno or 0)
        partial = _partial(path).name
        where = str(error.filename or path)
        if reason is None:
            if partial not in where:
                raise
            reason = f"{error.strerror}; choose another path"
        # what the user named, not what stands in for it until it is whole
        where = where.replace(os.path.join(partial, path.name), path.name).replace(partial, path.name)
        raise PopError(f"{where}: could not be written: {reason}") from error


# file systems and systems that know no locks
_UNKNOWN = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL}


class FolderLock:
    """A lock on a folder itself, for which no file is needed; it holds between processes of one machine.

    Where the file system knows no locks there is none, and nothing is refused.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._handle: int | None = None

    @property
    def held(self) -> bool:
        return self._handle is not None

    def take(self) -> None:
        """Take the lock of a folder that exists, once is enough; a PopError says that somebody else holds it."""
        if self._handle is not None:
            return
        try:
            import fcntl
        except ImportError:  # not on Windows
            return
        try:
            handle = os.open(self.path, os.O_RDONLY)
        except OSError:  # writing to the folder tells what is wrong with it
            return
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(handle)
            if error.errno in _UNKNOWN:
                return
            raise PopError(
                f"{self.path}: another run is writing to this folder; wait for its end, or choose another result folder"
            ) from None
        self._handle = handle

    def release(self) -> None:
        """Give the lock back, if it was taken."""
        if self._handle is not None:
            with contextlib.suppress(OSError):
                os.close(self._handle)
            self._handle = None
