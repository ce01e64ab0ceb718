"""Front-to-back blending of a group of tiles with early ray termination, and its transpose.

Meaning: `pop_ref.compositing`.
One step of the blend takes a group of tiles, CHUNK list entries and all pixels of a tile, in this order:

    alpha = 2^(coefficients @ basis), 0 under the floor (D5), the ceiling at most (D6)
    S[0] = T;  S[k+1] = S[k] - S[k] alpha[k], set to 0 where that passes the stop (D7)
    alpha = 0 where S[k+1] = 0;  weight[k] = S[k] alpha[k];  image += colours @ weight

S is the transmittance that is still worth blending into: it falls to 0 at the terminating splat, whose weight and
those of all behind it are then 0 without a branch.

The transpose goes back to front with one number per pixel, B, the light from behind dotted with the pixel's gradient:

    q[k] = colour[k] . v_image;  G[k] = weight[k] (q[k] - B);  B += alpha[k] (q[k] - B)

G = alpha dL/dalpha; its six moments over a tile's pixels give every geometric gradient (`alpha.entry_gradients`).
There is no division by 1 - alpha.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache

import torch
from torch import Tensor

from pop_fast import workspace
from pop_fast.dominance import Dominance
from pop_fast.tile_groups import CHUNK, TileGroup
from pop_ref.constants import Profile

COMPACT_BELOW = 0.8  # share of live tiles under which the group is compacted


@dataclass
class Chunk:
    """One blended step, as the transpose needs it.

    Attributes:
        index: number of the chunk along the lists.
        rows: which of the group's tiles took part: the first `n` of these, or of all when None.
        n: how many took part.
        slots: entry numbers, the null entry where a list is padded. [n * CHUNK]
        entries: their rows of the blender's table. [n, CHUNK, 6 + D + 1]
        slabs: the buffers behind `alpha` and `weight`.
        alpha: 0 for skipped and terminated pairs. [n, CHUNK, P]
        weight: [n, CHUNK, P]
    """

    index: int
    rows: Tensor | None
    n: int
    slots: Tensor
    entries: Tensor
    slabs: tuple[Tensor, Tensor]
    alpha: Tensor
    weight: Tensor

    @classmethod
    def of(cls, group: TileGroup, index: int, rows: Tensor | None, n: int, table: Tensor, n_pixels: int) -> Chunk:
        """Gather a chunk's entries and take buffers for it."""
        slots = group.slots[:, index * CHUNK : (index + 1) * CHUNK]
        slots = (slots[:n] if rows is None else slots[rows[:n]]).reshape(n * CHUNK)
        entries = table.index_select(0, slots).view(n, CHUNK, table.shape[1])
        numel = n * CHUNK * n_pixels
        slabs = (workspace.take(numel, table.dtype), workspace.take(numel, table.dtype))
        alpha, weight = (slab[:numel].view(n, CHUNK, n_pixels) for slab in slabs)
        return cls(index, rows, n, slots, entries, slabs, alpha, weight)

    @property
    def where(self) -> slice | Tensor:
        """Return what selects the chunk's tiles out of the group's."""
        return slice(self.n) if self.rows is None else self.rows[: self.n]

    @property
    def coefficients(self) -> Tensor:
        """Return the exponent's coefficients of every entry. [n * CHUNK, 6]"""
        return self.entries.view(self.n * CHUNK, self.entries.shape[2])[:, :6]

    @property
    def colors(self) -> Tensor:
        """Return the colours of every entry and a 1. [n, CHUNK, D + 1]"""
        return self.entries[:, :, 6:]

    def release(self) -> None:
        """Give the buffers back to the workspace."""
        for slab in self.slabs:
            workspace.give(slab)


@dataclass
class GroupBlend:
    """What blending a group gives.

    Attributes:
        image: weighted colours and, last, the sum of weights. [G, D + 1, P]
        chunks: the steps, front to back.
        n_blended: [G, P] int32, when counted.
        n_passed: list entries that the pixel went past without stopping. [G, P] int32, when counted.
        n_pairs: (entry, pixel) pairs evaluated.
        dominance: the largest weights, when asked for.
    """

    image: Tensor
    chunks: list[Chunk] = field(default_factory=list)
    n_blended: Tensor | None = None
    n_passed: Tensor | None = None
    n_pairs: int = 0
    dominance: Dominance | None = None

    def release(self) -> None:
        """Give the chunks' buffers back to the workspace."""
        for chunk in self.chunks:
            chunk.release()
        self.chunks.clear()


@dataclass(frozen=True)
class Blender:
    """The fixed numbers of a blend.

    Attributes:
        table: per entry, the exponent's coefficients, the colours and a 1; the null entry last. [I + 1, 6 + D + 1]
        basis: pixel basis. [6, P]
        profile: constants and strictness.
        clamps: whether any alpha can pass the ceiling.
    """

    table: Tensor
    basis: Tensor
    profile: Profile
    clamps: bool

    def blend(self, group: TileGroup, counted: bool = False, dominance: bool = False, keep: bool = True) -> GroupBlend:
        """Blend a group front to back."""
        n_pixels = self.basis.shape[1]
        n_tiles = len(group.tiles)
        result = GroupBlend(self.basis.new_zeros((n_tiles, self.table.shape[1] - 6, n_pixels)))
        if counted:
            result.n_blended = torch.zeros((n_tiles, n_pixels), dtype=torch.int32)
            result.n_passed = torch.zeros((n_tiles, n_pixels), dtype=torch.int32)
        if dominance:
            result.dominance = Dominance(result.image[:, 0])
        rows: Tensor | None = None
        image = result.image
        light = self.basis.new_ones((n_tiles, n_pixels))
        for index, reached in enumerate(group.reached):
            n = reached if rows is None else int((rows < reached).sum())
            if n == 0:
                break
            chunk, passing = self._step(group, index, rows, n, light[:n])
            image[:n].baddbmm_(chunk.colors.transpose(1, 2), chunk.weight)
            if counted:
                self._count(result, chunk, passing)
            if result.dominance is not None:
                result.dominance.see(chunk)
            light = passing[:, CHUNK].clone()
            result.n_pairs += chunk.weight.numel()
            if keep:
                result.chunks.append(chunk)
            else:
                chunk.release()
            rows, light, image = self._drop_dark_tiles(result, rows, n, light, image)
        if rows is not None:
            result.image.index_copy_(0, rows, image)
        return result

    def _step(self, group: TileGroup, index: int, rows: Tensor | None, n: int, light: Tensor) -> tuple[Chunk, Tensor]:
        n_pixels = self.basis.shape[1]
        chunk = Chunk.of(group, index, rows, n, self.table, n_pixels)
        alpha = chunk.alpha
        torch.mm(chunk.coefficients, self.basis, out=alpha.view(n * CHUNK, n_pixels))
        alpha.exp2_()
        torch.threshold_(alpha, _below(self.profile.alpha_floor, alpha.dtype), 0.0)
        if self.clamps:
            alpha.clamp_max_(self.profile.alpha_ceiling)
        passing = alpha.new_empty((n, CHUNK + 1, n_pixels))
        passing[:, 0] = light
        stop = self.profile.transmittance_stop
        stop = stop if self.profile.stop_inclusive else _below(stop, alpha.dtype)
        for k in range(CHUNK):
            after = passing[:, k + 1]
            torch.addcmul(passing[:, k], passing[:, k], alpha[:, k], value=-1.0, out=after)
            torch.threshold_(after, stop, 0.0)
        if passing[:, CHUNK].amin() <= 0.0:
            torch.ops.aten.threshold_backward.grad_input(alpha, passing[:, 1:], 0.0, grad_input=alpha)
        torch.mul(passing[:, :-1], alpha, out=chunk.weight)
        return chunk, passing

    @staticmethod
    def _count(result: GroupBlend, chunk: Chunk, passing: Tensor) -> None:
        assert result.n_blended is not None
        assert result.n_passed is not None
        where = chunk.where
        result.n_blended[where] += (chunk.weight > 0.0).sum(1, dtype=torch.int32)
        result.n_passed[where] += (passing[:, 1:] > 0.0).sum(1, dtype=torch.int32)

    @staticmethod
    def _drop_dark_tiles(
        result: GroupBlend, rows: Tensor | None, n: int, light: Tensor, image: Tensor
    ) -> tuple[Tensor | None, Tensor, Tensor]:
        lit = light.amax(1) > 0.0
        n_lit = int(lit.sum())
        if n_lit >= COMPACT_BELOW * n:
            return rows, light, image
        if rows is not None:
            result.image.index_copy_(0, rows, image)
        keep = lit.nonzero().squeeze(1)
        rows = keep if rows is None else rows[keep]
        return rows, light[keep], result.image[rows]

    def transpose(self, blend: GroupBlend, v_image: Tensor, absolute: bool) -> Iterator[tuple[Tensor, Tensor]]:
        """Pull the cotangent of a group's image ([G, D + 1, P]) back to its entries, chunk by chunk, back to front.

        Yields:
            Entry numbers [n * CHUNK] and their rows [n * CHUNK, 6 + D (+ 2)]: six moments of G, the gradient to the
            colours and, when asked for, the sums of absolute gradients along x and y.
        """
        behind = v_image.new_zeros((v_image.shape[0], v_image.shape[2]))
        for chunk in reversed(blend.chunks):
            where = chunk.where
            v = v_image[where]
            light, n_pixels = v.new_empty((chunk.n, CHUNK + 1, v.shape[2])), v.shape[2]
            q = torch.bmm(chunk.colors, v)
            light[:, CHUNK] = behind[where]
            for k in reversed(range(CHUNK)):
                torch.lerp(light[:, k + 1], q[:, k], chunk.alpha[:, k], out=light[:, k])
            behind[where] = light[:, 0]
            g = q.sub_(light[:, 1:]).mul_(chunk.weight)
            n_colors = v.shape[1] - 1
            rows = g.new_empty((chunk.n, CHUNK, 6 + n_colors + 2 * absolute))
            rows[:, :, 6 : 6 + n_colors] = torch.bmm(v[:, :-1], chunk.weight.transpose(1, 2)).transpose(1, 2)
            if self.clamps:
                self._pass_ceiling(chunk, g)
            flat = rows.view(chunk.n * CHUNK, rows.shape[2])
            flat[:, :6] = torch.mm(self.basis, g.view(chunk.n * CHUNK, n_pixels).T).T
            if absolute:
                flat[:, 6 + n_colors :] = self._absolute(chunk, g).T
            chunk.release()
            yield chunk.slots, flat

    def _pass_ceiling(self, chunk: Chunk, g: Tensor) -> None:
        """Apply the profile's gradient rule to clamped alphas (B3), in place."""
        ceiling = self.profile.alpha_ceiling
        if self.profile.ceiling_gradient == "zero":
            torch.ops.aten.hardtanh_backward.grad_input(g, chunk.alpha, -1.0, ceiling, grad_input=g)
        else:
            # passed through as if unclamped: G carries the clamped alpha, the chain rule wants the raw one
            raw = torch.exp2(chunk.coefficients @ self.basis)
            g.mul_((raw / ceiling).clamp_min_(1.0).view_as(g))

    def _absolute(self, chunk: Chunk, g: Tensor) -> Tensor:
        """Sum |dL/du| and |dL/dv| over the pixels of each entry. [2, n * CHUNK]"""
        rows = chunk.coefficients / math.log2(math.e)
        zero = torch.zeros_like(rows[:, 0])
        # the derivative of sigma along x and y, again as coefficients of (1, x, y)
        along = (
            torch.stack((rows[:, 1], 2.0 * rows[:, 3], rows[:, 4], zero, zero, zero), 1),
            torch.stack((rows[:, 2], rows[:, 4], 2.0 * rows[:, 5], zero, zero, zero), 1),
        )
        flat = g.reshape(len(rows), g.shape[2])
        return torch.stack([(flat * (c @ self.basis)).abs_().sum(1) for c in along])


@lru_cache
def _below(value: float, dtype: torch.dtype) -> float:
    """Return the number just under `value` in a type, so that `>` of it means `>= value`."""
    at = torch.tensor(value, dtype=dtype)
    return float(torch.nextafter(at, torch.zeros_like(at)))
