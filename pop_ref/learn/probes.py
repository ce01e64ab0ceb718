"""The course's own inputs of every function: a few plain ones, and ones that only a part of the definition decides.

Each special input says in words what is special about it, so that a function which is wrong on these alone can be told
so. All are drawn once from fixed seeds: a solution that is judged twice is judged alike.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np

from pop_ref.density import POP, Statistics
from pop_ref.density_rows import Rows
from pop_ref.learn.course import COURSE
from pop_ref.learn.probes_geometry import GEOMETRY, Probe
from pop_ref.learn.splat import orbit
from pop_ref.pixel import SplatRows, composite_pixel, zero_gradients
from pop_ref.recipes import RECIPES
from pop_ref.records import Camera
from pop_ref.render import RenderGradients
from pop_ref.training import Training, start


@functools.cache
def oracle() -> dict[str, Callable[..., Any]]:
    """Return the oracle's functions of the course by name."""
    return {
        name: getattr(importlib.import_module(f"pop_ref.{home}"), name)
        for stage in COURSE
        for home, names in stage.functions.items()
        for name in names
    }


def probes(name: str) -> list[Probe]:
    """Return a function's inputs, plain ones first.

    Example:
        >>> [words for words, _ in probes("falloff")]
        ['', '', '', 'sigma is 0']
    """
    rng = np.random.default_rng(11)
    if name in _PROBES:
        found = list(_PROBES[name](rng))
    else:
        forward = name.removesuffix("_vjp")
        found = [
            (words, (*given, _cotangent(oracle()[forward](*given), rng))) for words, given in _PROBES[forward](rng)
        ]
    return sorted(found, key=lambda probe: probe[0] != "")


def _cotangent(result: Any, rng: np.random.Generator) -> Any:
    """Draw a cotangent of a result: no entry near 0, both signs, no symmetry."""
    shape = np.shape(result)
    v = rng.uniform(0.5, 2.0, shape) * rng.choice([-1.0, 1.0, 1.0], shape)
    return float(v) if shape == () else v


def _at_pixel(rng: np.random.Generator) -> Iterator[Probe]:
    for _ in range(4):
        a, c = rng.uniform(0.5, 2.0, 2)
        b = rng.uniform(-0.4, 0.4)
        mean2d = tuple(rng.uniform(0.0, 8.0, 2).tolist())
        yield "", (mean2d, (float(a), float(b), float(c)), 3.5, 5.5)


def _sigmas(rng: np.random.Generator) -> Iterator[Probe]:
    for sigma in (0.5, 1.75, 3.25):
        yield "", (sigma,)
    yield "sigma is 0", (0.0,)


def _alphas(rng: np.random.Generator) -> Iterator[Probe]:
    for sigma, opacity in ((0.5, 0.5), (1.25, 0.75), (2.0, 0.875)):
        yield "", (sigma, opacity)
    yield "alpha is over the ceiling of 0.999 and cut there", (0.0, 1.0)
    yield "alpha is over the ceiling of 0.999 and cut there", (0.0002, 0.9999)
    yield "alpha is under the floor of 1/255, where the splat is skipped", (6.0, 0.5)
    yield "alpha is under the floor of 1/255, where the splat is skipped", (0.0, 0.0035)
    yield "sigma is negative, where the splat is skipped", (-0.25, 0.5)
    yield "alpha is exactly the floor of 1/255, where the splat is still drawn", (0.0, 1.0 / 255.0)
    yield "alpha is exactly the ceiling of 0.999, which is not over it", (0.0, 0.999)


def _alphas_back(rng: np.random.Generator) -> Iterator[Probe]:
    for k, (words, given) in enumerate(_alphas(rng)):
        yield words, (*given, (1.0, -2.0, 0.5)[k % 3])


def _stops(rng: np.random.Generator) -> Iterator[Probe]:
    for next_T in (0.5, 0.01, 2e-4, 5e-5, 1e-9):
        yield "", (next_T,)
    yield "the light left is exactly 1e-4, where the pixel stops", (1e-4,)


def _stack(rng: np.random.Generator, opacities: list[float]) -> SplatRows:
    n = len(opacities)
    means = rng.uniform(1.0, 4.0, (n, 2)).tolist()
    conics = rng.uniform([0.02, -0.01, 0.02], [0.1, 0.01, 0.1], (n, 3)).tolist()
    return SplatRows(means, conics, opacities, rng.uniform(0.1, 1.0, (n, 3)).tolist())


def _pixels(rng: np.random.Generator) -> Iterator[Probe]:
    background = [0.25, 0.5, 1.0]
    yield "", ([0], _stack(rng, [0.6]), 2.5, 2.5, background)
    yield "", ([2, 0, 1], _stack(rng, [0.6, 0.4, 0.8]), 2.5, 2.5, background)
    yield "", ([3, 1, 0, 2], _stack(rng, [0.5, 0.7, 0.6, 0.3]), 3.5, 1.5, background)
    yield "no splat is listed", ([], _stack(rng, [0.6]), 2.5, 2.5, background)
    walls = SplatRows([[2.5, 2.5]] * 4, [[0.2, 0.0, 0.2]] * 4, [0.75, 0.9995, 0.99, 0.5], [[0.5, 0.75, 0.25]] * 4)
    yield "the pixel stops before the end of its list", ([0, 1, 2, 3], walls, 2.5, 2.5, background)
    faint = walls._replace(opacities=[0.003, 0.5, 0.002, 0.25])
    yield "a splat is under the floor of 1/255 and skipped", ([0, 1, 2, 3], faint, 2.5, 2.5, background)


def _pixels_back(rng: np.random.Generator) -> Iterator[Probe]:
    for words, given in list(_pixels(rng)):
        rows, pixel = given[1], composite_pixel(*given)
        back = (pixel, rows, *given[2:], [0.5, -1.0, 2.0])
        yield words, (*back, 0.0, zero_gradients(len(rows.opacities), 3))
    ids, rows = [1, 0], _stack(rng, [0.5, 0.25])
    pixel = composite_pixel(ids, rows, 2.5, 2.5, [0.25, 0.5, 1.0])
    back = (pixel, rows, 2.5, 2.5, [0.25, 0.5, 1.0], [0.5, -1.0, 2.0])
    yield "the light that is left has a cotangent, too", (*back, 1.5, zero_gradients(2, 3))
    before = zero_gradients(2, 3)
    for total in before:
        total[...] = 1.0
    yield "the totals hold the sums of other pixels already", (*back, 0.0, before)


def _weights(rng: np.random.Generator) -> Iterator[Probe]:
    yield "", ([4, 2, 7], [0.25, 0.5, 0.125])
    yield "", ([0, 1, 2, 3], [0.125, 0.25, 0.0625, 0.375])
    yield "", ([5, 3], [0.75, 0.125])
    yield "two weights are equal, and the front one wins", ([4, 2, 7], [0.25, 0.5, 0.5])
    yield "nothing is blended", ([], [])
    yield "every weight is 0, and there is no winner", ([3, 0], [0.0, 0.0])


def _winners(rng: np.random.Generator) -> Iterator[Probe]:
    yield "", (np.array([[0, 2], [2, 1]]), 4)
    yield "", (rng.integers(0, 5, (4, 6)), 5)
    yield "a pixel has no winner (-1)", (np.array([[0, -1, 1], [-1, -1, 3]]), 4)


def _pictures(rng: np.random.Generator) -> Iterator[Probe]:
    for size in ((1, 2, 3), (4, 5, 3), (3, 2, 1)):
        yield "", (rng.uniform(0.0, 1.0, size), rng.uniform(0.0, 1.0, size))
    equal = rng.uniform(0.0, 1.0, (2, 2, 3))
    yield "picture and photograph are equal", (equal, equal.copy())
    mask = np.array([[True, False, True], [False, True, True]])
    pair = rng.uniform(0.0, 1.0, (2, 3, 3)), rng.uniform(0.0, 1.0, (2, 3, 3))
    yield "a mask leaves pixels out", (*pair, mask)
    yield "a mask leaves all pixels out", (*pair, np.zeros((2, 3), dtype=bool))


def _pictures_back(rng: np.random.Generator) -> Iterator[Probe]:
    for k, (words, given) in enumerate(_pictures(rng)):
        yield words, (*given[:2], (1.0, 2.0, 0.5, 1.0, 1.5, 1.0)[k], *given[2:])


def _counts(rng: np.random.Generator) -> Iterator[Probe]:
    yield "", (np.array([3, 0, 1]),)
    yield "", (rng.integers(0, 3, 7),)


def _poles(rng: np.random.Generator) -> Iterator[Probe]:
    for mask in ([True, False, False], [True, True, False, True, False]):
        yield "", (rng.uniform(0.0, 1.0, len(mask)), np.array(mask))
    yield "every Gaussian is important", (rng.uniform(0.0, 1.0, 3), np.ones(3, dtype=bool))
    yield "no Gaussian is important", (rng.uniform(0.0, 1.0, 3), np.zeros(3, dtype=bool))
    some = np.array([True, False, True, False, True])
    visible = np.array([True, True, False, False, True])
    yield "only the visible Gaussians take part", (rng.uniform(0.0, 1.0, 5), some, visible)


def _poles_back(rng: np.random.Generator) -> Iterator[Probe]:
    for k, (words, given) in enumerate(_poles(rng)):
        yield words, (*given[:2], (1.0, 0.25, 1.0, 1.0, 2.0)[k], *given[2:])


def _adam(rng: np.random.Generator) -> Iterator[Probe]:
    lr = {"a": 0.1, "b": 0.02}

    def state(scale: float = 1.0) -> tuple[dict[str, np.ndarray], ...]:
        shapes = {"a": (2,), "b": (3, 2)}
        params, grads, m = ({k: scale * rng.standard_normal(s) for k, s in shapes.items()} for _ in range(3))
        return params, grads, m, {k: scale**2 * rng.uniform(0.1, 1.0, s) for k, s in shapes.items()}

    for step in (2, 7, 40):
        yield "", (*state(), step, lr)
    params, grads, m, v = state()
    zero = {name: np.zeros_like(x) for name, x in params.items()}
    yield "it is the first step", (params, grads, zero, zero, 1, lr)
    yield "gradients are tiny, and eps decides", (*state(1e-13), 3, lr)
    yield "a parameter has no gradient and stays as it is", (params, {"a": grads["a"]}, m, v, 3, lr)
    yield "other betas and another eps are given", (params, grads, m, v, 3, lr, (0.8, 0.95), 0.5)
    by_name = {"a": 3, "b": 9}
    yield (
        "parameters have had different numbers of updates, and step has one for each",
        (params, grads, m, v, by_name, lr),
    )
    yield "the step is 0, and updates count from 1", (params, grads, m, v, 0, lr)


def _rows(rng: np.random.Generator, n: int) -> Rows:
    shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "sh0": (n, 1, 3)}
    params, m = ({name: rng.uniform(-1.0, 1.0, shape) for name, shape in shapes.items()} for _ in range(2))
    return Rows(params, m, {name: rng.uniform(0.1, 1.0, shape) for name, shape in shapes.items()})


def _masked_rows(rng: np.random.Generator) -> Iterator[Probe]:
    yield "", (_rows(rng, 3), np.array([True, False, False]))
    yield "", (_rows(rng, 5), np.array([False, True, False, True, False]))
    yield "no row is selected", (_rows(rng, 2), np.zeros(2, dtype=bool))


def _split(rng: np.random.Generator) -> Iterator[Probe]:
    for words, (rows, mask) in _masked_rows(rng):
        yield words, (rows, mask, rng.standard_normal((2, int(np.sum(mask)), 3)))


def _growing(rng: np.random.Generator) -> Iterator[Probe]:
    def window(grads: list[float], seen: list[int], blurred: list[bool]) -> Statistics:
        counts = np.array(seen)
        sums = np.array(grads) * np.maximum(counts, 1)
        return Statistics(sums, counts, 4, np.zeros(len(grads), dtype=np.int64), np.array(blurred))

    sizes = np.array([[0.001, 0.02, 0.003], [0.5, 0.005, 0.2], [0.004, 0.003, 0.001], [0.3, 0.6, 0.1]])
    none, hard = [False] * 4, [1e-3, 1e-3, 1.5e-4, 1e-5]
    for scale in (1.0, 4.0):
        yield "", (window(hard, [1, 2, 3, 1], none), sizes, scale, 600, POP)
    yield "", (window([1.5e-4, 3e-4, 3e-4, 1e-3], [4, 2, 1, 4], none), sizes, 1.0, 900, POP)
    some = [True, False, True, True]
    blurred = "a Gaussian is in the blur set, inside the blur window (steps 3000 to 7000, both included)"
    for step in (3000, 5000, 7000):
        yield blurred, (window([1e-5] * 4, [1] * 4, some), sizes, 1.0, step, POP)
    for step in (2900, 7100):
        yield "a blur flag is set outside the blur window", (window([1e-5] * 4, [1] * 4, some), sizes, 1.0, step, POP)
    yield "no view showed a Gaussian", (window([0.0, 1e-3, 0.0, 0.0], [0, 1, 0, 2], none), sizes, 1.0, 600, POP)
    exact = replace(POP, grow_grad2d=0.25, grow_scale3d=0.5)
    even = window([0.25, 0.5, 0.25, 0.5], [1, 1, 1, 1], none)
    edge = np.array([[0.5, 0.1, 0.1], [0.5, 0.1, 0.1], [0.75, 0.1, 0.1], [0.75, 0.1, 0.1]])
    yield "a gradient or a size is exactly at its threshold", (even, edge, 1.0, 600, exact)


def _pruning(rng: np.random.Generator) -> Iterator[Probe]:
    sizes = rng.uniform(0.01, 0.05, (4, 3))
    yield "", (np.array([0.001, 0.5, 0.0049, 0.9]), sizes, 1.0, 600, POP)
    yield "", (np.array([0.0051, 0.004, 0.2, 0.0]), sizes, 1.0, 900, POP)
    yield "an opacity is exactly at its threshold", (np.array([0.005, 0.5]), sizes[:2], 1.0, 600, POP)
    yield (
        "a Gaussian is very large, which POP does not prune",
        (np.array([0.5, 0.001]), 9.0 * np.ones((2, 3)), 1.0, 9000, POP),
    )
    yield "another threshold is given", (np.array([0.1, 0.3]), sizes[:2], 1.0, 600, replace(POP, prune_opa=0.2))


def _params(rng: np.random.Generator, n: int) -> dict[str, np.ndarray]:
    return {
        "means": rng.uniform(-0.5, 0.5, (n, 3)),
        "quats": rng.standard_normal((n, 4)),
        "scales": rng.uniform(-2.0, -1.0, (n, 3)),
        "opacities": rng.uniform(-1.0, 2.0, n),
        "sh0": rng.uniform(-0.5, 0.5, (n, 1, 3)),
    }


def _raw(rng: np.random.Generator) -> Iterator[Probe]:
    yield "", (_params(rng, 2),)
    yield "", (_params(rng, 3),)
    yield "there are harmonics of degree 1, in shN", ({**_params(rng, 2), "shN": rng.uniform(-1.0, 1.0, (2, 3, 3))},)


def _raw_back(rng: np.random.Generator) -> Iterator[Probe]:
    for words, (params,) in _raw(rng):
        n, rest = len(params["means"]), params.get("shN", np.zeros((len(params["means"]), 0, 3)))
        gradients = RenderGradients(
            means=rng.standard_normal((n, 3)),
            quats=rng.standard_normal((n, 4)),
            scales=rng.standard_normal((n, 3)),
            opacities=rng.standard_normal(n),
            sh=rng.standard_normal((n, 1 + rest.shape[1], 3)),
            viewmat=np.zeros((4, 4)),
            background=np.zeros(3),
            means2d=np.zeros((n, 2)),
            means2d_abs=np.zeros((n, 2)),
        )
        yield words, (params, gradients, rng.standard_normal(n))


def _zeros(n: int) -> np.ndarray:
    return np.zeros((2, n, 3))


def _steps(rng: np.random.Generator) -> Iterator[Probe]:
    viewmat, K, _, height = orbit(0.4, 12)
    # wider than high: x is not y
    camera, target = Camera(viewmat, K, 16, height), rng.uniform(0.0, 1.0, (height, 16, 3))
    recipe = RECIPES["POP"]
    for n in (2, 4):
        yield "", (start(_params(rng, n)), camera, target, 1.0, _zeros, recipe)
    rows = _rows(rng, 3)
    middle = start(rows.params)
    later = Training(Rows(_params(rng, 3), rows.m, rows.v), middle.statistics, 41)
    yield "it is not the first step, and Adam's moments are not 0", (later, camera, target, 1.0, _zeros, recipe)
    pulled = replace(middle.statistics, grad_sum=np.array([1.0, 0.0, 0.0]), n_visible=np.array([1, 1, 1]), n_views=1)
    editing = Training(later.rows, pulled, 600)
    yield "it is a densification step", (editing, camera, target, 1.0, _zeros, recipe)
    over = replace(recipe, pop_stop_iter=10)
    yield "the prior is over", (later, camera, target, 1.0, _zeros, over)


def _looks(rng: np.random.Generator) -> Iterator[Probe]:
    for where, (state, camera, target, scale, _, recipe) in _steps(rng):
        yield where, (state, camera, target, scale, recipe)


_PROBES: Final[dict[str, Callable[[np.random.Generator], Iterator[Probe]]]] = {
    **GEOMETRY,
    "sigma_at_pixel": _at_pixel,
    "falloff": _sigmas,
    "alpha_from_sigma": _alphas,
    "alpha_from_sigma_vjp": _alphas_back,
    "stops": _stops,
    "composite_pixel": _pixels,
    "composite_pixel_vjp": _pixels_back,
    "dominant_id": _weights,
    "dominant_counts": _winners,
    "l1": _pictures,
    "l1_vjp": _pictures_back,
    "l2": _pictures,
    "l2_vjp": _pictures_back,
    "importance_mask": _counts,
    "pop_loss": _poles,
    "pop_loss_vjp": _poles_back,
    "adam_step": _adam,
    "clone_rows": _masked_rows,
    "split_rows": _split,
    "prune_rows": _masked_rows,
    "grow_masks": _growing,
    "prune_mask": _pruning,
    "gaussians_from_params": _raw,
    "params_vjp": _raw_back,
    "look": _looks,
    "train_step": _steps,
}
