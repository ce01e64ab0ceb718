"""Mini-Splatting's importance, and the numbers from which it sets a cloud of points anew.

The importance of a Gaussian is its weight in the views; outdoors its mean weight a pixel, so that what is near and
covers many pixels does not outweigh what is far. What never dominates a pixel has none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pop_ref._shapes import Float64, Int64
from pop_ref.contributions import Contributions

_LEAST_SQUARED_DISTANCE = 1e-7


def view_importance(
    found: Contributions, dominant_counts: Int64[np.ndarray, " N"], outdoor: bool
) -> Float64[np.ndarray, " N"]:
    """Tell what one view adds to each Gaussian's importance.

    Indoors `sum_p T alpha`; outdoors `sum_p T alpha / n_pixels` where `D_i > 0`, and 0 elsewhere.

    Source: Fang and Wang 2024 (Mini-Splatting), Gaussian sampling, and its code.
    Departs: the paper has the sum only; the code divides by the pixels in outdoor scenes.

    Args:
        found: sums over the view's pixels.
        dominant_counts: pixels of the view that each Gaussian dominates.
        outdoor: which of the two.

    Returns:
        What the view adds, >= 0.

    Example:
        >>> sums = Contributions(np.array([1.0, 0.5]), np.array([4, 2]), np.zeros(2), np.zeros(2))
        >>> counts = np.array([1, 0])
        >>> view_importance(sums, counts, outdoor=True).tolist(), view_importance(sums, counts, outdoor=False).tolist()
        ([0.25, 0.0], [1.0, 0.5])
    """
    if not outdoor:
        return found.weight_sum.copy()
    return np.where(dominant_counts > 0, found.weight_sum / np.maximum(found.n_pixels, 1), 0.0)


def scene_importance(
    views: Sequence[tuple[Contributions, Int64[np.ndarray, " N"]]], outdoor: bool
) -> Float64[np.ndarray, " N"]:
    """Add the views' importance up: `I_i = sum_v I_iv`, and 0 where no view is dominated at any pixel.

    Source: Fang and Wang 2024 (Mini-Splatting), Gaussian sampling.
    Departs: the second half of the sentence is the code's.

    Args:
        views: of each view its sums and its dominant counts, at least one.
        outdoor: as in `view_importance`.

    Returns:
        The importance, >= 0.

    Raises:
        ValueError: there are no views.

    Example:
        >>> sums = Contributions(np.array([1.0, 0.5]), np.array([4, 2]), np.zeros(2), np.zeros(2))
        >>> scene_importance([(sums, np.array([1, 0])), (sums, np.array([0, 0]))], outdoor=False).tolist()
        [2.0, 0.0]
    """
    if not views:
        raise ValueError("there are no views; importance is a sum over at least one")
    importance = np.zeros(len(views[0][1]))
    dominant_sum = np.zeros(len(importance), dtype=np.int64)
    for found, dominant_counts in views:
        importance = importance + view_importance(found, dominant_counts, outdoor)
        dominant_sum = dominant_sum + dominant_counts
    return np.where(dominant_sum > 0, importance, 0.0)


def samples_per_view(n_views: int, width: int, height: int, max_points: int = 3_500_000) -> int:
    """Say how many pixels of a view become points: `floor(max_points / n_views)`, at most all of them.

    Source: Fang and Wang 2024 (Mini-Splatting), its code (3.5 million points of all views).
    Departs: the code has no bound by the image's size and fails where there are fewer pixels.

    Args:
        n_views: training views.
        width: px.
        height: px.
        max_points: of all views together.

    Returns:
        Pixels to draw.

    Raises:
        ValueError: there is no view.

    Example:
        >>> samples_per_view(100, 1024, 512), samples_per_view(100, 16, 16)
        (35000, 256)
    """
    if n_views < 1:
        raise ValueError(f"n_views is {n_views}; it must be >= 1")
    return min(max_points // n_views, width * height)


def nearest_log_scales(points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Size each point by its neighbours: `log sqrt(max(mean squared distance to the 3 nearest, 1e-7))`, on each axis.

    Source: Kerbl et al. 2023 (3DGS), section 5.1; the bound is the code's.
    Departs: the paper means the distances, the code the squared distances. Of fewer than 4 points the mean is over
        those there are, and of a single one the bound itself.

    Args:
        points: world units.

    Returns:
        Logarithms of standard deviations in world units, the same on all three axes.

    Example:
        >>> np.exp(nearest_log_scales(np.array([[0.0, 0, 0], [2.0, 0, 0], [0, 2.0, 0], [0, 0, 2.0]])))[0].round(12)
        array([2., 2., 2.])
    """
    log_scales = np.zeros((len(points), 3))
    for i in range(len(points)):
        squared = sorted(np.sum((np.delete(points, i, axis=0) - points[i]) ** 2, axis=1).tolist())[:3]
        mean = sum(squared) / max(len(squared), 1)
        log_scales[i] = 0.5 * math.log(max(mean, _LEAST_SQUARED_DISTANCE))
    return log_scales
