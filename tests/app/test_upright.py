"""Photographs that a camera stored sideways: where the program finds the cameras itself, all is shown upright."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pop_fast.data import load_capture, run_sfm, sfm
from pop_fast.data.capture import View
from tests.app.captures import PINHOLE, assert_one_line, camera, make_model, photograph, ring, write_photograph
from tests.app.conftest import Pop

ORIENTATIONS = (1, 6, 3, 8)
# what a viewer does to the stored pixels
SHOWN = {1: 0, 6: -1, 3: 2, 8: 1}


@pytest.fixture(autouse=True)
def _cameras_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(job: Any, *_: Any) -> Any:
        return make_model(job.names, ring(len(job.names)), [camera("PINHOLE", PINHOLE, 40, 30)])

    monkeypatch.setattr(sfm, "_find_cameras", find)


def shoot(folder: Path) -> Path:
    """Photographs of 40 x 30 stored pixels, each held another way."""
    folder.mkdir()
    for orientation in ORIENTATIONS:
        exif = Image.Exif()
        exif[0x112] = orientation
        Image.fromarray(photograph(orientation, 40, 30)).save(folder / f"{orientation}.png", exif=exif)
    return folder


def colors_at(view: View, points: np.ndarray) -> np.ndarray:
    """The colours of the pixels that points are seen in; those outside the picture are black."""
    seen = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    u, v = (view.K @ seen.T)[:2] / seen[:, 2]
    inside = (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height)
    colors = np.zeros((len(points), 3), np.uint8)
    colors[inside] = view.image[np.floor(v[inside]).astype(int), np.floor(u[inside]).astype(int)]
    assert inside.sum() > len(points) // 2
    return colors


def test_pictures_are_upright_and_every_point_keeps_its_pixel(tmp_path: Path) -> None:
    folder = shoot(tmp_path / "photos")
    run_sfm(folder)
    turned = {view.name: view for view in load_capture(folder, normalize=False).views}
    (folder / "sparse" / "upright.json").unlink()
    stored = {view.name: view for view in load_capture(folder, normalize=False).views}
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (300, 3))
    for orientation in ORIENTATIONS:
        name = f"{orientation}.png"
        np.testing.assert_array_equal(turned[name].image, np.rot90(stored[name].image, SHOWN[orientation]))
        np.testing.assert_array_equal(colors_at(turned[name], points), colors_at(stored[name], points))
        assert np.linalg.det(turned[name].viewmat) == pytest.approx(1.0)
        np.testing.assert_allclose(turned[name].camera_center, stored[name].camera_center, atol=1e-12)


def test_a_mask_fits_drawn_over_the_stored_or_over_the_shown_picture(tmp_path: Path) -> None:
    folder = shoot(tmp_path / "photos")
    run_sfm(folder)
    keep = np.zeros((30, 40), np.uint8)
    keep[:7, :11] = 255
    (folder / "masks").mkdir()
    for name, mask in (("6.png", keep), ("8.png", np.rot90(keep, SHOWN[8])), ("1.png", keep), ("3.png", keep)):
        write_photograph(folder / "masks" / name, mask)
    for view in load_capture(folder).views:
        orientation = int(view.name[0])
        assert view.mask is not None
        np.testing.assert_array_equal(view.mask, np.rot90(keep > 0, SHOWN[orientation]))


def test_a_capture_of_its_own_is_upright_too_and_may_be_made_again(tmp_path: Path) -> None:
    folder = shoot(tmp_path / "photos")
    for overwrite in (False, True):
        run_sfm(folder, tmp_path / "scene", overwrite=overwrite)
        sizes = {view.name: (view.width, view.height) for view in load_capture(tmp_path / "scene").views}
        assert sizes == {"1.png": (40, 30), "3.png": (40, 30), "6.png": (30, 40), "8.png": (30, 40)}


def test_photographs_that_are_upright_as_stored_leave_no_note(tmp_path: Path) -> None:
    for i in range(3):
        write_photograph(tmp_path / f"{i}.png", photograph(i))
    run_sfm(tmp_path)
    assert sorted(path.name for path in (tmp_path / "sparse").iterdir()) == ["0", "sfm.sha256"]


@pytest.mark.parametrize("text", ["{", '{"6.png": 4}', '{"6.png": true}', "[]"])
def test_a_damaged_note_is_named(tmp_path: Path, text: str) -> None:
    folder = shoot(tmp_path / "photos")
    run_sfm(folder)
    (folder / "sparse" / "upright.json").write_text(text)
    assert_one_line(lambda: load_capture(folder), "upright.json", "pop sfm again with --overwrite")


def test_the_check_says_that_they_are_turned(pop: Pop, tmp_path: Path) -> None:
    folder = shoot(tmp_path / "photos")
    run_sfm(folder)
    outcome = pop("data", "check", folder)
    assert "3 are stored turned and shown upright" in outcome.out
    assert "LOOK  EXIF" not in outcome.out
