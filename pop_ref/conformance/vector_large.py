"""Portable vectors at scale: the corpus, whose images and gradients are kept as weighted sums."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from pop_ref.conformance.corpus import PLANS, corpus_scene
from pop_ref.conformance.corpus_answers import GRADIENTS as IN_RUNS
from pop_ref.conformance.corpus_answers import MAPS, answers, unambiguous_cotangents
from pop_ref.conformance.scene_files import scene_arrays
from pop_ref.conformance.scenes import Scene
from pop_ref.conformance.vector_schema import (
    GRADIENTS,
    IMAGES,
    INPUTS,
    WHERE,
    close,
    entry,
    equal,
    gradient,
)

_SUMS = {"image": "[blocks, 3]", "T_final": "[blocks, 1]", "dominant_ids": "[blocks, 1]", "n_blended": "[blocks, 1]"}
_RUNS = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh": "3 n_sh", "means2d": 2, "means2d_abs": 2}

# Gaussians of a vector; those of a larger scene would be a file of many megabytes
MOST: Final = 10_000


def large_kind() -> dict[str, Any]:
    """Return what the index says of vectors at scale."""
    arrays = {name: entry("input", *about) for name, about in INPUTS.items()}
    for name, (shape, meaning) in IMAGES.items():
        whole = name in ("dominant_ids", "n_blended")
        more = {"reduce": "blocks", "expected": f"sums_{name}"}
        rule = (
            equal(WHERE[name], **more) if whole else close(f"scale.{name}", f"error_bound_{name}", WHERE[name], **more)
        )
        arrays[name] = entry("output", shape, meaning, "int64" if whole else "float64", [rule]) | {"stored": False}
        arrays[f"sums_{name}"] = entry("sums", _SUMS[name], f"of {name}", "int64" if whole else "float64")
        if not whole:
            arrays[f"error_bound_{name}"] = entry("error_bound", _SUMS[name], f"what rounding may cost in sums_{name}")
    for name in GRADIENTS:
        shape = {"means2d": "[N, 2]", "means2d_abs": "[N, 2]"}.get(name) or INPUTS[name][0]
        more = {"expected": f"sums_v_{name}"} | ({"reduce": "runs"} if name in IN_RUNS else {})
        rule = close(f"scale.v_{name}", f"error_bound_v_{name}", **more)
        arrays[f"v_{name}"] = entry("output", shape, gradient(name), compare=[rule]) | {"stored": False}
        sums = f"[runs, {_RUNS[name]}]" if name in IN_RUNS else shape
        arrays[f"sums_v_{name}"] = entry("sums", sums, f"of v_{name}")
        arrays[f"error_bound_v_{name}"] = entry("error_bound", sums, f"what rounding may cost in sums_v_{name}")
    meanings = ("every decision behind the pixel is clear of float32's rounding", "and no ceiling is near (D6)",
                "and the dominant Gaussian is clear too")  # fmt: skip
    arrays |= {name: entry("mask", "[H, W]", said, "bool") for name, said in zip(MAPS, meanings, strict=True)}
    about = "up to 5,000 Gaussians: long lists, many tiles, tiles cut by the border; judged by weighted sums"
    return {"about": about, "arrays": arrays}


def large_vectors() -> dict[str, tuple[dict[str, np.ndarray], Scene, dict[str, list[int]]]]:
    """Return arrays, scene and the shapes of what is not stored, by name."""
    return {f"large_{name}": (*_vector(name),) for name, plan in PLANS.items() if plan.n <= MOST}


def _vector(name: str) -> tuple[dict[str, np.ndarray], Scene, dict[str, list[int]]]:
    scene, kept = corpus_scene(name), answers(name)
    v_image, v_T_final = unambiguous_cotangents(scene, kept["smooth"])
    arrays = {**scene_arrays(scene), "v_image": v_image, "v_T_final": v_T_final}
    for key, part in (("image", np.s_[:, :3]), ("T_final", np.s_[:, 3:])):
        arrays[f"sums_{key}"] = kept["blocks"][part]
        arrays[f"error_bound_{key}"] = kept["e_blocks"][part].astype(np.float64)
    arrays |= {"sums_dominant_ids": kept["winners"], "sums_n_blended": kept["blended"]}
    for key in GRADIENTS:
        arrays[f"sums_v_{key}"] = kept[f"v_{key}"]
        arrays[f"error_bound_v_{key}"] = kept[f"e_{key}"].astype(np.float64)
    arrays |= {key: kept[key] for key in MAPS}
    H, W, g = scene.camera.height, scene.camera.width, scene.gaussians
    shapes = {"image": [H, W, 3], "T_final": [H, W], "dominant_ids": [H, W], "n_blended": [H, W]}
    shapes |= {f"v_{key}": list(np.shape(getattr(g, key))) for key in ("means", "quats", "scales", "opacities", "sh")}
    shapes |= {"v_viewmat": [4, 4], "v_background": [3], "v_means2d": [len(g), 2], "v_means2d_abs": [len(g), 2]}
    return arrays, scene, shapes
