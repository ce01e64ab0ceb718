"""Video through OpenCV's own encoder, so that no program outside the package is needed."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Final

import cv2
import numpy as np

from pop_fast.errors import PopError
from pop_fast.io.atomic import file_atomically

# what players expect behind each ending: H.264, VP9, Motion JPEG
_CODECS: Final = {".webm": "VP90", ".mp4": "avc1", ".avi": "MJPG"}
# frames a second that all of these containers can store; beyond them encoders fail, round to another rate, or hang
_FPS: Final = (0.5, 600.0)


class VideoFile:
    """A video under construction: frames go to a hidden file beside `path`, which appears when the block ends well.

    Args:
        path: the file to make or to replace: .webm (VP9), .avi (Motion JPEG), or .mp4 (H.264), for which the wheels of
            OpenCV have no encoder; missing parent folders are made.
        fps: frames a second, from 0.5 to 600.

    Raises:
        PopError: at once, for a name or a rate that no video can have; when frames are added, for one of another size;
            when the block ends, for a file that does not play to its last frame. `path` is then as it was.

    Example:
        with VideoFile(Path("path.webm"), fps=30) as video:
            video.add(frame)  # uint8 [H, W, 3], RGB
    """

    def __init__(self, path: Path, fps: float = 30.0) -> None:
        if path.suffix.lower() not in _CODECS:
            raise PopError(f"{path}: the video's name must end in {', '.join(_CODECS)}")
        if path.is_dir():
            raise PopError(f"{path}: a folder of this name is in the way; give the video another name")
        if not _FPS[0] <= fps <= _FPS[1]:
            raise PopError(f"{path}: fps is {fps}; it must be a number from {_FPS[0]:g} to {_FPS[1]:g}, such as 30")
        if path.suffix.lower() == ".mp4" and not has_h264():
            raise PopError(
                f"{path}: this build of OpenCV cannot write H.264, which players expect in .mp4; name it "
                f"{path.with_suffix('.webm').name}, which browsers, VLC and ffmpeg play, or turn that into .mp4 with "
                f"ffmpeg -i {path.with_suffix('.webm').name} {path.name}"
            )
        self.path = path
        self.fps = fps
        self._count = 0
        self._steps = ExitStack()
        self._part = path
        self._writer: cv2.VideoWriter | None = None
        self._size: tuple[int, int] | None = None

    def __enter__(self) -> VideoFile:
        self._part = self._steps.enter_context(file_atomically(self.path))
        self._steps.enter_context(_quiet())
        self._steps.push(self._finish)
        return self

    def add(self, frame: np.ndarray) -> None:
        """Append one frame, uint8 RGB [H, W, 3]; an odd last row or column is dropped, as encoders want even sizes."""
        size = (frame.shape[1] // 2 * 2, frame.shape[0] // 2 * 2)
        if self._writer is None or self._size is None:
            if min(size) == 0:
                raise PopError(f"{self.path}: frames are {_pixels(frame)}; a video needs 2 x 2 or more")
            self._size = size
            self._writer = self._open(size)
        if size != self._size:
            first = f"{self._size[0]} x {self._size[1]} px"
            raise PopError(
                f"{self.path}: frame {self._count} is {_pixels(frame)}, the first was {first}; a video has one size: "
                "use views of one size, or make a video of each"
            )
        self._writer.write(np.ascontiguousarray(frame[: size[1], : size[0], ::-1]))
        self._count += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        return self._steps.__exit__(kind, error, trace)

    def _finish(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.release()
        if kind is not None:
            return
        if self._count == 0:
            raise PopError(f"{self.path}: no frame was added; a video needs one or more")
        # the encoder reports no failed write, neither of a frame nor of the index at the end
        whole = frames_in(self._part)
        if whole != self._count:
            raise PopError(
                f"{self.path}: only {whole} of {self._count} frames could be read back after writing; the disk may be "
                "full: free some space, or choose another folder for the video"
            )

    def _open(self, size: tuple[int, int]) -> cv2.VideoWriter:
        codec = _CODECS[self.path.suffix.lower()]
        with _no_standard_error():
            writer = cv2.VideoWriter(str(self._part), cv2.VideoWriter.fourcc(*codec), self.fps, size)
        if writer.isOpened():
            return writer
        # an encoder that cannot write fails in the same way: this raises where the disk is at fault
        self._part.write_bytes(bytes(4096))
        raise PopError(f"{self.path}: this build of OpenCV has no encoder for {self.path.suffix}; try another ending")


@cache
def has_h264() -> bool:
    """Tell whether this build of OpenCV can write H.264, by writing a frame."""
    with tempfile.TemporaryDirectory(prefix="pop_video_") as folder, _quiet():
        code = cv2.VideoWriter.fourcc(*_CODECS[".mp4"])
        writer = cv2.VideoWriter(str(Path(folder, "probe.mp4")), code, 30.0, (64, 64))
        works = writer.isOpened()
        writer.release()
        return works


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the log of OpenCV and ffmpeg off the terminal: what goes wrong is found by playing the file, and raised."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


@contextmanager
def _no_standard_error() -> Iterator[None]:
    """Close standard error to libraries: OpenCV prints there, past its log, that it chose the tag of WebM itself."""
    sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:  # there is none
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def frames_in(path: Path) -> int:
    """Play a video from its start and count the frames that can be decoded; 0 for what is no video."""
    # of a damaged file the other readers print bytes to the terminal
    reader = cv2.CAP_FFMPEG if cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG) else cv2.CAP_ANY
    video = cv2.VideoCapture(str(path), reader)
    try:
        count = 0
        while video.read()[0]:
            count += 1
        return count
    finally:
        video.release()


def _pixels(frame: np.ndarray) -> str:
    return f"{frame.shape[1]} x {frame.shape[0]} px"
