"""The exponent of alpha as a matrix product over a tile's pixels. Meaning: `pop_ref.alpha`.

alpha = o exp(-sigma) = 2^(f . p) with p = (1, x, y, x^2, xy, y^2) in pixels from the tile's centre and six
coefficients f per (splat, tile). The constant and linear coefficients cancel for needles whose centre lies far from
the tile, so they are computed in float64 and rounded once; what is left within a tile is of the order of the exponent
itself.

The transpose needs the same six moments of G = alpha dL/dalpha, M = sum_p G p: every geometric gradient is linear in
them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pop_fast.layout import columns
from pop_fast.tiles import TileLists

_LOG2_E = math.log2(math.e)
NULL_EXPONENT = -1e4  # 2 to this power is 0 in float32 and float64: entries that pad a list blend nothing


@dataclass(frozen=True)
class Entries:
    """What the pairs of one tile-list entry share: centre relative to the tile's centre, conic, opacity. Each [I].

    Attributes:
        u: px.
        v: px.
        a: conic xx, px^-2.
        b: conic xy, px^-2.
        c: conic yy, px^-2.
        opacity: of the splat.
    """

    u: Tensor
    v: Tensor
    a: Tensor
    b: Tensor
    c: Tensor
    opacity: Tensor


def entries_of_lists(means2d: Tensor, conics: Tensor, opacities: Tensor, lists: TileLists) -> Entries:
    """Gather, in float64, what each tile-list entry needs."""
    tile = lists.entry_tiles
    ids = lists.ids
    row = torch.div(tile, lists.tiles_x, rounding_mode="floor")
    half = 0.5 * lists.tile_size
    x, y, a, b, c, o = (t.double().index_select(0, ids) for t in (*columns(means2d), *columns(conics), opacities))
    u = x - ((tile - row * lists.tiles_x) * lists.tile_size + half)
    v = y - (row * lists.tile_size + half)
    return Entries(u, v, a, b, c, o)


def exponent_coefficients(entries: Entries, dtype: torch.dtype) -> Tensor:
    """Return the six coefficients of log2(alpha) of every entry, and one last row that blends nothing. [I + 1, 6]"""
    e = entries
    gx = e.a * e.u + e.b * e.v
    gy = e.b * e.u + e.c * e.v
    constant = torch.log2(e.opacity) - (0.5 * _LOG2_E) * (gx * e.u + gy * e.v)
    rows = torch.zeros((6, len(e.u) + 1), dtype=torch.float64)
    rows[0, :-1] = constant
    rows[0, -1] = NULL_EXPONENT
    torch.mul(gx, _LOG2_E, out=rows[1, :-1])
    torch.mul(gy, _LOG2_E, out=rows[2, :-1])
    torch.mul(e.a, -0.5 * _LOG2_E, out=rows[3, :-1])
    torch.mul(e.b, -_LOG2_E, out=rows[4, :-1])
    torch.mul(e.c, -0.5 * _LOG2_E, out=rows[5, :-1])
    return rows.T.to(dtype)


def pixel_basis(tile_size: int, dtype: torch.dtype) -> Tensor:
    """Return (1, x, y, x^2, xy, y^2) at a tile's pixel centres, from its centre. [6, tile_size^2]"""
    at = torch.arange(tile_size, dtype=dtype) + (0.5 - 0.5 * tile_size)
    y, x = torch.meshgrid(at, at, indexing="ij")
    x, y = x.reshape(-1), y.reshape(-1)
    return torch.stack((torch.ones_like(x), x, y, x * x, x * y, y * y))


def entry_gradients(entries: Entries, moments: Tensor) -> tuple[Tensor, ...]:
    """Turn the six moments of G ([6, I]) into gradients to screen centre (2), conic (3) and opacity."""
    e = entries
    m0, mx, my, mxx, mxy, myy = moments
    du, dv = e.u * m0 - mx, e.v * m0 - my
    v_x = -(e.a * du + e.b * dv)
    v_y = -(e.b * du + e.c * dv)
    v_a = -0.5 * (e.u * (du - mx) + mxx)
    v_b = -(e.u * dv - e.v * mx + mxy)
    v_c = -0.5 * (e.v * (dv - my) + myy)
    return v_x, v_y, v_a, v_b, v_c, m0 / e.opacity
