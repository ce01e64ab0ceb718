"""Count the instructions of every kernel's loops in the machine code, with registers, shared memory and occupancy.

    python -m cuda_ext.machine_code.count_sass [--arch sm_80 sm_90] [--only blend] [--json out.json]

Needs nvcc and nvdisasm, but no GPU. Exit status 1 when a file does not compile, 2 when a tool is missing.

A loop is a natural loop of the control flow graph of what nvdisasm prints. Of its instructions outside inner loops,
those in blocks that every iteration passes are `always`; the rest form regions, one for each place where a warp may
jump over something. A region is issued when any lane of the warp takes it, so that what an iteration costs lies between
`always` and all of it. Paths that only a diverged warp takes (BRA.DIV, BRA.CONV) are left out.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cuda_ext.machine_code.check_ptxas import CSRC, KernelUse, compile_and_read, demangled, is_own
from cuda_ext.toolkit import find_nvcc, nvcc_version

ARCHS = ("sm_80", "sm_90")
NO_NVCC = "nvcc was not found; install a CUDA toolkit or set CUDACXX"
NO_NVDISASM = (
    "nvdisasm was not found; install the extra that brings it, pip install 'pop-splatting[sass]', or a CUDA toolkit"
)
# what one warp does in one pass of a kernel's body, and threads a block, with the kernels of which this is so
_PASSES = {
    ("Gaussian", 256): "add_rows",
    ("step", 32): "begin_step",
    ("tile", 128): "blend_forward contributions points slopes",
    ("32 tiles", 256): "buckets bucket_counts",
    ("tile", 64): "columns",
    ("32 Gaussians", 256): "count_important count depth_keys emit pack splat_gradients",
    ("step", 256): "end_step",
    ("32 instances", 256): "fill_tail ranges",
    ("128 pixels", 256): "pixels windows",
    ("32 Gaussians", 128): "project_backward project update update_views",
    ("bucket", 128): "splats",
    ("4 Gaussians", 256): "sum_slots",
    ("image", 512): "tile_order",
    ("step", 1): "total",
}
KERNELS = {f"{name}_kernel": of for of, names in _PASSES.items() for name in names.split()}
# a comment at the end of a loop's line says what one iteration of a warp is, and how often it is passed where that is
# fixed: "// per record", "// per coefficient, 45 times"
_UNIT = re.compile(r"// per ([\w ]+?)(?:, (\d+) times)?$")
# one for every pixel of a lane's column, or for the one pixel of a step: tells how often a loop was unrolled
EXPONENTIALS = {"record": 4, "visit": 4, "step": 1}
# what unrolling multiplies, unlike counters and branches
_WORK = ("float", "special", "shared", "global")
Frame = tuple[str, int]
_SECTION = re.compile(r"^\s*\.section\s+\.text\.(\w+)")
_LABEL = re.compile(r"^(\.L_[\w.]+|\$[\w$.]+):")
_FRAME = re.compile(r'//## File "([^"]+)", line (\d+)')
_INSTRUCTION = re.compile(r"^\s*/\*([0-9a-f]+)\*/\s+(?:@(!?U?P\w+)\s+)?([A-Z][\w.]*)\s*(.*?)\s*;")
_TARGET = re.compile(r"`\((\.L_[\w.]+)\)")
# opcodes by their beginnings; the first class that fits
_CLASSES = {
    "uniform": "U",
    "float": "FADD FMUL FFMA",
    "special": "MUFU",
    "compare": "FSETP FSET FSEL FMNMX FCHK ISETP IMNMX VIMNMX VIADDMNMX SEL PLOP P2R",
    "shuffle": "SHFL",
    "vote": "VOTE MATCH REDUX CREDUX",
    "shared": "LDS STS ATOMS",
    "constant": "LDC",
    "global": "LDG STG RED ATOM LD ST CCTL",
    "multiply": "IMAD IDP",
    "integer": "IADD VIADD LOP SHF LEA IABS POPC FLO BREV SGXT BMSK ISCADD PRMT",
    "convert": "I2F F2I F2F FRND I2I",
    "double": "DADD DMUL DFMA DSETP",
    "branch": "BRA BSSY BSYNC BREAK EXIT CALL RET BRX JMP WARPSYNC YIELD NANOSLEEP",
    "move": "MOV CS2R S2R S2UR R2UR HFMA2 R2P",
    "barrier": "BAR MEMBAR ERRBAR DEPBAR",
}
CLASSES = (*_CLASSES, "other")


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
    """Return the path of nvdisasm: the PATH, next to nvcc, or inside the package triton; or None."""
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
    pairs = zip(codes, names, strict=True)
    found = [kernel_entry(code, replace(uses[code.name], kernel=name, arch=arch), sources) for code, name in pairs]
    return sorted(found, key=lambda entry: entry["kernel"])


def count(nvcc: str, nvdisasm: str, archs: list[str], only: str = "", jobs: int = 1) -> dict[str, Any]:
    """Count all kernels for all architectures."""
    files = [source for source in sorted(CSRC.glob("*.cu")) if only in source.name]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        work = [(nvcc, nvdisasm, source, arch, Path(folder)) for arch in archs for source in files]
        kernels = [entry for found in pool.map(lambda args: count_file(*args), work) for entry in found]
    return {"nvcc": ".".join(map(str, nvcc_version(nvcc))), "sources": sources(), "kernels": kernels}


def sources() -> dict[str, str]:
    """Return the digest of every file of the kernels, by which it can be told what has changed since a count."""
    found = (path for path in CSRC.iterdir() if path.suffix in (".cu", ".cuh", ".h"))
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in sorted(found)}


def as_json(found: dict[str, Any]) -> str:
    """Lay out the counts, one kernel a line, so that a change shows as the kernels that it changes."""
    kernels = ",\n".join(json.dumps(entry) for entry in found["kernels"])
    head = json.dumps({name: value for name, value in found.items() if name != "kernels"})
    return f'{head[:-1]}, "kernels": [\n{kernels}\n]}}\n'


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


def class_of(opcode: str) -> str:
    """Return the class of an opcode; a move written as IMAD counts with IMAD, whose unit it takes."""
    for name, prefixes in _CLASSES.items():
        if opcode.startswith(tuple(prefixes.split())):
            return name
    return "other"


@dataclass(frozen=True)
class Instruction:
    """One instruction."""

    address: int  # bytes from the kernel's begin
    predicate: str  # for example "P0" or "!P0", "" where it is always executed
    opcode: str  # with modifiers
    operands: str  # as printed
    frames: tuple[Frame, ...] = ()  # source lines, innermost first, the kernel's own last

    @property
    def target(self) -> str:
        """Return the label that it jumps to, or ""."""
        match = _TARGET.search(self.operands)
        jumps = self.opcode.startswith(("BRA", "CALL"))
        return match.group(1) if match and jumps else ""


@dataclass
class Code:
    """A kernel's instructions, and where labels stand among them."""

    name: str
    instructions: list[Instruction] = field(default_factory=list)
    labels: dict[str, int] = field(default_factory=dict)


def parse_sass(text: str) -> list[Code]:
    """Read the kernels of `nvdisasm -c -gi`."""
    found: list[Code] = []
    frames: list[Frame] = []
    in_frames = False
    for line in text.splitlines():
        if match := _SECTION.match(line):
            found.append(Code(match.group(1)))
            frames, in_frames = [], False
        elif not found:
            continue
        elif match := _FRAME.search(line):
            # consecutive lines are one stack, innermost first
            frames = frames if in_frames else []
            frames.append((match.group(1).rsplit("/", 1)[-1], int(match.group(2))))
            in_frames = True
        elif match := _LABEL.match(line):
            found[-1].labels[match.group(1)] = len(found[-1].instructions)
        elif match := _INSTRUCTION.match(line):
            address, predicate, opcode, operands = match.groups()
            found[-1].instructions.append(
                Instruction(int(address, 16), predicate or "", opcode, operands, tuple(frames))
            )
            in_frames = False
    return found


def _successors(code: Code, index: int) -> list[int]:
    """Return where a converged warp may go after an instruction."""
    this, after = code.instructions[index], index + 1
    to = code.labels.get(this.target)
    last = after >= len(code.instructions)
    if this.opcode.startswith("BRA.DIV"):
        return [after]
    if this.opcode.startswith("BRA.CONV") and to is not None:
        return [to]
    if to is not None:
        return [to] if not this.predicate else [after, to]
    if this.opcode.startswith(("EXIT", "RET")):
        return [after] if this.predicate and not last else []
    return [] if last else [after]


class Flow:
    """Basic blocks of a kernel that a converged warp can reach, their successors and dominators.

    Attributes:
        blocks: first instruction -> one behind the last.
        after: successors by first instruction.
        dominators: blocks on every path from the entry to a block, itself among them.
    """

    def __init__(self, code: Code) -> None:
        self.code = code
        leads = {0}
        for k in range(len(code.instructions)):
            next_ones = _successors(code, k)
            if next_ones != [k + 1]:
                leads.update((*next_ones, k + 1))
        leads.update(code.labels.values())
        order = sorted(lead for lead in leads if lead < len(code.instructions))
        ends = dict(zip(order, [*order[1:], len(code.instructions)], strict=True))
        self.blocks: dict[int, int] = {}
        self.after: dict[int, list[int]] = {}
        waiting = [0]
        while waiting:
            block = waiting.pop()
            if block in self.blocks:
                continue
            self.blocks[block] = ends[block]
            self.after[block] = _successors(code, ends[block] - 1)
            waiting += self.after[block]
        self.before: dict[int, set[int]] = {block: set() for block in self.blocks}
        for block, to in self.after.items():
            for one in to:
                self.before[one].add(block)
        self.dominators = self._dominators()

    def _dominators(self) -> dict[int, set[int]]:
        found = {block: set(self.blocks) for block in self.blocks}
        found[0] = {0}
        changed = True
        while changed:
            changed = False
            for block in sorted(self.blocks):
                if block == 0:
                    continue
                common = set.intersection(*(found[one] for one in self.before[block])) | {block}
                if common != found[block]:
                    found[block], changed = common, True
        return found

    def count(self, blocks: Iterable[int]) -> Counter[str]:
        """Count a set of blocks by class; NOP issues nothing that is waited for and is left out."""
        return Counter(class_of(one.opcode) for one in self.listed(blocks) if one.opcode != "NOP")

    def listed(self, blocks: Iterable[int]) -> list[Instruction]:
        """Return the instructions of a set of blocks in order."""
        return [one for block in sorted(blocks) for one in self.code.instructions[block : self.blocks[block]]]


@dataclass
class Region:
    """Instructions that a warp may jump over, by class."""

    kind: str
    counts: Counter[str]


@dataclass
class Loop:
    """One loop."""

    header: int  # its first block
    blocks: set[int]  # all of its blocks, inner loops among them
    depth: int = 0  # loops around it
    # source lines of its backward branch, innermost first, then those of its other instructions
    frames: list[Frame] = field(default_factory=list)
    always: Counter[str] = field(default_factory=Counter)  # what every iteration issues, by class
    regions: list[Region] = field(default_factory=list)  # what an iteration may jump over
    exponentials: int = 0  # how many exp2 it holds, for a lane

    @property
    def total(self) -> Counter[str]:
        """Return what an iteration issues that jumps over nothing, by class."""
        return sum((region.counts for region in self.regions), Counter(self.always))


def _kind(instructions: list[Instruction]) -> str:
    """Name a region by what only it is there for."""
    opcodes = [one.opcode for one in instructions]
    kinds = {"exponential": "MUFU.EX2", "reduce": "SHFL", "store": ("STG", "RED", "ATOM"), "look": "VOTE"}
    for kind, prefix in kinds.items():
        if any(opcode.startswith(prefix) for opcode in opcodes):
            return kind
    return "other"


def _regions(flow: Flow, blocks: set[int]) -> list[Region]:
    """Split blocks into parts that no edge connects."""
    left, found = set(blocks), []
    while left:
        part, waiting = set(), [min(left)]
        while waiting:
            block = waiting.pop()
            if block not in left:
                continue
            left.discard(block)
            part.add(block)
            waiting += [*flow.after[block], *flow.before[block]]
        found.append(Region(_kind(flow.listed(part)), flow.count(part)))
    return found


def find_loops(flow: Flow) -> list[Loop]:
    """Find the natural loops, outer before inner; loops of one header are one."""
    latches: dict[int, set[int]] = {}
    for block, to in flow.after.items():
        for header in to:
            if header in flow.dominators[block]:
                latches.setdefault(header, set()).add(block)
    loops = []
    for header, ends in sorted(latches.items()):
        blocks, waiting = {header}, list(ends)
        while waiting:
            block = waiting.pop()
            if block not in blocks:
                blocks.add(block)
                waiting += flow.before[block]
        loops.append(Loop(header, blocks))
    for loop in loops:
        loop.depth = sum(loop.header in other.blocks for other in loops) - 1
        inner = set[int]().union(*(o.blocks for o in loops if o.header in loop.blocks and o.header != loop.header))
        own = loop.blocks - inner
        ends = latches[loop.header]
        passed = {block for block in own if all(block in flow.dominators[end] for end in ends)}
        loop.always = flow.count(passed)
        loop.regions = _regions(flow, own - passed)
        loop.exponentials = sum(one.opcode.startswith("MUFU.EX2") for one in flow.listed(own))
        last = flow.listed({max(ends)})
        loop.frames = [frame for one in (*reversed(last), *flow.listed(own)) for frame in one.frames]
    return loops


def outside_loops(flow: Flow, loops: list[Loop]) -> Counter[str]:
    """Count what a warp issues outside all loops if it jumps over nothing."""
    return flow.count(set(flow.blocks) - set[int]().union(*(loop.blocks for loop in loops)))


def loop_line(loop: Loop, sources: Mapping[str, list[str]]) -> tuple[str, int, str] | None:
    """Find the statement that a loop was written as: file, line and text, by the first frame that shows one."""
    for file, line in loop.frames:
        lines = sources.get(file, [])
        text = lines[line - 1].strip() if 0 < line <= len(lines) else ""
        if re.search(r"\b(for|while) ?\(", text):
            return file, line, text
    return None


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
