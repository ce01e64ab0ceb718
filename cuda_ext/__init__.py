"""CUDA kernels with the same stage names, and the reasons why they may not be available here.

Importing this package imports neither torch nor the compiled module, and compiles nothing: `python -m cuda_ext.build`
(or `pop build-cuda`, `make cuda`) does that, when it is asked to.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
import sys
from types import ModuleType

_MODULE = "cuda_ext._kernels"
_could_run: list[bool] = []
_BUILD = "run `pop build-cuda`"


def available() -> bool:
    """Tell whether backend "cuda" can run here: built, a driver, a GPU that it was built for."""
    return why_not() is None


def why_not() -> str | None:
    """Return one sentence on why backend "cuda" cannot run here and what to do, or None where it can."""
    # a machine that could run it once continues to; asking anew would cost at every render
    if not _could_run:
        reason = _why_not()
        if reason is not None:
            return reason
        _could_run.append(True)
    return None


def _why_not() -> str | None:
    if importlib.util.find_spec(_MODULE) is None:
        return f"the CUDA extension is not built; {_BUILD}, which says what it needs"
    try:
        kernels = load()
    except ImportError as error:
        return f"the CUDA extension does not load ({error}); build it again: {_BUILD}"
    try:
        import torch
    except ImportError:
        return "torch is not installed; install a CUDA build of torch"
    if torch.version.cuda is None:
        return f"torch {torch.__version__} is a CPU build; install a CUDA build of torch"
    driver, runtime = kernels.driver_version(), kernels.RUNTIME
    if driver == 0:
        return "there is no NVIDIA driver; install one: `nvidia-smi` must show the GPU"
    if driver // 1000 < runtime // 1000:
        return (
            f"the driver knows CUDA {_named(driver)}, the CUDA extension was built with {_named(runtime)}; update the "
            f"driver, or build with a toolkit of the driver's age (CUDACXX=.../nvcc pop build-cuda)"
        )
    if not torch.cuda.is_available():
        return f"torch finds no usable GPU ({_words_of_torch()}); check `nvidia-smi`, and that its driver is new " + (
            f"enough for torch's CUDA {torch.version.cuda}"
        )
    return _why_not_this_gpu(torch.cuda.get_device_capability(), str(kernels.ARCHS))


def load() -> ModuleType:
    """Return the compiled module.

    Raises:
        ImportError: it is not built, or does not load.
    """
    # a call of `rasterization` asks 17 times, and importlib takes longer to say what is loaded
    return sys.modules.get(_MODULE) or importlib.import_module(_MODULE)


def _named(version: int) -> str:
    """Turn 12040 into "12.4"."""
    return f"{version // 1000}.{version % 1000 // 10}"


def _words_of_torch() -> str:
    """Ask torch why it cannot start CUDA; the first sentence."""
    import torch

    try:
        torch.cuda.init()
    except (RuntimeError, AssertionError) as error:
        return re.split(r"[.\n]\s", f"{error} ")[0].strip()
    return "it does not say why"


def _why_not_this_gpu(capability: tuple[int, int], archs: str) -> str | None:
    """Tell whether a card of that capability runs code built for `archs`, for example "75-real,90"."""
    number = capability[0] * 10 + capability[1]
    for arch in archs.split(","):
        built = int(arch.split("-")[0].rstrip("af"))
        same_major = built // 10 == number // 10 and built <= number
        # without "-real" the module carries PTX, which the driver compiles for newer cards
        if same_major or (not arch.endswith("-real") and built <= number):
            return None
    return f"the GPU is sm_{number}, the CUDA extension was built for {archs}; run `pop build-cuda --arch sm_{number}`"
