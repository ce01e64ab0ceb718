"""Dominant ids and counts (D8). Meaning: `pop_ref.dominance`."""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

EIGHT: Final = 8  # entries whose comparisons make one number


def dominant_counts(dominant_ids: Tensor, n: int) -> Tensor:
    """See `pop_ref.dominance.dominant_counts`. Optimizations: one bincount."""
    return torch.bincount(dominant_ids.reshape(-1) + 1, minlength=n + 1)[1:]


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
