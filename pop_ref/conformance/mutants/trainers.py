"""Mutants after bugs of public trainers, written before anybody looked which law would notice.

Some are lines of the program, others stand behind gsplat's signature. `docs/kit.md` says how many were killed by the
laws that there were.
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
        "depth_read_from_the_corner",
        "sparse depth is read as if centres of pixels were integers (gsplat's trainer, grid_sample with align_corners)",
        "stages/regularizers.py",
        "u, v = (places[:, 0] - 0.5).clamp(0.0, width - 1.0), (places[:, 1] - 0.5)",
        "u, v = (places[:, 0]).clamp(0.0, width - 1.0), (places[:, 1])",
        "test_few_photographs:a_point_at_the_centre_of_a_pixel_reads_the_depth_of_that_pixel_alone",
    ),
    (
        "depth_by_row_and_column",
        "places of sparse points are taken as row and column (fvdb-reality-capture PR#188 has to exchange them)",
        "stages/regularizers.py",
        "u, v = (places[:, 0] - 0.5).clamp(0.0, width - 1.0), (places[:, 1] - 0.5)",
        "u, v = (places[:, 1] - 0.5).clamp(0.0, width - 1.0), (places[:, 0] - 0.5)",
        "test_few_photographs:the_depth_of_sparse_points_is_compared_as_the_oracle_compares_it",
    ),
    (
        "depth_of_the_nearest_pixel",
        "sparse depth is read at the nearest pixel (fvdb-reality-capture PR#188)",
        "stages/regularizers.py",
        "a, b = u - left, v - top",
        "a, b = (u - left).round(), (v - top).round()",
        "test_few_photographs:the_depth_of_sparse_points_is_compared_as_the_oracle_compares_it",
    ),
    (
        "depths_compared_not_disparities",
        "depths are compared, not disparities: far points weigh most (fvdb-reality-capture PR#188)",
        "stages/regularizers.py",
        "return (rendered - disparities).abs()",
        "return (torch.where(seen, sampled, 0.0) - 1.0 / disparities).abs()",
        "test_few_photographs:the_depth_of_sparse_points_is_compared_as_the_oracle_compares_it",
    ),
    (
        "depth_of_nothing_is_infinite",
        "where nothing is drawn the disparity is infinite, and training ends in NaN (as brush PR#522 mends elsewhere)",
        "stages/regularizers.py",
        "rendered = torch.where(seen, 1.0 / torch.where(seen, sampled, 1.0), 0.0)",
        "rendered = torch.where(seen, 1.0 / sampled, 0.0)",
        "test_few_photographs:the_depth_of_sparse_points_is_compared_as_the_oracle_compares_it",
    ),
    (
        "points_behind_have_depths",
        "points behind the camera are mirrored into the picture (gsplat's COLMAP reader keeps depths > 0 alone)",
        "stages/regularizers.py",
        "in_camera[in_camera[:, 2] > 0.0]",
        "in_camera[in_camera[:, 2] != 0.0]",
        "test_few_photographs:points_behind_the_camera_outside_the_picture_or_left_out_by_a_mask_have_no_depth",
    ),
    (
        "points_outside_are_kept",
        "points right of the picture or below it are kept, and read the border (the same reader's bounds)",
        "stages/regularizers.py",
        "shown = (places >= 0.0).all(1) & (places[:, 0] < camera.width) & (places[:, 1] < camera.height)",
        "shown = (places >= 0.0).all(1)",
        "test_few_photographs:points_behind_the_camera_outside_the_picture_or_left_out_by_a_mask_have_no_depth",
    ),
    (
        "depth_mask_transposed",
        "the mask of sparse points is read as [x, y]",
        "stages/regularizers.py",
        "mask[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]",
        "mask[column.clamp(0, camera.height - 1), row.clamp(0, camera.width - 1)]",
        "test_few_photographs:points_behind_the_camera_outside_the_picture_or_left_out_by_a_mask_have_no_depth",
    ),
    (
        "regularizer_is_a_sum_of_rows",
        "the mean scale is a mean over Gaussians of sums over axes (the terms that nerfstudio PR#3436 lacked)",
        "stages/regularizers.py",
        "values.sum() / max(values.numel(), 1)",
        "values.sum() / max(len(values), 1)",
        "test_agreement:mean_activation_is_the_oracles",
    ),
    (
        "exposure_transposed",
        "an exposure multiplies rows in place of columns: Inria's file read by another program",
        "stages/appearance.py",
        "image.reshape(-1, 3), exposure[:, :3].T)",
        "image.reshape(-1, 3), exposure[:, :3])",
        "test_agreement:expose_is_the_oracles",
    ),
    (
        "exposure_without_offset",
        "an exposure is its matrix alone",
        "stages/appearance.py",
        "torch.addmm(exposure[:, 3], image",
        "torch.addmm(0.0 * exposure[:, 3], image",
        "test_agreement:expose_is_the_oracles",
    ),
    (
        "exposures_drift",
        "nothing keeps the colour that all exposures share out of the scene (LichtFeld-Studio PR#1892: the blue cast)",
        "stages/appearance.py",
        "return exposures - (exposures.mean(0) - torch.eye(3, 4, dtype=exposures.dtype))",
        "return exposures - 0.0 * exposures.mean(0)",
        "test_agreement:centred_exposures_is_the_oracles",
    ),
    (
        "exposures_centred_at_zero",
        "the mean exposure becomes 0, not the identity",
        "stages/appearance.py",
        "(exposures.mean(0) - torch.eye(3, 4, dtype=exposures.dtype))",
        "exposures.mean(0)",
        "test_agreement:centred_exposures_is_the_oracles",
    ),
    (
        "background_where_the_photograph_is",
        "another background is laid where a photograph is opaque (nerfstudio PR#2889 makes photographs follow it)",
        "stages/appearance.py",
        "(1.0 - alpha)[:, :, None] * (now - was)",
        "alpha[:, :, None] * (now - was)",
        "test_agreement:over_background_is_the_oracles",
    ),
    (
        "large_on_screen_need_a_gradient",
        "a Gaussian that is large on the screen is split only if its gradient is large, too (gsplat PR#354)",
        "density/control.py",
        'masks[1] | (state["radii"] > self.grow_scale2d)',
        'masks[1] | ((state["radii"] > self.grow_scale2d) & (state["grad2d"] > self.grow_grad2d * state["count"]))',
        "test_strategies:a_training_is_the_oracles_under_every_reading",
    ),
    (
        "reset_by_precedence",
        "step % every == 0 & step > 0 is never true: opacities are never reset (gsplat 1.5.3, #797, PR#776)",
        "density/control.py",
        "self.reset_every > 0 and step % self.reset_every == 0 and step < self.refine_stop_iter",
        "self.reset_every > 0 and (step % self.reset_every == 0 & step > 0) and step < self.refine_stop_iter",
        "test_density:the_gaussians_change_every_hundred_steps_and_opacities_are_reset_where_that_is_asked_for",
    ),
    (
        "children_turned_the_other_way",
        "children are drawn along the axes of the inverse rotation (brush PR#56)",
        "stages/density.py",
        '(rotmats_from_quats(params["quats"]) @',
        '(rotmats_from_quats(params["quats"]).mT @',
        "test_density:a_split_replaces_each_parent_by_two_smaller_children_drawn_from_it",
    ),
    (
        "extents_of_packed_rows",
        "packed extents are read by the row's number, not by its Gaussian (an index as in LichtFeld-Studio PR#2057)",
        "density/control.py",
        'info["gaussian_ids"].long(), largest, "amax"',
        'torch.arange(len(largest)) % len(state["radii"]), largest, "amax"',
        "test_strategies:a_training_is_the_oracles_under_every_reading",
    ),
    (
        "extents_by_the_width",
        "extents are a share of the width, not of the longer side: nobody sees it in wide pictures",
        "density/control.py",
        '/ max(int(info["width"]), int(info["height"]))',
        '/ int(info["width"])',
        "test_strategies:a_training_is_the_oracles_under_every_reading",
    ),
    (
        "extents_of_the_last_view",
        "the last view's extent counts, not the largest of the window",
        "density/control.py",
        'torch.maximum(state["radii"], seen.amax(0), out=state["radii"])',
        'state["radii"].copy_(seen.amax(0))',
        "test_strategies:a_training_is_the_oracles_under_every_reading",
    ),
    (
        "seen_along_one_axis",
        "since extents have two axes, one of them is enough to be seen (gsplat 1.5's radii)",
        "density/protocol.py",
        "return (radii > 0).all(-1)",
        "return (radii > 0).any(-1)",
        "test_strategies:a_training_by_pop_is_the_oracles_at_every_step",
    ),
    (
        "bands_counted_from_one",
        "bands are added a step early, as by code that counts iterations from 1 (Inria's)",
        "train/schedule.py",
        "max(step - start, 0) // interval",
        "max(step + 1 - start, 0) // interval",
        "test_optimizer:bands_wait_for_the_step_that_they_are_counted_from",
    ),
    (
        "positions_fall_linearly",
        "the positions' rate falls linearly (OpenSplat#6 had no schedule at first)",
        "train/schedule.py",
        'base["means"] * lr.means_decay**share',
        'base["means"] * (1.0 + (lr.means_decay - 1.0) * share)',
        "test_optimizer:the_position_rate_falls_log_linearly_to_a_hundredth",
    ),
    (
        "weights_decay",
        "Adam has a weight decay (a field of nerfstudio's optimizer settings)",
        "train/model.py",
        "betas=BETAS, eps=EPS, fused=True",
        "betas=BETAS, eps=EPS, fused=True, weight_decay=1e-3",
        "test_optimizer:adam_follows_the_scalar_recurrence",
    ),
    (
        "rows_without_gradient_stay",
        "rows without a gradient keep still, moments or not (selective Adam, LichtFeld-Studio PR#244)",
        "train/model.py",
        "            optimizer.step()\n",
        "            old = param.detach().clone()\n            optimizer.step()\n            "
        "param.data[param.grad == 0] = old[param.grad == 0]\n",
        "test_optimizer:rows_do_not_mix_and_rows_without_gradient_move_by_their_moments",
    ),
    (
        "window_forgets_this_view",
        "with a window of views this view's own dominant Gaussians are not important",
        "density/control.py",
        'mask = mask | importance_mask(state["dominant_sum"])',
        'mask = importance_mask(state["dominant_sum"])',
        "test_strategies:a_training_is_the_oracles_under_every_reading",
    ),
    (
        "flags_outlive_the_change",
        "blur flags go on after the Gaussians have changed",
        "density/rows.py",
        '    # rows that wait are not those of Gaussians that have been edited\n    state["blurred"] = '
        'state["dominant_sum"] = state["sh_rest_sum"] = None',
        '    state["dominant_sum"] = state["sh_rest_sum"] = None',
        "test_strategies:a_training_by_mini_splatting_is_the_oracles_at_every_step",
    ),
    (
        "budget_from_the_current_count",
        "Taming-3DGS's parabola begins at the present number of Gaussians",
        "density/methods.py",
        'context.state["first_count"], target)',
        "len(context), target)",
        "test_strategies:a_training_by_taming_is_the_oracles_at_every_step",
    ),
    (
        "colours_not_as_harmonics",
        "Mini-Splatting's new points have colours for coefficients",
        "density/methods.py",
        "(torch.cat(colors) - 0.5) / SH_C0",
        "torch.cat(colors)",
        "test_strategies:a_training_by_mini_splatting_is_the_oracles_at_every_step",
    ),
    (
        "fisher_at_full_size",
        "PUP-3DGS's scores are taken at full size",
        "density/methods.py",
        "context.sh_degree, divisor)",
        "context.sh_degree, 1)",
        "test_strategies:a_training_by_pup_is_the_oracles_at_every_step",
    ),
    (
        "hard_share_is_soft",
        "Speedy-Splat's hard pruning takes the soft share",
        "density/methods.py",
        "return self.hard_prune_share if",
        "return self.soft_prune_share if",
        "test_strategies:a_training_by_speedy_splat_is_the_oracles_at_every_step",
    ),
    (
        "masked_mean_forgets_channels",
        "a masked mean is over pixels, not over their channels, too",
        "stages/losses.py",
        "max(int(mask.sum()), 1) * image.shape[2]",
        "max(int(mask.sum()), 1)",
        "test_masked_losses:pixelwise_losses_of_what_a_mask_keeps_are_the_oracles",
    ),
    (
        "halved_not_in_the_gradient",
        "half of D-SSIM halves the value and not the gradient",
        "stages/losses.py",
        "weight = terms.d_ssim_weight if want_grad",
        "weight = (1.0 if terms.d_ssim_weight == 0.5 else terms.d_ssim_weight) if want_grad",
        "test_masked_losses:the_dissimilarity_of_what_a_mask_keeps_is_the_oracles",
    ),
    (
        "depth_clamped_not_slope",
        "the frustum clamp is of z, not of x / z (GaussianSplattingMlx PR#28)",
        "stages/projection.py",
        "return z * slope.clamp(low, high), (slope",
        "return slope * z.clamp(low, high), (slope",
        "test_agreement:projection_jacobians_is_the_oracles",
    ),
    (
        "three_sigma_for_all",
        "every extent is three deviations, though alpha is visible beyond (brush#97)",
        "stages/projection.py",
        "reach = reach.clamp_max(profile.extent_sigmas)",
        "reach = torch.full_like(reach, 3.0)",
        "test_footprint:no_point_as_bright_as_the_floor_lies_outside_the_extent",
    ),
    (
        "conic_gradient_twice",
        "the conic's off-diagonal gradient lacks its half (gsplat PR#136, PR#139)",
        "stages/projection.py",
        "h = 0.5 * v_b\n",
        "h = v_b\n",
        "test_agreement:conics_from_covars2d_vjp_is_the_oracles",
    ),
    (
        "colour_has_no_camera",
        "the gradient of colours by the camera's place is left out",
        "stages/projection.py",
        "v_viewmat[:3, 3] = -viewmat[:3, :3] @ v_center",
        "v_viewmat[:3, 3] = 0.0",
        "test_agreement:view_dirs_vjp_is_the_oracles",
    ),
    (
        "absolute_gradients_are_zero",
        "absolute gradients are never written (FastGS#35)",
        "api/rasterize.py",
        "absgrad_sink=image.absgrad,",
        "absgrad_sink=None,",
        "test_agreement:gradients_are_the_oracles",
    ),
)


def _given(change: Callable[[Given], Given]) -> Callable[[Rasterization, Given], Any]:
    return lambda sound, given: sound(**given | change(given))


def _depth_in_a_padded_channel(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    if given["render_mode"].startswith("RGB+") and images.shape[-1] == 5:
        torch = importlib.import_module("torch")
        images = torch.cat((images[..., :4], 0.0 * images[..., 4:]), -1)
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

    own = quats * 1.0
    own.register_hook(misplaced)
    return sound(**given | {"quats": own})


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
        torch = importlib.import_module("torch")
        less = images[..., -1:] * alphas.clamp_min(1e-10) / alphas.clamp_min(1e-2)
        images = torch.cat((images[..., :-1], less), -1)
    return images, alphas, meta


PLAIN: Final = "test_signature_arguments:plain_colours_are_drawn_as_they_are"
DEPTH: Final = "test_signature_depth:the_expected_depth_is_the_accumulated_one_over_the_opacity"
_BOXES: Final = (
    ("depth_in_a_padded_channel", "four channels and depth are padded to a number that kernels have, and depth is read "
     "behind the padding (gsplat PR#559)", _depth_in_a_padded_channel,
     "test_signature_depth:depth_follows_plain_colours_of_several_cameras"),
    ("quaternion_gradients_by_compact_rows", "the rotations' gradient is read by visible row where it is written by "
     "Gaussian (LichtFeld-Studio PR#2057)", _quats_by_compact_rows, PLAIN),
    ("depth_is_divided_always", "the accumulated depth is divided by the opacity as the expected one "
     "(as nerfstudio PR#2824 mends)", _given(_always_divided),
     "test_signature_depth:the_accumulated_depth_is_the_oracles_alone_and_behind_colours"),
    ("dark_splats_are_dropped", "splats that are black by eight bits are dropped (brush#250)",
     _given(_dark_are_dropped), "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike"),
    ("absolute_gradients_are_inverted", "absolute gradients are summed where nobody asks for them (fvdb-core#354)",
     _given(lambda given: {"absgrad": not given["absgrad"]}),
     "test_gradients:asking_for_dominance_and_counts_changes_neither_image_nor_gradient"),
    ("one_focal_length", "pixels are square: fy is fx", _given(_one_focal_length), PLAIN),
    ("principal_point_centred", "the principal point is the picture's centre (Inria's cameras)",
     _given(_centred), PLAIN),
    ("expected_depth_of_the_faint", "the expected depth is divided by a hundredth at least, where less is opaque",
     _faint_are_not_divided, DEPTH),
)  # fmt: skip

TRAINERS: Final = tuple(Mutant(*line, package=PACKAGE) for line in _LINES)
TRAINERS_BOXES: Final = tuple(BlackBox(*box) for box in _BOXES)
