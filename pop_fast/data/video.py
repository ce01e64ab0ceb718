"""Take photographs out of a video: the sharpest frame of every stretch of time, none twice of a camera at rest.

The video is cut into as many stretches of equal length as frames are wanted. Of each stretch the sharpest frame is
taken, at least half a stretch after the one before; where it looks like the one before, none is. One pass over the
video decides and writes, so that no more than one frame is held.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from pop_fast.data.capture import Progress
from pop_fast.data.photo_quality import look_the_same, sharpness, thumbnail
from pop_fast.errors import CaptureError, PopError
from pop_fast.io.atomic import folder_atomically
from pop_fast.io.budget import PICTURE, check_memory
from pop_fast.io.images import SILENT, set_log_level

__all__ = ["Taken", "take_frames"]

_CONVERT: Final = "convert it, for example to MP4 with H.264"
_JPEG_QUALITY: Final = 97


@dataclass(frozen=True)
class Taken:
    """What was taken out of a video.

    Attributes:
        folder: holds the photographs.
        frames: their numbers in the video, from 0.
        of: frames that the video has.
        alike: stretches without a photograph, because nothing had moved.
    """

    folder: Path
    frames: tuple[int, ...]
    of: int
    alike: int


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
        raise CaptureError(f"{path}: has {total} frame(s); a scene needs two or more")
    stretch = max(total / count, 1.0)
    pattern = f"{path.stem}_"
    taken: list[int] = []
    alike = 0
    last: np.ndarray | None = None
    with folder_atomically(out, overwrite, keeps=[path], recognise=lambda file: _is_ours(file, pattern)) as folder:
        for best in _sharpest(path, total, stretch, progress):
            thumb = thumbnail(cv2.cvtColor(best.image, cv2.COLOR_BGR2GRAY))
            if last is not None and look_the_same(thumb, last[None])[0]:
                alike += 1
                continue
            last = thumb
            _write(folder / f"{pattern}{best.number:06d}.jpg", best.image, max_size)
            taken.append(best.number)
        if len(taken) < 2:
            raise CaptureError(f"{path}: nothing moves in it; walk around the subject with the camera")
    return Taken(out, tuple(taken), total, alike)


def _is_ours(file: Path, pattern: str) -> bool:
    return file.suffix == ".jpg" and file.name.startswith(pattern) and file.stem[len(pattern) :].isdigit()


def _open(path: Path) -> Any:
    if not path.is_file():
        raise CaptureError(f"{path}: no such file; give a video")
    # ffmpeg's own words about a damaged file; what matters is raised as one line
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = set_log_level(SILENT)
    try:
        video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    finally:
        set_log_level(level)
    if not video.isOpened():
        raise CaptureError(f"{path}: is no video that OpenCV can read; {_CONVERT}")
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
    """Count by the file's header, or one by one where that tells nothing."""
    video = _open(path)
    try:
        n_frames = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        if n_frames > 0:
            return n_frames
        counted = 0
        while video.grab():
            counted += 1
        return counted
    finally:
        video.release()


def _sharpest(path: Path, total: int, stretch: float, progress: Progress | None) -> Iterator[_Candidate]:
    """Give the sharpest frame of every stretch, in order, half a stretch or more apart."""
    video = _open(path)
    best: _Candidate | None = None
    earliest, end = 0.0, stretch
    try:
        for number in range(total):
            found, image = video.read()
            if not found:
                break
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
