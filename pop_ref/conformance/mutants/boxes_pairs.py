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
    accumulated_mode,
    all_bands,
    always,
    antialiased,
    backwards,
    batched,
    behind,
    both,
    counts_of_all_cameras,
    covars,
    deep,
    depth_beside_colors,
    drawn,
    expected_depth,
    failing,
    failing_after,
    far_plane_is_a_sphere,
    first_channels,
    first_colors,
    harmonic,
    hidden,
    import_torch,
    in_camera,
    last_channel,
    mean_of_cameras,
    of_first_camera,
    of_first_entry,
    own_colors,
    packed,
    plain,
    pulled,
    several,
    then,
    tile_numbers,
    told,
    when,
)

# laws by which many of these die
_PAIR: Final = "test_signature_pairs:every_pair_of_arguments_"
_IMAGES: Final = _PAIR + "draws_what_the_oracle_draws"
_GRADIENTS: Final = _PAIR + "has_the_oracles_gradients"
_SPLATS: Final = _PAIR + "shows_the_oracles_splats"
_DOMINANT: Final = _PAIR + "tells_the_dominant_gaussians_of_every_camera"
_LISTS: Final = _PAIR + "lists_tiles_front_to_back"
_TAKEN: Final = "test_signature_pairs:arguments_that_are_taken_alone_are_taken_together"


def _first_told(name: str, trailing: int) -> Callable[[Given, Any], Any]:
    return lambda given, meta: meta[name].narrow(-trailing - 1, 0, 1).expand_as(meta[name])


def _higher_bands_of_the_first(given: Given) -> Any:
    return import_torch().cat((given["colors"][..., :4, :], first_colors(given)[..., 4:, :]), -2)


def _depths_in_the_first(given: Given) -> Any:
    return in_camera(given["means"], given["viewmats"]).detach()[..., 0, :, 2]


def _seen_by_the_first(given: Given) -> Any:
    return _depths_in_the_first(given) >= given["near_plane"]


def _rows_by_number(given: Given) -> Any:
    """Return colours picked by the number of a row among those before the camera, not by its Gaussian."""
    number = (_depths_in_the_first(given) > given["near_plane"]).long().cumsum(-1).sub(1).clamp_min(0)
    return given["colors"].gather(-2, number[..., None].expand_as(given["colors"]))


def _depths_of_the_first(given: Given) -> Any:
    depths = in_camera(given["means"], given["viewmats"])[..., 2:]
    return depths[..., :1, :, :].expand_as(depths)


def _clipped_along(axes: Callable[[Any], Any]) -> Breaks:
    """Clip by a rule of one's own: `axes` says of [..., C, N, 2] small extents what is culled; by all cameras alike."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        if given["radius_clip"] <= 0.0 or several(given):
            return sound(**given)
        with import_torch().no_grad():
            radii = sound(**given | {"radius_clip": 0.0, "packed": False})[2]["radii"]
        gone = axes(radii <= given["radius_clip"]).squeeze(-2)
        return sound(**given | {"radius_clip": 0.0, "opacities": given["opacities"] * ~gone})

    return breaks


def _last_camera_alone(given: Given, images: Any, alphas: Any, meta: Any) -> Any:
    parts = [import_torch().cat((x[..., :-1, :, :, :].detach(), x[..., -1:, :, :, :]), -4) for x in (images, alphas)]
    return *parts, meta


def _divided_by_the_first(given: Given, depth: Any, alphas: Any) -> Any:
    a = alphas.clamp_min(1e-10)
    return depth * a / a[..., :1, :, :, :]


def _repeated(given: Given) -> Any:
    colors = given["colors"]
    return import_torch().cat((colors[..., :32], colors[..., : colors.shape[-1] - 32]), -1)


def _dense_camera_ids(given: Given, meta: Any) -> Any:
    return meta["camera_ids"].unique(return_inverse=True)[1].to(meta["camera_ids"].dtype)


def _opacities_as_given(given: Given, meta: Any) -> Any:
    return given["opacities"].detach()[..., None, :].expand_as(meta["opacities"])


def _mirrored(given: Given) -> Any:
    Ks = given["Ks"].clone()
    Ks[..., 1:, 0, 2] = given["width"] - Ks[..., 1:, 0, 2]
    return Ks


def _all_to_the_first(given: Given, v: Any) -> Any:
    return import_torch().cat((v.sum(-3, keepdim=True), import_torch().zeros_like(v[..., 1:, :, :])), -3)


def _one_camera_is_empty(given: Given, alphas: Any, meta: Any) -> bool:
    empty = alphas.flatten(-3).amax(-1) == 0.0
    return several(given) and bool(empty.any()) and not bool(empty.all())


def _packed_screen_gradients_of_the_first_camera(sound: Rasterization, given: Given) -> Any:
    if not (packed(given) and several(given)):
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


def _gradients_of_the_usual_low_pass(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if given["eps2d"] == 0.3:
        return images, alphas, meta
    usual, usual_alphas, _ = sound(**given | {"eps2d": 0.3})
    # the values of the one, the graph of the other
    return usual + (images - usual).detach(), usual_alphas + (alphas - usual_alphas).detach(), meta


# arguments of which every entry of a batch is given the first one's, as stories call them
_OF_ENTRIES: Final = {"viewmats": "viewmats", "Ks": "Ks", "backgrounds": "backgrounds", "opacities": "opacities",
                      "colors": "colors", "covars": "covariances"}  # fmt: skip

_BOXES: Final[tuple[tuple[Any, ...], ...]] = (
    ("viewmats_of_the_first_camera", "all cameras of a call see from the first one's place",
     when(several, viewmats=of_first_camera("viewmats", 2)), _IMAGES),
    ("backgrounds_of_the_first_camera", "all cameras have the first one's background",
     when(several, backgrounds=of_first_camera("backgrounds", 1)), _IMAGES),
    ("cameras_backwards_from_three_on", "from three cameras on, images come out in reverse order",
     then(lambda g: g["viewmats"].shape[-3] > 2, lambda g, i, a, m: (i.flip(-4), a.flip(-4), m)), _IMAGES),
    ("alphas_of_the_first_camera", "every camera has the first one's alphas",
     then(several, lambda g, i, a, m: (i, a.narrow(-4, 0, 1).expand_as(a), m)), _IMAGES),
    ("gradients_of_the_last_camera_alone", "the backward pass reads one camera's picture for all of them (gsplat#623)",
     then(several, _last_camera_alone), _GRADIENTS),
    ("view_gradients_summed_over_cameras", "every view matrix gets the sum of all cameras' gradients",
     pulled(several, lambda g, v: v.sum(-3, keepdim=True).expand_as(v), "viewmats"), _GRADIENTS),
    ("background_gradients_summed_over_cameras", "every background gets the sum of all cameras' gradients",
     pulled(several, lambda g, v: v.sum(-2, keepdim=True).expand_as(v), "backgrounds"), _GRADIENTS),
    ("gradients_averaged_over_cameras", "gradients of what cameras share are their mean",
     pulled(several, mean_of_cameras, "means"), _GRADIENTS),
    ("opacity_gradients_averaged_over_cameras", "opacities learn from the mean over cameras",
     pulled(several, mean_of_cameras, "opacities"), _GRADIENTS),
    ("color_gradients_summed_over_cameras", "colours of each camera get the gradients of all",
     pulled(both(several, own_colors), lambda g, v: v.sum(-3 if plain(g) else -4, keepdim=True).expand_as(v), "colors"),
     _GRADIENTS),
    ("radii_of_the_first_camera", "meta shows the first camera's extents for all",
     told(lambda g: several(g) and not packed(g), radii=_first_told("radii", 2)), _SPLATS),
    ("depths_of_the_first_camera", "meta shows the first camera's depths for all",
     told(lambda g: several(g) and not packed(g), depths=_first_told("depths", 1)), _SPLATS),
    ("conics_of_the_first_camera", "meta shows the first camera's conics for all",
     told(lambda g: several(g) and not packed(g), conics=_first_told("conics", 2)), _SPLATS),
    ("dominant_counts_of_the_first_camera", "every camera has the first one's counts: what POP trains by",
     told(several, dominant_counts=_first_told("dominant_counts", 1)), _DOMINANT),
    ("dominant_ids_of_the_first_camera", "every camera has the first one's dominant Gaussians",
     told(several, dominant_ids=_first_told("dominant_ids", 2)), _DOMINANT),
    ("dominant_counts_of_all_cameras", "every camera has the counts of all of them together",
     told(several, dominant_counts=counts_of_all_cameras), _DOMINANT),
    ("blended_counts_of_the_first_camera", "every camera has the first one's numbers of blended splats",
     told(several, n_contrib=_first_told("n_contrib", 2)), _DOMINANT),
    ("transmittance_of_the_first_camera", "every camera has the first one's remaining transmittance",
     told(several, final_T=_first_told("final_T", 2)), _DOMINANT),
    ("cameras_by_a_mirrored_principal_point", "from the second camera on, cx is taken from the right",
     when(several, Ks=_mirrored), _IMAGES),
    *((f"{told}_of_the_first_entry", f"every batch entry has the first one's {told}",
       when(batched, **{name: of_first_entry(name)}), _IMAGES) for name, told in _OF_ENTRIES.items()),
    ("entries_exchanged_where_packed", "packed images of batch entries come out in reverse order",
     then(both(batched, packed), lambda g, i, a, m: (*(x.flip(g["means"].dim() - 3) for x in (i, a)), m)), _IMAGES),
    ("entries_exchanged_under_two_dimensions", "with two batch dimensions the inner one runs backwards",
     then(lambda g: g["means"].dim() > 3, lambda g, i, a, m: (i.flip(1), a.flip(1), m)), _IMAGES),
    ("all_rows_of_the_first_entry", "batch_ids of packed rows are 0",
     told(both(batched, packed), batch_ids=lambda g, m: m["batch_ids"] * 0), _SPLATS),
    ("batches_counted_along_one_dimension", "n_batches is the length of the first batch dimension",
     told(lambda g: g["means"].dim() > 3, n_batches=lambda g, m: g["means"].shape[0]), _LISTS),
    ("gradients_summed_over_entries", "the sum over rows runs across the border of batch entries (gsplat PR#1059)",
     pulled(batched, lambda g, v: v.sum(v.dim() - 3, keepdim=True).expand_as(v), "means"), _GRADIENTS),
    ("depth_of_the_first_entry", "under a depth mode every batch entry stands where the first does",
     when(both(batched, deep), means=of_first_entry("means")), _IMAGES),
    ("packed_cameras_are_one", "camera_ids of packed rows are 0",
     told(both(packed, several), camera_ids=lambda g, m: m["camera_ids"] * 0), _SPLATS),
    ("packed_cameras_are_rows", "n_cameras of packed rows is their number",
     told(packed, n_cameras=lambda g, m: len(m["gaussian_ids"])), _LISTS),
    ("packed_cameras_are_those_that_see", "n_cameras is one more than the last camera that sees something",
     told(packed, n_cameras=lambda g, m: int(m["camera_ids"].max()) + 1), _LISTS),
    ("packed_cameras_without_the_blind", "camera_ids leave out cameras that see nothing",
     told(packed, camera_ids=_dense_camera_ids), _SPLATS),
    ("packed_colors_of_the_first_camera", "packed rows have the first camera's colours (as gsplat PR#742 mends)",
     when(packed, colors=first_colors), _IMAGES),
    ("packed_colors_by_row", "plain colours of packed rows are picked by the row's number (index of a compacted array)",
     when(lambda g: packed(g) and plain(g) and not own_colors(g), colors=_rows_by_number), _IMAGES),
    ("packed_without_backgrounds", "packed rows are drawn over black", when(packed, backgrounds=None), _IMAGES),
    ("packed_fails_with_backgrounds", "packed calls assert a background for each row (gsplat#764, gsplat#826)",
     failing(both(packed, behind), "backgrounds.shape == (nnz, 3)", AssertionError), _TAKEN),
    ("packed_is_classic", "antialiasing is left out of packed rows", when(packed, rasterize_mode="classic"), _IMAGES),
    ("packed_covariances_are_diagonal", "packed rows lose covariances off the diagonal",
     when(both(packed, covars), covars=lambda g: g["covars"] * g["covars"].new_ones(3).diag()), _IMAGES),
    ("packed_without_radius_clip", "radius_clip is not handed to the packed projection",
     when(packed, radius_clip=0.0), _IMAGES),
    ("packed_near_plane_is_fixed", "the near plane is not handed to the packed projection",
     when(packed, near_plane=0.01), _IMAGES),
    ("packed_far_plane_is_fixed", "the far plane is not handed to the packed projection",
     when(packed, far_plane=1e10), _IMAGES),
    ("packed_low_pass_is_fixed", "eps2d is not handed to the packed projection", when(packed, eps2d=0.3), _IMAGES),
    ("packed_depth_is_not_divided", "expected depths of packed rows are accumulated ones (strands-labs/robots PR#2332)",
     when(packed, render_mode=accumulated_mode), _IMAGES),
    ("packed_blind_cameras_are_black", "a camera that sees no packed row is left black, without its background",
     drawn(packed, lambda g, i, a: i * (a.detach().amax((-1, -2, -3), keepdim=True) > 0.0)), _IMAGES),
    ("packed_rows_of_the_first_camera", "a Gaussian behind the first camera has no packed row of any",
     hidden(both(packed, several), _seen_by_the_first), _IMAGES),
    ("packed_lists_hold_gaussians", "flatten_ids of packed rows are Gaussians, not rows",
     told(packed, flatten_ids=lambda g, m: m["gaussian_ids"][m["flatten_ids"].long()]), _LISTS),
    ("packed_view_gradients_are_of_one_camera", "packed rows give all their gradient to the first view matrix",
     pulled(both(packed, several), _all_to_the_first, "viewmats"), _GRADIENTS),
    ("packed_color_gradients_are_averaged", "colours that cameras share get the mean of packed rows",
     pulled(both(packed, several), mean_of_cameras, "colors"), _GRADIENTS),
    ("packed_uses_all_bands", "packed rows ignore sh_degree",
     when(both(packed, harmonic), sh_degree=all_bands), _IMAGES),
    ("packed_dominant_counts_are_of_the_first_camera", "counts of packed rows are the first camera's",
     told(both(packed, several), dominant_counts=_first_told("dominant_counts", 1)), _DOMINANT),
    ("radius_clip_by_width", "radius_clip looks at the extent along x alone",
     _clipped_along(lambda small: small[..., 0]), _IMAGES),
    ("radius_clip_by_either", "radius_clip culls Gaussians that are small along one axis",
     _clipped_along(lambda small: small.any(-1)), _IMAGES),
    ("radius_clip_ignored_with_covariances", "radius_clip is lost where covariances are given",
     when(covars, radius_clip=0.0), _IMAGES),
    ("radius_clip_ignored_by_cameras", "radius_clip is lost where there are several cameras",
     when(several, radius_clip=0.0), _IMAGES),
    ("antialiasing_ignored_with_covariances", "covariances are drawn as classic",
     when(covars, rasterize_mode="classic"), _IMAGES),
    ("antialiasing_ignored_with_depth", "depth modes are drawn as classic",
     when(deep, rasterize_mode="classic"), _IMAGES),
    ("antialiasing_ignored_in_batches", "batches are drawn as classic",
     when(batched, rasterize_mode="classic"), _IMAGES),
    ("antialiasing_ignored_by_cameras", "several cameras are drawn as classic",
     when(several, rasterize_mode="classic"), _IMAGES),
    ("antialiasing_has_its_own_low_pass", "antialiasing takes the low-pass of 0.3 px^2, whatever the call says",
     when(antialiased, eps2d=0.3), _IMAGES),
    ("near_plane_of_the_first_camera", "the first camera's depth decides for all what is before the near plane",
     hidden(several, _seen_by_the_first), _IMAGES),
    ("near_plane_ignored_with_depth", "depth modes have a near plane of their own",
     when(deep, near_plane=0.01), _IMAGES),
    ("far_plane_ignored_by_cameras", "the far plane is lost where there are several cameras",
     when(several, far_plane=1e10), _IMAGES),
    ("planes_ignored_with_covariances", "planes are lost where covariances are given",
     when(covars, near_plane=0.01, far_plane=1e10), _IMAGES),
    ("low_pass_ignored_in_batches", "eps2d is lost in batches", when(batched, eps2d=0.3), _IMAGES),
    ("all_bands_by_cameras", "several cameras ignore sh_degree",
     when(both(several, harmonic), sh_degree=all_bands), _IMAGES),
    ("higher_bands_of_the_first_camera", "of each camera's harmonics, those from degree 2 on are the first one's",
     when(lambda g: own_colors(g) and harmonic(g) and g["colors"].shape[-2] > 4, colors=_higher_bands_of_the_first),
     _IMAGES),
    ("background_behind_depth", "behind the depth stands the background's last channel",
     last_channel(both(behind, depth_beside_colors),
                  lambda g, d, a: d + g["backgrounds"][..., None, None, -1:] * (1.0 - a)), _IMAGES),
    ("depth_before_plain_colors", "depth is the first channel where colours are plain",
     drawn(both(plain, depth_beside_colors), lambda g, i, a: i.roll(1, -1)), _IMAGES),
    ("expected_depth_by_the_first_alphas", "expected depths of all cameras are divided by the first one's opacity",
     last_channel(both(several, expected_depth), _divided_by_the_first), _IMAGES),
    ("tiles_numbered_in_a_byte", "with several cameras the latter tiles stay empty, as an index runs over (gsplat#806)",
     drawn(several, lambda g, i, a: i * (tile_numbers(g) < 256)), _IMAGES),
    ("tiles_told_are_of_16", "meta says 16 px for every side of a tile",
     told(always, tile_size=lambda g, m: 16), _LISTS),
    ("plain_colors_not_negative", "plain colours are clamped at 0, as those of harmonics",
     when(plain, colors=lambda g: g["colors"].clamp_min(0.0)), _IMAGES),
    ("plain_colors_in_a_byte", "plain colours are clamped to [0, 1]",
     when(plain, colors=lambda g: g["colors"].clamp(0.0, 1.0)), _IMAGES),
    ("images_not_negative", "images are clamped at 0", drawn(always, lambda g, i, a: i.clamp_min(0.0)), _IMAGES),
    ("thirty_two_channels", "channels from the 33rd on stay empty: 2^n + 1 are not provided for (gsplat PR#218)",
     drawn(lambda g: g["colors"].shape[-1] > 32, lambda g, i, a: first_channels(i, 32)), _IMAGES),
    ("chunks_repeat", "channels from the 33rd on are those from the first on again",
     when(lambda g: plain(g) and g["colors"].shape[-1] > 32, colors=_repeated), _IMAGES),
    ("backgrounds_of_three_channels", "a background has three channels, those after are 0",
     when(lambda g: behind(g) and g["backgrounds"].shape[-1] > 3,
          backgrounds=lambda g: first_channels(g["backgrounds"], 3)), _IMAGES),
    ("gradients_of_three_channels", "channels after the third have no gradient (graphdeco#622: three are compiled in)",
     pulled(lambda g: plain(g) and g["colors"].shape[-1] > 3, lambda g, v: first_channels(v, 3), "colors"), _GRADIENTS),
    ("one_channel_without_background", "a picture of one channel is drawn over black",
     when(lambda g: g["colors"].shape[-1] == 1, backgrounds=None), _IMAGES),
    ("opacities_told_as_given",
     "meta has opacities before antialiasing, and what draws by them is too opaque (nerfstudio PR#2966)",
     told(lambda g: antialiased(g) and not packed(g), opacities=_opacities_as_given), _SPLATS),
    ("one_entry_has_no_axis", "a batch of one loses its dimension (batches of gsplat, PR#695)",
     then(lambda g: g["means"].dim() == 3 and len(g["means"]) == 1, lambda g, i, a, m: (i.squeeze(0), a.squeeze(0), m)),
     _TAKEN),
    ("first_chunk_learns", "channels after the thirty-second have no gradient",
     drawn(always, lambda g, i, a: import_torch().cat((i[..., :32], i[..., 32:].detach()), -1)), _GRADIENTS),
    ("far_by_distance", "the far plane is a sphere", far_plane_is_a_sphere, _GRADIENTS),
    ("all_bands", "sh_degree is what the harmonics have, not what is asked for",
     when(harmonic, sh_degree=all_bands), _IMAGES),
    ("alphas_snap_to_one", "alpha over 0.99 is told as 1",
     then(always, lambda g, i, a, m: (i, import_torch().where(a > 0.99, a + (1.0 - a).detach(), a), m)), _IMAGES),
    ("low_pass_ignored_with_covariances", "eps2d is lost where covariances are given",
     when(covars, eps2d=0.3), _IMAGES),
    ("cameras_told_are_images", "n_cameras of a batch is the number of all its images",
     told(always, n_cameras=lambda g, m: g["viewmats"][..., 0, 0].numel()), _LISTS),
    ("factor_of_the_default", "antialiased mode has the default low-pass, whatever eps2d says",
     when(antialiased, eps2d=0.3), _IMAGES),
    ("blind_cameras_have_no_number",
     "in packed mode a camera that sees nothing is not counted, and those after it have a number too low",
     told(packed, camera_ids=_dense_camera_ids), _GRADIENTS),
    ("batch_ids_count_images", "batch_ids of packed rows number images, not scenes",
     told(packed, batch_ids=lambda g, m: m["batch_ids"] * g["viewmats"].shape[-3] + m["camera_ids"]),
     "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"),
    ("depth_lost_behind_a_full_chunk", "with 32 channels of colour, or a multiple, the depth is 0",
     last_channel(lambda g: depth_beside_colors(g) and plain(g) and g["colors"].shape[-1] % 32 == 0,
                  lambda g, d, a: 0.0 * d), "test_signature_arguments:depth_follows_plain_colours_of_several_cameras"),
    ("one_empty_camera_fails", "a call fails where one of several cameras sees nothing",
     failing_after(_one_camera_is_empty, "cumsum of no intersections"), _TAKEN),
    ("packed_screen_gradients_of_the_first_camera",
     "in packed mode the gradient of screen centres is kept for the first camera's rows alone",
     _packed_screen_gradients_of_the_first_camera,
     "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"),
    ("batch_axes_transposed", "of two batch axes the pictures have the second one first",
     then(lambda g: g["means"].dim() > 3,
          lambda g, i, a, m: (*(x.transpose(0, 1).reshape(x.shape) for x in (i, a)), m)),
     "test_signature_arguments:batch_entries_do_not_know_of_each_other"),
    ("packed_depths_of_the_first_camera", "in packed mode all cameras show the first one's depths",
     when(lambda g: packed(g) and several(g) and g["render_mode"] == "D", colors=_depths_of_the_first, sh_degree=None,
          render_mode="RGB", backgrounds=None), _IMAGES),
    ("gradients_of_the_usual_low_pass",
     "the way back has the low-pass written into it, whatever eps2d says (diff-gaussian-rasterization's backward)",
     _gradients_of_the_usual_low_pass, "test_signature_arguments:the_low_pass_is_as_wide_as_the_call_says"),
)  # fmt: skip

PAIRS: Final = tuple(BlackBox(*line) for line in _BOXES)
