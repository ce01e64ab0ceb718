"""Portable vectors: scenes with what the oracle makes of them, so that ports are judged without Python.

`export` writes one npz a scene and an `index.json` that explains every array. A port reads the inputs, writes an npz of
the same name with as many of the outputs as it has, and `check` (or a port's own few lines) holds them to

    |result - expected| <= units * eps * charge    where the mask is true,        integers exactly where theirs is,

with eps of the port's precision: `charge` is what rounding may cost, computed from absolute values.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.conformance import tolerances
from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.charges import PixelCharges, charge
from pop_ref.conformance.gradient_charges import gradient_charges
from pop_ref.conformance.scene_files import scene_arrays
from pop_ref.conformance.scenes import Scene, rounded_to
from pop_ref.conformance.strategies import cotangents
from pop_ref.conformance.vector_scenes import vector_scenes
from pop_ref.margins import margins

VERSION: Final = 1
GRADIENTS: Final = ("means", "quats", "scales", "opacities", "sh", "viewmat", "background", "means2d", "means2d_abs")
SCHEMA: Final = {
    "means quats scales opacities sh viewmat K background": "inputs, all exact in float32; quats are wxyz, scales and "
    "opacities activated, viewmat world -> camera in OpenCV's axes, pixel centres at +0.5",
    "options": "a JSON string: width, height, tile_size, sh_degree, antialiased, and the profile's constants",
    "v_image v_T_final": "cotangents that the gradients belong to; zero where a decision is doubtful",
    "image T_final": "expected output; charge_* beside each, compared where `certain`",
    "dominant_ids n_blended": "expected integers, compared exactly where `decided` and where `certain`",
    "v_*": "expected gradients of sum(v_image image) + sum(v_T_final T_final); charge_v_* beside each",
    "smooth_rows": "Gaussians whose own kinks (B1, B2) are clear of rounding; other rows of gradients are not compared",
    "margin_D1 ... margin_D8": "per pixel, how far each decision is from flipping; float32 decides alike over 1e-6",
}


@dataclass(frozen=True)
class Verdict:
    """One array of one vector.

    Attributes:
        vector, array: names.
        units: the largest difference, in eps times charge; for integers the number of wrong entries.
        allowed: the largest that passes.
    """

    vector: str
    array: str
    units: float
    allowed: float

    @property
    def passed(self) -> bool:
        """Tell whether the array is as good as rounding lets it be."""
        return self.units <= self.allowed


def expected_arrays(scene: Scene) -> dict[str, np.ndarray]:
    """Return a vector's arrays: inputs, outputs, charges, masks and margins."""
    scene = rounded_to(scene, np.float32)
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
    return {
        "charge_image": charges.image + charges.absolute,
        "charge_T_final": charges.T_final + 1.0,
        "certain": charges.certain,
        "decided": charges.decided,
        "smooth_rows": ~charges.screen.kinked,
    }


def export(folder: Path) -> list[str]:
    """Write every vector and the index; return the names."""
    folder.mkdir(parents=True, exist_ok=True)
    units = {
        "image": "agreement.image",
        "T_final": "agreement.T_final",
        **{f"v_{n}": f"agreement.v_{n}" for n in GRADIENTS},
    }
    index: dict[str, Any] = {
        "version": VERSION,
        "schema": SCHEMA,
        "units": {array: tolerances.TABLE[key].units for array, key in units.items()},
        "vectors": {},
    }
    for name, scene in vector_scenes().items():
        arrays: dict[str, Any] = expected_arrays(scene)
        np.savez_compressed(folder / f"{name}.npz", **arrays)
        index["vectors"][name] = {key: [str(a.dtype), list(a.shape)] for key, a in arrays.items()}
    (folder / "index.json").write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")
    return list(index["vectors"])


def check(folder: Path, results: Path, dtype: Any = np.float32) -> list[Verdict]:
    """Hold a port's results to the vectors of a folder; a result that is missing is not judged."""
    index = json.loads((folder / "index.json").read_text(encoding="utf-8"))
    if index["version"] != VERSION:
        raise ValueError(f"{folder} holds vectors of version {index['version']}; this program reads version {VERSION}")
    verdicts = []
    for name in index["vectors"]:
        path = results / f"{name}.npz"
        if path.exists():
            with np.load(folder / f"{name}.npz") as wanted, np.load(path) as found:
                verdicts += _judge(name, dict(wanted), dict(found), index["units"], dtype)
    return verdicts


def _judge(
    name: str, wanted: dict[str, Any], found: dict[str, Any], units: dict[str, float], dtype: Any
) -> list[Verdict]:
    verdicts = []
    for array in (a for a in found if a in wanted):
        if found[array].shape != wanted[array].shape:
            raise ValueError(
                f"{name}: {array} has shape {list(found[array].shape)}, expected {list(wanted[array].shape)}"
            )
        where = _compared(array, wanted)
        if array in units:
            size = float(np.finfo(dtype).eps) * wanted[f"charge_{array}"] + float(np.finfo(dtype).tiny)
            off = np.abs(found[array].astype(np.float64) - wanted[array]) / size
            off = np.where(np.isfinite(off), off, np.inf)
            verdicts.append(Verdict(name, array, float(np.max(off[where], initial=0.0)), units[array]))
        elif wanted[array].dtype.kind == "i":
            verdicts.append(Verdict(name, array, float(np.sum((found[array] != wanted[array])[where])), 0.0))
    return verdicts


def _compared(array: str, wanted: dict[str, Any]) -> Any:
    if array == "dominant_ids":
        return wanted["decided"]
    if array in ("image", "T_final", "n_blended"):
        return wanted["certain"]
    if array == "v_viewmat":
        return np.full((4, 4), bool(np.all(wanted["smooth_rows"])))
    if array.startswith("v_") and array != "v_background":
        return wanted["smooth_rows"]
    return slice(None)
