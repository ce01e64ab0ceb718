"""Where compilers are: nvcc, of the toolkit on this machine or of NVIDIA's pip wheels, and a C++ compiler."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sysconfig
from pathlib import Path

NVCC_FLAGS = ("-std=c++17", "-O3", "--expt-relaxed-constexpr", "-lineinfo")
# Turing is the oldest that CUDA 13 compiles for; older cards need a 12.x toolkit
OLDEST = 75


def _candidates() -> list[Path]:
    """List where nvcc may be: CUDACXX, CUDA_HOME, the PATH, the usual place, the wheels of pip."""
    homes = (os.environ.get(name) for name in ("CUDA_HOME", "CUDA_PATH"))
    named = (os.environ.get("CUDACXX"), *(f"{home}/bin/nvcc" for home in homes if home), shutil.which("nvcc"))
    found = [Path(path) for path in (*named, "/usr/local/cuda/bin/nvcc") if path]
    packages = Path(sysconfig.get_paths()["purelib"]) / "nvidia"
    # nvidia-cuda-nvcc (13 and newer) shares one folder, nvidia-cuda-nvcc-cu12 has its own
    return [*found, *sorted(packages.glob("cu*/bin/nvcc")), packages / "cuda_nvcc" / "bin" / "nvcc"]


def find_nvcc() -> str | None:
    """Return the path of nvcc, or None."""
    return next((str(one) for one in _candidates() if one.is_file() and os.access(one, os.X_OK)), None)


def nvcc_version(nvcc: str) -> tuple[int, int]:
    """Ask nvcc for its version.

    Raises:
        RuntimeError: it does not answer as nvcc does.
    """
    done = subprocess.run([nvcc, "--version"], capture_output=True, text=True, check=False)
    match = re.search(r"release (\d+)\.(\d+)", done.stdout)
    if match is None:
        raise RuntimeError(f"{nvcc} --version did not answer: {done.stdout or done.stderr}")
    return int(match.group(1)), int(match.group(2))


def link_flags(nvcc: str) -> list[str]:
    """Return the options by which nvcc finds its own runtime: the wheels keep it in lib, nvcc looks into lib64."""
    root = Path(nvcc).resolve().parent.parent
    here, usual = root / "lib" / "libcudart_static.a", root / "lib64" / "libcudart_static.a"
    return [f"-L{here.parent}"] if here.exists() and not usual.exists() else []


def find_compiler() -> list[str] | None:
    """Return the command of a C++17 compiler: what CXX says where it is set, else g++, clang++ or c++; None without."""
    try:
        given = shlex.split(os.environ.get("CXX", ""))
    except ValueError:  # a quotation that nothing closes
        return None
    for command in [given] if given else [["g++"], ["clang++"], ["c++"]]:
        found = shutil.which(command[0])
        if found:
            return [found, *command[1:]]
    return None


def no_compiler() -> str:
    """Return one sentence on why `find_compiler` found none and what to do."""
    given = os.environ.get("CXX", "").strip()
    if given:
        return f"CXX is {given!r}, which is not on this machine; set it to a C++ compiler's path, or unset it"
    return "no C++ compiler was found; install g++ or clang++, or set CXX to one's path"
