"""What stands for a GPU: the card itself, and the kernels' own source under the emulator.

The tests of `gpu/` run on both, and are skipped with the reason where one is not there; POP_CUDA_ON ("cuda",
"emulated") chooses one. Training steps run under the emulator with every test run. The laws take minutes there;
POP_EMULATED_LAWS=1 (`make emulate`) runs them too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.register_assert_rewrite("pop_ref.conformance.laws")

import cuda_ext  # noqa: E402  asserts must be rewritten first
from cuda_ext.host import emulate  # noqa: E402

# where the emulated module is built
FOLDER = emulate.library_folder(Path(__file__).parent / "emulated")
# asked before an emulated module can take the extension's place
NO_CARD = cuda_ext.why_not()


@pytest.fixture
def card() -> Any:
    """Return the GPU as a device, or skip with the reason why there is none."""
    import torch

    if NO_CARD is not None:
        pytest.skip(NO_CARD)
    return torch.device("cuda")


@pytest.fixture
def emulated_card(monkeypatch: pytest.MonkeyPatch, _threads_of_torch: None) -> Any:
    """Return the device of the emulated GPU, or skip with the reason why there is none."""
    import torch

    reason = emulate.why_not()
    if reason is not None:
        pytest.skip(reason)
    emulate.install(monkeypatch, emulate.build(FOLDER))
    # threads of the CPU run that is compared with are not what is tested
    torch.set_num_threads(1)
    return torch.device("cpu")


@pytest.fixture
def gpu(emulated_card: Any) -> Any:
    """Return the device of the emulated GPU; the tests in `gpu/` run on the card as well."""
    return emulated_card


def emulated_engine() -> Any:
    """Return the emulated GPU, once it is installed, as `pop train` takes one."""
    import torch

    from pop_fast.api.backend import get_backend
    from pop_fast.train.engines import GpuProxy
    from pop_fast.train.stepper import Engine, FusedStepper, Task

    device, cuda = torch.device("cpu"), get_backend("cuda")
    step = cuda.whole_step()
    assert step is not None

    def stepper(task: Task) -> FusedStepper:
        return FusedStepper(task, step.name, step.most, step.make(task))

    return Engine("cuda", device, GpuProxy(cuda, device), stepper, lambda: {"gpu": "emulated"})
