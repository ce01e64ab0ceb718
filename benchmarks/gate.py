"""The correctness gate: no speed is reported of a backend that is not right."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from cases import GATE_CASE, gaussians_of
from raster import SCENE, backends
from torch import Tensor

from pop_fast.api.registry import get_backend
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render, render_vjp

GATE = {torch.float64: 1e-10, torch.float32: 5e-5}


def gate() -> dict[str, float]:
    """Compare every backend's image and gradients with the oracle; raise SystemExit where they differ.

    Returns:
        The worst difference of each backend and type, relative to each array's largest entry.
    """
    exact = gaussians_of(GATE_CASE, torch.float64)
    arrays = [exact[name].numpy() for name in SCENE]
    camera = Camera(exact["viewmats"][0].numpy(), exact["Ks"][0].numpy(), GATE_CASE.width, GATE_CASE.height)
    image = render(Gaussians(*arrays), camera).image
    v_image = np.random.default_rng(1).normal(size=image.shape)
    v = render_vjp(Gaussians(*arrays), camera, v_image)
    expected = [image, v.means, v.quats, v.scales, v.opacities, v.sh]
    worst: dict[str, float] = {}
    for backend, (dtype, bound) in itertools.product(backends(), GATE.items()):
        given = {name: value.detach().to(dtype, copy=True) for name, value in exact.items()}
        leaves = {name: given[name].requires_grad_() for name in SCENE}
        size = {"width": GATE_CASE.width, "height": GATE_CASE.height, "sh_degree": 3}
        fast, _, _ = get_backend(backend).rasterization(**{**given, **leaves}, **size)
        (fast[0] * torch.tensor(v_image, dtype=dtype)).sum().backward()
        found = [fast[0].detach(), *(_gradient(leaf) for leaf in leaves.values())]
        error = max(
            float(np.abs(a.double().numpy() - b).max() / np.abs(b).max()) for a, b in zip(found, expected, strict=True)
        )
        worst[f"{backend} {dtype}"] = error
        if not error <= bound:
            raise SystemExit(
                f"gate: {backend} {dtype} differs from the oracle by {error:.2e}, more than {bound:.0e}; "
                f"nothing was timed"
            )
    return worst


def _gradient(leaf: Tensor) -> Tensor:
    assert leaf.grad is not None
    return leaf.grad
