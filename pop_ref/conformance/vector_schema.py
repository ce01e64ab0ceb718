"""What `index.json` says of the portable vectors: every array's meaning and the rule that it is compared by.

The index is written for readers without Python, and `vector_check` knows no more than stands in it.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from pop_ref.conformance import tolerances

FORMAT: Final = "pop-vectors"
VERSION: Final = 2
GRADIENTS: Final = ("means", "quats", "scales", "opacities", "sh", "viewmat", "background", "means2d", "means2d_abs")

ABOUT: Final = (
    "Scenes of 3D Gaussian Splatting with everything an exact renderer makes of them, to judge a renderer in any "
    "language.",
    "A vector is one file NAME.npz: a zip archive of .npy arrays, little-endian, in C order, float64, int64 or bool.",
    "Read the arrays whose role is 'input' and the vector's 'options', and write a result of the same name into a "
    "folder of your own: NAME.npz, or NAME.json holding nested lists by array name. Write as many of the arrays whose "
    "role is 'output' as you have, in the stated shape and any number type.",
    "A result is judged by its array's 'compare'. 'close': |result - expected| <= limit * error bound + tiny, with "
    "limit and tiny of the precision that you compute in, and the array named by 'error_bound': what rounding may cost. "
    "'equal': result = expected.",
    "Only entries whose mask 'where' is true are compared: elsewhere rounding may decide either way. A mask covers the "
    "leading axes of its array: unambiguous [H, W] covers image [H, W, 3], a mask of shape [] all or nothing.",
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
    "profile.near_plane, near_inclusive": "Gaussians with camera z < near_plane are left out; z = near_plane too if "
    "near_inclusive (D1)",
    "profile.far_plane": "beyond every scene here",
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

_INPUTS = {
    "means": ("[N, 3]", "centres, world units"),
    "quats": ("[N, 4]", "rotations w x y z, of any norm > 0"),
    "scales": ("[N, 3]", "standard deviations, world units"),
    "opacities": ("[N]", "in [0, 1]"),
    "sh": ("[N, n_sh, 3]", "spherical-harmonics coefficients of red, green and blue"),
    "viewmat": ("[4, 4]", "world -> camera: x right, y down, z forward"),
    "K": ("[3, 3]", "intrinsics fx, fy, cx, cy, px"),
    "background": ("[3]", "colour behind everything"),
    "v_image": (
        "[H, W, 3]",
        "cotangent of image that the gradients belong to; zero near thresholds",
    ),
    "v_T_final": (
        "[H, W]",
        "cotangent of T_final that the gradients belong to; zero near thresholds",
    ),
}
_OUTPUTS = {
    "image": ("[H, W, 3]", "colours over the background, not clamped"),
    "T_final": ("[H, W]", "transmittance behind the last blended splat"),
    "dominant_ids": (
        "[H, W]",
        "index of the Gaussian with the largest weight T alpha, the front one of equals; -1 none",
    ),
    "n_blended": ("[H, W]", "splats blended at the pixel"),
}
_MASKS = {
    "unambiguous": ("[H, W]", "every decision behind the pixel is clear of float32's rounding"),
    "decided": ("[H, W]", "unambiguous, and the dominant Gaussian is clear too"),
    "smooth_rows": ("[N]", "no kink of this Gaussian (B1 frustum clamp, B2 colour clamp) is within rounding"),
    "all_smooth": ("[]", "smooth_rows holds everywhere"),
}
_AIDS = {
    "radii": ("[N, 2]", "extents along x and y, px, 0 where culled; not judged"),
    "means2d": ("[N, 2]", "screen centres, px; not judged"),
}
_WHERE = {"image": "unambiguous", "T_final": "unambiguous", "n_blended": "unambiguous", "dominant_ids": "decided",
          "v_viewmat": "all_smooth", "v_background": None}  # fmt: skip
_DECISIONS = {
    "D1": "near plane", "D2": "extent and cull", "D3": "tile overlap", "D4": "depth order", "D5": "alpha floor",
    "D6": "alpha ceiling", "D7": "transmittance stop", "D8": "dominance tie",
}  # fmt: skip


def schema() -> dict[str, Any]:
    """Return what the index says beside the list of vectors."""
    tiny = {"float32": float(np.finfo(np.float32).tiny), "float64": float(np.finfo(np.float64).tiny)}
    return {
        "format": FORMAT,
        "version": VERSION,
        "about": list(ABOUT),
        "model": list(MODEL),
        "axes": AXES,
        "options": OPTIONS,
        "tiny": tiny,
        "arrays": {entry["name"]: {k: v for k, v in entry.items() if k != "name"} for entry in _entries()},
    }


def _entries() -> list[dict[str, Any]]:
    rows = [_entry(name, "input", "float64", *about) for name, about in _INPUTS.items()]
    shapes = {**{name: shape for name, (shape, _) in _INPUTS.items()}, "means2d": "[N, 2]", "means2d_abs": "[N, 2]"}
    outputs = dict(_OUTPUTS)
    for name in GRADIENTS:
        outputs[f"v_{name}"] = (shapes[name], _gradient(name))
    for name, (shape, meaning) in outputs.items():
        whole = name in ("dominant_ids", "n_blended")
        rows.append(_entry(name, "output", "int64" if whole else "float64", shape, meaning, _rule(name)))
    for name, (shape, _) in outputs.items():
        if name not in ("dominant_ids", "n_blended"):
            rows.append(
                _entry(f"error_bound_{name}", "error_bound", "float64", shape, f"what rounding may cost in {name}")
            )
    rows += [_entry(name, "mask", "bool", *about) for name, about in _MASKS.items()]
    rows += [_entry(name, "aid", "int64" if name == "radii" else "float64", *about) for name, about in _AIDS.items()]
    for label, decision in _DECISIONS.items():
        meaning = f"distance of {decision} decisions ({label}) from flipping; float32 decides alike over 1e-6"
        rows.append(_entry(f"margin_{label}", "margin", "float64", "[H, W]", meaning))
    return rows


def _entry(
    name: str, role: str, dtype: str, shape: str, meaning: str, compare: dict[str, Any] | None = None
) -> dict[str, Any]:
    entry = {"name": name, "role": role, "dtype": dtype, "shape": shape, "meaning": meaning}
    return entry if compare is None else {**entry, "compare": compare}


def _gradient(name: str) -> str:
    if name == "means2d_abs":
        return "absolute values of the pixels' shares of v_means2d, summed (AbsGS)"
    place = {"means2d": " to the screen centres, per px", "quats": " to the quaternions as given, not normalised"}
    return f"derivative of sum(v_image image) + sum(v_T_final T_final){place.get(name, f' to {name}')}"


def _rule(name: str) -> dict[str, Any]:
    where = _WHERE.get(name, "smooth_rows")
    if name in ("dominant_ids", "n_blended"):
        return {"rule": "equal", "where": where}
    units = tolerances.TABLE[f"agreement.{name}"].units
    limit = {"float32": units * float(np.finfo(np.float32).eps), "float64": tolerances.AGREEMENT_FLOAT64}
    return {"rule": "close", "error_bound": f"error_bound_{name}", "limit": limit, "where": where}
