"""Portable vectors: what an exact renderer makes of fixed inputs, so that ports are judged without Python.

`export` writes one npz a vector and an `index.json` that explains every array and how it is compared: single images
with every stage on the way, few scenes, one for each thing that goes wrong in a port; calls of several cameras
(`vector_calls`); the corpus at scale, whose images and gradients are kept as weighted sums; losses and training steps
(`vector_training`); single stages (`vector_stages`). `vector_check` judges a port's results by that index alone. Needs
numpy only.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.conformance import vector_training as training
from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.corpus import GRADIENTS as IN_RUNS
from pop_ref.conformance.corpus import MAPS, PLANS, answers, corpus_scene, unambiguous_cotangents
from pop_ref.conformance.error_bounds import PixelErrorBounds, pixel_error_bounds
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.scenes import (
    Record,
    Scene,
    cotangents,
    golden_scene,
    pack,
    rounded_to,
    scene_arrays,
    scene_options,
)
from pop_ref.conformance.vector_calls import FORMS, KINDS, call_arrays, call_kind, calls, kind_of
from pop_ref.conformance.vector_check import (
    GRADIENTS,
    IMAGES,
    INPUTS,
    WHERE,
    close,
    entry,
    equal,
    gradient,
    render_kind,
    schema,
)
from pop_ref.conformance.vector_stages import stage_kinds, stage_vectors
from pop_ref.conformance.vector_training import training_kind, training_vectors
from pop_ref.constants import GSPLAT_1_6, INRIA, PAPER, Profile
from pop_ref.margins import margins
from pop_ref.records import Camera

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
    return scene_options(scene) | {"tile_size": scene.side, "sh_degree": scene.degree}


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
