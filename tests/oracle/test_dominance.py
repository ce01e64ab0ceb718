"""Dominance by brute force, ties above all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pop_ref import PAPER, dominance, render
from tests.oracle.scenes import dyadic_camera, grey

weights = st.lists(st.sampled_from([0.125, 0.25, 0.25, 0.5]), max_size=6)


@given(weights, st.randoms())
def test_the_winner_is_the_first_of_the_largest(values: list[float], random) -> None:
    ids = list(range(10, 10 + len(values)))
    random.shuffle(ids)
    want = -1
    for i, weight in zip(reversed(ids), reversed(values), strict=True):
        # walking from the back, an equal one further in front takes over
        if weight == max(values):
            want = i
    assert dominance.dominant_id(ids, values) == want


def test_a_weight_of_zero_never_wins() -> None:
    assert dominance.dominant_id([3, 4], [0.0, 0.0]) == -1


@given(st.lists(st.lists(st.integers(-1, 4), min_size=3, max_size=3), min_size=1, max_size=4))
def test_counts_are_pixels_won_and_with_empty_pixels_make_the_image(winners: list[list[int]]) -> None:
    ids = np.array(winners)
    counts = dominance.dominant_counts(ids, 5)
    assert counts.tolist() == [int(np.sum(ids == i)) for i in range(5)]
    assert np.sum(counts) + np.sum(ids == -1) == ids.size


def test_of_coincident_copies_the_one_of_lower_index_dominates() -> None:
    out = render(grey([0.5, 0.5, 0.5]), dyadic_camera(1, 1))
    assert out.tile_lists == [[0, 1, 2]]
    assert out.n_blended[0, 0] == 3
    assert out.dominant_ids[0, 0] == 0


def test_equal_weights_go_to_the_front() -> None:
    # with no ceiling the second takes all that the first leaves: 1/2 each
    profile = replace(PAPER, alpha_ceiling=1.0, transmittance_stop=-1.0)
    behind = grey([1.0, 0.5], means=[[0.0, 0.0, 4.0], [0.0, 0.0, 2.0]])
    out = render(behind, dyadic_camera(1, 1), profile=profile)
    assert out.tile_lists == [[1, 0]]
    assert out.dominant_weights[0, 0] == 0.5
    assert out.dominant_ids[0, 0] == 1


def test_the_terminating_splat_does_not_compete() -> None:
    # the second would weigh more than the first but ends the pixel
    profile = replace(PAPER, alpha_floor=1 / 256, alpha_ceiling=1.0, transmittance_stop=0.25)
    out = render(grey([0.25, 0.875]), dyadic_camera(1, 1), profile=profile)
    assert (out.n_blended[0, 0], out.n_traversed[0, 0]) == (1, 2)
    assert out.dominant_ids[0, 0] == 0


def test_colours_and_background_do_not_matter() -> None:
    gaussians = grey([0.25, 0.75, 0.5], means=[[0.0, 0.0, 4.0], [0.5, 1.0, 5.0], [-1.0, 0.0, 3.0]])
    other = replace(gaussians, sh=np.random.default_rng(0).normal(size=(3, 1, 3)))
    view = dyadic_camera(4, 4)
    one, two = render(gaussians, view), render(other, view, background=np.ones(3))
    assert np.array_equal(one.dominant_ids, two.dominant_ids)
    assert np.array_equal(one.dominant_counts, two.dominant_counts)
    assert not np.array_equal(one.image, two.image)
