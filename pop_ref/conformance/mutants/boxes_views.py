"""Black boxes that draw a view wrongly in some corner, or pull it back wrongly: what laws of single views notice."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from pop_ref.conformance.mutants.black_box import (
    BlackBox,
    Breaks,
    Given,
    Rasterization,
    Told,
    backwards,
    breaking,
    import_torch,
    in_camera,
    one_view,
    own_colors,
    passing,
    telling,
)
from pop_ref.constants import PAPER

_SH_C0: Final = 0.28209479177387814
_MANY: Final = 4096  # Gaussians of which copies are not looked for


def _root_without_a_guard(given: Given) -> Given:
    if given["rasterize_mode"] != "antialiased":
        return {}
    return {"opacities": given["opacities"] + 0.0 * given["scales"].prod(-1).sqrt()}


def _fails(where: Callable[[Given], bool], words: str) -> Breaks:
    def breaks(sound: Rasterization, given: Given) -> Any:
        if where(given):
            raise AssertionError(words)
        return sound(**given)

    return breaks


def _at_most_white(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    return (images.clamp(max=1.0) if given["render_mode"] == "RGB" else images), alphas, meta


def _nothing_in_view_fails(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if not bool((meta["radii"] > 0).any()):
        raise RuntimeError("cumsum of no intersections")
    return images, alphas, meta


def _background_twice(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    behind = given["backgrounds"]
    if behind is None or given["render_mode"] != "RGB" or not images.requires_grad:
        return images, alphas, meta
    once = behind.detach()[..., None, None, :]
    # nothing is added but a gradient
    more = (once * (alphas.detach() - alphas)).expand_as(images)
    return images + more, alphas, meta


def _centres_are_a_copy(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if meta["means2d"].requires_grad:
        meta["means2d"] = meta["means2d"].detach().clone().requires_grad_()
    return images, alphas, meta


def _centres_in_a_wider_picture(given: Given) -> Given:
    if given["viewmats"].shape[-3] > 1:
        return {}
    x, y, z = in_camera(given["means"], given["viewmats"]).squeeze(-3).detach().unbind(-1)
    K, width, height = given["Ks"].squeeze(-3), given["width"], given["height"]
    u = (K[..., 0, 0, None] * x / z + K[..., 0, 2, None]) / (0.5 * width) - 1.0
    v = (K[..., 1, 1, None] * y / z + K[..., 1, 2, None]) / (0.5 * height) - 1.0
    return {"opacities": given["opacities"] * ((u.abs() <= 1.2) & (v.abs() <= 1.2))}


def _alphas_without_gradient(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    return images, alphas.detach(), meta


def _middle(given: Given) -> Given:
    Ks = given["Ks"].clone()
    Ks[..., 0, 2], Ks[..., 1, 2] = given["width"] / 2, given["height"] / 2
    return {"Ks": Ks}


def _rounded(value: Any, levels: float) -> Any:
    """Round, and let gradients pass."""
    return value + ((value * levels).round() / levels - value).detach()


def _translation_stays(given: Given) -> Given:
    V = given["viewmats"]
    return {"viewmats": import_torch().cat((V[..., :3], V[..., 3:].detach()), -1)}


def _normalized_in_place(sound: Rasterization, given: Given) -> Any:
    answer = sound(**given)
    if given["quats"] is not None:
        given["quats"].data.div_(given["quats"].data.norm(dim=-1, keepdim=True))
    return answer


def _white_in_evaluation(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    clamps = not images.requires_grad and given["render_mode"] == "RGB"
    return images.clamp(max=1.0) if clamps else images, alphas, meta


def _line_fails(sound: Rasterization, given: Given) -> Any:
    if min(given["width"], given["height"]) == 1:
        raise RuntimeError("squeeze of a picture of one row")
    return sound(**given)


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


def _unused_bands_learn(given: Given) -> Given:
    if given["sh_degree"] is None:
        return {}
    used = (given["sh_degree"] + 1) ** 2

    def change(gradient: Any) -> Any:
        gradient = gradient.clone()
        gradient[..., used:, :] = gradient[..., :1, :]
        return gradient

    return {"colors": backwards(given["colors"], change)}


def _square_part(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    width = given["width"]
    keep = (import_torch().arange(given["height"], device=images.device) < width)[:, None, None]
    return images * keep, alphas * keep, meta


def _factor_learns_nothing(sound: Rasterization, given: Given) -> Any:
    if given["rasterize_mode"] != "antialiased" or not given["opacities"].requires_grad:
        return sound(**given)
    opacities = given["opacities"]
    plain = {name: v.detach() if isinstance(v, import_torch().Tensor) else v for name, v in given.items()}
    images, alphas, meta = sound(**given | {"opacities": opacities.detach()})
    more, covered, _ = sound(**plain | {"opacities": opacities, "rasterize_mode": "classic"})
    return images + (more - more.detach()), alphas + (covered - covered.detach()), meta


def _last_row_learns(given: Given) -> Given:
    def change(gradient: Any) -> Any:
        gradient = gradient.clone()
        gradient[..., 3, :] = gradient[..., :3, :].sum(-2)
        return gradient

    return {"viewmats": backwards(given["viewmats"], change)}


def _near_by_distance(given: Given) -> Given:
    if given["viewmats"].shape[-3] > 1 or not given["near_plane"] > 0.0:
        return {}
    distances = in_camera(given["means"], given["viewmats"]).norm(dim=-1).squeeze(-2).detach()
    far_enough = distances >= given["near_plane"]
    return {"near_plane": 1e-6 * given["near_plane"], "opacities": given["opacities"] * far_enough}


def _empty_tiles_black(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if given["backgrounds"] is None:
        return images, alphas, meta
    size, (height, width) = given["tile_size"], alphas.shape[-3:-1]
    rows, columns = -(-height // size), -(-width // size)
    padded = alphas.new_zeros((*alphas.shape[:-3], rows * size, columns * size))
    padded[..., :height, :width] = alphas.detach()[..., 0]
    drawn = (padded.reshape(*padded.shape[:-2], rows, size, columns, size) > 0.0).any(-1).any(-2)
    here = drawn.repeat_interleave(size, -2).repeat_interleave(size, -1)[..., :height, :width, None]
    return images * here, alphas, meta


def _centre_inside(given: Given) -> Given:
    Ks = given["Ks"].clone()
    Ks[..., 0, 2].clamp_(0.0, given["width"])
    Ks[..., 1, 2].clamp_(0.0, given["height"])
    return {"Ks": Ks}


def _absolute_learns(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if given["absgrad"] and meta["means2d"].requires_grad:
        meta["means2d"].register_hook(lambda gradient: gradient.abs())
    return images, alphas, meta


def _degree_zero_unclamped(given: Given) -> Given:
    if given["sh_degree"] != 0:
        return {}
    return {"sh_degree": None, "colors": 0.5 + _SH_C0 * given["colors"][..., 0, :]}


def _alpha_still_beside_background(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    return images, alphas if given["backgrounds"] is None else alphas.detach(), meta


def _directions_are_constants(sound: Rasterization, given: Given) -> Any:
    degree = given["sh_degree"]
    if degree is None or degree == 0 or not given["means"].requires_grad:
        return sound(**given)
    harmonics = importlib.import_module("pop_fast.stages.harmonics")
    means, colors, viewmats = given["means"].detach(), given["colors"], given["viewmats"]
    n, cameras = means.shape[-2], viewmats.shape[-3]
    if n == 0:
        return sound(**given)
    batch = means.dim() - 2
    if not own_colors(given):
        shape = colors.shape
        colors = colors.unsqueeze(batch).expand(*shape[:batch], cameras, *shape[batch:])
    eyes = -(viewmats[..., :3, :3].transpose(-1, -2) @ viewmats[..., :3, 3:])[..., 0]
    dirs = means[..., None, :, :] - eyes[..., :, None, :]
    flat = harmonics.colors_from_sh(colors.reshape(-1, *colors.shape[-2:]), dirs.reshape(-1, 3), degree)
    return sound(**given | {"sh_degree": None, "colors": flat.reshape(*colors.shape[:-2], 3)})


def _lengths_stretch(given: Given) -> Given:
    if given.get("covars") is not None or given["quats"] is None:
        return {}
    return {"scales": given["scales"] * (given["quats"] ** 2).sum(-1, keepdim=True)}


def _nothing_is_black(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    return images if given["means"].shape[-2] else images * 0.0, alphas, meta


def _every_band(given: Given) -> Given:
    if given["sh_degree"] is None:
        return {}
    return {"sh_degree": math.isqrt(given["colors"].shape[-2]) - 1}


def _kept_intrinsics() -> Breaks:
    kept: dict[Any, Any] = {}

    def breaks(sound: Rasterization, given: Given) -> Any:
        Ks = given["Ks"]
        key = (given["width"], given["height"], Ks.shape, Ks.dtype)
        return sound(**given | {"Ks": kept.setdefault(key, Ks.detach().clone())})

    return breaks


def _no_tile_fits(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    size = given["tile_size"] or 16
    if given["width"] >= size and given["height"] >= size:
        return images, alphas, meta
    return images * 0.0, alphas * 0.0, meta


def _tiles_of_16_bits(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    torch, size = import_torch(), given["tile_size"] or 16
    x, y = torch.arange(given["width"]) // size, torch.arange(given["height"]) // size
    there = (y[:, None] * -(-given["width"] // size) + x < 2**15)[..., None].to(images.device)
    return images * there, alphas * there, meta


def _principal_point_in_whole_pixels(given: Given) -> Given:
    Ks = given["Ks"].clone()
    Ks[..., :2, 2] = Ks[..., :2, 2].round()
    return {"Ks": Ks}


def _low_pass_factor_is_a_constant(sound: Rasterization, given: Given) -> Any:
    if given["rasterize_mode"] != "antialiased" or not one_view(given):
        return sound(**given)
    torch, opacities = import_torch(), given["opacities"]
    with torch.no_grad():
        of_view = sound(**given | {"packed": False, "absgrad": False})[2]["opacities"].reshape(opacities.shape)
        factors = torch.where(opacities > 0.0, of_view / opacities, torch.zeros_like(of_view))
    return sound(**given | {"rasterize_mode": "classic", "opacities": opacities * factors})


def _absolute_gradient_of_the_sum(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    means2d = meta["means2d"]
    absolute: Any = getattr(means2d, "absgrad", None)

    def tell(gradient: Any) -> None:
        absolute.copy_(gradient.detach().abs())

    if absolute is not None and means2d.requires_grad:
        means2d.register_hook(tell)
    return images, alphas, meta


def _one_gaussian_stays(given: Given) -> Given:
    if given["means"].shape[-2] != 1:
        return {}
    return {"means": backwards(given["means"], lambda gradient: gradient * 0.0)}


def _opacities_end_at_99(given: Given) -> Given:
    return {"opacities": given["opacities"].clamp_max(0.99)}


def _only_w_made_positive(given: Given) -> Given:
    quats = given["quats"]
    if quats is None:
        return {}
    return {"quats": import_torch().cat((quats[..., :1].abs(), quats[..., 1:]), -1)}


def _needles_are_thickened(given: Given) -> Given:
    scales = given["scales"]
    if scales is None:
        return {}
    return {"scales": import_torch().maximum(scales, 0.01 * scales.amax(-1, keepdim=True))}


def _harmonics_end_at_white(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if given["sh_degree"] is None or not given["render_mode"].startswith("RGB"):
        return images, alphas, meta
    return import_torch().cat((images[..., :3].clamp_max(1.0), images[..., 3:]), -1), alphas, meta


def _sorted_along_the_cameras_place(given: Given) -> Given:
    """Order Gaussians by the product of their place with the camera's; each keeps its place in the picture."""
    if not one_view(given) or given["render_mode"] != "RGB" or given["scales"] is None:
        return {}
    torch, view = import_torch(), given["viewmats"][0].detach()
    means, scales = given["means"], given["scales"]
    eye = -(view[:3, :3].T @ view[:3, 3])
    depths = means.detach() @ view[2, :3] + view[2, 3]
    seen = (depths > given["near_plane"]).nonzero()[:, 0]
    keys = -(means.detach()[seen] @ eye)
    order = torch.argsort(keys, stable=True)
    shift = torch.ones_like(depths)
    shift[seen[order]] = torch.sort(depths[seen]).values / depths[seen[order]]
    # nearer by as much as it is smaller, so that it looks the same
    return {"means": eye + (means - eye) * shift[:, None], "scales": scales * shift[:, None]}


def _needles_are_culled(given: Given) -> Given:
    if given["scales"] is None:
        return {}
    lengths = import_torch().sort(given["scales"].detach(), dim=-1).values
    return {"opacities": given["opacities"] * (lengths[..., 1] >= 0.01 * lengths[..., 2])}


def _axis_aligned_splats_vanish(sound: Rasterization, given: Given) -> Any:
    if not one_view(given):
        return sound(**given)
    with import_torch().no_grad():
        conics = sound(**given | {"packed": False, "absgrad": False})[2]["conics"].reshape(-1, 3)
    return sound(**given | {"opacities": given["opacities"] * (conics[:, 1] != 0.0)})


def _directions_in_camera_axes(given: Given) -> Given:
    degree = given["sh_degree"]
    if degree is None or own_colors(given) or not one_view(given) or given["means"].shape[-2] == 0:
        return {}
    harmonics = importlib.import_module("pop_fast.stages.harmonics")
    seen = in_camera(given["means"], given["viewmats"])[0]
    return {"sh_degree": None, "colors": harmonics.colors_from_sh(given["colors"], seen, degree)}


def _copies_are_drawn_once(given: Given) -> Given:
    torch, means = import_torch(), given["means"].detach()
    n = means.shape[-2]
    if means.dim() != 2 or not 1 < n <= _MANY:
        return {}
    rows = torch.arange(n, device=means.device)
    group = torch.unique(means, dim=0, return_inverse=True)[1]
    first = torch.full_like(rows, n).scatter_reduce(0, group, rows, "amin")[group]
    return {"opacities": given["opacities"] * (first == rows)}


def _square_pictures_are_transposed(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if given["width"] != given["height"]:
        return images, alphas, meta
    return images.transpose(-3, -2), alphas.transpose(-3, -2), meta


def _centres_outside_stay(given: Given) -> Given:
    if not one_view(given):
        return {}
    seen = in_camera(given["means"].detach(), given["viewmats"].detach())[0]
    K = given["Ks"].detach().reshape(3, 3)
    x, y = (K[i, i] * seen[:, i] / seen[:, 2] + K[i, 2] for i in range(2))
    inside = (x >= 0.0) & (x <= given["width"]) & (y >= 0.0) & (y <= given["height"])
    return {"means": backwards(given["means"], lambda gradient: gradient * inside[:, None])}


def _gradients_end_at_one(value: Any) -> Any:
    return backwards(value, lambda gradient: gradient.clamp(-1.0, 1.0))


def _end_at_one_255th(sound: Rasterization, given: Given) -> Any:
    return sound(**given | {"profile": replace(PAPER, transmittance_stop=1.0 / 255.0)})


def _in_half_precision(value: Any) -> Any:
    return value + (value.half().to(value.dtype) - value).detach()


_BOXES: Final[tuple[tuple[Any, ...], ...]] = (
    ("factor_without_a_guard", "the root in the antialiasing factor has an infinite derivative at 0",
     breaking(_root_without_a_guard),
     "test_gradients:antialiasing_takes_a_splat_without_area_away_with_all_its_gradients"),
    ("absolute_gradients_are_inverted", "absolute gradients are summed where nobody asks for them (fvdb-core#354)",
     breaking(lambda given: {"absgrad": not given["absgrad"]}),
     "test_gradients:asking_for_dominance_and_counts_changes_neither_image_nor_gradient"),
    ("render_at_most_white", "what is brighter than 1 is clamped (splatfacto and OpenSplat clamp the render)",
     _at_most_white, "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("nothing_in_view_fails", "a call in which no Gaussian is visible ends in an error (gsplat#107)",
     _nothing_in_view_fails, "test_compositing:light_never_rises_when_a_splat_is_added_behind"),
    ("degree_zero_fails", "a degree of 0 is read as no degree, and the colours' shape is refused (gsplat#268)",
     _fails(lambda given: given["sh_degree"] == 0, "colors.dim() == 2"), "test_agreement:dominant_ids_are_the_oracles"),
    ("empty_scene_fails", "a scene without Gaussians ends in an error (gsplat.js PR#84)",
     _fails(lambda given: given["means"].shape[-2] == 0, "no splats"),
     "test_compositing:light_never_rises_when_a_splat_is_added_behind"),
    ("one_gaussian_fails", "of a single Gaussian an axis is squeezed away (GaussianSplats3D PR#264)",
     _fails(lambda given: given["means"].shape[-2] == 1, "squeeze"),
     "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("background_twice_in_the_gradient",
     "the background behind a splat counts twice in the gradient by alpha (diff-gaussian-rasterization#86)",
     _background_twice, "test_agreement:gradients_are_the_oracles"),
    ("centres_told_are_a_copy",
     "meta's screen centres are none of the graph, and get no gradient (asked for in taichi-splatting#4)",
     _centres_are_a_copy, "test_agreement:gradients_are_the_oracles"),
    ("centres_in_a_wider_picture", "a splat whose centre is 20 % beyond the picture is left out (antimatter15/splat)",
     breaking(_centres_in_a_wider_picture), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("alphas_without_gradient", "a loss of alpha teaches nothing (ashawkey/diff-gaussian-rasterization PR#6)",
     _alphas_without_gradient, "test_agreement:gradients_are_the_oracles"),
    ("principal_point_in_the_middle", "cx and cy are not read (viewers draw about the centre)",
     breaking(_middle), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("halves_of_quaternions",
     "w is taken to be positive, its sign is lost (three-component quaternions of compressed files)",
     passing(lambda q: import_torch().cat((q[..., :1].abs(), q[..., 1:]), -1), "quats"),
     "test_agreement:gradients_are_the_oracles"),
    ("opacities_at_most_99_percent", "opacity is capped before the falloff, alpha after it is not",
     passing(lambda o: o.clamp(max=0.99), "opacities"), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("translation_learns_nothing", "of a camera only the rotation has a gradient",
     breaking(_translation_stays), "test_agreement:gradients_are_the_oracles"),
    ("nearest_plane_of_inria", "nothing nearer than 0.2 is drawn (Inria's rasterizer)",
     breaking(lambda given: {"near_plane": max(given["near_plane"], 0.2)}),
     "test_thresholds:at_the_near_plane_a_splat_is_wholly_there_or_wholly_gone"),
    ("quaternions_normalized_in_place", "quaternions of the caller are normalized",
     _normalized_in_place, "test_agreement:gradients_are_the_oracles"),
    ("white_in_evaluation", "without a gradient the picture is clamped",
     telling(_white_in_evaluation), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("centres_in_half_precision", "centres are of 16 bits (textures of WebGL viewers)",
     passing(lambda m: m + (m.half().to(m.dtype) - m).detach(), "means"),
     "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("opacities_in_eight_bits", "opacities have 256 values (.splat)",
     passing(lambda o: _rounded(o, 255.0), "opacities"), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("colours_in_eight_bits", "colours have steps of 1/255",
     passing(lambda c: _rounded(c, 255.0), "colors"), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("line_fails", "a picture of one row or column ends in an error",
     _line_fails, "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("scales_through_logarithms",
     "scales are the exponential of their logarithm, and a scale of 0 has a gradient of NaN",
     passing(lambda s: s.log().exp(), "scales"), "test_agreement:gradients_are_the_oracles"),
    ("opacities_through_logits",
     "opacities are the sigmoid of their logit, and an opacity of 0 or 1 has a gradient of NaN",
     passing(lambda o: import_torch().sigmoid(import_torch().logit(o)), "opacities"),
     "test_agreement:gradients_are_the_oracles"),
    ("opaque_at_most_99", "opacities end at 0.99 before they are drawn",
     passing(lambda o: o.clamp_max(0.99), "opacities"), "test_agreement:antialiased_gradients_are_the_oracles"),
    ("absolute_gradients_pile_up", "sums of absolute gradients go on from call to call: a buffer that nobody clears",
     _sums_pile_up(), "test_agreement:gradients_are_the_oracles"),
    ("unused_bands_learn", "bands beyond sh_degree have the first band's gradient, where memory is not cleared",
     breaking(_unused_bands_learn), "test_gradients:gradients_ignore_the_coefficients_of_other_bands"),
    ("portraits_are_cut_square", "rows below the width are not drawn: the grid has the width along both axes",
     telling(_square_part), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("factor_not_in_the_gradient", "antialiased opacities have the gradient of classic ones",
     _factor_learns_nothing, "test_agreement:antialiased_gradients_are_the_oracles"),
    ("last_row_learns", "the constant last row of a view matrix has a gradient",
     breaking(_last_row_learns), "test_agreement:gradients_are_the_oracles"),
    ("near_by_distance", "the near plane is a sphere",
     breaking(_near_by_distance), "test_agreement:the_image_that_training_draws_is_one_of_the_oracles_outcomes"),
    ("empty_tiles_stay_black", "tiles that nothing reaches have no background",
     telling(_empty_tiles_black), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("principal_point_inside", "a principal point outside the picture is moved to its edge (crops of larger pictures)",
     breaking(_centre_inside), "test_agreement:the_antialiased_image_is_one_of_the_oracles_outcomes"),
    ("means_learn_absolutely", "with absgrad the gradient itself loses its sign, and centres move by it",
     telling(_absolute_learns), "test_agreement:gradients_are_the_oracles"),
    ("degree_zero_unclamped",
     "harmonics of degree 0 alone are turned into colours by a shortcut without the clamp at 0",
     breaking(_degree_zero_unclamped), "test_agreement:antialiased_gradients_are_the_oracles"),
    ("alpha_still_beside_background", "alphas have no gradient where there is a background",
     telling(_alpha_still_beside_background), "test_agreement:gradients_are_the_oracles"),
    ("directions_are_constants", "centres learn nothing through the direction that they are seen from",
     _directions_are_constants, "test_agreement:gradients_are_the_oracles"),
    ("lengths_stretch", "quaternions are not normalised, and their length stretches the Gaussian",
     breaking(_lengths_stretch), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("nothing_is_black", "a call without Gaussians returns a black image, whatever is behind",
     telling(_nothing_is_black), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("every_band", "all bands that are given are evaluated, whatever the degree",
     breaking(_every_band), "test_gradients:gradients_ignore_the_coefficients_of_other_bands"),
    ("kept_intrinsics", "intrinsics are kept for each size of an image, and those of the first call stay",
     _kept_intrinsics(), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("no_tile_fits", "pictures smaller than a tile stay empty",
     telling(_no_tile_fits), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("normalized_in_place", "the caller's quaternions are normalised in place",
     _normalized_in_place, "test_agreement:gradients_are_the_oracles"),
    ("tiles_of_16_bits", "tiles from number 32768 on stay empty",
     telling(_tiles_of_16_bits), "test_whole:tiles_of_a_number_beyond_16_bits_are_drawn"),
    ("principal_point_in_whole_pixels", "cx and cy are kept as whole numbers, as a data loader that resizes once did",
     breaking(_principal_point_in_whole_pixels), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("low_pass_factor_is_a_constant",
     "in antialiased calls of one camera the low-pass factor has no gradient by centre and shape",
     _low_pass_factor_is_a_constant, "test_agreement:antialiased_gradients_are_the_oracles"),
    ("absolute_gradient_of_the_sum",
     "absgrad is the absolute value of the gradient, not the sum of its absolute values over pixels",
     telling(_absolute_gradient_of_the_sum), "test_agreement:gradients_are_the_oracles"),
    ("one_gaussian_stays",
     "the centre of a Gaussian that is the only one has no gradient, as its axis was squeezed away",
     breaking(_one_gaussian_stays), "test_agreement:gradients_are_the_oracles"),
    ("opacities_end_at_99", "opacities over 0.99 are drawn as 0.99 and learn nothing",
     breaking(_opacities_end_at_99), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("only_w_made_positive", "quaternions are given a positive w without turning the other three round",
     breaking(_only_w_made_positive), "test_agreement:the_image_that_training_draws_is_one_of_the_oracles_outcomes"),
    ("needles_are_thickened", "no Gaussian is thinner than a hundredth of its length",
     breaking(_needles_are_thickened), "test_thresholds:a_needle_shows_one_of_the_oracles_outcomes"),
    ("harmonics_end_at_white", "pictures from harmonics are clamped at 1, and what is brighter learns nothing",
     telling(_harmonics_end_at_white), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("sorted_along_the_cameras_place",
     "splats are sorted by the product of their place with the camera's, not with its axis (OGRE#3444)",
     breaking(_sorted_along_the_cameras_place),
     "test_agreement:the_image_that_training_draws_is_one_of_the_oracles_outcomes"),
    ("needles_are_culled", "what is a hundred times as long as it is wide is not drawn (playcanvas/engine PR#5834)",
     breaking(_needles_are_culled), "test_thresholds:a_needle_shows_one_of_the_oracles_outcomes"),
    ("axis_aligned_splats_vanish",
     "a splat that does not lean has axes that are no numbers, and is not drawn (wgpu-3dgs-viewer PR#18)",
     _axis_aligned_splats_vanish, "test_thresholds:at_the_near_plane_a_splat_is_wholly_there_or_wholly_gone"),
    ("directions_in_camera_axes",
     "harmonics are seen along the camera's axes, not the world's (turned scenes: GaussianSplats3D#402)",
     breaking(_directions_in_camera_axes), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("copies_are_drawn_once",
     "of Gaussians at one place the first alone is drawn: points are welded when they are read",
     breaking(_copies_are_drawn_once), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("square_pictures_are_transposed", "pictures that are as wide as high are returned column by column",
     telling(_square_pictures_are_transposed), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("centres_outside_stay", "a Gaussian whose centre lies outside the picture is drawn, and does not move",
     breaking(_centres_outside_stay), "test_agreement:gradients_are_the_oracles"),
    ("gradients_end_at_one", "gradients of opacities and of scales are clipped to [-1, 1]",
     passing(_gradients_end_at_one, "opacities", "scales"), "test_agreement:gradients_are_the_oracles"),
    ("pixels_end_at_one_255th", "a pixel ends where less than 1/255 of the light is left, which eight bits do not show",
     _end_at_one_255th, "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
    ("scales_in_half_precision", "scales have 16 bits (covariances of viewers: GaussianSplats3D#142)",
     passing(_in_half_precision, "scales"), "test_agreement:the_image_is_one_of_the_oracles_outcomes"),
)  # fmt: skip

VIEWS: Final = tuple(BlackBox(*line) for line in _BOXES)
