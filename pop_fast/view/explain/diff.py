"""Where two renderers part: over the picture in numbers, and at a pixel by the first decision that falls otherwise.

A renderer is a profile ("inria"), which the oracle can follow, or a backend ("fast", "ref") under the view's profile. A
backend other than "ref" renders in float32, as in training; at a pixel its own projected splats are walked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from pop_fast.api.backend import backend_names, get_backend
from pop_fast.errors import PopError
from pop_fast.view.explain.pixel import Step, Walk, candidates, oracle_splats, walk
from pop_fast.view.explain.scene import TILE_SIZE, ExplainedView, Map, scaled
from pop_ref.camera import in_front
from pop_ref.constants import PROFILES, Profile
from pop_ref.dominance import dominant_id
from pop_ref.records import Splats


@dataclass(frozen=True)
class Flip:
    """One decision, D1 to D8, that two renderers take differently at a Gaussian."""

    decision: str
    gaussian: int
    depth: float
    first: str  # what the one does, with operand and threshold
    second: str  # what the other does
    more: int = 0  # how many entries behind it also meet another fate, most of them in consequence


def first_flip(ids: np.ndarray, walks: tuple[Walk, Walk], profiles: tuple[Profile, Profile]) -> Flip | None:
    """Find where two walks over the same candidates part, from the front; `ids` are the Gaussians of their rows.

    Entries that one list holds only to skip them are no parting: they change nothing.
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
            first = _fate(pair[0], row, walks, profiles[0])
            second = _fate(pair[1], row, (walks[1], walks[0]), profiles[1])
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


def _fate(step: Step | None, row: int, walks: tuple[Walk, Walk], profile: Profile) -> str:
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


# a colour that 8 bits can tell apart
_SEEN = 1.0 / 255.0


@dataclass(frozen=True, eq=False)
class Side:
    """One of the two: its constants, and what it renders in the region that is compared.

    `info` is its own meta, None for the oracle, which is asked pixel by pixel.
    """

    name: str
    profile: Profile
    info: Mapping[str, Any] | None
    image: np.ndarray
    dominant: np.ndarray
    blended: np.ndarray


@dataclass(frozen=True, eq=False)
class Difference:
    """What `difference` found."""

    names: tuple[str, str]
    lines: tuple[str, ...]  # the result in words
    region: tuple[int, int, int, int]  # left, top, width and height of what was compared, px
    n_colors: int  # pixels whose colours 8 bits can tell apart
    n_dominant: int  # pixels with another dominant Gaussian
    n_blended: int  # pixels that blend another number of Gaussians
    largest: float  # the largest difference of a channel
    # the pixel `flip` is about: the one asked for, or the worst where that one does not differ
    at: tuple[int, int]
    # the first decision there that falls otherwise; None where values differ and no decision does
    flip: Flip | None
    maps: tuple[Map, ...]  # pictures of the region

    def plain(self) -> dict[str, Any]:
        """Give everything but the pictures, for JSON."""
        kept = ("names", "lines", "region", "n_colors", "n_dominant", "n_blended", "largest", "at")
        return {**{name: getattr(self, name) for name in kept}, "flip": None if self.flip is None else vars(self.flip)}


def difference(scene: ExplainedView, a: str, b: str, x: int, y: int, world_scale: float = 1.0) -> Difference:
    """Compare two renderers, profiles or backends, on a view, and at a pixel.

    The oracle is slow, so where it is one of the two only the pixel's tile is compared.

    Args:
        scene: the view.
        a: name of a profile or a backend.
        b: another.
        x: column of the pixel.
        y: row of the pixel.
        world_scale: length of one unit of the capture's own frame in the world of the splat, by which the near planes
            of Inria's profiles lie as many times farther.
    """
    width, height = scene.view.width, scene.view.height
    left, top = x // TILE_SIZE * TILE_SIZE, y // TILE_SIZE * TILE_SIZE
    tile = (left, top, min(TILE_SIZE, width - left), min(TILE_SIZE, height - top))
    region = tile if "ref" in (a, b) else (0, 0, width, height)
    sides = (_side(scene, a, region, world_scale), _side(scene, b, region, world_scale))
    colors = np.abs(sides[0].image - sides[1].image).max(axis=2)
    dominant, blended = sides[0].dominant != sides[1].dominant, sides[0].blended != sides[1].blended
    at = (x, y)
    flip, words = _at(scene, sides, *at)
    lines = [*_overall(sides, region, colors, dominant, blended), *words]
    asked = (y - region[1], x - region[0])
    severity = colors * (colors > _SEEN) + dominant + 0.5 * blended
    if flip is None and severity[asked] == 0.0 and severity.max() > 0.0:
        worst = np.unravel_index(np.argmax(severity), colors.shape)
        at = (int(worst[1]) + region[0], int(worst[0]) + region[1])
        flip, words = _at(scene, sides, *at)
        lines += words
    return Difference(
        names=(a, b),
        lines=tuple(lines),
        region=region,
        n_colors=int((colors > _SEEN).sum()),
        n_dominant=int(dominant.sum()),
        n_blended=int(blended.sum()),
        largest=float(colors.max()),
        at=at,
        flip=flip,
        maps=tuple(_maps(sides, colors, dominant)),
    )


def _side(scene: ExplainedView, name: str, region: tuple[int, int, int, int], world_scale: float) -> Side:
    left, top, width, height = region
    part = (slice(top, top + height), slice(left, left + width))
    if name == "ref":
        return _oracle_side(scene, region)
    if name in PROFILES:
        own = scene.config.renderer
        other = scene.config.with_overrides(profile=name, near_plane=None, eps2d=None).in_world(world_scale)
        profile = own if own.name == name else other.renderer
        image, info = scene.rasterized(profile=profile)
    elif name in backend_names():
        backend, profile = get_backend(name), scene.config.renderer
        image, info = scene.rasterized(torch.float32, backend)
    else:
        raise PopError(
            f"diff names {name!r}, which is neither a profile ({', '.join(PROFILES)}) nor a backend "
            f"({', '.join(backend_names())})"
        )
    dominant, blended = (info[key][0].numpy()[part] for key in ("dominant_ids", "n_contrib"))
    return Side(name, profile, info, image.double().numpy()[part], dominant, blended)


def _oracle_side(scene: ExplainedView, region: tuple[int, int, int, int]) -> Side:
    left, top, width, height = region
    profile = scene.config.renderer
    ids = candidates(scene.info, left, top)
    splats = oracle_splats(scene, ids, profile)
    image = np.zeros((height, width, 3))
    dominant = np.full((height, width), -1)
    blended = np.zeros((height, width), dtype=np.int64)
    for y, x in np.ndindex(height, width):
        pixel = walk(scene, splats, left + x, top + y, profile).pixel
        winner = dominant_id(pixel.ids, pixel.weights)
        image[y, x], blended[y, x] = pixel.color, len(pixel.ids)
        dominant[y, x] = ids[winner] if winner >= 0 else -1
    return Side("ref", profile, None, image, dominant, blended)


def _splats(scene: ExplainedView, side: Side, ids: np.ndarray) -> Splats:
    splats = oracle_splats(scene, ids, side.profile)
    if side.info is None or side.name in PROFILES:
        return splats
    info = {name: side.info[name][0].double().numpy()[ids] for name in ("means2d", "depths", "conics", "opacities")}
    # colours are not in meta; no decision reads them
    return Splats(**info, colors=splats.colors, radii=side.info["radii"][0].numpy()[ids].astype(np.int64))


def _at(scene: ExplainedView, sides: tuple[Side, Side], x: int, y: int) -> tuple[Flip | None, list[str]]:
    infos = [scene.info if side.info is None else side.info for side in sides]
    ids = np.union1d(candidates(infos[0], x, y), candidates(infos[1], x, y))
    a, b = (walk(scene, _splats(scene, side, ids), x, y, side.profile) for side in sides)
    flip = first_flip(ids, (a, b), (sides[0].profile, sides[1].profile))
    return flip, list(_words(sides, (a, b), ids, flip, x, y))


def _words(
    sides: tuple[Side, Side], walks: tuple[Walk, Walk], ids: np.ndarray, flip: Flip | None, x: int, y: int
) -> Iterator[str]:
    yield f"at pixel ({x}, {y}):"
    size = max(len(side.name) for side in sides)
    for side, walked in zip(sides, walks, strict=True):
        pixel = walked.pixel
        winner = dominant_id(pixel.ids, pixel.weights)
        yield (
            f"  {side.name:{size}}  colour {' '.join(f'{c:.4f}' for c in pixel.color)}  T_final {pixel.T_final:.2e}  "
            f"{len(pixel.ids)} blended, dominant {int(ids[winner]) if winner >= 0 else 'none'}"
        )
    if flip is None:
        far = max(abs(p - q) for p, q in zip(walks[0].pixel.color, walks[1].pixel.color, strict=True))
        yield f"  every decision is the same; the colours differ by {far:.1e}"
        return
    yield f"  {flip.decision} is the first decision that differs, at Gaussian {flip.gaussian} (depth {flip.depth:.4g}):"
    for side, words in zip(sides, (flip.first, flip.second), strict=True):
        yield f"  {side.name:{size}}  {words}"
    if flip.more:
        yield f"  and {flip.more} more behind it"


def _overall(
    sides: tuple[Side, Side], region: tuple[int, int, int, int], colors: np.ndarray, dominant: np.ndarray, n: np.ndarray
) -> Iterator[str]:
    left, top, width, height = region
    worst = np.unravel_index(np.argmax(colors), colors.shape)
    yield f"{sides[0].name} | {sides[1].name}, {width} x {height} px from ({left}, {top}):"
    yield (
        f"  colours differ by over 1/255 at {int((colors > _SEEN).sum()):,} px, "
        f"at most by {colors.max():.2e} at ({worst[1] + left}, {worst[0] + top})"
    )
    yield (
        f"  another Gaussian dominates at {int(dominant.sum()):,} px, another number is blended at {int(n.sum()):,} px"
    )


def _maps(sides: tuple[Side, Side], colors: np.ndarray, dominant: np.ndarray) -> Iterator[Map]:
    pair = f"{sides[0].name} | {sides[1].name}"
    top = max(float(np.quantile(colors, 0.999)), 1e-12)
    yield scaled("diff_color", f"Colour, {pair}", "largest difference of a channel", colors, "magma", top)
    about = f"white: another dominant Gaussian, at {int(dominant.sum()):,} px"
    yield Map("diff_dominant", f"Dominance, {pair}", about, np.repeat(dominant[..., None] * np.uint8(255), 3, axis=2))
