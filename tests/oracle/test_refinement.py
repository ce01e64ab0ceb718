"""Corrections of cameras: rotations by scipy, motions that stay rigid."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from pop_ref.refinement import refined_viewmat, rotmat_from_vector, without_common_motion
from tests.oracle.scenes import tilted_camera

RNG = np.random.default_rng(12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0999999, 0.1, 0.1000001, 1.0, 3.0, 6.0])
def test_rotations_are_those_of_scipy_on_both_sides_of_the_series(angle: float) -> None:
    axis = RNG.normal(size=3)
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
    viewmat, correction = tilted_camera().viewmat, RNG.normal(0.0, 0.3, 6)
    refined = refined_viewmat(viewmat, correction)
    np.testing.assert_allclose(refined[:3, :3] @ refined[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.linalg.det(refined[:3, :3]) > 0.0
    point = RNG.normal(size=3)
    in_camera = viewmat[:3, :3] @ point + viewmat[:3, 3]
    moved = Rotation.from_rotvec(correction[:3]).apply(in_camera) + correction[3:]
    np.testing.assert_allclose(refined[:3, :3] @ point + refined[:3, 3], moved, atol=1e-14)


def ring() -> np.ndarray:
    turns = [Rotation.from_euler("yx", [angle, 20.0], degrees=True).as_matrix() for angle in range(0, 360, 60)]
    viewmats = np.tile(np.eye(4), (len(turns), 1, 1))
    for viewmat, R in zip(viewmats, turns, strict=True):
        viewmat[:3, :3], viewmat[:3, 3] = R, RNG.normal(0.0, 1.0, 3)
    return viewmats


def test_a_motion_of_the_whole_world_is_no_correction() -> None:
    viewmats, twist = ring(), 1e-5 * RNG.normal(size=6)
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
    viewmats, corrections = ring(), RNG.normal(0.0, 0.01, (6, 6))
    left = without_common_motion(corrections, viewmats)
    assert np.abs(np.sum(left * (corrections - left))) < 1e-15
    np.testing.assert_allclose(without_common_motion(left, viewmats), left, rtol=0.0, atol=1e-16)
    assert np.abs(left).max() > 5e-3
