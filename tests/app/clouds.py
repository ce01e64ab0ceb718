"""Splats for the tests of file formats: drawn by Hypothesis, with the extremes that training reaches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor

from pop_fast.io.formats import FORMATS
from pop_fast.io.formats.cloud import Cloud
from pop_fast.io.ply import Frame


def _floats(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, width=32, allow_subnormal=False)


@st.composite
def splats(draw: st.DrawFn, most: int = 6) -> dict[str, Tensor]:
    """Draw raw parameters of none to some Gaussians, of colour degree 0 to 3."""
    n, bands = draw(st.integers(0, most)), draw(st.sampled_from((0, 3, 8, 15)))

    def rows(shape: tuple[int, ...], values: st.SearchStrategy[float]) -> Tensor:
        return torch.from_numpy(draw(arrays(np.float32, shape, elements=values)))

    quats = rows((n, 4), st.sampled_from((0.0, 1.0, -1.0, 0.5, 0.0625, -3.0)))
    quats[~quats.any(1)] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    # opacities of exactly 0 and 1 in float32 among them
    logits = st.one_of(st.sampled_from((0.0, -120.0, 40.0, -5.5, 5.5)), _floats(-8.0, 8.0))
    return {
        "means": rows((n, 3), _floats(-100.0, 100.0)),
        "scales": rows((n, 3), _floats(-9.0, 5.0)),
        "quats": quats,
        "opacities": rows((n,), logits),
        "sh0": rows((n, 1, 3), _floats(-1.75, 1.75)),
        "shN": rows((n, bands, 3), _floats(-0.9375, 0.9375)),
    }


def many(n: int, bands: int = 15, seed: int = 0) -> dict[str, Tensor]:
    """Make raw parameters of many Gaussians, most of them near the origin."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=random)

    return {
        "means": 2.0 * normal(n, 3),
        "scales": normal(n, 3) - 4.0,
        "quats": normal(n, 4),
        "opacities": 3.0 * normal(n),
        "sh0": normal(n, 1, 3).clamp(-1.7, 1.7),
        "shN": (0.2 * normal(n, bands, 3)).clamp(-0.9, 0.9),
    }


def decoded(
    name: str, params: dict[str, Tensor], antialiased: bool = False, frame: Frame | None = None
) -> tuple[Cloud, Cloud, bytes]:
    """Return what went into a file, in its order, what came out, and the file."""
    format, cloud = FORMATS[name], Cloud.of(params, antialiased, frame)
    cloud = cloud if format.order is None else cloud.take(format.order(cloud))
    data = format.encode(cloud)
    return cloud, format.decode(data, Path(f"x{format.suffix}")), data


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between rotations."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    b = b * np.where((a * b).sum(1, keepdims=True) < 0.0, -1.0, 1.0)
    return np.degrees(4.0 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2.0, 0.0, 1.0)))
