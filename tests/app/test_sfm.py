"""Cameras of bare folders of photographs: that they are found, what is read, what is written, what is never removed."""

from __future__ import annotations

import json
import shutil
import struct
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from benchmarks.kinds import KINDS, write_kind
from pop_fast.data import CaptureError, load_capture, run_sfm, sfm
from pop_fast.data.capture import View
from pop_fast.data.sfm import pairs_of
from pop_fast.demo.make import render_view
from pop_fast.demo.scene import make_scene
from tests.app.captures import (
    HEIGHT,
    WIDTH,
    assert_one_line,
    camera,
    colmap_capture,
    look_at,
    make_model,
    photograph,
    raw,
    ring,
    write_photograph,
)
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import contents

K = np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]])
CENTERS = [(4.0 * np.cos(a), 4.0 * np.sin(a), 1.5 + 0.2 * (i % 2)) for i, a in enumerate(np.linspace(0.3, 1.3, 7))]


@pytest.fixture(scope="module")
def photographs(made_once: Callable[..., Path]) -> Path:
    def make(folder: Path) -> None:
        scene = make_scene(0)
        for i, center in enumerate(CENTERS):
            view = render_view(scene, look_at(center, (0.0, 0.0, 0.4)), K, 320, 240)
            write_photograph(folder / f"walk {i}.png", view)

    return made_once("photographs", make)


@pytest.fixture(scope="module")
def found(photographs: Path, made_once: Callable[..., Path]) -> Path:
    def make(folder: Path) -> None:
        result = run_sfm(photographs, folder / "capture")
        assert result.capture == folder / "capture"
        assert result.registered == result.photographs == len(CENTERS)
        assert result.points >= 50
        assert result.reprojection_error < 1.0

    return made_once("sfm", make) / "capture"


def test_cameras_are_found_where_the_photographs_were_taken(found: Path, photographs: Path) -> None:
    views = raw(found).views
    assert [view.name for view in views] == [f"walk {i}.png" for i in range(len(CENTERS))]
    centers = np.stack([view.camera_center for view in views])
    truth = np.array(CENTERS)
    # up to a similarity: align by the singular value decomposition of the covariance (Umeyama)
    a, b = centers - centers.mean(axis=0), truth - truth.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    aligned = (np.trace(np.diag(S) @ mirror) / (a**2).sum()) * a @ (U @ mirror @ Vt).T
    assert np.abs(aligned - b).max() < 0.05
    assert views[0].K[0, 0] == pytest.approx(300.0, rel=0.05)
    for file in photographs.iterdir():
        assert (found / "images" / file.name).read_bytes() == file.read_bytes()


def test_the_same_photographs_give_the_same_bytes(found: Path, photographs: Path, tmp_path: Path) -> None:
    told: list[tuple[str, int, int]] = []
    folder = Path(shutil.copytree(photographs, tmp_path / "in"))
    # in place this time: the model comes to lie with the photographs
    result = run_sfm(folder, progress=lambda *what: told.append(what))
    assert result.capture == folder.resolve()
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (folder / "sparse" / "0" / name).read_bytes() == (found / "sparse" / "0" / name).read_bytes()
    n = len(CENTERS)
    totals = {
        "checking photographs": n,
        "finding features in photographs": n,
        "matching pairs of photographs": n * (n - 1) // 2,
        "finding cameras of photographs": n,
    }
    assert {stage for stage, _, _ in told} == totals.keys()
    assert all((stage, total, total) in told for stage, total in list(totals.items())[1:])
    assert all(0 <= done <= total for _, done, total in told)
    assert len(load_capture(folder).views) == n
    assert_one_line(lambda: run_sfm(folder), "sparse", "--overwrite")


@pytest.mark.slow
def test_photographs_51_degrees_apart_are_all_placed_by_the_second_search(tmp_path: Path) -> None:
    kind = KINDS["few"]
    told: list[str] = []
    result = run_sfm(write_kind(kind, tmp_path), tmp_path / "out", lambda stage, *_: told.append(stage))
    assert result.registered == result.photographs == 7
    assert "matching pairs of photographs, again and more thoroughly" in told
    truth = np.stack([one.viewmat[:3, :3] for one in kind.photographs()])
    turned = np.stack([view.viewmat[:3, :3] for view in raw(tmp_path / "out").views])
    # R = truth @ W, with W the turn of the world that is nearest to all of them
    U, _, Vt = np.linalg.svd(np.einsum("mji,mjk->ik", truth, turned))
    world = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    cosines = (np.einsum("mij,jk,mik->m", truth, world, turned) - 1.0) / 2.0
    assert np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).max() < 1.0


class Model:
    """As much of a COLMAP model as decides which is kept."""

    def __init__(self, photographs: int, points: int = 100) -> None:
        self.num_reg_images = lambda: photographs
        self.num_points3D = lambda: points


@pytest.mark.parametrize(
    ("n", "first", "second", "kept"),
    [
        (40, [36], None, 36),  # enough at first sight
        (41, [5], None, 5),  # too many for a second search
        (14, [5, 3], [14], 14),
        (14, [5], [4], 5),  # what was found already is not lost
        (14, [], [12], 12),
        (14, [], [], None),
    ],
)
def test_photographs_are_searched_again_where_few_of_few_were_placed(n, first, second, kept, tmp_path, monkeypatch):
    results = {False: first, True: second}

    def models(job: sfm.Search, tell: object, thorough: bool) -> list[Model]:
        found = results.pop(thorough)
        assert found is not None
        # of the first search nothing is in the way
        assert list(tmp_path.iterdir()) == []
        (tmp_path / "database.db").touch()
        (tmp_path / "models").mkdir()
        return [Model(count) for count in found]

    monkeypatch.setattr(sfm, "_models", models)
    job = sfm.Search("photos", str(tmp_path), [f"{i}.png" for i in range(n)], sfm.SfmOptions())
    if kept is None:
        assert_one_line(lambda: sfm._best(job, lambda *_: None), "no cameras could be found")
    else:
        assert sfm._best(job, lambda *_: None).num_reg_images() == kept
    assert (True in results) == (second is None)


WIDE, TALL = (64, 48), (48, 64)


@pytest.mark.parametrize(
    ("kinds", "lenses"),
    [
        # size, focal length and that of 35 mm film
        ([(WIDE, 0, 0), (TALL, 0, 0), (WIDE, 0, 0), (WIDE, 5, 0), (TALL, 0, 0)], [0, 1, 0, 3, 1]),
        # of one size: a zoom, and a digital one
        ([(WIDE, 5, 0), (WIDE, 7, 0), (WIDE, 5.01, 0), (WIDE, 7, 0)], [0, 1, 0, 1]),
        ([(WIDE, 5, 26), (WIDE, 5, 52), (WIDE, 5, 26)], [0, 1, 0]),
        ([(WIDE, 5, 26), (WIDE, 5, 26), (WIDE, 5, 26)], [0, 0, 0]),
    ],
)
def test_photographs_of_one_size_and_focal_length_share_a_lens(
    kinds: list, lenses: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = tmp_path / "photos"
    for i, (size, focal, of_film) in enumerate(kinds):
        exif = Image.Exif()
        noted = {0x920A: IFDRational(round(100 * focal), 100)} if focal else {}
        exif[0x8769] = noted | ({0xA405: of_film} if of_film else {})
        write_photograph(photos / "plain.png", photograph(i, *size))
        Image.open(photos / "plain.png").save(photos / f"{i}.jpg", exif=exif)
        (photos / "plain.png").unlink()
    found: list[list[int]] = []

    def cameras(job: sfm.Search, progress: object) -> None:
        sfm._extract(job, lambda *_: None, thorough=False)
        images = pycolmap.Database.open(job.database).read_all_images()
        found.append([image.camera_id for image in sorted(images, key=lambda image: image.name)])
        raise CaptureError("enough")

    monkeypatch.setattr(sfm, "find_cameras", cameras)
    for how in (None, False):
        assert_one_line(lambda how=how: run_sfm(photos, tmp_path / "out", single_camera=how), "enough")
    default, each = found
    assert [default.index(lens) for lens in default] == lenses
    assert len(set(each)) >= len(kinds) - 1


def fill(folder: Path, *names: str | bytes) -> Path:
    """Write photographs, by default 0.png to 2.png."""
    for i, name in enumerate(names or ("0.png", "1.png", "2.png")):
        path = folder / (name if isinstance(name, str) else name.decode(errors="surrogateescape"))
        write_photograph(folder / "plain.png", photograph(i, 64, 48))
        path.parent.mkdir(parents=True, exist_ok=True)
        (folder / "plain.png").rename(path)
    return folder


def test_what_cannot_be_searched_for_cameras_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    assert_one_line(lambda: run_sfm(tmp_path / "absent"), "absent", "no such folder")
    (tmp_path / "walk.mp4").touch()
    assert_one_line(lambda: run_sfm(tmp_path / "walk.mp4"), "walk.mp4", "pop frames")
    (tmp_path / "walk.mp4").unlink()
    assert_one_line(lambda: run_sfm(tmp_path), "has 0 photograph")
    fill(tmp_path / "one", "a.png", "masks/a.png")
    assert_one_line(lambda: run_sfm(tmp_path / "one"), "has 1 photograph")
    some = fill(tmp_path / "in")
    # they have nothing in common
    assert_one_line(lambda: run_sfm(some, tmp_path / "out"), "in", "no cameras could be found", "overlap")
    assert_one_line(lambda: run_sfm(some, camera_model="PINHOLES"), "'PINHOLES'", "SIMPLE_RADIAL")
    # before the long work begins
    (some / "b.jpg").write_bytes(cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1].tobytes()[:-40])
    assert_one_line(lambda: run_sfm(some), "b.jpg", "truncated")
    assert sorted(file.name for file in some.iterdir()) == ["0.png", "1.png", "2.png", "b.jpg"]
    bytes_of_a_name = fill(tmp_path / "bytes", b"a\xff.png", b"b.png")
    assert_one_line(lambda: run_sfm(bytes_of_a_name), "not UTF-8", "rename the photograph")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["bytes", "in", "one"]


def test_few_photographs_are_all_matched_and_many_with_their_neighbours() -> None:
    assert len(pairs_of(60, "auto")) == 60 * 59 // 2
    assert len(pairs_of(200, "exhaustive")) == 200 * 199 // 2
    assert pairs_of(30, "sequential") == [pair for pair in pairs_of(200, "auto") if pair[1] < 30]
    many = pairs_of(200, "auto")
    assert len(many) < 200 * 20
    assert {(0, 1), (0, 10), (0, 16), (0, 128), (198, 199)} <= set(many)
    assert all(i < j < 200 for i, j in many)


# Bare folders of photographs: what is read, what is written where, and what is never removed.


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras of the first four photographs, without a search for them."""
    monkeypatch.setattr(
        sfm, "find_cameras", lambda job, *_: make_model(job.names[:4], ring(len(job.names[:4])), [camera()])
    )


def test_photographs_are_never_replaced_by_the_capture_that_is_made_of_them(known: None, tmp_path: Path) -> None:
    shoot = tmp_path / "shoot"
    fill(shoot / "jpgs")
    (shoot / "raw").mkdir()
    (shoot / "raw" / "a.dng").write_bytes(b"raw")
    before = contents(tmp_path)
    for overwrite in (False, True):
        for out in (shoot, tmp_path, shoot / "raw" / ".."):
            says = (str(out), "jpgs", "--out")
            assert_one_line(lambda out=out, o=overwrite: run_sfm(shoot / "jpgs", out, overwrite=o), *says)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("mine", ["notes.txt", "raw/a.dng", "images/more.png", "sparse/0/project.ini", "images/0.png"])
def test_only_what_was_written_before_is_replaced(known: None, tmp_path: Path, mine: str) -> None:
    photos, out = fill(tmp_path / "in"), tmp_path / "out"
    run_sfm(photos, out)
    # another result of the same photographs, and one of fewer, take its place
    run_sfm(photos, out, overwrite=True)
    (photos / "2.png").unlink()
    run_sfm(photos, out, overwrite=True)
    assert sorted(path.name for path in (out / "images").iterdir()) == ["0.png", "1.png"]
    (out / mine).parent.mkdir(exist_ok=True)
    (out / mine).write_bytes(b"mine")
    before = contents(tmp_path)
    assert_one_line(lambda: run_sfm(photos, out, overwrite=True), str(out), mine, "not replaced")
    assert contents(tmp_path) == before


def test_a_model_that_somebody_else_made_next_to_the_photographs_is_kept(known: None, tmp_path: Path) -> None:
    fill(tmp_path / "images")
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / "cameras.bin").write_bytes(b"mine")
    before = contents(tmp_path)
    assert_one_line(lambda: run_sfm(tmp_path / "images", overwrite=True), "sparse", "0/cameras.bin", "did not write")
    assert contents(tmp_path) == before
    shutil.rmtree(tmp_path / "sparse")
    for overwrite in (False, True):
        assert run_sfm(tmp_path / "images", overwrite=overwrite).capture == tmp_path.resolve()


def test_a_capture_among_its_photographs_is_none_of_them_the_next_time(known: None, tmp_path: Path) -> None:
    fill(tmp_path)
    for overwrite in (False, True):
        assert run_sfm(tmp_path, tmp_path / "scene", overwrite=overwrite).photographs == 3
        # photographs that are upright as stored leave no note
        assert sorted(path.name for path in (tmp_path / "scene" / "sparse").iterdir()) == ["0", "sfm.sha256"]


def test_folders_called_images_and_subfolders_alone_are_loaded(known: None, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    images = fill(tmp_path / "images")
    assert_one_line(lambda: load_capture(images), "3 photographs", "pop sfm")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["images", "notes.txt"]
    for options in ({"sfm": True}, {}):
        assert len(load_capture(images, **options).views) == 3
        assert (images / "sparse" / "0" / "cameras.bin").is_file()
    names = ["left cam/0.png", "left cam/1.png", "right/0.png"]
    capture = load_capture(fill(tmp_path / "scene", *names), sfm=True)
    assert [view.name for view in capture.views] == names
    assert capture.notes == ()


def test_a_capture_with_a_folder_images_is_searched_there_and_that_may_be_a_link(known: None, tmp_path: Path) -> None:
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / "images").symlink_to(fill(tmp_path / "scene" / "images"))
    fill(tmp_path / "scene" / "masks")
    for name in ("0.png", "1.png", "2.png"):
        write_photograph(tmp_path / "scene" / "images_2" / name, photograph(3, WIDTH // 2, HEIGHT // 2))
    shutil.copytree(tmp_path / "scene" / "masks", tmp_path / "link" / "masks")
    for root in (tmp_path / "scene", tmp_path / "link"):
        result = run_sfm(root)
        assert (result.capture, result.photographs) == (root, 3)
        (root / "sparse").rename(root / "before")
        views = load_capture(root, factor=2, sfm=True).views
        assert [view.name for view in views] == ["0.png", "1.png", "2.png"]
        assert (root / "sparse" / "0").is_dir()
        assert all(view.mask is not None for view in views)


def test_the_search_for_cameras_is_told_apart_from_loading(known: None, pop: Pop, tmp_path: Path, monkeypatch) -> None:
    fill(tmp_path / "photos", *(f"{i}.png" for i in range(5)))
    searched = sfm.find_cameras

    def slowly(*given: Any) -> Any:
        time.sleep(1.0)
        return searched(*given)

    monkeypatch.setattr(sfm, "find_cameras", slowly)
    done = pop.done("train", tmp_path / "photos", "--out", tmp_path / "out", "--max-steps", "2", *TRAIN, "--skip-sizes")
    lines = done.out.splitlines()
    assert lines[0] in ("cameras found in 1 s", "cameras found in 2 s", "cameras found in 3 s")
    assert any("the model has no camera for 4.png" in line for line in lines)
    stats = json.loads((tmp_path / "out" / "stats" / "val_step0001.json").read_text())
    assert stats["seconds_sfm"] >= 1.0
    assert f"loading {stats['seconds_loading']:.0f} s, finding cameras {stats['seconds_sfm']:.0f} s" in done.out


def test_a_full_disk_of_temporary_files_is_told_by_its_name(photographs, tmp_path, monkeypatch):
    monkeypatch.setattr(sfm, "_listen", lambda child, *_: child.kill())
    with pytest.raises(CaptureError, match="its process ended with status -9; fewer threads and smaller images"):
        run_sfm(photographs, tmp_path / "out")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1_000_000))
    with pytest.raises(CaptureError, match=r"pop_sfm_\w+: the disk is full, .* TMPDIR"):
        run_sfm(photographs, tmp_path / "out")


# Photographs that a camera stored sideways: where the program finds the cameras itself, all is shown upright.

# what a viewer does to the stored pixels, by the orientation in EXIF
SHOWN = {1: 0, 6: -1, 3: 2, 8: 1}


@pytest.fixture
def sideways(known: None, tmp_path: Path) -> Path:
    """Photographs of 40 x 30 stored pixels, each held another way, and their cameras."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for orientation in SHOWN:
        exif = Image.Exif()
        exif[0x112] = orientation
        Image.fromarray(photograph(orientation)).save(folder / f"{orientation}.png", exif=exif)
    run_sfm(folder)
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


def test_pictures_are_upright_and_every_point_keeps_its_pixel(pop: Pop, sideways: Path) -> None:
    outcome = pop("data", "check", sideways)
    assert "3 are stored rotated and shown upright" in outcome.out
    assert "LOOK  EXIF" not in outcome.out
    turned = {view.name: view for view in raw(sideways).views}
    (sideways / "sparse" / "upright.json").unlink()
    # EXIF is ignored as COLMAP ignores it, where nothing says that the program found the cameras
    stored = {view.name: view for view in raw(sideways).views}
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (300, 3))
    for orientation, quarters in SHOWN.items():
        name = f"{orientation}.png"
        np.testing.assert_array_equal(stored[name].image, photograph(orientation))
        np.testing.assert_array_equal(turned[name].image, np.rot90(stored[name].image, quarters))
        np.testing.assert_array_equal(colors_at(turned[name], points), colors_at(stored[name], points))
        assert np.linalg.det(turned[name].viewmat) == pytest.approx(1.0)
        np.testing.assert_allclose(turned[name].camera_center, stored[name].camera_center, atol=1e-12)


def test_exif_orientation_is_ignored_in_a_jpeg_which_opencv_would_turn(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, names=["a.jpg", "b.jpg"])
    plain, path = raw(root).views[0].image, root / "images" / "a.jpg"
    data, rotate = path.read_bytes(), b"Exif\0\0II*\0" + struct.pack("<IHHHIII", 8, 1, 0x0112, 3, 1, 6, 0)
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(rotate) + 2) + rotate + data[2:])
    assert cv2.imread(str(path)).shape[:2] == (WIDTH, HEIGHT)
    assert np.array_equal(raw(root).views[0].image, plain)


def test_a_mask_fits_drawn_over_the_stored_or_over_the_shown_picture(sideways: Path) -> None:
    keep = np.zeros((30, 40), np.uint8)
    keep[:7, :11] = 255
    for orientation in SHOWN:
        mask = np.rot90(keep, SHOWN[8]) if orientation == 8 else keep
        write_photograph(sideways / "masks" / f"{orientation}.png", mask)
    for view in load_capture(sideways).views:
        np.testing.assert_array_equal(view.mask, np.rot90(keep > 0, SHOWN[int(view.name[0])]))


def test_a_capture_of_its_own_is_upright_too_and_may_be_made_again(sideways: Path, tmp_path: Path) -> None:
    for overwrite in (False, True):
        run_sfm(sideways, tmp_path / "scene", overwrite=overwrite)
        sizes = {view.name: (view.width, view.height) for view in load_capture(tmp_path / "scene").views}
        assert sizes == {"1.png": (40, 30), "3.png": (40, 30), "6.png": (30, 40), "8.png": (30, 40)}


@pytest.mark.parametrize("text", ["{", '{"6.png": 4}', '{"6.png": true}', "[]"])
def test_a_damaged_note_is_named(sideways: Path, text: str) -> None:
    (sideways / "sparse" / "upright.json").write_text(text)
    assert_one_line(lambda: load_capture(sideways), "upright.json", "pop sfm again with --overwrite")
