"""Portable vectors and the corpus: the oracle and a float32 port pass the vectors, and a broken port is told where.

What is kept of the corpus, and what the oracle is remembered to have answered, is what the oracle says today.
"""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pop_ref.conformance import vector_stages
from pop_ref.conformance.adapter import KEPT, LARGEST, OracleAdapter, Reference, forget, remembered
from pop_ref.conformance.backends import SHIPPED, shipped
from pop_ref.conformance.corpus import (
    MAPS,
    PLANS,
    answers,
    bounded_windows,
    corpus_scene,
    picked_pixels,
    weighted_blocks,
    weighted_runs,
)
from pop_ref.conformance.corpus import answer as corpus_answer
from pop_ref.conformance.mutants import FAMILIES, MUTANTS, living
from pop_ref.conformance.scenes import Scene, cotangents
from pop_ref.conformance.strategies import corners, wide_scene
from pop_ref.conformance.vector_check import check, schema
from pop_ref.conformance.vector_kills import answer
from pop_ref.conformance.vectors import export, kinds
from pop_ref.constants import GSPLAT_1_6

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def folder(made_once: Callable[..., Path]) -> Path:
    # tests/app reads the same folder, whoever makes it
    return made_once("vectors", lambda folder: export(folder / "vectors")) / "vectors"


@pytest.fixture
def index(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "index.json").read_text())


@pytest.mark.slow  # hundreds of vectors
@pytest.mark.parametrize("name", SHIPPED)
def test_a_sound_port_passes_every_vector(folder: Path, tmp_path: Path, name: str) -> None:
    backend = shipped(name)
    unanswered = answer(folder, tmp_path / "results", backend)
    found = check(folder, tmp_path / "results", np.dtype(backend.dtype).name)
    assert not found.failed, found.failed
    assert (found.missing, found.strange) == (unanswered, [])
    # the oracle is too slow for thousands of Gaussians, and no rasterizer tells colours on the way
    large = [vector for vector in unanswered if vector.startswith("large_")]
    assert bool(large) == (name == "oracle")
    if name == "oracle":
        # it draws frame by frame, from quaternions and scales
        assert all(vector.startswith(("large_", "packed", "covariances")) for vector in unanswered)
        lists = {"tiles_per_gauss", "list_rows", "list_keys"}
        told = {"n_cameras", "n_batches", "tile_size", "width", "height", "tile_width", "tile_height"}
        assert set(found.absent) == {"dominant_counts", *told, *lists}
    else:
        assert all(vector.startswith("stage_") for vector in unanswered)
        assert [array for array in found.absent if not array.startswith("value")] == ["colors"]
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


def test_the_index_explains_every_array_of_every_vector(folder: Path, index: dict[str, Any]) -> None:
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


@pytest.mark.parametrize("kind", kinds())
def test_every_rule_names_arrays_that_are_there(kind: str) -> None:
    arrays = kinds()[kind]["arrays"]
    for name, entry in arrays.items():
        assert ("compare" in entry) == (entry["role"] == "output"), name
        for rule in entry.get("compare", []):
            expected = arrays[rule.get("expected", name)]
            if rule["where"]:
                assert arrays[rule["where"]]["role"] == "mask"
                assert entry["shape"].startswith(arrays[rule["where"]]["shape"].rstrip("]"))
            if rule["rule"] == "close":
                assert arrays[rule["error_bound"]]["shape"] == expected["shape"]
                units = {each: limit / np.finfo(each).eps for each, limit in rule["limit"].items()}
                assert set(units) == {"float32", "float64"}
                # whoever computes in single precision is no float64 port; whose row a row is, is asked coarsely of all
                assert (units["float64"] <= 64.001 * units["float32"]) == (name != "places"), name
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


def test_inputs_are_exact_in_float32_and_masks_leave_most_of_every_vector_to_be_compared(folder, index):
    for vector in index["vectors"].values():
        arrays = index["kinds"][vector["kind"]]["arrays"]
        with np.load(folder / vector["file"]) as stored:
            for name in (name for name, entry in arrays.items() if entry["role"] == "input"):
                assert np.array_equal(stored[name], stored[name].astype(np.float32)), f"{vector['file']}: {name}"
            for mask in {"decided", "unambiguous", "clear_rows", "clear_steps"} & set(stored.files):
                if mask == "clear_steps" and np.any(stored["rows"] != stored["step_rows"]):
                    # who is there is compared also where rounding decides a pixel
                    continue
                assert np.mean(stored[mask] if stored[mask].size else True) > 0.5, f"{vector['file']}: {mask}"
            for cotangent in {"v_image", "v_images"} & set(stored.files):
                assert np.any(stored[cotangent] != 0.0)


def test_calls_are_kept_for_mutants_that_there_are(monkeypatch, tmp_path: Path, capsys) -> None:
    kept = tmp_path / "calls.json"
    kept.write_bytes(vector_stages.FILE.read_bytes())
    monkeypatch.setattr(vector_stages, "FILE", kept)
    for names, said in (([], "no mutant is named"), (["nobody"], "there is no mutant nobody")):
        assert vector_stages.main(names) == 2
        assert said in capsys.readouterr().out
    # a call of the file tells this one from the oracle already
    assert vector_stages.main(["all_directions_count_too_much"]) == 0
    assert kept.read_bytes() == Path(vector_stages.__file__).with_suffix(".json").read_bytes()
    assert list(tmp_path.iterdir()) == [kept]


@pytest.mark.slow  # a copy of the program is loaded and tried
def test_a_call_is_kept_for_a_mutant_of_the_program_which_lacks_functions_of_other_calls(monkeypatch, tmp_path: Path):
    kept = tmp_path / "calls.json"
    calls = json.loads(vector_stages.FILE.read_text(encoding="utf-8"))
    # which are functions of the oracle alone
    others = [call for call in calls if call[0] in ("sigma_at_pixel", "stops")]
    kept.write_text(json.dumps(others), encoding="utf-8")
    monkeypatch.setattr(vector_stages, "FILE", kept)
    vector_stages.recorded.cache_clear()
    try:
        assert vector_stages.main(["gradient_of_scales_for_logarithms"]) == 0
    finally:
        vector_stages.recorded.cache_clear()
    found = json.loads(kept.read_text(encoding="utf-8"))
    assert len(others) == 2
    assert [call[0] for call in found] == [*(call[0] for call in others), "scales_from_log_scales_vjp"]


def test_what_is_published_of_the_vectors_is_of_todays_mutants_and_no_sound_backend_is_refused() -> None:
    kept = json.loads((ROOT / "benchmarks" / "results" / "vector_kills.json").read_text())
    for family, mutants in FAMILIES.items():
        assert set(kept[family]) == {mutant.name for mutant in mutants}, "run pop_ref.conformance.vector_kills again"
    assert set(kept["sound"].values()) == {None}


# in seconds; of the others a part is computed again
QUICK = (
    "far_and_huge",
    "near_equal_depths",
    "fifty",
    "slanted",
    "hundreds_in_a_tile",
    "many_tiles",
    "fifty_of_inria",
    "hundreds_of_inria",
)
# takes the oracle half a minute; a float64 program is held to its answers by the laws of scale
LARGE = ("seventy_thousand",)


@functools.cache
def drawn_of(name: str) -> Any:
    return OracleAdapter().full_render(corpus_scene(name))


@pytest.mark.slow  # the oracle draws large scenes
@pytest.mark.parametrize("name", QUICK)
def test_the_answers_are_the_oracles(name: str) -> None:
    kept, again = answers(name), corpus_answer(name)
    assert set(kept) == set(again)
    for key, value in again.items():
        if key in MAPS:
            assert np.array_equal(np.packbits(kept[key]), value)
        elif key.startswith("e_"):
            np.testing.assert_allclose(kept[key], value, rtol=1e-5)
        else:
            close = 1e-11 * np.abs(again.get(f"e_{key.removeprefix('v_')}", 0.0))
            assert np.all(np.abs(kept[key] - value) <= close), key


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if PLANS[name].n > 4_000 else name
        for name in sorted(set(PLANS) - {*QUICK, *LARGE})
    ],
)
def test_the_images_of_the_answers_are_the_oracles(name: str) -> None:
    kept, scene = answers(name), corpus_scene(name)
    drawn = drawn_of(name)
    seen = np.concatenate([drawn.image, drawn.T_final[..., None]], axis=2)
    np.testing.assert_allclose(seen[picked_pixels(scene)], kept["pixels"], rtol=1e-10)
    np.testing.assert_allclose(weighted_blocks(seen, kept["unambiguous"]), kept["blocks"], rtol=1e-10)
    assert np.array_equal(weighted_blocks(drawn.n_blended, kept["unambiguous"]), kept["blended"])
    assert np.array_equal(weighted_blocks(drawn.dominant_ids, kept["decided"]), kept["winners"])


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in LARGE else n for n in sorted(set(PLANS) - set(QUICK))]
)
def test_two_windows_of_the_answers_are_the_oracles(name: str) -> None:
    windows = slice(40, 42) if name in LARGE else slice(1, 3)
    for place, error_bounds in bounded_windows(corpus_scene(name), windows):
        for key in MAPS:
            assert np.array_equal(getattr(error_bounds, key), answers(name)[key][place])


@pytest.mark.slow  # the oracle draws large scenes
def test_the_corpus_has_long_lists_wide_splats_many_tiles_many_entries_and_cut_tiles() -> None:
    longest, tiles, entries, blended, widest = [], [], [], [], []
    for name, plan in PLANS.items():
        assert answers(name)["unambiguous"].mean() > 0.5
        assert 16 <= plan.n <= 70_000
        if name in LARGE:
            # over the 8,192 tiles and 65,535 rows that some programs have room for
            assert -(-plan.width // plan.tile_size) * -(-plan.height // plan.tile_size) > 8192
            assert plan.n > 2**16
            continue
        drawn = drawn_of(name)
        lengths = [len(ids) for ids in drawn.tile_lists]
        longest.append(max(lengths))
        blended.append(int(drawn.n_blended.max()))
        tiles.append(len(lengths))
        entries.append(sum(lengths))
        widest.append(int(np.bincount(np.concatenate([np.array(ids, dtype=int) for ids in drawn.tile_lists])).max()))
    assert max(longest) > 9_000
    for length in (8, 32, 256, 1024):
        assert max(longest) > length
        assert any(length < each <= 8 * length for each in longest)
    assert max(blended) > 1024
    assert max(tiles) > 256
    assert max(widest) > 256
    assert max(entries) > 2**16
    assert any(plan.width % plan.tile_size and plan.height % plan.tile_size for plan in PLANS.values())
    assert {(33, 17), (200, 120)} <= {(plan.width, plan.height) for plan in PLANS.values()}


@pytest.mark.parametrize("name", PLANS)
def test_a_scene_is_the_same_in_single_precision_and_has_signal(name: str) -> None:
    scene = corpus_scene(name)
    for array in (*vars(scene.gaussians).values(), scene.camera.viewmat, scene.camera.K, scene.background):
        assert np.array_equal(array, array.astype(np.float32))
    norms = np.linalg.norm(scene.gaussians.quats, axis=1)
    assert norms.min() < 0.5
    assert norms.max() > 2.0
    kept = answers(name)
    for key in ("means", "quats", "scales", "opacities", "sh", "means2d"):
        assert np.mean(kept[f"v_{key}"] != 0.0) > 0.5, f"the gradient of {key} says little"


def test_weighted_sums_see_two_pixels_or_rows_change_places() -> None:
    image = np.arange(24.0 * 20.0).reshape(24, 20)
    everywhere = np.ones(image.shape, dtype=bool)
    for a, b in (((0, 0), (0, 1)), ((0, 0), (1, 0)), ((9, 3), (15, 6))):
        swapped = image.copy()
        swapped[a], swapped[b] = image[b], image[a]
        assert not np.array_equal(weighted_blocks(swapped, everywhere), weighted_blocks(image, everywhere))
    rows = np.arange(600.0).reshape(300, 2)
    swapped = rows.copy()
    swapped[[1, 2]] = rows[[2, 1]]
    assert not np.array_equal(weighted_runs(swapped), weighted_runs(rows))


def test_what_is_remembered_is_the_oracles() -> None:
    for values in corners(3):
        scene, v = values["scene"], cotangents(values["scene"])
        for _ in range(2):
            np.testing.assert_array_equal(Reference().render(scene).image, OracleAdapter().render(scene).image)
            found, expected = Reference().gradients(scene, *v), OracleAdapter().gradients(scene, *v)
            assert set(found) == set(expected)
            for name, value in expected.items():
                np.testing.assert_array_equal(found[name], value)


def test_another_scene_or_question_is_answered_anew() -> None:
    asked = []

    @remembered
    def answer(scene: Scene, *more: object) -> int:
        asked.append(scene)
        return len(asked)

    scene = corners(3)[2]["scene"]
    moved = scene.gaussians.means.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], 9.0)
    viewmat = scene.camera.viewmat.copy()
    viewmat[0, 3] += 2.0**-30
    others = [
        scene.with_overrides(means=moved),
        scene.with_overrides(background=[0.0, 0.0, 0.5]),
        scene.with_overrides(profile=GSPLAT_1_6),
        scene.with_overrides(tile_size=3),
        scene.with_overrides(sh_degree=0),
        scene.with_overrides(antialiased=True),
        scene.with_overrides(width=scene.camera.width + 1),
        scene.with_overrides(viewmat=viewmat),
    ]
    questions = [(scene,), *((other,) for other in others), (scene, np.float32), (scene, np.zeros(2), np.zeros(3))]
    first = [answer(*question) for question in questions]
    assert first == list(range(1, len(questions) + 1))
    assert [answer(*question) for question in questions] == first
    # the same numbers in other arrays are the same question
    assert answer(scene.with_overrides(means=scene.gaussians.means.copy())) == 1


def test_the_oldest_answers_and_large_scenes_are_forgotten() -> None:
    asked = []

    @remembered
    def answer(scene: Scene, number: int) -> None:
        asked.append(number)

    scene = corners(1)[0]["scene"]
    for number in (*range(KEPT + 1), 0):
        answer(scene, number)
    assert asked == [*range(KEPT + 1), 0]
    forget()
    answer(scene, 0)
    assert asked[-2:] == [0, 0]
    many = wide_scene(0)
    times = -(-(LARGEST + 1) // len(many.gaussians))
    large = many.rows(np.tile(np.arange(len(many.gaussians)), times))
    answer(large, -1)
    answer(large, -1)
    assert asked[-2:] == [-1, -1]
