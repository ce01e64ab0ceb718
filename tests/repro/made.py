"""Results that no training made: for tests of what reads them, and written nowhere but into a test's own folder."""

from __future__ import annotations

import atexit
import hashlib
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

from paper_repro.figures import FIGURES, curves, style, tradeoffs
from paper_repro.figures.data import Asked
from paper_repro.figures.style import Drawn
from paper_repro.jobs import Job, job_named
from paper_repro.results import BINS, Result, run_id, settings_hash
from paper_repro.scenes import SCENES
from paper_repro.train_row import Options, capture_folder

_SCHEDULE = {"max_steps": 10_000, "factor": 4, "pop.blur_start_iter": 1000, "pop.blur_stop_iter": 2333}
# the paper's, on which every claim can be decided
WHOLE = {"method": "pop", "max_steps": 30_000, "pop.blur_start_iter": 3000, "pop.blur_stop_iter": 7000}
_VIEWS = {f"{letter}.png": {"psnr": 30.0, "ssim": 0.9} for letter in "abcdefg"}
PLAIN = Result(
    scale="small",
    row="pop",
    scene="fox",
    seed=42,
    run=run_id(settings_hash(_SCHEDULE), "d" * 64, 42),
    commit="25d084e",
    config_hash=settings_hash(_SCHEDULE),
    data_hash="d" * 64,
    machine="a machine",
    cpu="a kind",
    engine="native",
    threads=1,
    versions={"python": "3.11.0"},
    protocol={
        "split": "every 8th by name is held out",
        "test_views": 7,
        "images": "images",
        "factor": 4,
        "width": 270,
        "height": 480,
        "resize": "area",
        "ssim": "valid",
        "lpips": "no weights",
        "timing": "training loop",
        "checkpoint_bytes_per_gaussian": 236,
    },
    schedule=_SCHEDULE,
    seconds={"load": 1.0, "train": 100.0, "evaluate": 2.0, "cpu": 100.0},
    num_gaussians=1000,
    checkpoint_mib=1000 * 236 / 2**20,
    psnr=30.0,
    ssim=0.9,
    lpips={"vgg_01": None, "alex_norm": None, "alex_01": None},
    lpips_reason="no weights were given (lpips_vgg, lpips_alex)",
    n_blended=20.0,
    n_traversed=100.0,
    opacity_below_01=1.0,
    opacity_above_09=0.0,
    opacity_histogram=(1000, *[0] * (BINS - 1)),
    curve=(),
    per_view=_VIEWS,
    ply_hash="e" * 64,
    files={"splat.spz": "f" * 64},
)


def result(row: str = "pop", scene: str = "fox", seed: int = 42, n: int = 1000, **changes: Any) -> Result:
    """Make a result that agrees with itself: what follows from its row, scene, seed, `n` and the changes is set so."""
    protocol = changes.get("protocol", PLAIN.protocol)
    told = {
        "num_gaussians": n,
        "checkpoint_mib": n * protocol["checkpoint_bytes_per_gaussian"] / 2**20,
        "opacity_histogram": (n, *[0] * (BINS - 1)),
        "data_hash": hashlib.sha256(f"{row} {scene} {n}".encode()).hexdigest(),
        **changes,
        "schedule": {"factor": protocol["factor"], **changes.get("schedule", _SCHEDULE)},
    }
    config_hash, counts = settings_hash(told["schedule"]), told["opacity_histogram"]
    agreeing = {
        "config_hash": config_hash,
        "run": run_id(config_hash, told["data_hash"], seed),
        "opacity_below_01": sum(counts[:5]) / max(sum(counts), 1),
        "opacity_above_09": sum(counts[-5:]) / max(sum(counts), 1),
        "per_view": {name: {"psnr": told.get("psnr", 30.0), "ssim": told.get("ssim", 0.9)} for name in _VIEWS},
    }
    return replace(PLAIN, row=row, scene=scene, seed=seed, **{**agreeing, **told})


def whole(row: str = "pop", scene: str = "fox", seed: int = 42, n: int = 1000, **changes: Any) -> Result:
    """Make a result of the paper's whole schedule."""
    return result(row, scene, seed, n, **{"schedule": WHOLE, **changes})


def curve(counts: Mapping[int, int], **more: Sequence[float | None]) -> tuple[Mapping[str, Any], ...]:
    """Make a curve from the number of Gaussians by step, and other columns in the same order."""
    columns = {name: list(values) for name, values in more.items()}
    return tuple(
        {"step": step, "num_gaussians": n, **{c: values[i] for c, values in columns.items() if values[i] is not None}}
        for i, (step, n) in enumerate(counts.items())
    )


# Trainings of rows at toy scale, or shorter, in folders of their own.

# measured in seconds, so not the same twice
TIMES = {"seconds"}


@cache
def demo() -> Path:
    """Make the demo capture once for this module."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return capture_folder(SCENES["demo"], Options(data=folder, work=folder))


def options(folder: Path, **more) -> Options:
    how = Options(**{"data": folder, "results": folder / "results", "work": folder / "work", "quiet": True, **more})
    shutil.copytree(demo(), how.work / "demo", dirs_exist_ok=True)
    return how


def toy(row: str, **scale) -> Job:
    job = job_named(row, "demo", "toy")
    return replace(job, scale=replace(job.scale, **scale))


def values(result: Result) -> dict:
    """What must be the same in two trainings of one row: everything but times."""
    found = {field.name: getattr(result, field.name) for field in fields(Result) if field.name not in TIMES}
    found["curve"] = [{key: value for key, value in point.items() if key not in TIMES} for point in result.curve]
    return found


def asked(figure: str, results: list[Result], folder: Path = Path("nowhere"), scale: str = "small") -> Asked:
    return Asked(figure, scale, [r for r in results if r.scale == scale], folder, folder)


def drawn(figure: str, results: list[Result], **more) -> Drawn:
    """Draw one figure of results that are nowhere on the disk."""
    module = {"tradeoffs": tradeoffs, "curves": curves}[FIGURES[figure][0]]
    with style.look():
        return getattr(module, FIGURES[figure][1])(asked(figure, results, **more))


def lines(made: Drawn) -> list[dict]:
    return [dict(zip(made.columns, row, strict=True)) for row in made.rows]


def texts(made: Drawn) -> str:
    """Read all that is written in a figure, in one line."""
    from matplotlib.text import Text

    return " ".join(found.get_text().replace("\n", " ") for found in made.figure.findobj(Text))
