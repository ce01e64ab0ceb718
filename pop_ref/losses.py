"""L1, L2, and the two photometric objectives, each with its transpose; SSIM itself is in `ssim`.

A mask (True = keep) acts the same way in every loss: the render is replaced by the photograph where the mask is False,
and the mean runs over the kept pixels only (for SSIM: over the windows whose centre is kept). A pixel that is left out
thus has no loss and no gradient, and a mask that keeps nothing gives loss 0.

Labels decided here: B4 (sign of zero), A10 (no 1/2 in L2), A28 (`l1_scale`); A11 is decided in `ssim`.
"""

from __future__ import annotations

import numpy as np

from pop_ref._shapes import Bool, Float64
from pop_ref.settings import LAMBDA_SSIM_3DGS, Recipe
from pop_ref.ssim import Padding, d_ssim, d_ssim_vjp, replace_left_out, ssim, ssim_map, ssim_vjp

__all__ = ["Padding", "l1", "l1_vjp", "l2", "l2_vjp", "ssim", "ssim_map", "ssim_vjp", "d_ssim", "d_ssim_vjp"]
__all__ += ["photometric_3dgs", "photometric_3dgs_vjp", "photometric_pop", "photometric_pop_vjp"]


def l1(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    mask: Bool[np.ndarray, "H W"] | None = None,
) -> float:
    """Average the absolute difference: `mean |image - target|` over pixels and channels.

    Source: Kerbl et al. 2023, the L1 term of the training objective (POP paper eq. 2).
    Departs: nothing.

    Args:
        image: the render, encoded rgb, not clamped.
        target: the photograph in [0, 1].
        mask: True where a pixel counts: the mean is over those alone, 0 if there are none; None keeps all.

    Returns:
        The loss, >= 0.

    Raises:
        ValueError: the shapes differ.

    Example:
        >>> l1(np.full((2, 2, 3), 0.75), np.full((2, 2, 3), 0.25))
        0.5
    """
    difference = replace_left_out(image, target, mask) - target
    return float(np.sum(np.abs(difference)) / _n_kept(image, mask))


def l1_vjp(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    v_l1: float,
    mask: Bool[np.ndarray, "H W"] | None = None,
) -> Float64[np.ndarray, "H W D"]:
    """Pull a cotangent of `l1` back to the render: `v sign(image - target) / (H W D)`.

    At equality the derivative is 0, the mean of the two one-sided ones (B4), so sign(0) = 0.

    Source: POP paper eq. 4, left.
    Departs: nothing; torch uses sign(0) = 0 as well.

    Args:
        image: the render.
        target: the photograph.
        v_l1: cotangent of the loss.
        mask: True where a pixel counts; the others get 0.

    Returns:
        Cotangent of the render.

    Raises:
        ValueError: the shapes differ.

    Example:
        >>> l1_vjp(np.full((1, 2, 1), 0.75), np.array([[[0.25], [0.75]]]), 1.0).tolist()
        [[[0.5], [0.0]]]
    """
    difference = replace_left_out(image, target, mask) - target
    return v_l1 * np.sign(difference) / _n_kept(image, mask)


def l2(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    mask: Bool[np.ndarray, "H W"] | None = None,
) -> float:
    """Average the squared difference: `mean (image - target)²` over pixels and channels, without a 1/2 (A10).

    Source: POP paper section 3.3; its normalisation is the one whose gradient eq. 4 prints.
    Departs: nothing.

    Args:
        image: the render, encoded rgb, not clamped.
        target: the photograph in [0, 1].
        mask: True where a pixel counts: the mean is over those alone, 0 if there are none; None keeps all.

    Returns:
        The loss, >= 0.

    Raises:
        ValueError: the shapes differ.

    Example:
        >>> l2(np.full((2, 2, 3), 0.75), np.full((2, 2, 3), 0.25))
        0.25
    """
    difference = replace_left_out(image, target, mask) - target
    return float(np.sum(difference**2) / _n_kept(image, mask))


def l2_vjp(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    v_l2: float,
    mask: Bool[np.ndarray, "H W"] | None = None,
) -> Float64[np.ndarray, "H W D"]:
    """Pull a cotangent of `l2` back to the render: `2 v (image - target) / (H W D)`.

    Source: POP paper eq. 4, right.
    Departs: nothing.

    Args:
        image: the render.
        target: the photograph.
        v_l2: cotangent of the loss.
        mask: True where a pixel counts; the others get 0.

    Returns:
        Cotangent of the render.

    Raises:
        ValueError: the shapes differ.

    Example:
        >>> l2_vjp(np.full((1, 2, 1), 0.75), np.array([[[0.25], [0.75]]]), 1.0).tolist()
        [[[0.5], [0.0]]]
    """
    difference = replace_left_out(image, target, mask) - target
    return v_l2 * 2.0 * difference / _n_kept(image, mask)


def photometric_3dgs(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    lambda_ssim: float = LAMBDA_SSIM_3DGS,
    padding: Padding = "valid",
    mask: Bool[np.ndarray, "H W"] | None = None,
    halved: bool = False,
    l1_scale: float = 1.0,
) -> float:
    """Weigh L1 against D-SSIM: `(1 - lambda_ssim) l1 + lambda_ssim d_ssim`.

    Source: POP paper eq. 2; Kerbl et al. 2023, lambda 0.2.
    Departs: gsplat crops the SSIM map ("valid", the default here), Inria zero-pads ("same").

    Args:
        image: the render, encoded rgb, not clamped.
        target: the photograph in [0, 1].
        lambda_ssim: weight of D-SSIM, in [0, 1].
        padding: SSIM's border, "valid" or "same".
        mask: True where a pixel counts.
        halved: D-SSIM as (1 - SSIM) / 2 (A11).
        l1_scale: factor on L1 (A28: 1/n draws the paper's "div=n" figure).

    Returns:
        The loss, >= 0.

    Raises:
        ValueError: the shapes differ, or the image is too small for "valid".

    Example:
        >>> photometric_3dgs(np.full((11, 11, 3), 0.5), np.zeros((11, 11, 3)), lambda_ssim=0.0)
        0.5
    """
    pixelwise = l1_scale * l1(image, target, mask)
    return (1.0 - lambda_ssim) * pixelwise + lambda_ssim * d_ssim(image, target, padding, mask, halved)


def photometric_3dgs_vjp(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    v_loss: float,
    lambda_ssim: float = LAMBDA_SSIM_3DGS,
    padding: Padding = "valid",
    mask: Bool[np.ndarray, "H W"] | None = None,
    halved: bool = False,
    l1_scale: float = 1.0,
) -> Float64[np.ndarray, "H W D"]:
    """Pull a cotangent of `photometric_3dgs` back to the render.

    Source: derivative of eq. 2.
    Departs: sign(0) = 0 (B4).

    Args:
        image: the render.
        target: the photograph.
        v_loss: cotangent of the loss.
        lambda_ssim: weight of D-SSIM.
        padding: SSIM's border.
        mask: True where a pixel counts.
        halved: D-SSIM as (1 - SSIM) / 2 (A11).
        l1_scale: factor on L1.

    Returns:
        Cotangent of the render.

    Raises:
        ValueError: as `photometric_3dgs`.

    Example:
        >>> photometric_3dgs_vjp(np.ones((11, 11, 3)), np.zeros((11, 11, 3)), 363.0, lambda_ssim=0.0)[5, 5].tolist()
        [1.0, 1.0, 1.0]
    """
    v_pixelwise = l1_vjp(image, target, v_loss * (1.0 - lambda_ssim) * l1_scale, mask)
    return v_pixelwise + d_ssim_vjp(image, target, v_loss * lambda_ssim, padding, mask, halved)


def photometric_pop(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    lambda_ssim: float = Recipe.lambda_ssim,
    padding: Padding = "valid",
    mask: Bool[np.ndarray, "H W"] | None = None,
    halved: bool = False,
    l2_scale: float = 1.0,
) -> float:
    """Weigh L2 against D-SSIM: `(1 - lambda_ssim) l2 + lambda_ssim d_ssim`.

    Source: POP paper eq. 9 without its POP term (see `polarization`), lambda 0.01 from section 3.4.
    Departs: nothing; the SSIM is gsplat's ("valid"), on which the paper builds.

    Args:
        image: the render, encoded rgb, not clamped.
        target: the photograph in [0, 1].
        lambda_ssim: weight of D-SSIM, in [0, 1].
        padding: SSIM's border, "valid" or "same".
        mask: True where a pixel counts.
        halved: D-SSIM as (1 - SSIM) / 2 (A11).
        l2_scale: factor on L2 (A10: 1/2 halves the mean square, 3 sums over rgb).

    Returns:
        The loss, >= 0.

    Raises:
        ValueError: the shapes differ, or the image is too small for "valid".

    Example:
        >>> photometric_pop(np.full((11, 11, 3), 0.5), np.zeros((11, 11, 3)), lambda_ssim=0.0)
        0.25
    """
    pixelwise = l2_scale * l2(image, target, mask)
    return (1.0 - lambda_ssim) * pixelwise + lambda_ssim * d_ssim(image, target, padding, mask, halved)


def photometric_pop_vjp(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    v_loss: float,
    lambda_ssim: float = Recipe.lambda_ssim,
    padding: Padding = "valid",
    mask: Bool[np.ndarray, "H W"] | None = None,
    halved: bool = False,
    l2_scale: float = 1.0,
) -> Float64[np.ndarray, "H W D"]:
    """Pull a cotangent of `photometric_pop` back to the render.

    Source: derivative of eq. 9.
    Departs: nothing.

    Args:
        image: the render.
        target: the photograph.
        v_loss: cotangent of the loss.
        lambda_ssim: weight of D-SSIM.
        padding: SSIM's border.
        mask: True where a pixel counts.
        halved: D-SSIM as (1 - SSIM) / 2 (A11).
        l2_scale: factor on L2.

    Returns:
        Cotangent of the render.

    Raises:
        ValueError: as `photometric_pop`.

    Example:
        >>> photometric_pop_vjp(np.ones((11, 11, 3)), np.zeros((11, 11, 3)), 363.0, lambda_ssim=0.0)[5, 5].tolist()
        [2.0, 2.0, 2.0]
    """
    v_pixelwise = l2_vjp(image, target, v_loss * (1.0 - lambda_ssim) * l2_scale, mask)
    return v_pixelwise + d_ssim_vjp(image, target, v_loss * lambda_ssim, padding, mask, halved)


def _n_kept(image: np.ndarray, mask: np.ndarray | None) -> int:
    """Count the values that the mean runs over, at least 1."""
    height, width, channels = image.shape
    return max(1, (height * width if mask is None else int(np.sum(mask))) * channels)
