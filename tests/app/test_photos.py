"""Structure from motion on a bare folder of photographs."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from pop_fast.data import load_capture, run_sfm, sfm
from pop_fast.data.capture import View
from pop_fast.data.photo_quality import sharpness
from pop_fast.data.sfm import pairs_of
from pop_fast.data.unpack import take_frames
from pop_fast.demo.make import render_view
from pop_fast.demo.scene import make_scene
from pop_fast.errors import CaptureError, PopError
from pop_fast.io import images
from pop_fast.io.images import list_images, read_image
from pop_fast.view.paths import VideoFile
from tests.app.captures import PINHOLE, assert_one_line, camera, look_at, make_model, photograph, ring, write_photograph
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import contents, says

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


def test_cameras_are_found_where_the_photographs_were_taken(found: Path) -> None:
    views = load_capture(found, normalize=False).views
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


def test_photographs_are_copied_beside_the_model(found: Path, photographs: Path) -> None:
    for file in photographs.iterdir():
        assert (found / "images" / file.name).read_bytes() == file.read_bytes()


def test_the_same_photographs_give_the_same_bytes_and_progress_is_told(
    found: Path, photographs: Path, tmp_path: Path
) -> None:
    told: list[tuple[str, int, int]] = []
    (tmp_path / "in").mkdir()
    for file in photographs.iterdir():
        shutil.copy(file, tmp_path / "in")
    # in place this time: the model comes to lie beside the photographs
    result = run_sfm(tmp_path / "in", progress=lambda *what: told.append(what))
    assert result.capture == (tmp_path / "in").resolve()
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (tmp_path / "in" / "sparse" / "0" / name).read_bytes() == (found / "sparse" / "0" / name).read_bytes()
    n = len(CENTERS)
    assert {stage for stage, _, _ in told} == {
        "checking photographs",
        "finding features in photographs",
        "matching pairs of photographs",
        "finding cameras of photographs",
    }
    assert ("finding features in photographs", n, n) in told
    assert ("matching pairs of photographs", n * (n - 1) // 2, n * (n - 1) // 2) in told
    assert ("finding cameras of photographs", n, n) in told
    assert all(0 <= done <= total for _, done, total in told)
    assert len(load_capture(tmp_path / "in").views) == n
    assert_one_line(lambda: run_sfm(tmp_path / "in"), "sparse", "--overwrite")


def test_a_bare_folder_is_loaded_only_when_sfm_is_asked_for(photographs: Path, tmp_path: Path) -> None:
    shutil.copytree(photographs, tmp_path / "scene" / "images")
    assert_one_line(lambda: load_capture(tmp_path / "scene"), "7 photographs", "pop sfm")
    assert sorted(file.name for file in (tmp_path / "scene").iterdir()) == ["images"]
    capture = load_capture(tmp_path / "scene", sfm=True)
    assert len(capture.views) == len(CENTERS)
    assert (tmp_path / "scene" / "sparse" / "0" / "cameras.bin").is_file()
    assert len(load_capture(tmp_path / "scene").views) == len(CENTERS)


def test_photographs_without_anything_in_common_give_one_line_and_no_output(tmp_path: Path) -> None:
    for i in range(3):
        write_photograph(tmp_path / "in" / f"{i}.png", photograph(i, 64, 48))
    assert_one_line(lambda: run_sfm(tmp_path / "in", tmp_path / "out"), "in", "no cameras could be found", "overlap")
    assert [file.name for file in tmp_path.iterdir()] == ["in"]


def test_fewer_than_two_photographs_are_refused(tmp_path: Path) -> None:
    assert_one_line(lambda: run_sfm(tmp_path / "absent"), "absent", "no such folder")
    assert_one_line(lambda: run_sfm(tmp_path), "has 0 photograph")
    write_photograph(tmp_path / "a.png", photograph(0))
    write_photograph(tmp_path / "masks" / "a.png", photograph(0))
    assert_one_line(lambda: run_sfm(tmp_path), "has 1 photograph")


def test_a_damaged_photograph_is_found_before_the_long_work_begins(tmp_path: Path) -> None:
    write_photograph(tmp_path / "a.png", photograph(0))
    _, data = cv2.imencode(".jpg", photograph(1))
    (tmp_path / "b.jpg").write_bytes(data.tobytes()[:-40])
    assert_one_line(lambda: run_sfm(tmp_path), "b.jpg", "truncated")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.png", "b.jpg"]


def test_an_unknown_camera_model_is_refused(tmp_path: Path) -> None:
    for i in range(2):
        write_photograph(tmp_path / f"{i}.png", photograph(i))
    assert_one_line(lambda: run_sfm(tmp_path, camera_model="PINHOLES"), "'PINHOLES'", "SIMPLE_RADIAL")


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
def _cameras_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(job: Any, *_: Any) -> Any:
        return make_model(job.names[:3], ring(len(job.names[:3])))

    monkeypatch.setattr(sfm, "find_cameras", find)


def fill(folder: Path, names: tuple[str, ...] = ("0.png", "1.png", "2.png")) -> Path:
    for i, name in enumerate(names):
        write_photograph(folder / name, photograph(i))
    return folder


@pytest.mark.usefixtures("_cameras_are_known")
def test_photographs_are_never_replaced_by_the_capture_that_is_made_of_them(tmp_path: Path) -> None:
    shoot = tmp_path / "shoot"
    fill(shoot / "jpgs")
    (shoot / "raw").mkdir()
    (shoot / "raw" / "a.dng").write_bytes(b"raw")
    (shoot / "notes.txt").write_text("mine")
    before = contents(tmp_path)
    for overwrite in (False, True):
        for out in (shoot, tmp_path, shoot / "raw" / ".."):
            assert_one_line(
                lambda out=out, o=overwrite: run_sfm(shoot / "jpgs", out, overwrite=o), str(out), "jpgs", "--out"
            )
    assert contents(tmp_path) == before


@pytest.mark.usefixtures("_cameras_are_known")
@pytest.mark.parametrize("mine", ["notes.txt", "raw/a.dng", "images/more.png", "sparse/0/project.ini", "images/0.png"])
def test_only_what_was_written_before_is_replaced(tmp_path: Path, mine: str) -> None:
    fill(tmp_path / "in")
    out = tmp_path / "out"
    run_sfm(tmp_path / "in", out)
    # another result of the same photographs, and one of fewer, take its place
    run_sfm(tmp_path / "in", out, overwrite=True)
    (tmp_path / "in" / "2.png").unlink()
    run_sfm(tmp_path / "in", out, overwrite=True)
    assert sorted(path.name for path in (out / "images").iterdir()) == ["0.png", "1.png"]
    (out / mine).parent.mkdir(exist_ok=True)
    (out / mine).write_bytes(b"mine")
    before = contents(tmp_path)
    assert_one_line(lambda: run_sfm(tmp_path / "in", out, overwrite=True), str(out), mine, "not replaced")
    assert contents(tmp_path) == before


@pytest.mark.usefixtures("_cameras_are_known")
def test_a_model_that_somebody_else_made_beside_the_photographs_is_kept(tmp_path: Path) -> None:
    fill(tmp_path / "images")
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / "cameras.bin").write_bytes(b"mine")
    before = contents(tmp_path)
    assert_one_line(lambda: run_sfm(tmp_path / "images", overwrite=True), "sparse", "0/cameras.bin", "did not write")
    assert contents(tmp_path) == before
    shutil.rmtree(tmp_path / "sparse")
    for overwrite in (False, True):
        assert run_sfm(tmp_path / "images", overwrite=overwrite).capture == tmp_path.resolve()


@pytest.mark.usefixtures("_cameras_are_known")
def test_a_capture_made_inside_the_folder_of_photographs_is_no_photograph_the_next_time(tmp_path: Path) -> None:
    fill(tmp_path)
    for overwrite in (False, True):
        assert run_sfm(tmp_path, tmp_path / "scene", overwrite=overwrite).photographs == 3


@pytest.mark.usefixtures("_cameras_are_known")
def test_a_folder_that_is_itself_called_images_is_loaded(tmp_path: Path) -> None:
    root = fill(tmp_path / "images")
    (tmp_path / "notes.txt").write_text("mine")
    assert len(load_capture(root, sfm=True).views) == 3
    assert len(load_capture(root).views) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["images", "notes.txt"]


@pytest.mark.usefixtures("_cameras_are_known")
def test_photographs_in_subfolders_alone_are_loaded(tmp_path: Path) -> None:
    fill(tmp_path, ("left cam/0.png", "left cam/1.png", "right/0.png"))
    capture = load_capture(tmp_path, sfm=True)
    assert [view.name for view in capture.views] == ["left cam/0.png", "left cam/1.png", "right/0.png"]
    assert capture.notes == ()


@pytest.mark.usefixtures("_cameras_are_known")
def test_photographs_that_could_not_be_placed_are_told(tmp_path: Path) -> None:
    fill(tmp_path, tuple(f"{i}.png" for i in range(5)))
    (note,) = load_capture(tmp_path, sfm=True).notes
    assert note.startswith("3 of 5 photographs in")
    assert note.endswith("has no camera for 3.png, 4.png")


@pytest.mark.usefixtures("_cameras_are_known")
def test_photographs_in_a_format_that_is_not_read_are_named_with_the_way_to_convert_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(images, "can_read_heif", lambda: False)
    for name in ("a.HEIC", "b.HEIC", "c.dng"):
        (tmp_path / name).write_bytes(b"no JPEG")
    words = ("3 files are HEIC", "pip install pillow-heif, or convert them to JPEG", "mogrify -format jpg *.HEIC")
    assert_one_line(lambda: load_capture(tmp_path, sfm=True), "has no photographs", *words)
    assert_one_line(lambda: run_sfm(tmp_path), "has 0 photograph(s)", *words)


@pytest.mark.usefixtures("_cameras_are_known")
def test_the_search_for_cameras_is_told_apart_from_loading(pop: Pop, tmp_path: Path, monkeypatch: Any) -> None:
    fill(tmp_path / "photos", tuple(f"{i}.png" for i in range(4)))
    searched = sfm.find_cameras

    def slowly(*given: Any) -> Any:
        time.sleep(1.0)
        return searched(*given)

    monkeypatch.setattr(sfm, "find_cameras", slowly)
    done = pop.done("train", tmp_path / "photos", "--out", tmp_path / "out", "--max-steps", "2", *TRAIN, "--skip-sizes")
    lines = done.out.splitlines()
    assert lines[0] in ("cameras found in 1 s", "cameras found in 2 s", "cameras found in 3 s")
    assert any("the model has no camera for 3.png" in line for line in lines)
    stats = json.loads((tmp_path / "out" / "stats" / "val_step0001.json").read_text())
    assert stats["seconds_sfm"] >= 1.0
    assert f"loading {stats['seconds_loading']:.0f} s, finding cameras {stats['seconds_sfm']:.0f} s" in done.out


# Photographs that a camera stored sideways: where the program finds the cameras itself, all is shown upright.

ORIENTATIONS = (1, 6, 3, 8)
# what a viewer does to the stored pixels
SHOWN = {1: 0, 6: -1, 3: 2, 8: 1}


@pytest.fixture
def _upright_cameras_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(job: Any, *_: Any) -> Any:
        return make_model(job.names, ring(len(job.names)), [camera("PINHOLE", PINHOLE, 40, 30)])

    monkeypatch.setattr(sfm, "find_cameras", find)


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


@pytest.mark.usefixtures("_upright_cameras_are_known")
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


@pytest.mark.usefixtures("_upright_cameras_are_known")
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


@pytest.mark.usefixtures("_upright_cameras_are_known")
def test_a_capture_of_its_own_is_upright_too_and_may_be_made_again(tmp_path: Path) -> None:
    folder = shoot(tmp_path / "photos")
    for overwrite in (False, True):
        run_sfm(folder, tmp_path / "scene", overwrite=overwrite)
        sizes = {view.name: (view.width, view.height) for view in load_capture(tmp_path / "scene").views}
        assert sizes == {"1.png": (40, 30), "3.png": (40, 30), "6.png": (30, 40), "8.png": (30, 40)}


@pytest.mark.usefixtures("_upright_cameras_are_known")
def test_photographs_that_are_upright_as_stored_leave_no_note(tmp_path: Path) -> None:
    for i in range(3):
        write_photograph(tmp_path / f"{i}.png", photograph(i))
    run_sfm(tmp_path)
    assert sorted(path.name for path in (tmp_path / "sparse").iterdir()) == ["0", "sfm.sha256"]


@pytest.mark.usefixtures("_upright_cameras_are_known")
@pytest.mark.parametrize("text", ["{", '{"6.png": 4}', '{"6.png": true}', "[]"])
def test_a_damaged_note_is_named(tmp_path: Path, text: str) -> None:
    folder = shoot(tmp_path / "photos")
    run_sfm(folder)
    (folder / "sparse" / "upright.json").write_text(text)
    assert_one_line(lambda: load_capture(folder), "upright.json", "pop sfm again with --overwrite")


@pytest.mark.usefixtures("_upright_cameras_are_known")
def test_the_check_says_that_they_are_turned(pop: Pop, tmp_path: Path) -> None:
    folder = shoot(tmp_path / "photos")
    run_sfm(folder)
    outcome = pop("data", "check", folder)
    assert "3 are stored turned and shown upright" in outcome.out
    assert "LOOK  EXIF" not in outcome.out


# Photographs out of a video: sharp ones, spread over its time, and none of a camera at rest.

# of every five frames these are sharp; two stretches of ten in the middle show the same
SHARP = (2, 4)
RESTING = range(30, 50)


def frame(number: int) -> np.ndarray:
    """A window that wanders over a texture; blurred unless the camera is held still for it."""
    coarse = np.random.default_rng(3).integers(0, 256, (24, 60, 3)).astype(np.uint8)
    texture = cv2.resize(coarse, (480, 192), interpolation=cv2.INTER_CUBIC)
    at = RESTING.start if number in RESTING else number
    window = np.ascontiguousarray(texture[20 : 20 + 96, 4 * at : 4 * at + 128])
    return window if number % 5 in SHARP else cv2.GaussianBlur(window, (0, 0), 3.0)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "walk.avi"
    with VideoFile(path, fps=30.0) as video:
        for number in range(80):
            video.add(frame(number))
    return path


def test_every_stretch_gives_a_sharp_frame_and_a_rest_gives_one(clip: Path, tmp_path: Path) -> None:
    taken = take_frames(clip, tmp_path / "out", count=8)
    assert taken.of == 80
    assert len(taken.frames) + taken.alike == 8
    assert all(number % 5 in SHARP for number in taken.frames)
    assert all(later - earlier >= 5 for earlier, later in zip(taken.frames, taken.frames[1:], strict=False))
    assert sum(number in RESTING for number in taken.frames) == 1
    assert taken.alike == 1
    names = [path.name for path in list_images(tmp_path / "out")]
    assert names == [f"walk_{number:06d}.jpg" for number in taken.frames]
    image = read_image(tmp_path / "out" / names[0])
    assert np.abs(image.astype(int) - frame(taken.frames[0])).mean() < 6.0


def test_sharpness_is_that_of_the_picture_shrunk_and_falls_with_blur() -> None:
    sharp, soft = (cv2.cvtColor(frame(number), cv2.COLOR_RGB2GRAY) for number in (2, 3))
    assert sharpness(sharp) > 4.0 * sharpness(soft)
    large = np.kron(sharp, np.ones((8, 8), np.uint8))
    assert sharpness(large) == pytest.approx(sharpness(cv2.resize(large, (512, 384), interpolation=cv2.INTER_AREA)))


def test_more_frames_than_there_are_give_all_that_differ(clip: Path, tmp_path: Path) -> None:
    taken = take_frames(clip, tmp_path / "out", count=1000)
    assert len(taken.frames) + taken.alike == 80
    assert len(taken.frames) >= 55


def test_photographs_can_be_made_smaller(clip: Path, tmp_path: Path) -> None:
    take_frames(clip, tmp_path / "out", count=4, max_size=64)
    assert {read_image(path).shape for path in list_images(tmp_path / "out")} == {(48, 64, 3)}


def test_the_command_writes_beside_the_video_and_says_what_comes_next(clip: Path, tmp_path: Path, pop: Pop) -> None:
    video = tmp_path / "walk.avi"
    video.write_bytes(clip.read_bytes())
    done = pop("frames", video, "--count", "6")
    folder = tmp_path / "walk_frames"
    assert done.status == 0
    assert done.out.splitlines()[-1] == f"next: pop train {folder}"
    assert "of 80 frames" in done.out
    says(pop("frames", video, "--count", "4"), str(folder))
    assert pop("frames", video, "--count", "4", "--overwrite").status == 0
    assert len(list_images(folder)) <= 4
    (folder / "mine.jpg").write_bytes(b"mine")
    assert pop("frames", video, "--overwrite").status == 2
    assert (folder / "mine.jpg").read_bytes() == b"mine"


def test_what_is_no_video_is_one_line_and_leaves_nothing(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.avi").write_bytes(clip.read_bytes()[:2000])
    (tmp_path / "text.mp4").write_text("no video")
    with VideoFile(tmp_path / "still.avi", fps=10.0) as video:
        for _ in range(12):
            video.add(frame(2))
    out = tmp_path / "out"
    for name, message in (
        ("absent.mp4", "no such file"),
        ("text.mp4", "is no video that OpenCV can read"),
        ("still.avi", "nothing moves in it"),
    ):
        with pytest.raises(CaptureError, match=message) as error:
            take_frames(tmp_path / name, out, count=4)
        assert str(tmp_path / name) in str(error.value)
        assert not out.exists()
    with pytest.raises(CaptureError, match=r"cut\.avi"):
        take_frames(tmp_path / "cut.avi", out, count=4)
    for wrong, message in (({"count": 1}, "count is 1"), ({"max_size": 8}, "max_size is 8")):
        with pytest.raises(PopError, match=message):
            take_frames(clip, out, **wrong)


def test_training_on_a_video_says_how_to_take_photographs_out_of_it(clip: Path) -> None:
    with pytest.raises(CaptureError, match=r"walk\.avi: is a video; .* pop frames"):
        load_capture(clip)
