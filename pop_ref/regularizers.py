"""Terms of the loss for captures of few photographs: depth at sparse points, opacities and sizes that are kept small.

Few photographs leave it open where along a ray a Gaussian lies. The points that structure from motion has found say so
at some pixels: a point that a photograph sees has a known depth there, and the render's expected depth is held to it.
What no photograph needs can be made faint and small besides, by the mean of all opacities and of all sizes.

    L = photometric + prior + depth_lambda s L_depth + opacity_reg mean(o) + scale_reg mean(s)
"""

from __future__ import annotations

import numpy as np

from pop_ref._shapes import Bool, Float64
from pop_ref.records import Camera


def depth_samples(
    points: Float64[np.ndarray, "P 3"], camera: Camera, mask: Bool[np.ndarray, "H W"] | None = None
) -> tuple[Float64[np.ndarray, "M 2"], Float64[np.ndarray, " M"]]:
    """Project the points that a photograph sees: where each falls, and one over its depth.

    Source: gsplat v1.5.3, examples/datasets/colmap.py, `Dataset.__getitem__` with `load_depths`.
    Departs: a point whose pixel the mask leaves out says nothing.

    Args:
        points: world, those that the photograph sees.
        camera: of the photograph.
        mask: True for the pixels that count, or None.

    Returns:
        Places in the image, px, pixel centres at +0.5; disparities, per world unit. Points outside the image or not in
        front of the camera are left out.

    Example:
        >>> camera = Camera(np.eye(4), np.array([[8.0, 0.0, 2.0], [0.0, 8.0, 2.0], [0.0, 0.0, 1.0]]), 4, 4)
        >>> depth_samples(np.array([[0.0, 0.5, 4.0], [0.0, 0.0, -1.0], [9.0, 0.0, 4.0]]), camera)
        (array([[2., 3.]]), array([0.25]))
    """
    places: list[np.ndarray] = []
    disparities: list[float] = []
    for point in points:
        x, y, z = camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3]
        if z <= 0.0:
            continue
        u, v = camera.K[0] @ (x / z, y / z, 1.0), camera.K[1] @ (x / z, y / z, 1.0)
        inside = 0.0 <= u < camera.width and 0.0 <= v < camera.height
        if inside and (mask is None or mask[int(v), int(u)]):
            places.append(np.array([u, v]))
            disparities.append(1.0 / z)
    return np.array(places).reshape(-1, 2), np.array(disparities)


def sparse_depth_loss(
    depth: Float64[np.ndarray, "H W"], places: Float64[np.ndarray, "M 2"], disparities: Float64[np.ndarray, " M"]
) -> float:
    """Compare a render's depth with that of sparse points: `mean_j |1 / E(x_j) - d_j|`.

    E(x) is interpolated between the four pixels around x, bilinearly; where it is 0, as nothing is rendered there, the
    disparity is taken to be 0.

    Source: gsplat v1.5.3, examples/simple_trainer.py, `depth_loss`; the trainer multiplies it by the scene's scale and
        by `depth_lambda`, and so does `pop_ref.training.train_step`.
    Departs: gsplat's `grid_sample` with `align_corners` takes integers for pixel centres and fades out beyond the last
        one; here centres lie at +0.5, as everywhere, and the border goes on.

    Args:
        depth: expected depth E, world units, 0 where nothing is rendered.
        places: where to compare, px.
        disparities: of the points there, per world unit.

    Returns:
        The mean; 0 where there is no point.

    Example:
        >>> sparse_depth_loss(np.array([[2.0, 4.0]]), np.array([[1.5, 0.5]]), np.array([0.5]))
        0.25
    """
    differences = [abs(_disparity(depth, place) - d) for place, d in zip(places, disparities, strict=True)]
    return float(np.sum(differences) / max(len(differences), 1))


def sparse_depth_loss_vjp(
    depth: Float64[np.ndarray, "H W"],
    places: Float64[np.ndarray, "M 2"],
    disparities: Float64[np.ndarray, " M"],
    v_loss: float,
) -> Float64[np.ndarray, "H W"]:
    """Pull a cotangent of `sparse_depth_loss` back: `v_E += v / M sign(1/E - d) (-1/E^2) w` at each of four pixels.

    Source: derivative of `sparse_depth_loss`.
    Departs: where E is 0 the disparity is a constant, and where both disparities agree the slope is 0 (B4).

    Args:
        depth: expected depth, world units.
        places: where to compare, px.
        disparities: of the points there, per world unit.
        v_loss: cotangent of the mean.

    Returns:
        Cotangent of the depth.

    Example:
        >>> sparse_depth_loss_vjp(np.array([[2.0, 4.0]]), np.array([[1.5, 0.5]]), np.array([0.5]), 16.0)
        array([[0., 1.]])
    """
    v_depth = np.zeros(depth.shape)
    for place, d in zip(places, disparities, strict=True):
        disparity = _disparity(depth, place)
        for pixel, weight in _around(depth, place):
            v_depth[pixel] -= v_loss / len(places) * np.sign(disparity - d) * disparity**2 * weight
    return v_depth


def mean_activation(values: Float64[np.ndarray, "..."]) -> float:
    """Average activated opacities [N], or scales [N, 3] in world units: what `opacity_reg` and `scale_reg` weigh.

    Source: gsplat v1.5.3, examples/simple_trainer.py, `opacity_reg` and `scale_reg`.
    Departs: nothing; both are positive, so that the absolute values in gsplat's lines change nothing.

    Args:
        values: activated.

    Returns:
        The mean; 0 for no Gaussians.

    Example:
        >>> mean_activation(np.array([0.25, 0.75]))
        0.5
    """
    return float(np.sum(values) / max(values.size, 1))


def mean_activation_vjp(values: Float64[np.ndarray, "..."], v_loss: float) -> Float64[np.ndarray, "..."]:
    """Pull a cotangent of `mean_activation` back: every value has an equal share.

    Source: derivative of `mean_activation`.
    Departs: nothing.

    Args:
        values: activated.
        v_loss: cotangent of the mean.

    Returns:
        Cotangent of `values`.

    Example:
        >>> mean_activation_vjp(np.array([0.25, 0.75]), 1.0)
        array([0.5, 0.5])
    """
    return np.full_like(values, v_loss / max(values.size, 1))


def _around(depth: np.ndarray, place: np.ndarray) -> list[tuple[tuple[int, int], float]]:
    """List the four pixels around a place with their bilinear weights; the border's pixels go on beyond it."""
    height, width = depth.shape
    u, v = np.clip(place[0] - 0.5, 0.0, width - 1.0), np.clip(place[1] - 0.5, 0.0, height - 1.0)
    left, top = int(u), int(v)
    right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
    a, b = float(u - left), float(v - top)
    weights = ((1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b)
    return list(zip(((top, left), (top, right), (bottom, left), (bottom, right)), weights, strict=True))


def _disparity(depth: np.ndarray, place: np.ndarray) -> float:
    sampled = sum(weight * depth[pixel] for pixel, weight in _around(depth, place))
    return 1.0 / sampled if sampled > 0.0 else 0.0
