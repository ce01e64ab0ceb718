"""The first decision that falls otherwise in two walks through one pixel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pop_fast.view.explain.walk import Step, Walk
from pop_ref.camera import in_front
from pop_ref.constants import Profile
from pop_ref.dominance import dominant_id


@dataclass(frozen=True)
class Flip:
    """One decision, D1 to D8, that two renderers take differently.

    Attributes:
        decision: its label.
        gaussian: whom it is about.
        depth: of that Gaussian.
        first: what the one does, with operand and threshold.
        second: what the other does.
        more: how many entries behind it also meet another fate, most of them in consequence.
    """

    decision: str
    gaussian: int
    depth: float
    first: str
    second: str
    more: int = 0


def first_flip(ids: np.ndarray, walks: tuple[Walk, Walk], profiles: tuple[Profile, Profile]) -> Flip | None:
    """Find where two walks over the same candidates part, from the front.

    Entries that one list holds only to skip them are no parting: they change nothing.

    Args:
        ids: Gaussian of every row of both walks' splats.
        walks: the two.
        profiles: their constants.
    """
    flips = list(_flips(ids, walks, profiles))
    if flips:
        return replace(flips[0], more=len(flips) - 1)
    winners = [dominant_id(walked.pixel.ids, walked.pixel.weights) for walked in walks]
    if winners[0] == winners[1]:
        return None
    first, second = (_weights(walked, winners) for walked in walks)
    return Flip("D8", int(ids[winners[0]]), float(walks[0].splats.depths[winners[0]]), first, second)


def _flips(ids: np.ndarray, walks: tuple[Walk, Walk], profiles: tuple[Profile, Profile]) -> Iterator[Flip]:
    a, b = ({step.row: step for step in walked.steps} for walked in walks)
    place = {step.row: i for i, step in enumerate(walks[1].steps)}
    depths = walks[0].splats.depths
    # the farthest place in the second list of what the first has passed: an entry before it was overtaken (D4)
    passed = -1
    for row in sorted({*a, *b}, key=lambda row: (depths[row], row)):
        pair = (a.get(row), b.get(row))
        present = [step for step in pair if step is not None]
        if len(present) == 1 and not _acts(present[0]):
            continue
        decision = _decision(pair, row, walks, profiles)
        if decision is None and all(map(_acts, present)):
            decision = "D4" if place[row] < passed else None
            passed = max(passed, place[row])
        if decision is not None:
            first = _words(pair[0], row, walks, profiles[0])
            second = _words(pair[1], row, (walks[1], walks[0]), profiles[1])
            yield Flip(decision, int(ids[row]), float(depths[row]), first, second)


def _acts(step: Step) -> bool:
    return step.status in ("blended", "stopped")


def _decision(
    pair: tuple[Step | None, Step | None], row: int, walks: tuple[Walk, Walk], profiles: tuple[Profile, Profile]
) -> str | None:
    one, other = pair
    if one is None:
        return _why_absent(row, walks, profiles[0])[0]
    if other is None:
        return _why_absent(row, (walks[1], walks[0]), profiles[1])[0]
    statuses = {one.status, other.status}
    if len(statuses) == 1:
        return "D6" if one.status == "blended" and _ceiling(one) != _ceiling(other) else None
    if "hidden" in statuses:
        return "D7" if _acts(one) or _acts(other) else None
    if "skipped" in statuses:
        return "D5"
    # a ceiling that only one of them met moved what the stop is compared with
    return "D6" if _ceiling(one) != _ceiling(other) else "D7"


def _ceiling(step: Step) -> float | None:
    return step.alpha if step.alpha_raw > step.alpha else None


def _why_absent(row: int, walks: tuple[Walk, Walk], profile: Profile) -> tuple[str, str]:
    """Say which decision keeps a splat out of the first walk's list, and how."""
    own, other = (walked.splats for walked in walks)
    depth, radii, theirs = float(own.depths[row]), own.radii[row].tolist(), other.radii[row].tolist()
    if not in_front(np.array([depth]), profile)[0]:
        return "D1", f"z {depth:.6g} is not between the planes {profile.near_plane:g} and {profile.far_plane:g}"
    if min(radii) == 0:
        return "D2", f"its extent does not reach the image (the other's: {theirs[0]} x {theirs[1]} px)"
    if radii != theirs:
        return "D2", f"its extent, {radii[0]} x {radii[1]} px (not {theirs[0]} x {theirs[1]}), does not reach the tile"
    return "D3", f"its extent of {radii[0]} x {radii[1]} px overlaps other tiles"


def _words(step: Step | None, row: int, walks: tuple[Walk, Walk], profile: Profile) -> str:
    if step is None:
        return "does not list it: " + _why_absent(row, walks, profile)[1]
    if step.T is None:
        return "never visits it: the walk has ended (D7)"
    left = step.T * (1.0 - step.alpha)
    if step.status == "blended":
        clamped = f" (clamped from {step.alpha_raw:.7f})" if _ceiling(step) else ""
        return f"blends it: alpha {step.alpha:.7f}{clamped}, T {step.T:.7g} -> {left:.7g}"
    if step.status == "skipped":
        return f"skips it: alpha {step.alpha_raw:.9f}, floor {profile.alpha_floor:.9f}"
    stop = profile.transmittance_stop
    return f"stops at it: alpha {step.alpha:.7f}, T {step.T:.7g} would become {left:.7g}, stop {stop:g}"


def _weights(walked: Walk, rows: list[int]) -> str:
    weights = dict(zip(walked.pixel.ids, walked.pixel.weights, strict=True))
    return "weighs the rivals " + " and ".join(f"{weights.get(row, 0.0):.9f}" for row in rows)
