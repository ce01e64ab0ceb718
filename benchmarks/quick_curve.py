"""PSNR against seconds: preset quick, and a tenth of the paper's schedule, which quick was before; turn about.

    python benchmarks/quick_curve.py fox --factor 4 --json benchmarks/results/quick.json
    python benchmarks/quick_curve.py --json benchmarks/results/quick.json --write

Every run is measured on its held-out views at ten of its steps. Seconds are processor time of the steps alone, so that
other work on the machine counts little, and the two kinds of run take turns, seed by seed. What the JSON holds already
is not run again. With `--write` the tables go into benchmarks/NOTES.md: one row a capture, means over the seeds, with
the time in which quick comes within 0.1 dB of where the longer schedule ends; and the curve, at shares of that
schedule's time.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from benchmarks.record import commit, machine, read_json, with_table, write_json
from pop_fast.data import Capture, load_capture
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.choose import choose_backend
from pop_fast.train.presets import QUICK_BLUR_MIN_PIXELS
from pop_fast.view.report.source import read_stats

# "before": with quick's threshold for small images, as it was
KINDS: Final[Mapping[str, dict[str, Any]]] = {
    "before": {"steps_scaler": 0.1, "pop.blur_min_pixels": QUICK_BLUR_MIN_PIXELS},
    "now": {"preset": "quick"},
}
POINTS: Final = 10  # of a curve
AS_GOOD: Final = 0.1  # dB
SHARES: Final = (0.1, 0.2, 0.3, 0.4, 0.5, 0.75, 1.0)


def curve(kind: str, capture: Capture, data: Path, seed: int) -> list[dict[str, float]]:
    """Train, and give what was measured on the way: step, seconds, psnr, ssim, gaussians."""
    with TemporaryDirectory() as folder:
        places: dict[str, Any] = {"data": str(data), "result_dir": f"{folder}/run", "progress": False}
        last = TrainConfig.of(**KINDS[kind]).max_steps
        steps = tuple(round(last * k / POINTS) for k in range(1, POINTS + 1))
        often = {"eval_steps": steps, "save_steps": (last,), "checkpoint_every": 0}
        config = choose_backend(TrainConfig.of(**KINDS[kind], **places, **often, seed=seed))[0]
        TrainingRun(config, capture).run()
        found = [read_stats(Path(folder) / "run" / "stats" / f"val_step{step - 1:04d}.json") for step in steps]
    return [
        {
            "step": step,
            "seconds": round(stats["seconds_cpu"], 2),
            "psnr": round(stats["psnr"], 4),
            "ssim": round(stats["ssim"], 5),
            "gaussians": stats["num_GS"],
        }
        for step, stats in zip(steps, found, strict=True)
    ]


def psnr_at(points: list[dict[str, float]], seconds: float) -> float:
    """Read a curve between its points; nan before the first and behind the last."""
    times, values = ([point[name] for point in points] for name in ("seconds", "psnr"))
    return float(np.interp(seconds, times, values, left=np.nan, right=np.nan))


def seconds_until(points: list[dict[str, float]], psnr: float) -> float:
    """Find when a curve first reaches a PSNR; nan where it does not."""
    for one, two in itertools.pairwise(points):
        if one["psnr"] >= psnr:
            return one["seconds"]
        if two["psnr"] >= psnr:
            share = (psnr - one["psnr"]) / (two["psnr"] - one["psnr"])
            return one["seconds"] + share * (two["seconds"] - one["seconds"])
    return float("nan")


def ends_table(runs: Mapping[str, Any]) -> Iterator[str]:
    """Lay out where both kinds end, means over the seeds of a capture."""
    yield "| capture, seeds | before: 3,000 steps | now: 1,500 steps | PSNR | SSIM | time | time to within 0.1 dB |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for capture, seeds in runs.items():
        both = [seed for seed in seeds.values() if set(seed) == set(KINDS)]
        if not both:
            continue
        ends = {kind: [seed[kind][-1] for seed in both] for kind in KINDS}
        mean = {k: {name: float(np.mean([end[name] for end in ends[k]])) for name in ends[k][0]} for k in KINDS}
        gain = [n["psnr"] - b["psnr"] for b, n in zip(ends["before"], ends["now"], strict=True)]
        until = [seconds_until(s["now"], s["before"][-1]["psnr"] - AS_GOOD) / s["before"][-1]["seconds"] for s in both]
        reached = [share for share in until if share == share]
        time = f"{np.mean(reached):.2f}" if reached else "never"
        time += f" ({len(reached)} of {len(until)} seeds)" if 0 < len(reached) < len(until) else ""
        cells = [
            f"{m['psnr']:.2f} dB, {m['ssim']:.3f}, {m['gaussians']:,.0f}, {m['seconds']:.0f} s" for m in mean.values()
        ]
        ssim, took = mean["now"]["ssim"] - mean["before"]["ssim"], mean["now"]["seconds"] / mean["before"]["seconds"]
        spread = f"{np.mean(gain):+.2f} dB ({min(gain):+.2f} to {max(gain):+.2f})"
        yield f"| {capture}, {len(both)} | {' | '.join(cells)} | {spread} | {ssim:+.3f} | {took:.2f} | {time} |"


def curve_table(runs: Mapping[str, Any]) -> Iterator[str]:
    """Lay out the curves, before / now, at shares of the time that the longer schedule takes; means over the seeds."""
    yield "| capture | " + " | ".join(f"{share:.0%} of the time" for share in SHARES) + " |"
    yield "| --- |" + " --- |" * len(SHARES)
    for capture, seeds in runs.items():
        both = [seed for seed in seeds.values() if set(seed) == set(KINDS)]
        if not both:
            continue
        cells = []
        for share in SHARES:
            at = [[psnr_at(seed[kind], share * seed["before"][-1]["seconds"]) for kind in KINDS] for seed in both]
            cells.append(" / ".join("" if np.isnan(value) else f"{value:.2f}" for value in np.mean(at, axis=0)))
        yield f"| {capture} | " + " | ".join(cells) + " |"


def main(words: list[str] | None = None) -> int:
    """Run what is missing, then lay it out."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("capture", type=Path, nargs="?", help="without one, the rows of --json are laid out")
    parser.add_argument("--factor", type=int, default=1)
    parser.add_argument("--seed", type=int, nargs="+", default=[42, 43, 44])
    parser.add_argument("--json", type=Path, required=True, help="keep the runs here, and go on from those in it")
    parser.add_argument("--write", action="store_true", help="put the tables into benchmarks/NOTES.md")
    parser.add_argument("--check", action="store_true", help="exit with 1 where benchmarks/NOTES.md has others")
    args = parser.parse_args(words)
    if args.capture is None and not args.json.exists():
        parser.error(f"{args.json}: no such file; name one that holds runs, or a capture to run")
    kept: dict[str, Any] = read_json(args.json) or {"machine": machine(), "runs": {}}
    if args.capture is not None:
        capture = load_capture(args.capture, factor=args.factor)
        name = args.capture.resolve().name + (f", factor {args.factor}" if args.factor > 1 else "")
        for seed in args.seed:
            for kind in KINDS:
                done = kept["runs"].setdefault(name, {}).setdefault(str(seed), {})
                if kind not in done:
                    done[kind] = curve(kind, capture, args.capture, seed)
                    kept.setdefault("commits", {})[name] = commit(Path(__file__).resolve().parent)
                    write_json(args.json, kept)
    text = "\n".join([*ends_table(kept["runs"]), "", *curve_table(kept["runs"])])
    notes = Path(__file__).resolve().parent / "NOTES.md"
    before = notes.read_text(encoding="utf-8")
    after = with_table(before, "quick", text)
    if args.check and after != before:
        print("NOTES.md: the tables of preset quick are not what was measured; run quick_curve.py --json FILE --write")
        return 1
    if args.write:
        notes.write_text(after, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
