"""A few Gaussians with optimizers, and what a rasterizer would say about them."""

from __future__ import annotations

import math

import torch

KEYS = ("means", "scales", "quats", "opacities", "sh0", "shN")
WIDTH, HEIGHT = 64, 32


def make(n: int, seed: int = 0, opacities: float = 0.5, scale: float = 0.005):
    g = torch.Generator().manual_seed(seed)
    params = {
        "means": torch.randn(n, 3, generator=g),
        "scales": torch.full((n, 3), math.log(scale)),
        "quats": torch.randn(n, 4, generator=g),
        "opacities": torch.full((n,), math.log(opacities / (1 - opacities))),
        "sh0": torch.randn(n, 1, 3, generator=g),
        "shN": torch.randn(n, 15, 3, generator=g),
    }
    params = {key: torch.nn.Parameter(value) for key, value in params.items()}
    optimizers = {key: torch.optim.Adam([value], lr=0.01, eps=1e-15, fused=True) for key, value in params.items()}
    for key, value in params.items():
        value.grad = torch.randn(value.shape, generator=g)
        optimizers[key].step()
    return params, optimizers


def make_info(
    n: int, grads=None, visible=None, counts=None, cameras: int = 1, width: int = WIDTH, height: int = HEIGHT
):
    def rows(values, otherwise):
        return otherwise if values is None else torch.as_tensor(values).to(otherwise.dtype).reshape(otherwise.shape)

    means2d = torch.zeros(cameras, n, 2, requires_grad=True)
    means2d.grad = rows(grads, torch.zeros(cameras, n, 2))
    seen = rows(visible, torch.ones(cameras, n, dtype=torch.bool))
    radii = seen[..., None].int().expand(-1, -1, 2) * 4
    return {
        "means2d": means2d,
        "radii": radii,
        "width": width,
        "height": height,
        "n_cameras": cameras,
        "dominant_counts": rows(counts, torch.zeros(cameras, n, dtype=torch.int64)),
        "gaussian_ids": None,
    }


def packed(info):
    """The same statistics as rasterization(packed=True) reports them: visible rows only."""
    cameras, ids = torch.nonzero((info["radii"] > 0).all(-1), as_tuple=True)
    means2d = torch.zeros(len(ids), 2, requires_grad=True)
    means2d.grad = info["means2d"].grad[cameras, ids]
    return {**info, "means2d": means2d, "radii": info["radii"][cameras, ids], "gaussian_ids": ids.int()}


def moments(optimizers, params, key):
    state = optimizers[key].state[params[key]]
    return state["exp_avg"], state["exp_avg_sq"], state["step"]


def densified_at(strategy, params, optimizers, info, step: int, is_packed: bool = False, scene_scale: float = 1.0):
    state = strategy.initialize_state(scene_scale, seed=3)
    return strategy.step_post_backward(params, optimizers, state, step, info, packed=is_packed)
