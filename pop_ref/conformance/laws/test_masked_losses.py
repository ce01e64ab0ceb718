"""Laws of what the photometric losses offer beside their defaults: masks, SSIM's other border, half of D-SSIM."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.scenes import pattern
from pop_ref.conformance.strategies import dyadic
from pop_ref.magnitudes import d_ssim_magnitudes, pixelwise_magnitudes

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
    # one unit of a pixel's share beside its own error bound: a gradient may vanish where its terms cancel
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
