"""How small an error the kit notices, and how much of what is allowed a sound backend needs.

    python -m pop_ref.conformance.teeth benchmarks/results/teeth.json

Each quantity of a render is moved by a little in the oracle, and each gradient by a share of itself, on the scenes that
laws are tried on first (`corners`). What that changes, against what is allowed, is the smallest error of that quantity
which breaks the laws of agreement somewhere; errors this small act to first order. Drawn scenes only add to it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.compositing import composite
from pop_ref.conformance import tolerances
from pop_ref.conformance.adapter import Adapter, OracleAdapter, projected
from pop_ref.conformance.assertions import WORST_CONDITION
from pop_ref.conformance.backends import Unavailable, shipped
from pop_ref.conformance.error_bounds import PixelErrorBounds, pixel_error_bounds
from pop_ref.conformance.files import write_file
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.scenes import Scene, cotangents, rounded_to
from pop_ref.conformance.strategies import corners
from pop_ref.records import Splats

# far below every decision's distance from its threshold, and far above rounding
STEP: Final = 2.0**-30
SOUND: Final = {"float32": ("fast32", "compiled32"), "float64": ("fast64", "compiled64")}
UNITS: Final = {"centre": "px", "colour": "of 1", "background": "of 1"}

MOVED: Final[dict[str, Callable[[Splats], Splats]]] = {
    "alpha": lambda s: replace(s, opacities=s.opacities * (1.0 + STEP)),
    "colour": lambda s: replace(s, colors=s.colors + STEP),
    "conic": lambda s: replace(s, conics=s.conics * (1.0 + STEP)),
    "centre": lambda s: replace(s, means2d=s.means2d + STEP),
}


def _scenes(dtype: Any) -> Iterator[tuple[Scene, PixelErrorBounds]]:
    for values in (*corners(3), *corners()):
        scene = rounded_to(values["scene"], dtype)
        error_bounds = pixel_error_bounds(scene, dtype)
        if error_bounds.worst_condition() * error_bounds.reach < WORST_CONDITION:
            yield scene, error_bounds


def _drawn(scene: Scene, moved: Callable[[Splats], Splats], background: float = 0.0) -> np.ndarray:
    splats, lists = projected(scene)
    camera, size = scene.camera, scene.side
    behind = scene.background + background
    drawn = composite(moved(splats), lists, camera.width, camera.height, size, behind, scene.profile)
    return np.concatenate([drawn.image, drawn.T_final[..., None]], axis=2)


def _allowed(error_bounds: PixelErrorBounds, dtype: Any) -> np.ndarray:
    image = tolerances.agreement("agreement.image", dtype) * (error_bounds.image + error_bounds.absolute)
    transmittance = tolerances.agreement("agreement.T_final", dtype) * (error_bounds.T_final + 1.0)
    return np.concatenate([image, transmittance[..., None]], axis=2)


def _least(allowed: np.ndarray, change: np.ndarray) -> float:
    """Return how many times a change has to be made before something passes what is allowed."""
    return float(np.min(allowed[change > 0.0] / change[change > 0.0], initial=np.inf))


def image_teeth(dtype: Any) -> dict[str, float]:
    """Return the least error noticed in an image, by the quantity that it stands in."""
    found = dict.fromkeys((*MOVED, "background"), np.inf)
    for scene, error_bounds in _scenes(dtype):
        here, room, sure = _drawn(scene, lambda s: s), _allowed(error_bounds, dtype), error_bounds.unambiguous
        moved = {name: _drawn(scene, move) for name, move in MOVED.items()}
        moved["background"] = _drawn(scene, lambda s: s, STEP)
        for name, there in moved.items():
            found[name] = min(found[name], STEP * _least(room[sure], np.abs(there - here)[sure]))
    return found


def gradient_teeth(dtype: Any) -> dict[str, float]:
    """Return the least share of itself by which a gradient may be wrong and is noticed, by name."""
    found: dict[str, float] = {}
    for _, _, expected, room, _ in _pulled(dtype):
        for name, value in expected.items():
            found[f"v_{name}"] = min(found.get(f"v_{name}", np.inf), _least(room[name], np.abs(value)))
    return found


def _pulled(dtype: Any) -> Iterator[tuple[Scene, PixelErrorBounds, dict[str, Any], dict[str, Any], tuple[Any, Any]]]:
    """Yield scenes with their error bounds, the oracle's gradients, what is allowed of each, and the cotangents."""
    for scene, error_bounds in _scenes(dtype):
        v_image, v_T_final = cotangents(scene)
        v = v_image * error_bounds.smooth[..., None], v_T_final * error_bounds.smooth
        if np.any(error_bounds.screen.kinked):
            continue
        expected, units = OracleAdapter().gradients(scene, *v), gradient_error_bounds(scene, error_bounds, *v)
        room = {name: tolerances.agreement(f"agreement.v_{name}", dtype) * units[name] for name in expected}
        yield scene, error_bounds, expected, room, v


def shares(backend: Adapter) -> dict[str, float]:
    """Return which share of what is allowed a sound backend needs at worst, of images and of every gradient."""
    found = {"image": 0.0}
    for scene, error_bounds in _scenes(backend.dtype):
        view, sure = backend.render(scene), error_bounds.unambiguous
        seen = np.concatenate([view.image, view.T_final[..., None]], axis=2)
        off = np.abs(seen - _drawn(scene, lambda s: s)) / _allowed(error_bounds, backend.dtype)
        found["image"] = max(found["image"], float(np.max(off[sure], initial=0.0)))
    for scene, _, expected, room, v in _pulled(backend.dtype):
        for name, value in backend.gradients(scene, *v).items():
            off = np.abs(value - expected[name])
            worst = float(np.max(off[off > 0.0] / room[name][off > 0.0], initial=0.0))
            found[f"v_{name}"] = max(found.get(f"v_{name}", 0.0), worst)
    return found


def measured() -> dict[str, dict[str, dict[str, float]]]:
    """Return teeth, and the shares of all sound backends that are here, by precision and quantity."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for name, dtype in (("float32", np.float32), ("float64", np.float64)):
        teeth = {**image_teeth(dtype), **gradient_teeth(dtype)}
        needed: dict[str, float] = {}
        for each in SOUND[name]:
            try:
                of_one = shares(shipped(each))
            except Unavailable:
                continue
            needed = {key: max(share, needed.get(key, 0.0)) for key, share in of_one.items()}
        found[name] = {"teeth": _short(teeth), "sound": _short(needed)}
    return found


def _short(values: dict[str, float]) -> dict[str, float]:
    return {name: float(f"{value:.2g}") for name, value in values.items()}


def main(words: list[str]) -> int:
    """Write what was measured into the file named, or print it."""
    if len(words) > 1 or (words[:1] and words[0].startswith("-")):
        print("usage: python -m pop_ref.conformance.teeth [FILE]")
        return 2
    text = json.dumps(measured(), indent=1) + "\n"
    if words:
        write_file(Path(words[0]), text)
    else:
        print(text, end="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
