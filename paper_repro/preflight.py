"""What a queue takes before it begins: the hours, and what of data, disk, memory and GPU is lacking.

The hours are those of the paper's GPU: what its tables print of the row on the dataset, and where they print nothing,
POP's times the row's `cost`.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from paper_repro.data_check import check_scene
from paper_repro.jobs import Job
from paper_repro.paper import paper
from paper_repro.scenes import DATASETS, MADE, PaperScene

# of one Gaussian in training: parameters, gradients and two moments in float32; a checkpoint has no gradients
_TRAINING, _CHECKPOINT, _PLY = 4 * 236, 3 * 236, 248
# besides the Gaussians and photographs: the program and its libraries, and what a GPU's renderer lists and sorts
_PROGRAM: Final = 4 * 2**30
# of each of the twelve renders that a row keeps for its figures: render, photograph and dominant Gaussian of a pixel
_RENDERS, _OF_PIXEL = 12, 10
_GIB: Final = 2**30


def hours(job: Job) -> float | None:
    """Return the hours that a training takes of the paper's GPU; None of a scene that the paper does not report."""
    if not job.scene.in_paper:
        return None
    own = _printed(job.row.name, job.scene, "time_s")
    pop = max(_printed("pop", job.scene, "time_s"))
    return (max(own) if own else pop * job.row.cost) / 3600.0


def hours_by_row(jobs: Sequence[Job]) -> list[str]:
    """Write the hours of each row over its scenes and seeds, and their sum; nothing where none is known."""
    found: dict[str, float] = {}
    for job in jobs:
        taken = hours(job)
        if taken is not None:
            found[job.row.name] = found.get(job.row.name, 0.0) + taken
    if not found:
        return []
    width = max(map(len, found))
    lines = [f"{name:<{width}}  {taken:6.1f} h" for name, taken in found.items()]
    gpu = paper().stated["gpu"].value
    source = "by the paper's times, or by a row's cost where it prints none"
    return [*lines, f"{sum(found.values()):.1f} hours of one {gpu} in all, {source}"]


def lacking(jobs: Sequence[Job], data: Path, work: Path, backend: str) -> list[str]:
    """Say what is lacking for some trainings: each point in a line that names the fix.

    Args:
        jobs: to be trained one after the other.
        data: the folder that holds the scenes.
        work: the folder of checkpoints.
        backend: as `pop train --backend`.
    """
    if not jobs:
        return []
    return [*_data(jobs, data), *_disk(jobs, work), *_memory(jobs), *_gpu(jobs, backend)]


def _data(jobs: Sequence[Job], data: Path) -> list[str]:
    scenes = {job.scene.name: job.scene for job in jobs if job.scene.name not in MADE}
    found = [check_scene(scene, data) for scene in scenes.values()]
    return [f"data: {item.scene.name} is {item.status}: {item.reason}" for item in found if item.status != "ok"]


def _disk(jobs: Sequence[Job], work: Path) -> list[str]:
    pixels = [job.scene.size[0] * job.scene.size[1] / job.factor**2 for job in jobs]
    needed = sum(_RENDERS * _OF_PIXEL * count for count in pixels) + max(map(_gaussians, jobs)) * (
        2 * _CHECKPOINT + _PLY
    )
    place = next(folder for folder in (work.absolute(), *work.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(place).free
    if free >= needed:
        return []
    return [
        f"disk: {len(jobs)} trainings leave up to {needed / _GIB:.0f} GiB in {work}, where {free / _GIB:.0f} GiB are "
        "free; name another folder with --work"
    ]


def _memory(jobs: Sequence[Job]) -> list[str]:
    from pop_fast.machine import free_bytes

    def needed_by(job: Job) -> float:
        photographs = job.scene.n_images * job.scene.size[0] * job.scene.size[1] / job.factor**2 * 3
        return photographs + _gaussians(job) * _TRAINING + _PROGRAM

    largest = max(jobs, key=needed_by)
    needed, free = needed_by(largest), free_bytes()
    if free is None or free >= needed:
        return []
    what = f"{largest.row.name} on {largest.scene.name} takes about {needed / _GIB:.0f} GiB"
    return [f"memory: {what}, and {free / _GIB:.0f} GiB are free; end other programs, or leave it out with --scenes"]


def _gpu(jobs: Sequence[Job], backend: str) -> list[str]:
    from pop_fast.api.registry import get_backend

    on_gpu = backend == "auto" or get_backend(backend).device == "cuda"
    if not on_gpu or not any(job.scale.name == "paper" for job in jobs):
        return []
    import torch

    if not torch.cuda.is_available():
        return [
            "GPU: there is no NVIDIA GPU here, and a CPU takes far longer than these hours; run it where there is one, "
            "or train on the CPU all the same with --backend compiled"
        ]
    total = torch.cuda.get_device_properties(0).total_memory
    needed = max(map(_gaussians, jobs)) * _TRAINING + _PROGRAM
    if total >= needed:
        return []
    return [f"GPU: it has {total / _GIB:.0f} GiB, and the largest training takes about {needed / _GIB:.0f} GiB"]


def _gaussians(job: Job) -> float:
    """Return how many Gaussians a training comes to, as far as the paper says: its own number, or the largest there."""
    if not job.scene.in_paper:
        # these captures are smaller than the paper's
        return 2e6
    own = _printed(job.row.name, job.scene, "num_gaussians_k")
    return 1e3 * max(own or _printed(None, job.scene, "num_gaussians_k"))


def _printed(row: str | None, scene: PaperScene, metric: str) -> list[float]:
    """List what the tables print of a row on a scene's dataset, of all rows for None."""
    dataset = DATASETS[scene.dataset].name
    lines = [line for table in paper().tables if dataset in table.datasets for line in table.rows]
    values = [line.values[dataset].get(metric) for line in lines if row in (None, line.row)]
    return [value for value in values if value is not None]
