"""What each kernel of a training step has to do at least: bytes, instructions, and the time that a card needs for them.

The blend's instructions are counted in its machine code for sm_90 (`results/sass.json`), the loss's are estimated from
its loops there. A floor is the largest of four times: for the bytes, at the bandwidth that this card copies with; for
the instructions, at its full issue rate; for comparisons, selections and integers of the blend, which go through a pipe
of half that rate; and for the longest list, whose warp issues one instruction a cycle when the others are done.
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
ROW = 48  # bytes of a packed splat, and of a gradient slot
PARAMETERS = 59  # floats of a Gaussian
GEOMETRY = 11  # of these, what a culled Gaussian is read for
HALF_RATE = ("compare", "integer")  # classes of instructions, by the tables of arithmetic throughput for sm_90
LANE_PIXELS = 4  # pixels that a lane of the blend evaluates a splat at
SASS = json.loads((Path(__file__).resolve().parent / "results" / "sass.json").read_text(encoding="utf-8"))
# what a POP step launches
FORWARD, BACKWARD = "blend_forward_kernel<3, 1, false>", "columns_kernel<3, false, false, false>"


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
    """

    gaussians: int
    visible: int
    instances: int
    evaluated: int
    contributing: int
    pixels: int
    longest: int = 0


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


def instructions_a_record(kernel: str, arch: str = "sm_90") -> tuple[float, float]:
    """Return what a warp issues for a record, by the count of the kernel's loop, and how much of it at half rate."""
    (entry,) = (entry for entry in SASS["kernels"] if (entry["kernel"], entry["arch"]) == (kernel, arch))
    (loop,) = (loop for loop in entry["loops"] if loop["per"] == "record")
    half = sum(loop["always_by_class"].get(name, 0) for name in HALF_RATE)
    return loop["all"] / loop["iterations"], half / loop["iterations"]


def instructions_a_pair(kernel: str) -> float:
    """Return what a lane issues for one splat at one pixel."""
    return instructions_a_record(kernel)[0] / LANE_PIXELS


def work(loads: Loads) -> dict[str, tuple[float, float]]:
    """Return bytes and lane instructions of every kernel of a step, by the kernel's name."""
    n, seen, entries, pixels = loads.gaussians, loads.visible, loads.instances, loads.pixels
    evaluated = loads.evaluated
    adam = 4 * 3 * PARAMETERS * 2  # parameter and both moments, read and written
    return {
        # 36 bytes for the lists, and a packed splat where one is seen
        "project": (4 * (GEOMETRY * (n - seen) + PARAMETERS * seen) + 36 * n + ROW * seen, 0.0),
        # four passes of an 8-byte pair over 32-bit depths, extents read, counts written
        "count_instances": ((4 * 16 + ROW + 8) * n, 0.0),
        # emitted once, two passes of a 6-byte pair over 16-bit tiles, ids and slots written
        "make_tile_lists": ((6 + 2 * 12 + 12) * entries, 0.0),
        "blend_forward": ((ROW + 4) * entries + 20 * pixels, instructions_a_pair(FORWARD) * evaluated),
        # a pixel and channel: 215 for its window, 162 for its gradient
        "photometric": (8 * 12 * pixels, (215.0 + 162.0) * 3 * pixels),
        # a slot an entry, written once and read once
        "blend_backward": ((3 * ROW + 8) * entries + 20 * pixels, instructions_a_pair(BACKWARD) * evaluated),
        "update": ((adam + ROW) * n, 0.0),
    }


def floors(loads: Loads, card: Card) -> dict[str, dict[str, Any]]:
    """Return bytes, instructions, the floor in ms and what it is of, for every kernel."""
    blends = {"blend_forward": FORWARD, "blend_backward": BACKWARD}
    found: dict[str, dict[str, Any]] = {}
    for name, (moved, issued) in work(loads).items():
        times = {"memory": moved / card.bytes_per_s, "issue": issued / card.instructions_per_s}
        if name in blends:
            record, half = instructions_a_record(blends[name])
            times["half rate"] = 2.0 * half / LANE_PIXELS * loads.evaluated / card.instructions_per_s
            times["longest list"] = record * loads.longest / card.clock_hz
        bound = max(times, key=lambda name: times[name])
        found[name] = {
            "bytes": float(moved),
            "instructions": issued,
            "times_ms": {name: 1e3 * seconds for name, seconds in times.items()},
            "bound": bound,
            "floor_ms": 1e3 * times[bound],
        }
    return found
