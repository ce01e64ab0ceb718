"""The oracle as what others are compared with: it keeps its latest answers.

Laws begin with the same scenes, and each backend is tried on those of the backend before it. What is asked of one
scene again is a large part of the time of a run, and the answer is the same. The oracle that is judged itself
(`adapter.OracleAdapter`) keeps nothing.
"""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Final

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter, View
from pop_ref.conformance.error_bounds import PixelErrorBounds, pixel_error_bounds
from pop_ref.conformance.scenes import Scene

# answers, of small images; a law has at most fifty scenes, and its backends follow each other
KEPT: Final = 192
# Gaussians of the largest scene that is remembered
LARGEST: Final = 256

# the answers of every function that keeps some
_ALL: Final[list[OrderedDict[Hashable, Any]]] = []


def forget() -> None:
    """Forget every answer; whoever breaks the oracle itself must, before and after."""
    for kept in _ALL:
        kept.clear()


def remembered(answer: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of a scene and of arrays or plain values that keeps its latest answers, which are read only."""
    kept: OrderedDict[Hashable, Any] = OrderedDict()
    _ALL.append(kept)

    @functools.wraps(answer)
    def asked(scene: Scene, *more: Any) -> Any:
        if len(scene.gaussians) > LARGEST:
            return answer(scene, *more)
        key = (_scene_key(scene), *map(_key, more))
        if key not in kept:
            kept[key] = answer(scene, *more)
            if len(kept) > KEPT:
                kept.popitem(last=False)
        kept.move_to_end(key)
        return kept[key]

    return asked


def _scene_key(scene: Scene) -> Hashable:
    g, camera = scene.gaussians, scene.camera
    arrays = (g.means, g.quats, g.scales, g.opacities, g.sh, camera.viewmat, camera.K, scene.background)
    plain = (camera.width, camera.height, scene.profile, scene.tile_size, scene.sh_degree, scene.antialiased)
    return (*map(_key, arrays), *plain)


def _key(value: Any) -> Hashable:
    # the bits, in which 0.0 and -0.0 differ
    return (value.shape, value.dtype.str, value.tobytes()) if isinstance(value, np.ndarray) else value


class Reference(OracleAdapter):
    """The oracle, whose renders and gradients of a scene are computed once."""

    def render(self, scene: Scene) -> View:
        """Draw a scene, or return what was drawn of it."""
        return _render(scene)

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        """Return the cotangents of `render.render_vjp`."""
        return dict(_gradients(scene, v_image, v_T_final))


_ORACLE: Final = OracleAdapter()


@remembered
def _render(scene: Scene) -> View:
    return _ORACLE.render(scene)


@remembered
def _gradients(scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
    return _ORACLE.gradients(scene, v_image, v_T_final)


@remembered
def error_bounds_of(scene: Scene, dtype: Any) -> PixelErrorBounds:
    """Return a scene's error bounds in a precision; of square extents with the oracle's own tile lists."""
    lists = _ORACLE.full_render(scene).tile_lists if scene.profile.extent == "square" else None
    return pixel_error_bounds(scene, dtype, lists)
