"""Laws of the photometric losses: L1, L2, SSIM and the two objectives (paper eqs. 2, 4, 9; B4)."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.capabilities import SCALE
from pop_ref.conformance.law import law
from pop_ref.conformance.scenes import pattern
from pop_ref.conformance.strategies import arrays_of, dyadic

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
