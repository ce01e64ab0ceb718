"""What needs a GPU: the laws on the CUDA backend, bits, training steps; on a card and under the emulator."""

from __future__ import annotations

import functools
import os
from pathlib import Path
from typing import Any

import pytest

import cuda_ext
from cuda_ext.host import emulate
from pop_ref.conformance.backends import Absent
from pop_ref.conformance.plugin import parametrize_backends
from tests.cuda.conftest import FOLDER as EMULATED
from tests.cuda.conftest import NO_CARD, emulated_engine

FOLDER = Path(__file__).parent
ON = tuple(os.environ.get("POP_CUDA_ON", "cuda emulated").split())
LAWS_EMULATED = bool(os.environ.get("POP_EMULATED_LAWS"))
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
def card_backends() -> list[Any]:
    return cuda_backends("cuda", "cuda")


@functools.cache
def emulated_backends() -> list[Any]:
    # for good: a backend of the laws is asked while tests are collected, and goes back after its call has returned
    emulate.install(pytest.MonkeyPatch(), emulate.build(EMULATED))
    return cuda_backends("cpu", "emulated")


def law_backends() -> list[Any]:
    """Return the backends on which the laws are tried, or in the place of each device's why they are not."""
    found: list[Any] = []
    if "cuda" in ON:
        found += card_backends() if NO_CARD is None else [Absent("cuda", NO_CARD)]
    if "emulated" in ON:
        reason = emulate.why_not() if LAWS_EMULATED else "minutes: set POP_EMULATED_LAWS=1, or `make emulate`"
        found += emulated_backends() if reason is None else [Absent("emulated", reason)]
    return found


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "backend" in metafunc.fixturenames:
        parametrize_backends(metafunc, law_backends())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run what no emulator can show before everything else, so that a failure there is known at once."""
    if cuda_ext.why_not() is None:
        # stable: all else stays in its order
        items.sort(key=lambda item: item.path.parent != FOLDER or item.get_closest_marker("graph") is None)


@pytest.fixture(params=ON)
def gpu(request: pytest.FixtureRequest) -> Any:
    """Return the device, or skip with the reason why there is none."""
    return request.getfixturevalue({"cuda": "card", "emulated": "emulated_card"}[request.param])


@pytest.fixture
def engine(gpu: Any) -> Any:
    """Return the GPU as `pop train` finds it."""
    from pop_fast.train.engines import whole_engine

    return whole_engine("cuda") if gpu.type == "cuda" else emulated_engine()
