"""Black boxes in which two arguments, several cameras, batches, packed rows or channels are mixed up.

Each draws a single view with every argument at its default rightly. The stories name where such an error happened,
where that is known.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, Final

from pop_ref.conformance.backends import function_named
from pop_ref.conformance.mutants.black_box import BlackBox, Rasterization

Given = dict[str, Any]
Breaks = Callable[[Rasterization, Given], Any]
PAIRS: Final = "test_signature_pairs:every_pair_of_arguments_"
IMAGES: Final = f"{PAIRS}draws_what_the_oracle_draws"
GRADIENTS: Final = f"{PAIRS}has_the_oracles_gradients"
ROWS: Final = f"{PAIRS}shows_the_oracles_splats"
DOMINANCE: Final = f"{PAIRS}tells_the_dominant_gaussians_of_every_camera"
TILES: Final = f"{PAIRS}lists_tiles_front_to_back"
TOGETHER: Final = "test_signature_pairs:arguments_that_are_taken_alone_are_taken_together"


def _torch() -> Any:
    return importlib.import_module("torch")


# what is asked


def _several(given: Given) -> bool:
    return bool(given["viewmats"].shape[-3] > 1)


def _batched(given: Given) -> bool:
    return bool(given["means"].dim() > 2)


def _packed(given: Given) -> bool:
    return bool(given["packed"])


def _plain(given: Given) -> bool:
    return given["sh_degree"] is None


def _own_colors(given: Given) -> bool:
    return bool(given["colors"].dim() - (2 if _plain(given) else 3) == given["viewmats"].dim() - 2)


def _deep(given: Given) -> bool:
    return bool(given["render_mode"] != "RGB")


def _antialiased(given: Given) -> bool:
    return bool(given["rasterize_mode"] == "antialiased")


def _covars(given: Given) -> bool:
    return given["covars"] is not None


def _clipped(given: Given) -> bool:
    return bool(given["radius_clip"] > 0.0)


def _behind(given: Given) -> bool:
    return given["backgrounds"] is not None


def _fewer_bands(given: Given) -> bool:
    return not _plain(given) and (given["sh_degree"] + 1) ** 2 < given["colors"].shape[-2]


def _both(*conditions: Callable[[Given], bool]) -> Callable[[Given], bool]:
    return lambda given: all(condition(given) for condition in conditions)


# how it is broken


def _if(condition: Callable[[Given], bool], **changed: Any) -> Breaks:
    """Break arguments where a condition holds: each is a value, or what a function makes of all of them."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        if condition(given):
            given = given | {name: new(given) if callable(new) else new for name, new in changed.items()}
        return sound(**given)

    return breaks


def _then(condition: Callable[[Given], bool], change: Callable[..., Any]) -> Breaks:
    """Break what is returned where a condition holds: images, alphas and meta become what `change` makes of them."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        images, alphas, meta = sound(**given)
        return change(given, images, alphas, meta) if condition(given) else (images, alphas, meta)

    return breaks


def _told(condition: Callable[[Given], bool], **changed: Callable[[Given, Any], Any]) -> Breaks:
    """Break keys of meta where a condition holds."""

    def change(given: Given, images: Any, alphas: Any, meta: Any) -> Any:
        return images, alphas, dict(meta) | {name: new(given, meta) for name, new in changed.items()}

    return _then(condition, change)


def _pulled(condition: Callable[[Given], bool], name: str, change: Callable[[Given, Any], Any]) -> Breaks:
    """Break an argument's gradient where a condition holds."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        value = given[name]
        if condition(given) and value is not None and value.requires_grad:
            own = value * 1.0
            own.register_hook(lambda grad: change(given, grad))
            given = given | {name: own}
        return sound(**given)

    return breaks


def _of_first(name: str, trailing: int) -> Callable[[Given], Any]:
    """Return an argument of which everybody has the first one's along the axis before the trailing ones."""

    def change(given: Given) -> Any:
        value = given[name]
        return None if value is None else value.narrow(-trailing - 1, 0, 1).expand_as(value)

    return change


def _of_first_entry(name: str) -> Callable[[Given], Any]:
    def change(given: Given) -> Any:
        value, depth = given[name], given["means"].dim() - 3
        return None if value is None else value.narrow(depth, 0, 1).expand_as(value)

    return change


def _first_told(name: str, trailing: int) -> Callable[[Given, Any], Any]:
    return lambda given, meta: meta[name].narrow(-trailing - 1, 0, 1).expand_as(meta[name])


def _first_colors(given: Given) -> Any:
    return _of_first("colors", 2 if _plain(given) else 3)(given)


def _higher_bands_of_the_first(given: Given) -> Any:
    sh = given["colors"]
    return _torch().cat((sh[..., :4, :], _first_colors(given)[..., 4:, :]), -2)


def _seen_from_the_first(sound: Rasterization, given: Given) -> Any:
    if _plain(given) or not _several(given) or _own_colors(given) or _batched(given):
        return sound(**given)
    dirs = function_named("pop_fast.stages.projection:view_dirs")(given["means"], given["viewmats"][0])
    colors = function_named("pop_fast.stages.harmonics:colors_from_sh")(given["colors"], dirs, given["sh_degree"])
    return sound(**given | {"colors": colors, "sh_degree": None})


def _culled_by_the_first(given: Given) -> Any:
    """Return opacities of 0 for Gaussians behind the first camera or before its near plane."""
    viewmat, means = given["viewmats"][..., 0, :, :], given["means"]
    depths = (means * viewmat[..., None, 2, :3]).sum(-1) + viewmat[..., 2, 3, None]
    return given["opacities"] * (depths.detach() >= given["near_plane"])


def _clipped_along(axes: Callable[[Any], Any]) -> Breaks:
    """Clip by a rule of one's own: `axes` says of [..., C, N, 2] small extents what is culled; by all cameras alike."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        if not _clipped(given) or _several(given):
            return sound(**given)
        with _torch().no_grad():
            radii = sound(**given | {"radius_clip": 0.0, "packed": False})[2]["radii"]
        gone = axes(radii <= given["radius_clip"]).squeeze(-2)
        return sound(**given | {"radius_clip": 0.0, "opacities": given["opacities"] * ~gone})

    return breaks


def _images_of(change: Callable[[Given, Any, Any], Any]) -> Callable[..., Any]:
    return lambda given, images, alphas, meta: (change(given, images, alphas), alphas, meta)


def _last_camera_alone(given: Given, images: Any, alphas: Any, meta: Any) -> Any:
    parts = [_torch().cat((each[..., :-1, :, :, :].detach(), each[..., -1:, :, :, :]), -4) for each in (images, alphas)]
    return *parts, meta


def _black_where_nothing_is_seen(given: Given, images: Any, alphas: Any) -> Any:
    seen = alphas.detach().amax((-1, -2, -3), keepdim=True) > 0.0
    return images * seen


def _depth_before_colors(given: Given, images: Any, alphas: Any) -> Any:
    return images.roll(1, -1)


def _background_behind_depth(given: Given, images: Any, alphas: Any) -> Any:
    last = given["backgrounds"][..., None, None, -1:] * (1.0 - alphas)
    return _torch().cat((images[..., :-1], images[..., -1:] + last), -1)


def _divided_by_the_first(given: Given, images: Any, alphas: Any) -> Any:
    a = alphas.clamp_min(1e-10)
    return _torch().cat((images[..., :-1], images[..., -1:] * a / a[..., :1, :, :, :]), -1)


def _tiles_in_a_byte(given: Given, images: Any, alphas: Any) -> Any:
    side, (H, W) = given["tile_size"], images.shape[-3:-1]
    tiles_x = -(-W // side)
    like = images.new_tensor
    tile = like(range(H)).div(side).floor()[:, None] * tiles_x + like(range(W)).div(side).floor()[None]
    return images * (tile < 256)[..., None]


def _cut(images: Any, count: int) -> Any:
    return _torch().cat((images[..., :count], _torch().zeros_like(images[..., count:])), -1)


def _rows_by_number(given: Given) -> Any:
    """Return colours picked by the number of a row among those before the camera, not by its Gaussian."""
    viewmat, means = given["viewmats"][..., 0, :, :], given["means"]
    depths = (means * viewmat[..., None, 2, :3]).sum(-1) + viewmat[..., 2, 3, None]
    number = (depths.detach() > given["near_plane"]).long().cumsum(-1).sub(1).clamp_min(0)
    index = number[..., None].expand_as(given["colors"])
    return given["colors"].gather(-2, index)


def _dense_camera_ids(given: Given, meta: Any) -> Any:
    return meta["camera_ids"].unique(return_inverse=True)[1].to(meta["camera_ids"].dtype)


def _summed_counts(given: Given, meta: Any) -> Any:
    counts = meta["dominant_counts"]
    return counts.sum(-2, keepdim=True).expand_as(counts)


def _mirrored(given: Given) -> Any:
    Ks = given["Ks"].clone()
    Ks[..., 1:, 0, 2] = given["width"] - Ks[..., 1:, 0, 2]
    return Ks


def _all_to_the_first(v: Any) -> Any:
    total = v.sum(-3, keepdim=True)
    return _torch().cat((total, _torch().zeros_like(v[..., 1:, :, :])), -3)


def _repeated(colors: Any) -> Any:
    return _torch().cat((colors[..., :32], colors[..., : colors.shape[-1] - 32]), -1)


def _asserting(sound: Rasterization, given: Given) -> Any:
    assert not (_packed(given) and _behind(given)), "backgrounds.shape == (nnz, 3)"
    return sound(**given)


BOXES: Final[tuple[tuple[str, str, Breaks, str], ...]] = (
    # cameras
    ("viewmats_of_the_first_camera", "all cameras of a call see from the first one's place",
     _if(_several, viewmats=_of_first("viewmats", 2)), IMAGES),
    ("backgrounds_of_the_first_camera", "all cameras have the first one's background",
     _if(_both(_several, _behind), backgrounds=_of_first("backgrounds", 1)), IMAGES),
    ("harmonics_seen_from_the_first_camera", "directions of harmonics begin at the first camera",
     _seen_from_the_first, "test_signature_cameras:several_cameras_in_one_call_see_what_each_sees_alone"),
    ("cameras_backwards_from_three_on", "from three cameras on, images come out in reverse order",
     _then(lambda g: g["viewmats"].shape[-3] > 2, lambda g, i, a, m: (i.flip(-4), a.flip(-4), m)), IMAGES),
    ("alphas_of_the_first_camera", "every camera has the first one's alphas",
     _then(_several, lambda g, i, a, m: (i, a.narrow(-4, 0, 1).expand_as(a), m)), IMAGES),
    ("gradients_of_the_last_camera_alone", "the backward pass reads one camera's picture for all of them (gsplat#623)",
     _then(_several, _last_camera_alone), GRADIENTS),
    ("view_gradients_summed_over_cameras", "every view matrix gets the sum of all cameras' gradients",
     _pulled(_several, "viewmats", lambda g, v: v.sum(-3, keepdim=True).expand_as(v)), GRADIENTS),
    ("background_gradients_summed_over_cameras", "every background gets the sum of all cameras' gradients",
     _pulled(_several, "backgrounds", lambda g, v: v.sum(-2, keepdim=True).expand_as(v)), GRADIENTS),
    ("gradients_averaged_over_cameras", "gradients of what cameras share are their mean",
     _pulled(_several, "means", lambda g, v: v / g["viewmats"].shape[-3]), GRADIENTS),
    ("opacity_gradients_averaged_over_cameras", "opacities learn from the mean over cameras",
     _pulled(_several, "opacities", lambda g, v: v / g["viewmats"].shape[-3]), GRADIENTS),
    ("color_gradients_summed_over_cameras", "colours of each camera get the gradients of all",
     _pulled(_both(_several, _own_colors), "colors",
             lambda g, v: v.sum(-3 if _plain(g) else -4, keepdim=True).expand_as(v)), GRADIENTS),
    ("radii_of_the_first_camera", "meta shows the first camera's extents for all",
     _told(lambda g: _several(g) and not _packed(g), radii=_first_told("radii", 2)), ROWS),
    ("depths_of_the_first_camera", "meta shows the first camera's depths for all",
     _told(lambda g: _several(g) and not _packed(g), depths=_first_told("depths", 1)), ROWS),
    ("conics_of_the_first_camera", "meta shows the first camera's conics for all",
     _told(lambda g: _several(g) and not _packed(g), conics=_first_told("conics", 2)), ROWS),
    ("dominant_counts_of_the_first_camera", "every camera has the first one's counts: what POP trains by",
     _told(_several, dominant_counts=_first_told("dominant_counts", 1)), DOMINANCE),
    ("dominant_ids_of_the_first_camera", "every camera has the first one's dominant Gaussians",
     _told(_several, dominant_ids=_first_told("dominant_ids", 2)), DOMINANCE),
    ("dominant_counts_of_all_cameras", "every camera has the counts of all of them together",
     _told(_several, dominant_counts=_summed_counts), DOMINANCE),
    ("blended_counts_of_the_first_camera", "every camera has the first one's numbers of blended splats",
     _told(_several, n_contrib=_first_told("n_contrib", 2)), DOMINANCE),
    ("transmittance_of_the_first_camera", "every camera has the first one's remaining transmittance",
     _told(_several, final_T=_first_told("final_T", 2)), DOMINANCE),
    ("cameras_by_a_mirrored_principal_point", "from the second camera on, cx is taken from the right",
     _if(_several, Ks=_mirrored), IMAGES),
    # batches
    *((f"{name}_of_the_first_entry", f"every batch entry has the first one's {name}",
       _if(_batched, **{name: _of_first_entry(name)}), IMAGES)
      for name in ("viewmats", "Ks", "backgrounds", "opacities", "colors")),
    ("covariances_of_the_first_entry", "every batch entry has the first one's covariances",
     _if(_both(_batched, _covars), covars=_of_first_entry("covars")), IMAGES),
    ("entries_exchanged_where_packed", "packed images of batch entries come out in reverse order",
     _then(_both(_batched, _packed),
           lambda g, i, a, m: (i.flip(g["means"].dim() - 3), a.flip(g["means"].dim() - 3), m)), IMAGES),
    ("entries_exchanged_under_two_dimensions", "with two batch dimensions the inner one runs backwards",
     _then(lambda g: g["means"].dim() > 3, lambda g, i, a, m: (i.flip(1), a.flip(1), m)), IMAGES),
    ("all_rows_of_the_first_entry", "batch_ids of packed rows are 0",
     _told(_both(_batched, _packed), batch_ids=lambda g, m: m["batch_ids"] * 0), ROWS),
    ("batches_counted_along_one_dimension", "n_batches is the length of the first batch dimension",
     _told(lambda g: g["means"].dim() > 3, n_batches=lambda g, m: g["means"].shape[0]), TILES),
    ("gradients_summed_over_entries", "the sum over rows runs across the border of batch entries (gsplat PR#1059)",
     _pulled(_batched, "means", lambda g, v: v.sum(v.dim() - 3, keepdim=True).expand_as(v)), GRADIENTS),
    ("depth_of_the_first_entry", "under a depth mode every batch entry stands where the first does",
     _if(_both(_batched, _deep), means=_of_first_entry("means")), IMAGES),
    # packed rows
    ("packed_cameras_are_one", "camera_ids of packed rows are 0",
     _told(_both(_packed, _several), camera_ids=lambda g, m: m["camera_ids"] * 0), ROWS),
    ("packed_cameras_are_rows", "n_cameras of packed rows is their number",
     _told(_packed, n_cameras=lambda g, m: len(m["gaussian_ids"])), TILES),
    ("packed_cameras_are_those_that_see", "n_cameras is one more than the last camera that sees something",
     _told(_packed, n_cameras=lambda g, m: int(m["camera_ids"].max()) + 1), TILES),
    ("packed_cameras_without_the_blind", "camera_ids leave out cameras that see nothing",
     _told(_packed, camera_ids=_dense_camera_ids), ROWS),
    ("packed_colors_of_the_first_camera", "packed rows have the first camera's colours (as gsplat PR#742 mends)",
     _if(_both(_packed, _own_colors), colors=_first_colors), IMAGES),
    ("packed_colors_by_row", "plain colours of packed rows are picked by the row's number (index of a compacted array)",
     _if(lambda g: _packed(g) and _plain(g) and not _own_colors(g), colors=_rows_by_number), IMAGES),
    ("packed_without_backgrounds", "packed rows are drawn over black",
     _if(_packed, backgrounds=None), IMAGES),
    ("packed_fails_with_backgrounds", "packed calls assert a background for each row (gsplat#764, gsplat#826)",
     _asserting, TOGETHER),
    ("packed_is_classic", "antialiasing is left out of packed rows",
     _if(_packed, rasterize_mode="classic"), IMAGES),
    ("packed_covariances_are_diagonal", "packed rows lose covariances off the diagonal",
     _if(_both(_packed, _covars), covars=lambda g: g["covars"] * g["covars"].new_ones(3).diag()), IMAGES),
    ("packed_without_radius_clip", "radius_clip is not handed to the packed projection",
     _if(_packed, radius_clip=0.0), IMAGES),
    ("packed_near_plane_is_fixed", "the near plane is not handed to the packed projection",
     _if(_packed, near_plane=0.01), IMAGES),
    ("packed_far_plane_is_fixed", "the far plane is not handed to the packed projection",
     _if(_packed, far_plane=1e10), IMAGES),
    ("packed_low_pass_is_fixed", "eps2d is not handed to the packed projection",
     _if(_packed, eps2d=0.3), IMAGES),
    ("packed_depth_is_not_divided", "expected depths of packed rows are accumulated ones (strands-labs/robots PR#2332)",
     _if(_packed, render_mode=lambda g: g["render_mode"].replace("ED", "D")), IMAGES),
    ("packed_blind_cameras_are_black", "a camera that sees no packed row is left black, without its background",
     _then(_packed, _images_of(_black_where_nothing_is_seen)), IMAGES),
    ("packed_rows_of_the_first_camera", "a Gaussian behind the first camera has no packed row of any",
     _if(_both(_packed, _several), opacities=_culled_by_the_first), IMAGES),
    ("packed_lists_hold_gaussians", "flatten_ids of packed rows are Gaussians, not rows",
     _told(_packed, flatten_ids=lambda g, m: m["gaussian_ids"][m["flatten_ids"].long()]), TILES),
    ("packed_view_gradients_are_of_one_camera", "packed rows give all their gradient to the first view matrix",
     _pulled(_both(_packed, _several), "viewmats", lambda g, v: _all_to_the_first(v)), GRADIENTS),
    ("packed_color_gradients_are_averaged", "colours that cameras share get the mean of packed rows",
     _pulled(_both(_packed, _several), "colors", lambda g, v: v / g["viewmats"].shape[-3]), GRADIENTS),
    ("packed_uses_all_bands", "packed rows ignore sh_degree",
     _if(_both(_packed, _fewer_bands), sh_degree=lambda g: round(g["colors"].shape[-2] ** 0.5) - 1), IMAGES),
    ("packed_dominant_counts_are_of_the_first_camera", "counts of packed rows are the first camera's",
     _told(_both(_packed, _several), dominant_counts=_first_told("dominant_counts", 1)), DOMINANCE),
    # two arguments
    ("radius_clip_by_width", "radius_clip looks at the extent along x alone",
     _clipped_along(lambda small: small[..., 0]), IMAGES),
    ("radius_clip_by_either", "radius_clip culls Gaussians that are small along one axis",
     _clipped_along(lambda small: small.any(-1)), IMAGES),
    ("radius_clip_ignored_with_covariances", "radius_clip is lost where covariances are given",
     _if(_covars, radius_clip=0.0), IMAGES),
    ("radius_clip_ignored_by_cameras", "radius_clip is lost where there are several cameras",
     _if(_several, radius_clip=0.0), IMAGES),
    ("antialiasing_ignored_with_covariances", "covariances are drawn as classic",
     _if(_covars, rasterize_mode="classic"), IMAGES),
    ("antialiasing_ignored_with_depth", "depth modes are drawn as classic",
     _if(_deep, rasterize_mode="classic"), IMAGES),
    ("antialiasing_ignored_in_batches", "batches are drawn as classic",
     _if(_batched, rasterize_mode="classic"), IMAGES),
    ("antialiasing_ignored_by_cameras", "several cameras are drawn as classic",
     _if(_several, rasterize_mode="classic"), IMAGES),
    ("antialiasing_has_its_own_low_pass", "antialiasing takes the low-pass of 0.3 px^2, whatever the call says",
     _if(_antialiased, eps2d=0.3), IMAGES),
    ("near_plane_of_the_first_camera", "the first camera's depth decides for all what is before the near plane",
     _if(_several, opacities=_culled_by_the_first), IMAGES),
    ("near_plane_ignored_with_depth", "depth modes have a near plane of their own",
     _if(_deep, near_plane=0.01), IMAGES),
    ("far_plane_ignored_by_cameras", "the far plane is lost where there are several cameras",
     _if(_several, far_plane=1e10), IMAGES),
    ("planes_ignored_with_covariances", "planes are lost where covariances are given",
     _if(_covars, near_plane=0.01, far_plane=1e10), IMAGES),
    ("low_pass_ignored_in_batches", "eps2d is lost in batches",
     _if(_batched, eps2d=0.3), IMAGES),
    ("all_bands_by_cameras", "several cameras ignore sh_degree",
     _if(_both(_several, _fewer_bands), sh_degree=lambda g: round(g["colors"].shape[-2] ** 0.5) - 1), IMAGES),
    ("higher_bands_of_the_first_camera", "of each camera's harmonics, those from degree 2 on are the first one's",
     _if(lambda g: _own_colors(g) and not _plain(g) and g["colors"].shape[-2] > 4,
         colors=_higher_bands_of_the_first), IMAGES),
    ("background_behind_depth", "behind the depth stands the background's last channel",
     _then(lambda g: _behind(g) and g["render_mode"].startswith("RGB+"), _images_of(_background_behind_depth)), IMAGES),
    ("depth_before_plain_colors", "depth is the first channel where colours are plain",
     _then(lambda g: _plain(g) and g["render_mode"].startswith("RGB+"), _images_of(_depth_before_colors)), IMAGES),
    ("expected_depth_by_the_first_alphas", "expected depths of all cameras are divided by the first one's opacity",
     _then(lambda g: _several(g) and g["render_mode"].endswith("ED"), _images_of(_divided_by_the_first)), IMAGES),
    ("tiles_numbered_in_a_byte", "with several cameras the latter tiles stay empty, as an index runs over (gsplat#806)",
     _then(_several, _images_of(_tiles_in_a_byte)), IMAGES),
    ("tiles_told_are_of_16", "meta says 16 px for every side of a tile",
     _told(lambda g: True, tile_size=lambda g, m: 16), TILES),
    # channels and plain colours
    ("plain_colors_not_negative", "plain colours are clamped at 0, as those of harmonics",
     _if(_plain, colors=lambda g: g["colors"].clamp_min(0.0)), IMAGES),
    ("plain_colors_in_a_byte", "plain colours are clamped to [0, 1]",
     _if(_plain, colors=lambda g: g["colors"].clamp(0.0, 1.0)), IMAGES),
    ("images_not_negative", "images are clamped at 0",
     _then(lambda g: True, _images_of(lambda g, i, a: i.clamp_min(0.0))), IMAGES),
    ("thirty_two_channels", "channels from the 33rd on stay empty: 2^n + 1 are not provided for (gsplat PR#218)",
     _then(lambda g: g["colors"].shape[-1] > 32, _images_of(lambda g, i, a: _cut(i, 32))), IMAGES),
    ("chunks_repeat", "channels from the 33rd on are those from the first on again",
     _if(lambda g: _plain(g) and g["colors"].shape[-1] > 32, colors=lambda g: _repeated(g["colors"])), IMAGES),
    ("backgrounds_of_three_channels", "a background has three channels, those after are 0",
     _if(lambda g: _behind(g) and g["backgrounds"].shape[-1] > 3,
         backgrounds=lambda g: _cut(g["backgrounds"], 3)), IMAGES),
    ("gradients_of_three_channels", "channels after the third have no gradient (graphdeco#622: three are compiled in)",
     _pulled(lambda g: _plain(g) and g["colors"].shape[-1] > 3, "colors", lambda g, v: _cut(v, 3)), GRADIENTS),
    ("one_channel_without_background", "a picture of one channel is drawn over black",
     _if(lambda g: g["colors"].shape[-1] == 1, backgrounds=None), IMAGES),
)  # fmt: skip

COMBINED: Final = tuple(BlackBox(*box) for box in BOXES)
