"""Every engine that can take the steps of a run, as one fixture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from cuda_ext.library_folder import library_folder
from pop_fast.backends import get_backend
from pop_fast.train.engines import native_engine, torch_engine
from tests.cuda.emulated import emulate

# "cuda" is the kernels' own source under the emulator; tests/cuda/gpu says the same of a GPU
ENGINES = ("fast", "compiled", "native", "cuda")


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what takes the steps, or skip with the reason why it cannot here."""
    if request.param == "cuda":
        reason = emulate.why_not()
        if reason is not None:
            pytest.skip(reason)
        folder = Path(emulate.__file__).parent
        emulate.install(monkeypatch, emulate.build(library_folder(folder)))
        return emulate.engine()
    reason = get_backend("fast" if request.param == "fast" else "compiled").why_not()
    if reason is not None:
        pytest.skip(reason)
    return native_engine() if request.param == "native" else torch_engine(request.param)


@pytest.fixture(autouse=True)
def _one_thread() -> Any:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
