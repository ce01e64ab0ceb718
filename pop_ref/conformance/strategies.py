"""Strategies that shrink: records in lists, dyadic numbers first, the dullest value first.

Numbers are tried in this order when Hypothesis shrinks: the dull value, then dyadic ones (exact in every precision), then
any float32. Opacities under 1/255 and at 1 are always in range, because POP drives them there. Sizes reach needles and
splats larger than the picture. Images have at most 16 x 16 pixels.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.scenes import Record, Scene, pack
from pop_ref.constants import PAPER, Profile
from pop_ref.types import Camera

FLOOR = 1.0 / 255.0
ANCHOR_SH = ((1.0, 0.5, 0.25),)


def dyadic(low: float, high: float, bits: int = 3) -> st.SearchStrategy[float]:
    """Draw k / 2^bits in [low, high]; shrinks towards 0, or the end nearest to it."""
    return st.integers(math.ceil(low * 2**bits), math.floor(high * 2**bits)).map(lambda k: k / 2**bits)


def reals(low: float, high: float, dull: float | None = None, bits: int = 3) -> st.SearchStrategy[float]:
    """Draw the dull value, a dyadic number or any float32 in [low, high]."""
    wild = st.floats(low, high, width=32, allow_subnormal=False)
    return st.one_of(*([st.just(dull)] if dull is not None else []), dyadic(low, high, bits), wild)


def opacities() -> st.SearchStrategy[float]:
    """Draw an opacity: dull, at the ends, around 1/255 and the ceilings, or any."""
    return st.one_of(
        st.sampled_from([0.5, 1.0, 0.25, 0.75, 0.0, 0.125]),
        st.sampled_from([FLOOR, 0.001086, 1.0 / 512.0, 0.005, 0.0040, 0.0039, 0.99, 0.999, 0.9995, 1.0 - 2.0**-20]),
        st.floats(0.0, 1.0, width=32, allow_subnormal=False),
    )


def quats() -> st.SearchStrategy[tuple[float, ...]]:
    """Draw wxyz of any norm > 0: the identity, quarter and odd integer turns, then any."""
    whole = st.tuples(*[st.integers(-2, 2).map(float)] * 4).filter(any)
    wild = st.tuples(*[st.floats(-2.0, 2.0, width=32, allow_subnormal=False)] * 4)
    return st.one_of(st.just((1.0, 0.0, 0.0, 0.0)), whole, wild.filter(lambda q: 0.01 < sum(c * c for c in q) < 100.0))


def sizes() -> st.SearchStrategy[tuple[float, ...]]:
    """Draw standard deviations in px: round and plain, uneven, needles, flat discs, points and giants."""
    side = reals(0.125, 4.0, dull=1.0)
    uneven = st.tuples(side, side, side)
    needle = st.tuples(st.sampled_from([8.0, 16.0, 64.0]), *[st.sampled_from([0.125, 0.03125, 0.0])] * 2)
    giant = st.sampled_from([16.0, 64.0, 256.0]).map(lambda s: (s, s, s))
    point = st.just((0.0, 0.0, 0.0))
    return st.one_of(side.map(lambda s: (s, s, s)), uneven, uneven, needle, giant, point)


def sh_rows(max_degree: int = 3) -> st.SearchStrategy[tuple[tuple[float, ...], ...]]:
    """Draw SH coefficients of a degree in {0..max_degree}; colours from under 0 to over 1."""

    def rows(degree: int) -> st.SearchStrategy[tuple[tuple[float, ...], ...]]:
        first = st.tuples(*[dyadic(-2.0, 2.0)] * 3)
        rest = st.lists(
            st.tuples(*[dyadic(-1.0, 1.0)] * 3), min_size=(degree + 1) ** 2 - 1, max_size=(degree + 1) ** 2 - 1
        )
        return st.tuples(first, rest).map(lambda fr: (fr[0], *fr[1]))

    return st.sampled_from([0, 0, 0, *range(1, max_degree + 1)]).flatmap(rows)


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


def viewmats(turned: bool = True) -> st.SearchStrategy[np.ndarray]:
    """Draw a rigid world -> camera matrix: the identity, then shifts by eighths, then turns."""
    shift = st.tuples(*[dyadic(-4.0, 4.0)] * 3)
    turn = quats() if turned else st.just((1.0, 0.0, 0.0, 0.0))
    return st.one_of(st.just(np.eye(4)), st.builds(rigid, turn, shift))


def rigid(quat: tuple[float, ...], shift: tuple[float, ...]) -> np.ndarray:
    """Return the world -> camera matrix of a turn and a shift."""
    # written out here: the kit must not draw its inputs through the functions that it judges
    w, x, y, z = np.array(quat) / math.sqrt(sum(c * c for c in quat))
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = shift
    return viewmat


@st.composite
def cameras(draw: Any, max_side: int = 8, turned: bool = True, centred: bool = False) -> Camera:
    """Draw a camera: square and plain first; then off-centre principal points, oblong pixels, turns."""
    side = st.one_of(st.sampled_from([s for s in (4, 8, 16) if s <= max_side]), st.integers(1, max_side))
    width, height = draw(side), draw(side)
    fx = draw(st.one_of(st.sampled_from([8.0, 16.0, 4.0]), reals(4.0, 32.0)))
    fy = draw(st.one_of(st.just(fx), reals(4.0, 32.0)))
    cx, cy = width / 2.0, height / 2.0
    if not centred:
        cx = draw(st.one_of(st.just(cx), dyadic(0.0, width), dyadic(-4.0, width + 4.0)))
        cy = draw(st.one_of(st.just(cy), dyadic(0.0, height), dyadic(-4.0, height + 4.0)))
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(draw(viewmats(turned)), K, width, height)


def backgrounds() -> st.SearchStrategy[tuple[float, ...]]:
    """Draw a background colour, black first."""
    return st.one_of(st.just((0.0, 0.0, 0.0)), st.tuples(*[dyadic(0.0, 1.0)] * 3))


@st.composite
def scenes(
    draw: Any,
    min_gaussians: int = 0,
    max_gaussians: int = 6,
    max_side: int = 8,
    max_degree: int = 0,
    turned: bool = True,
    centred: bool = False,
    profile: Profile = PAPER,
    tile_sizes: tuple[int, ...] = (4, 16, 1, 2, 3),
    opacity: st.SearchStrategy[float] | None = None,
    size: st.SearchStrategy[tuple[float, ...]] | None = None,
    copies: bool = True,
    anchored: bool = False,
) -> Scene:
    """Draw a scene; coincident copies of its Gaussians are frequent, because cloning makes them.

    `anchored` puts one plain Gaussian into the middle of the picture, so that no law speaks of an empty image.
    """
    camera = draw(cameras(max_side, turned, centred or profile.principal_point == "centred"))
    record = records(camera.width, camera.height, max_degree, opacity, size)
    chosen = draw(st.lists(record, min_size=min_gaussians, max_size=max_gaussians - anchored))
    if anchored:
        chosen = [
            Record(camera.width * 0.5 + 0.25, camera.height * 0.5 + 0.25, 2.5, opacity=0.5, sh=ANCHOR_SH),
            *chosen,
        ]
    if chosen and copies:
        again = draw(st.lists(st.sampled_from(range(len(chosen))), max_size=2))
        chosen = (chosen + [chosen[i] for i in again])[: max(max_gaussians, 2)]
    tile_size = None if profile.extent == "square" else draw(st.sampled_from(tile_sizes))
    return Scene(pack(chosen, camera), camera, draw(backgrounds()), profile, tile_size)


def faint_opacities() -> st.SearchStrategy[float]:
    """Draw opacities so low that six Gaussians never reach the transmittance stop: 0.75^6 > 1e-4."""
    return st.one_of(st.sampled_from([0.5, 0.25, 0.75, 0.125]), st.floats(0.0, 0.75, width=32, allow_subnormal=False))


def plain_sizes() -> st.SearchStrategy[tuple[float, ...]]:
    """Draw sizes in which no dimension is degenerate: one half to four px."""
    side = reals(0.5, 4.0, dull=1.0)
    return st.one_of(side.map(lambda s: (s, s, s)), st.tuples(side, side, side))


@st.composite
def arrays_of(draw: Any, shape: tuple[int, ...], low: float = -2.0, high: float = 2.0) -> np.ndarray:
    """Draw an array of dyadic numbers, zero first."""
    count = int(np.prod(shape))
    return np.array(draw(st.lists(dyadic(low, high), min_size=count, max_size=count)), dtype=np.float64).reshape(shape)


def cotangents(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return v_image and v_T_final for a scene: dyadic, of either sign, nowhere zero, and the same on every run."""
    H, W = scene.camera.height, scene.camera.width
    k = np.arange(H * W * 3, dtype=np.float64).reshape(H, W, 3)
    v_image = (np.mod(k * 5.0 + 3.0, 16.0) - 7.5) / 8.0
    v_T_final = (np.mod(np.arange(H * W, dtype=np.float64).reshape(H, W) * 3.0, 8.0) - 3.5) / 8.0
    return v_image, v_T_final
