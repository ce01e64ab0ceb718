"""Strategies that shrink: records in lists, dyadic numbers first, the dullest value first; and scenes that come before.

Numbers are tried in this order when Hypothesis shrinks: the dull value, then dyadic ones (exact in every precision),
then any float32. Opacities under 1/255 and at 1 are always in range, because POP drives them there. Sizes reach needles
and splats larger than the picture. Images have at most 16 x 16 pixels.

Strategies are cached: Hypothesis examines each new strategy object before it draws from it, which takes longer than
drawing.

Every law of rendering and gradients is tried on `corners` before anything is drawn. They hold what random scenes seldom
hold at once: harmonics of the third degree under a turned camera, quaternions of any norm, an order in depth that is
not the order of distances, tiles cut by the border, slanted needles over corners of tiles, pixels that end, oblong
pixels with the principal point aside, splats beyond the frustum's clamp, exact ties; and a splat alone.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.scenes import Record, Scene, pack, rigid
from pop_ref.constants import PAPER, Profile
from pop_ref.records import Camera

FLOOR = 1.0 / 255.0
ANCHOR_SH = ((1.0, 0.5, 0.25),)


@functools.cache
def dyadic(low: float, high: float, bits: int = 3) -> st.SearchStrategy[float]:
    """Draw k / 2^bits in [low, high]; shrinks towards 0, or the end nearest to it."""
    return st.integers(math.ceil(low * 2**bits), math.floor(high * 2**bits)).map(lambda k: k / 2**bits)


def _floats(low: float, high: float) -> st.SearchStrategy[float]:
    # what would underflow when squared or halved a few times has laws of its own
    return st.floats(low, high, width=32).map(lambda x: x if abs(x) > 2.0**-60 else 0.0)


@functools.cache
def reals(low: float, high: float, dull: float | None = None, bits: int = 3) -> st.SearchStrategy[float]:
    """Draw the dull value, a dyadic number or any float32 in [low, high]."""
    wild = _floats(low, high)
    return st.one_of(*([st.just(dull)] if dull is not None else []), dyadic(low, high, bits), wild)


@functools.cache
def opacities() -> st.SearchStrategy[float]:
    """Draw an opacity: dull, at the ends, around 1/255 and the ceilings, or any."""
    return st.one_of(
        st.sampled_from([0.5, 1.0, 0.25, 0.75, 0.0, 0.125]),
        st.sampled_from(
            [FLOOR, 0.001086, 1.0 / 512.0, 0.005, 0.0040, 0.0039, 0.99, 0.995, 0.999, 0.9995, 1.0 - 2.0**-20]
        ),
        st.floats(0.0, 1.0, width=32, allow_subnormal=False),
    )


@functools.cache
def quats() -> st.SearchStrategy[tuple[float, ...]]:
    """Draw wxyz of any norm > 0: the identity, quarter and odd integer turns, then any."""
    whole = st.tuples(*[st.integers(-2, 2).map(float)] * 4).filter(any)
    wild = st.tuples(*[_floats(-2.0, 2.0)] * 4)
    return st.one_of(st.just((1.0, 0.0, 0.0, 0.0)), whole, wild.filter(lambda q: 0.01 < sum(c * c for c in q) < 100.0))


@functools.cache
def sizes() -> st.SearchStrategy[tuple[float, ...]]:
    """Draw standard deviations in px: round and plain, uneven, needles, flat discs, points and giants."""
    side = reals(0.125, 4.0, dull=1.0)
    uneven = st.tuples(side, side, side)
    needle = st.tuples(st.sampled_from([8.0, 16.0, 64.0]), *[st.sampled_from([0.125, 0.03125, 0.0])] * 2)
    giant = st.sampled_from([16.0, 64.0, 256.0]).map(lambda s: (s, s, s))
    point = st.just((0.0, 0.0, 0.0))
    return st.one_of(side.map(lambda s: (s, s, s)), uneven, uneven, needle, giant, point)


@functools.cache
def sh_rows(max_degree: int = 3) -> st.SearchStrategy[tuple[tuple[float, ...], ...]]:
    """Draw SH coefficients of a degree in {0..max_degree}; colours from under 0 to over 1."""

    return st.sampled_from([0, 0, 0, *range(1, max_degree + 1)]).flatmap(_sh_rows_of)


@functools.cache
def _sh_rows_of(degree: int) -> st.SearchStrategy[tuple[tuple[float, ...], ...]]:
    first, rest = st.tuples(*[dyadic(-2.0, 2.0)] * 3), st.tuples(*[dyadic(-1.0, 1.0)] * 3)
    return st.tuples(first, *[rest] * ((degree + 1) ** 2 - 1))


@functools.cache
def records(
    width: int = 8,
    height: int = 8,
    max_degree: int = 0,
    opacity: st.SearchStrategy[float] | None = None,
    size: st.SearchStrategy[tuple[float, ...]] | None = None,
) -> st.SearchStrategy[Record]:
    """Draw a Gaussian on or near the picture, or, seldom, behind the camera or before the near plane."""
    depth = st.one_of(st.sampled_from([1.0, 2.0, 4.0]), reals(0.5, 8.0), st.sampled_from([0.009, 0.25, -1.0, 64.0]))
    return st.builds(
        Record,
        x=reals(-4.0, width + 4.0, dull=width / 2.0 + 0.5, bits=1),
        y=reals(-4.0, height + 4.0, dull=height / 2.0 + 0.5, bits=1),
        depth=depth,
        size=sizes() if size is None else size,
        quat=quats(),
        opacity=opacities() if opacity is None else opacity,
        sh=sh_rows(max_degree),
    )


@functools.cache
def viewmats(turned: bool = True) -> st.SearchStrategy[np.ndarray]:
    """Draw a rigid world -> camera matrix: the identity, then shifts by eighths, then turns."""
    shift = st.tuples(*[dyadic(-4.0, 4.0)] * 3)
    turn = quats() if turned else st.just((1.0, 0.0, 0.0, 0.0))
    return st.one_of(st.just(np.eye(4)), st.builds(rigid, turn, shift))


COINS = st.booleans()


@functools.cache
def _sides(max_side: int) -> st.SearchStrategy[int]:
    return st.one_of(st.sampled_from([s for s in (4, 8, 16) if s <= max_side]), st.integers(1, max_side))


@functools.cache
def _focals() -> st.SearchStrategy[float]:
    return st.one_of(st.sampled_from([8.0, 16.0, 4.0]), reals(4.0, 32.0))


@functools.cache
def _principal_points(size: int) -> st.SearchStrategy[float]:
    return st.one_of(st.just(size / 2.0), dyadic(0.0, size), dyadic(-4.0, size + 4.0))


@st.composite
def cameras(draw: Any, max_side: int = 8, turned: bool = True, centred: bool = False) -> Camera:
    """Draw a camera: square and plain first; then off-centre principal points, oblong pixels, turns."""
    width, height = draw(_sides(max_side)), draw(_sides(max_side))
    fx = draw(_focals())
    fy = draw(_focals()) if draw(COINS) else fx
    cx, cy = width / 2.0, height / 2.0
    if not centred:
        cx, cy = draw(_principal_points(width)), draw(_principal_points(height))
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(draw(viewmats(turned)), K, width, height)


@functools.cache
def backgrounds() -> st.SearchStrategy[tuple[float, ...]]:
    """Draw a background colour, black first."""
    return st.one_of(st.just((0.0, 0.0, 0.0)), st.tuples(*[dyadic(0.0, 1.0)] * 3))


@functools.cache
def _lists(record: st.SearchStrategy[Record], low: int, high: int) -> st.SearchStrategy[list[Record]]:
    return st.lists(record, min_size=low, max_size=high)


@functools.cache
def _cameras(max_side: int, turned: bool, centred: bool) -> st.SearchStrategy[Camera]:
    return cameras(max_side, turned, centred)


COPIES = st.lists(st.integers(0, 5), max_size=2)
TILE_SIZES = st.sampled_from([4, 16, 1, 2, 3])


@st.composite
def scenes(
    draw: Any,
    max_gaussians: int = 6,
    max_side: int = 8,
    max_degree: int = 0,
    turned: bool = True,
    profile: Profile = PAPER,
    opacity: st.SearchStrategy[float] | None = None,
    size: st.SearchStrategy[tuple[float, ...]] | None = None,
    anchored: bool = False,
) -> Scene:
    """Draw a scene; coincident copies of its Gaussians are frequent, because cloning makes them.

    `anchored` puts one plain Gaussian into the middle of the picture, so that no law speaks of an empty image.
    """
    camera = draw(_cameras(max_side, turned, profile.principal_point == "centred"))
    record = records(camera.width, camera.height, max_degree, opacity, size)
    chosen = draw(_lists(record, 0, max_gaussians - anchored))
    if anchored:
        chosen = [
            Record(camera.width * 0.5 + 0.25, camera.height * 0.5 + 0.25, 2.5, opacity=0.5, sh=ANCHOR_SH),
            *chosen,
        ]
    if chosen:
        chosen = (chosen + [chosen[i % len(chosen)] for i in draw(COPIES)])[:max_gaussians]
    tile_size = None if profile.extent == "square" else draw(TILE_SIZES)
    return Scene(pack(chosen, camera), camera, draw(backgrounds()), profile, tile_size)


def wide_scene(seed: int) -> Scene:
    """Return a scene of 24 long Gaussians over many tiles, of which most meet no more than a corner of each splat.

    They are as long as conics can be that single precision resolves.
    """
    rng = np.random.default_rng(seed)
    width, height = int(rng.integers(40, 97)), int(rng.integers(24, 65))
    camera = Camera(np.eye(4), np.array([[32.0, 0, 0.5 * width], [0, 32.0, 0.5 * height], [0, 0, 1]]), width, height)

    def long_one() -> Record:
        size = (*rng.choice([2.0, 4.0, 6.0], 1), *rng.choice([0.75, 1.0, 1.5], 2))
        at = {"x": rng.uniform(0.0, width), "y": rng.uniform(0.0, height), "depth": rng.uniform(1.0, 8.0)}
        colour = tuple(rng.integers(-4, 9, 3) / 4.0)
        return Record(**at, size=size, quat=tuple(rng.normal(size=4)), opacity=rng.uniform(0.1, 1.0), sh=(colour,))

    return Scene(pack([long_one() for _ in range(24)], camera), camera, (0.25, 0.5, 0.75))


@functools.cache
def faint_opacities() -> st.SearchStrategy[float]:
    """Draw opacities so low that six Gaussians never reach the transmittance stop: 0.75^6 > 1e-4."""
    return st.one_of(st.sampled_from([0.5, 0.25, 0.75, 0.125]), st.floats(0.0, 0.75, width=32, allow_subnormal=False))


@functools.cache
def plain_sizes() -> st.SearchStrategy[tuple[float, ...]]:
    """Draw sizes in which no dimension is degenerate: one half to four px."""
    side = reals(0.5, 4.0, dull=1.0)
    return st.one_of(side.map(lambda s: (s, s, s)), st.tuples(side, side, side))


@functools.cache
def arrays_of(shape: tuple[int, ...], low: float = -2.0, high: float = 2.0) -> st.SearchStrategy[np.ndarray]:
    """Draw an array of dyadic numbers, zero first."""
    count = int(np.prod(shape))
    numbers = st.lists(dyadic(low, high), min_size=count, max_size=count)
    return numbers.map(lambda k: np.array(k, dtype=np.float64).reshape(shape))


_TURN, _SHIFT = (1.0, -2.0, 0.5, 1.5), (0.5, -1.0, 2.0)
# half the norm of a unit quaternion, and three of it
_SHORT, _LONG = (0.25, 0.25, -0.25, 0.25), (2.0, 1.0, -1.0, 1.75)


def _bands(seed: int, degree: int) -> tuple[tuple[float, float, float], ...]:
    k = np.arange((degree + 1) ** 2 * 3) * 5.0 + 3.0 * seed
    rows = (np.mod(k, 9.0) - 4.0).reshape(-1, 3) / 8.0
    rows[0] += 0.75
    return tuple((float(r), float(g), float(b)) for r, g, b in rows)


def _camera(width: int, height: int, fx: float, fy: float, aside: tuple[float, float], turned: bool) -> Camera:
    K = np.array([[fx, 0.0, 0.5 * width + aside[0]], [0.0, fy, 0.5 * height + aside[1]], [0.0, 0.0, 1.0]])
    return Camera(rigid(_TURN, _SHIFT) if turned else np.eye(4), K, width, height)


def _records(width: int, height: int, degree: int) -> dict[str, list[Record]]:
    sh = [_bands(seed, degree) for seed in range(4)]
    x, y = 0.5 * width + 0.25, 0.5 * height + 0.25
    return {
        # where nothing cancels, the least error shows
        "alone": [Record(x, y, 2.0, (1.0, 1.5, 1.0), _SHORT, 0.5, sh[0])],
        "norms": [
            Record(x, y, 2.5, (1.5, 1.0, 2.0), _SHORT, 0.5, sh[0]),
            Record(x - 1.0, y + 0.5, 1.5, (0.75, 2.0, 1.25), _LONG, 0.625, sh[1]),
            Record(x + 1.5, y - 1.0, 4.0, (2.0, 1.0, 3.0), (0.5, 2.0, 0.0, -1.5), 0.75, sh[2]),
        ],
        # the second is farther away, and in front
        "depth_is_not_distance": [
            Record(x + 1.0, y, 2.25, (2.0, 2.0, 2.0), _LONG, 0.75, sh[0]),
            Record(width - 0.5, height - 0.5, 2.0, (4.0, 3.0, 2.0), _SHORT, 0.75, sh[1]),
            Record(x, y, 4.0, (2.0, 1.5, 2.0), _SHORT, 0.5, sh[2]),
        ],
        "borders": [
            Record(width - 0.25, height - 0.5, 2.0, (1.0, 0.75, 1.0), _LONG, 0.875, sh[0]),
            Record(0.25, height + 1.0, 1.25, (2.0, 1.0, 1.0), _SHORT, 0.75, sh[1]),
            Record(width + 2.0, 0.5, 3.0, (2.5, 2.5, 2.5), _SHORT, 0.625, sh[2]),
            Record(x, y, 2.5, (1.0, 1.0, 1.0), _SHORT, 0.5, sh[3]),
        ],
        "needles": [
            Record(x, y, 2.0, (4.0, 0.5, 0.5), (0.875, 0.0, 0.0, 0.375), 0.75, sh[0]),
            Record(x + 0.5, y, 3.0, (4.0, 0.5, 0.75), (0.75, 0.0, 0.0, -0.5), 0.875, sh[1]),
            Record(x, y + 0.5, 4.0, (1.0, 1.0, 1.0), _SHORT, 0.5, sh[2]),
        ],
        "ends": [
            Record(x, y, depth, (3.0, 3.0, 3.0), _SHORT, opacity, sh[k])
            for k, (depth, opacity) in enumerate(((1.0, 0.96875), (1.5, 0.9375), (2.0, 0.96875), (3.0, 0.75)))
        ],
        "ties": [
            Record(x, y, 2.0, (1.5, 1.0, 1.0), _LONG, 0.5, sh[0]),
            Record(x, y, 2.0, (1.5, 1.0, 1.0), _LONG, 0.375, sh[1]),
            Record(x - 0.5, y + 0.5, 2.0, (1.0, 2.0, 1.0), _SHORT, 0.25, sh[2]),
        ],
    }


# width, height, fx, fy, principal point off the centre, tile
_VIEWS = {
    "alone": (3, 2, 8.0, 8.0, (0.0, 0.0), 16),
    "norms": (7, 5, 8.0, 8.0, (0.0, 0.0), 16),
    "depth_is_not_distance": (8, 8, 4.0, 4.0, (0.0, 0.0), 4),
    "borders": (7, 6, 6.0, 9.0, (1.5, -0.75), 4),
    "needles": (8, 7, 8.0, 8.0, (0.0, 0.5), 3),
    "ends": (6, 5, 16.0, 12.0, (0.0, 0.0), 16),
    "ties": (5, 8, 8.0, 8.0, (-1.0, 0.0), 2),
}


def corners(degree: int = 0, turned: bool = True, with_: dict[str, Any] | None = None, **changes: Any) -> list[Any]:
    """Return what a law is tried on first: values by argument name, a scene in each.

    Args:
        degree: of the harmonics.
        turned: whether cameras are.
        with_: the law's other arguments.
        changes: of each scene, as `Scene.but` takes them.
    """
    found = []
    for name, (width, height, fx, fy, aside, tile_size) in _VIEWS.items():
        camera = _camera(width, height, fx, fy, aside, turned)
        scene = Scene(
            pack(_records(width, height, degree)[name], camera), camera, (0.25, 0.5, 0.125), tile_size=tile_size
        )
        found.append({"scene": scene.with_overrides(**changes), **(with_ or {})})
    return found
