"""Video through OpenCV's own encoder, so that no program outside the package is needed."""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import Final

import cv2
import numpy as np

from pop_fast.errors import PopError

# vp9 first: the wheels of opencv carry its encoder and browsers play it; mpeg-4 part 2 where a build lacks vp9
_CODECS: Final = {".mp4": ("vp09", "mp4v"), ".webm": ("VP90",), ".avi": ("MJPG",)}


class VideoFile:
    """A video under construction: frames go to a hidden file beside `path`, which appears when the block ends well.

    Example:
        with VideoFile(Path("path.mp4"), fps=30) as video:
            video.add(frame)  # uint8 [H, W, 3], RGB
    """

    def __init__(self, path: Path, fps: float = 30.0) -> None:
        if path.suffix.lower() not in _CODECS:
            raise PopError(f"{path}: the video's name must end in {', '.join(_CODECS)}")
        self.path = path
        self.fps = fps
        self._part = path.with_name(f".{path.stem}.part{path.suffix.lower()}")
        self._writer: cv2.VideoWriter | None = None
        self._size: tuple[int, int] | None = None

    def __enter__(self) -> VideoFile:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        return self

    def add(self, frame: np.ndarray) -> None:
        """Append one frame, uint8 RGB [H, W, 3]; an odd last row or column is dropped, as encoders want even sizes."""
        height, width = frame.shape[0] // 2 * 2, frame.shape[1] // 2 * 2
        if self._writer is None:
            self._size = (width, height)
            self._writer = self._open(self._size)
        if (width, height) != self._size:
            raise ValueError(f"frame is {width} x {height}; the first one was {self._size}")
        self._writer.write(np.ascontiguousarray(frame[:height, :width, ::-1]))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.release()
        if kind is None and self._part.exists():
            os.replace(self._part, self.path)
        else:
            self._part.unlink(missing_ok=True)

    def _open(self, size: tuple[int, int]) -> cv2.VideoWriter:
        for codec in _CODECS[self.path.suffix.lower()]:
            writer = cv2.VideoWriter(str(self._part), cv2.VideoWriter.fourcc(*codec), self.fps, size)
            if writer.isOpened():
                return writer
        raise PopError(f"{self.path}: this build of OpenCV has no encoder for {self.path.suffix}; try another ending")
