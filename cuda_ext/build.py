"""Build the CUDA extension, when asked: CMake, nvcc and nanobind, into this package's folder.

    python -m cuda_ext.build [--arch sm_90] [--jobs 2]

No torch is linked, so the module works with any torch; the Python ABI is the stable one where nanobind offers it
(Python 3.12 and newer).
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from cuda_ext.toolkit import OLDEST, find_nvcc, link_flags, nvcc_version
from pop_fast.children import SAFE_PATH

HERE = Path(__file__).resolve().parent
INSTALL = "`pip install 'pop-splatting[cuda-build]'` (from a clone: pip install -e '.[cuda-build]')"
DEFAULT_ARCHS = ("sm_75", "sm_80", "sm_90")


class BuildError(RuntimeError):
    """Something that the build needs is missing, or a compiler failed; the message says what to do."""


def build(
    arch: str | list[str] | None = None, jobs: int = 2, folder: Path | None = None, verbose: bool = False
) -> Path:
    """Compile the kernels and put the module next to this file.

    Args:
        arch: for example "sm_90" or ["sm_80", "sm_90"]; None takes this machine's GPU, or 75, 80 and 90 without one.
        jobs: compilers at a time.
        folder: where CMake works; None takes `build/` in this package.
        verbose: show the compilers' commands.

    Returns:
        The module's file.

    Raises:
        BuildError: nvcc, CMake or nanobind is missing, nvcc does not know the architecture, `jobs` is under 1, or a
            step failed.
    """
    if jobs < 1:
        raise BuildError(f"jobs is {jobs}; it must be at least 1")
    nvcc, cmake = tools()
    archs = _architectures(arch, nvcc)
    work = folder or HERE / "build"
    configure = [
        cmake,
        *("-S", str(HERE), "-B", str(work)),
        f"-DCMAKE_CUDA_COMPILER={nvcc}",
        f"-DCMAKE_CUDA_ARCHITECTURES={';'.join(archs)}",
        f"-DPython_EXECUTABLE={sys.executable}",
        f"-DCMAKE_INSTALL_PREFIX={HERE}",
        f"-DCMAKE_CUDA_FLAGS={' '.join(link_flags(nvcc))}",
    ]
    ninja = _program("ninja")
    if ninja is not None:
        configure += ["-G", "Ninja", f"-DCMAKE_MAKE_PROGRAM={ninja}"]
    try:
        _run("configuring", configure)
    except BuildError:
        # a half-configured folder would fail in another way next time
        (work / "CMakeCache.txt").unlink(missing_ok=True)
        shutil.rmtree(work / "CMakeFiles", ignore_errors=True)
        raise
    _run("compiling", [cmake, "--build", str(work), "--parallel", str(jobs), *(["--verbose"] if verbose else [])])
    _run("installing", [cmake, "--install", str(work)])
    found = sorted(HERE.glob("_kernels*.so"), key=lambda path: path.stat().st_mtime)
    if not found:
        raise BuildError(f"the build finished but left no module in {HERE}; look into {work}")
    return found[-1]


def tools() -> tuple[str, str]:
    """Find nvcc and cmake, and see that nanobind is here.

    Raises:
        BuildError: one of the three is missing; says how to get it.
    """
    nvcc = find_nvcc()
    if nvcc is None:
        raise BuildError(
            "nvcc was not found; install a CUDA toolkit (12 or newer), or `pip install nvidia-cuda-nvcc nvidia-nvvm "
            "nvidia-cuda-crt nvidia-cuda-runtime nvidia-cuda-cccl` (all of one version), or set CUDACXX to nvcc's path"
        )
    cmake = _program("cmake")
    if cmake is None:
        raise BuildError(f"cmake was not found; {INSTALL}")
    if importlib.util.find_spec("nanobind") is None:
        raise BuildError(f"nanobind was not found; {INSTALL}")
    return nvcc, cmake


def _program(name: str) -> str | None:
    """Find a program next to this Python, where pip puts it, or on the PATH."""
    return shutil.which(name, path=os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", ""))))


def _architectures(arch: str | list[str] | None, nvcc: str) -> list[str]:
    """Return CMake's architecture list: machine code for each, and PTX of the newest for cards to come."""
    asked = [arch] if isinstance(arch, str) else list(arch or _of_this_machine() or DEFAULT_ARCHS)
    numbers: list[int] = []
    for name in asked:
        match = re.fullmatch(r"(?:sm_|compute_)?(\d{2,3})", name)
        if match is None:
            raise BuildError(f"arch is {name!r}; write it like sm_90")
        numbers.append(int(match.group(1)))
    try:
        oldest, version = min(numbers), nvcc_version(nvcc)
    except (RuntimeError, OSError) as error:
        raise BuildError(f"{error}; set CUDACXX to the path of an nvcc that works") from error
    if oldest < OLDEST:
        raise BuildError(f"sm_{oldest} is too old: the kernels are written for sm_{OLDEST} and newer")
    newest = max(numbers)
    if version < (12, 0) or (newest >= 100 and version < (12, 8)):
        raise BuildError(f"nvcc {version[0]}.{version[1]} does not know sm_{newest}; install a newer CUDA toolkit")
    ordered = sorted(set(numbers))
    return [*(f"{number}-real" for number in ordered[:-1]), str(ordered[-1])]


def _of_this_machine() -> list[str]:
    """Ask torch which GPUs are here; none where torch or a GPU is missing."""
    if importlib.util.find_spec("torch") is None:
        return []
    import torch

    if not torch.cuda.is_available():
        return []
    pairs = {torch.cuda.get_device_capability(k) for k in range(torch.cuda.device_count())}
    return [f"sm_{major}{minor}" for major, minor in sorted(pairs)]


def _run(doing: str, command: list[str]) -> None:
    # CMake asks Python where things are
    environment = {**os.environ, **SAFE_PATH, "CLICOLOR": "0"}
    done = subprocess.run(command, text=True, capture_output=True, check=False, env=environment)
    if done.returncode != 0:
        tail = "\n".join((done.stdout + done.stderr).splitlines()[-40:])
        raise BuildError(f"{doing} the CUDA extension failed; {' '.join(command)} said:\n{tail}")


def main() -> int:
    """Build from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arch", nargs="+", help="for example sm_90; default: this machine's GPU")
    parser.add_argument("--jobs", type=int, default=2, help="compilers at a time")
    parser.add_argument("--verbose", action="store_true", help="show the compilers' commands")
    args = parser.parse_args()
    try:
        module = build(args.arch, args.jobs, verbose=args.verbose)
    except BuildError as error:
        print(f"pop: error: {error}", file=sys.stderr)
        return 2
    print(module)
    return 0


if __name__ == "__main__":
    sys.exit(main())
