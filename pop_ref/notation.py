"""Every symbol once: its name in code, shape, unit, frame, and what the paper calls it.

Conventions that the table cannot say: plural is an axis, singular one item; batching is only ever a leading axis
(`viewmats [C, 4, 4]`, `Ks [C, 3, 3]`); `scales` and `opacities` are always activated; quaternions are wxyz; cameras are
OpenCV's (+x right, +y down, +z forward); pixel centres lie at index + 0.5; verbs are `x_from_y` (builds), `project_*`
(changes space) and `*_vjp` (the transpose), and the cotangent of x is `v_x`. Encoded rgb is what a photograph's file
holds, byte / 255, with the file's gamma in it; no stage decodes it.
"""

from __future__ import annotations

from typing import Final, NamedTuple


class Symbol(NamedTuple):
    """One row of the table; `paper` is TeX, empty where the paper has no symbol."""

    name: str
    shape: str
    unit: str
    frame: str
    paper: str
    meaning: str


AXES: Final = {
    "N": "Gaussians",
    "C": "cameras",
    "H": "rows of an image",
    "W": "columns of an image",
    "D": "colour channels",
    "n_sh": "spherical-harmonics coefficients, (degree + 1)^2",
}

SYMBOLS: Final = (
    Symbol("means", "[N, 3]", "world", "world", r"\mu_i", "centres"),
    Symbol("quats", "[N, 4]", "1", "Gaussian -> world", r"q_i", "rotations wxyz, any norm > 0"),
    Symbol("rotmats", "[N, 3, 3]", "1", "Gaussian -> world", "R_i", "rotation matrices"),
    Symbol("log_scales", "[N, 3]", "1", "Gaussian", "", "raw parameter of scales"),
    Symbol("scales", "[N, 3]", "world", "Gaussian", r"s_i", "standard deviations"),
    Symbol("logit_opacities", "[N]", "1", "", "", "raw parameter of opacities"),
    Symbol("opacities", "[N]", "1", "", r"o_i", "opacities, in [0, 1]"),
    Symbol("sh", "[N, n_sh, 3]", "encoded rgb", "world", "", "spherical-harmonics coefficients"),
    Symbol("dirs", "[N, 3]", "world", "world", "", "from the camera's centre to the Gaussians"),
    Symbol("colors", "[N, D]", "encoded rgb", "", r"c_i", "colours as this camera sees them"),
    Symbol("covars", "[N, 3, 3]", "world^2", "world", r"\Sigma_i", "covariances"),
    Symbol("viewmat", "[4, 4]", "world", "world -> camera", "W", "rigid transformation"),
    Symbol("K", "[3, 3]", "px", "camera -> screen", "", "intrinsics without skew"),
    Symbol("width", "", "px", "screen", "W", "columns"),
    Symbol("height", "", "px", "screen", "H", "rows"),
    Symbol("means_cam", "[N, 3]", "world", "camera", "", "centres"),
    Symbol("depths", "[N]", "world", "camera", "", "camera z"),
    Symbol("covars_cam", "[N, 3, 3]", "world^2", "camera", r"W \Sigma_i W^T", "covariances"),
    Symbol("jacobians", "[N, 2, 3]", "px/world", "camera -> screen", "J", "of the projection, clamped to the frustum"),
    Symbol("means2d", "[N, 2]", "px", "screen", r"\mu_i^{2D}", "centres"),
    Symbol("covars2d", "[N, 2, 2]", "px^2", "screen", r"\Sigma_i^{2D}", "covariances"),
    Symbol("eps2d", "", "px^2", "screen", "", "low-pass added to covars2d"),
    Symbol("compensations", "[N]", "1", "", "", "opacity factors of the antialiased mode"),
    Symbol("conics", "[N, 3]", "px^-2", "screen", r"(\Sigma_i^{2D})^{-1}", "inverse covariances as (xx, xy, yy)"),
    Symbol("radii", "[N, 2]", "px", "screen", "", "integer extents along x and y; 0 where culled"),
    Symbol("tile_size", "", "px", "screen", "", "side of a tile"),
    Symbol("tile_lists", "list of lists", "", "", "", "ids front to back, tiles in row-major order"),
    Symbol("px, py", "", "px", "screen", r"\mathbf{p}", "centre of one pixel"),
    Symbol("sigma", "", "1", "", "", "exponent of one splat at one pixel"),
    Symbol("alpha", "", "1", "", r"\alpha_i", "opacity of one splat at one pixel"),
    Symbol("T", "", "1", "", r"T_i", "transmittance before a splat"),
    Symbol("weight", "", "1", "", r"T_i \alpha_i", "what a splat contributes to a pixel"),
    Symbol("background", "[D]", "encoded rgb", "", "", "colour behind everything"),
    Symbol("image", "[H, W, D]", "encoded rgb", "screen", r"\mathbf{c}(\mathbf{p})", "rendered colours, not clamped"),
    Symbol("T_final", "[H, W]", "1", "screen", "", "transmittance behind the last blended splat"),
    Symbol("n_blended", "[H, W]", "1", "screen", "m", "splats blended at a pixel"),
    Symbol("n_traversed", "[H, W]", "1", "screen", "", "list entries visited until the pixel stopped"),
    Symbol("dominant_ids", "[H, W]", "", "screen", r"i^*(\mathbf{p})", "Gaussian of the largest weight, -1 none"),
    Symbol("dominant_weights", "[H, W]", "1", "screen", "", "that weight"),
    Symbol("dominant_counts", "[N]", "px", "", r"\mathcal{D}_i", "pixels that a Gaussian dominates"),
    Symbol("importance_mask", "[N]", "", "", r"M_{\mathrm{imp},i}", "dominates a pixel of the current view"),
    Symbol("v_x", "as x", "1/x", "as x", r"\partial L / \partial x", "cotangent of x"),
)


def symbol_named(name: str) -> Symbol:
    """Look a symbol up by its name in code.

    Source: the POP paper's notation, section 3.1.
    Departs: nothing.

    Args:
        name: as in code.

    Returns:
        Its row.

    Raises:
        ValueError: the table has no such symbol.

    Example:
        >>> symbol_named("conics").unit
        'px^-2'
    """
    for symbol in SYMBOLS:
        if symbol.name == name:
            return symbol
    raise ValueError(f"symbol {name!r} is not in the notation table")
