"""The losses and regularizers against definitions written down elsewhere: scikit-image, scipy.

Exposure, colour correction, random backgrounds and corrected cameras against other implementations. What the laws of
the kit ask of the oracle, among it all of masks and of eq. 8, is not repeated here.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage
from scipy.spatial.transform import Rotation

from pop_ref import losses
from pop_ref.appearance import background_at, color_correct, expose, over_background
from pop_ref.records import Camera
from pop_ref.refinement import refined_viewmat, rotmat_from_vector
from pop_ref.regularizers import depth_samples, mean_activation, mean_activation_vjp, sparse_depth_loss
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


def test_depth_at_points_is_interpolated_and_compared_inverse() -> None:
    depth = DEPTH_RNG.uniform(1.0, 9.0, (5, 7))
    # beyond the outer pixels' centres too
    places = np.vstack([DEPTH_RNG.uniform(0.0, 1.0, (40, 2)) * [7.0, 5.0], [[0.0, 0.0], [7.0 - 1e-9, 2.5]]])
    disparities = DEPTH_RNG.uniform(0.05, 1.2, len(places))
    at = scipy.ndimage.map_coordinates(depth, (places - 0.5).T[::-1], order=1, mode="nearest")
    expected = np.mean(np.abs(1.0 / at - disparities))
    assert sparse_depth_loss(depth, places, disparities) == pytest.approx(expected, rel=1e-14)


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
