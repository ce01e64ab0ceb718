"""`pop render`: held-out views and camera paths, as pictures and as video."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from pop_fast.blocks import jobs
from pop_fast.data import Capture, View, load_capture
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
from tests.app.conftest import Pop
from tests.app.damage import contents, says
from tests.app.test_blocks import in_this_process
from tests.app.test_strategies import engine_or_skip, tiny_method
from tests.app.tiny import tiny_capture


def read(path: Path) -> np.ndarray:
    return cv2.imread(str(path))[:, :, ::-1]


def test_held_out_views_are_rendered_to_the_same_bytes_as_in_training(
    pop: Pop, shared_result: Path, tmp_path: Path
) -> None:
    outcome = pop.done("render", shared_result, "--out", tmp_path / "views")
    assert "1 views of toy" in outcome.out
    assert sorted(os.listdir(tmp_path / "views")) == ["renders.json", "view_000.png"]
    kept = np.load(shared_result / "report_data" / "val_step29_0000.npz")
    np.testing.assert_array_equal(read(tmp_path / "views" / "view_000.png"), kept["render"])


@pytest.mark.parametrize("path", ["orbit", "ellipse", "interpolate"])
def test_a_path_gives_as_many_pictures_and_frames_as_asked(
    pop: Pop, shared_result: Path, tmp_path: Path, path: str
) -> None:
    words = ["--path", path, "--frames", "3", "--out", tmp_path / "frames", "--video", tmp_path / "clip.webm"]
    pop.done("render", shared_result, *words)
    pictures = sorted((tmp_path / "frames").glob("*.png"))
    assert [p.name for p in pictures] == [f"{path}_{i:04d}.png" for i in range(3)]
    assert all(read(p).shape == (32, 40, 3) for p in pictures)
    assert len({p.read_bytes() for p in pictures}) == 3
    video = cv2.VideoCapture(str(tmp_path / "clip.webm"))
    assert [video.read()[0] for _ in range(4)] == [True, True, True, False]


def test_a_video_alone_leaves_no_pictures(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    assert pop("render", shared_result, "--video", tmp_path / "clip.webm").status == 0
    assert [p.name for p in tmp_path.iterdir()] == ["clip.webm"]


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ([], "give --out DIR for pictures, --video FILE"),
        (["--video", "clip.gif"], "must end in .webm, .mp4, .avi"),
        (["--video", "clip.webm", "--fps", "0"], "clip.webm: fps is 0.0; it must be a number from 0.5 to 600"),
        (["--video", "clip.webm", "--fps", "nan"], "clip.webm: fps is nan; it must be a number from 0.5 to 600"),
        (["--out", "r", "--video", "r/clip.webm"], "r/clip.webm: lies in --out r, which holds pictures only"),
        (["--out", "r", "--path", "orbit", "--frames", "0"], "frames is 0; give --frames 1 or more"),
        (["--out", "r", "--test-every", "0"], "holds no view out"),
        (["--out", "r", "--path", "orbit", "--test-every", "1"], "needs 1 or more training views and there are 0"),
        (["--out", "."], "the folder that this command runs in; choose another output folder"),
    ],
    ids=[
        "nothing to write",
        "unknown video",
        "no rate",
        "a rate that is no number",
        "the video among the pictures",
        "no frames",
        "no held-out views",
        "no training views",
        "the folder that one is in",
    ],
)
def test_what_cannot_be_rendered_is_said_and_nothing_is_written(
    pop: Pop, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], part: str
) -> None:
    monkeypatch.chdir(tmp_path)
    says(pop("render", shared_result, *words), part)
    assert list(tmp_path.iterdir()) == []


def test_an_earlier_video_is_replaced_only_when_asked(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    (tmp_path / "clip.webm").write_text("mine")
    says(pop("render", shared_result, "--video", tmp_path / "clip.webm"), "clip.webm", "exists; pass --overwrite")
    assert (tmp_path / "clip.webm").read_text() == "mine"
    assert pop("render", shared_result, "--video", tmp_path / "clip.webm", "--overwrite").status == 0
    assert frames_in(tmp_path / "clip.webm") == 1


def test_the_index_of_a_render_names_the_file_of_every_view(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    assert pop("render", shared_result, "--out", tmp_path / "r", "--path", "orbit", "--frames", "2").status == 0
    assert json.loads((tmp_path / "r" / "renders.json").read_text()) == {
        "splat": str(shared_result / "ckpts" / "ckpt_29_rank0.pt"),
        "capture": "toy",
        "path": "orbit",
        "renders": [{"view": f"orbit_{i:04d}", "file": f"orbit_{i:04d}.png"} for i in range(2)],
    }


def test_an_earlier_render_is_replaced_only_when_asked(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    words = ["render", shared_result, "--out", tmp_path / "r"]
    assert pop(*words, "--path", "orbit", "--frames", "2").status == 0
    before = contents(tmp_path)
    says(pop(*words), str(tmp_path / "r"), "exists and is not empty; choose another or pass --overwrite")
    assert contents(tmp_path) == before
    assert pop(*words, "--overwrite").status == 0
    assert sorted(os.listdir(tmp_path / "r")) == ["renders.json", "view_000.png"]


@pytest.mark.parametrize("index", [None, "[]", '{"renders": 3}', "{", '{"renders": [{}]}'])
def test_pictures_without_an_index_of_this_command_are_somebody_else_s(
    pop: Pop, shared_result: Path, tmp_path: Path, index: str | None
) -> None:
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "view_000.png").write_text("mine")
    if index is not None:
        (tmp_path / "r" / "renders.json").write_text(index)
    before = contents(tmp_path)
    says(pop("render", shared_result, "--out", tmp_path / "r", "--overwrite"), "did not write", "view_000.png")
    assert contents(tmp_path) == before


def test_what_is_read_is_never_replaced(pop: Pop, capture: Path, result: Path, tmp_path: Path) -> None:
    before = contents(tmp_path)
    words = ["render", result, "--capture", capture, "--overwrite", "--out"]
    says(pop(*words, result), f"{result}: is read by this command")
    says(pop(*words, capture), f"{capture}: is read by this command")
    says(pop(*words, tmp_path), f"{tmp_path}: holds", "choose another output folder")
    says(pop(*words, capture / "images"), "did not write (view_000.png, view_001.png, view_002.png, ...)")
    assert contents(tmp_path) == before


def test_renders_never_take_the_place_of_photographs_outside_the_capture(
    pop: Pop, shared_result: Path, tmp_path: Path
) -> None:
    scene = transforms_capture(tmp_path / "scene", 8)
    for i in range(8):
        write_photograph(tmp_path / "away" / f"{i}.png", photograph(i))

    def lead_out(listing: dict[str, Any]) -> None:
        for i, frame in enumerate(listing["frames"]):
            frame["file_path"] = f"../away/{i}.png" if i % 2 else str(tmp_path / "away" / f"{i}.png")

    edit_transforms(scene, lead_out)
    before = contents(tmp_path)
    pop.done("render", shared_result, "--capture", scene, "--test-every", "1", "--out", tmp_path / "r")
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


def test_every_view_has_a_file_of_its_own(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    names = ["cam.00", "cam.08", "x.jpg", "x.png"]
    scene = transforms_capture(tmp_path / "scene", 4)
    for i, name in enumerate(names):
        stored = name if name.startswith("x") else f"{name}.png"
        write_photograph(scene / "images" / stored, photograph(i))
    edit_transforms(
        scene, lambda d: [d["frames"][i].update(file_path=f"images/{name}") for i, name in enumerate(names)]
    )
    outcome = pop("render", shared_result, "--capture", scene, "--test-every", "1", "--out", tmp_path / "r")
    assert "4 views" in outcome.out, outcome.err
    listed = json.loads((tmp_path / "r" / "renders.json").read_text())["renders"]
    assert [entry["view"] for entry in listed] == [f"images/{name}" for name in names]
    assert [entry["file"] for entry in listed] == [f"images/{name}.png" for name in names]
    assert sorted(os.listdir(tmp_path / "r" / "images")) == sorted(f"{name}.png" for name in names)


def test_a_video_of_views_of_two_sizes_is_refused_with_a_way_out(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    lenses = [camera(), camera(params=(36.0, 35.0, 15.5, 20.25), width=30, height=40)] * 2
    for i, lens in enumerate(lenses):
        write_photograph(tmp_path / "scene" / "images" / f"{i}.png", photograph(i, lens.width, lens.height))
    write_model(tmp_path / "scene" / "sparse" / "0", [f"{i}.png" for i in range(4)], ring(4), lenses)
    words = ["render", shared_result, "--capture", tmp_path / "scene", "--test-every", "1"]
    says(
        pop(*words, "--video", tmp_path / "clip.webm"),
        "clip.webm: the views have 2 sizes (1.png is 30 x 40 px, 0.png is 40 x 30 px)",
        "write pictures with --out DIR, or film a path with --path orbit",
    )
    assert os.listdir(tmp_path) == ["scene"]
    assert pop(*words, "--out", tmp_path / "r").status == 0


def test_a_path_through_one_training_view_is_refused_with_a_way_out(
    pop: Pop, shared_result: Path, tmp_path: Path
) -> None:
    scene = transforms_capture(tmp_path / "scene", 2)
    words = ["render", shared_result, "--capture", scene, "--test-every", "2", "--out", tmp_path / "r", "--path"]
    says(
        pop(*words, "interpolate"),
        "scene: --path interpolate needs 2 or more training views and there are 1",
        "hold fewer out with --test-every 0, or take --path orbit",
    )
    assert not (tmp_path / "r").exists()
    assert pop(*words, "orbit", "--frames", "2").status == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda entry: entry["viewmat"][0].__setitem__(0, -1.0), ("viewmat is mirrored", "record it again")),
        (lambda entry: entry.update(fov_y_degrees=10**400), ("needs viewmat and fov_y_degrees", "record it again")),
    ],
    ids=["mirrored", "no float"],
)
def test_a_camera_of_a_recorded_path_that_is_none_is_refused(
    pop: Pop, shared_result: Path, tmp_path: Path, change: Callable[[dict[str, Any]], None], words: tuple[str, ...]
) -> None:
    entries = [{"viewmat": np.eye(4).tolist(), "fov_y_degrees": 50.0} for _ in range(2)]
    change(entries[1])
    content = {"kind": "pop camera path", "frame": "capture", "cameras": entries}
    (tmp_path / "path.json").write_text(json.dumps(content))
    outcome = pop("render", shared_result, "--path", tmp_path / "path.json", "--out", tmp_path / "views")
    says(outcome, f"{tmp_path / 'path.json'}: cameras[1]: ", *words)
    assert not (tmp_path / "views").exists()


# Inria's near plane is a length of the capture's own world: what a run draws, trains, records and hands on.

SHORT = ("--method", "3dgs", "--steps-scaler", "0.001", "--no-progress", "--skip-checks", "--skip-sizes")


def scaled(capture: Capture, scale: float) -> Capture:
    """Say that the capture's own world was scaled by so much to make the one that it is in."""
    return replace(capture, world_transform=np.diag([scale, scale, scale, 1.0]))


CASES = {
    "3dgs": (0.25, True),
    "3dgs in its own world": (1.0, False),
    "speedy-splat": (0.25, True),
    "gsplat": (1.0, True),
}


@pytest.mark.parametrize("backend", ["fast", "compiled"])
@pytest.mark.parametrize("case", CASES)
def test_a_gaussian_at_half_of_inrias_near_plane_is_seen_where_the_world_was_shrunk(
    case: str, backend: str, tmp_path: Path
) -> None:
    engine_or_skip(backend)
    (scale, is_seen), capture = CASES[case], tiny_capture()
    eye, *others = capture.train_views(5)
    config = tiny_method(tmp_path, case.split()[0], backend=backend, test_every=5)
    initial = {key: value.detach().clone() for key, value in TrainingRun(config, capture).params.items()}
    # a tenth of the world's unit in front of one camera; the others are far away
    place = eye.camera_center + 0.1 * eye.viewmat[2, :3]
    initial["means"][0], initial["scales"][0] = torch.tensor(place), -6.0
    run = TrainingRun(config, scaled(capture, scale), initial=initial)
    run.take_steps(1 + len(others))
    assert int(run.state["count"][0]) == is_seen + sum(_shows(view, place) for view in others)


def _shows(view: View, place: np.ndarray) -> bool:
    x, y, z = view.viewmat[:3, :3] @ place + view.viewmat[:3, 3]
    u, v = (view.K @ [x, y, z])[:2] / z
    return bool(z > 1.0 and 0.0 <= u <= view.width and 0.0 <= v <= view.height)


def test_a_run_writes_its_near_plane_down_and_goes_on_with_it(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    scale = load_capture(shared_capture).world_scale
    assert abs(scale - 1.0) > 0.1
    out = tmp_path / "out"
    assert pop("train", shared_capture, "--out", out, *SHORT).status == 0
    near = json.loads((out / "cfg.json").read_text())["resolved"]["near_plane"]
    assert near == pytest.approx(0.2 * scale, rel=1e-12)
    again = pop("train", shared_capture, "--out", out, *SHORT, "--resume")
    assert (again.status, read_config(out).near_plane) == (0, near)
    splat = load_splat(out)
    assert open_capture(splat, CaptureOptions())[1].renderer.near_plane == near
    # in the capture's own world it is Inria's number
    own = open_capture(splat, CaptureOptions(own_frame=True))[1]
    assert own.renderer.near_plane == pytest.approx(0.2, rel=1e-12)


def test_blocks_are_trained_with_the_near_plane_of_the_whole(
    pop: Pop, shared_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def named(*views: str) -> list[str]:
    return [path.as_posix() for path in picture_names(views)]


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
    assert named(*views) == files


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


@pytest.mark.parametrize("name", ["../a.png", "/a.png", "b/../../a.png"])
def test_a_name_that_leads_out_of_its_folder_is_refused(tmp_path: Path, name: str) -> None:
    assert_one_line(lambda: inside(tmp_path, Path(name)), name, "leads out", "give it a name without")
