"""Spherical harmonics to colour, with the clamp at 0 (B2). Meaning: `pop_ref.harmonics`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pop_fast.stages.types import columns, from_columns

_C0 = math.sqrt(1.0 / (4.0 * math.pi))
_C1 = math.sqrt(3.0 / (4.0 * math.pi))
_C2 = math.sqrt(15.0 / (4.0 * math.pi))
_C2_Z = math.sqrt(5.0 / (16.0 * math.pi))
_C3_3 = math.sqrt(35.0 / (32.0 * math.pi))
_C3_2 = math.sqrt(105.0 / (4.0 * math.pi))
_C3_1 = math.sqrt(21.0 / (32.0 * math.pi))
_C3_0 = math.sqrt(7.0 / (16.0 * math.pi))


def sh_basis(dirs: Tensor, degree: int) -> Tensor:
    """See `pop_ref.harmonics.sh_basis`.

    Optimizations: one row per basis function; products of coordinates are shared.
    """
    x, y, z = columns(dirs)
    return from_columns(_basis_columns(x, y, z, degree), (_n_sh(degree),))


def sh_basis_vjp(dirs: Tensor, degree: int, v_basis: Tensor) -> Tensor:
    """See `pop_ref.harmonics.sh_basis_vjp`. Optimizations: component rows; only the active bands are touched."""
    x, y, z = columns(dirs)
    v = columns(v_basis)
    _n_sh(degree)
    v_x, v_y, v_z = torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x)
    if degree > 0:
        v_x, v_y, v_z = -_C1 * v[3], -_C1 * v[1], _C1 * v[2]
    if degree > 1:
        v_x = v_x + _C2 * (y * v[4] - z * v[7] + x * v[8]) - 2.0 * _C2_Z * x * v[6]
        v_y = v_y + _C2 * (x * v[4] - z * v[5] - y * v[8]) - 2.0 * _C2_Z * y * v[6]
        v_z = v_z + 4.0 * _C2_Z * z * v[6] - _C2 * (y * v[5] + x * v[7])
    if degree > 2:
        g_x, g_y, g_z = _third_band_vjp(x, y, z, v)
        v_x, v_y, v_z = v_x + g_x, v_y + g_y, v_z + g_z
    return from_columns((v_x, v_y, v_z), (3,))


def colors_from_sh(sh: Tensor, dirs: Tensor, degree: int) -> Tensor:
    """See `pop_ref.harmonics.colors_from_sh`.

    Optimizations: coefficients are transposed once so that the sum over bands runs over contiguous rows.
    """
    return evaluate_sh(sh, dirs, degree).unclamped.clamp_min(0.0).T


def colors_from_sh_vjp(sh: Tensor, dirs: Tensor, degree: int, v_colors: Tensor) -> tuple[Tensor, Tensor]:
    """See `pop_ref.harmonics.colors_from_sh_vjp` (B2).

    Optimizations: as `colors_from_sh`; the gradient to the coefficients is one outer product of rows.
    """
    v_active, v_dirs = evaluate_sh_vjp(evaluate_sh(sh, dirs, degree), v_colors.T)
    v_sh = torch.zeros_like(sh)
    v_sh[:, : v_active.shape[1]] = v_active
    return v_sh, v_dirs


def lower_degree(sh: Tensor, dirs: Tensor, weights: Tensor, degree: int, uniform: float = 1.0) -> Tensor:
    """See `pop_ref.harmonics.lower_degree`.

    Optimizations: all Gaussians' normal equations are made at once and solved as one batch.
    """
    n_sh, (n_views, n, _) = _n_sh(degree), dirs.shape
    rows = (dirs / torch.sqrt((dirs * dirs).sum(-1, keepdim=True))).reshape(-1, 3)
    basis = sh_basis(rows, math.isqrt(sh.shape[1]) - 1).reshape(n_views, n, -1)
    kept, dropped = basis[..., :n_sh], torch.einsum("cnk,nkd->cnd", basis[..., n_sh:], sh[:, n_sh:])
    weighted = (weights[..., None] * kept).permute(1, 2, 0)
    A = weighted @ kept.transpose(0, 1) + uniform / (4.0 * math.pi) * torch.eye(n_sh, dtype=sh.dtype)
    return sh[:, :n_sh] + torch.linalg.solve(A, weighted @ dropped.transpose(0, 1))


@dataclass(frozen=True)
class Evaluation:
    """Harmonics evaluated, with what the transpose needs, all component-major."""

    degree: int  # active bands
    rows: Tensor  # active coefficients. [n_sh, 3, N]
    basis: Tensor  # [n_sh, N]
    unit: Tensor  # unit directions. [3, N]
    norms: Tensor  # of the directions given. [N]
    unclamped: Tensor  # colours before the clamp at 0. [3, N]


def evaluate_sh(sh: Tensor, dirs: Tensor, degree: int) -> Evaluation:
    """Evaluate the active bands and keep what the transpose needs."""
    n_sh = check_bands(sh.shape[1], degree)
    rows = sh[:, :n_sh].permute(1, 2, 0).contiguous()
    components = dirs.T
    norms = torch.sqrt((components * components).sum(0))
    unit = components / norms
    basis = torch.stack(_basis_columns(unit[0], unit[1], unit[2], degree))
    return Evaluation(degree, rows, basis, unit, norms, (rows * basis[:, None]).sum(0) + 0.5)


def check_bands(given: int, degree: int) -> int:
    """Return how many coefficients a degree needs; ValueError where it is none, or fewer are given."""
    n_sh = _n_sh(degree)
    if given < n_sh:
        raise ValueError(f"sh has {given} coefficients; degree {degree} needs {n_sh}")
    return n_sh


def evaluate_sh_vjp(evaluation: Evaluation, v_colors: Tensor) -> tuple[Tensor, Tensor]:
    """Pull a cotangent of colours ([3, N]) back to the active coefficients [N, n_sh, 3] and the directions [N, 3]."""
    e = evaluation
    v_sum = v_colors * (e.unclamped >= 0.0)
    v_unit = sh_basis_vjp(e.unit.T, e.degree, (e.rows * v_sum).sum(1).T).T
    v_dirs = (v_unit - e.unit * (e.unit * v_unit).sum(0)) / e.norms
    return (e.basis[:, None] * v_sum).permute(2, 0, 1), v_dirs.T


def _n_sh(degree: int) -> int:
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"degree is {degree}; it must be 0, 1, 2 or 3")
    return (degree + 1) ** 2


def _basis_columns(x: Tensor, y: Tensor, z: Tensor, degree: int) -> list[Tensor]:
    n_sh = _n_sh(degree)
    basis = [torch.full_like(x, _C0)]
    if degree > 0:
        basis += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        basis += [_C2 * x * y, -_C2 * y * z, _C2_Z * (2.0 * zz - xx - yy), -_C2 * x * z, 0.5 * _C2 * (xx - yy)]
        if degree > 2:
            basis += [
                -_C3_3 * y * (3.0 * xx - yy),
                _C3_2 * x * y * z,
                -_C3_1 * y * (4.0 * zz - xx - yy),
                _C3_0 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
                -_C3_1 * x * (4.0 * zz - xx - yy),
                0.5 * _C3_2 * z * (xx - yy),
                -_C3_3 * x * (xx - 3.0 * yy),
            ]
    return basis[:n_sh]


def _third_band_vjp(x: Tensor, y: Tensor, z: Tensor, v: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor]:
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    v_x = (
        _C3_3 * (-6.0 * xy * v[9] - 3.0 * (xx - yy) * v[15])
        + _C3_2 * (yz * v[10] + xz * v[14])
        + _C3_1 * (2.0 * xy * v[11] - (4.0 * zz - 3.0 * xx - yy) * v[13])
        - 6.0 * _C3_0 * xz * v[12]
    )
    v_y = (
        _C3_3 * (-3.0 * (xx - yy) * v[9] + 6.0 * xy * v[15])
        + _C3_2 * (xz * v[10] - yz * v[14])
        + _C3_1 * (2.0 * xy * v[13] - (4.0 * zz - xx - 3.0 * yy) * v[11])
        - 6.0 * _C3_0 * yz * v[12]
    )
    v_z = (
        _C3_2 * (xy * v[10] + 0.5 * (xx - yy) * v[14])
        - 8.0 * _C3_1 * (yz * v[11] + xz * v[13])
        + 3.0 * _C3_0 * (2.0 * zz - xx - yy) * v[12]
    )
    return v_x, v_y, v_z
