"""What needs a GPU: the laws on the CUDA backend, bits, ten training steps. Skipped, with the reason, without."""

from __future__ import annotations

import functools
import os
from pathlib import Path
from typing import Any

import pytest

pytest.register_assert_rewrite("pop_ref.conformance.laws")

import cuda_ext  # noqa: E402  asserts must be rewritten first
from pop_ref.conformance.plugin import parametrize_backends  # noqa: E402

FOLDER = Path(__file__).parent
OF_META = ("means2d", "radii", "depths", "conics", "opacities", "final_T")
DOMINANCE = ("dominant_ids", "dominant_weights", "dominant_counts")


def rasterizer(backward: str, deterministic: bool = True) -> Any:
    """Return the CUDA rasterization with one backward kernel; visits are counted where the tile allows it."""
    from pop_fast.cuda import rasterization

    # the kit reads off the signature what it may ask for: a mode that is not named here is not judged
    def draw(
        *args: Any, profile: Any = "paper", rasterize_mode: Any = "classic", dominance: bool = False, **options: Any
    ) -> Any:
        settings = {"profile": profile, "rasterize_mode": rasterize_mode, "dominance": dominance, **options}
        image, alphas, meta = rasterization(*args, backward=backward, deterministic=deterministic, **settings)
        visits = ("n_traversed",) if options.get("tile_size", 16) % 16 == 0 else ()
        return image, alphas, {key: meta[key] for key in (*OF_META, *DOMINANCE, "n_contrib", *visits)}

    return draw


def cuda_backends(device: str, name: str) -> list[Any]:
    from pop_ref.conformance.torch_adapter import TorchAdapter

    kinds = {
        "pixel_parallel": ("pixel_parallel", True),
        "gaussian_parallel": ("gaussian_parallel", True),
        "atomics": ("pixel_parallel", False),
    }
    asked = os.environ.get("POP_CUDA_KINDS", " ".join(kinds)).split()
    return [
        TorchAdapter(f"{name}32-{kind}", rasterizer(*kinds[kind]), None, "float32", device=device) for kind in asked
    ]


@functools.cache
def gpu_backends() -> list[Any]:
    return cuda_backends("cuda", "cuda")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "backend" not in metafunc.fixturenames:
        return
    reason = cuda_ext.why_not()
    if reason is None:
        parametrize_backends(metafunc, gpu_backends())
    else:
        metafunc.parametrize("backend", [pytest.param(None, id="cuda", marks=[pytest.mark.skip(reason=reason)])])


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run what no emulator can show before everything else, so that a failure there is known at once."""
    if cuda_ext.why_not() is None:
        # stable: all else stays in its order
        items.sort(key=lambda item: item.path.parent != FOLDER or item.get_closest_marker("graph") is None)


@pytest.fixture
def gpu() -> Any:
    """Return the device, or skip with the reason why there is none."""
    import torch

    reason = cuda_ext.why_not()
    if reason is not None:
        pytest.skip(reason)
    return torch.device("cuda")


@pytest.fixture
def engine(gpu: Any) -> Any:
    """Return the GPU as `pop train` finds it, or skip with the reason why there is none."""
    from pop_fast.train.engines import whole_engine

    return whole_engine("cuda")
