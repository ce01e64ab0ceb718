"""`pop render`: held-out views and camera paths, as pictures and as video."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.app.conftest import Pop


def read(path: Path) -> np.ndarray:
    return cv2.imread(str(path))[:, :, ::-1]


def test_held_out_views_are_rendered_to_the_same_bytes_as_in_training(
    pop: Pop, shared_result: Path, tmp_path: Path
) -> None:
    outcome = pop("render", shared_result, "--out", tmp_path / "views")
    assert outcome.status == 0, outcome.err
    assert "1 views of toy" in outcome.out
    assert [path.name for path in (tmp_path / "views").iterdir()] == ["view_000.png"]
    kept = np.load(shared_result / "report_data" / "val_step29_0000.npz")
    np.testing.assert_array_equal(read(tmp_path / "views" / "view_000.png"), kept["render"])


@pytest.mark.parametrize("path", ["orbit", "ellipse", "interpolate"])
def test_a_path_gives_as_many_pictures_and_frames_as_asked(
    pop: Pop, shared_result: Path, tmp_path: Path, path: str
) -> None:
    words = ["--path", path, "--frames", "3", "--out", tmp_path / "frames", "--video", tmp_path / "clip.mp4"]
    outcome = pop("render", shared_result, *words)
    assert outcome.status == 0, outcome.err
    pictures = sorted((tmp_path / "frames").iterdir())
    assert [p.name for p in pictures] == [f"{path}_{i:04d}.png" for i in range(3)]
    assert all(read(p).shape == (32, 40, 3) for p in pictures)
    assert len({p.read_bytes() for p in pictures}) == 3
    video = cv2.VideoCapture(str(tmp_path / "clip.mp4"))
    assert [video.read()[0] for _ in range(4)] == [True, True, True, False]


def test_a_video_alone_leaves_no_pictures(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    assert pop("render", shared_result, "--video", tmp_path / "clip.webm").status == 0
    assert [p.name for p in tmp_path.iterdir()] == ["clip.webm"]


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ([], "give --out DIR for pictures, --video FILE"),
        (["--video", "clip.gif"], "must end in .mp4, .webm, .avi"),
        (["--out", "r", "--path", "orbit", "--frames", "0"], "n_frames is 0"),
        (["--out", "r", "--test-every", "0"], "holds no view out"),
    ],
    ids=["nothing to write", "unknown video", "no frames", "no held-out views"],
)
def test_what_cannot_be_rendered_is_said_and_nothing_is_written(
    pop: Pop, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], part: str
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = pop("render", shared_result, *words)
    assert outcome.status == 2
    assert part in outcome.err
    assert len(outcome.err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_replaced_only_when_asked(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_text("mine")
    (tmp_path / "views").mkdir()
    (tmp_path / "views" / "notes.txt").write_text("mine")
    assert "--overwrite" in pop("render", shared_result, "--video", tmp_path / "clip.mp4").err
    assert "--overwrite" in pop("render", shared_result, "--out", tmp_path / "views").err
    assert (tmp_path / "clip.mp4").read_text() == (tmp_path / "views" / "notes.txt").read_text() == "mine"
    words = ["--video", tmp_path / "clip.mp4", "--out", tmp_path / "views", "--overwrite"]
    assert pop("render", shared_result, *words).status == 0
    assert [p.name for p in (tmp_path / "views").iterdir()] == ["view_000.png"]
    assert (tmp_path / "clip.mp4").stat().st_size > 100
