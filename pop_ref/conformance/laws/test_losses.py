"""Laws of what is minimised: L1, L2, SSIM and the two objectives (paper eqs. 2, 4, 9; B4), and the opacity prior.

Losses have masks, SSIM another border, and half of D-SSIM; the prior has its mask of importance (paper eqs. 7, 8).
"""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.capabilities import SCALE
from pop_ref.conformance.law import law
from pop_ref.conformance.scenes import pattern
from pop_ref.conformance.strategies import arrays_of, dyadic, opacities
from pop_ref.magnitudes import d_ssim_magnitudes, pixelwise_magnitudes

small = arrays_of((2, 3, 3), 0.0, 1.0)
large = st.integers(0, 255).map(lambda k: pattern(k, (13, 12, 3)))
SSIM_NAMES = ("ssim", "d_ssim")


@law("losses", "l1", "l2", image=small, target=small)
def test_losses_are_means_over_pixels_and_channels(backend, image, target):
    # L1 and L2 divide by 3 H W and carry no factor one half
    difference = image - target
    assert_close("losses.mean", backend.stage("l1")(image, target), np.mean(np.abs(difference)), 2.0, backend.dtype)
    assert_close("losses.mean", backend.stage("l2")(image, target), np.mean(difference**2), 4.0, backend.dtype)


@law("losses", "l1", "l2", image=small, target=small, shift=dyadic(-1.0, 1.0))
def test_losses_are_symmetric_and_see_differences_only(backend, image, target, shift):
    for name in ("l1", "l2"):
        loss = backend.stage(name)
        assert_same_bits(name, loss(target, image), loss(image, target))
        assert_same_bits(name, loss(image + shift, target + shift), loss(image, target))
        assert_same_bits(name, loss(image, image), 0.0)


@law("losses", "l1_vjp", "l2_vjp", image=small, target=small)
def test_the_gradients_of_l1_and_l2_are_those_that_the_paper_prints(backend, image, target):
    # eq. 4: sign(C - C*) / 3HW, which is 0 where they are equal (B4), and 2 (C - C*) / 3HW
    difference, n = image - target, image.size
    v_l1, v_l2 = backend.stage("l1_vjp")(image, target, 1.0), backend.stage("l2_vjp")(image, target, 1.0)
    assert_close("losses.gradient", v_l1, np.sign(difference) / n, 1.0 / n, backend.dtype)
    assert_close("losses.gradient", v_l2, 2.0 * difference / n, 2.0 / n, backend.dtype)


@law("losses", *SSIM_NAMES, image=large, target=large, padding=st.sampled_from(["valid", "same"]))
def test_similarity_is_symmetric_at_most_one_and_the_loss_is_its_complement(backend, image, target, padding):
    similarity = backend.stage("ssim")
    one, other = similarity(image, target, padding), similarity(target, image, padding)
    assert one <= 1.0 + 1e-6
    assert_close("losses.ssim", other, one, 1.0, backend.dtype)
    assert_close("losses.ssim", backend.stage("d_ssim")(image, target, padding), 1.0 - one, 2.0, backend.dtype)
    assert_close("losses.ssim", similarity(image, image, padding), 1.0, 1.0, backend.dtype)


@law("losses", *SSIM_NAMES, SCALE)
def test_a_large_picture_is_as_similar_as_its_halves_are(backend):
    # 288,000 values: more than a program compares at once; the halves share the ten rows that windows reach over
    image, target = np.random.default_rng(7).random((2, 320, 300, 3))
    for name in SSIM_NAMES:
        loss = backend.stage(name)
        halves = [loss(image[rows], target[rows], "valid") for rows in (slice(0, 165), slice(155, 320))]
        assert_close("losses.ssim", loss(image, target, "valid"), np.mean(halves), 2.0, backend.dtype)


@law("losses", "ssim", level=dyadic(0.0, 1.0), other=dyadic(0.0, 1.0))
def test_the_similarity_of_flat_pictures_is_the_luminance_term(backend, level, other):
    # variances vanish, so SSIM = (2 a b + C1) / (a^2 + b^2 + C1) with C1 = 0.01^2, everywhere where no border shows
    flat = np.ones((12, 11, 3))
    expected = (2.0 * level * other + 0.01**2) / (level**2 + other**2 + 0.01**2)
    found = backend.stage("ssim")(level * flat, other * flat, "valid")
    # the variance term divides rounding of the squares by C2 = 0.03^2
    size = 1.0 + (level**2 + other**2) / 0.03**2
    assert_close("losses.flat", found, expected, size, backend.dtype)


@law("losses", *SSIM_NAMES, image=large, target=large)
def test_channels_are_compared_one_by_one(backend, image, target):
    similarity = backend.stage("ssim")
    each = [similarity(image[..., k : k + 1].copy(), target[..., k : k + 1].copy()) for k in range(3)]
    size = 1.0 + 2.0 / 0.03**2
    assert_close("losses.flat", similarity(image, target), np.mean(each), size, backend.dtype)


@law(
    "losses",
    "photometric_3dgs",
    "photometric_pop",
    "l1",
    "l2",
    "d_ssim",
    image=large,
    target=large,
    share=dyadic(0.0, 1.0),
)
def test_the_objectives_mix_their_terms(backend, image, target, share):
    # eq. 2: (1 - s) L1 + s (1 - SSIM); eq. 9 without its last term: (1 - s) L2 + s (1 - SSIM)
    l1, l2, dissimilarity = (backend.stage(n)(image, target) for n in ("l1", "l2", "d_ssim"))
    of_3dgs = backend.stage("photometric_3dgs")(image, target, share)
    of_pop = backend.stage("photometric_pop")(image, target, share)
    assert_close("losses.mix", of_3dgs, (1.0 - share) * l1 + share * dissimilarity, 4.0, backend.dtype)
    assert_close("losses.mix", of_pop, (1.0 - share) * l2 + share * dissimilarity, 4.0, backend.dtype)


@law("losses", "photometric_3dgs", "photometric_pop", "l1", "l2", "d_ssim", image=large, target=large)
def test_the_default_shares_are_the_papers(backend, image, target):
    l1, l2, dissimilarity = (backend.stage(n)(image, target) for n in ("l1", "l2", "d_ssim"))
    defaults = (backend.stage("photometric_3dgs")(image, target), backend.stage("photometric_pop")(image, target))
    assert_close("losses.mix", defaults[0], 0.8 * l1 + 0.2 * dissimilarity, 4.0, backend.dtype)
    assert_close("losses.mix", defaults[1], 0.99 * l2 + 0.01 * dissimilarity, 4.0, backend.dtype)


ORACLE = OracleAdapter()
H, W = 11, 12
pictures = st.integers(0, 255).map(lambda k: pattern(k, (H, W, 2)))
paddings = st.sampled_from(["same", "valid"])
OBJECTIVES = {"photometric_3dgs": 1, "photometric_pop": 2}


def _mask(seed):
    """Return a mask that keeps a third of the pixels, all, none, or one in the middle."""
    some = pattern(seed, (H, W)) > 0.6
    one = np.zeros((H, W), dtype=bool)
    one[H // 2, W // 2] = True
    return (some, ~some, some, np.ones_like(some), ~some, one, some, np.zeros_like(some))[seed % 8]


masks = st.integers(0, 63).map(_mask)


def _similarity_error_bounds(image, target, padding, mask):
    """Bound the rounding of D-SSIM and its gradient for whoever writes it as the textbook does, or as a difference."""
    forms = [d_ssim_magnitudes(image, target, padding, mask, form) for form in ("textbook", "difference")]
    return max(form.value for form in forms) + 1.0, np.maximum(*[form.gradient for form in forms])


def _agrees(backend, name, image, target, error_bounds, arguments):
    image, target = (a.astype(backend.dtype).astype(np.float64) for a in (image, target))
    of_value, of_gradient = error_bounds
    expected = ORACLE.stage(name)(image, target, *arguments)
    found = backend.stage(name)(image, target, *arguments)
    assert_close("agreement.losses", found, expected, of_value, backend.dtype, against_oracle=True)
    pulled = ORACLE.stage(f"{name}_vjp")(image, target, 0.75, *arguments)
    found = backend.stage(f"{name}_vjp")(image, target, 0.75, *arguments)
    # one unit of a pixel's share on top of its own error bound: a gradient may vanish where its terms cancel
    size = of_gradient + 1.0 / image.size
    assert_close("agreement.losses_vjp", found, pulled, size, backend.dtype, against_oracle=True)


@law("losses", "ssim", "ssim_vjp", image=pictures, target=pictures, padding=paddings)
def test_the_similarity_and_its_gradient_are_the_oracles_with_either_border(backend, image, target, padding):
    error_bounds = _similarity_error_bounds(image, target, padding, None)
    _agrees(backend, "ssim", image, target, error_bounds, (padding,))


@law(
    "losses",
    "d_ssim",
    "d_ssim_vjp",
    image=pictures,
    target=pictures,
    padding=paddings,
    mask=masks,
    halved=st.booleans(),
)
def test_the_dissimilarity_of_what_a_mask_keeps_is_the_oracles(backend, image, target, padding, mask, halved):
    error_bounds = _similarity_error_bounds(image, target, padding, mask)
    _agrees(backend, "d_ssim", image, target, error_bounds, (padding, mask, halved))


@law("losses", "l1", "l2", "l1_vjp", "l2_vjp", image=pictures, target=pictures, mask=masks)
def test_pixelwise_losses_of_what_a_mask_keeps_are_the_oracles(backend, image, target, mask):
    for power, name in ((1, "l1"), (2, "l2")):
        error_bounds = pixelwise_magnitudes(image, target, power, mask)
        _agrees(backend, name, image, target, error_bounds, (mask,))


@law(
    "losses",
    *OBJECTIVES,
    *(f"{name}_vjp" for name in OBJECTIVES),
    image=pictures,
    target=pictures,
    padding=paddings,
    mask=masks,
    halved=st.booleans(),
    share=dyadic(0.0, 1.0),
    scale=st.sampled_from([1.0, 0.5, 3.0]),
)
def test_the_objectives_with_every_option_are_the_oracles(backend, image, target, padding, mask, halved, share, scale):
    of_value, of_gradient = _similarity_error_bounds(image, target, padding, mask)
    for name, power in OBJECTIVES.items():
        pixels = pixelwise_magnitudes(image, target, power, mask)
        error_bounds = of_value + scale * pixels.value, of_gradient + scale * pixels.gradient
        _agrees(backend, name, image, target, error_bounds, (share, padding, mask, halved, scale))


def _large(seed):
    """Return a picture over several blocks of any implementation, of four channels, with numbers below 0 and over 1."""
    return 2.0 * pattern(seed, (70, 50, 4)) - 0.5


@law("losses", "d_ssim", "d_ssim_vjp")
def test_the_dissimilarity_of_large_pictures_beyond_black_and_white_is_the_oracles(backend):
    kept = pattern(3, (70, 50)) > 0.3
    for seed, (padding, mask) in enumerate((("valid", None), ("same", None), ("valid", kept))):
        image, target = _large(4 * seed + 1), _large(4 * seed + 2)
        error_bounds = _similarity_error_bounds(image, target, padding, mask)
        _agrees(backend, "d_ssim", image, target, error_bounds, (padding, mask, False))


@law("losses", *OBJECTIVES, *(f"{name}_vjp" for name in OBJECTIVES))
def test_the_objectives_of_large_pictures_beyond_black_and_white_are_the_oracles(backend):
    image, target, arguments = _large(5), _large(6), (0.25, "valid", None, False, 1.0)
    of_value, of_gradient = _similarity_error_bounds(image, target, "valid", None)
    for name, power in OBJECTIVES.items():
        pixels = pixelwise_magnitudes(image, target, power, None)
        error_bounds = of_value + pixels.value, of_gradient + pixels.gradient
        _agrees(backend, name, image, target, error_bounds, arguments)


@law("losses", "d_ssim_vjp", "l1_vjp", "l2_vjp", image=pictures, target=pictures, mask=masks, padding=paddings)
def test_what_a_mask_leaves_out_has_no_gradient_and_no_say(backend, image, target, mask, padding):
    other = np.where(mask[..., None], image, 1.0 - image)
    for name, more in (("l1_vjp", (mask,)), ("l2_vjp", (mask,)), ("d_ssim_vjp", (padding, mask))):
        pulled = backend.stage(name)(image, target, 1.0, *more)
        assert_same_bits(f"{name} where the mask is False", pulled[~mask], 0.0 * pulled[~mask])
        assert_same_bits(name, backend.stage(name)(other, target, 1.0, *more), pulled)


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


@law("polarization", "opacity_entropy", logits=logits, first=[{"logits": np.zeros(0)}])
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
