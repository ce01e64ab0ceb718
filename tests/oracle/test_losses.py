"""The losses and regularizers against definitions written down elsewhere: eq. 4, scikit-image, scipy.

Exposure, colour correction and random backgrounds by what they must do, and against other implementations."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import scipy.ndimage
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from pop_ref import losses
from pop_ref.appearance import background_at, centred_exposures, color_correct, expose, over_background
from pop_ref.polarization import pop_loss
from pop_ref.records import Camera
from pop_ref.refinement import refined_viewmat, rotmat_from_vector, without_common_motion
from pop_ref.regularizers import (
    depth_samples,
    mean_activation,
    mean_activation_vjp,
    sparse_depth_loss,
    sparse_depth_loss_vjp,
)
from pop_ref.ssim import WINDOW_SIGMA, gaussian_window
from tests.oracle.scenes import tilted_camera

SIZES = ((11, 11), (12, 17), (16, 13))


def pair(height: int, width: int, channels: int = 3, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    target = rng.random((height, width, channels))
    return np.clip(target + 0.25 * rng.normal(size=target.shape), -0.25, 1.25), target


def convolved(image: np.ndarray) -> np.ndarray:
    window = gaussian_window()[:, :, None]
    return scipy.ndimage.convolve(image, window, mode="constant", cval=0.0)


def test_l1_at_equality_has_the_mean_of_its_one_sided_slopes() -> None:
    target = np.full((1, 1, 1), 0.5)
    above, at, below = (losses.l1_vjp(target + d, target, 1.0).item() for d in (2.0**-40, 0.0, -(2.0**-40)))
    assert (above, at, below) == (1.0, 0.0, -1.0)


def test_window_is_the_impulse_response_of_scipys_gaussian_filter() -> None:
    impulse = np.zeros((11, 11))
    impulse[5, 5] = 1.0
    expected = scipy.ndimage.gaussian_filter(impulse, WINDOW_SIGMA, radius=5, mode="constant")
    np.testing.assert_allclose(gaussian_window(), expected, rtol=1e-14)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_ssim_valid_equals_scikit_image(height: int, width: int) -> None:
    # here, since it takes seconds to import and every worker imports every module
    from skimage.metrics import structural_similarity

    image, target = pair(height, width)
    expected, full = structural_similarity(
        *(image, target),
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    assert losses.ssim(image, target, "valid") == pytest.approx(expected, abs=1e-13)
    np.testing.assert_allclose(losses.ssim_map(image, target, "valid"), full[5:-5, 5:-5], atol=1e-12)


@pytest.mark.parametrize(("height", "width"), [*SIZES, (1, 1), (3, 7)])
def test_ssim_same_equals_zero_padded_convolutions(height: int, width: int) -> None:
    image, target = pair(height, width)
    mu_x, mu_y = convolved(image), convolved(target)
    s_xx, s_yy = convolved(image**2) - mu_x**2, convolved(target**2) - mu_y**2
    s_xy = convolved(image * target) - mu_x * mu_y
    c1, c2 = 1e-4, 9e-4
    expected = (2 * mu_x * mu_y + c1) * (2 * s_xy + c2) / ((mu_x**2 + mu_y**2 + c1) * (s_xx + s_yy + c2))
    np.testing.assert_allclose(losses.ssim_map(image, target, "same"), expected, atol=1e-12)
    assert losses.ssim(image, target, "same") == pytest.approx(expected.mean(), abs=1e-13)


def test_ssim_of_equal_images_is_one_and_is_its_maximum() -> None:
    image, target = pair(12, 12)
    for padding in ("valid", "same"):
        assert losses.ssim(image, image, padding) == pytest.approx(1.0, abs=1e-15)
        assert losses.d_ssim(image, image, padding) == pytest.approx(0.0, abs=1e-15)
        assert np.all(losses.ssim_map(image, target, padding) < 1.0)
        assert np.max(np.abs(losses.ssim_vjp(image, image, 1.0, padding))) < 1e-15


@pytest.mark.parametrize("height_width", [(10, 64), (64, 10), (1, 1)])
def test_an_image_without_a_whole_window_is_refused_with_the_fix(height_width: tuple[int, int]) -> None:
    image = np.zeros((*height_width, 3))
    with pytest.raises(ValueError, match=r"at least 11 x 11: use padding='same'"):
        losses.ssim(image, image, "valid")


def test_unfit_arguments_are_refused_by_name() -> None:
    # either by the shape types, when they are checked, or by the function itself
    image = np.zeros((11, 11, 3))
    with pytest.raises(Exception, match="reflect"):
        losses.ssim_map(image, image, "reflect")  # type: ignore[arg-type]
    with pytest.raises(Exception, match="target"):
        losses.l2(image, np.zeros((11, 12, 3)))
    with pytest.raises(Exception, match="mask"):
        losses.l2(image, image, np.ones((11, 12), dtype=bool))


def test_objectives_are_the_weighted_sums_of_eqs_2_and_9() -> None:
    image, target = pair(12, 12)
    for padding in ("valid", "same"):
        d_ssim = 1.0 - losses.ssim(image, target, padding)
        expected_3dgs = 0.8 * losses.l1(image, target) + 0.2 * d_ssim
        expected_pop = 0.99 * losses.l2(image, target) + 0.01 * d_ssim
        assert losses.photometric_3dgs(image, target, padding=padding) == pytest.approx(expected_3dgs, rel=1e-14)
        assert losses.photometric_pop(image, target, padding=padding) == pytest.approx(expected_pop, rel=1e-14)


def test_halved_d_ssim_is_half_of_it() -> None:
    image, target = pair(11, 11)
    whole = losses.d_ssim(image, target)
    assert losses.d_ssim(image, target, halved=True) == 0.5 * whole
    gained = losses.photometric_pop(image, target) - losses.photometric_pop(image, target, halved=True)
    assert gained == pytest.approx(0.01 * 0.5 * whole, rel=1e-12)


def test_scales_act_on_the_pixelwise_term_alone() -> None:
    image, target = pair(11, 11)
    for loss, scale, pixelwise, weight in (
        (losses.photometric_3dgs, "l1_scale", losses.l1, 0.8),
        (losses.photometric_pop, "l2_scale", losses.l2, 0.99),
    ):
        less = loss(image, target) - loss(image, target, **{scale: 0.25})
        assert less == pytest.approx(0.75 * weight * pixelwise(image, target), rel=1e-12)


ALL = (
    (losses.l1, losses.l1_vjp),
    (losses.l2, losses.l2_vjp),
    (losses.d_ssim, losses.d_ssim_vjp),
    (losses.photometric_3dgs, losses.photometric_3dgs_vjp),
    (losses.photometric_pop, losses.photometric_pop_vjp),
)


@given(seed=st.integers(0, 2**16), share=st.sampled_from([0.0, 0.25, 0.9]))
def test_pixels_that_are_left_out_have_no_loss_and_no_gradient(seed: int, share: float) -> None:
    image, target = pair(12, 12, channels=1, seed=seed)
    mask = np.random.default_rng(seed).random((12, 12)) < share
    poisoned = np.where(mask[:, :, None], image, np.nan)
    for loss, vjp in ALL:
        assert loss(poisoned, target, mask=mask) == loss(image, target, mask=mask)
        v_image = vjp(poisoned, target, 1.0, mask=mask)
        assert np.all(v_image[~mask] == 0.0)
        assert np.all(np.isfinite(v_image))


def test_a_mask_that_keeps_everything_changes_nothing() -> None:
    image, target = pair(12, 12)
    mask = np.ones((12, 12), dtype=bool)
    for loss, vjp in ALL:
        assert loss(image, target, mask=mask) == loss(image, target)
        np.testing.assert_array_equal(vjp(image, target, 1.0, mask=mask), vjp(image, target, 1.0))


def test_a_mask_that_keeps_nothing_leaves_no_loss() -> None:
    image, target = pair(12, 12)
    mask = np.zeros((12, 12), dtype=bool)
    assert losses.ssim(image, target, mask=mask) == 1.0
    for loss, vjp in ALL:
        assert loss(image, target, mask=mask) == 0.0
        assert np.all(vjp(image, target, 1.0, mask=mask) == 0.0)


def test_masked_means_run_over_the_kept_pixels_only() -> None:
    image, target = pair(12, 14)
    mask = np.zeros((12, 14), dtype=bool)
    mask[:, :6] = True
    assert losses.l1(image, target, mask) == pytest.approx(losses.l1(image[:, :6], target[:, :6]), rel=1e-14)
    replaced = np.where(mask[:, :, None], image, target)
    kept = losses.ssim_map(replaced, target, "same")[mask]
    assert losses.ssim(image, target, "same", mask) == pytest.approx(kept.mean(), rel=1e-14)


# The polarized opacity prior against eq. 8 in exact rationals, and its edge cases.

opacities_st = st.sampled_from([0.5, 0.25, 0.75, 0.0, 1.0, 0.0009765625]) | st.floats(0.0, 1.0)
members_st = st.lists(st.tuples(opacities_st, st.booleans(), st.booleans()), max_size=12)


def unpacked(members: list[tuple[float, bool, bool]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    o, mask, visible = zip(*members, strict=True) if members else ((), (), ())
    return np.array(o, dtype=np.float64), np.array(mask, dtype=bool), np.array(visible, dtype=bool)


def exact_loss(members: list[tuple[float, bool, bool]]) -> Fraction:
    toward_one = [1 - Fraction(o) for o, important, _ in members if important]
    toward_zero = [Fraction(o) for o, important, _ in members if not important]
    return sum((sum(side, Fraction(0)) / len(side) for side in (toward_one, toward_zero) if side), Fraction(0))


@given(members_st)
def test_pop_loss_is_eq_8_in_exact_rationals(members: list[tuple[float, bool, bool]]) -> None:
    o, mask, visible = unpacked(members)
    assert pop_loss(o, mask) == pytest.approx(float(exact_loss(members)), rel=1e-14, abs=1e-300)
    seen = [member for member in members if member[2]]
    assert pop_loss(o, mask, visible) == pytest.approx(float(exact_loss(seen)), rel=1e-14, abs=1e-300)


# Sparse depth against scipy's interpolation, and the means that opacities and scales are held down by.

DEPTH_RNG = np.random.default_rng(17)


def samples_of_points() -> tuple[np.ndarray, Camera, np.ndarray, np.ndarray]:
    camera, rng = tilted_camera(), np.random.default_rng(3)
    points = rng.uniform(-6.0, 6.0, (2000, 3))
    return points, camera, *depth_samples(points, camera)


def test_samples_are_the_points_that_a_camera_shows_where_it_shows_them() -> None:
    points, camera, places, disparities = samples_of_points()
    homogeneous = np.hstack([points, np.ones((len(points), 1))]) @ camera.viewmat[:3].T
    z, on_screen = homogeneous[:, 2], homogeneous @ camera.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = on_screen[:, 0] / z, on_screen[:, 1] / z
    shown = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    assert 10 < shown.sum() < len(points)
    np.testing.assert_allclose(places, np.stack([u, v], axis=1)[shown], rtol=1e-12)
    np.testing.assert_allclose(disparities, 1.0 / z[shown], rtol=1e-13)


def test_a_point_whose_pixel_the_mask_leaves_out_says_nothing() -> None:
    points, camera, places, disparities = samples_of_points()
    mask = np.zeros((camera.height, camera.width), dtype=bool)
    mask[:, : camera.width // 2] = True
    left = places[:, 0] < camera.width // 2
    kept = depth_samples(points, camera, mask)
    assert 0 < left.sum() < len(places)
    np.testing.assert_array_equal(kept[0], places[left])
    np.testing.assert_array_equal(kept[1], disparities[left])


def test_depth_at_points_is_interpolated_and_compared_inverse() -> None:
    depth = DEPTH_RNG.uniform(1.0, 9.0, (5, 7))
    # beyond the outer pixels' centres too
    places = np.vstack([DEPTH_RNG.uniform(0.0, 1.0, (40, 2)) * [7.0, 5.0], [[0.0, 0.0], [7.0 - 1e-9, 2.5]]])
    disparities = DEPTH_RNG.uniform(0.05, 1.2, len(places))
    at = scipy.ndimage.map_coordinates(depth, (places - 0.5).T[::-1], order=1, mode="nearest")
    expected = np.mean(np.abs(1.0 / at - disparities))
    assert sparse_depth_loss(depth, places, disparities) == pytest.approx(expected, rel=1e-14)


def test_depth_loss_scales_inversely_with_the_world() -> None:
    depth, places = DEPTH_RNG.uniform(1.0, 9.0, (4, 4)), DEPTH_RNG.uniform(0.0, 4.0, (9, 2))
    disparities = DEPTH_RNG.uniform(0.1, 1.0, 9)
    loss = sparse_depth_loss(depth, places, disparities)
    assert loss > 0.0
    # so that the scene's scale times it does not depend on the unit of length
    assert sparse_depth_loss(4.0 * depth, places, disparities / 4.0) == loss / 4.0


def test_where_nothing_is_rendered_the_disparity_is_zero_and_nothing_is_pulled() -> None:
    places, disparities = np.array([[0.5, 0.5], [2.5, 0.5]]), np.array([0.5, 0.25])
    depth = np.array([[0.0, 0.0, 8.0]])
    assert sparse_depth_loss(depth, places, disparities) == (0.5 + 0.125) / 2.0
    assert sparse_depth_loss_vjp(depth, places, disparities, 1.0).tolist() == [[0.0, 0.0, 0.5 / 64.0]]
    assert sparse_depth_loss(depth, np.zeros((0, 2)), np.zeros(0)) == 0.0


def test_means_of_activations_are_numpys_and_none_is_zero() -> None:
    for shape in ((7,), (7, 3)):
        values = DEPTH_RNG.uniform(0.0, 1.0, shape)
        assert mean_activation(values) == pytest.approx(float(np.mean(values)), rel=1e-14)
    assert mean_activation(np.zeros((0, 3))) == 0.0
    assert mean_activation_vjp(np.zeros((0, 3)), 2.0).shape == (0, 3)


RNG = np.random.default_rng(11)
IMAGE = RNG.uniform(-0.2, 1.3, (3, 4, 3))
EXPOSURE = np.eye(3, 4) + RNG.normal(0.0, 0.3, (3, 4))


def test_the_identity_leaves_every_bit_of_a_render() -> None:
    np.testing.assert_array_equal(expose(IMAGE, np.eye(3, 4)), IMAGE)


def test_an_exposure_mixes_channels_row_by_row() -> None:
    np.testing.assert_allclose(
        expose(IMAGE, EXPOSURE), np.einsum("ij,hwj->hwi", EXPOSURE[:, :3], IMAGE) + EXPOSURE[:, 3], atol=1e-14
    )


def test_centred_exposures_have_the_identity_as_mean() -> None:
    exposures = np.eye(3, 4) + RNG.normal(0.1, 0.3, (4, 3, 4))
    centred = centred_exposures(exposures)
    np.testing.assert_allclose(centred.mean(axis=0), np.eye(3, 4), atol=1e-15)
    np.testing.assert_allclose(centred - centred[0], exposures - exposures[0], atol=1e-15)


def test_correction_takes_back_gain_and_offset_by_channel() -> None:
    target = RNG.uniform(0.0, 1.0, (40, 3))
    image = target * [0.5, 0.75, 0.9] + [0.25, 0.1, 0.05]
    np.testing.assert_allclose(color_correct(image, target), target, atol=1e-13)


def test_correction_is_the_inverse_of_the_line_that_numpy_fits_from_photograph_to_render() -> None:
    target, image = RNG.uniform(0.0, 1.0, (2, 60, 3))
    image = 0.7 * target + 0.2 * image
    for channel in range(3):
        slope, offset = np.polyfit(target[:, channel], image[:, channel], 1)
        expected = np.clip((image[:, channel] - offset) / slope, 0.0, 1.0)
        np.testing.assert_allclose(color_correct(image, target)[:, channel], expected, atol=1e-12)


def test_a_render_without_any_colour_of_its_photograph_keeps_a_slope_of_one() -> None:
    target = np.linspace(0.0, 1.0, 9)[:, None].repeat(3, axis=1)
    np.testing.assert_allclose(color_correct(np.full((9, 3), 0.5), target), np.zeros((9, 3)), atol=1e-12)


def test_the_stream_is_splitmix64_by_its_published_numbers() -> None:
    # the first three numbers from state 0, whose mix is 0; Vigna's splitmix64.c prints these
    words = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    np.testing.assert_array_equal(background_at(0, 0), [(word >> 11) * 2.0**-53 for word in words])


def test_backgrounds_of_many_steps_are_uniform() -> None:
    colors = np.array([background_at(step, 3) for step in range(3000)])
    far = background_at(2**40, 2**31 - 1)
    assert np.all((colors >= 0.0) & (colors < 1.0) & (far >= 0.0) & (far < 1.0))
    np.testing.assert_allclose(colors.mean(axis=0), 0.5, atol=0.02)
    np.testing.assert_allclose(np.cov(colors.T), np.eye(3) / 12.0, atol=5e-3)


def test_a_photograph_over_another_background_is_as_if_laid_over_it() -> None:
    alpha = RNG.uniform(0.0, 1.0, (3, 4))
    alpha[0, :2] = 0.0, 1.0
    was, now = RNG.uniform(0.0, 1.0, (2, 3))

    def over(background: np.ndarray) -> np.ndarray:
        return alpha[:, :, None] * IMAGE + (1.0 - alpha)[:, :, None] * background

    np.testing.assert_allclose(over_background(over(was), alpha, was, now), over(now), rtol=0.0, atol=1e-15)
    np.testing.assert_array_equal(over_background(over(was), alpha, was, now)[0, 1], IMAGE[0, 1])


# Corrections of cameras: rotations by scipy, motions that stay rigid.

REFINEMENT_RNG = np.random.default_rng(12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0999999, 0.1, 0.1000001, 1.0, 3.0, 6.0])
def test_rotations_are_those_of_scipy_on_both_sides_of_the_series(angle: float) -> None:
    axis = REFINEMENT_RNG.normal(size=3)
    vector = angle * axis / np.linalg.norm(axis)
    np.testing.assert_allclose(rotmat_from_vector(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)


def test_a_rotation_is_the_exponential_of_its_generator() -> None:
    x, y, z = vector = np.array([0.3, -0.2, 0.5])
    generator = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    np.testing.assert_allclose(rotmat_from_vector(vector), expm(generator), atol=1e-15)


def test_no_correction_leaves_every_bit_of_a_camera() -> None:
    viewmat = tilted_camera().viewmat
    np.testing.assert_array_equal(refined_viewmat(viewmat, np.zeros(6)), viewmat)


def test_a_corrected_camera_is_rigid_and_moves_points_in_its_own_axes() -> None:
    viewmat, correction = tilted_camera().viewmat, REFINEMENT_RNG.normal(0.0, 0.3, 6)
    refined = refined_viewmat(viewmat, correction)
    np.testing.assert_allclose(refined[:3, :3] @ refined[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.linalg.det(refined[:3, :3]) > 0.0
    point = REFINEMENT_RNG.normal(size=3)
    in_camera = viewmat[:3, :3] @ point + viewmat[:3, 3]
    moved = Rotation.from_rotvec(correction[:3]).apply(in_camera) + correction[3:]
    np.testing.assert_allclose(refined[:3, :3] @ point + refined[:3, 3], moved, atol=1e-14)


def ring() -> np.ndarray:
    turns = [Rotation.from_euler("yx", [angle, 20.0], degrees=True).as_matrix() for angle in range(0, 360, 60)]
    viewmats = np.tile(np.eye(4), (len(turns), 1, 1))
    for viewmat, R in zip(viewmats, turns, strict=True):
        viewmat[:3, :3], viewmat[:3, 3] = R, REFINEMENT_RNG.normal(0.0, 1.0, 3)
    return viewmats


def test_what_is_taken_out_is_orthogonal_to_what_is_left() -> None:
    viewmats, corrections = ring(), REFINEMENT_RNG.normal(0.0, 0.01, (6, 6))
    left = without_common_motion(corrections, viewmats)
    assert np.abs(np.sum(left * (corrections - left))) < 1e-15
    np.testing.assert_allclose(without_common_motion(left, viewmats), left, rtol=0.0, atol=1e-16)
    assert np.abs(left).max() > 5e-3
