"""Files appear whole or not at all."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import BinaryIO

import pytest

from pop_fast.io.atomic import file_atomically, write_atomically
from tests.app.captures import assert_one_line
from tests.app.damage import contents


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
