"""Portable vectors: the oracle passes its own, a float32 port passes, and a broken port is told where."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pop_ref.conformance.backends import SHIPPED, shipped
from pop_ref.conformance.mutants import MUTANTS, living
from pop_ref.conformance.scene_files import scene_from
from pop_ref.conformance.vector_check import check
from pop_ref.conformance.vector_schema import GRADIENTS, schema
from pop_ref.conformance.vectors import export


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("vectors")
    export(made)
    return made


def answer(folder: Path, results: Path, backend: object) -> None:
    """Do what a port does: read the inputs, write the outputs."""
    results.mkdir()
    vectors = json.loads((folder / "index.json").read_text())["vectors"]
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as inputs:
            scene = scene_from(dict(inputs), vectors[path.stem]["options"])
            gradients = backend.gradients(scene, inputs["v_image"], inputs["v_T_final"])  # type: ignore[attr-defined]
        view = backend.render(scene)  # type: ignore[attr-defined]
        outputs = {name: getattr(view, name) for name in ("image", "T_final", "dominant_ids", "n_blended")}
        np.savez(results / path.name, **outputs, **{f"v_{name}": gradients[name] for name in GRADIENTS})


@pytest.mark.parametrize("name", SHIPPED)
def test_a_sound_port_passes_every_vector(folder: Path, tmp_path: Path, name: str) -> None:
    backend = shipped(name)
    answer(folder, tmp_path / "results", backend)
    found = check(folder, tmp_path / "results", np.dtype(backend.dtype).name)
    assert len(found.verdicts) == len(list(folder.glob("*.npz"))) * (4 + len(GRADIENTS))
    assert not found.failed, found.failed
    assert (found.absent, found.missing, found.strange) == ([], [], [])


def test_a_broken_port_is_told_which_vector_and_array(folder: Path, tmp_path: Path) -> None:
    by_name = {mutant.name: mutant for mutant in MUTANTS}
    with living(by_name["conic_off_diagonal_twice"]) as backend:
        answer(folder, tmp_path / "results", backend)
    failed = {(v.vector, v.array) for v in check(folder, tmp_path / "results").failed}
    assert ("one_turned_splat", "v_quats") in failed
    assert not any(array == "image" for _, array in failed)


def test_the_index_explains_every_array_of_every_vector(folder: Path) -> None:
    index = json.loads((folder / "index.json").read_text())
    assert {key: value for key, value in index.items() if key != "vectors"} == schema()
    axes = index["axes"]
    for name, vector in index["vectors"].items():
        sizes: dict[str, int] = {}
        with np.load(folder / vector["file"]) as stored:
            assert set(stored.files) == set(index["arrays"]) == set(vector["shapes"]), name
            for key in stored.files:
                stated = index["arrays"][key]
                assert str(stored[key].dtype) == stated["dtype"], key
                assert stored[key].dtype.byteorder in "=|<"
                assert np.all(np.isfinite(stored[key])) or stated["role"] == "margin", f"{name}: {key}"
                symbols = [axis for axis in stated["shape"].strip("[]").split(", ") if axis]
                assert list(stored[key].shape) == vector["shapes"][key]
                # one letter is one length through all arrays of a vector
                for symbol, length in zip(symbols, stored[key].shape, strict=True):
                    assert sizes.setdefault(symbol, length) == length == (int(symbol) if symbol.isdigit() else length)
                    assert symbol.isdigit() or symbol in axes
        assert (sizes["W"], sizes["H"]) == (vector["options"]["width"], vector["options"]["height"])


def test_every_rule_names_arrays_that_are_there(folder: Path) -> None:
    arrays = json.loads((folder / "index.json").read_text())["arrays"]
    for name, entry in arrays.items():
        assert ("compare" in entry) == (entry["role"] == "output"), name
        rule = entry.get("compare", {})
        if rule.get("where"):
            assert arrays[rule["where"]]["role"] == "mask"
            assert entry["shape"].startswith(arrays[rule["where"]]["shape"].rstrip("]"))
        if rule.get("rule") == "close":
            assert arrays[rule["error_bound"]]["shape"] == entry["shape"]
            assert set(rule["limit"]) == {"float32", "float64"}
        elif rule:
            assert entry["dtype"] == "int64"


def test_masks_leave_most_of_every_vector_to_be_compared(folder: Path) -> None:
    for path in folder.glob("*.npz"):
        with np.load(path) as stored:
            assert np.mean(stored["decided"]) > 0.5, path.stem
            assert np.any(stored["v_image"] != 0.0)


def test_inputs_are_exact_in_float32(folder: Path) -> None:
    for path in folder.glob("*.npz"):
        with np.load(path) as stored:
            for name in ("means", "quats", "scales", "opacities", "sh", "viewmat", "K", "background", "v_image"):
                assert np.array_equal(stored[name], stored[name].astype(np.float32)), f"{path.name}: {name}"
