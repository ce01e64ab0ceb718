"""Where names stand next to the markers of a figure: each at its own, none over another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

# left, bottom, right, top in points
Box = tuple[float, float, float, float]

# directions from the marker, the best first
_SIDES: Final = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))
# between marker and name; one that stands farther off is joined to its marker by a line
_GAPS: Final = (2.0, 9.0, 20.0)
# what it costs in square points covered: a point of the line that joins a name, and to seem to be another marker's name
_JOINED, _MISTAKEN = 4.0, 120.0


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

    One after the other moves to where it costs least while the others stay, until none moves.

    Args:
        markers: with their names' sizes.
        frame: that names should not leave.
        taken: boxes that names should not cover.
    """
    choices = [_choices(marker) for marker in markers]
    fixed = [
        [_fixed_cost(place, i, markers, frame, taken) + rank for rank, place in enumerate(each)]
        for i, each in enumerate(choices)
    ]
    chosen = [min(range(len(costs)), key=costs.__getitem__) for costs in fixed]
    # each move makes the whole cheaper, so that this ends; the bound is for ties that rounding makes
    for _ in range(20):
        before = list(chosen)
        for i, each in enumerate(choices):
            others = [choices[j][k].box for j, k in enumerate(chosen) if j != i]
            costs = [
                cost + sum(_overlap(place.box, other) for other in others)
                for cost, place in zip(fixed[i], each, strict=True)
            ]
            chosen[i] = min(range(len(costs)), key=costs.__getitem__)
        if chosen == before:
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
