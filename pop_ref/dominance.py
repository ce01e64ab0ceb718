"""Dominance: which Gaussian a pixel belongs to, and how many pixels each Gaussian wins.

POP calls a Gaussian important in a view if it wins at least one pixel, and densifies those that win many.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pop_ref._shapes import Int64


def dominant_id(ids: Sequence[int], weights: Sequence[float]) -> int:
    """Find the splat with the largest weight at a pixel: `argmax_i T_i alpha_i`, ties to the front (D8).

    Source: POP paper, eq. 5.
    Departs: the paper leaves ties and empty pixels open; as in Mini-Splatting's kernel a later splat must be strictly
        larger, only blended splats compete, and a pixel without any belongs to none (D8).

    Args:
        ids: the blended splats of the pixel, front to back.
        weights: their weights T alpha.

    Returns:
        The winner's id, -1 where there is none; a weight of 0 wins nothing.

    Example:
        >>> dominant_id([4, 2, 7], [0.25, 0.5, 0.5]), dominant_id([], [])
        (2, -1)
    """
    best_id, best_weight = -1, 0.0
    for i, weight in zip(ids, weights, strict=True):
        if weight > best_weight:
            best_id, best_weight = i, weight
    return best_id


def dominant_counts(dominant_ids: Int64[np.ndarray, "H W"], n: int) -> Int64[np.ndarray, " N"]:
    """Count the pixels that each Gaussian dominates: `D_i = #{p : i*(p) = i}`.

    Source: POP paper, section 3.2, below eq. 5.
    Departs: the paper's "cumulative" count is over views; this is one view's.

    Args:
        dominant_ids: the winner of each pixel, -1 for none.
        n: number of Gaussians.

    Returns:
        Pixels won.

    Example:
        >>> dominant_counts(np.array([[0, 2], [2, -1]]), 4).tolist()
        [1, 0, 2, 0]
    """
    counts = np.zeros(n, dtype=np.int64)
    for i in dominant_ids.ravel().tolist():
        if i >= 0:
            counts[i] += 1
    return counts
