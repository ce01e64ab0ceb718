"""One small scene that every backend draws: fixed for good, with every kind of splat in it."""

from __future__ import annotations

import numpy as np

from pop_ref.conformance.scenes import Record, Scene, pack
from pop_ref.records import Camera


def golden_scene() -> Scene:
    """Return a 16 x 16 scene: plain, opaque, needle, faint, hidden, coincident, off-screen and culled Gaussians."""
    K = np.array([[16.0, 0.0, 7.5], [0.0, 15.0, 8.25], [0.0, 0.0, 1.0]])
    viewmat = np.array([[0.8, 0.0, -0.6, 0.25], [0.0, 1.0, 0.0, -0.5], [0.6, 0.0, 0.8, 1.0], [0.0, 0.0, 0.0, 1.0]])
    camera = Camera(viewmat, K, 16, 16)
    bands = ((0.5, -0.25, 0.75), (0.25, 0.0, -0.5), (0.0, 0.5, 0.25), (-0.25, 0.25, 0.0))
    records = [
        Record(8.0, 8.0, 2.0, (2.0, 2.0, 2.0), opacity=0.75, sh=((1.0, 0.5, -0.25),)),
        Record(4.25, 5.5, 1.5, (3.0, 1.0, 0.5), (1.0, 0.25, -0.5, 0.125), 1.0, bands),
        Record(12.0, 3.0, 4.0, (16.0, 0.125, 0.125), (1.0, 0.0, 0.0, 0.5), 0.9375, ((-0.5, 1.5, 0.25),)),
        Record(10.0, 12.5, 3.0, (1.5, 1.5, 1.5), opacity=0.015625, sh=((2.0, 2.0, 2.0),)),
        Record(10.0, 12.5, 3.0, (1.5, 1.5, 1.5), opacity=0.5, sh=((-4.0, 1.0, 0.0),)),
        Record(4.25, 5.5, 1.5, (3.0, 1.0, 0.5), (1.0, 0.25, -0.5, 0.125), 1.0, bands),
        Record(6.0, 11.0, 8.0, (64.0, 64.0, 64.0), opacity=0.3125, sh=((0.25, 0.25, 1.0),)),
        Record(-40.0, 8.0, 2.0, (1.0, 1.0, 1.0), opacity=0.5),
        Record(8.0, 8.0, -2.0, (1.0, 1.0, 1.0), opacity=0.5),
        Record(13.0, 13.0, 1.0, (1.0, 1.0, 1.0), opacity=0.001953125),
    ]
    return Scene(pack(records, camera), camera, np.array([0.125, 0.25, 0.5]))
