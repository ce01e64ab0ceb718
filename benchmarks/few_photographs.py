"""What terms for few photographs change: depth at sparse points, regularizers, exposure, corrected cameras.

    python benchmarks/few_photographs.py fox --factor 4 --left 8 12 20 25 --seed 42 43 44 --json few.json
    python benchmarks/few_photographs.py --json few.json
    python benchmarks/few_photographs.py fox --gains 0.3 --only plain --only=--exposure
    python benchmarks/few_photographs.py fox --turned 0.3 --only plain --only=--refine-cameras

Every eighth photograph is held out; of the others, in the order of their names, so many are left as are asked for, at
even distances from the first to the last. Where points have tracks, those are left that two of these photographs see:
others would not have been found without the rest. Cameras are those that were found with all photographs. A run is made
with each setting, by preset quick; what a JSON file holds already is not run again. Prints a row of a Markdown table
for each: held-out PSNR, the same after fitting colours, SSIM, Gaussians. Good captures have little for some settings to
put right, so photographs can be made brighter and darker at random, and training cameras turned.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.record import machine, markdown, read_json, write_json
from pop_fast.api.backend import get_backend
from pop_fast.data import Capture, View, load_capture
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.choose import choose_backend
from pop_fast.train.evaluate import evaluate
from pop_fast.train.views import ViewTensors

# options of `pop train`
SETTINGS: Final = (
    "plain",
    "--exposure",
    "--random-background",
    "--exposure --appearance-lr.exposures 1e-3",
    "--refine-cameras",
    "--refine-cameras --appearance-lr.cameras 1e-4",
    "--refine-cameras --appearance-lr.cameras 1e-3",
    "--exposure --refine-cameras",
)
FEWEST_SEEN: Final = 2
COLUMNS: Final = ("psnr", "cc_psnr", "ssim", "gaussians", "seconds")


def left_of(capture: Capture, count: int | None) -> Capture:
    """Leave so many of the training photographs, and the points that they would have given.

    Args:
        capture: any; the same views stay held out.
        count: of photographs; None leaves every other one.
    """
    held_out, given = capture.test_views(), capture.train_views()
    chosen = np.linspace(0, len(given) - 1, min(count or len(given) // 2, len(given))).round().astype(int)
    kept = [given[i] for i in chosen]
    seen = [view.seen for view in kept if view.seen is not None]
    rows = np.arange(len(capture.points))
    if seen:
        rows = np.flatnonzero(np.bincount(np.concatenate(seen), minlength=len(rows)) >= FEWEST_SEEN)
    places = np.full(len(capture.points), -1)
    places[rows] = np.arange(len(rows))

    def placed(view: View, split: Any) -> View:
        found = None if view.seen is None else places[view.seen]
        return replace(view, split=split, seen=None if found is None else found[found >= 0])

    views = [placed(view, "train") for view in kept] + [placed(view, "test") for view in held_out]
    return replace(capture, views=tuple(views), points=capture.points[rows], points_rgb=capture.points_rgb[rows])


def disturbed(capture: Capture, gains: float, turned: float) -> Capture:
    """Disturb a capture, the same way at every call.

    Args:
        capture: with a split.
        gains: every photograph is multiplied by a number drawn from 1 - gains to 1.
        turned: training cameras are turned by angles of this standard deviation about each axis, degrees.
    """
    draw = np.random.default_rng(0)
    views: list[View] = []
    for view in capture.views:
        image = np.rint(view.image * draw.uniform(1.0 - gains, 1.0)).astype(np.uint8)
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(np.radians(draw.normal(0.0, turned, 3))).as_matrix()
        viewmat = turn @ view.viewmat if view.split == "train" else view.viewmat
        views.append(replace(view, image=image, viewmat=viewmat))
    return replace(capture, views=tuple(views))


def config_of(setting: str, steps: int, seed: int, data: Path, folder: str) -> TrainConfig:
    """Read the options of a setting, over preset quick of so many steps."""
    words, method = [] if setting == "plain" else shlex.split(setting), "pop"
    if "--method" in words:
        at = words.index("--method")
        _, method = words[at : at + 2]
        del words[at : at + 2]
    said = TrainConfig.from_options(words, method=method, preset="quick").given
    settings = {} if said is None else said.settings
    plan = {"method": method, "preset": "quick", "steps_scaler": steps / 30_000}
    given = TrainConfig.of(**plan, **settings, seed=seed, data=str(data), result_dir=f"{folder}/run", progress=False)
    return choose_backend(replace(given, checkpoint_every=0))[0]


def measured(setting: str, capture: Capture, steps: int, seed: int, data: Path) -> dict[str, float]:
    """Train, and measure the views that were held out, and those that were not."""
    with TemporaryDirectory() as folder:
        config = config_of(setting, steps, seed, data, folder)
        run, before = TrainingRun(config, capture), time.process_time()
        run.run()
        seconds = time.process_time() - before
    # measured with colours fitted whether or not the run asked for it
    how = (replace(config, given=None, exposure=True), config.sh_degree)
    sides = (capture.test_views(), capture.train_views())
    found, fitted = (
        evaluate(get_backend(config.backend), run.params, [ViewTensors.of(view) for view in views], *how)
        for views in sides
    )
    names = ("psnr", "cc_psnr", "ssim")
    trained = {f"train_{name}": round(float(fitted[name]), 4) for name in names[:2]}
    numbers = {name: round(float(found[name]), 4) for name in names}
    return {**numbers, **trained, "gaussians": len(run.params["means"]), "seconds": round(seconds, 1)}


def rows_of(args: argparse.Namespace, known: dict[str, Any]) -> Iterator[tuple[str, dict[str, float]]]:
    """Give every row by its name, those of earlier calls too."""
    whole = load_capture(args.capture, factor=args.factor, missing="skip")
    for count in args.left or [None]:
        capture = disturbed(left_of(whole, count), args.gains, args.turned)
        shown = f"{len(capture.train_views())} photographs"
        what = f"{args.capture.name} / {args.factor}, {shown}, {args.steps} steps"
        what += f", gains {args.gains}" if args.gains else ""
        what += f", turned {args.turned}" if args.turned else ""
        for setting in args.only or SETTINGS:
            for seed in args.seed:
                name = f"{what}, seed {seed}: {setting}"
                if name not in known:
                    # of its own, because others may have been measured elsewhere
                    known[name] = {"machine": machine(), **measured(setting, capture, args.steps, seed, args.capture)}
                yield name, known[name]


def table_of(known: Mapping[str, Any], only: Sequence[str] | None = None) -> str:
    """Lay the rows of a JSON file out: PSNR / SSIM of the plain runs, and what every setting changes of them.

    A change is the mean over the seeds that were run with both; how many these are stands in brackets.

    Args:
        known: the rows.
        only: settings; None takes all.
    """
    found: dict[str, dict[str, dict[str, tuple[float, float]]]] = {}
    for name, numbers in known.items():
        if name != "machine":
            what, _, setting = name.partition(": ")
            place, _, seed = what.rpartition(", seed ")
            found.setdefault(place, {}).setdefault(setting, {})[seed] = (numbers["psnr"], numbers["ssim"])
    settings = [s for s in only or dict.fromkeys(s for row in found.values() for s in row) if s != "plain"]
    rows: list[list[str]] = []
    for place in sorted(found, key=_by_count):
        plain = found[place].get("plain", {})
        cells = [_mean_of(list(plain.values()), "{:.2f} / {:.3f} ({})")]
        for setting in settings:
            seeds = found[place].get(setting, {})
            both = [np.subtract(value, plain[seed]) for seed, value in seeds.items() if seed in plain]
            cells.append(_mean_of(both, "{:+.2f} / {:+.3f} ({})"))
        rows.append([place, *cells])
    return markdown(["capture", "plain", *(f"`{setting}`" for setting in settings)], rows)


def _mean_of(pairs: Sequence[Any], shown: str) -> str:
    return shown.format(*np.mean(pairs, axis=0), len(pairs)) if len(pairs) else ""


def _by_count(place: str) -> tuple[str, int]:
    capture, count = place.split(", ")[:2]
    return capture, int(count.split()[0])


def main(words: list[str] | None = None) -> int:
    """Measure, a row for each number of photographs, setting and seed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("capture", type=Path, nargs="?", help="without one, the rows of --json are laid out as a table")
    parser.add_argument("--factor", type=int, default=8)
    parser.add_argument("--left", type=int, nargs="+", help="training photographs; every other one is left by default")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seed", type=int, nargs="+", default=[42])
    parser.add_argument("--gains", type=float, default=0.0)
    parser.add_argument("--turned", type=float, default=0.0, help="degrees")
    parser.add_argument("--only", action="append", help="'plain' or options of pop train, as one word")
    parser.add_argument("--json", type=Path, help="keep the rows here, and go on from those that are in it")
    args = parser.parse_args(words)
    known = {} if args.json is None else read_json(args.json)
    if args.capture is None:
        print(table_of(known))
        return 0
    known.setdefault("machine", machine())
    print(f"| run | {' | '.join(COLUMNS)} |\n| --- |{' --- |' * len(COLUMNS)}", flush=True)
    for name, numbers in rows_of(args, known):
        print(f"| {name} | {' | '.join(str(numbers[column]) for column in COLUMNS)} |", flush=True)
        if args.json is not None:
            # another call may have written meanwhile
            write_json(args.json, {**read_json(args.json), **known})
    return 0


if __name__ == "__main__":
    sys.exit(main())
