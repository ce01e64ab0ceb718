"""Times of `rasterization()` and of the blend alone, every backend in turns, after the gate: no speed is reported of a
backend that is not right.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import torch
from cases import GATE_CASE, Case, gaussians_of, turns_ms
from torch import Tensor

from pop_fast.api.registry import backend_names, get_backend
from pop_fast.stages.compositing import Composite, composite
from pop_fast.stages.tiles import TileLists, tile_lists
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render, render_vjp

# the largest relative difference from the oracle that the gate lets pass
GATE = {torch.float64: 1e-10, torch.float32: 5e-5}
SCENE = ("means", "quats", "scales", "opacities", "colors")


def backends() -> tuple[str, ...]:
    """Return the CPU backends that can run here, the slowest first."""
    return tuple(name for name in ("fast", "compiled") if name in backend_names() and get_backend(name).available())


def time_raster(case: Case, repeats: int) -> dict[str, Any]:
    """Time `rasterization()` and, apart from it, the blend alone in 16 and 8 pixel tiles; every backend in turns."""
    scene = gaussians_of(case)
    leaves = {name: scene[name].requires_grad_() for name in SCENE}
    arguments = {**scene, **leaves, "width": case.width, "height": case.height, "sh_degree": 3, "packed": False}

    def forward(backend: str, dominance: bool) -> Tensor:
        return get_backend(backend).rasterization(**arguments, dominance=dominance)[0]

    def both(backend: str, dominance: bool) -> None:
        forward(backend, dominance).square().mean().backward()

    def timed(what: Callable[[str, bool], Any], dominance: bool) -> dict[str, float]:
        return turns_ms({name: partial(what, name, dominance) for name in backends()}, repeats)

    meta = get_backend("fast").rasterization(**arguments, counts=True)[2]
    return {
        **asdict(case),
        "forward_ms": timed(forward, False),
        "forward_dominance_ms": timed(forward, True),
        "forward_backward_ms": timed(both, False),
        "forward_backward_dominance_ms": timed(both, True),
        "contributing_per_pixel": float(meta["n_contrib"].float().mean()),
        "list_entries_per_pixel": float(meta["n_traversed"].float().mean()),
        "visible": int((meta["radii"] > 0).all(-1).sum()),
        "blend": [time_blend(case, tile, repeats) for tile in (16, 8)],
    }


def blend_of(case: Case, tile: int, backend: str = "fast") -> tuple[TileLists, list[Tensor], Callable[[], Composite]]:
    """Return a case's tile lists, its splats, and what blends them, differentiably, and nothing else."""
    scene, size = gaussians_of(case), (case.width, case.height)
    with torch.no_grad():
        _, _, meta = get_backend("fast").rasterization(
            **scene, width=size[0], height=size[1], sh_degree=3, packed=False
        )
    names = ("means2d", "conics", "opacities")
    splats = [meta[name][0].detach().clone().requires_grad_() for name in names]
    colors = torch.rand(case.n, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    exact = {"conics": meta["conics"][0], "opacities": meta["opacities"][0]}
    lists = tile_lists(meta["means2d"][0], meta["radii"][0], meta["depths"][0], *size, tile, **exact)
    blend = composite
    if backend == "compiled":
        from pop_fast.compiled.compositing import composite as blend
    return lists, [*splats, colors], lambda: blend(*splats, colors, lists, *size)


def time_blend(case: Case, tile: int, repeats: int) -> dict[str, Any]:
    """Time blending and its transpose alone, per evaluated (Gaussian, pixel) pair; every backend in turns."""
    blends = {name: blend_of(case, tile, name) for name in backends()}

    # a cotangent that is there already: what a loss costs is not the blend's
    v_image = torch.randn((case.height, case.width, 3), generator=torch.Generator().manual_seed(1))

    def both(splats: list[Tensor], blend: Callable[[], Composite]) -> None:
        torch.autograd.grad(blend().image, splats, v_image)

    ahead = turns_ms({name: blend for name, (_, _, blend) in blends.items()}, repeats)
    whole = turns_ms({name: partial(both, splats, blend) for name, (_, splats, blend) in blends.items()}, repeats)
    pairs = {name: blend().n_pairs for name, (_, _, blend) in blends.items()}
    return {
        "tile": tile,
        "entries": len(blends["fast"][0].ids),
        "pairs_per_pixel": {name: n / (case.width * case.height) for name, n in pairs.items()},
        "forward_ms": ahead,
        "forward_backward_ms": whole,
        "forward_ns_per_pair": {name: 1e6 * ahead[name] / n for name, n in pairs.items()},
        "forward_backward_ns_per_pair": {name: 1e6 * whole[name] / n for name, n in pairs.items()},
    }


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
