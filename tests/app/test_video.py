"""Photographs out of a video: sharp ones, spread over its time, and none of a camera at rest."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pop_fast.data import load_capture
from pop_fast.data.photo_quality import sharpness
from pop_fast.data.video import take_frames
from pop_fast.errors import CaptureError, PopError
from pop_fast.io.images import list_images, read_image
from pop_fast.view.paths import VideoFile
from tests.app.conftest import Pop

# of every five frames these are sharp; two stretches of ten in the middle show the same
SHARP = (2, 4)
RESTING = range(30, 50)


def frame(number: int) -> np.ndarray:
    """A window that wanders over a texture; blurred unless the camera is held still for it."""
    coarse = np.random.default_rng(3).integers(0, 256, (24, 60, 3)).astype(np.uint8)
    texture = cv2.resize(coarse, (480, 192), interpolation=cv2.INTER_CUBIC)
    at = RESTING.start if number in RESTING else number
    window = np.ascontiguousarray(texture[20 : 20 + 96, 4 * at : 4 * at + 128])
    return window if number % 5 in SHARP else cv2.GaussianBlur(window, (0, 0), 3.0)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "walk.avi"
    with VideoFile(path, fps=30.0) as video:
        for number in range(80):
            video.add(frame(number))
    return path


def test_every_stretch_gives_a_sharp_frame_and_a_rest_gives_one(clip: Path, tmp_path: Path) -> None:
    taken = take_frames(clip, tmp_path / "out", count=8)
    assert taken.of == 80
    assert len(taken.frames) + taken.alike == 8
    assert all(number % 5 in SHARP for number in taken.frames)
    assert all(later - earlier >= 5 for earlier, later in zip(taken.frames, taken.frames[1:], strict=False))
    assert sum(number in RESTING for number in taken.frames) == 1
    assert taken.alike == 1
    names = [path.name for path in list_images(tmp_path / "out")]
    assert names == [f"walk_{number:06d}.jpg" for number in taken.frames]
    image = read_image(tmp_path / "out" / names[0])
    assert np.abs(image.astype(int) - frame(taken.frames[0])).mean() < 6.0


def test_sharpness_is_that_of_the_picture_shrunk_and_falls_with_blur() -> None:
    sharp, soft = (cv2.cvtColor(frame(number), cv2.COLOR_RGB2GRAY) for number in (2, 3))
    assert sharpness(sharp) > 4.0 * sharpness(soft)
    large = np.kron(sharp, np.ones((8, 8), np.uint8))
    assert sharpness(large) == pytest.approx(sharpness(cv2.resize(large, (512, 384), interpolation=cv2.INTER_AREA)))


def test_more_frames_than_there_are_give_all_that_differ(clip: Path, tmp_path: Path) -> None:
    taken = take_frames(clip, tmp_path / "out", count=1000)
    assert len(taken.frames) + taken.alike == 80
    assert len(taken.frames) >= 55


def test_photographs_can_be_made_smaller(clip: Path, tmp_path: Path) -> None:
    take_frames(clip, tmp_path / "out", count=4, max_size=64)
    assert {read_image(path).shape for path in list_images(tmp_path / "out")} == {(48, 64, 3)}


def test_the_command_writes_beside_the_video_and_says_what_comes_next(clip: Path, tmp_path: Path, pop: Pop) -> None:
    video = tmp_path / "walk.avi"
    video.write_bytes(clip.read_bytes())
    done = pop("frames", video, "--count", "6")
    folder = tmp_path / "walk_frames"
    assert done.status == 0
    assert done.out.splitlines()[-1] == f"next: pop train {folder}"
    assert "of 80 frames" in done.out
    again = pop("frames", video, "--count", "4")
    assert again.status == 2
    assert str(folder) in again.err
    assert pop("frames", video, "--count", "4", "--overwrite").status == 0
    assert len(list_images(folder)) <= 4
    (folder / "mine.jpg").write_bytes(b"mine")
    assert pop("frames", video, "--overwrite").status == 2
    assert (folder / "mine.jpg").read_bytes() == b"mine"


def test_what_is_no_video_is_one_line_and_leaves_nothing(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.avi").write_bytes(clip.read_bytes()[:2000])
    (tmp_path / "text.mp4").write_text("no video")
    with VideoFile(tmp_path / "still.avi", fps=10.0) as video:
        for _ in range(12):
            video.add(frame(2))
    out = tmp_path / "out"
    for name, message in (
        ("absent.mp4", "no such file"),
        ("text.mp4", "is no video that OpenCV can read"),
        ("still.avi", "nothing moves in it"),
    ):
        with pytest.raises(CaptureError, match=message) as error:
            take_frames(tmp_path / name, out, count=4)
        assert str(tmp_path / name) in str(error.value)
        assert not out.exists()
    with pytest.raises(CaptureError, match=r"cut\.avi"):
        take_frames(tmp_path / "cut.avi", out, count=4)
    for wrong, message in (({"count": 1}, "count is 1"), ({"max_size": 8}, "max_size is 8")):
        with pytest.raises(PopError, match=message):
            take_frames(clip, out, **wrong)


def test_training_on_a_video_says_how_to_take_photographs_out_of_it(clip: Path) -> None:
    with pytest.raises(CaptureError, match=r"walk\.avi: is a video; .* pop frames"):
        load_capture(clip)
