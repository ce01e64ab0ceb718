"""`pop render`: held-out views and camera paths, as pictures and as video; and the paths and the video files."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pop_fast.blocks import jobs
from pop_fast.data import View, load_capture
from pop_fast.data.capture import camera_centers, focus_point, look_at_one_point, neighbour_degrees
from pop_fast.data.unpack import take_frames
from pop_fast.errors import PopError
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.load_result import CaptureOptions, drawn_in_frame, load_splat, open_capture
from pop_fast.train.results import read_config
from pop_fast.view import paths
from pop_fast.view.frames import inside, picture_names, write_pictures
from pop_fast.view.paths import PATHS, VideoFile, camera_path, frames_in, has_h264, interpolate, look_at, mean_up, orbit
from tests.app.captures import (
    assert_one_line,
    camera,
    edit_transforms,
    photograph,
    transforms_capture,
    write_model,
    write_photograph,
)
from tests.app.captures import ring as turntable
from tests.app.conftest import Outcome, Pop, in_a_child
from tests.app.damage import contents, says
from tests.app.test_blocks import in_this_process
from tests.app.test_strategies import tiny_method
from tests.app.tiny import skip_without, tiny_capture

Render = Callable[..., Outcome]


def read(path: Path) -> np.ndarray:
    return cv2.imread(str(path))[:, :, ::-1]


@pytest.fixture
def rendered(pop: Pop, shared_result: Path) -> Render:
    return lambda *words: pop("render", shared_result, *words)


def test_held_out_views_are_rendered_to_the_same_bytes_as_in_training(rendered, shared_result, tmp_path):
    assert "1 view of toy" in rendered("--out", tmp_path / "views").out
    assert sorted(os.listdir(tmp_path / "views")) == ["renders.json", "view_000.png"]
    kept = np.load(shared_result / "report_data" / "val_step29_0000.npz")
    np.testing.assert_array_equal(read(tmp_path / "views" / "view_000.png"), kept["render"])


@pytest.mark.parametrize("path", ["orbit", "ellipse", "interpolate"])
def test_a_path_gives_as_many_pictures_and_frames_as_asked(rendered, shared_result, tmp_path, path):
    words = ["--path", path, "--frames", "3", "--out", tmp_path / "frames", "--video", tmp_path / "clip.webm"]
    assert rendered(*words).status == 0
    pictures = sorted((tmp_path / "frames").glob("*.png"))
    assert [p.name for p in pictures] == [f"{path}_{i:04d}.png" for i in range(3)]
    assert all(read(p).shape == (32, 40, 3) for p in pictures)
    assert len({p.read_bytes() for p in pictures}) == 3
    video = cv2.VideoCapture(str(tmp_path / "clip.webm"))
    assert [video.read()[0] for _ in range(4)] == [True, True, True, False]
    # the index names the file of every view
    assert json.loads((tmp_path / "frames" / "renders.json").read_text()) == {
        "splat": str(shared_result / "ckpts" / "ckpt_29_rank0.pt"),
        "capture": "toy",
        "path": path,
        "renders": [{"view": f"{path}_{i:04d}", "file": f"{path}_{i:04d}.png"} for i in range(3)],
    }


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("", "give --out DIR for pictures, --video FILE"),
        ("--out r --frames 3", "--frames 3 is of a path, and every held-out view is drawn; give --path orbit"),
        ("--out r --path orbit --frames 1000000000", "frames is 1000000000; give --frames 1 or more, and at most"),
        ("--out r --fps 5", "--fps 5 is of a video; give --video FILE"),
        ("--video clip.webm --fps 0", "clip.webm: fps is 0.0; it must be a number from 0.5 to 600"),
        ("--out r --video r/clip.webm", "r/clip.webm: lies in --out r, which holds pictures only"),
        ("--out r --test-every 0", "no view is held out"),
        ("--out r --path orbit --test-every 1", "needs 1 or more training views and there are 0"),
        ("--out .", "the folder that this command runs in; choose another output folder"),
    ],
)
def test_what_cannot_be_rendered_is_said_and_nothing_is_written(rendered, tmp_path, monkeypatch, words, part):
    monkeypatch.chdir(tmp_path)
    says(rendered(*words.split()), part)
    assert list(tmp_path.iterdir()) == []


def test_an_earlier_video_is_replaced_only_when_asked(rendered: Render, tmp_path: Path) -> None:
    clip = tmp_path / "clip.webm"
    clip.write_text("mine")
    says(rendered("--video", clip), "clip.webm", "exists; pass --overwrite")
    assert clip.read_text() == "mine"
    assert rendered("--video", clip, "--overwrite").status == 0
    assert frames_in(clip) == 1
    # and leaves no pictures
    assert os.listdir(tmp_path) == ["clip.webm"]


def test_an_earlier_render_is_replaced_only_when_asked(rendered: Render, tmp_path: Path) -> None:
    out = ("--out", tmp_path / "r")
    assert rendered(*out, "--path", "orbit", "--frames", "2").status == 0
    before = contents(tmp_path)
    says(rendered(*out), str(tmp_path / "r"), "exists and is not empty; choose another or pass --overwrite")
    assert contents(tmp_path) == before
    assert rendered(*out, "--overwrite").status == 0
    assert sorted(os.listdir(tmp_path / "r")) == ["renders.json", "view_000.png"]


def test_pictures_without_an_index_of_this_command_are_somebody_else_s(rendered: Render, tmp_path: Path) -> None:
    for number, index in enumerate((None, "[]", '{"renders": 3}', "{", '{"renders": [{}]}')):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "view_000.png").write_text("mine")
        if index is not None:
            (folder / "renders.json").write_text(index)
        before = contents(folder)
        says(rendered("--out", folder, "--overwrite"), "did not write", "view_000.png")
        assert contents(folder) == before


def test_what_is_read_is_never_replaced(pop: Pop, capture: Path, result: Path, tmp_path: Path) -> None:
    before = contents(tmp_path)
    words = ["render", result, "--capture", capture, "--overwrite", "--out"]
    says(pop(*words, result), f"{result}: is read by this command")
    says(pop(*words, capture), f"{capture}: is read by this command")
    says(pop(*words, tmp_path), f"{tmp_path}: holds", "choose another output folder")
    says(pop(*words, capture / "images"), "did not write (view_000.png, view_001.png, view_002.png, ...)")
    assert contents(tmp_path) == before


def test_renders_never_take_the_place_of_photographs_outside_the_capture(rendered: Render, tmp_path: Path) -> None:
    scene = transforms_capture(tmp_path / "scene", 8)
    for i in range(8):
        write_photograph(tmp_path / "away" / f"{i}.png", photograph(i))

    def lead_out(listing: dict[str, Any]) -> None:
        for i, frame in enumerate(listing["frames"]):
            frame["file_path"] = f"../away/{i}.png" if i % 2 else str(tmp_path / "away" / f"{i}.png")

    edit_transforms(scene, lead_out)
    before = contents(tmp_path)
    assert rendered("--capture", scene, "--own-frame", "--test-every", "1", "--out", tmp_path / "r").status == 0
    after = contents(tmp_path)
    assert {path: after.get(path) for path in before} == before
    new = sorted(path.relative_to(tmp_path).as_posix() for path in set(after) - set(before))
    assert new == [*(f"r/{i}.png" for i in (0, 2, 4, 6)), *(f"r/away/{i}.png" for i in (1, 3, 5, 7)), "r/renders.json"]


def test_no_picture_is_written_outside_its_folder(tmp_path: Path) -> None:
    (tmp_path / "r").mkdir()
    frames = write_pictures(iter([np.zeros((2, 2, 3), np.uint8)]), [Path("../a.png")], tmp_path / "r")
    with pytest.raises(PopError, match="leads out"):
        next(frames)
    assert os.listdir(tmp_path) == ["r"]
    for name in ("../a.png", "/a.png", "b/../../a.png"):
        assert_one_line(partial(inside, tmp_path, Path(name)), name, "leads out", "give it a name without")


def test_every_view_has_a_file_of_its_own(rendered: Render, tmp_path: Path) -> None:
    names = ["cam.00", "cam.08", "x.jpg", "x.png"]
    scene = transforms_capture(tmp_path / "scene", 4)
    for i, name in enumerate(names):
        stored = name if name.startswith("x") else f"{name}.png"
        write_photograph(scene / "images" / stored, photograph(i))
    edit_transforms(
        scene, lambda d: [d["frames"][i].update(file_path=f"images/{name}") for i, name in enumerate(names)]
    )
    outcome = rendered("--capture", scene, "--own-frame", "--test-every", "1", "--out", tmp_path / "r")
    assert "4 views" in outcome.out, outcome.err
    listed = json.loads((tmp_path / "r" / "renders.json").read_text())["renders"]
    assert listed == [{"view": f"images/{name}", "file": f"images/{name}.png"} for name in names]
    assert sorted(os.listdir(tmp_path / "r" / "images")) == sorted(f"{name}.png" for name in names)


def test_what_a_capture_does_not_allow_is_refused_with_a_way_out(rendered: Render, tmp_path: Path) -> None:
    # a video of views of two sizes
    lenses = [camera(), camera(params=(36.0, 35.0, 15.5, 20.25), width=30, height=40)] * 2
    for i, lens in enumerate(lenses):
        write_photograph(tmp_path / "scene" / "images" / f"{i}.png", photograph(i, lens.width, lens.height))
    write_model(tmp_path / "scene" / "sparse" / "0", [f"{i}.png" for i in range(4)], turntable(4), lenses)
    words = ["--capture", tmp_path / "scene", "--own-frame", "--test-every", "1"]
    says(
        rendered(*words, "--video", tmp_path / "clip.webm"),
        "clip.webm: the views have 2 sizes (1.png is 30 x 40 px, 0.png is 40 x 30 px)",
        "write pictures with --out DIR, or film a path with --path orbit",
    )
    assert os.listdir(tmp_path) == ["scene"]
    assert rendered(*words, "--out", tmp_path / "r").status == 0
    # a path through one training view
    scene = transforms_capture(tmp_path / "two", 2)
    words = ["--capture", scene, "--own-frame", "--test-every", "2", "--out", tmp_path / "one", "--path"]
    says(
        rendered(*words, "interpolate"),
        "two: --path interpolate needs 2 or more training views and there are 1",
        "hold fewer out with --test-every 0, or take --path orbit",
    )
    assert not (tmp_path / "one").exists()
    assert rendered(*words, "orbit", "--frames", "2").status == 0


RIGID = {"viewmat": np.eye(4).tolist(), "fov_y_degrees": 50.0}


def recorded(**camera: Any) -> str:
    """Write a path down whose second camera is another."""
    cameras = [RIGID, RIGID | camera]
    return json.dumps({"kind": "pop camera path", "frame": "capture", "cameras": cameras})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[1]", "it must be an object"),
        ('{"kind": "something"}', "is not a camera path of 'pop view' (kind 'something')"),
        ('{"kind": "pop camera path", "frame": "capture", "cameras": []}', "has no cameras"),
        ('{"kind": "pop camera path", "frame": "capture", "cameras": [{}]}', "cameras[0]: needs viewmat"),
        (recorded(viewmat=np.diag([2.0, 1, 1, 1]).tolist()), "cameras[1]: viewmat is not a rigid"),
        (recorded(fov_y_degrees=180), "fov_y_degrees is 180"),
        (recorded(viewmat=np.diag([-1.0, 1, 1, 1]).tolist()), "cameras[1]: viewmat is mirrored"),
        (recorded(fov_y_degrees=10**400), "cameras[1]: needs viewmat and fov_y_degrees"),
    ],
)
def test_a_recorded_path_that_is_none_is_refused(rendered: Render, tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "path.json").write_text(text)
    outcome = rendered("--path", tmp_path / "path.json", "--out", tmp_path / "views")
    says(outcome, f"{tmp_path / 'path.json'}: ", words, "record it again")
    assert not (tmp_path / "views").exists()


# Inria's near plane is a length of the capture's own world: what a run draws, trains, records and hands on.

SHORT = ("--method", "3dgs", "--steps-scaler", "0.001", "--no-progress", "--skip-checks", "--skip-sizes")


# a method, by how much the capture's own world was scaled to make the one that it is in, and whether it is seen
CASES = {
    "3dgs": (0.25, True),
    "3dgs in its own world": (1.0, False),
    "speedy-splat": (0.25, True),
    "gsplat": (1.0, True),
}


@pytest.mark.parametrize("backend", ["fast", "compiled"])
@pytest.mark.parametrize("case", CASES)
def test_a_gaussian_at_half_of_inrias_near_plane_is_seen_where_the_world_was_shrunk(case, backend, tmp_path):
    skip_without(backend)
    (scale, is_seen), capture = CASES[case], tiny_capture()
    eye, *others = capture.train_views(5)
    config = tiny_method(tmp_path, case.split()[0], backend=backend, test_every=5)
    initial = {key: value.detach().clone() for key, value in TrainingRun(config, capture).params.items()}
    # a tenth of the world's unit in front of one camera; the others are far away
    place = eye.camera_center + 0.1 * eye.viewmat[2, :3]
    initial["means"][0], initial["scales"][0] = torch.tensor(place), -6.0
    shrunk = replace(capture, world_transform=np.diag([scale, scale, scale, 1.0]))
    run = TrainingRun(config, shrunk, initial=initial)
    run.take_steps(1 + len(others))
    assert int(run.state["count"][0]) == is_seen + sum(_shows(view, place) for view in others)


def _shows(view: View, place: np.ndarray) -> bool:
    x, y, z = view.viewmat[:3, :3] @ place + view.viewmat[:3, 3]
    u, v = (view.K @ [x, y, z])[:2] / z
    return bool(z > 1.0 and 0.0 <= u <= view.width and 0.0 <= v <= view.height)


def test_a_run_writes_its_near_plane_down_and_goes_on_with_it(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    scale, out = load_capture(shared_capture).world_scale, tmp_path / "out"
    assert abs(scale - 1.0) > 0.1
    words = ("train", shared_capture, "--out", out, *SHORT)
    pop.done(*words)
    near = json.loads((out / "cfg.json").read_text())["resolved"]["near_plane"]
    assert near == pytest.approx(0.2 * scale, rel=1e-12)
    pop.done(*words, "--resume")
    assert read_config(out).near_plane == near
    splat = load_splat(out)
    assert open_capture(splat, CaptureOptions())[1].renderer.near_plane == near
    # in the capture's own world it is Inria's number
    own = open_capture(splat, CaptureOptions(own_frame=True))[1]
    assert own.renderer.near_plane == pytest.approx(0.2, rel=1e-12)


def test_an_export_is_looked_at_with_the_near_plane_of_its_run(pop, shared_capture, shared_result, tmp_path):
    scale = load_capture(shared_capture).world_scale
    for frame, near in {"capture": 0.01 / scale, "training": 0.01}.items():
        pop.done("export", shared_result, "--out", tmp_path / f"{frame}.ply", "--frame", frame)
        splat = load_splat(tmp_path / f"{frame}.ply")
        config = open_capture(splat, CaptureOptions(capture=shared_capture))[1]
        assert config.renderer.near_plane == pytest.approx(near, rel=1e-12)


def test_a_file_without_a_capture_is_drawn_with_the_near_plane_of_its_run(pop, shared_capture, shared_result, tmp_path):
    scale = load_capture(shared_capture).world_scale
    for frame, near in {"capture": 0.01 / scale, "training": 0.01}.items():
        file = tmp_path / f"{frame}.ply"
        pop.done("export", shared_result, "--out", file, "--frame", frame)
        assert drawn_in_frame(load_splat(file), CaptureOptions()).renderer.near_plane == pytest.approx(near, rel=1e-12)
        for word in ("export", "convert"):
            page = tmp_path / f"{frame}_{word}.html"
            pop.done(word, file, *(["--out"] if word == "export" else []), page)
            found = re.search(r'"near": ?([\d.e-]+)', page.read_text())
            assert found is not None
            assert float(found[1]) == pytest.approx(near, rel=1e-6)


def test_blocks_are_trained_with_the_near_plane_of_the_whole(pop, shared_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "_run", in_this_process)
    monkeypatch.setattr(jobs, "has_snakemake", lambda: False)
    scale, out = load_capture(shared_capture).world_scale, tmp_path / "out"
    words = ("train", shared_capture, "--out", out, *SHORT, "--blocks", "2x1", "--blocks-rounds", "0", "--threads", "1")
    for more in ((), ("--resume",)):
        assert pop(*words, *more).status == 0
    found = {path.parent: read_config(path.parent).near_plane for path in out.rglob("cfg.json")}
    assert len(found) > 2
    assert list(found.values()) == [pytest.approx(0.2 * scale, rel=1e-12)] * len(found)


def test_what_is_said_is_taken_and_other_profiles_have_their_own() -> None:
    said = TrainConfig.of(method="3dgs", near_plane=0.5).in_world(0.25)
    assert said.renderer.near_plane == 0.5
    assert TrainConfig.of(method="gsplat").in_world(0.25).near_plane is None
    assert TrainConfig.of(method="gsplat").renderer.near_plane == 0.01
    # settings of before there were others bind a resumed run as they did
    assert "near_plane" not in TrainConfig().binding()
    assert TrainConfig.of(method="3dgs").in_world(0.25).binding()["near_plane"] == 0.05


# Pictures of views get file names of their own, inside one folder.


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
    assert [path.as_posix() for path in picture_names(views)] == files


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


# Camera paths and video files.

UP, TARGET = np.array([0.0, 0.0, 1.0]), np.array([0.5, -0.25, 0.0])


def around(degrees: np.ndarray, height: float) -> np.ndarray:
    """Cameras 3 away from the target, at these angles, looking at it. [n, 4, 4]"""
    turn = np.radians(degrees)
    offsets = np.stack([3.0 * np.cos(turn), 3.0 * np.sin(turn), np.full(len(turn), height)], axis=1)
    return look_at(TARGET + offsets, TARGET, UP)


def ring(n: int = 12) -> np.ndarray:
    return around(np.linspace(0.0, 360.0, n, endpoint=False), 1.0)


def seen_from_target(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres of cameras from the target, and their angles in degrees."""
    offsets = camera_centers(path) - TARGET
    return offsets, np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0])) % 360.0


def steps_round(path: np.ndarray) -> np.ndarray:
    """Lengths of the steps from camera to camera, and from the last to the first."""
    centers = camera_centers(path)
    return np.linalg.norm(np.diff(np.vstack([centers, centers[:1]]), axis=0), axis=1)


@pytest.mark.parametrize("name", PATHS)
def test_every_path_has_rigid_cameras_and_as_many_as_asked(name: str) -> None:
    path = camera_path(name, ring(), 17)
    assert path.shape == (17, 4, 4)
    R = path[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (17, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)
    np.testing.assert_array_equal(path[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (17, 1)))
    if name != "interpolate":
        # up stays up along closed paths, which step evenly round to their start
        assert mean_up(path) @ UP > 0.5
        steps = steps_round(camera_path(name, ring(n=24), 40))
        assert steps.max() < 1.3 * steps.min()


def test_the_focus_of_a_ring_is_the_point_its_cameras_look_at_and_else_ahead_of_them() -> None:
    np.testing.assert_allclose(focus_point(ring()), TARGET, atol=1e-9)
    parallel = np.tile(np.eye(4), (3, 1, 1))
    parallel[:, 0, 3] = [-1.0, 0.0, 1.0]
    assert focus_point(parallel)[2] > 0.0
    assert np.all(np.isfinite(orbit(parallel, 5)))
    outwards = ring()[:3]
    outwards[:, :3, :] *= np.array([-1.0, 1.0, -1.0])[:, None]  # half a turn about their own y axes
    ahead = np.einsum("mj,mj->m", focus_point(outwards) - camera_centers(outwards), outwards[:, 2, :3])
    assert np.median(ahead) > 0.0


def test_an_orbit_keeps_distance_height_and_gaze_and_is_a_full_circle_where_cameras_stand_all_round() -> None:
    for n in (3, 4, 12):
        path = orbit(ring(n), 8)
        offsets, angles = seen_from_target(path)
        np.testing.assert_allclose(np.diff(np.sort(angles)), 45.0)
    np.testing.assert_allclose(np.hypot(offsets[:, 0], offsets[:, 1]), 3.0, atol=1e-9)
    np.testing.assert_allclose(offsets[:, 2], 1.0, atol=1e-9)
    gaze = np.einsum("mij,mj->mi", path[:, :3, :3], -offsets)
    np.testing.assert_allclose(gaze[:, :2], 0.0, atol=1e-9)
    assert np.all(gaze[:, 2] > 0.0)


@pytest.mark.parametrize("width", [20.0, 100.0, 190.0])
def test_an_orbit_of_a_capture_from_one_side_stays_on_that_side(width: float) -> None:
    # over the seam of the angle too
    path = orbit(around(np.linspace(-width / 2, width / 2, 9) + 170.0, 0.0), 40)
    _, angles = seen_from_target(path)
    assert angles.min() == pytest.approx(170.0 - width / 2, abs=1e-6)
    assert angles.max() == pytest.approx(170.0 + width / 2, abs=1e-6)
    assert angles[0] == pytest.approx(170.0)
    assert steps_round(path).max() < 3.0 * np.radians(width) / 2 * 2.0 * np.pi / 40


def walk(n: int = 30, turn: float = 0.0) -> np.ndarray:
    """Cameras of a walk along y that looks ahead and, by `turn` degrees, to the sides. [n, 4, 4]"""
    along = np.linspace(0.0, 10.0, n)
    centers = np.stack([0.1 * np.sin(3.0 * along), along, 0.02 * np.cos(5.0 * along)], axis=1)
    side = np.radians(turn) * np.sin(along)
    ahead = centers + np.stack([np.sin(side), np.cos(side), np.zeros(n)], axis=1)
    return np.concatenate([look_at(a[None], b, UP) for a, b in zip(centers, ahead, strict=True)])


@pytest.mark.parametrize("turn", [0.0, 15.0, 60.0, 180.0])
def test_an_orbit_of_a_walk_or_a_room_follows_the_cameras(turn: float) -> None:
    cameras = walk(turn=turn)
    assert not look_at_one_point(cameras)
    assert neighbour_degrees(cameras) is None
    path = orbit(cameras, 60)
    np.testing.assert_allclose(path[[0, -1]], cameras[[0, -1]], atol=1e-9)
    apart = np.linalg.norm(camera_centers(path)[:, None] - camera_centers(cameras), axis=2)
    assert apart.min(axis=1).max() < 0.5  # cameras stand 0.34 apart
    nearest = apart.argmin(axis=1)
    gaze = np.einsum("mj,mj->m", path[:, 2, :3], cameras[nearest, 2, :3])
    assert gaze.min() > np.cos(np.radians(40.0))


def test_an_orbit_of_a_walk_towards_what_it_looks_at_follows_the_cameras() -> None:
    along = np.linspace(0.0, 6.0, 30)
    centers = np.stack([0.35 * np.sin(3.0 * along), along, np.zeros(30)], axis=1)
    towards = np.stack([-0.6 * centers[:, 0], along + 4.0, np.full(30, -0.4)], axis=1)
    cameras = np.concatenate([look_at(a[None], b, UP) for a, b in zip(centers, towards, strict=True)])
    assert not look_at_one_point(cameras)
    np.testing.assert_allclose(orbit(cameras, 60)[[0, -1]], cameras[[0, -1]], atol=1e-9)
    # a subject from near and from far is still gone round
    near_and_far = ring(n=24)
    near_and_far[::2, :3, 3] *= 1.7
    assert look_at_one_point(near_and_far)


@pytest.mark.parametrize("seed", range(3))
def test_cameras_that_shake_still_look_at_one_point(seed: int) -> None:
    shaken = ring(n=24)
    turns = Rotation.random(24, rng=np.random.default_rng(seed)).as_rotvec()
    for viewmat, turn in zip(shaken, turns, strict=True):
        viewmat[:3] = Rotation.from_rotvec(np.radians(15.0) * turn / np.linalg.norm(turn)).as_matrix() @ viewmat[:3]
    assert look_at_one_point(shaken)
    assert neighbour_degrees(shaken) is not None


def test_a_single_camera_sways_and_does_not_fly_round() -> None:
    path = orbit(ring(1), 16)
    assert (path[:, 2, :3] @ ring(1)[0, 2, :3]).min() > np.cos(np.radians(6.0))


@given(st.integers(2, 6), st.integers(1, 4))
def test_interpolation_passes_through_every_given_camera(n: int, between: int) -> None:
    viewmats = ring(n=12)[:n]
    path = interpolate(viewmats, (n - 1) * between + 1)
    np.testing.assert_allclose(path[::between], viewmats, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "cameras", "frames", "told"),
    [
        ("spiral", 12, 5, "orbit, ellipse, interpolate"),
        ("orbit", 12, 0, "n_frames is 0"),
        ("interpolate", 1, 5, "at le"),
    ],
)
def test_bad_path_requests_name_the_field_and_the_choices(name: str, cameras: int, frames: int, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        camera_path(name, ring()[:cameras], frames)


def test_a_video_holds_the_frames_that_were_added(tmp_path: Path) -> None:
    path = tmp_path / "clip.webm"
    with VideoFile(path, fps=10) as film_of_grays:
        for shade in (0, 120, 240):
            film_of_grays.add(np.full((49, 64, 3), shade, np.uint8))  # an odd height loses its last row
    reader = cv2.VideoCapture(str(path))
    for shade in (0, 120, 240):
        frame = reader.read()[1]
        assert frame.shape == (48, 64, 3)
        assert abs(int(frame.mean()) - shade) < 8
    assert os.listdir(tmp_path) == ["clip.webm"]


def film(path: Path, *sizes: tuple[int, int], fps: float = 30.0) -> None:
    with VideoFile(path, fps) as clip:
        for i, (width, height) in enumerate(sizes):
            clip.add(np.random.default_rng(i).integers(0, 256, (height, width, 3), dtype=np.uint8))


# OpenCV crashes at a name that is not UTF-8, and takes what precedes a colon for a protocol
@pytest.mark.parametrize("name", ["clip.webm", "clip.AVI", os.fsdecode(b"clip\xff.webm")])
@pytest.mark.parametrize("fps", [0.5, 29.97, 600.0])
def test_every_kind_of_video_plays_to_its_last_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, fps: float
) -> None:
    monkeypatch.chdir(tmp_path)
    film(Path("12:30", name), *[(32, 16)] * 5, fps=fps)
    assert frames_in(Path("12:30", name)) == 5
    assert take_frames(Path("12:30", name), "taken").of == 5
    assert os.listdir("12:30") == [name]


@pytest.mark.parametrize(
    ("sizes", "told"),
    [
        ([(16, 16), (8, 16)], "frame 1 is 8 x 16 px, the first was 16 x 16 px; a video has one size: use views of one"),
        ([(1, 16)], "frames are 1 x 16 px; a video needs 2 x 2 or more"),
        ([], "no frame was added; a video needs one or more"),
    ],
    ids=["two sizes", "no size", "no frame"],
)
def test_a_video_that_fails_leaves_the_old_file(tmp_path: Path, sizes: list[tuple[int, int]], told: str) -> None:
    path = tmp_path / "clip.webm"
    path.write_bytes(b"old")
    assert_one_line(lambda: film(path, *sizes), f"{path}: {told}")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["clip.webm"]


@pytest.mark.parametrize("fps", [0.0, -1.0, 0.4, 601.0, float("nan"), float("inf")])
def test_a_rate_that_no_video_can_have_is_refused_at_once(tmp_path: Path, fps: float) -> None:
    assert_one_line(lambda: VideoFile(tmp_path / "clip.webm", fps), f"fps is {fps}", "from 0.5 to 600, such as 30")


def test_what_cannot_become_a_video_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "clip.webm").mkdir()
    assert_one_line(lambda: VideoFile(tmp_path / "clip.webm"), "clip.webm: a folder of this name is in the way")
    assert_one_line(lambda: VideoFile(tmp_path / "clip.gif"), ".mp4")
    # an MP4 would hold what players do not expect
    monkeypatch.setattr(paths, "has_h264", lambda: False)
    words = ("cannot write H.264", "name it clip.webm", "ffmpeg -i clip.webm clip.mp4")
    assert_one_line(lambda: VideoFile(tmp_path / "clip.mp4"), "clip.mp4", *words)
    assert os.listdir(tmp_path) == ["clip.webm"]
    if Path("/proc/self").is_dir():
        # nobody can write there
        told = "/proc/self/clip.webm: could not be written: "
        assert_one_line(lambda: film(Path("/proc/self/clip.webm"), (16, 16)), told, "choose another path")


_LIMITED = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from pop_fast.view.paths import VideoFile
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
with VideoFile(Path(sys.argv[1])) as video:
    for i in range(12):
        video.add(np.random.default_rng(i).integers(0, 256, (64, 64, 3), dtype=np.uint8))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX resource limits")
@pytest.mark.parametrize(("name", "room"), [("clip.webm", 0), ("clip.webm", 4096), ("clip.avi", 4096)])
def test_a_video_without_room_on_the_disk_leaves_the_old_file(tmp_path: Path, name: str, room: int) -> None:
    path = tmp_path / name
    path.write_bytes(b"old")
    done = in_a_child(_LIMITED, path, room)
    assert done.status == 1
    last = done.err.strip().splitlines()[-1]
    assert last.startswith(f"pop_fast.errors.PopError: {path}: ")
    assert "of 12 frames could be read back after writing; the disk may be full: free some space" in last
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == [name]


def test_a_video_holds_what_its_ending_promises(tmp_path: Path) -> None:
    names = {"clip.webm": ("VP90", "vp09"), "clip.avi": ("MJPG",), "clip.mp4": ("avc1", "h264")}
    for name, codecs in list(names.items())[: 3 if has_h264() else 2]:
        film(tmp_path / name, (64, 64), (64, 64))
        code = int(cv2.VideoCapture(str(tmp_path / name)).get(cv2.CAP_PROP_FOURCC))
        assert code.to_bytes(4, "little").decode() in codecs
