"""Portable vectors of what trains: losses, the POP loss, steps of Adam and of density control."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from pop_ref import losses, ssim
from pop_ref.activations import opacities_from_logits, scales_from_log_scales
from pop_ref.conformance.scenes import pattern
from pop_ref.conformance.vector_schema import entry, equal, output
from pop_ref.density import Statistics, densify_and_prune, grow_masks, rows_from_params
from pop_ref.magnitudes import d_ssim_magnitudes, pixelwise_magnitudes
from pop_ref.optimizer import BETAS, EPS, adam_step
from pop_ref.polarization import importance_mask, pop_loss, pop_loss_vjp
from pop_ref.settings import GSPLAT, POP, DensityConfig

Vector = tuple[dict[str, np.ndarray], dict[str, Any]]
LOSSES = {
    "l1": losses.l1,
    "l2": losses.l2,
    "ssim": ssim.ssim,
    "d_ssim": ssim.d_ssim,
    "photometric_3dgs": losses.photometric_3dgs,
    "photometric_pop": losses.photometric_pop,
}
_PULLED: dict[str, Callable[..., Any]] = {
    "l1": losses.l1_vjp,
    "l2": losses.l2_vjp,
    "ssim": ssim.ssim_vjp,
    "d_ssim": ssim.d_ssim_vjp,
    "photometric_3dgs": losses.photometric_3dgs_vjp,
    "photometric_pop": losses.photometric_pop_vjp,
}
V_LOSS = 0.75
SHARE = 0.25


def _in_float32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64)


def loss_kind() -> dict[str, Any]:
    """Return what the index says of losses."""
    arrays = {
        "picture": entry("input", "[H, W, D]", "what is drawn"),
        "target": entry("input", "[H, W, D]", "the photograph"),
        "mask": entry("input", "[H, W]", "pixels that count; all where the option 'masked' is false", "bool"),
        **output("loss", "[]", "the option 'loss' of picture and target", "agreement.losses"),
        **output("v_picture", "[H, W, D]", "derivative of v_loss times the loss to picture", "agreement.losses_vjp"),
    }
    about = (
        "'l1', 'l2': mean absolute, mean squared difference. 'ssim': mean similarity under 11 x 11 Gaussian windows of "
        "deviation 1.5, K1 = 0.01, K2 = 0.03. 'd_ssim': 1 - SSIM. 'photometric_3dgs': (1 - share) L1 + share D-SSIM; "
        "'photometric_pop' with L2. 'padding': 'valid' takes windows inside the image, 'same' all, zeros around. "
        "Masked, the mean is over kept pixels, and the picture is the target elsewhere for the windows"
    )
    return {"about": about, "arrays": arrays}


def loss_vectors() -> dict[str, Vector]:
    """Return losses with either border, masked and not."""
    found: dict[str, Vector] = {}
    for name in LOSSES:
        similar = name not in ("l1", "l2")
        for padding in ("valid", "same") if similar else ("valid",):
            for masked in (False,) if name == "ssim" else (False, True):
                words = ("loss", name, *([padding] if similar else []), *(["masked"] if masked else []))
                found["_".join(words)] = _loss(name, padding, masked)
            # seams of blocks of 16 and 32, a fourth channel, values that a clamp would change
            words = ("loss", name, *([padding] if similar else []), "of_large_pictures")
            found["_".join(words)] = _loss(name, padding, False, (70, 50, 4), 2.0)
    return found


def loss_arguments(options: dict[str, Any], mask: np.ndarray) -> tuple[Any, ...]:
    """Return what the oracle's function of a loss takes behind picture and target."""
    kept = mask if options["masked"] else None
    if options["loss"] in ("l1", "l2"):
        return (kept,)
    if options["loss"] == "ssim":
        return (options["padding"],)
    return (*(() if options["loss"] == "d_ssim" else (options["share"],)), options["padding"], kept)


def _loss(
    name: str, padding: Any, masked: bool, shape: tuple[int, int, int] = (17, 19, 3), contrast: float = 1.0
) -> Vector:
    picture, target = (_in_float32(contrast * (pattern(seed, shape) - 0.5) + 0.5) for seed in (3, 11))
    mask = pattern(5, shape[:2]) > 0.4 if masked else np.ones(shape[:2], dtype=bool)
    options = {"loss": name, "padding": padding, "masked": masked, "share": SHARE, "v_loss": V_LOSS}
    arguments = loss_arguments(options, mask)
    of_value, of_gradient = 0.0, np.zeros_like(picture)
    if name not in ("l1", "l2"):
        forms = [d_ssim_magnitudes(picture, target, padding, mask, form) for form in ("textbook", "difference")]
        of_value, of_gradient = max(f.value for f in forms) + 1.0, np.maximum(*[f.gradient for f in forms])
    if name not in ("ssim", "d_ssim"):
        pixels = pixelwise_magnitudes(picture, target, 2 if name in ("l2", "photometric_pop") else 1, mask)
        of_value, of_gradient = of_value + pixels.value, of_gradient + pixels.gradient
    arrays = {
        "picture": picture,
        "target": target,
        "mask": mask,
        "loss": np.array(LOSSES[name](picture, target, *arguments)),
        "error_bound_loss": np.array(of_value),
        "v_picture": _PULLED[name](picture, target, V_LOSS, *arguments),
        "error_bound_v_picture": of_gradient + 1.0 / picture.size,
    }
    return arrays, options


def pop_kind() -> dict[str, Any]:
    """Return what the index says of the POP loss."""
    arrays = {
        "opacities": entry("input", "[N]", "in [0, 1]"),
        "dominant_counts": entry("input", "[N]", "pixels that each Gaussian has dominated", "int64"),
        "important": entry("output", "[N]", "1 for a Gaussian that has dominated a pixel, else 0", "int64", [equal()]),
        **output("pop_loss", "[]", "mean of 1 - o over the important + mean of o over the others", "polarization.loss"),
        **output("v_opacities", "[N]", "derivative of v_loss times the loss", "polarization.gradient"),
    }
    return {
        "about": "the importance mask and the polarized opacity prior, whose empty side adds nothing",
        "arrays": arrays,
    }


def pop_vectors() -> dict[str, Vector]:
    """Return the loss with some, all and none important."""
    opacities = _in_float32(np.array([0.0, 0.003, 0.25, 0.5, 0.75, 0.9, 1.0]))
    some, found = np.array([0, 3, 0, 1, 0, 0, 12]), {}
    for name, counts in (("some", some), ("all", some + 1), ("none", 0 * some)):
        mask = importance_mask(counts)
        v_opacities = pop_loss_vjp(opacities, mask, V_LOSS)
        arrays = {
            "opacities": opacities,
            "dominant_counts": counts,
            "important": mask.astype(np.int64),
            "pop_loss": np.array(pop_loss(opacities, mask)),
            "error_bound_pop_loss": np.array(2.0),
            "v_opacities": v_opacities,
            "error_bound_v_opacities": np.abs(v_opacities),
        }
        found[f"pop_loss_{name}_important"] = (arrays, {"v_loss": V_LOSS})
    return found


def adam_kind() -> dict[str, Any]:
    """Return what the index says of Adam."""
    arrays = {
        "param": entry("input", "[N]", "before the step"),
        "grad": entry("input", "[N]", "its gradient"),
        "m": entry("input", "[N]", "first moments before the step"),
        "v": entry("input", "[N]", "second moments before the step"),
        **output("new_param", "[N]", "after the step", "optimizer.adam"),
        **output("new_m", "[N]", "beta1 m + (1 - beta1) grad", "optimizer.adam"),
        **output("new_v", "[N]", "beta2 v + (1 - beta2) grad^2", "optimizer.adam"),
    }
    about = "new_param = param - lr new_m / (1 - beta1^t) / (sqrt(new_v / (1 - beta2^t)) + eps), t = 'step' from 1"
    return {"about": about, "arrays": arrays}


def adam_vectors() -> dict[str, Vector]:
    """Return a first step, a later one, and steps of gradients that are very small or zero."""
    grad = _in_float32(np.array([0.0, 1.0, -0.25, 3e-3, -7.0]))
    tiny = _in_float32(np.array([0.0, 1e-10, -1e-8, 1e-6, -1e-4]))
    param, zero = _in_float32(np.array([0.5, -2.0, 0.1, 4.0, 0.0])), np.zeros(5)
    m, v = _in_float32(0.5 * grad[::-1] + 0.125), _in_float32(grad[::-1] ** 2 + 2.0**-10)
    given = {
        "adam_first_step": (grad, zero, zero, 1),
        "adam_first_step_of_small_gradients": (tiny, zero, zero, 1),
        "adam_later_step": (grad, m, v, 1234),
        "adam_moments_alone": (zero, m, v, 7),
    }
    return {name: _adam(param, *values) for name, values in given.items()}


def _adam(param: np.ndarray, grad: np.ndarray, m: np.ndarray, v: np.ndarray, step: int) -> Vector:
    options = {"step": step, "lr": 2.0**-6, "beta1": BETAS[0], "beta2": BETAS[1], "eps": EPS}
    x, new_m, new_v = adam_step({"x": param}, {"x": grad}, {"x": m}, {"x": v}, step, {"x": options["lr"]})
    arrays = {
        "param": param,
        "grad": grad,
        "m": m,
        "v": v,
        "new_param": x["x"],
        "error_bound_new_param": np.abs(param) + 4.0 * np.abs(x["x"] - param),
        "new_m": new_m["x"],
        "error_bound_new_m": np.abs(m) + np.abs(grad),
        "new_v": new_v["x"],
        "error_bound_new_v": new_v["x"],
    }
    return arrays, options


_RAW = {
    "means": ("3", "centres, world units"),
    "log_scales": ("3", "logarithms of the standard deviations"),
    "quats": ("4", "rotations w x y z"),
    "logit_opacities": ("", "logits of the opacities"),
    "sh0": ("1, 3", "harmonics of degree 0"),
}
_KEYS = {"log_scales": "scales", "logit_opacities": "opacities"}


def density_kind() -> dict[str, Any]:
    """Return what the index says of density steps."""

    def shape(rows: str, rest: str) -> str:
        return f"[{rows}, {rest}]" if rest else f"[{rows}]"

    arrays = {name: entry("input", shape("N", rest), said) for name, (rest, said) in _RAW.items()}
    arrays |= {
        "grad_sum": entry("input", "[N]", "sum of screen-gradient norms over the window, NDC"),
        "n_visible": entry("input", "[N]", "views of the window that showed the Gaussian", "int64"),
        "blurred": entry("input", "[N]", "whether the blur rule marked it", "bool"),
        "normals": entry(
            "input", "[2, N, 3]", "standard normal draws for the two children of each row, if it is split"
        ),
        "cloned": entry("output", "[N]", "1 where a row is cloned", "int64", [equal()]),
        "split": entry("output", "[N]", "1 where a row is split", "int64", [equal()]),
    }
    for name, (rest, said) in _RAW.items():
        arrays |= output(f"new_{name}", shape("M", rest), f"{said}, after the step", "density.split")
    about = (
        "one step of density control: clones are appended; then split rows make way for two children each, appended, "
        "with mean + R(q) (scale * normal) and scale / 1.6; then rows are pruned. 'config' names the thresholds"
    )
    return {"about": about, "arrays": arrays}


def density_vectors() -> dict[str, Vector]:
    """Return steps under POP's and gsplat's rules, in and behind the blur window."""
    given = {"pop_in_the_blur_window": (POP, 4000), "pop_after_it": (POP, 8000), "gsplat": (GSPLAT, 2000),
             "revised_opacity": (dataclasses.replace(GSPLAT, revised_opacity=True), 4000)}  # fmt: skip
    return {f"density_{name}": _density(config, step) for name, (config, step) in given.items()}


def density_inputs(arrays: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], Statistics]:
    """Return raw parameters and statistics as the oracle takes them."""
    params = {_KEYS.get(name, name): arrays[name] for name in _RAW}
    n = len(arrays["means"])
    none = np.zeros(n, dtype=np.int64)
    return params, Statistics(arrays["grad_sum"], arrays["n_visible"], 4, none, arrays["blurred"])


def density_rows(params: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return parameters after a step under the vector's names."""
    return {f"new_{name}": params[_KEYS.get(name, name)] for name in _RAW}


def _density(config: DensityConfig, step: int) -> Vector:
    rng, n = np.random.default_rng(step), 12
    given: dict[str, np.ndarray] = {
        "means": _in_float32(rng.uniform(-2.0, 2.0, (n, 3))),
        # small, large, and far too large in turns; no largest scale is within a tenth of a threshold
        "log_scales": _in_float32(np.log(np.tile([0.004, 0.03, 0.25], 4)[:, None] * rng.uniform(0.5, 0.8, (n, 3)))),
        "quats": _in_float32(rng.normal(size=(n, 4))),
        "logit_opacities": _in_float32(np.tile([-9.0, -1.0, 0.0, 4.0, 1.0], 3)[:n]),
        "sh0": _in_float32(rng.normal(size=(n, 1, 3))),
        "grad_sum": _in_float32(np.tile([0.0, 1e-3, 4e-3, 2e-4], 3)),
        "n_visible": np.tile([0, 2, 4, 3], 3),
        "blurred": np.arange(n) % 5 == 0,
        "normals": _in_float32(rng.normal(size=(2, n, 3))),
    }
    params, statistics = density_inputs(given)
    clone, split = grow_masks(statistics, scales_from_log_scales(given["log_scales"]), 1.0, step, config)
    rows, _ = densify_and_prune(
        rows_from_params(params), statistics, 1.0, step, lambda _: given["normals"][:, split], config
    )
    found = density_rows(dict(rows.params))
    arrays = {**given, "cloned": clone.astype(np.int64), "split": split.astype(np.int64), **found}
    bounds = {f"error_bound_{name}": np.abs(value) + 1.0 for name, value in found.items()}
    # a logit costs the rounding of what its opacity leaves open
    opacities = opacities_from_logits(found["new_logit_opacities"])
    bounds["error_bound_new_logit_opacities"] += 1.0 / np.minimum(opacities, 1.0 - opacities)
    options = {"step": step, "scene_scale": 1.0, "n_views": 4, "config": dataclasses.asdict(config)}
    return arrays | bounds, options
