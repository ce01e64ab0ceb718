"""Make a folder of photographs of what is none: the frames of a video, what a ZIP archive holds.

The folder lies beside the file, and a later call finds it there, with the cameras that were found in it.
"""

from __future__ import annotations

import errno
import shutil
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from pop_fast.data.capture import Progress
from pop_fast.data.video import take_frames
from pop_fast.errors import CaptureError
from pop_fast.io.atomic import folder_atomically
from pop_fast.io.budget import check_members
from pop_fast.io.images import VIDEO_SUFFIXES

_FIX = "unpack it yourself, and give the folder"
# what the system says of a member's name that cannot be a file's
_NAMES = (errno.ENAMETOOLONG, errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.EINVAL, errno.EILSEQ)
# beside the photographs of an archive, what other systems have put there
_LEFT_OUT = ("__MACOSX", ".DS_Store", "Thumbs.db")


def capture_folder(path: Path, progress: Progress | None = None) -> tuple[Path, str | None]:
    """Return the folder with the photographs of a file, made where it is not there; a folder is itself.

    Args:
        path: a folder, a video, a ZIP archive; of anything else it is returned, for the reader to refuse.
        progress: called with (stage, done, total).

    Returns:
        The folder, and a line that says what was made of the file; None where it is a folder.

    Raises:
        CaptureError: the file is damaged, or the folder is of an older file of that name.
    """
    if not path.is_file():
        return path, None
    if path.suffix.lower() in VIDEO_SUFFIXES:
        target = path.with_name(f"{path.stem}_frames")
        if _made_before(path, target):
            return target, f"{path}: its photographs are in {target} already"
        taken = take_frames(path, target, progress=progress)
        return target, f"{path}: {len(taken.frames)} of {taken.of:,} frames are taken as photographs, in {target}"
    # one that was cut short is not known by its end, but by its name
    if zipfile.is_zipfile(path) or path.suffix.lower() == ".zip":
        target = path.with_name(f"{path.stem}_unpacked")
        if not _made_before(path, target):
            unpack(path, target)
        return _inmost(target), f"{path}: unpacked in {target}"
    return path, None


def _made_before(path: Path, target: Path) -> bool:
    """Tell whether the folder is there, and younger than its file."""
    if not target.is_dir() or not any(target.iterdir()):
        return False
    if target.stat().st_mtime < path.stat().st_mtime:
        raise CaptureError(f"{target}: is older than {path}; remove the folder, and it is made again")
    return True


def unpack(path: Path, target: Path) -> None:
    """Unpack a ZIP archive, whole or not at all.

    Args:
        path: the archive.
        target: the folder to make.

    Raises:
        CaptureError: it is damaged or locked, has a member that would lie elsewhere, or would not fit.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = [member for member in archive.infolist() if not _left_out(member)]
            check_members(path, archive, path.stat().st_size, _FIX)
            with folder_atomically(target, keeps=[path]) as folder:
                for member in members:
                    place = folder / _inside(path, member)
                    place.parent.mkdir(parents=True, exist_ok=True)
                    with archive.open(member) as source, place.open("wb") as file:
                        shutil.copyfileobj(source, file)
    except OSError as error:
        # a full disk is reported as such by the caller; a name that no folder can hold is the archive's
        if error.errno not in _NAMES:
            raise
        raise CaptureError(f"{path}: cannot be unpacked: {error.strerror}; {_FIX}") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        # a RuntimeError asks for a password
        raise CaptureError(f"{path}: cannot be unpacked: {error}; {_FIX}") from error


def _left_out(member: zipfile.ZipInfo) -> bool:
    if not member.filename:
        return False
    return member.is_dir() or any(part in _LEFT_OUT for part in PurePosixPath(member.filename).parts)


def _inside(path: Path, member: zipfile.ZipInfo) -> str:
    name = PurePosixPath(member.filename.replace("\\", "/"))
    if not name.parts or name.is_absolute() or ".." in name.parts or ":" in name.parts[0]:
        raise CaptureError(f"{path}: {member.filename!r} would be unpacked outside of its folder; {_FIX}")
    return str(name)


def _inmost(folder: Path) -> Path:
    """Go down to the capture, where an archive holds it in one folder of its own."""
    while True:
        inside = [path for path in folder.iterdir() if not path.name.startswith(".")]
        # a folder of photographs is found in the capture; sparse cameras belong to the folder over them
        if len(inside) != 1 or not inside[0].is_dir() or inside[0].name in ("images", "sparse"):
            return folder
        folder = inside[0]
