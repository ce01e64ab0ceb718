"""What kernels and ranks should take, and what a card has measured of it: the CUDA tables of NOTES.md.

    python benchmarks/gpu_predictions.py            print them
    python benchmarks/gpu_predictions.py --write    put them into NOTES.md, between their marks
    python benchmarks/gpu_predictions.py --check    exit with 1 when NOTES.md holds others

The first holds counts (`results/sass.json`, made by `make sass`). The second is computed from them and from the bytes
of `gpu_floors`, for one case on an H200:

    predicted = the largest time of `gpu_floors` / USED + NODE * nodes of the graph

Beside it stands what `gpu_check` has measured (`results/gpu/kernels.json`), with the floor on that card. The third
compares with gsplat (`results/gpu/gsplat.json`), the fourth is what the hardware's counters say of every kernel
(`results/gpu/counters.json`). The last is `cuda_ext.training.batch_step.step_bytes`, which a test holds to what
emulated ranks count.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from gpu_floors import SASS, Card, Loads, floors
from record import read_json, with_table

from cuda_ext.training.batch_step import step_bytes

NOTES = Path(__file__).resolve().parent / "NOTES.md"
MEASURED = NOTES.parent / "results" / "gpu"
# 132 processors of 128 lanes at the clock that an H200 holds under load; the bandwidth that a copy reaches on it
H200 = Card(4.2e12, 132 * 128 * 1.755e9, 1.755e9)
# 270,000 Gaussians, 160,000 of them visible, 1.6 MP, 120 evaluated and 35 contributing pairs a pixel; the longest list
# is as much longer than the mean as that of fox at 960 x 540 after 3DGS: 1,343 to 187; visits, eights and batches are
# 0.774, 0.104 and 0.0354 of the 1.5 million entries walked, a rectangle has 27.3 tiles, as in the case of gpu_scenes
_BLENDED = (192_000_000, 56_000_000, 1_600_000, 862, 1_161_000, 156_000, 53_100)
CASE = Loads(270_000, 160_000, 2_000_000, *_BLENDED, tried=4_360_000)
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


def an_iteration(kernel: dict[str, Any]) -> str:
    """Say what an iteration of a kernel's loop over visits, steps or slots issues, or what its whole body does."""
    found: list[str] = []
    # an update has a loop over slots too, and much besides
    units = ("visit", "step", "8 visits", "16 slots", "32 slots", "32 records")
    told = () if kernel["kernel"].startswith("update") else units
    for unit in told:
        # what is unrolled has several loops of one unit
        spans = [[loop[name] / loop["iterations"] for name in ("always", "all")] for loop in kernel["loops"]]
        spans = [span for span, loop in zip(spans, kernel["loops"], strict=True) if loop["per"] == unit]
        if spans:
            least, most = min(span[0] for span in spans), max(span[1] for span in spans)
            found.append(f"{most:.0f} per {unit}" if most - least < 1.5 else f"{least:.0f} to {most:.0f} per {unit}")
    if found:
        return ", ".join(found)
    return f"{kernel['instructions']} in all, per {kernel['per']}"


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
    return "\n".join(lines)


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
    for kernel in found["kernels"]:
        if kernel["us"] < LEAST_SHOWN:
            continue
        name = kernel["kernel"].removeprefix("void ").removeprefix("pop::")
        # a sort's arguments are lines of policy
        name = f"cub::{name.split('<')[0]}" if name.startswith(("radix_sort::", "scan::")) else name
        waits = [f"{what.replace('_', ' ')} {share}" for what, share in kernel["warps_stalled_per_issue"].items()]
        waits = [words for words in waits if not words.startswith(("selected", "not selected"))]
        shares = f"{kernel['busy_percent']} % | {kernel['issue_percent']} % | {kernel['warps_percent']} %"
        millions = kernel["instructions"] / 1e6
        lines.append(f"| `{name}` | {kernel['us']:.0f} | {millions:.1f} | {shares} | {', '.join(waits[:2])} |")
    return "\n".join(lines)


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


def with_tables(text: str) -> str:
    """Put the tables between their marks."""
    tables = {"machine code": machine_code(SASS), "predictions": predictions(), "ranks": exchanged()}
    tables |= {"beside gsplat": beside_gsplat(), "counters": counters()}
    for name, table in tables.items():
        text = with_table(text, name, table)
    return text


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
        print(machine_code(SASS), predictions(), beside_gsplat(), counters(), exchanged(), sep="\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
