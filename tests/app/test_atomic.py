"""Files and folders appear whole or not at all, and one run at a time writes in a folder."""

from __future__ import annotations

import errno
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pytest

from pop_fast.errors import PopError
from pop_fast.io import atomic
from pop_fast.io.atomic import (
    FolderLock,
    check_file,
    file_atomically,
    folder_atomically,
    write_atomically,
    write_json,
)
from pop_fast.train import TrainingRun
from pop_fast.train.results import ResultFolder
from tests.app.captures import assert_one_line
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import contents, says
from tests.app.tiny import Killed, killed_after, run_until, tiny_capture, tiny_config

needs_posix = pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX limits, signals and locks")
needs_links = pytest.mark.skipif(os.name == "nt", reason="links need a privilege there")


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A file that is there already, alone in its folder."""
    path = tmp_path / "x.bin"
    path.write_bytes(b"old")
    return path


def assert_untouched(path: Path) -> None:
    assert path.read_bytes() == b"old"
    assert os.listdir(path.parent) == [path.name]


def failing(error: Exception) -> Callable[[BinaryIO], None]:
    def writer(file: BinaryIO) -> None:
        file.write(b"half of the new")
        raise error

    return writer


def test_a_written_file_holds_what_the_writer_wrote_and_parents_are_made(tmp_path: Path) -> None:
    target = tmp_path / "a" / "b.bin"
    write_atomically(target, lambda file: file.write(b"new"))
    assert target.read_bytes() == b"new"
    assert os.listdir(target.parent) == ["b.bin"]


def test_json_of_a_number_that_is_not_finite_is_read_by_every_parser(tmp_path: Path) -> None:
    equal = {"psnr": math.inf, "per_view": [{"psnr": math.nan}]}
    write_json(tmp_path / "eval.json", equal)
    results = ResultFolder(tmp_path)
    results.log(equal)
    results.open_metrics(0)
    results.close()
    for name in ("eval.json", "metrics.jsonl"):
        found = json.loads((tmp_path / name).read_text(), parse_constant=pytest.fail)
        assert found == {"psnr": None, "per_view": [{"psnr": None}]}


@pytest.mark.parametrize(
    ("number", "word"),
    [(errno.ENOSPC, "disk is full"), (errno.EDQUOT, "quota"), (errno.EROFS, "read-only"), (errno.EACCES, "permission")],
)
def test_a_failing_writer_leaves_the_old_file(old: Path, number: int, word: str) -> None:
    refused = OSError(number, os.strerror(number))
    assert_one_line(lambda: write_atomically(old, failing(refused)), str(old), word)
    assert_untouched(old)
    with pytest.raises(KeyError):
        write_atomically(old, failing(KeyError("in the middle")))
    assert_untouched(old)


@needs_posix
def test_a_pipe_or_a_device_is_never_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for write in (check_file, lambda path: write_atomically(path, lambda file: file.write(b"new"))):
        assert_one_line(lambda write=write: write(pipe), str(pipe), "is a pipe or a device")
    for device in ("/dev/null", "/dev/stdout"):
        assert_one_line(lambda device=device: check_file(device), device, "is a pipe or a device")
    assert os.listdir(tmp_path) == ["pipe"]
    assert pipe.is_fifo()


def test_a_file_in_place_of_a_parent_folder_is_named(old: Path) -> None:
    assert_one_line(lambda: write_atomically(old / "x.bin", lambda file: file.write(b"new")), str(old), "place")
    assert_untouched(old)


KILLED = """
import sys, time
from pop_fast.io.atomic import write_atomically
def writer(file):
    file.write(bytes(1000)); file.flush(); print("begun", flush=True); time.sleep(60)
write_atomically(sys.argv[1], writer)
"""


def begun(script: str, path: Path) -> subprocess.Popen[bytes]:
    """Start a script that says when it has begun, and wait for it to say so."""
    child = subprocess.Popen([sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE)
    assert child.stdout.readline() == b"begun\n"
    return child


@needs_posix
def test_a_killed_writer_leaves_the_old_file_and_the_next_write_sweeps_up(old: Path) -> None:
    with begun(KILLED, old) as child:
        child.kill()
    assert old.read_bytes() == b"old"
    assert len(os.listdir(old.parent)) == 2
    # what a living writer has begun is not swept up
    theirs = old.with_name(f".x.bin.{os.getppid()}.partial")
    theirs.write_bytes(b"theirs")
    # no process has this number, and what is none was written by nobody here
    old.with_name(f".x.bin.{10**30}.partial").touch()
    odd = old.with_name(".x.bin.\u00b2.partial")
    odd.touch()
    write_atomically(old, lambda file: file.write(b"new"))
    assert contents(old.parent) == {old: b"new", theirs: b"theirs", odd: b""}


def test_a_file_that_a_library_writes_by_name_appears_when_its_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "out" / "a.mp4"
    with file_atomically(target) as part:
        assert part.name == "a.mp4"
        part.write_bytes(b"new")
        assert not target.exists()
    assert target.read_bytes() == b"new"
    assert os.listdir(target.parent) == ["a.mp4"]


def test_a_block_that_fails_leaves_the_old_file(old: Path) -> None:
    def half(error: Exception) -> None:
        with file_atomically(old) as part:
            part.write_bytes(b"half")
            raise error

    with pytest.raises(KeyError):
        half(KeyError("in the middle"))
    part = old.parent / f".x.bin.{os.getpid()}.partial" / "x.bin"
    told = f"{old}: could not be written: "
    assert_one_line(lambda: half(OSError(errno.EROFS, "Read-only file system", str(part))), told + "the file system is")
    assert_one_line(lambda: half(OSError(errno.EIO, "I/O error", str(part))), told + "I/O error; choose another path")
    assert_untouched(old)


# Folders appear whole or not at all, and take the place of nothing that is not their writer's own.


def test_a_folder_appears_only_when_its_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "out" / "folder"
    with folder_atomically(target) as folder:
        (folder / "sub").mkdir()
        (folder / "sub" / "a.txt").write_text("a")
        assert not target.exists()
    assert (target / "sub" / "a.txt").read_text() == "a"
    assert os.listdir(target.parent) == ["folder"]


def test_a_failing_block_leaves_no_folder_and_a_full_disk_is_named(tmp_path: Path) -> None:
    new = tmp_path / "of" / "parents" / "new"

    def half(error: Callable[[Path], Exception]) -> None:
        with folder_atomically(new) as folder:
            (folder / "a.txt").write_text("a")
            raise error(folder)

    with pytest.raises(KeyError):
        half(lambda _: KeyError("in the middle"))
    with pytest.raises(FileNotFoundError):
        # an error about another file passes through
        half(lambda _: FileNotFoundError(errno.ENOENT, "absent", str(tmp_path / "absent")))
    full = (errno.ENOSPC, "No space left on device")
    assert_one_line(lambda: half(lambda at: OSError(*full, str(at / "a.bin"))), str(new / "a.bin"), "disk is full")
    assert os.listdir(tmp_path) == []


def fill(target: Path, overwrite: bool = False, name: str = "new.txt", **rules: Any) -> None:
    with folder_atomically(target, overwrite, **rules) as folder:
        (folder / name).write_text("new")


def old_folder(path: Path, *names: str) -> Path:
    for name in names:
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text("old")
    return path


def by_name(*names: str) -> dict[str, Callable[[Path], bool]]:
    return {"recognise": lambda file: file.as_posix() in names}


ANY = {"recognise": lambda _: True}


def test_an_existing_folder_is_kept_unless_it_may_be_replaced(tmp_path: Path) -> None:
    target = old_folder(tmp_path / "folder", "old.txt", "sub/old.txt")
    own = by_name("old.txt", "sub/old.txt")
    assert_one_line(lambda: fill(target, **own), str(target), "choose another or pass --overwrite")
    assert contents(target) == {target / "old.txt": b"old", target / "sub" / "old.txt": b"old"}
    # what file browsers leave in a folder is nobody's
    old_folder(target, ".DS_Store", "sub/Thumbs.db")
    with folder_atomically(target, True, **own) as folder:
        (folder / "new.txt").write_text("new")
        assert (target / "old.txt").read_text() == "old"
    assert contents(tmp_path) == {target / "new.txt": b"new"}
    assert os.listdir(tmp_path) == ["folder"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_with_a_file_of_somebody_else_is_kept(tmp_path: Path, overwrite: bool) -> None:
    target = old_folder(tmp_path / "folder", "old.txt", "sub/mine.txt")
    told = assert_one_line(
        lambda: fill(target, overwrite, **by_name("old.txt")),
        str(target),
        "holds what this command did not write (sub/mine.txt), so it is not replaced",
        "choose another output folder, or move these files away",
    )
    assert "--overwrite" not in told
    assert sorted(contents(tmp_path)) == [target / "old.txt", target / "sub" / "mine.txt"]


def test_without_a_rule_a_folder_is_replaced_only_when_all_its_files_are_written_anew(tmp_path: Path) -> None:
    target = old_folder(tmp_path / "folder", "new.txt")
    assert_one_line(lambda: fill(target), "--overwrite, which replaces only files that are written anew")
    fill(target, True)
    assert contents(tmp_path) == {target / "new.txt": b"new"}
    assert_one_line(lambda: fill(target, True, name="other.txt"), "did not write (new.txt)")
    assert contents(tmp_path) == {target / "new.txt": b"new"}
    assert os.listdir(tmp_path) == ["folder"]


@pytest.mark.parametrize("read", ["folder", "folder/sub/old.txt", "folder/sub"])
def test_a_folder_that_is_or_holds_what_is_read_is_never_replaced(tmp_path: Path, read: str) -> None:
    target = old_folder(tmp_path / "folder", "sub/old.txt")
    said = f"{target}: ", "read by this command, so it is not replaced; choose another output folder"
    for overwrite in (False, True):
        told = assert_one_line(lambda o=overwrite: fill(target, o, keeps=[tmp_path / read], **ANY), *said)
        assert "--overwrite" not in told
    assert contents(target) == {target / "sub" / "old.txt": b"old"}
    fill(target, True, keeps=[tmp_path, tmp_path / "folder2"], **ANY)


@needs_links
def test_links_are_followed_and_a_link_in_a_folder_counts_as_a_file_of_somebody_else(tmp_path: Path) -> None:
    target, link = old_folder(tmp_path / "disk" / "folder", "old.txt"), tmp_path / "link"
    link.symlink_to(target)
    for out, read in ((target, link), (link, target)):
        assert_one_line(lambda out=out, read=read: fill(out, True, keeps=[read], **ANY), "read by this command")
    fill(link, True, **by_name("old.txt"))
    assert link.is_symlink()
    assert contents(target) == {target / "new.txt": b"new"}
    assert os.listdir(target.parent) == ["folder"]
    (target / "inside").symlink_to(old_folder(tmp_path / "elsewhere", "mine.txt"))
    own = by_name("new.txt", "inside/mine.txt")
    assert_one_line(lambda: fill(target, True, **own), "did not write (inside)")


def test_what_others_put_there_while_a_block_ran_is_kept(tmp_path: Path) -> None:
    target = tmp_path / "folder"

    def slow() -> None:
        with folder_atomically(target, **by_name("new.txt")) as folder:
            (folder / "new.txt").write_text("new")
            old_folder(target, "theirs.txt")

    assert_one_line(slow, str(target), "did not write (theirs.txt)")
    assert contents(tmp_path) == {target / "theirs.txt": b"old"}


@pytest.mark.parametrize("out", [".", "..", "../here"])
def test_the_folder_that_one_is_in_is_not_swapped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: str) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert_one_line(lambda: fill(Path(out), True), "the folder that this command runs in; choose another")
    assert os.listdir(tmp_path) == ["here"]


def test_an_empty_folder_is_filled_without_being_asked_and_a_file_in_the_way_is_named(old: Path) -> None:
    assert_one_line(lambda: fill(old, True), str(old), "in the way")
    empty = old.parent / "folder"
    empty.mkdir()
    fill(empty)
    assert os.listdir(empty) == ["new.txt"]


@pytest.mark.parametrize("can_exchange", [True, False])
def test_a_killed_replacement_never_hides_the_old_folder(tmp_path, monkeypatch, can_exchange):
    if not can_exchange:
        monkeypatch.setattr(atomic, "_exchange", lambda *_: False)
    kills, own = 0, by_name("a.txt")
    for changes in range(12):
        target = old_folder(tmp_path / str(changes) / "folder", "a.txt")
        try:
            with killed_after(changes):
                fill(target, True, "a.txt", **own)
        except Killed:
            kills += 1
        if can_exchange:
            assert (target / "a.txt").read_text() in ("old", "new")
        # whoever writes there next finds the one or the other
        assert_one_line(lambda target=target: fill(target, **own), "not empty")
        assert (target / "a.txt").read_text() in ("old", "new")
        assert os.listdir(target.parent) == ["folder"]
    assert 3 <= kills < 12


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no exchange of names that Python reaches")
def test_two_folders_are_exchanged_in_one_step(tmp_path: Path) -> None:
    one, other = old_folder(tmp_path / "one", "a.txt"), old_folder(tmp_path / "other", "b.txt")
    assert atomic._exchange(one, other)  # pyright: ignore[reportPrivateUsage]
    assert (os.listdir(one), os.listdir(other)) == (["b.txt"], ["a.txt"])
    assert not atomic._exchange(one, tmp_path / "absent")  # pyright: ignore[reportPrivateUsage]


# One run at a time in a result folder, and the next one as soon as that has ended, however it ended.

HOLD = """
import sys, time
from pathlib import Path
from pop_fast.io.atomic import FolderLock
FolderLock(Path(sys.argv[1])).take()
print("begun", flush=True)
time.sleep(300.0)
"""


@needs_posix
@pytest.mark.parametrize("how", ["--resume", "--overwrite"])
def test_a_run_next_to_a_live_one_is_refused(pop: Pop, shared_capture: Path, result: Path, how: str) -> None:
    before = contents(result)
    with begun(HOLD, result) as holder:
        says(pop("train", shared_capture, "--out", result, *TRAIN, how), "another run is writing to this folder")
        assert contents(result) == before
        os.kill(holder.pid, signal.SIGKILL)
    pop.done("train", shared_capture, "--out", result, *TRAIN, how)


@needs_posix
def test_of_two_that_found_no_folder_one_gets_it(tmp_path: Path) -> None:
    first, second = ResultFolder(tmp_path / "r"), ResultFolder(tmp_path / "r")

    def begin(results: ResultFolder) -> None:
        results.begin(tiny_config(results.path), {}, np.full(3, 0.5), False)

    for results in (first, second):
        results.hold()
        results.check(resume=False, overwrite=False)
    begin(first)
    with pytest.raises(PopError, match="another run is writing"):
        begin(second)
    first.close()
    # by then the folder holds the results of the first
    assert_one_line(lambda: begin(second), str(tmp_path / "r"), "another run has begun in this folder")


@needs_posix
def test_a_run_that_stops_or_ends_gives_the_folder_back_with_nothing_left_in_it(tmp_path: Path) -> None:
    lock = FolderLock(tmp_path)
    lock.take()
    assert list(tmp_path.iterdir()) == []
    lock.release()
    run_until(TrainingRun(tiny_config(tmp_path), tiny_capture()), 7)
    lock.take()
    lock.release()
    TrainingRun(tiny_config(tmp_path), tiny_capture(), resume=True).run()
    lock.take()
    assert lock.held
    with pytest.raises(PopError):
        FolderLock(tmp_path).take()
    lock.release()
    assert not lock.held
    # writing to a folder tells what is wrong with it
    FolderLock(tmp_path / "absent").take()
