"""What a command cannot do it says before the long work: nothing is loaded, searched, drawn or trained first."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pop_fast.cli import capture_options, explain, export, render
from pop_fast.cli import eval as eval_command
from pop_fast.data import load, sfm
from pop_fast.demo import make
from pop_fast.io import formats
from tests.app.captures import photograph, write_photograph
from tests.app.conftest import Pop
from tests.app.damage import says


class BegunError(Exception):
    """The long work has begun."""


@pytest.fixture(autouse=True)
def nothing_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let everything that takes long fail."""

    def begun(*_: Any, **__: Any) -> None:
        raise BegunError

    for module in (render, eval_command, explain, export):
        monkeypatch.setattr(module, "load_splat", begun)
    for owner, name in (
        (capture_options, "open_capture"),
        (load, "run_sfm"),
        (load, "read_views"),
        (sfm, "find_cameras"),
        (sfm, "measure"),
        (make, "_photograph"),
        (formats, "load_splat_file"),
    ):
        monkeypatch.setattr(owner, name, begun)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with photographs, a file and a folder that are in the way, and one that may not be written."""
    for i in range(4):
        write_photograph(tmp_path / "photos" / f"{i}.png", photograph(i))
    (tmp_path / "splat.ply").write_bytes(b"")
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    return tmp_path


REFUSED: dict[str, tuple[str, tuple[str, ...]]] = {
    "no such path": ("render splat.ply --out o --path spiral", ("spiral", "orbit")),
    "no frames": ("render splat.ply --out o --path orbit --frames 0", ("--frames 1",)),
    "pictures where somebody's files are": ("render splat.ply --out folder --overwrite", ("folder", "thesis.txt")),
    "pictures where a folder is": ("render splat.ply --out folder", ("folder", "thesis.txt")),
    "pictures where a file is": ("render splat.ply --out file", ("file", "in the way")),
    "pictures under a file": ("render splat.ply --out file/o", ("file/o", "is a file")),
    "a video of no kind": ("render splat.ply --video o.gif", ("o.gif", ".webm")),
    "a video under a file": ("render splat.ply --video file/o.webm", ("file/o.webm", "is a file")),
    "numbers where a folder is": ("eval splat.ply --capture photos --json folder", ("folder", "in the way")),
    "numbers under a file": ("eval splat.ply --capture photos --json file/o.json", ("file/o.json", "is a file")),
    "a page where a folder is": ("explain splat.ply --view 0 --pixel 1,1 --html folder", ("folder", "in the way")),
    "maps where a folder is": ("explain splat.ply --view 0 --maps folder", ("folder", "--overwrite")),
    "an export under a file": ("export splat.ply --out file/o.spz", ("file/o.spz", "is a file")),
    "an export of no format": ("export splat.ply --out o.xyz", ("o.xyz", ".spz")),
    "an Inria folder that is in use": ("export splat.ply --layout inria --out folder", ("folder", "thesis.txt")),
    "a conversion under a file": ("convert splat.ply file/o.spz", ("file/o.spz", "is a file")),
    "cameras where a folder is": ("sfm photos --out folder", ("folder", "thesis.txt")),
    "cameras under a file": ("sfm photos --out file/o", ("file/o", "is a file")),
    "a demo where somebody's files are": ("demo folder --overwrite", ("folder", "thesis.txt")),
    "a demo under a file": ("demo file/o", ("file/o", "is a file")),
    "a factor that leaves nothing": ("train photos --factor 1000", ("0.png", "40x30", "factor 1000", "use 30 at most")),
    "results under a file": ("train photos --out file/o", ("file/o", "is a file")),
    "weights that are not there": ("train photos --lpips-alex gone.pth", ("gone.pth", "--lpips-alex")),
}


@pytest.mark.parametrize("what", REFUSED)
def test_it_is_said_before_the_long_work(pop: Pop, place: Path, what: str) -> None:
    command, words = REFUSED[what]
    says(pop(*command.split()), *words)
    assert (place / "folder" / "thesis.txt").read_text() == "mine"


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="a folder that this user may not write to")
@pytest.mark.parametrize("command", ["render splat.ply --out locked/o", "sfm photos --out locked/o"])
def test_a_folder_that_may_not_be_written_to_is_said_before_the_long_work(pop: Pop, place: Path, command: str) -> None:
    (place / "locked").mkdir(mode=0o500)
    says(pop(*command.split()), "locked", "permission denied")


def test_what_can_be_done_goes_on_to_the_long_work(pop: Pop, place: Path) -> None:
    for command in ("render splat.ply --out o", "train photos --factor 2", "sfm photos --out o", "demo o"):
        with pytest.raises(BegunError):
            pop(*command.split())
    assert np.all([not (place / name).exists() for name in ("o", "out")])
