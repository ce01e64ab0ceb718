"""Near a threshold: the outcomes that the oracle has when each decision is taken either way, and scenes that aim there.

At a pixel whose decisions are all clear of rounding there is one outcome. Elsewhere every such splat is blended or
skipped (D1, D2, D5), the pixel ends before such a splat or continues (D7), and neighbours in depth swap
(D4); each combination is a list of splats, and the oracle's own blending of that list is an outcome. A backend must
equal one of them.

Random scenes never come close: of 60,000 random pixels none decided differently in float32 and float64. Each strategy
here solves the pinhole and the splat for the number that puts one decision at its threshold, D1 to D8, and then moves
it by nothing, by one last place of float64 or float32, or by a little more.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance import tolerances
from pop_ref.conformance.adapter import Reference
from pop_ref.conformance.assertions import assert_same_bits, assert_same_image, assert_same_transmittance
from pop_ref.conformance.error_bounds import Layer, PixelErrorBounds
from pop_ref.conformance.scenes import Record, Scene, pack
from pop_ref.conformance.strategies import dyadic, quats, viewmats
from pop_ref.constants import GSPLAT_1_5, GSPLAT_1_6, INRIA, PAPER, Profile
from pop_ref.pixel import Pixel, SplatRows, composite_pixel
from pop_ref.records import Camera

# more than this at one pixel is not enumerated; the pixel is left out
MOST_DOUBTS = 6
MOST_ORDERS = 24


def outcomes(error_bounds: PixelErrorBounds, x: int, y: int) -> list[Pixel]:
    """Return every outcome of one pixel, the likeliest first; empty if there are too many near_threshold."""
    met = [layer for layer in error_bounds.layers if layer.taken[y, x] or layer.near_threshold[y, x]]
    orders = list(itertools.islice(_orders(met, error_bounds), MOST_ORDERS + 1))
    if len(orders) > MOST_ORDERS or sum(bool(layer.near_threshold[y, x]) for layer in met) > MOST_DOUBTS:
        return []
    s, profile = error_bounds.screen, error_bounds.scene.profile
    rows = SplatRows(s.means2d.tolist(), s.conics.tolist(), s.opacities.tolist(), s.colors.tolist())
    # which splats are blended is decided here, so the oracle must not decide again
    forced = dataclasses.replace(profile, alpha_floor=-1.0, transmittance_stop=-1.0)
    lists = [ids for order in orders for ids in _lists(order, error_bounds, x, y)]
    background = error_bounds.scene.background.tolist()
    return [composite_pixel(ids, rows, x + 0.5, y + 0.5, background, forced) for ids in lists]


def _orders(met: list[Layer], error_bounds: PixelErrorBounds) -> Iterator[list[Layer]]:
    """Yield the orders in depth that rounding allows: those that keep every pair whose order is unambiguous."""
    if not met:
        yield []
    for k, layer in enumerate(met):
        if all(error_bounds.swappable(front.id, layer.id) for front in met[:k]):
            yield from ([layer, *rest] for rest in _orders([*met[:k], *met[k + 1 :]], error_bounds))


def _lists(met: list[Layer], error_bounds: PixelErrorBounds, x: int, y: int) -> Iterator[list[int]]:
    """Yield the lists of blended splats that the decisions near their thresholds allow."""
    profile, stop = error_bounds.scene.profile, error_bounds.scene.profile.transmittance_stop

    def walk(k: int, T: float, T_error: float, blended: list[int]) -> Iterator[list[int]]:
        if k == len(met):
            yield blended
            return
        layer = met[k]
        if layer.near_threshold[y, x]:
            yield from walk(k + 1, T, T_error, blended)
        alpha, e_alpha = float(layer.alpha[y, x]), float(layer.e_alpha[y, x])
        next_T = T * (1.0 - alpha)
        e_next = T_error * (1.0 - alpha) + T * e_alpha + 2.0 * next_T
        near = abs(next_T - stop) <= error_bounds.reach * (e_next + abs(stop))
        ends = next_T <= stop if profile.stop_inclusive else next_T < stop
        if ends or near:
            yield blended
        if not ends or near:
            yield from walk(k + 1, next_T, e_next, [*blended, layer.id])

    yield from walk(0, 1.0, 0.0, [])


def assert_one_of_the_oracles_outcomes(
    backend: Any, scene: Scene, error_bounds: PixelErrorBounds, drawn: Any = None
) -> None:
    """Assert that a render equals the oracle's where that is unambiguous, and one of its outcomes elsewhere.

    Args:
        backend: that draws.
        scene: what is drawn.
        error_bounds: of the scene.
        drawn: the backend's view of it, if it is not to be drawn by `render`.
    """
    expected, view = Reference().render(scene), backend.render(scene) if drawn is None else drawn
    assert_same_image("agreement.image", backend, view.image, expected.image, error_bounds, against_oracle=True)
    assert_same_transmittance(
        "agreement.T_final", backend, view.T_final, expected.T_final, error_bounds, against_oracle=True
    )
    if view.n_blended is not None:
        assert_same_bits("blended", view.n_blended, expected.n_blended, error_bounds.unambiguous)
    for y, x in np.argwhere(~error_bounds.unambiguous).tolist():
        _assert_an_outcome(backend, view, error_bounds, x, y)


def _assert_an_outcome(backend: Any, view: Any, error_bounds: PixelErrorBounds, x: int, y: int) -> None:
    possible = outcomes(error_bounds, x, y)
    if not possible:
        return
    limit = tolerances.agreement("agreement.image", backend.dtype)
    room = _room(error_bounds, x, y)
    got = np.append(view.image[y, x], view.T_final[y, x])
    wanted = [np.append(p.color, p.T_final) for p in possible]
    if any(np.all(np.abs(got - w) <= limit * room) for w in wanted):
        return
    raise AssertionError(
        f"pixel ({x}, {y}) is none of the oracle's {len(possible)} outcomes: got {got.tolist()},"
        f" outcomes {[w.tolist() for w in wanted]}, allowed {(limit * room).tolist()}"
    )


def _room(error_bounds: PixelErrorBounds, x: int, y: int) -> np.ndarray:
    # the error bounds of the likeliest outcome, and as much again for what another one blends
    brightest = max([1.0, float(np.max(np.abs(error_bounds.screen.colors), initial=0.0))])
    gain = brightest * (1.0 + sum(float(layer.e_raw[y, x]) for layer in error_bounds.layers))
    image = error_bounds.image[y, x] + error_bounds.absolute[y, x] + gain
    return np.append(image, error_bounds.T_final[y, x] + 1.0 + gain)


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
