"""Portable vectors: the oracle passes its own, a float32 port passes, and a broken port is told where."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pop_ref.conformance.backends import SHIPPED, shipped
from pop_ref.conformance.mutants import FAMILIES, MUTANTS, living
from pop_ref.conformance.vector_check import check, schema
from pop_ref.conformance.vector_kills import answer
from pop_ref.conformance.vectors import export, kinds

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def folder(made_once: Callable[..., Path]) -> Path:
    # tests/app reads the same folder, whoever makes it
    return made_once("vectors", lambda folder: export(folder / "vectors")) / "vectors"


@pytest.mark.parametrize(
    "name", [name if name == "fast64" else pytest.param(name, marks=pytest.mark.slow) for name in SHIPPED]
)
def test_a_sound_port_passes_every_vector(folder: Path, tmp_path: Path, name: str) -> None:
    backend = shipped(name)
    unanswered = answer(folder, tmp_path / "results", backend)
    found = check(folder, tmp_path / "results", np.dtype(backend.dtype).name)
    assert not found.failed, found.failed
    assert (found.missing, found.strange) == (unanswered, [])
    # the oracle is too slow for thousands of Gaussians, and no rasterizer says what it does with colours on the way
    large = [vector for vector in unanswered if vector.startswith("large_")]
    assert bool(large) == (name == "oracle")
    if name == "oracle":
        # it draws frame by frame, from quaternions and scales
        assert all(vector.startswith(("large_", "packed", "covariances")) for vector in unanswered)
        lists = {"tiles_per_gauss", "list_rows", "list_keys"}
        assert set(found.absent) == {"dominant_counts", "n_cameras", "n_batches", "tile_size", *lists}
    else:
        assert all(vector.startswith("stage_") for vector in unanswered)
        assert [array for array in found.absent if not array.startswith("value")] == ["effective_opacities", "colors"]
    assert len(found.verdicts) > 400


def _some(folder: Path, place: Path, *names: str) -> Path:
    """Return a folder of a few of the vectors."""
    index = json.loads((folder / "index.json").read_text())
    index["vectors"] = {name: index["vectors"][name] for name in names}
    place.mkdir()
    for vector in index["vectors"].values():
        shutil.copy(folder / vector["file"], place)
    (place / "index.json").write_text(json.dumps(index))
    return place


def test_a_broken_port_is_told_which_vector_and_array(folder: Path, tmp_path: Path) -> None:
    folder = _some(folder, tmp_path / "few", "one_turned_splat", "three_cameras", "batches")
    by_name = {mutant.name: mutant for mutant in MUTANTS}
    with living(by_name["conic_off_diagonal_twice"]) as backend:
        answer(folder, tmp_path / "results", backend)
    failed = {(v.vector, v.array) for v in check(folder, tmp_path / "results").failed}
    assert ("one_turned_splat", "v_quats") in failed
    assert ("three_cameras", "v_quats") in failed
    assert not any(array in ("image", "images") for _, array in failed)


def test_the_index_explains_every_array_of_every_vector(folder: Path) -> None:
    index = json.loads((folder / "index.json").read_text())
    assert {key: value for key, value in index.items() if key != "vectors"} == schema(kinds())
    axes = {name for names in index["axes"] for name in names.split(", ")}
    for name, vector in index["vectors"].items():
        sizes: dict[str, int] = {}
        arrays = index["kinds"][vector["kind"]]["arrays"]
        assert set(arrays) == set(vector["shapes"]), name
        with np.load(folder / vector["file"]) as stored:
            assert set(stored.files) == {key for key, entry in arrays.items() if entry.get("stored", True)}, name
            for key in stored.files:
                assert str(stored[key].dtype) == arrays[key]["dtype"], f"{name}: {key}"
                assert stored[key].dtype.byteorder in "=|<"
                assert np.all(np.isfinite(stored[key])) or arrays[key]["role"] == "margin", f"{name}: {key}"
                assert list(stored[key].shape) == vector["shapes"][key]
        for key, shape in vector["shapes"].items():
            symbols = [axis for axis in arrays[key]["shape"].strip("[]").split(", ") if axis]
            # one letter is one length through all arrays of a vector
            for symbol, length in zip(symbols, shape, strict=True):
                if symbol.isdigit():
                    assert length == int(symbol), f"{name}: {key}"
                elif symbol == "3 n_sh":
                    assert length == 3 * sizes["n_sh"]
                elif symbol != "runs":
                    assert sizes.setdefault(symbol, length) == length, f"{name}: {key}"
                    assert symbol in axes
        if "width" in vector["options"]:
            assert (sizes["W"], sizes["H"]) == (vector["options"]["width"], vector["options"]["height"])


def test_every_rule_names_arrays_that_are_there() -> None:
    for arrays in (kind["arrays"] for kind in kinds().values()):
        _assert_rules_name_arrays(arrays)


def _assert_rules_name_arrays(arrays: dict[str, dict[str, Any]]) -> None:
    for name, entry in arrays.items():
        assert ("compare" in entry) == (entry["role"] == "output"), name
        for rule in entry.get("compare", []):
            expected = arrays[rule.get("expected", name)]
            if rule["where"]:
                assert arrays[rule["where"]]["role"] == "mask"
                assert entry["shape"].startswith(arrays[rule["where"]]["shape"].rstrip("]"))
            if rule["rule"] == "close":
                assert arrays[rule["error_bound"]]["shape"] == expected["shape"]
                assert set(rule["limit"]) == {"float32", "float64"}
            else:
                assert entry["dtype"] == expected["dtype"] == "int64"


def test_one_wrong_pixel_of_thousands_is_found_by_the_sums(folder: Path, tmp_path: Path) -> None:
    backend = shipped("fast32")
    folder = _some(folder, tmp_path / "large", "large_five_thousand")
    answer(folder, tmp_path / "results", backend)
    path = tmp_path / "results" / "large_five_thousand.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    arrays["image"][101, 77, 2] += 2e-3
    np.savez(path, **arrays)
    (failed,) = check(folder, tmp_path / "results").failed
    assert (failed.vector, failed.array) == ("large_five_thousand", "image")
    assert f"at [{101 // 8 * 25 + 77 // 8}, 2] of its sums" in failed.where


def test_masks_leave_most_of_every_vector_to_be_compared(folder: Path) -> None:
    for path in folder.glob("*.npz"):
        with np.load(path) as stored:
            for mask in ("decided", "unambiguous", "clear_rows"):
                assert mask not in stored.files or np.mean(stored[mask]) > 0.5, f"{path.stem}: {mask}"
            for cotangent in ("v_image", "v_images"):
                assert cotangent not in stored.files or np.any(stored[cotangent] != 0.0)


def test_inputs_are_exact_in_float32(folder: Path) -> None:
    index = json.loads((folder / "index.json").read_text())
    for vector in index["vectors"].values():
        arrays = index["kinds"][vector["kind"]]["arrays"]
        with np.load(folder / vector["file"]) as stored:
            for name in (name for name, entry in arrays.items() if entry["role"] == "input"):
                assert np.array_equal(stored[name], stored[name].astype(np.float32)), f"{vector['file']}: {name}"


def test_vectors_of_an_older_version_are_refused(folder: Path, tmp_path: Path) -> None:
    index = json.loads((folder / "index.json").read_text()) | {"version": 3}
    (tmp_path / "index.json").write_text(json.dumps(index))
    with pytest.raises(ValueError, match="version is 3, this program reads 4; write the vectors again"):
        check(tmp_path, tmp_path)


def test_what_is_published_of_the_vectors_is_of_todays_mutants_and_no_sound_backend_is_refused() -> None:
    kept = json.loads((ROOT / "benchmarks" / "results" / "vector_kills.json").read_text())
    for family, mutants in FAMILIES.items():
        assert set(kept[family]) == {mutant.name for mutant in mutants}, "run pop_ref.conformance.vector_kills again"
    assert set(kept["sound"].values()) == {None}
