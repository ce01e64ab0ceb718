"""Black boxes with one argument, camera, mode of depth or key of meta ignored or mixed up.

One small view is drawn rightly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

from pop_ref.conformance.backends import function_named
from pop_ref.conformance.mutants.black_box import (
    BlackBox,
    Breaks,
    Given,
    Rasterization,
    Told,
    absolute_told,
    accumulated_mode,
    always,
    batched,
    behind,
    both,
    centred,
    counts_of_all_cameras,
    deep,
    depth_beside_colors,
    drawn,
    expected_depth,
    far_plane_is_a_sphere,
    first_channels,
    first_colors,
    flat,
    harmonic,
    hidden,
    import_torch,
    in_camera,
    last_channel,
    mean_of_cameras,
    no_gradient,
    numbers,
    of_first_camera,
    of_first_entry,
    own_colors,
    packed,
    passing,
    plain,
    pulled,
    several,
    shown,
    then,
    told,
    when,
)

_CHUNK: Final = 32  # channels that a pass takes together

# laws by which many of these die
_UNITS: Final = "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike"
_BLACK: Final = "test_signature_arguments:without_a_background_it_is_black"
_EXPECTED: Final = "test_signature_arguments:the_expected_depth_is_the_accumulated_one_over_the_opacity"
_ACCUMULATED: Final = "test_signature_arguments:the_accumulated_depth_is_the_oracles_alone_and_behind_colours"
_DEPTH: Final = "test_signature_arguments:depth_follows_plain_colours_of_several_cameras"
_PACKED: Final = "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"
_CHANNELS: Final = "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike"
_PLAIN: Final = "test_signature_arguments:plain_colours_are_drawn_as_they_are"
_CLIP: Final = "test_signature_arguments:what_is_no_larger_than_radius_clip_is_culled"
_LOW_PASS: Final = "test_signature_arguments:the_low_pass_is_as_wide_as_the_call_says"
_CAMERAS: Final = "test_signature_arguments:several_cameras_in_one_call_see_what_each_sees_alone"
_ENTRIES: Final = "test_signature_arguments:batch_entries_do_not_know_of_each_other"
_ASKED: Final = "test_signature_meta:meta_says_what_was_asked"
_TOLD: Final = "test_signature_meta:the_splats_that_meta_shows_where_nothing_requires_a_gradient_are_the_oracles"


def _columns(given: Given) -> Any:
    return numbers(given["width"], given["means"])[:, None]


def _white(given: Given) -> Any:
    channels = given["colors"].shape[-1] if plain(given) else 3
    return given["means"].new_ones((*given["viewmats"].shape[:-2], channels))


def _by_gaussian(name: str) -> Callable[[Given, Any], Any]:
    return lambda given, meta: meta[name][meta["gaussian_ids"].argsort(stable=True)]


def _tile_above_the_image(given: Given, meta: Any) -> Any:
    keys, tiles = meta["isect_ids"], meta["tile_width"] * meta["tile_height"]
    high, bits = keys >> 32, tiles.bit_length()
    image, tile = high >> bits, high & ((1 << bits) - 1)
    return (tile << 40) | (image << 32) | (keys & 0xFFFFFFFF)


def _dominant_packed_rows(given: Given, meta: Any) -> Any:
    ids, n = meta["dominant_ids"], given["means"].shape[-2]
    rows = ids.new_zeros((meta["n_cameras"], n))
    for camera in range(meta["n_cameras"]):
        present = meta["gaussian_ids"][meta["camera_ids"] == camera]
        rows[camera, present] = ids.new_tensor(range(len(present)))
    wrong = rows.gather(1, ids.clamp_min(0).flatten(-2).reshape(meta["n_cameras"], -1)).reshape(ids.shape)
    return wrong.where(ids >= 0, ids)


def _seen_from_the_first(given: Given) -> Any:
    dirs = function_named("pop_fast.stages.projection:view_dirs")(given["means"], given["viewmats"][0])
    return function_named("pop_fast.stages.harmonics:colors_from_sh")(given["colors"], dirs, given["sh_degree"])


def _by_compact_rows(given: Given, v: Any) -> Any:
    depths = in_camera(given["means"].detach(), given["viewmats"].detach())[0, :, 2]
    seen = (depths > given["near_plane"]).nonzero()[:, 0]
    found = v.new_zeros(v.shape)
    found[seen] = v[: len(seen)]
    return found


def _one_focal_length(given: Given) -> Any:
    Ks = given["Ks"].clone()
    Ks[..., 1, 1] = Ks[..., 0, 0]
    return Ks


def _depth_of(value: Callable[[Given], Any]) -> Breaks:
    """Draw another depth: `value` gives it for every Gaussian and camera, [..., C, N]."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        if flat(given):
            return sound(**given)
        images, alphas, meta = sound(**given)
        as_colors = {"colors": value(given)[..., None], "sh_degree": None, "backgrounds": None, "render_mode": "RGB"}
        depth, opacity, _ = sound(**given | as_colors)
        if expected_depth(given):
            depth = depth / opacity.clamp_min(1e-10)
        return import_torch().cat((images[..., :-1], depth), -1), alphas, meta

    return breaks


def _taught_by_the_last_camera(given: Given) -> Any:
    colors, cameras = given["colors"], given["viewmats"].shape[-3]
    return import_torch().stack([colors.detach()] * (cameras - 1) + [colors], given["means"].dim() - 2)


def _background_of_the_call_before() -> Breaks:
    kept: dict[tuple[int, ...], Any] = {}

    def breaks(sound: Rasterization, given: Given) -> Any:
        shape = _white(given).shape
        if behind(given):
            kept[shape] = given["backgrounds"].detach().clone()
        elif shape in kept:
            return sound(**given | {"backgrounds": kept[shape].to(given["means"])})
        return sound(**given)

    return breaks


def _as_many_as_cameras(given: Given) -> bool:
    colors = given["colors"]
    return plain(given) and not batched(given) and colors.dim() == 2 and given["viewmats"].shape[-3] == len(colors) > 1


def _rotation_transposed(given: Given, v: Any) -> Any:
    v = v.clone()
    v[..., :3, :3] = v[..., :3, :3].mT.clone()
    return v


def _sums_of_the_first_camera(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    sums = meta["means2d"].absgrad
    meta["means2d"].absgrad = sums.narrow(-3, 0, 1).expand_as(sums)
    return images, alphas, meta


def _multiplied_by_the_fourth(given: Given) -> Any:
    colors, opacities = given["colors"][..., :3], given["colors"][..., 3:]
    return import_torch().cat((colors * opacities, opacities), -1)


def _colours_divided(given: Given, images: Any, alphas: Any) -> Any:
    return import_torch().cat((images[..., :-1] / alphas.clamp_min(1e-10), images[..., -1:]), -1)


def _rows_for_cameras(given: Given) -> Any:
    colors, batch = given["colors"], given["means"].dim() - 2
    square = colors.shape[batch] == colors.shape[batch + 1]
    return colors.transpose(batch, batch + 1) if square else colors


def _whole_chunks(value: Any) -> Any:
    whole = value.shape[-1] // _CHUNK * _CHUNK
    return first_channels(value, whole) if whole else value


def _full_chunks_lose_their_last(given: Given, images: Any, alphas: Any) -> Any:
    channels = images.shape[-1]
    return images if channels % _CHUNK else first_channels(images, channels - 1)


def _composited_twice(given: Given, images: Any, alphas: Any) -> Any:
    passing_by = (1.0 - alphas) * given["backgrounds"][..., None, None, :]
    return (images - passing_by) * alphas + passing_by


def _still(**changed: Callable[[Given, Any], Any]) -> Breaks:
    """Change what meta tells, where it is not differentiated."""

    def of(name: str, change: Callable[[Given, Any], Any]) -> Callable[[Given, Any], Any]:
        return lambda given, meta: meta[name] if meta[name].requires_grad else change(given, meta[name])

    return told(always, **{name: of(name, change) for name, change in changed.items()})


_BOXES: Final[tuple[tuple[Any, ...], ...]] = (
    ("near_plane_ignored", "the near plane is a constant of the kernel, whatever the call says",
     when(always, near_plane=0.01), "test_signature_arguments:the_near_and_the_far_plane_are_where_the_call_says"),
    ("eps2d_ignored", "the low-pass of 0.3 px^2 is a constant of the kernel, whatever the call says",
     when(always, eps2d=0.3), _LOW_PASS),
    ("radius_clip_ignored", "splats no larger than radius_clip are drawn", when(always, radius_clip=0.0), _CLIP),
    ("background_of_the_camera_before", "every camera of a call has the background of the one before it",
     when(behind, backgrounds=lambda g: g["backgrounds"].roll(1, -2)), _CAMERAS),
    ("intrinsics_of_the_first_camera", "all cameras of a call are given the first one's K",
     when(always, Ks=of_first_camera("Ks", 2)), _CAMERAS),
    ("colours_of_the_first_camera", "all cameras of a call are given the first one's colours",
     when(always, colors=first_colors),
     "test_signature_arguments:every_camera_has_the_colours_and_harmonics_that_were_given_for_it"),
    ("packed_ids_by_gaussian", "the indices of packed rows are sorted by Gaussian, the rows themselves by camera",
     told(packed, **{name: _by_gaussian(name) for name in ("gaussian_ids", "camera_ids", "batch_ids")}), _PACKED),
    ("keys_sort_by_tile_first", "the key of an intersection has its tile above its image, eight bits each",
     told(always, isect_ids=_tile_above_the_image),
     "test_signature_meta:the_keys_of_intersections_hold_image_tile_and_depth"),
    ("expected_depth_not_divided", "the expected depth is the accumulated one: nobody divides by the opacity",
     when(always, render_mode=accumulated_mode), _EXPECTED),
    ("expected_depth_of_a_constant_opacity", "the opacity by which the expected depth is divided has no gradient",
     last_channel(expected_depth, lambda g, d, a: d * a.clamp_min(1e-10) / a.detach().clamp_min(1e-10)), _EXPECTED),
    ("tiles_counted_in_a_byte", "a splat that lies over more than 255 tiles begins to count them from 0 again",
     told(always, tiles_per_gauss=lambda g, m: m["tiles_per_gauss"] & 255),
     "test_signature_meta:a_splat_over_hundreds_of_tiles_counts_all_of_them"),
    ("dominant_packed_rows", "dominant ids of packed rows are row numbers, not Gaussians",
     told(packed, dominant_ids=_dominant_packed_rows),
     "test_signature_meta:dominant_ids_are_of_gaussians_and_not_of_packed_rows"),
    ("far_plane_exclusive", "a centre on the far plane is culled",
     when(always, far_plane=lambda g: g["far_plane"] * (1.0 - 2.0**-20)),
     "test_signature_arguments:a_centre_on_the_far_plane_is_drawn_and_one_on_the_near_plane_as_the_profile_says"),
    ("covariances_counted_once",
     "covariances are read by their upper triangle, and an entry off the diagonal is counted once in the gradient",
     passing(lambda c: c.triu() + c.detach().tril(-1), "covars"),
     "test_signature_arguments:covariances_draw_what_their_quaternions_and_scales_draw"),
    ("white_by_default", "without backgrounds the picture is white behind",
     when(lambda g: not behind(g), backgrounds=_white), _BLACK),
    ("harmonics_seen_from_the_first_camera", "directions of harmonics begin at the first camera",
     when(lambda g: harmonic(g) and several(g) and not own_colors(g) and not batched(g), colors=_seen_from_the_first,
          sh_degree=None), _CAMERAS),
    ("depth_in_a_padded_channel",
     "four channels and depth are padded to a number that kernels have, and depth is read behind the padding "
     "(gsplat PR#559)",
     last_channel(lambda g: depth_beside_colors(g) and plain(g) and g["colors"].shape[-1] == 4,
                  lambda g, d, a: 0.0 * d), _DEPTH),
    ("quaternion_gradients_by_compact_rows",
     "the rotations' gradient is read by visible row where it is written by Gaussian (LichtFeld-Studio PR#2057)",
     pulled(lambda g: not batched(g), _by_compact_rows, "quats"), _PLAIN),
    ("depth_is_divided_always",
     "the accumulated depth is divided by the opacity as the expected one (as nerfstudio PR#2824 mends)",
     when(lambda g: not expected_depth(g), render_mode=lambda g: g["render_mode"].replace("D", "ED")), _ACCUMULATED),
    ("dark_splats_are_dropped", "splats that are black by eight bits are dropped (brush#250)",
     hidden(lambda g: plain(g) and g["colors"].dim() == g["means"].dim(),
            lambda g: g["colors"].detach().amax(-1) > 1.0 / 255.0), _CHANNELS),
    ("one_focal_length", "pixels are square: fy is fx", when(always, Ks=_one_focal_length), _PLAIN),
    ("principal_point_centred", "the principal point is the picture's centre (Inria's cameras)",
     when(always, Ks=centred), _PLAIN),
    ("expected_depth_of_the_faint", "the expected depth is divided by a hundredth at least, where less is opaque",
     last_channel(expected_depth, lambda g, d, a: d * a.clamp_min(1e-10) / a.clamp_min(1e-2)), _EXPECTED),
    ("depth_does_not_move_means",
     "depth has a gradient by what is blended, none by the centres (ashawkey/diff-gaussian-rasterization#7)",
     _depth_of(lambda g: in_camera(g["means"], g["viewmats"])[..., 2].detach()), _ACCUMULATED),
    ("depth_does_not_move_cameras", "depth's gradient by the camera is lost (LucidDreamer#26)",
     _depth_of(lambda g: in_camera(g["means"], g["viewmats"].detach())[..., 2]), _ACCUMULATED),
    ("depth_along_the_ray", "depth is the distance from the camera (as nerfstudio's rays have it)",
     _depth_of(lambda g: in_camera(g["means"], g["viewmats"]).norm(dim=-1)), _ACCUMULATED),
    ("harmonics_learn_of_the_last_camera",
     "cameras write their gradients of shared harmonics over each other (fvdb-core PR#434)",
     when(lambda g: harmonic(g) and not own_colors(g), colors=_taught_by_the_last_camera), _BLACK),
    ("absolute_of_the_sum",
     "packed rows have the absolute value of the sum, not the sum of absolute values (fvdb-core#354)",
     absolute_told(packed, lambda g, v, sums: v.abs()), _PACKED),
    ("background_of_the_call_before",
     "without backgrounds those of the call before are behind (splatfacto's background in evaluation)",
     _background_of_the_call_before(), _BLACK),
    ("radius_clip_exclusive", "a Gaussian exactly as large as radius_clip is drawn (gsplat compares with <=)",
     when(always, radius_clip=lambda g: g["radius_clip"] * (1.0 - 2.0**-20)), _CLIP),
    ("no_axis_under_a_thousandth", "scales are at least 0.001 (flat Gaussians blow up some solvers)",
     passing(lambda s: s.clamp(min=1e-3), "scales"), _UNITS),
    ("no_axis_over_fifty", "scales are at most 50 (sky of SuperSplat's scenes)",
     passing(lambda s: s.clamp(max=50.0), "scales"), _UNITS),
    ("alpha_of_the_background", "with a background alpha is 1 everywhere",
     then(behind, lambda g, i, a, m: (i, a + (1.0 - a).detach(), m)), _PLAIN),
    ("depth_of_nothing_is_nan", "expected depth is divided by an alpha of 0",
     last_channel(expected_depth, lambda g, d, a: import_torch().where(a.detach() == 0.0, d + math.nan, d)), _EXPECTED),
    ("extents_in_sixteen_bits", "radii over 32,767 wrap (16-bit bounds of WebGPU viewers)",
     _still(radii=lambda _, r: ((r + 2**15) % 2**16 - 2**15).to(r.dtype)),
     "test_signature_meta:extents_that_sixteen_bits_do_not_hold_are_told_as_they_are"),
    ("extents_are_round", "both extents are the larger one (gsplat before 1.5)",
     _still(radii=lambda _, r: r.amax(-1, keepdim=True).expand_as(r).contiguous()), _PACKED),
    ("centres_told_from_corners", "screen centres are half a pixel off",
     _still(means2d=lambda _, m: m - 0.5), _TOLD),
    ("conics_told_backwards", "xx and yy change places", _still(conics=lambda _, c: c.flip(-1)), _TOLD),
    ("depths_told_from_the_near_plane", "depth is counted from the near plane",
     _still(depths=lambda given, d: d - given["near_plane"]), _TOLD),
    ("last_columns_black", "columns beyond the last whole tile are not drawn",
     shown(lambda g: _columns(g) < (g["width"] // g["tile_size"] * g["tile_size"] or g["width"])), _PACKED),
    ("tiles_of_sixteen", "tile_size is not read", when(always, tile_size=16), _ASKED),
    ("three_backgrounds", "the background of channels after the third is black",
     when(lambda g: behind(g) and g["backgrounds"].shape[-1] > 3,
          backgrounds=lambda g: first_channels(g["backgrounds"], 3)), _CHANNELS),
    ("smallest_extent_kept", "what is exactly as large as radius_clip, or half a pixel less, is drawn",
     when(always, radius_clip=lambda g: max(g["radius_clip"] - 0.5, 0.0)), _CLIP),
    ("blur_of_three_tenths", "eps2d is not read", when(always, eps2d=0.3), _LOW_PASS),
    ("covariances_overruled", "scales and quaternions go before covariances",
     when(lambda g: g["quats"] is not None and g["scales"] is not None, covars=None),
     "test_signature_arguments:covariances_go_before_quaternions_and_scales"),
    ("background_of_the_first_entry", "entries of a batch share the first one's background",
     when(batched, backgrounds=of_first_entry("backgrounds")), _ENTRIES),
    ("colours_of_cameras", "where there are as many Gaussians as cameras, a colour a Gaussian is read as one a camera",
     when(_as_many_as_cameras, colors=lambda g: g["colors"][:, None].expand(*[len(g["colors"])] * 2, -1)),
     "test_signature_arguments:where_there_are_as_many_gaussians_as_cameras_a_colour_is_a_gaussians"),
    ("dark_light_clipped", "negative colours come out as black",
     drawn(always, lambda g, i, a: i.clamp_min(0.0)), _UNITS),
    ("background_in_front", "the background shines through whatever covers it",
     drawn(both(behind, flat), lambda g, i, a: i + a * g["backgrounds"][..., None, None, :]), _UNITS),
    ("depth_is_expected", "modes D are divided by alpha like modes ED",
     last_channel(lambda g: deep(g) and not expected_depth(g), lambda g, d, a: d / a.clamp_min(1e-10)), _DEPTH),
    ("expected_beside_colours", "depth drawn with colours is not divided",
     last_channel(both(expected_depth, depth_beside_colors), lambda g, d, a: d * a.clamp_min(1e-10)), _DEPTH),
    ("radii_halved", "meta tells diameters as radii, rounded", _still(radii=lambda g, r: (r + 1) // 2), _PACKED),
    ("corners_are_integers", "meta's centres have integers at pixel centres",
     _still(means2d=lambda g, u: u - 0.5), _TOLD),
    ("lens_of_the_first", "all cameras have the first one's lens", when(always, Ks=of_first_camera("Ks", 2)), _BLACK),
    ("even_widths", "a last odd column is not drawn", shown(lambda g: _columns(g) < g["width"] // 2 * 2), _UNITS),
    ("pose_gradient_transposed", "the rotation's gradient is transposed",
     pulled(always, _rotation_transposed, "viewmats"), _UNITS),
    ("two_bands", "bands beyond the second are not drawn",
     when(harmonic, sh_degree=lambda g: min(g["sh_degree"], 2)), _CAMERAS),
    ("background_is_no_leaf", "the background has no gradient", passing(lambda b: b.detach(), "backgrounds"), _UNITS),
    ("far_unread", "nothing is too far",
     when(always, far_plane=1e10), "test_signature_arguments:the_near_and_the_far_plane_are_where_the_call_says"),
    ("small_scales_raised", "no scale is under a thousandth", passing(lambda s: s.clamp_min(1e-3), "scales"), _UNITS),
    ("colours_reach_one", "plain colours are clamped to 1",
     passing(lambda c: c.clamp_max(1.0) if c.shape[-1] == 3 else c, "colors"), _PLAIN),
    ("low_pass_of_zero_is_the_default", "eps2d=0 counts as not given",
     when(always, eps2d=lambda g: g["eps2d"] or 0.3), _LOW_PASS),
    ("near_plane_of_zero_is_the_default", "near_plane=0 counts as not given",
     when(always, near_plane=lambda g: g["near_plane"] or 0.01),
     "test_signature_arguments:a_centre_on_the_far_plane_is_drawn_and_one_on_the_near_plane_as_the_profile_says"),
    ("culled_rows_keep_an_extent", "unpacked rows of what is culled have radii of 1, and count as visible",
     _still(radii=lambda given, r: r if given["packed"] else r.clamp_min(1)),
     "test_signature_meta:the_splats_that_meta_shows_are_the_oracles"),
    ("absolute_gradients_of_the_first_camera", "all cameras have the first one's sums of absolute gradients",
     then(lambda g: g["absgrad"] and not packed(g), _sums_of_the_first_camera), _BLACK),
    ("four_channels_are_rgba", "of four channels the last one is taken for the opacity of the colour",
     when(lambda g: plain(g) and g["colors"].shape[-1] == 4, colors=_multiplied_by_the_fourth), _CHANNELS),
    ("colours_divided_like_depth", "with the expected depth colours are divided by the opacity, too",
     drawn(both(expected_depth, depth_beside_colors), _colours_divided), _EXPECTED),
    ("sides_told_exchanged", "meta has the height as width",
     told(always, width=lambda g, m: g["height"], height=lambda g, m: g["width"]), _ASKED),
    ("rows_for_cameras", "colours of each camera are read [N, C] where there are as many cameras as Gaussians",
     when(own_colors, colors=_rows_for_cameras),
     "test_signature_arguments:where_there_are_as_many_gaussians_as_cameras_a_cameras_colours_are_its_own"),
    ("intrinsics_by_column", "intrinsics of a batch are flattened cameras first",
     when(lambda g: g["Ks"].dim() == 4, Ks=lambda g: g["Ks"].transpose(0, 1).reshape(g["Ks"].shape)), _ENTRIES),
    ("upper_half_learns", "the gradient of covariances has an upper half only",
     pulled(always, lambda g, v: v.triu(), "covars"),
     "test_signature_arguments:covariances_draw_what_their_quaternions_and_scales_draw"),
    ("counted_over_cameras", "dominant counts are those of all cameras together",
     told(always, dominant_counts=counts_of_all_cameras),
     "test_signature_meta:every_camera_has_dominant_gaussians_and_counts_of_its_own"),
    ("expected_over_a_constant", "the expected depth's gradient takes the opacity that it is divided by for a constant",
     last_channel(expected_depth, lambda g, d, a: d * a.clamp_min(1e-10) / a.detach().clamp_min(1e-10)), _EXPECTED),
    ("behind_the_first_chunk", "the background lies behind the first chunk of channels only",
     when(behind, backgrounds=lambda g: first_channels(g["backgrounds"], _CHUNK)), _CHANNELS),
    ("last_camera_teaches", "shared colours learn from the last camera only",
     when(lambda g: not own_colors(g), colors=_taught_by_the_last_camera), _BLACK),
    ("backgrounds_of_the_first_scene", "every scene of a batch is drawn over the backgrounds of the first",
     when(batched, backgrounds=of_first_entry("backgrounds")), _ENTRIES),
    ("empty_pixels_are_farthest",
     "the expected depth of a pixel that shows nothing is the largest of the picture, as in splatfacto",
     last_channel(expected_depth, lambda g, d, a: import_torch().where(a > 0.0, d, d.detach().amax())), _EXPECTED),
    ("tiles_the_other_way",
     "meta has tile_width and tile_height the other way round, as seen in pictures that are not square",
     told(always, tile_width=lambda g, m: m["tile_height"], tile_height=lambda g, m: m["tile_width"]), _ASKED),
    ("far_plane_is_a_sphere",
     "in calls of one camera the far plane culls by the distance from the camera, not by depth",
     far_plane_is_a_sphere, "test_signature_arguments:the_far_plane_culls_by_depth_and_not_by_distance"),
    ("intersections_forget_the_camera",
     "flatten_ids of every camera are those of the first one's rows, where rows are not packed",
     told(lambda g: not packed(g) and g["means"].shape[-2] > 0,
          flatten_ids=lambda g, m: m["flatten_ids"] % g["means"].shape[-2]),
     "test_signature_meta:the_tile_lists_that_meta_shows_run_front_to_back_and_hold_who_is_blended"),
    ("averaged_over_cameras", "what several cameras of a call share gets the mean of their gradients, not the sum",
     pulled(several, mean_of_cameras, "means", "quats", "scales", "opacities", "covars"), _BLACK),
    ("one_radius", "radii along x and y are both the larger one",
     told(always, radii=lambda g, m: m["radii"].amax(-1, keepdim=True).expand_as(m["radii"]).clone()), _PACKED),
    ("whole_chunks_only", "of more than 32 channels those after the last whole 32 are black",
     passing(_whole_chunks, "colors", "backgrounds"), _CHANNELS),
    ("packed_backgrounds_stay", "backgrounds have no gradient in packed mode",
     pulled(packed, no_gradient, "backgrounds"), _PACKED),
    ("backgrounds_ignored_with_harmonics",
     "what is drawn from harmonics is drawn over black (a setting without effect: gsplat#145)",
     when(harmonic, backgrounds=None), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("backgrounds_learn_nothing_beside_depth", "backgrounds have no gradient where depth is drawn with colours",
     pulled(depth_beside_colors, no_gradient, "backgrounds"),
     "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("full_chunks_lose_their_last_channel", "of 32 channels, or a multiple, the last one is black",
     drawn(always, _full_chunks_lose_their_last), _CHANNELS),
    ("composited_twice",
     "a picture that lies over its background is blended with it once more (strands-labs/robots #2322)",
     drawn(both(behind, flat), _composited_twice), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("absolute_gradients_are_of_ndc", "absolute gradients are by normalised device coordinates, as Inria's are",
     absolute_told(always, lambda g, v, sums: sums * sums.new_tensor([0.5 * g["width"], 0.5 * g["height"]])),
     "test_agreement:gradients_are_the_oracles"),
    ("radius_clip_is_a_diameter", "radius_clip is compared with twice the extent",
     when(always, radius_clip=lambda g: 0.5 * g["radius_clip"]), _CLIP),
)  # fmt: skip

ARGUMENTS: Final = tuple(BlackBox(*line) for line in _BOXES)
