"""Compile every kernel for the given architectures and read what ptxas says: registers, shared memory, spills.

    python -m cuda_ext.machine_code.check_ptxas [--arch sm_75 sm_80 sm_90] [--json out.json]

Exit status 1 when a blend kernel spills or a file does not compile, 2 when there is no nvcc. No GPU is needed.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from cuda_ext.toolkit import NVCC_FLAGS, find_nvcc

CSRC = Path(__file__).resolve().parents[1] / "csrc"
# in these a spill costs at every (splat, pixel) pair; elsewhere it costs once a Gaussian
MUST_NOT_SPILL = ("blend_forward_kernel", "columns_kernel", "splats_kernel")

_COMPILING = re.compile(r"Compiling entry function '(\w+)' for '(\w+)'")
_SPILLS = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads")
_USED = re.compile(r"Used (\d+) registers")
_SHARED = re.compile(r"(\d+) bytes smem")


@dataclass(frozen=True)
class KernelUse:
    """What ptxas says of one kernel on one architecture."""

    file: str  # source file
    kernel: str  # name with template arguments, demangled where c++filt is found
    arch: str  # for example sm_90
    registers: int  # per thread
    shared: int  # static shared memory, bytes
    stack: int  # frame, bytes
    # bytes
    spill_stores: int
    spill_loads: int

    @property
    def spills(self) -> bool:
        """Tell whether registers went to memory."""
        return self.spill_stores > 0 or self.spill_loads > 0


def parse_ptxas(file: str, text: str) -> list[KernelUse]:
    """Read the verbose output of ptxas."""
    found: list[KernelUse] = []
    name, arch, frame = "", "", (0, 0, 0)
    for line in text.splitlines():
        if match := _COMPILING.search(line):
            name, arch = match.groups()
        elif match := _SPILLS.search(line):
            stack, stores, loads = match.groups()
            frame = int(stack), int(stores), int(loads)
        elif (match := _USED.search(line)) and name:
            shared = _SHARED.search(line)
            used = int(match.group(1)), int(shared.group(1)) if shared else 0
            found.append(KernelUse(file, name, arch, *used, *frame))
            name = ""
    return found


def demangled(names: list[str]) -> list[str]:
    """Return readable names, or the names as they are where c++filt is missing."""
    tool = shutil.which("c++filt")
    if tool is None or not names:
        return names
    done = subprocess.run([tool], input="\n".join(names), capture_output=True, text=True, check=True)
    short = [re.sub(r"\(anonymous namespace\)::|pop::|void ", "", line) for line in done.stdout.splitlines()]
    return [re.sub(r"\(.*", "", re.sub(r"\((?:int|bool|Collect)\)", "", line)) for line in short]


def is_own(mangled: str) -> bool:
    """Tell our own kernels from CUB's, which may name our types among their parameters."""
    return mangled.startswith("_ZN3pop")


def compile_and_read(nvcc: str, source: Path, arch: str, folder: Path, output: str = "-c") -> list[KernelUse]:
    """Compile one file for one architecture; `output` is nvcc's flag, "-cubin" for the device's code alone.

    Raises:
        RuntimeError: it does not compile; nvcc's words are in the message.
    """
    target = folder / f"{source.stem}.{arch}.o"
    command = [nvcc, *NVCC_FLAGS, f"-arch={arch}", "-Xptxas", "-v", output, str(source), "-o", str(target)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{source.name} does not compile for {arch}:\n{done.stderr}")
    return parse_ptxas(source.name, done.stderr)


def check(archs: list[str], jobs: int = 1, only: str = "") -> list[KernelUse]:
    """Compile all kernels for all architectures; leave out the kernels that belong to CUB.

    Raises:
        RuntimeError: a file does not compile, or there is no nvcc.
    """
    nvcc = find_nvcc()
    if nvcc is None:
        raise RuntimeError("nvcc was not found; install a CUDA toolkit or set CUDACXX")
    sources = [source for source in sorted(CSRC.glob("*.cu")) if only in source.name]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        work = [(nvcc, source, arch, Path(folder)) for arch in archs for source in sources]
        uses = [use for found in pool.map(lambda args: compile_and_read(*args), work) for use in found]
    own = [use for use in uses if is_own(use.kernel)]
    names = demangled([use.kernel for use in own])
    return [replace(use, kernel=name) for use, name in zip(own, names, strict=True)]


def offenders(uses: list[KernelUse]) -> list[KernelUse]:
    """Return the blend kernels that spill."""
    return [use for use in uses if use.spills and use.kernel.startswith(MUST_NOT_SPILL)]


def as_table(uses: list[KernelUse]) -> str:
    """Lay out one line a kernel, one column an architecture: registers, and spilled bytes where there are any."""
    archs = sorted({use.arch for use in uses})
    cells = {(use.kernel, use.arch): use for use in uses}
    lines = [f"{'kernel':58s}" + "".join(f"{arch:>18s}" for arch in archs)]
    for kernel in sorted({use.kernel for use in uses}):
        line = f"{kernel:58s}"
        for arch in archs:
            use = cells.get((kernel, arch))
            text = "" if use is None else f"{use.registers} reg"
            if use is not None and use.spills:
                text += f" {use.spill_stores}+{use.spill_loads} B!"
            line += f"{text:>18s}"
        lines.append(line)
    return "\n".join(lines)


def main() -> int:
    """Run the check from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arch", nargs="+", default=["sm_75", "sm_80", "sm_90"], help="architectures")
    parser.add_argument("--jobs", type=int, default=1, help="compilers at a time")
    parser.add_argument("--only", default="", help="part of a file's name")
    parser.add_argument("--json", type=Path, help="where to write the table as JSON")
    args = parser.parse_args()
    if find_nvcc() is None:
        print("check_ptxas: nvcc was not found; install a CUDA toolkit or set CUDACXX", file=sys.stderr)
        return 2
    try:
        uses = check(args.arch, args.jobs, args.only)
    except RuntimeError as error:
        print(f"check_ptxas: {error}", file=sys.stderr)
        return 1
    print(as_table(uses))
    if args.json:
        args.json.write_text(json.dumps([asdict(use) for use in uses], indent=1) + "\n")
    bad = offenders(uses)
    for use in bad:
        print(f"check_ptxas: {use.kernel} spills on {use.arch}", file=sys.stderr)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
