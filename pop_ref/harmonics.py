"""Spherical harmonics to colour: real harmonics of degree 0 to 3 as homogeneous polynomials of the view direction.

The signs are those of the code bases (the Condon-Shortley phase is kept: degree 1 is -y, +z, -x). Written as
homogeneous polynomials their gradient needs no care about the unit sphere: the normalisation's transpose removes the
radial part.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from pop_ref._shapes import Float64

_C0: Final = math.sqrt(1.0 / (4.0 * math.pi))
_C1: Final = math.sqrt(3.0 / (4.0 * math.pi))
_C2: Final = math.sqrt(15.0 / (4.0 * math.pi))
_C2_Z: Final = math.sqrt(5.0 / (16.0 * math.pi))
_C3_3: Final = math.sqrt(35.0 / (32.0 * math.pi))
_C3_2: Final = math.sqrt(105.0 / (4.0 * math.pi))
_C3_1: Final = math.sqrt(21.0 / (32.0 * math.pi))
_C3_0: Final = math.sqrt(7.0 / (16.0 * math.pi))


def _basis_one(x: float, y: float, z: float) -> list[float]:
    xx, yy, zz = x * x, y * y, z * z
    return [
        _C0,
        -_C1 * y,
        _C1 * z,
        -_C1 * x,
        _C2 * x * y,
        -_C2 * y * z,
        _C2_Z * (2.0 * zz - xx - yy),
        -_C2 * x * z,
        _C2 / 2.0 * (xx - yy),
        -_C3_3 * y * (3.0 * xx - yy),
        _C3_2 * x * y * z,
        -_C3_1 * y * (4.0 * zz - xx - yy),
        _C3_0 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -_C3_1 * x * (4.0 * zz - xx - yy),
        _C3_2 / 2.0 * z * (xx - yy),
        -_C3_3 * x * (xx - 3.0 * yy),
    ]


def _basis_gradient_one(x: float, y: float, z: float) -> list[list[float]]:
    xx, yy, zz = x * x, y * y, z * z
    return [
        [0.0, 0.0, 0.0],
        [0.0, -_C1, 0.0],
        [0.0, 0.0, _C1],
        [-_C1, 0.0, 0.0],
        [_C2 * y, _C2 * x, 0.0],
        [0.0, -_C2 * z, -_C2 * y],
        [-2.0 * _C2_Z * x, -2.0 * _C2_Z * y, 4.0 * _C2_Z * z],
        [-_C2 * z, 0.0, -_C2 * x],
        [_C2 * x, -_C2 * y, 0.0],
        [-6.0 * _C3_3 * x * y, -3.0 * _C3_3 * (xx - yy), 0.0],
        [_C3_2 * y * z, _C3_2 * x * z, _C3_2 * x * y],
        [2.0 * _C3_1 * x * y, -_C3_1 * (4.0 * zz - xx - 3.0 * yy), -8.0 * _C3_1 * y * z],
        [-6.0 * _C3_0 * x * z, -6.0 * _C3_0 * y * z, 3.0 * _C3_0 * (2.0 * zz - xx - yy)],
        [-_C3_1 * (4.0 * zz - 3.0 * xx - yy), 2.0 * _C3_1 * x * y, -8.0 * _C3_1 * x * z],
        [_C3_2 * x * z, -_C3_2 * y * z, _C3_2 / 2.0 * (xx - yy)],
        [-3.0 * _C3_3 * (xx - yy), 6.0 * _C3_3 * x * y, 0.0],
    ]


def sh_basis(dirs: Float64[np.ndarray, "N 3"], degree: int) -> Float64[np.ndarray, "N n_sh"]:
    """Evaluate the real spherical harmonics up to a degree.

    Source: Ramamoorthi and Hanrahan 2001; Sloan 2013, appendix A2.
    Departs: gsplat and Inria write the constants as decimal literals; here they are their closed forms.

    Args:
        dirs: unit directions, world frame.
        degree: 0, 1, 2 or 3.

    Returns:
        The first (degree + 1)^2 basis functions.

    Raises:
        ValueError: the degree is not 0, 1, 2 or 3.

    Example:
        >>> sh_basis(np.array([[0.0, 0.0, 1.0]]), 1).round(4) + 0.0
        array([[0.2821, 0.    , 0.4886, 0.    ]])
    """
    n_sh = _n_sh(degree)
    basis = np.zeros((len(dirs), n_sh))
    for i, (x, y, z) in enumerate(dirs.tolist()):
        basis[i] = _basis_one(x, y, z)[:n_sh]
    return basis


def sh_basis_vjp(
    dirs: Float64[np.ndarray, "N 3"], degree: int, v_basis: Float64[np.ndarray, "N n_sh"]
) -> Float64[np.ndarray, "N 3"]:
    """Pull a cotangent of the basis back to the directions: `v_d = sum_k v_Y_k grad Y_k`.

    The basis is differentiated as homogeneous polynomials of an unconstrained direction.

    Source: transpose of `sh_basis`.
    Departs: gsplat differentiates other polynomials that agree on the unit sphere; the tangential part is the same.

    Args:
        dirs: unit directions, world frame.
        degree: 0, 1, 2 or 3.
        v_basis: cotangent of the basis functions.

    Returns:
        Cotangent of `dirs`.

    Example:
        >>> sh_basis_vjp(np.array([[0.0, 0.0, 1.0]]), 1, np.array([[1.0, 0.0, 1.0, 0.0]])).round(4)
        array([[0.    , 0.    , 0.4886]])
    """
    v_dirs = np.zeros((len(dirs), 3))
    for i, (x, y, z) in enumerate(dirs.tolist()):
        v_dirs[i] = v_basis[i] @ np.array(_basis_gradient_one(x, y, z)[: _n_sh(degree)])
    return v_dirs


def colors_from_sh(
    sh: Float64[np.ndarray, "N n_coefficients 3"], dirs: Float64[np.ndarray, "N 3"], degree: int
) -> Float64[np.ndarray, "N 3"]:
    """Evaluate view-dependent colours: `c = max(sum_k Y_k(d / |d|) sh_k + 0.5, 0)`.

    Source: Kerbl et al. 2023 (3DGS), section 4, and the code bases for the offset 0.5 and the clamp.
    Departs: the paper states neither the offset nor the clamp (B2).

    Args:
        sh: coefficients; those beyond (degree + 1)^2 are not used.
        dirs: from the camera centre to the Gaussians, world frame, any norm > 0.
        degree: 0, 1, 2 or 3.

    Returns:
        Colours, encoded rgb, >= 0, not bounded above.

    Raises:
        ValueError: the degree is not 0 to 3, or `sh` has fewer than (degree + 1)^2 coefficients.

    Example:
        >>> sh = np.array([[[0.0, 1.0, -8.0]]])
        >>> colors_from_sh(sh, np.array([[0.0, 0.0, 2.0]]), 0).round(4)
        array([[0.5   , 0.7821, 0.    ]])
    """
    n_sh = _enough(sh, degree)
    basis = sh_basis(_unit(dirs), degree)
    colors = np.zeros((len(sh), 3))
    for i in range(len(sh)):
        colors[i] = np.maximum(basis[i] @ sh[i, :n_sh] + 0.5, 0.0)
    return colors


def colors_from_sh_vjp(
    sh: Float64[np.ndarray, "N n_coefficients 3"],
    dirs: Float64[np.ndarray, "N 3"],
    degree: int,
    v_colors: Float64[np.ndarray, "N 3"],
) -> tuple[Float64[np.ndarray, "N n_coefficients 3"], Float64[np.ndarray, "N 3"]]:
    """Pull a cotangent of colours back to coefficients and directions.

    `v_sh_k = Y_k v_c`, `v_Y_k = sh_k . v_c`, then through the basis and the normalisation. A channel under 0
    passes nothing; at exactly 0 the derivative from above is used.

    Source: transpose of `colors_from_sh`.
    Departs: nothing.

    Args:
        sh: coefficients; those beyond (degree + 1)^2 get zero.
        dirs: from the camera centre to the Gaussians, world frame, any norm > 0.
        degree: 0, 1, 2 or 3.
        v_colors: cotangent of the colours.

    Returns:
        Cotangents of `sh` and `dirs`, the second orthogonal to `dirs`.

    Example:
        >>> sh = np.array([[[0.0, 1.0, -8.0]]])
        >>> v_sh, v_dirs = colors_from_sh_vjp(sh, np.array([[0.0, 0.0, 2.0]]), 0, np.ones((1, 3)))
        >>> v_sh.round(4)
        array([[[0.2821, 0.2821, 0.    ]]])
    """
    n_sh = _enough(sh, degree)
    units = _unit(dirs)
    basis = sh_basis(units, degree)
    v_sh = np.zeros(sh.shape)
    v_basis = np.zeros(basis.shape)
    for i in range(len(sh)):
        unclamped = basis[i] @ sh[i, :n_sh] + 0.5
        v_sum = np.where(unclamped >= 0.0, v_colors[i], 0.0)
        v_sh[i, :n_sh] = np.outer(basis[i], v_sum)
        v_basis[i] = sh[i, :n_sh] @ v_sum
    v_units = sh_basis_vjp(units, degree, v_basis)
    v_dirs = np.zeros(dirs.shape)
    for i in range(len(dirs)):
        u, v_u = units[i], v_units[i]
        v_dirs[i] = (v_u - u * (u @ v_u)) / math.hypot(*dirs[i].tolist())
    return v_sh, v_dirs


def lower_degree(
    sh: Float64[np.ndarray, "N n_coefficients 3"],
    dirs: Float64[np.ndarray, "C N 3"],
    weights: Float64[np.ndarray, "C N"],
    degree: int,
    uniform: float = 1.0,
) -> Float64[np.ndarray, "N n_sh 3"]:
    """Fit harmonics of a lower degree to the colours of a higher one, where views show them.

    `x` minimises `sum_v w_v |Y(d_v) . x - Y(d_v) . sh|^2 + u mean_d |Y(d) . x - Y(d) . sh|^2`, the mean over all
    directions. As the harmonics are orthogonal, the second term is `u / 4 pi` times the squares of the change of the
    bands that stay, and what views do not show is left as it was: with no view, `x` is `sh` cut off.

    Source: least squares; orthogonality of the real harmonics (Sloan 2013).
    Departs: the clamp of colours at 0 (B2) is left out.

    Args:
        sh: coefficients.
        dirs: from the camera centres to the Gaussians, world frame, any norm > 0.
        weights: how much each view counts, as the sum of a Gaussian's blending weights over its pixels; >= 0.
        degree: of the result, 0, 1, 2 or 3.
        uniform: how much all directions together count, in the unit of the weights; > 0.

    Returns:
        The first (degree + 1)^2 coefficients.

    Raises:
        ValueError: the degree is not 0 to 3, or `sh` has fewer than (degree + 1)^2 coefficients.

    Example:
        >>> sh = np.zeros((1, 4, 3))
        >>> sh[0, 2] = 1.0
        >>> seen_from_below = np.array([[[0.0, 0.0, 1.0]]])
        >>> lower_degree(sh, seen_from_below, np.array([[3.0]]), 0)[0, 0].round(4)
        array([1.299, 1.299, 1.299])
    """
    n_sh = _enough(sh, degree)
    every = math.isqrt(sh.shape[1]) - 1
    bases = [sh_basis(_unit(view), every) for view in dirs]
    lower = np.zeros((len(sh), n_sh, 3))
    for i in range(len(sh)):
        left, right = uniform / (4.0 * math.pi) * np.eye(n_sh), np.zeros((n_sh, 3))
        for basis, weight in zip(bases, weights[:, i], strict=True):
            kept, dropped = basis[i, :n_sh], basis[i, n_sh:] @ sh[i, n_sh:]
            left += weight * np.outer(kept, kept)
            right += weight * np.outer(kept, dropped)
        lower[i] = sh[i, :n_sh] + np.linalg.solve(left, right)
    return lower


def _unit(dirs: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    units = np.zeros(dirs.shape)
    for i in range(len(dirs)):
        units[i] = dirs[i] / math.hypot(*dirs[i].tolist())
    return units


def _n_sh(degree: int) -> int:
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"sh_degree is {degree}; it must be 0, 1, 2 or 3")
    return (degree + 1) ** 2


def _enough(sh: Float64[np.ndarray, "N n_coefficients 3"], degree: int) -> int:
    n_sh = _n_sh(degree)
    if sh.shape[1] < n_sh:
        raise ValueError(f"sh has {sh.shape[1]} coefficients; sh_degree {degree} needs {n_sh}")
    return n_sh
