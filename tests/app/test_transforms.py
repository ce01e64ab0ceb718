"""transforms.json of nerfstudio, instant-ngp and Blender."""

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
from pop_fast.data.exports import read_transforms
from pop_fast.data.sfm import photographs
from pop_fast.errors import CaptureError
from tests.app import exported
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
from tests.app.conftest import Pop


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


# Which of the intrinsics in transforms.json count: a frame's own before the file's, and all that is there.

ANGLE = 1.2
FOCAL = 0.5 * WIDTH / math.tan(0.5 * ANGLE)


def K_of(root: Path, index: int) -> list[float]:
    """Read fx, fy, cx, cy of a view."""
    K = load_capture(root, normalize=False).views[index].K
    return [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]


@pytest.mark.parametrize(
    ("own", "want"),
    [
        ({"camera_angle_x": ANGLE}, [FOCAL, FOCAL]),
        ({"camera_angle_x": ANGLE, "fl_y": 50.0}, [FOCAL, 50.0]),
        ({"camera_angle_x": ANGLE, "fl_x": 50.0}, [50.0, 50.0]),
        ({"camera_angle_y": ANGLE}, [PINHOLE[0], 0.5 * HEIGHT / math.tan(0.5 * ANGLE)]),
    ],
)
def test_a_frames_own_field_of_view_counts_before_the_files_focal_length(
    tmp_path: Path, own: dict[str, Any], want: list[float]
) -> None:
    root = transforms_capture(tmp_path)
    edit_transforms(root, lambda listing: listing["frames"][1].update(own))
    assert K_of(root, 1) == pytest.approx([*want, *PINHOLE[2:]])
    assert K_of(root, 0) == pytest.approx(list(PINHOLE))


def test_a_principal_point_beside_a_field_of_view_counts_or_is_asked_to_be_complete(tmp_path: Path) -> None:
    fields = {"fl_x": None, "fl_y": None, "camera_angle_x": ANGLE}
    assert K_of(transforms_capture(tmp_path / "a", **fields), 0) == pytest.approx([FOCAL, FOCAL, *PINHOLE[2:]])
    root = transforms_capture(tmp_path / "b", **fields, w=None, h=None)
    assert_one_line(lambda: load_capture(root), "frames[0]", "w and h are absent", "measured in")


def test_null_counts_as_absent(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path)
    edit_transforms(root, lambda listing: listing.update(val_filenames=None, ply_file_path=None))
    capture = load_capture(root, points=100)
    assert len(capture.views) == 4
    assert all(view.split is None for view in capture.views)


def test_the_mark_that_some_editors_put_before_a_file_does_no_harm(tmp_path: Path) -> None:
    path = transforms_capture(tmp_path) / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(load_capture(tmp_path, points=100).views) == 4


# Cameras of Polycam, Metashape and RealityCapture: those of the demo capture come back from each program's export.

WRITERS: dict[str, Callable[..., Path]] = {
    "polycam": exported.polycam,
    "metashape": exported.metashape,
    "realitycapture": exported.realitycapture,
}
FILES = {
    "polycam": "keyframes/corrected_cameras/view_002.json",
    "metashape": "cameras.xml",
    "realitycapture": "cameras.csv",
}


@pytest.fixture(scope="module")
def original(shared_capture: Path) -> Capture:
    return load_capture(shared_capture, normalize=False)


def write(program: str, original: Capture, shared_capture: Path, tmp_path: Path, **options: str) -> Path:
    return WRITERS[program](original, shared_capture, tmp_path / "export", **options)


def same_cameras(found: Capture, expected: Capture) -> None:
    assert [view.name for view in found.views] == [view.name for view in expected.views]
    for ours, theirs in zip(found.views, expected.views, strict=True):
        np.testing.assert_allclose(ours.viewmat, theirs.viewmat, rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(ours.K, theirs.K, rtol=0.0, atol=1e-6)
        np.testing.assert_array_equal(ours.image, theirs.image)


@pytest.mark.parametrize("program", WRITERS)
@pytest.mark.parametrize("said", [True, False])
def test_the_cameras_of_an_export_are_those_it_was_made_from(
    program: str, said: bool, original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    folder = write(program, original, shared_capture, tmp_path)
    source = {"source": program} if said else {}
    found = load_capture(folder, normalize=False, points=20, **source)
    same_cameras(found, original)
    assert found.source.startswith(
        {"polycam": "Polycam", "metashape": "Metashape", "realitycapture": "RealityCapture"}[program]
    )
    assert any("not aligned and left out, first lost" in note for note in found.notes) == (program == "metashape")


def test_a_metashape_export_of_which_every_camera_is_aligned_is_read(
    original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    folder = write("metashape", original, shared_capture, tmp_path)
    (path,) = folder.glob("*.xml")
    tree = ET.parse(path)
    for group in tree.iter("cameras"):
        for entry in [entry for entry in group.iter("camera") if entry.find("transform") is None]:
            next(parent for parent in tree.iter() if entry in list(parent)).remove(entry)
    tree.write(path)
    found = load_capture(folder, normalize=False, points=20)
    same_cameras(found, original)
    assert not any("not aligned" in note for note in found.notes)


def test_polycams_first_cameras_are_read_where_it_has_not_corrected_them(
    original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    folder = write("polycam", original, shared_capture, tmp_path, kind="")
    same_cameras(load_capture(folder, normalize=False, points=20), original)


def test_structure_from_motion_takes_a_polycam_exports_photographs_and_nothing_else(
    original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    folder = write("polycam", original, shared_capture, tmp_path)
    exported.photographs(shared_capture, folder / "keyframes" / "images")
    assert [path.relative_to(folder).as_posix() for path in photographs(folder)] == [
        f"keyframes/corrected_images/view_{i:03d}.png" for i in range(8)
    ]


def test_points_beside_an_export_are_read(original: Capture, shared_capture: Path, tmp_path: Path) -> None:
    folder = write("realitycapture", original, shared_capture, tmp_path)
    rows = "\n".join(f"{i} {2 * i} {i * i} 10 20 30" for i in range(12))
    names = "".join(f"property float {axis}\n" for axis in "xyz") + "".join(
        f"property uchar {color}\n" for color in ("red", "green", "blue")
    )
    (folder / "points3D.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 12\n{names}end_header\n{rows}\n")
    assert len(load_capture(folder, normalize=False).points) == 12


def test_a_metashape_lens_is_opencvs_with_its_tangential_terms_exchanged(
    original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    from pop_fast.data.exports import read_metashape

    lens = "<k1>-0.1</k1><k2>0.02</k2><k3>0.003</k3><p1>0.004</p1><p2>-0.005</p2>"
    folder = write("metashape", original, shared_capture, tmp_path, lens=lens)
    camera = read_metashape(folder / "cameras.xml", folder, "images")[0][0].camera
    x, y = 0.25, -0.125
    r2 = x * x + y * y
    radial = 1.0 - 0.1 * r2 + 0.02 * r2**2 + 0.003 * r2**3
    # Metashape's manual, appendix D, frame cameras
    xd = x * radial + 0.004 * (r2 + 2 * x * x) + 2 * -0.005 * x * y
    yd = y * radial + -0.005 * (r2 + 2 * y * y) + 2 * 0.004 * x * y
    K = original.views[0].K
    expected = [K[0, 0] * xd + K[0, 2], K[1, 1] * yd + K[1, 2]]
    np.testing.assert_allclose(camera.img_from_cam(np.array([[x, y, 1.0]]))[0], expected, rtol=0.0, atol=1e-9)


def test_a_metashape_fisheye_is_opencvs(original: Capture, shared_capture: Path, tmp_path: Path) -> None:
    from pop_fast.data.exports import read_metashape

    folder = write("metashape", original, shared_capture, tmp_path, lens="<k1>0.1</k1><k4>0.01</k4>", kind="fisheye")
    camera = read_metashape(folder / "cameras.xml", folder, "images")[0][0].camera
    angle = 0.5
    distorted = angle * (1.0 + 0.1 * angle**2 + 0.01 * angle**8)
    K = original.views[0].K
    seen = camera.img_from_cam(np.array([[np.tan(angle), 0.0, 1.0]]))[0]
    np.testing.assert_allclose(seen, [K[0, 0] * distorted + K[0, 2], K[1, 2]], rtol=0.0, atol=1e-9)


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
    "metashape: k4": ("metashape", "<b1>", "<k4>3</k4><b1>", r"sensor 3: calibration has k4 = 3.*undistort"),
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
def test_a_damaged_export_is_one_line_that_names_file_and_field(
    case: str, original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    program, pattern, instead, message = DAMAGED[case]
    folder = write(program, original, shared_capture, tmp_path)
    path = folder / FILES[program]
    text = path.read_text()
    changed = re.sub(pattern, instead, text, count=0 if program != "metashape" or "ameras>" in pattern else 1)
    assert changed != text
    path.write_text(changed)
    with pytest.raises(CaptureError, match=message) as error:
        load_capture(folder, source=program)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("program", WRITERS)
def test_a_source_that_is_not_there_is_said(program: str, shared_capture: Path) -> None:
    with pytest.raises(CaptureError, match=r"toy: has no .*; export it there, or choose another --source"):
        load_capture(shared_capture, source=program)


def test_a_photograph_that_an_export_lists_and_that_is_absent_can_be_skipped(
    original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    for program in WRITERS:
        folder = write(program, original, shared_capture, tmp_path / program)
        next(path for path in folder.rglob("view_003.png") if "depth" not in path.parts).unlink()
        with pytest.raises(CaptureError, match="1 of them absent"):
            load_capture(folder)
        assert len(load_capture(folder, missing="skip", points=20).views) == 7
        shutil.rmtree(folder)


@pytest.mark.parametrize("program", WRITERS)
def test_data_check_looks_an_export_over(
    program: str, original: Capture, shared_capture: Path, tmp_path: Path, pop: Pop
) -> None:
    found = pop.done("data", "check", write(program, original, shared_capture, tmp_path))
    assert "8 views from the" in found.out
    assert "8 of 40x32 px" in found.out
