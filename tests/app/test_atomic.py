"""Files appear whole or not at all."""

from __future__ import annotations

import errno
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
from pop_fast.io.atomic import FolderLock, file_atomically, folder_atomically, write_atomically
from pop_fast.train import TrainingRun
from pop_fast.train.results import ResultFolder
from tests.app.captures import assert_one_line
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import contents, says
from tests.app.tiny import Killed, killed_after, run_until, tiny_capture, tiny_config


def fail_with(number: int):
    def writer(file: BinaryIO) -> None:
        file.write(b"half of the new")
        raise OSError(number, os.strerror(number))

    return writer


def test_a_written_file_holds_what_the_writer_wrote_and_parents_are_made(tmp_path: Path) -> None:
    target = tmp_path / "a" / "b.bin"
    write_atomically(target, lambda file: file.write(b"new"))
    assert target.read_bytes() == b"new"
    assert os.listdir(target.parent) == ["b.bin"]


def test_a_failing_writer_leaves_the_old_content_and_nothing_beside(tmp_path: Path) -> None:
    target = tmp_path / "x.bin"
    target.write_bytes(b"old")

    def writer(file: BinaryIO) -> None:
        file.write(b"half")
        raise KeyError("in the middle")

    with pytest.raises(KeyError):
        write_atomically(target, writer)
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["x.bin"]


@pytest.mark.parametrize(
    ("number", "word"),
    [
        (errno.ENOSPC, "disk is full"),
        (errno.EDQUOT, "quota"),
        (errno.EROFS, "read-only"),
        (errno.EACCES, "permission"),
    ],
)
def test_what_the_system_refuses_becomes_one_line_that_names_the_file(tmp_path: Path, number: int, word: str) -> None:
    target = tmp_path / "x.bin"
    target.write_bytes(b"old")
    assert_one_line(lambda: write_atomically(target, fail_with(number)), str(target), word)
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["x.bin"]


def test_a_file_in_place_of_a_parent_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    target = tmp_path / "file" / "x.bin"
    assert_one_line(lambda: write_atomically(target, lambda file: file.write(b"new")), str(tmp_path / "file"), "place")
    assert os.listdir(tmp_path) == ["file"]


_LIMITED = """
import resource, signal, sys
from pop_fast.io.atomic import write_atomically
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
write_atomically(sys.argv[1], lambda file: file.write(bytes(100_000)))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX resource limits")
def test_a_write_that_the_kernel_really_refuses_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "x.bin"
    target.write_bytes(b"old")
    done = subprocess.run([sys.executable, "-c", _LIMITED, str(target)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert f"PopError: {target}: could not be written: the file is larger" in done.stderr
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["x.bin"]


_KILLED = """
import sys, time
from pop_fast.io.atomic import write_atomically
def writer(file):
    file.write(bytes(1000)); file.flush(); print("half", flush=True); time.sleep(60)
write_atomically(sys.argv[1], writer)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_a_killed_writer_leaves_the_old_file_and_the_next_write_sweeps_up(tmp_path: Path) -> None:
    target = tmp_path / "x.bin"
    target.write_bytes(b"old")
    process = subprocess.Popen([sys.executable, "-c", _KILLED, str(target)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"half\n"
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert target.read_bytes() == b"old"
    assert len(os.listdir(tmp_path)) == 2
    write_atomically(target, lambda file: file.write(b"new"))
    assert target.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["x.bin"]


def test_what_a_living_writer_has_begun_is_not_swept_up(tmp_path: Path) -> None:
    begun = tmp_path / f".x.bin.{os.getppid()}.partial"
    begun.write_bytes(b"theirs")
    write_atomically(tmp_path / "x.bin", lambda file: file.write(b"ours"))
    assert begun.read_bytes() == b"theirs"


def test_a_file_that_a_library_writes_by_name_appears_when_its_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "out" / "a.mp4"
    with file_atomically(target) as part:
        assert part.name == "a.mp4"
        part.write_bytes(b"new")
        assert not target.exists()
    assert target.read_bytes() == b"new"
    assert os.listdir(target.parent) == ["a.mp4"]


def test_a_block_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "a.mp4"
    target.write_bytes(b"old")

    def half(error: Exception) -> None:
        with file_atomically(target) as part:
            part.write_bytes(b"half")
            raise error

    with pytest.raises(KeyError):
        half(KeyError("in the middle"))
    part = tmp_path / f".a.mp4.{os.getpid()}.partial" / "a.mp4"
    told = f"{target}: could not be written: "
    assert_one_line(lambda: half(OSError(errno.EROFS, "Read-only file system", str(part))), told + "the file system is")
    assert_one_line(lambda: half(OSError(errno.EIO, "I/O error", str(part))), told + "I/O error; choose another path")
    assert contents(tmp_path) == {target: b"old"}
    assert os.listdir(tmp_path) == ["a.mp4"]


# Folders appear whole or not at all, and take the place of nothing that is not their writer's own.


def test_a_folder_appears_only_when_its_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "out" / "folder"
    with folder_atomically(target) as folder:
        (folder / "sub").mkdir()
        (folder / "sub" / "a.txt").write_text("a")
        assert not target.exists()
    assert (target / "sub" / "a.txt").read_text() == "a"
    assert os.listdir(target.parent) == ["folder"]


def test_a_failing_block_leaves_no_folder(tmp_path: Path) -> None:
    def half() -> None:
        with folder_atomically(tmp_path / "new") as folder:
            (folder / "a.txt").write_text("a")
            raise KeyError("in the middle")

    with pytest.raises(KeyError):
        half()
    assert os.listdir(tmp_path) == []


def test_a_full_disk_in_a_block_is_named_and_leaves_no_folder(tmp_path: Path) -> None:
    def full() -> None:
        with folder_atomically(tmp_path / "new") as folder:
            raise OSError(errno.ENOSPC, "No space left on device", str(folder / "points.bin"))

    assert_one_line(full, str(tmp_path / "new" / "points.bin"), "disk is full")
    assert os.listdir(tmp_path) == []


def test_an_error_about_another_file_passes_through_a_block(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), folder_atomically(tmp_path / "new"):
        (tmp_path / "absent").read_bytes()


def fill(target: Path, overwrite: bool = False, name: str = "new.txt", **rules: Any) -> None:
    with folder_atomically(target, overwrite, **rules) as folder:
        (folder / name).write_text("new")


def old_folder(path: Path, *names: str) -> Path:
    for name in names:
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text("old")
    return path


def by_name(*names: str) -> Callable[[Path], bool]:
    return lambda file: file.as_posix() in names


def test_an_existing_folder_is_kept_unless_it_may_be_replaced(tmp_path: Path) -> None:
    target = old_folder(tmp_path / "folder", "old.txt", "sub/old.txt")
    own = by_name("old.txt", "sub/old.txt")
    assert_one_line(lambda: fill(target, recognise=own), str(target), "choose another or pass --overwrite")
    assert contents(target) == {target / "old.txt": b"old", target / "sub" / "old.txt": b"old"}
    with folder_atomically(target, True, recognise=own) as folder:
        (folder / "new.txt").write_text("new")
        assert (target / "old.txt").read_text() == "old"
    assert contents(tmp_path) == {target / "new.txt": b"new"}
    assert os.listdir(tmp_path) == ["folder"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_with_a_file_of_somebody_else_is_never_replaced_and_the_file_is_named(
    tmp_path: Path, overwrite: bool
) -> None:
    target = old_folder(tmp_path / "folder", "old.txt", "sub/mine.txt")
    told = assert_one_line(
        lambda: fill(target, overwrite, recognise=by_name("old.txt")),
        str(target),
        "holds what this command did not write (sub/mine.txt), so it is not replaced",
        "choose another output folder, or move these files away",
    )
    assert "--overwrite" not in told
    assert sorted(contents(tmp_path)) == [target / "old.txt", target / "sub" / "mine.txt"]


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege there")
def test_a_link_in_a_folder_counts_as_a_file_of_somebody_else(tmp_path: Path) -> None:
    target = old_folder(tmp_path / "folder", "old.txt")
    (target / "link").symlink_to(old_folder(tmp_path / "elsewhere", "mine.txt"))
    own = by_name("old.txt", "link/mine.txt")
    assert_one_line(lambda: fill(target, True, recognise=own), "did not write (link)")


def test_what_file_browsers_leave_in_a_folder_is_nobody_s(tmp_path: Path) -> None:
    target = old_folder(tmp_path / "folder", "old.txt", ".DS_Store", "sub/Thumbs.db")
    fill(target, True, recognise=by_name("old.txt"))
    assert contents(tmp_path) == {target / "new.txt": b"new"}


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
    for overwrite in (False, True):
        told = assert_one_line(
            lambda overwrite=overwrite: fill(target, overwrite, keeps=[tmp_path / read], recognise=lambda _: True),
            f"{target}: ",
            "read by this command, so it is not replaced; choose another output folder",
        )
        assert "--overwrite" not in told
    assert contents(target) == {target / "sub" / "old.txt": b"old"}
    fill(target, True, keeps=[tmp_path, tmp_path / "folder2"], recognise=lambda _: True)


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege there")
def test_what_is_read_is_known_through_links(tmp_path: Path) -> None:
    target = old_folder(tmp_path / "folder", "old.txt")
    (tmp_path / "link").symlink_to(target)
    for out, read in ((target, tmp_path / "link"), (tmp_path / "link", target)):
        assert_one_line(
            lambda out=out, read=read: fill(out, True, keeps=[read], recognise=lambda _: True), "read by this command"
        )


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege there")
def test_a_link_to_a_folder_is_followed_and_stays(tmp_path: Path) -> None:
    target = old_folder(tmp_path / "disk" / "folder", "old.txt")
    (tmp_path / "link").symlink_to(target)
    fill(tmp_path / "link", True, recognise=by_name("old.txt"))
    assert (tmp_path / "link").is_symlink()
    assert contents(target) == {target / "new.txt": b"new"}
    assert os.listdir(target.parent) == ["folder"]


def test_what_others_put_there_while_a_block_ran_is_kept(tmp_path: Path) -> None:
    target = tmp_path / "folder"

    def slow() -> None:
        with folder_atomically(target, recognise=by_name("new.txt")) as folder:
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


def test_an_empty_folder_is_filled_without_being_asked(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with folder_atomically(tmp_path / "folder") as folder:
        (folder / "new.txt").write_text("new")
    assert os.listdir(tmp_path / "folder") == ["new.txt"]


def test_a_file_in_the_way_of_a_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("")
    assert_one_line(lambda: fill(tmp_path / "x", True), str(tmp_path / "x"), "in the way")


@pytest.mark.parametrize("can_exchange", [True, False])
def test_a_killed_replacement_never_hides_the_old_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can_exchange: bool
) -> None:
    if not can_exchange:
        monkeypatch.setattr(atomic, "_exchange", lambda *_: False)
    kills = 0
    for changes in range(12):
        target = old_folder(tmp_path / str(changes) / "folder", "a.txt")
        try:
            with killed_after(changes):
                fill(target, True, "a.txt", recognise=by_name("a.txt"))
        except Killed:
            kills += 1
        if can_exchange:
            assert (target / "a.txt").read_text() in ("old", "new")
        # whoever writes there next finds the one or the other
        assert_one_line(lambda target=target: fill(target, recognise=by_name("a.txt")), "not empty")
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

needs_flock = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no flock")

_HOLD = """
import sys, time
from pathlib import Path
from pop_fast.io.atomic import FolderLock
FolderLock(Path(sys.argv[1])).take()
print("held", flush=True)
time.sleep(300.0)
"""


def begin(results: ResultFolder, overwrite: bool = False) -> None:
    results.begin(tiny_config(results.path), {}, np.full(3, 0.5), overwrite)


@needs_flock
@pytest.mark.parametrize("how", ["--resume", "--overwrite"])
def test_a_run_beside_a_live_one_is_refused_and_the_next_after_it_is_not(
    pop: Pop, shared_capture: Path, result: Path, how: str
) -> None:
    before = contents(result)
    with subprocess.Popen([sys.executable, "-c", _HOLD, str(result)], stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        says(pop("train", shared_capture, "--out", result, *TRAIN, how), "another run is writing to this folder")
        assert contents(result) == before
        os.kill(holder.pid, signal.SIGKILL)
    assert pop("train", shared_capture, "--out", result, *TRAIN, how).status == 0


@needs_flock
def test_of_two_that_found_no_folder_one_gets_it(tmp_path: Path) -> None:
    first, second = ResultFolder(tmp_path / "r"), ResultFolder(tmp_path / "r")
    for results in (first, second):
        results.hold()
        results.check(resume=False, overwrite=False)
    begin(first)
    with pytest.raises(PopError, match="another run is writing"):
        begin(second)
    first.close()
    # by then the folder holds the results of the first
    assert_one_line(lambda: begin(second), str(tmp_path / "r"), "another run has begun in this folder")


@needs_flock
def test_a_run_that_stops_or_ends_gives_the_folder_back(tmp_path: Path) -> None:
    run_until(TrainingRun(tiny_config(tmp_path), tiny_capture()), 7)
    lock = FolderLock(tmp_path)
    lock.take()
    lock.release()
    TrainingRun(tiny_config(tmp_path), tiny_capture(), resume=True).run()
    lock.take()
    assert lock.held
    with pytest.raises(PopError):
        FolderLock(tmp_path).take()
    lock.release()
    assert not lock.held


@needs_flock
def test_nothing_is_left_in_the_folder_for_it(tmp_path: Path) -> None:
    lock = FolderLock(tmp_path)
    lock.take()
    assert list(tmp_path.iterdir()) == []
    lock.release()
    # writing to a folder tells what is wrong with it
    FolderLock(tmp_path / "absent").take()
