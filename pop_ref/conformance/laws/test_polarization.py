"""Laws of the importance mask and the polarized opacity prior (paper eqs. 7, 8)."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import opacities

members = st.lists(st.tuples(opacities(), st.booleans()), max_size=8)


def _columns(backend, members):
    o = np.array([m[0] for m in members], dtype=np.float64).astype(backend.dtype).astype(np.float64)
    return o, np.array([m[1] for m in members], dtype=bool)


@law("polarization", "importance_mask", counts=st.lists(st.integers(0, 3), max_size=6))
def test_a_gaussian_is_important_if_it_dominates_one_pixel(backend, counts):
    mask = backend.stage("importance_mask")(np.array(counts, dtype=np.int64))
    assert_same_bits("mask", mask, [c > 0 for c in counts])


@law("polarization", "pop_loss", members=members)
def test_the_prior_is_the_mean_distance_of_each_side_from_its_pole(backend, members):
    # a side without members adds nothing (A7)
    o, mask = _columns(backend, members)
    expected = sum(float(np.mean(side)) for side in (1.0 - o[mask], o[~mask]) if side.size)
    assert_close("polarization.loss", backend.stage("pop_loss")(o, mask), expected, 2.0, backend.dtype)


@law("polarization", "pop_loss", members=members, order=st.randoms(use_true_random=False))
def test_the_prior_does_not_depend_on_the_order_of_gaussians(backend, members, order):
    shuffled = list(members)
    order.shuffle(shuffled)
    loss = backend.stage("pop_loss")
    one, other = loss(*_columns(backend, members)), loss(*_columns(backend, shuffled))
    assert_close("polarization.loss", other, one, 2.0, backend.dtype)


@law("polarization", "pop_loss", mask=st.lists(st.booleans(), max_size=8).map(lambda m: np.array(m, dtype=bool)))
def test_the_prior_is_exactly_zero_at_polarised_opacities_and_two_at_their_opposite(backend, mask):
    loss = backend.stage("pop_loss")
    assert_same_bits("loss", loss(mask.astype(np.float64), mask), 0.0)
    sides = int(np.any(mask)) + int(np.any(~mask))
    assert_same_bits("loss", loss(1.0 - mask.astype(np.float64), mask), float(sides))


@law("polarization", "pop_loss_vjp", members=members, v=st.sampled_from([1.0, 0.5, -2.0, 0.0]))
def test_the_prior_pulls_the_important_up_and_the_others_down_by_one_over_their_number(backend, members, v):
    o, mask = _columns(backend, members)
    n_important = int(np.sum(mask))
    expected = np.where(mask, -v / max(n_important, 1), v / max(len(mask) - n_important, 1))
    pulled = backend.stage("pop_loss_vjp")(o, mask, v)
    assert_close("polarization.gradient", pulled, expected, np.abs(expected), backend.dtype)


@law("polarization", "pop_loss", "pop_loss_vjp", opacity=opacities(), n=st.integers(1, 4), important=st.booleans())
def test_the_prior_is_finite_when_all_or_none_are_important(backend, opacity, n, important):
    o, mask = np.full(n, opacity), np.full(n, important)
    assert np.isfinite(backend.stage("pop_loss")(o, mask))
    assert np.all(np.isfinite(backend.stage("pop_loss_vjp")(o, mask, 1.0)))


@law("polarization", "pop_loss", "pop_loss_vjp")
def test_the_prior_of_no_gaussians_is_zero(backend):
    none = np.zeros(0), np.zeros(0, dtype=bool)
    assert_same_bits("loss", backend.stage("pop_loss")(*none), 0.0)
    assert backend.stage("pop_loss_vjp")(*none, 1.0).shape == (0,)


@law("polarization", "pop_loss", "pop_loss_vjp", members=members)
def test_restricting_the_prior_to_the_visible_is_the_prior_of_the_visible(backend, members):
    # the other reading of A12
    o, mask = _columns(backend, members)
    visible = np.arange(len(o)) % 2 == 0
    loss, pull = backend.stage("pop_loss"), backend.stage("pop_loss_vjp")
    assert_close("polarization.loss", loss(o, mask, visible), loss(o[visible], mask[visible]), 2.0, backend.dtype)
    pulled = pull(o, mask, 1.0, visible)
    assert_same_bits("gradient of the hidden", pulled[~visible], np.zeros(int(np.sum(~visible))))
    assert_close("polarization.gradient", pulled[visible], pull(o[visible], mask[visible], 1.0), 1.0, backend.dtype)


logits = st.lists(st.integers(-40, 40).map(lambda k: k / 4.0), max_size=8).map(lambda x: np.array(x, dtype=np.float64))


@law("polarization", "opacity_entropy", logits=logits)
def test_the_entropy_of_opacities_is_the_mean_of_what_each_leaves_open(backend, logits):
    o, rest = 1.0 / (1.0 + np.exp(-logits)), 1.0 / (1.0 + np.exp(logits))
    expected = float(np.sum(-o * np.log(o) - rest * np.log(rest))) / max(len(o), 1)
    assert_close("polarization.loss", backend.stage("opacity_entropy")(logits), expected, 2.0, backend.dtype)


@law("polarization", "opacity_entropy_vjp", logits=logits, v=st.sampled_from([1.0, 0.5, -2.0, 0.0]))
def test_the_entropy_pulls_every_opacity_to_the_pole_that_it_is_nearer_to(backend, logits, v):
    o, rest = 1.0 / (1.0 + np.exp(-logits)), 1.0 / (1.0 + np.exp(logits))
    expected = -v * logits * o * rest / max(len(o), 1)
    pulled = backend.stage("opacity_entropy_vjp")(logits, v)
    assert_close("polarization.gradient", pulled, expected, 4.0 * np.abs(expected), backend.dtype)


@law("polarization", "opacity_entropy", "opacity_entropy_vjp")
def test_the_entropy_at_the_poles_is_zero_and_pulls_nowhere(backend):
    poles = np.array([-800.0, 800.0])
    assert_same_bits("entropy", backend.stage("opacity_entropy")(poles), 0.0)
    assert_same_bits("gradient", np.abs(backend.stage("opacity_entropy_vjp")(poles, 1.0)), np.zeros(2))
