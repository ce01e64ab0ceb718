"""Exposure, colour correction and random backgrounds by what they must do, and against other implementations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from pop_ref.appearance import background_at, centred_exposures, color_correct, expose, over_background
from pop_ref.refinement import refined_viewmat, rotmat_from_vector, without_common_motion
from tests.oracle.scenes import tilted_camera

RNG = np.random.default_rng(11)
IMAGE = RNG.uniform(-0.2, 1.3, (3, 4, 3))
EXPOSURE = np.eye(3, 4) + RNG.normal(0.0, 0.3, (3, 4))


def test_the_identity_leaves_every_bit_of_a_render() -> None:
    np.testing.assert_array_equal(expose(IMAGE, np.eye(3, 4)), IMAGE)


def test_exposures_compose_as_affine_maps_do() -> None:
    second = np.eye(3, 4) + RNG.normal(0.0, 0.3, (3, 4))
    last = [[0.0, 0.0, 0.0, 1.0]]
    together = (np.vstack([second, last]) @ np.vstack([EXPOSURE, last]))[:3]
    np.testing.assert_allclose(expose(expose(IMAGE, EXPOSURE), second), expose(IMAGE, together), rtol=0.0, atol=1e-14)


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


@given(st.integers(0, 2**40), st.integers(0, 2**31 - 1))
def test_a_background_lies_in_the_unit_cube_and_depends_on_nothing_but_step_and_seed(step: int, seed: int) -> None:
    color = background_at(step, seed)
    assert np.all((color >= 0.0) & (color < 1.0))
    np.testing.assert_array_equal(color, background_at(step, seed))


def test_the_stream_is_splitmix64_by_its_published_numbers() -> None:
    # the first three numbers from state 0, whose mix is 0; Vigna's splitmix64.c prints these
    words = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    np.testing.assert_array_equal(background_at(0, 0), [(word >> 11) * 2.0**-53 for word in words])


def test_backgrounds_of_many_steps_are_uniform() -> None:
    colors = np.array([background_at(step, 3) for step in range(3000)])
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


def test_a_motion_of_the_whole_world_is_no_correction() -> None:
    viewmats, twist = ring(), 1e-5 * REFINEMENT_RNG.normal(size=6)
    world = refined_viewmat(np.eye(4), twist)
    moved = viewmats @ world
    corrections = np.zeros((len(viewmats), 6))
    for i, (after, before) in enumerate(zip(moved, viewmats, strict=True)):
        motion = after @ np.linalg.inv(before)
        corrections[i, :3] = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
        corrections[i, 3:] = motion[:3, 3]
    assert np.abs(corrections).max() > 5e-6
    # to first order: what is left is of the size of the twist's square
    assert np.abs(without_common_motion(corrections, viewmats)).max() < 1e-9


def test_what_is_taken_out_is_orthogonal_to_what_is_left() -> None:
    viewmats, corrections = ring(), REFINEMENT_RNG.normal(0.0, 0.01, (6, 6))
    left = without_common_motion(corrections, viewmats)
    assert np.abs(np.sum(left * (corrections - left))) < 1e-15
    np.testing.assert_allclose(without_common_motion(left, viewmats), left, rtol=0.0, atol=1e-16)
    assert np.abs(left).max() > 5e-3
