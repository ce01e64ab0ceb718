"""The polarized opacity prior against eq. 8 in exact rationals, and its edge cases."""

from __future__ import annotations

from fractions import Fraction
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_ref.polarization import importance_mask, pop_loss, pop_loss_vjp

opacities_st = st.sampled_from([0.5, 0.25, 0.75, 0.0, 1.0, 0.0009765625]) | st.floats(0.0, 1.0)
members_st = st.lists(st.tuples(opacities_st, st.booleans(), st.booleans()), max_size=12)


def unpacked(members: list[tuple[float, bool, bool]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    o, mask, visible = zip(*members, strict=True) if members else ((), (), ())
    return np.array(o, dtype=np.float64), np.array(mask, dtype=bool), np.array(visible, dtype=bool)


def exact_loss(members: list[tuple[float, bool, bool]]) -> Fraction:
    toward_one = [1 - Fraction(o) for o, important, _ in members if important]
    toward_zero = [Fraction(o) for o, important, _ in members if not important]
    return sum((sum(side, Fraction(0)) / len(side) for side in (toward_one, toward_zero) if side), Fraction(0))


@given(members_st)
def test_pop_loss_is_eq_8_in_exact_rationals(members: list[tuple[float, bool, bool]]) -> None:
    o, mask, visible = unpacked(members)
    assert pop_loss(o, mask) == pytest.approx(float(exact_loss(members)), rel=1e-14, abs=1e-300)
    seen = [member for member in members if member[2]]
    assert pop_loss(o, mask, visible) == pytest.approx(float(exact_loss(seen)), rel=1e-14, abs=1e-300)


@given(members_st)
def test_gradient_is_minus_one_over_n_imp_and_plus_one_over_the_rest(members: list[tuple[float, bool, bool]]) -> None:
    o, mask, visible = unpacked(members)
    v = pop_loss_vjp(o, mask, 1.0)
    n_imp, n = int(mask.sum()), len(mask)
    assert np.all(v[mask] == -1.0 / max(n_imp, 1))
    assert np.all(v[~mask] == 1.0 / max(n - n_imp, 1))
    restricted = pop_loss_vjp(o, mask, 1.0, visible)
    assert np.all(restricted[~visible] == 0.0)
    np.testing.assert_array_equal(restricted[visible], pop_loss_vjp(o[visible], mask[visible], 1.0))


@given(members_st, st.randoms())
def test_order_of_gaussians_does_not_matter(members: list[tuple[float, bool, bool]], shuffle: Random) -> None:
    shuffled = shuffle.sample(members, len(members))
    a, b = unpacked(members), unpacked(shuffled)
    assert pop_loss(a[0], a[1]) == pytest.approx(pop_loss(b[0], b[1]), rel=1e-14, abs=1e-300)


@given(st.lists(st.booleans(), max_size=12))
def test_loss_is_exactly_zero_at_polarised_opacities(important: list[bool]) -> None:
    mask = np.array(important, dtype=bool)
    assert pop_loss(mask.astype(np.float64), mask) == 0.0


@given(members_st)
def test_gradient_does_not_depend_on_opacities(members: list[tuple[float, bool, bool]]) -> None:
    o, mask, _ = unpacked(members)
    np.testing.assert_array_equal(pop_loss_vjp(o, mask, 0.5), pop_loss_vjp(1.0 - o, mask, 0.5))


@pytest.mark.parametrize(("important", "loss", "slope"), [(True, 0.75, -0.5), (False, 0.25, 0.5)])
def test_an_empty_side_contributes_nothing(important: bool, loss: float, slope: float) -> None:
    o, mask = np.array([0.25, 0.25]), np.array([important, important])
    assert pop_loss(o, mask) == loss
    assert pop_loss_vjp(o, mask, 1.0).tolist() == [slope, slope]


def test_no_gaussians_give_no_loss() -> None:
    nobody = np.zeros(0)
    assert pop_loss(nobody, nobody > 0) == 0.0
    assert pop_loss_vjp(nobody, nobody > 0, 1.0).shape == (0,)


def test_an_invisible_population_gives_no_loss_under_the_visible_reading() -> None:
    o, mask, visible = np.array([0.25, 0.5]), np.array([True, False]), np.array([False, False])
    assert pop_loss(o, mask, visible) == 0.0
    assert pop_loss_vjp(o, mask, 1.0, visible).tolist() == [0.0, 0.0]


def test_importance_takes_one_pixel() -> None:
    assert importance_mask(np.array([0, 1, 2**40])).tolist() == [False, True, True]
