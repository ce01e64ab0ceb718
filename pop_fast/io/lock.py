"""One writer at a time: a lock on a folder that ends with the process that holds it, however that ends."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

from pop_fast.errors import PopError

__all__ = ["FolderLock"]

# file systems and systems that know no locks
_UNKNOWN = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL}


class FolderLock:
    """A lock on a folder itself, for which no file is needed; it holds between processes of one machine.

    Where the file system knows no locks there is none, and nothing is refused.

    Args:
        path: the folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._handle: int | None = None

    @property
    def held(self) -> bool:
        """Tell whether this object holds the lock."""
        return self._handle is not None

    def take(self) -> None:
        """Take the lock of a folder that exists; once is enough.

        Raises:
            PopError: somebody else holds it.
        """
        if self._handle is not None:
            return
        try:
            import fcntl
        except ImportError:  # not on Windows
            return
        try:
            handle = os.open(self.path, os.O_RDONLY)
        except OSError:  # what is wrong with the folder is said by who writes to it
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
