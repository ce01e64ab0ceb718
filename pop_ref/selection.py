"""What is kept, by a score: a share of the rows, a share of the mass, or a draw without replacement."""

from __future__ import annotations

import math

import numpy as np

from pop_ref._shapes import Bool, Float64, Int64

_SMALLEST_MASS = 1e-6


def lowest_share(scores: Float64[np.ndarray, " N"], share: float) -> Bool[np.ndarray, " N"]:
    """Mark the lowest scores for removal: all up to the one at index `int(share (N - 1))` of the sorted scores.

    Of N distinct scores `int(share (N - 1)) + 1` are removed; scores equal to the threshold all are.

    Source: Hanson et al. 2025 (PUP 3D-GS) and Hanson et al. 2025 (Speedy-Splat), and their code.
    Departs: the papers name the share only; the index is the code's.

    Args:
        scores: any numbers, -inf first.
        share: of the rows, in [0, 1].

    Returns:
        True where a row is removed.

    Raises:
        ValueError: the share lies outside [0, 1], or a score is not a number.

    Example:
        >>> lowest_share(np.array([4.0, -np.inf, 2.0, 8.0, 1.0]), 0.5).tolist()
        [False, True, True, False, True]
    """
    _check_share(share)
    if np.any(np.isnan(scores)):
        raise ValueError(f"scores[{int(np.argmax(np.isnan(scores)))}] is nan; scores must be numbers")
    if len(scores) == 0:
        return np.zeros(0, dtype=bool)
    ascending = sorted(scores.tolist())
    return scores <= ascending[int(share * (len(ascending) - 1))]


def least_mass(importance: Float64[np.ndarray, " N"], share: float = 0.01) -> Bool[np.ndarray, " N"]:
    """Mark for removal the Gaussians that hold the least `share` of the importance, and the one that goes beyond it.

    With I + 1e-6 sorted ascending and m the first of these at which the cumulative share exceeds `share`, all with
    `I <= m` are removed.

    Source: Fang and Wang 2024 (Mini-Splatting), its code (keeps 99 %).
    Departs: the paper adds nothing to the importance; the code adds 1e-6 to what it sorts and not to what it compares,
        so that rows up to 1e-6 above the first one that is over the share go as well.

    Args:
        importance: >= 0.
        share: of the mass, in [0, 1].

    Returns:
        True where a row is removed.

    Raises:
        ValueError: the share lies outside [0, 1], or an importance is negative or not finite.

    Example:
        >>> least_mass(np.array([0.0, 64.0, 0.5, 32.0, 1.0]), share=0.01).tolist()
        [True, False, True, False, True]
    """
    _check_share(share)
    _check_weights("importance", importance)
    ascending = [mass + _SMALLEST_MASS for mass in sorted(importance.tolist())]
    total, held = math.fsum(ascending), 0.0
    for mass in ascending:
        held += mass
        if held / total > share:
            return importance <= mass
    return np.ones(len(importance), dtype=bool)


def sample_without_replacement(
    weights: Float64[np.ndarray, " N"], k: int, uniforms: Float64[np.ndarray, " N"]
) -> Int64[np.ndarray, " k"]:
    """Draw k different rows, each next one with a probability proportional to its weight among those left.

    An exponential race: row i arrives at `-log(1 - u_i) / w_i`, and the first k are drawn. Weight 0 never arrives.

    Source: Efraimidis and Spirakis 2006, in the form of exponential variates.
    Departs: nothing.

    Args:
        weights: >= 0, of any sum.
        k: how many rows.
        uniforms: one draw a row, uniform in [0, 1).

    Returns:
        The rows, ascending.

    Raises:
        ValueError: k is negative or more than the positive weights, a weight is negative or not finite, or a uniform
            lies outside [0, 1).

    Example:
        >>> sample_without_replacement(np.array([1.0, 0.0, 1.0, 4.0]), 2, np.array([0.5, 0.0, 0.25, 0.5])).tolist()
        [2, 3]
    """
    _check_weights("weights", weights)
    if uniforms.shape != weights.shape:
        raise ValueError(f"uniforms has shape {list(uniforms.shape)}; it must be {list(weights.shape)}, as the weights")
    if np.any(~((uniforms >= 0.0) & (uniforms < 1.0))):
        raise ValueError("uniforms must be in [0, 1)")
    racing = np.flatnonzero(weights > 0.0).tolist()
    if not 0 <= k <= len(racing):
        raise ValueError(f"k is {k}; of {len(weights)} weights {len(racing)} are positive, and so many can be drawn")
    arrivals = [(-math.log1p(-float(uniforms[i])) / float(weights[i]), i) for i in racing]
    return np.array(sorted(i for _, i in sorted(arrivals)[:k]), dtype=np.int64)


def _check_share(share: float) -> None:
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"share is {share}; it must be in [0, 1]")


def _check_weights(name: str, weights: Float64[np.ndarray, " N"]) -> None:
    bad = np.flatnonzero(~((weights >= 0.0) & np.isfinite(weights)))
    if len(bad):
        raise ValueError(f"{name}[{int(bad[0])}] is {weights[bad[0]]}; it must be >= 0 and finite")
