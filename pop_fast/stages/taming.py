"""Taming-3DGS: how many Gaussians there may be when, and which candidates grow. Meaning: `pop_ref.taming`."""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.stages.contributions import Contributions

# weights of the nine terms, of the view and of the two halves of the pixel map
GRAD, OPACITY, DEPTH, RADIUS, SCALE = 25.0, 100.0, 5.0, 10.0, 25.0
DISTANCE, LOSS, COUNT, BLEND = 50.0, 10.0, 0.1, 50.0
VIEW, ERROR, EDGE = 50.0, 50.0, 50.0

# of "L" images: 0.299, 0.587, 0.114 in units of 2^-16
_LUMA = (19595, 38470, 7471)


def budget_at(nth: int, n: int, start: int, target: int) -> int:
    """See `pop_ref.taming.budget_at`. Optimizations: none.

    Raises:
        ValueError: nth lies outside 0 to n, or there are none.
    """
    if n < 1 or not 0 <= nth <= n:
        raise ValueError(f"nth is {nth} of {n}; it must be in 0 to n, and n >= 1")
    return start + (target - start) * (2 * n * nth - nth * nth) // (n * n)


def edge_map(photo: Tensor) -> Tensor:
    """See `pop_ref.taming.edge_map`. [H, W] float32 Optimizations: whole rows and columns are added up.

    Raises:
        ValueError: the photograph is not uint8 [H, W, 3].
    """
    if photo.dtype != torch.uint8 or photo.dim() != 3 or photo.shape[2] != 3:
        raise ValueError(f"photo is {photo.dtype} {list(photo.shape)}; it must be uint8 [H, W, 3]")
    red, green, blue = photo.to(torch.int32).unbind(2)
    grey = (_LUMA[0] * red + _LUMA[1] * green + _LUMA[2] * blue + (1 << 15)) >> 16
    edges = grey.clone()
    if min(grey.shape) > 2:
        columns = grey[:, :-2] + grey[:, 1:-1] + grey[:, 2:]
        neighbourhood = columns[:-2] + columns[1:-1] + columns[2:]
        edges[1:-1, 1:-1] = (9 * grey[1:-1, 1:-1] - neighbourhood).clamp(0, 255)
    return edges.to(torch.float32)


def pixel_weights(image: Tensor, photo: Tensor) -> Tensor:
    """See `pop_ref.taming.pixel_weights`. [H, W] Optimizations: none.

    Raises:
        ValueError: the photograph is not uint8 [H, W, 3], or the shapes differ.
    """
    edges = edge_map(photo).to(image.dtype)
    if image.shape != photo.shape:
        raise ValueError(f"image has shape {list(image.shape)}, photo {list(photo.shape)}; they must be the same")
    error = (image - photo.to(image.dtype) / 255.0).abs().mean(2)
    return ERROR * _minmax(error) + EDGE * _minmax(edges)


def scaled_to_median(c: float, x: Tensor) -> Tensor:
    """See `pop_ref.taming.scaled_to_median`. [N] float64 Optimizations: the median is selected, not sorted for."""
    x = x.double()
    positive = x[x > 0.0]
    if len(positive) == 0:
        return torch.zeros_like(x)
    return torch.where(x > 0.0, c * (x / positive.median()), 0.0)


def view_score(
    photometric: float | Tensor,
    grads: Tensor,
    opacities: Tensor,
    scales: Tensor,
    depths: Tensor,
    radii: Tensor,
    found: Contributions,
) -> Tensor:
    """See `pop_ref.taming.view_score`. [N] float64 Optimizations: none."""
    visible = (radii > 0).all(1)
    terms = (
        scaled_to_median(GRAD, grads)
        + scaled_to_median(OPACITY, opacities)
        + scaled_to_median(DEPTH, torch.where(visible, depths, 0.0))
        + scaled_to_median(RADIUS, torch.where(visible, torch.maximum(radii[:, 0], radii[:, 1]), 0))
        + scaled_to_median(SCALE, scales.double().prod(1))
        + scaled_to_median(DISTANCE, found.distance_sum)
        + scaled_to_median(LOSS, found.map_sum)
        + scaled_to_median(COUNT, found.n_pixels)
        + scaled_to_median(BLEND, found.weight_sum)
    )
    return torch.where(visible, VIEW * float(photometric) * terms, 0.0)


def quotas(budget: int, n: int, n_clone: int, n_split: int) -> tuple[int, int]:
    """See `pop_ref.taming.quotas`. Optimizations: none."""
    n_candidates = n_clone + n_split
    more = max(min(budget, n + n_candidates) - n, 0)
    return more * n_clone // max(n_candidates, 1), more * n_split // max(n_candidates, 1)


def _minmax(x: Tensor) -> Tensor:
    least, greatest = x.aminmax()
    return (x - least) / (greatest - least) if bool(greatest > least) else torch.zeros_like(x)
