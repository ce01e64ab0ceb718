"""transforms.json of nerfstudio, instant-ngp and Blender."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from pop_fast.data import Capture, load_capture
from pop_fast.data.transforms import read_transforms
from tests.app.captures import (
    HEIGHT,
    PINHOLE,
    WIDTH,
    assert_one_line,
    camera,
    cloud,
    colmap_capture,
    edit_transforms,
    opengl,
    photograph,
    ring,
    transforms_capture,
    write_photograph,
)


def raw(root: Path, **options) -> Capture:
    return load_capture(root, normalize=False, **options)


def write_points(path: Path) -> None:
    xyz, rgb = cloud()
    rows = np.zeros(len(xyz), [*((n, "f8") for n in "xyz"), *((n, "u1") for n in ("red", "green", "blue"))])
    for i, (place, color) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        rows[place], rows[color] = xyz[:, i], rgb[:, i]
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


def test_poses_are_turned_from_opengl_camera_to_world_into_opencv_world_to_camera(tmp_path: Path) -> None:
    capture = raw(transforms_capture(tmp_path))
    fx, fy, cx, cy = PINHOLE
    for i, (view, viewmat) in enumerate(zip(capture.views, ring(4), strict=True)):
        assert view.name == f"images/{i:02d}.png"
        assert np.allclose(view.viewmat, viewmat, atol=1e-12)
        assert np.array_equal(view.K, [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        assert np.array_equal(view.image, photograph(i))


def test_both_routes_give_the_same_views_of_the_same_scene(tmp_path: Path) -> None:
    one = raw(transforms_capture(tmp_path / "a"))
    other = raw(colmap_capture(tmp_path / "b"))
    for a, b in zip(one.views, other.views, strict=True):
        assert np.allclose(a.viewmat, b.viewmat, atol=1e-12)
        assert np.array_equal(a.K, b.K)
        assert np.array_equal(a.image, b.image)


def test_fields_of_a_frame_come_before_those_of_the_file(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path)
    edit_transforms(root, lambda listing: listing["frames"][1].update(fl_x=50.0, cx=19.0, camera_model="PINHOLE"))
    views = raw(root).views
    assert views[1].K[0].tolist() == [50.0, 0.0, 19.0]
    assert views[0].K[0].tolist() == [PINHOLE[0], 0.0, PINHOLE[2]]


def test_what_is_absent_follows_from_the_rest(tmp_path: Path) -> None:
    view = raw(transforms_capture(tmp_path, fl_y=None, cx=None, cy=None)).views[0]
    assert np.array_equal(view.K, [[PINHOLE[0], 0.0, WIDTH / 2], [0.0, PINHOLE[0], HEIGHT / 2], [0.0, 0.0, 1.0]])
    angles = {"fl_x": None, "fl_y": None, "camera_angle_x": 1.0, "camera_angle_y": 0.8}
    view = raw(transforms_capture(tmp_path, **angles)).views[0]
    assert view.K[0, 0] == pytest.approx(0.5 * WIDTH / math.tan(0.5))
    assert view.K[1, 1] == pytest.approx(0.5 * HEIGHT / math.tan(0.4))


@pytest.mark.parametrize(
    ("fields", "model", "terms"),
    [
        ({}, "PINHOLE", []),
        ({"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}, "OPENCV", [0.1, 0.2, 0.3, 0.4]),
        ({"k1": 0.1, "k3": 0.5, "p1": 0.3}, "FULL_OPENCV", [0.1, 0.0, 0.3, 0.0, 0.5, 0.0, 0.0, 0.0]),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, "OPENCV_FISHEYE", [0.1, 0.0, 0.0, 0.4]),
        ({"is_fisheye": True, "k2": 0.1}, "OPENCV_FISHEYE", [0.0, 0.1, 0.0, 0.0]),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "PINHOLE", []),
    ],
)
def test_lenses_become_the_colmap_model_that_means_the_same(
    tmp_path: Path, fields: dict[str, Any], model: str, terms: list[float]
) -> None:
    root = transforms_capture(tmp_path, **fields)
    (shot, *_), _ = read_transforms([root / "transforms.json"])
    assert shot.camera is not None
    assert shot.camera.model_name == model
    assert shot.camera.params.tolist() == [*PINHOLE, *terms]


def test_a_distorted_capture_gives_the_views_that_the_same_colmap_model_gives(tmp_path: Path) -> None:
    terms = {"k1": 0.05, "k2": -0.02, "p1": 0.001, "p2": -0.002}
    one = raw(transforms_capture(tmp_path / "a", **terms))
    other = raw(colmap_capture(tmp_path / "b", cameras=[camera("OPENCV", (*PINHOLE, *terms.values()))]))
    for a, b in zip(one.views, other.views, strict=True):
        assert np.array_equal(a.image, b.image)
        assert np.array_equal(a.K, b.K)


def test_the_listed_size_is_what_intrinsics_are_measured_in(tmp_path: Path) -> None:
    view = raw(transforms_capture(tmp_path, w=2 * WIDTH, h=2 * HEIGHT)).views[0]
    assert np.allclose(view.K[0], np.array([PINHOLE[0], 0.0, PINHOLE[2]]) / 2.0)


@pytest.mark.parametrize("name", ["sparse_pc.ply", "points3D.ply", "points3d.ply", "named.ply"])
def test_points_beside_the_file_are_used(tmp_path: Path, name: str) -> None:
    root = transforms_capture(tmp_path, ply_file_path="named.ply" if name == "named.ply" else None)
    write_points(root / name)
    capture = raw(root)
    xyz, rgb = cloud()
    assert np.array_equal(capture.points, xyz)
    assert np.array_equal(capture.points_rgb, rgb)
    assert capture.source == "transforms.json: 4 views, 20 points"


def test_named_points_that_are_absent_are_an_error(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path, ply_file_path="named.ply")
    write_points(root / "sparse_pc.ply")
    assert_one_line(lambda: raw(root), "named.ply", "absent")


def test_without_points_random_ones_are_made_where_two_cameras_look(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path)
    capture = raw(root, points=500)
    assert capture.source == "transforms.json: 4 views, no points: 500 random ones (seed 0)"
    assert capture.points.shape == (500, 3)
    centers = capture.camera_centers
    middle, half = 0.5 * (centers.min(axis=0) + centers.max(axis=0)), 0.5 * np.ptp(centers, axis=0).max()
    assert np.all(np.abs(capture.points - middle) <= half)
    seen = np.zeros(500, int)
    for view in capture.views:
        p = capture.points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        u, v = (p @ view.K.T)[:, :2].T / p[:, 2]
        seen += (p[:, 2] > 0) & (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height)
    assert seen.min() >= 2
    assert np.array_equal(raw(root, points=500).points, capture.points)
    assert not np.array_equal(raw(root, points=500, seed=1).points, capture.points)


def test_cameras_that_share_no_view_cannot_get_random_points(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path, count=2)

    def turn_away(listing: dict[str, Any]) -> None:
        for frame in listing["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist()

    edit_transforms(root, turn_away)
    assert_one_line(lambda: raw(root), "transforms.json", "no two views look at")


def test_absent_frames_are_an_error_or_are_skipped_with_a_note(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path, count=5)
    for i in (1, 3):
        (root / "images" / f"{i:02d}.png").unlink()
    assert_one_line(lambda: raw(root), "lists 5 images, 2 of them absent", "01.png", "--missing skip")
    capture = raw(root, missing="skip")
    assert [view.name for view in capture.views] == ["images/00.png", "images/02.png", "images/04.png"]
    assert capture.notes == ("2 of 5 listed images are absent and were skipped",)


def names(views) -> list[str]:
    return [Path(view.name).stem for view in views]


def test_the_files_own_split_comes_before_every_eighth(tmp_path: Path) -> None:
    listed = {f"{s}_filenames": [f"images/0{i}.png" for i in which] for s, which in
              (("train", (0, 1, 4)), ("val", (2,)), ("test", (3,)))}  # fmt: skip
    capture = raw(transforms_capture(tmp_path, count=6, **listed))
    assert names(capture.train_views()) == ["00", "01", "04"]
    assert names(capture.test_views()) == ["03"]
    assert names(capture.views) == ["00", "01", "02", "03", "04"]


def test_validation_views_are_tested_on_where_no_test_views_are_named(tmp_path: Path) -> None:
    split = {"train_filenames": ["images/00.png", "images/01.png"], "val_filenames": ["./images/02.png"]}
    capture = raw(transforms_capture(tmp_path, **split))
    assert names(capture.test_views()) == ["02"]
    assert names(capture.train_views()) == ["00", "01"]


def test_with_training_views_alone_the_rest_is_tested_on(tmp_path: Path) -> None:
    capture = raw(transforms_capture(tmp_path, train_filenames=["images/00.png", "images/03.png"]))
    assert names(capture.test_views()) == ["01", "02"]


def test_a_photograph_in_both_lists_is_never_trained_on(tmp_path: Path) -> None:
    everything = [f"images/0{i}.png" for i in range(4)]
    capture = raw(transforms_capture(tmp_path, train_filenames=everything, test_filenames=everything[:1]))
    assert names(capture.test_views()) == ["00"]
    assert names(capture.train_views()) == ["01", "02", "03"]


def blender_capture(root: Path) -> Path:
    for split, count in (("train", 3), ("val", 2), ("test", 2)):
        frames = []
        for i, viewmat in enumerate(ring(count)):
            write_photograph(root / split / f"r_{i}.png", photograph(i, channels=4))
            frames.append({"file_path": f"./{split}/r_{i}", "rotation": 0.1, "transform_matrix": opengl(viewmat)})
        listing = {"camera_angle_x": 0.9, "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(listing))
    return root


def test_blender_captures_have_their_own_split_field_of_view_and_transparency(tmp_path: Path) -> None:
    root = blender_capture(tmp_path)
    capture = raw(root, background=(1.0, 1.0, 1.0))
    assert [view.name for view in capture.train_views()] == ["train/r_0", "train/r_1", "train/r_2"]
    assert [view.name for view in capture.test_views()] == ["test/r_0", "test/r_1"]
    assert len(capture.views) == 5
    focal = 0.5 * WIDTH / math.tan(0.45)
    assert np.allclose(capture.views[0].K, [[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    assert capture.views[0].image.shape == (HEIGHT, WIDTH, 3)
    assert not np.array_equal(capture.views[0].image, raw(root).views[0].image)
    (root / "transforms_test.json").unlink()
    assert [view.name for view in raw(root).test_views()] == ["val/r_0", "val/r_1"]


def test_masks_named_by_a_frame_are_read(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:5] = 255
    write_photograph(root / "elsewhere" / "m.png", mask)
    write_photograph(root / "masks" / "01.png", 255 - mask)
    edit_transforms(root, lambda listing: listing["frames"][0].update(mask_path="elsewhere/m.png"))
    first, second, *_ = raw(root).views
    assert first.mask is not None
    assert second.mask is not None
    assert np.array_equal(first.mask, mask > 0)
    assert np.array_equal(second.mask, mask == 0)
    edit_transforms(root, lambda listing: listing["frames"][0].update(mask_path="elsewhere/absent.png"))
    assert_one_line(lambda: raw(root), "absent.png")


def test_shrunk_photographs_in_a_folder_beside_are_taken(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path)
    for i in range(4):
        write_photograph(root / "images_2" / f"{i:02d}.png", photograph(i + 20, WIDTH // 2, HEIGHT // 2))
    view = raw(root, factor=2).views[1]
    assert np.array_equal(view.image, photograph(21, WIDTH // 2, HEIGHT // 2))
    assert view.K[0, 0] == PINHOLE[0] / 2.0


def test_colmap_is_preferred_unless_the_other_is_asked_for(tmp_path: Path) -> None:
    root = colmap_capture(transforms_capture(tmp_path))
    assert raw(root).source.startswith("COLMAP model")
    assert raw(root, source="transforms").source.startswith("transforms.json")
    assert raw(root, source="colmap").source.startswith("COLMAP model")


def test_rotations_rounded_by_the_file_are_made_rotations_again(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path)

    def rounded(listing: dict[str, Any]) -> None:
        for frame in listing["frames"]:
            frame["transform_matrix"] = np.round(frame["transform_matrix"], 4).tolist()

    edit_transforms(root, rounded)
    for view, viewmat in zip(raw(root).views, ring(4), strict=True):
        R = view.viewmat[:3, :3]
        assert np.abs(R @ R.T - np.eye(3)).max() < 1e-14
        assert np.abs(view.viewmat - viewmat).max() < 1e-3


def test_points_without_a_coordinate_or_with_nan_are_named(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path)
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
    (root / "sparse_pc.ply").write_text(header + "end_header\n1 2\n3 4\n")
    assert_one_line(lambda: load_capture(root), "sparse_pc.ply", "'z'")
    (root / "sparse_pc.ply").write_text(header + "property float z\nend_header\n1 2 3\n3 nan 4\n")
    assert_one_line(lambda: load_capture(root), "sparse_pc.ply", "vertex[1].y is nan")
