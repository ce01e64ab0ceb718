"""Compile the CPU kernels, when asked: one call of a C++ compiler, into this package's folder.

    python -m pop_fast.compiled.build [--if-possible]

The library's name holds a digest of its source, the compiler's options and the processor's features, because it is
compiled for exactly the processor that it is compiled on: what was built for another one is never loaded. A wheel
brings libraries for levels of instructions instead, of which `library_path` takes the highest that this processor has,
unless one was compiled here.
"""

from __future__ import annotations

import argparse
import ctypes
import hashlib
import os
import platform
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Final

import cuda_ext
from cuda_ext.toolkit import find_compiler, no_compiler

HERE: Final = Path(__file__).resolve().parent
UNITS: Final = tuple(
    f"{name}.cpp" for name in ("blend", "scores", "step", "step_lists", "step_pixels", "step_update", "counts")
)
SOURCES: Final = (
    *("projection.h", "colors.h", "lists.h", "tile.h", "forward.h", "backward.h", "ssim.h"),
    *("scores.h", "c_api.h", "lanes.h", "threads.h", "step.h", "row_block.h"),
    *UNITS,
)
# one Gaussian's arithmetic is that of the CUDA kernels
CUDA: Final = Path(cuda_ext.__file__).resolve().parent
SHARED: Final = tuple(
    f"csrc/{name}.cuh"
    for name in (
        *("real", "profile", "activations", "covariance", "camera", "projection", "footprint", "tiles", "splatting"),
        *("harmonics", "ssim", "optimizer", "density", "polarization"),
    )
)
# roots and comparisons of many numbers at once neither set errno nor stop at a NaN
FLAGS: Final = (
    *("-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-fno-tree-slp-vectorize"),
    *("-fPIC", "-shared", "-pthread"),
)
# for this processor, as compilers of different kinds and ages spell it; the last resort is any processor of its kind
# whole vectors where there are any: compilers halve those of sixteen floats unasked, which costs the transpose a fifth
TUNING: Final = (("-march=native", "-mprefer-vector-width=512"), ("-march=native",), ("-mcpu=native",), ())
# What a wheel brings for a kind of machine, the highest level first: the compiler's name of the level, and the features
# by which Linux tells that a processor has it, besides those of the lower ones (the x86-64 psABI, section 3.1.1).
LEVELS: Final = {
    "x86_64": (
        ("x86-64-v4", "avx512f avx512bw avx512cd avx512dq avx512vl"),
        ("x86-64-v3", "avx avx2 bmi1 bmi2 f16c fma abm movbe"),
        ("x86-64-v2", "cx16 lahf_lm popcnt pni sse4_1 sse4_2 ssse3"),
    ),
    "aarch64": (("armv8-a", "fp asimd"),),
}


class BuildError(RuntimeError):
    """There is no compiler, or it failed; the message says what to do."""


@cache
def library_path() -> Path:
    """Return where the library to load is: compiled for this processor, else what a wheel brought for its like.

    Where neither is there, it is where the first would be.
    """
    own = native_path()
    brought = (HERE / level_name(level) for level in supported_levels())
    return own if own.exists() else next((path for path in brought if path.exists()), own)


def native_path() -> Path:
    """Return where the library of this version for exactly this processor is, whether or not it has been compiled."""
    return HERE / f"_blend_{_source()}_{_machine()}.so"


def level_name(level: str) -> str:
    """Return the name of the library of this version that a wheel brings for a level."""
    return f"_blend_{_source()}_{level}.so"


def supported_levels() -> list[str]:
    """Return the levels whose libraries this processor can run, the highest first; none where the system tells none."""
    features = set((processor_features() or "").lower().split())
    levels = LEVELS.get(platform.machine(), ())
    needed = [set(" ".join(words for _, words in levels[at:]).split()) for at in range(len(levels))]
    return [level for (level, _), words in zip(levels, needed, strict=True) if words <= features]


def _source() -> str:
    """Return a digest of what the library is compiled from."""
    source = hashlib.sha256()
    for path in (*(HERE / name for name in SOURCES), *(CUDA / name for name in SHARED)):
        source.update(path.read_bytes())
    return source.hexdigest()[:16]


def _machine() -> str:
    """Return a digest of what the library is compiled for."""
    words = (*FLAGS, *map(str, _tuning()), platform.system(), processor_features() or platform.machine())
    return hashlib.sha256("\n".join(words).encode()).hexdigest()[:8]


def processor_features() -> str | None:
    """Return what the system says of the processor's kind and instructions, or None where it does not."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            if line.lower().startswith(("flags", "features")):
                return f"{platform.machine()} {line}"
    return None


def _tuning() -> tuple[tuple[str, ...], ...]:
    # where nothing tells processors apart, the library must run on all of them
    return TUNING if processor_features() else ((),)


def build(verbose: bool = False) -> Path:
    """Compile the library for this processor, unless it is there and loads; older versions of it are removed.

    Returns:
        The library's file.

    Raises:
        BuildError: no compiler was found, it failed, or the folder cannot be written to.
    """
    library = native_path()
    if library.exists() and _loads(library):
        return library
    compiler = _compiler()
    try:
        # under a temporary name and then renamed, so that nobody loads half a library
        descriptor, partial = tempfile.mkstemp(dir=HERE, prefix="_partial_", suffix=".so")
    except OSError as error:
        raise BuildError(f"{HERE} cannot be written to ({error.strerror}); install the package for yourself") from error
    os.close(descriptor)
    try:
        _compile(compiler, partial, _tuning(), verbose)
        os.chmod(partial, 0o644)
        os.replace(partial, library)
    except OSError as error:
        raise BuildError(f"compiling the CPU kernels failed: {' '.join(compiler)}, {library}: {error}") from error
    finally:
        Path(partial).unlink(missing_ok=True)
    # those of other processors stay: an installation may be shared by several machines
    for other in HERE.glob(f"_blend_*_{_machine()}.so"):
        if other != library:
            other.unlink(missing_ok=True)
    library_path.cache_clear()
    return library


def build_levels(folder: Path) -> list[Path]:
    """Compile the libraries of a wheel for this kind of machine.

    Raises:
        BuildError: there are no levels for this kind of machine, no compiler was found, or it failed.
    """
    levels = LEVELS.get(platform.machine(), ())
    if not levels or platform.system() != "Linux":
        raise BuildError(f"wheels bring no CPU kernels for {platform.system()} on {platform.machine()}")
    compiler = _compiler()
    libraries = [folder / level_name(level) for level, _ in levels]
    for library, (level, _) in zip(libraries, levels, strict=True):
        width = ("-mprefer-vector-width=512",) if platform.machine() == "x86_64" else ()
        _compile(compiler, str(library), ((f"-march={level}", *width),))
    return libraries


def _compiler() -> list[str]:
    compiler = find_compiler()
    if compiler is None:
        raise BuildError(no_compiler())
    return compiler


def _loads(library: Path) -> bool:
    try:
        ctypes.CDLL(str(library))
    except OSError:
        return False
    return True


def _compile(compiler: list[str], library: str, tunings: tuple[tuple[str, ...], ...], verbose: bool = False) -> None:
    failures: list[str] = []
    for tuning in tunings:
        command = [*compiler, *FLAGS, *tuning, f"-I{CUDA.parent}", "-o", library, *(str(HERE / unit) for unit in UNITS)]
        if verbose:
            print(" ".join(command))
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return
        tail = "\n".join(done.stderr.splitlines()[-20:])
        failures.append(f"{' '.join(command)} said:\n{tail}")
    # without tuning there is the least that can go wrong
    raise BuildError(f"compiling the CPU kernels failed; {failures[-1]}")


def main() -> int:
    """Compile from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--if-possible", action="store_true", help="say why it cannot be compiled, and succeed")
    parser.add_argument("--verbose", action="store_true", help="show the compiler's command")
    args = parser.parse_args()
    try:
        print(build(args.verbose))
    except BuildError as error:
        print(f"the CPU kernels are not compiled, and backend fast stands in: {error}", file=sys.stderr)
        return 0 if args.if_possible else 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
