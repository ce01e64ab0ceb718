"""Folders in use, foreign, full or forbidden, and runs that do not fit: refused in one line, nothing touched."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.app.conftest import TRAIN, Pop
from tests.app.damage import contents, photo, says, truncate


def test_an_output_folder_in_use_is_left_alone(pop: Pop, shared_capture: Path, result: Path) -> None:
    before = contents(result)
    says(pop("train", shared_capture, "--out", result, *TRAIN), str(result), "--resume", "--overwrite")
    assert contents(result) == before


def test_a_folder_of_somebody_else_is_not_overwritten(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("mine")
    outcome = pop("train", shared_capture, "--out", tmp_path / "home", "--overwrite", *TRAIN)
    says(outcome, "home", "not a result folder")
    assert [path.name for path in (tmp_path / "home").iterdir()] == ["thesis.txt"]


def test_a_run_is_not_resumed_with_other_settings(pop: Pop, shared_capture: Path, result: Path) -> None:
    before = contents(result)
    outcome = pop("train", shared_capture, "--out", result, *TRAIN, "--resume", "--seed", "7")
    says(outcome, "ckpt_29_rank0.pt", "seed = 42", "seed = 7", "use the same settings")
    assert contents(result) == before


def test_a_run_is_not_resumed_on_another_capture(pop: Pop, capture: Path, result: Path) -> None:
    cv2.imwrite(str(photo(capture, 2)), np.zeros((32, 40, 3), np.uint8))
    before = contents(result)
    outcome = pop("train", capture, "--out", result, *TRAIN, "--resume")
    says(outcome, "another capture", "photographs", "use the same photographs")
    assert contents(result) == before


def test_a_damaged_checkpoint_is_named_on_resume(pop: Pop, shared_capture: Path, result: Path) -> None:
    truncate(result / "ckpts" / "ckpt_29_rank0.pt")
    says(pop("train", shared_capture, "--out", result, *TRAIN, "--resume"), "ckpt_29_rank0.pt", "remove it")


@pytest.mark.parametrize("command", ["train", "demo", "render", "export"])
def test_a_full_disk_leaves_nothing_half_written(
    pop: Pop, shared_capture: Path, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    target = tmp_path / "here" / ("out.ply" if command == "export" else "out")
    words = {
        "train": ["train", shared_capture, "--out", target, *TRAIN],
        "demo": ["demo", target, "--views", "4", "--width", "16", "--height", "16"],
        "render": ["render", shared_result, "--out", target],
        "export": ["export", shared_result, "--out", target],
    }
    says(pop(*words[command]), str(target.parent), "the disk is full", "free some space")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written_is_named(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    says(pop("train", shared_capture, "--out", tmp_path / "locked" / "r", *TRAIN), "locked", "permission denied")


def test_a_video_that_the_disk_has_no_room_for_leaves_the_old_one(
    pop: Pop, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["render", shared_result, "--path", "orbit", "--frames", "3", "--video", tmp_path / "clip.webm"]
    assert pop(*words).status == 0
    before = contents(tmp_path)
    open_writer = cv2.VideoWriter

    class Full:
        """An encoder on a full disk: it says nothing, and half of the file is missing."""

        fourcc = staticmethod(cv2.VideoWriter.fourcc)

        def __init__(self, path: str, *rest: Any) -> None:
            self.path, self.writer = Path(path), open_writer(path, *rest)

        def __getattr__(self, name: str) -> Any:
            return getattr(self.writer, name)

        def release(self) -> None:
            self.writer.release()
            truncate(self.path)

    monkeypatch.setattr(cv2, "VideoWriter", Full)
    says(pop(*words, "--overwrite"), f"{tmp_path / 'clip.webm'}: only 0 of 3 frames", "free some space")
    assert contents(tmp_path) == before
