"""What a card has measured, and what ranks exchange: tables of NOTES.md.

    python benchmarks/gpu_tables.py            print them
    python benchmarks/gpu_tables.py --write    put them into NOTES.md, between their marks
    python benchmarks/gpu_tables.py --check    exit with 1 when NOTES.md holds others

The first compares with gsplat (`results/gpu/gsplat.json`), the second is what the hardware's counters say of every
kernel (`results/gpu/counters.json`). The last is `cuda_ext.training.batch_step.step_bytes`, which a test holds to what
emulated ranks count.
"""

from __future__ import annotations

import sys
from pathlib import Path

from record import read_json, with_table

from cuda_ext.training.batch_step import step_bytes

NOTES = Path(__file__).resolve().parent / "NOTES.md"
MEASURED = NOTES.parent / "results" / "gpu"
# Gaussians and processes, each of which draws one view of a step; steps between two changes of the Gaussians
TOGETHER = ((270_000, 8), (3_000_000, 8), (40_000_000, 64))
BETWEEN = 100
LEAST_SHOWN = 10.0  # us


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


def tables() -> dict[str, str]:
    """Make the tables, by their marks in NOTES.md."""
    return {"beside gsplat": beside_gsplat(), "counters": counters(), "ranks": exchanged()}


def with_tables(text: str) -> str:
    """Put the tables between their marks."""
    for name, table in tables().items():
        text = with_table(text, name, table)
    return text


def main(words: list[str]) -> int:
    """Run the script."""
    text = NOTES.read_text(encoding="utf-8")
    if words == ["--write"]:
        NOTES.write_text(with_tables(text), encoding="utf-8")
    elif words == ["--check"]:
        if with_tables(text) != text:
            print("NOTES.md: the CUDA tables are not what was measured; run gpu_tables.py --write")
            return 1
    else:
        print(*tables().values(), sep="\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
