"""Transposes against differences: the whole renderer's, away from thresholds, and stages' where the laws do not look.

Inria's are compared with differences in 50 digits of a renderer that is written here once more.
The checks themselves stand first: differences, the dot-product test, exact zeros, a guard against checking nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import mpmath
import numpy as np
import pytest

from pop_ref import (
    INRIA,
    PAPER,
    Gaussians,
    Profile,
    Splats,
    alpha,
    footprint,
    project,
    project_vjp,
    projection,
    render,
    render_vjp,
)
from pop_ref.camera import (
    camera_center_vjp,
    covars_cam_from_covars,
    covars_cam_from_covars_vjp,
    means_cam_from_means_vjp,
    view_dirs_vjp,
)
from pop_ref.compositing import composite, composite_vjp
from pop_ref.pixel import SplatRows, composite_pixel, composite_pixel_vjp, rows_from_splats, zero_gradients
from pop_ref.recipes import RECIPES, Recipe
from pop_ref.refinement import refined_viewmat_vjp
from pop_ref.tiles import listed_pixels
from pop_ref.training import gaussians_from_params, objective, params_vjp, start
from tests.golden import ten_losses
from tests.oracle.scenes import camera, loose_camera, safe_gaussians, tilted_camera

Arrays = Sequence[np.ndarray]


def central_gradient(f: Callable[[np.ndarray], float], x: np.ndarray, step: float = 1e-4) -> np.ndarray:
    """Differentiate a scalar function entry by entry with fourth-order central differences.

    The step is relative to an entry's size where that exceeds 1.
    """
    gradient = np.zeros_like(x)
    for index in np.ndindex(*x.shape):
        h, values = step * max(1.0, abs(float(x[index]))), list[float]()
        for k in (-2, -1, 1, 2):
            moved = x.copy()
            moved[index] += k * h
            values.append(f(moved))
        gradient[index] = (8.0 * (values[2] - values[1]) - (values[3] - values[0])) / (12.0 * h)
    return gradient


def inner(vs: Arrays, ys: Arrays) -> float:
    """Sum the products of matching entries."""
    return float(sum(np.sum(v * y) for v, y in zip(vs, ys, strict=True)))


def as_arrays(value: Any) -> list[np.ndarray]:
    """Make a list of float64 arrays of one output, or of a tuple of them."""
    values = value if isinstance(value, tuple) else (value,)
    return [np.asarray(v, dtype=np.float64) for v in values]


def assert_vjp_matches(
    f: Callable[..., Any],
    vjp: Callable[..., Any],
    args: Arrays,
    rtol: float = 1e-6,
    *,
    seed: int = 0,
    step: float = 1e-4,
    zero_gradient_allowed: Collection[int] = (),
) -> None:
    """Check `vjp(*args, *v_outputs)` against `f(*args)`, both of arrays; an output or gradient may be a tuple.

    Four things must hold, with random cotangents of every output:
    every argument has a gradient that is not zero (unless its position is in `zero_gradient_allowed`);
    it equals central differences to `rtol` of its norm; `<v, J u> = <J^T v, u>` along a random direction of all
    arguments together; a zero cotangent gives exact zeros.
    """
    rng = np.random.default_rng(seed)
    args = [np.asarray(a, dtype=np.float64) for a in args]
    outputs = as_arrays(f(*args))
    vs = [rng.normal(size=y.shape) for y in outputs]
    analytic = as_arrays(vjp(*args, *vs))
    assert len(analytic) == len(args), f"{len(analytic)} gradients for {len(args)} arguments"
    assert any(np.any(y != 0.0) for y in outputs), "vacuous: every output is zero"
    flat = [g.ravel() for g in analytic]

    for k, arg in enumerate(args):

        def loss_of(moved: np.ndarray, k: int = k) -> float:
            return inner(vs, as_arrays(f(*args[:k], moved, *args[k + 1 :])))

        assert analytic[k].shape == arg.shape, f"gradient {k} has shape {analytic[k].shape}, its argument {arg.shape}"
        # an argument that is not read has no differences; harmonics beside given colours are most of all entries
        idle = k in zero_gradient_allowed and not _is_read(f, args, k, rng)
        numeric = np.zeros_like(arg) if idle else central_gradient(loss_of, arg, step)
        scale = float(np.linalg.norm(numeric))
        assert scale > 0.0 or k in zero_gradient_allowed, f"vacuous: argument {k} has no influence"
        error = float(np.linalg.norm(analytic[k] - numeric))
        limit = rtol * (scale if k not in zero_gradient_allowed else max(scale, np.linalg.norm(np.concatenate(flat))))
        assert error <= limit, f"gradient {k} is off by {error:.3e}, its norm is {scale:.3e}"

    us = [rng.normal(size=a.shape) for a in args]

    def loss_along(t: np.ndarray) -> float:
        return inner(vs, as_arrays(f(*(a + t * u for a, u in zip(args, us, strict=True)))))

    pushed = float(central_gradient(loss_along, np.array(0.0), step))
    pulled = inner(analytic, us)
    magnitude = float(sum(np.sum(np.abs(g * u)) for g, u in zip(analytic, us, strict=True)))
    assert abs(pushed - pulled) <= rtol * magnitude, f"<v, Ju> = {pushed!r} but <J^T v, u> = {pulled!r}"

    silent = as_arrays(vjp(*args, *(np.zeros_like(v) for v in vs)))
    assert all(np.all(g == 0.0) for g in silent), "a zero cotangent gives a gradient that is not zero"


def _is_read(f: Callable[..., Any], args: Arrays, k: int, rng: np.random.Generator) -> bool:
    """Tell whether any bit of the outputs changes when every entry of one argument does."""
    moved = args[k] * rng.uniform(1.001, 1.002, args[k].shape) + rng.uniform(1e-4, 2e-4, args[k].shape)
    outputs = zip(as_arrays(f(*args)), as_arrays(f(*args[:k], moved, *args[k + 1 :])), strict=True)
    return not all(np.array_equal(before, after) for before, after in outputs)


VIEW = tilted_camera()
BACKGROUND = np.array([0.5, 0.25, 1.0])
INRIA_TRUE = replace(INRIA, clamp_gradient="exact")


MODES = [(mode, n, PAPER, False) for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED") for n in (0, 1, 4)]
PROFILES = [("RGB", 0, PAPER, True), ("RGB", 0, INRIA_TRUE, False), ("RGB", 0, INRIA_TRUE, True)]


@pytest.mark.parametrize(("render_mode", "n_channels", "profile", "antialiased"), [*MODES, *PROFILES])
def test_transpose_matches_differences_in_every_mode_profile_and_number_of_channels(
    render_mode: str, n_channels: int, profile: Profile, antialiased: bool
) -> None:
    # of 0 channels the colours are the harmonics'
    gaussians, rng = safe_gaussians(VIEW, profile=profile, antialiased=antialiased), np.random.default_rng(5)
    given = rng.uniform(0.25, 1.0, (len(gaussians), n_channels))
    behind = rng.uniform(0.25, 1.0, n_channels) if n_channels else BACKGROUND

    def scene(means, quats, scales, opacities, sh, viewmat):
        moved = replace(gaussians, means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)
        return moved, loose_camera(VIEW, viewmat)

    def options(colors):
        more = {"profile": profile, "antialiased": antialiased}
        return {**more, "render_mode": render_mode, "colors": colors if n_channels else None}

    def f(*args):
        out = render(*scene(*args[:6]), args[6], **options(args[7]))
        return out.image, out.T_final

    def vjp(*args):
        *parameters, background, colors, v_image, v_T_final = args
        v = render_vjp(*scene(*parameters), v_image, v_T_final, background, **options(colors))
        v_colors = np.zeros_like(given) if v.colors is None else v.colors
        return v.means, v.quats, v.scales, v.opacities, v.sh, v.viewmat, v.background, v_colors

    g = gaussians
    args = [g.means, g.quats, g.scales, g.opacities, g.sh, VIEW.viewmat, behind, given]
    out = render(gaussians, VIEW, profile=profile, antialiased=antialiased)
    assert np.mean(out.n_blended) > 1.0
    assert np.min(out.T_final) < 0.9
    colored = render_mode.startswith("RGB")
    assert f(*args)[0].shape[2] == colored * (n_channels or 3) + (render_mode != "RGB")
    # harmonics, background and colours are read by the modes that show colours, and harmonics only without colours
    unread = {4: not colored or n_channels > 0, 6: not colored, 7: not colored or n_channels == 0}
    assert_vjp_matches(f, vjp, args, step=2e-6, zero_gradient_allowed=[k for k, idle in unread.items() if idle])


def test_every_gaussian_has_signal_in_the_scene_the_differences_are_taken_of() -> None:
    v = render_vjp(safe_gaussians(VIEW), VIEW, np.random.default_rng(0).normal(size=(5, 6, 3)))
    for name in ("means", "quats", "scales", "opacities", "sh", "means2d"):
        rows = getattr(v, name)
        assert np.all(np.linalg.norm(rows.reshape(len(rows), -1), axis=1) > 1e-6), name


def test_screen_gradients_are_those_of_the_centres_in_px() -> None:
    # moving the principal point moves every screen centre alike
    gaussians = safe_gaussians(camera())
    v_image = np.random.default_rng(3).normal(size=(5, 6, 3))
    v = render_vjp(gaussians, camera(), v_image)

    # the clamp's limits move with the principal point; a wide margin keeps them out of the picture
    wide = replace(PAPER, frustum_margin=100.0)

    def loss(shift: float) -> float:
        view = camera()
        view.K[0, 2] += shift
        return float(np.sum(v_image * render(gaussians, view, profile=wide).image))

    v_wide = render_vjp(gaussians, camera(), v_image, profile=wide)
    slope = (loss(1e-5) - loss(-1e-5)) / 2e-5
    np.testing.assert_allclose(np.sum(v_wide.means2d[:, 0]), slope, rtol=1e-6)
    assert np.all(v.means2d_abs >= np.abs(v.means2d))


def test_an_empty_scene_has_empty_gradients_and_sends_everything_to_the_background() -> None:
    empty = Gaussians([], [], [], [], [])
    v = render_vjp(empty, VIEW, np.ones((5, 6, 3)), background=BACKGROUND)
    assert v.background.tolist() == [30.0, 30.0, 30.0]
    of = project_vjp(empty, VIEW, np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))
    assert v.means.shape == of.means.shape == (0, 3)
    assert np.all(of.viewmat == 0.0)


# The transpose of blending against differences, and what must hold of it exactly.

BLEND_RNG = np.random.default_rng(7)
WIDTH, HEIGHT, TILE = 4, 3, 2
LISTS = [[2, 0, 1, 3], [0, 1, 2, 3], [3, 2, 1], [1, 0, 2, 3]]


def some_splats(n_channels: int = 4) -> Splats:
    roots = BLEND_RNG.normal(size=(4, 2, 2)) * 0.3 + 0.5 * np.eye(2)
    conics = roots @ roots.swapaxes(1, 2)
    return Splats(
        means2d=BLEND_RNG.uniform(0.0, 1.0, size=(4, 2)) * [WIDTH, HEIGHT],
        depths=np.arange(4.0) + 1.0,
        conics=np.stack([conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]], axis=1),
        opacities=np.array([0.75, 0.9, 0.5, 0.8]),
        colors=BLEND_RNG.normal(size=(4, n_channels)),
        radii=np.full((4, 2), 9),
    )


def test_transpose_matches_differences_where_a_ray_terminates_early() -> None:
    scene = replace(some_splats(1), opacities=np.full(4, 0.998), conics=np.tile([0.01, 0.0, 0.01], (4, 1)))
    out = composite(scene, LISTS, WIDTH, HEIGHT, TILE)
    assert np.all(out.n_blended < 3)
    assert np.all(out.n_traversed > out.n_blended)
    assert np.all(out.T_final > 1.01e-4)

    def f(opacities, colors):
        return composite(replace(scene, opacities=opacities, colors=colors), LISTS, WIDTH, HEIGHT, TILE).image

    def vjp(opacities, colors, v_image):
        moved = replace(scene, opacities=opacities, colors=colors)
        v = composite_vjp(moved, LISTS, WIDTH, HEIGHT, TILE, v_image)
        return v.v_opacities, v.v_colors

    assert_vjp_matches(f, vjp, [scene.opacities, scene.colors], step=1e-6)


def test_an_opaque_splat_in_front_leaves_a_finite_gradient() -> None:
    # opacity exactly at a ceiling of 1: recovering T by division would be 0 / 0
    opaque = replace(PAPER, alpha_ceiling=1.0, transmittance_stop=-1.0)
    # at the pixel's own centre exp(-sigma) = 1, so that v_opacity is dC/dalpha
    rows = SplatRows([[0.5, 0.5]] * 3, [[1.0, 0.0, 1.0]] * 3, [0.5, 1.0, 0.5], [[1.0], [2.0], [4.0]])
    pixel = composite_pixel(range(3), rows, 0.5, 0.5, [0.25], opaque)
    assert pixel.ids == [0, 1, 2]
    totals = zero_gradients(3, 1)
    composite_pixel_vjp(pixel, rows, 0.5, 0.5, [0.25], [1.0], 0.0, totals, opaque)
    assert totals.v_opacities.tolist() == [1.0 - 2.0, 0.5 * (2.0 - (0.5 * 4.0 + 0.5 * 0.25)), 0.0]


def test_culled_rows_are_zero_but_for_their_depth_and_get_exactly_zero() -> None:
    gaussians = safe_gaussians(VIEW)
    means = gaussians.means.copy()
    means[0] = [0.0, 0.0, -4.0]
    means[1] = [900.0, 0.0, 4.0]
    culled = replace(gaussians, means=means, opacities=np.array([0.5, 0.5, 1.0 / 512.0, 0.5, 0.5]))
    splats = project(culled, VIEW)
    assert splats.visible.tolist() == [False, False, False, True, True]
    for name in ("means2d", "conics", "opacities", "colors", "radii"):
        assert np.all(getattr(splats, name)[:3] == 0.0)
    assert np.all(splats.depths != 0.0)
    rng = np.random.default_rng(2)
    v = project_vjp(culled, VIEW, *(rng.normal(size=s) for s in ((5, 2), (5, 3), (5,), (5, 3), (5,))))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert np.all(getattr(v, name)[:3] == 0.0)
        assert np.all(np.any(getattr(v, name)[3:] != 0.0, axis=tuple(range(1, getattr(v, name).ndim))))


# The gradient of the whole objective by raw parameters, through every stage at once.

CAMERA, PHOTO = ten_losses.cameras()[1], ten_losses.photographs()[1]
PARAMS = {name: array[4:6] for name, array in ten_losses.first_params().items()}
# one band stands for the others, which are most of all numbers: the raw coefficients are the activated ones
PARAMS["shN"] = PARAMS["shN"][:, :3]


def loss_of(params: dict[str, np.ndarray], recipe: Recipe) -> float:
    gaussians = gaussians_from_params(params)
    return objective(render(gaussians, CAMERA), gaussians, PHOTO, start(params), recipe)[0]


@pytest.mark.parametrize("name", ["POP", pytest.param("3DGS", marks=pytest.mark.slow)])
def test_gradient_by_raw_parameters_matches_differences(name: str) -> None:
    gaussians = gaussians_from_params(PARAMS)
    recipe = RECIPES[name]
    _, v_image, v_opacities = objective(render(gaussians, CAMERA), gaussians, PHOTO, start(PARAMS), recipe)
    analytic = params_vjp(PARAMS, render_vjp(gaussians, CAMERA, v_image), v_opacities)
    for key, array in PARAMS.items():
        # a small step keeps every decision of the render (what is skipped, what wins) as it is
        numeric = central_gradient(lambda x, key=key: loss_of({**PARAMS, key: x}, recipe), array, step=2e-6)
        scale = np.linalg.norm(numeric)
        assert scale > 0.0
        assert np.linalg.norm(analytic[key] - numeric) <= 1e-6 * scale, key


# Single stages.

RNG = np.random.default_rng(4)
VIEWMAT = tilted_camera().viewmat
MEANS, COVARS = RNG.normal(size=(3, 3)), RNG.normal(size=(3, 3, 3))
FLAT = np.array([[[1.0, 2.0], [2.0, 1.0]]])


def test_transposes_of_covariances_match_differences_for_matrices_that_are_not_symmetric() -> None:
    assert_vjp_matches(covars_cam_from_covars, covars_cam_from_covars_vjp, [COVARS, VIEWMAT])
    args = [COVARS, RNG.normal(size=(3, 2, 3))]
    assert_vjp_matches(projection.project_covars, projection.project_covars_vjp, args)


def test_the_view_matrix_s_last_row_gets_exactly_zero() -> None:
    for v_viewmat in (
        camera_center_vjp(VIEWMAT, np.ones(3)),
        view_dirs_vjp(MEANS, VIEWMAT, MEANS)[1],
        means_cam_from_means_vjp(MEANS, VIEWMAT, MEANS)[1],
        covars_cam_from_covars_vjp(COVARS, VIEWMAT, COVARS)[1],
        refined_viewmat_vjp(VIEWMAT, np.full(6, 0.2), np.vstack([np.ones((3, 4)), np.zeros(4)]))[0],
    ):
        assert np.all(v_viewmat[3] == 0.0)
        assert np.any(v_viewmat[:3] != 0.0)


def test_at_exactly_the_limit_the_derivative_from_inside_is_used() -> None:
    K = np.array([[4.0, 0.0, 2.0], [0.0, 4.0, 2.0], [0.0, 0.0, 1.0]])
    # the limit is (W - cx) / fx + 0.5 W / (2 fx) = 0.5 + 0.25
    v_J = np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]])
    dyadic = replace(PAPER, frustum_margin=0.5)
    v = projection.projection_jacobians_vjp(np.array([[1.5, 0.0, 2.0]]), K, 4, 4, v_J, dyadic)
    assert v[0].tolist() == [-1.0, 0.0, 1.5]


def test_cotangents_of_a_footprint_are_symmetric_and_none_passes_without_an_ellipse() -> None:
    roots = RNG.normal(size=(4, 2, 2))
    covars2d = roots @ roots.swapaxes(1, 2) + 0.125 * np.eye(2)
    for v in (
        footprint.conics_from_covars2d_vjp(covars2d, RNG.normal(size=(4, 3))),
        footprint.compensations_vjp(covars2d, 0.3, RNG.normal(size=4)),
    ):
        assert np.linalg.norm(v) > 0.0
        np.testing.assert_allclose(v, v.swapaxes(1, 2), rtol=1e-12)
    assert np.all(footprint.conics_from_covars2d_vjp(FLAT, np.ones((1, 3))) == 0.0)
    for none in (FLAT, np.zeros((1, 2, 2))):
        assert np.all(footprint.compensations_vjp(none, 0.25, np.ones(1)) == 0.0)


def test_at_exactly_the_ceiling_the_derivative_from_below_is_used() -> None:
    half = replace(PAPER, alpha_ceiling=0.5)
    assert alpha.alpha_from_sigma_vjp(0.0, 0.5, 4.0, half) == (-2.0, 4.0)


# Inria in 50 digits.

NAMES = ("means", "quats", "scales", "opacities", "sh")
DIGITS = 50


def _rotation(q: Any) -> Any:
    w, x, y, z = (c / mpmath.sqrt(sum(c * c for c in q)) for c in q)
    return mpmath.matrix(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _color(sh: Any, mean: Any, eye: Any) -> list[Any]:
    d = [a - b for a, b in zip(mean, eye, strict=True)]
    x, y, z = (c / mpmath.sqrt(sum(c * c for c in d)) for c in d)
    low, high = 1 / mpmath.sqrt(4 * mpmath.pi), mpmath.sqrt(3 / (4 * mpmath.pi))
    basis = (low, -high * y, high * z, -high * x)
    sums = [sum(b * row[c] for b, row in zip(basis, sh, strict=True)) + mpmath.mpf("0.5") for c in range(3)]
    return [max(s, mpmath.mpf(0)) for s in sums]


class Inria:
    """The loss in mpmath, with the decisions of one scene and what its backward pass holds constant.

    That pass leaves two derivatives out of the chain: where the frustum clamps a centre, the clamped coordinate is a
    constant (B1), and a clamped alpha passes its gradient as if it were not clamped (B3). So the clamped coordinate is
    frozen here, and the clamp of alpha is a constant offset.
    """

    def __init__(self, gaussians: Gaussians, v_image: np.ndarray, v_T_final: np.ndarray) -> None:
        drawn = render(gaussians, VIEW, BACKGROUND, profile=INRIA)
        rows, size = rows_from_splats(drawn.splats), INRIA.tile_size
        self.blended = {
            (x, y): composite_pixel(ids, rows, x + 0.5, y + 0.5, BACKGROUND.tolist(), INRIA).ids
            for x, y, ids in listed_pixels(drawn.tile_lists, VIEW.width, VIEW.height, size)
        }
        self.v_image, self.v_T_final = v_image, v_T_final
        self.frozen: dict[Any, Any] = {}
        self.n_clamped_centres = self.n_clamped_alphas = 0
        R = VIEW.viewmat[:3, :3].astype(object)
        self.R = mpmath.matrix([[mpmath.mpf(e) for e in row] for row in R])
        self.t = [mpmath.mpf(e) for e in VIEW.viewmat[:3, 3]]
        self.eye = list(-(self.R.T * mpmath.matrix(self.t)))
        self.base = {name: getattr(gaussians, name) for name in NAMES}

    def _splat(self, i: int, mean: Any, quat: Any, scale: Any) -> tuple[Any, Any, Any]:
        p = [sum(self.R[a, b] * mean[b] for b in range(3)) + self.t[a] for a in range(3)]
        f = [mpmath.mpf(VIEW.K[a, a]) for a in (0, 1)]
        sizes, z = (VIEW.width, VIEW.height), p[2]
        centre = [f[a] * p[a] / z + mpmath.mpf(sizes[a]) / 2 for a in (0, 1)]
        side = []
        for a in (0, 1):
            limit = mpmath.mpf(str(1 + INRIA.frustum_margin)) * sizes[a] / (2 * f[a])
            if (i, a) not in self.frozen:
                clamped = max(-limit, min(limit, p[a] / z)) * z
                self.frozen[i, a] = None if clamped == p[a] or abs(p[a] / z) < limit else clamped
                self.n_clamped_centres += self.frozen[i, a] is not None
            side.append(p[a] if self.frozen[i, a] is None else self.frozen[i, a])
        J = mpmath.matrix([[f[0] / z, 0, -f[0] * side[0] / z**2], [0, f[1] / z, -f[1] * side[1] / z**2]])
        M = J * self.R * _rotation(quat) * mpmath.diag(list(scale))
        cov = M * M.T
        a, b, c = cov[0, 0] + mpmath.mpf(INRIA.eps2d), cov[0, 1], cov[1, 1] + mpmath.mpf(INRIA.eps2d)
        det = a * c - b * b
        return z, centre, (c / det, -b / det, a / det)

    def loss(self, values: dict[str, Any]) -> Any:
        n = len(values["means"])
        splats = [self._splat(i, values["means"][i], values["quats"][i], values["scales"][i]) for i in range(n)]
        colors = [_color(values["sh"][i], values["means"][i], self.eye) for i in range(n)]
        total = mpmath.mpf(0)
        for (x, y), ids in self.blended.items():
            T, pixel = mpmath.mpf(1), [mpmath.mpf(0)] * 3
            for i in ids:
                _, centre, (A, B, C) = splats[i]
                dx, dy = centre[0] - x - mpmath.mpf("0.5"), centre[1] - y - mpmath.mpf("0.5")
                raw = values["opacities"][i] * mpmath.exp(-(A * dx * dx + C * dy * dy) / 2 - B * dx * dy)
                key = (i, x, y)
                if key not in self.frozen:
                    self.frozen[key] = min(raw, mpmath.mpf(INRIA.alpha_ceiling)) - raw
                    self.n_clamped_alphas += self.frozen[key] != 0
                alpha = raw + self.frozen[key]
                pixel = [c + T * alpha * own for c, own in zip(pixel, colors[i], strict=True)]
                T = T * (1 - alpha)
            seen = [c + T * mpmath.mpf(b) for c, b in zip(pixel, BACKGROUND, strict=True)]
            total += sum(mpmath.mpf(v) * c for v, c in zip(self.v_image[y, x], seen, strict=True))
            total += mpmath.mpf(self.v_T_final[y, x]) * T
        return total

    def values(self) -> dict[str, Any]:
        return {name: np.vectorize(mpmath.mpf, otypes=[object])(value) for name, value in self.base.items()}

    def slope(self, name: str, index: tuple[int, ...]) -> Any:
        h, ends = mpmath.mpf(10) ** -16, []
        for sign in (1, -1):
            values = self.values()
            values[name][index] += sign * h
            ends.append(self.loss(values))
        return (ends[0] - ends[1]) / (2 * h)


def _scene() -> Gaussians:
    gaussians = safe_gaussians(VIEW, profile=INRIA)
    # opaque and large, so that a pixel lies where alpha is clamped
    opacities = np.where(np.arange(len(gaussians)) < 3, 1.0, gaussians.opacities)
    return replace(gaussians, opacities=opacities, scales=gaussians.scales * 3.0)


@pytest.mark.parametrize("name", NAMES)
def test_inrias_gradients_are_those_of_fifty_digits(name: str) -> None:
    gaussians, rng = _scene(), np.random.default_rng(3)
    v_image, v_T_final = rng.normal(size=(5, 6, 3)), rng.normal(size=(5, 6))
    stated = getattr(render_vjp(gaussians, VIEW, v_image, v_T_final, BACKGROUND, profile=INRIA), name)
    with mpmath.workdps(DIGITS):
        by_hand = Inria(gaussians, v_image, v_T_final)
        drawn = render(gaussians, VIEW, BACKGROUND, profile=INRIA)
        here = np.sum(v_image * drawn.image) + np.sum(v_T_final * drawn.T_final)
        assert abs(float(by_hand.loss(by_hand.values())) - here) < 1e-13 * np.sum(np.abs(v_image))
        assert by_hand.n_clamped_centres > 0, "no centre is clamped (B1)"
        assert by_hand.n_clamped_alphas > 0, "no alpha is clamped (B3)"
        measured = np.array([float(by_hand.slope(name, index)) for index in np.ndindex(*stated.shape)])
    assert np.any(measured != 0.0)
    np.testing.assert_allclose(stated.reshape(-1), measured, rtol=0.0, atol=1e-12 * np.max(np.abs(measured)))
