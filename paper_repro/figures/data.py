"""What a figure takes of the results: which scenes it averages over, and what is missing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from statistics import fmean
from typing import TypeAlias

import numpy as np

from paper_repro.results import Result
from paper_repro.scenes import scale_named
from pop_fast.errors import PopError

# steps and values
Curve: TypeAlias = tuple[np.ndarray, np.ndarray]


class NoDataError(PopError):
    """Say that nothing of what a figure shows was run.

    Attributes:
        status: the exit status of `pop-repro figure`.
    """

    status = 1


@dataclass(frozen=True)
class Asked:
    """What is to be drawn, and of what."""

    figure: str  # its number in the paper
    scale: str  # of the results
    results: Sequence[Result]  # all of that scale
    work: Path  # the folder of checkpoints, with the renders of finished rows
    data: Path  # the folder that holds the scenes

    def scenes(self, of_paper: Sequence[str]) -> tuple[str, ...]:
        """Return the scenes that the figure is of: the paper's, or all of a scale that has others."""
        return tuple(of_paper) if self.scale == "paper" else tuple(scale_named(self.scale).factors)


@dataclass(frozen=True)
class Chosen:
    """The results that a figure shows."""

    # by row and scene, one or more seeds each; every row has every scene
    runs: Mapping[str, Mapping[str, tuple[Result, ...]]]
    scenes: tuple[str, ...]  # that all of them have
    missing: tuple[str, ...]  # rows that have none of them
    left_out: tuple[str, ...]  # scenes of the figure that not all rows have

    def of(self, row: str) -> list[Result]:
        """Return all runs of a row."""
        return [result for scene in self.scenes for result in self.runs[row][scene]]

    @property
    def all(self) -> list[Result]:
        """Return all runs."""
        return [result for row in self.runs for result in self.of(row)]


def choose(
    asked: Asked, rows: Iterable[str], scenes: Sequence[str], usable: Callable[[Result], bool] = lambda _: True
) -> Chosen:
    """Choose the scenes over which rows can be compared: those that all have, or else those that most rows have.

    Args:
        asked: what is drawn.
        rows: that it shows.
        scenes: that it is of.
        usable: whether a result has what is shown.

    Raises:
        NoDataError: there is no result of any row on any scene; names them.
    """
    wanted = list(rows)
    runs: dict[str, dict[str, tuple[Result, ...]]] = {}
    for result in asked.results:
        if result.row in wanted and result.scene in scenes and usable(result):
            of_row = runs.setdefault(result.row, {})
            of_row[result.scene] = (*of_row.get(result.scene, ()), result)
    if not runs:
        raise _nothing(asked, wanted, scenes)
    # as many rows as possible come first, then as many scenes
    subsets = [subset for n in range(len(scenes), 0, -1) for subset in combinations(scenes, n)]
    common = max(subsets, key=lambda subset: sum(set(subset) <= set(found) for found in runs.values()))
    shown = {row: runs[row] for row in wanted if set(common) <= set(runs.get(row, {}))}
    missing = tuple(row for row in wanted if row not in shown)
    return Chosen(shown, common, missing, tuple(scene for scene in scenes if scene not in common))


def choose_one_scene(
    asked: Asked, rows: Iterable[str], scene: str, usable: Callable[[Result], bool] = lambda _: True
) -> Chosen:
    """Choose the results of one scene: the paper's, or the first of the scale that most rows have.

    Raises:
        NoDataError: as `choose`.
    """
    wanted, scenes = list(rows), asked.scenes([scene])
    chosen = choose(asked, wanted, scenes, usable)
    first = chosen.scenes[:1]
    runs = {row: {name: found[name] for name in first} for row, found in chosen.runs.items()}
    return Chosen(runs, first, chosen.missing, ())


def mean_of(results: Mapping[str, Sequence[Result]], scenes: Iterable[str], get: Callable[[Result], float]) -> float:
    """Average over the seeds of each scene, then over the scenes."""
    return fmean(fmean(get(result) for result in results[scene]) for scene in scenes)


def curve_of(
    results: Mapping[str, Sequence[Result]], scenes: Iterable[str], key: str, where: str | None = None
) -> Curve:
    """Average a column of the curves over the seeds of each scene, then over the scenes.

    Between two points that a run logged it is linear; outside of what every run logged there is nothing.

    Args:
        results: by scene.
        scenes: to average over.
        key: of the column, which every run has.
        where: another column; only points that have it too are taken.

    Returns:
        Steps and values.
    """
    by_scene = [[_column(result, key, where) for result in results[scene]] for scene in scenes]
    flat = [column for columns in by_scene for column in columns]
    first, last = max(steps[0] for steps, _ in flat), min(steps[-1] for steps, _ in flat)
    steps = np.unique(np.concatenate([steps for steps, _ in flat]))
    steps = steps[(steps >= first) & (steps <= last)]
    means = [np.mean([np.interp(steps, *column) for column in columns], axis=0) for columns in by_scene]
    return steps, np.mean(means, axis=0)


def has(result: Result, *keys: str) -> bool:
    """Say whether a result's curve has something in each of some columns."""
    return all(any(point.get(key) is not None for point in result.curve) for key in keys)


def _column(result: Result, key: str, where: str | None) -> Curve:
    points = [p for p in result.curve if p.get(key) is not None and (where is None or p.get(where) is not None)]
    return np.array([p["step"] for p in points]), np.array([p[key] for p in points], dtype=np.float64)


def _nothing(asked: Asked, rows: Sequence[str], scenes: Sequence[str]) -> NoDataError:
    named = f"figure {asked.figure} at scale {asked.scale} is not drawn"
    old = sorted({r.row for r in asked.results if r.row in rows and r.scene in scenes})
    if old:
        said = f"the results of {', '.join(old)} have no curve of what it shows; remove them and train the rows again"
        return NoDataError(f"{named}: {said}")
    words = f"pop-repro queue --scale {asked.scale} --data DATA --rows {' '.join(rows)}"
    return NoDataError(f"{named}: not run are {', '.join(rows)} on {', '.join(scenes)}; train them with {words}")
