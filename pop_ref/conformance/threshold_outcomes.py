"""Near a threshold: the outcomes that the oracle has when each decision near its threshold is taken either way.

At a pixel whose decisions are all clear of rounding there is one outcome. Elsewhere every such splat is blended or
skipped (D1, D2, D5), the pixel ends before such a splat or continues (D7), and neighbours in depth swap
(D4); each combination is a list of splats, and the oracle's own blending of that list is an outcome. A backend must
equal one of them.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from pop_ref.conformance import tolerances
from pop_ref.conformance.assertions import assert_same_bits, assert_same_image, assert_same_transmittance
from pop_ref.conformance.error_bounds import Layer, PixelErrorBounds
from pop_ref.conformance.reference import Reference
from pop_ref.conformance.scenes import Scene
from pop_ref.pixel import Pixel, SplatRows, composite_pixel

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
        sure = error_bounds.unambiguous
        assert_same_bits("blended", view.n_blended[sure], expected.n_blended[sure])
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
