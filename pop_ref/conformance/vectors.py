"""Portable vectors: what an exact renderer makes of fixed inputs, so that ports are judged without Python.

`export` writes one npz a vector and an `index.json` that explains every array and how it is compared: single images
with every stage on the way, few scenes, one for each thing that goes wrong in a port; calls of several cameras,
with batches, depth modes and plain colours; the corpus at scale, whose images and gradients are kept as weighted sums;
losses and scripted trainings (`vector_training`); whole steps on photographs (`vector_steps`); single stages
(`vector_stages`). `vector_check` judges a port's results by that index alone. Needs numpy only.

What a call is packed as, and in what form covariances come, is told by options: images are the same.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.conformance import vector_training as training
from pop_ref.conformance.adapter import Adapter, OracleAdapter
from pop_ref.conformance.calls import Call
from pop_ref.conformance.corpus import GRADIENTS as IN_RUNS
from pop_ref.conformance.corpus import MAPS, PLANS, answers, corpus_scene, unambiguous_cotangents
from pop_ref.conformance.error_bounds import PixelErrorBounds, pixel_error_bounds
from pop_ref.conformance.files import write_file
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.scenes import (
    Scene,
    cotangents,
    rounded_to,
    scene_arrays,
    scene_options,
)
from pop_ref.conformance.signature import Expected, expectations
from pop_ref.conformance.vector_check import (
    GRADIENTS,
    IMAGES,
    INPUTS,
    WHERE,
    axes,
    close,
    entry,
    equal,
    gradient,
    output,
    render_kind,
    schema,
)
from pop_ref.conformance.vector_scenes import calls, vector_scenes
from pop_ref.conformance.vector_stages import stage_kinds, stage_vectors
from pop_ref.conformance.vector_steps import steps_kind, steps_vectors
from pop_ref.conformance.vector_training import training_kind, training_vectors
from pop_ref.margins import margins
from pop_ref.splatting import project

# options that change the form of what is given, and no image
FORMS: Final = ("packed", "covars", "no_background")
_GAUSSIANS = ("means", "quats", "scales", "opacities")
_ABOUT = "cameras that look at the same Gaussians, each with its background; 'render_mode' says what an image is"
MODES = {
    "RGB": "colours",
    "D": "depth: the sum of weights times camera z, nothing behind",
    "ED": "expected depth: D over max(1 - T_final, 1e-10)",
    "RGB+D": "colours, then D",
    "RGB+ED": "colours, then ED",
}


def _clear_of_the_far_plane(call: Call) -> Call:
    """Return a call with the plane a little beyond a centre that lies on it: it draws the same, and clearly so."""
    far = call.planes.get("far_plane")
    depths = [project(f.scene.gaussians, f.scene.camera, f.scene.sh_degree, f.scene.profile).depths
              for _, _, f in call.each]  # fmt: skip
    if far is None or not np.any(np.array(depths) == far):
        return call
    return replace(call, planes={**call.planes, "far_plane": far * (1.0 + 2.0**-8)})


def kind_of(call: Call) -> str:
    """Return the kind of a call's vector: its colours' names and shapes, and whether it has batches."""
    form = {"_plain": call.sh_degree is None, "_of_each_camera": call.camera_colors, "_of_batches": bool(call.batch)}
    return "call" + "".join(word for word, holds in form.items() if holds)


KINDS: Final = ("call", "call_plain", "call_of_each_camera", "call_plain_of_each_camera", "call_of_batches",
                "call_plain_of_batches")  # fmt: skip
_OF_ROWS: Final = {
    "means2d": ("[C, N, 2]", "screen centres, px"),
    "depths": ("[C, N]", "camera z"),
    "conics": ("[C, N, 3]", "inverse of the blurred screen covariance: xx, xy, yy, px^-2"),
    "effective_opacities": ("[C, N]", "opacities that blend, antialiased times the factor; 'opacities' of meta"),
}
_BY_CENTRES: Final = {
    "means2d": "derivative of the same sum to screen centres",
    "means2d_abs": "sums over pixels of the absolute values of what each adds to v_means2d",
}
# what gsplat's meta tells of a call besides
_TOLD: Final = {"n_cameras": "cameras", "n_batches": "batch entries", "tile_size": "px, as the option", "width": "px",
                "height": "px", "tile_width": "tiles in a row", "tile_height": "tiles in a column"}  # fmt: skip
_MASKS: Final = {
    "unambiguous": ("[C, H, W]", "every decision of the pixel is clear of rounding"),
    "decided": ("[C, H, W]", "unambiguous, and the dominant Gaussian is clear too"),
    "counted_rows": ("[C, N]", "at no pixel that is undecided the Gaussian is blended, or could be"),
    "clear_rows": ("[C, N]", "no cull and no extent of the Gaussian is within rounding"),
    "visible_rows": ("[C, N]", "clear_rows, and the Gaussian is not culled"),
    "smooth_rows": ("[N]", "no kink of this Gaussian is within rounding for any camera"),
    "smooth_rows_of_each": ("[C, N]", "smooth_rows, once more for each camera"),
    "all_smooth": ("[]", "smooth_rows holds everywhere"),
    "all_clear": ("[]", "clear_rows holds everywhere"),
}
# gsplat's lists of intersections; of an entry of a batch they are left out
_LISTS: Final = {
    "tiles_per_gauss": ("[C, N]", "tiles that each Gaussian's extent overlaps, 'tiles_per_gauss' of meta"),
    "list_rows": ("[I]", "which Gaussians lie in each tile of each camera, front to back: row c N + i, or where rows "
                  "are packed the place among visible ones; 'flatten_ids' of meta"),
    "list_keys": ("[I]", "camera and tile of each: c 2^b + tile, b the bits of the number of tiles; the upper 32 bits "
                  "of 'isect_ids' of meta"),
}  # fmt: skip
_WHOLE_LISTS: Final = "; leave it out where your lists are tighter than whole extents"


def call_kind(kind: str) -> dict[str, Any]:
    """Return what the index says of calls of one of KINDS."""
    plain, own, batches = (word in kind for word in ("_plain", "_of_each_camera", "_of_batches"))
    colors, shape = ("colors", "[N, D]") if plain else ("sh", INPUTS["sh"][0])
    shape = shape.replace("[N", "[C, N") if own else shape
    given = {name: INPUTS[name] for name in _GAUSSIANS}
    given |= {
        colors: (shape, "colours as they are drawn" if plain else INPUTS["sh"][1]),
        "viewmats": ("[C, 4, 4]", "world -> camera, of each camera"),
        "Ks": ("[C, 3, 3]", "intrinsics, px, of each camera"),
        "backgrounds": ("[C, B]", "colours behind everything, of each camera"),
        "v_images": ("[C, H, W, X]", "cotangents of images; zero near thresholds"),
        "v_alphas": ("[C, H, W]", "cotangents of alphas; zero near thresholds"),
    }
    arrays = {name: entry("input", *about) for name, about in given.items()}
    arrays |= output("images", "[C, H, W, X]", "what every camera sees", "agreement.image", "unambiguous")
    arrays |= output("alphas", "[C, H, W]", "1 - T_final", "agreement.T_final", "unambiguous")
    arrays |= output("T_final", "[C, H, W]", "transmittance that is left", "agreement.T_final", "unambiguous")
    for name, said in _TOLD.items():
        arrays[name] = entry("output", "[]", said, "int64", [equal()])
    for name, where in (("dominant_ids", "decided"), ("n_blended", "unambiguous")):
        arrays[name] = entry("output", "[C, H, W]", IMAGES[name][1], "int64", [equal(where)])
    counted = "pixels that each Gaussian dominates"
    arrays["dominant_counts"] = entry("output", "[C, N]", counted, "int64", [equal("counted_rows")])
    extents = "extents along x and y, px, 0 where culled"
    arrays["radii"] = entry("output", "[C, N, 2]", extents, "int64", [equal("clear_rows")])
    for name, (shape, said) in () if batches else _LISTS.items():
        where = "clear_rows" if shape == "[C, N]" else "all_clear"
        arrays[name] = entry("output", shape, said + _WHOLE_LISTS, "int64", [equal(where)])
    for name, about in _OF_ROWS.items():
        arrays |= output(name, *about, "meta.rows", "visible_rows")
    for name in (*_GAUSSIANS, colors):
        whose = "" if own and name == colors else ", summed over cameras"
        where = "smooth_rows_of_each" if own and name == colors else "smooth_rows"
        meaning = f"derivative of sum(v_images images) + sum(v_alphas alphas) to {name}{whose}"
        arrays |= output(f"v_{name}", given[name][0], meaning, f"agreement.v_{name}", where)
    for name, meaning in _BY_CENTRES.items():
        arrays |= output(f"v_{name}", "[C, N, 2]", meaning, f"agreement.v_{name}", "smooth_rows_of_each")
    for name, key in (("viewmats", "viewmat"), ("backgrounds", "background")):
        where = "all_smooth" if name == "viewmats" else None
        arrays |= output(f"v_{name}", given[name][0], f"derivative to {name}", f"agreement.v_{key}", where)
    arrays |= {name: entry("mask", *about, "bool") for name, about in _MASKS.items()}
    if batches:
        for about in arrays.values():
            about["shape"] = axes("E", about["shape"][1:-1])
    return {"about": _ABOUT, "modes": MODES, "arrays": arrays}


def call_arrays(call: Call) -> dict[str, np.ndarray]:
    """Return a call's arrays; of batches the entries lie along one axis."""
    entries = expectations(Adapter(), _clear_of_the_far_plane(call))
    rows = [_entry(call, b, row) for b, row in enumerate(entries)]
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]} if call.batch else rows[0]


def _entry(call: Call, b: int, row: list[Expected]) -> dict[str, np.ndarray]:
    colors = "sh" if call.sh_degree is not None else "colors"
    # quaternions and scales are the input also where a rasterizer is given covariances
    tensors = replace(call, covars=False, no_background=False).tensors()
    given = {colors if name == "colors" else name: call.by_entry(value)[b] for name, value in tensors.items()}
    arrays = {**given, "Ks": call.by_entry(call.intrinsics())[b]}
    arrays["v_images"] = np.stack([e.v_image for e in row])
    arrays["v_alphas"] = -np.stack([e.v_T_final for e in row])
    arrays["images"] = np.stack([e.render.image for e in row])
    arrays["error_bound_images"] = np.stack([e.image_error_bounds for e in row])
    arrays["alphas"] = 1.0 - np.stack([e.render.T_final for e in row])
    arrays["error_bound_alphas"] = np.stack([e.error_bounds.T_final + 1.0 for e in row])
    arrays |= {"T_final": 1.0 - arrays["alphas"], "error_bound_T_final": arrays["error_bound_alphas"]}
    camera, side = call.first.scene.camera, call.tile_size
    tiles = (-(-camera.width // side), -(-camera.height // side))
    told = (len(row), len(call.frames), side, camera.width, camera.height, *tiles)
    arrays |= {name: np.array(value) for name, value in zip(_TOLD, told, strict=True)}
    for name in ("dominant_ids", "n_blended"):
        arrays[name] = np.stack([getattr(e.render, name) for e in row])
    n = len(given["means"])
    counts = [np.bincount(ids[ids >= 0], minlength=n) for ids in arrays["dominant_ids"]]
    arrays["dominant_counts"] = np.stack(counts).astype(np.int64)
    arrays["unambiguous"] = np.stack([e.error_bounds.unambiguous for e in row])
    arrays["decided"] = np.stack([e.error_bounds.decided for e in row])
    arrays["counted_rows"] = np.stack([_counted(e, n) for e in row])
    smooth = ~np.any([e.error_bounds.screen.kinked for e in row], axis=0)
    arrays |= {"smooth_rows": smooth, "smooth_rows_of_each": np.tile(smooth, (len(row), 1))}
    arrays |= {} if call.batch else _lists(call, row)
    arrays |= _splats(row) | _gradients(row, colors, call.camera_colors)
    return arrays | {"all_smooth": np.array(np.all(smooth)), "all_clear": np.array(np.all(arrays["clear_rows"]))}


def _lists(call: Call, row: list[Expected]) -> dict[str, np.ndarray]:
    """Return the lists of intersections of all cameras, one after the other."""
    n, rows, keys = len(row[0].render.splats.visible), list[int](), list[int]()
    before, counts = 0, np.zeros((len(row), n), dtype=np.int64)
    for c, e in enumerate(row):
        visible = e.render.splats.visible
        place = before + (np.cumsum(visible) - 1 if call.packed else np.arange(n))
        before += int(np.sum(visible)) if call.packed else n
        bits = len(e.render.tile_lists).bit_length()
        for tile, listed in enumerate(e.render.tile_lists):
            rows += [int(place[i]) for i in listed]
            keys += [(c << bits) | tile] * len(listed)
            counts[c, listed] += 1
    return {"tiles_per_gauss": counts, "list_rows": np.array(rows), "list_keys": np.array(keys)}


def _counted(e: Expected, n: int) -> np.ndarray:
    found = np.ones(n, dtype=bool)
    for layer in e.error_bounds.layers:
        found[layer.id] = not np.any((layer.blended | layer.near_threshold) & ~e.error_bounds.decided)
    return found


def _splats(row: list[Expected]) -> dict[str, np.ndarray]:
    clear = np.stack([e.clear for e in row])
    visible = clear & np.stack([e.render.splats.visible for e in row])
    found = {"radii": np.stack([e.render.splats.radii for e in row]), "clear_rows": clear, "visible_rows": visible}
    for name in _OF_ROWS:
        # what is culled holds no number
        key = name.removeprefix("effective_")
        values = np.stack([getattr(e.render.splats, key) for e in row])
        bounds = np.stack([getattr(e.error_bounds.screen, f"e_{key}") for e in row]) + np.abs(values)
        finite = np.isfinite(values) & np.isfinite(bounds)
        found |= {name: np.where(finite, values, 0.0), f"error_bound_{name}": np.where(finite, bounds, 0.0)}
    return found


def _gradients(row: list[Expected], colors: str, own_colors: bool) -> dict[str, np.ndarray]:
    pulled = [e.gradients for e in row]
    of_each = ("viewmats", "backgrounds", *_BY_CENTRES, *["colors"] * own_colors)
    names = {name: name for name in (*_GAUSSIANS, "viewmats", "backgrounds", *_BY_CENTRES)} | {"colors": colors}
    found: dict[str, np.ndarray] = {}
    for name, own in names.items():
        gathered = np.stack if name in of_each else _added
        found[f"v_{own}"] = gathered([value[name] for value, _ in pulled])
        found[f"error_bound_v_{own}"] = gathered([bound[name] for _, bound in pulled])
    return found


def _added(values: list[np.ndarray]) -> np.ndarray:
    return np.sum(values, axis=0)


_TRAINING = {
    "loss": training.loss_vectors,
    "pop": training.pop_vectors,
    "adam": training.adam_vectors,
    "density": training.density_vectors,
    "training": training_vectors,
    "steps": steps_vectors,
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
        "steps": steps_kind(),
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
    arrays |= {"dominant_weights": drawn.dominant_weights}
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
        "error_bound_dominant_weights": error_bounds.dominant_weight + 1.0,
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
    write_file(folder / "index.json", json.dumps(index, indent=1) + "\n")
    return list(vectors)


def _full_options(scene: Scene) -> dict[str, Any]:
    """Return the scene's options with every default written out: a port has no defaults to take."""
    return scene_options(scene) | {"tile_size": scene.side, "sh_degree": scene.degree}


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
