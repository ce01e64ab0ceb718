"""How far the runs of a scale are: finished, begun, to do, or not possible with this version of the program."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from paper_repro.jobs import Job, trainable
from paper_repro.rows import ROWS
from paper_repro.scenes import SCENES


def state(job: Job, results: Path, work: Path) -> str:
    """Say how far a job is: "done", "step 1,500", "to do" or "not in this version"."""
    if job.is_done(results):
        return "done"
    from pop_fast.train.checkpoint import list_checkpoints

    found = list_checkpoints(job.work(work))
    if found:
        return f"step {found[-1][0] + 1:,}"
    return "to do" if trainable(job) else "not in this version"


def progress(jobs: Sequence[Job], results: Path, work: Path) -> list[str]:
    """Write a grid of rows by scenes, and one line of counts.

    Args:
        jobs: of one scale.
        results: the folder of results.
        work: the folder of checkpoints.
    """
    cells: dict[tuple[str, str], list[str]] = {}
    for job in jobs:
        cells.setdefault((job.row.name, job.scene.name), []).append(state(job, results, work))
    # in the order of the tables and of the scales, whatever the order of the jobs
    rows = [row for row in ROWS if any(row == name for name, _ in cells)]
    scenes = [scene for scene in SCENES if any(scene == name for _, name in cells)]
    shown = {key: _merged(states) for key, states in cells.items()}
    first = max(map(len, rows))
    widths = [max(len(scene), *(len(shown.get((row, scene), "")) for row in rows)) for scene in scenes]
    lines = ["  ".join(["".ljust(first), *(scene.ljust(width) for scene, width in zip(scenes, widths, strict=True))])]
    for row in rows:
        texts = (shown.get((row, scene), "").ljust(width) for scene, width in zip(scenes, widths, strict=True))
        lines.append("  ".join([row.ljust(first), *texts]))
    done = sum(states.count("done") for states in cells.values())
    lines.append(f"{done} of {len(jobs)} done")
    return [line.rstrip() for line in lines]


def _merged(states: Sequence[str]) -> str:
    """Merge what is said of several seeds."""
    done = states.count("done")
    rest = [state for state in states if state != "done"]
    if done == 0 or not rest:
        return ", ".join(dict.fromkeys(states)) + (f" x {done}" if done > 1 else "")
    return f"{done} done, {', '.join(dict.fromkeys(rest))}"
