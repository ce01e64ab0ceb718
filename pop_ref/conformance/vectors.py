"""Portable vectors: what an exact renderer makes of fixed inputs, so that ports are judged without Python.

`export` writes one npz a vector and an `index.json` that explains every array and how it is compared (`vector_schema`):
single images with every stage on the way (`vector_scenes`), calls of several cameras (`vector_calls`), the corpus at
scale (`vector_large`), losses and training steps (`vector_training`). `vector_check` judges a port's results by that
index alone. Needs numpy only.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pop_ref.conformance import vector_training as training
from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.error_bounds import PixelErrorBounds, pixel_error_bounds
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.scene_files import scene_arrays, scene_options
from pop_ref.conformance.scenes import Scene, cotangents, rounded_to
from pop_ref.conformance.vector_calls import FORMS, KINDS, call_arrays, call_kind, calls, kind_of
from pop_ref.conformance.vector_large import large_kind, large_vectors
from pop_ref.conformance.vector_methods import training_kind, training_vectors
from pop_ref.conformance.vector_scenes import vector_scenes
from pop_ref.conformance.vector_schema import GRADIENTS, render_kind, schema
from pop_ref.conformance.vector_stages import stage_kinds, stage_vectors
from pop_ref.margins import margins

_TRAINING = {
    "loss": training.loss_vectors,
    "pop": training.pop_vectors,
    "adam": training.adam_vectors,
    "density": training.density_vectors,
    "training": training_vectors,
}


def kinds() -> dict[str, dict[str, Any]]:
    """Return what the index says of each kind of vector."""
    return {
        "render": render_kind(),
        **{kind: call_kind(kind) for kind in KINDS},
        "large": large_kind(),
        "loss": training.loss_kind(),
        "pop": training.pop_kind(),
        "adam": training.adam_kind(),
        "density": training.density_kind(),
        "training": training_kind(),
        **stage_kinds(),
    }


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
    clear = found.safe_gaussians(64.0 * float(np.finfo(np.float32).eps), ("D1", "D2", "D3"))
    arrays = {**scene_arrays(scene), "v_image": v_image, "v_T_final": v_T_final}
    for name in ("image", "T_final", "dominant_ids", "n_blended"):
        arrays[name] = getattr(drawn, name)
    arrays |= _error_bounds(error_bounds) | _stages(drawn.splats, error_bounds)
    for name in GRADIENTS:
        arrays[f"v_{name}"], arrays[f"error_bound_v_{name}"] = gradients[name], bounds[name]
    arrays |= {"clear_rows": clear, "visible_rows": clear & drawn.splats.visible}
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


def _stages(splats: Any, error_bounds: PixelErrorBounds) -> dict[str, np.ndarray]:
    s = error_bounds.screen
    values = {
        "depths": (splats.depths, s.e_depths),
        "means2d": (splats.means2d, s.e_means2d),
        "conics": (splats.conics, s.e_conics),
        "effective_opacities": (splats.opacities, s.e_opacities),
        "colors": (splats.colors, s.e_colors),
    }
    # what is culled holds no number
    found = {name: np.where(np.isfinite(value), value, 0.0) for name, (value, _) in values.items()}
    for name, (value, e) in values.items():
        bound = e + np.abs(value)
        found[f"error_bound_{name}"] = np.where(np.isfinite(bound), bound, 0.0)
    return {**found, "radii": splats.radii}


# rows that nobody sees; the next ones need a third byte
_HIDDEN = 70_000


def _behind_rows(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return a vector of one image whose Gaussians are the last ones, after thousands behind the camera."""
    kinds_of, found = render_kind()["arrays"], dict(arrays)
    R, t = arrays["viewmat"][:3, :3], arrays["viewmat"][:3, 3]
    hidden = {"means": R.T @ (np.array([0.0, 0.0, -8.0]) - t), "quats": np.array([1.0, 0.0, 0.0, 0.0]),
              "scales": np.ones(3), "opacities": 0.5, "clear_rows": True, "smooth_rows": True}  # fmt: skip
    for name, array in arrays.items():
        if kinds_of[name]["shape"].startswith("[N"):
            row = np.broadcast_to(np.asarray(hidden.get(name, 0.0)), array.shape[1:]).astype(np.float32)
            found[name] = np.concatenate([np.repeat(row[None], _HIDDEN, axis=0).astype(array.dtype), array])
    ids = arrays["dominant_ids"]
    return found | {"dominant_ids": np.where(ids >= 0, ids + _HIDDEN, ids)}


def export(folder: Path) -> list[str]:
    """Write every vector and the index into a folder; return the vectors' names."""
    folder.mkdir(parents=True, exist_ok=True)
    vectors: dict[str, Any] = {}

    def write(name: str, kind: str, arrays: dict[str, Any], options: dict[str, Any], more: Any = None) -> None:
        np.savez_compressed(folder / f"{name}.npz", **arrays)
        shapes = {key: list(np.shape(array)) for key, array in arrays.items()} | (more or {})
        vectors[name] = {"kind": kind, "file": f"{name}.npz", "options": options, "shapes": shapes}

    for name, drawn in vector_scenes().items():
        scene = rounded_to(drawn, np.float32)
        write(name, "render", expected_arrays(scene), _full_options(scene))
    # one scene once more, behind more rows than two bytes number
    last = rounded_to(vector_scenes()["a_turned_camera"], np.float32)
    write("large_rows_beyond_two_bytes", "render", _behind_rows(expected_arrays(last)), _full_options(last))
    for name, call in calls().items():
        options = _full_options(call.first.scene.with_overrides(profile=call.profile))
        options |= {name: getattr(call, name) for name in ("render_mode", "radius_clip", "batch", *FORMS)}
        write(name, kind_of(call), call_arrays(call), options)
    for name, (arrays, scene, shapes) in large_vectors().items():
        write(name, "large", arrays, _full_options(scene), shapes)
    for kind, made in _TRAINING.items():
        for name, (arrays, options) in made().items():
            write(name, kind, arrays, options)
    for name, (arrays, options) in stage_vectors().items():
        write(name, name, arrays, options)
    index = {**schema(kinds()), "vectors": vectors}
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
