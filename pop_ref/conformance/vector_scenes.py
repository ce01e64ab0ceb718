"""The scenes of the portable vectors: few, fixed for good, one for each thing that goes wrong in a port."""

from __future__ import annotations

import dataclasses

import numpy as np

from pop_ref.conformance.scenes import Record, Scene, golden_scene, pack
from pop_ref.constants import GSPLAT_1_6, INRIA, PAPER, Profile
from pop_ref.records import Camera

_BANDS = tuple((0.125 * (k % 5) - 0.25, 0.0625 * (k % 7) - 0.125, 0.25 - 0.0625 * (k % 3)) for k in range(15))


def _camera(width: int = 12, height: int = 9, turned: bool = False) -> Camera:
    K = np.array([[12.0, 0.0, 5.5], [0.0, 11.0, 4.75], [0.0, 0.0, 1.0]])
    viewmat = np.eye(4)
    if turned:
        viewmat[:3] = [[0.0, 0.0, -1.0, 0.5], [0.6, 0.8, 0.0, -0.25], [0.8, -0.6, 0.0, 1.5]]
    return Camera(viewmat, K, width, height)


def _scene(records: list[Record], turned: bool = False, profile: Profile = PAPER) -> Scene:
    camera = _camera(turned=turned)
    return Scene(pack(records, camera), camera, np.array([0.125, 0.25, 0.5]), profile)


def vector_scenes() -> dict[str, Scene]:
    """Return the scenes by name."""
    one = Record(5.75, 4.25, 2.0, (2.0, 2.0, 2.0), opacity=0.75, sh=((1.0, 0.5, -0.25),))
    turned = dataclasses.replace(one, size=(3.0, 1.0, 0.5), quat=(1.0, 0.5, -0.25, 0.75))
    coloured = dataclasses.replace(turned, sh=((0.5, 0.25, 1.0), *_BANDS))
    stack = [dataclasses.replace(one, depth=1.0 + k, opacity=o) for k, o in enumerate((0.9, 0.99, 0.95, 1.0, 0.5))]
    clones = [dataclasses.replace(one, opacity=0.5)] * 3
    faint = [dataclasses.replace(one, opacity=o, depth=1.0 + o) for o in (0.0, 0.003, 0.0035, 0.005, 0.0625)]
    far_out = [
        dataclasses.replace(one, x=-30.0, size=(12.0, 12.0, 12.0)),
        dataclasses.replace(one, y=40.0, size=(16.0,) * 3),
    ]
    hidden = [
        one,
        dataclasses.replace(one, depth=-1.0),
        dataclasses.replace(one, depth=0.001),
        dataclasses.replace(one, x=900.0),
    ]
    needle = dataclasses.replace(one, size=(24.0, 0.0625, 0.0625), quat=(1.0, 0.0, 0.0, 0.5), opacity=1.0)
    scenes = {
        "one round splat": _scene([one]),
        "one turned splat": _scene([turned]),
        "a turned camera": _scene([one, turned], turned=True),
        "harmonics of degree three": _scene([coloured], turned=True),
        "a stack that ends early": _scene(stack),
        "coincident clones": _scene(clones),
        "opacities about the floor": _scene(faint),
        "a clamped jacobian": _scene([one, *far_out]),
        "hidden splats": _scene(hidden),
        "a needle": _scene([needle, one]),
        "antialiased": _scene([one, dataclasses.replace(one, size=(0.25, 0.5, 0.25), opacity=1.0)]).with_overrides(
            antialiased=True
        ),
        "the ceiling of 0.99": _scene(stack, profile=GSPLAT_1_6),
        "inria": _scene([one, turned, *stack[2:]], profile=INRIA),
        "golden": golden_scene(),
    }
    return {name.replace(" ", "_"): scene for name, scene in scenes.items()}
