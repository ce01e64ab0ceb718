"""How far points lie from their nearest others."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree


def mean_squared_distances(points: np.ndarray, k: int = 3) -> np.ndarray:
    """Return each point's mean squared distance to its k nearest others, or to all where there are fewer.

    Args:
        points: any unit; those that coincide are each other's nearest. [N, 3]
        k: how many.

    Returns:
        In the squared unit; 0 for a single point. [N] float64
    """
    n = len(points)
    if n < 2:
        return np.zeros(n)
    # a point is its own nearest neighbour
    nearest = np.asarray(KDTree(points).query(points, k=min(k + 1, n))[0])[:, 1:]
    return np.mean(nearest**2, axis=1)
