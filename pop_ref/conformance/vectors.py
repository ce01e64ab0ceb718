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
from pop_ref.conformance.charges import PixelCharges, charge
from pop_ref.conformance.gradient_charges import gradient_charges
from pop_ref.conformance.scene_files import scene_arrays, scene_options
from pop_ref.conformance.scenes import Scene, cotangents, rounded_to
from pop_ref.conformance.vector_scenes import vector_scenes
from pop_ref.conformance.vector_schema import GRADIENTS, schema
from pop_ref.margins import margins


def expected_arrays(scene: Scene) -> dict[str, np.ndarray]:
    """Return a vector's arrays: inputs, outputs, charges, masks and margins.

    Args:
        scene: every array exact in float32.
    """
    oracle = OracleAdapter()
    drawn = oracle.full_render(scene)
    charges = charge(scene, np.float32, drawn.tile_lists if scene.profile.extent == "square" else None)
    v_image, v_T_final = cotangents(scene)
    v_image, v_T_final = v_image * charges.smooth[..., None], v_T_final * charges.smooth
    gradients = oracle.gradients(scene, v_image, v_T_final)
    bounds = gradient_charges(scene, charges, v_image, v_T_final)
    found = margins(scene.gaussians, scene.camera, scene.sh_degree, scene.profile, scene.tile_size, scene.antialiased)
    arrays = {**scene_arrays(scene), "v_image": v_image, "v_T_final": v_T_final}
    for name in ("image", "T_final", "dominant_ids", "n_blended"):
        arrays[name] = getattr(drawn, name)
    arrays |= {"radii": drawn.splats.radii, "means2d": drawn.splats.means2d}
    arrays |= _charges(charges)
    for name in GRADIENTS:
        arrays[f"v_{name}"], arrays[f"charge_v_{name}"] = gradients[name], bounds[name]
    return {**arrays, **{f"margin_{label}": values for label, values in found.pixels.items()}}


def _charges(charges: PixelCharges) -> dict[str, np.ndarray]:
    smooth = ~charges.screen.kinked
    return {
        "charge_image": charges.image + charges.absolute,
        "charge_T_final": charges.T_final + 1.0,
        "certain": charges.certain,
        "decided": charges.decided,
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
