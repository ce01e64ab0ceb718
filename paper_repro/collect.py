"""What a finished training says, gathered from its result folder into one `Result`, and what it leaves to be published.

To be published are its splat and two renders of held-out views, in `<folder>/<scale>/<row>/<scene>_<seed>/`. The result
has the SHA-256 of each, by which anybody who gets the folder from elsewhere can tell whether a picture or a splat is
the result's.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from paper_repro.jobs import Job
from paper_repro.results import BINS, LPIPS_VARIANTS, UNTIMED, Result, run_id, settings_hash, to_line
from pop_fast.errors import PopError
from pop_fast.io.read_back import read_arrays, read_json
from pop_fast.machine import processor_kind
from pop_fast.train.results import ResultFolder, read_config

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.train import TrainConfig

# what `train_row` leaves in the result folder about the capture and the program, from before the first step
BESIDE: Final = "row.json"
# what `ProbedRun` leaves there
PROBE: Final = "probe.json"
_AGAIN: Final = "train the row again in an empty folder"
# where things lie, which engine takes the steps and how often something is written: no part of what was trained
_APART: Final = frozenset(
    {
        *("data", "result_dir", "eval_steps", "save_steps", "checkpoint_every", "keep_checkpoints", "max_renders"),
        *("progress", "lpips_vgg", "lpips_alex", "target_cache_mb", "seed", "threads", "backend", "log_every"),
    }
)
# as many points as a curve of the whole schedule has with one each 100 steps
_POINTS: Final = 300
# what the points of a curve have, where it was measured, before and after the loss between pixels
_COLUMNS: Final = ("step", "num_gaussians", "psnr", "psnr_test", "seconds", "n_blended", "n_traversed")
_CHANGES: Final = ("d_ssim", "pop", "cloned", "split", "pruned")
_PROBED: Final = ("grad_", "probe_")
# a PSNR of five digits has three after the point
_PRECISE: Final = ("psnr", "psnr_test", "seconds")
_SSIM: Final = "11 x 11 Gaussian window, sigma 1.5, windows inside the image, floats clamped to [0, 1]"
_LPIPS: Final = {
    "vgg_01": "vgg_01: VGG16, images in [0, 1]",
    "alex_norm": "alex_norm: AlexNet, images moved to [-1, 1]",
    "alex_01": "alex_01: AlexNet, images in [0, 1]",
}
_TIMING: Final = (
    "training steps and density control with its passes over the views; reading the capture, measuring held-out views "
    "and writing files are apart"
)
_SPLAT: Final = "splat.spz"


def state_of_data(job: Job, config: TrainConfig, capture: Capture) -> dict[str, Any]:
    """Describe the photographs that a training uses, as the protocol of its result says it.

    Args:
        job: the training.
        config: its settings.
        capture: as it was loaded.

    Returns:
        data_hash, and of the protocol: split, test_views, images, factor, width, height, resize.
    """
    from pop_fast.train.checkpoint import capture_fingerprint

    prints = capture_fingerprint(capture, replace(config, test_every=0))
    first, published = capture.views[0], job.scene.images
    folder = "the photographs that the capture lists" if published is None else f"{published}, as published"
    return {
        "data_hash": hashlib.sha256(json.dumps(prints, sort_keys=True).encode()).hexdigest(),
        "split": f"every {config.test_every}th by name is held out",
        "test_views": len(capture.test_views(config.test_every)),
        "images": folder,
        "factor": job.factor,
        "width": first.width,
        "height": first.height,
        "resize": config.resize if job.factor > 1 else "none",
    }


def collect(job: Job, folder: Path, files: Mapping[str, str]) -> Result:
    """Gather a finished training.

    Args:
        job: what was trained.
        folder: its result folder.
        files: what `paper_repro.collect` has made of it, by name, with hashes.

    Raises:
        PopError: something of a finished training is absent or damaged; names the file or the folder.
    """
    try:
        found = _collected(job, folder, files)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        if isinstance(error, PopError):
            raise
        raise PopError(
            f"{folder}: its records are not what a finished training leaves ({error!r}); {_AGAIN}"
        ) from error
    try:
        to_line(found)
    except PopError as error:
        raise PopError(f"{folder}: {error}") from error
    return found


def _collected(job: Job, folder: Path, files: Mapping[str, str]) -> Result:
    config = read_config(folder)
    last = config.max_steps - 1
    stats, before = final_stats(folder, last), final_stats(folder, last, "train")
    said = read_json(folder / BESIDE, _AGAIN)
    data_hash, commit = said.pop("data_hash"), said.pop("commit")
    untimed = said.pop("untimed", False)
    settings = _settings(config)
    config_hash = settings_hash(settings)
    n, size = stats["num_GS"], job.row.bytes_per_gaussian
    variants = stats["lpips_variants"]
    return Result(
        scale=job.scale.name,
        row=job.row.name,
        scene=job.scene.name,
        seed=job.seed,
        run=run_id(config_hash, data_hash, job.seed),
        commit=commit,
        config_hash=config_hash,
        data_hash=data_hash,
        machine=", ".join(stats[name] for name in ("machine", "gpu") if name in stats),
        cpu=processor_kind(),
        # a step by autograd is as a backend draws it
        engine=f"torch ({stats['backend']})" if stats["stepper"] == "torch" else stats["stepper"],
        threads=stats["threads"],
        versions=stats["versions"],
        protocol={
            **said,
            "ssim": _SSIM,
            "lpips": "; ".join(_LPIPS[name] for name in variants) or "not measured",
            "timing": _TIMING + (UNTIMED if untimed else ""),
            "checkpoint_bytes_per_gaussian": size,
        },
        schedule=settings,
        seconds={
            "load": stats["seconds_loading"],
            "train": stats["seconds"],
            "evaluate": max(stats["seconds_total"] - before["seconds_total"], 0.0),
            **({"cpu": stats["seconds_cpu"]} if "seconds_cpu" in stats else {}),
        },
        num_gaussians=n,
        checkpoint_mib=n * size / 2**20,
        psnr=stats["psnr"],
        ssim=stats["ssim"],
        lpips={name: variants.get(name) for name in LPIPS_VARIANTS},
        lpips_reason=_lpips_reason(stats),
        n_blended=stats.get("n_blended"),
        n_traversed=stats.get("n_traversed"),
        opacity_below_01=stats["opacity_below_0.1"],
        opacity_above_09=stats["opacity_above_0.9"],
        opacity_histogram=_histogram(folder, last),
        curve=curve_of(folder, config.max_steps),
        per_view={name: {key: view[key] for key in ("psnr", "ssim")} for name, view in stats["per_view"].items()},
        ply_hash=file_hash(ply_of(folder, last)),
        files=files,
    )


def first_change(result: Result, config: TrainConfig) -> str | None:
    """Say which setting of a finished result the row has otherwise now, or None; settings that are new do not count."""
    now = _settings(config)
    # None is the profile's: what that comes to in the world of a capture is known when the capture is read
    free = {"near_plane"} if config.near_plane is None else set[str]()
    for name, value in result.schedule.items():
        if name not in free and name in now and now[name] != value:
            return f"{name} = {value}, and the row has {now[name]} now"
    return None


def _settings(config: TrainConfig) -> dict[str, Any]:
    return {name: value for name, value in config.flat().items() if name not in _APART}


def final_stats(folder: Path, step: int, kind: str = "val") -> dict[str, Any]:
    """Read what a finished training has measured after its last step.

    Args:
        folder: its result folder.
        step: the last, counted from 0.
        kind: "val" for everything, "train" for what was known before the held-out views were measured.

    Raises:
        PopError: it is not finished; names the file.
    """
    results = ResultFolder(folder)
    found = results.read_stats(kind, step)
    if found is None:
        raise PopError(
            f"{results.stats_path(kind, step)}: is absent, so the training is not finished; run the row again"
        )
    return found


def _lpips_reason(stats: Mapping[str, Any]) -> str | None:
    missing = [name for name in LPIPS_VARIANTS if name not in stats["lpips_variants"]]
    if not missing:
        return None
    return stats["lpips_reason"] or f"no weights were given for {', '.join(missing)}"


def _histogram(folder: Path, last: int) -> tuple[int, ...]:
    path = folder / "report_data" / f"opacity_step{last}.npz"
    if not path.is_file():
        raise PopError(f"{path}: is absent; {_AGAIN}")
    counts = read_arrays(path, {"counts": ("iu", 1)}, _AGAIN)["counts"]
    if len(counts) % BINS:
        raise PopError(f"{path}: counts has {len(counts)} bins, which no run writes; {_AGAIN}")
    return tuple(int(count) for count in counts.reshape(BINS, -1).sum(axis=1))


def curve_of(folder: Path, max_steps: int) -> tuple[dict[str, Any], ...]:
    """Make the curve of a training, as far as it has come.

    It has the records of single training views, the measurements of all held-out views, and what a few training views
    say all along.

    Raises:
        PopError: a record is damaged.
    """
    # it needs torch, which listing rows does not
    from pop_fast.view.report.source import read_records

    points = {record["step"]: dict(record) for record in _thinned(read_records(folder), max_steps)}
    for path in sorted((folder / "stats").glob("val_step*.json")):
        stats = read_json(path, _AGAIN)
        # at a step that has a record too, what that says of its training view stays
        measured = {**stats, "num_gaussians": stats["num_GS"], "psnr": None, "psnr_test": stats["psnr"]}
        points[stats["step"]] = measured | _known(points.get(stats["step"], {}))
    for step, probed in read_probe(folder).items():
        points[step] = {"step": step, **probed} | _known(points.get(step, {}))
    return tuple(_point(points[step]) for step in sorted(points))


def read_probe(folder: Path) -> dict[int, dict[str, Any]]:
    """Read what `ProbedRun` has measured in a result folder, by step; nothing where it has not.

    Raises:
        PopError: the file is damaged.
    """
    path = folder / PROBE
    found = read_json(path, _AGAIN) if path.is_file() else {}
    if not all(step.isascii() and step.isdecimal() and isinstance(point, dict) for step, point in found.items()):
        raise PopError(f"{path}: must hold an object for each step; {_AGAIN}")
    return {int(step): point for step, point in found.items()}


def spacing(max_steps: int) -> int:
    """Return how many steps at least lie between two points of a curve."""
    return max(max_steps // _POINTS, 1)


def _thinned(records: Iterable[Mapping[str, Any]], max_steps: int) -> list[Mapping[str, Any]]:
    """Keep about `_POINTS` of the records, the first among them."""
    kept: list[Mapping[str, Any]] = []
    for record in records:
        if not kept or record["step"] >= kept[-1]["step"] + spacing(max_steps):
            kept.append(record)
    return kept


def _known(point: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in point.items() if value is not None}


def digits(name: str) -> int:
    """Return how many significant digits a column of a curve keeps."""
    return 5 if name in _PRECISE else 4


def _point(found: Mapping[str, Any]) -> dict[str, Any]:
    """Take what a curve holds, in one order, rounded to what a figure shows; what JSON cannot hold is left out."""
    from pop_fast.train.presets import LOSSES

    more = sorted(name for name in found if name.startswith(_PROBED))
    names = (*_COLUMNS, *sorted(LOSSES), *_CHANGES, *more)
    values = {name: found[name] for name in names if found.get(name) is not None}
    return {
        name: float(f"{value:.{digits(name)}g}") if isinstance(value, float) else value
        for name, value in values.items()
        if math.isfinite(value)
    }


def publish(job: Job, work: Path, folder: Path, last: int) -> dict[str, str]:
    """Write the splat as SPZ, and the first and the last render of a held-out view that the training kept as PNG.

    Args:
        job: what was trained.
        work: its result folder.
        folder: of everything that is to be published.
        last: its last step, counted from 0.

    Returns:
        The names of the files and the SHA-256 of each.

    Raises:
        PopError: the training is not finished, or a file cannot be written; names it.
    """
    from pop_fast.io.formats.files import load_splat_file, save_as
    from pop_fast.io.images import write_png
    from pop_fast.view.report.source import read_view

    place, stored = job.work(folder), load_splat_file(ply_of(work, last))
    save_as(place / _SPLAT, "spz", stored.params, stored.antialiased, stored.frame)
    names = [_SPLAT]
    kept = sorted((work / "report_data").glob(f"val_step{last}_*.npz"))
    for path in dict.fromkeys([*kept[:1], *kept[-1:]]):
        names.append(f"held_out_{path.stem.rpartition('_')[2]}.png")
        write_png(place / names[-1], read_view(path)["render"])
    return {name: file_hash(place / name) for name in names}


def ply_of(work: Path, last: int) -> Path:
    """Return the file of the Gaussians that a finished training ended with.

    Raises:
        PopError: it is absent.
    """
    path = work / "ply" / f"point_cloud_{last}.ply"
    if not path.is_file():
        raise PopError(f"{path}: is absent, so the training is not finished; run the row again")
    return path


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file's content in hex digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
