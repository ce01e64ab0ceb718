"""`pop render`: held-out views and camera paths, as pictures and as video."""

from __future__ import annotations

import json
import os
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

from pop_fast.blocks import jobs
from pop_fast.data import View, load_capture
from pop_fast.errors import PopError
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.load_result import CaptureOptions, load_splat, open_capture
from pop_fast.train.results import read_config
from pop_fast.view.frames import inside, picture_names, write_pictures
from pop_fast.view.paths import frames_in
from tests.app.captures import (
    assert_one_line,
    camera,
    edit_transforms,
    photograph,
    ring,
    transforms_capture,
    write_model,
    write_photograph,
)
from tests.app.conftest import Outcome, Pop
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
    assert "1 views of toy" in rendered("--out", tmp_path / "views").out
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
        ("--video clip.webm --fps 0", "clip.webm: fps is 0.0; it must be a number from 0.5 to 600"),
        ("--video clip.webm --fps nan", "clip.webm: fps is nan; it must be a number from 0.5 to 600"),
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
    assert rendered("--capture", scene, "--test-every", "1", "--out", tmp_path / "r").status == 0
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
    outcome = rendered("--capture", scene, "--test-every", "1", "--out", tmp_path / "r")
    assert "4 views" in outcome.out, outcome.err
    listed = json.loads((tmp_path / "r" / "renders.json").read_text())["renders"]
    assert listed == [{"view": f"images/{name}", "file": f"images/{name}.png"} for name in names]
    assert sorted(os.listdir(tmp_path / "r" / "images")) == sorted(f"{name}.png" for name in names)


def test_what_a_capture_does_not_allow_is_refused_with_a_way_out(rendered: Render, tmp_path: Path) -> None:
    # a video of views of two sizes
    lenses = [camera(), camera(params=(36.0, 35.0, 15.5, 20.25), width=30, height=40)] * 2
    for i, lens in enumerate(lenses):
        write_photograph(tmp_path / "scene" / "images" / f"{i}.png", photograph(i, lens.width, lens.height))
    write_model(tmp_path / "scene" / "sparse" / "0", [f"{i}.png" for i in range(4)], ring(4), lenses)
    words = ["--capture", tmp_path / "scene", "--test-every", "1"]
    says(
        rendered(*words, "--video", tmp_path / "clip.webm"),
        "clip.webm: the views have 2 sizes (1.png is 30 x 40 px, 0.png is 40 x 30 px)",
        "write pictures with --out DIR, or film a path with --path orbit",
    )
    assert os.listdir(tmp_path) == ["scene"]
    assert rendered(*words, "--out", tmp_path / "r").status == 0
    # a path through one training view
    scene = transforms_capture(tmp_path / "two", 2)
    words = ["--capture", scene, "--test-every", "2", "--out", tmp_path / "one", "--path"]
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
