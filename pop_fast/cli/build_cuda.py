"""`pop build-cuda`: compile the CUDA extension."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from cuda_ext.build import BuildError, build
from pop_fast.cli.arguments import parse
from pop_fast.errors import PopError

_EXAMPLES: Final = """
    pop build-cuda                      for the GPU of this machine
    pop build-cuda --arch sm_80 sm_90   for these, also where there is no GPU
"""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Compile the CUDA extension with nvcc, CMake and nanobind. Nothing else ever compiles it.

    `pip install 'pop-splatting[cuda-build]'` brings all but nvcc, which comes from a CUDA toolkit or from NVIDIA's
    packages on PyPI; `pop doctor` says what is missing.
    """

    arch: tuple[str, ...] = ()
    """Architectures, for example sm_90; by default this machine's GPU, or sm_75, sm_80 and sm_90 without one."""
    jobs: int = 2
    """Compilers at a time."""
    verbose: bool = False
    """Show the compilers' commands."""


def run(argv: Sequence[str]) -> int:
    """Run the subcommand."""
    args = parse(Args, argv, "build-cuda", examples=_EXAMPLES)
    try:
        module = build(list(args.arch) or None, args.jobs, verbose=args.verbose)
    except BuildError as error:
        first, *rest = str(error).splitlines()
        print("\n".join(rest), end="\n" if rest else "")
        raise PopError(first) from error
    print(module)
    return 0
