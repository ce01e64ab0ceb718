"""Folders appear whole or not at all, and take the place of nothing that is not their writer's own."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pop_fast.io import atomic
from pop_fast.io.atomic import folder_atomically
from tests.app.captures import assert_one_line
from tests.app.damage import contents
from tests.app.interruptions import Killed, killed_after


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
