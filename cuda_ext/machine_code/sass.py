"""Read what nvdisasm prints: instructions by class, loops by backward branches, and what an iteration issues.

A loop is a natural loop of the control flow graph. Of its instructions outside inner loops, those in blocks that every
iteration passes are `always`; the rest form regions, one for each place where a warp may jump over something. A region
is issued when any lane of the warp takes it, so that what an iteration costs lies between `always` and all of it. Paths
that only a diverged warp takes (BRA.DIV, BRA.CONV) are left out.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

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


def class_of(opcode: str) -> str:
    """Return the class of an opcode; a move written as IMAD counts with IMAD, whose unit it takes."""
    for name, prefixes in _CLASSES.items():
        if opcode.startswith(tuple(prefixes.split())):
            return name
    return "other"


@dataclass(frozen=True)
class Instruction:
    """One instruction.

    Attributes:
        address: bytes from the kernel's begin.
        predicate: for example "P0" or "!P0", "" where it is always executed.
        opcode: with modifiers.
        operands: as printed.
        frames: source lines, innermost first, the kernel's own last.
    """

    address: int
    predicate: str
    opcode: str
    operands: str
    frames: tuple[Frame, ...] = ()

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
    """One loop.

    Attributes:
        header: its first block.
        blocks: all of its blocks, inner loops among them.
        depth: loops around it.
        frames: source lines of its backward branch, innermost first, then those of its other instructions.
        always: what every iteration issues, by class.
        regions: what an iteration may jump over.
        exponentials: how many exp2 it holds, for a lane.
    """

    header: int
    blocks: set[int]
    depth: int = 0
    frames: list[Frame] = field(default_factory=list)
    always: Counter[str] = field(default_factory=Counter)
    regions: list[Region] = field(default_factory=list)
    exponentials: int = 0

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
