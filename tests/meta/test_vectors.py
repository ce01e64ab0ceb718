"""Portable vectors: the oracle passes its own, a float32 port passes, and a broken port is told where."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pop_ref.conformance.backends import SHIPPED, shipped
from pop_ref.conformance.mutants import MUTANTS, living
from pop_ref.conformance.scene_files import load_scene
from pop_ref.conformance.vectors import GRADIENTS, SCHEMA, check, export


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("vectors")
    export(made)
    return made


def answer(folder: Path, results: Path, backend: object) -> None:
    """Do what a port does: read the inputs, write the outputs."""
    results.mkdir()
    for path in sorted(folder.glob("*.npz")):
        scene = load_scene(path)
        with np.load(path) as inputs:
            gradients = backend.gradients(scene, inputs["v_image"], inputs["v_T_final"])  # type: ignore[attr-defined]
        view = backend.render(scene)  # type: ignore[attr-defined]
        outputs = {name: getattr(view, name) for name in ("image", "T_final", "dominant_ids", "n_blended")}
        np.savez(results / path.name, **outputs, **{f"v_{name}": gradients[name] for name in GRADIENTS})


@pytest.mark.parametrize("name", SHIPPED)
def test_a_sound_port_passes_every_vector(folder: Path, tmp_path: Path, name: str) -> None:
    answer(folder, tmp_path / "results", shipped(name))
    # vectors charge float32; a port in float64 is held to the same numbers
    verdicts = check(folder, tmp_path / "results", np.float32)
    assert len(verdicts) == len(list(folder.glob("*.npz"))) * (4 + len(GRADIENTS))
    failed = [v for v in verdicts if not v.passed]
    assert not failed, failed


def test_a_broken_port_is_told_which_vector_and_array(folder: Path, tmp_path: Path) -> None:
    by_name = {mutant.name: mutant for mutant in MUTANTS}
    with living(by_name["conic_off_diagonal_twice"]) as backend:
        answer(folder, tmp_path / "results", backend)
    failed = {(v.vector, v.array) for v in check(folder, tmp_path / "results") if not v.passed}
    assert ("one_turned_splat", "v_quats") in failed
    assert not any(array == "image" for _, array in failed)


def test_the_index_explains_every_array(folder: Path) -> None:
    index = json.loads((folder / "index.json").read_text())
    assert index["schema"] == SCHEMA
    assert set(index["units"]) == {"image", "T_final", *(f"v_{name}" for name in GRADIENTS)}
    for name, arrays in index["vectors"].items():
        with np.load(folder / f"{name}.npz") as stored:
            assert {key: [str(a.dtype), list(a.shape)] for key, a in stored.items()} == arrays


def test_inputs_are_exact_in_float32(folder: Path) -> None:
    for path in folder.glob("*.npz"):
        with np.load(path) as stored:
            for name in ("means", "quats", "scales", "opacities", "sh", "viewmat", "K", "background", "v_image"):
                assert np.array_equal(stored[name], stored[name].astype(np.float32)), f"{path.name}: {name}"


def test_wrong_shapes_and_other_versions_are_refused(folder: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    results.mkdir()
    np.savez(results / "golden.npz", image=np.zeros((2, 2, 3)))
    with pytest.raises(ValueError, match=r"golden: image has shape \[2, 2, 3\]"):
        check(folder, results)
    other = tmp_path / "other"
    other.mkdir()
    (other / "index.json").write_text('{"version": 99, "vectors": {}}')
    with pytest.raises(ValueError, match="version 99"):
        check(other, results)
