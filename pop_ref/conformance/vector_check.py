"""What `index.json` says of the portable vectors, and a port's results held to it.

The index has every array's meaning and the rule that it is compared by. It is written for readers without Python, and
`check` goes by these rules and nothing else.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.conformance import tolerances
from pop_ref.conformance.corpus import weighted_blocks, weighted_runs

# bytes of all arrays of a file; the largest vector has a few million
_LARGEST = 2**28
AGAIN = "write the vectors again with 'pop vectors export'"


class VectorsError(ValueError):
    """Tell what is wrong with a folder of vectors or with a port's results, in a line that names the file."""


@dataclass(frozen=True)
class Verdict:
    """One array of one vector.

    Attributes:
        vector, array: names.
        worst: the largest difference over its error bound; for integers the number of wrong entries.
        allowed: the largest that passes.
        where: where the worst entry is, with both values.
        unit: what `worst` and `allowed` count.
    """

    vector: str
    array: str
    worst: float
    allowed: float
    where: str = ""
    unit: str = "of its error_bound"

    @property
    def passed(self) -> bool:
        """Tell whether the array is as good as rounding lets it be."""
        return self.worst <= self.allowed


@dataclass
class Judgement:
    """Everything that was compared, and what could not be.

    Attributes:
        verdicts: one for each array of each result.
        absent: outputs that no result holds.
        missing: vectors without a result.
        strange: files and arrays of the results that the index does not know.
    """

    verdicts: list[Verdict] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    strange: list[str] = field(default_factory=list)

    @property
    def failed(self) -> list[Verdict]:
        """Return the verdicts that did not pass."""
        return [verdict for verdict in self.verdicts if not verdict.passed]


def check(folder: Path, results: Path, precision: str = "float32") -> Judgement:
    """Hold a port's results to the vectors of a folder; a result that is missing is not judged.

    Args:
        folder: that `vectors.export` wrote.
        results: holds NAME.npz or NAME.json for as many vectors as the port draws.
        precision: "float32" or "float64", that the port computes in.

    Raises:
        VectorsError: a folder, file or array is missing, damaged or of another version or shape; or nothing is there to
            be judged. Says which and what to do.
    """
    index = read_index(folder)
    try:
        return _check(index, folder, results, precision)
    except VectorsError:
        raise
    # what the index says is taken as it stands: where it does not fit the arrays, any step of the rules may fail
    except Exception as error:
        raise VectorsError(
            f"{folder / 'index.json'}: does not fit the vectors next to it ({error!r}); {AGAIN}"
        ) from error


def _check(index: dict[str, Any], folder: Path, results: Path, precision: str) -> Judgement:
    if not results.is_dir():
        raise VectorsError(
            f"{results}: no such folder; a port writes its results there, NAME.npz or NAME.json a vector"
        )
    found = Judgement()
    known = {f"{name}{suffix}" for name in index["vectors"] for suffix in (".npz", ".json")}
    found.strange = sorted(path.name for path in results.iterdir() if path.name not in known)
    seen: set[str] = set()
    known_outputs: dict[str, None] = {}
    for name, vector in index["vectors"].items():
        arrays = index["kinds"][vector["kind"]]["arrays"]
        outputs = {array: entry for array, entry in arrays.items() if entry["role"] == "output"}
        known_outputs |= dict.fromkeys(outputs)
        paths = [p for p in (results / f"{name}.npz", results / f"{name}.json") if p.exists()]
        if not paths:
            found.missing.append(name)
            continue
        path = paths[0]
        found.strange += [f"{other.name} ({path.name} is there)" for other in paths[1:]]
        result = read_arrays(path)
        found.strange += [f"{path.name}: {array}" for array in result if array not in outputs]
        seen |= result.keys() & outputs.keys()
        found.verdicts += verdicts_of(index, folder, name, result, precision, path)
    if not found.verdicts:
        raise VectorsError(
            f"{results}: holds nothing to judge; write one file for each vector, as "
            f"{next(iter(index['vectors']))}.npz with {', '.join(known_outputs)}"
        )
    found.absent = [array for array in known_outputs if array not in seen]
    return found


def verdicts_of(
    index: dict[str, Any], folder: Path, name: str, result: dict[str, np.ndarray], precision: str, path: Path
) -> list[Verdict]:
    """Hold a port's result for one vector to it.

    Args:
        index: that `read_index` read.
        folder: of the vectors.
        name: of the vector.
        result: arrays by name.
        precision: "float32" or "float64", that the port computes in.
        path: where the result is from, for errors.

    Raises:
        VectorsError: an array of the vector or of the result is missing, damaged or of another shape.
    """
    vector, found = index["vectors"][name], []
    arrays = index["kinds"][vector["kind"]]["arrays"]
    stored = {a: shape for a, shape in vector["shapes"].items() if arrays[a].get("stored", True)}
    wanted = _vector(folder / vector["file"], stored)
    for array, about in arrays.items():
        if about["role"] == "output" and array in result:
            _check_shape(path, array, result[array], vector["shapes"][array])
            for rule in about["compare"]:
                found.append(_judge(name, array, wanted, result[array], rule, index["tiny"], precision))
    return found


def read_index(folder: Path) -> dict[str, Any]:
    """Read the index of a folder of vectors.

    Raises:
        VectorsError: the folder or the index is missing, damaged, foreign or of another version.
    """
    path = folder / "index.json"
    if not folder.is_dir():
        raise VectorsError(f"{folder}: no such folder; write the vectors with 'pop vectors export {folder}'")
    if not path.is_file():
        raise VectorsError(f"{path}: absent, so {folder} holds no vectors; write them with 'pop vectors export'")
    try:
        index = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise VectorsError(f"{path}: is damaged ({error}); {AGAIN}") from error
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        raise VectorsError(f"{path}: format is not {FORMAT!r}, so it is no index of vectors; {AGAIN}")
    if index.get("version") != VERSION:
        raise VectorsError(f"{path}: version is {index.get('version')}, this program reads {VERSION}; {AGAIN}")
    lacks = [name for name in ("kinds", "vectors", "tiny") if name not in index]
    if lacks:
        raise VectorsError(f"{path}: {lacks[0]} is absent; {AGAIN}")
    return index


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read an npz, or a JSON file of nested lists, as arrays by name.

    Raises:
        VectorsError: the file is neither, or an array of it holds no numbers.
    """
    try:
        if path.suffix == ".json":
            return {name: np.asarray(value) for name, value in json.loads(path.read_text(encoding="utf-8")).items()}
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > _LARGEST:
            raise ValueError(f"its arrays have {size} bytes, more than any vector's")
        with np.load(path, allow_pickle=False) as stored:
            # what is no array in such a file is bytes
            return {name: np.asarray(stored[name]) for name in stored.files}
    # a damaged zip, a damaged head of an array and lists of lists that are no array end in errors of many kinds
    except Exception as error:
        kind = "JSON of number lists by name" if path.suffix == ".json" else "npz file of numbers"
        raise VectorsError(f"{path}: is no {kind} ({error}); write it again") from error


def _vector(path: Path, shapes: dict[str, list[int]]) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise VectorsError(f"{path}: absent; {AGAIN}")
    arrays = read_arrays(path)
    for name, shape in shapes.items():
        if name not in arrays:
            raise VectorsError(f"{path}: has no array {name}; {AGAIN}")
        if arrays[name].dtype.kind not in "fiub":
            raise VectorsError(f"{path}: {name} has type {arrays[name].dtype}, not numbers; {AGAIN}")
        if list(arrays[name].shape) != shape:
            raise VectorsError(f"{path}: {name} has shape {list(arrays[name].shape)}, the index says {shape}; {AGAIN}")
    return arrays


def _check_shape(path: Path, array: str, result: np.ndarray, wanted: list[int]) -> None:
    if result.dtype.kind not in "fiub":
        raise VectorsError(f"{path}: {array} has type {result.dtype}; it must hold numbers")
    if list(result.shape) != wanted:
        raise VectorsError(f"{path}: {array} has shape {list(result.shape)}; it must be {wanted}")


def _judge(
    vector: str,
    array: str,
    wanted: dict[str, np.ndarray],
    result: np.ndarray,
    rule: dict[str, Any],
    tiny: dict[str, float],
    precision: str,
) -> Verdict:
    expected = wanted[rule.get("expected", array)]
    mask = np.array(True) if rule["where"] is None else wanted[rule["where"]]
    if "reduce" in rule:
        result, mask = _reduced(rule["reduce"], np.asarray(result, dtype=np.float64), mask), np.array(True)
    # a mask covers the leading axes
    where = np.broadcast_to(np.reshape(mask, mask.shape + (1,) * (expected.ndim - mask.ndim)), expected.shape)
    unit = "of its error_bound"
    if rule["rule"] == "equal":
        unit = "wrong entries"
        wrong = np.asarray((result != expected) & where, dtype=np.float64)
        worst, allowed = float(np.sum(wrong)), 0.0
    else:
        allowed = rule["limit"][precision]
        # an error bound of zero leaves `tiny`
        error_bound = wanted[rule["error_bound"]] + tiny[precision] / allowed
        off = np.abs(result.astype(np.float64) - expected) / error_bound
        wrong = np.where(where, np.where(np.isfinite(off), off, np.inf), 0.0)
        worst = float(np.max(wrong, initial=0.0))
    if worst <= allowed:
        return Verdict(vector, array, worst, allowed, unit=unit)
    at = tuple(int(i) for i in np.unravel_index(np.argmax(wrong), wrong.shape))
    where = f"at {list(at)}{' of its sums' if 'reduce' in rule else ''}: got {result[at]}, expected {expected[at]}"
    return Verdict(vector, array, worst, allowed, where, unit)


def _reduced(how: str, values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Reduce a result to weighted sums, as the index says."""
    if how == "blocks":
        return weighted_blocks(values, np.broadcast_to(mask, values.shape[:2]))
    return weighted_runs(values)


FORMAT: Final = "pop-vectors"
VERSION: Final = 4
GRADIENTS: Final = ("means", "quats", "scales", "opacities", "sh", "viewmat", "background", "means2d", "means2d_abs")

ABOUT: Final = (
    "Scenes of 3D Gaussian Splatting with everything an exact renderer makes of them, to judge a renderer in any "
    "language.",
    "A vector is one file NAME.npz: a zip archive of .npy arrays, little-endian, in C order, float64, int64 or bool.",
    "A vector is of one of the 'kinds', which says what it is about and explains every array.",
    "Read the arrays whose role is 'input' and the vector's 'options', and write a result of the same name into a "
    "folder of your own: NAME.npz, or NAME.json holding nested lists by array name. Write as many of the arrays whose "
    "role is 'output' as you have, in the vector's 'shapes' and any number type.",
    "A result is judged by the rules of its array's 'compare', a list. 'close': |result - expected| <= limit * error "
    "bound + tiny, with limit and tiny of your precision, and the array named by 'error_bound', which says what "
    "rounding may cost. 'equal': result = expected. Expected is the array of the same name, or the one that "
    "'expected' names.",
    "Only entries whose mask 'where' is true are compared: elsewhere rounding may decide either way. A mask covers the "
    "leading axes of its array: unambiguous [H, W] covers image [H, W, 3], a mask of shape [] all or nothing.",
    "Where a rule says 'reduce', result and mask are reduced first. 'blocks': entries of an [H, W, D] map where the "
    "mask is true, each times 1 + (7 x + 13 y) mod 16, are summed over blocks of 8 x 8 pixels; row r of the expected "
    "[blocks, D] is block (r mod columns, r div columns). 'runs': rows i of an array, flattened to [N, K], each times "
    "1 + 7 i mod 16, are summed over runs of max(1, N div 100) rows.",
    "What a vector of one stage function asks stands in its option 'arguments', by name: an array with its 'dtype', "
    "'shape' and numbers, a 'record' with its fields 'of', a 'tuple', a list, or a plain value.",
    "'pop vectors check DIR RESULTS' does all of this.",
)
MODEL: Final = (
    "Camera: p = R mean + t with [R t] the upper rows of viewmat; depth z = p.z; mean2d = (fx p.x / z + cx, "
    "fy p.y / z + cy).",
    "Covariance: A = rotation(quat / |quat|) diag(scales); covar2d = J R A A^T R^T J^T + eps2d I.",
    "J = [[fx / z, 0, -fx a / z], [0, fy / z, -fy b / z]]; a = p.x / z clamped to [-cx - m W / 2, W - cx + m W / 2] "
    "/ fx and b = p.y / z to [-cy - m H / 2, H - cy + m H / 2] / fy, m = frustum_margin.",
    "Colour: max(0, 0.5 + sum_k basis_k sh_k), real harmonics of the unit direction (x, y, z) from the camera's centre "
    "to mean; degree 0: 0.28209479177387814; degree 1: 0.4886025119029199 (-y, z, -x); degrees 2 and 3 with the order "
    "and signs of 3DGS.",
    "Alpha: sigma = d^T covar2d^-1 d / 2 with d = mean2d - pixel centre; alpha = min(alpha_ceiling, "
    "opacity exp(-sigma)); skipped if sigma < 0 or alpha < alpha_floor.",
    "Blending: front to back by depth, equal depths in index order, from T = 1: image += T alpha colour, "
    "T *= 1 - alpha; last image += T background.",
)
AXES: Final = {
    "C": "cameras",
    "I": "entries of all tiles' lists",
    "E": "entries of a batch, along one axis",
    "D": "channels of plain colours, or of a picture",
    "X": "channels of an image: colours, or depth, or both, depth last",
    "B": "channels of a background",
    "M": "Gaussians after the step",
    "S": "steps of a training",
    "A": "Gaussians after each step, one step after the other",
    "L": "sparse points",
    "O": "views of all steps",
    "n_rest": "harmonics' coefficients beyond degree 0",
    "R": "Gaussians before each step, one step after the other",
    "P": "passes over views",
    "Q": "Gaussians of all passes, one pass after the other",
    "V": "training views",
    "U": "random numbers",
    "blocks, runs": "sums that a large result is reduced to",
    "N": "Gaussians",
    "H": "rows of the image, from the top",
    "W": "columns of the image, from the left",
    "n_sh": "spherical-harmonics coefficients, (degree + 1)^2",
}
OPTIONS: Final = {
    "width, height": "of the image, px; the centre of pixel (x, y) lies at (x + 0.5, y + 0.5)",
    "tile_size": "px; it matters only where profile.extent is 'square'",
    "sh_degree": "bands that are used",
    "antialiased": "opacities are multiplied by sqrt(max(0, det(covar2d) / det(covar2d + eps2d I)))",
    "render_mode": "what an image of a call holds; its kind explains it under 'modes'",
    "radius_clip": "px; Gaussians whose extents 'radii' are both at most this are left out of a call; 0: nobody",
    "batch": "of a call: dimensions of its batch, whose entries lie along E, none without one; of steps: views of each",
    "packed": "a renderer that has it keeps rows of visible Gaussians only; arrays stay those of all",
    "covars": "a renderer that takes covariances is given rotation(quat) diag(scales)^2 rotation(quat)^T instead; "
    "v_quats and v_scales are what the symmetric part of its gradient by these gives",
    "no_background": "a renderer that can be called without a background is, and backgrounds are black",
    "profile.near_plane, near_inclusive": "Gaussians with camera z < near_plane are left out; z = near_plane too if "
    "near_inclusive (D1)",
    "profile.far_plane": "Gaussians with camera z > far_plane are left out",
    "profile.eps2d": "px^2, added to both diagonal entries of the screen covariance",
    "profile.frustum_margin": "in the projection's Jacobian x/z and y/z are clamped this many half images outside the "
    "image (B1)",
    "profile.principal_point": "'used' takes cx, cy from K, 'centred' takes width / 2, height / 2",
    "profile.clamp_gradient": "'exact' differentiates the clamped Jacobian, 'inria' leaves out the clamp's z term (B1)",
    "profile.extent": "'opacity_aware': extents hold every pixel with alpha >= alpha_floor, so that tiles do not "
    "matter; 'square': extent_sigmas of the larger axis, and only tiles that it overlaps draw the splat (D2, D3)",
    "profile.extent_sigmas": "upper bound of the extent in standard deviations",
    "profile.alpha_floor": "a splat whose alpha is under it is skipped at that pixel (D5)",
    "profile.alpha_ceiling, ceiling_gradient": "alpha is clamped to it (D6); a clamped alpha passes no gradient "
    "('zero') or all of it ('pass', B3)",
    "profile.transmittance_stop, stop_inclusive": "a splat that would take T under it, or to it if stop_inclusive, is "
    "not blended and ends the pixel (D7)",
}

Rule = dict[str, Any]
INPUTS: Final = {
    "means": ("[N, 3]", "centres, world units"),
    "quats": ("[N, 4]", "rotations w x y z, of any norm > 0"),
    "scales": ("[N, 3]", "standard deviations, world units"),
    "opacities": ("[N]", "in [0, 1]"),
    "sh": ("[N, n_sh, 3]", "spherical-harmonics coefficients of red, green and blue"),
    "viewmat": ("[4, 4]", "world -> camera: x right, y down, z forward"),
    "K": ("[3, 3]", "intrinsics fx, fy, cx, cy, px"),
    "background": ("[3]", "colour behind everything"),
    "v_image": ("[H, W, 3]", "cotangent of image that the gradients belong to; zero near thresholds"),
    "v_T_final": ("[H, W]", "cotangent of T_final that the gradients belong to; zero near thresholds"),
}
IMAGES: Final = {
    "image": ("[H, W, 3]", "colours over the background, not clamped"),
    "T_final": ("[H, W]", "transmittance behind the last blended splat"),
    "dominant_ids": (
        "[H, W]",
        "index of the Gaussian with the largest weight T alpha, the front one of equals; -1 none",
    ),
    "n_blended": ("[H, W]", "splats blended at the pixel"),
}
STAGES: Final = {
    "depths": ("[N]", "camera z, world units"),
    "means2d": ("[N, 2]", "screen centres, px"),
    "conics": ("[N, 3]", "inverse of the blurred screen covariance: xx, xy, yy, px^-2"),
    "effective_opacities": ("[N]", "opacities, in antialiased mode times the compensation"),
    "colors": ("[N, 3]", "of the harmonics, not under 0"),
    "radii": ("[N, 2]", "extents along x and y, px, 0 where culled"),
}
_MASKS = {
    "unambiguous": ("[H, W]", "every decision behind the pixel is clear of float32's rounding"),
    "decided": ("[H, W]", "unambiguous, and the dominant Gaussian is clear too"),
    "smooth_rows": ("[N]", "no kink of this Gaussian (B1 frustum clamp, B2 colour clamp) is within rounding"),
    "all_smooth": ("[]", "smooth_rows holds everywhere"),
    "clear_rows": ("[N]", "no cull and no extent of this Gaussian is within rounding (D1, D2, D3)"),
    "visible_rows": ("[N]", "clear_rows, and the Gaussian is not culled"),
}
WHERE: Final = {
    "image": "unambiguous", "T_final": "unambiguous", "n_blended": "unambiguous", "dominant_ids": "decided",
    "radii": "clear_rows", "v_viewmat": "all_smooth", "v_background": None,
    **dict.fromkeys(("depths", "means2d", "conics", "effective_opacities", "colors"), "visible_rows"),
}  # fmt: skip
INTEGERS: Final = frozenset({"dominant_ids", "n_blended", "radii"})
_DECISIONS = {
    "D1": "near plane", "D2": "extent and cull", "D3": "tile overlap", "D4": "depth order", "D5": "alpha floor",
    "D6": "alpha ceiling", "D7": "transmittance stop", "D8": "dominance tie",
}  # fmt: skip


def entry(role: str, shape: str, meaning: str, dtype: str = "float64", compare: list[Rule] | None = None) -> Rule:
    """Return what the index says of an array."""
    said: Rule = {"role": role, "dtype": dtype, "shape": shape, "meaning": meaning}
    return said if compare is None else {**said, "compare": compare}


def axes(rows: str, rest: str) -> str:
    """Return the shape of an array of rows, as the index writes it."""
    return f"[{rows}, {rest}]" if rest else f"[{rows}]"


def close(key: str, error_bound: str, where: str | None = None, **more: str) -> Rule:
    """Return the rule that a result differs by rounding at most, with the tolerance of that key."""
    limit = {name: tolerances.agreement(key, getattr(np, name)) for name in ("float32", "float64")}
    return {"rule": "close", "error_bound": error_bound, "limit": limit, "where": where, **more}


def equal(where: str | None = None, **more: str) -> Rule:
    """Return the rule that a result is the expected number."""
    return {"rule": "equal", "where": where, **more}


def output(name: str, shape: str, meaning: str, key: str, where: str | None = None) -> dict[str, Rule]:
    """Return the entries of an output that is compared up to rounding, and of its error bound."""
    bound = f"error_bound_{name}"
    return {
        name: entry("output", shape, meaning, compare=[close(key, bound, where)]),
        bound: entry("error_bound", shape, f"what rounding may cost in {name}"),
    }


def schema(kinds: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return what the index says besides the list of vectors.

    Args:
        kinds: of vectors, by name: what each is about, and its arrays.
    """
    tiny = {"float32": float(np.finfo(np.float32).tiny), "float64": float(np.finfo(np.float64).tiny)}
    return {
        "format": FORMAT,
        "version": VERSION,
        "about": list(ABOUT),
        "model": list(MODEL),
        "axes": AXES,
        "options": OPTIONS,
        "tiny": tiny,
        "kinds": kinds,
    }


def render_kind() -> dict[str, Any]:
    """Return what the index says of vectors of one image."""
    arrays = {name: entry("input", *about) for name, about in INPUTS.items()}
    for name, (shape, meaning) in {**IMAGES, **STAGES}.items():
        where = WHERE[name]
        if name in INTEGERS:
            arrays[name] = entry("output", shape, meaning, "int64", [equal(where)])
        else:
            arrays |= output(name, shape, meaning, f"agreement.{name}" if name in IMAGES else "meta.rows", where)
    arrays |= output("dominant_weights", "[H, W]", "the largest weight, 0 of none", "agreement.weight", "decided")
    shapes = {**{name: shape for name, (shape, _) in INPUTS.items()}, "means2d": "[N, 2]", "means2d_abs": "[N, 2]"}
    for name in GRADIENTS:
        where = WHERE.get(f"v_{name}", "smooth_rows")
        arrays |= output(f"v_{name}", shapes[name], gradient(name), f"agreement.v_{name}", where)
    arrays |= {name: entry("mask", *about, "bool") for name, about in _MASKS.items()}
    for label, decision in _DECISIONS.items():
        meaning = f"distance of {decision} decisions ({label}) from flipping; float32 decides alike over 1e-6"
        arrays[f"margin_{label}"] = entry("margin", "[H, W]", meaning)
    return {"about": "one image with all that lies on the way to it, and its gradients", "arrays": arrays}


def gradient(name: str) -> str:
    """Return the meaning of a gradient."""
    if name == "means2d_abs":
        return "absolute values of the pixels' shares of v_means2d, summed (AbsGS)"
    place = {"means2d": " to the screen centres, per px", "quats": " to the quaternions as given, not normalised"}
    return f"derivative of sum(v_image image) + sum(v_T_final T_final){place.get(name, f' to {name}')}"
