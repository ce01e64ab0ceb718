"""Selection: counts by the rule, draws against exact probabilities of small cases."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from pop_ref.selection import least_mass, lowest_share, sample_without_replacement

shares = st.one_of(st.sampled_from([0.0, 1.0, 0.5, 0.8, 0.3]), st.floats(0.0, 1.0))
masses = st.lists(st.floats(0.0, 1e3), min_size=1, max_size=30)


@given(st.permutations(range(17)), st.integers(1, 17), shares)
def test_of_distinct_scores_as_many_go_as_the_rule_says(order, n: int, share: float) -> None:
    scores = np.array(order[:n], dtype=np.float64)
    gone = lowest_share(scores, share)
    assert np.sum(gone) == int(share * (n - 1)) + 1
    # and they are the lowest
    assert np.max(scores[gone]) < np.min(scores[~gone], initial=np.inf)


def test_ties_at_the_threshold_all_go_and_minus_infinity_goes_first() -> None:
    scores = np.array([2.0, -np.inf, 2.0, 2.0, 5.0])
    assert lowest_share(scores, 0.25).tolist() == [True, True, True, True, False]
    assert lowest_share(scores, 0.0).tolist() == [False, True, False, False, False]
    assert lowest_share(np.zeros(0), 0.8).shape == (0,)


def test_what_cannot_be_sorted_is_told() -> None:
    with pytest.raises(ValueError, match=r"scores\[1\] is nan; scores must be numbers"):
        lowest_share(np.array([0.0, np.nan]), 0.5)
    with pytest.raises(ValueError, match=r"share is 1.5; it must be in \[0, 1\]"):
        lowest_share(np.zeros(2), 1.5)
    with pytest.raises(ValueError, match=r"share is -0.5"):
        least_mass(np.zeros(2), -0.5)
    with pytest.raises(ValueError, match=r"importance\[0\] is -1.0; it must be >= 0 and finite"):
        least_mass(np.array([-1.0, 1.0]))


@given(masses, st.sampled_from([0.01, 0.25, 0.9]))
def test_the_first_mass_beyond_the_share_bounds_what_goes(values: list[float], share: float) -> None:
    importance = np.array(values)
    gone = least_mass(importance, share)
    ascending = np.sort(importance) + 1e-6
    beyond = np.cumsum(ascending) / np.sum(ascending) > share
    # a boundary that rounding decides is left alone
    if np.min(np.abs(np.cumsum(ascending) / np.sum(ascending) - share)) > 1e-12:
        assert gone.tolist() == (importance <= ascending[np.argmax(beyond)]).tolist()


def test_a_hundredth_of_the_mass_is_dropped_and_no_more_than_one_row_beyond_it() -> None:
    importance = np.random.default_rng(0).exponential(size=4000) ** 3
    gone = least_mass(importance)
    assert np.sum(importance[gone]) >= 0.01 * np.sum(importance)
    assert np.sum(np.sort(importance[gone])[:-1]) <= 0.01 * np.sum(importance)


def test_all_the_mass_is_all_rows() -> None:
    assert least_mass(np.array([1.0, 2.0]), 1.0).tolist() == [True, True]


def exact_probabilities(weights: list[float], k: int) -> dict[tuple[int, ...], float]:
    """Add over all orders the probability to draw these rows one after the other."""
    found: dict[tuple[int, ...], float] = {}
    positive = [i for i, w in enumerate(weights) if w > 0.0]
    for order in itertools.permutations(positive, k):
        p, left = 1.0, sum(weights)
        for i in order:
            p *= weights[i] / left
            left -= weights[i]
        key = tuple(sorted(order))
        found[key] = found.get(key, 0.0) + p
    return found


@pytest.mark.parametrize(("weights", "k"), [([1.0, 2.0, 4.0], 1), ([1.0, 0.0, 2.0, 5.0], 2), ([0.5, 3, 1, 1, 2], 3)])
def test_draws_are_distributed_as_one_after_the_other(weights: list[float], k: int) -> None:
    rng = np.random.default_rng(7)
    n = 20_000
    seen: dict[tuple[int, ...], int] = {}
    for uniforms in rng.uniform(size=(n, len(weights))):
        drawn = sample_without_replacement(np.array(weights), k, uniforms)
        assert len(set(drawn.tolist())) == k
        assert np.all(np.diff(drawn) > 0)
        seen[tuple(drawn.tolist())] = seen.get(tuple(drawn.tolist()), 0) + 1
    want = exact_probabilities(weights, k)
    assert set(seen) <= set(want), "what weighs nothing was drawn"
    statistic = sum((seen.get(key, 0) - n * p) ** 2 / (n * p) for key, p in want.items())
    assert statistic < chi2.ppf(0.999, len(want) - 1)


def test_all_positive_weights_can_be_drawn_and_none() -> None:
    weights, uniforms = np.array([0.0, 1.0, 1e-300, 0.0, 5.0]), np.linspace(0.0, 0.9, 5)
    assert sample_without_replacement(weights, 3, uniforms).tolist() == [1, 2, 4]
    assert sample_without_replacement(weights, 0, uniforms).tolist() == []


def test_the_smallest_exponential_arrivals_are_drawn() -> None:
    rng = np.random.default_rng(3)
    weights, uniforms = rng.uniform(0.1, 2.0, 50), rng.uniform(size=50)
    arrivals = -np.log(1.0 - uniforms) / weights
    assert sample_without_replacement(weights, 20, uniforms).tolist() == sorted(np.argsort(arrivals)[:20].tolist())


def test_impossible_draws_are_told_with_their_numbers() -> None:
    with pytest.raises(ValueError, match="k is 3; of 3 weights 2 are positive, and so many can be drawn"):
        sample_without_replacement(np.array([1.0, 0.0, 1.0]), 3, np.zeros(3))
    with pytest.raises(ValueError, match="k is -1"):
        sample_without_replacement(np.ones(2), -1, np.zeros(2))
    with pytest.raises(ValueError, match=r"weights\[1\] is nan"):
        sample_without_replacement(np.array([1.0, np.nan]), 1, np.zeros(2))
    with pytest.raises(ValueError, match=r"uniforms must be in \[0, 1\)"):
        sample_without_replacement(np.ones(2), 1, np.array([0.5, 1.0]))
    with pytest.raises((ValueError, TypeError), match="uniforms"):
        sample_without_replacement(np.ones(2), 1, np.zeros(3))
