"""Strategies that aim at thresholds on purpose: D1 to D8, exactly at, just under and just over.

Random scenes never come close: of 60,000 random pixels none decided differently in float32 and float64. Each strategy
here solves the pinhole and the splat for the number that puts one decision at its threshold, and then moves it by
nothing, by one last place of float64 or float32, or by a little more.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.scenes import Record, Scene, pack
from pop_ref.conformance.strategies import dyadic, quats, viewmats
from pop_ref.constants import GSPLAT_1_5, GSPLAT_1_6, INRIA, PAPER, Profile
from pop_ref.records import Camera

profiles = st.sampled_from([PAPER, GSPLAT_1_6, GSPLAT_1_5])
slight = st.sampled_from(
    [0.0, 2.0**-52, -(2.0**-52), 2.0**-24, -(2.0**-24), 2.0**-22, -(2.0**-22), 2.0**-10, -(2.0**-10)]
)
round_sizes = st.sampled_from([1.0, 0.5, 2.0])
SIDE = 5


def _camera(viewmat: np.ndarray | None = None, focal: float = 8.0) -> Camera:
    K = np.array([[focal, 0.0, SIDE / 2.0], [0.0, focal, SIDE / 2.0], [0.0, 0.0, 1.0]])
    return Camera(np.eye(4) if viewmat is None else viewmat, K, SIDE, SIDE)


def _scene(records: list[Record], profile: Profile, camera: Camera | None = None) -> Scene:
    camera = camera or _camera()
    return Scene(pack(records, camera), camera, np.array([0.25, 0.5, 1.0]), profile, 4)


def _falloff(size: float, dx: float, dy: float, eps2d: float) -> float:
    # near the optical axis a sphere is a disc; its variance in px^2 is size^2, plus the low-pass
    return math.exp(-0.5 * (dx * dx + dy * dy) / (size * size + eps2d))


@st.composite
def _on_axis(draw: Any, **changes: Any) -> Record:
    size = draw(round_sizes)
    values = {"x": SIDE / 2.0, "y": SIDE / 2.0, "depth": 1.0, "size": (size,) * 3, "sh": ((1.0, 0.5, -0.5),), **changes}
    return Record(**values)


@st.composite
def near_plane(draw: Any) -> Scene:
    """Aim at D1: centres at the near plane, and something behind."""
    profile = draw(st.sampled_from([PAPER, INRIA]))
    depth = profile.near_plane * (1.0 + draw(slight))
    front = draw(_on_axis(depth=depth, opacity=0.5))
    behind = draw(_on_axis(depth=2.0, opacity=0.75))
    return _scene([front, behind], profile)


@st.composite
def near_floor(draw: Any) -> Scene:
    """Aim at D5 and at D2's opacity cull: alpha at 1/255 on some pixel, or the opacity itself."""
    profile = draw(profiles)
    dx, dy = draw(st.integers(0, 2)), draw(st.integers(0, 2))
    record = draw(_on_axis())
    falloff = _falloff(record.size[0], dx, dy, profile.eps2d)
    opacity = min(profile.alpha_floor / falloff * (1.0 + draw(slight)), 1.0)
    faint = draw(_on_axis(size=record.size, opacity=opacity, depth=draw(st.sampled_from([1.0, 2.0]))))
    return _scene([faint, draw(_on_axis(opacity=0.5, depth=4.0))], profile)


@st.composite
def near_ceiling(draw: Any) -> Scene:
    """Aim at D6: opacity times falloff at the ceiling."""
    profile = draw(profiles)
    opacity = min(profile.alpha_ceiling * (1.0 + draw(slight)), 1.0)
    return _scene([draw(_on_axis(opacity=opacity)), draw(_on_axis(opacity=0.5, depth=4.0))], profile)


@st.composite
def near_stop(draw: Any) -> Scene:
    """Aim at D7: a splat that would leave the transmittance at the stop."""
    profile = draw(profiles)
    front = draw(st.lists(st.sampled_from([0.75, 0.5, 0.9375, 0.875]), min_size=1, max_size=3))
    T = float(np.prod([1.0 - a for a in front]))
    last = 1.0 - profile.transmittance_stop * (1.0 + draw(slight)) / T
    stack = [*front, last] if last <= profile.alpha_ceiling else [*front, 1.0 - 2.0**-6, 1.0 - 2.0**-6]
    records = [draw(_on_axis(opacity=a, depth=1.0 + k)) for k, a in enumerate(stack)]
    return _scene([*records, draw(_on_axis(opacity=0.5, depth=16.0, sh=((4.0, 4.0, 4.0),)))], profile)


@st.composite
def near_depth_tie(draw: Any) -> Scene:
    """Aim at D4: several splats at nearly or exactly one depth, seen straight on or by a turned camera."""
    camera = _camera(draw(st.one_of(st.just(np.eye(4)), viewmats())))
    depth = draw(st.sampled_from([1.0, 2.0]))
    n = draw(st.integers(2, 3))
    colors = (((1.0, 0.0, 0.0),), ((0.0, 1.0, 0.0),), ((0.0, 0.0, 1.0),))
    records = []
    for k in range(n):
        x, y = draw(dyadic(1.0, 4.0, bits=1)), draw(dyadic(1.0, 4.0, bits=1))
        near = depth * (1.0 + draw(slight))
        records.append(Record(x, y, near, (1.0, 1.0, 1.0), opacity=0.5, sh=colors[k]))
    return _scene(records, PAPER, camera)


@st.composite
def near_dominance_tie(draw: Any) -> Scene:
    """Aim at D8: two splats with almost or exactly one weight, in front of or behind a third."""
    first = draw(st.sampled_from([0.25, 0.125, 0.375]))
    second = first / (1.0 - first) * (1.0 + draw(slight))
    extra = draw(st.lists(st.sampled_from([0.0625, 0.03125]), max_size=1))
    stack = [*extra, first, second]
    size = draw(round_sizes)
    return _scene([Record(2.5, 2.5, 1.0 + k, (size,) * 3, opacity=a) for k, a in enumerate(stack)], PAPER)


def _just_seen(edge: float, side: float, size: float, opacity: float, profile: Profile, camera: Camera) -> float:
    """Return where a sphere's centre must lie, left (-1) or right (1) of an edge, for alpha to be 1/255 on the edge."""
    deviations = math.sqrt(2.0 * math.log(opacity / profile.alpha_floor))
    x = edge
    for _ in range(60):
        # off the axis by s = x / z a sphere widens by sqrt(1 + s^2), so its place depends on its own reach; beyond the
        # picture the frustum clamp holds s (B1)
        slope = min(abs(x - SIDE / 2.0), SIDE / 2.0 * (1.0 + profile.frustum_margin)) / camera.K[0, 0]
        x = edge + side * deviations * math.sqrt(size * size * (1.0 + slope * slope) + profile.eps2d)
    return x


@st.composite
def near_tile_edge(draw: Any) -> Scene:
    """Aim at D3: opaque splats that just reach the first column or row of the next tile, from a tile further off.

    At 1.5625 px three deviations are 4.97 px, which round up to less than the 5.5 px at which such a splat is seen.
    """
    camera = _camera(focal=64.0)
    edge, side = draw(st.sampled_from([(3.5, 1.0), (4.5, -1.0)]))
    u = _just_seen(edge, side, 1.5625, 1.0, PAPER, camera) - side * draw(
        st.sampled_from([0.0, 2.0**-10, 2.0**-6, 2.0**-22])
    )
    x, y = (u, 2.5) if draw(st.booleans()) else (2.5, u)
    return _scene(
        [Record(x, y, 8.0, (1.5625, 1.5625, 1.5625), opacity=1.0), draw(_on_axis(opacity=0.25, depth=16.0))],
        PAPER,
        camera,
    )


@st.composite
def near_edge(draw: Any) -> Scene:
    """Aim at D2 and D3: the ellipse alpha = 1/255 through a pixel centre, extents at tile and image edges."""
    profile = draw(st.sampled_from([PAPER, INRIA]))
    camera = _camera(focal=64.0)
    size = draw(round_sizes)
    opacity = draw(st.sampled_from([1.0, 0.5, 0.0625, 0.015625]))
    edge = draw(st.sampled_from([3.5, 0.5, 4.5, 0.0, 4.0, 5.0]))
    x = _just_seen(edge, draw(st.sampled_from([1.0, -1.0])), size, opacity, profile, camera) + draw(slight)
    records = [Record(x, 2.5, 8.0, (size,) * 3, opacity=opacity), draw(_on_axis(opacity=0.25, depth=16.0))]
    return _scene(records, profile, camera)


@st.composite
def near_flat(draw: Any) -> Scene:
    """Aim at the exponent's sign and the determinant's: needles and discs seen edge-on."""
    long, thin = draw(st.sampled_from([16.0, 64.0, 512.0])), draw(st.sampled_from([0.0, 0.03125]))
    x, y = draw(dyadic(0.0, 5.0, bits=1)), draw(dyadic(0.0, 5.0, bits=1))
    sizes = draw(st.sampled_from([(long, thin, thin), (long, long, thin)]))
    needle = Record(x, y, 4.0, sizes, draw(quats()), draw(st.sampled_from([1.0, 0.5])))
    return _scene([needle, draw(_on_axis(opacity=0.25, depth=8.0))], PAPER)


AIMS = {
    "D1": near_plane,
    "D2": near_edge,
    "D3": near_tile_edge,
    "D4": near_depth_tie,
    "D5": near_floor,
    "D6": near_ceiling,
    "D7": near_stop,
    "D8": near_dominance_tie,
}
