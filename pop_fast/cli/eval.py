"""`pop eval`: measure a result, a checkpoint or a PLY on the held-out views of a capture."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import tyro

from pop_fast.cli import parse, printable
from pop_fast.cli.options import CaptureArguments, open_with_bars
from pop_fast.errors import PopError
from pop_fast.io.atomic import check_file, write_json
from pop_fast.io.heartbeat import Heartbeat
from pop_fast.train.config import TrainConfig
from pop_fast.train.load_result import CaptureOptions, Splat, check_not_read, load_splat
from pop_fast.train.results import ResultFolder

if TYPE_CHECKING:
    from pop_fast.train.lpips import LPIPS
    from pop_fast.train.views import ViewTensors

_EXAMPLES: Final = """
    pop eval out/scene_pop                                   the last checkpoint, on the capture it was trained on
    pop eval out/scene_pop --lpips-alex alexnet.pth lin.pth  add LPIPS to its stats and its report
    pop eval point_cloud.ply --capture scene                 a PLY of another trainer
    pop eval point_cloud.ply --capture scene --training-frame    of gsplat's trainer, which moves the world
"""


@dataclass(frozen=True, kw_only=True)
class Args(CaptureArguments):
    """Measure a splat on the held-out views of a capture: PSNR, SSIM, LPIPS where weights are given.

    For a result folder the numbers also go into its stats and its report, unless it may not be written to, or an option
    asks for another capture, other photographs or another frame than those of its training, or other views are held
    out now. A capture whose cameras have changed since is refused.
    """

    splat: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT|CKPT|FILE")]
    """What to measure."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write the numbers to this file."""
    lpips_vgg: tuple[str, ...] = field(default=())
    """Weights of LPIPS on VGG16: one merged file, or backbone and linear layers."""
    lpips_alex: tuple[str, ...] = field(default=())
    """Weights of LPIPS on AlexNet, in the same form."""
    per_view: bool = False
    """Print one line for each view."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "eval", examples=_EXAMPLES)
    if args.json is not None:
        check_file(args.json)
    splat = load_splat(args.splat)
    if args.json is not None:
        check_not_read(args.json, splat)
    keeps = _keeps(splat, args)
    from pop_fast.train.lpips import LPIPS

    chosen = {"vgg": args.lpips_vgg or splat.config.lpips_vgg, "alex": args.lpips_alex or splat.config.lpips_alex}
    nets = [LPIPS(net, files) for net, files in chosen.items() if files]  # type: ignore[arg-type]
    _, stats = measured(splat, args, nets)
    if args.per_view:
        for name, numbers in stats["per_view"].items():
            print(f"{printable(name)}: " + ", ".join(f"{key} {value:.4f}" for key, value in numbers.items()))
    print("\n".join(_lines(stats)))
    if args.json is not None:
        write_json(args.json, stats)
    if keeps and splat.step is not None:
        _record(args.splat, splat.step, stats)
    return 0


def _keeps(splat: Splat, args: Args) -> bool:
    """Say whether the numbers go into a result's stats and report; a note tells first where they cannot."""
    as_trained = all(getattr(args, option.name) == option.default for option in fields(CaptureOptions))
    if not (args.splat.is_dir() and splat.step is not None and as_trained):
        return False
    for place in (args.splat, args.splat / "stats"):
        if place.is_dir() and not os.access(place, os.W_OK | os.X_OK):
            print(f"note: {place} may not be written to; stats and report stay as they are", file=sys.stderr)
            return False
    return True


def measured(splat: Splat, options: CaptureOptions, nets: Sequence[LPIPS]) -> tuple[str, dict[str, Any]]:
    """Measure a splat on the held-out views of its capture, and return the capture's name and the numbers."""
    from pop_fast.train.evaluate import too_small
    from pop_fast.train.views import ViewTensors

    capture, config = open_with_bars(splat, options, "held out")
    views = [ViewTensors.of(view) for view in capture.test_views(config.test_every)]
    if not views:
        fix = "its own lists name none" if capture.has_own_split else "give --test-every 8 or another number over 0"
        raise PopError(f"{capture.name}: no view is held out; {fix}")
    small = too_small(views)
    if small is not None:
        raise PopError(f"{capture.name}: {small}; use larger images (a lower --factor)")
    return capture.name, measure_splat(splat, config, views, nets)


def measure_splat(splat: Splat, config: TrainConfig, views: list[ViewTensors], nets: Sequence[LPIPS]) -> dict[str, Any]:
    """Measure a splat on views; the numbers are those that training itself would write."""
    from pop_fast.train.engines import renderer
    from pop_fast.train.environment import reproducible
    from pop_fast.train.evaluate import evaluate, population

    backend, note = renderer(config.backend)
    if note:
        print(f"note: {note}", file=sys.stderr)
    with reproducible(config.threads), Heartbeat() as beat:
        beat.say(f"measuring {len(views)} views")
        measured = evaluate(backend, splat.params, views, config, splat.sh_degree, nets)
        return {**population(splat.params["opacities"].sigmoid()), **measured}


def _record(folder: Path, step: int, stats: dict[str, Any]) -> None:
    from pop_fast.view.report import write_report
    from pop_fast.view.report.source import read_stats

    results = ResultFolder(folder)
    path = results.stats_path("val", step)
    before = read_stats(path) if path.is_file() else {"step": step}
    views = before.get("per_view")
    if isinstance(views, dict) and views.keys() != stats["per_view"].keys():
        # those that are held out now may be views that it was trained on
        why = "photographs were added or removed since its training, so that other views are held out"
        print(f"note: {folder}: {why}; stats and report stay as they are", file=sys.stderr)
        return
    results.write_stats("val", step, {**before, **stats})
    write_report(folder)


def _lines(stats: dict[str, Any]) -> list[str]:
    variants = [f"LPIPS      {value:.4f} ({variant})" for variant, value in stats["lpips_variants"].items()]
    return [
        f"views      {stats['views']}",
        f"PSNR       {stats['psnr']:.3f} dB",
        *([f"cc PSNR    {stats['cc_psnr']:.3f} dB, colours fitted to each photograph"] if "cc_psnr" in stats else []),
        f"SSIM       {stats['ssim']:.4f}",
        *(variants or ["LPIPS      not measured: give --lpips-alex or --lpips-vgg FILE"]),
        f"Gaussians  {stats['num_GS']:,} ({stats['num_GS_above_floor']:,} with opacity >= 1/255)",
        f"per pixel  {stats['n_blended']:.1f} blended, {stats['n_traversed']:.1f} traversed",
        f"opacity    {stats['opacity_below_0.1']:.1%} under 0.1, {stats['opacity_above_0.9']:.1%} over 0.9",
    ]
