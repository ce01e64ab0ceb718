"""Taming-3DGS: how many Gaussians there may be when, and which of the candidates grow.

A training may hold A(x) Gaussians after its x-th densification step, a parabola that starts steeply and ends level.
The candidates that fill it are drawn with a probability proportional to a score, nine terms summed over a few views:
each term is a quantity divided by its median and weighed, so that terms of different units can be added.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from pop_ref._shapes import Bool, Float64, Int64
from pop_ref.constants import INRIA, Profile
from pop_ref.contributions import Contributions, contributions
from pop_ref.losses import photometric_3dgs
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render

# weights of the nine terms, of the view and of the two halves of the pixel map
GRAD, OPACITY, DEPTH, RADIUS, SCALE = 25.0, 100.0, 5.0, 10.0, 25.0
DISTANCE, LOSS, COUNT, BLEND = 50.0, 10.0, 0.1, 50.0
VIEW: Final = 50.0
ERROR: Final = 50.0
EDGE: Final = 50.0

# of "L" images: 0.299, 0.587, 0.114 in units of 2^-16
_LUMA: Final = (19595, 38470, 7471)


def budget_at(nth: int, n: int, start: int, target: int) -> int:
    """Say how many Gaussians there may be after a densification step: `floor(S + (B - S) (1 - (1 - x / n)^2))`.

    Source: Mallick et al. 2024 (Taming-3DGS), the budget's parabola.
    Departs: nothing; computed in integers.

    Args:
        nth: x, which densification step it is, from 0 (before the first) to n.
        n: densification steps in all, (15000 - 500) // interval in the code.
        start: S, Gaussians at the start.
        target: B, Gaussians at the end.

    Returns:
        A(x), from S at 0 to B at n.

    Raises:
        ValueError: nth lies outside 0 to n, or there are none.

    Example:
        >>> [budget_at(x, 4, 1000, 2600) for x in range(5)]
        [1000, 1700, 2200, 2500, 2600]
    """
    if n < 1 or not 0 <= nth <= n:
        raise ValueError(f"nth is {nth} of {n}; it must be in 0 to n, and n >= 1")
    return start + (target - start) * (2 * n * nth - nth * nth) // (n * n)


def edge_map(photo: np.ndarray) -> Float64[np.ndarray, "H W"]:
    """Find the edges of a photograph: its grey values under a 3 x 3 Laplacian, `8 centre - sum of the 8 around it`.

    Grey is `(19595 R + 38470 G + 7471 B + 2^15) >> 16`. The result is cut to 0 to 255.

    Source: Mallick et al. 2024 (Taming-3DGS), and its code: Pillow's `convert("L")` and `FIND_EDGES`.
    Departs: nothing; as in Pillow the outermost pixels keep their grey values, whose neighbourhood is not whole, and
        so count as edges where they are bright.

    Args:
        photo: 8-bit rgb, uint8 [H, W, 3].

    Returns:
        Whole numbers from 0 to 255.

    Raises:
        ValueError: the photograph is not uint8 [H, W, 3].

    Example:
        >>> photo = np.zeros((3, 3, 3), dtype=np.uint8)
        >>> photo[1, 1] = 16
        >>> edge_map(photo)
        array([[  0.,   0.,   0.],
               [  0., 128.,   0.],
               [  0.,   0.,   0.]])
    """
    if photo.dtype != np.uint8 or photo.ndim != 3 or photo.shape[2] != 3:
        raise ValueError(f"photo is {photo.dtype} {list(photo.shape)}; it must be uint8 [H, W, 3]")
    grey = (photo.astype(np.int64) @ np.array(_LUMA) + (1 << 15)) >> 16
    edges = grey.astype(np.float64)
    for y in range(1, grey.shape[0] - 1):
        for x in range(1, grey.shape[1] - 1):
            neighbourhood = int(np.sum(grey[y - 1 : y + 2, x - 1 : x + 2]))
            edges[y, x] = min(max(9 * int(grey[y, x]) - neighbourhood, 0), 255)
    return edges


def pixel_weights(
    image: Float64[np.ndarray, "H W 3"], photo: np.ndarray, mask: Bool[np.ndarray, "H W"] | None = None
) -> Float64[np.ndarray, "H W"]:
    """Weigh a view's pixels: `50 minmax(mean_c |C - photo|) + 50 minmax(edges)`, `minmax(x) = (x - min) / (max - min)`.

    Source: Mallick et al. 2024 (Taming-3DGS), and its code.
    Departs: where all pixels are alike the code divides by 0; here such a map is 0. The code has no masks: here min and
        max are of what a mask keeps, and the rest weighs nothing.

    Args:
        image: the render, encoded rgb, not clamped.
        photo: the photograph, uint8 [H, W, 3].
        mask: True where a pixel counts; None keeps all.

    Returns:
        Weights from 0 to 100.

    Raises:
        ValueError: the photograph is not uint8 [H, W, 3], or the shapes differ.

    Example:
        >>> pixel_weights(np.array([[[0.0, 0.0, 0.0], [0.5, 0.5, 0.5]]]), np.zeros((1, 2, 3), dtype=np.uint8))
        array([[ 0., 50.]])
    """
    edges = edge_map(photo)
    if image.shape != photo.shape:
        raise ValueError(f"image has shape {list(image.shape)}, photo {list(photo.shape)}; they must be the same")
    error = np.mean(np.abs(image - photo / 255.0), axis=2)
    return ERROR * _minmax(error, mask) + EDGE * _minmax(edges, mask)


def scaled_to_median(c: float, x: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
    """Bring a quantity to the size of its weight: `c x / median(x over x > 0)`, 0 where `x <= 0`.

    Source: Mallick et al. 2024 (Taming-3DGS), and its code.
    Departs: the paper does not say how terms are made comparable. Of an even number of values the median is the lower
        of the middle two, torch's convention.

    Args:
        c: weight of the term.
        x: the quantity.

    Returns:
        The term, >= 0.

    Example:
        >>> scaled_to_median(8.0, np.array([2.0, 0.0, 4.0, 1.0, 8.0])).tolist()
        [8.0, 0.0, 16.0, 4.0, 32.0]
    """
    ascending = sorted(value for value in x.tolist() if value > 0.0)
    if not ascending:
        return np.zeros(len(x))
    return np.where(x > 0.0, c * (x / ascending[(len(ascending) - 1) // 2]), 0.0)


def view_score(
    photometric: float,
    grads: Float64[np.ndarray, " N"],
    opacities: Float64[np.ndarray, " N"],
    scales: Float64[np.ndarray, "N 3"],
    depths: Float64[np.ndarray, " N"],
    radii: Int64[np.ndarray, "N 2"],
    found: Contributions,
) -> Float64[np.ndarray, " N"]:
    """Score the Gaussians that one view shows: fifty times its loss times nine terms, each scaled to its median.

    `50 P (nrm(25, grad) + nrm(100, o) + nrm(5, depth) + nrm(10, radius) + nrm(25, sx sy sz) + nrm(50, distance_sum) +
    nrm(10, map_sum) + nrm(0.1, n_pixels) + nrm(50, weight_sum))` with `nrm` = `scaled_to_median`, 0 for what the view
    does not show. Depths and radii are those of what it shows; medians of the other terms run over all.

    Source: Mallick et al. 2024 (Taming-3DGS), the score; the weights are the code's.
    Departs: nothing.

    Args:
        photometric: P, the view's loss 0.8 L1 + 0.2 D-SSIM, of what its mask keeps.
        grads: average view-space gradients of the window (`density.average_grads`).
        opacities: activated.
        scales: standard deviations, activated, world units.
        depths: camera z, world units.
        radii: extents, px; 0 where the view does not show the Gaussian. The larger of the two counts.
        found: sums over the view's pixels, `map_sum` of `pixel_weights`.

    Returns:
        The view's part of the score, >= 0.

    Example:
        >>> one, found = np.ones(1), Contributions(np.ones(1), np.array([1]), np.ones(1), np.ones(1))
        >>> view_score(0.5, one, one, np.ones((1, 3)), one, np.array([[1, 1]]), found).item() / 25.0
        275.1
    """
    visible = np.all(radii > 0, axis=1)
    terms = (
        scaled_to_median(GRAD, grads)
        + scaled_to_median(OPACITY, opacities)
        + scaled_to_median(DEPTH, np.where(visible, depths, 0.0))
        + scaled_to_median(RADIUS, np.where(visible, np.max(radii, axis=1, initial=0), 0).astype(np.float64))
        + scaled_to_median(SCALE, scales[:, 0] * scales[:, 1] * scales[:, 2])
        + scaled_to_median(DISTANCE, found.distance_sum)
        + scaled_to_median(LOSS, found.map_sum)
        + scaled_to_median(COUNT, found.n_pixels.astype(np.float64))
        + scaled_to_median(BLEND, found.weight_sum)
    )
    return np.where(visible, VIEW * photometric * terms, 0.0)


def taming_scores(
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, np.ndarray]],
    grads: Float64[np.ndarray, " N"],
    background: Float64[np.ndarray, "3"] | None = None,
    sh_degree: int | None = None,
    profile: Profile = INRIA,
    masks: Sequence[np.ndarray | None] | None = None,
) -> Float64[np.ndarray, " N"]:
    """Score Gaussians by a few views: render each, weigh its pixels, sum what each Gaussian adds, add the scores.

    Source: Mallick et al. 2024 (Taming-3DGS).
    Departs: the code has no masks. What one leaves out is in no loss, neither P nor the weights of pixels; the sums of
        pixels, distances and blending weights are over all.

    Args:
        gaussians: activated.
        views: cameras and their photographs, uint8 [H, W, 3].
        grads: average view-space gradients of the window.
        background: colour behind everything, default black.
        sh_degree: bands in use, default all.
        profile: of the renderer.
        masks: of each view, True where a pixel counts [H, W], or None; None for no masks.

    Returns:
        The scores, >= 0; 0 where no view shows the Gaussian.

    Raises:
        ValueError: a photograph is not uint8 or not of its camera's size.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> camera = Camera(np.eye(4), np.array([[8.0, 0.0, 0.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]]), 2, 2)
        >>> taming_scores(g, [(camera, np.zeros((2, 2, 3), dtype=np.uint8))], np.zeros(1)).shape
        (1,)
    """
    scores = np.zeros(len(gaussians))
    for (camera, photo), mask in zip(views, masks or [None] * len(views), strict=True):
        drawn = render(gaussians, camera, background, sh_degree, profile)
        weights = pixel_weights(drawn.image, photo, mask)
        found = contributions(
            drawn.splats, drawn.tile_lists, camera.width, camera.height, profile.tile_size, weights, profile
        )
        photometric = photometric_3dgs(drawn.image, photo / 255.0, padding="same", mask=mask)
        scores = scores + view_score(
            photometric, grads, gaussians.opacities, gaussians.scales, drawn.splats.depths, drawn.splats.radii, found
        )
    return scores


def quotas(budget: int, n: int, n_clone: int, n_split: int) -> tuple[int, int]:
    """Share what the budget leaves among the two kinds of candidates, in proportion to their numbers.

    With `more = min(A, N + n_clone + n_split) - N`: `floor(more n_clone / (n_clone + n_split))`, and so for splits.

    Source: Mallick et al. 2024 (Taming-3DGS), and its code.
    Departs: over the budget none is grown; the code asks for a negative number.

    Args:
        budget: A, as `budget_at` gives it.
        n: Gaussians now.
        n_clone: candidates that would be cloned.
        n_split: candidates that would be split.

    Returns:
        How many to clone, how many to split.

    Example:
        >>> quotas(107, 100, 10, 5), quotas(1000, 100, 10, 5), quotas(90, 100, 10, 5)
        ((4, 2), (10, 5), (0, 0))
    """
    n_candidates = n_clone + n_split
    more = max(min(budget, n + n_candidates) - n, 0)
    return more * n_clone // max(n_candidates, 1), more * n_split // max(n_candidates, 1)


def _minmax(x: Float64[np.ndarray, "H W"], mask: Bool[np.ndarray, "H W"] | None) -> Float64[np.ndarray, "H W"]:
    kept = np.ones(x.shape, dtype=bool) if mask is None else mask
    least, greatest = float(np.min(x[kept], initial=np.inf)), float(np.max(x[kept], initial=-np.inf))
    return np.where(kept, (x - least) / (greatest - least), 0.0) if greatest > least else np.zeros_like(x)
