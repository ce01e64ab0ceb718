"""Rasterizers broken after habits of viewers and exporters, written in one go and tried on the laws that there were.

`docs/kit.md` says how many were killed at first sight.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, Final

from pop_ref.conformance.mutants.black_box import BlackBox, Rasterization

Given = dict[str, Any]
Breaks = Callable[[Rasterization, Given], Any]


def _torch() -> Any:
    return importlib.import_module("torch")


def backwards(value: Any, change: Any) -> Any:
    """Return the value, through which a gradient goes as the change makes it."""
    passed = value * 1.0
    if passed.requires_grad:
        passed.register_hook(change)
    return passed


def breaking(change: Callable[[Given], Given]) -> Breaks:
    return lambda sound, given: sound(**given | change(given))


def telling(change: Callable[[Given, Any, Any, Any], tuple[Any, Any, Any]]) -> Breaks:
    return lambda sound, given: change(given, *sound(**given))


def meta_telling(**changed: Callable[[Given, Any], Any]) -> Breaks:
    """Change what meta tells, where it is not differentiated."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        images, alphas, meta = sound(**given)
        for name, change in changed.items():
            if not meta[name].requires_grad:
                meta[name] = change(given, meta[name])
        return images, alphas, meta

    return breaks


def _middle(given: Given) -> Given:
    Ks = given["Ks"].clone()
    Ks[..., 0, 2], Ks[..., 1, 2] = given["width"] / 2, given["height"] / 2
    return {"Ks": Ks}


def _rounded(value: Any, levels: float) -> Any:
    """Round, and let gradients pass."""
    return value + ((value * levels).round() / levels - value).detach()


def _translation_stays(given: Given) -> Given:
    V = given["viewmats"]
    return {"viewmats": _torch().cat((V[..., :3], V[..., 3:].detach()), -1)}


def _alpha_of_the_background(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    return images, alphas if given["backgrounds"] is None else alphas + (1.0 - alphas).detach(), meta


def _depth_of_nothing(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    if not given["render_mode"].endswith("ED"):
        return images, alphas, meta
    torch = _torch()
    nan = torch.where(alphas.detach() == 0.0, torch.nan, 0.0)
    return torch.cat((images[..., :-1], images[..., -1:] + nan), -1), alphas, meta


def _last_columns_black(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    whole = given["width"] // given["tile_size"] * given["tile_size"]
    keep = _torch().arange(given["width"], device=images.device) < (whole or given["width"])
    return images * keep[:, None], alphas * keep[:, None], meta


def _three_backgrounds(given: Given) -> Given:
    behind = given["backgrounds"]
    if behind is None or behind.shape[-1] <= 3:
        return {}
    return {"backgrounds": _torch().cat((behind[..., :3], _torch().zeros_like(behind[..., 3:])), -1)}


def _first_chunk_learns(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    return _torch().cat((images[..., :32], images[..., 32:].detach()), -1), alphas, meta


def _distances(given: Given) -> Any:
    R, t = given["viewmats"][..., :3, :3], given["viewmats"][..., None, :3, 3]
    return (given["means"][..., None, :, :] @ R.transpose(-1, -2) + t).norm(dim=-1)


def _far_by_distance(given: Given) -> Given:
    if given["viewmats"].shape[-3] > 1:
        return {}
    near_enough = _distances(given).squeeze(-2).detach() < given["far_plane"]
    return {"opacities": given["opacities"] * near_enough}


def _covariances_overruled(given: Given) -> Given:
    both = given["covars"] is not None and given["quats"] is not None and given["scales"] is not None
    return {"covars": None} if both else {}


def _normalized_in_place(sound: Rasterization, given: Given) -> Any:
    answer = sound(**given)
    if given["quats"] is not None:
        given["quats"].data.div_(given["quats"].data.norm(dim=-1, keepdim=True))
    return answer


def _strides_unread(given: Given) -> Given:
    means = given["means"]
    if means.is_contiguous():
        return {}
    flat = means.detach().contiguous().reshape(-1)
    return {"means": means + (flat.reshape(means.shape[::-1]).mT.reshape(means.shape) - means).detach()}


def _cotangent_of_strides(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    if images.requires_grad:
        images = images.clone()
        images.register_hook(lambda g: g if g.is_contiguous() else _torch().zeros_like(g))
    return images, alphas, meta


def _white_in_evaluation(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    clamps = not images.requires_grad and given["render_mode"] == "RGB"
    return images.clamp(max=1.0) if clamps else images, alphas, meta


def _background_of_the_first_entry(given: Given) -> Given:
    behind = given["backgrounds"]
    return {} if behind is None or behind.dim() < 3 else {"backgrounds": behind[:1].expand_as(behind)}


def _first_65536(given: Given) -> Given:
    n = given["means"].shape[-2]
    if n <= 65536:
        return {}
    return {"opacities": given["opacities"] * (_torch().arange(n, device=given["means"].device) < 65536)}


def _line_fails(sound: Rasterization, given: Given) -> Any:
    if min(given["width"], given["height"]) == 1:
        raise RuntimeError("squeeze of a picture of one row")
    return sound(**given)


def _all_bands(given: Given) -> Given:
    if given["sh_degree"] is None:
        return {}
    return {"sh_degree": round(given["colors"].shape[-2] ** 0.5) - 1}


def _colours_of_cameras(given: Given) -> Given:
    colors, C = given["colors"], given["viewmats"].shape[-3]
    plain = given["sh_degree"] is None and colors.dim() == 2 and given["viewmats"].dim() == 3
    return {"colors": colors[:, None].expand(C, C, -1)} if plain and C == len(colors) > 1 else {}


def _alphas_snap(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    return images, _torch().where(alphas > 0.99, alphas + (1.0 - alphas).detach(), alphas), meta


def passing(change: Callable[[Any], Any], *names: str) -> Breaks:
    return breaking(lambda given: {name: change(given[name]) for name in names if given[name] is not None})


_BOXES: Final = (
    (
        "principal_point_in_the_middle",
        "cx and cy are not read (viewers draw about the centre)",
        breaking(_middle),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "halves_of_quaternions",
        "w is taken to be positive, its sign is lost (three-component quaternions of compressed files)",
        passing(lambda q: _torch().cat((q[..., :1].abs(), q[..., 1:]), -1), "quats"),
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "no_axis_under_a_thousandth",
        "scales are at least 0.001 (flat Gaussians blow up some solvers)",
        passing(lambda s: s.clamp(min=1e-3), "scales"),
        "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike",
    ),
    (
        "no_axis_over_fifty",
        "scales are at most 50 (sky of SuperSplat's scenes)",
        passing(lambda s: s.clamp(max=50.0), "scales"),
        "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike",
    ),
    (
        "opacities_at_most_99_percent",
        "opacity is capped before the falloff, alpha after it is not",
        passing(lambda o: o.clamp(max=0.99), "opacities"),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "translation_learns_nothing",
        "of a camera only the rotation has a gradient",
        breaking(_translation_stays),
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "alpha_of_the_background",
        "with a background alpha is 1 everywhere",
        telling(_alpha_of_the_background),
        "test_signature_arguments:plain_colours_are_drawn_as_they_are",
    ),
    (
        "depth_of_nothing_is_nan",
        "expected depth is divided by an alpha of 0",
        telling(_depth_of_nothing),
        "test_signature_depth:the_expected_depth_is_the_accumulated_one_over_the_opacity",
    ),
    (
        "extents_in_sixteen_bits",
        "radii over 32,767 wrap (16-bit bounds of WebGPU viewers)",
        meta_telling(radii=lambda _, r: ((r + 2**15) % 2**16 - 2**15).to(r.dtype)),
        "test_signature_meta:extents_that_sixteen_bits_do_not_hold_are_told_as_they_are",
    ),
    (
        "extents_are_round",
        "both extents are the larger one (gsplat before 1.5)",
        meta_telling(radii=lambda _, r: r.amax(-1, keepdim=True).expand_as(r).contiguous()),
        "test_signature_cameras:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same",
    ),
    (
        "centres_told_from_corners",
        "screen centres are half a pixel off",
        meta_telling(means2d=lambda _, m: m - 0.5),
        "test_signature_meta:the_splats_that_meta_shows_where_nothing_requires_a_gradient_are_the_oracles",
    ),
    (
        "conics_told_backwards",
        "xx and yy change places",
        meta_telling(conics=lambda _, c: c.flip(-1)),
        "test_signature_meta:the_splats_that_meta_shows_where_nothing_requires_a_gradient_are_the_oracles",
    ),
    (
        "depths_told_from_the_near_plane",
        "depth is counted from the near plane",
        meta_telling(depths=lambda given, d: d - given["near_plane"]),
        "test_signature_meta:the_splats_that_meta_shows_where_nothing_requires_a_gradient_are_the_oracles",
    ),
    (
        "last_columns_black",
        "columns beyond the last whole tile are not drawn",
        telling(_last_columns_black),
        "test_signature_cameras:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same",
    ),
    (
        "tiles_of_sixteen",
        "tile_size is not read",
        breaking(lambda _: {"tile_size": 16}),
        "test_signature_meta:meta_says_what_was_asked",
    ),
    (
        "three_backgrounds",
        "the background of channels after the third is black",
        breaking(_three_backgrounds),
        "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike",
    ),
    (
        "first_chunk_learns",
        "channels after the thirty-second have no gradient",
        telling(_first_chunk_learns),
        "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients",
    ),
    (
        "far_by_distance",
        "the far plane is a sphere",
        breaking(_far_by_distance),
        "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients",
    ),
    (
        "nearest_plane_of_inria",
        "nothing nearer than 0.2 is drawn (Inria's rasterizer)",
        breaking(lambda given: {"near_plane": max(given["near_plane"], 0.2)}),
        "test_thresholds:at_the_near_plane_a_splat_is_wholly_there_or_wholly_gone",
    ),
    (
        "smallest_extent_kept",
        "what is exactly as large as radius_clip, or half a pixel less, is drawn",
        breaking(lambda given: {"radius_clip": max(given["radius_clip"] - 0.5, 0.0)}),
        "test_signature_arguments:what_is_no_larger_than_radius_clip_is_culled",
    ),
    (
        "blur_of_three_tenths",
        "eps2d is not read",
        breaking(lambda _: {"eps2d": 0.3}),
        "test_signature_arguments:the_low_pass_is_as_wide_as_the_call_says",
    ),
    (
        "covariances_overruled",
        "scales and quaternions go before covariances",
        breaking(_covariances_overruled),
        "test_signature_arguments:covariances_go_before_quaternions_and_scales",
    ),
    (
        "quaternions_normalized_in_place",
        "quaternions of the caller are normalized",
        _normalized_in_place,
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "strides_unread",
        "centres are read as if columns were rows where they are strided",
        breaking(_strides_unread),
        "test_autograd:how_arguments_lie_in_memory_changes_no_gradient",
    ),
    (
        "cotangent_of_strides",
        "a gradient that is expanded counts as 0",
        telling(_cotangent_of_strides),
        "test_autograd:how_cotangents_lie_in_memory_changes_no_gradient",
    ),
    (
        "white_in_evaluation",
        "without a gradient the picture is clamped",
        telling(_white_in_evaluation),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "background_of_the_first_entry",
        "entries of a batch share the first one's background",
        breaking(_background_of_the_first_entry),
        "test_signature_cameras:batch_entries_do_not_know_of_each_other",
    ),
    (
        "centres_in_half_precision",
        "centres are of 16 bits (textures of WebGL viewers)",
        passing(lambda m: m + (m.half().to(m.dtype) - m).detach(), "means"),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "opacities_in_eight_bits",
        "opacities have 256 values (.splat)",
        passing(lambda o: _rounded(o, 255.0), "opacities"),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "colours_in_eight_bits",
        "colours have steps of 1/255",
        passing(lambda c: _rounded(c, 255.0), "colors"),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "first_65536",
        "Gaussians from 65,536 on are not drawn (16-bit indices)",
        breaking(_first_65536),
        "test_scale:the_image_of_seventy_thousand_is_the_oracles",
    ),
    (
        "line_fails",
        "a picture of one row or column ends in an error",
        _line_fails,
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "scales_through_logarithms",
        "scales are the exponential of their logarithm, and a scale of 0 has a gradient of NaN",
        passing(lambda s: s.log().exp(), "scales"),
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "opacities_through_logits",
        "opacities are the sigmoid of their logit, and an opacity of 0 or 1 has a gradient of NaN",
        passing(lambda o: _torch().sigmoid(_torch().logit(o)), "opacities"),
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "all_bands",
        "sh_degree is what the harmonics have, not what is asked for",
        breaking(_all_bands),
        "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws",
    ),
    (
        "colours_of_cameras",
        "where there are as many Gaussians as cameras, a colour a Gaussian is read as one a camera",
        breaking(_colours_of_cameras),
        "test_signature_cameras:where_there_are_as_many_gaussians_as_cameras_a_colour_is_a_gaussians",
    ),
    (
        "alphas_snap_to_one",
        "alpha over 0.99 is told as 1",
        telling(_alphas_snap),
        "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws",
    ),
)

UNSEEN_BOXES: Final = tuple(BlackBox(*box) for box in _BOXES)
