"""The course's own inputs of the stages from raw parameters to tiles; see `probes`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np

from pop_ref.harmonics import sh_basis

# what is special, empty for a plain input; the arguments
Probe = tuple[str, tuple[Any, ...]]


def _logs(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (1, 3, 4):
        yield "", (rng.uniform(-2.0, 1.0, (n, 3)),)


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
    q = rng.standard_normal(4)
    w, x, y, z = q / np.linalg.norm(q)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = rng.uniform(-3.0, 3.0, 3)
    return viewmat


def _viewmats(rng: np.random.Generator) -> Iterator[Probe]:
    for _ in range(3):
        yield "", (_viewmat(rng),)


def _means(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (1, 2, 4):
        yield "", (rng.uniform(-3.0, 3.0, (n, 3)), _viewmat(rng))


def _covars(rng: np.random.Generator, n: int, size: int) -> np.ndarray:
    M = rng.uniform(-1.0, 1.0, (n, size, size)) + 1.5 * np.eye(size)
    return M @ M.swapaxes(1, 2)


def _covars_world(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (1, 2, 4):
        yield "", (_covars(rng, n, 3), _viewmat(rng))


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


def _jacobians(rng: np.random.Generator) -> Iterator[Probe]:
    for n in (1, 2, 4):
        yield "", (_covars(rng, n, 3), rng.uniform(-4.0, 4.0, (n, 2, 3)))


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


GEOMETRY: Final[dict[str, Callable[[np.random.Generator], Iterator[Probe]]]] = {
    "scales_from_log_scales": _logs,
    "opacities_from_logits": _logits,
    "unit_quats_from_quats": _quats,
    "rotmats_from_quats": _quats,
    "covars_from_quats_scales": _quats_scales,
    "covars_from_quats_scales_vjp": _covars_vjp,
    "sh_basis": _basis,
    "colors_from_sh": _colors,
    "camera_center": _viewmats,
    "view_dirs": _means,
    "means_cam_from_means": _means,
    "covars_cam_from_covars": _covars_world,
    "covars_cam_from_covars_vjp": _covars_cam_vjp,
    "in_front": _depths,
    "project_means": _pinhole,
    "projection_jacobians": _pinhole,
    "project_covars": _jacobians,
    "project_covars_vjp": _project_covars_vjp,
    "low_pass": _blur,
    "conics_from_covars2d": _covars2d,
    "radii_from_covars2d": _radii,
    "on_screen": _seen,
    "grid_size": _grid,
    "tile_span": _span,
    "tile_rects": _rects,
    "tile_lists": _lists,
}
