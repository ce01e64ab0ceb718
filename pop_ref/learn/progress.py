"""How far a student is: which stages have passed as they stand now, the map of the pipeline, and its picture."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.conformance.files import write_file
from pop_ref.learn.course import BY_NAME, COURSE, Stage
from pop_ref.learn.splat import BALLS, PAINT, SH_C0, orbit
from pop_ref.learn.student import Borrowed, Work, borrowing, said, where

_NOTES: Final = ".progress.json"
PASSED, WRITTEN, BEGUN, UNTOUCHED = "passed", "written, not passed", "begun", "borrowed"
_MARKS: Final = {PASSED: "●", WRITTEN: "◐", BEGUN: "◔", UNTOUCHED: "○"}
_COLORS: Final = {PASSED: "32", WRITTEN: "33", BEGUN: "33", UNTOUCHED: "2"}


def note_passed(folder: Path, stage: Stage) -> None:
    """Remember that a stage has passed as its file is now."""
    notes = _notes(folder)
    notes.setdefault("passed", {})[stage.name] = _digest(folder / stage.file)
    _keep(folder, notes)


def passed_stages(work: Work) -> list[str]:
    """Name the stages that have passed as their files are now."""
    return [stage.name for stage in COURSE if state(work, stage) == PASSED]


def asked_before(folder: Path, stage: Stage) -> bool:
    """Tell whether the answer of a stage has been asked for before, and remember that it has been now."""
    notes = _notes(folder)
    asked = notes.setdefault("asked", [])
    if stage.name in asked:
        return True
    asked.append(stage.name)
    _keep(folder, notes)
    return False


def state(work: Work, stage: Stage) -> str:
    """Return how far a stage is; it has passed only while its file is as it was then."""
    path = work.folder / stage.file
    if path.exists() and _notes(work.folder).get("passed", {}).get(stage.name) == _digest(path):
        return PASSED
    if work.is_whole(stage):
        return WRITTEN
    return BEGUN if work.written[stage.name] else UNTOUCHED


def course_map(work: Work, color: bool = False) -> str:
    """Draw the pipeline, a line a stage."""
    width = max(len(name) for name in BY_NAME)
    lines, n_passed = [], 0
    for number, stage in enumerate(COURSE, start=1):
        how = state(work, stage)
        n_passed += how == PASSED
        count = f"{len(work.written[stage.name])}/{len(stage.names)}"
        line = f"{number:>2} {_MARKS[how]} {stage.name:<{width}}  {count:>5}  {how:<19}  {stage.does}"
        lines.append(f"\x1b[{_COLORS[how]}m{line}\x1b[0m" if color else line)
    return "\n".join([*lines, f"{n_passed} of {len(COURSE)} stages have passed"])


def picture(work: Work, size: int = 48) -> tuple[np.ndarray, list[str]]:
    """Render the toy by the student's stages, and the oracle's where there is none or where it stops with an error.

    Returns:
        The picture, and a line for each stage that stopped.
    """
    stages, complaints = list(COURSE), []
    while True:
        with borrowing(work, stages) as borrowed:
            try:
                return _rendered(borrowed, size), complaints
            except Exception as error:
                at = where(error, work.folder)
                guilty = [stage for stage in stages if f"{work.folder / stage.file}, line" in at]
                # what stops in the oracle was handed something by the last stage that the student wrote
                guilty = guilty or [stage for stage in stages if work.written[stage.name]][-1:]
                if not guilty:
                    raise
                stages.remove(guilty[0])
                complaints.append(f"{guilty[0].name} is borrowed in the picture: {at}: {said(error)}")


def _rendered(borrowed: Borrowed, size: int) -> np.ndarray:
    types, params = borrowed.module("records"), toy()
    gaussians = borrowed.module("training").gaussians_from_params(params)
    image = borrowed.module("render").render(gaussians, types.Camera(*orbit(0.6, size))).image
    if image.shape != (size, size, 3) or not np.all(np.isfinite(image)):
        raise ValueError("the picture has numbers that are not finite")
    return image


def toy() -> dict[str, np.ndarray]:
    """Cover the toy's balls and floor with flat Gaussians of their colour, as raw parameters."""
    means, normals, sizes, colors = [], [], [], []
    for centre, radius, paint in zip(*BALLS, PAINT, strict=True):
        n = evenly(90)
        means.append(centre + radius * n)
        normals.append(n)
        sizes.append(np.full(90, 0.16 * radius))
        colors.append((0.25 + 0.75 * np.maximum(n @ [0.4, -0.8, 0.45], 0.0))[:, None] * paint)
    x, z = (axis.ravel() for axis in np.meshgrid(*[(np.arange(12) - 5.5) / 4.0] * 2))
    means.append(np.stack([x, 0.0 * x, z], axis=1))
    normals.append(np.tile([0.0, 1.0, 0.0], (144, 1)))
    sizes.append(np.full(144, 0.12))
    colors.append((0.35 + 0.4 * ((np.floor(2 * x) + np.floor(2 * z)) % 2))[:, None] * np.ones(3))
    n, size, color = np.concatenate(normals), np.concatenate(sizes), np.concatenate(colors)
    scales = np.log(np.stack([0.15 * size, size, size], axis=1))
    return {
        "means": np.concatenate(means),
        # the half-turn between the x axis and the normal takes the first onto the second
        "quats": np.concatenate([1.0 + 1e-6 + n[:, :1], 0.0 * n[:, :1], -n[:, 2:], n[:, 1:2]], axis=1),
        "scales": scales,
        "opacities": np.full(len(n), 3.0),
        "sh0": ((color - 0.5) / SH_C0)[:, None],
    }


def evenly(n: int) -> np.ndarray:
    """Spread points evenly over the unit sphere, along a spiral. [n, 3]

    Example:
        >>> evenly(90).mean(axis=0).round(2) + 0.0
        array([0., 0., 0.])
    """
    k = np.arange(n)
    z, turn = 1.0 - (2.0 * k + 1.0) / n, np.pi * (3.0 - np.sqrt(5.0)) * k
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)


def _notes(folder: Path) -> dict[str, Any]:
    path = folder / _NOTES
    try:
        found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        if not (isinstance(found.get("passed", {}), dict) and isinstance(found.get("asked", []), list)):
            raise ValueError("passed must be an object, and asked a list")
    except (ValueError, AttributeError, RecursionError):
        raise ValueError(f"{path} is damaged; delete it, and check the stages again") from None
    return found


def _keep(folder: Path, notes: dict[str, Any]) -> None:
    write_file(folder / _NOTES, json.dumps(notes, indent=1) + "\n")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
