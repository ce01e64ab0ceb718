"""What each kernel of a training step has to do at least: bytes, instructions, and the time that a card needs for them.

The instructions of the blend and of the tiles that are tried are counted in the machine code for sm_90
(`results/sass.json`), the loss's are estimated from its loops there. A floor is the largest of five times: for the
bytes, at the bandwidth that this card copies with; for the instructions, at its full issue rate; for comparisons,
selections and integers of the blend, which go through a pipe of half that rate; for its accesses of shared memory, 128
bytes a cycle; and for the longest list, whose warp issues one instruction a cycle when the others are done.
"""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

LANES_PER_SM = 128
TILE_PIXELS = 128
ROW = 48  # bytes of a packed splat, and of a gradient slot
PARAMETERS = 59  # floats of a Gaussian
GEOMETRY = 11  # of these, what a culled Gaussian is read for
HALF_RATE = ("compare", "integer")  # classes of instructions, by the tables of arithmetic throughput for sm_90
WARP, SCHEDULERS = 32, 4
SASS = json.loads((Path(__file__).resolve().parent / "results" / "sass.json").read_text(encoding="utf-8"))
# what a POP step launches
FORWARD, BACKWARD = "blend_forward_kernel<3, 1, false>", "columns_kernel<3, false, false, false>"
COUNT, EMIT = "count_kernel", "emit_kernel<unsigned short>"
BLENDS = {"blend_forward": FORWARD, "blend_backward": BACKWARD}
# cycles of shared memory: of a visit, three pieces of 16 bytes for each of four quarters, and going back a lane's 24
# bytes of sums; of eight visits, these again and a row of 48 bytes, read and written; of a batch, 48 bytes a lane in
# and, going back, 96 cleared and 96 read
SHARED = {"blend_forward": (12, 0, 12), "blend_backward": (18, 72, 60)}


@dataclass(frozen=True)
class Loads:
    """What a step has to do.

    Attributes:
        gaussians: all of them.
        visible: those with an extent on the screen.
        instances: pairs of a splat and a 16 x 8 tile that it reaches.
        evaluated: pairs of a list entry and a pixel up to where the last pixel of the tile stops.
        contributing: of these, those that are blended.
        pixels: of the image.
        longest: entries of one tile's list up to where its last pixel stops, at most.
        visits, eights, batches: of the blend's warps, as `gpu_visits` counts them.
        tried: tiles in the splats' rectangles.
    """

    gaussians: int
    visible: int
    instances: int
    evaluated: int
    contributing: int
    pixels: int
    longest: int
    visits: int
    eights: int
    batches: int
    tried: int


@dataclass(frozen=True)
class Card:
    """What a card can do: bytes copied and lane instructions issued, per second, and its processors' clock, Hz."""

    bytes_per_s: float
    instructions_per_s: float
    clock_hz: float


def measured_card(device: torch.device, copied: int = 1 << 30) -> Card:
    """Measure the bandwidth of a copy of so many bytes, and ask for processors and their clock."""
    source = torch.zeros(copied, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    best = float("inf")
    for _ in range(5):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        target.copy_(source)
        end.record()
        end.synchronize()
        best = min(best, start.elapsed_time(end))
    lanes, clock = torch.cuda.get_device_properties(device).multi_processor_count * LANES_PER_SM, _clock_hz()
    return Card(2e3 * copied / best, lanes * clock, clock)


def _clock_hz() -> float:
    """Return the highest clock that the driver allows; a tenth less is usual under load."""
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return 1e9
    query = [tool, "--query-gpu=clocks.max.sm", "--format=csv,noheader,nounits"]
    printed = subprocess.run(query, capture_output=True, text=True, check=False).stdout.split()
    return 1e6 * float(printed[0]) if printed else 1e9


def issued_per(kernel: str, unit: str, arch: str = "sm_90") -> tuple[float, float]:
    """Return what a warp issues for a unit of a kernel's loop, without the loops in it, and how much at half rate."""
    (entry,) = (entry for entry in SASS["kernels"] if (entry["kernel"], entry["arch"]) == (kernel, arch))
    (loop,) = (loop for loop in entry["loops"] if loop["per"] == unit)
    half = sum(loop["always_by_class"].get(name, 0) for name in HALF_RATE)
    return loop["all"] / loop["iterations"], half / loop["iterations"]


def blend_work(name: str, loads: Loads) -> tuple[float, float, float]:
    """Return what a blend's warps issue altogether, how much of it at half rate, and their cycles of shared memory."""
    parts = {"visit": loads.visits, "8 visits": loads.eights, "32 records": loads.batches}
    issued = half = 0.0
    for unit, times in parts.items():
        if unit == "8 visits" and name == "blend_forward":
            continue
        one, at_half = issued_per(BLENDS[name], unit)
        issued, half = issued + times * one, half + times * at_half
    return issued, half, float(sum(cycles * times for cycles, times in zip(SHARED[name], parts.values(), strict=True)))


def work(loads: Loads) -> dict[str, tuple[float, float]]:
    """Return bytes and lane instructions of every kernel of a step, by the kernel's name."""
    n, seen, entries, pixels = loads.gaussians, loads.visible, loads.instances, loads.pixels
    adam = 4 * 3 * PARAMETERS * 2  # parameter and both moments, read and written
    return {
        # 36 bytes for the lists, and a packed splat where one is seen
        "project": (4 * (GEOMETRY * (n - seen) + PARAMETERS * seen) + 36 * n + ROW * seen, 0.0),
        # what a tile is tried by, a count for each splat and a bit for each tile that was tried
        "count_tiles": ((32 + 4) * n + loads.tried / 8, issued_per(COUNT, "32 tiles tried")[0] * loads.tried),
        # depths and extents read, four passes of an 8-byte pair over 32-bit depths
        "sort_by_depth": ((8 + 8 + 4 * 16) * n, 0.0),
        # the order read twice, counts read, first slots written
        "number_instances": (4 * 4 * n, 0.0),
        # emitted once, two passes of a 6-byte pair over 16-bit tiles, ids and slots written
        "make_tile_lists": ((6 + 2 * 12 + 12) * entries, issued_per(EMIT, "32 tiles listed")[0] * loads.tried),
        "blend_forward": ((ROW + 4) * entries + 20 * pixels, WARP * blend_work("blend_forward", loads)[0]),
        # a pixel and channel: 215 for its window, 162 for its gradient
        "photometric": (8 * 12 * pixels, (215.0 + 162.0) * 3 * pixels),
        # a slot an entry, written once and read once
        "blend_backward": ((3 * ROW + 8) * entries + 20 * pixels, WARP * blend_work("blend_backward", loads)[0]),
        "update": ((adam + ROW) * n, 0.0),
    }


def floors(loads: Loads, card: Card) -> dict[str, dict[str, Any]]:
    """Return bytes, instructions, the floor in ms and what it is of, for every kernel."""
    found: dict[str, dict[str, Any]] = {}
    for name, (moved, issued) in work(loads).items():
        times = {"memory": moved / card.bytes_per_s, "issue": issued / card.instructions_per_s}
        if name in BLENDS:
            of_warps, half, shared = blend_work(name, loads)
            times["half rate"] = 2.0 * WARP * half / card.instructions_per_s
            # lanes issue on four schedulers of a processor, which has one path to its shared memory
            times["shared memory"] = SCHEDULERS * WARP * shared / card.instructions_per_s
            # an entry of the longest list costs what an entry costs in the mean
            a_list = of_warps * TILE_PIXELS / max(loads.evaluated, 1)
            times["longest list"] = a_list * loads.longest / card.clock_hz
        bound = max(times, key=lambda name: times[name])
        found[name] = {
            "bytes": float(moved),
            "instructions": issued,
            "times_ms": {name: 1e3 * seconds for name, seconds in times.items()},
            "bound": bound,
            "floor_ms": 1e3 * times[bound],
        }
    return found
