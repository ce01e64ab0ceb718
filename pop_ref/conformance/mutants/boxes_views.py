"""Black boxes that draw a view wrongly in some corner, or pull it back wrongly: what laws of single views notice."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

from pop_ref.conformance.backends import function_named
from pop_ref.conformance.mutants.black_box import (
    BlackBox,
    Breaks,
    Given,
    Rasterization,
    Told,
    absolute_told,
    all_bands,
    always,
    antialiased,
    batched,
    behind,
    both,
    breaking,
    centred,
    covars,
    deep,
    detached,
    drawn,
    drawn_in_order,
    empty,
    factor_is_constant,
    failing,
    failing_after,
    flat,
    harmonic,
    hidden,
    import_torch,
    in_camera,
    no_gradient,
    numbers,
    one_view,
    own_colors,
    passing,
    pulled,
    several,
    shown,
    then,
    tile_numbers,
    told,
    when,
)
from pop_ref.constants import PAPER

# laws by which many of these die
_IMAGE: Final = "test_agreement:the_image_is_one_of_the_oracles_outcomes"
_GRADIENTS: Final = "test_agreement:gradients_are_the_oracles"
_ANTIALIASED: Final = "test_agreement:antialiased_gradients_are_the_oracles"
_SH_C0: Final = 0.28209479177387814
_MANY: Final = 4096  # Gaussians of which copies are not looked for


def _background_twice(given: Given, images: Any, alphas: Any) -> Any:
    # nothing is added but a gradient
    return images + given["backgrounds"].detach()[..., None, None, :] * (alphas.detach() - alphas)


def _copied(given: Given, meta: Any) -> Any:
    return meta["means2d"].detach().clone().requires_grad_(meta["means2d"].requires_grad)


def _screen(given: Given) -> tuple[Any, Any]:
    """Return the screen centres of single views, x and y, [..., N]."""
    seen, K = in_camera(given["means"].detach(), given["viewmats"].detach()).squeeze(-3), given["Ks"].squeeze(-3)
    return tuple(K[..., i, i, None] * seen[..., i] / seen[..., 2] + K[..., i, 2, None] for i in range(2))


def _in_a_wider_picture(given: Given) -> Any:
    x, y = _screen(given)
    u, v = x / (0.5 * given["width"]) - 1.0, y / (0.5 * given["height"]) - 1.0
    return (u.abs() <= 1.2) & (v.abs() <= 1.2)


def _inside_learn(given: Given, v: Any) -> Any:
    x, y = _screen(given)
    inside = (x >= 0.0) & (x <= given["width"]) & (y >= 0.0) & (y <= given["height"])
    return v * inside[:, None]


def _in_eight_bits(value: Any) -> Any:
    return detached(value, (value * 255.0).round() / 255.0)


def _normalized_in_place(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if given["quats"] is not None:
        given["quats"].data.div_(given["quats"].data.norm(dim=-1, keepdim=True))
    return images, alphas, meta


def _sums_pile_up() -> Breaks:
    kept: dict[Any, Any] = {}

    def breaks(sound: Rasterization, given: Given) -> Any:
        images, alphas, meta = sound(**given)
        if given["absgrad"]:
            sums = meta["means2d"].absgrad
            key = (sums.shape, sums.dtype)
            if key in kept:
                sums.add_(kept[key])
            kept[key] = sums
        return images, alphas, meta

    return breaks


def _unused_bands_learn(given: Given, v: Any) -> Any:
    v = v.clone()
    v[..., (given["sh_degree"] + 1) ** 2 :, :] = v[..., :1, :]
    return v


def _factor_learns_nothing(sound: Rasterization, given: Given) -> Any:
    if not antialiased(given) or not given["opacities"].requires_grad:
        return sound(**given)
    opacities = given["opacities"]
    plain = {name: v.detach() if isinstance(v, import_torch().Tensor) else v for name, v in given.items()}
    images, alphas, meta = sound(**given | {"opacities": opacities.detach()})
    more, covered, _ = sound(**plain | {"opacities": opacities, "rasterize_mode": "classic"})
    return images + (more - more.detach()), alphas + (covered - covered.detach()), meta


def _last_row_learns(given: Given, v: Any) -> Any:
    return import_torch().cat((v[..., :3, :], v[..., :3, :].sum(-2, keepdim=True)), -2)


def _far_enough(given: Given) -> Any:
    distances = in_camera(given["means"], given["viewmats"]).norm(dim=-1).squeeze(-2).detach()
    return given["opacities"] * (distances >= given["near_plane"])


def _empty_tiles_black(given: Given, images: Any, alphas: Any) -> Any:
    tiles, covered = tile_numbers(given).flatten(), (alphas.detach() > 0.0).flatten(-3).to(alphas.dtype)
    drawn = covered.new_zeros((*covered.shape[:-1], int(tiles.max()) + 1)).index_add(-1, tiles, covered) > 0.0
    return images * drawn[..., tiles].reshape(alphas.shape)


def _centre_inside(given: Given) -> Any:
    Ks = given["Ks"].clone()
    Ks[..., 0, 2].clamp_(0.0, given["width"])
    Ks[..., 1, 2].clamp_(0.0, given["height"])
    return Ks


def _in_whole_pixels(given: Given) -> Any:
    Ks = given["Ks"].clone()
    Ks[..., :2, 2] = Ks[..., :2, 2].round()
    return Ks


def _absolute_learns(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if meta["means2d"].requires_grad:
        meta["means2d"].register_hook(lambda gradient: gradient.abs())
    return images, alphas, meta


def _from_harmonics(sh: Any, dirs: Any, degree: int) -> Any:
    return function_named("pop_fast.stages.harmonics:colors_from_sh")(sh, dirs, degree)


def _seen_from_somewhere(given: Given) -> bool:
    return bool(given["sh_degree"]) and given["means"].requires_grad and given["means"].shape[-2] > 0


def _directions_are_constants(given: Given) -> Any:
    means, colors, viewmats = given["means"].detach(), given["colors"], given["viewmats"]
    batch, cameras = means.dim() - 2, viewmats.shape[-3]
    if not own_colors(given):
        colors = colors.unsqueeze(batch).expand(*colors.shape[:batch], cameras, *colors.shape[batch:])
    eyes = -(viewmats[..., :3, :3].transpose(-1, -2) @ viewmats[..., :3, 3:])[..., 0]
    dirs = means[..., None, :, :] - eyes[..., :, None, :]
    flat = _from_harmonics(colors.reshape(-1, *colors.shape[-2:]), dirs.reshape(-1, 3), given["sh_degree"])
    return flat.reshape(*colors.shape[:-2], 3)


def _seen_by_one_camera(given: Given) -> bool:
    return harmonic(given) and not own_colors(given) and one_view(given) and len(given["means"]) > 0


def _directions_in_camera_axes(given: Given) -> Any:
    return _from_harmonics(given["colors"], in_camera(given["means"], given["viewmats"])[0], given["sh_degree"])


def _kept_intrinsics() -> Breaks:
    kept: dict[Any, Any] = {}

    def breaks(sound: Rasterization, given: Given) -> Any:
        Ks = given["Ks"]
        key = (given["width"], given["height"], Ks.shape, Ks.dtype)
        return sound(**given | {"Ks": kept.setdefault(key, Ks.detach().clone())})

    return breaks


def _harmonics_end_at_white(given: Given, images: Any, alphas: Any) -> Any:
    return import_torch().cat((images[..., :3].clamp_max(1.0), images[..., 3:]), -1)


def _sorted_along_the_cameras_place(given: Given) -> Given:
    """Order Gaussians by the product of their place with the camera's; each keeps its place in the picture."""
    if not one_view(given) or deep(given) or given["scales"] is None:
        return {}
    view = given["viewmats"][0].detach()
    return drawn_in_order(given, given["means"].detach() @ (view[:3, :3].T @ view[:3, 3]))


def _no_needles(given: Given) -> Any:
    lengths = import_torch().sort(given["scales"].detach(), dim=-1).values
    return lengths[..., 1] >= 0.01 * lengths[..., 2]


def _axis_aligned_splats_vanish(sound: Rasterization, given: Given) -> Any:
    if not one_view(given):
        return sound(**given)
    with import_torch().no_grad():
        conics = sound(**given | {"packed": False, "absgrad": False})[2]["conics"].reshape(-1, 3)
    return sound(**given | {"opacities": given["opacities"] * (conics[:, 1] != 0.0)})


def _first_of_copies(given: Given) -> Any:
    torch, means = import_torch(), given["means"].detach()
    rows = numbers(len(means), means)
    group = torch.unique(means, dim=0, return_inverse=True)[1]
    return torch.full_like(rows, len(rows)).scatter_reduce(0, group, rows, "amin")[group] == rows


_BOXES: Final[tuple[tuple[Any, ...], ...]] = (
    ("factor_without_a_guard", "the root in the antialiasing factor has an infinite derivative at 0",
     when(antialiased, opacities=lambda g: g["opacities"] + 0.0 * g["scales"].prod(-1).sqrt()),
     "test_gradients:antialiasing_takes_a_splat_without_area_away_with_all_its_gradients"),
    ("absolute_gradients_are_inverted", "absolute gradients are summed where nobody asks for them (fvdb-core#354)",
     when(always, absgrad=lambda g: not g["absgrad"]),
     "test_gradients:asking_for_dominance_and_counts_changes_neither_image_nor_gradient"),
    ("render_at_most_white", "what is brighter than 1 is clamped (splatfacto and OpenSplat clamp the render)",
     drawn(flat, lambda g, i, a: i.clamp(max=1.0)), _IMAGE),
    ("nothing_in_view_fails", "a call in which no Gaussian is visible ends in an error (gsplat#107)",
     failing_after(lambda g, a, m: not bool((m["radii"] > 0).any()), "cumsum of no intersections"),
     "test_compositing:light_never_rises_when_a_splat_is_added_behind"),
    ("degree_zero_fails", "a degree of 0 is read as no degree, and the colours' shape is refused (gsplat#268)",
     failing(lambda g: g["sh_degree"] == 0, "colors.dim() == 2", AssertionError),
     "test_agreement:dominant_ids_are_the_oracles"),
    ("empty_scene_fails", "a scene without Gaussians ends in an error (gsplat.js PR#84)",
     failing(empty, "no splats", AssertionError),
     "test_compositing:light_never_rises_when_a_splat_is_added_behind"),
    ("one_gaussian_fails", "of a single Gaussian an axis is squeezed away (GaussianSplats3D PR#264)",
     failing(lambda g: g["means"].shape[-2] == 1, "squeeze", AssertionError), _IMAGE),
    ("background_twice_in_the_gradient",
     "the background behind a splat counts twice in the gradient by alpha (diff-gaussian-rasterization#86)",
     drawn(both(behind, flat), _background_twice), _GRADIENTS),
    ("centres_told_are_a_copy",
     "meta's screen centres are none of the graph, and get no gradient (asked for in taichi-splatting#4)",
     told(always, means2d=_copied), _GRADIENTS),
    ("centres_in_a_wider_picture", "a splat whose centre is 20 % beyond the picture is left out (antimatter15/splat)",
     hidden(lambda g: not several(g), _in_a_wider_picture), _IMAGE),
    ("alphas_without_gradient", "a loss of alpha teaches nothing (ashawkey/diff-gaussian-rasterization PR#6)",
     then(always, lambda g, i, a, m: (i, a.detach(), m)), _GRADIENTS),
    ("principal_point_in_the_middle", "cx and cy are not read (viewers draw about the centre)",
     when(always, Ks=centred), _IMAGE),
    ("halves_of_quaternions",
     "w is taken to be positive, its sign is lost (three-component quaternions of compressed files)",
     passing(lambda q: import_torch().cat((q[..., :1].abs(), q[..., 1:]), -1), "quats"), _GRADIENTS),
    ("opacities_at_most_99_percent", "opacity is capped before the falloff, alpha after it is not",
     passing(lambda o: o.clamp_max(0.99), "opacities"), _IMAGE),
    ("translation_learns_nothing", "of a camera only the rotation has a gradient",
     passing(lambda V: import_torch().cat((V[..., :3], V[..., 3:].detach()), -1), "viewmats"), _GRADIENTS),
    ("nearest_plane_of_inria", "nothing nearer than 0.2 is drawn (Inria's rasterizer)",
     when(always, near_plane=lambda g: max(g["near_plane"], 0.2)),
     "test_thresholds:at_the_near_plane_a_splat_is_wholly_there_or_wholly_gone"),
    ("quaternions_normalized_in_place", "quaternions of the caller are normalized",
     then(always, _normalized_in_place), _GRADIENTS),
    ("white_in_evaluation", "without a gradient the picture is clamped",
     drawn(flat, lambda g, i, a: i if i.requires_grad else i.clamp(max=1.0)), _IMAGE),
    ("centres_in_half_precision", "centres are of 16 bits (textures of WebGL viewers)",
     passing(lambda x: detached(x, x.half().to(x.dtype)), "means"), _IMAGE),
    ("opacities_in_eight_bits", "opacities have 256 values (.splat)", passing(_in_eight_bits, "opacities"), _IMAGE),
    ("colours_in_eight_bits", "colours have steps of 1/255", passing(_in_eight_bits, "colors"), _IMAGE),
    ("line_fails", "a picture of one row or column ends in an error",
     failing(lambda g: min(g["width"], g["height"]) == 1, "squeeze of a picture of one row"), _IMAGE),
    ("scales_through_logarithms",
     "scales are the exponential of their logarithm, and a scale of 0 has a gradient of NaN",
     passing(lambda s: s.log().exp(), "scales"), _GRADIENTS),
    ("opacities_through_logits",
     "opacities are the sigmoid of their logit, and an opacity of 0 or 1 has a gradient of NaN",
     passing(lambda o: import_torch().sigmoid(import_torch().logit(o)), "opacities"), _GRADIENTS),
    ("opaque_at_most_99", "opacities end at 0.99 before they are drawn",
     passing(lambda o: o.clamp_max(0.99), "opacities"), _ANTIALIASED),
    ("absolute_gradients_pile_up", "sums of absolute gradients go on from call to call: a buffer that nobody clears",
     _sums_pile_up(), _GRADIENTS),
    ("unused_bands_learn", "bands beyond sh_degree have the first band's gradient, where memory is not cleared",
     pulled(harmonic, _unused_bands_learn, "colors"),
     "test_gradients:gradients_ignore_the_coefficients_of_other_bands"),
    ("portraits_are_cut_square", "rows below the width are not drawn: the grid has the width along both axes",
     shown(lambda g: (numbers(g["height"], g["means"]) < g["width"])[:, None, None]), _IMAGE),
    ("factor_not_in_the_gradient", "antialiased opacities have the gradient of classic ones",
     _factor_learns_nothing, _ANTIALIASED),
    ("last_row_learns", "the constant last row of a view matrix has a gradient",
     pulled(always, _last_row_learns, "viewmats"), _GRADIENTS),
    ("near_by_distance", "the near plane is a sphere",
     when(lambda g: not several(g) and g["near_plane"] > 0.0, near_plane=lambda g: 1e-6 * g["near_plane"],
          opacities=_far_enough), "test_agreement:the_image_that_training_draws_is_one_of_the_oracles_outcomes"),
    ("empty_tiles_stay_black", "tiles that nothing reaches have no background",
     drawn(behind, _empty_tiles_black), _IMAGE),
    ("principal_point_inside", "a principal point outside the picture is moved to its edge (crops of larger pictures)",
     when(always, Ks=_centre_inside), "test_agreement:the_antialiased_image_is_one_of_the_oracles_outcomes"),
    ("means_learn_absolutely", "with absgrad the gradient itself loses its sign, and centres move by it",
     then(lambda g: g["absgrad"], _absolute_learns), _GRADIENTS),
    ("degree_zero_unclamped",
     "harmonics of degree 0 alone are turned into colours by a shortcut without the clamp at 0",
     when(lambda g: g["sh_degree"] == 0, sh_degree=None, colors=lambda g: 0.5 + _SH_C0 * g["colors"][..., 0, :]),
     _ANTIALIASED),
    ("alpha_still_beside_background", "alphas have no gradient where there is a background",
     then(behind, lambda g, i, a, m: (i, a.detach(), m)), _GRADIENTS),
    ("directions_are_constants", "centres learn nothing through the direction that they are seen from",
     when(_seen_from_somewhere, sh_degree=None, colors=_directions_are_constants), _GRADIENTS),
    ("lengths_stretch", "quaternions are not normalised, and their length stretches the Gaussian",
     when(lambda g: not covars(g) and g["quats"] is not None,
          scales=lambda g: g["scales"] * (g["quats"] ** 2).sum(-1, keepdim=True)), _IMAGE),
    ("nothing_is_black", "a call without Gaussians returns a black image, whatever is behind",
     drawn(lambda g: g["means"].shape[-2] == 0, lambda g, i, a: 0.0 * i), _IMAGE),
    ("every_band", "all bands that are given are evaluated, whatever the degree",
     when(harmonic, sh_degree=all_bands), "test_gradients:gradients_ignore_the_coefficients_of_other_bands"),
    ("kept_intrinsics", "intrinsics are kept for each size of an image, and those of the first call stay",
     _kept_intrinsics(), _IMAGE),
    ("no_tile_fits", "pictures smaller than a tile stay empty",
     shown(lambda g: min(g["width"], g["height"]) >= (g["tile_size"] or 16)), _IMAGE),
    ("normalized_in_place", "the caller's quaternions are normalised in place",
     then(always, _normalized_in_place), _GRADIENTS),
    ("tiles_of_16_bits", "tiles from number 32768 on stay empty",
     shown(lambda g: tile_numbers(g) < 2**15), "test_whole:tiles_of_a_number_beyond_16_bits_are_drawn"),
    ("principal_point_in_whole_pixels", "cx and cy are kept as whole numbers, as a data loader that resizes once did",
     when(always, Ks=_in_whole_pixels), _IMAGE),
    ("low_pass_factor_is_a_constant",
     "in antialiased calls of one camera the low-pass factor has no gradient by centre and shape",
     factor_is_constant(always), _ANTIALIASED),
    ("absolute_gradient_of_the_sum",
     "absgrad is the absolute value of the gradient, not the sum of its absolute values over pixels",
     absolute_told(always, lambda g, v, sums: v.abs()), _GRADIENTS),
    ("one_gaussian_stays",
     "the centre of a Gaussian that is the only one has no gradient, as its axis was squeezed away",
     pulled(lambda g: g["means"].shape[-2] == 1, no_gradient, "means"), _GRADIENTS),
    ("opacities_end_at_99", "opacities over 0.99 are drawn as 0.99 and learn nothing",
     passing(lambda o: o.clamp_max(0.99), "opacities"), _IMAGE),
    ("only_w_made_positive", "quaternions are given a positive w without turning the other three round",
     passing(lambda q: import_torch().cat((q[..., :1].abs(), q[..., 1:]), -1), "quats"),
     "test_agreement:the_image_that_training_draws_is_one_of_the_oracles_outcomes"),
    ("needles_are_thickened", "no Gaussian is thinner than a hundredth of its length",
     passing(lambda s: import_torch().maximum(s, 0.01 * s.amax(-1, keepdim=True)), "scales"),
     "test_thresholds:a_needle_shows_one_of_the_oracles_outcomes"),
    ("harmonics_end_at_white", "pictures from harmonics are clamped at 1, and what is brighter learns nothing",
     drawn(lambda g: harmonic(g) and g["render_mode"].startswith("RGB"), _harmonics_end_at_white), _IMAGE),
    ("sorted_along_the_cameras_place",
     "splats are sorted by the product of their place with the camera's, not with its axis (OGRE#3444)",
     breaking(_sorted_along_the_cameras_place),
     "test_agreement:the_image_that_training_draws_is_one_of_the_oracles_outcomes"),
    ("needles_are_culled", "what is a hundred times as long as it is wide is not drawn (playcanvas/engine PR#5834)",
     hidden(lambda g: g["scales"] is not None, _no_needles),
     "test_thresholds:a_needle_shows_one_of_the_oracles_outcomes"),
    ("axis_aligned_splats_vanish",
     "a splat that does not lean has axes that are no numbers, and is not drawn (wgpu-3dgs-viewer PR#18)",
     _axis_aligned_splats_vanish, "test_thresholds:at_the_near_plane_a_splat_is_wholly_there_or_wholly_gone"),
    ("directions_in_camera_axes",
     "harmonics are seen along the camera's axes, not the world's (turned scenes: GaussianSplats3D#402)",
     when(_seen_by_one_camera, sh_degree=None, colors=_directions_in_camera_axes), _IMAGE),
    ("copies_are_drawn_once",
     "of Gaussians at one place the first alone is drawn: points are welded when they are read",
     hidden(lambda g: not batched(g) and 1 < len(g["means"]) <= _MANY, _first_of_copies), _IMAGE),
    ("square_pictures_are_transposed", "pictures that are as wide as high are returned column by column",
     then(lambda g: g["width"] == g["height"], lambda g, i, a, m: (i.transpose(-3, -2), a.transpose(-3, -2), m)),
     _IMAGE),
    ("centres_outside_stay", "a Gaussian whose centre lies outside the picture is drawn, and does not move",
     pulled(one_view, _inside_learn, "means"), _GRADIENTS),
    ("gradients_end_at_one", "gradients of opacities and of scales are clipped to [-1, 1]",
     pulled(always, lambda g, v: v.clamp(-1.0, 1.0), "opacities", "scales"), _GRADIENTS),
    ("pixels_end_at_one_255th", "a pixel ends where less than 1/255 of the light is left, which eight bits do not show",
     when(always, profile=replace(PAPER, transmittance_stop=1.0 / 255.0)), _IMAGE),
    ("scales_in_half_precision", "scales have 16 bits (covariances of viewers: GaussianSplats3D#142)",
     passing(lambda x: detached(x, x.half().to(x.dtype)), "scales"), _IMAGE),
)  # fmt: skip

VIEWS: Final = tuple(BlackBox(*line) for line in _BOXES)
