"""A third round of errors, written with the laws and the tests unread, and tried on the laws that there were.

Lines of the oracle and of the program that trains; `blind_third_boxes` has the rasterizers.
"""

from __future__ import annotations

from typing import Final

from pop_ref.conformance.mutants.copies import PROGRAM as PACKAGE
from pop_ref.conformance.mutants.copies import Mutant

_ORACLE: Final = (
    (
        "lower_degree_weighs_one_side",
        "fitting colours of a lower degree, views weigh in the matrix and not in the right-hand side",
        "harmonics.py",
        "right += weight * np.outer(kept, dropped)",
        "right += np.outer(kept, dropped)",
        "test_harmonics:a_band_less_is_made_up_for_where_a_view_shows_it_by_its_weight",
    ),
    (
        "far_plane_forgotten",
        "what lies beyond the far plane is drawn",
        "camera.py",
        "return beyond_near & (depths <= profile.far_plane)",
        "return beyond_near",
        "test_camera:the_far_plane_is_beyond_every_scene",
    ),
    (
        "clamped_offset_is_a_constant",
        "where the frustum clamp acts, nothing is pulled through the depth either",
        "projection.py",
        "return 0.0, fx * tx / (z * z * z) * v_offset",
        "return 0.0, 0.0",
        "test_agreement:projection_jacobians_vjp_is_the_oracles",
    ),
    (
        "factor_learns_from_its_product",
        "the antialiasing factor's cotangent is multiplied by the opacity that has the factor in it already",
        "splatting.py",
        "v_factors = v_seen_opacities * seen.opacities",
        "v_factors = v_seen_opacities * shape.opacities",
        "test_agreement:antialiased_gradients_are_the_oracles",
    ),
    (
        "depth_over_the_background",
        "in the modes of depth alone, depth is laid over the background's first channel",
        "render.py",
        "else np.zeros(1)",
        "else background[:1]",
        "test_signature_depth:the_accumulated_depth_is_the_oracles_alone_and_behind_colours",
    ),
    (
        "discriminant_from_zero",
        "the square extent's discriminant is bounded by 0, not by 0.1",
        "footprint.py",
        "math.sqrt(max(0.1, ",
        "math.sqrt(max(0.0, ",
        "test_footprint:known_square_extents_of_circles",
    ),
    (
        "weight_of_the_first",
        "the dominant weight is that of the first blended splat",
        "compositing.py",
        "max(pixel.weights, default=0.0)",
        "next(iter(pixel.weights), 0.0)",
        "test_agreement:dominant_weights_are_the_oracles",
    ),
    (
        "fisher_over_black",
        "the moments take what is behind a pixel for black",
        "fisher.py",
        "suffix_color = np.array(black_or_given)",
        "suffix_color = np.zeros(_N_CHANNELS)",
        "test_fisher:screen_moments_are_the_oracles",
    ),
    (
        "depth_sampled_half_a_pixel_off",
        "rendered depth is sampled as though pixel centres had whole coordinates along x",
        "regularizers.py",
        "np.clip(place[0] - 0.5, ",
        "np.clip(place[0], ",
        "test_agreement:sparse_depth_loss_is_the_oracles",
    ),
    (
        "mask_at_the_windows_corner",
        "without padding a window is kept by the mask at its corner, not at its centre",
        "ssim.py",
        "kept[margin:-margin, margin:-margin]",
        "kept[: -2 * margin, : -2 * margin]",
        "test_masked_losses:the_dissimilarity_of_what_a_mask_keeps_is_the_oracles",
    ),
    (
        "empty_views_do_not_count",
        "a view that shows no Gaussian is not a view of the window",
        "density.py",
        "n_views=statistics.n_views + 1",
        "n_views=statistics.n_views + int(np.any(visible))",
        "test_density:the_density_statistic_averages_ndc_gradients_over_the_views_that_showed_the_gaussian",
    ),
    (
        "copies_are_split_too",
        "the copy of a Gaussian that is cloned and split is split with it",
        "density.py",
        "np.concatenate([split, np.zeros(int(np.sum(clone)), dtype=bool)])",
        "np.concatenate([split, split[clone]])",
        "test_density:the_copy_of_a_gaussian_that_is_cloned_and_split_stays_whole",
    ),
    (
        "second_moments_survive_a_reset",
        "a reset of opacities forgets the first moments only",
        "density_rows.py",
        '{**rows.v, "opacities": zeros.copy()},',
        "dict(rows.v),",
        "test_density:a_reset_lowers_opacities_to_the_ceiling_and_forgets_their_moments_only",
    ),
)

_PROGRAM: Final = (
    (
        "blur_seen_only_while_it_is_split",
        "views of the window before the first blur step are not looked at for blurred Gaussians",
        "density/control.py",
        "return self.collects(step) and step <= self.blur_stop_iter",
        "return self.collects(step) and self.blur_start_iter <= step <= self.blur_stop_iter",
        "test_density:the_blur_set_dominates_strictly_more_than_its_share_of_pixels",
    ),
    (
        "cameras_blur_together",
        "dominated pixels of a step's cameras are added up before they are compared with one image's share",
        "density/control.py",
        "blur_set(dominant_counts(info), *bound).any(0)",
        "blur_set(dominant_counts(info).sum(0), *bound)",
        "test_strategies:a_training_by_mini_splatting_is_the_oracles_at_every_step",
    ),
    (
        "important_in_the_first_camera",
        "the prior looks at the first camera's dominant counts",
        "density/control.py",
        "importance_mask(dominant_counts(info).sum(0))",
        "importance_mask(dominant_counts(info)[0])",
        "test_strategies:a_training_by_pop_is_the_oracles_at_every_step",
    ),
    (
        "large_extents_wait_for_clones",
        "a Gaussian of a large extent that is cloned is not split",
        "density/control.py",
        'masks[1] | (state["radii"] > self.grow_scale2d)',
        'masks[1] | ((state["radii"] > self.grow_scale2d) & ~masks[0])',
        "test_strategies:a_training_is_the_oracles_under_every_reading",
    ),
    (
        "window_cleared_before_the_prune",
        "the window is cleared before extents have been pruned by",
        "density/control.py",
        "        done = DensificationStep(n_clones, n_splits, rows.prune_marked(context, prunes()))\n"
        "        rows.clear(context.state)\n",
        "        rows.clear(context.state)\n"
        "        done = DensificationStep(n_clones, n_splits, rows.prune_marked(context, prunes()))\n",
        "test_strategies:a_training_is_the_oracles_under_every_reading",
    ),
    (
        "views_of_all_windows",
        "a new window goes on counting views",
        "density/rows.py",
        'state["count"].zero_()\n    state["views"] = 0\n',
        'state["count"].zero_()\n',
        "test_density:a_densification_step_is_the_oracles_under_every_reading",
    ),
    (
        "rewound_to_the_start",
        "the rate of the centres is rewound to step 0",
        "train/schedule.py",
        "torch.where(steps < rules.means_rewind_iter, steps, steps - back)",
        "torch.where(steps < rules.means_rewind_iter, steps, steps - rules.means_rewind_iter)",
        "test_optimizer:rates_rewind_and_fall_in_rounds_as_the_rules_say",
    ),
    (
        "the_last_gradient_counts",
        "of the gradients that wait for an update the last one is kept",
        "train/model.py",
        "param.grad if waiting is None else waiting + param.grad",
        "param.grad",
        "test_strategies:a_training_by_taming_is_the_oracles_at_every_step",
    ),
    (
        "budget_of_the_present",
        "Taming's budget multiplies the number of Gaussians now, not that at the start",
        "density/methods.py",
        'self.target(context.state["first_count"])',
        "self.target(len(context))",
        "test_strategies:a_training_by_taming_is_the_oracles_at_every_step",
    ),
    (
        "dominant_in_the_last_view",
        "Mini-Splatting's importance is 0 for what dominates no pixel of the last view",
        "density/methods.py",
        "dominant_sum += found.dominant_counts.cpu()",
        "dominant_sum = found.dominant_counts.cpu()",
        "test_strategies:a_training_by_mini_splatting_is_the_oracles_at_every_step",
    ),
    (
        "pruned_in_place_of_grown",
        "Speedy-Splat does not densify at steps at which it prunes by sensitivity",
        "density/methods.py",
        "if self.is_refine_step(context.step) else DensificationStep()",
        "if self.is_refine_step(context.step) and not self.needs_passes(context.step) else DensificationStep()",
        "test_strategies:a_training_by_speedy_splat_is_the_oracles_at_every_step",
    ),
    (
        "either_extent_is_clipped",
        "radius_clip culls a splat of which one extent is small",
        "stages/splatting.py",
        "(radii > view.radius_clip).any(1)",
        "(radii > view.radius_clip).all(1)",
        "test_signature_arguments:what_is_no_larger_than_radius_clip_is_culled",
    ),
    (
        "opacities_of_another_scene",
        "opacities go round by image, not by scene",
        "api/rasterize.py",
        "opacities[i // n]",
        "opacities[i % len(opacities)]",
        "test_signature_cameras:batch_entries_do_not_know_of_each_other",
    ),
)

BLIND_THIRD: Final = tuple(Mutant(*line) for line in _ORACLE)
BLIND_THIRD_PROGRAM: Final = tuple(Mutant(*line, package=PACKAGE) for line in _PROGRAM)
