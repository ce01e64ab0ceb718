"""Training, one step at a time: render -> loss -> gradient -> Adam -> density control.

The order is gsplat's since 1.5: Adam moves first, then density control edits the Gaussians. Dominant counts come from
the forward pass that made the loss (A27), so importance and blur cost no second render.

What is minimised and when is a `recipes.Recipe`.

Label decided here: A27 (whose dominant counts).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import isqrt
from typing import Any

import numpy as np

from pop_ref import losses
from pop_ref._shapes import Bool, Float64
from pop_ref.activations import (
    opacities_from_logits,
    opacities_from_logits_vjp,
    scales_from_log_scales,
    scales_from_log_scales_vjp,
)
from pop_ref.density import (
    DensityConfig,
    Rows,
    Statistics,
    accumulate,
    densifies_at,
    densify_and_prune,
    prune_rows,
    reset_opacities,
    resets_at,
    rows_from_params,
    zero_statistics,
)
from pop_ref.optimizer import adam_step, learning_rates, sh_degree_at, update_numbers
from pop_ref.polarization import importance_mask, opacity_entropy, opacity_entropy_vjp, pop_loss, pop_loss_vjp
from pop_ref.recipes import RECIPES, Recipe
from pop_ref.records import Camera, Gaussians, Render
from pop_ref.regularizers import (
    depth_samples,
    mean_activation,
    mean_activation_vjp,
    sparse_depth_loss,
    sparse_depth_loss_vjp,
)
from pop_ref.render import RenderGradients, render, render_vjp
from pop_ref.settings import BETAS

# the objective of every pixelwise loss, and its transpose
_PHOTOMETRIC = {
    "l1": (losses.photometric_3dgs, losses.photometric_3dgs_vjp),
    "l2": (losses.photometric_pop, losses.photometric_pop_vjp),
}


@dataclass(frozen=True)
class Training:
    """The state of a training between two steps.

    Attributes:
        rows: raw parameters ("means", "scales", "quats", "opacities", "sh0", "shN") and Adam's moments; any other key
            is not trained, and goes with its row.
        statistics: of the current densification window.
        step: number of the next step, from 0.
        waiting: gradients that wait for their parameter's next update (`UpdateRules.sh_rest_every`); absent ones are 0.
    """

    rows: Rows
    statistics: Statistics
    step: int = 0
    waiting: Mapping[str, np.ndarray] = field(default_factory=dict[str, np.ndarray])


def start(params: Mapping[str, np.ndarray]) -> Training:
    """Begin a training with these parameters.

    Source: Kerbl et al. 2023, algorithm 1.
    Departs: nothing.

    Args:
        params: raw parameters.

    Returns:
        The state before step 0.

    Example:
        >>> start({"means": np.zeros((2, 3))}).step
        0
    """
    rows = rows_from_params(params)
    return Training(rows, zero_statistics(len(rows)))


@dataclass(frozen=True)
class Look:
    """What a step learns of one view before it moves anything.

    Attributes:
        loss: with all its terms.
        grads: of the raw parameters, shapes as these.
        v_image: cotangent of the render; with the depth of sparse points its last channel is depth. [H, W, D]
        v_means2d: gradient by the screen centres, per px. [N, 2]
        visible: whom the view shows. [N]
        dominant_counts: pixels that each dominates, of those that count. [N]
    """

    loss: float
    grads: dict[str, np.ndarray]
    v_image: np.ndarray
    v_means2d: np.ndarray
    visible: np.ndarray
    dominant_counts: np.ndarray


def look(
    state: Training,
    camera: Camera,
    target: Float64[np.ndarray, "H W 3"],
    scene_scale: float,
    recipe: Recipe = RECIPES["POP"],
    points: Float64[np.ndarray, "P 3"] | None = None,
    mask: Bool[np.ndarray, "H W"] | None = None,
    background: Float64[np.ndarray, " 3"] | None = None,
    antialiased: bool = False,
) -> Look:
    """Render a view, compare it with its photograph, and go back to the gradients of the raw parameters.

    Source: POP paper, section 3; Kerbl et al. 2023, algorithm 1.
    Departs: nothing.

    Args:
        state: before the step.
        camera: of the view.
        target: the photograph.
        scene_scale: world units.
        recipe: what is minimised.
        points: sparse points that the photograph sees, world, for `Recipe.depth_lambda`; None where none are known.
        mask: True for the pixels that count, or None.
        background: colour behind everything; None is black.
        antialiased: whether opacities make up for the low-pass.

    Returns:
        The loss, its gradients, and what density control collects.

    Example:
        >>> params = {"means": np.array([[0.0, 0.0, 4.0]]), "quats": np.array([[1.0, 0.0, 0.0, 0.0]]),
        ...           "scales": np.zeros((1, 3)), "opacities": np.zeros(1), "sh0": np.zeros((1, 1, 3))}
        >>> camera = Camera(np.eye(4), np.array([[16.0, 0.0, 8.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]]), 16, 16)
        >>> seen = look(start(params), camera, np.ones((16, 16, 3)), 1.0)
        >>> seen.visible.tolist(), bool(seen.grads["opacities"][0] < 0.0)
        ([True], True)
    """
    rows, step = state.rows, state.step
    gaussians = gaussians_from_params(rows.params)
    degree = sh_degree_at(step, recipe.sh_interval, isqrt(gaussians.sh.shape[1]) - 1, recipe.updates.sh_start_iter)
    deep = points is not None and recipe.depth_lambda != 0.0
    mode = "RGB+ED" if deep else "RGB"
    options: dict[str, Any] = {"sh_degree": degree, "profile": recipe.profile, "render_mode": mode}
    options |= {"background": background, "antialiased": antialiased}
    view = render(gaussians, camera, **options)
    # the dominant counts of this very forward pass say what is important (A27)
    counts = view.dominant_counts if mask is None else _counts_inside(view, mask)
    colored = replace(view, image=view.image[..., :3], dominant_counts=counts)
    loss, v_image, v_opacities = objective(colored, gaussians, target, state, recipe, mask)
    if points is not None and deep:
        samples, weight = depth_samples(points, camera, mask), recipe.depth_lambda * scene_scale
        loss += weight * sparse_depth_loss(view.image[..., 3], *samples)
        v_depth = sparse_depth_loss_vjp(view.image[..., 3], *samples, weight)
        v_image = np.concatenate((v_image, v_depth[..., None]), axis=2)
    gradients = render_vjp(gaussians, camera, v_image, **options)
    grads = params_vjp(rows.params, gradients, v_opacities)
    loss += _add_regularizers(grads, gaussians, rows.params, recipe)
    if recipe.lambda_entropy != 0.0 and recipe.pop_start_iter <= step < recipe.pop_stop_iter:
        loss += recipe.lambda_entropy * opacity_entropy(rows.params["opacities"])
        grads["opacities"] += opacity_entropy_vjp(rows.params["opacities"], recipe.lambda_entropy)
    return Look(loss, grads, v_image, gradients.means2d, view.splats.visible, counts)


def _counts_inside(view: Render, mask: np.ndarray) -> np.ndarray:
    ids = view.dominant_ids[mask]
    return np.bincount(ids[ids >= 0], minlength=len(view.dominant_counts)).astype(np.int64)


def train_step(
    state: Training,
    camera: Camera,
    target: Float64[np.ndarray, "H W 3"],
    scene_scale: float,
    normals: Callable[[int], np.ndarray],
    recipe: Recipe = RECIPES["POP"],
    points: Float64[np.ndarray, "P 3"] | None = None,
    mask: Bool[np.ndarray, "H W"] | None = None,
    background: Float64[np.ndarray, " 3"] | None = None,
    antialiased: bool = False,
) -> tuple[Training, float]:
    """Take one step with one view.

    Source: POP paper, section 3; Kerbl et al. 2023, algorithm 1.
    Departs: Inria edits the Gaussians before Adam and so loses that step's update; gsplat edits it after. Here it is
        edited after, and `UpdateRules.edits_replace_update` leaves the update out.

    Args:
        state: before the step.
        camera: of the view.
        target: the photograph.
        scene_scale: world units.
        normals: given n, standard normal draws [2, n, 3], for instance `lambda n: rng.standard_normal((2, n, 3))`.
        recipe: what is minimised.
        points: sparse points that the photograph sees, world, for `Recipe.depth_lambda`; None where none are known.
        mask: True for the pixels that count, or None.
        background: colour behind everything; None is black.
        antialiased: whether opacities make up for the low-pass.

    Returns:
        The state after the step; the loss before it.

    Example:
        >>> params = {"means": np.array([[0.0, 0.0, 4.0]]), "quats": np.array([[1.0, 0.0, 0.0, 0.0]]),
        ...           "scales": np.zeros((1, 3)), "opacities": np.zeros(1), "sh0": np.zeros((1, 1, 3))}
        >>> camera = Camera(np.eye(4), np.array([[16.0, 0.0, 8.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]]), 16, 16)
        >>> state, before = train_step(start(params), camera, np.ones((16, 16, 3)), 1.0, lambda n: np.zeros((2, n, 3)))
        >>> state, after = train_step(state, camera, np.ones((16, 16, 3)), 1.0, lambda n: np.zeros((2, n, 3)))
        >>> state.step, after < before
        (2, True)
    """
    step = state.step
    found = look(state, camera, target, scene_scale, recipe, points, mask, background, antialiased)
    rows, waiting = update(state.rows, found.grads, state, scene_scale, recipe)
    seen = (found.v_means2d, found.visible, found.dominant_counts, camera.width, camera.height)
    kept = None if mask is None else int(np.sum(mask))
    statistics = accumulate(state.statistics, *seen, recipe.density, kept)
    waiting = _still_waiting(waiting, rows, step, recipe.density)
    rows, statistics = control(rows, statistics, scene_scale, step, normals, recipe.density)
    return Training(rows, statistics, step + 1, waiting), found.loss


def _still_waiting(
    waiting: Mapping[str, np.ndarray], rows: Rows, step: int, config: DensityConfig
) -> Mapping[str, np.ndarray]:
    """Return the gradients that wait after a step's edits: those of Gaussians that are left, none where some grow."""
    if densifies_at(step, config):
        return {}
    if step != config.final_prune_iter:
        return waiting
    rows = reset_opacities(rows, config.reset_opa) if resets_at(step, config) else rows
    return {name: array[~_faint_at_last(rows, config)] for name, array in waiting.items()}


def _faint_at_last(rows: Rows, config: DensityConfig) -> np.ndarray:
    return opacities_from_logits(rows.params["opacities"]) < config.final_prune_opa


def _add_regularizers(
    grads: dict[str, np.ndarray], gaussians: Gaussians, params: Mapping[str, np.ndarray], recipe: Recipe
) -> float:
    """Add what the mean opacity and the mean scale pull, where they weigh; return what they cost."""
    loss = 0.0
    if recipe.opacity_reg != 0.0:
        loss += recipe.opacity_reg * mean_activation(gaussians.opacities)
        v_opacities = mean_activation_vjp(gaussians.opacities, recipe.opacity_reg)
        grads["opacities"] += opacities_from_logits_vjp(params["opacities"], v_opacities)
    if recipe.scale_reg != 0.0:
        loss += recipe.scale_reg * mean_activation(gaussians.scales)
        v_scales = mean_activation_vjp(gaussians.scales, recipe.scale_reg)
        grads["scales"] += scales_from_log_scales_vjp(params["scales"], v_scales)
    return loss


def update(
    rows: Rows, grads: Mapping[str, np.ndarray], state: Training, scene_scale: float, recipe: Recipe
) -> tuple[Rows, dict[str, np.ndarray]]:
    """Let Adam move the parameters whose turn it is; gradients of the bands beyond the first wait for theirs.

    Source: Kingma and Ba 2015, algorithm 1; taming-3dgs for the gradients that wait.
    Departs: nothing.

    Args:
        rows: the Gaussians.
        grads: gradients of this step's loss.
        state: before the step: its number, and the gradients that wait.
        scene_scale: world units.
        recipe: rates and rules.

    Returns:
        The Gaussians after the update; the gradients that wait from now on.

    Example:
        >>> from pop_ref.settings import UpdateRules
        >>> rows, recipe = rows_from_params({"shN": np.zeros((1, 3, 3))}), Recipe(updates=UpdateRules(sh_rest_every=2))
        >>> same, waiting = update(rows, {"shN": np.ones((1, 3, 3))}, Training(rows, zero_statistics(1)), 1.0, recipe)
        >>> float(same.params["shN"].max()), float(waiting["shN"].max())
        (0.0, 1.0)
    """
    summed = {name: g + state.waiting.get(name, 0.0) for name, g in grads.items()}
    numbers = update_numbers(summed, state.step, recipe)
    rates = learning_rates(state.step, scene_scale, recipe.max_steps, recipe.lr, recipe.updates)
    due = {name: summed[name] for name in numbers}
    betas = (BETAS[0], recipe.lr.beta2)
    moved = Rows(*adam_step(rows.params, due, rows.m, rows.v, numbers, rates, betas))
    waits = recipe.updates.sh_rest_every > 1 and "shN" in summed and "shN" not in numbers
    return moved, {"shN": summed["shN"]} if waits else {}


def gaussians_from_params(params: Mapping[str, np.ndarray]) -> Gaussians:
    """Activate raw parameters; quaternions stay as they are, the renderer normalises them.

    Source: Kerbl et al. 2023, section 5.1.
    Departs: nothing.

    Args:
        params: "means", "scales" (log), "quats", "opacities" (logit), "sh0" and, unless there is one band only, "shN".

    Returns:
        The Gaussians.

    Example:
        >>> params = {"means": np.zeros((1, 3)), "quats": np.ones((1, 4)), "scales": np.zeros((1, 3)),
        ...           "opacities": np.zeros(1), "sh0": np.zeros((1, 1, 3)), "shN": np.zeros((1, 3, 3))}
        >>> g = gaussians_from_params(params)
        >>> g.scales.tolist(), g.opacities.tolist(), g.sh.shape
        ([[1.0, 1.0, 1.0]], [0.5], (1, 4, 3))
    """
    return Gaussians(
        means=params["means"],
        quats=params["quats"],
        scales=scales_from_log_scales(params["scales"]),
        opacities=opacities_from_logits(params["opacities"]),
        sh=np.concatenate([params[name] for name in ("sh0", "shN") if name in params], axis=1),
    )


def params_vjp(
    params: Mapping[str, np.ndarray], gradients: RenderGradients, v_opacities: Float64[np.ndarray, " N"]
) -> dict[str, np.ndarray]:
    """Pull cotangents of the activated Gaussians back to raw parameters.

    Source: transpose of `gaussians_from_params`.
    Departs: nothing.

    Args:
        params: raw parameters.
        gradients: what the render hands back.
        v_opacities: what the POP term adds for the opacities.

    Returns:
        Gradients, shapes as `params`, of the keys that `gaussians_from_params` reads.

    Example:
        >>> params = {"means": np.zeros((1, 3)), "quats": np.ones((1, 4)), "scales": np.zeros((1, 3)),
        ...           "opacities": np.zeros(1), "sh0": np.zeros((1, 1, 3))}
        >>> g = RenderGradients(means=np.zeros((1, 3)), quats=np.zeros((1, 4)), scales=np.ones((1, 3)),
        ...                     opacities=np.ones(1), sh=np.zeros((1, 1, 3)), viewmat=np.zeros((4, 4)),
        ...                     background=np.zeros(3), means2d=np.zeros((1, 2)), means2d_abs=np.zeros((1, 2)))
        >>> params_vjp(params, g, np.ones(1))["opacities"].tolist()
        [0.5]
    """
    sh = {"sh0": gradients.sh[:, :1], "shN": gradients.sh[:, 1:]}
    return {
        "means": gradients.means,
        "quats": gradients.quats,
        "scales": scales_from_log_scales_vjp(params["scales"], gradients.scales),
        "opacities": opacities_from_logits_vjp(params["opacities"], gradients.opacities + v_opacities),
        **{name: value for name, value in sh.items() if name in params},
    }


def objective(
    view: Render,
    gaussians: Gaussians,
    target: Float64[np.ndarray, "H W 3"],
    state: Training,
    recipe: Recipe,
    mask: Bool[np.ndarray, "H W"] | None = None,
) -> tuple[float, Float64[np.ndarray, "H W 3"], Float64[np.ndarray, " N"]]:
    """Compare a render with its photograph and opacities with their poles: eq. 9, or eq. 2.

    Source: POP paper eqs. 2 and 9.
    Departs: nothing.

    Args:
        view: the render.
        gaussians: what was rendered.
        target: the photograph.
        state: tells the step, and the window's dominant counts.
        recipe: the terms and their weights.
        mask: True for the pixels that count, or None; the render's dominant counts are of these.

    Returns:
        The loss; its cotangents of the image and, through the POP term alone, of the opacities.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> camera = Camera(np.eye(4), np.array([[16.0, 0.0, 8.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]]), 16, 16)
        >>> view = render(g, camera)
        >>> loss, _, v_opacities = objective(view, g, view.image, start({"opacities": np.zeros(1)}), RECIPES["POP"])
        >>> round(loss, 12), v_opacities.tolist()
        (0.0005, [-0.001])
    """
    goal = recipe.at(state.step, recipe.l2_stop_iter)
    options = (goal.lambda_ssim, goal.padding, mask, goal.d_ssim_halved, goal.pixel_scale)
    value, value_vjp = _PHOTOMETRIC[goal.pixelwise]
    loss, v_image = value(view.image, target, *options), value_vjp(view.image, target, 1.0, *options)
    if not recipe.pop_start_iter <= state.step < recipe.pop_stop_iter:
        return loss, v_image, np.zeros(len(gaussians))
    counts = view.dominant_counts
    important = importance_mask(counts + state.statistics.dominant_sum if recipe.pop_views == "window" else counts)
    visible = view.splats.visible if recipe.pop_over == "visible" else None
    loss += recipe.lambda_pop * pop_loss(gaussians.opacities, important, visible)
    return loss, v_image, pop_loss_vjp(gaussians.opacities, important, recipe.lambda_pop, visible)


def control(
    rows: Rows,
    statistics: Statistics,
    scene_scale: float,
    step: int,
    normals: Callable[[int], np.ndarray],
    config: DensityConfig,
) -> tuple[Rows, Statistics]:
    """Edit the Gaussians if this step is one for it: densification, a reset, both, or neither.

    Source: POP paper sections 3.1 and 4.1.
    Departs: nothing.

    Args:
        rows: after Adam.
        statistics: of the window, this step's view included.
        scene_scale: world units.
        step: just taken, from 0.
        normals: as in `train_step`.
        config: of density control.

    Returns:
        The Gaussians and the window for the next step.

    Example:
        >>> rows = rows_from_params({"opacities": np.array([9.0])})
        >>> rows, _ = control(rows, zero_statistics(1), 1.0, 3000, lambda n: np.zeros((2, n, 3)),
        ...                   DensityConfig(reset_every=3000, reset_opa=0.25, refine_every=7))
        >>> rows.params["opacities"].round(3).tolist()
        [-1.099]
    """
    if densifies_at(step, config):
        rows, statistics = densify_and_prune(rows, statistics, scene_scale, step, normals, config)
    if resets_at(step, config):
        rows = reset_opacities(rows, config.reset_opa)
    if step == config.final_prune_iter:
        faint = _faint_at_last(rows, config)
        kept = {name: array[~faint] for name, array in vars(statistics).items() if name != "n_views"}
        rows, statistics = prune_rows(rows, faint), replace(statistics, **kept)
    return rows, statistics
