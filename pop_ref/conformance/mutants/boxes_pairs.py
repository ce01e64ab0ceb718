"""Black boxes in which two arguments, several cameras, batches, packed rows or channels are mixed up.

Each draws a single view with every argument at its default rightly. The stories name where such an error happened,
where that is known.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

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
    own_colors,
    plain,
    several,
    telling,
)


def _packed(given: Given) -> bool:
    return bool(given["packed"])


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
    return not plain(given) and (given["sh_degree"] + 1) ** 2 < given["colors"].shape[-2]


def _both(*conditions: Callable[[Given], bool]) -> Callable[[Given], bool]:
    return lambda given: all(condition(given) for condition in conditions)


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
        if condition(given) and value is not None:
            given = given | {name: backwards(value, lambda grad: change(given, grad))}
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
    return _of_first("colors", 2 if plain(given) else 3)(given)


def _higher_bands_of_the_first(given: Given) -> Any:
    sh = given["colors"]
    return import_torch().cat((sh[..., :4, :], _first_colors(given)[..., 4:, :]), -2)


def _culled_by_the_first(given: Given) -> Any:
    """Return opacities of 0 for Gaussians behind the first camera or before its near plane."""
    viewmat, means = given["viewmats"][..., 0, :, :], given["means"]
    depths = (means * viewmat[..., None, 2, :3]).sum(-1) + viewmat[..., 2, 3, None]
    return given["opacities"] * (depths.detach() >= given["near_plane"])


def _clipped_along(axes: Callable[[Any], Any]) -> Breaks:
    """Clip by a rule of one's own: `axes` says of [..., C, N, 2] small extents what is culled; by all cameras alike."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        if not _clipped(given) or several(given):
            return sound(**given)
        with import_torch().no_grad():
            radii = sound(**given | {"radius_clip": 0.0, "packed": False})[2]["radii"]
        gone = axes(radii <= given["radius_clip"]).squeeze(-2)
        return sound(**given | {"radius_clip": 0.0, "opacities": given["opacities"] * ~gone})

    return breaks


def _images_of(change: Callable[[Given, Any, Any], Any]) -> Callable[..., Any]:
    return lambda given, images, alphas, meta: (change(given, images, alphas), alphas, meta)


def _last_camera_alone(given: Given, images: Any, alphas: Any, meta: Any) -> Any:
    parts = [
        import_torch().cat((each[..., :-1, :, :, :].detach(), each[..., -1:, :, :, :]), -4) for each in (images, alphas)
    ]
    return *parts, meta


def _black_where_nothing_is_seen(given: Given, images: Any, alphas: Any) -> Any:
    seen = alphas.detach().amax((-1, -2, -3), keepdim=True) > 0.0
    return images * seen


def _depth_before_colors(given: Given, images: Any, alphas: Any) -> Any:
    return images.roll(1, -1)


def _background_behind_depth(given: Given, images: Any, alphas: Any) -> Any:
    last = given["backgrounds"][..., None, None, -1:] * (1.0 - alphas)
    return import_torch().cat((images[..., :-1], images[..., -1:] + last), -1)


def _divided_by_the_first(given: Given, images: Any, alphas: Any) -> Any:
    a = alphas.clamp_min(1e-10)
    return import_torch().cat((images[..., :-1], images[..., -1:] * a / a[..., :1, :, :, :]), -1)


def _tiles_in_a_byte(given: Given, images: Any, alphas: Any) -> Any:
    side, (H, W) = given["tile_size"], images.shape[-3:-1]
    tiles_x = -(-W // side)
    like = images.new_tensor
    tile = like(range(H)).div(side).floor()[:, None] * tiles_x + like(range(W)).div(side).floor()[None]
    return images * (tile < 256)[..., None]


def _cut(images: Any, count: int) -> Any:
    return import_torch().cat((images[..., :count], import_torch().zeros_like(images[..., count:])), -1)


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
    return import_torch().cat((total, import_torch().zeros_like(v[..., 1:, :, :])), -3)


def _repeated(colors: Any) -> Any:
    return import_torch().cat((colors[..., :32], colors[..., : colors.shape[-1] - 32]), -1)


def _asserting(sound: Rasterization, given: Given) -> Any:
    assert not (_packed(given) and _behind(given)), "backgrounds.shape == (nnz, 3)"
    return sound(**given)


def _opacities_told_as_given(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if given["rasterize_mode"] == "antialiased" and not given["packed"]:
        meta["opacities"] = given["opacities"].detach()[..., None, :].expand_as(meta["opacities"])
    return images, alphas, meta


def _one_entry_has_no_axis(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if given["means"].dim() == 3 and len(given["means"]) == 1:
        return images.squeeze(0), alphas.squeeze(0), meta
    return images, alphas, meta


def _first_chunk_learns(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    return import_torch().cat((images[..., :32], images[..., 32:].detach()), -1), alphas, meta


def _far_by_distance(given: Given) -> Given:
    if given["viewmats"].shape[-3] > 1:
        return {}
    near_enough = in_camera(given["means"], given["viewmats"]).norm(dim=-1).squeeze(-2).detach() < given["far_plane"]
    return {"opacities": given["opacities"] * near_enough}


def _all_bands(given: Given) -> Given:
    if given["sh_degree"] is None:
        return {}
    return {"sh_degree": round(given["colors"].shape[-2] ** 0.5) - 1}


def _alphas_snap(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    return images, import_torch().where(alphas > 0.99, alphas + (1.0 - alphas).detach(), alphas), meta


def _all_are_cameras(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    meta["n_cameras"] = given["viewmats"][..., 0, 0].numel()
    return images, alphas, meta


def _factor_of_the_default(given: Given) -> Given:
    return {"eps2d": 0.3} if given["rasterize_mode"] == "antialiased" else {}


def _blind_cameras_have_no_number(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if given["packed"]:
        ids = meta["camera_ids"]
        meta["camera_ids"] = import_torch().unique(ids, return_inverse=True)[1].to(ids.dtype)
    return images, alphas, meta


def _batch_ids_count_images(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if _packed(given):
        meta["batch_ids"] = meta["batch_ids"] * given["viewmats"].shape[-3] + meta["camera_ids"]
    return images, alphas, meta


def _depth_lost_behind_a_full_chunk(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    full = given["render_mode"].startswith("RGB+") and plain(given) and given["colors"].shape[-1] % 32 == 0
    if full:
        torch = import_torch()
        images = torch.cat((images[..., :-1], 0.0 * images[..., -1:]), -1)
    return images, alphas, meta


def _one_empty_camera_fails(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    empty = alphas.detach().flatten(-3).amax(-1) == 0.0
    if several(given) and bool(empty.any()) and not bool(empty.all()):
        raise RuntimeError("cumsum of no intersections")
    return images, alphas, meta


def _packed_screen_gradients_of_the_first_camera(sound: Rasterization, given: Given) -> Any:
    if not (_packed(given) and several(given)):
        return sound(**given)
    told: dict[str, Any] = {}

    def first_alone(v: Any) -> Any:
        # by now that of the screen centres is known
        grad = told["meta"]["means2d"].grad
        if grad is not None:
            grad[told["meta"]["camera_ids"] > 0] = 0.0
        return v

    images, alphas, told["meta"] = sound(**given | {"means": backwards(given["means"], first_alone)})
    return images, alphas, told["meta"]


def _batch_axes_transposed(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if given["means"].dim() < 4:
        return images, alphas, meta
    return images.transpose(0, 1).reshape(images.shape), alphas.transpose(0, 1).reshape(alphas.shape), meta


def _packed_depths_of_the_first_camera(sound: Rasterization, given: Given) -> Any:
    if not (_packed(given) and several(given) and given["render_mode"] == "D"):
        return sound(**given)
    depths = in_camera(given["means"], given["viewmats"])[..., 2:]
    first = depths[..., :1, :, :].expand_as(depths)
    return sound(**given | {"colors": first, "sh_degree": None, "render_mode": "RGB", "backgrounds": None})


def _gradients_of_the_usual_low_pass(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if given["eps2d"] == 0.3:
        return images, alphas, meta
    usual, usual_alphas, _ = sound(**given | {"eps2d": 0.3})
    # the values of the one, the graph of the other
    return usual + (images - usual).detach(), usual_alphas + (alphas - usual_alphas).detach(), meta


_BOXES: Final[tuple[tuple[Any, ...], ...]] = (
    ("viewmats_of_the_first_camera", "all cameras of a call see from the first one's place",
     _if(several, viewmats=_of_first("viewmats", 2)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("backgrounds_of_the_first_camera", "all cameras have the first one's background",
     _if(_both(several, _behind), backgrounds=_of_first("backgrounds", 1)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("cameras_backwards_from_three_on", "from three cameras on, images come out in reverse order",
     _then(lambda g: g["viewmats"].shape[-3] > 2, lambda g, i, a, m: (i.flip(-4), a.flip(-4), m)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("alphas_of_the_first_camera", "every camera has the first one's alphas",
     _then(several, lambda g, i, a, m: (i, a.narrow(-4, 0, 1).expand_as(a), m)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("gradients_of_the_last_camera_alone", "the backward pass reads one camera's picture for all of them (gsplat#623)",
     _then(several, _last_camera_alone), "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("view_gradients_summed_over_cameras", "every view matrix gets the sum of all cameras' gradients",
     _pulled(several, "viewmats", lambda g, v: v.sum(-3, keepdim=True).expand_as(v)),
     "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("background_gradients_summed_over_cameras", "every background gets the sum of all cameras' gradients",
     _pulled(several, "backgrounds", lambda g, v: v.sum(-2, keepdim=True).expand_as(v)),
     "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("gradients_averaged_over_cameras", "gradients of what cameras share are their mean",
     _pulled(several, "means", lambda g, v: v / g["viewmats"].shape[-3]),
     "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("opacity_gradients_averaged_over_cameras", "opacities learn from the mean over cameras",
     _pulled(several, "opacities", lambda g, v: v / g["viewmats"].shape[-3]),
     "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("color_gradients_summed_over_cameras", "colours of each camera get the gradients of all",
     _pulled(_both(several, own_colors), "colors",
             lambda g, v: v.sum(-3 if plain(g) else -4, keepdim=True).expand_as(v)),
     "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("radii_of_the_first_camera", "meta shows the first camera's extents for all",
     _told(lambda g: several(g) and not _packed(g), radii=_first_told("radii", 2)),
     "test_signature_pairs:every_pair_of_arguments_shows_the_oracles_splats"),
    ("depths_of_the_first_camera", "meta shows the first camera's depths for all",
     _told(lambda g: several(g) and not _packed(g), depths=_first_told("depths", 1)),
     "test_signature_pairs:every_pair_of_arguments_shows_the_oracles_splats"),
    ("conics_of_the_first_camera", "meta shows the first camera's conics for all",
     _told(lambda g: several(g) and not _packed(g), conics=_first_told("conics", 2)),
     "test_signature_pairs:every_pair_of_arguments_shows_the_oracles_splats"),
    ("dominant_counts_of_the_first_camera", "every camera has the first one's counts: what POP trains by",
     _told(several, dominant_counts=_first_told("dominant_counts", 1)),
     "test_signature_pairs:every_pair_of_arguments_tells_the_dominant_gaussians_of_every_camera"),
    ("dominant_ids_of_the_first_camera", "every camera has the first one's dominant Gaussians",
     _told(several, dominant_ids=_first_told("dominant_ids", 2)),
     "test_signature_pairs:every_pair_of_arguments_tells_the_dominant_gaussians_of_every_camera"),
    ("dominant_counts_of_all_cameras", "every camera has the counts of all of them together",
     _told(several, dominant_counts=_summed_counts),
     "test_signature_pairs:every_pair_of_arguments_tells_the_dominant_gaussians_of_every_camera"),
    ("blended_counts_of_the_first_camera", "every camera has the first one's numbers of blended splats",
     _told(several, n_contrib=_first_told("n_contrib", 2)),
     "test_signature_pairs:every_pair_of_arguments_tells_the_dominant_gaussians_of_every_camera"),
    ("transmittance_of_the_first_camera", "every camera has the first one's remaining transmittance",
     _told(several, final_T=_first_told("final_T", 2)),
     "test_signature_pairs:every_pair_of_arguments_tells_the_dominant_gaussians_of_every_camera"),
    ("cameras_by_a_mirrored_principal_point", "from the second camera on, cx is taken from the right",
     _if(several, Ks=_mirrored), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("viewmats_of_the_first_entry", "every batch entry has the first one's viewmats",
     _if(batched, viewmats=_of_first_entry("viewmats")),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("Ks_of_the_first_entry", "every batch entry has the first one's Ks",
     _if(batched, Ks=_of_first_entry("Ks")),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("backgrounds_of_the_first_entry", "every batch entry has the first one's backgrounds",
     _if(batched, backgrounds=_of_first_entry("backgrounds")),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("opacities_of_the_first_entry", "every batch entry has the first one's opacities",
     _if(batched, opacities=_of_first_entry("opacities")),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("colors_of_the_first_entry", "every batch entry has the first one's colors",
     _if(batched, colors=_of_first_entry("colors")),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("covariances_of_the_first_entry", "every batch entry has the first one's covariances",
     _if(_both(batched, _covars), covars=_of_first_entry("covars")),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("entries_exchanged_where_packed", "packed images of batch entries come out in reverse order",
     _then(_both(batched, _packed),
           lambda g, i, a, m: (i.flip(g["means"].dim() - 3), a.flip(g["means"].dim() - 3), m)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("entries_exchanged_under_two_dimensions", "with two batch dimensions the inner one runs backwards",
     _then(lambda g: g["means"].dim() > 3, lambda g, i, a, m: (i.flip(1), a.flip(1), m)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("all_rows_of_the_first_entry", "batch_ids of packed rows are 0",
     _told(_both(batched, _packed), batch_ids=lambda g, m: m["batch_ids"] * 0),
     "test_signature_pairs:every_pair_of_arguments_shows_the_oracles_splats"),
    ("batches_counted_along_one_dimension", "n_batches is the length of the first batch dimension",
     _told(lambda g: g["means"].dim() > 3, n_batches=lambda g, m: g["means"].shape[0]),
     "test_signature_pairs:every_pair_of_arguments_lists_tiles_front_to_back"),
    ("gradients_summed_over_entries", "the sum over rows runs across the border of batch entries (gsplat PR#1059)",
     _pulled(batched, "means", lambda g, v: v.sum(v.dim() - 3, keepdim=True).expand_as(v)),
     "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("depth_of_the_first_entry", "under a depth mode every batch entry stands where the first does",
     _if(_both(batched, _deep), means=_of_first_entry("means")),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_cameras_are_one", "camera_ids of packed rows are 0",
     _told(_both(_packed, several), camera_ids=lambda g, m: m["camera_ids"] * 0),
     "test_signature_pairs:every_pair_of_arguments_shows_the_oracles_splats"),
    ("packed_cameras_are_rows", "n_cameras of packed rows is their number",
     _told(_packed, n_cameras=lambda g, m: len(m["gaussian_ids"])),
     "test_signature_pairs:every_pair_of_arguments_lists_tiles_front_to_back"),
    ("packed_cameras_are_those_that_see", "n_cameras is one more than the last camera that sees something",
     _told(_packed, n_cameras=lambda g, m: int(m["camera_ids"].max()) + 1),
     "test_signature_pairs:every_pair_of_arguments_lists_tiles_front_to_back"),
    ("packed_cameras_without_the_blind", "camera_ids leave out cameras that see nothing",
     _told(_packed, camera_ids=_dense_camera_ids),
     "test_signature_pairs:every_pair_of_arguments_shows_the_oracles_splats"),
    ("packed_colors_of_the_first_camera", "packed rows have the first camera's colours (as gsplat PR#742 mends)",
     _if(_both(_packed, own_colors), colors=_first_colors),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_colors_by_row", "plain colours of packed rows are picked by the row's number (index of a compacted array)",
     _if(lambda g: _packed(g) and plain(g) and not own_colors(g), colors=_rows_by_number),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_without_backgrounds", "packed rows are drawn over black",
     _if(_packed, backgrounds=None), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_fails_with_backgrounds", "packed calls assert a background for each row (gsplat#764, gsplat#826)",
     _asserting, "test_signature_pairs:arguments_that_are_taken_alone_are_taken_together"),
    ("packed_is_classic", "antialiasing is left out of packed rows",
     _if(_packed, rasterize_mode="classic"),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_covariances_are_diagonal", "packed rows lose covariances off the diagonal",
     _if(_both(_packed, _covars), covars=lambda g: g["covars"] * g["covars"].new_ones(3).diag()),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_without_radius_clip", "radius_clip is not handed to the packed projection",
     _if(_packed, radius_clip=0.0), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_near_plane_is_fixed", "the near plane is not handed to the packed projection",
     _if(_packed, near_plane=0.01), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_far_plane_is_fixed", "the far plane is not handed to the packed projection",
     _if(_packed, far_plane=1e10), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_low_pass_is_fixed", "eps2d is not handed to the packed projection",
     _if(_packed, eps2d=0.3), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_depth_is_not_divided", "expected depths of packed rows are accumulated ones (strands-labs/robots PR#2332)",
     _if(_packed, render_mode=lambda g: g["render_mode"].replace("ED", "D")),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_blind_cameras_are_black", "a camera that sees no packed row is left black, without its background",
     _then(_packed, _images_of(_black_where_nothing_is_seen)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_rows_of_the_first_camera", "a Gaussian behind the first camera has no packed row of any",
     _if(_both(_packed, several), opacities=_culled_by_the_first),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_lists_hold_gaussians", "flatten_ids of packed rows are Gaussians, not rows",
     _told(_packed, flatten_ids=lambda g, m: m["gaussian_ids"][m["flatten_ids"].long()]),
     "test_signature_pairs:every_pair_of_arguments_lists_tiles_front_to_back"),
    ("packed_view_gradients_are_of_one_camera", "packed rows give all their gradient to the first view matrix",
     _pulled(_both(_packed, several), "viewmats", lambda g, v: _all_to_the_first(v)),
     "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("packed_color_gradients_are_averaged", "colours that cameras share get the mean of packed rows",
     _pulled(_both(_packed, several), "colors", lambda g, v: v / g["viewmats"].shape[-3]),
     "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("packed_uses_all_bands", "packed rows ignore sh_degree",
     _if(_both(_packed, _fewer_bands), sh_degree=lambda g: round(g["colors"].shape[-2] ** 0.5) - 1),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("packed_dominant_counts_are_of_the_first_camera", "counts of packed rows are the first camera's",
     _told(_both(_packed, several), dominant_counts=_first_told("dominant_counts", 1)),
     "test_signature_pairs:every_pair_of_arguments_tells_the_dominant_gaussians_of_every_camera"),
    ("radius_clip_by_width", "radius_clip looks at the extent along x alone",
     _clipped_along(lambda small: small[..., 0]),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("radius_clip_by_either", "radius_clip culls Gaussians that are small along one axis",
     _clipped_along(lambda small: small.any(-1)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("radius_clip_ignored_with_covariances", "radius_clip is lost where covariances are given",
     _if(_covars, radius_clip=0.0), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("radius_clip_ignored_by_cameras", "radius_clip is lost where there are several cameras",
     _if(several, radius_clip=0.0), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("antialiasing_ignored_with_covariances", "covariances are drawn as classic",
     _if(_covars, rasterize_mode="classic"),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("antialiasing_ignored_with_depth", "depth modes are drawn as classic",
     _if(_deep, rasterize_mode="classic"), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("antialiasing_ignored_in_batches", "batches are drawn as classic",
     _if(batched, rasterize_mode="classic"),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("antialiasing_ignored_by_cameras", "several cameras are drawn as classic",
     _if(several, rasterize_mode="classic"),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("antialiasing_has_its_own_low_pass", "antialiasing takes the low-pass of 0.3 px^2, whatever the call says",
     _if(_antialiased, eps2d=0.3), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("near_plane_of_the_first_camera", "the first camera's depth decides for all what is before the near plane",
     _if(several, opacities=_culled_by_the_first),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("near_plane_ignored_with_depth", "depth modes have a near plane of their own",
     _if(_deep, near_plane=0.01), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("far_plane_ignored_by_cameras", "the far plane is lost where there are several cameras",
     _if(several, far_plane=1e10), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("planes_ignored_with_covariances", "planes are lost where covariances are given",
     _if(_covars, near_plane=0.01, far_plane=1e10),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("low_pass_ignored_in_batches", "eps2d is lost in batches",
     _if(batched, eps2d=0.3), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("all_bands_by_cameras", "several cameras ignore sh_degree",
     _if(_both(several, _fewer_bands), sh_degree=lambda g: round(g["colors"].shape[-2] ** 0.5) - 1),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("higher_bands_of_the_first_camera", "of each camera's harmonics, those from degree 2 on are the first one's",
     _if(lambda g: own_colors(g) and not plain(g) and g["colors"].shape[-2] > 4,
         colors=_higher_bands_of_the_first),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("background_behind_depth", "behind the depth stands the background's last channel",
     _then(lambda g: _behind(g) and g["render_mode"].startswith("RGB+"), _images_of(_background_behind_depth)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("depth_before_plain_colors", "depth is the first channel where colours are plain",
     _then(lambda g: plain(g) and g["render_mode"].startswith("RGB+"), _images_of(_depth_before_colors)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("expected_depth_by_the_first_alphas", "expected depths of all cameras are divided by the first one's opacity",
     _then(lambda g: several(g) and g["render_mode"].endswith("ED"), _images_of(_divided_by_the_first)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("tiles_numbered_in_a_byte", "with several cameras the latter tiles stay empty, as an index runs over (gsplat#806)",
     _then(several, _images_of(_tiles_in_a_byte)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("tiles_told_are_of_16", "meta says 16 px for every side of a tile",
     _told(lambda g: True, tile_size=lambda g, m: 16),
     "test_signature_pairs:every_pair_of_arguments_lists_tiles_front_to_back"),
    ("plain_colors_not_negative", "plain colours are clamped at 0, as those of harmonics",
     _if(plain, colors=lambda g: g["colors"].clamp_min(0.0)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("plain_colors_in_a_byte", "plain colours are clamped to [0, 1]",
     _if(plain, colors=lambda g: g["colors"].clamp(0.0, 1.0)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("images_not_negative", "images are clamped at 0",
     _then(lambda g: True, _images_of(lambda g, i, a: i.clamp_min(0.0))),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("thirty_two_channels", "channels from the 33rd on stay empty: 2^n + 1 are not provided for (gsplat PR#218)",
     _then(lambda g: g["colors"].shape[-1] > 32, _images_of(lambda g, i, a: _cut(i, 32))),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("chunks_repeat", "channels from the 33rd on are those from the first on again",
     _if(lambda g: plain(g) and g["colors"].shape[-1] > 32, colors=lambda g: _repeated(g["colors"])),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("backgrounds_of_three_channels", "a background has three channels, those after are 0",
     _if(lambda g: _behind(g) and g["backgrounds"].shape[-1] > 3,
         backgrounds=lambda g: _cut(g["backgrounds"], 3)),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("gradients_of_three_channels", "channels after the third have no gradient (graphdeco#622: three are compiled in)",
     _pulled(lambda g: plain(g) and g["colors"].shape[-1] > 3, "colors", lambda g, v: _cut(v, 3)),
     "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("one_channel_without_background", "a picture of one channel is drawn over black",
     _if(lambda g: g["colors"].shape[-1] == 1, backgrounds=None),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("opacities_told_as_given",
     "meta has opacities before antialiasing, and what draws by them is too opaque (nerfstudio PR#2966)",
     _opacities_told_as_given, "test_signature_pairs:every_pair_of_arguments_shows_the_oracles_splats"),
    ("one_entry_has_no_axis", "a batch of one loses its dimension (batches of gsplat, PR#695)",
     _one_entry_has_no_axis, "test_signature_pairs:arguments_that_are_taken_alone_are_taken_together"),
    ("first_chunk_learns", "channels after the thirty-second have no gradient",
     telling(_first_chunk_learns), "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("far_by_distance", "the far plane is a sphere",
     breaking(_far_by_distance), "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("all_bands", "sh_degree is what the harmonics have, not what is asked for",
     breaking(_all_bands), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("alphas_snap_to_one", "alpha over 0.99 is told as 1",
     telling(_alphas_snap), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("low_pass_ignored_with_covariances", "eps2d is lost where covariances are given",
     breaking(lambda given: {} if given["covars"] is None else {"eps2d": 0.3}),
     "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("cameras_told_are_images", "n_cameras of a batch is the number of all its images",
     telling(_all_are_cameras), "test_signature_pairs:every_pair_of_arguments_lists_tiles_front_to_back"),
    ("factor_of_the_default", "antialiased mode has the default low-pass, whatever eps2d says",
     breaking(_factor_of_the_default), "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("blind_cameras_have_no_number",
     "in packed mode a camera that sees nothing is not counted, and those after it have a number too low",
     telling(_blind_cameras_have_no_number), "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients"),
    ("batch_ids_count_images", "batch_ids of packed rows number images, not scenes",
     telling(_batch_ids_count_images),
     "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"),
    ("depth_lost_behind_a_full_chunk", "with 32 channels of colour, or a multiple, the depth is 0",
     telling(_depth_lost_behind_a_full_chunk),
     "test_signature_arguments:depth_follows_plain_colours_of_several_cameras"),
    ("one_empty_camera_fails", "a call fails where one of several cameras sees nothing",
     telling(_one_empty_camera_fails), "test_signature_pairs:arguments_that_are_taken_alone_are_taken_together"),
    ("packed_screen_gradients_of_the_first_camera",
     "in packed mode the gradient of screen centres is kept for the first camera's rows alone",
     _packed_screen_gradients_of_the_first_camera,
     "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"),
    ("batch_axes_transposed", "of two batch axes the pictures have the second one first",
     telling(_batch_axes_transposed), "test_signature_arguments:batch_entries_do_not_know_of_each_other"),
    ("packed_depths_of_the_first_camera", "in packed mode all cameras show the first one's depths",
     _packed_depths_of_the_first_camera, "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"),
    ("gradients_of_the_usual_low_pass",
     "the way back has the low-pass written into it, whatever eps2d says (diff-gaussian-rasterization's backward)",
     _gradients_of_the_usual_low_pass, "test_signature_arguments:the_low_pass_is_as_wide_as_the_call_says"),
)  # fmt: skip

PAIRS: Final = tuple(BlackBox(*line) for line in _BOXES)
