"""Trainings of rows at toy scale, or shorter, in folders of their own."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from dataclasses import fields, replace
from functools import cache
from pathlib import Path

from paper_repro.jobs import Job, job_named
from paper_repro.results import Result
from paper_repro.scenes import SCENES
from paper_repro.train_row import Options, capture_folder

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
