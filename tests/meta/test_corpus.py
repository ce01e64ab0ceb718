"""What is kept of the corpus, and what the oracle is remembered to have answered, is what the oracle says today."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from pop_ref.conformance.adapter import KEPT, LARGEST, OracleAdapter, Reference, forget, remembered
from pop_ref.conformance.corpus import (
    MAPS,
    PLANS,
    answer,
    answers,
    bounded_windows,
    corpus_scene,
    picked_pixels,
    weighted_blocks,
    weighted_runs,
)
from pop_ref.conformance.scenes import Scene, cotangents
from pop_ref.conformance.strategies import corners, wide_scene
from pop_ref.constants import GSPLAT_1_6

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
    kept, again = answers(name), answer(name)
    assert set(kept) == set(again)
    for key, value in again.items():
        if key in MAPS:
            assert np.array_equal(np.packbits(kept[key]), value)
        elif key.startswith("e_"):
            np.testing.assert_allclose(kept[key], value, rtol=1e-5)
        else:
            close = 1e-11 * np.abs(again.get(f"e_{key.removeprefix('v_')}", 0.0))
            assert np.all(np.abs(kept[key] - value) <= close), key


@pytest.mark.parametrize("name", sorted(set(PLANS) - {*QUICK, *LARGE}))
def test_the_images_and_two_windows_of_the_answers_are_the_oracles(name: str) -> None:
    kept, scene = answers(name), corpus_scene(name)
    drawn = drawn_of(name)
    seen = np.concatenate([drawn.image, drawn.T_final[..., None]], axis=2)
    np.testing.assert_allclose(seen[picked_pixels(scene)], kept["pixels"], rtol=1e-10)
    np.testing.assert_allclose(weighted_blocks(seen, kept["unambiguous"]), kept["blocks"], rtol=1e-10)
    assert np.array_equal(weighted_blocks(drawn.n_blended, kept["unambiguous"]), kept["blended"])
    assert np.array_equal(weighted_blocks(drawn.dominant_ids, kept["decided"]), kept["winners"])
    for place, error_bounds in bounded_windows(scene, slice(1, 3)):
        for key in MAPS:
            assert np.array_equal(getattr(error_bounds, key), kept[key][place])


@pytest.mark.parametrize("name", LARGE)
def test_two_windows_of_the_largest_answers_are_the_oracles(name: str) -> None:
    kept, scene = answers(name), corpus_scene(name)
    for place, error_bounds in bounded_windows(scene, slice(40, 42)):
        for key in MAPS:
            assert np.array_equal(getattr(error_bounds, key), kept[key][place])


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
