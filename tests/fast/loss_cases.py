"""Pairs of images on which losses are compared, and what the oracle and the fast code make of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch
from hypothesis import strategies as st

from pop_fast.stages import losses, ssim
from pop_ref import losses as oracle


@contextmanager
def bands_of(values: int) -> Iterator[None]:
    before = ssim._BAND_VALUES
    ssim._BAND_VALUES = values
    try:
        yield
    finally:
        ssim._BAND_VALUES = before


class Case(NamedTuple):
    """A pair of images to compare; small when printed."""

    height: int = 12
    width: int = 12
    channels: int = 3
    kind: str = "noisy"
    seed: int = 0
    masked: bool = False
    padding: str = "valid"

    def images(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a render and a photograph whose values float32 holds exactly."""
        rng = np.random.default_rng(self.seed)
        y = rng.random((self.height, self.width, self.channels))
        if self.kind == "flat":
            y = np.full_like(y, 0.75)
        if self.kind == "black and white":
            y = np.round(y)
        noise = {"close": 1e-3, "equal": 0.0}.get(self.kind, 0.25)
        x = rng.random(y.shape) if self.kind == "unrelated" else y + noise * rng.normal(size=y.shape)
        return x.astype(np.float32).astype(np.float64), y.astype(np.float32).astype(np.float64)

    def tensors(self, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
        x, y = self.images()
        return torch.tensor(x, dtype=dtype), torch.tensor(y, dtype=dtype)

    def mask(self) -> np.ndarray | None:
        return np.random.default_rng(self.seed).random((self.height, self.width)) < 0.75 if self.masked else None

    def options(self, name: str) -> dict[str, str]:
        return {} if name in ("l1", "l2") else {"padding": self.padding}


def cases() -> st.SearchStrategy[Case]:
    common = {
        "channels": st.sampled_from([3, 1, 4]),
        "kind": st.sampled_from(["noisy", "close", "equal", "flat", "black and white", "unrelated"]),
        "seed": st.integers(0, 2**16),
        "masked": st.booleans(),
    }
    whole, any_size = st.integers(11, 24), st.integers(1, 24)
    inside = st.builds(Case, whole, whole, **common, padding=st.just("valid"))
    return inside | st.builds(Case, any_size, any_size, **common, padding=st.just("same"))


def both(
    name: str, case: Case, dtype: torch.dtype, module: ModuleType = losses, **options
) -> tuple[float, np.ndarray, float, np.ndarray]:
    """Return value and gradient of the oracle, then of the fast loss."""
    options, (x, y), mask = {**case.options(name), **options}, case.images(), case.mask()
    value = getattr(oracle, name)(x, y, mask=mask, **options)
    v_image = getattr(oracle, name + "_vjp")(x, y, 1.0, mask=mask, **options)
    image = torch.tensor(x, dtype=dtype, requires_grad=True)
    kept = None if mask is None else torch.tensor(mask)
    loss = getattr(module, name)(image, torch.tensor(y, dtype=dtype), mask=kept, **options)
    loss.backward()
    assert loss.dtype == image.grad.dtype == dtype
    return value, v_image, loss.item(), image.grad.numpy()
