"""Portable vectors of whole calls: several cameras, depth modes, plain colours of any number of channels."""

from __future__ import annotations

from typing import Any

import numpy as np

from pop_ref.conformance.adapter import Adapter
from pop_ref.conformance.calls import Call
from pop_ref.conformance.signature import Expected, expectations
from pop_ref.conformance.vector_schema import IMAGES, INPUTS, entry, equal, output
from pop_ref.conformance.views import clear_call
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

    def seen(seed: int, count: int, mode: RenderMode = "RGB", **asks: Any) -> Call:
        return clear_call(reader, 16 * seed, count=count, render_mode=mode, **asks)

    found = {"three_cameras": seen(0, 3), "three_cameras_of_degree_three": seen(1, 3, degree=3)}
    for k, mode in enumerate(("D", "ED", "RGB+D", "RGB+ED")):
        found[f"mode_{mode.lower().replace('+', '_and_')}"] = seen(2 + k, 2, mode)
    return found | {
        "five_channels": seen(6, 2, channels=5),
        "one_channel_and_depth": seen(7, 2, "RGB+ED", channels=1),
        "thirty_three_channels": seen(8, 2, channels=33),
        "antialiased_cameras": seen(9, 2, antialiased=True),
        "antialiased_depth_under_a_wide_low_pass": seen(10, 2, "RGB+ED", antialiased=True, eps2d=1.25),
        "a_near_plane": seen(11, 2, "RGB+D", near_plane=2.0),
        "a_far_plane": seen(12, 2, far_plane=4.5),
        "small_splats_left_out": seen(13, 2, "ED", radius_clip=5.5),
        "first_band_of_three": seen(14, 2, degree=3, sh_degree=1),
        "harmonics_of_each_camera": seen(15, 3, degree=3, camera_colors=True),
        "colors_of_each_camera": seen(16, 3, "RGB+D", channels=4, camera_colors=True),
        "a_camera_that_sees_nothing": seen(17, 2, blind=1),
        "hundreds_of_tiles": seen(18, 2, size=(35, 33), tile_size=2),
    }


def kind_of(call: Call) -> str:
    """Return the kind of a call's vector: its colours' names and shapes."""
    return f"call{'_plain' * (call.sh_degree is None)}{'_of_each_camera' * call.camera_colors}"


def call_kind(plain: bool, own: bool) -> dict[str, Any]:
    """Return what the index says of calls with harmonics or plain colours, of all cameras or of each its own."""
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
    arrays["dominant_ids"] = entry("output", "[C, H, W]", IMAGES["dominant_ids"][1], "int64", [equal("decided")])
    for name in (*_GAUSSIANS, colors):
        whose = "" if own and name == colors else ", summed over cameras"
        where = "smooth_rows_of_each" if own and name == colors else "smooth_rows"
        meaning = f"derivative of sum(v_images images) + sum(v_alphas alphas) to {name}{whose}"
        arrays |= output(f"v_{name}", given[name][0], meaning, f"agreement.v_{name}", where)
    for name, key in (("viewmats", "viewmat"), ("backgrounds", "background")):
        where = "all_smooth" if name == "viewmats" else None
        arrays |= output(f"v_{name}", given[name][0], f"derivative to {name}", f"agreement.v_{key}", where)
    arrays["unambiguous"] = entry("mask", "[C, H, W]", "every decision of the pixel is clear of rounding", "bool")
    arrays["decided"] = entry("mask", "[C, H, W]", "unambiguous, and the dominant Gaussian is clear too", "bool")
    arrays["smooth_rows"] = entry("mask", "[N]", "no kink of this Gaussian is within rounding for any camera", "bool")
    arrays["smooth_rows_of_each"] = entry("mask", "[C, N]", "smooth_rows, once more for each camera", "bool")
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
    arrays["dominant_ids"] = np.stack([e.render.dominant_ids for e in row])
    arrays["unambiguous"] = np.stack([e.error_bounds.unambiguous for e in row])
    arrays["decided"] = np.stack([e.error_bounds.decided for e in row])
    smooth = ~np.any([e.error_bounds.screen.kinked for e in row], axis=0)
    arrays |= {"smooth_rows": smooth, "smooth_rows_of_each": np.tile(smooth, (len(row), 1))}
    return arrays | _gradients(row, colors, call.camera_colors) | {"all_smooth": np.array(np.all(smooth))}


def _gradients(row: list[Expected], colors: str, own_colors: bool) -> dict[str, np.ndarray]:
    pulled = [e.gradients for e in row]
    names = {name: name for name in (*_GAUSSIANS, "viewmats", "backgrounds")} | {"colors": colors}
    found: dict[str, np.ndarray] = {}
    for name, own in names.items():
        of_each = name in ("viewmats", "backgrounds") or (name == "colors" and own_colors)
        gathered = np.stack if of_each else _added
        found[f"v_{own}"] = gathered([value[name] for value, _ in pulled])
        found[f"error_bound_v_{own}"] = gathered([bound[name] for _, bound in pulled])
    return found


def _added(values: list[np.ndarray]) -> np.ndarray:
    return np.sum(values, axis=0)
