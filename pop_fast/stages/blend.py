"""Front-to-back blending of a group of tiles with early ray termination, and its transpose.

Meaning: `pop_ref.compositing`.

One step of the blend takes a group of tiles, K list entries and all pixels of a tile, in this order:

    alpha = 2^(coefficients @ basis), 0 under the floor (D5), the ceiling at most (D6)
    T[k + 1] = T[k] - T[k] alpha[k];  where T[k + 1] passes the stop (D7): alpha[k] = 0
    weight[k] = T[k] alpha[k];  image += colours @ weight

T is the light that is still worth blending into. It never grows, so that the alphas of the terminating splat and of
all behind it become 0 at once; at the end of the step a T that passed the stop becomes 0, too.

Nothing of a step is kept but the light before it, 4 bytes for K pairs: the transpose makes alphas and weights anew
in buffers that stay in the cache, which is cheaper than a way through memory and back. It goes back to front with one
number per pixel, B, the light from behind dotted with the pixel's gradient:

    q[k] = colour[k] . v_image - B;  B += alpha[k] q[k];  G[k] = weight[k] q[k]

G = alpha dL/dalpha; its six moments over a tile's pixels give every geometric gradient (`splat_gradients`).
There is no division by 1 - alpha. Buffers are used again: fresh pages cost more than the arithmetic that fills them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import torch
from torch import Tensor

from pop_fast.stages.tile_groups import BLOCK, Entries, TileGroup, exponent_coefficients, pixel_basis
from pop_ref.constants import Profile

EIGHT: Final = 8  # entries whose comparisons of weights make one number


class ActiveTiles:
    """States with a row per tile of a group, of which a shrinking choice, `rows`, is held together; None is all."""

    def __init__(self, states: dict[str, Tensor]) -> None:
        self.rows: Tensor | None = None
        self._whole = states
        self._held = states

    def __getitem__(self, name: str) -> Tensor:
        return self._held[name]

    def count_below(self, reached: int) -> int:
        """Return how many of the held tiles are among the group's first `reached`."""
        return reached if self.rows is None else int((self.rows < reached).sum())

    def select(self, rows: Tensor | None) -> None:
        """Hold these tiles; what was held before is written back first."""
        if rows is self.rows:
            return
        whole = self.whole()
        self.rows = rows
        self._held = whole if rows is None else {name: state[rows] for name, state in whole.items()}

    def drop(self, n: int, transmittance: Tensor, below: float) -> None:
        """Hold only the tiles with light left, out of the first `n`, when these are less than a share of them."""
        bright = transmittance.amax(1) > 0.0
        if int(bright.sum()) < below * n:
            keep = bright.nonzero().squeeze(1)
            self.select(keep if self.rows is None else self.rows[keep])

    def whole(self) -> dict[str, Tensor]:
        """Return the states of all tiles."""
        if self.rows is not None:
            for name, state in self._held.items():
                self._whole[name].index_copy_(0, self.rows, state)
        return self._whole


class Dominance:
    """The running maximum of weights over a group's pixels, fed step by step, front to back (D8).

    Optimizations: the comparisons of eight weights with their maximum become one number by a matrix product with
    (128, …, 2, 1), whose highest set bit is the foremost entry that equals the maximum; no index ever moves through
    the slab, and the bit is looked up once, at the end.
    """

    def __init__(self, dtype: torch.dtype) -> None:
        self._powers = 2.0 ** torch.arange(EIGHT - 1, -1, -1, dtype=dtype)

    def see(self, weight: Tensor, first: int, best: Tensor, codes: Tensor, scratch: Tensor) -> None:
        """Take a step's weights into account.

        Args:
            weight: of the step, K a multiple of 8. [n, K, P]
            first: place of the step's first entry, a multiple of 8.
            best: the largest weight of each pixel so far, in and out. [n, P]
            codes: which entry that is, -1 for none, in and out. [n, P]
            scratch: overwritten. [n, K, P]
        """
        n, K, n_pixels = weight.shape
        for start in range(0, K, EIGHT):
            part, equal = weight[:, start : start + EIGHT], scratch[:, start : start + EIGHT]
            largest = part.amax(1)
            torch.ge(part, largest[:, None], out=equal)
            code = torch.bmm(self._powers.expand(n, 1, EIGHT), equal).view(n, n_pixels)
            code.add_(float((first + start) // EIGHT * 2**EIGHT))
            # strictly larger: on equal weights the entry in front keeps the pixel
            improved = torch.gt(largest, best, out=torch.empty_like(best))
            codes.lerp_(code, improved)
            torch.maximum(best, largest, out=best)

    @staticmethod
    def places(codes: Tensor) -> Tensor:
        """Return the place in its tile's list of each pixel's dominant entry, -1 where nothing was blended. [G, P]"""
        whole = codes.to(torch.int64)
        eight, bits = whole >> EIGHT, whole & (2**EIGHT - 1)
        highest = torch.frexp(bits.to(torch.float32)).exponent - 1
        return torch.where(whole < 0, -1, eight * EIGHT + (EIGHT - 1 - highest))


@dataclass(frozen=True)
class Stop:
    """The transmittance that a pixel must stay above."""

    at: float  # a pixel stops where T <= at

    @classmethod
    def of(cls, profile: Profile, dtype: torch.dtype) -> Stop:
        """Return the profile's stop, its strictness folded into the number."""
        stop = profile.transmittance_stop
        return cls(stop if profile.stop_inclusive else below(stop, dtype))


def weights_of_alphas(alpha: Tensor, transmittances: Tensor, stop: Stop) -> Tensor:
    """Take a step's alphas off the light and return the weights; both are 0 from where a pixel stops.

    T never grows, so that one comparison of all T with the stop finds what is behind it, with no flag carried along.

    Args:
        alpha: in and, where a pixel stops, out. [n, K, P]
        transmittances: T before the step in the first of K + 1 rows; out: T after it in the last, still to be
            compared with the stop, and in the others the weights. [n, K + 1, P]

    Returns:
        The weights, a view of `transmittances`. [n, K, P]
    """
    rows = transmittances.unbind(1)
    for before, after, a in zip(rows, rows[1:], alpha.unbind(1), strict=False):
        torch.addcmul(before, before, a, value=-1.0, out=after)
    torch.ops.aten.threshold_backward.grad_input(alpha, transmittances[:, 1:], stop.at, grad_input=alpha)
    return transmittances[:, :-1].mul_(alpha)


def count_passed(alpha: Tensor, transmittance: Tensor, stop: Stop) -> Tensor:
    """Count the entries of a step that each pixel goes past without stopping. [n, P] int64"""
    transmittance = transmittance.clone()
    passed = torch.zeros(transmittance.shape, dtype=torch.int64)
    for a in alpha.unbind(1):
        torch.threshold_(transmittance.addcmul_(transmittance, a, value=-1.0), stop.at, 0.0)
        passed += transmittance > 0.0
    return passed


@lru_cache
def below(value: float, dtype: torch.dtype) -> float:
    """Return the number just under `value` in a type, so that `>` of it means `>= value`."""
    at = torch.tensor(value, dtype=dtype)
    return float(torch.nextafter(at, torch.zeros_like(at)))


COMPACT_BELOW = 0.8  # share of live tiles under which the group is compacted


@dataclass(frozen=True)
class Step:
    """One blended step, as the transpose needs it."""

    blocks: Tensor  # of eight entries each, the null block where a list has ended. [n, K / 8]
    rows: Tensor | None  # which of the group's tiles took part: the first `n` of these, or of all when None
    transmittance: Tensor  # T before the step; belongs to the buffers. [n, P]


@dataclass
class GroupBlend:
    """What blending a group gives."""

    image: Tensor  # weighted colours and, last, the sum of weights. [G, D + 1, P]
    steps: list[Step] = field(default_factory=list)  # front to back
    n_blended: Tensor | None = None  # [G, P], when counted
    n_passed: Tensor | None = None  # list entries that the pixel went past without stopping. [G, P], when counted.
    dominant_weights: Tensor | None = None  # the largest weights, when asked for. [G, P]
    # and their places in the tile's list, -1 where nothing was blended. [G, P]
    dominant_places: Tensor | None = None
    n_pairs: int = 0  # (entry, pixel) pairs evaluated


@dataclass(frozen=True)
class Blender:
    """The fixed numbers of a blend."""

    # per entry, the exponent's coefficients, the colours and a 1, in blocks of eight. [B, 8, 6 + D + 1]
    table: Tensor
    basis: Tensor  # pixel basis. [6, P]
    profile: Profile  # constants and strictness
    clamps: bool  # whether any alpha can pass the ceiling

    @classmethod
    def of(cls, entries: Entries, conics: Tensor, opacities: Tensor, colors: Tensor, profile: Profile) -> Blender:
        """Make what blends entries of splats in the precision of their colours; padding has any colour."""
        ids, n_colors = entries.lists.ids, colors.shape[1]
        table = colors.new_empty((len(ids), 6 + n_colors + 1))
        table[:, :6] = exponent_coefficients(entries, conics, opacities).T
        table[:, 6:-1] = torch.cat((colors, colors.new_zeros((1, n_colors)))).index_select(0, ids)
        table[:, -1] = 1.0
        basis = pixel_basis(entries.lists.tile_size, colors.dtype)
        clamps = bool((opacities > profile.alpha_ceiling).any())
        return cls(table.view(-1, BLOCK, table.shape[1]), basis, profile, clamps)

    @property
    def stop(self) -> Stop:
        """Return the transmittance that a pixel must stay above."""
        return Stop.of(self.profile, self.table.dtype)

    def blend(self, group: TileGroup, counted: bool = False, dominance: bool = False, keep: bool = True) -> GroupBlend:
        """Blend a group front to back; `keep` what the transpose needs."""
        active = self._active(group, counted, dominance)
        dominant = Dominance(self.table.dtype)
        steps: list[Step] = []
        start, n_pairs = 0, 0
        with acquired_buffers(2, group.slab, self.table.dtype) as scratch:
            while start < len(group.reached) and (n := active.count_below(group.reached[start])) > 0:
                blocks = group.blocks(active.rows, n, start, group.step_blocks(start, n))
                entries, transmittance = self._entries(blocks), active["transmittance"][:n]
                alpha, transmittances = _shaped(scratch, entries, group.n_pixels)
                self._alphas(entries, alpha)
                if counted:
                    active["n_passed"][:n].add_(count_passed(alpha, transmittance, self.stop))
                before = copy_to_buffer(transmittance)
                weight = self._weights(alpha, transmittances, before)
                torch.ops.aten.threshold.out(transmittances[:, -1], self.stop.at, 0.0, out=transmittance)
                active["image"][:n].baddbmm_(entries[:, :, 6:].transpose(1, 2), weight)
                if counted:
                    active["n_blended"][:n].add_((weight > 0.0).sum(1))
                if dominance:
                    dominant.see(weight, start * BLOCK, active["best"][:n], active["codes"][:n], alpha)
                start += blocks.shape[1]
                n_pairs += weight.numel()
                if keep:
                    steps.append(Step(blocks, active.rows, before))
                else:
                    release_buffer(before)
                active.drop(n, transmittance, COMPACT_BELOW)
        return self._result(active.whole(), steps, n_pairs)

    def _active(self, group: TileGroup, counted: bool, dominance: bool) -> ActiveTiles:
        size = (len(group.tiles), self.basis.shape[1])
        states = {
            "transmittance": self.basis.new_ones(size),
            "image": self.basis.new_zeros((size[0], self.table.shape[2] - 6, size[1])),
        }
        if counted:
            states |= {name: torch.zeros(size, dtype=torch.int64) for name in ("n_blended", "n_passed")}
        if dominance:
            states |= {"best": self.basis.new_zeros(size), "codes": self.basis.new_full(size, -1.0)}
        return ActiveTiles(states)

    @staticmethod
    def _result(states: dict[str, Tensor], steps: list[Step], n_pairs: int) -> GroupBlend:
        n_blended, n_passed, best, codes = (states.get(name) for name in ("n_blended", "n_passed", "best", "codes"))
        places = None if codes is None else Dominance.places(codes)
        return GroupBlend(states["image"], steps, n_blended, n_passed, best, places, n_pairs)

    def _entries(self, blocks: Tensor) -> Tensor:
        """Gather a step's rows of the table. [n, K, 6 + D + 1]"""
        return self.table.index_select(0, blocks.view(-1)).view(len(blocks), -1, self.table.shape[2])

    def _alphas(self, entries: Tensor, alpha: Tensor) -> None:
        flat = alpha.view(-1, alpha.shape[2])
        torch.mm(entries.view(len(flat), entries.shape[2])[:, :6], self.basis, out=flat)
        flat.exp2_()
        torch.threshold_(flat, below(self.profile.alpha_floor, flat.dtype), 0.0)
        if self.clamps:
            flat.clamp_max_(self.profile.alpha_ceiling)

    def _weights(self, alpha: Tensor, transmittances: Tensor, before: Tensor) -> Tensor:
        transmittances[:, 0] = before
        return weights_of_alphas(alpha, transmittances, self.stop)

    def transpose(
        self, group: TileGroup, blend: GroupBlend, v_image: Tensor, absolute: bool
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Pull the cotangent of a group's image ([G, D + 1, P]) back to its entries, step by step, back to front.

        Yields:
            Blocks [n K / 8] and their rows [n K / 8, 6 + D (+ 2), 8]: six moments of G, the gradient to the
            colours and, when asked for, the sums of absolute gradients along x and y.
        """
        active = ActiveTiles({"behind": v_image.new_zeros((v_image.shape[0], v_image.shape[2])), "v": v_image})
        with acquired_buffers(3, group.slab, self.table.dtype) as scratch:
            for step in reversed(blend.steps):
                active.select(step.rows)
                n = len(step.blocks)
                v, behind = active["v"][:n], active["behind"][:n]
                entries, alpha, weight, q = self.again(group, step, scratch)
                torch.bmm(entries[:, :, 6:], v, out=q)
                for a, q_k in zip(reversed(alpha.unbind(1)), reversed(q.unbind(1)), strict=True):
                    q_k.sub_(behind)
                    behind.addcmul_(a, q_k)
                # nothing is behind a pixel that had stopped before this step
                torch.ops.aten.threshold_backward.grad_input(behind, step.transmittance, 0.0, grad_input=behind)
                release_buffer(step.transmittance)
                yield step.blocks.view(-1), self._rows(entries, alpha, weight, q, v, absolute)

    def again(self, group: TileGroup, step: Step, scratch: list[Tensor]) -> list[Tensor]:
        """Blend a step that was kept once more.

        Args:
            step: of a `blend` that kept what the transpose needs; its light stays.
            scratch: two of `group.slab` numbers, or three.

        Returns:
            The entries' rows of the table [n, K, 6 + D + 1], and in the scratch their alphas and weights, both 0 from
            where a pixel stops [n, K, P], and of a third slab as much.
        """
        entries = self._entries(step.blocks)
        alpha, transmittances, *rest = _shaped(scratch, entries, group.n_pixels)
        self._alphas(entries, alpha)
        return [entries, alpha, self._weights(alpha, transmittances, step.transmittance), *rest]

    def _rows(self, entries: Tensor, alpha: Tensor, weight: Tensor, q: Tensor, v: Tensor, absolute: bool) -> Tensor:
        n_colors, n_rows = v.shape[1] - 1, q.shape[0] * q.shape[1]
        rows = q.new_empty((len(q), q.shape[1] // BLOCK, 6 + n_colors + 2 * absolute, BLOCK))
        # [n, D, K] and, below, [6, n K], each cut into blocks
        by_color = torch.bmm(v[:, :-1], weight.transpose(1, 2)).view(len(q), n_colors, rows.shape[1], BLOCK)
        rows[:, :, 6 : 6 + n_colors] = by_color.transpose(1, 2)
        rows = rows.view(-1, rows.shape[2], BLOCK)
        g = q.mul_(weight)
        flat = entries.view(n_rows, entries.shape[2])[:, :6]
        self.pass_ceiling(flat, alpha, g)
        pairs = g.view(n_rows, g.shape[2])
        rows[:, :6] = torch.mm(self.basis, pairs.T).view(6, -1, BLOCK).transpose(0, 1)
        if absolute:
            rows[:, 6 + n_colors :] = self._absolute(flat, pairs).view(2, -1, BLOCK).transpose(0, 1)
        return rows

    def pass_ceiling(self, coefficients: Tensor, alpha: Tensor, g: Tensor) -> None:
        """Apply the profile's gradient rule to clamped alphas (B3), in place.

        Args:
            coefficients: of the exponents. [n K, 6]
            alpha: clamped. [n, K, P]
            g: alpha dL/dalpha, in and out. [n, K, P]
        """
        if not self.clamps:
            return
        ceiling = self.profile.alpha_ceiling
        if self.profile.ceiling_gradient == "zero":
            torch.ops.aten.hardtanh_backward.grad_input(g, alpha, -1.0, ceiling, grad_input=g)
        else:
            # passed through as if unclamped: G carries the clamped alpha, the chain rule wants the raw one
            raw = torch.exp2(coefficients @ self.basis)
            g.mul_((raw / ceiling).clamp_min_(1.0).view_as(g))

    def _absolute(self, coefficients: Tensor, g: Tensor) -> Tensor:
        """Sum |dL/du| and |dL/dv| over the pixels of each entry. [2, n K]"""
        rows = coefficients / math.log2(math.e)
        zero = torch.zeros_like(rows[:, 0])
        # the derivative of sigma along x and y, again as coefficients of (1, x, y)
        along = (
            torch.stack((rows[:, 1], 2.0 * rows[:, 3], rows[:, 4], zero, zero, zero), 1),
            torch.stack((rows[:, 2], rows[:, 4], 2.0 * rows[:, 5], zero, zero, zero), 1),
        )
        return torch.stack([(g * (c @ self.basis)).abs_().sum(1) for c in along])


def _shaped(scratch: list[Tensor], entries: Tensor, n_pixels: int) -> list[Tensor]:
    """Shape scratch: alphas [n, K, P], lights [n, K + 1, P] and, if there is a third, another like the first."""
    n, length, _ = entries.shape
    lengths = (length, length + 1, length)
    return [slab[: n * k * n_pixels].view(n, k, n_pixels) for slab, k in zip(scratch, lengths, strict=False)]


RETAINED_BYTES = 1 << 30


class _Pool:
    def __init__(self) -> None:
        self.free: dict[tuple[torch.dtype, int], list[Tensor]] = {}
        self.retained = 0


_pool = _Pool()


def acquire_buffer(numel: int, dtype: torch.dtype) -> Tensor:
    """Return a flat buffer of at least `numel` uninitialised numbers, used before if one is free.

    Lengths are powers of two, so that scenes whose sizes change from step to step share a few kinds of buffers.
    """
    length = 1 << max(numel - 1, 0).bit_length()
    free = _pool.free.get((dtype, length))
    if not free:
        # of no mode: what `torch.inference_mode` makes may not be written to after it
        with torch.inference_mode(False):
            return torch.empty(length, dtype=dtype)
    _pool.retained -= length * dtype.itemsize
    return free.pop()


def release_buffer(slab: Tensor) -> None:
    """Return a buffer from `acquire_buffer`, or a view of one's beginning; nobody may use it afterwards."""
    size = slab.untyped_storage().nbytes()
    slab = slab.as_strided((size // slab.itemsize,), (1,), 0)
    if _pool.retained + size <= RETAINED_BYTES:
        _pool.retained += size
        _pool.free.setdefault((slab.dtype, slab.numel()), []).append(slab)


def copy_to_buffer(tensor: Tensor) -> Tensor:
    """Return a copy in a buffer from `acquire_buffer`, which `release_buffer` takes back."""
    return acquire_buffer(tensor.numel(), tensor.dtype)[: tensor.numel()].view(tensor.shape).copy_(tensor)


@contextmanager
def acquired_buffers(n: int, numel: int, dtype: torch.dtype) -> Iterator[list[Tensor]]:
    """Lend `n` buffers of at least `numel` numbers for a block of code."""
    taken = [acquire_buffer(numel, dtype) for _ in range(n)]
    try:
        yield taken
    finally:
        for slab in taken:
            release_buffer(slab)


def clear_buffers() -> None:
    """Free every retained buffer."""
    _pool.free.clear()
    _pool.retained = 0
