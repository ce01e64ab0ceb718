"""A library that somebody else could have put there is never loaded."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from cuda_ext.host import emulate
from cuda_ext.toolkit import find_compiler

ROOT = Path(__file__).parents[2]
# what a library of somebody else would do: tell that it was loaded
PLANTED = r"""
#include <stdio.h>
__attribute__((constructor)) static void loaded(void) { puts("planted"); fflush(stdout); }
"""
LOAD = """
import os
from types import SimpleNamespace
from unittest import mock
from cuda_ext.host import emulate
if {read_only}:
    emulate.os = SimpleNamespace(**{{**vars(os), "access": lambda *_: False}})
# compiling takes long, and which library is loaded is known before
emulate._compile = mock.Mock(side_effect=RuntimeError("compiling"))
emulate.loaded(emulate.build(emulate.library_folder()))
"""
needs_compiler = pytest.mark.skipif(emulate.why_not() is not None, reason=str(emulate.why_not()))


@pytest.fixture
def read_only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A package that cannot be written to, and the cache that stands in for it."""
    monkeypatch.setattr(emulate.os, "access", lambda *_: False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "pop-splatting"


def test_what_can_be_written_to_is_compiled_into() -> None:
    assert emulate.library_folder(ROOT / "tests") == ROOT / "tests" / "build"
    assert not (ROOT / "tests" / "build").exists()


def test_the_cache_is_made_for_this_user_alone(read_only: Path) -> None:
    before = os.umask(0)
    try:
        assert emulate.library_folder() == read_only
    finally:
        os.umask(before)
    assert stat.S_IMODE(read_only.stat().st_mode) == 0o700
    (read_only / "ours.so").write_bytes(b"")
    assert emulate.library_folder() == read_only


def test_a_cache_that_is_not_absolute_is_not_taken(
    read_only: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", "here")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert emulate.library_folder() == tmp_path / "home" / ".cache" / "pop-splatting"


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777, 0o701, 0o750])
def test_a_cache_that_is_open_to_others_is_refused(read_only: Path, mode: int) -> None:
    read_only.mkdir(parents=True)
    read_only.chmod(mode)
    words = rf"pop-splatting: is open to others \(mode {mode:o}\), so nothing is loaded"
    with pytest.raises(RuntimeError, match=words):
        emulate.library_folder()


@pytest.mark.parametrize("what", ["the folder", "a file"])
def test_what_belongs_to_somebody_else_is_refused(read_only: Path, what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    read_only.mkdir(parents=True, mode=0o700)
    path = read_only if what == "the folder" else read_only / "emulated_0123456789abcdef"
    if what == "a file":
        path.write_bytes(b"")
    real = Path.lstat

    def lstat(self: Path) -> os.stat_result:
        found = list(real(self))
        found[stat.ST_UID] += 1 if self == path else 0
        return os.stat_result(found)

    monkeypatch.setattr(Path, "lstat", lstat)
    with pytest.raises(RuntimeError, match=rf"{path.name}: belongs to user {os.geteuid() + 1}, not to you"):
        emulate.library_folder()


def test_a_link_is_refused(read_only: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    read_only.parent.mkdir()
    read_only.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RuntimeError, match="pop-splatting: is a link"):
        emulate.library_folder()


def plant(folder: Path, tmp_path: Path) -> None:
    """Compile a library that is not ours under the name of the emulated kernels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(emulate, "_compile", lambda compiler, library: None)
        library = emulate.build(folder)
    (tmp_path / "planted.cpp").write_text(PLANTED)
    subprocess.run([*(find_compiler() or []), "-shared", "-fPIC", "-o", library, tmp_path / "planted.cpp"], check=True)


def load(folder: Path, read_only: bool) -> subprocess.CompletedProcess[str]:
    """Load the emulated kernels in another process that has `folder` for temporary files, with a cache in it."""
    places = {"TMPDIR": str(folder), "XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", LOAD.format(read_only=read_only)]
    return subprocess.run(command, env=os.environ | places, capture_output=True, text=True, check=False, cwd=folder)


@needs_compiler
def test_a_library_in_the_folder_for_temporary_files_is_not_loaded(tmp_path: Path) -> None:
    plant(tmp_path / "emulated", tmp_path)
    assert "planted" not in load(tmp_path, read_only=False).stdout
    assert "planted" not in load(tmp_path, read_only=True).stdout


@needs_compiler
def test_a_library_in_a_cache_that_is_open_to_others_is_not_loaded(tmp_path: Path) -> None:
    cache = tmp_path / "cache" / "pop-splatting"
    plant(cache, tmp_path)
    cache.chmod(0o777)
    done = load(tmp_path, read_only=True)
    assert "planted" not in done.stdout
    assert done.returncode != 0
    assert done.stderr.splitlines()[-1].startswith(f"RuntimeError: {cache}: is open to others (mode 777)")
    # one's own is
    cache.chmod(0o700)
    assert "planted" in load(tmp_path, read_only=True).stdout
