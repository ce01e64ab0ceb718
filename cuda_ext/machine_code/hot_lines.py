"""Lay the samples of a profiled kernel on the lines of its source: where its warps wait, and for what.

    python -m cuda_ext.machine_code.hot_lines lines.csv.gz                        the kernels that are in it
    python -m cuda_ext.machine_code.hot_lines lines.csv.gz --kernel update_kernel [--most 30]

`lines.csv.gz` is what `benchmarks/gpu_counters.py --lines` brings back: samples of every machine instruction. The same
source is compiled here by the same flags, and its instructions are compared with the profiled ones: where they differ,
the source is not the one that was profiled, and nothing is said.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from cuda_ext.machine_code.check_ptxas import CSRC, compile_and_read, is_own
from cuda_ext.machine_code.count_sass import NO_NVCC, NO_NVDISASM, Code, Instruction, disassemble, find_nvdisasm
from cuda_ext.toolkit import find_nvcc

SAMPLES, EXECUTED = "# Samples", "Instructions Executed"
STALL, NOT_ISSUED = "stall_", "(Not Issued)"


class Profiled(NamedTuple):
    """An instruction as it was profiled: opcode, samples, how often it was executed, samples by reason."""

    opcode: str
    samples: int
    executed: int
    stalls: Counter[str]


@dataclass
class Line:
    """What the instructions of a line of the source have together."""

    samples: int = 0
    executed: int = 0
    stalls: Counter[str] = field(default_factory=Counter)


def read_profile(lines: Iterable[str]) -> dict[str, list[Profiled]]:
    """Read the instructions of ncu's page of sources, by the kernels' names.

    Raises:
        ValueError: it is no such page.
    """
    csv.field_size_limit(sys.maxsize)
    found: dict[str, list[Profiled]] = {}
    head: list[str] = []
    this: list[Profiled] | None = None
    for row in csv.reader(lines):
        if row[:1] == ["Kernel Name"]:
            # ncu prints some tables twice; of several launches of a kernel the last stands
            this = found[row[1]] = []
        elif row[:1] == ["Address"]:
            head = row
        elif this is not None and head and len(row) == len(head):
            entry = dict(zip(head, row, strict=True))
            reasons = {name: int(n) for name, n in entry.items() if name.startswith(STALL) and NOT_ISSUED not in name}
            stalls = Counter({name.removeprefix(STALL): n for name, n in reasons.items() if n})
            this.append(Profiled(opcode_of(entry["Source"]), int(entry[SAMPLES]), int(entry[EXECUTED]), stalls))
    if not any(found.values()):
        raise ValueError("there is no instruction in it; it must be ncu's --page source --csv")
    return found


def opcode_of(source: str) -> str:
    """Return an instruction's opcode without its predicate."""
    words = source.split()
    return words[1] if words and words[0].startswith("@") else words[0] if words else ""


def by_line(profiled: list[Profiled], instructions: list[Instruction]) -> dict[tuple[str, int], Line]:
    """Add the samples up by the innermost line of the source.

    Raises:
        ValueError: these are not the instructions that were profiled.
    """
    differ = [one.opcode != was.opcode for one, was in zip(instructions, profiled, strict=False)]
    if len(instructions) != len(profiled) or any(differ):
        raise ValueError(
            f"{len(instructions)} instructions are compiled here, {len(profiled)} were profiled, and number "
            f"{differ.index(True) if any(differ) else 0} differs; check out the commit that was profiled, and use its "
            "nvcc"
        )
    found: dict[tuple[str, int], Line] = defaultdict(Line)
    for instruction, was in zip(instructions, profiled, strict=True):
        line = found[instruction.frames[0] if instruction.frames else ("?", 0)]
        line.samples += was.samples
        line.executed += was.executed
        line.stalls += was.stalls
    return dict(found)


def compiled_kernels(nvcc: str, nvdisasm: str, arch: str) -> list[Code]:
    """Compile all kernels for one architecture and disassemble them."""
    found: list[Code] = []
    with tempfile.TemporaryDirectory() as folder:
        for source in sorted(CSRC.glob("*.cu")):
            compile_and_read(nvcc, source, arch, Path(folder), "-cubin")
            found += disassemble(nvdisasm, Path(folder) / f"{source.stem}.{arch}.o")
    return [code for code in found if is_own(code.name)]


def table(lines: dict[tuple[str, int], Line], most: int) -> list[str]:
    """Lay out the lines with the most samples."""
    samples = max(sum(line.samples for line in lines.values()), 1)
    executed = max(sum(line.executed for line in lines.values()), 1)
    told = ["samples  instructions  line, and what warps waited for there"]
    for (file, number), line in sorted(lines.items(), key=lambda item: -item[1].samples)[:most]:
        waits = ", ".join(f"{name} {n}" for name, n in line.stalls.most_common(3))
        shares = f"{100 * line.samples / samples:6.1f}%  {100 * line.executed / executed:11.1f}%"
        told.append(f"{shares}  {file}:{number}  {waits}")
    return told


def _laid_on_lines(profile: dict[str, list[Profiled]], part: str, arch: str, most: int) -> list[str]:
    names = [name for name in profile if part in name]
    if len(names) != 1:
        raise ValueError(f"{len(names)} kernels have {part!r} in their names; without --kernel they are listed")
    nvcc, nvdisasm = find_nvcc(), find_nvdisasm()
    if nvcc is None or nvdisasm is None:
        raise ValueError(NO_NVCC if nvcc is None else NO_NVDISASM)
    profiled, codes = profile[names[0]], compiled_kernels(nvcc, nvdisasm, arch)
    # instantiations have names of their own there: the instructions say which one it is
    opcodes = [one.opcode for one in profiled]
    twins = [code for code in codes if [one.opcode for one in code.instructions] == opcodes]
    nearest = min(codes, key=lambda code: abs(len(code.instructions) - len(opcodes)))
    return [names[0], *table(by_line(profiled, (twins or [nearest])[0].instructions), most)]


def main(words: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="hot_lines", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("profile", type=Path, help="lines.csv.gz, or the same unpacked")
    parser.add_argument("--kernel", help="a part of the kernel's name that no other has")
    parser.add_argument("--arch", default="sm_90", help="what it was profiled on; default sm_90")
    parser.add_argument("--most", type=int, default=30, help="lines that are shown; default 30")
    args = parser.parse_args(words)
    opened = gzip.open if args.profile.suffix == ".gz" else open
    try:
        with opened(args.profile, "rt", encoding="utf-8") as file:
            profile = read_profile(file)
        if args.kernel is None:
            told = [f"{sum(one.samples for one in kernel):9,} samples  {name}" for name, kernel in profile.items()]
        else:
            told = _laid_on_lines(profile, args.kernel, args.arch, args.most)
    except (OSError, ValueError, RuntimeError) as error:
        print(f"hot_lines: {args.profile}: {error}", file=sys.stderr)
        return 1
    print("\n".join(told))
    return 0


if __name__ == "__main__":
    sys.exit(main())
