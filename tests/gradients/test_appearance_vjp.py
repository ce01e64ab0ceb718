"""Transposes of exposure and of the correction of cameras against differences."""

from __future__ import annotations

import numpy as np
import pytest

from pop_ref.appearance import expose, expose_vjp
from pop_ref.refinement import refined_viewmat, refined_viewmat_vjp, rotmat_from_vector, rotmat_from_vector_vjp
from tests.gradients.checks import assert_vjp_matches
from tests.oracle.scenes import tilted_camera

RNG = np.random.default_rng(13)


def test_exposure_transpose_matches_differences() -> None:
    assert_vjp_matches(
        expose, expose_vjp, [RNG.uniform(-0.2, 1.2, (2, 3, 3)), np.eye(3, 4) + RNG.normal(0.0, 0.3, (3, 4))]
    )


# at no rotation, and on both sides of where the series end
@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.099, 0.101, 2.5])
def test_rotation_transpose_matches_differences(angle: float) -> None:
    axis = RNG.normal(size=3)
    assert_vjp_matches(rotmat_from_vector, rotmat_from_vector_vjp, [angle * axis / np.linalg.norm(axis)])


def test_correction_transpose_matches_differences() -> None:
    def upper(upper_rows: np.ndarray, correction: np.ndarray) -> np.ndarray:
        return refined_viewmat(np.vstack([upper_rows, [0.0, 0.0, 0.0, 1.0]]), correction)[:3]

    def upper_vjp(upper_rows: np.ndarray, correction: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        whole = np.vstack([upper_rows, [0.0, 0.0, 0.0, 1.0]])
        v_viewmat, v_correction = refined_viewmat_vjp(whole, correction, np.vstack([v, np.zeros(4)]))
        assert np.all(v_viewmat[3] == 0.0)
        return v_viewmat[:3], v_correction

    assert_vjp_matches(upper, upper_vjp, [tilted_camera().viewmat[:3], RNG.normal(0.0, 0.2, 6)])
