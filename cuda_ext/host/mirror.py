"""Compile the host mirror: the kernels' mathematics as an ordinary shared library, for tests on machines without a GPU.

Nothing here runs at import, and nothing but tests and `gpu_check` calls it.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
from pathlib import Path

from cuda_ext.toolkit import find_compiler, no_compiler

HERE = Path(__file__).resolve().parent
# contraction would let the compiler round differently from the kernels, which fuse only where they say so
FLAGS = ("-std=c++17", "-O1", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC")


def mirror_sources() -> list[Path]:
    """List every file that the mirror is made of."""
    return [
        HERE / "mirror.cpp",
        *sorted((HERE.parent / "csrc").glob("*.cuh")),
        *sorted(HERE.glob("mirror*.h")),
    ]


def build_mirror(folder: Path) -> Path:
    """Compile the mirror into a folder, unless the same sources were compiled there before.

    Args:
        folder: made if it is missing; one library per state of the sources is kept in it.

    Returns:
        The shared library.

    Raises:
        RuntimeError: no compiler, or the compiler's own words.
    """
    compiler = find_compiler()
    if compiler is None:
        raise RuntimeError(no_compiler())
    digest = hashlib.sha256(" ".join((*compiler, *FLAGS)).encode())
    for source in mirror_sources():
        digest.update(source.read_bytes())
    library = folder / f"pop_mirror_{digest.hexdigest()[:16]}.so"
    if library.exists():
        return library
    folder.mkdir(parents=True, exist_ok=True)
    # under a temporary name and then renamed, so that two test processes cannot load half a library
    partial = library.with_suffix(f".{os.getpid()}")
    command = [*compiler, *FLAGS, "-x", "c++", str(HERE / "mirror.cpp"), "-o", str(partial)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    partial.replace(library)
    return library
