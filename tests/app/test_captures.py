"""Captures are loaded whole: COLMAP models of any kind, photographs of all sizes; what is wrong with one is named."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.cli.data_check import look_over
from pop_fast.cli.sfm import run as search
from pop_fast.data import Capture, CaptureError, View, initialize_params, load_capture
from pop_fast.data.camera_models import CAMERA_MODELS
from pop_fast.data.cameras import make_camera
from pop_fast.data.colmap import model_name, parameter_count, read_model
from pop_fast.data.load import list_capture
from pop_fast.data.read_images import find_masks, find_photographs
from pop_fast.errors import PopError
from pop_fast.io import images
from pop_fast.io.images import find_image
from tests.app.captures import (
    HEIGHT,
    PINHOLE,
    WIDTH,
    assert_one_line,
    camera,
    cloud,
    colmap_capture,
    edit_transforms,
    look_at,
    opengl,
    photograph,
    raw,
    ring,
    transforms_capture,
    write_model,
    write_photograph,
)
from tests.app.conftest import ROOT, in_a_child

K = np.array([[PINHOLE[0], 0.0, PINHOLE[2]], [0.0, PINHOLE[1], PINHOLE[3]], [0.0, 0.0, 1.0]])


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return colmap_capture(tmp_path / "scene")


@pytest.fixture
def text(tmp_path: Path) -> Path:
    """The same with a model in text."""
    return colmap_capture(tmp_path / "scene", binary=False)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return colmap_capture(tmp_path_factory.mktemp("shared"))


def names(capture: Capture) -> list[str]:
    return [view.name for view in capture.views]


def shows(capture: Capture, *numbers: int) -> bool:
    """Tell whether the views show the photographs of these numbers."""
    pairs = zip(capture.views, numbers or range(len(capture.views)), strict=True)
    return all(np.array_equal(view.image, photograph(i)) for view, i in pairs)


@pytest.mark.parametrize("binary", [True, False])
def test_a_model_is_loaded_as_it_was_written(tmp_path: Path, binary: bool) -> None:
    capture = raw(colmap_capture(tmp_path / "scene", binary=binary))
    assert capture.name == "scene"
    assert names(capture) == ["00.png", "01.png", "02.png", "03.png"]
    assert shows(capture)
    for view, viewmat in zip(capture.views, ring(4), strict=True):
        assert np.allclose(view.viewmat, viewmat, atol=1e-12)
        assert np.array_equal(view.K, K)
        assert view.mask is None
        assert view.seen is None
        assert np.allclose(view.camera_center, -viewmat[:3, :3].T @ viewmat[:3, 3])
    xyz, rgb = cloud()
    assert np.allclose(capture.points, xyz)
    assert np.array_equal(capture.points_rgb, rgb)
    assert np.array_equal(capture.world_transform, np.eye(4))
    assert capture.source == "COLMAP model: 4 views, 20 points"
    # the camera of a shot outlives the model it came from
    shots, _ = read_model(tmp_path / "scene" / "sparse" / "0")
    assert [shot.camera.params.tolist() for shot in shots] == [list(PINHOLE)] * 4


@pytest.mark.parametrize("binary", [True, False])
def test_poses_of_a_rig_and_the_points_seen_are_colmaps(tmp_path: Path, binary: bool) -> None:
    two = {"num_rigs": 1, "num_cameras_per_rig": 2, "num_frames_per_rig": 3, "num_points3D": 20, "track_length": 3}
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(**two))
    # an image may see a point at two places, and ids need not be without gaps; a row is that of the order of ids
    (first, *_), ids = model.images.values(), sorted(model.points3D)
    twice = next(i for i, seen in enumerate(first.points2D) if not seen.has_point3D())
    model.points3D[ids[3]].track.elements = [pycolmap.TrackElement(first.image_id, place) for place in (twice, 0)]
    model.delete_point3D(ids.pop(7))
    (model.write_binary if binary else model.write_text)(str(tmp_path))
    images = sorted(model.images.values(), key=lambda image: image.name)
    for image in images:
        write_photograph(tmp_path / image.name, photograph(image.image_id))
    capture = raw(tmp_path)
    for view, image in zip(capture.views, images, strict=True):
        assert view.name == image.name
        assert np.allclose(view.viewmat[:3], image.cam_from_world().matrix(), atol=1e-12)
        tracks = {i: {element.image_id for element in model.points3D[i].track.elements} for i in ids}
        assert view.seen.tolist() == [row for row, i in enumerate(ids) if image.image_id in tracks[i]]
    assert np.allclose(capture.points, [model.points3D[i].xyz for i in ids])
    assert np.array_equal(raw(tmp_path, photographs="none").views[1].seen, capture.views[1].seen)


@pytest.mark.parametrize("place", ["sparse/0", "sparse/1", "sparse", "colmap/sparse/0", "."])
def test_the_model_is_found_wherever_programs_put_it(root: Path, place: str) -> None:
    for file in (root / "sparse" / "0").iterdir():
        target = root / place / file.name
        target.parent.mkdir(parents=True, exist_ok=True)
        if target != file:
            file.rename(target)
    assert len(raw(root).views) == 4


@pytest.mark.parametrize("listed", [["left/a 1.png", "left/b.png", "right/a 1.png"], ["images/0.png", "images/1.png"]])
def test_subfolders_and_spaces_in_names_are_kept(tmp_path: Path, listed: list[str]) -> None:
    root = colmap_capture(tmp_path, names=listed)
    if (root / "images" / "images").is_dir():
        # as pop sfm names them in a capture whose photographs lie in `images`
        shutil.copytree(root / "images" / "images", root / "images", dirs_exist_ok=True)
        shutil.rmtree(root / "images" / "images")
    capture = raw(root)
    assert names(capture) == listed
    assert shows(capture)


def test_what_else_lies_in_the_folder_and_images_that_are_not_registered_are_left_out(text: Path) -> None:
    for name in ("00a.png", "unregistered.png"):
        write_photograph(text / "images" / name, photograph(9))
    assert names(raw(text)) == ["00.png", "01.png", "02.png", "03.png"]
    assert shows(raw(text))
    model = text / "sparse" / "0"
    # a model in text is preferred to an incomplete one in binary
    (model / "cameras.bin").write_bytes(b"left over")
    kept = [line for line in (model / "images.txt").read_text().splitlines() if not line.endswith("03.png")]
    (model / "images.txt").write_text("\n".join(kept) + "\n")
    for file in ("frames.txt", "rigs.txt"):
        (model / file).unlink()
    assert names(raw(text)) == ["00.png", "01.png", "02.png"]


def test_photographs_that_were_converted_are_found_unless_two_could_be_meant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(images, "can_read_heif", lambda: False)
    root = colmap_capture(tmp_path, names=["a.JPG", "b.jpeg", "c.png", "d.png"])
    for name in ("c.HEIC", "d.ARW"):
        # developed or converted since
        assert find_image(root / "images", name) == (root / "images" / name).with_suffix(".png")
    for old, new in (("a.JPG", "a.png"), ("b.jpeg", "b.PNG")):
        (root / "images" / old).unlink()
        cv2.imwrite(str(root / "images" / new.lower()), photograph(3)[..., ::-1])
        (root / "images" / new.lower()).rename(root / "images" / new)
    assert shows(raw(root), 3, 3, 2, 3)
    write_photograph(root / "images" / "b.tif", photograph(1))
    assert_one_line(lambda: raw(root), "b.jpeg", "b.PNG", "b.tif", "remove one")


def test_a_folder_of_many_photographs_is_listed_once(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in list((root / "images").iterdir()):
        path.rename(path.with_suffix(".jpg"))
        write_photograph(root / "masks" / f"{path.stem}.png.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    looked, iterdir = [], Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda path: looked.append(path) or iterdir(path))
    shots = list_capture(root).shots
    for find, folder in (
        (lambda: find_photographs(root, shots), "images"),
        (lambda: find_masks(root / "masks", shots), "masks"),
    ):
        looked.clear()
        assert all(find())
        assert looked == [root / folder]


def test_absent_photographs_are_an_error_or_are_skipped_with_a_note(root: Path) -> None:
    (root / "images" / "00.png").unlink()
    assert_one_line(lambda: raw(root), "lists 4 images, 1 of them absent", "00.png", "--missing skip")
    capture = raw(root, missing="skip")
    assert names(capture) == ["01.png", "02.png", "03.png"]
    assert shows(capture, 1, 2, 3)
    assert capture.notes == ("1 of 4 listed images are absent and were skipped",)
    for name in ("01.png", "02.png"):
        (root / "images" / name).unlink()
    assert_one_line(lambda: raw(root, missing="skip"), "1 of 4 photographs is left", "two or more")
    (root / "images" / "03.png").unlink()
    assert_one_line(lambda: raw(root, missing="skip"), "4 of them absent", "restore them")


@pytest.mark.parametrize("folder", [".", "stills"])
def test_photographs_that_lie_in_another_folder_than_listed_are_found_by_name(tmp_path: Path, folder: str) -> None:
    root = transforms_capture(tmp_path / "scene")
    (root / folder).mkdir(exist_ok=True)
    for photo in list((root / "images").iterdir()):
        photo.rename(root / folder / photo.name)
    asked = f"00.png lies in {root / folder}: pass --images {folder}"
    message = assert_one_line(lambda: raw(root), "4 of them absent", asked)
    assert "skip" not in message
    (problem,) = [found for found in look_over(root) if "are absent" in found.text]
    assert problem.text.endswith(asked)
    assert shows(raw(root, images=folder), 0, 1, 2, 3)


@given(factor=st.integers(1, 12))
def test_shrinking_keeps_every_point_of_the_scene_at_its_place_in_the_picture(factor: int, shared: Path) -> None:
    for view in raw(shared, factor=factor).views:
        assert view.width == round(WIDTH / factor)
        assert view.height == round(HEIGHT / factor)
        # relative to the picture's width and height, K stays exactly the same
        assert np.allclose(view.K[0] / view.width, K[0] / WIDTH, rtol=1e-14)
        assert np.allclose(view.K[1] / view.height, K[1] / HEIGHT, rtol=1e-14)


def test_shrinking_averages_areas_or_takes_a_folder_of_shrunk_photographs_and_tells(root: Path) -> None:
    here = raw(root, factor=2)
    want = photograph(1).astype(float).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
    assert np.abs(here.views[1].image - want).max() <= 0.5 + 1e-6
    assert load_capture(root).notes == ()
    assert here.notes == ("the photographs of images/ are shrunk by 2 here",)
    for i in range(4):
        write_photograph(root / "images_2" / f"{i:02d}.jpg", photograph(i + 10, 20, 15))
    exact = raw(root, factor=2)
    (note,) = exact.notes
    assert note.startswith("the photographs of images_2/ are used, which were shrunk earlier")
    assert exact.views[0].image.shape == (15, 20, 3)
    assert not np.array_equal(exact.views[0].image, raw(root, factor=2, images="images").views[0].image)
    assert np.allclose(exact.views[0].K[:2], K[:2] / 2.0)
    named = raw(root, factor=1, images="images_2")
    assert np.array_equal(named.views[0].image, exact.views[0].image)
    assert raw(root, factor=2, images="images_2/").views[0].image.shape == (15, 20, 3)
    (root / "images_2" / "03.jpg").unlink()
    assert_one_line(lambda: raw(root, factor=2), "images_2", "03.png")
    assert np.array_equal(raw(root, factor=2, missing="skip").views[2].image, exact.views[2].image)


def test_photographs_beside_their_model_have_no_folder_to_name(root: Path) -> None:
    for path in (root / "images").iterdir():
        path.rename(root / path.name)
    (root / "images").rmdir()
    assert load_capture(root, factor=2).notes == ("the photographs are shrunk by 2 here",)


def test_every_photograph_is_scaled_by_its_own_size_and_one_of_another_shape_is_refused(root: Path) -> None:
    write_photograph(root / "images" / "01.png", photograph(1, 2 * WIDTH, 2 * HEIGHT))
    write_photograph(root / "images" / "02.png", photograph(2, 20, 15))
    views = raw(root).views
    assert [(view.width, view.height) for view in views] == [(40, 30), (80, 60), (20, 15), (40, 30)]
    for view, scale in zip(views, (1.0, 2.0, 0.5, 1.0), strict=True):
        assert np.allclose(view.K[:2], K[:2] * scale)
    write_photograph(root / "images" / "02.png", photograph(2, HEIGHT, WIDTH))
    assert_one_line(lambda: raw(root), "02.png", "30x40", "40x30", "rotated")


def test_rounding_of_shrunk_sizes_is_no_other_shape(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, cameras=[camera(params=(4000.0, 4000.0, 2473.0, 1643.0), width=4946, height=3286)])
    for i in range(4):
        write_photograph(root / "images" / f"{i:02d}.png", photograph(i, 618, 410))
    assert np.allclose(raw(root).views[0].K[0, 2], 309.0)


def test_cameras_of_several_sizes_live_in_one_capture(tmp_path: Path) -> None:
    write_photograph(tmp_path / "images" / "a.png", photograph(0))
    write_photograph(tmp_path / "images" / "b.png", photograph(1, 60, 80))
    cameras = [camera(), camera("SIMPLE_PINHOLE", (60.0, 30.0, 40.0), 60, 80)]
    write_model(tmp_path / "sparse" / "0", ["a.png", "b.png"], ring(2), cameras)
    first, second = raw(tmp_path, factor=2).views
    assert first.image.shape == (15, 20, 3)
    assert second.image.shape == (40, 30, 3)
    assert np.allclose(second.K, [[30.0, 0.0, 15.0], [0.0, 30.0, 20.0], [0.0, 0.0, 1.0]])


def test_every_eighth_file_by_name_is_held_out_beginning_with_the_first(tmp_path: Path) -> None:
    ordered = sorted(f"{i}.png" for i in range(17))
    capture = raw(colmap_capture(tmp_path, names=[f"{i}.png" for i in range(17)]))
    held = [ordered[0], ordered[8], ordered[16]]
    assert [view.name for view in capture.test_views()] == held
    assert {view.name for view in capture.train_views()} == set(ordered) - set(held)
    assert capture.test_views(0) == ()
    assert capture.train_views(0) == capture.views
    assert len(capture.test_views(5)) == 4


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV_FISHEYE", "FOV", "THIN_PRISM_FISHEYE"])
def test_distorted_cameras_give_pinhole_views_of_the_same_size(tmp_path: Path, model: str) -> None:
    terms = {"SIMPLE_RADIAL": (0.05,), "OPENCV_FISHEYE": (0.01, 0.0, 0.0, 0.0), "FOV": (0.4,)}.get(model, (0.01,) * 8)
    focal = (36.0,) if model == "SIMPLE_RADIAL" else (36.0, 36.0)
    root = colmap_capture(tmp_path, cameras=[camera(model, (*focal, 20.5, 14.25, *terms))])
    write_photograph(root / "masks" / "00.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    view = raw(root).views[0]
    assert view.image.shape == (HEIGHT, WIDTH, 3)
    assert view.K[:2, 2].tolist() == [20.5, 14.25]
    assert view.mask.all()
    assert not np.array_equal(view.image, photograph(0))


def test_progress_is_told_and_loading_twice_gives_the_same_bits(shared: Path) -> None:
    told: list[tuple[str, int, int]] = []
    first = load_capture(shared, factor=2, progress=lambda *what: told.append(what))
    assert told == [("reading photographs", i, 4) for i in range(1, 5)]
    second = load_capture(shared, factor=2)
    assert np.array_equal(first.points, second.points)
    for a, b in zip(first.views, second.views, strict=True):
        assert np.array_equal(a.image, b.image)
        assert np.array_equal(a.viewmat, b.viewmat)


# Which model and which photographs of a capture are used, and what is told about those that are not.


@pytest.mark.parametrize("binary", [True, False])
def test_the_model_with_the_most_images_is_used_and_the_others_are_told(tmp_path: Path, binary: bool) -> None:
    root = colmap_capture(tmp_path, count=5, binary=binary)
    sparse = root / "sparse"
    (sparse / "0").rename(sparse / "10")
    write_model(sparse / "0", ["00.png", "01.png"], ring(2), binary=binary)
    shutil.copytree(sparse / "10", sparse / "9")
    (sparse / "3").mkdir()
    (sparse / "3" / "images.bin").write_bytes(b"cut")
    capture = load_capture(root)
    assert len(capture.views) == 5
    assert capture.notes == (
        "of 4 COLMAP models the one with the most images is used, sparse/9 (5), not sparse/10 (5), sparse/0 (2), "
        "sparse/3 (unreadable)",
    )


@pytest.mark.parametrize("folder", ["images", "."])
def test_photographs_without_a_camera_are_told(tmp_path: Path, folder: str) -> None:
    root = colmap_capture(tmp_path, names=["0.png", "left/1.png", "2.png"])
    write_photograph(root / "images" / "left" / "0.png", photograph(9))
    write_photograph(root / "images" / "9.png", photograph(9))
    # a photograph that was converted since is no other one
    (root / "images" / "2.png").unlink()
    write_photograph(root / "images" / "2.bmp", photograph(2))
    if folder == ".":
        shutil.copytree(root / "images", root, dirs_exist_ok=True)
        shutil.rmtree(root / "images")
    (note,) = load_capture(root).notes
    assert note.startswith(f"3 of 5 photographs in {root / folder} are placed")
    assert load_capture(root).unplaced == 2
    assert note.endswith("the model has no camera for 9.png, left/0.png")


def test_photographs_without_a_mask_are_told_where_others_have_one(root: Path) -> None:
    white = np.full((HEIGHT, WIDTH), 255, np.uint8)
    write_photograph(root / "masks" / "01.png", white)
    first = root / "images" / "00.png"
    assert load_capture(root).notes == (f"3 of 4 photographs have no mask and count in full, first {first}",)
    for i in range(4):
        write_photograph(root / "masks" / f"{i:02d}.png", white)
    assert load_capture(root).notes == ()


def test_random_points_of_cameras_that_look_the_same_way_are_told(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path)
    assert load_capture(root, points=500).notes == ()

    def in_a_row(listing) -> None:
        for i, frame in enumerate(listing["frames"]):
            frame["transform_matrix"] = opengl(look_at((0.3 * i, -5.0, 0.1 * i), (0.3 * i, 0.0, 0.0)))

    edit_transforms(root, in_a_row)
    (note,) = load_capture(root, points=500).notes
    assert "all cameras look about the same way" in note
    assert "pop sfm" in note


# Pinhole cameras without pycolmap: what pycolmap says of them, and captures that load where it is not installed.

PARAMS = {"SIMPLE_PINHOLE": [31.5, 20.25, 11.0], "PINHOLE": [31.5, 30.0, 20.25, 11.0]}
# stands in for an environment without them
LOAD = """
import sys
sys.modules.update(dict.fromkeys(("pycolmap", "plyfile")))
from pop_fast.data import load_capture
print([len(load_capture(folder).views) for folder in sys.argv[1:]])
"""


@pytest.mark.parametrize("name", PARAMS)
def test_a_pinhole_is_pycolmaps_pinhole(name):
    number = int(pycolmap.CameraModelId.__members__[name])
    assert (CAMERA_MODELS[name].number, model_name(number)) == (number, name)
    ours = make_camera(7, name, 40, 22, PARAMS[name])
    theirs = pycolmap.Camera(camera_id=7, model=name, width=40, height=22, params=PARAMS[name])
    assert not isinstance(ours, pycolmap.Camera)
    assert parameter_count(name) == len(theirs.params)
    fields = ("camera_id", "model_name", "width", "height", "focal_length_x", "focal_length_y")
    for field in (*fields, "principal_point_x", "principal_point_y"):
        assert getattr(ours, field) == getattr(theirs, field), field
    assert ours.params.tolist() == list(theirs.params)
    assert list(ours.focal_length_idxs()) == list(theirs.focal_length_idxs())
    assert ours.mean_focal_length() == theirs.mean_focal_length()
    points = np.random.default_rng(0).uniform(0.5, 3.0, (50, 3))
    np.testing.assert_allclose(ours.img_from_cam(points), theirs.img_from_cam(points), rtol=1e-14)


def test_other_models_are_pycolmaps_own():
    assert isinstance(make_camera(1, "OPENCV", 8, 8, [9.0, 9.0, 4.0, 4.0, 0.1, 0.0, 0.0, 0.0]), pycolmap.Camera)
    assert model_name(4) == "OPENCV"
    assert parameter_count("OPENCV") == 8
    assert model_name(1000) is None


def test_captures_of_pinholes_load_without_pycolmap_and_plyfile_and_a_lens_that_needs_it_says_so(shared, tmp_path):
    done = in_a_child(LOAD, shared, transforms_capture(tmp_path / "transforms"))
    assert done.out == "[4, 4]\n", done.err
    (tmp_path / "sparse").mkdir()
    lines = {"cameras": "1 OPENCV 8 8 9 9 4 4 0.1 0 0 0\n", "images": "1 1 0 0 0 0 0 0 1 a.png\n\n", "points3D": ""}
    for name, content in lines.items():
        (tmp_path / "sparse" / f"{name}.txt").write_text(content)
    done = in_a_child(LOAD, tmp_path)
    assert done.status != 0
    assert "CaptureError: pycolmap, which finds cameras" in done.err
    assert "pip install pycolmap" in done.err


# Whatever is wrong with a capture is said in one line that names the file, the field and the fix.


def test_every_message_is_one_line_whatever_it_was_made_from() -> None:
    assert str(PopError("a\n  b\tc")) == "a b c"
    assert issubclass(CaptureError, PopError)
    assert issubclass(PopError, ValueError)


def test_a_missing_folder_a_file_an_empty_folder_and_an_absent_source_are_told_apart(tmp_path: Path) -> None:
    assert_one_line(lambda: load_capture(tmp_path / "absent"), "absent", "no such folder")
    (tmp_path / "file").write_text("")
    assert_one_line(lambda: load_capture(tmp_path / "file"), "file", "not a folder")
    (tmp_path / "photos").mkdir()
    assert_one_line(lambda: load_capture(tmp_path / "photos"), "photos", "no photographs", "no COLMAP model")
    write_photograph(tmp_path / "photos" / "a.png", photograph(0))
    assert_one_line(lambda: load_capture(tmp_path / "photos", source="colmap"), "no COLMAP model", "pop sfm")
    assert_one_line(lambda: load_capture(tmp_path / "photos", source="transforms"), "no transforms.json")
    assert_one_line(lambda: load_capture(tmp_path / "photos"), "1 photographs", "pop sfm")


def test_a_folder_of_captures_names_them_and_the_command_unless_all_photographs_are_asked_for(tmp_path: Path) -> None:
    for name in ("a walk", "b"):
        colmap_capture(tmp_path / name)
    write_photograph(tmp_path / "more" / "0.png", photograph(0))
    found = assert_one_line(lambda: load_capture(tmp_path), "captures in it have theirs (a walk, b)", "--source photos")
    assert f"pop train '{tmp_path / 'a walk'}'" in found
    assert_one_line(lambda: load_capture(tmp_path, source="photos"), "has 9 photographs but no cameras")
    assert_one_line(lambda: search([str(tmp_path)]), "captures in it have theirs (a walk, b)")


def test_cameras_of_the_photographs_in_a_folder_beside_them_are_named_before_they_are_searched(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path / "dense").parent
    (root / "images").mkdir()
    write_photograph(root / "images" / "other.png", photograph(0))
    assert_one_line(lambda: load_capture(root), "1 photographs but no cameras")
    write_photograph(root / "images" / "00.png", photograph(0))
    assert_one_line(lambda: load_capture(root), "a capture in it has its own (dense)", f"pop train {root / 'dense'}")
    # but for the place that the search is to write to
    assert_one_line(lambda: search([str(root), "--out", str(root / "dense")]), "did not write")


def test_a_world_too_far_from_its_origin_for_float32_is_told(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path)
    assert raw(root).notes == ()
    moved = np.array([5e5, 5.4e6, 300.0])
    edit_transforms(root, lambda listing: [place(frame, moved) for frame in listing["frames"]])
    assert "steps of 0.5: leave out --no-normalize" in raw(root).notes[-1]
    assert load_capture(root).notes == ()


def place(frame: dict[str, Any], moved: np.ndarray) -> None:
    for row, more in zip(frame["transform_matrix"], moved, strict=False):
        row[3] += more


def test_points_that_no_camera_can_have_measured_are_left_out_and_told(tmp_path: Path) -> None:
    xyz, rgb = cloud()
    usual = load_capture(colmap_capture(tmp_path / "usual"))
    astray = (np.insert(xyz, 3, [1e13, 0.0, 0.0], axis=0), np.insert(rgb, 3, 255, axis=0))
    root = colmap_capture(tmp_path / "astray", points=astray, binary=False)
    path = root / "sparse" / "0" / "points3D.txt"
    seen = ("4 ", "6 ")  # the fourth is the one astray
    lines = [f"{line} 1 0" if line.startswith(seen) else line for line in path.read_text().splitlines()]
    path.write_text("\n".join(lines))
    found = load_capture(root)
    assert "1 of 21 sparse points left out" in found.notes[-1]
    assert np.array_equal(found.points, usual.points)
    assert np.array_equal(found.views[0].viewmat, usual.views[0].viewmat)
    assert [list(view.seen) for view in found.views[:2] if view.seen is not None] == [[4], []]


def test_a_model_without_photographs_is_named(root: Path) -> None:
    (root / "images").rename(root / "pictures")
    assert_one_line(lambda: load_capture(root), str(root / "images"), "--images")
    assert_one_line(lambda: load_capture(root, images="photos"), str(root / "photos"), "--images")
    assert len(load_capture(root, images="pictures").views) == 4


@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("binary", [True, False])
def test_an_absent_file_of_a_model_is_named(tmp_path: Path, file: str, binary: bool) -> None:
    root = colmap_capture(tmp_path, binary=binary)
    (root / "sparse" / "0" / f"{file}{'.bin' if binary else '.txt'}").unlink()
    assert_one_line(lambda: load_capture(root, source="colmap"), file, "absent")


def test_fewer_than_two_views_and_cameras_that_did_not_move_are_refused(tmp_path: Path) -> None:
    assert_one_line(
        lambda: load_capture(colmap_capture(tmp_path / "a", count=1)), "sparse", "has 1 view", "two or more"
    )
    assert_one_line(lambda: load_capture(transforms_capture(tmp_path / "b", count=1)), "transforms.json", "has 1 view")
    root = colmap_capture(tmp_path / "c")
    write_model(root / "sparse" / "0", ["00.png", "01.png"], ring(1)[[0, 0]])
    assert_one_line(lambda: load_capture(root), "sparse", "one place")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"factor": 0}, ("factor is 0", "at least 1")),
        ({"factor": 1.5}, ("factor is 1.5", "whole number")),
        ({"factor": 1000}, ("40x30", "factor 1000")),
        ({"missing": "ignore"}, ("missing is 'ignore'", "'skip'")),
        ({"background": (0.0, 0.0, 255.0)}, ("background", "[0, 1]")),
        ({"background": (0.0,)}, ("background", "three numbers")),
    ],
)
def test_impossible_options_are_named(shared: Path, options: dict[str, Any], words: tuple[str, ...]) -> None:
    assert_one_line(lambda: load_capture(shared, **options), *words)


def test_a_lens_that_folds_the_image_is_named_with_its_photograph(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, cameras=[camera("SIMPLE_RADIAL", (2.0, 20.0, 15.0, -0.9))])
    assert_one_line(lambda: load_capture(root), ".png", "SIMPLE_RADIAL", "folds", "undistort")


def refused(root: Path, file: str, damage: Callable[[bytes], bytes], *words: str) -> None:
    """Damage a file of a model, try to load it, and repair it."""
    path = root / "sparse" / "0" / file
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    try:
        assert_one_line(lambda: load_capture(root), file, *words)
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
@given(cut=st.floats(0.0, 1.0, exclude_max=True))
def test_a_model_file_cut_anywhere_or_with_more_than_it_says_is_named(file: str, cut: float, shared: Path) -> None:
    refused(shared, file, lambda data: data[: int(cut * len(data))], "truncated")
    refused(shared, file, lambda data: data + b"more", "4 bytes too many")
    if file not in ("rigs.bin", "frames.bin"):
        # an absurd count asks for no memory
        refused(shared, file, lambda data: struct.pack("<Q", 2**60) + data[8:])


@pytest.mark.parametrize(
    ("file", "offset", "value", "words"),
    [
        ("cameras.bin", 12, struct.pack("<i", 77), ("camera 1", "unknown camera model 77")),
        ("cameras.bin", 12, struct.pack("<i", -2), ("unknown camera model -2",)),
        ("cameras.bin", 16, struct.pack("<Q", 0), ("camera 1 (PINHOLE)", "0x30 px")),
        ("cameras.bin", 32, struct.pack("<d", np.nan), ("params[0] is nan",)),
        ("cameras.bin", 48, struct.pack("<d", np.inf), ("params[2] is inf",)),
        ("cameras.bin", 48, struct.pack("<d", 1e200), ("params[2] is 1e+200", "within")),
        ("cameras.bin", 32, struct.pack("<d", 0.0), ("focal length 0.0", "> 0")),
        ("cameras.bin", 40, struct.pack("<d", -5.0), ("focal length -5.0",)),
        ("points3D.bin", 16, struct.pack("<d", np.nan), ("point 1", "X is nan")),
        ("points3D.bin", 16, struct.pack("<d", 1e200), ("point 1", "X is 1e+200", "within")),
        ("points3D.bin", 51, struct.pack("<Q", 2**63), ("truncated",)),
        ("images.bin", 12, struct.pack("<d", np.nan), ("image 1 (00.png)", "quaternion", "nan")),
        ("images.bin", 12, bytes(32), ("image 1 (00.png)", "quaternion QW QX QY QZ", "not zero")),
        ("images.bin", 44, struct.pack("<d", -1e200), ("image 1 (00.png)", "translation", "-1e+200")),
        ("images.bin", 68, struct.pack("<I", 9), ("image 1 (00.png)", "CAMERA_ID 9", "cameras.bin")),
        ("images.bin", 72, b"\xfc", ("image 1", "\\xfc", "not UTF-8")),
    ],
)
def test_a_wrong_field_is_named_in_binary(shared, file, offset, value, words):
    refused(shared, file, lambda data: data[:offset] + value + data[offset + len(value) :], *words)


# COLMAP models in text, which people write by hand: what is wrong is named by file, line and field.


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("cameras.txt", "PINHOLE", "PINHOLES", ("line 4", "MODEL is 'PINHOLES'", "SIMPLE_RADIAL")),
        (
            "cameras.txt",
            "1 PINHOLE 40 30 36 35 20.5 14.25",
            f"{2**32} SIMPLE_RADIAL 40 30 36 20 15 0",
            ("CAMERA_ID is 429",),
        ),
        ("cameras.txt", "36", "abc", ("line 4", "PARAMS[0] is 'abc'", "a number")),
        ("cameras.txt", "36", "NaN", ("camera 1 (PINHOLE)", "params[0] is nan")),
        ("cameras.txt", " 14.25", "", ("line 4", "PARAMS[] has 3 numbers", "PINHOLE has 4")),
        ("cameras.txt", " 40 30 ", " 0 30 ", ("0x30",)),
        ("cameras.txt", " 40 30 ", " 40.5 30 ", ("WIDTH is '40.5'", "whole number")),
        ("cameras.txt", " 30 36 35 20.5 14.25", "", ("line 4", "HEIGHT is absent", "CAMERA_ID, MODEL, WIDTH")),
        ("images.txt", " 1 00.png", " 9 00.png", ("image 1 (00.png)", "CAMERA_ID 9", "cameras.txt")),
        ("images.txt", " 1 00.png", " 1 01.png", ("01.png", "listed twice")),
        ("images.txt", " 1 00.png", " 00.png", ("line 5", "NAME is absent")),
        ("points3D.txt", "1 ", "one ", ("line 4", "POINT3D_ID is 'one'", "whole number")),
        ("points3D.txt", None, " 1", ("line 4", "TRACK[] has 1 numbers", "IMAGE_ID, POINT2D_IDX")),
        ("points3D.txt", None, " x 0", ("line 4", "TRACK[] IMAGE_ID is 'x'", "whole number")),
    ],
)
def test_a_wrong_field_is_named(text: Path, file: str, old: str | None, new: str, words: tuple[str, ...]) -> None:
    path = text / "sparse" / "0" / file
    lines = path.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    assert old is None or old in lines[first]
    # None: at the end of the first record
    lines[first] = lines[first].rstrip() + new if old is None else lines[first].replace(old, new, 1)
    path.write_text("\n".join(lines) + "\n")
    assert_one_line(lambda: load_capture(text), file, *words)


def test_a_file_without_records_and_one_in_another_encoding_are_named(text: Path) -> None:
    cameras = text / "sparse" / "0" / "cameras.txt"
    whole = cameras.read_text()
    cameras.write_text("")
    assert_one_line(lambda: load_capture(text), "images.txt", "image 1 (00.png)", "CAMERA_ID 1", "cameras.txt")
    cameras.write_bytes(b"# K\xfcche\n" + whole.encode())
    assert_one_line(lambda: load_capture(text), "cameras.txt", "not UTF-8")


def test_images_without_the_empty_line_for_observations_are_refused_and_not_halved(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, names=["0.png", "1 b.png", "2 b c.png", "3.png"], binary=False)
    path = root / "sparse" / "0" / "images.txt"
    lines = [line for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    for last in lines[1:4]:
        path.write_text(f"{lines[0]}\n{last}\n")
        assert_one_line(lambda: load_capture(root), "images.txt", "line 2", "POINTS2D", "0.png", "empty line")


def test_names_with_spaces_comments_and_other_line_ends_are_read(tmp_path: Path) -> None:
    listed = ["a b.png", "left/c  d.png", "Küche.png"]
    root = colmap_capture(tmp_path, names=listed, binary=False)
    for file in (root / "sparse" / "0").iterdir():
        content = "\ufeff  # by hand\n\n" + file.read_text(encoding="utf-8")
        file.write_bytes(content.replace("\n", "\r\n").encode())
    assert set(names(load_capture(root))) == set(listed)


def rewrite_quaternions(root: Path, change: Callable[[list[str]], list[str]]) -> None:
    path = root / "sparse" / "0" / "images.txt"
    lines = path.read_text().split("\n")
    for i, line in enumerate(lines):
        words = line.split()
        if len(words) == 10 and words[-1].endswith(".png"):
            lines[i] = " ".join([words[0], *change(words[1:5]), *words[5:]])
    path.write_text("\n".join(lines))


@pytest.mark.parametrize("scale", [2.0, 0.001, 1e200, None])
def test_quaternions_of_any_norm_are_the_rotation_they_mean(text: Path, scale: float | None) -> None:
    rewrite_quaternions(text, lambda quat: [f"{scale * float(q)}" if scale else f"{float(q):.3f}" for q in quat])
    for view, viewmat in zip(raw(text).views, ring(4), strict=True):
        R = view.viewmat[:3, :3]
        assert np.abs(R @ R.T - np.eye(3)).max() < 1e-14
        assert np.allclose(view.viewmat, viewmat, atol=1e-12 if scale else 3e-3)


@pytest.mark.parametrize("quat", ["0", "1e-200", "nan"])
def test_a_quaternion_that_is_no_rotation_is_named(text: Path, quat: str) -> None:
    rewrite_quaternions(text, lambda _: [quat] * 4)
    assert_one_line(lambda: load_capture(text), "images.txt", "image 1 (00.png)", "quaternion QW QX QY QZ", "not zero")


# Real photographs, where they lie next to the repository: loaded whole, posed right, quickly.

DATA = ROOT.parent / "shared" / "data"


def real(name: str) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"the real capture {name} is not at {DATA}")
    return DATA / name


def pixels_of(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points appear: indices of those inside the picture, and their rows and columns. [M], [2, M]"""
    p = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    front = np.flatnonzero(p[:, 2] > 1e-3)
    x, y = (p[front] @ view.K.T)[:, :2].T / p[front, 2]
    inside = (x >= 0.0) & (x < view.width) & (y >= 0.0) & (y < view.height)
    return front[inside], np.stack([y[inside], x[inside]]).astype(int)


def color_errors(capture: Capture) -> list[float]:
    """Median colour error of points where they project, and where they would in a mirror and upside down."""
    errors: list[list[float]] = [[], [], []]
    for view in capture.views[::5]:
        which, (row, column) = pixels_of(view, capture.points)
        places = ((row, column), (row, view.width - 1 - column), (view.height - 1 - row, column))
        for found, place in zip(errors, places, strict=True):
            off = np.abs(view.image[place].astype(float) - capture.points_rgb[which]).mean(axis=1)
            found.append(float(np.median(off)))
    return [float(np.mean(found)) for found in errors]


@pytest.mark.parametrize(
    ("name", "factor", "views", "size", "points", "tests"),
    [
        ("fox", 4, 50, (270, 480), 12_174, 7),
        ("bear_512", 2, 96, (256, 256), 34_174, 12),
        ("m360_garden_512", 4, 185, (128, 128), 138_766, 24),
        ("m360_bonsai_800", 4, 292, (200, 133), 109_926, 37),
    ],
)
def test_a_real_capture_is_loaded_whole_and_its_points_project_onto_their_colours(
    name, factor, views, size, points, tests
):
    capture = load_capture(real(name), factor=factor)
    assert len(capture.views) == views
    assert len(capture.test_views()) == tests
    assert len(capture.train_views()) == views - tests
    assert {(view.width, view.height) for view in capture.views} == {size}
    assert capture.points.shape == (points, 3)
    inside = [len(pixels_of(view, capture.points)[0]) / points for view in capture.views[::5]]
    assert np.mean(inside) > 0.3
    here, mirrored, upended = color_errors(capture)
    assert here < 0.75 * min(mirrored, upended)
    # normalised: cameras about one unit away, the points around the origin
    assert 0.5 < capture.scene_scale() < 3.0
    assert np.abs(np.median(capture.points, axis=0)).max() < 0.5
    params = initialize_params(capture)
    assert all(bool(value.isfinite().all()) for value in params.values())


def test_both_routes_to_fox_agree_on_the_cameras_up_to_a_similarity_where_absent_photographs_are_skipped() -> None:
    root = real("fox")
    absent = ("lists 67 images, 17 of them absent", "images/0005.jpg", "--missing skip")
    options = {"factor": 8, "normalize": False}
    assert_one_line(lambda: load_capture(root, source="transforms"), str(root / "transforms.json"), *absent)
    model = load_capture(root, **options)
    listing = load_capture(root, source="transforms", missing="skip", **options)
    assert len(listing.views) == 50
    assert listing.notes[0] == "17 of 67 listed images are absent and were skipped"
    assert "no points: 30000 random ones (seed 0)" in listing.source
    by_name = {Path(view.name).name: view.camera_center for view in listing.views}
    a = model.camera_centers
    b = np.stack([by_name[view.name] for view in model.views])
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    assert np.linalg.det(U @ Vt) > 0.0  # no mirror between them
    scale = S.sum() / (a**2).sum()
    assert np.abs(scale * a @ (U @ Vt).T - b).max() < 0.05 * np.abs(b).max()
    assert model.views[0].K[0, 0] == pytest.approx(listing.views[0].K[0, 0], rel=0.02)
