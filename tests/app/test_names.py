"""Pictures of views get file names of their own, inside one folder."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pop_fast.view.frames import inside, picture_names
from tests.app.captures import assert_one_line


def named(*views: str) -> list[str]:
    return [path.as_posix() for path in picture_names(views)]


@pytest.mark.parametrize(
    ("views", "files"),
    [
        (["images/a.jpg", "b.PNG"], ["images/a.png", "b.png"]),
        (["cam.00", "cam.08", "plain"], ["cam.00.png", "cam.08.png", "plain.png"]),
        (["/data/set/a.png", "/data/set/b.png"], ["a.png", "b.png"]),
        (["/data/l/a.png", "/data/r/a.png"], ["l/a.png", "r/a.png"]),
        (["C:\\set\\l\\a.png", "C:\\set\\r\\a.png"], ["l/a.png", "r/a.png"]),
        (["../images/a.png", "../../a.png"], ["images/a.png", "a.png"]),
        (["x.jpg", "x.png", "y.jpg"], ["x.jpg.png", "x.png.png", "y.png"]),
        (["../a.png", "a.png"], ["a.png.png", "a.png_2.png"]),
        (["A.png", "a.jpg"], ["A.png.png", "a.jpg.png"]),
        (["x.jpg.png", "x.jpg", "x.webp"], ["x.jpg.png", "x.jpg_2.png", "x.webp.png"]),
        (["..", "/"], ["view.png", "view_2.png"]),
    ],
)
def test_names_of_views_become_names_of_files(views: list[str], files: list[str]) -> None:
    assert named(*views) == files


@given(st.lists(st.text(alphabet="aA./\\:_2pngj", max_size=12), max_size=6))
@example(["a", "a", "a_2"])
def test_files_are_all_different_and_none_leads_out(views: list[str]) -> None:
    files = picture_names(views)
    assert len({file.as_posix().casefold() for file in files}) == len(views)
    for file in files:
        assert file.suffix == ".png"
        assert not file.is_absolute()
        assert ".." not in file.parts
        assert inside(Path("folder"), file) == Path("folder") / file


@pytest.mark.parametrize("name", ["../a.png", "/a.png", "b/../../a.png"])
def test_a_name_that_leads_out_of_its_folder_is_refused(tmp_path: Path, name: str) -> None:
    assert_one_line(lambda: inside(tmp_path, Path(name)), name, "leads out", "give it a name without")
