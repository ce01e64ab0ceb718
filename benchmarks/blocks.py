r"""A capture trained whole, in blocks that are merged, and on in rounds: quality, memory and processor time.

python -m benchmarks.blocks CAPTURE --work FOLDER [--blocks 2x2] [--rounds 3] [--factor 2] [--preset quick] \
    [--threads 1]

All are `pop train` of the same settings, so that each block takes as many steps as the whole, and all are measured on
the held-out views of the whole capture. Memory is the peak of each training's process. What was interrupted is resumed
when the command is given again, and what is finished is kept; processor times add up in FOLDER. The rounds are added to
the merged blocks, and so pay for two more merges. Because they are also more training, the whole is trained on by as
many steps too, on the Gaussians that it has, as they are. Writes benchmarks/results/blocks.json, a line a capture, of
which docs/using.md has a table.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.record import machine, markdown, read_json, write_json
from pop_fast.children import module_command
from pop_fast.view.report.source import read_last_stats

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "blocks.json"
# the capture of the table in docs/using.md
SHOWN = "m360_bonsai_800"
GIB = 2**30


def run(words: Sequence[str], folder: Path, note: Path) -> dict[str, float]:
    """Run `pop train`, or resume it, and return the seconds that it has taken up to now: of clock and processor.

    Args:
        words: after `pop train`.
        folder: of results.
        note: where the seconds of earlier calls stand.
    """
    spent = read_json(note) or {"clock": 0.0, "processor": 0.0}
    if spent.get("done"):
        return spent
    again = ["--resume"] if (folder / "cfg.json").is_file() else []
    start = time.perf_counter()
    child = subprocess.Popen(
        module_command("pop_fast.cli", "train", *words, "--out", str(folder), *again), cwd=HERE.parent
    )
    # of the process and of those that it waited for
    _, status, used = os.wait4(child.pid, 0)
    spent = {
        "clock": spent["clock"] + time.perf_counter() - start,
        "processor": spent["processor"] + used.ru_utime + used.ru_stime,
    }
    write_json(note, {**spent, "done": 1.0} if status == 0 else spent)
    if status != 0:
        raise SystemExit(f"pop train {' '.join(words)}: ended with {os.waitstatus_to_exitcode(status)}")
    return spent


def train_on(whole: Path, steps: int, folder: Path) -> dict[str, Any]:
    """Train the whole on, without density control, as a round trains its blocks, and return what that measures.

    Args:
        whole: the result folder of its training.
        steps: how many more.
        folder: of results; what is there already is read.
    """
    from pop_fast.train import TrainingRun
    from pop_fast.train.load_result import CaptureOptions, load_splat, open_capture
    from pop_fast.train.schedule import refining

    if not (folder / "stats").is_dir():
        splat = load_splat(whole)
        capture, config = open_capture(splat, CaptureOptions())
        after = replace(refining(config, steps), result_dir=str(folder), seed=config.seed + 1)
        TrainingRun(after, capture, initial=splat.params, overwrite=True).run()
    return read_last_stats(folder)


def numbers(stats: dict[str, Any]) -> dict[str, Any]:
    """Choose what is compared."""
    chosen = {name: stats[name] for name in ("psnr", "ssim")}
    return {**chosen, "gaussians": stats["num_GS"], "peak_gib": stats["memory_bytes"] / GIB}


def main(words: list[str]) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--blocks", default="2x2")
    parser.add_argument("--rounds", default="3")
    parser.add_argument("--factor", default="2")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--threads", default="1")
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args(words)
    settings = [str(args.capture), "--factor", args.factor, "--preset", args.preset, "--threads", args.threads]
    work = args.work.absolute()
    settings += ["--skip-sizes", "--skip-checks"]
    whole, blocks = work / "whole", work / "blocks"
    in_blocks = [*settings, "--blocks", args.blocks, "--blocks-rounds"]
    spent = {
        "whole": run(settings, whole, work / "whole.json"),
        "merged": run([*in_blocks, "0"], blocks, work / "blocks.json"),
        "rounds": run([*in_blocks, args.rounds], blocks, work / "rounds.json"),
    }
    rounds = read_last_stats(blocks)["rounds"][1:]
    more = len(rounds) * read_json(blocks / "blocks" / "job.json")["round_steps"]
    write(args, whole, blocks, spent, train_on(whole, more, work / "longer"))
    print(table(args.out, args.capture.resolve().name))
    return 0


def write(
    args: argparse.Namespace, whole: Path, blocks: Path, spent: dict[str, dict[str, float]], longer: dict[str, Any]
) -> None:
    """Write what the runs came to."""
    merged, one = read_last_stats(blocks), read_last_stats(whole)
    parts = [
        {
            **{key: part[key] for key in ("name", "training_views", "held_out_views", "points", "background_points")},
            **numbers(part),
            "kept": part["kept"],
            "seconds": part["seconds"],
        }
        for part in merged["blocks"]
    ]
    found, job = merged["rounds"], read_json(blocks / "blocks" / "job.json")
    times = {name: {key: value for key, value in each.items() if key != "done"} for name, each in spent.items()}
    result = {
        "machine": machine(),
        "capture": args.capture.resolve().name,
        "grid": args.blocks,
        "factor": int(args.factor),
        "preset": args.preset,
        "steps": one["step"] + 1,
        "held_out_views": one["views"],
        "whole": {**numbers(one), "seconds": one["seconds"], "spent": times["whole"]},
        "merged": {**numbers(found[0]), "merge_gib": merged["memory_bytes_merging"] / GIB, "spent": times["merged"]},
        "blocks": parts,
        "whole_trained_on": {"steps": longer["step"] + 1, **numbers(longer)},
        "round_steps": job["round_steps"],
        "rounds": [
            {
                **numbers(each),
                "blocks": [
                    {**{key: part[key] for key in ("name", "own", "fixed", "seconds")}, **numbers(part)}
                    for part in each["blocks"]
                ],
            }
            for each in found[1:]
        ],
        "rounds_spent": times["rounds"],
    }
    write_json(args.out, {**read_json(args.out), args.capture.resolve().name: result})


def table(path: Path = RESULTS, capture: str = SHOWN) -> str:
    """Make the table of a capture; that of docs/using.md unless told."""
    found = read_json(path)[capture]
    whole, merged = found["whole"], found["merged"]
    views = f"{found['held_out_views']} of the whole"
    rows = [["the whole", "all", f"{whole['gaussians']:,}", "", *_measured(whole, views)]]
    for part in found["blocks"]:
        counts = [f"{part[name]:,}" for name in ("training_views", "gaussians", "kept")]
        rows.append([f"block {part['name']}", *counts, *_measured(part, f"{part['held_out_views']} in its core")])
    merging = {**merged, "peak_gib": merged["merge_gib"]}
    rows.append([f"**{found['grid']}, merged**", "", f"{merged['gaussians']:,}", "", *_measured(merging, views)])
    on = found["whole_trained_on"]
    rows.insert(1, [f"the whole, {on['steps']} steps more", "all", f"{on['gaussians']:,}", "", *_measured(on, views)])
    for number, each in enumerate(found["rounds"], start=1):
        rows.append([f"**after round {number}**", "", f"{each['gaussians']:,}", "", *_measured(each, views)])
    head = ["", "training views", "Gaussians", "kept", "held-out views", "PSNR", "SSIM", "peak memory"]
    rule = ["---", "---:", "---:", "---:", "---", "---:", "---:", "---:"]
    return f"{markdown(head, rows, rule)}\n\nCommit {found['machine']['commit']}."


def _measured(row: dict[str, Any], views: str) -> list[str]:
    quality = ["", ""] if row["psnr"] is None else [f"{row['psnr']:.2f} dB", f"{row['ssim']:.4f}"]
    return [views, *quality, f"{row['peak_gib'] * GIB / 1e9:.2f} GB"]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
