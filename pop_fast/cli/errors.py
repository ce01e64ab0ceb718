"""Which exceptions are the user's to correct, the one line that says how, and text made fit for a terminal."""

from __future__ import annotations

import errno
import re
import traceback
from typing import Final

# C0 without tab and line feed, DEL, C1, and what turns the direction of a line
_CONTROL: Final = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
# of a message; both of its ends say more than the middle
_LONGEST: Final = 1_200
_END: Final = 300


def printable(text: str) -> str:
    """Write control characters, and what no text may hold, as escapes: a terminal shows them and obeys none."""
    shown = _CONTROL.sub(_escaped, text)
    return shown.encode("utf-8", "backslashreplace").decode("utf-8")


def _escaped(found: re.Match[str]) -> str:
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}"


def message(text: str) -> str:
    """Make an error's text `printable`, and shorten it in its middle."""
    shown = printable(text)
    return shown if len(shown) <= _LONGEST else f"{shown[: _LONGEST - _END]} ... {shown[-_END:]}"


_PACKAGES: Final = ("/pop_fast/", "/pop_ref/", "/cuda_ext/")


def describe(error: BaseException) -> str | None:
    """Say in one line what the user can do about an error, or None when it is a fault of the program.

    A `ValueError` or `NotImplementedError` counts as the user's when the package itself raised it, because then its
    message names field and fix; one that escapes from a library below is a fault, and keeps its traceback.
    """
    if isinstance(error, OSError):
        return _describe_os_error(error)
    if isinstance(error, MemoryError) or "not enough memory" in str(error) or "can't allocate memory" in str(error):
        return "out of memory; use smaller images (--factor 2 or more) or fewer Gaussians"
    if isinstance(error, RuntimeError) and "can't start new thread" in str(error):
        return "the system allows no further thread; raise the limit (ulimit -u), or use fewer: --threads 1"
    if isinstance(error, ValueError | NotImplementedError) and _raised_here(error):
        return re.sub(r"\s*\n\s*", " ", str(error))
    return None


def _describe_os_error(error: OSError) -> str | None:
    where = f"{error.filename}: " if error.filename else ""
    match error.errno:
        case errno.ENOSPC | errno.EDQUOT:
            return f"{where}the disk is full; free some space or write elsewhere with --out"
        case errno.EACCES | errno.EPERM | errno.EROFS:
            return f"{where}permission denied; change its owner or mode, or write elsewhere with --out"
        case errno.ENOENT:
            return f"{where}no such file or folder"
        case errno.EISDIR:
            return f"{where}is a folder where a file is needed"
        case errno.ENOTDIR | errno.EEXIST:
            return f"{where}a file is in the way where a folder is needed"
        case None:
            return None
        case _:
            return f"{where}{error.strerror}"


def _raised_here(error: BaseException) -> bool:
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and any(package in frames[-1].filename.replace("\\", "/") for package in _PACKAGES)
