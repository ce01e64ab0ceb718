"""What the portable vectors alone would have noticed: `python -m pop_ref.conformance.vector_kills FILE [--more]`.

Every mutant answers the vectors as a port would (`answer`); it is killed where an array fails, or where it raises. The
laws see more: they draw scenes, compare a rasterizer with itself, and judge stages that no vector is about.

With `--more`, after vectors or mutants were added and none was changed, what the file says to be killed stays so, and
the others are tried.
"""

from __future__ import annotations

import functools
import json
import math
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pop_ref.conformance import capabilities
from pop_ref.conformance import vector_training as training
from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.backends import SHIPPED, shipped
from pop_ref.conformance.calls import Call, Frame, unpacked
from pop_ref.conformance.files import write_file
from pop_ref.conformance.mutants import FAMILIES
from pop_ref.conformance.mutants.trial import alive
from pop_ref.conformance.scenes import Scene, scene_from
from pop_ref.conformance.vector_check import read_index, verdicts_of
from pop_ref.conformance.vector_stages import made, outputs
from pop_ref.conformance.vector_steps import HeldTraining, answered_steps
from pop_ref.conformance.vector_training import Replay, step_sums
from pop_ref.conformance.vectors import FORMS, KINDS, export
from pop_ref.constants import PAPER, Profile
from pop_ref.covariance import covars_from_quats_scales_vjp
from pop_ref.density import DensityConfig, rows_from_params
from pop_ref.records import Camera, Gaussians


def first_failure(folder: Path, backend: Any) -> str | None:
    """Return the first vector and array at which a backend fails, or what it raises; None where it passes.

    Args:
        folder: that `vectors.export` wrote.
        backend: an adapter.
    """
    index, precision = _index(folder), np.dtype(backend.dtype).name
    # what takes longest comes last
    for name in sorted(index["vectors"], key=lambda name: name.startswith("large_")):
        vector = index["vectors"][name]
        try:
            with np.load(folder / vector["file"]) as stored:
                result = answered(backend, vector["kind"], dict(stored), vector["options"])
            found = verdicts_of(index, folder, name, result, precision, folder / name)
        # mistakes of this program, which no mutant makes
        except (NameError, ImportError):
            raise
        except Exception as error:
            return f"{name}: raises {type(error).__name__}"
        for verdict in found:
            if not verdict.passed:
                return f"{name}: {verdict.array}"
    return None


@functools.cache
def _index(folder: Path) -> dict[str, Any]:
    return read_index(folder)


Kills = dict[str, dict[str, str | None]]


def kills(report: Callable[[str, str | None], None] = lambda name, found: None, known: Kills | None = None) -> Kills:
    """Return by family and mutant what fails first, None for a mutant that survives; sound backends are a family, too.

    Args:
        report: is given every name and result as it comes.
        known: a mutant that is killed in these is not tried.
    """
    found: Kills = {family: {} for family in (*FAMILIES, "sound")}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "vectors"
        export(folder)
        trials: list[tuple[str, str, Callable[[], AbstractContextManager[Any]]]] = []
        for family, mutants in FAMILIES.items():
            trials += [(family, mutant.name, partial(alive, mutant)) for mutant in mutants]
        for family, name, living in trials:
            found[family][name] = (known or found).get(family, {}).get(name)
            if found[family][name] is None:
                with living() as backend:
                    found[family][name] = first_failure(folder, backend)
            report(name, found[family][name])
        for name in SHIPPED:
            found["sound"][name] = first_failure(folder, shipped(name))
    return found


def main(words: list[str]) -> int:
    """Write the results."""
    more = words[1:] == ["--more"]
    if len(words) != 1 + more or words[0].startswith("-"):
        print("usage: python -m pop_ref.conformance.vector_kills FILE [--more]")
        return 2
    known = json.loads(Path(words[0]).read_text(encoding="utf-8")) if more else None
    found = kills(lambda name, first: print(f"{name}: {first or 'survives'}", flush=True), known)
    write_file(Path(words[0]), json.dumps(found, indent=1) + "\n")
    return 0


Arrays = dict[str, np.ndarray]
LARGE = 100


def answer(folder: Path, results: Path, backend: Any) -> list[str]:
    """Answer every vector of a folder as far as a backend can; return the names of those that it could not.

    Args:
        folder: that `vectors.export` wrote.
        results: is made.
        backend: an adapter.
    """
    results.mkdir(parents=True)
    index, unanswered = json.loads((folder / "index.json").read_text(encoding="utf-8")), []
    for name, vector in index["vectors"].items():
        with np.load(folder / vector["file"]) as stored:
            arrays = dict(stored)
        outputs = answered(backend, vector["kind"], arrays, vector["options"])
        if outputs:
            given: dict[str, Any] = outputs
            np.savez(results / f"{name}.npz", **given)
        else:
            unanswered.append(name)
    return unanswered


def answered(backend: Any, kind: str, arrays: Arrays, options: dict[str, Any]) -> Arrays:
    """Return a backend's outputs for one vector; none where it lacks what the vector is about."""
    answers = {
        "render": _image,
        "large": _image,
        **dict.fromkeys(KINDS, _call),
        "loss": _loss,
        "pop": _pop,
        "adam": _adam,
        "density": _density,
        "training": _training,
        "steps": _steps,
    }
    # every stage function has a kind of its own
    return answers.get(kind, _stage)(backend, arrays, options)


def _image(backend: Any, arrays: Arrays, options: dict[str, Any]) -> Arrays:
    scene = scene_from(arrays, options)
    able = backend.has(capabilities.RENDER) and (len(scene.gaussians) < LARGE or backend.has(capabilities.SCALE))
    if not able or not _same(backend.sees(scene), scene):
        return {}
    view = backend.render(scene)
    found = {"image": view.image, "T_final": view.T_final, "n_blended": view.n_blended, "radii": view.radii}
    found |= {name: getattr(view, name) for name in ("means2d", "depths", "conics")}
    if backend.has(capabilities.DOMINANCE):
        found["dominant_ids"] = view.dominant_ids
    if backend.has(capabilities.DOMINANT_WEIGHTS):
        found["dominant_weights"] = view.dominant_weights
    if isinstance(backend, OracleAdapter):
        splats = backend.full_render(scene).splats
        found |= {"colors": splats.colors, "effective_opacities": splats.opacities}
    if "depths" not in arrays:
        # a large vector asks for the image alone
        found = {name: found.get(name) for name in ("image", "T_final", "n_blended", "dominant_ids")}
    if backend.has(capabilities.GRADIENTS):
        v = backend.gradients(scene, arrays["v_image"], arrays["v_T_final"])
        found |= {f"v_{name}": value for name, value in v.items()}
    return {name: np.asarray(value) for name, value in found.items() if value is not None}


def _same(seen: Scene, scene: Scene) -> bool:
    # a backend of one profile, without a principal point or of fewer bands reads another scene than the vector holds
    same = (np.array_equal(getattr(seen.gaussians, name), getattr(scene.gaussians, name)) for name in ("means", "sh"))
    return seen.profile == scene.profile and all(same)


def _call(backend: Any, arrays: Arrays, options: dict[str, Any]) -> Arrays:
    call = call_of(arrays, options)
    if not all(backend.has(need) for need in _needs(call)):
        return {}
    batched = len(call.batch) > 0
    whole = {name: value if batched else value[None] for name, value in arrays.items()}
    cotangents = (whole["v_images"], whole["v_alphas"]) if backend.has(capabilities.GRADIENTS) else ()
    called = backend.call(call, *cotangents)
    found = {"images": called.images, "alphas": called.alphas}
    for name, key in (("dominant_ids", "dominant_ids"), ("n_blended", "n_contrib")):
        if key in called.meta:
            found[name] = called.meta[key].reshape(called.alphas.shape)
    if "final_T" in called.meta:
        found["T_final"] = called.meta["final_T"].reshape(called.alphas.shape)
    # of a rasterizer whose tiles have a side of their own nothing is expected
    of_tiles = ("tile_size", "tile_width", "tile_height") if backend.takes("tile_size") else ()
    told = ("n_cameras", "n_batches", "width", "height", *of_tiles)
    entries = call.shape[0]
    found |= {name: np.full(entries, called.meta[name]) for name in told if name in called.meta}
    if "dominant_counts" in called.meta:
        found["dominant_counts"] = called.meta["dominant_counts"].reshape(call.shape)
    if not call.batch:
        found |= _lists(backend, call, called.meta, arrays)
    for name in ("radii", "means2d", "depths", "conics", "opacities"):
        rows = unpacked(call, called.meta[name], called.meta) if name in called.meta else None
        found |= {} if rows is None else {name.replace("opacities", "effective_opacities"): rows}
    screen = {name: value for name, value in called.gradients.items() if name in ("means2d", "means2d_abs")}
    found |= {f"v_{name}": value for name, value in screen.items()}
    names = {name: name for name in ("means", "quats", "scales", "opacities", "viewmats", "backgrounds")}
    names["colors"] = "colors" if call.sh_degree is None else "sh"
    found |= {f"v_{names[name]}": call.by_entry(v) for name, v in called.gradients.items() if name in names}
    if "covars" in called.gradients:
        found |= _through_covariances(call, call.by_entry(called.gradients["covars"]))
    return found if batched else {name: value[0] for name, value in found.items()}


def _lists(backend: Any, call: Call, meta: Any, arrays: Arrays) -> Arrays:
    """Return what meta tells of tiles, each with an axis for the one entry; nothing of tiles of another side."""
    if not backend.takes("tile_size") or not all(name in meta for name in ("flatten_ids", "isect_ids")):
        return {}
    found = {"list_rows": meta["flatten_ids"][None], "list_keys": (meta["isect_ids"] >> 32)[None]}
    counts = unpacked(call, meta["tiles_per_gauss"], meta) if "tiles_per_gauss" in meta else None
    found |= {} if counts is None else {"tiles_per_gauss": counts}
    found = {name: value.astype(np.int64) for name, value in found.items()}
    # lists of another length are wrong from end to end
    return {name: value if value[0].shape == arrays[name].shape else np.full((1, *arrays[name].shape), -1)
            for name, value in found.items()}  # fmt: skip


def _through_covariances(call: Call, v_covars: np.ndarray) -> Arrays:
    symmetric, of_entries = 0.5 * (v_covars + np.swapaxes(v_covars, -1, -2)), [row[0] for row in call.frames]
    pulled = [covars_from_quats_scales_vjp(frame.scene.gaussians.quats, frame.scene.gaussians.scales, v)
              for frame, v in zip(of_entries, symmetric, strict=True)]  # fmt: skip
    v_quats, v_scales = zip(*pulled, strict=True)
    return {"v_quats": np.stack(v_quats), "v_scales": np.stack(v_scales)}


def call_of(arrays: Arrays, options: dict[str, Any]) -> Call:
    """Return the call that a vector holds."""
    batch = tuple(options["batch"])
    entries = (
        [{name: value[b] for name, value in arrays.items()} for b in range(math.prod(batch))] if batch else [arrays]
    )
    plain, given = "colors" in arrays, Profile(**options["profile"])
    planes = {name: getattr(given, name) for name in ("near_plane", "far_plane", "eps2d")}
    planes = {name: value for name, value in planes.items() if value != getattr(PAPER, name)}
    profile = replace(given, **{name: getattr(PAPER, name) for name in planes})
    own = entries[0]["colors" if plain else "sh"].ndim == (3 if plain else 4)
    frames = tuple(tuple(_frames(each, options, profile, plain, own)) for each in entries)
    more = {name: options[name] for name in FORMS}
    mode, clip = options["render_mode"], options["radius_clip"]
    return Call(frames, batch, own, mode, radius_clip=clip, planes=planes, dominance=True, absgrad=True, **more)


def _frames(arrays: Arrays, options: dict[str, Any], profile: Profile, plain: bool, own: bool) -> Iterator[Frame]:
    colors, n = arrays["colors" if plain else "sh"], len(arrays["means"])
    for c in range(len(arrays["viewmats"])):
        of_camera = colors[c] if own else colors
        sh = np.zeros((n, 1, 3)) if plain else of_camera
        gaussians = Gaussians(arrays["means"], arrays["quats"], arrays["scales"], arrays["opacities"], sh)
        camera = Camera(arrays["viewmats"][c], arrays["Ks"][c], options["width"], options["height"])
        more = (profile, options["tile_size"], None if plain else options["sh_degree"], options["antialiased"])
        scene = Scene(gaussians, camera, arrays["backgrounds"][c], *more)
        yield Frame(scene, of_camera if plain else None)


def _needs(call: Call) -> list[str]:
    """Return what a rasterizer has to offer to be asked for a call."""
    asked = {
        capabilities.ALL_BANDS: call.first.scene.gaussians.sh.shape[1] > 1,
        capabilities.COLORS: call.sh_degree is None,
        capabilities.CHANNELS: call.sh_degree is None,
        capabilities.CAMERA_COLORS: call.camera_colors,
        capabilities.DEPTH: call.render_mode != "RGB",
        capabilities.ANTIALIASING: call.antialiased,
        capabilities.PLANES: bool(call.planes),
        capabilities.RADIUS_CLIP: call.radius_clip > 0.0,
        capabilities.PACKED: call.packed,
        capabilities.COVARS: call.covars,
        capabilities.BATCHES: bool(call.batch),
        capabilities.NO_BACKGROUND: call.no_background,
    }
    return [capabilities.SIGNATURE, capabilities.CAMERAS, *(need for need, holds in asked.items() if holds)]


def _loss(backend: Any, arrays: Arrays, options: dict[str, Any]) -> Arrays:
    name, found = options["loss"], {}
    arguments = training.loss_arguments(options, arrays["mask"])
    if backend.has(name):
        found["loss"] = np.asarray(backend.stage(name)(arrays["picture"], arrays["target"], *arguments))
    if backend.has(f"{name}_vjp"):
        pull = backend.stage(f"{name}_vjp")
        found["v_picture"] = pull(arrays["picture"], arrays["target"], options["v_loss"], *arguments)
    return found


def _pop(backend: Any, arrays: Arrays, options: dict[str, Any]) -> Arrays:
    found = {}
    important = arrays["dominant_counts"] > 0
    if backend.has("importance_mask"):
        important = backend.stage("importance_mask")(arrays["dominant_counts"])
        found["important"] = np.asarray(important).astype(np.int64)
    if backend.has("pop_loss"):
        found["pop_loss"] = np.asarray(backend.stage("pop_loss")(arrays["opacities"], important))
    if backend.has("pop_loss_vjp"):
        found["v_opacities"] = backend.stage("pop_loss_vjp")(arrays["opacities"], important, options["v_loss"])
    return found


def _adam(backend: Any, arrays: Arrays, options: dict[str, Any]) -> Arrays:
    if not backend.has("adam_step"):
        return {}
    # the name of a parameter that every trainer knows
    given = [{"means": arrays[name]} for name in ("param", "grad", "m", "v")]
    after = backend.stage("adam_step")(*given, options["step"], {"means": options["lr"]})
    return {name: value["means"] for name, value in zip(("new_param", "new_m", "new_v"), after, strict=True)}


def _density(backend: Any, arrays: Arrays, options: dict[str, Any]) -> Arrays:
    if not backend.has("densify_and_prune"):
        return {}
    params, statistics = training.density_inputs(arrays)
    config = DensityConfig(**options["config"])
    split = arrays["split"].astype(bool)
    rows, _ = backend.stage("densify_and_prune")(
        rows_from_params(params),
        statistics,
        options["scene_scale"],
        options["step"],
        lambda n: arrays["normals"][:, split][:, :n],
        config,
    )
    found = training.density_rows(dict(rows.params))
    if backend.has("grow_masks"):
        scales = np.exp(arrays["log_scales"])
        masks = backend.stage("grow_masks")(statistics, scales, options["scene_scale"], options["step"], config)
        found |= {
            name: np.asarray(mask).astype(np.int64) for name, mask in zip(("cloned", "split"), masks, strict=True)
        }
    return _in_form(found, arrays)


def _training(backend: Any, arrays: Arrays, options: dict[str, Any]) -> Arrays:
    if not backend.has("scripted_steps"):
        return {}
    script = Replay(arrays, options)
    found = step_sums(backend.stage("scripted_steps")(script, script.rows()))
    return {name: value for name, value in found.items() if not name.startswith("error_bound_")}


def _steps(backend: Any, arrays: Arrays, options: dict[str, Any]) -> Arrays:
    if not backend.has("taken_steps"):
        return {}
    short = HeldTraining(arrays, options)
    return _in_form(answered_steps(backend.stage("taken_steps")(short, short.before)), arrays)


def _in_form(found: Arrays, arrays: Arrays) -> Arrays:
    """Return answers, and of another number of rows numbers that are as wrong as can be: that is an answer, too."""
    return {name: value if value.shape == arrays[name].shape else np.full(arrays[name].shape, np.nan)
            for name, value in found.items()}  # fmt: skip


def _stage(backend: Any, arrays: Arrays, options: dict[str, Any]) -> Arrays:
    name, args = options["function"], [made(value) for value in options["arguments"].values()]
    profiles = [arg for arg in args if isinstance(arg, Profile)]
    if not backend.has(name) or not all(backend.profile is None or p == backend.profile for p in profiles):
        return {}
    return outputs(backend.stage(name)(*args))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
