"""Mutants as black boxes: this program's rasterizer behind gsplat's signature, with one argument ignored or mixed up.

Nothing inside is broken, and one small view is drawn rightly: only laws of the whole signature can tell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from pop_ref.conformance.backends import function_named

Rasterization = Callable[..., Any]
CAMERAS = "test_signature_cameras:several_cameras_in_one_call_see_what_each_sees_alone"
ARGUMENTS = "test_signature_arguments"


@dataclass(frozen=True)
class BlackBox:
    """A rasterizer with one argument broken.

    Attributes:
        name: how tables call it.
        story: what it does.
        breaks: makes of a sound rasterizer and its arguments by name what comes of the call.
        law: that kills it.
    """

    name: str
    story: str
    breaks: Callable[[Rasterization, dict[str, Any]], Any]
    law: str
    precisions = ("float32", "float64")

    def adapter(self, dtype: str = "float32") -> Any:
        """Return it as the kit is handed any rasterizer, in float32 or float64."""
        from pop_ref.conformance.torch_adapter import TorchAdapter

        return TorchAdapter(self.name, self.rasterization(), dtype=dtype)

    def rasterization(self) -> Rasterization:
        """Return the broken function, with the arguments that gsplat has."""
        sound = partial(function_named("pop_fast.api.rasterize:rasterization"), backend="fast")

        def rasterization(
            means: Any, quats: Any, scales: Any, opacities: Any, colors: Any, viewmats: Any, Ks: Any, width: int,
            height: int, near_plane: float = 0.01, far_plane: float = 1e10, radius_clip: float = 0.0,
            eps2d: float = 0.3, sh_degree: int | None = None, packed: bool = True, tile_size: int = 16,
            backgrounds: Any = None, render_mode: str = "RGB", absgrad: bool = False, rasterize_mode: str = "classic",
            covars: Any = None,
        ) -> Any:  # fmt: skip
            given = dict(locals())
            # what the function closes over is no argument
            del given["self"], given["sound"]
            return self.breaks(sound, given)

        return rasterization


def _with(**changed: Callable[[dict[str, Any]], Any]) -> Callable[[Rasterization, dict[str, Any]], Any]:
    """Break arguments: each is what its function makes of all of them."""

    def breaks(sound: Rasterization, given: dict[str, Any]) -> Any:
        return sound(**given | {name: change(given) for name, change in changed.items()})

    return breaks


def _first_of_cameras(name: str, trailing: int) -> Callable[[dict[str, Any]], Any]:
    """Return a change that gives every camera what is the first one's."""

    def change(given: dict[str, Any]) -> Any:
        value = given[name]
        axis = value.dim() - trailing - 1
        return value.narrow(axis, 0, 1).expand_as(value)

    return change


def _colors_of_the_first_camera(given: dict[str, Any]) -> Any:
    colors, rows = given["colors"], 2 if given["sh_degree"] is None else 3
    per_camera = colors.dim() - rows == given["viewmats"].dim() - 2
    return _first_of_cameras("colors", rows)(given) if per_camera else colors


def _rolled_backgrounds(given: dict[str, Any]) -> Any:
    behind = given["backgrounds"]
    return None if behind is None else behind.roll(1, -2)


def _white_by_default(given: dict[str, Any]) -> Any:
    if given["backgrounds"] is not None:
        return given["backgrounds"]
    channels = 3 if given["sh_degree"] is not None else given["colors"].shape[-1]
    return given["means"].new_ones((*given["viewmats"].shape[:-2], channels))


def _packed_by_gaussian(sound: Rasterization, given: dict[str, Any]) -> Any:
    images, alphas, meta = sound(**given)
    if given["packed"]:
        order = meta["gaussian_ids"].argsort(stable=True)
        meta |= {name: meta[name][order] for name in ("gaussian_ids", "camera_ids", "batch_ids")}
    return images, alphas, meta


def _tile_above_the_image(sound: Rasterization, given: dict[str, Any]) -> Any:
    images, alphas, meta = sound(**given)
    keys, tiles = meta["isect_ids"], meta["tile_width"] * meta["tile_height"]
    high, bits = keys >> 32, tiles.bit_length()
    image, tile = high >> bits, high & ((1 << bits) - 1)
    return images, alphas, {**meta, "isect_ids": (tile << 40) | (image << 32) | (keys & 0xFFFFFFFF)}


def _expected_depth_of_a_constant_opacity(sound: Rasterization, given: dict[str, Any]) -> Any:
    if not given["render_mode"].endswith("ED"):
        return sound(**given)
    images, alphas, meta = sound(**given | {"render_mode": given["render_mode"].replace("ED", "D")})
    # an image of its own, as a tensor that shares storage with what autograd keeps must not be written to
    images = images.clone()
    images[..., -1:] = images[..., -1:] / alphas.detach().clamp_min(1e-10)
    return images, alphas, meta


def _tiles_counted_in_a_byte(sound: Rasterization, given: dict[str, Any]) -> Any:
    images, alphas, meta = sound(**given)
    return images, alphas, {**meta, "tiles_per_gauss": meta["tiles_per_gauss"] & 255}


def _dominant_packed_rows(sound: Rasterization, given: dict[str, Any]) -> Any:
    images, alphas, meta = sound(**given)
    if not given["packed"]:
        return images, alphas, meta
    ids, n = meta["dominant_ids"], given["means"].shape[-2]
    rows = ids.new_zeros((meta["n_cameras"], n))
    for camera in range(meta["n_cameras"]):
        present = meta["gaussian_ids"][meta["camera_ids"] == camera]
        rows[camera, present] = ids.new_tensor(range(len(present)))
    wrong = rows.gather(1, ids.clamp_min(0).flatten(-2).reshape(meta["n_cameras"], -1)).reshape(ids.shape)
    return images, alphas, {**meta, "dominant_ids": wrong.where(ids >= 0, ids)}


def _just_below_the_far_plane(given: dict[str, Any]) -> float:
    return float(given["far_plane"]) * (1.0 - 2.0**-20)


def _accumulated_for_expected(given: dict[str, Any]) -> str:
    return given["render_mode"].replace("ED", "D")


def _upper_triangle_once(given: dict[str, Any]) -> Any:
    covars = given["covars"]
    return None if covars is None else covars.triu() + covars.detach().tril(-1)


def _default(name: str, value: float) -> Callable[[Rasterization, dict[str, Any]], Any]:
    return _with(**{name: lambda given: value})


BLACK_BOXES: Final = (
    BlackBox(
        "near_plane_ignored",
        "the near plane is a constant of the kernel, whatever the call says",
        _default("near_plane", 0.01),
        f"{ARGUMENTS}:the_near_and_the_far_plane_are_where_the_call_says",
    ),
    BlackBox(
        "eps2d_ignored",
        "the low-pass of 0.3 px^2 is a constant of the kernel, whatever the call says",
        _default("eps2d", 0.3),
        f"{ARGUMENTS}:the_low_pass_is_as_wide_as_the_call_says",
    ),
    BlackBox(
        "radius_clip_ignored",
        "splats no larger than radius_clip are drawn",
        _default("radius_clip", 0.0),
        f"{ARGUMENTS}:what_is_no_larger_than_radius_clip_is_culled",
    ),
    BlackBox(
        "background_of_the_camera_before",
        "every camera of a call has the background of the one before it",
        _with(backgrounds=_rolled_backgrounds),
        CAMERAS,
    ),
    BlackBox(
        "intrinsics_of_the_first_camera",
        "all cameras of a call are given the first one's K",
        _with(Ks=_first_of_cameras("Ks", 2)),
        CAMERAS,
    ),
    BlackBox(
        "colours_of_the_first_camera",
        "all cameras of a call are given the first one's colours",
        _with(colors=_colors_of_the_first_camera),
        "test_signature_cameras:every_camera_has_the_colours_and_harmonics_that_were_given_for_it",
    ),
    BlackBox(
        "packed_ids_by_gaussian",
        "the indices of packed rows are sorted by Gaussian, the rows themselves by camera",
        _packed_by_gaussian,
        "test_signature_cameras:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same",
    ),
    BlackBox(
        "keys_sort_by_tile_first",
        "the key of an intersection has its tile above its image, eight bits each",
        _tile_above_the_image,
        "test_signature_meta:the_keys_of_intersections_hold_image_tile_and_depth",
    ),
    BlackBox(
        "expected_depth_not_divided",
        "the expected depth is the accumulated one: nobody divides by the opacity",
        _with(render_mode=_accumulated_for_expected),
        "test_signature_depth:the_expected_depth_is_the_accumulated_one_over_the_opacity",
    ),
    BlackBox(
        "expected_depth_of_a_constant_opacity",
        "the opacity by which the expected depth is divided has no gradient",
        _expected_depth_of_a_constant_opacity,
        "test_signature_depth:the_expected_depth_is_the_accumulated_one_over_the_opacity",
    ),
    BlackBox(
        "tiles_counted_in_a_byte",
        "a splat that lies over more than 255 tiles begins to count them from 0 again",
        _tiles_counted_in_a_byte,
        "test_signature_meta:a_splat_over_hundreds_of_tiles_counts_all_of_them",
    ),
    BlackBox(
        "dominant_packed_rows",
        "dominant ids of packed rows are row numbers, not Gaussians",
        _dominant_packed_rows,
        "test_signature_meta:dominant_ids_are_of_gaussians_and_not_of_packed_rows",
    ),
    BlackBox(
        "far_plane_exclusive",
        "a centre on the far plane is culled",
        _with(far_plane=_just_below_the_far_plane),
        f"{ARGUMENTS}:a_centre_on_the_far_plane_is_drawn_and_one_on_the_near_plane_as_the_profile_says",
    ),
    BlackBox(
        "covariances_counted_once",
        "covariances are read by their upper triangle, and an entry off the diagonal is counted once in the gradient",
        _with(covars=_upper_triangle_once),
        f"{ARGUMENTS}:covariances_draw_what_their_quaternions_and_scales_draw",
    ),
    BlackBox(
        "white_by_default",
        "without backgrounds the picture is white behind",
        _with(backgrounds=_white_by_default),
        f"{ARGUMENTS}:without_a_background_it_is_black",
    ),
)
