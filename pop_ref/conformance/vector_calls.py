"""Portable vectors of whole calls: several cameras, depth modes, plain colours of any number of channels."""

from __future__ import annotations

from typing import Any

import numpy as np

from pop_ref.conformance.adapter import Adapter
from pop_ref.conformance.calls import Call
from pop_ref.conformance.signature import Expected, expectations
from pop_ref.conformance.vector_schema import INPUTS, entry, output
from pop_ref.conformance.views import frames
from pop_ref.depth import RenderMode

_GAUSSIANS = ("means", "quats", "scales", "opacities")
_ABOUT = "cameras that look at the same Gaussians, each with its background; 'render_mode' says what an image is"
MODES = {
    "RGB": "colours",
    "D": "depth: the sum of weights times camera z, nothing behind",
    "ED": "expected depth: D over max(1 - T_final, 1e-10)",
    "RGB+D": "colours, then D",
    "RGB+ED": "colours, then ED",
}


def calls() -> dict[str, Call]:
    """Return the calls by name."""
    reader = Adapter()  # float32 and the paper's constants

    def seen(seed: int, count: int, mode: RenderMode = "RGB", **options: Any) -> Call:
        return Call((frames(reader, seed, count, **options),), render_mode=mode)

    found = {"three_cameras": seen(0, 3), "three_cameras_of_degree_three": seen(1, 3, degree=3)}
    for k, mode in enumerate(("D", "ED", "RGB+D", "RGB+ED")):
        found[f"mode_{mode.lower().replace('+', '_and_')}"] = seen(2 + k, 2, mode)
    return found | {"five_channels": seen(6, 2, channels=5), "one_channel_and_depth": seen(7, 2, "RGB+ED", channels=1)}


def call_kind(plain: bool) -> dict[str, Any]:
    """Return what the index says of calls with harmonics, or with plain colours."""
    colors, shape = ("colors", "[N, D]") if plain else ("sh", INPUTS["sh"][0])
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
    for name, key in zip((*_GAUSSIANS, colors), (*_GAUSSIANS, colors), strict=True):
        meaning = f"derivative of sum(v_images images) + sum(v_alphas alphas) to {name}, summed over cameras"
        arrays |= output(f"v_{name}", given[name][0], meaning, f"agreement.v_{key}", "smooth_rows")
    for name, key in (("viewmats", "viewmat"), ("backgrounds", "background")):
        where = "all_smooth" if name == "viewmats" else None
        arrays |= output(f"v_{name}", given[name][0], f"derivative to {name}", f"agreement.v_{key}", where)
    arrays["unambiguous"] = entry("mask", "[C, H, W]", "every decision of the pixel is clear of rounding", "bool")
    arrays["smooth_rows"] = entry("mask", "[N]", "no kink of this Gaussian is within rounding for any camera", "bool")
    arrays["all_smooth"] = entry("mask", "[]", "smooth_rows holds everywhere", "bool")
    return {"about": _ABOUT, "modes": MODES, "arrays": arrays}


def call_arrays(call: Call) -> dict[str, np.ndarray]:
    """Return a call's arrays."""
    (row,), colors = expectations(Adapter(), call), "sh" if call.sh_degree is not None else "colors"
    given = {colors if name == "colors" else name: value for name, value in call.tensors().items()}
    arrays = {**given, "Ks": call.intrinsics()}
    arrays["v_images"] = np.stack([e.v_image for e in row])
    arrays["v_alphas"] = -np.stack([e.v_T_final for e in row])
    arrays["images"] = np.stack([e.render.image for e in row])
    arrays["error_bound_images"] = np.stack([e.image_error_bounds for e in row])
    arrays["alphas"] = 1.0 - np.stack([e.render.T_final for e in row])
    arrays["error_bound_alphas"] = np.stack([e.error_bounds.T_final + 1.0 for e in row])
    arrays["unambiguous"] = np.stack([e.error_bounds.unambiguous for e in row])
    smooth = ~np.any([e.error_bounds.screen.kinked for e in row], axis=0)
    return arrays | _gradients(row, colors) | {"smooth_rows": smooth, "all_smooth": np.array(np.all(smooth))}


def _gradients(row: list[Expected], colors: str) -> dict[str, np.ndarray]:
    pulled = [e.gradients for e in row]
    found: dict[str, np.ndarray] = {}
    for name in (*_GAUSSIANS, "colors"):
        own = f"v_{colors if name == 'colors' else name}"
        found[own] = np.sum([value[name] for value, _ in pulled], axis=0)
        found[f"error_bound_{own}"] = np.sum([bound[name] for _, bound in pulled], axis=0)
    for name in ("viewmats", "backgrounds"):
        found[f"v_{name}"] = np.stack([value[name] for value, _ in pulled])
        found[f"error_bound_v_{name}"] = np.stack([bound[name] for _, bound in pulled])
    return found
