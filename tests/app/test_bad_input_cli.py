"""Bad captures and settings on the command line: status 2, one line that names file, field and fix.

A few of each kind: `test_bad_input_data` and `test_config` have what is said of all others."""

from __future__ import annotations

import errno
import json
import os
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pop_fast.io.ply import load_ply, save_ply
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import Damage, contents, patch_bytes, photo, says, truncate


def corrupt_jpeg(folder: Path) -> None:
    image = cv2.imread(str(photo(folder)))
    photo(folder).unlink()
    path = photo(folder).with_suffix(".jpg")
    cv2.imwrite(str(path), image)
    truncate(path)


def other_shape(folder: Path) -> None:
    cv2.imwrite(str(photo(folder, 1)), np.zeros((40, 32, 3), np.uint8))


def camera_model(folder: Path) -> None:
    patch_bytes(folder / "sparse/0/cameras.bin", 12, struct.pack("<i", 999))


def only_one_view(folder: Path) -> None:
    for path in sorted((folder / "images").iterdir())[1:]:
        path.unlink()


CAPTURES: list[tuple[str, Damage, tuple[str, ...]]] = [
    ("an image is listed but absent", lambda f: photo(f, 3).unlink(), ("view_003.png", "absent", "--missing skip")),
    ("a JPEG is truncated", corrupt_jpeg, ("view_000.jpg", "truncated", "copy it again")),
    ("a photograph has another shape", other_shape, ("view_001.png", "32x40", "40x32", "use the photographs")),
    ("the cameras are truncated", lambda f: truncate(f / "sparse/0/cameras.bin"), ("cameras.bin", "truncated")),
    ("the camera model is unknown", camera_model, ("cameras.bin", "unknown camera model 999")),
]


@pytest.mark.parametrize(("damage", "parts"), [case[1:] for case in CAPTURES], ids=[case[0] for case in CAPTURES])
def test_a_damaged_capture_is_named_before_anything_is_written(
    pop: Pop, capture: Path, tmp_path: Path, damage: Damage, parts: tuple[str, ...]
) -> None:
    damage(capture)
    says(pop("train", capture, "--out", tmp_path / "r", *TRAIN), *parts)
    assert not (tmp_path / "r").exists()


def transforms(folder: Path, **frame: object) -> Path:
    """Write a small transforms.json beside the photographs, its second frame and its fields changed as given."""
    pose = np.eye(4)
    frames = [
        {"file_path": f"images/view_{i:03d}.png", "transform_matrix": (pose + 0.1 * i * np.eye(4, k=3)).tolist()}
        for i in range(4)
    ]
    listing: dict[str, object] = {"fl_x": 30.0, "fl_y": 30.0, "cx": 20.0, "cy": 16.0, "w": 40, "h": 32}
    for key, value in frame.items():
        (frames[1] if key in ("transform_matrix", "file_path") else listing)[key] = value
    (folder / "transforms.json").write_text(json.dumps({**listing, "frames": frames}))
    return folder


STRETCHED = np.diag([2.0, 1.0, 1.0, 1.0]).tolist()


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"transform_matrix": STRETCHED}, ("frames[1]", "transform_matrix")),
        ({"file_path": "images/gone.png"}, ("gone.png", "absent", "--missing skip")),
    ],
    ids=["non-rigid", "absent image"],
)
def test_a_bad_transforms_json_is_named_with_its_frame_and_field(
    pop: Pop, capture: Path, tmp_path: Path, change: dict[str, object], parts: tuple[str, ...]
) -> None:
    folder = transforms(capture, **change)
    outcome = pop("train", folder, "--source", "transforms", "--out", tmp_path / "r", *TRAIN)
    says(outcome, "transforms.json", *parts)
    assert not (tmp_path / "r").exists()


def test_a_folder_that_is_not_there_is_named(pop: Pop, tmp_path: Path) -> None:
    says(pop("train", tmp_path / "gone", "--out", tmp_path / "r"), "gone", "no such folder", "give the folder")
    assert not (tmp_path / "r").exists()


def test_a_folder_without_photographs_is_named(pop: Pop, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    says(pop("train", tmp_path / "empty", "--out", tmp_path / "r"), "empty", "no photographs", "give the folder")


def test_absent_images_can_be_skipped_but_one_view_is_too_few(pop: Pop, capture: Path, tmp_path: Path) -> None:
    only_one_view(capture)
    outcome = pop("train", capture, "--out", tmp_path / "r", "--missing", "skip", *TRAIN)
    says(outcome, "a scene")
    assert not (tmp_path / "r").exists()


def test_one_photograph_is_too_few_for_sfm(pop: Pop, capture: Path, tmp_path: Path) -> None:
    only_one_view(capture)
    says(pop("sfm", capture / "images", "--out", tmp_path / "r"), "1 photograph", "two or more")
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["--sh-degree", "4"], ("sh_degree is 4",)),
        (["--factor", "99"], ("factor 99", "lower it")),
        (["--test-every", "1"], ("no view to train on", "test_every")),
        (["--lpips-vgg", "gone.pth"], ("gone.pth", "LPIPS")),
        (["--resume", "--overwrite"], ("--resume and --overwrite",)),
        (["--images", "gone"], ("gone",)),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_setting_out_of_range_is_named(
    pop: Pop, shared_capture: Path, tmp_path: Path, words: list[str], parts: tuple[str, ...]
) -> None:
    says(pop("train", shared_capture, "--out", tmp_path / "r", "--quiet", *words), *parts)
    assert not (tmp_path / "r").exists()


# Folders in use, foreign, full or forbidden, and runs that do not fit: refused in one line, nothing touched.


def test_an_output_folder_in_use_is_left_alone(pop: Pop, shared_capture: Path, result: Path) -> None:
    before = contents(result)
    says(pop("train", shared_capture, "--out", result, *TRAIN), str(result), "--resume", "--overwrite")
    assert contents(result) == before


def test_a_folder_of_somebody_else_is_not_overwritten(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("mine")
    outcome = pop("train", shared_capture, "--out", tmp_path / "home", "--overwrite", *TRAIN)
    says(outcome, "home", "not a result folder")
    assert [path.name for path in (tmp_path / "home").iterdir()] == ["thesis.txt"]


def test_a_run_is_not_resumed_with_other_settings(pop: Pop, shared_capture: Path, result: Path) -> None:
    before = contents(result)
    outcome = pop("train", shared_capture, "--out", result, *TRAIN, "--resume", "--seed", "7")
    says(outcome, "ckpt_29_rank0.pt", "seed = 42", "seed = 7", "use the same settings")
    assert contents(result) == before


@pytest.mark.parametrize("command", ["train", "demo", "render", "export"])
def test_a_full_disk_leaves_nothing_half_written(
    pop: Pop, shared_capture: Path, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    target = tmp_path / "here" / ("out.ply" if command == "export" else "out")
    words = {
        "train": ["train", shared_capture, "--out", target, *TRAIN],
        "demo": ["demo", target, "--views", "4", "--width", "16", "--height", "16"],
        "render": ["render", shared_result, "--out", target],
        "export": ["export", shared_result, "--out", target],
    }
    says(pop(*words[command]), str(target.parent), "the disk is full", "free some space")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written_is_named(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    says(pop("train", shared_capture, "--out", tmp_path / "locked" / "r", *TRAIN), "locked", "permission denied")


# Damaged checkpoints, PLY files and results: refused in one line that names file, field and fix.


def splat_file(shared_result: Path, path: Path, **changes: object) -> Path:
    """Write a checkpoint or PLY like the tiny result's, with tensors changed or left out (None)."""
    params = load_ply(shared_result / "ply" / "point_cloud_29.ply")
    kept = {name: changes.get(name, value) for name, value in params.items()}
    torch.save({"step": 29, "splats": {k: v for k, v in kept.items() if v is not None}}, path)
    return path


def with_value(shape: tuple[int, ...], index: tuple[int, ...], value: float) -> torch.Tensor:
    tensor = torch.zeros(shape)
    tensor[index] = value
    return tensor


def test_every_defect_of_a_checkpoint_is_named_with_its_tensor(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    n = len(load_ply(shared_result / "ply" / "point_cloud_29.ply")["means"])
    cases: list[tuple[dict[str, object], tuple[str, ...]]] = [
        ({"scales": None}, ("no splats.scales",)),
        ({"means": with_value((n, 3), (4, 1), float("nan"))}, ("splats.means[4, 1] is nan",)),
        ({"sh0": with_value((n, 1, 3), (0, 0, 2), float("inf"))}, ("splats.sh0[0, 0, 2] is inf",)),
        ({"quats": torch.zeros((n, 3))}, (f"splats.quats has shape [{n}, 3]; it must be [{n}, 4]",)),
        ({"shN": torch.zeros((n, 7, 3))}, ("splats.shN has shape", "or 0, 3 or 8")),
        ({"opacities": torch.zeros(n, dtype=torch.int64)}, ("splats.opacities is torch.int64", "floats")),
        ({"means": torch.zeros(())}, ("splats.means has shape []",)),
        ({"means": [1.0]}, ("splats.means is list",)),
    ]
    for changes, parts in cases:
        path = splat_file(shared_result, tmp_path / "broken.pt", **changes)
        says(pop("export", path, "--out", tmp_path / "o.ply"), "broken.pt", *parts)
    assert not (tmp_path / "o.ply").exists()


def test_a_zero_quaternion_is_named_before_it_is_rendered_or_exported(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path
) -> None:
    quats = load_ply(shared_result / "ply" / "point_cloud_29.ply")["quats"]
    quats[2] = 0.0
    path = splat_file(shared_result, tmp_path / "zero.pt", quats=quats)
    says(pop("export", path, "--out", tmp_path / "o.ply"), "quats[2", "norm > 0")
    says(pop("eval", path, "--capture", shared_capture), "quats[", "norm > 0")
    assert not (tmp_path / "o.ply").exists()


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (lambda p: truncate(p), ("x.ply",)),
        (lambda p: patch_bytes(p, p.stat().st_size - 248, struct.pack("<f", float("nan"))), (".x is nan", "finite")),
    ],
    ids=["truncated", "NaN"],
)
def test_a_damaged_ply_is_named_and_nothing_is_exported(
    pop: Pop, shared_result: Path, tmp_path: Path, damage: Damage, parts: tuple[str, ...]
) -> None:
    path = tmp_path / "x.ply"
    save_ply(path, load_ply(shared_result / "ply" / "point_cloud_29.ply"))
    damage(path)
    says(pop("export", path, "--out", tmp_path / "o.splat"), "x.ply", *parts)
    assert not (tmp_path / "o.splat").exists()


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["eval", "gone"], ("gone", "no such file or folder")),
        (["report", "gone"], ("gone", "no cfg.json")),
        (["compare", "gone"], ("gone", "no cfg.json")),
        (["compare"], ("name one or more",)),
        (["data", "check", "gone"], ("gone", "no such folder")),
        (["sfm", "gone"], ("gone", "no such folder")),
        (["demo", "here", "--views", "2"], ("2 views", "use 4")),
        (["doctor", "--lpips-alex", "gone"], ("gone", "LPIPS")),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_the_other_subcommands_name_what_is_wrong(
    pop: Pop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], parts: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    says(pop(*words), *parts)
    assert list(tmp_path.iterdir()) == []


def test_a_result_that_was_never_saved_is_named(pop: Pop, result: Path) -> None:
    for path in [*(result / "ckpts").iterdir(), *(result / "ply").iterdir()]:
        path.unlink()
    says(pop("eval", result), "no checkpoint and no PLY", "--resume")


def test_an_unknown_setting_in_cfg_json_is_named(pop: Pop, result: Path) -> None:
    config = json.loads((result / "cfg.json").read_text())
    (result / "cfg.json").write_text(json.dumps({**config, "resolved": {**config["resolved"], "colour": 1}}))
    says(pop("eval", result), "config.colour", "not a setting")


@pytest.mark.parametrize("text", ["", "{oops", '{"max_steps": 0}'], ids=["empty", "not JSON", "out of range"])
@pytest.mark.parametrize("command", ["eval", "compare", "report"])
def test_a_damaged_cfg_json_is_named_by_its_path(pop: Pop, result: Path, command: str, text: str) -> None:
    (result / "cfg.json").write_text(text)
    says(pop(command, result), str(result / "cfg.json"), "repair the file")


def test_a_cfg_json_in_another_encoding_is_named(pop: Pop, result: Path) -> None:
    (result / "cfg.json").write_bytes("{}".encode("utf-16"))
    says(pop("eval", result), str(result / "cfg.json"), "repair the file")


def test_a_capture_that_is_no_longer_there_is_asked_for(pop: Pop, capture: Path, result: Path) -> None:
    config = json.loads((result / "cfg.json").read_text())
    (result / "cfg.json").write_text(
        json.dumps({**config, "resolved": {**config["resolved"], "data": str(capture.parent / "gone")}})
    )
    says(pop("eval", result), str(capture.parent / "gone"), "not there", "--capture DIR")
    assert pop("eval", result, "--capture", capture).status == 0


def test_held_out_views_too_small_to_be_measured_are_named(pop: Pop, shared_result: Path) -> None:
    checkpoint = shared_result / "ckpts" / "ckpt_29_rank0.pt"
    says(pop("eval", checkpoint, "--factor", "4"), "view_000.png is 10 x 8 px", "lower --factor")


def test_endings_may_be_written_in_capitals(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    for source in (shared_result / "ply" / "point_cloud_29.ply", shared_result / "ckpts" / "ckpt_29_rank0.pt"):
        loud = tmp_path / f"LOUD{source.suffix.upper()}"
        loud.write_bytes(source.read_bytes())
        outcome = pop("export", loud, "--out", tmp_path / f"{source.suffix[1:]}.splat")
        assert outcome.status == 0, outcome.err
