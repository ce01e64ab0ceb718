"""Adaptive density control: what is counted, what is selected, and the densification step that edits the Gaussians.

Between two densification steps each view adds to the window's statistics. At a densification step

    grad set   average view-space gradient > tau_Den              (eq. 3)
    blur set   dominates more than theta H W pixels of a view     (eq. 6), inside the blur window only
    grow       selected and small -> clone; selected and large -> split
    prune      opacity too low, or far too large
    forget     the window's statistics start again from zero (A3: row identities changed)

Steps count from 0 as in gsplat: the densification step of step s follows the Adam update of step s.

The row operations are in `density_rows`, the constants in `settings`; both are re-exported here.

Labels decided here: A2, A3, A4, A8, A14, A16, A17, A18, A23; which reading is taken is a field of `DensityConfig`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pop_ref._shapes import Bool, Float64, Int64
from pop_ref.activations import opacities_from_logits, scales_from_log_scales
from pop_ref.density_rows import Rows, clone_rows, prune_rows, reset_opacities, rows_from_params, split_rows
from pop_ref.settings import GSPLAT, POP, DensityConfig

__all__ = ["GSPLAT", "POP", "DensityConfig", "blurs_at", "densifies_at", "resets_at"]
__all__ += ["Rows", "rows_from_params", "clone_rows", "split_rows", "prune_rows", "reset_opacities"]
__all__ += ["Statistics", "zero_statistics", "accumulate", "average_grads", "blur_set"]
__all__ += ["grow_masks", "prune_mask", "densify_and_prune"]


@dataclass(frozen=True)
class Statistics:
    """What the views since the last densification step have shown.

    Attributes:
        grad_sum: sum of view-space gradient norms, NDC units. [N]
        n_visible: views that showed the Gaussian. [N]
        n_views: views of the window.
        dominant_sum: pixels dominated, over all views of the window. [N]
        blurred: the blur flag, see `DensityConfig.blur_window`. [N]
    """

    grad_sum: Float64[np.ndarray, " N"]
    n_visible: Int64[np.ndarray, " N"]
    n_views: int
    dominant_sum: Int64[np.ndarray, " N"]
    blurred: Bool[np.ndarray, " N"]


def zero_statistics(n: int) -> Statistics:
    """Start a window: nothing seen.

    Source: Kerbl et al. 2023, section 5.2.
    Departs: nothing.

    Args:
        n: number of Gaussians.

    Returns:
        Statistics of no views.

    Example:
        >>> zero_statistics(2).n_visible.tolist()
        [0, 0]
    """
    counts = np.zeros(n, dtype=np.int64)
    return Statistics(np.zeros(n), counts, 0, counts.copy(), np.zeros(n, dtype=bool))


def blur_set(
    dominant_counts: Int64[np.ndarray, " N"],
    width: int,
    height: int,
    theta_blur: float,
    min_pixels: float = 0.0,
    kept_pixels: int | None = None,
) -> Bool[np.ndarray, " N"]:
    """Select the Gaussians that dominate more of an image than a point should: `D > max(theta H W, min)`, strictly.

    Source: POP paper eq. 6; theta 2e-5, one tenth of Mini-Splatting's.
    Departs: the paper has no least number of pixels (`DensityConfig.blur_min_pixels`), which is 0 unless asked for, and
        no masks.

    Args:
        dominant_counts: pixels that each Gaussian dominates.
        width: of the view, px (A18: each view's own size).
        height: of the view, px.
        theta_blur: share of the pixels.
        min_pixels: and at least so many of them.
        kept_pixels: how many of the view's pixels count, where a mask leaves some out; None for all. Dominant counts
            are then those of the kept ones, and so is the share.

    Returns:
        True where a Gaussian is blurred.

    Example:
        >>> blur_set(np.array([2, 3]), width=16, height=8, theta_blur=1 / 64).tolist()
        [False, True]
    """
    n_pixels = height * width if kept_pixels is None else kept_pixels
    return dominant_counts > max(theta_blur * n_pixels, min_pixels)


def accumulate(
    statistics: Statistics,
    v_means2d: Float64[np.ndarray, "N 2"],
    visible: Bool[np.ndarray, " N"],
    dominant_counts: Int64[np.ndarray, " N"],
    width: int,
    height: int,
    config: DensityConfig = POP,
    kept_pixels: int | None = None,
) -> Statistics:
    """Add one view to the window.

    `grad_sum += |(W/2 v_x, H/2 v_y)|` for what the view shows: a gradient by px becomes one by NDC in [-1, 1], because
    an image is 2 wide there. The norm is taken of the gradient summed over pixels, view by view.

    Source: POP paper eqs. 3 (sum) and 6 (blur set).
    Departs: eq. 3 does not name the unit; NDC is what Inria emits and gsplat rescales to.

    Args:
        statistics: the window so far.
        v_means2d: gradient of the loss by the screen centres, per px.
        visible: True where the view shows the Gaussian (extents > 0).
        dominant_counts: pixels that each Gaussian dominates in this view, of those that count.
        width: of the view, px.
        height: of the view, px.
        config: says how the blur flags of several views combine (A2).
        kept_pixels: how many of the view's pixels count, where a mask leaves some out; None for all.

    Returns:
        The window with this view.

    Example:
        >>> s = accumulate(zero_statistics(1), np.array([[0.75, 1.0]]), np.array([True]), np.array([1]), 8, 8)
        >>> s.grad_sum.tolist(), s.n_visible.tolist(), s.blurred.tolist()
        ([5.0], [1], [True])
    """
    grads = np.sqrt((0.5 * width * v_means2d[:, 0]) ** 2 + (0.5 * height * v_means2d[:, 1]) ** 2)
    dominant_sum = statistics.dominant_sum + dominant_counts
    tested = dominant_sum if config.blur_window == "sum" else dominant_counts
    blurred = blur_set(tested, width, height, config.theta_blur, config.blur_min_pixels, kept_pixels)
    if config.blur_window == "any_view":
        blurred = blurred | statistics.blurred
    return Statistics(
        grad_sum=statistics.grad_sum + np.where(visible, grads, 0.0),
        n_visible=statistics.n_visible + visible,
        n_views=statistics.n_views + 1,
        dominant_sum=dominant_sum,
        blurred=blurred,
    )


def average_grads(statistics: Statistics, config: DensityConfig = POP) -> Float64[np.ndarray, " N"]:
    """Average the window's gradient norms: `grad_sum / n_visible`, 0 for a Gaussian that no view showed.

    Source: POP paper eq. 3.
    Departs: eq. 3 divides by the window's length V; both code bases divide by the views that showed the Gaussian, and
        that is the default (A23).

    Args:
        statistics: the window.
        config: names the denominator.

    Returns:
        Average gradient norms, NDC units.

    Example:
        >>> from dataclasses import replace
        >>> s = replace(zero_statistics(2), grad_sum=np.array([1.0, 0.0]), n_visible=np.array([2, 0]), n_views=4)
        >>> average_grads(s).tolist(), average_grads(s, DensityConfig(grad_denominator="window")).tolist()
        ([0.5, 0.0], [0.25, 0.0])
    """
    if config.grad_denominator == "window":
        return statistics.grad_sum / max(statistics.n_views, 1)
    return statistics.grad_sum / np.maximum(statistics.n_visible, 1)


def grow_masks(
    statistics: Statistics,
    scales: Float64[np.ndarray, "N 3"],
    scene_scale: float,
    step: int,
    config: DensityConfig = POP,
) -> tuple[Bool[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """Decide which Gaussians are cloned and which are split.

    A Gaussian is small if its largest scale is at most `grow_scale3d * scene_scale`. The grad set, joined inside the
    blur window by the blur set (A8), is cloned where small and split where not (A14). Under "split" blurred
    Gaussians are split whatever their size, so one that is small with a high gradient is cloned and split.

    Source: POP paper eqs. 3 and 6, section 3.3 ("choose between cloning and splitting based on scale").
    Departs: nothing.

    Args:
        statistics: the window.
        scales: standard deviations, activated, world units.
        scene_scale: world units.
        step: of the densification step, from 0.
        config: thresholds and readings.

    Returns:
        True where a row is cloned; True where a row is split.

    Example:
        >>> from dataclasses import replace
        >>> s = replace(zero_statistics(3), grad_sum=np.array([1.0, 1.0, 0.0]), n_visible=np.array([1, 1, 1]))
        >>> clone, split = grow_masks(s, np.array([[0.001] * 3, [0.5] * 3, [0.5] * 3]), scene_scale=1.0, step=600)
        >>> clone.tolist(), split.tolist()
        ([True, False, False], [False, True, False])
    """
    grads = average_grads(statistics, config)
    by_grad = grads >= config.grow_grad2d if config.inclusive else grads > config.grow_grad2d
    by_blur = statistics.blurred & blurs_at(step, config)
    if not config.grow_on_gradient or (blurs_at(step, config) and not config.grow_on_gradient_in_blur_window):
        by_grad = np.zeros_like(by_grad)
    small = np.max(scales, axis=1) <= config.grow_scale3d * scene_scale
    if config.blur_rule == "split":
        return by_grad & small, (by_grad & ~small) | by_blur
    return (by_grad | by_blur) & small, (by_grad | by_blur) & ~small


def prune_mask(
    opacities: Float64[np.ndarray, " N"],
    scales: Float64[np.ndarray, "N 3"],
    scene_scale: float,
    step: int,
    config: DensityConfig = POP,
) -> Bool[np.ndarray, " N"]:
    """Decide which rows go: `o < prune_opa`, or, with `prune_too_big`, `max scale > prune_scale3d * scene_scale` (A16).

    Source: POP paper section 3.1 (opacity below a threshold, or excessively large).
    Departs: the paper's sentence describes 3DGS; POP, which has no resets, leaves large Gaussians, as gsplat does
    without resets (A16). Inria also has a 20 px rule on the screen extent, which never fires there; it is left out.

    Args:
        opacities: activated.
        scales: standard deviations, activated, world units.
        scene_scale: world units.
        step: of the densification step, from 0.
        config: thresholds.

    Returns:
        True where a row is pruned.

    Example:
        >>> prune_mask(np.array([0.0, 0.5]), np.full((2, 3), 0.25), scene_scale=1.0, step=600).tolist()
        [True, False]
    """
    too_faint = opacities < config.prune_opa
    if not config.prune_too_big or step <= config.prune_too_big_after:
        return too_faint
    return too_faint | (np.max(scales, axis=1) > config.prune_scale3d * scene_scale)


def densify_and_prune(
    rows: Rows,
    statistics: Statistics,
    scene_scale: float,
    step: int,
    normals: Callable[[int], np.ndarray],
    config: DensityConfig = POP,
) -> tuple[Rows, Statistics]:
    """Hold one densification step: clone, split, prune, forget.

    Copies are appended first and are never split in the same step; then split parents make way for their children;
    then the grown set of Gaussians is pruned, newcomers included. N' = N + clones + splits - prunes.

    Source: POP paper sections 3.1 and 3.3.
    Departs: nothing; the order is gsplat's.

    Args:
        rows: the Gaussians.
        statistics: the window that ends here.
        scene_scale: world units.
        step: of the densification step, from 0.
        normals: given n, standard normal draws [2, n, 3] for n split parents.
        config: thresholds and readings.

    Returns:
        The new Gaussians; statistics of an empty window (A3).

    Example:
        >>> rows = rows_from_params({"means": np.zeros((2, 3)), "scales": np.zeros((2, 3)),
        ...                          "quats": np.ones((2, 4)), "opacities": np.array([0.0, -9.0])})
        >>> rows, _ = densify_and_prune(rows, zero_statistics(2), 1.0, 600, lambda n: np.zeros((2, n, 3)))
        >>> rows.params["opacities"].tolist()
        [0.0]
    """
    clone, split = grow_masks(statistics, scales_from_log_scales(rows.params["scales"]), scene_scale, step, config)
    rows = clone_rows(rows, clone)
    split = np.concatenate([split, np.zeros(int(np.sum(clone)), dtype=bool)])
    rows = split_rows(rows, split, normals(int(np.sum(split))), config.revised_opacity)
    opacities = opacities_from_logits(rows.params["opacities"])
    scales = scales_from_log_scales(rows.params["scales"])
    rows = prune_rows(rows, prune_mask(opacities, scales, scene_scale, step, config))
    return rows, zero_statistics(len(rows))


def densifies_at(step: int, config: DensityConfig) -> bool:
    """Tell whether the Gaussians are grown and pruned after this step (A17).

    `refine_start_iter < step < refine_stop_iter`, and step is a multiple of `refine_every`: 600, 700 ... 14900; but not
    within `pause_refine_after_reset` steps of a reset.

    Source: POP paper section 4.1 (every 100 iterations from 0.5K to 15K).
    Departs: nothing; both bounds are exclusive, as in Inria's and gsplat's code.

    Args:
        step: from 0.
        config: the schedule.

    Returns:
        True at a densification step.

    Example:
        >>> [step for step in range(0, 900, 50) if densifies_at(step, POP)]
        [600, 700, 800]
    """
    if config.reset_every > 0 and step % config.reset_every < config.pause_refine_after_reset:
        return False
    return config.refine_start_iter < step < config.refine_stop_iter and step % config.refine_every == 0


def blurs_at(step: int, config: DensityConfig) -> bool:
    """Tell whether the blur rule takes part in densification after this step: both ends of its window included (A19).

    Source: POP paper section 4.1 (between 3K and 7K iterations).
    Departs: nothing.

    Args:
        step: from 0.
        config: the schedule.

    Returns:
        True inside the blur window.

    Example:
        >>> [blurs_at(step, POP) for step in (2999, 3000, 7000, 7001)]
        [False, True, True, False]
    """
    return config.blur_start_iter <= step <= config.blur_stop_iter


def resets_at(step: int, config: DensityConfig) -> bool:
    """Tell whether opacities are reset after this step: never in POP (A22), 3000, 6000, 9000, 12000 in gsplat.

    Source: POP paper section 3.1 (every 3,000 iterations).
    Departs: gsplat up to 1.5.2 resets at step 0 too (`reset_at_zero`, A25), and 1.5.3 by mistake never.

    Args:
        step: from 0.
        config: the schedule.

    Returns:
        True at a reset.

    Example:
        >>> [step for step in range(0, 16000, 1000) if resets_at(step, GSPLAT)]
        [3000, 6000, 9000, 12000]
    """
    if config.reset_every == 0 or step >= config.refine_stop_iter or step % config.reset_every != 0:
        return False
    return step > 0 or config.reset_at_zero
