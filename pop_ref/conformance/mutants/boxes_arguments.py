"""Black boxes with one argument, camera, mode of depth or key of meta ignored or mixed up.

One small view is drawn rightly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from pop_ref.conformance.backends import function_named
from pop_ref.conformance.mutants.black_box import (
    BlackBox,
    Breaks,
    Given,
    Rasterization,
    Told,
    backwards,
    batched,
    breaking,
    import_torch,
    in_camera,
    one_view,
    own_colors,
    passing,
    plain,
    several,
    telling,
)

_CHUNK: Final = 32  # channels that a pass takes together


def _with(**changed: Callable[[Given], Any]) -> Breaks:
    """Break arguments: each is what its function makes of all of them."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        return sound(**given | {name: change(given) for name, change in changed.items()})

    return breaks


def _first_of_cameras(name: str, trailing: int) -> Callable[[Given], Any]:
    """Return a change that gives every camera what is the first one's."""

    def change(given: Given) -> Any:
        value = given[name]
        axis = value.dim() - trailing - 1
        return value.narrow(axis, 0, 1).expand_as(value)

    return change


def _colors_of_the_first_camera(given: Given) -> Any:
    return _first_of_cameras("colors", 2 if plain(given) else 3)(given) if own_colors(given) else given["colors"]


def _rolled_backgrounds(given: Given) -> Any:
    behind = given["backgrounds"]
    return None if behind is None else behind.roll(1, -2)


def _white_by_default(given: Given) -> Any:
    if given["backgrounds"] is not None:
        return given["backgrounds"]
    channels = 3 if given["sh_degree"] is not None else given["colors"].shape[-1]
    return given["means"].new_ones((*given["viewmats"].shape[:-2], channels))


def _packed_by_gaussian(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if given["packed"]:
        order = meta["gaussian_ids"].argsort(stable=True)
        meta |= {name: meta[name][order] for name in ("gaussian_ids", "camera_ids", "batch_ids")}
    return images, alphas, meta


def _tile_above_the_image(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    keys, tiles = meta["isect_ids"], meta["tile_width"] * meta["tile_height"]
    high, bits = keys >> 32, tiles.bit_length()
    image, tile = high >> bits, high & ((1 << bits) - 1)
    return images, alphas, {**meta, "isect_ids": (tile << 40) | (image << 32) | (keys & 0xFFFFFFFF)}


def _expected_depth_of_a_constant_opacity(sound: Rasterization, given: Given) -> Any:
    if not given["render_mode"].endswith("ED"):
        return sound(**given)
    images, alphas, meta = sound(**given | {"render_mode": given["render_mode"].replace("ED", "D")})
    # an image of its own, as a tensor that shares storage with what autograd keeps must not be written to
    images = images.clone()
    images[..., -1:] = images[..., -1:] / alphas.detach().clamp_min(1e-10)
    return images, alphas, meta


def _tiles_counted_in_a_byte(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    return images, alphas, {**meta, "tiles_per_gauss": meta["tiles_per_gauss"] & 255}


def _dominant_packed_rows(sound: Rasterization, given: Given) -> Any:
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


def _just_below_the_far_plane(given: Given) -> float:
    return float(given["far_plane"]) * (1.0 - 2.0**-20)


def _accumulated_for_expected(given: Given) -> str:
    return given["render_mode"].replace("ED", "D")


def _upper_triangle_once(given: Given) -> Any:
    covars = given["covars"]
    return None if covars is None else covars.triu() + covars.detach().tril(-1)


def _default(name: str, value: float) -> Breaks:
    return _with(**{name: lambda given: value})


def _seen_from_the_first(sound: Rasterization, given: Given) -> Any:
    if plain(given) or not several(given) or own_colors(given) or batched(given):
        return sound(**given)
    dirs = function_named("pop_fast.stages.projection:view_dirs")(given["means"], given["viewmats"][0])
    colors = function_named("pop_fast.stages.harmonics:colors_from_sh")(given["colors"], dirs, given["sh_degree"])
    return sound(**given | {"colors": colors, "sh_degree": None})


def _depth_in_a_padded_channel(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if given["render_mode"].startswith("RGB+") and images.shape[-1] == 5:
        images = import_torch().cat((images[..., :4], 0.0 * images[..., 4:]), -1)
    return images, alphas, meta


def _quats_by_compact_rows(sound: Rasterization, given: Given) -> Any:
    means, quats, view = given["means"], given["quats"], given["viewmats"]
    if quats is None or not quats.requires_grad or means.dim() > 2:
        return sound(**given)
    depths = (means.detach() @ view.detach()[0, 2, :3]) + view.detach()[0, 2, 3]
    seen = (depths > given["near_plane"]).nonzero()[:, 0]

    def misplaced(v: Any) -> Any:
        found = v.new_zeros(v.shape)
        found[seen] = v[: len(seen)]
        return found

    return sound(**given | {"quats": backwards(quats, misplaced)})


def _always_divided(given: Given) -> Given:
    mode = given["render_mode"]
    return {"render_mode": mode if mode.endswith("ED") else mode.replace("D", "ED")}


def _dark_are_dropped(given: Given) -> Given:
    colors = given["colors"]
    if given["sh_degree"] is not None or colors.dim() != given["means"].dim():
        return {}
    return {"opacities": given["opacities"] * (colors.detach().amax(-1) > 1.0 / 255.0)}


def _one_focal_length(given: Given) -> Given:
    Ks = given["Ks"].clone()
    Ks[..., 1, 1] = Ks[..., 0, 0]
    return {"Ks": Ks}


def _centred(given: Given) -> Given:
    Ks = given["Ks"].clone()
    Ks[..., 0, 2], Ks[..., 1, 2] = 0.5 * given["width"], 0.5 * given["height"]
    return {"Ks": Ks}


def _faint_are_not_divided(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if given["render_mode"].endswith("ED"):
        less = images[..., -1:] * alphas.clamp_min(1e-10) / alphas.clamp_min(1e-2)
        images = import_torch().cat((images[..., :-1], less), -1)
    return images, alphas, meta


def _depth_of(value: Callable[[Given], Any]) -> Breaks:
    """Draw another depth: `value` gives it for every Gaussian and camera, [..., C, N]."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        mode = given["render_mode"]
        if mode == "RGB":
            return sound(**given)
        images, alphas, meta = sound(**given)
        as_colors = {"colors": value(given)[..., None], "sh_degree": None, "backgrounds": None, "render_mode": "RGB"}
        depth, opacity, _ = sound(**given | as_colors)
        if mode.endswith("ED"):
            depth = depth / opacity.clamp_min(1e-10)
        return import_torch().cat((images[..., :-1], depth), -1), alphas, meta

    return breaks


def _harmonics_learn_of_the_last_camera(given: Given) -> Given:
    colors, cameras = given["colors"], given["viewmats"].shape[-3]
    shared = given["sh_degree"] is not None and colors.dim() - 3 != given["viewmats"].dim() - 2
    if not shared or cameras < 2:
        return {}
    each = colors.unsqueeze(-4)
    return {"colors": import_torch().cat([each.detach()] * (cameras - 1) + [each], -4)}


def _absolute_of_the_sum(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if given["packed"] and given["absgrad"] and meta["means2d"].requires_grad:
        centres = meta["means2d"]

        def replaced(grad: Any) -> None:
            centres.absgrad.copy_(grad.abs())

        centres.register_hook(replaced)
    return images, alphas, meta


def _background_of_the_call_before() -> Breaks:
    kept: dict[tuple[int, ...], Any] = {}

    def breaks(sound: Rasterization, given: Given) -> Any:
        behind, cameras = given["backgrounds"], tuple(given["viewmats"].shape[:-2])
        channels = 3 if given["sh_degree"] is not None else given["colors"].shape[-1]
        if behind is not None:
            kept[(*cameras, channels)] = behind.detach().clone()
        elif (*cameras, channels) in kept:
            return sound(**given | {"backgrounds": kept[(*cameras, channels)].to(given["means"])})
        return sound(**given)

    return breaks


def meta_telling(**changed: Callable[[Given, Any], Any]) -> Breaks:
    """Change what meta tells, where it is not differentiated."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        images, alphas, meta = sound(**given)
        for name, change in changed.items():
            if not meta[name].requires_grad:
                meta[name] = change(given, meta[name])
        return images, alphas, meta

    return breaks


def _alpha_of_the_background(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    return images, alphas if given["backgrounds"] is None else alphas + (1.0 - alphas).detach(), meta


def _depth_of_nothing(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    if not given["render_mode"].endswith("ED"):
        return images, alphas, meta
    torch = import_torch()
    nan = torch.where(alphas.detach() == 0.0, torch.nan, 0.0)
    return torch.cat((images[..., :-1], images[..., -1:] + nan), -1), alphas, meta


def _last_columns_black(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    whole = given["width"] // given["tile_size"] * given["tile_size"]
    keep = import_torch().arange(given["width"], device=images.device) < (whole or given["width"])
    return images * keep[:, None], alphas * keep[:, None], meta


def _three_backgrounds(given: Given) -> Given:
    behind = given["backgrounds"]
    if behind is None or behind.shape[-1] <= 3:
        return {}
    return {"backgrounds": import_torch().cat((behind[..., :3], import_torch().zeros_like(behind[..., 3:])), -1)}


def _covariances_overruled(given: Given) -> Given:
    both = given["covars"] is not None and given["quats"] is not None and given["scales"] is not None
    return {"covars": None} if both else {}


def _background_of_the_first_entry(given: Given) -> Given:
    behind = given["backgrounds"]
    return {} if behind is None or behind.dim() < 3 else {"backgrounds": behind[:1].expand_as(behind)}


def _colours_of_cameras(given: Given) -> Given:
    colors, C = given["colors"], given["viewmats"].shape[-3]
    plain = given["sh_degree"] is None and colors.dim() == 2 and given["viewmats"].dim() == 3
    return {"colors": colors[:, None].expand(C, C, -1)} if plain and C == len(colors) > 1 else {}


def _background_in_front(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    behind = given["backgrounds"]
    if behind is None or given["render_mode"] != "RGB":
        return images, alphas, meta
    return images + alphas * behind[..., None, None, :], alphas, meta


def _depth_is_expected(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if given["render_mode"] not in ("D", "RGB+D"):
        return images, alphas, meta
    expected = images[..., -1:] / alphas.clamp_min(1e-10)
    return import_torch().cat((images[..., :-1], expected), -1), alphas, meta


def _expected_beside_colours(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if given["render_mode"] != "RGB+ED":
        return images, alphas, meta
    plain = images[..., -1:] * alphas.clamp_min(1e-10)
    return import_torch().cat((images[..., :-1], plain), -1), alphas, meta


def _lens_of_the_first(given: Given) -> Given:
    return {"Ks": given["Ks"][..., :1, :, :].expand_as(given["Ks"])}


def _even_widths(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    keep = import_torch().arange(given["width"], device=images.device) < given["width"] // 2 * 2
    return images * keep[:, None], alphas * keep[:, None], meta


def _pose_gradient_transposed(given: Given) -> Given:
    def transposed(v: Any) -> Any:
        v = v.clone()
        v[..., :3, :3] = v[..., :3, :3].mT.clone()
        return v

    return {"viewmats": backwards(given["viewmats"], transposed)}


def _two_bands(given: Given) -> Given:
    return {"sh_degree": None if given["sh_degree"] is None else min(given["sh_degree"], 2)}


def _sums_of_the_first_camera(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if given["absgrad"] and not given["packed"]:
        sums = meta["means2d"].absgrad
        meta["means2d"].absgrad = sums.narrow(-3, 0, 1).expand_as(sums)
    return images, alphas, meta


def _four_are_rgba(given: Given) -> Given:
    colors = given["colors"]
    if given["sh_degree"] is not None or colors.shape[-1] != 4:
        return {}
    return {"colors": import_torch().cat((colors[..., :3] * colors[..., 3:], colors[..., 3:]), -1)}


def _colours_divided(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if given["render_mode"] != "RGB+ED":
        return images, alphas, meta
    return import_torch().cat((images[..., :-1] / alphas.clamp_min(1e-10), images[..., -1:]), -1), alphas, meta


def _sides_exchanged(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    meta["width"], meta["height"] = given["height"], given["width"]
    return images, alphas, meta


def _rows_for_cameras(given: Given) -> Given:
    colors = given["colors"]
    batch = given["means"].dim() - 2
    if not own_colors(given) or colors.shape[batch] != colors.shape[batch + 1]:
        return {}
    return {"colors": colors.transpose(batch, batch + 1)}


def _intrinsics_by_column(given: Given) -> Given:
    Ks = given["Ks"]
    if Ks.dim() != 4:
        return {}
    return {"Ks": Ks.transpose(0, 1).reshape(Ks.shape)}


def _upper_half_learns(given: Given) -> Given:
    if given.get("covars") is None:
        return {}
    return {"covars": backwards(given["covars"], lambda gradient: gradient.triu())}


def _counted_over_cameras(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if "dominant_counts" in meta:
        counts = meta["dominant_counts"]
        meta["dominant_counts"] = counts.sum(-2, keepdim=True).expand(counts.shape).clone()
    return images, alphas, meta


def _behind_the_first_chunk(given: Given) -> Given:
    behind = given["backgrounds"]
    if behind is None:
        return {}
    first = import_torch().arange(behind.shape[-1], device=behind.device) < given.get("channel_chunk", 32)
    return {"backgrounds": behind * first}


def _last_camera_teaches(given: Given) -> Given:
    torch, colors, batch = import_torch(), given["colors"], given["means"].dim() - 2
    shared = colors.dim() == batch + 2 + (given["sh_degree"] is not None)
    cameras = given["viewmats"].shape[-3]
    if not shared or cameras < 2:
        return {}
    return {"colors": torch.stack([colors.detach()] * (cameras - 1) + [colors], batch)}


def _empty_pixels_are_farthest(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if not given["render_mode"].endswith("ED") or images.numel() == 0:
        return images, alphas, meta
    torch, depth = import_torch(), images[..., -1:]
    depth = torch.where(alphas > 0.0, depth, depth.detach().amax())
    return torch.cat((images[..., :-1], depth), -1), alphas, meta


def _tiles_the_other_way(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    meta["tile_width"], meta["tile_height"] = meta["tile_height"], meta["tile_width"]
    return images, alphas, meta


def _far_plane_is_a_sphere(given: Given) -> Given:
    if not one_view(given):
        return {}
    viewmat = given["viewmats"].detach().reshape(4, 4)
    distances = (given["means"].detach() @ viewmat[:3, :3].T + viewmat[:3, 3]).norm(dim=-1)
    return {"opacities": given["opacities"] * (distances <= given["far_plane"])}


def _intersections_forget_the_camera(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    n = given["means"].shape[-2]
    if not given["packed"] and n > 0:
        meta["flatten_ids"] = meta["flatten_ids"] % n
    return images, alphas, meta


def _averaged_over_cameras(given: Given) -> Given:
    n_cameras = given["viewmats"].shape[-3]
    if n_cameras == 1:
        return {}
    shared = {name: given.get(name) for name in ("means", "quats", "scales", "opacities", "covars")}
    return {
        name: backwards(value, lambda gradient: gradient / n_cameras)
        for name, value in shared.items()
        if value is not None
    }


def _one_radius(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    radii = meta["radii"]
    meta["radii"] = radii.amax(-1, keepdim=True).expand_as(radii).clone()
    return images, alphas, meta


def _whole_chunks_only(given: Given) -> Given:
    colors, behind = given["colors"], given["backgrounds"]
    channels = colors.shape[-1]
    if given["sh_degree"] is not None or channels <= _CHUNK or channels % _CHUNK == 0:
        return {}
    drawn = import_torch().arange(channels, device=colors.device) < channels // _CHUNK * _CHUNK
    return {"colors": colors * drawn, "backgrounds": None if behind is None else behind * drawn}


def _packed_backgrounds_stay(given: Given) -> Given:
    behind = given["backgrounds"]
    if behind is None or not given["packed"]:
        return {}
    return {"backgrounds": backwards(behind, lambda gradient: gradient * 0.0)}


def _without_backgrounds_for_harmonics(given: Given) -> Given:
    return {} if plain(given) else {"backgrounds": None}


def _backgrounds_stay_beside_depth(given: Given) -> Given:
    behind = given["backgrounds"]
    if behind is None or not given["render_mode"].startswith("RGB+"):
        return {}
    return {"backgrounds": backwards(behind, lambda gradient: gradient * 0.0)}


def _full_chunks_lose_their_last(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if images.shape[-1] % _CHUNK:
        return images, alphas, meta
    return import_torch().cat((images[..., :-1], 0.0 * images[..., -1:]), -1), alphas, meta


def _composited_twice(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    behind = given["backgrounds"]
    if behind is None or given["render_mode"] != "RGB":
        return images, alphas, meta
    passing_by = (1.0 - alphas) * behind[..., None, None, :]
    return (images - passing_by) * alphas + passing_by, alphas, meta


def _absolute_gradients_of_ndc(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    means2d = meta["means2d"]
    absolute: Any = getattr(means2d, "absgrad", None)

    def tell(gradient: Any) -> None:
        absolute.mul_(absolute.new_tensor([0.5 * given["width"], 0.5 * given["height"]]))

    if absolute is not None and means2d.requires_grad:
        means2d.register_hook(tell)
    return images, alphas, meta


_BOXES: Final[tuple[tuple[Any, ...], ...]] = (
    ("near_plane_ignored", "the near plane is a constant of the kernel, whatever the call says",
     _default("near_plane", 0.01), "test_signature_arguments:the_near_and_the_far_plane_are_where_the_call_says"),
    ("eps2d_ignored", "the low-pass of 0.3 px^2 is a constant of the kernel, whatever the call says",
     _default("eps2d", 0.3), "test_signature_arguments:the_low_pass_is_as_wide_as_the_call_says"),
    ("radius_clip_ignored", "splats no larger than radius_clip are drawn",
     _default("radius_clip", 0.0), "test_signature_arguments:what_is_no_larger_than_radius_clip_is_culled"),
    ("background_of_the_camera_before", "every camera of a call has the background of the one before it",
     _with(backgrounds=_rolled_backgrounds),
     "test_signature_arguments:several_cameras_in_one_call_see_what_each_sees_alone"),
    ("intrinsics_of_the_first_camera", "all cameras of a call are given the first one's K",
     _with(Ks=_first_of_cameras("Ks", 2)),
     "test_signature_arguments:several_cameras_in_one_call_see_what_each_sees_alone"),
    ("colours_of_the_first_camera", "all cameras of a call are given the first one's colours",
     _with(colors=_colors_of_the_first_camera),
     "test_signature_arguments:every_camera_has_the_colours_and_harmonics_that_were_given_for_it"),
    ("packed_ids_by_gaussian", "the indices of packed rows are sorted by Gaussian, the rows themselves by camera",
     _packed_by_gaussian, "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"),
    ("keys_sort_by_tile_first", "the key of an intersection has its tile above its image, eight bits each",
     _tile_above_the_image, "test_signature_meta:the_keys_of_intersections_hold_image_tile_and_depth"),
    ("expected_depth_not_divided", "the expected depth is the accumulated one: nobody divides by the opacity",
     _with(render_mode=_accumulated_for_expected),
     "test_signature_arguments:the_expected_depth_is_the_accumulated_one_over_the_opacity"),
    ("expected_depth_of_a_constant_opacity", "the opacity by which the expected depth is divided has no gradient",
     _expected_depth_of_a_constant_opacity,
     "test_signature_arguments:the_expected_depth_is_the_accumulated_one_over_the_opacity"),
    ("tiles_counted_in_a_byte", "a splat that lies over more than 255 tiles begins to count them from 0 again",
     _tiles_counted_in_a_byte, "test_signature_meta:a_splat_over_hundreds_of_tiles_counts_all_of_them"),
    ("dominant_packed_rows", "dominant ids of packed rows are row numbers, not Gaussians",
     _dominant_packed_rows, "test_signature_meta:dominant_ids_are_of_gaussians_and_not_of_packed_rows"),
    ("far_plane_exclusive", "a centre on the far plane is culled",
     _with(far_plane=_just_below_the_far_plane),
     "test_signature_arguments:a_centre_on_the_far_plane_is_drawn_and_one_on_the_near_plane_as_the_profile_says"),
    ("covariances_counted_once",
     "covariances are read by their upper triangle, and an entry off the diagonal is counted once in the gradient",
     _with(covars=_upper_triangle_once),
     "test_signature_arguments:covariances_draw_what_their_quaternions_and_scales_draw"),
    ("white_by_default", "without backgrounds the picture is white behind",
     _with(backgrounds=_white_by_default), "test_signature_arguments:without_a_background_it_is_black"),
    ("harmonics_seen_from_the_first_camera", "directions of harmonics begin at the first camera",
     _seen_from_the_first, "test_signature_arguments:several_cameras_in_one_call_see_what_each_sees_alone"),
    ("depth_in_a_padded_channel",
     "four channels and depth are padded to a number that kernels have, and depth is read behind the padding (gsplat "
     "PR#559)",
     _depth_in_a_padded_channel, "test_signature_arguments:depth_follows_plain_colours_of_several_cameras"),
    ("quaternion_gradients_by_compact_rows",
     "the rotations' gradient is read by visible row where it is written by Gaussian (LichtFeld-Studio PR#2057)",
     _quats_by_compact_rows, "test_signature_arguments:plain_colours_are_drawn_as_they_are"),
    ("depth_is_divided_always",
     "the accumulated depth is divided by the opacity as the expected one (as nerfstudio PR#2824 mends)",
     breaking(_always_divided),
     "test_signature_arguments:the_accumulated_depth_is_the_oracles_alone_and_behind_colours"),
    ("dark_splats_are_dropped", "splats that are black by eight bits are dropped (brush#250)",
     breaking(_dark_are_dropped), "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike"),
    ("one_focal_length", "pixels are square: fy is fx",
     breaking(_one_focal_length), "test_signature_arguments:plain_colours_are_drawn_as_they_are"),
    ("principal_point_centred", "the principal point is the picture's centre (Inria's cameras)",
     breaking(_centred), "test_signature_arguments:plain_colours_are_drawn_as_they_are"),
    ("expected_depth_of_the_faint", "the expected depth is divided by a hundredth at least, where less is opaque",
     _faint_are_not_divided, "test_signature_arguments:the_expected_depth_is_the_accumulated_one_over_the_opacity"),
    ("depth_does_not_move_means",
     "depth has a gradient by what is blended, none by the centres (ashawkey/diff-gaussian-rasterization#7)",
     _depth_of(lambda given: in_camera(given["means"], given["viewmats"])[..., 2].detach()),
     "test_signature_arguments:the_accumulated_depth_is_the_oracles_alone_and_behind_colours"),
    ("depth_does_not_move_cameras", "depth's gradient by the camera is lost (LucidDreamer#26)",
     _depth_of(lambda given: in_camera(given["means"], given["viewmats"].detach())[..., 2]),
     "test_signature_arguments:the_accumulated_depth_is_the_oracles_alone_and_behind_colours"),
    ("depth_along_the_ray", "depth is the distance from the camera (as nerfstudio's rays have it)",
     _depth_of(lambda given: in_camera(given["means"], given["viewmats"]).norm(dim=-1)),
     "test_signature_arguments:the_accumulated_depth_is_the_oracles_alone_and_behind_colours"),
    ("harmonics_learn_of_the_last_camera",
     "cameras write their gradients of shared harmonics over each other (fvdb-core PR#434)",
     breaking(_harmonics_learn_of_the_last_camera), "test_signature_arguments:without_a_background_it_is_black"),
    ("absolute_of_the_sum",
     "packed rows have the absolute value of the sum, not the sum of absolute values (fvdb-core#354)",
     _absolute_of_the_sum, "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"),
    ("background_of_the_call_before",
     "without backgrounds those of the call before are behind (splatfacto's background in evaluation)",
     _background_of_the_call_before(), "test_signature_arguments:without_a_background_it_is_black"),
    ("radius_clip_exclusive", "a Gaussian exactly as large as radius_clip is drawn (gsplat compares with <=)",
     breaking(lambda given: {"radius_clip": given["radius_clip"] * (1.0 - 2.0**-20)}),
     "test_signature_arguments:what_is_no_larger_than_radius_clip_is_culled"),
    ("no_axis_under_a_thousandth", "scales are at least 0.001 (flat Gaussians blow up some solvers)",
     passing(lambda s: s.clamp(min=1e-3), "scales"),
     "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike"),
    ("no_axis_over_fifty", "scales are at most 50 (sky of SuperSplat's scenes)",
     passing(lambda s: s.clamp(max=50.0), "scales"),
     "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike"),
    ("alpha_of_the_background", "with a background alpha is 1 everywhere",
     telling(_alpha_of_the_background), "test_signature_arguments:plain_colours_are_drawn_as_they_are"),
    ("depth_of_nothing_is_nan", "expected depth is divided by an alpha of 0",
     telling(_depth_of_nothing), "test_signature_arguments:the_expected_depth_is_the_accumulated_one_over_the_opacity"),
    ("extents_in_sixteen_bits", "radii over 32,767 wrap (16-bit bounds of WebGPU viewers)",
     meta_telling(radii=lambda _, r: ((r + 2**15) % 2**16 - 2**15).to(r.dtype)),
     "test_signature_meta:extents_that_sixteen_bits_do_not_hold_are_told_as_they_are"),
    ("extents_are_round", "both extents are the larger one (gsplat before 1.5)",
     meta_telling(radii=lambda _, r: r.amax(-1, keepdim=True).expand_as(r).contiguous()),
     "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"),
    ("centres_told_from_corners", "screen centres are half a pixel off",
     meta_telling(means2d=lambda _, m: m - 0.5),
     "test_signature_meta:the_splats_that_meta_shows_where_nothing_requires_a_gradient_are_the_oracles"),
    ("conics_told_backwards", "xx and yy change places",
     meta_telling(conics=lambda _, c: c.flip(-1)),
     "test_signature_meta:the_splats_that_meta_shows_where_nothing_requires_a_gradient_are_the_oracles"),
    ("depths_told_from_the_near_plane", "depth is counted from the near plane",
     meta_telling(depths=lambda given, d: d - given["near_plane"]),
     "test_signature_meta:the_splats_that_meta_shows_where_nothing_requires_a_gradient_are_the_oracles"),
    ("last_columns_black", "columns beyond the last whole tile are not drawn",
     telling(_last_columns_black),
     "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"),
    ("tiles_of_sixteen", "tile_size is not read",
     breaking(lambda _: {"tile_size": 16}), "test_signature_meta:meta_says_what_was_asked"),
    ("three_backgrounds", "the background of channels after the third is black",
     breaking(_three_backgrounds), "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike"),
    ("smallest_extent_kept", "what is exactly as large as radius_clip, or half a pixel less, is drawn",
     breaking(lambda given: {"radius_clip": max(given["radius_clip"] - 0.5, 0.0)}),
     "test_signature_arguments:what_is_no_larger_than_radius_clip_is_culled"),
    ("blur_of_three_tenths", "eps2d is not read",
     breaking(lambda _: {"eps2d": 0.3}), "test_signature_arguments:the_low_pass_is_as_wide_as_the_call_says"),
    ("covariances_overruled", "scales and quaternions go before covariances",
     breaking(_covariances_overruled), "test_signature_arguments:covariances_go_before_quaternions_and_scales"),
    ("background_of_the_first_entry", "entries of a batch share the first one's background",
     breaking(_background_of_the_first_entry), "test_signature_arguments:batch_entries_do_not_know_of_each_other"),
    ("colours_of_cameras", "where there are as many Gaussians as cameras, a colour a Gaussian is read as one a camera",
     breaking(_colours_of_cameras),
     "test_signature_arguments:where_there_are_as_many_gaussians_as_cameras_a_colour_is_a_gaussians"),
    ("dark_light_clipped", "negative colours come out as black",
     telling(lambda g, i, a, m: (i.clamp_min(0.0), a, m)),
     "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike"),
    ("background_in_front", "the background shines through whatever covers it",
     telling(_background_in_front), "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike"),
    ("depth_is_expected", "modes D are divided by alpha like modes ED",
     telling(_depth_is_expected), "test_signature_arguments:depth_follows_plain_colours_of_several_cameras"),
    ("expected_beside_colours", "depth drawn with colours is not divided",
     telling(_expected_beside_colours), "test_signature_arguments:depth_follows_plain_colours_of_several_cameras"),
    ("radii_halved", "meta tells diameters as radii, rounded",
     meta_telling(radii=lambda g, r: (r + 1) // 2),
     "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"),
    ("corners_are_integers", "meta's centres have integers at pixel centres",
     meta_telling(means2d=lambda g, u: u - 0.5),
     "test_signature_meta:the_splats_that_meta_shows_where_nothing_requires_a_gradient_are_the_oracles"),
    ("lens_of_the_first", "all cameras have the first one's lens",
     breaking(_lens_of_the_first), "test_signature_arguments:without_a_background_it_is_black"),
    ("even_widths", "a last odd column is not drawn",
     telling(_even_widths), "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike"),
    ("pose_gradient_transposed", "the rotation's gradient is transposed",
     breaking(_pose_gradient_transposed), "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike"),
    ("two_bands", "bands beyond the second are not drawn",
     breaking(_two_bands), "test_signature_arguments:several_cameras_in_one_call_see_what_each_sees_alone"),
    ("background_is_no_leaf", "the background has no gradient",
     breaking(lambda g: {"backgrounds": None if g["backgrounds"] is None else g["backgrounds"].detach()}),
     "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike"),
    ("far_unread", "nothing is too far",
     breaking(lambda g: {"far_plane": 1e10}),
     "test_signature_arguments:the_near_and_the_far_plane_are_where_the_call_says"),
    ("small_scales_raised", "no scale is under a thousandth",
     passing(lambda s: s.clamp_min(1e-3), "scales"),
     "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike"),
    ("colours_reach_one", "plain colours are clamped to 1",
     passing(lambda c: c.clamp_max(1.0) if c.shape[-1] == 3 else c, "colors"),
     "test_signature_arguments:plain_colours_are_drawn_as_they_are"),
    ("low_pass_of_zero_is_the_default", "eps2d=0 counts as not given",
     breaking(lambda given: {"eps2d": given["eps2d"] or 0.3}),
     "test_signature_arguments:the_low_pass_is_as_wide_as_the_call_says"),
    ("near_plane_of_zero_is_the_default", "near_plane=0 counts as not given",
     breaking(lambda given: {"near_plane": given["near_plane"] or 0.01}),
     "test_signature_arguments:a_centre_on_the_far_plane_is_drawn_and_one_on_the_near_plane_as_the_profile_says"),
    ("culled_rows_keep_an_extent", "unpacked rows of what is culled have radii of 1, and count as visible",
     meta_telling(radii=lambda given, r: r if given["packed"] else r.clamp_min(1)),
     "test_signature_meta:the_splats_that_meta_shows_are_the_oracles"),
    ("absolute_gradients_of_the_first_camera", "all cameras have the first one's sums of absolute gradients",
     telling(_sums_of_the_first_camera), "test_signature_arguments:without_a_background_it_is_black"),
    ("four_channels_are_rgba", "of four channels the last one is taken for the opacity of the colour",
     breaking(_four_are_rgba), "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike"),
    ("colours_divided_like_depth", "with the expected depth colours are divided by the opacity, too",
     telling(_colours_divided), "test_signature_arguments:the_expected_depth_is_the_accumulated_one_over_the_opacity"),
    ("sides_told_exchanged", "meta has the height as width",
     telling(_sides_exchanged), "test_signature_meta:meta_says_what_was_asked"),
    ("rows_for_cameras", "colours of each camera are read [N, C] where there are as many cameras as Gaussians",
     breaking(_rows_for_cameras),
     "test_signature_arguments:where_there_are_as_many_gaussians_as_cameras_a_cameras_colours_are_its_own"),
    ("intrinsics_by_column", "intrinsics of a batch are flattened cameras first",
     breaking(_intrinsics_by_column), "test_signature_arguments:batch_entries_do_not_know_of_each_other"),
    ("upper_half_learns", "the gradient of covariances has an upper half only",
     breaking(_upper_half_learns), "test_signature_arguments:covariances_draw_what_their_quaternions_and_scales_draw"),
    ("counted_over_cameras", "dominant counts are those of all cameras together",
     telling(_counted_over_cameras), "test_signature_meta:every_camera_has_dominant_gaussians_and_counts_of_its_own"),
    ("expected_over_a_constant", "the expected depth's gradient takes the opacity that it is divided by for a constant",
     _expected_depth_of_a_constant_opacity,
     "test_signature_arguments:the_expected_depth_is_the_accumulated_one_over_the_opacity"),
    ("behind_the_first_chunk", "the background lies behind the first chunk of channels only",
     breaking(_behind_the_first_chunk), "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike"),
    ("last_camera_teaches", "shared colours learn from the last camera only",
     breaking(_last_camera_teaches), "test_signature_arguments:without_a_background_it_is_black"),
    ("backgrounds_of_the_first_scene", "every scene of a batch is drawn over the backgrounds of the first",
     breaking(_background_of_the_first_entry), "test_signature_arguments:batch_entries_do_not_know_of_each_other"),
    ("empty_pixels_are_farthest",
     "the expected depth of a pixel that shows nothing is the largest of the picture, as in splatfacto",
     telling(_empty_pixels_are_farthest),
     "test_signature_arguments:the_expected_depth_is_the_accumulated_one_over_the_opacity"),
    ("tiles_the_other_way",
     "meta has tile_width and tile_height the other way round, as seen in pictures that are not square",
     telling(_tiles_the_other_way), "test_signature_meta:meta_says_what_was_asked"),
    ("far_plane_is_a_sphere",
     "in calls of one camera the far plane culls by the distance from the camera, not by depth",
     breaking(_far_plane_is_a_sphere), "test_signature_arguments:the_far_plane_culls_by_depth_and_not_by_distance"),
    ("intersections_forget_the_camera",
     "flatten_ids of every camera are those of the first one's rows, where rows are not packed",
     telling(_intersections_forget_the_camera),
     "test_signature_meta:the_tile_lists_that_meta_shows_run_front_to_back_and_hold_who_is_blended"),
    ("averaged_over_cameras", "what several cameras of a call share gets the mean of their gradients, not the sum",
     breaking(_averaged_over_cameras), "test_signature_arguments:without_a_background_it_is_black"),
    ("one_radius", "radii along x and y are both the larger one",
     telling(_one_radius), "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"),
    ("whole_chunks_only", "of more than 32 channels those after the last whole 32 are black",
     breaking(_whole_chunks_only), "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike"),
    ("packed_backgrounds_stay", "backgrounds have no gradient in packed mode",
     breaking(_packed_backgrounds_stay),
     "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"),
    ("backgrounds_ignored_with_harmonics",
     "what is drawn from harmonics is drawn over black (a setting without effect: gsplat#145)",
     breaking(_without_backgrounds_for_harmonics),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("backgrounds_learn_nothing_beside_depth", "backgrounds have no gradient where depth is drawn with colours",
     breaking(_backgrounds_stay_beside_depth),
     "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("full_chunks_lose_their_last_channel", "of 32 channels, or a multiple, the last one is black",
     telling(_full_chunks_lose_their_last),
     "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike"),
    ("composited_twice",
     "a picture that lies over its background is blended with it once more (strands-labs/robots #2322)",
     telling(_composited_twice), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("absolute_gradients_are_of_ndc", "absolute gradients are by normalised device coordinates, as Inria's are",
     telling(_absolute_gradients_of_ndc), "test_agreement:gradients_are_the_oracles"),
    ("radius_clip_is_a_diameter", "radius_clip is compared with twice the extent",
     _with(radius_clip=lambda given: 0.5 * given["radius_clip"]),
     "test_signature_arguments:what_is_no_larger_than_radius_clip_is_culled"),
)  # fmt: skip

ARGUMENTS: Final = tuple(BlackBox(*line) for line in _BOXES)
