"""Figures 1 and 6b: PSNR against training time, and against the number of Gaussians.

A name stands next to its marker, none over another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from paper_repro.claims import METHODS, SWEEP, claims
from paper_repro.evidence import Evidence, Group, Groups, groups
from paper_repro.figures.data import Asked, Chosen, choose, mean_of
from paper_repro.figures.style import (
    COLUMN,
    TEXT,
    Drawn,
    Sheet,
    color_of,
    count,
    darker,
    foot,
    foot_of,
    log_ticks,
    name_of,
)
from paper_repro.paper import paper
from paper_repro.results import Result, most_timed_on

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STAR: Final = "l2"
# height of a panel of figure 6b with its title and its axis, inches
_PANEL: Final = 1.85
# area of the largest marker, square points
_LARGEST: Final = 330.0
# and of the smallest in which its middle is marked
_WITH_MIDDLE: Final = 16.0
# left, bottom, right, top in points
Box = tuple[float, float, float, float]
# directions from the marker, the best first
_SIDES: Final = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))
# between marker and name; one that stands farther off is joined to its marker by a line
_GAPS: Final = (2.0, 9.0, 20.0)
# least distance of two names, points
_APART: Final = 2.0
# what it costs in square points covered: a point of the line that joins a name, and to seem to be another marker's name
_JOINED, _MISTAKEN = 4.0, 120.0


@dataclass(frozen=True)
class _Point:
    """A row in the plane of a figure; `area` in square points."""

    row: str
    x: float
    y: float
    n: float
    area: float
    text: str


def psnr_against_time(asked: Asked) -> Drawn:
    """Figure 1: PSNR against training time; the area of a marker is the number of Gaussians."""
    timed, without = _timed(asked, asked.scenes(paper().datasets["Tanks & Temples"]))
    chosen = _whole(asked, timed)
    means = {row: _means(timed, chosen, row) for row in chosen.runs}
    largest = max(n for _, _, n in means.values())
    points = [
        _Point(row, seconds, psnr, n, _LARGEST * n / largest, f"{name_of(row)}\n{count(n)}")
        for row, (seconds, psnr, n) in means.items()
    ]
    where = " and ".join(sorted({r.trained_on for r in timed.all}))
    clock = "" if all(r.is_timed for r in timed.all) else ", by the clock though there may have been other work"
    alone = "" if len(timed.all) == len(chosen.all) else ", of the runs there alone"
    note = foot(
        asked, chosen, f"Area of a marker: number of Gaussians, written at it. Time on {where}{clock}{alone}.", *without
    )
    sheet = Sheet(note, 2.3)
    axes = sheet.panel(left=0.52, right=0.1)
    _plane(axes, points, "training time (s)", 0.16)
    # small markers lie on large ones
    for point in sorted(points, key=lambda point: -point.area):
        hollow = point.row.endswith("_star")
        color = color_of(point.row)
        ring, disc = {"facecolor": "none", "edgecolor": color, "linewidth": 1.0}, {"color": color, "linewidth": 0}
        axes.scatter(point.x, point.y, s=point.area, alpha=0.85, **(ring if hollow else disc))
        if point.area > _WITH_MIDDLE:
            axes.scatter(point.x, point.y, s=2.0, color=color if hollow else "white", linewidth=0)
    _name(axes, points)
    return Drawn(sheet.figure, *_table(timed, chosen))


def psnr_against_count(asked: Asked) -> Drawn:
    """Figure 6b: PSNR against the number of Gaussians, for L1 / n and for L2, a panel a capture."""
    scenes = asked.scenes(paper().datasets["Mip-NeRF 360"])
    rows = (*SWEEP, _STAR)
    found = groups(r for r in asked.results if r.row in rows and r.scene in scenes)
    run = [scene for scene in scenes if scene in found]
    # one row alone is compared with nothing
    shown = [scene for scene in run if len(found[scene]) > 1] or run
    if not shown:
        # which says what was not run
        _ = choose(asked, rows, scenes)
    claim = next(claim for claim in claims(asked.scale, asked.results) if claim.id == "l2")
    judged = {e.scene: e for e in claim.told.evidence}
    runs = [r for scene in shown for group in found[scene].values() for r in group.runs]
    missing = [
        f"Not run on {scene}: {', '.join(map(name_of, lacking))}."
        for scene in run
        if (lacking := [row for row in rows if row not in found[scene]])
    ]
    note = " ".join(
        [
            "Circles: L1 / n; star: L2. Each with 1 - SSIM at weight 0.01; growth by gradient alone. Means over seeds.",
            *foot_of(asked.scale, runs, averaged=False),
            *missing,
        ]
    )
    columns = 1 if len(shown) < 3 else 2
    lines = -(-len(shown) // columns)
    sheet = Sheet(note, lines * _PANEL, COLUMN if columns == 1 else TEXT)
    for i, scene in enumerate(shown):
        width = sheet.width / columns
        left, bottom = 0.52 + width * (i % columns), 0.33 + (lines - 1 - i // columns) * _PANEL
        axes = sheet.axes(left, bottom, width - 0.62, _PANEL - 0.33 - 0.2)
        _sweep_panel(axes, found[scene])
        axes.set_title(f"{scene}: {_told(judged.get(scene))}")
    return Drawn(sheet.figure, *_sweep_table(found, shown, judged))


def _sweep_panel(axes: Axes, by_row: Mapping[str, Group]) -> None:
    """Draw the runs of one capture: L1 / n joined by rising count, which is the curve that the claim judges by."""
    points = [
        _Point(row, group.n, group.psnr, group.n, 90.0 if row == _STAR else 18.0, _short(row))
        for row, group in sorted(by_row.items(), key=lambda item: item[1].n)
    ]
    _plane(axes, points, "Gaussians", 0.12)
    circles = [point for point in points if point.row != _STAR]
    color = color_of("l1_div_1")
    axes.plot([p.x for p in circles], [p.y for p in circles], color=color, linewidth=0.7, alpha=0.5)
    axes.scatter([p.x for p in circles], [p.y for p in circles], s=18.0, color=color, linewidth=0, zorder=3)
    for point in (p for p in points if p.row == _STAR):
        axes.scatter(point.x, point.y, s=point.area, marker="*", color=color_of(_STAR), linewidth=0, zorder=4)
    _name(axes, points, [point.row for point in circles])


def _short(row: str) -> str:
    return "L2" if row == _STAR else "L1" if row == "l1_div_1" else name_of(row).replace(" ", "")


def _told(evidence: Evidence | None) -> str:
    """Say what the claim says of one capture, in a few words."""
    if evidence is None or not evidence.nearest:
        return "not compared"
    return f"L2 less L1 / n {evidence.nearest.rpartition(': ')[2]}, {evidence.verdict}"


def _sweep_table(
    found: Groups, scenes: Sequence[str], judged: Mapping[str, Evidence]
) -> tuple[Sequence[str], Sequence[Sequence[Any]]]:
    rows: list[Sequence[Any]] = []
    for scene in scenes:
        for row in (row for row in (*SWEEP, _STAR) if row in found[scene]):
            group = found[scene][row]
            rows += [(scene, row, r.seed, r.run, r.psnr, r.num_gaussians) for r in group.runs]
            rows.append((scene, row, "mean", "", group.psnr, group.n))
        rows.append((scene, "l2 less l1_div", "", _told(judged.get(scene)), "", ""))
    return ("scene", "row", "seed", "run", "psnr", "num_gaussians"), rows


def _timed(asked: Asked, scenes: Sequence[str]) -> tuple[Chosen, list[str]]:
    """Choose what was timed on one machine, without scenes whose times do not compare where others have every row.

    A run by the clock stands in only for a row that has no other there.

    Returns:
        The results, and what the note says of those that are left out.
    """
    rows = (*METHODS, "pop")
    every = [r for r in asked.results if r.row in rows and r.scene in scenes]
    best = most_timed_on((r.row, r) for r in every)
    has_time = {(r.row, r.scene) for r in every if r.is_timed and r.trained_on == best}

    def there(result: Result) -> bool:
        if best is None:
            return True
        return result.trained_on == best and (result.is_timed or (result.row, result.scene) not in has_time)

    chosen = choose(asked, rows, scenes, there)
    untimed = {r.scene for r in chosen.all if not r.is_timed}
    said: list[str] = []
    if untimed and untimed != set(chosen.scenes):
        chosen = choose(asked, rows, [scene for scene in scenes if scene not in untimed], there)
        said.append(f"Without {', '.join(sorted(untimed))}: time there is by the clock.")
    elsewhere = {r.row for r in every if r.scene in chosen.scenes} - set(chosen.runs)
    if elsewhere:
        said.append(f"Timed on another machine: {', '.join(name_of(row) for row in rows if row in elsewhere)}.")
    return replace(chosen, missing=tuple(row for row in chosen.missing if row not in elsewhere)), said


def _whole(asked: Asked, timed: Chosen) -> Chosen:
    """Add the runs of the same rows and scenes that were timed elsewhere: what they came to does not depend on that."""
    runs = {
        row: {scene: tuple(r for r in asked.results if (r.row, r.scene) == (row, scene)) for scene in timed.scenes}
        for row in timed.runs
    }
    return replace(timed, runs=runs)


def _means(timed: Chosen, chosen: Chosen, row: str) -> tuple[float, float, float]:
    """Average seconds of training over what was timed, PSNR and Gaussians over all runs."""
    seconds = mean_of(timed.runs[row], timed.scenes, attrgetter("training_seconds"))
    psnr, n = (mean_of(chosen.runs[row], chosen.scenes, attrgetter(name)) for name in ("psnr", "num_gaussians"))
    return seconds, psnr, n


def _plane(axes: Axes, points: Sequence[_Point], label: str, room: float) -> None:
    """Settle the axes around points, with some room for their names."""
    xs, ys = [p.x for p in points], [p.y for p in points]
    stretch = max((max(xs) / min(xs)) ** room, 1.08)
    # names stand next to their markers where they can
    low, high = min(xs) / stretch**2.0, max(xs) * stretch**2.0
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    log_ticks(axes.xaxis, low, high)
    margin = max(room * (max(ys) - min(ys)), 0.05)
    axes.set_ylim(min(ys) - margin, max(ys) + margin)
    axes.locator_params(axis="y", nbins=6)
    axes.set_xlabel(label)
    axes.set_ylabel("PSNR (dB)")


def _name(axes: Axes, points: Sequence[_Point], joined: Sequence[str] = ()) -> None:
    """Write each point's name next to its marker.

    Args:
        axes: whose limits and place are settled.
        points: with their names.
        joined: rows that a line joins, in its order.
    """
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextToPath

    to_points, size = 72.0 / axes.figure.dpi, 6.4
    measure, font = TextToPath(), FontProperties(size=size)
    x0, y0 = axes.transAxes.transform((0.0, 0.0)) * to_points
    x1, y1 = axes.transAxes.transform((1.0, 1.0)) * to_points
    at = {p.row: [float(v) * to_points for v in axes.transData.transform((p.x, p.y))] for p in points}
    markers = []
    for point in points:
        lines = point.text.split("\n")
        width = max(measure.get_text_width_height_descent(line, font, ismath=False)[0] for line in lines)
        x, y = at[point.row]
        markers.append(Marker(x, y, (point.area / 3.1416) ** 0.5, width, len(lines) * size * 1.3))
    # the axis itself is a line that names keep off
    frame = (float(x0) + 3.0, float(y0) + 1.0, float(x1), float(y1))
    found = places(markers, frame, along([at[row] for row in joined]))
    for point, marker, place in zip(points, markers, found, strict=True):
        left, bottom, right, top = place.box
        color = darker(color_of(point.row))
        if place.is_joined:
            nearest = (min(max(marker.x, left), right), min(max(marker.y, bottom), top))
            ends = [[v / to_points for v in end] for end in ((marker.x, marker.y), nearest)]
            axes.plot(*axes.transData.inverted().transform(ends).T, color=color, linewidth=0.5, zorder=1)
        axes.annotate(
            point.text,
            ((left + right) / 2.0, (bottom + top) / 2.0),
            xycoords="figure points",
            ha="center",
            va="center",
            size=size,
            linespacing=1.05,
            color=color,
            zorder=5,
        )


def _table(timed: Chosen, chosen: Chosen) -> tuple[Sequence[str], Sequence[Sequence[Any]]]:
    rows: list[Sequence[Any]] = []
    for row in chosen.runs:
        compared = {r.run for r in timed.of(row)}
        for r in chosen.of(row):
            seconds = r.training_seconds if r.run in compared else ""
            rows.append((row, r.scene, r.seed, r.run, seconds, r.psnr, r.num_gaussians, r.trained_on))
        seconds, psnr, n = _means(timed, chosen, row)
        rows.append((row, "mean", "", "", seconds, psnr, n, ""))
    return ("row", "scene", "seed", "run", "seconds", "psnr", "num_gaussians", "machine"), rows


@dataclass(frozen=True)
class Marker:
    """A disc with a name: centre, radius and the name's size, all in points."""

    x: float
    y: float
    radius: float
    width: float
    height: float


@dataclass(frozen=True)
class Place:
    """Where a name stands; `is_joined` where it is too far off to be its marker's without a line."""

    box: Box
    is_joined: bool


def places(markers: Sequence[Marker], frame: Box, taken: Sequence[Box] = ()) -> list[Place]:
    """Find a place for every name, such that all together cover little and none seems to be another marker's.

    Two after two move to where they cost least together while the others stay, until none moves.

    Args:
        markers: with their names' sizes.
        frame: that names should not leave.
        taken: boxes that names should not cover.
    """
    choices = [_choices(marker) for marker in markers]
    fixed = np.array(
        [
            [_fixed_cost(place, i, markers, frame, taken) + rank for rank, place in enumerate(each)]
            for i, each in enumerate(choices)
        ]
    )
    boxes = np.array([[place.box for place in each] for each in choices])
    low = np.maximum(boxes[:, :, None, None, :2], boxes[..., :2])
    high = np.minimum(boxes[:, :, None, None, 2:], boxes[..., 2:])
    # of a name at a place and another at a place of its own
    between = (high - low + _APART).clip(0.0).prod(axis=-1)
    chosen = fixed.argmin(axis=1)
    # each move makes the whole cheaper, so that this ends; the bound is for ties that rounding makes
    for _ in range(20):
        before = chosen.copy()
        for pair in combinations(range(len(markers)), 2):
            rest = [k for k in range(len(markers)) if k not in pair]
            one, other = (fixed[i] + between[i][:, rest, chosen[rest]].sum(axis=1) for i in pair)
            costs = one[:, None] + other + between[pair[0], :, pair[1]]
            chosen[list(pair)] = np.unravel_index(int(costs.argmin()), costs.shape)
        if (chosen == before).all():
            break
    return [each[k] for each, k in zip(choices, chosen, strict=True)]


def along(line: Sequence[Sequence[float]]) -> list[Box]:
    """Cover a line with small boxes."""
    boxes = []
    for (x0, y0), (x1, y1) in pairwise(line):
        n = int(max(abs(x1 - x0), abs(y1 - y0)) / 2.0) + 1
        boxes += [_around(x0 + (x1 - x0) * i / n, y0 + (y1 - y0) * i / n, 1.0) for i in range(n + 1)]
    return boxes


def _choices(marker: Marker) -> list[Place]:
    found = []
    for gap in _GAPS:
        for right, up in _SIDES:
            off = marker.radius * (0.75 if right and up else 1.0) + gap
            x = marker.x + right * (off + marker.width / 2.0)
            y = marker.y + up * (off + marker.height / 2.0)
            box = (x - marker.width / 2.0, y - marker.height / 2.0, x + marker.width / 2.0, y + marker.height / 2.0)
            found.append(Place(box, gap > _GAPS[0]))
    return found


def _fixed_cost(place: Place, i: int, markers: Sequence[Marker], frame: Box, taken: Sequence[Box]) -> float:
    """Cost of a place whatever the other names do."""
    others = [marker for j, marker in enumerate(markers) if j != i]
    own = _distance(place.box, markers[i])
    covered = sum(_overlap(place.box, box) for box in taken)
    covered += sum(_overlap(place.box, _around(m.x, m.y, m.radius + _GAPS[0])) for m in others)
    outside = markers[i].width * markers[i].height - _overlap(place.box, frame)
    if place.is_joined:
        return covered + 2.0 * outside + _JOINED * own
    return covered + 2.0 * outside + sum(_MISTAKEN for m in others if _distance(place.box, m) < own)


def _distance(box: Box, marker: Marker) -> float:
    """Measure from a box to a disc's edge."""
    dx = max(box[0] - marker.x, marker.x - box[2], 0.0)
    dy = max(box[1] - marker.y, marker.y - box[3], 0.0)
    return max((dx * dx + dy * dy) ** 0.5 - marker.radius, 0.0)


def _around(x: float, y: float, half: float) -> Box:
    return (x - half, y - half, x + half, y + half)


def _overlap(a: Box, b: Box) -> float:
    return max(min(a[2], b[2]) - max(a[0], b[0]), 0.0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0.0)
