"""Laws of footprints: the low-pass, the conic, the antialiasing factor, the extents (D2), and who has none.

Of a Gaussian that cannot be drawn nothing may reach an image or a gradient, as NaN least of all.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import (
    assert_close,
    assert_same_bits,
    assert_same_image,
    assert_same_transmittance,
    assert_seen,
    with_error_bounds,
)
from pop_ref.conformance.capabilities import GRADIENTS, INRIAS, PROFILES, RENDER
from pop_ref.conformance.law import law
from pop_ref.conformance.scenes import Record, Scene, cotangents, pack
from pop_ref.conformance.strategies import dyadic, opacities, reals
from pop_ref.constants import INRIA, PAPER
from pop_ref.footprint import radii_from_covars2d
from pop_ref.records import Camera, Gaussians

variance = reals(0.0, 64.0, dull=1.0)


@st.composite
def covariances(draw):
    """Draw [[a, b], [b, c]] with |b| a fraction of sqrt(a c) in eighths."""
    a, c = draw(variance), draw(variance)
    b = draw(dyadic(-0.875, 0.875)) * math.sqrt(a * c)
    return np.array([[[a, b], [b, c]]])


def _seen(backend, array):
    return array.astype(backend.dtype).astype(np.float64)


def _condition(covar):
    a, b, c = covar[0, 0, 0], covar[0, 0, 1], covar[0, 1, 1]
    return (a * c + b * b) / (a * c - b * b)


@law("footprint", "low_pass", covar=covariances(), eps2d=dyadic(0.125, 1.0))
def test_the_low_pass_widens_every_direction_by_the_same_variance(backend, covar, eps2d):
    covar = _seen(backend, covar)
    blurred = backend.stage("low_pass")(covar, eps2d)
    assert_close("footprint.low_pass", blurred - covar, eps2d * np.eye(2)[None], np.abs(covar) + 1.0, backend.dtype)


@law("footprint", "conics_from_covars2d", covar=covariances())
def test_a_conic_is_the_inverse_of_its_covariance(backend, covar):
    covar = _seen(backend, covar + 0.25 * np.eye(2))
    A, B, C = backend.stage("conics_from_covars2d")(covar)[0]
    product = np.array([[A, B], [B, C]]) @ covar[0]
    size = (np.abs([[A, B], [B, C]]) @ np.abs(covar[0]) + 1.0) * _condition(covar)
    assert_close("footprint.inverse", product, np.eye(2), size, backend.dtype)


@law(
    "footprint",
    "conics_from_covars2d",
    "radii_from_covars2d",
    side=dyadic(0.125, 8.0),
    profile=st.sampled_from([PAPER, INRIA]),
)
def test_a_flat_covariance_has_no_conic_and_no_extent(backend, side, profile):
    # D2: determinant 0, and under 0
    flat = side * np.array([[[1.0, 1.0], [1.0, 1.0]], [[1.0, 2.0], [2.0, 1.0]]])
    assert_same_bits("conic", backend.stage("conics_from_covars2d")(flat), np.zeros((2, 3)))
    assert_same_bits("extent", backend.stage("radii_from_covars2d")(flat, np.ones(2), profile), np.zeros((2, 2)))
    if backend.has("conics_from_covars2d_vjp"):
        pulled = backend.stage("conics_from_covars2d_vjp")(flat, np.ones((2, 3)))
        assert_same_bits("gradient", np.abs(pulled), np.zeros((2, 2, 2)))


@law("footprint", "compensations", covar=covariances(), eps2d=dyadic(0.125, 1.0))
def test_antialiasing_keeps_the_energy_of_a_splat(backend, covar, eps2d):
    covar = _seen(backend, covar)
    factor = backend.stage("compensations")(covar, eps2d)[0]
    det, det_blurred = np.linalg.det(covar[0]), np.linalg.det(covar[0] + eps2d * np.eye(2))
    assert 0.0 <= factor <= 1.0
    cancelled = covar[0, 0, 0] * covar[0, 1, 1] + covar[0, 0, 1] ** 2
    size = (cancelled + 1e-3 * eps2d**2) / det_blurred * 4.0
    assert_close("footprint.energy", factor**2 * det_blurred, max(det, 0.0), size * det_blurred, backend.dtype)


@law("footprint", "compensations", eps2d=dyadic(0.125, 1.0))
def test_antialiasing_hides_a_point_and_hardly_touches_a_large_splat(backend, eps2d):
    covars = np.array([np.zeros((2, 2)), 2.0**60 * np.eye(2)])
    factors = backend.stage("compensations")(covars, eps2d)
    assert_close("footprint.energy", factors, np.array([0.0, 1.0]), 1.0, backend.dtype)
    if backend.has("compensations_vjp"):
        pulled = backend.stage("compensations_vjp")(covars, eps2d, np.ones(2))
        assert_same_bits("a point's gradient", np.abs(pulled[0]), np.zeros((2, 2)))


@law("footprint", "compensations", power=st.integers(4, 10), eps2d=dyadic(0.125, 1.0))
def test_antialiasing_dims_a_speck_as_much_as_the_low_pass_widens_it(backend, power, eps2d):
    # a disc: its variance over the widened one, down to a thousandth of a pixel
    variance = 2.0 ** (-2 * power)
    factor = backend.stage("compensations")(variance * np.eye(2)[None], eps2d)[0]
    assert_close("footprint.energy", factor * (variance + eps2d) / variance, 1.0, 16.0, backend.dtype)


@law("footprint", "radii_from_covars2d", covar=covariances(), opacity=opacities())
def test_no_point_as_bright_as_the_floor_lies_outside_the_extent(backend, covar, opacity):
    # D2: the ellipse o exp(-sigma) = floor, walked around, stays within the rectangle
    covar = _seen(backend, covar + 0.3 * np.eye(2))
    opacity = float(backend.dtype(opacity))
    r_x, r_y = backend.stage("radii_from_covars2d")(covar, np.array([opacity]))[0]
    if opacity < PAPER.alpha_floor * (1.0 - 1e-6):
        assert (r_x, r_y) == (0, 0)
        return
    reach = math.sqrt(2.0 * math.log(max(opacity / PAPER.alpha_floor, 1.0)))
    angles = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    ellipse = reach * np.linalg.cholesky(covar[0]) @ np.array([np.cos(angles), np.sin(angles)])
    # the extent is an integer number of px, so rounding may only matter where the ellipse touches one
    slack = 64.0 * np.finfo(backend.dtype).eps * (1.0 + np.max(np.abs(ellipse)))
    assert np.max(np.abs(ellipse[0])) <= r_x + slack
    assert np.max(np.abs(ellipse[1])) <= r_y + slack


@law("footprint", "radii_from_covars2d", covar=covariances(), opacity=opacities())
def test_the_extent_is_no_wider_than_the_ellipse_needs(backend, covar, opacity):
    covar = _seen(backend, covar + 0.3 * np.eye(2))
    opacity = max(float(backend.dtype(opacity)), 0.004)
    radii = backend.stage("radii_from_covars2d")(covar, np.array([opacity]))[0]
    reach = min(math.sqrt(2.0 * math.log(opacity / PAPER.alpha_floor)), PAPER.extent_sigmas)
    tight = reach * np.sqrt(np.diagonal(covar[0]))
    assert np.all(radii - tight < 1.0 + 1e-3)


@law("footprint", "radii_from_covars2d", INRIAS, covar=covariances(), one=opacities(), other=opacities())
def test_the_square_extent_is_three_deviations_of_the_longer_axis_whatever_the_opacity(backend, covar, one, other):
    covar = _seen(backend, covar + 0.3 * np.eye(2))
    radii = backend.stage("radii_from_covars2d")(np.repeat(covar, 2, 0), np.array([one, other]), INRIA)
    assert_same_bits("square", radii, np.full((2, 2), radii[0, 0]))
    middle = 0.5 * np.trace(covar[0])
    spread = max(middle**2 - np.linalg.det(covar[0]), 0.1)
    exact = 3.0 * math.sqrt(middle + math.sqrt(spread))
    slack = 64.0 * np.finfo(backend.dtype).eps * exact * (middle**2 / spread)
    assert math.ceil(exact - slack) <= radii[0, 0] <= math.ceil(exact + slack)


@law("footprint", "radii_from_covars2d", INRIAS)
def test_known_square_extents_of_circles(backend):
    # D2: the discriminant, 0 for a circle, is bounded by 0.1: 3 sqrt(c + sqrt(0.1)), which is not 3 sqrt(c)
    covars = np.array([0.25, 1.0, 4.0, 9.0])[:, None, None] * np.eye(2)
    radii = backend.stage("radii_from_covars2d")(covars, np.full(4, 0.5), INRIA)
    assert_same_bits("extents", radii, np.array([[3, 3], [4, 4], [7, 7], [10, 10]]))


@law("footprint", "radii_from_covars2d")
def test_known_extents(backend):
    # sqrt(2 ln 255) = 3.329 deviations at full opacity, sqrt(2 ln 127.5) = 3.114 at one half, none at the floor
    radii = backend.stage("radii_from_covars2d")
    covars = np.repeat(np.diag([4.0, 16.0])[None], 4, axis=0)
    opaque = np.array([1.0, 0.5, 1.0 / 255.0 - 1e-6, 0.0])
    assert_same_bits("extents", radii(covars, opaque), np.array([[7, 14], [7, 13], [0, 0], [0, 0]]))


@law("footprint", "on_screen", edge=st.sampled_from([0, 1, 2, 3]), reach=st.integers(1, 4), by=dyadic(0.125, 4.0))
def test_a_splat_is_kept_exactly_while_its_extent_overlaps_the_image(backend, edge, reach, by):
    # D2: touching from outside shows nothing
    width, height = 8, 4
    on_screen = backend.stage("on_screen")
    sign, axis = (-1.0, edge % 2) if edge < 2 else (1.0, edge % 2)
    at_edge = np.array([width / 2.0, height / 2.0])
    at_edge[axis] = -reach if sign < 0 else (width, height)[axis] + reach
    radii = np.full((4, 2), reach)
    step = np.zeros(2)
    step[axis] = sign * by
    inside = [share * step / by for share in (min(by, 2.0 * reach), 2.0**-16)]
    means2d = np.array([at_edge, at_edge + step, *(at_edge - each for each in inside)])
    assert_same_bits("kept", on_screen(means2d, radii, width, height), [False, False, True, True])
    assert not np.any(on_screen(np.array([[4.0, 2.0]]), np.zeros((1, 2), dtype=np.int64), width, height))


@law("footprint", "on_screen", PROFILES, at=dyadic(-24.0, 40.0), reach=st.integers(1, 20), axis=st.integers(0, 1),
     first=[{"at": at, "reach": 2, "axis": axis} for at in (-8.0, 16.0) for axis in (0, 1)])  # fmt: skip
def test_the_square_extent_is_kept_while_it_meets_a_tile(backend, at, reach, axis):
    # D2 as the tile grid decides it, truncation towards zero included
    profile, size, means2d = dataclasses.replace(INRIA, tile_size=4), (8, 12), np.array([[4.0, 6.0]] * 4)
    means2d[0, axis] = at
    first = min(max(int((at - 0.5 - reach) / 4), 0), size[axis] // 4)
    last = min(max(int((at - 0.5 + reach + 3) / 4), 0), size[axis] // 4)
    # without an extent, or along one axis alone, nothing is seen
    kept = backend.stage("on_screen")(means2d, np.array([[reach, reach], [0, 0], [0, 5], [5, 0]]), *size, profile)
    assert_same_bits("kept", kept, [first < last, False, False, False])


@law("footprint", "radii_from_covars2d")
def test_extents_have_no_upper_bound(backend):
    deviations = 2.0 ** np.arange(4, 17)
    covars = deviations[:, None, None] ** 2 * np.eye(2)
    args = (covars, np.full(len(deviations), 0.875), backend.profile or PAPER)
    found, expected = backend.stage("radii_from_covars2d")(*args), radii_from_covars2d(*args)
    assert np.max(expected) > 2**17
    # a whole number of pixels, up or down as rounding has it
    assert np.all(np.abs(found - expected) <= 1), f"extents {found.tolist()}, expected {expected.tolist()}"


CAMERA = Camera(np.eye(4), np.array([[8.0, 0.0, 4.0], [0.0, 8.0, 2.5], [0.0, 0.0, 1.0]]), 8, 5)
DRAWN = [Record(3.25, 2.25, 2.0, (1.5, 1.0, 0.75), (0.5, 0.25, 1.0, 0.125), 0.5), Record(5.0, 3.0, 3.0, opacity=0.75)]


def _scene(centres, opacity=1.0, scale=1.0):
    """Return two Gaussians that are drawn and, between them, one at each centre that is not."""
    g, n = pack(DRAWN, CAMERA), len(centres)

    def between(rows, more):
        return np.concatenate((rows[:1], np.broadcast_to(more, (n, *rows.shape[1:])), rows[1:]))

    return Scene(
        Gaussians(
            between(g.means, np.array(centres)),
            between(g.quats, [0.5, 0.5, -0.25, 1.0]),
            between(g.scales, scale),
            between(g.opacities, opacity),
            between(g.sh, 0.5),
        ),
        CAMERA,
        (0.25, 0.5, 0.75),
    )


def _assert_only_the_others_have_gradients(backend, scene, zero, hidden=slice(1, -1)):
    seen = backend.sees(scene)
    gradients = backend.gradients(seen, *cotangents(seen))
    assert np.any(gradients["means"][[0, -1]] != 0.0), "the Gaussians that are drawn have no gradient either"
    for name, value in gradients.items():
        assert np.all(np.isfinite(value)), f"v_{name} is not finite: {value.tolist()}"
        if name in zero:
            assert_same_bits(f"v_{name} of what is not drawn", value[hidden], np.zeros_like(value[hidden]))


EVERYTHING = ("means", "quats", "scales", "opacities", "sh", "means2d", "means2d_abs")


@law("gradients", GRADIENTS)
def test_a_centre_in_the_plane_of_the_camera_has_no_gradient(backend):
    # z = 0: 0/0 on the axis, 1/0 next to it
    scene = _scene([[0.0, 0.0, 0.0], [1.0, -0.5, 0.0], [0.0, 2.0, -0.0]])
    _assert_only_the_others_have_gradients(backend, scene, EVERYTHING)


@law("gradients", GRADIENTS)
def test_a_centre_behind_the_camera_whose_projection_overflows_has_no_gradient(backend):
    huge = 1e30 if backend.dtype == np.float32 else 1e200
    # of a usual size, and of one whose square overflows
    for scale in (1.0, huge):
        scene = _scene([[huge, 0.0, -1.0 / huge], [huge, -huge, -huge], [1.0, 1.0, -1.0 / huge]], scale=scale)
        _assert_only_the_others_have_gradients(backend, scene, EVERYTHING)


@law("gradients", GRADIENTS)
def test_an_opacity_of_zero_has_no_gradient(backend):
    scene = _scene([[0.0, 0.0, 2.5], [0.25, 0.0, 1.0]], opacity=0.0)
    _assert_only_the_others_have_gradients(backend, scene, EVERYTHING)


@law("gradients", GRADIENTS)
def test_a_scale_of_zero_has_no_gradient_of_shape_and_finite_others(backend):
    # a point that the low-pass widens: it is drawn, and d(s^2)/ds is 0
    scene = _scene([[0.0, 0.0, 2.5], [0.25, 0.0, 1.0]], opacity=0.5, scale=0.0)
    _assert_only_the_others_have_gradients(backend, scene, ("scales", "quats"))


@law("whole", RENDER)
def test_what_cannot_be_projected_changes_no_pixel(backend):
    huge = 1e30 if backend.dtype == np.float32 else 1e200
    centres = [[0.0, 0.0, 0.0], [1.0, -0.5, 0.0], [huge, 0.0, -1.0 / huge], [huge, -huge, -huge]]
    seen = backend.sees(_scene(centres))
    drawn, error_bounds = with_error_bounds(backend, seen.rows([0, len(centres) + 1]))
    whole, without = backend.render(seen), backend.render(drawn)
    assert_seen(without)
    assert_same_image("whole.invisible", backend, whole.image, without.image, error_bounds)
    assert_same_transmittance("whole.invisible", backend, whole.T_final, without.T_final, error_bounds)
