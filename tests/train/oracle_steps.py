"""One step of a training run, judged by the oracle's step from the same state, and what rounding may do to it.

Before each step the run's parameters, moments and statistics are taken as the oracle's state, in float64. Both take the
step; losses, parameters, moments, statistics and events are compared. A trajectory is so judged at every place that it
comes to, though float32 and float64 would go apart at the first decision that rounding turns.

The tolerances are no constants. The kit's running error analysis (`conformance.charges`, `gradient_charges`,
`loss_magnitudes`) says what rounding costs in each gradient, and Adam's update is bounded over all gradients, moments
and denominators within that: a row whose gradient is nothing but rounding may move either way, others may not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch

from pop_fast.strategies import POPStrategy
from pop_fast.strategies.control import standard_normals
from pop_fast.train import TrainConfig, TrainingRun
from pop_ref import losses
from pop_ref.conformance.charges import REACH, PixelCharges, charge
from pop_ref.conformance.gradient_charges import gradient_charges
from pop_ref.conformance.scenes import Scene
from pop_ref.density import Rows, Statistics, zero_statistics
from pop_ref.loss_magnitudes import d_ssim_magnitudes, pixelwise_magnitudes
from pop_ref.margins import margins
from pop_ref.optimizer import learning_rates, sh_degree_at
from pop_ref.render import render, render_vjp
from pop_ref.settings import BETAS, EPS, LAMBDA_SSIM_3DGS, DensityConfig, PopTerm, Recipe
from pop_ref.training import Training, control, gaussians_from_params, objective, params_vjp, train_step
from pop_ref.types import Camera

KEYS = ("means", "scales", "quats", "opacities", "sh0", "shN")
# the smallest normal number of float32: under it moments may be flushed to zero
SMALLEST = 1.2e-38


def config_of(recipe: Recipe, folder: Any, **changes: Any) -> TrainConfig:
    """Return the settings of a run that does what a recipe says, over views that are all trained on."""
    density = {f.name: getattr(recipe.density, f.name) for f in fields(DensityConfig)}
    term = {f.name: getattr(recipe, f.name) for f in fields(PopTerm)}
    settings: dict[str, Any] = {
        "result_dir": str(folder),
        "max_steps": recipe.max_steps,
        "profile": recipe.profile.name,
        "sh_interval": recipe.sh_interval,
        "photometric": recipe.pixelwise,
        "photometric_divisor": 1.0 / recipe.pixel_scale,
        "lambda_ssim": recipe.lambda_ssim,
        "l2_stop_iter": recipe.l2_stop_iter,
        "ssim_padding": recipe.padding,
        "d_ssim_halved": recipe.d_ssim_halved,
        "lr": recipe.lr,
        "strategy": POPStrategy(**density, **term),
        "test_every": 0,
        "threads": 1,
        "progress": False,
        **changes,
    }
    return TrainConfig(**settings)


@dataclass
class Judged:
    """What became of a step.

    Attributes:
        step: its number.
        event: what density control did, or None.
        loss: the run's.
        differences: what is not the oracle's within rounding; empty where all is.
        doubtful: whether a decision of this step was so close that rounding could turn it.
    """

    step: int
    event: Any
    loss: float
    differences: list[str]
    doubtful: bool


def state_of(run: TrainingRun) -> Training:
    """Take a run's rows and statistics as the oracle's."""
    arrays = {key: _array(run.params[key]) for key in KEYS}
    moments = {key: run.optimizers[key].state[run.params[key]] for key in KEYS}
    m, v = ({key: _array(moments[key][name]) for key in KEYS} for name in ("exp_avg", "exp_avg_sq"))
    found, empty = run.state, zero_statistics(len(arrays["means"]))

    def taken(name: str, otherwise: np.ndarray) -> np.ndarray:
        return otherwise if found[name] is None else _array(found[name]).astype(otherwise.dtype)

    statistics = Statistics(
        grad_sum=taken("grad2d", empty.grad_sum),
        n_visible=taken("count", empty.n_visible),
        n_views=found["views"],
        dominant_sum=taken("dominant_sum", empty.dominant_sum),
        blurred=taken("blurred", empty.blurred),
    )
    return Training(Rows(arrays, m, v), statistics, run.step)


def judged_step(run: TrainingRun, recipe: Recipe, scene_scale: float) -> Judged:
    """Let a run take a step and compare it with the oracle's."""
    before, generator = state_of(run), torch.Generator()
    generator.set_state(run.state["generator"].get_state())
    stretch = run.take_steps(run.step + 1)
    after = state_of(run)
    view = next(view for view in run._train if view.name == stretch.views[0])
    camera = Camera(_array(view.viewmat[0]), _array(view.K[0]), view.width, view.height)
    eps = float(torch.finfo(run.params["means"].dtype).eps)
    drawn: list[np.ndarray] = []

    def normals(n: int) -> np.ndarray:
        # the first call draws; a second, of another variant of the event, is given the same numbers
        if not drawn:
            drawn.append(standard_normals(generator, n).double().numpy())
        return np.resize(drawn[0], (2, n, 3))

    quiet = replace(recipe, density=replace(recipe.density, refine_start_iter=10**9, reset_every=0))
    target = view.photo.double().numpy() / 255.0
    moved, loss = train_step(before, camera, target, scene_scale, normals, quiet)
    work = Bounds.of(before, camera, target, recipe, eps)
    rows = work.around(moved.rows, before, scene_scale)
    rows, statistics = control(rows, moved.statistics, scene_scale, before.step, normals, recipe.density)
    found = stretch.stats[0].objective + stretch.stats[0].pop
    differences = [] if abs(found - loss) <= work.loss else [f"loss {found} instead of {loss}, {work.loss:.2g} allowed"]
    differences += compared_rows(after.rows, rows, max((float(np.abs(d).max(initial=0.0)) for d in drawn), default=0.0))
    if run.strategy.collects(before.step):
        differences += compared_statistics(after.statistics, statistics, work.gradients2d, recipe, before.step)
    doubtful = bool(differences) and (
        work.doubtful() or near_threshold(moved, work, before.step, scene_scale, normals, recipe.density)
    )
    return Judged(before.step, stretch.event, found, differences, doubtful)


@dataclass
class Bounds:
    """What rounding may do to a step.

    Attributes:
        scene: what was rendered.
        charges: of the render.
        recipe: what was minimised.
        eps: of the run's precision.
        gradients, errors: of the raw parameters, and what each entry may be off by.
        gradients2d: what a gradient norm on the screen may be off by, NDC. [N]
        loss: what the loss may be off by.
    """

    scene: Scene
    charges: PixelCharges
    recipe: Recipe
    eps: float
    gradients: Mapping[str, np.ndarray]
    errors: Mapping[str, np.ndarray]
    gradients2d: np.ndarray
    loss: float

    @classmethod
    def of(cls, state: Training, camera: Camera, target: np.ndarray, recipe: Recipe, eps: float) -> Bounds:
        """Bound a step of the oracle."""
        params, gaussians = state.rows.params, gaussians_from_params(state.rows.params)
        degree = sh_degree_at(state.step, recipe.sh_interval, int(np.sqrt(gaussians.sh.shape[1])) - 1)
        view = render(gaussians, camera, sh_degree=degree, profile=recipe.profile)
        loss, v_image, v_opacities = objective(view, gaussians, target, state, recipe)
        found = render_vjp(gaussians, camera, v_image, sh_degree=degree, profile=recipe.profile)
        grads = params_vjp(params, found, v_opacities)
        scene = Scene(gaussians, camera, profile=recipe.profile, sh_degree=degree)
        charges = charge(scene, np.float32 if eps > 1e-10 else np.float64)
        v_error, value = _loss_charges(view.image, target, charges.image, v_image, state.step, recipe, eps)
        units = gradient_charges(scene, charges, np.abs(v_image) + v_error, np.zeros(v_image.shape[:2]))
        o, reach = gaussians.opacities, REACH * eps
        # 1 - o loses digits where o is near 1
        logit = o * (1.0 - o) * (units["opacities"] + np.abs(v_opacities)) + np.abs(found.opacities + v_opacities)
        raw = {
            "means": units["means"],
            "scales": units["scales"] * gaussians.scales,
            "quats": units["quats"],
            "opacities": logit * o,
            "sh0": units["sh"][:, :1],
            "shN": units["sh"][:, 1:],
        }
        errors = {key: reach * (raw[key] + np.abs(grads[key])) for key in KEYS}
        half = 0.5 * np.array([camera.width, camera.height])
        screen = reach * np.linalg.norm(half * units["means2d"], axis=1)
        return cls(scene, charges, recipe, eps, grads, errors, screen, reach * (value + abs(loss)))

    def around(self, moved: Rows, before: Training, scene_scale: float) -> Rows:
        """Return the rows with what each entry of parameters and moments may be off by, under more keys."""
        eps, rows, step = self.eps, before.rows, before.step
        rates = learning_rates(step, scene_scale, self.recipe.max_steps, self.recipe.lr)
        more: dict[str, np.ndarray] = {"row": np.arange(float(len(rows)))}
        for key in KEYS:
            g, g_error = np.abs(self.gradients[key]), self.errors[key]
            m, v = moved.m[key], moved.v[key]
            m_error = (1.0 - BETAS[0]) * g_error + 4.0 * eps * (np.abs(rows.m[key]) + np.abs(m))
            v_error = (1.0 - BETAS[1]) * (2.0 * g * g_error + g_error**2) + 4.0 * eps * v + SMALLEST
            update = _update(m, v, step, rates[key])
            corners = [
                _update(m + i * m_error, np.maximum(v + j * v_error, 0.0), step, rates[key])
                for i in (-1, 1)
                for j in (-1, 1)
            ]
            spread = np.max([np.abs(corner - update) for corner in corners], axis=0)
            size = np.abs(update) + spread + np.abs(moved.params[key])
            more |= {f"error {key}": spread + 8.0 * eps * size, f"error m {key}": m_error, f"error v {key}": v_error}
        none = {name: np.zeros_like(array) for name, array in more.items()}
        return Rows({**moved.params, **more}, {**moved.m, **none}, {**moved.v, **none})

    def doubtful(self) -> bool:
        """Tell whether a decision of the render, or a kink of its gradient, was within reach of rounding."""
        seen = margins(self.scene.gaussians, self.scene.camera, self.scene.sh_degree, self.scene.profile)
        return bool(seen.doubts(REACH * self.eps))


def near_threshold(
    moved: Training, work: Bounds, step: int, scene_scale: float, normals: Any, density: DensityConfig
) -> bool:
    """Tell whether thresholds moved by rounding change who is grown or pruned."""
    off = REACH * work.eps
    share = float(np.max(work.gradients2d)) / density.grow_grad2d
    tagged = {**moved.rows.params, "row": np.arange(float(len(moved.rows)))}
    moments = {**moved.rows.m, "row": np.zeros(len(moved.rows))}
    kept = []
    for sign in (-1.0, 0.0, 1.0):
        config = replace(
            density,
            grow_grad2d=density.grow_grad2d * (1.0 + sign * (off + share)),
            grow_scale3d=density.grow_scale3d * (1.0 + sign * off),
            prune_scale3d=density.prune_scale3d * (1.0 + sign * off),
            prune_opa=density.prune_opa * (1.0 + sign * off),
        )
        rows, _ = control(Rows(tagged, moments, moments), moved.statistics, scene_scale, step, normals, config)
        kept.append(rows.params["row"].tolist())
    return not kept[0] == kept[1] == kept[2]


def compared_rows(found: Rows, wanted: Rows, farthest: float) -> list[str]:
    """List parameters and moments that differ by more than rounding.

    Args:
        found: the run's.
        wanted: the oracle's, with errors.
        farthest: the largest draw that placed children of a split.
    """
    if len(found) != len(wanted):
        return [f"{len(found)} Gaussians instead of {len(wanted)}"]
    out: list[str] = []
    scales = np.exp(wanted.params["scales"]).max(axis=1, initial=0.0)[:, None]
    turned = wanted.params["error scales"].max(1, initial=0.0) + 4.0 * wanted.params["error quats"].max(1, initial=0.0)
    for key in KEYS:
        error = 4.0 * wanted.params[f"error {key}"] + 1e-6 * SMALLEST
        if key == "means":
            # of a child of a split, which lies where its parent's axes and the draw put it
            error = error + 4.0 * farthest * scales * turned[:, None]
        for kind, a, b, allowed in (
            ("", found.params[key], wanted.params[key], error),
            ("m of ", found.m[key], wanted.m[key], wanted.params[f"error m {key}"]),
            ("v of ", found.v[key], wanted.v[key], wanted.params[f"error v {key}"]),
        ):
            wrong = ~(np.abs(a - b) <= allowed)
            if np.any(wrong):
                index = tuple(int(i) for i in np.argwhere(wrong)[0])
                out.append(f"{kind}{key}{index}: {a[index]!r} instead of {b[index]!r}, {allowed[index]:.2g} allowed")
    return out


def compared_statistics(
    found: Statistics, wanted: Statistics, error: np.ndarray, recipe: Recipe, step: int
) -> list[str]:
    """List statistics that differ by more than rounding; counts are exact."""
    collected: list[tuple[str, Any]] = [("n_visible", found.n_visible), ("n_views", found.n_views)]
    if step <= recipe.density.blur_stop_iter:
        collected.append(("blurred", found.blurred))
    if recipe.pop_views == "window":
        collected.append(("dominant_sum", found.dominant_sum))
    out = [f"{name}: {value} instead of {getattr(wanted, name)}" for name, value in collected
           if not np.array_equal(value, getattr(wanted, name))]  # fmt: skip
    # after an event all is zero, whatever the number of rows has become
    allowed = error + 1e-6 * wanted.grad_sum if len(error) == len(found.grad_sum) else np.zeros(len(found.grad_sum))
    if np.any(np.abs(found.grad_sum - wanted.grad_sum) > allowed):
        out.append(f"grad_sum: {found.grad_sum} instead of {wanted.grad_sum}")
    return out


def _update(m: np.ndarray, v: np.ndarray, step: int, rate: float) -> np.ndarray:
    denominator = np.sqrt(v) / np.sqrt(1.0 - BETAS[1] ** (step + 1)) + EPS
    return -rate / (1.0 - BETAS[0] ** (step + 1)) * m / denominator


def _loss_charges(
    image: np.ndarray,
    target: np.ndarray,
    e_image: np.ndarray,
    v_image: np.ndarray,
    step: int,
    recipe: Recipe,
    eps: float,
) -> tuple[np.ndarray, float]:
    """Return what rounding of the render and of the loss costs in its gradient by pixel, and in its value: in eps."""
    again = recipe.l2_stop_iter is not None and step >= recipe.l2_stop_iter
    l1, weight = recipe.pixelwise == "l1" or again, LAMBDA_SSIM_3DGS if again else recipe.lambda_ssim
    scale, halved = (1.0 - weight) * recipe.pixel_scale, 0.5 if recipe.d_ssim_halved else 1.0
    pixelwise = pixelwise_magnitudes(image, target, 1 if l1 else 2)
    structural = d_ssim_magnitudes(image, target, recipe.padding)
    vjp = losses.photometric_3dgs_vjp if l1 else losses.photometric_pop_vjp
    options = (weight, recipe.padding, None, recipe.d_ssim_halved, recipe.pixel_scale)
    moved = vjp(image + eps * e_image, target, 1.0, *options)
    v_error = scale * pixelwise.gradient + halved * weight * structural.gradient + 2.0 * np.abs(moved - v_image) / eps
    if l1:
        # where the render equals the photograph up to rounding, the slope of |x - y| has no sign
        flat = np.abs(image - target) <= REACH * eps * e_image
        v_error = v_error + np.where(flat, 2.0 * scale / image.size / (REACH * eps), 0.0)
    value = scale * pixelwise.value + halved * weight * structural.value + float(np.sum(np.abs(v_image) * e_image))
    return v_error, value


def _array(value: Any) -> np.ndarray:
    array = value.detach().cpu().numpy()
    return array.astype(np.float64) if array.dtype.kind == "f" else array
