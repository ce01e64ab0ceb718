"""Make a folder of photographs of what is none: the frames of a video, what a ZIP archive holds.

The folder is next to the file, and a later call finds it there, with the cameras that were found in it.

A video is cut into as many stretches of equal length as frames are wanted. Of each stretch the sharpest frame is
taken, at least half a stretch after the one before; where it looks like the one before, none is. One pass over the
video decides and writes, so that no more than one frame is held.
"""

from __future__ import annotations

import errno
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

import cv2
import numpy as np

from pop_fast.data.capture import Progress
from pop_fast.data.photo_quality import look_the_same, sharpness, thumbnail
from pop_fast.errors import CaptureError, PopError
from pop_fast.io.atomic import folder_atomically
from pop_fast.io.images import QUIET, VIDEO_SUFFIXES, named_for_opencv
from pop_fast.io.read_back import PICTURE, check_members, check_memory

_FIX = "unpack it yourself, and give the folder"
# what the system says of a member's name that cannot be a file's
_NAMES = (errno.ENAMETOOLONG, errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.EINVAL, errno.EILSEQ)
# next to the photographs of an archive, what other systems have put there
_LEFT_OUT = ("__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini")
# words about a capture that lie beside its folder
_ABOUT = ("readme", "license", "licence")


def capture_folder(path: Path, progress: Progress | None = None) -> tuple[Path, str | None]:
    """Return the folder with the photographs of a video or a ZIP archive, made where it is absent; a folder is itself.

    Anything else is returned, for the reader to refuse.

    Returns:
        The folder, and a line that says what was made of the file; None where it is a folder.

    Raises:
        CaptureError: the file is damaged, or the folder is of an older file of that name.
    """
    if not path.is_file():
        return path, None
    if path.suffix.lower() in VIDEO_SUFFIXES:
        target = frames_folder(path)
        if _made_before(path, target):
            return target, f"{path}: its photographs are in {target} already"
        taken = take_frames(path, target, progress=progress)
        what = f"{len(taken.frames)} of {taken.of:,} frames are taken as photographs, in {target}"
        return target, f"{path}: {what}{taken.lost}"
    # one that was cut short is not known by its end, but by its name
    if zipfile.is_zipfile(path) or path.suffix.lower() == ".zip":
        # next to x.zip, what x.usdz holds has a folder of its own
        target = path.with_name(f"{path.stem if path.suffix.lower() == '.zip' else path.name}_unpacked")
        if not _made_before(path, target):
            unpack(path, target)
        return _inmost(target), f"{path}: unpacked in {target}"
    return path, None


def frames_folder(video: Path) -> Path:
    """Name the folder of a video's frames next to it; by its whole name where another video differs by suffix only.

    Otherwise `walk.mov` would be trained on by the frames of `walk.mp4`.
    """
    beside = (other for other in video.absolute().parent.glob("*") if other.suffix.lower() in VIDEO_SUFFIXES)
    alone = not any(other.stem == video.stem and other.name != video.name for other in beside)
    return video.parent / f"{video.stem if alone else video.name}_frames"


def _made_before(path: Path, target: Path) -> bool:
    """Tell whether the folder is there, and younger than its file."""
    if not target.is_dir() or not any(target.iterdir()):
        return False
    if target.stat().st_mtime < path.stat().st_mtime:
        raise CaptureError(f"{target}: is older than {path}; remove the folder to have it made again")
    return True


def unpack(path: Path, target: Path) -> None:
    """Unpack a ZIP archive into a new folder, whole or not at all.

    Raises:
        CaptureError: it is damaged or locked, has a member that would lie elsewhere, or would not fit.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = [member for member in archive.infolist() if not _left_out(member)]
            check_members(path, archive, path.stat().st_size, _FIX, disk=path.absolute().parent)
            with folder_atomically(target, keeps=[path]) as folder:
                for member in members:
                    place = folder / _inside(path, member)
                    place.parent.mkdir(parents=True, exist_ok=True)
                    with archive.open(member) as source, place.open("wb") as file:
                        shutil.copyfileobj(source, file)
    except PopError as error:
        raise CaptureError(str(error)) from error
    except OSError as error:
        # a full disk is reported as such by the caller; a name that no folder can hold is the archive's
        if error.errno not in _NAMES:
            raise
        raise CaptureError(f"{path}: cannot be unpacked: {error.strerror}; {_FIX}") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        # a RuntimeError asks for a password
        raise CaptureError(f"{path}: cannot be unpacked: {error}; {_FIX}") from error


def _left_out(member: zipfile.ZipInfo) -> bool:
    name = member.filename.replace("\\", "/")
    return name.endswith("/") or any(part in _LEFT_OUT for part in PurePosixPath(name).parts)


def _name(member: zipfile.ZipInfo) -> str:
    """Return a member's name: macOS writes UTF-8 without the flag that says so, and Python reads that as cp437."""
    try:
        return member.filename if member.flag_bits & 0x800 else member.filename.encode("cp437").decode()
    except UnicodeError:
        return member.filename


def _inside(path: Path, member: zipfile.ZipInfo) -> str:
    name = PurePosixPath(_name(member).replace("\\", "/"))
    if not name.parts or name.is_absolute() or ".." in name.parts or ":" in name.parts[0]:
        raise CaptureError(f"{path}: {member.filename!r} would be unpacked outside of its folder; {_FIX}")
    return str(name)


def _inmost(folder: Path) -> Path:
    """Go down to the capture, where an archive holds it in one folder of its own."""
    while True:
        inside = [path for path in folder.iterdir() if path.name[0] != "." and path.stem.lower() not in _ABOUT]
        # a folder of photographs is found in the capture; sparse cameras belong to the folder over them
        if len(inside) != 1 or not inside[0].is_dir() or inside[0].name in ("images", "sparse"):
            return folder
        folder = inside[0]


_CONVERT: Final = "convert it, for example to MP4 with H.264"
_JPEG_QUALITY: Final = 97


@dataclass(frozen=True)
class Taken:
    """What was taken out of a video."""

    folder: Path  # holds the photographs
    frames: tuple[int, ...]  # their numbers in the video, from 0
    of: int  # frames that the video has
    alike: int  # stretches without a photograph, because nothing had moved
    decoded: int  # frames before the first that could not be decoded

    @property
    def lost(self) -> str:
        """Say which frames were not looked at; empty where all were."""
        what = f"; from frame {self.decoded + 1:,} on the video is damaged, and was not read: {_CONVERT}"
        return what if self.decoded < self.of else ""


@dataclass
class _Candidate:
    number: int
    image: np.ndarray
    sharpness: float


def take_frames(
    video: str | Path,
    out_dir: str | Path,
    count: int = 150,
    max_size: int = 0,
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
) -> Taken:
    """Write sharp frames of a video as photographs, whole or not at all.

    Args:
        video: the file, in any format that OpenCV's ffmpeg reads.
        out_dir: folder to make, with `<video>_<frame>.jpg` in it.
        count: how many frames are wanted; fewer where the video has fewer, or where the camera rests.
        max_size: longest side of the photographs, px; 0 leaves them as they are.
        progress: called with (stage, done, total).
        overwrite: replace an existing folder, where it is nothing but an earlier result of this.

    Raises:
        CaptureError: the file is absent or no video, holds fewer than two frames, or a number is out of range.
    """
    path, out = Path(video), Path(out_dir)
    if count < 2:
        raise CaptureError(f"count is {count}; a scene needs two photographs or more")
    if max_size and max_size < 64:
        raise CaptureError(f"max_size is {max_size}; it must be 0, or at least 64 px")
    total = _frame_count(path)
    if total < 2:
        raise CaptureError(f"{path}: has {total} frame{'' if total == 1 else 's'}; a scene needs two or more")
    stretch = max(total / count, 1.0)
    pattern = f"{path.stem}_"
    taken: list[int] = []
    alike = 0
    last: np.ndarray | None = None
    decoded: list[int] = []
    with folder_atomically(out, overwrite, keeps=[path], recognise=lambda file: _is_ours(file, pattern)) as folder:
        for best in _sharpest(path, total, stretch, progress, decoded):
            thumb = thumbnail(cv2.cvtColor(best.image, cv2.COLOR_BGR2GRAY))
            if last is not None and look_the_same(thumb, last[None])[0]:
                alike += 1
                continue
            last = thumb
            _write(folder / f"{pattern}{best.number:06d}.jpg", best.image, max_size)
            taken.append(best.number)
        if len(taken) < 2:
            raise CaptureError(f"{path}: nothing moves in it; walk around the subject with the camera")
    return Taken(out, tuple(taken), total, alike, len(decoded))


def _is_ours(file: Path, pattern: str) -> bool:
    return file.suffix == ".jpg" and file.name.startswith(pattern) and file.stem[len(pattern) :].isdigit()


def _open(path: Path, *settings: int) -> Any:
    if not path.is_file():
        raise CaptureError(f"{path}: no such file; give a video")
    with QUIET, named_for_opencv(path) as name:
        video = cv2.VideoCapture(name, cv2.CAP_FFMPEG, settings)
    if not video.isOpened():
        raise CaptureError(f"{path}: is not a video that OpenCV can read; {_CONVERT}")
    width, height = (int(video.get(size)) for size in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    try:
        # as it is decoded, as it is handed over, and the sharpest so far
        check_memory(
            path, 9 * width * height, path.stat().st_size, f"its frames of {width}x{height} px", _CONVERT, PICTURE
        )
    except PopError as error:
        video.release()
        raise CaptureError(str(error)) from error
    return video


def _frame_count(path: Path) -> int:
    """Count the frames that are there: the header of a file that was cut short or trimmed still states them all."""
    # undecoded, which takes no time, where OpenCV can hand them over so
    packets, stated = _count(path, cv2.CAP_PROP_FORMAT, -1)
    # of a video that a telephone has trimmed, decoding starts and ends with frames that are not shown
    return packets if packets >= stated and packets else _count(path, tries=packets)[0]


def _count(path: Path, *settings: int, tries: int = 0) -> tuple[int, int]:
    """Count frames, and return how many the header states; after one that fails others follow, in so many tries."""
    video = _open(path, *settings)
    try:
        counted = 0
        while video.grab():
            counted += 1
        counted += sum(video.grab() for _ in range(tries - counted))
        return counted, int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    finally:
        video.release()


def _sharpest(
    path: Path, total: int, stretch: float, progress: Progress | None, decoded: list[int]
) -> Iterator[_Candidate]:
    """Give the sharpest frame of every stretch, in order, half a stretch or more apart.

    What follows a damaged frame would show it too, up to a frame that does not build on others, and is not read.
    """
    video = _open(path)
    best: _Candidate | None = None
    earliest, end = 0.0, stretch
    try:
        for number in range(total):
            found, image = video.read()
            if not found:
                break
            decoded.append(number)
            if progress is not None:
                progress("looking at frames", number + 1, total)
            if number >= end:
                if best is not None:
                    yield best
                    earliest = best.number + 0.5 * stretch
                best, end = None, end + stretch
            if number >= earliest:
                value = sharpness(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
                if best is None or value > best.sharpness:
                    best = _Candidate(number, image, value)
        if best is not None:
            yield best
    finally:
        video.release()


def _write(path: Path, image: np.ndarray, max_size: int) -> None:
    scale = max_size / max(image.shape[:2]) if max_size else 1.0
    if scale < 1.0:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    path.write_bytes(data.tobytes())
