"""Transposes of the activations against differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from pop_ref import (
    INRIA,
    PAPER,
    Profile,
    activations,
    alpha,
    camera,
    covariance,
    footprint,
    harmonics,
    losses,
    projection,
)
from pop_ref.appearance import expose, expose_vjp
from pop_ref.polarization import pop_loss, pop_loss_vjp
from pop_ref.refinement import refined_viewmat, refined_viewmat_vjp, rotmat_from_vector, rotmat_from_vector_vjp
from pop_ref.regularizers import mean_activation, mean_activation_vjp, sparse_depth_loss, sparse_depth_loss_vjp
from tests.gradients.checks import assert_vjp_matches, complex_step_gradient
from tests.oracle.scenes import tilted_camera

RNG = np.random.default_rng(1)


def test_scales_transpose_matches_differences() -> None:
    args = [RNG.normal(size=(4, 3))]
    assert_vjp_matches(activations.scales_from_log_scales, activations.scales_from_log_scales_vjp, args)


def test_opacities_transpose_matches_differences() -> None:
    args = [np.array([-9.0, -1.0, 0.0, 0.5, 9.0])]
    assert_vjp_matches(activations.opacities_from_logits, activations.opacities_from_logits_vjp, args)


def test_opacities_transpose_does_not_cancel_near_one() -> None:
    v = activations.opacities_from_logits_vjp(np.array([40.0]), np.ones(1))
    np.testing.assert_allclose(v, np.exp(-40.0), rtol=1e-12)


def test_unit_quaternions_transpose_matches_differences() -> None:
    args = [RNG.normal(size=(4, 4)) * np.array([[1.0], [1.0], [0.125], [8.0]])]
    assert_vjp_matches(activations.unit_quats_from_quats, activations.unit_quats_from_quats_vjp, args)


def test_unit_quaternions_gradient_is_orthogonal_to_the_quaternion() -> None:
    quats = RNG.normal(size=(6, 4))
    v = activations.unit_quats_from_quats_vjp(quats, RNG.normal(size=(6, 4)))
    assert np.linalg.norm(v) > 0.0
    np.testing.assert_allclose(np.sum(quats * v, axis=1), 0.0, atol=1e-14)


# Transposes of rotations and covariances against differences.

ROWS_RNG = np.random.default_rng(2)
QUATS = ROWS_RNG.normal(size=(3, 4)) * np.array([[1.0], [0.25], [4.0]])
SCALES = np.exp(ROWS_RNG.normal(size=(3, 3)))


def test_rotations_transpose_matches_differences() -> None:
    assert_vjp_matches(covariance.rotmats_from_quats, covariance.rotmats_from_quats_vjp, [QUATS])


def test_covariances_transpose_matches_differences() -> None:
    assert_vjp_matches(covariance.covars_from_quats_scales, covariance.covars_from_quats_scales_vjp, [QUATS, SCALES])


def test_quaternion_gradient_is_orthogonal_to_the_quaternion() -> None:
    v_quats, _ = covariance.covars_from_quats_scales_vjp(QUATS, SCALES, ROWS_RNG.normal(size=(3, 3, 3)))
    assert np.linalg.norm(v_quats) > 0.0
    np.testing.assert_allclose(np.sum(QUATS * v_quats, axis=1), 0.0, atol=1e-13)


def test_a_zero_scale_has_a_zero_scale_gradient() -> None:
    scales = SCALES.copy()
    scales[1] = 0.0
    v_quats, v_scales = covariance.covars_from_quats_scales_vjp(QUATS, scales, ROWS_RNG.normal(size=(3, 3, 3)))
    assert np.all(v_scales[1] == 0.0)
    assert np.all(v_quats[1] == 0.0)
    assert np.all(v_scales[[0, 2]] != 0.0)


def test_an_isotropic_covariance_does_not_depend_on_its_rotation() -> None:
    v_quats, _ = covariance.covars_from_quats_scales_vjp(QUATS, np.full((3, 3), 2.0), ROWS_RNG.normal(size=(3, 3, 3)))
    np.testing.assert_allclose(v_quats, 0.0, atol=1e-12)


# Transposes of the world-to-camera stages against differences, the view matrix's twelve entries included.

CAMERA_RNG = np.random.default_rng(4)
VIEWMAT = tilted_camera().viewmat
MEANS = CAMERA_RNG.normal(size=(3, 3))
COVARS = CAMERA_RNG.normal(size=(3, 3, 3))


def test_center_transpose_matches_differences() -> None:
    assert_vjp_matches(camera.camera_center, camera.camera_center_vjp, [VIEWMAT])


def test_view_directions_transpose_matches_differences() -> None:
    assert_vjp_matches(camera.view_dirs, camera.view_dirs_vjp, [MEANS, VIEWMAT])


def test_camera_frame_centres_transpose_matches_differences() -> None:
    assert_vjp_matches(camera.means_cam_from_means, camera.means_cam_from_means_vjp, [MEANS, VIEWMAT])


def test_camera_frame_covariances_transpose_matches_differences_for_matrices_that_are_not_symmetric() -> None:
    assert_vjp_matches(camera.covars_cam_from_covars, camera.covars_cam_from_covars_vjp, [COVARS, VIEWMAT])


def test_the_view_matrix_s_last_row_gets_exactly_zero() -> None:
    for v_viewmat in (
        camera.camera_center_vjp(VIEWMAT, np.ones(3)),
        camera.view_dirs_vjp(MEANS, VIEWMAT, MEANS)[1],
        camera.means_cam_from_means_vjp(MEANS, VIEWMAT, MEANS)[1],
        camera.covars_cam_from_covars_vjp(COVARS, VIEWMAT, COVARS)[1],
    ):
        assert np.all(v_viewmat[3] == 0.0)
        assert np.any(v_viewmat[:3] != 0.0)


def test_the_center_s_gradient_agrees_with_matrix_inversion_along_rigid_motions() -> None:
    # gsplat differentiates the inverse instead: equal on the tangent directions of a rotation
    v_center, omega = CAMERA_RNG.normal(size=3), CAMERA_RNG.normal(size=3)
    spin = np.array([[0.0, -omega[2], omega[1]], [omega[2], 0.0, -omega[0]], [-omega[1], omega[0], 0.0]])
    motion = np.zeros((4, 4))
    motion[:3, :3] = spin @ VIEWMAT[:3, :3]
    motion[:3, 3] = CAMERA_RNG.normal(size=3)
    inverse = np.linalg.inv(VIEWMAT)
    through_inverse = v_center @ (-inverse @ motion @ inverse)[:3, 3]
    ours = np.sum(camera.camera_center_vjp(VIEWMAT, v_center) * motion)
    np.testing.assert_allclose(ours, through_inverse, rtol=1e-12)


# Transposes of the projection against differences, inside and outside the frustum clamp.

PROJECTION_RNG = np.random.default_rng(5)
K = np.array([[7.0, 0.0, 3.25], [0.0, 9.0, 2.0], [0.0, 0.0, 1.0]])
SIZE = (6, 5)
INSIDE = np.array([[0.5, -0.25, 2.0], [-1.0, 0.5, 4.0]])
# one clamped on each side: +x, -x, +y, -y, and both axes at once
OUTSIDE = np.array([[4.0, 0.5, 2.0], [-4.0, 0.5, 2.0], [0.5, 4.0, 2.0], [0.5, -4.0, 3.0], [-5.0, 6.0, 1.5]])


@pytest.mark.parametrize("profile", [PAPER, INRIA], ids=lambda p: p.name)
def test_centres_transpose_matches_differences(profile: Profile) -> None:
    assert_vjp_matches(
        lambda p: projection.project_means(p, K, *SIZE, profile),
        lambda p, v: projection.project_means_vjp(p, K, *SIZE, v, profile),
        [np.vstack([INSIDE, OUTSIDE])],
    )


@pytest.mark.parametrize("means_cam", [INSIDE, OUTSIDE], ids=["inside", "outside"])
def test_jacobians_transpose_matches_differences(means_cam: np.ndarray) -> None:
    assert_vjp_matches(
        lambda p: projection.projection_jacobians(p, K, *SIZE),
        lambda p, v: projection.projection_jacobians_vjp(p, K, *SIZE, v),
        [means_cam],
    )


def test_inria_s_jacobians_transpose_matches_differences_inside_the_frustum() -> None:
    assert_vjp_matches(
        lambda p: projection.projection_jacobians(p, K, *SIZE, INRIA),
        lambda p, v: projection.projection_jacobians_vjp(p, K, *SIZE, v, INRIA),
        [INSIDE],
    )


def test_inria_s_clamped_z_path_keeps_its_unclamped_form_and_its_x_path_is_cut() -> None:
    exact = Profile(**{**INRIA.__dict__, "clamp_gradient": "exact"})
    for x, y, z in OUTSIDE[:2].tolist():
        p, v_J = np.array([[x, y, z]]), np.zeros((1, 2, 3))
        v_J[0, 0, 2] = 1.0
        true = projection.projection_jacobians_vjp(p, K, *SIZE, v_J, exact)[0]
        inria = projection.projection_jacobians_vjp(p, K, *SIZE, v_J, INRIA)[0]
        tx = -projection.projection_jacobians(p, K, *SIZE, INRIA)[0, 0, 2] * z * z / K[0, 0]
        assert true[0] == inria[0] == 0.0
        np.testing.assert_allclose(inria[2], 2.0 * K[0, 0] * tx / z**3, rtol=1e-14)
        np.testing.assert_allclose(true[2], K[0, 0] * tx / z**3, rtol=1e-14)


def test_at_exactly_the_limit_the_derivative_from_inside_is_used() -> None:
    K4 = np.array([[4.0, 0.0, 2.0], [0.0, 4.0, 2.0], [0.0, 0.0, 1.0]])
    dyadic = Profile(**{**PAPER.__dict__, "frustum_margin": 0.5})
    # the limit is (W - cx) / fx + 0.5 W / (2 fx) = 0.5 + 0.25
    v_J = np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]])
    v = projection.projection_jacobians_vjp(np.array([[1.5, 0.0, 2.0]]), K4, 4, 4, v_J, dyadic)
    assert v[0].tolist() == [-1.0, 0.0, 1.5]


def test_projected_covariances_transpose_matches_differences_for_matrices_that_are_not_symmetric() -> None:
    args = [PROJECTION_RNG.normal(size=(3, 3, 3)), PROJECTION_RNG.normal(size=(3, 2, 3))]
    assert_vjp_matches(projection.project_covars, projection.project_covars_vjp, args)


# Transposes of the splat's footprint against differences.

FOOTPRINT_RNG = np.random.default_rng(6)
ROOTS = FOOTPRINT_RNG.normal(size=(4, 2, 2))
COVARS2D = ROOTS @ ROOTS.swapaxes(1, 2) + 0.125 * np.eye(2)
FLAT = np.array([[[1.0, 2.0], [2.0, 1.0]]])


def test_low_pass_transpose_matches_differences() -> None:
    assert_vjp_matches(lambda c: footprint.low_pass(c, 0.3), lambda c, v: footprint.low_pass_vjp(c, 0.3, v), [COVARS2D])


def test_conics_transpose_matches_differences() -> None:
    assert_vjp_matches(footprint.conics_from_covars2d, footprint.conics_from_covars2d_vjp, [COVARS2D])


def test_compensations_transpose_matches_differences() -> None:
    assert_vjp_matches(
        lambda c: footprint.compensations(c, 0.3), lambda c, v: footprint.compensations_vjp(c, 0.3, v), [COVARS2D]
    )


def test_both_cotangents_are_symmetric() -> None:
    for v in (
        footprint.conics_from_covars2d_vjp(COVARS2D, FOOTPRINT_RNG.normal(size=(4, 3))),
        footprint.compensations_vjp(COVARS2D, 0.3, FOOTPRINT_RNG.normal(size=4)),
    ):
        assert np.linalg.norm(v) > 0.0
        np.testing.assert_allclose(v, v.swapaxes(1, 2), rtol=1e-12)


def test_without_an_ellipse_nothing_passes() -> None:
    assert np.all(footprint.conics_from_covars2d_vjp(FLAT, np.ones((1, 3))) == 0.0)
    assert np.all(footprint.compensations_vjp(FLAT, 0.25, np.ones(1)) == 0.0)


def test_the_gradient_of_a_vanishing_footprint_in_antialiased_mode_is_finite() -> None:
    v = footprint.compensations_vjp(np.diag([0.0, 0.0])[None], 0.3, np.ones(1))
    assert np.all(v == 0.0)


# Transposes of the spherical harmonics against differences.

HARMONICS_RNG = np.random.default_rng(3)
DIRS = HARMONICS_RNG.normal(size=(5, 3)) * np.array([[1.0], [0.25], [4.0], [1.0], [16.0]])
SH = HARMONICS_RNG.normal(size=(5, 16, 3))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_basis_transpose_matches_differences(degree: int) -> None:
    constant = {0} if degree == 0 else set()
    assert_vjp_matches(
        lambda dirs: harmonics.sh_basis(dirs, degree),
        lambda dirs, v: harmonics.sh_basis_vjp(dirs, degree, v),
        [DIRS],
        zero_gradient_allowed=constant,
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colors_transpose_matches_differences_with_clamped_channels_among_them(degree: int) -> None:
    sums = np.einsum("nk,nkc->nc", harmonics.sh_basis(_unit(DIRS), degree), SH[:, : (degree + 1) ** 2]) + 0.5
    assert np.min(np.abs(sums)) > 1e-2
    assert np.any(sums < 0.0)
    assert np.any(sums > 0.0)
    assert_vjp_matches(
        lambda sh, dirs: harmonics.colors_from_sh(sh, dirs, degree),
        lambda sh, dirs, v: harmonics.colors_from_sh_vjp(sh, dirs, degree, v),
        [SH, DIRS],
        zero_gradient_allowed={1} if degree == 0 else set(),
    )


def test_basis_gradient_is_exact_by_complex_step_of_the_closed_form() -> None:
    # Y_6 = sqrt(5 / 16 pi) (2 zz - xx - yy), Y_14 = sqrt(105 / 16 pi) z (xx - yy)
    def closed(d: np.ndarray) -> complex:
        x, y, z = d
        return np.sqrt(5 / (16 * np.pi)) * (2 * z * z - x * x - y * y) + np.sqrt(105 / (16 * np.pi)) * z * (
            x * x - y * y
        )

    v = np.zeros((1, 16))
    v[0, 6] = v[0, 14] = 1.0
    got = harmonics.sh_basis_vjp(DIRS[:1], 3, v)[0]
    np.testing.assert_allclose(got, complex_step_gradient(closed, DIRS[0]), rtol=1e-13)


def test_direction_gradient_is_orthogonal_to_the_direction() -> None:
    _, v_dirs = harmonics.colors_from_sh_vjp(SH, DIRS, 3, HARMONICS_RNG.normal(size=(5, 3)))
    assert np.linalg.norm(v_dirs) > 0.0
    np.testing.assert_allclose(np.sum(v_dirs * DIRS, axis=1), 0.0, atol=1e-13)


def test_a_clamped_channel_passes_exactly_nothing_and_one_at_zero_passes_from_above() -> None:
    below, at_zero = (
        -0.75 / harmonics.sh_basis(np.eye(3)[:1], 0)[0, 0],
        -0.5 / harmonics.sh_basis(np.eye(3)[:1], 0)[0, 0],
    )
    sh = np.array([[[below, at_zero, 0.0]]])
    assert harmonics.colors_from_sh(sh, np.eye(3)[:1], 0)[0].tolist() == [0.0, 0.0, 0.5]
    v_sh, _ = harmonics.colors_from_sh_vjp(sh, np.eye(3)[:1], 0, np.ones((1, 3)))
    assert v_sh[0, 0, 0] == 0.0
    assert v_sh[0, 0, 1] == v_sh[0, 0, 2] > 0.0


def test_coefficients_beyond_the_degree_get_exactly_zero() -> None:
    v_sh, _ = harmonics.colors_from_sh_vjp(SH, DIRS, 1, np.ones((5, 3)))
    assert np.all(v_sh[:, 4:] == 0.0)
    assert np.any(v_sh[:, :4] != 0.0)


def _unit(dirs: np.ndarray) -> np.ndarray:
    return dirs / np.linalg.norm(dirs, axis=1, keepdims=True)


# Transposes of one splat at one pixel against differences.

MEAN, CONIC = np.array([2.0, 1.25]), np.array([1.0, 0.5, 2.0])


def test_sigma_transpose_matches_differences() -> None:
    assert_vjp_matches(
        lambda mean, conic: alpha.sigma_at_pixel(mean.tolist(), conic.tolist(), 0.5, 0.5),
        lambda mean, conic, v: alpha.sigma_at_pixel_vjp(mean.tolist(), conic.tolist(), 0.5, 0.5, float(v)),
        [MEAN, CONIC],
    )


def test_falloff_transpose_matches_differences() -> None:
    assert_vjp_matches(
        lambda s: alpha.falloff(float(s)), lambda s, v: alpha.falloff_vjp(float(s), float(v)), [np.array(0.75)]
    )


@pytest.mark.parametrize("profile", [PAPER, INRIA], ids=lambda p: p.name)
@pytest.mark.parametrize("sigma", [0.25, 2.0])
def test_alpha_transpose_matches_differences_between_floor_and_ceiling(sigma: float, profile: Profile) -> None:
    assert_vjp_matches(
        lambda s, o: alpha.alpha_from_sigma(float(s), float(o), profile)[0],
        lambda s, o, v: alpha.alpha_from_sigma_vjp(float(s), float(o), float(v), profile),
        [np.array(sigma), np.array(0.75)],
    )


def test_over_the_ceiling_paper_passes_nothing_and_inria_passes_all() -> None:
    assert alpha.alpha_from_sigma(0.0, 1.0, PAPER)[0] == PAPER.alpha_ceiling
    assert alpha.alpha_from_sigma_vjp(0.0, 1.0, 4.0, PAPER) == (0.0, 0.0)
    assert alpha.alpha_from_sigma(0.0, 1.0, INRIA)[0] == INRIA.alpha_ceiling
    assert alpha.alpha_from_sigma_vjp(0.0, 1.0, 4.0, INRIA) == (-4.0, 4.0)


def test_at_exactly_the_ceiling_the_derivative_from_below_is_used() -> None:
    half = Profile(**{**PAPER.__dict__, "alpha_ceiling": 0.5})
    assert alpha.alpha_from_sigma_vjp(0.0, 0.5, 4.0, half) == (-2.0, 4.0)


@pytest.mark.parametrize(("sigma", "opacity"), [(0.0, 1.0 / 256.0), (0.0, 0.0), (100.0, 1.0), (-1.0, 0.5)])
def test_a_skipped_splat_passes_exactly_nothing(sigma: float, opacity: float) -> None:
    assert alpha.alpha_from_sigma(sigma, opacity)[1]
    assert alpha.alpha_from_sigma_vjp(sigma, opacity, 1.0) == (0.0, 0.0)


# Transposes of exposure and of the correction of cameras against differences.

COLOR_RNG = np.random.default_rng(13)


def test_exposure_transpose_matches_differences() -> None:
    assert_vjp_matches(
        expose,
        expose_vjp,
        [COLOR_RNG.uniform(-0.2, 1.2, (2, 3, 3)), np.eye(3, 4) + COLOR_RNG.normal(0.0, 0.3, (3, 4))],
    )


# at no rotation, and on both sides of where the series end
@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.099, 0.101, 2.5])
def test_rotation_transpose_matches_differences(angle: float) -> None:
    axis = COLOR_RNG.normal(size=3)
    assert_vjp_matches(rotmat_from_vector, rotmat_from_vector_vjp, [angle * axis / np.linalg.norm(axis)])


def test_correction_transpose_matches_differences() -> None:
    def upper(upper_rows: np.ndarray, correction: np.ndarray) -> np.ndarray:
        return refined_viewmat(np.vstack([upper_rows, [0.0, 0.0, 0.0, 1.0]]), correction)[:3]

    def upper_vjp(upper_rows: np.ndarray, correction: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        whole = np.vstack([upper_rows, [0.0, 0.0, 0.0, 1.0]])
        v_viewmat, v_correction = refined_viewmat_vjp(whole, correction, np.vstack([v, np.zeros(4)]))
        assert np.all(v_viewmat[3] == 0.0)
        return v_viewmat[:3], v_correction

    assert_vjp_matches(upper, upper_vjp, [tilted_camera().viewmat[:3], COLOR_RNG.normal(0.0, 0.2, 6)])


# Transposes of the losses against differences.

LOSSES_RNG = np.random.default_rng(5)
TARGET = LOSSES_RNG.random((12, 13, 1))
# far from L1's kink: no difference is under 0.05
IMAGE = TARGET + LOSSES_RNG.choice([-1.0, 1.0], TARGET.shape) * (0.05 + 0.25 * LOSSES_RNG.random(TARGET.shape))
MASK = LOSSES_RNG.random((12, 13)) < 0.7

CASES = {
    "l1": (losses.l1, losses.l1_vjp, {}),
    "l2": (losses.l2, losses.l2_vjp, {}),
    "ssim_valid": (losses.ssim, losses.ssim_vjp, {"padding": "valid"}),
    "ssim_same": (losses.ssim, losses.ssim_vjp, {"padding": "same"}),
    "d_ssim_halved": (losses.d_ssim, losses.d_ssim_vjp, {"halved": True}),
    "photometric_3dgs": (losses.photometric_3dgs, losses.photometric_3dgs_vjp, {"l1_scale": 0.5}),
    "photometric_pop": (losses.photometric_pop, losses.photometric_pop_vjp, {"lambda_ssim": 0.25, "l2_scale": 3.0}),
}


@pytest.mark.parametrize("name", CASES)
def test_loss_transpose_matches_differences(name: str) -> None:
    loss, vjp, options = CASES[name]
    # zero padding gives every pixel a window, so a smaller picture does
    small = np.s_[:7, :8] if options.get("padding") == "same" else np.s_[:, :]
    _check(loss, vjp, options, IMAGE[small], TARGET[small])


@pytest.mark.parametrize("name", ["l1", "l2", "ssim_valid", "photometric_pop"])
def test_masked_loss_transpose_matches_differences(name: str) -> None:
    loss, vjp, options = CASES[name]
    _check(loss, vjp, {**options, "mask": MASK}, IMAGE, TARGET)


def _check(
    loss: Callable[..., float], vjp: Callable[..., np.ndarray], options: dict, image: np.ndarray, target: np.ndarray
) -> None:
    assert_vjp_matches(
        lambda x: np.array(loss(x, target, **options)), lambda x, v: vjp(x, target, float(v), **options), [image]
    )


# Transpose of the POP loss against differences.

OPACITIES = np.random.default_rng(7).uniform(0.125, 0.875, 6)
POLARIZATION_MASK = np.array([True, False, True, False, False, False])


@pytest.mark.parametrize("visible", [None, np.array([True, True, True, True, False, True])])
@pytest.mark.parametrize("mask", [POLARIZATION_MASK, POLARIZATION_MASK | True, POLARIZATION_MASK & False])
def test_pop_loss_transpose_matches_differences(mask: np.ndarray, visible: np.ndarray | None) -> None:
    assert_vjp_matches(
        lambda o: np.array(pop_loss(o, mask, visible)),
        lambda o, v: pop_loss_vjp(o, mask, float(v), visible),
        [OPACITIES],
    )


def test_sparse_depth_transpose_matches_differences() -> None:
    rng = np.random.default_rng(8)
    # far from where the disparities agree; several points share pixels, and some lie beyond the outer centres
    places, disparities = rng.uniform(0.0, 1.0, (12, 2)) * [4.0, 3.0], rng.choice([0.02, 3.0], 12)

    def loss(depth: np.ndarray) -> np.ndarray:
        return np.array(sparse_depth_loss(depth, places, disparities))

    def loss_vjp(depth: np.ndarray, v: np.ndarray) -> np.ndarray:
        return sparse_depth_loss_vjp(depth, places, disparities, float(v))

    assert_vjp_matches(loss, loss_vjp, [rng.uniform(1.0, 8.0, (3, 4))])


@pytest.mark.parametrize("shape", [(5,), (5, 3)])
def test_means_of_activations_transpose_matches_differences(shape: tuple[int, ...]) -> None:
    def mean(values: np.ndarray) -> np.ndarray:
        return np.array(mean_activation(values))

    def mean_vjp(values: np.ndarray, v: np.ndarray) -> np.ndarray:
        return mean_activation_vjp(values, float(v))

    assert_vjp_matches(mean, mean_vjp, [RNG.uniform(0.1, 1.0, shape)])
