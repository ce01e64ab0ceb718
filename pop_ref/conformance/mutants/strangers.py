"""Forty mutants after bugs of public rasterizers and trainers, written by somebody who had not read the laws.

`docs/kit.md` says how many were killed by the laws that there were. Some are lines of the program, others stand behind
gsplat's signature.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, Final

from pop_ref.conformance.mutants.black_box import BlackBox, Rasterization
from pop_ref.conformance.mutants.copies import PROGRAM as PACKAGE
from pop_ref.conformance.mutants.copies import Mutant

Given = dict[str, Any]

_LINES: Final = (
    (
        "first_view_shows_everybody",
        "in the first view every Gaussian counts as seen (nerfstudio's splatfacto and OpenSplat began with ones)",
        "density/control.py",
        'state["count"] = torch.zeros(n, dtype=grads.dtype, device=grads.device)',
        'hidden = torch.zeros(1, n) if packed else ~visible_from_radii(info["radii"])\n'
        '            state["count"] = hidden.to(grads.dtype).sum(0)',
        "test_strategies:a_training_by_pop_is_the_oracles_at_every_step",
    ),
    (
        "gradients_by_the_longer_side",
        "both components of the screen gradient are scaled by the longer side (OpenSplat, splatfacto)",
        "density/control.py",
        'unit = grads.new_tensor([0.5 * info["width"] * cameras, 0.5 * info["height"] * cameras])',
        'unit = grads.new_tensor([0.5 * max(info["width"], info["height"]) * cameras] * 2)',
        "test_strategies:a_training_by_pop_is_the_oracles_at_every_step",
    ),
    (
        "blurred_of_any_size_are_split",
        "a second criterion passes the bound of size by (Gaussian-Splatting-with-Stochastic-Solids#14)",
        "stages/density.py",
        "return (by_grad | by_blur) & small, (by_grad | by_blur) & ~small",
        "return (by_grad | by_blur) & small, (by_grad & ~small) | by_blur",
        "test_strategies:a_training_by_pop_is_the_oracles_at_every_step",
    ),
    (
        "sizes_of_children_interleaved",
        "children lie one block after the other, their sizes pairwise (repeat_interleave beside gsplat's repeat)",
        "stages/density.py",
        "torch.log(scales / SPLIT_SHRINK).repeat(SPLIT_CHILDREN, 1)",
        "torch.log(scales / SPLIT_SHRINK).repeat_interleave(SPLIT_CHILDREN, 0)",
        "test_strategies:a_training_by_pop_is_the_oracles_at_every_step",
    ),
    (
        "new_rows_have_no_size",
        "clones and children begin with an extent of 0, so that no bound on the screen prunes them (graphdeco#741)",
        "density/rows.py",
        "None if sources is None else value[sources]",
        "None if sources is None else torch.zeros_like(value[sources])",
        "test_strategies:a_training_is_the_oracles_under_every_reading",
    ),
    (
        "skipped_updates_keep_their_gradients",
        "gradients are cleared where an update is made, and pile up where it is skipped (nerfstudio's accumulation)",
        "train/model.py",
        "            counter.fill_(float(number))\n        optimizer.zero_grad(set_to_none=True)",
        "            counter.fill_(float(number))\n            optimizer.zero_grad(set_to_none=True)",
        "test_strategies:a_training_by_taming_is_the_oracles_at_every_step",
    ),
    (
        "adam_counts_the_training",
        "the bias correction is of the training's iteration, not of the updates (fused Adam kernels)",
        "train/model.py",
        "counter.fill_(float(number - 1))",
        "counter.fill_(float(step))",
        "test_strategies:a_training_by_3dgs_is_the_oracles_at_every_step",
    ),
    (
        "last_gradient_of_those_that_wait",
        "of the gradients that wait for an update the last one counts, not their sum (zero_grad at every step)",
        "train/model.py",
        "waiting if param.grad is None else param.grad if waiting is None else waiting + param.grad",
        "waiting if param.grad is None else param.grad",
        "test_strategies:a_training_by_taming_is_the_oracles_at_every_step",
    ),
    (
        "resets_raise_the_faint",
        "a reset sets all opacities to its ceiling, also those below it (asked about in graphdeco#556)",
        "density/rows.py",
        "opacities.clamp_(max=math.log(ceiling / (1.0 - ceiling)))",
        "opacities.fill_(math.log(ceiling / (1.0 - ceiling)))",
        "test_strategies:a_training_by_gsplat_is_the_oracles_at_every_step",
    ),
    (
        "clamped_by_the_width",
        "the frustum clamp has the horizontal bound along y, too (UnityGaussianSplatting#196)",
        "stages/projection.py",
        "_clamp_one(y, z, fy, cy, height, profile)",
        "_clamp_one(y, z, fy, cy, width, profile)",
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "last_entry_lost",
        "the last tile's list ends one entry early (get_tile_bin_edges, gsplat PR#113)",
        "stages/tiles.py",
        "    n_tiles = tiles_x * tiles_y\n    order",
        "    kept = tile.argsort(stable=True)[:-1].sort().values\n"
        "    n_tiles, ids, tile = tiles_x * tiles_y, ids[kept], tile[kept]\n    order",
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "tile_numbers_in_sixteen_bits",
        "tile numbers from 32,768 on are negative in the keys that are sorted (16-bit keys of taichi-splatting)",
        "stages/tiles.py",
        "n_tiles < 2**15",
        "n_tiles < 2**16",
        "test_signature_meta:of_more_tiles_than_sixteen_bits_number_each_lists_who_overlaps_it",
    ),
    (
        "tight_tiles_transposed",
        "AccuTile's entries land in the wrong tile where a picture is not square (brush PR#512)",
        "stages/tiles.py",
        "tile = (y * tiles_x + x).to(torch.int32)",
        "tile = (y * tiles_y + x).to(torch.int32)",
        "test_tight_tiles:the_image_of_tight_lists_is_that_of_whole_rectangles",
    ),
    (
        "extremes_exchanged",
        "AccuTile looks for the leftmost point where the rightmost is (brush PR#512)",
        "stages/tiles.py",
        "for at in (-at_right, at_right))",
        "for at in (at_right, -at_right))",
        "test_tight_tiles:a_tile_is_kept_exactly_if_it_meets_the_ellipse_of_what_can_be_seen",
    ),
    (
        "extents_of_at_most_1024",
        "no extent is over 1,024 px (antimatter15/splat, UntoldEngine PR#1207)",
        "stages/projection.py",
        ".clamp_max(1e9)",
        ".clamp_max(1024)",
        "test_footprint:extents_have_no_upper_bound",
    ),
    (
        "blurred_determinant_is_constant",
        "the antialiasing factor's gradient leaves out the determinant under it (add_blur_vjp of gsplat's first ports)",
        "stages/projection.py",
        "v_xx = v_det * yy + v_det_blurred * (yy + eps2d)",
        "v_xx = v_det * yy",
        "test_agreement:antialiased_gradients_are_the_oracles",
    ),
    (
        "extents_of_the_uncompensated",
        "antialiased splats have the extents of the opacity that they had before (an order that gsplat#1011 describes)",
        "stages/splatting.py",
        "radii = radii_from_covars2d(blurred, effective_opacities, profile)",
        "radii = radii_from_covars2d(blurred, opacities, profile)",
        "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws",
    ),
    (
        "gradient_of_scales_for_logarithms",
        "the gradient by a log-scale lacks the scale (fvdb-core#432)",
        "stages/covariance.py",
        "return torch.exp(log_scales) * v_scales",
        "return v_scales",
        "test_agreement:scales_from_log_scales_vjp_is_the_oracles",
    ),
    (
        "keys_with_as_few_bits_as_tiles",
        "a key's tile has a bit less where the number of tiles is a power of two (log2 rounded up in gsplat's ports)",
        "api/rasterize.py",
        "math.floor(math.log2(lists.tiles_x * lists.tiles_y)) + 1",
        "math.ceil(math.log2(lists.tiles_x * lists.tiles_y))",
        "test_signature_pairs:every_pair_of_arguments_lists_tiles_front_to_back",
    ),
    (
        "offsets_begin_anew",
        "every camera's tile offsets begin at 0 (as an index of another camera in gsplat#806)",
        "api/rasterize.py",
        "offsets.append((found.offsets[:-1] + before).to(torch.int32))",
        "offsets.append(found.offsets[:-1].to(torch.int32))",
        "test_signature_meta:the_tile_lists_that_meta_shows_run_front_to_back_and_hold_who_is_blended",
    ),
    (
        "smaller_views_without_rounding",
        "pixels of a smaller view are rounded, its K is not (nerfstudio's rescale_output_resolution)",
        "density/passes.py",
        "K[1] *= height / view.height",
        "K[1] /= divisor",
        "test_collected:fisher_blocks_are_those_of_a_smaller_photograph_of_the_same_field_of_view",
    ),
    (
        "whole_windows_over_all_pixels",
        "the mean over whole windows is divided by the number of pixels (fused-ssim crops its map for 'valid')",
        "stages/losses.py",
        "n = moments.mu_y.numel() if kept is None",
        "n = d.numel() if kept is None",
        "test_masked_losses:the_dissimilarity_of_large_pictures_beyond_black_and_white_is_the_oracles",
    ),
)


def _torch() -> Any:
    return importlib.import_module("torch")


def _given(change: Callable[[Given], Given]) -> Callable[[Rasterization, Given], Any]:
    return lambda sound, given: sound(**given | change(given))


def _fails(where: Callable[[Given], bool], words: str) -> Callable[[Rasterization, Given], Any]:
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


def _depth_of(value: Callable[[Given], Any]) -> Callable[[Rasterization, Given], Any]:
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
        return _torch().cat((images[..., :-1], depth), -1), alphas, meta

    return breaks


def _in_camera(means: Any, viewmats: Any) -> Any:
    """Return the centres as every camera has them, [..., C, N, 3]."""
    R, t = viewmats[..., :3, :3], viewmats[..., None, :3, 3]
    return means[..., None, :, :] @ R.transpose(-1, -2) + t


def _background_twice(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    behind = given["backgrounds"]
    if behind is None or given["render_mode"] != "RGB" or not images.requires_grad:
        return images, alphas, meta
    once = behind.detach()[..., None, None, :]
    # nothing is added but a gradient
    more = (once * (alphas.detach() - alphas)).expand_as(images)
    return images + more, alphas, meta


def _harmonics_learn_of_the_last_camera(given: Given) -> Given:
    colors, cameras = given["colors"], given["viewmats"].shape[-3]
    shared = given["sh_degree"] is not None and colors.dim() - 3 != given["viewmats"].dim() - 2
    if not shared or cameras < 2:
        return {}
    each = colors.unsqueeze(-4)
    return {"colors": _torch().cat([each.detach()] * (cameras - 1) + [each], -4)}


def _absolute_of_the_sum(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if given["packed"] and given["absgrad"] and meta["means2d"].requires_grad:
        centres = meta["means2d"]

        def replaced(grad: Any) -> None:
            centres.absgrad.copy_(grad.abs())

        centres.register_hook(replaced)
    return images, alphas, meta


def _centres_are_a_copy(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if meta["means2d"].requires_grad:
        meta["means2d"] = meta["means2d"].detach().clone().requires_grad_()
    return images, alphas, meta


def _opacities_told_as_given(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if given["rasterize_mode"] == "antialiased" and not given["packed"]:
        meta["opacities"] = given["opacities"].detach()[..., None, :].expand_as(meta["opacities"])
    return images, alphas, meta


def _background_of_the_call_before() -> Callable[[Rasterization, Given], Any]:
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


def _one_entry_has_no_axis(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if given["means"].dim() == 3 and len(given["means"]) == 1:
        return images.squeeze(0), alphas.squeeze(0), meta
    return images, alphas, meta


def _centres_in_a_wider_picture(given: Given) -> Given:
    if given["viewmats"].shape[-3] > 1:
        return {}
    x, y, z = _in_camera(given["means"], given["viewmats"]).squeeze(-3).detach().unbind(-1)
    K, width, height = given["Ks"].squeeze(-3), given["width"], given["height"]
    u = (K[..., 0, 0, None] * x / z + K[..., 0, 2, None]) / (0.5 * width) - 1.0
    v = (K[..., 1, 1, None] * y / z + K[..., 1, 2, None]) / (0.5 * height) - 1.0
    return {"opacities": given["opacities"] * ((u.abs() <= 1.2) & (v.abs() <= 1.2))}


def _alphas_without_gradient(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    return images, alphas.detach(), meta


_BOXES: Final = (
    (
        "render_at_most_white",
        "what is brighter than 1 is clamped (splatfacto and OpenSplat clamp the render)",
        _at_most_white,
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "nothing_in_view_fails",
        "a call in which no Gaussian is visible ends in an error (gsplat#107)",
        _nothing_in_view_fails,
        "test_compositing:light_never_rises_when_a_splat_is_added_behind",
    ),
    (
        "degree_zero_fails",
        "a degree of 0 is read as no degree, and the colours' shape is refused (gsplat#268)",
        _fails(lambda given: given["sh_degree"] == 0, "colors.dim() == 2"),
        "test_agreement:dominant_ids_are_the_oracles",
    ),
    (
        "empty_scene_fails",
        "a scene without Gaussians ends in an error (gsplat.js PR#84)",
        _fails(lambda given: given["means"].shape[-2] == 0, "no splats"),
        "test_compositing:light_never_rises_when_a_splat_is_added_behind",
    ),
    (
        "one_gaussian_fails",
        "of a single Gaussian an axis is squeezed away (GaussianSplats3D PR#264)",
        _fails(lambda given: given["means"].shape[-2] == 1, "squeeze"),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "depth_does_not_move_means",
        "depth has a gradient by what is blended, none by the centres (ashawkey/diff-gaussian-rasterization#7)",
        _depth_of(lambda given: _in_camera(given["means"], given["viewmats"])[..., 2].detach()),
        "test_signature_depth:the_accumulated_depth_is_the_oracles_alone_and_behind_colours",
    ),
    (
        "depth_does_not_move_cameras",
        "depth's gradient by the camera is lost (LucidDreamer#26)",
        _depth_of(lambda given: _in_camera(given["means"], given["viewmats"].detach())[..., 2]),
        "test_signature_depth:the_accumulated_depth_is_the_oracles_alone_and_behind_colours",
    ),
    (
        "depth_along_the_ray",
        "depth is the distance from the camera (as nerfstudio's rays have it)",
        _depth_of(lambda given: _in_camera(given["means"], given["viewmats"]).norm(dim=-1)),
        "test_signature_depth:the_accumulated_depth_is_the_oracles_alone_and_behind_colours",
    ),
    (
        "background_twice_in_the_gradient",
        "the background behind a splat counts twice in the gradient by alpha (diff-gaussian-rasterization#86)",
        _background_twice,
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "harmonics_learn_of_the_last_camera",
        "cameras write their gradients of shared harmonics over each other (fvdb-core PR#434)",
        _given(_harmonics_learn_of_the_last_camera),
        "test_signature_arguments:without_a_background_it_is_black",
    ),
    (
        "absolute_of_the_sum",
        "packed rows have the absolute value of the sum, not the sum of absolute values (fvdb-core#354)",
        _absolute_of_the_sum,
        "test_signature_cameras:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same",
    ),
    (
        "centres_told_are_a_copy",
        "meta's screen centres are none of the graph, and get no gradient (asked for in taichi-splatting#4)",
        _centres_are_a_copy,
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "opacities_told_as_given",
        "meta has opacities before antialiasing, and what draws by them is too opaque (nerfstudio PR#2966)",
        _opacities_told_as_given,
        "test_signature_pairs:every_pair_of_arguments_shows_the_oracles_splats",
    ),
    (
        "background_of_the_call_before",
        "without backgrounds those of the call before are behind (splatfacto's background in evaluation)",
        _background_of_the_call_before(),
        "test_signature_arguments:without_a_background_it_is_black",
    ),
    (
        "one_entry_has_no_axis",
        "a batch of one loses its dimension (batches of gsplat, PR#695)",
        _one_entry_has_no_axis,
        "test_signature_pairs:arguments_that_are_taken_alone_are_taken_together",
    ),
    (
        "centres_in_a_wider_picture",
        "a splat whose centre is 20 % beyond the picture is left out (antimatter15/splat)",
        _given(_centres_in_a_wider_picture),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "alphas_without_gradient",
        "a loss of alpha teaches nothing (ashawkey/diff-gaussian-rasterization PR#6)",
        _alphas_without_gradient,
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "radius_clip_exclusive",
        "a Gaussian exactly as large as radius_clip is drawn (gsplat compares with <=)",
        _given(lambda given: {"radius_clip": given["radius_clip"] * (1.0 - 2.0**-20)}),
        "test_signature_arguments:what_is_no_larger_than_radius_clip_is_culled",
    ),
)

STRANGERS: Final = tuple(Mutant(*line, package=PACKAGE) for line in _LINES)
STRANGERS_BOXES: Final = tuple(BlackBox(*box) for box in _BOXES)
