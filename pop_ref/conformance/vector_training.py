"""Portable vectors of what trains: losses, the POP loss, steps of Adam and of density control, and whole trainings.

A whole training is what a script shows to a method, and what becomes of the Gaussians. Whoever answers takes every
number from the file: views and gradients in the order of the steps, passes by what was asked for, random numbers one
after the other. A training that parts from the recorded one asks for what is not there.
"""

from __future__ import annotations

import dataclasses
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from pop_ref import losses, methods, ssim
from pop_ref.activations import opacities_from_logits, scales_from_log_scales
from pop_ref.conformance.scenes import in_precision, pattern
from pop_ref.conformance.strategy_script import METHODS, READINGS, Draws, Script, script_of, trainings_of
from pop_ref.conformance.vector_check import axes, entry, equal, output
from pop_ref.contributions import Contributions
from pop_ref.density import Statistics, densify_and_prune, grow_masks, rows_from_params
from pop_ref.density_rows import Rows
from pop_ref.magnitudes import d_ssim_magnitudes, pixelwise_magnitudes
from pop_ref.methods import KEYS
from pop_ref.optimizer import BETAS, EPS, adam_step
from pop_ref.polarization import importance_mask, pop_loss, pop_loss_vjp
from pop_ref.scripted import Pass, ScriptedView
from pop_ref.settings import GSPLAT, POP, DensityConfig, LearningRates

Vector = tuple[dict[str, np.ndarray], dict[str, Any]]
# by the module of the loss and of its gradient
LOSSES = {
    "l1": losses,
    "l2": losses,
    "ssim": ssim,
    "d_ssim": ssim,
    "photometric_3dgs": losses,
    "photometric_pop": losses,
}
V_LOSS = 0.75
SHARE = 0.25


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
    picture, target = (in_precision(contrast * (pattern(seed, shape) - 0.5) + 0.5) for seed in (3, 11))
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
        "loss": np.array(getattr(LOSSES[name], name)(picture, target, *arguments)),
        "error_bound_loss": np.array(of_value),
        "v_picture": getattr(LOSSES[name], f"{name}_vjp")(picture, target, V_LOSS, *arguments),
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
    opacities = in_precision(np.array([0.0, 0.003, 0.25, 0.5, 0.75, 0.9, 1.0]))
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
    grad = in_precision(np.array([0.0, 1.0, -0.25, 3e-3, -7.0]))
    tiny = in_precision(np.array([0.0, 1e-10, -1e-8, 1e-6, -1e-4]))
    param, zero = in_precision(np.array([0.5, -2.0, 0.1, 4.0, 0.0])), np.zeros(5)
    m, v = in_precision(0.5 * grad[::-1] + 0.125), in_precision(grad[::-1] ** 2 + 2.0**-10)
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
    arrays = {name: entry("input", axes("N", rest), said) for name, (rest, said) in _RAW.items()}
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
        arrays |= output(f"new_{name}", axes("M", rest), f"{said}, after the step", "density.split")
    about = (
        "one step of density control: clones are appended; then split rows make way for two children each, appended, "
        "with mean + R(q) (scale * normal) and scale / 1.6; then rows are pruned. 'config' names the thresholds"
    )
    return {"about": about, "arrays": arrays}


def density_vectors() -> dict[str, Vector]:
    """Return steps under POP's and gsplat's rules, in and behind the blur window; of one a row is cloned and split."""
    given = {"pop_in_the_blur_window": (POP, 4000), "pop_after_it": (POP, 8000), "gsplat": (GSPLAT, 2000),
             "revised_opacity": (dataclasses.replace(GSPLAT, revised_opacity=True), 4000)}  # fmt: skip
    found = {f"density_{name}": _density(config, step) for name, (config, step) in given.items()}
    both = dataclasses.replace(POP, blur_rule="split", grow_on_gradient_in_blur_window=True)
    return found | {"density_cloned_and_split": _density(both, 5000, blurred_every=3)}


def density_inputs(arrays: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], Statistics]:
    """Return raw parameters and statistics as the oracle takes them."""
    params = {_KEYS.get(name, name): arrays[name] for name in _RAW}
    n = len(arrays["means"])
    none = np.zeros(n, dtype=np.int64)
    return params, Statistics(arrays["grad_sum"], arrays["n_visible"], 4, none, arrays["blurred"])


def density_rows(params: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return parameters after a step under the vector's names."""
    return {f"new_{name}": params[_KEYS.get(name, name)] for name in _RAW}


def _density(config: DensityConfig, step: int, blurred_every: int = 5) -> Vector:
    rng, n = np.random.default_rng(step), 12
    given: dict[str, np.ndarray] = {
        "means": in_precision(rng.uniform(-2.0, 2.0, (n, 3))),
        # small, large, and far too large in turns; no largest scale is within a tenth of a threshold
        "log_scales": in_precision(np.log(np.tile([0.004, 0.03, 0.25], 4)[:, None] * rng.uniform(0.5, 0.8, (n, 3)))),
        "quats": in_precision(rng.normal(size=(n, 4))),
        "logit_opacities": in_precision(np.tile([-9.0, -1.0, 0.0, 4.0, 1.0], 3)[:n]),
        "sh0": in_precision(rng.normal(size=(n, 1, 3))),
        "grad_sum": in_precision(np.tile([0.0, 1e-3, 4e-3, 2e-4], 3)),
        "n_visible": np.tile([0, 2, 4, 3], 3),
        "blurred": np.arange(n) % blurred_every == 0,
        "normals": in_precision(rng.normal(size=(2, n, 3))),
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


DONE: Final = ("cloned", "split", "pruned", "replaced", "reset")
_OF_PARAMS: Final = {"means": "3", "scales": "3", "quats": "4", "opacities": "", "sh0": "1, 3", "shN": "15, 3"}
_VIEW: Final = ("v_means2d", "absolute", "radii", "dominant_counts")
_OF_ROWS: Final = ("dominant_counts", "radii", "depths", "sensitivities", "blocks")
_OF_PIXELS: Final = ("image", "points", "ids", "T_final")
_SUMS: Final = ("weight_sum", "n_pixels", "map_sum", "distance_sum")
_OPTIONS: Final = ("method", "cameras", "packed", "scene_scale", "max_steps", "n_views", "width", "height")


def scripts() -> dict[str, Script]:
    """Return the trainings by name."""
    found = {}
    for method in METHODS:
        found[f"training_{method}"], found[f"training_{method}_of_two_cameras"] = trainings_of(method)
    late = {"pop_start_iter": 5, "pop_stop_iter": 15, "refine_start_iter": 100, "lambda_pop": 0.5}
    found["training_prior_alone"] = script_of("pop", settings=late, steps=(0, 4, 5, 6, 14, 15, 16), quiet=True)
    every = {"lambda_pop": 1.0, "pop_over": "visible"}
    found["training_prior_of_four_cameras"] = script_of("pop", settings=every, steps=(2, 3), cameras=4)
    found |= {f"training_reading_{k}": script for k, script in enumerate(READINGS)}
    return {name.replace("-", "_"): script for name, script in found.items()}


class Recorder:
    """A script that keeps what it has shown.

    Attributes:
        views, gradients: by step.
        passes: by view, number of Gaussians, bands and divisor.
        numbers: random ones.
    """

    def __init__(self, script: Script) -> None:
        self._script, self.numbers = script, KeptDraws(script.draws())
        self.seen: dict[int, ScriptedView] = {}
        self.pulled: dict[int, dict[str, np.ndarray]] = {}
        self.passes: dict[tuple[int, ...], Pass] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._script, name)

    def rows(self) -> Rows:
        """Return the Gaussians to start from, exact in float32."""
        rows = self._script.rows()
        return Rows(*({k: in_precision(v) for k, v in of.items()} for of in (rows.params, rows.m, rows.v)))

    def view(self, step: int, n: int) -> ScriptedView:
        """Show a render."""
        self.seen[step] = self._script.view(step, n)
        return self.seen[step]

    def gradients(self, step: int, shapes: Any) -> dict[str, np.ndarray]:
        """Show gradients."""
        self.pulled[step] = self._script.gradients(step, shapes)
        return dict(self.pulled[step])

    def over(self, index: int, n: int, sh_degree: int = 0, divisor: int = 1) -> Pass:
        """Show a pass."""
        return self.passes.setdefault((index, n, sh_degree, divisor), self._script.over(index, n, sh_degree, divisor))

    def draws(self) -> KeptDraws:
        """Show random numbers."""
        return self.numbers


class KeptDraws:
    """Random numbers that are kept as they are drawn, all exact in single precision.

    Attributes:
        drawn: every call's numbers, flat.
    """

    def __init__(self, source: Draws) -> None:
        self._source, self.drawn = source, list[np.ndarray]()

    @property
    def flat(self) -> np.ndarray:
        """Return all numbers in the order of their use."""
        return np.concatenate([np.zeros(0), *self.drawn])

    def normals(self, n: int) -> np.ndarray:
        """Draw for the children of n split parents. [2, n, 3]"""
        return self._kept(self._source.normals(n))

    def uniforms(self, n: int) -> np.ndarray:
        """Draw from [0, 1), in steps that float32 has. [n]"""
        return self._kept(np.floor(2.0**23 * self._source.uniforms(n)) / 2.0**23)

    def _kept(self, values: np.ndarray) -> np.ndarray:
        self.drawn.append(values.reshape(-1))
        return values


class HeldDraws:
    """The random numbers of a vector, one after the other.

    Args:
        values: all of them. Drawing more raises LookupError.
    """

    def __init__(self, values: np.ndarray) -> None:
        self._values, self._used = values, 0

    def normals(self, n: int) -> np.ndarray:
        """Draw for the children of n split parents. [2, n, 3]"""
        return self._next(6 * n).reshape(2, n, 3)

    def uniforms(self, n: int) -> np.ndarray:
        """Draw from [0, 1). [n]"""
        return self._next(n)

    def _next(self, count: int) -> np.ndarray:
        self._used += count
        if self._used > len(self._values):
            raise LookupError(f"{self._used} random numbers are drawn, {len(self._values)} are there")
        return self._values[self._used - count : self._used]


class Replay:
    """A script that shows what a vector holds, and nothing else.

    Args:
        arrays: of the vector.
        options: of the vector.
    """

    def __init__(self, arrays: dict[str, np.ndarray], options: dict[str, Any]) -> None:
        self._arrays = arrays
        self.settings = {k: tuple(v) if isinstance(v, list) else v for k, v in options["settings"].items()}
        self.lr, self.steps = LearningRates(**options["lr"]), tuple(int(step) for step in arrays["steps"])
        for name in _OPTIONS:
            setattr(self, name, options[name])
        self.n = len(arrays["means"])
        self._ends = np.cumsum(arrays["step_rows"])
        self._pass_ends = np.cumsum(arrays["passes"][:, 1])

    def rows(self) -> Rows:
        """Return the Gaussians to start from."""
        return Rows(*({key: self._arrays[f"{kind}{key}"] for key in KEYS} for kind in ("", "m_", "v_")))

    def view(self, step: int, n: int) -> ScriptedView:
        """Return the render of a step. Raises LookupError where it is of another number of Gaussians."""
        rows, kept = self._rows(step, n), int(self._arrays["kept_pixels"][self.steps.index(step)])
        given = {name: np.swapaxes(self._arrays[name][rows], 0, 1) for name in _VIEW}
        return ScriptedView(**given, kept_pixels=None if kept < 0 else kept)

    def gradients(self, step: int, shapes: Any) -> dict[str, np.ndarray]:
        """Return the gradients of a step."""
        rows = self._rows(step, shapes["means"][0])
        return {key: self._arrays[f"grad_{key}"][rows] for key in KEYS}

    def over(self, index: int, n: int, sh_degree: int = 0, divisor: int = 1) -> Pass:
        """Return a pass. Raises LookupError where none of these was recorded."""
        at = np.flatnonzero(np.all(self._arrays["passes"] == (index, n, sh_degree, divisor), axis=1))
        if not len(at):
            raise LookupError(f"no pass over view {index} of {n} Gaussians, {sh_degree} bands, {divisor} times smaller")
        k, rows = int(at[0]), slice(self._pass_ends[at[0]] - n, self._pass_ends[at[0]])
        # what is shown a pass may add to its arrays
        found = Contributions(*(self._arrays[f"pass_{name}"][rows].copy() for name in _SUMS))
        of_rows = {name: self._arrays[f"pass_{name}"][rows].copy() for name in _OF_ROWS}
        return Pass(found, **of_rows, **{name: self._arrays[f"pass_{name}"][k] for name in _OF_PIXELS})

    def photo(self, index: int) -> np.ndarray:
        """Return a photograph."""
        return self._arrays["photos"][index].astype(np.uint8)

    def mask(self, index: int) -> np.ndarray | None:
        """Return a mask; None where all pixels count."""
        mask = self._arrays["masks"][index]
        return None if np.all(mask) else mask

    def draws(self) -> HeldDraws:
        """Return the random numbers."""
        return HeldDraws(self._arrays["draws"])

    def sh_degree(self, step: int) -> int:
        """Return the bands that are drawn at a step."""
        return int(self._arrays["sh_degrees"][self.steps.index(step)])

    def _rows(self, step: int, n: int) -> slice:
        at = self.steps.index(step)
        if self._arrays["step_rows"][at] != n:
            raise LookupError(f"step {step} begins with {self._arrays['step_rows'][at]} Gaussians, not with {n}")
        return slice(self._ends[at] - n, self._ends[at])


def training_vectors() -> dict[str, Vector]:
    """Return what the oracle makes of every training."""
    return {name: _training(script) for name, script in scripts().items()}


def _training(script: Script) -> Vector:
    shown = Recorder(script)
    rows = shown.rows()
    arrays: dict[str, Any] = {key: rows.params[key] for key in KEYS}
    for kind in ("m", "v"):
        arrays |= {f"{kind}_{key}": getattr(rows, kind)[key] for key in KEYS}
    taken: Any = shown
    outputs = step_sums(methods.scripted_steps(taken, rows))
    views = [shown.seen[step] for step in script.steps]
    arrays |= {"steps": np.array(script.steps), "sh_degrees": np.array([script.sh_degree(s) for s in script.steps])}
    arrays["step_rows"] = np.array([view.radii.shape[1] for view in views])
    arrays["kept_pixels"] = np.array([-1 if view.kept_pixels is None else view.kept_pixels for view in views])
    arrays |= {name: np.concatenate([np.swapaxes(getattr(v, name), 0, 1) for v in views]) for name in _VIEW}
    arrays |= {f"grad_{key}": np.concatenate([shown.pulled[s][key] for s in script.steps]) for key in KEYS}
    arrays |= _passes(script, shown.passes)
    arrays["draws"] = shown.numbers.flat
    settings = {**methods.method_settings(str(script.method)), **script.settings}
    options = {name: getattr(script, name) for name in _OPTIONS}
    return arrays | outputs, {**options, "settings": settings, "lr": asdict(script.lr)}


def _passes(script: Script, passes: dict[tuple[int, ...], Pass]) -> dict[str, np.ndarray]:
    keys = list(passes)
    # a training without passes still tells of which form they are
    every = list(passes.values()) or [script.over(0, 1)]
    stop = None if passes else 0
    found: dict[str, np.ndarray] = {"passes": np.array(keys, dtype=np.int64).reshape(-1, 4)}
    found |= {f"pass_{n}": np.concatenate([getattr(p.found, n) for p in every])[:stop] for n in _SUMS}
    found |= {f"pass_{n}": np.concatenate([getattr(p, n) for p in every])[:stop] for n in _OF_ROWS}
    found |= {f"pass_{n}": np.stack([getattr(p, n) for p in every])[:stop] for n in _OF_PIXELS}
    masks = [script.mask(k) for k in range(script.n_views)]
    whole = np.ones((script.height, script.width), dtype=bool)
    found["photos"] = np.stack([script.photo(k) for k in range(script.n_views)]).astype(np.int64)
    return found | {"masks": np.stack([whole if mask is None else mask for mask in masks])}


def step_sums(steps: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Return what a training did at every step, its Gaussians as weighted sums, with error bounds."""
    found: dict[str, np.ndarray] = {
        "rows": np.array([len(step["params"]["means"]) for step in steps]),
        "done": np.array([[int(step["done"].get(name, 0)) for name in DONE] for step in steps]),
        "counters": np.array([[int(step["counters"][key]) for key in KEYS] for step in steps]),
        "terms": np.array([step["term"] for step in steps]),
    }
    found["error_bound_terms"] = np.abs(found["terms"])
    for kind in ("params", "m", "v"):
        for key in KEYS:
            values = [step[kind][key] for step in steps]
            found[f"sums_{kind}_{key}"] = np.stack([_weighted(value) for value in values])
            found[f"error_bound_sums_{kind}_{key}"] = np.stack([_weighted(np.abs(value) + 1.0) for value in values])
    return found


def _weighted(values: np.ndarray) -> np.ndarray:
    return np.tensordot(1.0 + np.mod(7.0 * np.arange(len(values)), 16.0), values, axes=1)


def training_kind() -> dict[str, Any]:
    """Return what the index says of trainings."""
    arrays: dict[str, Any] = {}
    for key, rest in _OF_PARAMS.items():
        arrays[key] = entry("input", axes("N", rest), f"raw {key} at the start: logarithms, logits")
        arrays |= {f"{k}_{key}": entry("input", axes("N", rest), f"Adam's moments {k} of {key}") for k in ("m", "v")}
        arrays[f"grad_{key}"] = entry("input", axes("R", rest), f"gradients of raw {key}, step after step; no prior's")
    arrays |= {name: entry("input", *about) for name, about in _SHOWN.items()}
    arrays["masks"]["dtype"] = "bool"
    whole = ("steps", "sh_degrees", "step_rows", "kept_pixels", "radii", "dominant_counts", "passes", "pass_n_pixels",
             "pass_dominant_counts", "pass_radii", "pass_ids", "photos")  # fmt: skip
    for name in whole:
        arrays[name]["dtype"] = "int64"
    for name, (form, meaning) in {
        "rows": ("[S]", "Gaussians after the step"),
        "done": ("[S, 5]", f"how many were {', '.join(DONE[:-1])}, and whether all were reset"),
        "counters": ("[S, 6]", f"updates that Adam counts of {', '.join(KEYS)}"),
    }.items():
        arrays[name] = entry("output", form, meaning, "int64", [equal()])
    arrays |= output("terms", "[S]", "the prior's term of the loss", "training.term")
    for kind, what in (("params", "raw"), ("m", "first moments of"), ("v", "second moments of")):
        for key, rest in _OF_PARAMS.items():
            said = f"{what} {key} after the step: rows i, each times 1 + 7 i mod 16, summed"
            arrays |= output(f"sums_{kind}_{key}", axes("S", rest), said, "training.rows")
    about = (
        "a training by 'method' under 'settings': at every step Adam, then statistics, then what the method does to "
        "the Gaussians. Views and gradients are given, so that nothing is drawn; 'passes' says which view, of how many "
        "Gaussians, under how many bands and how much smaller each pass over a training view is"
    )
    return {"about": about, "arrays": arrays}


_SHOWN: Final = {
    "steps": ("[S]", "numbers of the steps"),
    "sh_degrees": ("[S]", "bands that are drawn"),
    "step_rows": ("[S]", "Gaussians before the step; R is their sum"),
    "kept_pixels": ("[S]", "pixels that a mask keeps, -1 without a mask"),
    "v_means2d": ("[R, C, 2]", "gradient of the mean loss to the screen centres, per px"),
    "absolute": ("[R, C, 2]", "the same of absolute values (AbsGS)"),
    "radii": ("[R, C, 2]", "extents, px; 0 on an axis where the camera does not see it"),
    "dominant_counts": ("[R, C]", "pixels that each dominates"),
    "passes": ("[P, 4]", "view, Gaussians, bands, divisor; Q is the sum of the second"),
    "pass_weight_sum": ("[Q]", "sums of weights"),
    "pass_n_pixels": ("[Q]", "pixels that it is blended at"),
    "pass_distance_sum": ("[Q]", "sums of distances to the centre"),
    "pass_map_sum": ("[Q]", "sums of a map, of which the mean is taken"),
    "pass_dominant_counts": ("[Q]", "pixels that each dominates"),
    "pass_radii": ("[Q, 2]", "extents, px"),
    "pass_depths": ("[Q]", "camera z"),
    "pass_sensitivities": ("[Q]", "Speedy-Splat's scores"),
    "pass_blocks": ("[Q, 6, 6]", "PUP-3DGS's blocks"),
    "pass_image": ("[P, H, W, 3]", "what is drawn"),
    "pass_points": ("[P, H, W, 3]", "the point that a pixel shows"),
    "pass_ids": ("[P, H, W]", "the Gaussian that it belongs to, -1 none"),
    "pass_T_final": ("[P, H, W]", "transmittance"),
    "photos": ("[V, H, W, 3]", "photographs, 0 to 255"),
    "masks": ("[V, H, W]", "pixels of a training view that count"),
    "draws": ("[U]", "random numbers in the order of their use: normals [2, n, 3] of n split parents, uniforms [n]"),
}
