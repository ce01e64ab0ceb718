"""Portable vectors: scenes with what the oracle makes of them, so that ports are judged without Python.

`export` writes one npz a scene and an `index.json` that explains every array and how it is compared (`vector_schema`);
`vector_check` judges a port's results by that index alone. Needs numpy only.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.error_bounds import PixelErrorBounds, pixel_error_bounds
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.scene_files import scene_arrays, scene_options
from pop_ref.conformance.scenes import Scene, cotangents, rounded_to
from pop_ref.conformance.vector_scenes import vector_scenes
from pop_ref.conformance.vector_schema import GRADIENTS, schema
from pop_ref.margins import margins


def expected_arrays(scene: Scene) -> dict[str, np.ndarray]:
    """Return a vector's arrays: inputs, outputs, error bounds, masks and margins.

    Args:
        scene: every array exact in float32.
    """
    oracle = OracleAdapter()
    drawn = oracle.full_render(scene)
    error_bounds = pixel_error_bounds(scene, np.float32, drawn.tile_lists if scene.profile.extent == "square" else None)
    v_image, v_T_final = cotangents(scene)
    v_image, v_T_final = v_image * error_bounds.smooth[..., None], v_T_final * error_bounds.smooth
    gradients = oracle.gradients(scene, v_image, v_T_final)
    bounds = gradient_error_bounds(scene, error_bounds, v_image, v_T_final)
    found = margins(scene.gaussians, scene.camera, scene.sh_degree, scene.profile, scene.tile_size, scene.antialiased)
    arrays = {**scene_arrays(scene), "v_image": v_image, "v_T_final": v_T_final}
    for name in ("image", "T_final", "dominant_ids", "n_blended"):
        arrays[name] = getattr(drawn, name)
    arrays |= {"radii": drawn.splats.radii, "means2d": drawn.splats.means2d}
    arrays |= _error_bounds(error_bounds)
    for name in GRADIENTS:
        arrays[f"v_{name}"], arrays[f"error_bound_v_{name}"] = gradients[name], bounds[name]
    return {**arrays, **{f"margin_{label}": values for label, values in found.pixels.items()}}


def _error_bounds(error_bounds: PixelErrorBounds) -> dict[str, np.ndarray]:
    smooth = ~error_bounds.screen.kinked
    return {
        "error_bound_image": error_bounds.image + error_bounds.absolute,
        "error_bound_T_final": error_bounds.T_final + 1.0,
        "unambiguous": error_bounds.unambiguous,
        "decided": error_bounds.decided,
        "smooth_rows": smooth,
        "all_smooth": np.array(np.all(smooth)),
    }


def export(folder: Path) -> list[str]:
    """Write every vector and the index into a folder; return the vectors' names."""
    folder.mkdir(parents=True, exist_ok=True)
    vectors: dict[str, Any] = {}
    for name, drawn in vector_scenes().items():
        scene = rounded_to(drawn, np.float32)
        arrays: dict[str, Any] = expected_arrays(scene)
        np.savez_compressed(folder / f"{name}.npz", **arrays)
        shapes = {key: list(np.shape(array)) for key, array in arrays.items()}
        vectors[name] = {"file": f"{name}.npz", "options": _full_options(scene), "shapes": shapes}
    index = {**schema(), "vectors": vectors}
    (folder / "index.json").write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")
    return list(vectors)


def _full_options(scene: Scene) -> dict[str, Any]:
    """Return the scene's options with every default written out: a port has no defaults to take."""
    options = scene_options(scene)
    if options["tile_size"] is None:
        options["tile_size"] = scene.profile.tile_size
    if options["sh_degree"] is None:
        options["sh_degree"] = round(np.sqrt(scene.gaussians.sh.shape[1])) - 1
    return options
