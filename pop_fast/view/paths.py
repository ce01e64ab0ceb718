"""Camera paths made from the cameras of a capture (NumPy float64, viewmats in, viewmats out), and videos along them.

Every path is closed (its last camera leads back to its first) except those that run once through the given cameras:
`interpolate`, and `orbit` of cameras that look at no one point. Frames: world -> camera, OpenCV axes (+x right, +y
down, +z forward), as everywhere in the package. Videos are written by OpenCV's own encoder, so that no program outside
the package is needed.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from pop_fast.data.capture import camera_centers, focus_point, look_at_one_point
from pop_fast.errors import PopError
from pop_fast.io.atomic import file_atomically
from pop_fast.io.images import QUIET, named_for_opencv

# an orbit keeps out of a gap between cameras that is as wide as this and so many times wider than any other
_WIDE_GAP: Final = np.pi / 2.0
_STANDS_OUT: Final = 1.5
_LEAST_SWAY: Final = np.radians(5.0)  # to either side of a single camera
# frames between two cameras that a path passes through: with fewer it would follow every shake of a hand
_GLIDE: Final = 3
_SWAY: Final = 0.9  # the percentile that the ellipse keeps of the cameras' spread, so that one outlier does not set it


def orbit(viewmats: np.ndarray, n_frames: int) -> np.ndarray:
    """Turn about the point the cameras look at, at their median distance and height, as far round as cameras stand.

    Where they stand all round it is a full circle. Else it goes from the middle of their arc to one end, to the other
    and back, so that nothing is shown from where no photograph was taken. Cameras that look at no one point, as on a
    walk or in a room, have nothing to turn about: the path then glides through them, from the first to the last.
    """
    if not look_at_one_point(viewmats):
        passed = np.linspace(0, len(viewmats) - 1, min(len(viewmats), max(2, n_frames // _GLIDE)))
        return interpolate(viewmats[np.round(passed).astype(int)], n_frames)
    up, focus = mean_up(viewmats), focus_point(viewmats)
    offsets = camera_centers(viewmats) - focus
    heights = offsets @ up
    radius = float(np.median(np.linalg.norm(offsets - heights[:, None] * up, axis=1)))
    a, b = _plane_axes(up, offsets)
    turn = np.linspace(0.0, 2.0 * np.pi, n_frames, endpoint=False)
    arc = camera_arc(np.arctan2(offsets @ b, offsets @ a))
    angle = (turn if arc is None else arc[0] + arc[1] * np.sin(turn))[:, None]
    centers = focus + radius * (np.cos(angle) * a + np.sin(angle) * b) + float(np.median(heights)) * up
    return look_at(centers, focus, up)


def camera_arc(angles: np.ndarray) -> tuple[float, float] | None:
    """Find the arc that cameras stand on by their angles, radians: the circle without its largest gap.

    Its middle and half its width, radians; None where no gap stands out, for a full circle.
    """
    around = np.sort(np.mod(angles, 2.0 * np.pi))
    gaps = np.diff(around, append=around[0] + 2.0 * np.pi)
    widest = int(np.argmax(gaps))
    others = np.delete(gaps, widest)
    if gaps[widest] < _WIDE_GAP or (len(others) and gaps[widest] < _STANDS_OUT * others.max()):
        return None
    half = (2.0 * np.pi - gaps[widest]) / 2.0
    start = around[(widest + 1) % len(around)]
    return float(start + half), float(max(half, _LEAST_SWAY))


def ellipse(viewmats: np.ndarray, n_frames: int) -> np.ndarray:
    """Circle on the ellipse that the cameras themselves spread over, rising and sinking once a turn."""
    up, focus = mean_up(viewmats), focus_point(viewmats)
    offsets = camera_centers(viewmats) - focus
    flat = offsets - (offsets @ up)[:, None] * up
    axes = np.linalg.svd(flat, full_matrices=False)[2][:2]
    a, b = axes[0], np.cross(up, axes[0])
    half = np.quantile(np.abs(np.stack([flat @ a, flat @ b])), _SWAY, axis=1)
    low, high = np.quantile(offsets @ up, [1.0 - _SWAY, _SWAY])
    fine = np.linspace(0.0, 2.0 * np.pi, 1025)
    steps = np.hypot(half[0] * np.diff(np.cos(fine)), half[1] * np.diff(np.sin(fine)))
    length = np.concatenate([[0.0], np.cumsum(steps)])
    turn = np.interp(np.linspace(0.0, length[-1], n_frames, endpoint=False), length, fine)[:, None]
    height = (low + high) / 2.0 + (high - low) / 2.0 * np.sin(turn)
    return look_at(focus + half[0] * np.cos(turn) * a + half[1] * np.sin(turn) * b + height * up, focus, up)


def interpolate(viewmats: np.ndarray, n_frames: int) -> np.ndarray:
    """Glide through two or more cameras, from the first to the last: cubic splines through centres and rotations."""
    if len(viewmats) < 2:
        raise ValueError(f"viewmats has {len(viewmats)} cameras; a path through them needs at least 2")
    knots = np.arange(len(viewmats), dtype=np.float64)
    at = np.linspace(0.0, knots[-1], n_frames)
    centers = CubicSpline(knots, camera_centers(viewmats))(at)
    rotations = RotationSpline(knots, Rotation.from_matrix(viewmats[:, :3, :3]))(at).as_matrix()
    return _viewmats(rotations, centers)


# of cameras of a capture [M, 4, 4], in the order of their names, so many on a path; world -> camera
PATHS: Final[dict[str, Callable[[np.ndarray, int], np.ndarray]]] = {
    "orbit": orbit,
    "ellipse": ellipse,
    "interpolate": interpolate,
}


def camera_path(name: str, viewmats: np.ndarray, n_frames: int) -> np.ndarray:
    """Make the path called `name`: one of `PATHS`. [n_frames, 4, 4]"""
    if name not in PATHS:
        raise ValueError(f"path is '{name}'; it must be one of {', '.join(PATHS)}")
    if n_frames < 1:
        raise ValueError(f"n_frames is {n_frames}; it must be >= 1")
    return PATHS[name](np.asarray(viewmats, dtype=np.float64), n_frames)


def mean_up(viewmats: np.ndarray) -> np.ndarray:
    """Give the direction that is up on average: minus the cameras' y axes, unit length. [3]"""
    up = -viewmats[:, 1, :3].mean(axis=0)
    norm = float(np.linalg.norm(up))
    return up / norm if norm > 1e-9 else -viewmats[0, 1, :3]


def look_at(centers: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Place cameras at `centers` that look at `target` with `up` upwards in the picture. [n, 4, 4]"""
    forward = target - centers
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right, axis=1, keepdims=True)
    rotations = np.stack([right, np.cross(forward, right), forward], axis=1)
    return _viewmats(rotations, centers)


def _viewmats(rotations: np.ndarray, centers: np.ndarray) -> np.ndarray:
    viewmats = np.tile(np.eye(4), (len(centers), 1, 1))
    viewmats[:, :3, :3] = rotations
    viewmats[:, :3, 3] = -np.einsum("mij,mj->mi", rotations, centers)
    return viewmats


def _plane_axes(up: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    first = offsets[0] - (offsets[0] @ up) * up
    if np.linalg.norm(first) < 1e-9:
        first = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    a = first / np.linalg.norm(first)
    return a, np.cross(up, a)


# what players expect behind each ending: H.264, VP9, Motion JPEG
_CODECS: Final = {".webm": "VP90", ".mp4": "avc1", ".avi": "MJPG"}
# frames a second that all of these containers can store; beyond them encoders fail, round to another rate, or hang
_FPS: Final = (0.5, 600.0)


class VideoFile:
    """A video under construction: frames go to a hidden file next to `path`, which appears when the block ends well.

    Args:
        path: the file to make or to replace: .webm (VP9), .avi (Motion JPEG), or .mp4 (H.264), for which the wheels of
            OpenCV have no encoder; missing parent folders are made.
        fps: frames a second, from 0.5 to 600.

    Raises:
        PopError: at once, for a name or a rate that no video can have; when frames are added, for one of another size;
            when the block ends, for a file that does not play to its last frame. `path` is then as it was.
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
        self._steps.enter_context(QUIET)
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

    def __exit__(self, *error: Any) -> bool | None:
        return self._steps.__exit__(*error)

    def _finish(self, kind: type[BaseException] | None, *_: object) -> None:
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
        with _no_standard_error(), named_for_opencv(self._part) as name:
            writer = cv2.VideoWriter(name, cv2.VideoWriter.fourcc(*codec), self.fps, size)
        if writer.isOpened():
            return writer
        # an encoder that cannot write fails in the same way: this raises where the disk is at fault
        self._part.write_bytes(bytes(4096))
        raise PopError(f"{self.path}: this build of OpenCV has no encoder for {self.path.suffix}; try another ending")


@cache
def has_h264() -> bool:
    """Tell whether this build of OpenCV can write H.264, by writing a frame."""
    with tempfile.TemporaryDirectory(prefix="pop_video_") as folder, QUIET:
        code = cv2.VideoWriter.fourcc(*_CODECS[".mp4"])
        writer = cv2.VideoWriter(str(Path(folder, "probe.mp4")), code, 30.0, (64, 64))
        works = writer.isOpened()
        writer.release()
        return works


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
    with named_for_opencv(path) as name:
        video = cv2.VideoCapture(name, reader)
    try:
        count = 0
        while video.read()[0]:
            count += 1
        return count
    finally:
        video.release()


def _pixels(frame: np.ndarray) -> str:
    return f"{frame.shape[1]} x {frame.shape[0]} px"
