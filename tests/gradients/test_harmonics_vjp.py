"""Transposes of the spherical harmonics against differences."""

from __future__ import annotations

import numpy as np
import pytest

from pop_ref import harmonics
from tests.gradients.checks import assert_vjp_matches, complex_step_gradient

RNG = np.random.default_rng(3)
DIRS = RNG.normal(size=(5, 3)) * np.array([[1.0], [0.25], [4.0], [1.0], [16.0]])
SH = RNG.normal(size=(5, 16, 3))


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
    _, v_dirs = harmonics.colors_from_sh_vjp(SH, DIRS, 3, RNG.normal(size=(5, 3)))
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
