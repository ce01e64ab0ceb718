"""Steps of a training on photographs, each judged by the oracle's from the same Gaussians, and what rounding may do.

Before every step the oracle takes the parameters and moments that were found after the last one. So a training is
judged wherever it comes to, though single precision goes its own way at the first decision that rounding turns. Adam's
update is bounded over all moments that the gradient's error allows: where a gradient is nothing but rounding, a row may
move either way, and no other may.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pop_ref.conformance import tolerances
from pop_ref.conformance.adapter import error_bounds_of
from pop_ref.conformance.assertions import assert_close
from pop_ref.conformance.calls import Call, Frame
from pop_ref.conformance.error_bounds import PixelErrorBounds
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.scenes import Scene
from pop_ref.conformance.short_training import ShortTraining
from pop_ref.conformance.signature import Expected
from pop_ref.conformance.views import clear_of_extents
from pop_ref.density import Rows
from pop_ref.methods import KEYS
from pop_ref.optimizer import learning_rates, sh_degree_at
from pop_ref.settings import BETAS, EPS
from pop_ref.short_training import Trained
from pop_ref.training import Look, gaussians_from_params

# under it moments of single precision may be flushed to zero
_SMALLEST: Final = float(np.finfo(np.float32).tiny)
# world units that no step moves a Gaussian by, and that no two are within
_PLACE: Final = 0.01
# of the steps of a short training so many must be clear of rounding
_LEAST_JUDGED: Final = 0.6


def assert_steps(
    backend: Any, short: ShortTraining, found: Sequence[Mapping[str, Any]], least: float = _LEAST_JUDGED
) -> set[str]:
    """Assert that every step that was taken is the oracle's.

    Args:
        backend: that took them.
        short: what was trained.
        found: of every step what `pop_ref.short_training.taken_steps` returns; its "view" is the one that was seen.
        least: the share of the steps that must be clear of rounding; of the others nothing is compared but whose the
            rows are.

    Returns:
        What was done to the Gaussians.
    """
    # frozen, which a protocol of attributes does not allow
    given: Any = short
    trained, happened, judged = Trained(given), set[str](), 0
    waiting = np.zeros(0)
    for step, record in enumerate(found):
        rows, view = trained.driven.rows, int(record["view"])
        seen = trained.look(view)
        step_bounds = _Bounds(trained, view, seen, backend.dtype)
        waiting = waiting if len(waiting) == len(rows) else np.zeros_like(rows.params["shN"])
        errors, waiting = step_bounds.gradients(trained, waiting)
        trained.move(view, seen)
        trained.driven.rows = _with_errors(trained, rows, errors, backend.dtype)
        happened |= set(trained.change())
        if step_bounds.clear:
            judged += 1
            at = f"step {step} of {short.method}"
            size = abs(seen.loss) + step_bounds.loss_size
            assert_close("steps.loss", record["loss"], seen.loss, size, backend.dtype, True, place=_at(f"{at}: loss"))
            _assert_rows(record, trained.driven.rows, backend.dtype, at)
        _assert_whose(record["params"]["means"], trained.driven.rows.params["means"], f"step {step} of {short.method}")
        trained.driven.rows = Rows(*({key: record[kind][key] for key in KEYS} for kind in ("params", "m", "v")))
    assert judged >= least * len(found), "rounding decides a pixel of most steps"
    return happened


def _at(where: str) -> Any:
    return lambda index: f"{where}, {list(index)}"


def _assert_whose(found: np.ndarray, expected: np.ndarray, at: str) -> None:
    assert len(found) == len(expected), f"{at} left {len(found)} Gaussians, expected {len(expected)}"
    others = np.flatnonzero(np.any(np.abs(found - expected) > _PLACE, axis=1))
    assert not len(others), f"{at} left another Gaussian at row {others[:1]}"


def _assert_rows(record: Mapping[str, Any], wanted: Rows, dtype: Any, at: str) -> None:
    for key in KEYS:
        for kind, name in (("m", f"steps.{key}"), ("v", "steps.squares"), ("params", "steps.params")):
            ends = record[kind][key], getattr(wanted, kind)[key]
            size = wanted.params[f"size {kind} {key}"]
            assert_close(name, *ends, size, dtype, True, place=_at(f"{at}: {kind} of {key}"))


@dataclass
class _Bounds:
    """What rounding may do to a step.

    Attributes:
        trained: before the step.
        view: that is seen.
        seen: what the oracle has seen.
        dtype: the precision that is judged.
    """

    trained: Trained
    view: int
    seen: Look
    dtype: Any

    def __post_init__(self) -> None:
        short, recipe = self.trained.short, self.trained.recipe
        params = self.trained.driven.rows.params
        self.gaussians = gaussians_from_params(params)
        degree = sh_degree_at(
            self.trained.step, recipe.sh_interval, _degree_of(params), recipe.updates.sh_start_iter
        )  # fmt: skip
        camera, behind = short.cameras[self.view], np.array(short.background)
        self.scene = Scene(self.gaussians, camera, behind, recipe.profile, None, degree, short.antialiased)
        self.pixels: PixelErrorBounds = error_bounds_of(self.scene, self.dtype)

    @property
    def clear(self) -> bool:
        """Tell whether rounding decides nothing of the render."""
        recipe, pixels = self.trained.recipe, self.pixels
        dominates = recipe.lambda_pop != 0.0 or recipe.density.blur_start_iter < len(self.trained.short.order)
        decided = bool(np.all(pixels.smooth & (pixels.decided | (not dominates))))
        return decided and not np.any(pixels.screen.kinked) and bool(np.all(clear_of_extents(self.scene, self.dtype)))

    @property
    def loss_size(self) -> float:
        """Return what one unit of the loss is eps times of, besides the loss itself."""
        v_image = np.abs(self.seen.v_image[..., :3])
        return float(np.sum(v_image * (self.pixels.image + self.pixels.absolute)))

    def gradients(self, trained: Trained, waiting: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return the error bound of every raw parameter's gradient, and of those that wait, in units of eps.

        Args:
            trained: before the step.
            waiting: the error bound of what waited until now. [N, K - 1, 3]
        """
        units, o = self._of_render(), self.gaussians.opacities
        grads = self.seen.grads
        # 1 - o loses digits where o is near 1
        logits = o * (1.0 - o) * units["opacities"] + np.abs(grads["opacities"]) * (1.0 + 1.0 / (1.0 - o))
        raw = {
            "means": units["means"],
            "scales": units["scales"] * self.gaussians.scales,
            "quats": units["quats"],
            "opacities": logits,
            "sh0": units["sh"][:, :1],
            "shN": units["sh"][:, 1:],
        }
        errors = {key: raw[key] + np.abs(grads[key]) for key in KEYS}
        every = trained.recipe.updates.sh_rest_every
        if every == 1:
            return errors, np.zeros_like(waiting)
        errors["shN"] = errors["shN"] + waiting
        return errors, np.zeros_like(waiting) if (trained.step + 1) % every == 0 else errors["shN"]

    def _of_render(self) -> dict[str, np.ndarray]:
        v = np.abs(self.seen.v_image)
        recipe, n = self.trained.recipe, v.shape[0] * v.shape[1]
        goal = recipe.at(self.trained.step, recipe.l2_stop_iter)
        # a cotangent changes with the image: that of the square by its slope, that of SSIM by its window's
        slope = 2.0 / (3.0 * n) * (1.0 + 8.0 * goal.lambda_ssim)
        e_image = np.zeros_like(v)
        e_image[..., :3] = v[..., :3] + slope * (self.pixels.image + self.pixels.absolute)
        none = np.zeros(v.shape[:2])
        if v.shape[2] == 3:
            return gradient_error_bounds(self.scene, self.pixels, v, none, e_cotangents=(e_image, none))
        frame = Frame(self.scene)
        expected = Expected(Call(((frame,),), render_mode="RGB+ED"), frame, self.dtype, 0)
        expected.v_image, expected.v_T_final = v + e_image, none
        bounds = expected.gradients[1]
        return {**bounds, "sh": bounds["colors"]}


def _degree_of(params: Mapping[str, np.ndarray]) -> int:
    return round(np.sqrt(params["shN"].shape[1] + 1)) - 1


def _with_errors(trained: Trained, before: Rows, errors: Mapping[str, np.ndarray], dtype: Any) -> Rows:
    """Return the rows after Adam, with the size of a unit of each entry under more keys, which go with their rows."""
    moved, step, short, recipe = trained.driven.rows, trained.step, trained.short, trained.recipe
    rates = learning_rates(step, short.scene_scale, recipe.max_steps, recipe.lr, recipe.updates)
    limit = tolerances.agreement("steps.params", dtype)
    more: dict[str, np.ndarray] = {}
    for key in KEYS:
        m, v = moved.m[key], moved.v[key]
        g = np.abs(m - BETAS[0] * before.m[key]) / (1.0 - BETAS[0])
        size_m = (1.0 - BETAS[0]) * errors[key] + np.abs(before.m[key]) + np.abs(m)
        size_v = (1.0 - BETAS[1]) * 2.0 * g * errors[key] + v
        allowed = [
            tolerances.agreement(name, dtype) * size
            for name, size in ((f"steps.{key}", size_m), ("steps.squares", size_v))
        ]
        squared = (1.0 - BETAS[1]) * (tolerances.agreement(f"steps.{key}", dtype) * errors[key]) ** 2 + _SMALLEST
        number, update = trained.driven.counters[key], np.zeros_like(m)
        spread = np.zeros_like(m)
        if number > 0 and not np.array_equal(m, before.m[key]):
            update = _update(m, v, number, rates[key])
            ends = [_update(m + i * allowed[0], np.maximum(v + j * (allowed[1] + squared), 0.0), number, rates[key])
                    for i in (-1.0, 1.0) for j in (-1.0, 1.0)]  # fmt: skip
            spread = np.max([np.abs(end - update) for end in ends], axis=0)
        size = np.abs(moved.params[key]) + np.abs(update) + spread / limit
        squares = size_v + squared / tolerances.agreement("steps.squares", dtype)
        more |= {f"size params {key}": size, f"size m {key}": size_m, f"size v {key}": squares}
    none = {name: np.zeros_like(array) for name, array in more.items()}
    return Rows({**moved.params, **more}, {**moved.m, **none}, {**moved.v, **none})


def _update(m: np.ndarray, v: np.ndarray, number: float, rate: float) -> np.ndarray:
    denominator = np.sqrt(v) / np.sqrt(1.0 - BETAS[1] ** number) + EPS
    return -rate / (1.0 - BETAS[0] ** number) * m / denominator
