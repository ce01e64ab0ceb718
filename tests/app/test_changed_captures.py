"""Captures that are no longer as they were when a run was trained on them: no number is measured in a wrong frame."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from pop_fast.blocks import jobs
from pop_fast.cli import main
from pop_fast.data import load_capture
from pop_fast.train.load_result import CaptureOptions, CaptureRecord, load_splat, open_capture, read_record
from tests.app.conftest import TRAIN, Outcome, Pop, done
from tests.app.test_blocks import in_this_process

DIFFERS = ("toy: its cameras are not those that", "was trained with", "give the capture as it was", "or train again")


@pytest.fixture(scope="session")
def other_demo(made_once: Callable[..., Path]) -> Path:
    """The tiny capture with another seed: photographs of the same names and other cameras."""

    def make(folder: Path) -> None:
        words = ("--views", "8", "--width", "40", "--height", "32", "--seed", "1")
        assert main(["demo", str(folder / "toy"), *words]) == 0

    return made_once("other_demo", make) / "toy"


@pytest.fixture
def changed(result: Path, other_demo: Path) -> Path:
    """A result whose capture has been made anew with other cameras since."""
    return of_capture(result, other_demo)


def of_capture(result: Path, capture: Path) -> Path:
    """Let a result be one of the capture in this folder, as if that had been there when it was trained."""
    path = result / "cfg.json"
    settings = json.loads(path.read_text())
    settings["resolved"]["data"] = str(capture)
    path.write_text(json.dumps(settings))
    return result


def with_record(result: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    path = result / "capture.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return result


def recorded(result: Path) -> CaptureRecord:
    found = read_record(result)
    assert found is not None
    return found


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def edited(capture: Path, edit: Callable[[Any], object]) -> Path:
    """Change a capture's COLMAP model."""
    model = pycolmap.Reconstruction(str(capture / "sparse" / "0"))
    edit(model)
    model.write_binary(str(capture / "sparse" / "0"))
    return capture


def assert_refused(outcome: Outcome, *words: str) -> None:
    assert outcome.status == 2, outcome
    assert len(outcome.err.splitlines()) == 1
    assert all(word in outcome.err for word in words), outcome.err


def psnr(outcome: Outcome) -> str:
    return next(line for line in done(outcome).splitlines() if line.startswith("PSNR"))


@pytest.mark.parametrize(
    "words",
    [
        "eval {}",
        "render {} --out {}_views",
        "render {} --path orbit --frames 2 --out {}_orbit",
        "explain {} --view 0 --pixel 20,16",
        "export {} --to html --out {}.html",
        "export {} --out {}.spz --target-mb 0.01 --fine-tune-steps 2",
        "export {} --layout inria --out {}_inria",
        "report {} --check",
        "eval {}/ply/point_cloud_29.ply",
        "compare {} {}/../alone.ply",
    ],
)
def test_what_looks_at_a_capture_refuses_one_with_other_cameras(pop: Pop, changed: Path, words: str) -> None:
    shutil.copy(changed / "ply" / "point_cloud_29.ply", changed.parent / "alone.ply")
    before = contents(changed.parent)
    outcome = pop(*words.replace("{}", str(changed)).split())
    assert_refused(outcome, *DIFFERS, "view_000.png stands elsewhere (8 of 8 cameras differ)")
    assert contents(changed.parent) == before


def test_a_run_of_an_earlier_version_is_refused_by_its_training_frame(pop: Pop, changed: Path) -> None:
    before = contents(with_record(changed, lambda record: record.pop("cameras")))
    assert_refused(pop("eval", changed), "normalizes differently from toy", "the capture that it was trained on")
    assert contents(changed) == before


def test_a_run_of_an_earlier_version_is_measured_as_before(pop: Pop, result: Path) -> None:
    expected = psnr(pop("eval", result))
    assert psnr(pop("eval", with_record(result, lambda record: record.pop("cameras")))) == expected
    (result / "capture.json").unlink()
    assert psnr(pop("eval", result)) == expected


def test_a_capture_may_have_been_moved_and_its_points_be_others(pop: Pop, result: Path, capture: Path) -> None:
    expected = psnr(pop("eval", result))
    assert psnr(pop("eval", result, "--capture", capture)) == expected
    kept = edited(capture, lambda model: [model.delete_point3D(i) for i in sorted(model.point3D_ids())[::2]])
    assert not np.allclose(load_capture(kept).world_transform, np.array(recorded(result).world_transform))
    assert psnr(pop("eval", result, "--capture", kept)) == expected
    done(pop("eval", result, "--capture", capture, "--factor", "2", "--own-frame"))
    # whose cameras are written with six digits
    text = edited(capture, lambda model: [rounded(image) for image in model.images.values()])
    done(pop("eval", result, "--capture", text))


def rounded(image: Any) -> None:
    pose = image.cam_from_world()
    image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose.rotation, np.round(pose.translation, 6)))


def test_photographs_that_are_gone_do_not_move_the_rest(result: Path, capture: Path) -> None:
    for name in ("view_001.png", "view_005.png"):
        (capture / "images" / name).unlink()
    options = CaptureOptions(capture=capture, missing="skip")
    found, whole = open_capture(load_splat(result), options)[0], open_capture(load_splat(result), CaptureOptions())[0]
    own = {view.name: view.viewmat for view in whole.views}
    assert len(found.views) == 6
    for view in found.views:
        np.testing.assert_array_equal(view.viewmat, own[view.name])


def test_statistics_of_other_held_out_views_are_not_those_of_the_run(pop: Pop, result: Path, capture: Path) -> None:
    (capture / "images" / "view_000.png").unlink()
    of_capture(with_record(result, lambda record: record.update(missing="skip")), capture)
    before = contents(result)
    outcome = pop("eval", result, "--per-view")
    assert "view_001.png: " in done(outcome)
    assert "other views are held out; stats and report stay as they are" in outcome.err
    assert contents(result) == before


def test_photographs_that_were_added_do_not_move_the_rest(pop: Pop, result: Path, capture: Path, tmp_path: Path):
    full = Path(shutil.copytree(capture, tmp_path / "full"))
    (capture / "images" / "view_003.png").unlink()
    out = tmp_path / "out"
    done(pop("train", capture, "--missing", "skip", "--out", out, *TRAIN))
    assert list(recorded(out).cameras) == [f"view_00{i}.png" for i in (0, 1, 2, 4, 5, 6, 7)]
    found = open_capture(load_splat(out), CaptureOptions(capture=full))[0]
    assert len(found.views) == 8
    np.testing.assert_array_equal(found.world_transform, np.array(recorded(out).world_transform))


@pytest.mark.parametrize("what", ["stands elsewhere", "looks elsewhere", "has another lens"])
def test_one_camera_that_differs_is_named(pop: Pop, result: Path, capture: Path, what: str) -> None:
    def edit(model: Any) -> None:
        image = next(image for image in model.images.values() if image.name == "view_004.png")
        pose = image.cam_from_world()
        turn, moved = pose.rotation, np.array(pose.translation)
        if what == "stands elsewhere":
            moved += [0.05, 0.0, 0.0]
        elif what == "looks elsewhere":
            more = pycolmap.Rotation3d([0.0, 0.01, 0.0])
            turn, moved = more * turn, more * moved
        else:
            image.camera.focal_length_x *= 1.2
        image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(turn, moved))

    outcome = pop("eval", result, "--capture", edited(capture, edit))
    one = what != "has another lens"
    assert_refused(outcome, *DIFFERS, "view_004.png " + what if one else what, "1 of 8" if one else "cameras differ")


def test_a_capture_of_other_photographs_is_refused(pop: Pop, result: Path, other_demo: Path, tmp_path: Path) -> None:
    renamed = Path(shutil.copytree(other_demo, tmp_path / "renamed"))
    for path in list((renamed / "images").iterdir()):
        path.rename(path.with_name(f"other_{path.name}"))
    edited(renamed, lambda model: [setattr(image, "name", f"other_{image.name}") for image in model.images.values()])
    assert_refused(pop("eval", result, "--capture", renamed), "normalizes differently from renamed")


def test_blocks_are_merged_on_the_capture_that_they_were_divided_from(
    pop: Pop, capture: Path, other_demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "_run", in_this_process)
    monkeypatch.setattr(jobs, "has_snakemake", lambda: False)
    out = tmp_path / "out"
    done(pop("train", capture, "--out", out, *TRAIN, "--blocks", "2x1", "--blocks-rounds", "0", "--threads", "1"))
    expected = psnr(pop("eval", out))
    done(pop("eval", out / "blocks" / "0_0" / "result"))
    done(pop("blocks", "merge", out))
    assert psnr(pop("eval", out)) == expected
    shutil.rmtree(capture)
    shutil.copytree(other_demo, capture)
    refused = (*DIFFERS[:2], "put the capture back as it was, or train again")
    before = contents(out)
    assert_refused(pop("blocks", "merge", out), *refused)
    assert_refused(pop("eval", out), *DIFFERS)
    assert contents(out) == before


@pytest.mark.parametrize(
    "odd",
    [
        [],
        "text",
        {"a.png": None},
        {"a.png": {}},
        {"a.png": {"size": [40, 0], "lens": [1.0] * 4, "viewmat": np.eye(4).tolist()}},
        {"a.png": {"size": [40, 32], "lens": [1.0] * 3, "viewmat": np.eye(4).tolist()}},
        {"a.png": {"size": [40, 32], "lens": [1.0] * 4, "viewmat": [["x"] * 4] * 4}},
        {"a.png": {"size": [40, 32], "lens": [1.0] * 4, "viewmat": [[1e400] * 4] * 4}},
        {"a.png": {"size": [40, 10**400], "lens": [1.0] * 4, "viewmat": np.eye(4).tolist()}},
        {"a.png": {"size": [40, 32], "lens": [1.0] * 4, "viewmat": [[1.0], [2.0, 3.0]]}},
    ],
)
def test_damaged_records_of_cameras_are_named(pop: Pop, result: Path, odd: Any) -> None:
    path = with_record(result, lambda record: record.update(cameras=odd)) / "capture.json"
    assert_refused(pop("eval", result), f"{path}: is not what 'pop train' writes", "cameras", "remove it")
