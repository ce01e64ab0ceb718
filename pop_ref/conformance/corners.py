"""A few scenes that every law of rendering and gradients is tried on before any is drawn.

Each holds what random scenes seldom hold at once: harmonics of the third degree under a turned camera, quaternions of
any norm, an order in depth that is not the order of distances, tiles cut by the border, slanted needles over corners of
tiles, pixels that end, oblong pixels with the principal point aside, splats beyond the frustum's clamp, exact ties;
and a splat alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pop_ref.conformance.scenes import Record, Scene, pack
from pop_ref.conformance.strategies import rigid
from pop_ref.records import Camera

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
