"""`pop export`: the same splat, in files that other programs open."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pop_fast.data import load_capture
from pop_fast.data.colmap import read_model
from pop_fast.io.ply import load_ply, save_ply
from tests.app.conftest import Pop
from tests.app.damage import contents, says


def exported(pop: Pop, *words: object) -> str:
    outcome = pop("export", *words)
    assert outcome.status == 0, outcome.err
    return outcome.out


def psnr(pop: Pop, tmp_path: Path, *words: object) -> float:
    assert pop("eval", *words, "--json", tmp_path / "e.json").status == 0
    return float(json.loads((tmp_path / "e.json").read_text())["psnr"])


def test_a_ply_in_the_capture_s_own_frame_shows_the_same_pictures(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path
) -> None:
    exported(pop, shared_result, "--out", tmp_path / "own.ply")
    trained = load_ply(shared_result / "ply" / "point_cloud_29.ply")
    moved = load_ply(tmp_path / "own.ply")
    assert not torch.allclose(trained["means"], moved["means"], atol=0.1)
    own = psnr(pop, tmp_path, tmp_path / "own.ply", "--capture", shared_capture, "--own-frame")
    assert own == pytest.approx(psnr(pop, tmp_path, shared_result / "ply" / "point_cloud_29.ply"), abs=0.01)


def test_the_training_frame_keeps_every_bit(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    exported(pop, shared_result, "--out", tmp_path / "t.ply", "--frame", "training")
    assert (tmp_path / "t.ply").read_bytes() == (shared_result / "ply" / "point_cloud_29.ply").read_bytes()


def test_the_frame_is_found_from_the_capture_where_no_record_was_left(pop: Pop, result: Path, tmp_path: Path) -> None:
    exported(pop, result, "--out", tmp_path / "a.ply")
    (result / "capture.json").unlink()
    exported(pop, result, "--out", tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_what_no_renderer_shows_is_left_out_and_counted(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path
) -> None:
    params = load_ply(shared_result / "ply" / "point_cloud_29.ply")
    params["opacities"][:7] = torch.logit(torch.tensor(0.0039))  # just under 1/255 = 0.00392...
    save_ply(tmp_path / "with.ply", params)
    n = len(params["means"])
    said = exported(pop, tmp_path / "with.ply", "--out", tmp_path / "without.ply", "--drop-invisible")
    assert f"{n - 7:,} of {n:,} Gaussians kept, 7 left out" in said
    assert len(load_ply(tmp_path / "without.ply")["means"]) == n - 7
    words = ["--capture", shared_capture]
    assert psnr(pop, tmp_path, tmp_path / "without.ply", *words) == psnr(pop, tmp_path, tmp_path / "with.ply", *words)


def test_a_splat_file_has_32_bytes_a_gaussian(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    exported(pop, shared_result, "--out", tmp_path / "x.splat")
    n = len(load_ply(shared_result / "ply" / "point_cloud_29.ply")["means"])
    assert (tmp_path / "x.splat").stat().st_size == 32 * n


def test_inria_s_layout_has_what_its_scripts_read(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path
) -> None:
    exported(pop, shared_result, "--out", tmp_path / "inria", "--layout", "inria")
    own = load_ply(tmp_path / "inria" / "point_cloud" / "iteration_30" / "point_cloud.ply")
    exported(pop, shared_result, "--out", tmp_path / "own.ply")
    for name, value in load_ply(tmp_path / "own.ply").items():
        torch.testing.assert_close(own[name], value)
    renders = sorted((tmp_path / "inria" / "test" / "ours_30" / "renders").iterdir())
    photos = sorted((tmp_path / "inria" / "test" / "ours_30" / "gt").iterdir())
    assert [p.name for p in renders] == [p.name for p in photos] == ["00000.png"]
    photo = cv2.imread(str(shared_capture / "images" / "view_000.png"))
    np.testing.assert_array_equal(cv2.imread(str(photos[0])), photo)
    call = ast.parse((tmp_path / "inria" / "cfg_args").read_text(), mode="eval").body
    assert isinstance(call, ast.Call)
    settings = {word.arg: ast.literal_eval(word.value) for word in call.keywords}
    assert settings["source_path"] == str(shared_capture)
    assert settings["white_background"] is False


def test_inria_s_cameras_are_those_of_the_colmap_model(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path
) -> None:
    exported(pop, shared_result, "--out", tmp_path / "inria", "--layout", "inria")
    cameras = json.loads((tmp_path / "inria" / "cameras.json").read_text())
    shots, _ = read_model(shared_capture / "sparse" / "0")
    assert len(cameras) == len(shots) == len(load_capture(shared_capture).views)
    for camera, shot in zip(cameras, shots, strict=True):
        assert camera["img_name"] == Path(shot.name).stem
        np.testing.assert_allclose(camera["rotation"], shot.viewmat[:3, :3].T, atol=1e-9)
        np.testing.assert_allclose(camera["position"], -shot.viewmat[:3, :3].T @ shot.viewmat[:3, 3], atol=1e-9)
        assert camera["fx"] == pytest.approx(shot.camera.focal_length_x)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--out", "x.obj"], "must end in one of .compressed.ply, .glb, .ply, .sog, .splat, .spz"),
        (["--out", "there.ply"], "exists; pass --overwrite"),
        (["--out", "full", "--layout", "inria"], "full: holds what this command did not write (notes.txt)"),
        (["--out", "full", "--layout", "inria", "--overwrite"], "did not write (notes.txt)"),
        (["--out", "full.ply", "--overwrite"], "full.ply: a folder of this name is in the way; choose another --out"),
    ],
    ids=["unknown ending", "file in the way", "folder in the way", "folder of somebody else", "folder for a file"],
)
def test_what_cannot_be_exported_is_said_and_nothing_is_written(
    pop: Pop, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], part: str
) -> None:
    (tmp_path / "there.ply").write_text("mine")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    (tmp_path / "full.ply").mkdir()
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    outcome = pop("export", shared_result, *words)
    assert outcome.status == 2
    assert part in outcome.err
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / "there.ply").read_text() == "mine"


def test_an_earlier_export_in_inria_s_layout_is_replaced_only_when_asked(
    pop: Pop, shared_result: Path, tmp_path: Path
) -> None:
    words = ["export", shared_result, "--layout", "inria", "--out", tmp_path / "inria"]
    assert pop(*words).status == 0
    before = contents(tmp_path)
    (tmp_path / "inria" / "test" / "ours_30" / "gt" / "00001.png").write_bytes(b"of a longer test set")
    says(pop(*words), "inria: the folder exists and is not empty; choose another or pass --overwrite")
    assert pop(*words, "--overwrite").status == 0
    assert contents(tmp_path) == before


@pytest.mark.parametrize("damage", ["another trainer's", "measured", "no cfg_args"])
def test_an_inria_folder_that_is_not_just_our_export_is_never_replaced(
    pop: Pop, shared_result: Path, tmp_path: Path, damage: str
) -> None:
    words = ["export", shared_result, "--layout", "inria", "--out", tmp_path / "inria"]
    assert pop(*words).status == 0
    settings = tmp_path / "inria" / "cfg_args"
    if damage == "another trainer's":
        settings.write_text(settings.read_text().replace(", exported_by='pop export'", ""))
    elif damage == "measured":
        (tmp_path / "inria" / "results.json").write_text("{}")
    else:
        settings.unlink()
    before = contents(tmp_path)
    said = {"measured": "(results.json)", "no cfg_args": "(cameras.json"}.get(damage, "(cameras.json, cfg_args")
    says(pop(*words, "--overwrite"), "inria: holds what this command did not write", said, "move these files away")
    assert contents(tmp_path) == before


def test_an_export_takes_the_place_of_nothing_that_it_reads(
    pop: Pop, capture: Path, result: Path, tmp_path: Path
) -> None:
    words = ["export", result, "--capture", capture, "--overwrite", "--layout", "inria", "--out"]
    assert pop(*words, tmp_path / "inria").status == 0
    before = contents(tmp_path)
    says(pop(*words, capture), f"{capture}: is read by this command, so it is not replaced")
    says(pop(*words, result), f"{result}: is read by this command, so it is not replaced")
    lone = tmp_path / "inria" / "point_cloud" / "iteration_30" / "point_cloud.ply"
    again = ["export", lone, "--capture", capture, "--own-frame", "--overwrite"]
    says(
        pop(*again, "--layout", "inria", "--out", tmp_path / "inria"), "inria: holds", "point_cloud.ply, which is read"
    )
    says(pop(*again, "--out", lone), "point_cloud.ply: is the splat that is read; choose another --out")
    assert contents(tmp_path) == before
