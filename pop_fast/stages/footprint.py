"""Low-pass, antialiasing factor, conics, extents and the off-screen cull (D2). Meaning: `pop_ref.footprint`."""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.stages.layout import columns, from_columns
from pop_fast.stages.tiles import tile_rects
from pop_ref.constants import PAPER, Profile


def low_pass(covars2d: Tensor, eps2d: float) -> Tensor:
    """See `pop_ref.footprint.low_pass`. Optimizations: component rows."""
    xx, xy, yx, yy = columns(covars2d)
    return from_columns((xx + eps2d, xy, yx, yy + eps2d), (2, 2))


def low_pass_vjp(covars2d: Tensor, eps2d: float, v_blurred: Tensor) -> Tensor:
    """See `pop_ref.footprint.low_pass_vjp`. Optimizations: none."""
    return v_blurred


def compensations(covars2d: Tensor, eps2d: float) -> Tensor:
    """See `pop_ref.footprint.compensations`. Optimizations: component rows."""
    det, det_blurred = _determinants(covars2d, eps2d)
    return torch.sqrt(torch.clamp_min(det / det_blurred, 0.0))


def compensations_vjp(covars2d: Tensor, eps2d: float, v_factors: Tensor) -> Tensor:
    """See `pop_ref.footprint.compensations_vjp`. Optimizations: component rows, no branches."""
    xx, xy, _, yy = columns(covars2d)
    det, det_blurred = _determinants(covars2d, eps2d)
    ratio = det / det_blurred
    # d sqrt(r) = dr / (2 sqrt(r)); where r <= 0 the factor is flat at 0
    slope = torch.where(ratio > 0.0, 0.5 * v_factors / torch.sqrt(ratio.clamp_min(1e-300)), 0.0)
    v_det = slope / det_blurred
    v_det_blurred = -slope * ratio / det_blurred
    v_xx = v_det * yy + v_det_blurred * (yy + eps2d)
    v_yy = v_det * xx + v_det_blurred * (xx + eps2d)
    v_xy = -(v_det + v_det_blurred) * xy
    return from_columns((v_xx, v_xy, v_xy, v_yy), (2, 2))


def conics_from_covars2d(covars2d: Tensor) -> Tensor:
    """See `pop_ref.footprint.conics_from_covars2d`. Optimizations: component rows, no branches."""
    xx, xy, _, yy = columns(covars2d)
    inverse = _inverse_det(xx, xy, yy)
    return from_columns((yy * inverse, -xy * inverse, xx * inverse), (3,))


def conics_from_covars2d_vjp(covars2d: Tensor, v_conics: Tensor) -> Tensor:
    """See `pop_ref.footprint.conics_from_covars2d_vjp`. Optimizations: component rows, no branches."""
    xx, xy, _, yy = columns(covars2d)
    inverse = _inverse_det(xx, xy, yy)
    a, b, c = yy * inverse, -xy * inverse, xx * inverse
    v_a, v_b, v_c = columns(v_conics)
    h = 0.5 * v_b
    # the transpose of the inverse is -Q V Q with Q the conic and V the cotangent, its off-diagonal split evenly
    left_xx, left_xy = a * v_a + b * h, a * h + b * v_c
    left_yx, left_yy = b * v_a + c * h, b * h + c * v_c
    v_xy = -(left_xx * b + left_xy * c)
    return from_columns((-(left_xx * a + left_xy * b), v_xy, v_xy, -(left_yx * b + left_yy * c)), (2, 2))


def radii_from_covars2d(covars2d: Tensor, opacities: Tensor, profile: Profile = PAPER) -> Tensor:
    """See `pop_ref.footprint.radii_from_covars2d` (D2).

    Optimizations: component rows, no branches; int32.
    """
    xx, xy, _, yy = columns(covars2d)
    det = xx * yy - xy * xy
    if profile.extent == "square":
        middle = 0.5 * (xx + yy)
        largest = middle + torch.sqrt(torch.clamp_min(middle * middle - det, 0.1))
        r = torch.ceil(profile.extent_sigmas * torch.sqrt(largest))
        radii, shown = (r, r), det > 0.0
    else:
        # in float32 the ratio is off by its rounding, which just above the floor would round a splat away
        rounding = torch.finfo(torch.float32).eps if opacities.dtype == torch.float32 else 0.0
        reach = torch.sqrt(2.0 * (torch.log(torch.clamp_min(opacities / profile.alpha_floor, 1.0)) + rounding))
        reach = reach.clamp_max(profile.extent_sigmas)
        radii = (torch.ceil(reach * torch.sqrt(xx)), torch.ceil(reach * torch.sqrt(yy)))
        shown = (det > 0.0) & (opacities >= profile.alpha_floor)
    # a splat wider than any image still fits into int32
    return from_columns([torch.where(shown, r, 0.0).clamp_max(1e9).to(torch.int32) for r in radii], (2,))


def on_screen(means2d: Tensor, radii: Tensor, width: int, height: int, profile: Profile = PAPER) -> Tensor:
    """See `pop_ref.footprint.on_screen` (D2). Optimizations: component rows."""
    x, y = columns(means2d)
    rx, ry = columns(radii)
    some = (rx > 0) & (ry > 0)
    if profile.extent == "square":
        x0, y0, x1, y1 = columns(tile_rects(means2d, radii, width, height, profile.tile_size, profile))
        return some & (x0 < x1) & (y0 < y1)
    return some & (x + rx > 0) & (x - rx < width) & (y + ry > 0) & (y - ry < height)


def _determinants(covars2d: Tensor, eps2d: float) -> tuple[Tensor, Tensor]:
    xx, xy, _, yy = columns(covars2d)
    return xx * yy - xy * xy, (xx + eps2d) * (yy + eps2d) - xy * xy


def _inverse_det(xx: Tensor, xy: Tensor, yy: Tensor) -> Tensor:
    det = xx * yy - xy * xy
    return torch.where(det > 0.0, 1.0 / det, 0.0)
