"""The tests that need a GPU, on a machine without one: the kernels' own source runs under the emulator.

The training steps run with every test run. The laws take minutes; POP_EMULATED_LAWS=1 (`make emulate`) runs them too.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cuda_ext.host import emulate
from cuda_ext.host.library_folder import library_folder

pytest.register_assert_rewrite("pop_ref.conformance.laws")

from pop_ref.conformance.plugin import parametrize_backends  # noqa: E402  asserts must be rewritten first
from tests.cuda.gpu.conftest import cuda_backends  # noqa: E402

FOLDER = library_folder(Path(__file__).parent)
LAWS = bool(os.environ.get("POP_EMULATED_LAWS"))


@functools.cache
def laws_backends() -> list[Any]:
    # for good: a backend of the laws is asked while tests are collected, and goes back after its call has returned
    emulate.install(pytest.MonkeyPatch(), emulate.build(FOLDER))
    return cuda_backends("cpu", "emulated")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "backend" not in metafunc.fixturenames:
        return
    reason = "minutes: set POP_EMULATED_LAWS=1, or `make emulate`" if not LAWS else emulate.why_not()
    if reason is None:
        parametrize_backends(metafunc, laws_backends())
    else:
        metafunc.parametrize("backend", [pytest.param(None, id="emulated", marks=[pytest.mark.skip(reason=reason)])])


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return the device of the emulated GPU, or skip with the reason why there is none."""
    import torch

    reason = emulate.why_not()
    if reason is not None:
        pytest.skip(reason)
    emulate.install(monkeypatch, emulate.build(FOLDER))
    # threads of the CPU run that is compared with are not what is tested
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield torch.device("cpu")
    torch.set_num_threads(before)


@pytest.fixture
def engine(gpu: Any) -> Any:
    """Return the emulated GPU as `pop train` takes one."""

    from tests.cuda.emulated.engine import emulated_engine

    return emulated_engine()
