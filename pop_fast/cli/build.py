"""`pop build-cpu` and `pop build-cuda`: compile the CPU kernels, or the CUDA extension."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cuda_ext.build import BuildError as CudaBuildError
from cuda_ext.build import build as build_cuda
from pop_fast.cli import parse
from pop_fast.compiled import why_not
from pop_fast.compiled.build import BuildError, build
from pop_fast.errors import PopError

_CPU_EXAMPLES: Final = """
    pop build-cpu             backend "compiled", which `pop train` uses from then on
    CXX=clang++ pop build-cpu
"""
_CUDA_EXAMPLES: Final = """
    pop build-cuda                      for the GPU of this machine
    pop build-cuda --arch sm_80 sm_90   for these, even without a GPU
"""


@dataclass(frozen=True, kw_only=True)
class CpuArgs:
    """Compile the CPU kernels with g++, clang++ or the compiler that CXX names. Nothing else compiles them but `make`.

    It takes some seconds and makes training about four times as fast. They are compiled for exactly this processor,
    and have to be compiled again after an update.
    """

    verbose: bool = False
    """Show the compiler's command."""


@dataclass(frozen=True, kw_only=True)
class CudaArgs:
    """Compile the CUDA extension with nvcc, CMake and nanobind. An import never compiles it.

    `pip install 'pop-splatting[cuda-build]'` brings all but nvcc, which comes from a CUDA toolkit or from NVIDIA's
    packages on PyPI; `pop doctor` says what is missing.
    """

    arch: tuple[str, ...] = ()
    """Architectures, for example sm_90; by default this machine's GPU, or sm_75, sm_80 and sm_90 without one."""
    jobs: int = 2
    """Compilers at a time."""
    verbose: bool = False
    """Show the compilers' commands."""


def run_cpu(argv: Sequence[str]) -> int:
    args = parse(CpuArgs, argv, "build-cpu", examples=_CPU_EXAMPLES)
    library = _built(lambda: build(args.verbose))
    reason = why_not()
    if reason is not None:
        raise PopError(reason)
    print(library)
    return 0


def run_cuda(argv: Sequence[str]) -> int:
    args = parse(CudaArgs, argv, "build-cuda", examples=_CUDA_EXAMPLES)
    print(_built(lambda: build_cuda(list(args.arch) or None, args.jobs, verbose=args.verbose)))
    return 0


def _built(call: Callable[[], Path]) -> Path:
    """Build; of a failure the first line is the error, and what the compiler said is printed before it."""
    try:
        return call()
    except (BuildError, CudaBuildError) as error:
        first, *rest = str(error).splitlines()
        print("\n".join(rest), end="\n" if rest else "")
        raise PopError(first) from error
