"""Bad captures and settings on the command line: status 2, one line that names file, field and fix.

One of each kind: `test_bad_input_data` and `test_config` have what is said of all others."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest
import torch

from pop_fast.io.ply import load_ply
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import photo, says


def test_a_damaged_capture_is_named_before_anything_is_written(pop: Pop, capture: Path, tmp_path: Path) -> None:
    photo(capture, 3).unlink()
    outcome = pop("train", capture, "--out", tmp_path / "r", *TRAIN)
    says(outcome, "view_003.png", "absent", "--missing skip")
    assert not (tmp_path / "r").exists()


def test_settings_that_exclude_each_other_are_named(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    outcome = pop("train", shared_capture, "--out", tmp_path / "r", "--resume", "--overwrite")
    says(outcome, "--resume and --overwrite")
    assert not (tmp_path / "r").exists()


# Disks that are full and folders that are forbidden: refused in one line, nothing touched.


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
        pop.done("export", loud, "--out", tmp_path / f"{source.suffix[1:]}.splat")
