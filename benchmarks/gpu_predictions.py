"""What kernels and ranks have to do at least, what they should take, and what a card has measured: tables of NOTES.md.

    python benchmarks/gpu_predictions.py            print them
    python benchmarks/gpu_predictions.py --write    put them into NOTES.md, between their marks
    python benchmarks/gpu_predictions.py --check    exit with 1 when NOTES.md holds others

The first holds counts (`results/sass.json`, made by `make sass`). The second is computed from them and from the bytes
of each kernel, for one case on an H200:

    predicted = the largest time of `floors` / USED + NODE * nodes of the graph

Beside it stands what `gpu_check` has measured (`results/gpu/kernels.json`), with the floor on that card. The third
compares with gsplat (`results/gpu/gsplat.json`), the fourth is what the hardware's counters say of every kernel
(`results/gpu/counters.json`). The last two are `step_bytes` and `held_bytes` of `cuda_ext.training.batch_step`, which
tests hold to what emulated ranks count.

The instructions of the blend and of the tiles that are tried are counted in the machine code for sm_90, the loss's are
estimated from its loops there. A floor is the largest of five times: for the bytes, at the bandwidth that this card
copies with; for the instructions, at its full issue rate; for comparisons, selections and integers of the blend, which
go through a pipe of half that rate; for its accesses of shared memory, 128 bytes a cycle; and for the longest list,
whose warp issues one instruction a cycle when the others are done.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from record import read_json, with_table

from cuda_ext.machine_code.count_sass import sources
from cuda_ext.training.batch_step import held_bytes, step_bytes

NOTES = Path(__file__).resolve().parent / "NOTES.md"
MEASURED = NOTES.parent / "results" / "gpu"
# 270,000 Gaussians, 160,000 of them visible, 1.6 MP, 120 evaluated and 35 contributing pairs a pixel; the longest list
# is as much longer than the mean as that of fox at 960 x 540 after 3DGS: 1,343 to 187; visits, eights and batches are
# 0.774, 0.104 and 0.0354 of the 1.5 million entries walked, a rectangle has 27.3 tiles, as in the case of gpu_scenes
_BLENDED = (192_000_000, 56_000_000, 1_600_000, 862, 1_161_000, 156_000, 53_100)
# assumed: the share of the issue slots, or of the bandwidth, that a kernel keeps busy; what a node costs besides, ms
USED, NODE = 0.7, 0.004
# kernels, sorting passes and fills that a POP step launches, by the function that launches them
NODES = {
    "begin_step": 1,
    "project": 1,
    "count_tiles": 1,
    "sort_by_depth": 13,
    "number_instances": 2,
    "make_tile_lists": 11,
    "blend_forward": 1,
    "photometric": 2,
    "blend_backward": 2,
    "count_important": 1,
    "update": 1,
    "end_step": 1,
}
# Gaussians and processes, each of which draws one view of a step; steps between two changes of the Gaussians
TOGETHER = ((270_000, 8), (3_000_000, 8), (40_000_000, 64))
BETWEEN = 100
LEAST_SHOWN = 10.0  # us
# of the blend, besides those of memory and issue
OTHER_TIMES = ("half rate", "shared memory", "longest list")
# the instantiations that training takes, and what else is compared with them
SHOWN = {
    "project_kernel<3, false>": "project",
    "blend_forward_kernel<3, 0, false>": "blend forward",
    "blend_forward_kernel<3, 1, false>": "blend forward with dominant ids",
    "blend_forward_kernel<3, 2, false>": "the same with counts of splats",
    "columns_kernel<3, false, false, false>": "blend backward, columns",
    "columns_kernel<3, false, false, true>": "the same, atomic",
    "splats_kernel<3, false, false, false>": "blend backward, splats",
    "sum_slots_kernel": "sum of gradient slots",
    "tile_order_kernel": "order of tiles",
    "windows_kernel<true, false>": "loss, windows",
    "pixels_kernel": "loss, pixels",
    "update_kernel<3>": "update",
}
LANES_PER_SM = 128
TILE_PIXELS = 128
ROW = 48  # bytes of a packed splat, and of a gradient slot
PARAMETERS = 59  # floats of a Gaussian
GEOMETRY = 11  # of these, what a culled Gaussian is read for
HALF_RATE = ("compare", "integer")  # classes of instructions, by the tables of arithmetic throughput for sm_90
WARP, SCHEDULERS = 32, 4
SASS = read_json(NOTES.parent / "results" / "sass.json")
# what a POP step launches
FORWARD, BACKWARD = "blend_forward_kernel<3, 1, false>", "columns_kernel<3, false, false, false>"
COUNT, EMIT = "count_kernel", "emit_kernel<unsigned short>"
BLENDS = {"blend_forward": FORWARD, "blend_backward": BACKWARD}
# cycles of shared memory: of a visit, three pieces of 16 bytes for each of four quarters, and going back a lane's 24
# bytes of sums; of eight visits, these again and a row of 48 bytes, read and written; of a batch, 48 bytes a lane in
# and, going back, 96 cleared and 96 read
SHARED = {"blend_forward": (12, 0, 12), "blend_backward": (18, 72, 60)}


def an_iteration(kernel: dict[str, Any]) -> str:
    """Say what an iteration of a kernel's loop over visits, steps or slots issues, or what its whole body does."""
    found: list[str] = []
    # an update has a loop over slots too, and much besides
    units = ("visit", "step", "8 visits", "16 slots", "32 slots", "32 records")
    for unit in () if kernel["kernel"].startswith("update") else units:
        # what is unrolled has several loops of one unit
        if loops := [loop for loop in kernel["loops"] if loop["per"] == unit]:
            least = min(loop["always"] / loop["iterations"] for loop in loops)
            most = max(loop["all"] / loop["iterations"] for loop in loops)
            found.append(f"{most:.0f} per {unit}" if most - least < 1.5 else f"{least:.0f} to {most:.0f} per {unit}")
    return ", ".join(found) or f"{kernel['instructions']} in all, per {kernel['per']}"


def machine_code(sass: dict[str, Any]) -> str:
    """Make the table of counted instructions."""
    head = "| kernel | instructions of a warp, sm_80 | sm_90 | registers | shared memory, bytes | warps a processor |"
    lines = [head, "|---|---|---|---|---|---|"]
    found = {(entry["kernel"], entry["arch"]): entry for entry in sass["kernels"]}
    for kernel, title in SHOWN.items():
        both = [found[kernel, arch] for arch in ("sm_80", "sm_90")]
        registers, shared, warps = (
            " / ".join(dict.fromkeys(str(one[name]) for one in both)) for name in ("registers", "shared", "warps")
        )
        lines.append(
            f"| {title} | {an_iteration(both[0])} | {an_iteration(both[1])} | {registers} | {shared} | {warps} |"
        )
    now = sources()
    changed = sorted(name for name in {*now, *sass["sources"]} if now.get(name) != sass["sources"].get(name))
    since = f" Changed since: {', '.join(f'`{name}`' for name in changed)}." if changed else ""
    return "\n".join((*lines, "", f"Counted with nvcc {sass['nvcc']}.{since}"))


def predictions() -> str:
    """Make the table of predicted times, and what the card of the last check took."""
    found = read_json(MEASURED / "kernels.json")
    case = found["cases"]["270k_1.6MP"]
    card, by_kernel = f"{found['gpu']}, commit {found['commit'][:8]}", case["pixel_parallel_by_kernel"]
    head = ["step", "bound by", "floor at full use, ms", f"{', '.join(OTHER_TIMES)}, ms", "predicted, ms"]
    head += [f"measured, {card}, ms", "its floor there, ms"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    total = least = 0.0
    known = floors(CASE, H200)
    for name, nodes in NODES.items():
        entry = known.get(name, {"floor_ms": 0.0, "bound": "latency", "times_ms": {}})
        predicted = entry["floor_ms"] / USED + NODE * nodes
        bound = "latency" if NODE * nodes > predicted / 2 else entry["bound"]
        others = [f"{entry['times_ms'][key]:.3f}" for key in OTHER_TIMES if key in entry["times_ms"]]
        cells = [f"`{name}`", bound, f"{entry['floor_ms']:.3f}", ", ".join(others), f"{predicted:.3f}"]
        measured = by_kernel["kernels"][name]
        cells += [f"{measured['ms']:.3f}", f"{measured['floor_ms']:.3f}" if "floor_ms" in measured else ""]
        lines.append(f"| {' | '.join(cells)} |")
        total, least = total + predicted, least + entry["floor_ms"]
    step = case["pixel_parallel"]["step_with_pop_ms"]
    lines.append(
        f"| whole step, {sum(NODES.values())} graph nodes | | {least:.2f} | | {total:.2f} | {step:.2f} | "
        f"{by_kernel['floor_ms']:.2f} |"
    )
    return "\n".join(lines)


def beside_gsplat() -> str:
    """Make the table of this project's times and gsplat's, of one process on one card."""
    found = read_json(MEASURED / "gsplat.json")
    head = "| case | | kernels, ms | gsplat's kernels, ms | | with Python and waiting, ms | gsplat, ms | |"
    lines = [head, "|---|---|---|---|---|---|---|---|"]
    names = {"forward": "forward", "forward_backward": "forward and backward", "step": "training step"}
    for case, both in found["cases"].items():
        for key, title in names.items():
            sums = [both[side][f"{key}_kernels"]["kernels_ms"] for side in ("ours", "gsplat")]
            walls = [both[side][f"{key}_ms"] for side in ("ours", "gsplat")]
            cells = [f"{ours:.2f} | {theirs:.2f} | {theirs / ours:.2f} times" for ours, theirs in (sums, walls)]
            lines.append(f"| `{case}` | {title} | {' | '.join(cells)} |")
    return "\n".join(lines)


def counters() -> str:
    """Make the table of the hardware's counters of the kernels that take 10 us or more."""
    found = read_json(MEASURED / "counters.json")
    head = "| kernel | us | instructions, millions | processors busy | issue slots used | warps there "
    lines = [head + "| what its warps wait for most |", "|---|---|---|---|---|---|---|"]
    of_cub = []
    for kernel in found["kernels"]:
        if kernel["us"] < LEAST_SHOWN:
            continue
        name = kernel["kernel"].removeprefix("void ").removeprefix("pop::")
        if name.startswith(("radix_sort::", "scan::")):
            of_cub.append(kernel["us"])
            continue
        waits = [f"{what.replace('_', ' ')} {share}" for what, share in kernel["warps_stalled_per_issue"].items()]
        waits = [words for words in waits if not words.startswith(("selected", "not selected"))]
        shares = f"{kernel['busy_percent']} % | {kernel['issue_percent']} % | {kernel['warps_percent']} %"
        millions = kernel["instructions"] / 1e6
        lines.append(f"| `{name}` | {kernel['us']:.0f} | {millions:.1f} | {shares} | {', '.join(waits[:2])} |")
    each = f"{min(of_cub):.0f} to {max(of_cub):.0f} us each, {sum(of_cub):.0f} together"
    return "\n".join((*lines, "", f"Not listed: {len(of_cub)} kernels of CUB's sorts and sums ({each})."))


def exchanged() -> str:
    """Make the table of bytes that a rank receives in a step."""
    head = "| Gaussians, ranks | gradients summed, MB | every view shows all, MB | | every view shows a tenth, MB | |"
    lines = [head, "|---|---|---|---|---|---|"]
    for n, size in TOGETHER:
        # gradients are summed in two exchanges; statistics of every view are 24 bytes a Gaussian
        whole = (2 * 4 * 59 + 24 * size) * n * (size - 1) / size
        now = [sum(step_bytes(n, size, size, shown, BETWEEN).values()) for shown in (1.0, 0.1)]
        cells = " | ".join(f"{bytes_ / 1e6:,.0f} | {whole / bytes_:.0f} times fewer" for bytes_ in now)
        lines.append(f"| {n:,}, {size} | {whole / 1e6:,.0f} | {cells} |")
    return "\n".join(lines)


def held() -> str:
    """Make the table of bytes that a rank holds for Gaussians."""
    lines = ["| Gaussians, ranks | before, GB | every view shows all, GB | a tenth, GB |", "|---|---|---|---|"]
    for n, size in TOGETHER:
        shown_all, tenth = (held_bytes(n, size, size, shown) for shown in (1.0, 0.1))
        # there was room for all splats, and the others' moments and colours were held too
        before = sum(shown_all.values()) + (2 * 4 * 59 + 4 * 48) * n * (size - 1) / size
        cells = [before, *(sum(of.values()) for of in (shown_all, tenth))]
        lines.append(f"| {n:,}, {size} | {' | '.join(f'{bytes_ / 1e9:,.2f}' for bytes_ in cells)} |")
    return "\n".join(lines)


def tables() -> dict[str, str]:
    """Make the tables, by their marks in NOTES.md."""
    of_kernels = {"machine code": machine_code(SASS), "predictions": predictions(), "beside gsplat": beside_gsplat()}
    return {**of_kernels, "counters": counters(), "ranks": exchanged(), "held": held()}


def with_tables(text: str) -> str:
    """Put the tables between their marks."""
    for name, table in tables().items():
        text = with_table(text, name, table)
    return text


@dataclass(frozen=True)
class Loads:
    """What a step has to do."""

    gaussians: int  # all of them
    visible: int  # those with an extent on the screen
    instances: int  # pairs of a splat and a 16 x 8 tile that it reaches
    evaluated: int  # pairs of a list entry and a pixel up to where the last pixel of the tile stops
    contributing: int  # of these, those that are blended
    pixels: int  # of the image
    longest: int  # entries of one tile's list up to where its last pixel stops, at most
    # of the blend's warps, as `gpu_visits` counts them
    visits: int
    eights: int
    batches: int
    tried: int  # tiles in the splats' rectangles


CASE = Loads(270_000, 160_000, 2_000_000, *_BLENDED, tried=4_360_000)


@dataclass(frozen=True)
class Card:
    """What a card can do: bytes copied and lane instructions issued, per second, and its processors' clock, Hz."""

    bytes_per_s: float
    instructions_per_s: float
    clock_hz: float


# 132 processors of 128 lanes at the clock that an H200 holds under load; the bandwidth that a copy reaches on it
H200 = Card(4.2e12, 132 * 128 * 1.755e9, 1.755e9)


def elapsed_ms(run: Callable[[], Any]) -> float:
    """Time a run on the GPU, from what was asked before it to its own end."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    run()
    end.record()
    end.synchronize()
    return start.elapsed_time(end)


def measured_card(device: torch.device) -> Card:
    """Measure the bandwidth of a copy, and ask for processors and their clock."""
    source = torch.zeros(1 << 30, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    best = min(elapsed_ms(lambda: target.copy_(source)) for _ in range(5))
    lanes, clock = torch.cuda.get_device_properties(device).multi_processor_count * LANES_PER_SM, _clock_hz()
    return Card(2e3 * source.numel() / best, lanes * clock, clock)


def _clock_hz() -> float:
    """Return the highest clock that the driver allows; a tenth less is usual under load."""
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return 1e9
    query = [tool, "--query-gpu=clocks.max.sm", "--format=csv,noheader,nounits"]
    printed = subprocess.run(query, capture_output=True, text=True, check=False).stdout.split()
    return 1e6 * float(printed[0]) if printed else 1e9


def issued_per(kernel: str, unit: str) -> tuple[float, float]:
    """Return what a warp issues for a unit of a kernel's loop, without the loops in it, and how much at half rate."""
    (entry,) = (entry for entry in SASS["kernels"] if (entry["kernel"], entry["arch"]) == (kernel, "sm_90"))
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


def main(words: list[str]) -> int:
    """Run the script."""
    text = NOTES.read_text(encoding="utf-8")
    if words == ["--write"]:
        NOTES.write_text(with_tables(text), encoding="utf-8")
    elif words == ["--check"]:
        if with_tables(text) != text:
            print("NOTES.md: the CUDA tables are not what the counts give; run gpu_predictions.py --write")
            return 1
    else:
        print(*tables().values(), sep="\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
