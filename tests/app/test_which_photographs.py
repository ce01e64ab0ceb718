"""Which model and which photographs of a capture are used, and what is told about those that are not."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from pop_fast.data import load_capture
from pop_fast.data.colmap import read_model
from tests.app.captures import (
    HEIGHT,
    WIDTH,
    camera,
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


def test_a_model_that_is_not_numbered_zero_is_found(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    (root / "sparse" / "0").rename(root / "sparse" / "1")
    capture = load_capture(root)
    assert len(capture.views) == 4
    assert capture.notes == ()


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
