"""COLMAP captures: models of any kind, photographs paired by name, sizes of every kind."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.data import Capture, load_capture
from pop_fast.data.cameras import PINHOLES, make_camera
from pop_fast.data.colmap import model_name, parameter_count, read_model
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
    ring,
    transforms_capture,
    write_model,
    write_photograph,
)

K = np.array([[PINHOLE[0], 0.0, PINHOLE[2]], [0.0, PINHOLE[1], PINHOLE[3]], [0.0, 0.0, 1.0]])


def raw(root: Path, **options) -> Capture:
    """Load in the capture's own frame."""
    return load_capture(root, normalize=False, **options)


@pytest.mark.parametrize("binary", [True, False])
def test_a_model_is_loaded_as_it_was_written(tmp_path: Path, binary: bool) -> None:
    capture = raw(colmap_capture(tmp_path / "scene", binary=binary))
    assert capture.name == "scene"
    assert [view.name for view in capture.views] == ["00.png", "01.png", "02.png", "03.png"]
    for i, (view, viewmat) in enumerate(zip(capture.views, ring(4), strict=True)):
        assert np.allclose(view.viewmat, viewmat, atol=1e-12)
        assert np.array_equal(view.K, K)
        assert np.array_equal(view.image, photograph(i))
        assert view.mask is None
        assert np.allclose(view.camera_center, -viewmat[:3, :3].T @ viewmat[:3, 3])
    xyz, rgb = cloud()
    assert np.allclose(capture.points, xyz)
    assert np.array_equal(capture.points_rgb, rgb)
    assert np.array_equal(capture.world_transform, np.eye(4))
    assert capture.source == "COLMAP model: 4 views, 20 points"


@pytest.mark.parametrize("binary", [True, False])
def test_a_view_knows_the_points_that_it_sees_where_the_model_has_tracks(tmp_path: Path, binary: bool) -> None:
    root = colmap_capture(tmp_path / "scene", binary=binary)
    assert all(view.seen is None for view in raw(root).views)
    model = pycolmap.Reconstruction(root / "sparse" / "0")
    tracks = {9: [2, 1, 1], 5: [2], 17: [4, 2]}
    for point, images in tracks.items():
        # an image may see a point at two places; its row is that of the order of ids
        elements = [pycolmap.TrackElement(image, place) for place, image in enumerate(images)]
        model.points3D[point].track.elements = elements
    (model.write_binary if binary else model.write_text)(str(root / "sparse" / "0"))
    ids = sorted(model.points3D)
    wanted = {1: [9], 2: [5, 9, 17], 3: [], 4: [17]}
    capture = raw(root)
    for number, view in enumerate(capture.views, start=1):
        assert [ids[row] for row in view.seen] == wanted[number]
    assert np.allclose(capture.points[ids.index(9)], model.points3D[9].xyz)
    assert np.array_equal(raw(root, photographs="none").views[1].seen, capture.views[1].seen)


@pytest.mark.parametrize("place", ["sparse/0", "sparse/1", "sparse", "colmap/sparse/0", "."])
def test_the_model_is_found_wherever_programs_put_it(tmp_path: Path, place: str) -> None:
    root = colmap_capture(tmp_path / "scene")
    for file in (root / "sparse" / "0").iterdir():
        target = root / place / file.name
        target.parent.mkdir(parents=True, exist_ok=True)
        if target != file:
            file.rename(target)
    assert len(raw(root).views) == 4


def test_a_model_in_text_is_preferred_to_an_incomplete_one_in_binary(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, binary=False)
    (root / "sparse" / "0" / "cameras.bin").write_bytes(b"left over")
    assert len(raw(root).views) == 4


def test_subfolders_and_spaces_in_names_are_kept(tmp_path: Path) -> None:
    names = ["left/a 1.png", "left/b.png", "right/a 1.png"]
    capture = raw(colmap_capture(tmp_path, names=names))
    assert [view.name for view in capture.views] == names
    assert all(np.array_equal(view.image, photograph(i)) for i, view in enumerate(capture.views))


def test_names_that_begin_with_the_folder_of_the_photographs_are_found(tmp_path: Path) -> None:
    # as pop sfm finds them in a capture whose photographs lie in `images`
    root = colmap_capture(tmp_path, names=["images/0.png", "images/1.png"])
    for photo in (root / "images" / "images").iterdir():
        photo.rename(root / "images" / photo.name)
    (root / "images" / "images").rmdir()
    capture = raw(root)
    assert [view.name for view in capture.views] == ["images/0.png", "images/1.png"]
    assert all(np.array_equal(view.image, photograph(i)) for i, view in enumerate(capture.views))


def test_photographs_are_paired_by_name_whatever_else_lies_in_the_folder(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    write_photograph(root / "images" / "00a.png", photograph(9))
    write_photograph(root / "images" / "unregistered.png", photograph(10))
    capture = raw(root)
    assert [view.name for view in capture.views] == ["00.png", "01.png", "02.png", "03.png"]
    assert all(np.array_equal(view.image, photograph(i)) for i, view in enumerate(capture.views))


def test_photographs_converted_to_another_format_are_found(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, names=["a.JPG", "b.jpeg"])
    for old, new in (("a.JPG", "a.png"), ("b.jpeg", "b.PNG")):
        (root / "images" / old).unlink()
        cv2.imwrite(str(root / "images" / new.lower()), photograph(3)[..., ::-1])
        (root / "images" / new.lower()).rename(root / "images" / new)
    assert all(np.array_equal(view.image, photograph(3)) for view in raw(root).views)


def test_two_files_that_could_stand_for_an_absent_one_are_named(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    (root / "images" / "01.png").unlink()
    write_photograph(root / "images" / "01.bmp", photograph(1))
    write_photograph(root / "images" / "01.tif", photograph(1))
    assert_one_line(lambda: raw(root), "01.png", "01.bmp", "01.tif", "remove one")


def test_absent_photographs_are_an_error_or_are_skipped_with_a_note(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    (root / "images" / "00.png").unlink()
    assert_one_line(lambda: raw(root), "lists 4 images, 1 of them absent", "00.png", "--missing skip")
    capture = raw(root, missing="skip")
    assert [view.name for view in capture.views] == ["01.png", "02.png", "03.png"]
    assert np.array_equal(capture.views[0].image, photograph(1))
    assert capture.notes == ("1 of 4 listed images are absent and were skipped",)
    for file in (root / "images").iterdir():
        file.unlink()
    assert_one_line(lambda: raw(root, missing="skip"), "4 of them absent")


@given(factor=st.integers(1, 12))
def test_shrinking_keeps_every_point_of_the_scene_at_its_place_in_the_picture(factor: int, shared: Path) -> None:
    capture = raw(shared, factor=factor)
    for view in capture.views:
        assert view.width == round(WIDTH / factor)
        assert view.height == round(HEIGHT / factor)
        # relative to the picture's width and height, K stays exactly the same
        assert np.allclose(view.K[0] / view.width, K[0] / WIDTH, rtol=1e-14)
        assert np.allclose(view.K[1] / view.height, K[1] / HEIGHT, rtol=1e-14)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return colmap_capture(tmp_path_factory.mktemp("shared"))


def test_shrinking_averages_areas(shared: Path) -> None:
    capture = raw(shared, factor=2)
    want = photograph(1).astype(float).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
    assert np.abs(capture.views[1].image - want).max() <= 0.5 + 1e-6


def test_a_folder_of_shrunk_photographs_is_taken_where_it_exists(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    for i in range(4):
        write_photograph(root / "images_2" / f"{i:02d}.jpg", photograph(i + 10, 20, 15))
    exact = raw(root, factor=2)
    assert exact.views[0].image.shape == (15, 20, 3)
    assert not np.array_equal(exact.views[0].image, raw(root, factor=2, images="images").views[0].image)
    assert np.allclose(exact.views[0].K[:2], K[:2] / 2.0)
    named = raw(root, factor=1, images="images_2")
    assert np.array_equal(named.views[0].image, exact.views[0].image)
    (root / "images_2" / "03.jpg").unlink()
    assert_one_line(lambda: raw(root, factor=2), "images_2", "03.png")
    assert np.array_equal(raw(root, factor=2, missing="skip").views[2].image, exact.views[2].image)


def test_every_photograph_is_scaled_by_its_own_size(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    write_photograph(root / "images" / "01.png", photograph(1, 2 * WIDTH, 2 * HEIGHT))
    write_photograph(root / "images" / "02.png", photograph(2, 20, 15))
    views = raw(root).views
    assert [(view.width, view.height) for view in views] == [(40, 30), (80, 60), (20, 15), (40, 30)]
    for view, scale in zip(views, (1.0, 2.0, 0.5, 1.0), strict=True):
        assert np.allclose(view.K[:2], K[:2] * scale)


def test_cameras_of_several_sizes_live_in_one_capture(tmp_path: Path) -> None:
    names = ["a.png", "b.png"]
    cameras = [camera(), camera("SIMPLE_PINHOLE", (60.0, 30.0, 40.0), 60, 80)]
    write_photograph(tmp_path / "images" / "a.png", photograph(0))
    write_photograph(tmp_path / "images" / "b.png", photograph(1, 60, 80))
    write_model(tmp_path / "sparse" / "0", names, ring(2), cameras)
    first, second = raw(tmp_path, factor=2).views
    assert first.image.shape == (15, 20, 3)
    assert second.image.shape == (40, 30, 3)
    assert np.allclose(second.K, [[30.0, 0.0, 15.0], [0.0, 30.0, 20.0], [0.0, 0.0, 1.0]])


def test_a_photograph_of_another_shape_than_its_camera_is_refused(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    write_photograph(root / "images" / "02.png", photograph(2, HEIGHT, WIDTH))
    assert_one_line(lambda: raw(root), "02.png", "30x40", "40x30", "rotated")


def test_rounding_of_shrunk_sizes_is_no_other_shape(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, cameras=[camera(params=(4000.0, 4000.0, 2473.0, 1643.0), width=4946, height=3286)])
    for i in range(4):
        write_photograph(root / "images" / f"{i:02d}.png", photograph(i, 618, 410))
    assert np.allclose(raw(root).views[0].K[0, 2], 309.0)


def test_every_eighth_file_by_name_is_held_out_beginning_with_the_first(tmp_path: Path) -> None:
    names = [f"{i}.png" for i in range(17)]
    capture = raw(colmap_capture(tmp_path, names=names))
    ordered = sorted(names)
    assert [view.name for view in capture.test_views()] == [ordered[0], ordered[8], ordered[16]]
    assert {view.name for view in capture.train_views()} == set(names) - {ordered[0], ordered[8], ordered[16]}
    assert capture.test_views(0) == ()
    assert capture.train_views(0) == capture.views
    assert len(capture.test_views(5)) == 4


def test_unregistered_images_of_a_model_are_left_out(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, binary=False)
    model = root / "sparse" / "0" / "images.txt"
    kept = [line for line in model.read_text().splitlines() if not line.endswith("03.png")]
    model.write_text("\n".join(kept) + "\n")
    (root / "sparse" / "0" / "frames.txt").unlink()
    (root / "sparse" / "0" / "rigs.txt").unlink()
    assert [view.name for view in raw(root).views] == ["00.png", "01.png", "02.png"]


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV_FISHEYE", "FOV", "THIN_PRISM_FISHEYE"])
def test_distorted_cameras_give_pinhole_views_of_the_same_size(tmp_path: Path, model: str) -> None:
    terms = {"SIMPLE_RADIAL": (0.05,), "OPENCV_FISHEYE": (0.01, 0.0, 0.0, 0.0), "FOV": (0.4,)}.get(model, (0.01,) * 8)
    focal = (36.0,) if model == "SIMPLE_RADIAL" else (36.0, 36.0)
    root = colmap_capture(tmp_path, cameras=[camera(model, (*focal, 20.5, 14.25, *terms))])
    write_photograph(root / "masks" / "00.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    view = raw(root).views[0]
    assert view.image.shape == (HEIGHT, WIDTH, 3)
    assert view.K[0, 2] == 20.5
    assert view.K[1, 2] == 14.25
    assert view.mask is not None
    assert view.mask.all()
    assert not np.array_equal(view.image, photograph(0))


def test_progress_is_told_for_every_photograph(shared: Path) -> None:
    told: list[tuple[str, int, int]] = []
    raw(shared, progress=lambda *what: told.append(what))
    assert told == [("reading photographs", i, 4) for i in range(1, 5)]


def test_loading_twice_gives_the_same_bits(shared: Path) -> None:
    first, second = load_capture(shared, factor=2), load_capture(shared, factor=2)
    assert np.array_equal(first.points, second.points)
    for a, b in zip(first.views, second.views, strict=True):
        assert np.array_equal(a.image, b.image)
        assert np.array_equal(a.viewmat, b.viewmat)


def test_the_camera_of_a_shot_outlives_the_model_it_came_from(shared: Path) -> None:
    shots, _ = read_model(shared / "sparse" / "0")
    assert [shot.camera.params.tolist() for shot in shots] == [list(PINHOLE)] * 4


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
    assert note.endswith("the model has no camera for 9.png, left/0.png")


def test_photographs_without_a_mask_are_told_where_others_have_one(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    white = np.full((HEIGHT, WIDTH), 255, np.uint8)
    write_photograph(root / "masks" / "01.png", white)
    first = root / "images" / "00.png"
    assert load_capture(root).notes == (f"3 of 4 photographs have no mask and count whole, first {first}",)
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


@pytest.mark.parametrize("binary", [True, False])
def test_the_poses_of_a_rig_are_those_that_colmap_computes(tmp_path: Path, binary: bool) -> None:
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for number in (1, 2):
        one = camera()
        one.camera_id = number
        model.add_camera(one)
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    beside = pycolmap.Rigid3d(pycolmap.Rotation3d([0.1, 0.2, 0.3, 0.9]), [0.5, 0.1, 0.2])
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), beside)
    model.add_rig(rig)
    for i, viewmat in enumerate(ring(3)):
        frame = pycolmap.Frame(frame_id=i + 1, rig_id=1, rig_from_world=pycolmap.Rigid3d(viewmat[:3]))
        images = [pycolmap.Image(name=f"{i}{k}.png", camera_id=k, image_id=2 * i + k) for k in (1, 2)]
        for image in images:
            image.frame_id = i + 1
            frame.add_data_id(image.data_id)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(i + 1)
    tmp_path.mkdir(exist_ok=True)
    model.write_binary(tmp_path) if binary else model.write_text(tmp_path)
    shots, _ = read_model(tmp_path)
    want = {image.name: image.cam_from_world().matrix() for image in model.images.values()}
    assert [shot.name for shot in shots] == sorted(want)
    for shot in shots:
        assert np.allclose(shot.viewmat[:3], want[shot.name], atol=1e-12)


# Pinhole cameras without pycolmap: what pycolmap says of them, and captures that load where it is not installed.

ROOT = Path(__file__).resolve().parents[2]
PARAMS = {"SIMPLE_PINHOLE": [31.5, 20.25, 11.0], "PINHOLE": [31.5, 30.0, 20.25, 11.0]}
# stands in for an environment without them
BLOCKED = "import sys; sys.modules.update(dict.fromkeys(('pycolmap', 'plyfile'))); "
LOAD = BLOCKED + "from pop_fast.data import load_capture; c = load_capture({!r}); print(len(c.views), len(c.points))"


@pytest.mark.parametrize("name", PINHOLES)
def test_a_pinhole_is_pycolmaps_pinhole(name):
    number = int(pycolmap.CameraModelId.__members__[name])
    assert (PINHOLES[name][0], model_name(number)) == (number, name)
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


def load_without_colmap(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", LOAD.format(str(folder))]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def test_captures_of_pinholes_load_without_pycolmap_and_plyfile(tmp_path):
    for folder in (colmap_capture(tmp_path / "binary"), transforms_capture(tmp_path / "transforms")):
        done = load_without_colmap(folder)
        assert done.returncode == 0, done.stderr
        assert int(done.stdout.split()[0]) >= 2


def test_a_lens_that_needs_pycolmap_says_so(tmp_path):
    lines = {"cameras": "1 OPENCV 8 8 9 9 4 4 0.1 0 0 0\n", "images": "1 1 0 0 0 0 0 0 1 a.png\n\n", "points3D": ""}
    (tmp_path / "sparse").mkdir()
    for name, text in lines.items():
        (tmp_path / "sparse" / f"{name}.txt").write_text(text)
    done = load_without_colmap(tmp_path)
    assert done.returncode != 0
    assert "CaptureError: pycolmap cannot be imported" in done.stderr
    assert "pip install pycolmap" in done.stderr
