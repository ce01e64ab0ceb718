"""Cameras in other files than COLMAP's: transforms.json of nerfstudio, instant-ngp and Blender, and other programs'."""

from __future__ import annotations

import json
import math
import re
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from pop_fast.data import Capture, load_capture
from pop_fast.data.exports import read_metashape, read_realitycapture, read_transforms
from pop_fast.data.sfm import photographs
from pop_fast.errors import CaptureError
from tests.app.captures import (
    HEIGHT,
    PINHOLE,
    WIDTH,
    assert_one_line,
    camera,
    cloud,
    colmap_capture,
    edit_transforms,
    metashape,
    opengl,
    photograph,
    polycam,
    raw,
    realitycapture,
    ring,
    transforms_capture,
    write_photograph,
)

Edit = Callable[[dict[str, Any]], object]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return transforms_capture(tmp_path)


def write_points(path: Path) -> None:
    xyz, rgb = cloud()
    rows = np.zeros(len(xyz), [*((n, "f8") for n in "xyz"), *((n, "u1") for n in ("red", "green", "blue"))])
    for i, (place, color) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        rows[place], rows[color] = xyz[:, i], rgb[:, i]
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


@pytest.mark.parametrize("terms", [{}, {"k1": 0.05, "k2": -0.02, "p1": 0.001, "p2": -0.002}], ids=["", "distorted"])
def test_the_views_are_those_of_the_same_scene_by_colmap(tmp_path: Path, terms: dict[str, float]) -> None:
    one = raw(transforms_capture(tmp_path / "a", **terms))
    cameras = [camera("OPENCV", (*PINHOLE, *terms.values())) if terms else camera()]
    other = raw(colmap_capture(tmp_path / "b", cameras=cameras))
    assert [view.name for view in one.views] == [f"images/{i:02d}.png" for i in range(4)]
    for a, b in zip(one.views, other.views, strict=True):
        assert np.allclose(a.viewmat, b.viewmat, atol=1e-12)
        assert np.array_equal(a.K, b.K)
        assert np.array_equal(a.image, b.image)


def K_of(root: Path, index: int = 0) -> list[float]:
    K = raw(root).views[index].K
    return [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]


def focal(angle: float, size: int) -> float:
    return 0.5 * size / math.tan(0.5 * angle)


ANGLE = 1.2
FOCAL = focal(ANGLE, WIDTH)


@pytest.mark.parametrize(
    ("fields", "want"),
    [
        ({"fl_y": None, "cx": None, "cy": None}, [PINHOLE[0], PINHOLE[0], WIDTH / 2, HEIGHT / 2]),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": ANGLE}, [FOCAL, FOCAL, *PINHOLE[2:]]),
        (
            {"fl_x": None, "fl_y": None, "camera_angle_x": 1.0, "camera_angle_y": 0.8},
            [focal(1.0, WIDTH), focal(0.8, HEIGHT), *PINHOLE[2:]],
        ),
        # the listed size is what intrinsics are measured in
        ({"w": 2 * WIDTH, "h": 2 * HEIGHT}, [number / 2 for number in PINHOLE]),
    ],
)
def test_what_is_absent_follows_from_the_rest(tmp_path: Path, fields: dict[str, Any], want: list[float]) -> None:
    assert K_of(transforms_capture(tmp_path, **fields)) == pytest.approx(want)


@pytest.mark.parametrize(
    ("own", "want"),
    [
        ({"fl_x": 50.0, "cx": 19.0, "camera_model": "PINHOLE"}, [50.0, 35.0, 19.0, PINHOLE[3]]),
        ({"camera_angle_x": ANGLE}, [FOCAL, FOCAL]),
        ({"camera_angle_x": ANGLE, "fl_y": 50.0}, [FOCAL, 50.0]),
        ({"camera_angle_x": ANGLE, "fl_x": 50.0}, [50.0, 50.0]),
        ({"camera_angle_y": ANGLE}, [PINHOLE[0], focal(ANGLE, HEIGHT)]),
    ],
)
def test_fields_of_a_frame_count_before_those_of_the_file(root: Path, own: dict[str, Any], want: list[float]) -> None:
    edit_transforms(root, lambda listing: listing["frames"][1].update(own))
    assert K_of(root, 1) == pytest.approx([*want, *PINHOLE[len(want) :]])
    assert K_of(root, 0) == pytest.approx(list(PINHOLE))


@pytest.mark.parametrize(
    ("fields", "model", "terms"),
    [
        ({}, "PINHOLE", []),
        ({"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}, "OPENCV", [0.1, 0.2, 0.3, 0.4]),
        ({"k1": 0.1, "k3": 0.5, "p1": 0.3}, "FULL_OPENCV", [0.1, 0.0, 0.3, 0.0, 0.5, 0.0, 0.0, 0.0]),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, "OPENCV_FISHEYE", [0.1, 0.0, 0.0, 0.4]),
        ({"is_fisheye": True, "k2": 0.1}, "OPENCV_FISHEYE", [0.0, 0.1, 0.0, 0.0]),
        ({"camera_model": "PINHOLE", "k1": 0.0, "p2": 0.0}, "PINHOLE", []),
        ({"camera_model": "RADIAL", "k1": 0.1}, "OPENCV", [0.1, 0.0, 0.0, 0.0]),
        # nerfstudio's k4 is the factor of r^8, OpenCV's is in a denominator
        ({f"k{i}": i / 10 for i in range(1, 7)}, "FULL_OPENCV", [0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6]),
        ({"camera_model": "FULL_OPENCV", "k4": 0.4}, "FULL_OPENCV", [*[0.0] * 5, 0.4, 0.0, 0.0]),
        ({"camera_model": "BROWN4", "k4": 0.4, "p1": 0.1}, "BROWN4", [0.0, 0.0, 0.0, 0.4, 0.1, 0.0]),
        (
            {"camera_model": "FISHEYE624", "distortion_params": [i / 100 for i in range(12)]},
            "RAD_TAN_THIN_PRISM_FISHEYE",
            [i / 100 for i in range(12)],
        ),
    ],
)
def test_lenses_become_colmap_models(tmp_path: Path, fields: dict[str, Any], model: str, terms: list[float]) -> None:
    root = transforms_capture(tmp_path, **fields)
    (shot, *_), *_ = read_transforms([root / "transforms.json"])
    assert shot.camera.model_name == model
    assert shot.camera.params.tolist() == [*PINHOLE, *terms]


@pytest.mark.parametrize("name", ["sparse_pc.ply", "points3D.ply", "points3d.ply", "named.ply"])
def test_points_in_the_folder_are_used(tmp_path: Path, name: str) -> None:
    root = transforms_capture(tmp_path, ply_file_path="named.ply" if name == "named.ply" else None)
    write_points(root / name)
    capture = raw(root)
    xyz, rgb = cloud()
    assert np.array_equal(capture.points, xyz)
    assert np.array_equal(capture.points_rgb, rgb)
    assert capture.source == "transforms.json: 4 views, 20 points"
    edit_transforms(root, lambda listing: listing.update(ply_file_path="absent.ply"))
    assert_one_line(lambda: raw(root), "absent.ply", "absent;")


def test_without_points_random_ones_are_made_where_two_cameras_look(root: Path) -> None:
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

    def turn_away(listing: dict[str, Any]) -> None:
        listing["frames"] = listing["frames"][:2]
        for frame in listing["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist()

    edit_transforms(root, turn_away)
    assert_one_line(lambda: raw(root), "transforms.json", "no two views look at")


def numbers(views) -> str:
    return " ".join(str(int(Path(view.name).stem)) for view in views)


@pytest.mark.parametrize(
    ("listed", "train", "test"),
    [
        # its own split comes before every eighth
        ({"train": (0, 1, 4), "val": (2,), "test": (3,)}, "0 1 4", "3"),
        # validation views are tested on where no test views are named, and else the rest
        ({"train": (0, 1), "val": (2,)}, "0 1", "2"),
        ({"train": (0, 3)}, "0 3", "1 2 4 5"),
        # and what is not tested on is trained on
        ({"test": (0, 3)}, "1 2 4 5", "0 3"),
        # a photograph in both lists is never trained on
        ({"train": range(6), "test": (0,)}, "1 2 3 4 5", "0"),
    ],
)
def test_the_files_own_split_is_kept(tmp_path: Path, listed: dict[str, Any], train: str, test: str) -> None:
    split = {f"{s}_filenames": [f"{'./' * (s == 'val')}images/0{i}.png" for i in of] for s, of in listed.items()}
    capture = raw(transforms_capture(tmp_path, count=6, **split))
    assert numbers(capture.train_views()) == train
    assert numbers(capture.test_views()) == test
    assert len(capture.views) == len(
        {i for of in listed.values() for i in of} | set(map(int, f"{train} {test}".split()))
    )


def test_blender_captures_have_their_own_split_field_of_view_and_transparency(tmp_path: Path) -> None:
    for split, count in (("train", 3), ("val", 2), ("test", 2)):
        frames = []
        for i, viewmat in enumerate(ring(count)):
            write_photograph(tmp_path / split / f"r_{i}.png", photograph(i, channels=4))
            frames.append({"file_path": f"./{split}/r_{i}", "rotation": 0.1, "transform_matrix": opengl(viewmat)})
        listing = {"camera_angle_x": 0.9, "frames": frames}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(listing))
    capture = raw(tmp_path, background=(1.0, 1.0, 1.0))
    assert [view.name for view in capture.train_views()] == ["train/r_0", "train/r_1", "train/r_2"]
    assert [view.name for view in capture.test_views()] == ["test/r_0", "test/r_1"]
    assert len(capture.views) == 5
    assert K_of(tmp_path) == pytest.approx([focal(0.9, WIDTH)] * 2 + [WIDTH / 2, HEIGHT / 2])
    assert capture.views[0].image.shape == (HEIGHT, WIDTH, 3)
    assert not np.array_equal(capture.views[0].image, raw(tmp_path).views[0].image)
    train, test = (tmp_path / f"transforms_{split}.json" for split in ("train", "test"))
    test.write_text(test.read_text().replace("test/r_0", "train/r_0"))
    assert_one_line(lambda: raw(tmp_path), str(train), str(test), "lists train/r_0 twice")
    test.unlink()
    assert [view.name for view in raw(tmp_path).test_views()] == ["val/r_0", "val/r_1"]
    (tmp_path / "transforms_val.json").unlink()
    assert [view.name for view in raw(tmp_path).test_views(2)] == ["train/r_0", "train/r_2"]


def test_masks_named_by_a_frame_are_read(root: Path) -> None:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:5] = 255
    write_photograph(root / "elsewhere" / "m.png", mask)
    write_photograph(root / "masks" / "01.png", 255 - mask)
    edit_transforms(root, lambda listing: listing["frames"][0].update(mask_path="elsewhere/m.png"))
    first, second, *_ = raw(root).views
    assert np.array_equal(first.mask, mask > 0)
    assert np.array_equal(second.mask, mask == 0)
    edit_transforms(root, lambda listing: listing["frames"][0].update(mask_path="elsewhere/absent.png"))
    assert_one_line(lambda: raw(root), "absent.png")


def in_folders(root: Path, names: list[str]) -> None:
    """Move the photographs to other places, by names from the capture's folder, and list them there."""

    def moved(listing: dict[str, Any]) -> None:
        for frame, name in zip(listing["frames"], names, strict=True):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.move(root / frame["file_path"], root / name)
            frame["file_path"] = name

    edit_transforms(root, moved)


def test_cameras_with_a_folder_each_may_name_their_photographs_alike(root: Path) -> None:
    names = [f"cam{i % 2}/{i // 2}.png" for i in range(len(list((root / "images").iterdir())))]
    in_folders(root, names)
    keep = {name: np.full((HEIGHT, WIDTH), 255, np.uint8) for name in names}
    for i, (name, mask) in enumerate(keep.items()):
        mask[:, : 5 * i] = 0
        write_photograph(root / "masks" / name, mask)
        write_photograph(root / "small" / name, photograph(20 + i))
    views = {view.name: view for view in raw(root, images="small").views}
    for i, (name, mask) in enumerate(keep.items()):
        assert np.array_equal(views[name].mask, mask > 0)
        assert np.array_equal(views[name].image, photograph(20 + i))
    # what lies there without the cameras' folders could be anyone's
    for folder in ("masks", "small"):
        shutil.copytree(root / folder / "cam0", root / f"{folder}_of_one")
    assert_one_line(lambda: raw(root, images="small_of_one"), "small_of_one/cam0/0.png", "pass --images .")
    shutil.rmtree(root / "masks")
    (root / "masks_of_one").rename(root / "masks")
    assert_one_line(lambda: raw(root), "masks", "no mask named like a photograph")


def test_a_listed_folder_whose_name_ends_like_one_of_shrunk_photographs_is_shrunk_too(root: Path) -> None:
    names = [f"{'cam' if i % 2 else 'cam_2'}/{i}.png" for i in range(len(list((root / "images").iterdir())))]
    in_folders(root, names)
    for view in raw(root, factor=2).views:
        want = photograph(int(Path(view.name).stem)).astype(float).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3)
        assert np.abs(view.image - want.mean(axis=(1, 3))).max() <= 0.5 + 1e-6


@pytest.mark.parametrize("place", ["", "../", "absolute"])
def test_a_photograph_is_not_its_own_mask_wherever_it_lies(tmp_path: Path, place: str) -> None:
    root = transforms_capture(tmp_path / "scene")
    folder = f"{root.resolve()}/images/" if place == "absolute" else f"{place}images/"
    in_folders(root, names := [f"{folder}{path.name}" for path in sorted((root / "images").iterdir())])
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :10] = 0
    for name in names:
        write_photograph(root / "masks" / Path(name).name, mask)
        write_photograph(root / "small" / Path(name).name, photograph(33))
    assert all(np.array_equal(view.mask, mask > 0) for view in raw(root).views)
    assert all(np.array_equal(view.image, photograph(33)) for view in raw(root, images="small").views)


def test_every_name_of_a_list_from_windows_may_have_backslashes(root: Path) -> None:
    write_photograph(root / "masks of it" / "m.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    (root / "points").mkdir()
    write_points(root / "points" / "all.ply")

    def from_windows(listing: dict[str, Any]) -> None:
        for frame in listing["frames"]:
            frame |= {"file_path": frame["file_path"].replace("/", "\\"), "mask_path": "masks of it\\m.png"}
        listing["train_filenames"] = [frame["file_path"] for frame in listing["frames"][1:]]
        listing["ply_file_path"] = ".\\points\\all.ply"

    edit_transforms(root, from_windows)
    capture = raw(root)
    assert [(view.name, view.split) for view in capture.views] == [
        ("images/00.png", "test"),
        *((f"images/0{i}.png", "train") for i in (1, 2, 3)),
    ]
    assert all(view.mask is not None for view in capture.views)

    def absolute(listing: dict[str, Any]) -> None:
        for frame in listing["frames"]:
            frame["file_path"] = f"C:\\walk\\{frame['file_path']}"
        listing["train_filenames"] = None

    edit_transforms(root, absolute)
    assert_one_line(lambda: raw(root), "C:/walk/images", "pass --images .")
    assert np.array_equal(raw(root, images=".").views[1].image, capture.views[1].image)


def test_colmap_is_preferred_unless_the_other_is_asked_for(root: Path) -> None:
    colmap_capture(root)
    for options, source in (({}, "COLMAP model"), ({"source": "colmap"}, "COLMAP model")):
        assert raw(root, **options).source.startswith(source)
    assert raw(root, source="transforms").source.startswith("transforms.json")


def test_lists_of_cameras_that_are_passed_over_are_told_with_what_goes_unused(root: Path, original: Capture) -> None:
    assert raw(root).notes == ()
    edit_transforms(root, lambda listing: listing.update(test_filenames=["images/00.png"]))
    colmap_capture(root)
    (note,) = raw(root).notes
    assert "read from sparse/0; transforms.json is left unused with the test_filenames in it" in note
    assert "--source transforms" in note
    assert [view.split for view in raw(root, source="transforms").views] == ["test", "train", "train", "train"]
    assert raw(root, source="transforms").notes == raw(root, source="colmap").notes == ()
    shutil.rmtree(root / "sparse")
    (root / "cameras.csv").write_text("#name,x,y,alt,heading,pitch,roll,f\n")
    (note,) = raw(root).notes
    assert "read from transforms.json; cameras.csv is left unused: --source realitycapture" in note


def test_a_rolling_shutter_is_told_to_be_ignored(root: Path) -> None:
    edit_transforms(root, lambda listing: listing.update(rolling_shutter=[0.0, 0.0, 0.0, 0.0]))
    assert raw(root).notes == ()
    edit_transforms(root, lambda listing: listing["frames"][1].update(rolling_shutter=[0.0, 0.0, 0.02, 0.0]))
    (note,) = raw(root).notes
    assert "rolling_shutter of transforms.json is ignored" in note


def test_a_photograph_that_is_listed_with_its_ending_and_without_is_refused(root: Path) -> None:
    edit_transforms(root, lambda listing: listing["frames"].append({**listing["frames"][0], "file_path": "images/00"}))
    assert_one_line(
        lambda: raw(root), "transforms.json", "images/00 and images/00.png are one photograph", "remove one"
    )


def test_rotations_rounded_by_the_file_are_made_rotations_again(root: Path) -> None:
    def rounded(listing: dict[str, Any]) -> None:
        for frame in listing["frames"]:
            frame["transform_matrix"] = np.round(frame["transform_matrix"], 4).tolist()

    edit_transforms(root, rounded)
    for view, viewmat in zip(raw(root).views, ring(4), strict=True):
        R = view.viewmat[:3, :3]
        assert np.abs(R @ R.T - np.eye(3)).max() < 1e-14
        assert np.abs(view.viewmat - viewmat).max() < 1e-3


def test_null_counts_as_absent_and_the_mark_that_some_editors_put_before_a_file_does_no_harm(root: Path) -> None:
    edit_transforms(root, lambda listing: listing.update(val_filenames=None, ply_file_path=None))
    path = root / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    capture = load_capture(root, points=100)
    assert len(capture.views) == 4
    assert all(view.split is None for view in capture.views)


# Whatever is wrong with it is said in one line that names the frame and the field.


def frame(**fields: Any) -> Edit:
    return lambda listing: listing["frames"][1].update(fields)


def listed(**fields: Any) -> Edit:
    return lambda listing: listing.update(fields)


def without(*names: str, **fields: Any) -> Edit:
    return lambda listing: ([listing.pop(name) for name in names], listing.update(fields))


def matrix(change: Callable[[np.ndarray], Any]) -> Edit:
    def edit(listing: dict[str, Any]) -> None:
        m = change(np.array(listing["frames"][1]["transform_matrix"]))
        listing["frames"][1]["transform_matrix"] = m.tolist() if isinstance(m, np.ndarray) else m

    return edit


def entry(row: int, column: int, value: float) -> Edit:
    return lambda listing: listing["frames"][1]["transform_matrix"][row].__setitem__(column, value)


INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
BAD_FIELDS: dict[str, tuple[Edit, tuple[str, ...]]] = {
    "no frames": (without("frames"), ("'frames'",)),
    "frames is a number": (listed(frames=3), ("'frames'",)),
    "a frame is a number": (lambda listing: listing["frames"].append(3), ("frames[4]", "file_path")),
    "no file_path": (lambda listing: listing["frames"][1].pop("file_path"), ("frames[1]", "file_path")),
    "no matrix": (lambda listing: listing["frames"][1].pop("transform_matrix"), ("frames[1]", "transform_matrix")),
    "3x3 matrix": (matrix(lambda m: m[:3, :3]), ("frames[1]", "[3, 3]", "4x4")),
    "ragged matrix": (matrix(lambda m: [[1.0], [1.0, 2.0]]), ("frames[1]", "4x4")),
    "words for a matrix": (matrix(lambda m: [["a"] * 4] * 4), ("frames[1]", "4x4")),
    "NaN": (entry(1, 3, np.nan), ("frames[1]", "transform_matrix", "[1][3] is nan", "finite")),
    "Inf": (entry(0, 0, np.inf), ("frames[1]", "[0][0] is inf")),
    "scaled": (matrix(lambda m: m * [[2.0], [2.0], [2.0], [1.0]]), ("frames[1]", "not rigid", "scales by 2")),
    "sheared": (matrix(lambda m: m @ (np.eye(4) + 0.1 * np.eye(4, k=1))), ("frames[1]",)),
    "mirrored": (matrix(lambda m: m @ np.diag([-1.0, 1.0, 1.0, 1.0])), ("frames[1]", "mirrors")),
    "transposed": (matrix(lambda m: m.T), ("frames[1]", "last row")),
    "zero": (matrix(lambda m: m * 0.0), ("frames[1]",)),
    "no focal length": (without("fl_x"), ("frames[0]", "fl_x", "camera_angle_x")),
    "focal length 0": (frame(fl_x=0.0), ("frames[1]", "focal length")),
    "focal length -1": (frame(fl_y=-1), ("frames[1]", "focal length")),
    "focal length NaN": (frame(fl_x=float("nan")), ("frames[1]", "fl_x is nan", "finite")),
    "focal length a word": (frame(fl_x="long"), ("frames[1]", "fl_x is 'long'")),
    "focal length true": (frame(fl_x=True), ("frames[1]", "fl_x is True")),
    "angle 0": (without(*INTRINSICS, camera_angle_x=0.0), ("frames[0]", "camera_angle_x", "radians")),
    "angle -1": (without(*INTRINSICS, camera_angle_x=-1.0), ("frames[0]", "camera_angle_x", "radians")),
    "angle 4": (without(*INTRINSICS, camera_angle_x=4.0), ("frames[0]", "camera_angle_x", "radians")),
    "principal point a list": (frame(cx=[1]), ("frames[1]", "cx is [1]")),
    "principal point of no size": (
        without("fl_x", "fl_y", "w", "h", camera_angle_x=ANGLE),
        ("frames[0]", "w and h are absent", "measured in"),
    ),
    "width 0": (frame(w=0), ("frames[1]", "0 x 30")),
    "no size": (without("w", "h"), ("frames[0]", "w and h are absent")),
    "no height": (without("h"), ("frames[0]", "h is None")),
    "unknown lens": (frame(camera_model="PANINI"), ("frames[1]", "camera_model is 'PANINI'", "OPENCV")),
    "another lens": (frame(latlong=True), ("frames[1]", "latlong is no lens that is supported", "perspective views")),
    "full sphere": (frame(camera_model="EQUIRECTANGULAR"), ("frames[1]", "full sphere", "perspective views")),
    "fourth radial term": (frame(k4=0.1), ("frames[1]", "k4 is 0.1", "BROWN4", "FULL_OPENCV")),
    "fifth radial term": (frame(camera_model="OPENCV_FISHEYE", k5=0.1), ("frames[1]", "k5 is 0.1", "has it", "OPENCV")),
    "thin prism": (frame(s1=0.1), ("frames[1]", "s1 is 0.1", "undistort")),
    "terms of another": (frame(distortion_params=[0.1]), ("distortion_params[0] is 0.1", "FISHEYE624")),
    "terms a number": (frame(distortion_params=3), ("frames[1]", "distortion_params is 3", "list of up to 12")),
    "terms by the dozen": (frame(distortion_params=[0] * 13), ("distortion_params is [0", "list of up to 12")),
    "terms of a pinhole": (frame(camera_model="PINHOLE", k1=0.1), ("frames[1]", "k1 is 0.1", "PINHOLE", "OPENCV")),
    "p2 of a fisheye": (frame(camera_model="OPENCV_FISHEYE", p2=0.1), ("frames[1]", "p2 is 0.1")),
    "focal length of 400 digits": (frame(fl_x=10**400), ("frames[1]", "fl_x is 1000", "finite")),
    "matrix of 400 digits": (matrix(lambda m: [[10**400] * 4] * 4), ("frames[1]", "4x4")),
    "camera beyond the stars": (entry(0, 3, 1e200), ("frames[1]", "[0][3] is 1e+200", "within")),
    "width 1e300": (frame(w=1e300), ("frames[1]", "w x h", "at most")),
    "split a number": (listed(val_filenames=5), ("val_filenames is 5", "list")),
    "points a list": (listed(ply_file_path=[]), ("ply_file_path is []", "PLY")),
    "no points": (
        listed(ply_file_path="no.ply"),
        ("ply_file_path names", "no.ply, which is absent", "remove the field"),
    ),
    "listed twice": (lambda listing: listing["frames"].append(listing["frames"][0]), ("images/00.png twice",)),
    "split of unknown": (listed(test_filenames=["no.png"]), ("test_filenames", "no.png")),
}


@pytest.mark.parametrize("what", BAD_FIELDS)
def test_a_wrong_field_of_transforms_json_is_named(root: Path, what: str) -> None:
    edit, words = BAD_FIELDS[what]
    edit_transforms(root, edit)
    assert_one_line(lambda: load_capture(root), str(root / "transforms.json"), *words)


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"\xff\xfe\x00", b'{"frames": [}', b"[" * 99_999, b'{"w":' + b"1" * 9999]
)
def test_a_file_that_is_no_json_object_is_named(root: Path, content: bytes) -> None:
    (root / "transforms.json").write_bytes(content)
    assert_one_line(lambda: load_capture(root), str(root / "transforms.json"))


XY = b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1\n", ("truncated or corrupt",)),
        (b"", ("truncated or corrupt",)),
        (b"ply", ("truncated or corrupt",)),
        (XY + b"end_header\n1 2\n3 4\n", ("'z'",)),
        (XY + b"property float z\nend_header\n1 2 3\n3 nan 4\n", ("vertex[1].y is nan",)),
    ],
)
def test_damaged_points_in_the_folder_are_named(root: Path, content: bytes, words: tuple[str, ...]) -> None:
    (root / "sparse_pc.ply").write_bytes(content)
    with pytest.raises(CaptureError):
        load_capture(root)
    assert_one_line(lambda: load_capture(root), "sparse_pc.ply", *words)


# Cameras of Polycam, Metashape and RealityCapture: those of the demo capture come back from each program's export.

PROGRAMS: dict[str, tuple[str, Callable[..., Path], str]] = {
    "polycam": ("Polycam", polycam, "keyframes/corrected_cameras/view_002.json"),
    "metashape": ("Metashape", metashape, "cameras.xml"),
    "realitycapture": ("RealityCapture", realitycapture, "cameras.csv"),
}


@pytest.fixture(scope="module")
def original(shared_capture: Path) -> Capture:
    return raw(shared_capture)


@pytest.fixture
def write(original: Capture, shared_capture: Path, tmp_path: Path) -> Callable[..., Path]:
    """Export the demo capture as a program does, and return the folder."""
    return lambda program, **options: PROGRAMS[program][1](original, shared_capture, tmp_path / program, **options)


def assert_same_cameras(found: Capture, expected: Capture) -> None:
    assert [view.name for view in found.views] == [view.name for view in expected.views]
    for ours, theirs in zip(found.views, expected.views, strict=True):
        np.testing.assert_allclose(ours.viewmat, theirs.viewmat, rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(ours.K, theirs.K, rtol=0.0, atol=1e-6)
        np.testing.assert_array_equal(ours.image, theirs.image)


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_cameras_of_an_export_are_those_it_was_made_from_and_data_check_looks_it_over(
    program, original, write, pop
):
    folder = write(program)
    for source in ({}, {"source": program}):
        found = raw(folder, points=20, **source)
        assert_same_cameras(found, original)
        assert found.source.startswith(PROGRAMS[program][0])
        assert any("not aligned and left out, first lost" in note for note in found.notes) == (program == "metashape")
    said = pop.done("data", "check", folder).out
    assert "8 views from the" in said
    assert "8 of 40x32 px" in said


def test_a_metashape_export_of_which_every_camera_is_aligned_is_read(original: Capture, write: Callable) -> None:
    path = write("metashape") / "cameras.xml"
    tree = ET.parse(path)
    for parent in list(tree.iter()):
        for entry in [entry for entry in parent.findall("camera") if entry.find("transform") is None]:
            parent.remove(entry)
    tree.write(path)
    found = raw(path.parent, points=20)
    assert_same_cameras(found, original)
    assert not any("not aligned" in note for note in found.notes)


def test_polycams_first_cameras_are_read_where_it_has_not_corrected_them(original: Capture, write: Callable) -> None:
    folder = write("polycam", kind="")
    assert_same_cameras(raw(folder, points=20), original)
    # structure from motion takes its photographs and nothing else, the corrected ones where there are any
    shutil.rmtree(folder)
    write("polycam")
    write_photograph(folder / "keyframes" / "images" / "view_000.png", photograph(0))
    assert [path.relative_to(folder).as_posix() for path in photographs(folder)] == [
        f"keyframes/corrected_images/view_{i:03d}.png" for i in range(8)
    ]


def test_what_a_mac_leaves_beside_polycams_cameras_is_none_of_them(original: Capture, write: Callable) -> None:
    folder = write("polycam")
    (folder / "keyframes" / "corrected_cameras" / "._view_000.json").write_bytes(b"\0\5\x16\7")
    assert_same_cameras(raw(folder, points=20), original)


def test_points_in_the_folder_of_an_export_are_read(write: Callable[..., Path]) -> None:
    folder = write("realitycapture")
    write_points(folder / "points3D.ply")
    assert len(raw(folder).points) == len(cloud()[0])


@pytest.mark.parametrize("k4", [0.0, -0.2])
def test_a_metashape_lens_is_browns_with_its_tangential_terms_exchanged(
    k4: float, original: Capture, write: Callable
) -> None:
    lens = f"<k1>-0.1</k1><k2>0.02</k2><k3>0.003</k3><k4>{k4}</k4><p1>0.004</p1><p2>-0.005</p2>"
    folder = write("metashape", lens=lens)
    camera = read_metashape(folder / "cameras.xml", folder, "images")[0][0].camera
    x, y = 0.25, -0.125
    r2 = x * x + y * y
    radial = 1.0 - 0.1 * r2 + 0.02 * r2**2 + 0.003 * r2**3 + k4 * r2**4
    # Metashape's manual, appendix D, frame cameras
    xd = x * radial + 0.004 * (r2 + 2 * x * x) + 2 * -0.005 * x * y
    yd = y * radial + -0.005 * (r2 + 2 * y * y) + 2 * 0.004 * x * y
    K = original.views[0].K
    expected = [K[0, 0] * xd + K[0, 2], K[1, 1] * yd + K[1, 2]]
    np.testing.assert_allclose(camera.img_from_cam(np.array([[x, y, 1.0]]))[0], expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("p1", [0.0, 0.03])
def test_a_metashape_fisheye_is_opencvs_or_has_tangential_terms(
    p1: float, original: Capture, write: Callable[..., Path]
) -> None:
    folder = write("metashape", lens=f"<k1>0.1</k1><k4>0.01</k4><p1>{p1}</p1>", kind="fisheye")
    camera = read_metashape(folder / "cameras.xml", folder, "images")[0][0].camera
    assert camera.model_name == ("THIN_PRISM_FISHEYE" if p1 else "OPENCV_FISHEYE")
    angle = 0.5
    distorted = angle * (1.0 + 0.1 * angle**2 + 0.01 * angle**8) + 3.0 * p1 * angle**2
    K = original.views[0].K
    seen = camera.img_from_cam(np.array([[np.tan(angle), 0.0, 1.0]]))[0]
    np.testing.assert_allclose(seen, [K[0, 0] * distorted + K[0, 2], K[1, 2]], rtol=0.0, atol=1e-9)


def test_realitycaptures_fourth_radial_term_is_browns(original: Capture, write: Callable) -> None:
    folder = write("realitycapture")
    lines = (folder / "cameras.csv").read_text().splitlines()
    rows = [f"{line.rsplit(',', 6)[0]},1,2,3,4,5,6" for line in lines[1:]]
    (folder / "cameras.csv").write_text("\n".join([lines[0], *rows]))
    camera = read_realitycapture(folder / "cameras.csv", folder, "")[0][0].camera
    assert (camera.model_name, camera.params[4:].tolist()) == ("BROWN4", [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])


# what is put in the place of what, and what is said of it
DAMAGED = {
    "polycam: no JSON": ("polycam", r"\A\{", "", r"view_002\.json: is not valid JSON"),
    "polycam: field": ("polycam", '"t_12"', '"t_zz"', r"view_002\.json: t_12 is None; it must be a finite number"),
    "polycam: focal": ("polycam", r'"fx": [^,]*', '"fx": 0', r"view_002\.json: fx, fy are 0\.0.*must be > 0"),
    "polycam: size": ("polycam", '"width": 40', '"width": 0', r"view_002\.json: size is 0 x 32"),
    "polycam: rigid": ("polycam", r'"t_00": [^,]*', '"t_00": 9', r"view_002\.json: the matrix t_00 to t_23 is not"),
    "metashape: XML": ("metashape", "</document>", "", r"cameras\.xml: is not valid XML"),
    "metashape: cameras": ("metashape", "cameras>", "kameras>", r"cameras\.xml: has no chunk with cameras"),
    "metashape: sensor": ("metashape", '<sensor id="3"', '<sensor id="4"', r"camera view_000\.png: sensor_id names no"),
    "metashape: focal": ("metashape", r"<f>[0-9.]*</f><b1>", "<f>x</f><b1>", r"sensor 3: calibration: f is 'x'"),
    "metashape: skew": ("metashape", "<b1>", "<b2>3</b2><b1>", r"sensor 3: calibration: b2 is 3, a skew"),
    "metashape: p3": ("metashape", "<b1>", "<p3>3</p3><b1>", r"calibration: p3 is 3, but the type 'frame'.*undistort"),
    "metashape: kind": ("metashape", '"frame" class="adj', '"spherical" class="adj', r"the type 'spherical'"),
    "metashape: pose": ("metashape", r"<transform>[-0-9.e]+ ", "<transform>", r"view_000\.png: transform is .*16 fin"),
    "metashape: scale": ("metashape", "<scale>2.5", "<scale>-1", r"component 0: transform/scale is -1\.0; it must"),
    "metashape: label": ("metashape", 'label="view_001"', 'label="view_000.png"', r"two cameras .* view_000\.png"),
    "realitycapture: column": ("realitycapture", "pitch", "pitsch", r"cameras\.csv: has no column pitch"),
    "realitycapture: number": ("realitycapture", r"view_001\.png,[^,]*", "view_001.png,", r"view_001\.png: x is ''"),
    "realitycapture: twice": ("realitycapture", "view_001", "view_000", r"cameras\.csv: lists view_000\.png twice"),
    "realitycapture: none": ("realitycapture", r"(?s)\nview.*", "\n", r"cameras\.csv: lists no photograph"),
    "realitycapture: names": ("realitycapture", "view_", "else_", r"cameras\.csv: none of its 8 photographs lies in"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_export_is_one_line_that_names_file_and_field(case: str, write: Callable[..., Path]) -> None:
    program, pattern, instead, message = DAMAGED[case]
    folder = write(program)
    path = folder / PROGRAMS[program][2]
    text = path.read_text()
    changed = re.sub(pattern, instead, text, count=0 if program != "metashape" or "ameras>" in pattern else 1)
    assert changed != text
    path.write_text(changed)
    with pytest.raises(CaptureError, match=message) as error:
        load_capture(folder, source=program)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("program", PROGRAMS)
def test_an_absent_export_or_photograph_is_said(program: str, shared_capture: Path, write: Callable[..., Path]) -> None:
    with pytest.raises(CaptureError, match=r"toy: has no .*; export it there, or choose another --source"):
        load_capture(shared_capture, source=program)
    folder = write(program)
    next(path for path in folder.rglob("view_003.png") if "depth" not in path.parts).unlink()
    with pytest.raises(CaptureError, match="1 of them absent"):
        load_capture(folder)
    assert len(load_capture(folder, missing="skip", points=20).views) == 7
