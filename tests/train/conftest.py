"""Every engine on the CPU that can take the steps of a run, as one fixture.

The fused step on a GPU, or its kernels' own source under the emulator, is held to the same in tests/cuda.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch

from pop_fast.train.engines import torch_engine, whole_engine
from tests.app.tiny import skip_without

ENGINES = ("fast", "compiled", "native")


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> Any:
    """Return what takes the steps, or skip with the reason why it cannot here."""
    skip_without("fast" if request.param == "fast" else "compiled")
    return whole_engine() if request.param == "native" else torch_engine(request.param)


@pytest.fixture(autouse=True)
def _one_thread(_threads_of_torch: None) -> None:
    torch.set_num_threads(1)
