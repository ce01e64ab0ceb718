"""What `index.json` says of the portable vectors: every array's meaning and the rule that it is compared by.

The index is written for readers without Python, and `vector_check` knows no more than stands in it.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from pop_ref.conformance import tolerances

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
    "R": "Gaussians of all steps, one step after the other",
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
    "batch": "dimensions of a call's batch, whose entries lie along E; none without one",
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


def close(key: str, error_bound: str, where: str | None = None, **more: str) -> Rule:
    """Return the rule that a result differs by rounding at most, with the tolerance of that key."""
    units = tolerances.TABLE[key].units
    limit = {"float32": units * float(np.finfo(np.float32).eps), "float64": tolerances.AGREEMENT_FLOAT64}
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
    """Return what the index says beside the list of vectors.

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
