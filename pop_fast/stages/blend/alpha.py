"""The exponent of alpha as a matrix product over a tile's pixels. Meaning: `pop_ref.alpha`.

alpha = o exp(-sigma) = 2^(f . p) with p = (1, x, y, x^2, xy, y^2) in pixels from the tile's centre and six
coefficients f per (splat, tile). The constant and linear coefficients cancel for needles whose centre lies far from
the tile, so they are computed in float64 and rounded once; what is left within a tile is of the order of the exponent
itself.

The transpose needs the same six moments of G = alpha dL/dalpha, M = sum_p G p. Moved from the tile's centre to the
splat's they can be added up over tiles, and every geometric gradient of the splat is linear in the sums.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pop_fast.stages.blend.tile_groups import BLOCK, PackedLists
from pop_fast.stages.layout import columns

_LOG2_E = math.log2(math.e)
NULL_EXPONENT = -1e4  # 2 to this power is 0 in float32 and float64: entries that pad a list blend nothing


@dataclass(frozen=True)
class Entries:
    """What the pairs of one tile-list entry share, in float64, in the order of packed lists; padding has splat N.

    Attributes:
        lists: the packed lists.
        u: splat's centre from the tile's centre, px. [8 B]
        v: px. [8 B]
    """

    lists: PackedLists
    u: Tensor
    v: Tensor

    @classmethod
    def of(cls, means2d: Tensor, lists: PackedLists) -> Entries:
        """Gather where each entry's splat lies, seen from its tile."""
        x, y = (_with_padding(t, 0.0).index_select(0, lists.ids) for t in columns(means2d))
        size, tile = lists.tile_size, lists.block_tiles
        row = torch.div(tile, lists.tiles_x, rounding_mode="floor")
        x.view(-1, BLOCK).sub_((((tile - row * lists.tiles_x) * size).to(x.dtype) + 0.5 * size)[:, None])
        y.view(-1, BLOCK).sub_(((row * size).to(x.dtype) + 0.5 * size)[:, None])
        return cls(lists, x, y)


def exponent_coefficients(entries: Entries, conics: Tensor, opacities: Tensor) -> Tensor:
    """Return the six coefficients of log2(alpha) of every entry, such that padding blends nothing. [6, 8 B] float64

    Args:
        entries: of the tile lists.
        conics: inverse screen covariances, px^-2. [N, 3]
        opacities: [N]
    """
    u, v, ids = entries.u, entries.v, entries.lists.ids
    scaled = (_with_padding(t, 0.0).mul_(_LOG2_E) for t in columns(conics))
    a, b, c = (t.index_select(0, ids) for t in scaled)
    rows = torch.empty((6, len(ids)), dtype=torch.float64)
    constant, gx, gy = rows[0], rows[1], rows[2]
    torch.mul(a, u, out=gx).addcmul_(b, v)
    torch.mul(b, u, out=gy).addcmul_(c, v)
    torch.index_select(_with_padding(torch.log2(opacities.double()), NULL_EXPONENT), 0, ids, out=constant)
    constant.addcmul_(gx, u, value=-0.5).addcmul_(gy, v, value=-0.5)
    torch.mul(a, -0.5, out=rows[3])
    torch.neg(b, out=rows[4])
    torch.mul(c, -0.5, out=rows[5])
    return rows


def _with_padding(values: Tensor, padding: float) -> Tensor:
    """Return values as float64, with one more that padding takes. [N + 1]"""
    longer = torch.empty(len(values) + 1, dtype=torch.float64)
    longer[:-1], longer[-1] = values, padding
    return longer


def pixel_basis(tile_size: int, dtype: torch.dtype) -> Tensor:
    """Return (1, x, y, x^2, xy, y^2) at a tile's pixel centres, from its centre. [6, tile_size^2]"""
    at = torch.arange(tile_size, dtype=dtype) + (0.5 - 0.5 * tile_size)
    y, x = torch.meshgrid(at, at, indexing="ij")
    x, y = x.reshape(-1), y.reshape(-1)
    return torch.stack((torch.ones_like(x), x, y, x * x, x * y, y * y))


def centred_moments(entries: Entries, moments: Tensor) -> Tensor:
    """Turn the six moments of G about the tiles' centres ([6, 8 B]) into those about the splats' centres. float64"""
    u, v = entries.u, entries.v
    m0, mx, my, mxx, mxy, myy = found = moments.double()
    # about the splat's centre, with the signs of (splat - pixel); in place, so what is read last comes last
    du, dv = torch.mul(u, m0).sub_(mx), torch.mul(v, m0).sub_(my)
    mxx.addcmul_(u, du).addcmul_(u, mx, value=-1.0)
    mxy.addcmul_(u, dv).addcmul_(v, mx, value=-1.0)
    myy.addcmul_(v, dv).addcmul_(v, my, value=-1.0)
    mx.copy_(du)
    my.copy_(dv)
    return found


def splat_gradients(moments: Tensor, conics: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Turn each splat's centred moments ([6, N]) into gradients to screen centre, conic and opacity, component rows.

    Returns:
        [2, N], [3, N] and [N], float64.
    """
    a, b, c = (t.double() for t in columns(conics))
    m0, du, dv, duu, duv, dvv = moments
    centre = torch.stack((-(a * du + b * dv), -(b * du + c * dv)))
    # a splat without opacity blends nothing: its moment is 0
    return (
        centre,
        torch.stack((-0.5 * duu, -duv, -0.5 * dvv)),
        m0 / opacities.double().masked_fill(opacities == 0.0, 1.0),
    )
