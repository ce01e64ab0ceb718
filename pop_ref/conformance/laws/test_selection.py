"""Laws of selection: which Gaussians are kept by a score, by a share of the mass, or by a draw."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import dyadic

scores = st.lists(dyadic(-4.0, 4.0), min_size=1, max_size=12).map(np.array)
masses = st.lists(dyadic(0.0, 64.0), min_size=1, max_size=12).map(np.array)
shares = st.sampled_from([0.5, 0.0, 1.0, 0.25, 0.75, 0.8125])
uniforms = st.lists(st.integers(0, 1023).map(lambda k: k / 1024.0), min_size=12, max_size=12).map(np.array)


@law("selection", "lowest_share", scores=scores, share=shares)
def test_the_lowest_go_up_to_the_score_at_the_share_of_the_last_index(backend, scores, share):
    gone = backend.stage("lowest_share")(scores, share)
    threshold = np.sort(scores)[int(share * (len(scores) - 1))]
    assert_same_bits("removed", gone, scores <= threshold)
    assert int(np.sum(gone)) >= int(share * (len(scores) - 1)) + 1


@law("selection", "lowest_share", n=st.integers(1, 12), share=shares, seed=st.randoms(use_true_random=False))
def test_of_distinct_scores_one_more_than_the_share_of_the_last_index_goes(backend, n, share, seed):
    values = [float(k) for k in range(n)]
    seed.shuffle(values)
    values[values.index(0.0)] = -math.inf
    gone = backend.stage("lowest_share")(np.array(values), share)
    assert int(np.sum(gone)) == int(share * (n - 1)) + 1
    assert gone[values.index(-math.inf)], "what has no information goes first"


@law("selection", "least_mass", masses=masses, share=shares)
def test_the_least_mass_goes_with_the_first_that_exceeds_the_share(backend, masses, share):
    gone = backend.stage("least_mass")(masses, share)
    ascending = np.sort(masses) + 1e-6
    held = np.cumsum(ascending) / np.sum(ascending)
    # a share that is met to the last place may be met on either side
    if np.min(np.abs(held - share)) > 2.0**-20:
        beyond = np.flatnonzero(held > share)
        bound = ascending[beyond[0]] if len(beyond) else np.inf
        assert_same_bits("removed", gone, masses <= bound)
    assert np.sum(masses[~gone]) <= (1.0 - share) * np.sum(masses) * (1.0 + 2.0**-20) + 1e-4


@law("selection", "lowest_share", "least_mass", masses=masses, share=shares, seed=st.randoms(use_true_random=False))
def test_who_is_removed_does_not_hang_on_the_order_of_rows(backend, masses, share, seed):
    order = list(range(len(masses)))
    seed.shuffle(order)
    for name in ("lowest_share", "least_mass"):
        remove = backend.stage(name)
        assert_same_bits(name, remove(masses[order], share), remove(masses, share)[order])


@law("selection", "sample_without_replacement", masses=masses, uniforms=uniforms, k=st.integers(0, 12))
def test_a_draw_takes_the_first_arrivals_of_an_exponential_race(backend, masses, uniforms, k):
    u = uniforms[: len(masses)]
    draw = backend.stage("sample_without_replacement")
    if k > np.sum(masses > 0.0):
        with pytest.raises(ValueError, match=str(int(np.sum(masses > 0.0)))):
            draw(masses, k, u)
        return
    drawn = draw(masses, k, u)
    assert len(drawn) == k
    assert np.all(np.diff(drawn) > 0), "rows are given once each, ascending"
    assert np.all(masses[drawn] > 0.0), "what weighs nothing is never drawn"
    arrivals = np.array([-math.log1p(-p) / w if w > 0.0 else math.inf for p, w in zip(u, masses, strict=True)])
    last = np.max(arrivals[drawn], initial=-math.inf)
    left = np.delete(arrivals, drawn)
    assert np.all(left >= last * (1.0 - 2.0**-20)), "a Gaussian that was not drawn arrived before one that was"


@law("selection", "sample_without_replacement", masses=masses, uniforms=uniforms)
def test_all_that_weighs_something_can_be_drawn(backend, masses, uniforms):
    positive = np.flatnonzero(masses > 0.0)
    drawn = backend.stage("sample_without_replacement")(masses, len(positive), uniforms[: len(masses)])
    assert_same_bits("drawn", drawn, positive)


@law("selection", "sample_without_replacement", masses=masses, uniforms=uniforms, k=st.integers(0, 12))
def test_a_draw_hangs_on_proportions_only(backend, masses, uniforms, k):
    k = min(k, int(np.sum(masses > 0.0)))
    draw = backend.stage("sample_without_replacement")
    u = uniforms[: len(masses)]
    assert_same_bits("drawn", draw(8.0 * masses, k, u), draw(masses, k, u))
