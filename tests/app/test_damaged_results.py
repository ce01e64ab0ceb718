"""Files of a result that no run has written so: checkpoints, PLY files, settings, statistics, records and arrays.

Each is refused in one line that names the file, the entry and what to do, and never with a traceback.

Nor is a run measured or drawn on a capture whose cameras have changed since.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch

from pop_fast.blocks import jobs
from pop_fast.cli import main
from pop_fast.data import load_capture
from pop_fast.io.ply import load_ply
from pop_fast.train.load_result import CaptureOptions, CaptureRecord, load_splat, open_capture, read_record
from tests.app.conftest import TRAIN, Outcome, Pop, done
from tests.app.damage import says
from tests.app.test_blocks import in_this_process

STATISTICS, RECORDS, SETTINGS = "stats/val_step0029.json", "metrics.jsonl", "cfg.json"
NOT_JSON = [b"", b"{", b"\xff\xfe", b"[" * 5000, b"1" * 5000]
NO_OBJECT = [b"[]", b"3", b"null", b'"text"']
# every value under one key, and one value under every other
NO_NUMBER = [*(("psnr", value) for value in ("text", [], {}, True, 10**400, 1e300))]
NO_NUMBER += [(key, "text") for key in ("num_GS", "step", "seconds", "n_blended", "opacity_above_0.9")]
NO_TEXT = [("machine", 3), ("backend", []), ("versions", "2"), ("method", {})]
Damage = Callable[[bytes], bytes]


def instead(data: bytes) -> Damage:
    return lambda whole: data


def with_fields(change: Callable[[dict[str, Any]], object]) -> Damage:
    def damage(whole: bytes) -> bytes:
        content = json.loads(whole)
        change(content)
        return json.dumps(content).encode()

    return damage


def under(key: str, value: Any, *inside: str) -> Damage:
    """Put a value under a key of the file, or of an object within it."""
    return with_fields(lambda content: (content[inside[0]] if inside else content).update({key: value}))


# a file of a result, what is done to it, what reads it, and what is said; {} is its path and {n} its last line
DAMAGED: list[tuple[str, Damage, str, tuple[str, ...]]] = [
    *((STATISTICS, instead(data), "report compare", ("{}", "is not JSON", "pop eval")) for data in NOT_JSON),
    *((STATISTICS, instead(data), "report compare", ("{}", "must be an object", "pop eval")) for data in NO_OBJECT),
    *((STATISTICS, under(*odd), "report compare", (f"{{}}: {odd[0]} is ", "it must be a number")) for odd in NO_NUMBER),
    *((STATISTICS, under(*odd), "compare", (f"{{}}: {odd[0]} is ",)) for odd in NO_TEXT),
    *(
        (
            RECORDS,
            lambda whole, data=data: whole + data + b"\n",
            "report",
            ("{}: line {n}", "remove the file, or train again"),
        )
        for data in [*NOT_JSON[1:], *NO_OBJECT, b"{}", b'{"step": "x"}', b'{"step": true}']
    ),
    *(
        (SETTINGS, under(key, 10**400, "resolved"), "report", ("{}", f"config.{key} is a number beyond 2^53"))
        for key in ("init_scale", "max_steps", "l2_stop_iter")
    ),
    (SETTINGS, under("colour", 1, "resolved"), "eval", ("config.colour", "not a setting")),
    *(
        (SETTINGS, instead(data), "eval compare report", ("{}", "repair the file"))
        for data in (b"", b"{oops", b'{"max_steps": 0}', "{}".encode("utf-16"))
    ),
    (SETTINGS, instead(b"[" * 5000), "report", ("{}",)),
    ("capture.json", instead(b"[" * 5000), "eval", ("{}",)),
    *(
        ("capture.json", under("world_transform", odd), "eval", ("{}", "is not what 'pop train' writes", "remove it"))
        for odd in ("text", None, [[1.0, 2.0], [3.0]], [[0.0] * 4] * 4, [[1e400] * 4] * 4)
    ),
]


@pytest.mark.parametrize(("file", "damage", "commands", "parts"), DAMAGED, ids=range(len(DAMAGED)))
def test_a_file_of_a_result_that_is_damaged_is_named(pop, result, file, damage, commands, parts):
    path = result / file
    path.write_bytes(damage(path.read_bytes()))
    last = str(len(path.read_bytes().splitlines()))
    for command in commands.split():
        says(pop(command, result), *(part.replace("{}", str(path)).replace("{n}", last) for part in parts))


@pytest.mark.parametrize("kind", ["train", "val"])
def test_statistics_that_are_damaged_are_measured_again_as_the_message_says(pop: Pop, result: Path, kind: str) -> None:
    path = result / "stats" / f"{kind}_step0029.json"
    path.write_text("{")
    says(pop("report", result), f"{path}: is not JSON", "remove the file; 'pop eval' measures a result again")
    path.unlink()
    pop.done("eval", result)
    pop.done("report", result)


def test_a_record_cut_off_is_left_out_and_null_becomes_a_dash(pop: Pop, result: Path) -> None:
    with open(result / RECORDS, "ab") as file:
        file.write(b'{"step": 30, "view": "\xc3')
    pop.done("report", result)
    for path in (result / "stats").iterdir():
        path.write_text(json.dumps(dict.fromkeys(json.loads(path.read_text()))))
    pop.done("report", result)
    assert "–" in pop("compare", result).out


@pytest.mark.parametrize("damage", ["empty", "cut", "short", "no zip", "flipped"])
@pytest.mark.parametrize("stem", ["opacity_step-1", "val_step29_0000"])
def test_arrays_that_are_damaged_are_named(pop: Pop, result: Path, stem: str, damage: str) -> None:
    path = result / "report_data" / f"{stem}.npz"
    data = path.read_bytes()
    # in the array itself, behind the name that stands before it
    place = data.index(b"counts.npy" if "opacity" in stem else b"render.npy") + 60
    flipped = data[:place] + bytes([data[place] ^ 255]) + data[place + 1 :]
    damaged = {"empty": b"", "cut": data[: len(data) // 2], "short": data[:-1], "no zip": b"text", "flipped": flipped}
    path.write_bytes(damaged[damage])
    says(pop("report", result), f"{path}: is damaged", "remove the file, or train again")


@pytest.mark.parametrize(
    ("stem", "name", "value"),
    [
        *(
            ("opacity_step-1", "counts", value)
            for value in (None, np.zeros(3, int), np.zeros((2, 2), int), np.zeros(0, int), np.array("x"))
        ),
        ("val_step29_0000", "render", None),
        ("val_step29_0000", "render", np.zeros(3, np.uint8)),
        ("val_step29_0000", "photo", np.zeros((4, 4, 3))),
        ("val_step29_0000", "psnr", np.zeros(2)),
        ("val_step29_0000", "ssim", np.array("x")),
        ("val_step29_0000", "name", np.array(3)),
        ("val_step29_0000", "dominant_ids", np.zeros((2, 2))),
        ("val_step29_0000", "dominant_ids", np.zeros((2, 2, 2), np.int32)),
    ],
)
def test_an_array_of_another_form_is_named(pop: Pop, result: Path, stem: str, name: str, value: Any) -> None:
    path = result / "report_data" / f"{stem}.npz"
    with np.load(path) as stored:
        arrays = {key: stored[key] for key in stored.files} | {name: value}
    np.savez(path, **{key: array for key, array in arrays.items() if array is not None})
    says(pop("report", result), f"{path}: {name} ", "which no run writes")


def at(index: tuple[int, ...], value: float) -> Callable[[torch.Tensor], torch.Tensor]:
    def change(tensor: torch.Tensor) -> torch.Tensor:
        changed = torch.zeros_like(tensor)
        changed[index] = value
        return changed

    return change


@pytest.mark.parametrize(
    ("name", "change", "parts"),
    [
        ("scales", lambda x: None, ("no splats.scales",)),
        ("means", at((4, 1), float("nan")), ("splats.means[4, 1] is nan",)),
        ("sh0", at((0, 0, 2), float("inf")), ("splats.sh0[0, 0, 2] is inf",)),
        ("quats", lambda x: x[:, :3].clone(), ("splats.quats has shape [461, 3]; it must be [461, 4]",)),
        ("shN", lambda x: x[:, :7].clone(), ("splats.shN has shape", "or 0, 3 or 8")),
        ("opacities", lambda x: x.long(), ("splats.opacities is torch.int64", "floats")),
        ("means", lambda x: torch.zeros(()), ("splats.means has shape []",)),
        ("means", lambda x: [1.0], ("splats.means is list",)),
        ("quats", lambda x: x.index_fill(0, torch.tensor([2, 5]), 0.0), ("splats.quats[2] is zero", "norm > 0")),
        # of halves and doubles what counts is what they are as float32
        ("quats", lambda x: x.double().index_fill(0, torch.tensor([4]), 1e-60), ("splats.quats[4] is zero",)),
    ],
)
def test_every_defect_of_a_checkpoint_is_named_with_its_tensor_before_it_is_exported_or_drawn(
    pop, shared_result, shared_capture, tmp_path, name, change, parts
):
    params: dict[str, Any] = load_ply(shared_result / "ply" / "point_cloud_29.ply")
    params[name] = change(params[name])
    path = tmp_path / "broken.pt"
    torch.save({"step": 29, "splats": {k: v for k, v in params.items() if v is not None}}, path)
    parts = (f"{path}: ", *parts, "copy it again, or use another one")
    says(pop("export", path, "--out", tmp_path / "o.ply"), *parts)
    says(pop("eval", path, "--capture", shared_capture), *parts)
    assert not (tmp_path / "o.ply").exists()


def test_an_unsaved_result_and_an_absent_capture_are_named(pop: Pop, capture: Path, result: Path) -> None:
    gone, path = capture.parent / "gone", result / SETTINGS
    path.write_bytes(under("data", str(gone), "resolved")(path.read_bytes()))
    says(pop("eval", result), str(gone), "which is missing", "--capture DIR")
    pop.done("eval", result, "--capture", capture)
    for path in [*(result / "ckpts").iterdir(), *(result / "ply").iterdir()]:
        path.unlink()
    says(pop("eval", result), "no checkpoint and no PLY", "--resume")


def test_held_out_views_too_small_to_be_measured_are_named(pop: Pop, shared_result: Path) -> None:
    checkpoint = shared_result / "ckpts" / "ckpt_29_rank0.pt"
    says(pop("eval", checkpoint, "--factor", "4"), "view_000.png is 10 x 8 px", "lower --factor")


def test_endings_may_be_written_in_capitals(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    for source in (shared_result / "ply" / "point_cloud_29.ply", shared_result / "ckpts" / "ckpt_29_rank0.pt"):
        loud = tmp_path / f"LOUD{source.suffix.upper()}"
        loud.write_bytes(source.read_bytes())
        pop.done("export", loud, "--out", tmp_path / f"{source.suffix[1:]}.splat")


def test_renders_that_are_nested_beyond_reading_are_somebody_else_s(pop: Pop, shared_result: Path, tmp_path: Path):
    (tmp_path / "renders.json").write_text("[" * 200_000)
    says(pop("render", shared_result, "--out", tmp_path, "--overwrite"), "renders.json")


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
