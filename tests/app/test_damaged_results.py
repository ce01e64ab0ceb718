"""Files of a result folder that no run has written so: one line that names file and entry, never a traceback."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.app.conftest import Pop
from tests.app.damage import says

NOT_JSON = [b"", b"{", b"\xff\xfe", b"[" * 5000, b"1" * 5000]
NO_OBJECT = [b"[]", b"3", b"null", b'"text"']
NO_NUMBER = ["text", [], {}, True, 10**400, 1e300]


@pytest.mark.parametrize("data", [*NOT_JSON, *NO_OBJECT], ids=range(9))
@pytest.mark.parametrize("command", ["report", "compare"])
def test_statistics_that_are_no_object_are_named(pop: Pop, result: Path, command: str, data: bytes) -> None:
    path = result / "stats" / "val_step0029.json"
    path.write_bytes(data)
    says(pop(command, result), str(path), "is not JSON" if data in NOT_JSON else "must be an object", "pop eval")


@pytest.mark.parametrize("data", [*NOT_JSON[1:], *NO_OBJECT, b"{}", b'{"step": "x"}', b'{"step": true}'], ids=range(11))
def test_a_record_that_is_no_object_with_a_step_is_named(pop: Pop, result: Path, data: bytes) -> None:
    path = result / "metrics.jsonl"
    path.write_bytes(path.read_bytes() + data + b"\n")
    number = len(path.read_bytes().splitlines())
    says(pop("report", result), f"{path}: line {number}", "remove the file, or train again")


def test_a_record_that_a_kill_cut_off_is_left_out(pop: Pop, result: Path) -> None:
    path = result / "metrics.jsonl"
    path.write_bytes(path.read_bytes() + b'{"step": 30, "view": "\xc3')
    assert pop("report", result).status == 0


@pytest.mark.parametrize("value", NO_NUMBER, ids=range(6))
@pytest.mark.parametrize("key", ["psnr", "num_GS", "step", "seconds", "n_blended", "opacity_above_0.9"])
def test_a_number_that_is_none_is_named(pop: Pop, result: Path, key: str, value: Any) -> None:
    path = result / "stats" / "val_step0029.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    for command in ("report", "compare"):
        says(pop(command, result), f"{path}: {key} is ", "it must be a number")


@pytest.mark.parametrize(("key", "value"), [("machine", 3), ("backend", []), ("versions", "2"), ("method", {})])
def test_a_text_that_is_none_is_named(pop: Pop, result: Path, key: str, value: Any) -> None:
    path = result / "stats" / "val_step0029.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    says(pop("compare", result), f"{path}: {key} is ")


def test_what_is_absent_or_null_becomes_a_dash(pop: Pop, result: Path) -> None:
    for path in (result / "stats").iterdir():
        path.write_text(json.dumps(dict.fromkeys(json.loads(path.read_text()))))
    assert pop("report", result).status == 0
    assert "–" in pop("compare", result).out


@pytest.mark.parametrize("name", ["init_scale", "max_steps", "l2_stop_iter"])
def test_a_setting_beyond_all_floats_is_named(pop: Pop, result: Path, name: str) -> None:
    path = result / "cfg.json"
    config = json.loads(path.read_text())
    config["resolved"][name] = 10**400
    path.write_text(json.dumps(config))
    says(pop("report", result), str(path), f"config.{name} is a number beyond 2^53")


@pytest.mark.parametrize(("file", "command"), [("cfg.json", "report"), ("capture.json", "eval")])
def test_settings_nested_deeper_than_python_reads_are_named(pop: Pop, result: Path, file: str, command: str) -> None:
    (result / file).write_bytes(b"[" * 5000)
    says(pop(command, result), str(result / file))


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
        ("opacity_step-1", "counts", None),
        ("opacity_step-1", "counts", np.zeros(3, int)),
        ("opacity_step-1", "counts", np.zeros((2, 2), int)),
        ("opacity_step-1", "counts", np.zeros(0, int)),
        ("opacity_step-1", "counts", np.array("x")),
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
        arrays = {key: stored[key] for key in stored.files}
    arrays |= {} if value is None else {name: value}
    np.savez(path, **{key: array for key, array in arrays.items() if value is not None or key != name})
    says(pop("report", result), f"{path}: {name} ", "which no run writes")
