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

from pop_ref.covariance import rotmats_from_quats
from pop_ref.density import POP, Statistics
from pop_ref.density_rows import Rows
from pop_ref.harmonics import sh_basis
from pop_ref.learn.course import COURSE
from pop_ref.learn.splat import orbit
from pop_ref.pixel import SplatRows, composite_pixel, zero_gradients
from pop_ref.recipes import RECIPES
from pop_ref.records import Camera
from pop_ref.render import RenderGradients
from pop_ref.training import Training, start

# functions by name
Oracle = dict[str, Callable[..., Any]]
# what is special, empty for a plain input; the arguments
Probe = tuple[str, tuple[Any, ...]]
Draw = Callable[[np.random.Generator], Iterator[Probe]]


@functools.cache
def oracle() -> Oracle:
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


def _plain(make: Callable[[np.random.Generator, int], tuple[Any, ...]], *sizes: int) -> Draw:
    """Draw plain inputs alone, one of each size."""
    return lambda rng: (("", make(rng, n)) for n in sizes)


def _pulled(draw: Draw, at: int, *cotangents: float) -> Draw:
    """Draw the same inputs with cotangents among them, in turns."""
    return lambda rng: (
        (words, (*given[:at], cotangents[k % len(cotangents)], *given[at:]))
        for k, (words, given) in enumerate(draw(rng))
    )


def _logits(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (1, 3, 4):
        yield "", (rng.uniform(-3.0, 3.0, n),)
    yield "a logit is far out, where exp overflows", (np.array([-900.0, 900.0]),)


def _quats(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (1, 2, 4):
        q = rng.standard_normal((n, 4))
        yield "", (q / np.linalg.norm(q, axis=1, keepdims=True) * rng.uniform(0.5, 2.0, (n, 1)),)
    yield "a quaternion is very short", (np.array([[1e-5, 2e-5, -1e-5, 3e-5]]),)


def _quats_scales(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (1, 2, 4):
        yield "", (rng.standard_normal((n, 4)), rng.uniform(0.25, 2.0, (n, 3)))
    yield "a scale is 0", (rng.standard_normal((1, 4)), np.array([[0.5, 0.0, 2.0]]))


def _units(rng: np.random.Generator, n: int) -> np.ndarray:
    d = rng.standard_normal((n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def _basis(rng: np.random.Generator) -> Iterator[Probe]:
    yield "", (_units(rng, 1), 3)
    yield "", (_units(rng, 4), 3)
    for degree in (0, 1, 2):
        yield f"the degree is {degree}", (_units(rng, 3), degree)


def _colors(rng: np.random.Generator) -> Iterator[Probe]:
    for degree in (3, 2):
        yield "", (0.1 * rng.standard_normal((3, 16, 3)), _units(rng, 3), degree)
    yield "", (0.1 * rng.standard_normal((1, 4, 3)), _units(rng, 1), 1)
    yield "a direction is not of length 1", (0.1 * rng.standard_normal((2, 4, 3)), 3.0 * _units(rng, 2), 1)
    dark = 0.1 * rng.standard_normal((2, 4, 3))
    dark[0, 0, :2] = -4.0
    yield "a colour would be negative", (dark, _units(rng, 2), 1)
    black = np.full((1, 1, 3), -0.5 / float(sh_basis(_units(rng, 1), 0)[0, 0]))
    yield "a colour is exactly 0, which is not under it", (black, _units(rng, 1), 0)


def _viewmat(rng: np.random.Generator) -> np.ndarray:
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotmats_from_quats(rng.standard_normal((1, 4)))[0]
    viewmat[:3, 3] = rng.uniform(-3.0, 3.0, 3)
    return viewmat


_MEANS: Final = _plain(lambda rng, n: (rng.uniform(-3.0, 3.0, (n, 3)), _viewmat(rng)), 1, 2, 4)


def _covars(rng: np.random.Generator, n: int, size: int) -> np.ndarray:
    M = rng.uniform(-1.0, 1.0, (n, size, size)) + 1.5 * np.eye(size)
    return M @ M.swapaxes(1, 2)


def _depths(rng: np.random.Generator) -> Iterator[Probe]:
    yield "", (np.array([4.0, 0.5, 100.0, 0.02]),)
    yield "", (np.array([-1.0, 3.0, -0.5]),)
    yield "a Gaussian is nearer than the near plane", (np.array([0.005, 1.0]),)
    yield "a depth is the near plane's, which still counts as in front", (np.array([0.01, 2.0]),)
    yield "a Gaussian is beyond the far plane", (np.array([1e11, 2.0]),)
    yield "a depth is the far plane's, which still counts as in front", (np.array([1e10, 2.0]),)


_K: Final = np.array([[20.0, 0.0, 9.0], [0.0, 24.0, 5.0], [0.0, 0.0, 1.0]])
_SIZE: Final = (16, 12)


def _pinhole(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (1, 2, 4):
        z = rng.uniform(1.0, 6.0, n)
        xy = z[:, None] * rng.uniform(-0.2, 0.2, (n, 2))
        yield "", (np.column_stack([xy, z]), _K, *_SIZE)
    aside = "a Gaussian is far outside the picture, where x/z and y/z are clamped for the Jacobian"
    yield aside, (np.array([[9.0, 0.2, 2.0], [-8.0, 7.0, 3.0]]), _K, *_SIZE)


def _project_covars_vjp(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (1, 2):
        V = rng.uniform(-2.0, 2.0, (n, 2, 2))
        yield "", (_covars(rng, n, 3), rng.uniform(-4.0, 4.0, (n, 2, 3)), V + V.swapaxes(1, 2))
    V = np.array([[[1.0, 2.0], [-0.5, 0.75]]])
    yield _LOPSIDED, (_covars(rng, 1, 3), rng.uniform(-4.0, 4.0, (1, 2, 3)), V)


def _covars_cam_vjp(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (1, 2):
        V = rng.uniform(-2.0, 2.0, (n, 3, 3))
        yield "", (_covars(rng, n, 3), _viewmat(rng), V + V.swapaxes(1, 2))
    yield _LOPSIDED, (_covars(rng, 1, 3), _viewmat(rng), rng.uniform(-2.0, 2.0, (1, 3, 3)))


def _covars_vjp(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (1, 2):
        V = rng.uniform(-2.0, 2.0, (n, 3, 3))
        yield "", (rng.standard_normal((n, 4)), rng.uniform(0.25, 2.0, (n, 3)), V + V.swapaxes(1, 2))
    V = rng.uniform(-2.0, 2.0, (1, 3, 3))
    yield _LOPSIDED, (rng.standard_normal((1, 4)), rng.uniform(0.25, 2.0, (1, 3)), V)


_LOPSIDED: Final = "the cotangent V is not symmetric, so that V + V^T is not 2 V"


def _blur(rng: np.random.Generator) -> Iterator[Probe]:
    for n, eps2d in ((1, 0.3), (2, 0.5), (3, 0.125)):
        yield "", (_covars(rng, n, 2), eps2d)


def _covars2d(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (1, 2, 4):
        yield "", (4.0 * _covars(rng, n, 2),)
    yield "a determinant is not positive, so that there is no ellipse", (np.array([[[1.0, 2.0], [2.0, 1.0]]]),)


def _radii(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (2, 4):
        yield "", (4.0 * _covars(rng, n, 2), rng.uniform(0.1, 0.9, n))
    yield "a splat is fully opaque, and its reach is held to 3.33", (25.0 * _covars(rng, 2, 2), np.ones(2))
    yield "an opacity is under 1/255", (4.0 * _covars(rng, 2, 2), np.array([0.003, 0.5]))
    yield (
        "a determinant is not positive, so that there is no ellipse",
        (np.array([[[1.0, 2.0], [2.0, 1.0]]]), np.array([0.5])),
    )


def _seen(rng: np.random.Generator) -> Iterator[Probe]:
    yield "", (np.array([[8.0, 6.0], [40.0, 6.0], [8.0, -30.0]]), np.full((3, 2), 4), *_SIZE)
    yield "", (np.array([[-3.0, 6.0], [-5.0, 6.0], [18.0, 6.0], [8.0, 17.0]]), np.full((4, 2), 4), *_SIZE)
    yield "x and y reach differently far", (np.array([[-3.0, 6.0], [8.0, -3.0]]), np.array([[2, 9], [9, 2]]), *_SIZE)
    edge = "an extent ends exactly at the picture's edge, which does not count as on screen"
    yield edge, (np.array([[-4.0, 6.0], [20.0, 6.0], [8.0, 16.0]]), np.full((3, 2), 4), *_SIZE)
    yield "an extent is 0", (np.array([[8.0, 6.0], [8.0, 6.0]]), np.array([[0, 4], [3, 3]]), *_SIZE)


def _grid(rng: np.random.Generator) -> Iterator[Probe]:
    yield "", (32, 16, 16)
    yield "", (64, 48, 16)
    yield "the picture is not a multiple of the tile, and a part of a tile is left over", (33, 17, 16)
    yield "the picture is not a multiple of the tile, and a part of a tile is left over", (5, 30, 4)
    yield "the tile size is under 1", (32, 16, 0)


def _span(rng: np.random.Generator) -> Iterator[Probe]:
    yield "", (20.5, 9, 5, 8)
    yield "", (13.25, 3, 4, 8)
    yield "", (27.0, 4, 5, 8)
    yield "the extent ends exactly between two tiles", (16.0, 8, 4, 8)
    yield "the extent reaches past the first or the last tile", (1.0, 20, 3, 4)
    yield "the extent lies outside the grid", (100.0, 4, 3, 4)
    yield "the extent lies outside the grid", (-30.5, 4, 3, 4)


def _splats(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform(-2.0, 22.0, (n, 2)), rng.integers(1, 9, (n, 2))


def _rects(rng: np.random.Generator) -> Iterator[Probe]:
    yield "", (*_splats(rng, 2), 24, 16, 4)
    yield "", (*_splats(rng, 5), 24, 16, 8)
    yield "the picture is not a multiple of the tile, and a part of a tile is left over", (*_splats(rng, 4), 23, 14, 4)
    yield "an extent is 0", (np.array([[8.0, 6.0], [9.0, 5.0]]), np.array([[0, 4], [3, 0]]), 24, 16, 4)


def _lists(rng: np.random.Generator) -> Iterator[Probe]:
    yield "", (*_splats(rng, 3), rng.uniform(1.0, 9.0, 3), 24, 16, 8)
    yield "", (*_splats(rng, 6), rng.uniform(1.0, 9.0, 6), 24, 16, 8)
    yield "", (*_splats(rng, 5), rng.uniform(1.0, 9.0, 5), 10, 30, 8)
    equal = np.full((4, 2), 8.0), np.full((4, 2), 3), np.array([2.0, 1.0, 2.0, 1.0])
    yield "depths are equal, and the smaller index comes first", (*equal, 16, 16, 16)
    # few enough are kept in order by a sort that does not promise it
    many = np.full((40, 2), 8.0), np.full((40, 2), 3), rng.choice([1.0, 2.0], 40)
    yield "depths are equal, and the smaller index comes first", (*many, 16, 16, 16)


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


_PROBES: Final[dict[str, Draw]] = {
    "scales_from_log_scales": _plain(lambda rng, n: (rng.uniform(-2.0, 1.0, (n, 3)),), 1, 3, 4),
    "opacities_from_logits": _logits,
    "unit_quats_from_quats": _quats,
    "rotmats_from_quats": _quats,
    "covars_from_quats_scales": _quats_scales,
    "covars_from_quats_scales_vjp": _covars_vjp,
    "sh_basis": _basis,
    "colors_from_sh": _colors,
    "camera_center": _plain(lambda rng, _: (_viewmat(rng),), *range(3)),
    "view_dirs": _MEANS,
    "means_cam_from_means": _MEANS,
    "covars_cam_from_covars": _plain(lambda rng, n: (_covars(rng, n, 3), _viewmat(rng)), 1, 2, 4),
    "covars_cam_from_covars_vjp": _covars_cam_vjp,
    "in_front": _depths,
    "project_means": _pinhole,
    "projection_jacobians": _pinhole,
    "project_covars": _plain(lambda rng, n: (_covars(rng, n, 3), rng.uniform(-4.0, 4.0, (n, 2, 3))), 1, 2, 4),
    "project_covars_vjp": _project_covars_vjp,
    "low_pass": _blur,
    "conics_from_covars2d": _covars2d,
    "radii_from_covars2d": _radii,
    "on_screen": _seen,
    "grid_size": _grid,
    "tile_span": _span,
    "tile_rects": _rects,
    "tile_lists": _lists,
    "sigma_at_pixel": _at_pixel,
    "falloff": _sigmas,
    "alpha_from_sigma": _alphas,
    "alpha_from_sigma_vjp": _pulled(_alphas, 2, 1.0, -2.0, 0.5),
    "stops": _stops,
    "composite_pixel": _pixels,
    "composite_pixel_vjp": _pixels_back,
    "dominant_id": _weights,
    "dominant_counts": _winners,
    "l1": _pictures,
    "l1_vjp": _pulled(_pictures, 2, 1.0, 2.0, 0.5, 1.0, 1.5, 1.0),
    "l2": _pictures,
    "l2_vjp": _pulled(_pictures, 2, 1.0, 2.0, 0.5, 1.0, 1.5, 1.0),
    "importance_mask": _counts,
    "pop_loss": _poles,
    "pop_loss_vjp": _pulled(_poles, 2, 1.0, 0.25, 1.0, 1.0, 2.0),
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
