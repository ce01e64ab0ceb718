"""Count the instructions of every kernel's loops in the machine code, with registers, shared memory and occupancy.

    python -m cuda_ext.machine_code.count_sass [--arch sm_80 sm_90] [--only blend] [--json out.json] [--notes NOTES.md]

Needs nvcc and nvdisasm, but no GPU. Exit status 1 when a file does not compile, 2 when a tool is missing.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cuda_ext.machine_code.check_ptxas import CSRC, KernelUse, compile_and_read, demangled, is_own
from cuda_ext.machine_code.sass import Code, Flow, Loop, find_loops, loop_line, outside_loops, parse_sass
from cuda_ext.toolkit import find_nvcc, nvcc_version

ARCHS = ("sm_80", "sm_90")
NO_NVCC = "nvcc was not found; install a CUDA toolkit or set CUDACXX"
NO_NVDISASM = (
    "nvdisasm was not found; install the extra that brings it, pip install 'pop-splatting[sass]', or a CUDA toolkit"
)
# what one warp does in one pass of a kernel's body, and threads a block
KERNELS = {
    "add_rows_kernel": ("Gaussian", 256),
    "begin_step_kernel": ("step", 32),
    "blend_forward_kernel": ("tile", 128),
    "buckets_kernel": ("32 tiles", 256),
    "bucket_counts_kernel": ("32 tiles", 256),
    "columns_kernel": ("tile", 64),
    "contributions_kernel": ("tile", 128),
    "count_important_kernel": ("32 Gaussians", 256),
    "count_kernel": ("32 Gaussians", 256),
    "depth_keys_kernel": ("32 Gaussians", 256),
    "emit_kernel": ("32 Gaussians", 256),
    "end_step_kernel": ("step", 256),
    "fill_tail_kernel": ("32 instances", 256),
    "gather_rows_kernel": ("32 floats", 256),
    "pack_kernel": ("32 Gaussians", 256),
    "pixels_kernel": ("128 pixels", 256),
    "points_kernel": ("tile", 128),
    "project_backward_kernel": ("32 Gaussians", 128),
    "project_kernel": ("32 Gaussians", 128),
    "ranges_kernel": ("32 instances", 256),
    "reset_opacities_kernel": ("32 Gaussians", 256),
    "slopes_kernel": ("tile", 128),
    "splat_gradients_kernel": ("32 Gaussians", 256),
    "splats_kernel": ("bucket", 128),
    "split_rows_kernel": ("32 Gaussians", 256),
    "sum_slots_kernel": ("4 Gaussians", 256),
    "tile_order_kernel": ("image", 512),
    "total_kernel": ("step", 1),
    "update_kernel": ("32 Gaussians", 128),
    "update_views_kernel": ("32 Gaussians", 128),
    "windows_kernel": ("128 pixels", 256),
}
# a comment at the end of a loop's line says what one iteration of a warp is, and how often it is passed where that is
# fixed: "// per record", "// per coefficient, 45 times"
_UNIT = re.compile(r"// per ([\w ]+?)(?:, (\d+) times)?$")
# one for every pixel of a lane's column, or for the one pixel of a step: tells how often a loop was unrolled
EXPONENTIALS = {"record": 4, "visit": 4, "step": 1}
# what unrolling multiplies, unlike counters and branches
_WORK = ("float", "special", "shared", "global")


@dataclass(frozen=True)
class Processor:
    """What a multiprocessor holds: warps, blocks, registers (allotted 256 to a warp at a time), shared memory."""

    warps: int
    blocks: int
    shared: int
    registers: int = 65536
    reserved: int = 1024


PROCESSORS = {"sm_80": Processor(64, 32, 164 << 10), "sm_90": Processor(64, 32, 228 << 10)}


def warps_per_processor(registers: int, shared: int, threads: int, processor: Processor) -> int:
    """Return how many warps of a kernel fit a multiprocessor at a time."""
    warps = -(-threads // 32)
    a_warp = -(-registers * 32 // 256) * 256
    # four schedulers with a quarter of the registers each
    by_registers = processor.registers // 4 // a_warp * 4 // warps
    by_shared = processor.shared // (shared + processor.reserved)
    return min(processor.blocks, processor.warps // warps, by_registers, by_shared) * warps


def find_nvdisasm() -> str | None:
    """Return the path of nvdisasm: the PATH, beside nvcc, or inside the package triton; or None."""
    nvcc = find_nvcc()
    candidates = [Path(shutil.which("nvdisasm") or "")]
    if nvcc is not None:
        candidates.append(Path(nvcc).resolve().parent / "nvdisasm")
    # looked up, not imported: triton is large, and only its folder is asked for
    package = importlib.util.find_spec("triton")
    for folder in (package.submodule_search_locations or []) if package is not None else []:
        candidates.append(Path(folder) / "backends" / "nvidia" / "bin" / "nvdisasm")
    found = (str(one) for one in candidates if one.is_file() and os.access(one, os.X_OK))
    return next(found, None)


def disassemble(nvdisasm: str, cubin: Path) -> list[Code]:
    """Disassemble one object with the source lines of every instruction.

    Raises:
        RuntimeError: it cannot be read; nvdisasm's words are in the message.
    """
    done = subprocess.run([nvdisasm, "-c", "-gi", str(cubin)], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"nvdisasm cannot read {cubin.name}:\n{done.stderr}")
    return parse_sass(done.stdout)


def _loop_entry(loop: Loop, sources: dict[str, list[str]]) -> dict[str, Any]:
    """Describe a loop as it stands in the machine code."""
    found = loop_line(loop, sources)
    file, _, text = found or ("", 0, "")
    unit = _UNIT.search(text)
    # without its number, which an edit elsewhere changes
    statement = text.split("//")[0].rstrip(" {")
    return {
        "per": unit.group(1) if unit else "",
        "times": int(unit.group(2)) if unit and unit.group(2) else None,
        "loop": f"{file}: {statement}" if found else "",
        "depth": loop.depth,
        "iterations": 1,
        "always": sum(loop.always.values()),
        "all": sum(loop.total.values()),
        "exponentials": loop.exponentials,
        "always_by_class": dict(sorted(loop.always.items())),
        "regions": [
            {"kind": r.kind, "instructions": sum(r.counts.values()), "by_class": dict(sorted(r.counts.items()))}
            for r in loop.regions
        ],
    }


def _set_iterations(loops: list[dict[str, Any]], places: list[Any]) -> None:
    """Find how many iterations an unrolled body holds: by its exponentials, or by the loop that does the rest.

    Args:
        loops: as described; their iterations are set.
        places: the source line of each.
    """

    def work(entry: dict[str, Any]) -> int:
        counts = [entry["always_by_class"], *(region["by_class"] for region in entry["regions"])]
        return sum(one.get(name, 0) for one in counts for name in _WORK)

    for entry, place in zip(loops, places, strict=True):
        twins = [work(other) for other, its in zip(loops, places, strict=True) if its == place and work(other) > 0]
        if entry["per"] in EXPONENTIALS and entry["exponentials"] > 0:
            entry["iterations"] = max(entry["exponentials"] // EXPONENTIALS[entry["per"]], 1)
        elif place is not None and len(twins) > 1:
            entry["iterations"] = round(work(entry) / min(twins))


def kernel_entry(code: Code, use: KernelUse, sources: dict[str, list[str]]) -> dict[str, Any]:
    """Describe one kernel on one architecture."""
    base = use.kernel.split("<")[0]
    if base not in KERNELS:
        raise RuntimeError(f"{use.file}: add {base} to count_sass.KERNELS, with its threads a block")
    unit, threads = KERNELS[base]
    flow = Flow(code)
    loops = find_loops(flow)
    straight = outside_loops(flow, loops)
    described = [_loop_entry(loop, sources) for loop in loops]
    _set_iterations(described, [loop_line(loop, sources) for loop in loops])
    return {
        "file": use.file,
        "kernel": use.kernel,
        "arch": use.arch,
        "registers": use.registers,
        "shared": use.shared,
        "spilled": use.spill_stores + use.spill_loads,
        "threads": threads,
        "warps": warps_per_processor(use.registers, use.shared, threads, PROCESSORS[use.arch]),
        "per": unit,
        "instructions": sum(flow.count(flow.blocks).values()),
        "outside_loops": sum(straight.values()),
        "by_class": dict(sorted(flow.count(flow.blocks).items())),
        "loops": described,
    }


def count_file(nvcc: str, nvdisasm: str, source: Path, arch: str, folder: Path) -> list[dict[str, Any]]:
    """Compile one file for one architecture and describe its own kernels; CUB's are left out."""
    uses = {use.kernel: use for use in compile_and_read(nvcc, source, arch, folder, "-cubin")}
    codes = [code for code in disassemble(nvdisasm, folder / f"{source.stem}.{arch}.o") if is_own(code.name)]
    sources = {path.name: path.read_text(encoding="utf-8").splitlines() for path in CSRC.iterdir()}
    names = demangled([code.name for code in codes])
    found = []
    for code, name in zip(codes, names, strict=True):
        use = uses[code.name]
        named = KernelUse(use.file, name, arch, use.registers, use.shared, use.stack, use.spill_stores, use.spill_loads)
        found.append(kernel_entry(code, named, sources))
    return sorted(found, key=lambda entry: entry["kernel"])


def count(nvcc: str, nvdisasm: str, archs: list[str], only: str = "", jobs: int = 1) -> dict[str, Any]:
    """Count all kernels for all architectures."""
    files = [source for source in sorted(CSRC.glob("*.cu")) if only in source.name]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        work = [(nvcc, nvdisasm, source, arch, Path(folder)) for arch in archs for source in files]
        kernels = [entry for found in pool.map(lambda args: count_file(*args), work) for entry in found]
    return {"nvcc": ".".join(map(str, nvcc_version(nvcc))), "kernels": kernels}


def as_json(found: dict[str, Any]) -> str:
    """Lay out the counts, one kernel a line, so that a change shows as the kernels that it changes."""
    kernels = ",\n".join(json.dumps(entry) for entry in found["kernels"])
    return f'{{"nvcc": {json.dumps(found["nvcc"])}, "kernels": [\n{kernels}\n]}}\n'


def _text_of(entry: dict[str, Any]) -> list[str]:
    """Lay out one kernel on the terminal."""
    head = f"{entry['kernel']} {entry['arch']}: {entry['registers']} registers, {entry['shared']} B shared, "
    head += f"{entry['warps']} warps; {entry['outside_loops']} instructions per {entry['per']} outside loops"
    lines = [head + (f", {entry['spilled']} B SPILLED" if entry["spilled"] else "")]
    for loop in entry["loops"]:
        regions = Counter((r["kind"], r["instructions"]) for r in loop["regions"])
        shown = ", ".join(f"{n} x {size} ({kind})" for (kind, size), n in regions.items())
        unit = f"per {loop['per']}: " if loop["per"] else ""
        classes = " ".join(f"{name} {n}" for name, n in loop["always_by_class"].items())
        unrolled = f", {loop['iterations']} iterations" if loop["iterations"] > 1 else ""
        indent = "  " * (loop["depth"] + 1)
        lines.append(f"{indent}{unit}{loop['always']} always [{classes}]; may skip {shown or 'nothing'}{unrolled}")
        lines.append(f"{indent}  {loop['loop']}")
    return lines


def main() -> int:
    """Run the script from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arch", nargs="+", default=list(ARCHS), choices=sorted(PROCESSORS), help="architectures")
    parser.add_argument("--only", default="", help="part of a file's name")
    parser.add_argument("--jobs", type=int, default=1, help="compilers at a time")
    parser.add_argument("--json", type=Path, help="where to write the counts")
    args = parser.parse_args()
    nvcc, nvdisasm = find_nvcc(), find_nvdisasm()
    if nvcc is None or nvdisasm is None:
        print(f"count_sass: {NO_NVCC if nvcc is None else NO_NVDISASM}", file=sys.stderr)
        return 2
    try:
        found = count(nvcc, nvdisasm, args.arch, args.only, args.jobs)
    except RuntimeError as error:
        print(f"count_sass: {error}", file=sys.stderr)
        return 1
    print("\n".join(line for entry in found["kernels"] for line in _text_of(entry)))
    if args.json:
        args.json.write_text(as_json(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
