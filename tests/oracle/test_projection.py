"""The projection's Jacobian against mpmath and complex steps, its clamp at the limits, and EWA against samples."""

from __future__ import annotations

import math
from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from pop_ref import INRIA, PAPER, activations, camera, covariance, footprint, harmonics, projection
from tests.gradients.checks import complex_step_gradient
from tests.oracle.scenes import tilted_camera

K = np.array([[7.0, 0.0, 3.25], [0.0, 9.0, 2.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 6, 5

in_view = st.tuples(st.floats(-0.25, 0.25), st.floats(-0.2, 0.2), st.floats(0.5, 50.0))


@given(in_view)
def test_jacobians_are_the_pinhole_s_derivative_to_mpmath_s_digits(point: tuple[float, float, float]) -> None:
    slope_x, slope_y, z = point
    p = [slope_x * z, slope_y * z, z]
    with mpmath.workdps(40):
        pinhole = (lambda x, y, z: 7 * x / z, lambda x, y, z: 9 * y / z)
        orders = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
        want = [[float(mpmath.diff(f, tuple(map(mpmath.mpf, p)), n)) for n in orders] for f in pinhole]
    got = projection.projection_jacobians(np.array([p]), K, WIDTH, HEIGHT)[0]
    np.testing.assert_allclose(got, want, rtol=1e-14, atol=1e-18)


@given(in_view)
def test_jacobians_are_the_complex_step_derivative_of_the_projected_centres(point: tuple[float, float, float]) -> None:
    slope_x, slope_y, z = point
    p = np.array([slope_x * z, slope_y * z, z])
    rows = [
        complex_step_gradient(lambda q: K[0, 0] * q[0] / q[2] + K[0, 2], p),
        complex_step_gradient(lambda q: K[1, 1] * q[1] / q[2] + K[1, 2], p),
    ]
    np.testing.assert_allclose(
        projection.projection_jacobians(p[None], K, WIDTH, HEIGHT)[0], rows, rtol=1e-14, atol=1e-18
    )
    centre = projection.project_means(p[None], K, WIDTH, HEIGHT)[0]
    np.testing.assert_allclose(centre, (K @ p)[:2] / p[2], rtol=1e-14)


@pytest.mark.parametrize(
    ("axis", "sign", "limit"),
    [
        (0, 1.0, (6 - 3.25) / 7.0 + 0.3 * 0.5 * 6 / 7.0),
        (0, -1.0, 3.25 / 7.0 + 0.3 * 0.5 * 6 / 7.0),
        (1, 1.0, (5 - 2.0) / 9.0 + 0.3 * 0.5 * 5 / 9.0),
        (1, -1.0, 2.0 / 9.0 + 0.3 * 0.5 * 5 / 9.0),
    ],
    ids=["+x", "-x", "+y", "-y"],
)
def test_the_clamp_holds_the_slope_at_its_limit_beyond_it_only(axis: int, sign: float, limit: float) -> None:
    for slope in (0.5 * limit, 0.999 * limit, 1.001 * limit, 40.0 * limit):
        p = np.array([[0.0, 0.0, 2.0]])
        p[0, axis] = sign * slope * 2.0
        got = projection.projection_jacobians(p, K, WIDTH, HEIGHT)[0]
        want = -sign * K[axis, axis] * min(slope, limit) / 2.0
        np.testing.assert_allclose(got[axis, 2], want, rtol=1e-14)
        assert got[1 - axis, 2] == 0.0
        assert got[axis, axis] == K[axis, axis] / 2.0


def test_inria_puts_the_principal_point_in_the_middle_for_centres_and_clamp() -> None:
    centred_K = K.copy()
    centred_K[:2, 2] = WIDTH / 2.0, HEIGHT / 2.0
    p = np.array([[0.5, 0.25, 2.0], [9.0, -9.0, 2.0]])
    used = replace(PAPER, principal_point="used")
    for f in (projection.project_means, projection.projection_jacobians):
        assert np.array_equal(f(p, K, WIDTH, HEIGHT, INRIA), f(p, centred_K, WIDTH, HEIGHT, used))
        assert not np.array_equal(f(p, K, WIDTH, HEIGHT, INRIA), f(p, K, WIDTH, HEIGHT, used))


def test_inria_s_limit_is_1_3_tangents_of_half_the_field_of_view() -> None:
    p = np.array([[100.0, 0.0, 1.0]])
    slope = -projection.projection_jacobians(p, K, WIDTH, HEIGHT, INRIA)[0, 0, 2] / K[0, 0]
    np.testing.assert_allclose(slope, 1.3 * (WIDTH / 2.0) / K[0, 0], rtol=1e-15)


def test_projected_covariances_are_those_of_projected_samples_of_a_small_gaussian() -> None:
    rng = np.random.default_rng(10)
    centre = np.array([0.4, -0.3, 3.0])
    root = rng.normal(size=(3, 3)) * 1e-5
    samples = rng.normal(size=(2000, 3))
    samples = (samples - samples.mean(axis=0)) @ root.T + centre
    seen = projection.project_means(samples, K, WIDTH, HEIGHT)
    covar = np.cov(samples.T)
    J = projection.projection_jacobians(centre[None], K, WIDTH, HEIGHT)
    np.testing.assert_allclose(projection.project_covars(covar[None], J)[0], np.cov(seen.T), rtol=1e-4)


def test_scaling_focal_and_image_scales_centres_once_and_covariances_twice() -> None:
    p, covar = np.array([[0.5, 0.25, 2.0], [9.0, -9.0, 2.0]]), np.eye(3)[None] * [[[1.0]], [[2.0]]]
    K2 = K.copy()
    K2[:2] *= 2.0
    once = projection.project_means(p, K, WIDTH, HEIGHT)
    assert np.array_equal(projection.project_means(p, K2, 2 * WIDTH, 2 * HEIGHT), 2.0 * once)
    J, J2 = (projection.projection_jacobians(p, k, s * WIDTH, s * HEIGHT) for k, s in ((K, 1), (K2, 2)))
    assert np.array_equal(projection.project_covars(covar, J2), 4.0 * projection.project_covars(covar, J))


# Activations against closed forms and at the ends of their ranges.


@given(st.floats(-700.0, 700.0))
def test_opacities_are_the_logistic_function_to_the_last_bits(logit: float) -> None:
    with mpmath.workdps(40):
        want = float(1 / (1 + mpmath.exp(-mpmath.mpf(logit))))
    np.testing.assert_allclose(activations.opacities_from_logits(np.array([logit]))[0], want, rtol=4e-16)


def test_opacities_never_overflow_and_reach_both_ends() -> None:
    got = activations.opacities_from_logits(np.array([-1e308, -800.0, 800.0, 1e308]))
    assert got.tolist() == [0.0, 0.0, 1.0, 1.0]


@given(st.floats(-20.0, 20.0))
def test_scales_are_exponentials(log_scale: float) -> None:
    got = activations.scales_from_log_scales(np.array([[log_scale] * 3]))
    np.testing.assert_allclose(got, math.exp(log_scale), rtol=4e-16)


def test_quaternions_whose_squares_underflow_or_overflow_are_still_normalised() -> None:
    for size in (1e-200, 1e200):
        unit = activations.unit_quats_from_quats(np.array([[size, size, size, size]]))
        np.testing.assert_allclose(unit, 0.5, rtol=1e-15)


# Rotations and covariances against SciPy and their algebra.

# multiples of 1/1024, so that no square underflows where bits are compared
covariance_lattice = st.integers(-4096, 4096).map(lambda k: k / 1024.0)
quat_lists = st.lists(covariance_lattice, min_size=4, max_size=4).filter(any)
scale_lists = st.lists(covariance_lattice.map(abs), min_size=3, max_size=3)


@given(quat_lists)
def test_rotations_are_those_of_scipy(quat: list[float]) -> None:
    w, x, y, z = quat
    want = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(covariance.rotmats_from_quats(np.array([quat]))[0], want, atol=2e-15)


@given(quat_lists, scale_lists)
def test_covariances_map_the_rotation_s_axes_to_their_variances(quat: list[float], scales: list[float]) -> None:
    w, x, y, z = quat
    covar = covariance.covars_from_quats_scales(np.array([quat]), np.array([scales]))[0]
    axes = Rotation.from_quat([x, y, z, w]).as_matrix()
    for k in range(3):
        np.testing.assert_allclose(covar @ axes[:, k], scales[k] ** 2 * axes[:, k], atol=1e-12)


def test_no_gaussians_have_no_covariances() -> None:
    assert covariance.covars_from_quats_scales(np.zeros((0, 4)), np.zeros((0, 3))).shape == (0, 3, 3)


# World to camera against homogeneous coordinates, and the near plane at its edge.

RNG = np.random.default_rng(9)
VIEWMAT = tilted_camera().viewmat
MEANS = RNG.normal(size=(6, 3))


def test_the_center_is_where_the_inverse_sends_the_origin() -> None:
    np.testing.assert_allclose(camera.camera_center(VIEWMAT), np.linalg.inv(VIEWMAT)[:3, 3], atol=1e-15)


def test_centres_are_transformed_as_homogeneous_points() -> None:
    homogeneous = np.concatenate([MEANS, np.ones((6, 1))], axis=1)
    np.testing.assert_allclose(
        camera.means_cam_from_means(MEANS, VIEWMAT), (homogeneous @ VIEWMAT.T)[:, :3], atol=1e-15
    )


def test_view_directions_have_the_length_of_the_camera_frame_centres() -> None:
    dirs, means_cam = camera.view_dirs(MEANS, VIEWMAT), camera.means_cam_from_means(MEANS, VIEWMAT)
    np.testing.assert_allclose(np.linalg.norm(dirs, axis=1), np.linalg.norm(means_cam, axis=1), rtol=1e-14)
    np.testing.assert_allclose(dirs @ VIEWMAT[:3, :3].T, means_cam, atol=1e-14)


def test_covariances_are_those_of_transformed_samples() -> None:
    samples = RNG.normal(size=(50, 3)) * [1.0, 2.0, 0.25]
    covar = np.cov(samples.T)
    moved = camera.means_cam_from_means(samples, VIEWMAT)
    np.testing.assert_allclose(camera.covars_cam_from_covars(covar[None], VIEWMAT)[0], np.cov(moved.T), atol=1e-13)


def test_the_far_plane_itself_is_kept() -> None:
    close = replace(PAPER, far_plane=8.0)
    assert camera.in_front(np.array([8.0, math.nextafter(8.0, 9.0)]), close).tolist() == [True, False]


# The footprint: inverses, extents that miss nothing, culls at their edges, splats without an ellipse.

angles, stretches = st.floats(0.0, math.pi), st.floats(0.0, 6.0)


def covar2d(angle: float, a: float, b: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s], [s, c]])
    return footprint.low_pass((R @ np.diag([a * a, b * b]) @ R.T)[None], PAPER.eps2d)


@given(angles, stretches, stretches)
def test_compensations_are_root_determinant_ratios(angle: float, a: float, b: float) -> None:
    blurred = covar2d(angle, a, b)
    raw = blurred - PAPER.eps2d * np.eye(2)
    got = footprint.compensations(raw, PAPER.eps2d)[0]
    ratio = np.prod(np.linalg.eigvalsh(raw[0]) / np.linalg.eigvalsh(blurred[0]))
    assert 0.0 <= got <= 1.0
    np.testing.assert_allclose(got**2, max(0.0, ratio), atol=1e-12)


def test_the_extent_is_tight() -> None:
    # at o = 1 the ellipse alpha = 1/255 reaches sqrt(2 ln 255) = 3.329 standard deviations
    covar = np.diag([100.0**2, 10.0**2])[None]
    assert footprint.radii_from_covars2d(covar, np.array([1.0])).tolist() == [[333, 34]]
    assert footprint.radii_from_covars2d(covar, np.array([0.5])).tolist() == [[312, 32]]


def test_an_opacity_under_the_floor_has_no_extent_and_one_at_the_floor_a_zero_one() -> None:
    covars = np.tile(np.eye(2), (4, 1, 1))
    floor = PAPER.alpha_floor
    opacities = np.array([0.0, math.nextafter(floor, 0.0), floor, math.nextafter(floor, 1.0)])
    assert footprint.radii_from_covars2d(covars, opacities).tolist() == [[0, 0], [0, 0], [0, 0], [1, 1]]


def test_a_splat_without_an_ellipse_is_culled_in_every_profile() -> None:
    covars = np.array([[[1.0, 2.0], [2.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]], [[0.0, 0.0], [0.0, 0.0]]])
    for profile in (PAPER, INRIA):
        assert np.all(footprint.radii_from_covars2d(covars, np.ones(3), profile) == 0)
    assert np.all(footprint.conics_from_covars2d(covars) == 0.0)
    assert np.all(footprint.compensations(covars, 0.25) == 0.0)


def test_a_needle_so_long_that_the_determinant_rounds_to_nothing_is_culled() -> None:
    needle = np.array([[[1e18, 1e18], [1e18, 1e18]]])
    blurred = footprint.low_pass(needle, PAPER.eps2d)
    assert np.array_equal(blurred, needle)
    assert np.all(footprint.radii_from_covars2d(blurred, np.ones(1)) == 0)


def test_a_huge_splat_s_extent_fits_an_int32() -> None:
    radii = footprint.radii_from_covars2d(np.diag([1e30, 1e30])[None], np.ones(1))
    assert radii.tolist() == [[2**31 - 1, 2**31 - 1]]


def test_a_splat_that_only_touches_the_image_s_border_is_off_screen() -> None:
    means2d = np.array([[-2.0, 1.0], [-1.75, 1.0], [10.0, 1.0], [9.75, 1.0], [4.0, -2.0], [4.0, 6.0], [4.0, 5.75]])
    radii = np.full((7, 2), 2)
    assert footprint.on_screen(means2d, radii, 8, 4).tolist() == [False, True, False, True, False, False, True]


def test_a_splat_without_extent_is_off_screen() -> None:
    assert footprint.on_screen(np.array([[1.0, 1.0]]), np.array([[0, 0]]), 4, 4).tolist() == [False]


def test_inria_keeps_a_splat_if_its_square_reaches_a_tile() -> None:
    # grid of 16 px over 20 px: the right tile ends at 32, and the square's start is kept under 32.5
    means2d = np.array([[34.25, 8.0], [34.5, 8.0], [-0.5, 8.0], [-0.75, 8.0]])
    radii = np.full((4, 2), 2)
    assert footprint.on_screen(means2d, radii, 20, 16, INRIA).tolist() == [True, False, True, False]
    assert footprint.on_screen(means2d, radii, 20, 16, replace(INRIA, tile_size=4)).tolist() == [
        False,
        False,
        True,
        False,
    ]


# Spherical harmonics against SciPy's, and orthonormal by quadrature.

HARMONICS_RNG = np.random.default_rng(8)
DIRS = HARMONICS_RNG.normal(size=(40, 3))
UNITS = DIRS / np.linalg.norm(DIRS, axis=1, keepdims=True)


def real_harmonic(l: int, m: int, units: np.ndarray) -> np.ndarray:
    """Combine SciPy's complex harmonics (with their Condon-Shortley phase) into the real one of the code bases."""
    theta, phi = np.arccos(units[:, 2]), np.arctan2(units[:, 1], units[:, 0])
    complex_values = sph_harm_y(l, abs(m), theta, phi)
    if m == 0:
        return complex_values.real
    return math.sqrt(2.0) * (complex_values.imag if m < 0 else complex_values.real)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_basis_is_that_of_scipy_in_order_and_sign(degree: int) -> None:
    basis = harmonics.sh_basis(UNITS, degree)
    want = [real_harmonic(l, m, UNITS) for l in range(degree + 1) for m in range(-l, l + 1)]
    assert basis.shape == (40, len(want))
    np.testing.assert_allclose(basis, np.stack(want, axis=1), atol=5e-15)


def test_the_constants_are_the_decimal_literals_that_the_code_bases_print() -> None:
    along_z = harmonics.sh_basis(np.array([[0.0, 0.0, 1.0]]), 1)[0]
    np.testing.assert_allclose(along_z[[0, 2]], [0.28209479177387814, 0.4886025119029199], rtol=1e-15)
    diagonal = harmonics.sh_basis(np.array([[1.0, 1.0, 1.0]]), 3)[0]
    np.testing.assert_allclose(diagonal[4], 1.0925484305920792, rtol=1e-15)
    np.testing.assert_allclose(diagonal[[9, 10]], [-0.5900435899266435 * 2.0, 2.890611442640554], rtol=1e-15)
    np.testing.assert_allclose(diagonal[[11, 12]], [-0.4570457994644658 * 2.0, 0.3731763325901154 * -4.0], rtol=1e-15)


def test_the_basis_is_orthonormal_by_gauss_legendre_quadrature() -> None:
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    angles = 2.0 * np.pi * np.arange(16) / 16
    z, phi = (grid.ravel() for grid in np.meshgrid(nodes, angles, indexing="ij"))
    r = np.sqrt(1.0 - z * z)
    basis = harmonics.sh_basis(np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1), 3)
    weights = np.repeat(node_weights, 16) * 2.0 * np.pi / 16
    np.testing.assert_allclose((basis * weights[:, None]).T @ basis, np.eye(16), atol=1e-14)


def test_a_lower_degree_loses_least_where_views_show_it_and_little_elsewhere() -> None:
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    z, phi = (grid.ravel() for grid in np.meshgrid(nodes, 2.0 * np.pi * np.arange(16) / 16, indexing="ij"))
    r = np.sqrt(1.0 - z * z)
    sphere = harmonics.sh_basis(np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1), 3)
    shares = np.repeat(node_weights, 16) / 32.0
    sh, dirs = HARMONICS_RNG.normal(size=(6, 16, 3)), HARMONICS_RNG.normal(size=(5, 6, 3))
    weights = HARMONICS_RNG.uniform(0.0, 4.0, size=(5, 6))
    weights[:, 5] = 0.0
    shown = [harmonics.sh_basis(view / np.linalg.norm(view, axis=1, keepdims=True), 3) for view in dirs]

    def loss(lower: np.ndarray, i: int) -> float:
        change = sh[i].copy()
        change[: len(lower)] -= lower
        seen = sum(w[i] * ((basis[i] @ change) ** 2).sum() for w, basis in zip(weights, shown, strict=True))
        return float(seen + 2.0 * (shares @ (sphere @ change) ** 2).sum())

    for degree in range(4):
        lower = harmonics.lower_degree(sh, dirs, weights, degree, uniform=2.0)
        # seen by no view: cut off
        np.testing.assert_allclose(lower[5], sh[5, : (degree + 1) ** 2], rtol=1e-15)
        for i in range(6):
            least = loss(lower[i], i)
            for _ in range(5):
                step = 1e-3 * HARMONICS_RNG.normal(size=lower[i].shape)
                # a quadratic is as much higher on one side of its minimum as on the other
                higher = [loss(lower[i] + sign * step, i) - least for sign in (-1.0, 1.0)]
                assert min(higher) > 0.0
                assert higher[0] == pytest.approx(higher[1], rel=1e-6)
    np.testing.assert_allclose(harmonics.lower_degree(sh, dirs, weights, 3), sh, rtol=1e-15)


def test_wrong_degrees_and_too_few_coefficients_are_refused() -> None:
    with pytest.raises(ValueError, match="sh_degree is 4; it must be 0, 1, 2 or 3"):
        harmonics.sh_basis(UNITS, 4)
    with pytest.raises(ValueError, match="sh has 4 coefficients; sh_degree 2 needs 9"):
        harmonics.colors_from_sh(np.zeros((40, 4, 3)), DIRS, 2)
