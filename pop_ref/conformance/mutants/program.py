"""Mutants of the program that trains: its row operations, its strategy, its optimizers, and what it draws by when
nothing but an image is asked for."""

from __future__ import annotations

from typing import Final

from pop_ref.conformance.mutants.copies import PROGRAM as PACKAGE
from pop_ref.conformance.mutants.copies import Mutant

SPLIT = "test_density:a_split_replaces_each_parent_by_two_smaller_children_drawn_from_it"
PRUNING = "test_density:survivors_of_pruning_keep_their_order_bits_and_moments"
CLONES = "test_density:clones_are_exact_copies_at_the_end_with_fresh_moments"
RESET = "test_density:a_reset_lowers_opacities_to_the_ceiling_and_forgets_their_moments_only"
AVERAGE = "test_density:the_density_statistic_averages_ndc_gradients_over_the_views_that_showed_the_gaussian"
FLAGS = "test_density:blur_flags_combine_over_views_as_the_reading_says"
STEP = "test_density:a_densification_step_is_the_oracles_under_every_reading"
RESETS = "test_density:the_gaussians_change_every_hundred_steps_and_opacities_are_reset_where_that_is_asked_for"
TINY = "test_optimizer:gradients_of_any_smallness_take_whole_steps"
WAIT = "test_optimizer:harmonics_that_wait_do_not_move_and_their_counter_goes_on"
RATE = "test_optimizer:the_position_rate_falls_log_linearly_to_a_hundredth"
PLAIN = "test_agreement:the_image_that_training_draws_is_one_of_the_oracles_outcomes"
ASKED = "test_gradients:asking_for_dominance_and_counts_changes_neither_image_nor_gradient"

PRIOR = "test_strategies:the_prior_begins_and_ends_where_it_is_told_and_is_as_heavy_as_it_is_told"
CAMERAS = "test_strategies:of_several_cameras_any_may_show_that_a_gaussian_is_important"
READINGS = "test_strategies:a_training_is_the_oracles_under_every_reading"
PACKED = "test_strategies:packed_rows_are_collected_as_all_rows_are"
TRAINED = "test_strategies:edited_parameters_are_trained_as_they_were"
HELD = "test_strategies:after_every_step_each_optimizer_holds_its_parameter_and_nothing_else"
COUNTED = "test_strategies:an_edit_does_not_touch_the_counter_of_updates"
OF_3DGS = "test_strategies:a_training_by_3dgs_is_the_oracles_at_every_step"
OF_MINI = "test_strategies:a_training_by_mini_splatting_is_the_oracles_at_every_step"
OF_TAMING = "test_strategies:a_training_by_taming_is_the_oracles_at_every_step"
OF_PUP = "test_strategies:a_training_by_pup_is_the_oracles_at_every_step"

_LINES: Final = (
    (
        "moments_of_the_next_row",
        "an edit gathers the moments one row off: every survivor continues with its neighbour's momentum",
        "density/rows.py",
        "moments[name] = edited(value, None",
        "moments[name] = edited(value.roll(1, 0), None",
        PRUNING,
    ),
    (
        "copies_begin_with_momentum",
        "appended rows start with moments of their own values instead of zero",
        "density/rows.py",
        "None if tail is None else torch.zeros_like(tail)",
        "tail",
        CLONES,
    ),
    (
        "reset_keeps_moments",
        "a reset lowers the opacities and keeps their moments, which carry them up again",
        "density/rows.py",
        "value.shape == opacities.shape:\n            value.zero_()\n",
        "value.shape == opacities.shape:\n            pass\n",
        RESET,
    ),
    (
        "splits_keep_the_opacity",
        "the step forgets that revised opacities were asked for: two children are denser than their parent (A26)",
        "density/control.py",
        "context.draws.normals(n_splits),\n                self.revised_opacity,\n",
        "context.draws.normals(n_splits),\n",
        STEP,
    ),
    (
        "square_pixels_of_ndc",
        "the screen gradient is scaled by the width along both axes",
        "density/control.py",
        '0.5 * info["height"] * cameras',
        '0.5 * info["width"] * cameras',
        AVERAGE,
    ),
    (
        "every_view_counted",
        "views that do not show a Gaussian are counted in its average (A23)",
        "density/control.py",
        'state["count"].add_(visible.sum(0))',
        'state["count"].add_(len(visible))',
        AVERAGE,
    ),
    (
        "window_without_end",
        "the views that showed a Gaussian are counted from the first step on, its gradients from the last change",
        "density/rows.py",
        '    state["count"].zero_()\n',
        "",
        STEP,
    ),
    (
        "growth_in_world_units",
        "the size that decides between clone and split is in world units: scene_scale is forgotten",
        "density/control.py",
        'grow_masks(window(state), context.params["scales"].exp(), state["scene_scale"]',
        'grow_masks(window(state), context.params["scales"].exp(), 1.0',
        STEP,
    ),
    (
        "pruning_in_world_units",
        "the size over which a Gaussian is pruned is in world units: scene_scale is forgotten",
        "density/control.py",
        'prune_mask(opacities, context.params["scales"].exp(), state["scene_scale"]',
        'prune_mask(opacities, context.params["scales"].exp(), 1.0',
        STEP,
    ),
    (
        "clones_before_survivors",
        "a Gaussian to split is looked up as if the clones stood before the rest",
        "density/control.py",
        "padded = torch.cat([splits, splits.new_zeros(n_clones)])",
        "padded = torch.cat([splits.new_zeros(n_clones), splits])",
        STEP,
    ),
    (
        "reset_at_the_first_step",
        "opacities are reset at step 0, before anything has been learnt (A25)",
        "density/control.py",
        "(step > 0 or self.reset_at_zero)",
        "(step >= 0 or self.reset_at_zero)",
        RESETS,
    ),
    (
        "blur_flag_of_one_view",
        "the blur flag of earlier views is forgotten: only the last view counts (A2)",
        "density/control.py",
        '        blurred |= state["blurred"]\n',
        "        blurred |= blurred\n",
        FLAGS,
    ),
    (
        "blur_bound_not_passed_on",
        "the least number of pixels of a blurred Gaussian is a setting that nothing reads",
        "density/control.py",
        "self.theta_blur, self.blur_min_pixels, kept)",
        "self.theta_blur, 0.0, kept)",
        "test_density:the_blur_set_dominates_strictly_more_than_its_share_of_pixels",
    ),
    (
        "share_of_masked_pixels",
        "the share of a blurred Gaussian is of all pixels, also of those that a mask leaves out",
        "density/control.py",
        'kept = info.get("kept_pixels")',
        "kept = None",
        FLAGS,
    ),
    (
        "parent_opacity_for_children",
        "the children's opacity is revised twice",
        "stages/density.py",
        "log_left = -0.5 *",
        "log_left = -0.25 *",
        SPLIT,
    ),
    (
        "adams_usual_eps",
        "eps is 1e-8, Adam's usual one: gradients under it take small steps",
        "train/model.py",
        "eps=EPS",
        "eps=1e-8",
        TINY,
    ),
    (
        "betas_swapped",
        "the two decays change places",
        "train/model.py",
        "betas=updates.betas",
        "betas=updates.betas[::-1]",
        "test_optimizer:adam_follows_the_scalar_recurrence",
    ),
    (
        "usual_decay_whatever_is_set",
        "second moments decay by the usual 0.999, whatever the rates say",
        "train/schedule.py",
        "(BETAS[0], lr.beta2)",
        "BETAS",
        "test_strategies:second_moments_decay_as_they_are_told",
    ),
    (
        "waiting_stops_the_counter",
        "harmonics that wait do not count their steps, so that their first ones are corrected as if training began",
        "train/model.py",
        'counter = optimizer.state[param]["step"]\n',
        'counter = optimizer.state[param]["step"].clone()\n',
        WAIT,
    ),
    (
        "rate_in_world_units",
        "the positions' learning rate is not scaled by the scene",
        "train/schedule.py",
        '"means": lr.means * scene_scale}',
        '"means": lr.means}',
        RATE,
    ),
    (
        "ellipse_misses_its_tile",
        "the test that leaves tiles out follows the wrong diagonal; counting draws without it",
        "stages/tiles.py",
        "torch.maximum(-b * edge_x / c, top)",
        "torch.maximum(b * edge_x / c, top)",
        ASKED,
    ),
    (
        "ellipse_of_a_fainter_splat",
        "tiles are left out where alpha is under ten times the floor; counting draws without it",
        "stages/tiles.py",
        "torch.log(shapes[5] / profile.alpha_floor)",
        "torch.log(0.1 * shapes[5] / profile.alpha_floor)",
        ASKED,
    ),
    (
        "windows_of_the_corner",
        "whether a window of SSIM counts is read from its corner, not from its centre",
        "stages/losses.py",
        "mask[margin:-margin, margin:-margin]",
        "mask[: -2 * margin, : -2 * margin]",
        "test_masked_losses:the_dissimilarity_of_what_a_mask_keeps_is_the_oracles",
    ),
    (
        "tiles_end_where_they_are_wide",
        "the lower edge of a tile is reckoned from its left one; counting draws without the test",
        "stages/tiles.py",
        "right, bottom = left + (tile_size - 1), top + (tile_size - 1)",
        "right, bottom = left + (tile_size - 1), left + (tile_size - 1)",
        PLAIN,
    ),
    (
        "sums_without_absolute_ones",
        "where no absolute gradients are asked for, as 3DGS trains, the exponent's moments change places",
        "stages/blend.py",
        "rows[:, :6] = torch.mm(self.basis, pairs.T)",
        "rows[:, :6] = torch.mm(self.basis if absolute else self.basis[[0, 2, 1, 3, 4, 5]], pairs.T)",
        ASKED,
    ),
    (
        "lists_of_thirty_two",
        "a tile blends the first 32 entries of its list",
        "stages/tile_groups.py",
        "torch.arange(int(n_blocks[0]))",
        "torch.arange(min(int(n_blocks[0]), 4))",
        "test_scale:the_image_of_fifty_is_the_oracles",
    ),
    (
        "lists_of_256",
        "a tile blends the first 256 entries of its list: nobody sees it in small scenes",
        "stages/tile_groups.py",
        "torch.arange(int(n_blocks[0]))",
        "torch.arange(min(int(n_blocks[0]), 32))",
        "test_scale:the_image_of_hundreds_in_a_tile_is_the_oracles",
    ),
    (
        "lists_of_1024",
        "a tile blends the first 1,024 entries of its list",
        "stages/tile_groups.py",
        "torch.arange(int(n_blocks[0]))",
        "torch.arange(min(int(n_blocks[0]), 128))",
        "test_scale:the_image_of_a_thousand_in_a_tile_is_the_oracles",
    ),
    (
        "tiles_in_eight_bits",
        "entries are sorted by tile numbers of eight bits",
        "stages/tiles.py",
        "tile.to(torch.int16 if n_tiles < 2**15 else torch.int32)",
        "tile.to(torch.int8)",
        "test_scale:the_image_of_five_thousand_is_the_oracles",
    ),
    (
        "entries_in_sixteen_bits",
        "where a tile's list begins is counted in sixteen bits",
        "stages/tiles.py",
        "return TileLists(ids.index_select(0, order), offsets,",
        "return TileLists(ids.index_select(0, order), offsets % 2**16,",
        "test_scale:dominant_ids_and_counts_of_five_thousand_are_the_oracles",
    ),
    (
        "winners_in_eight_bits",
        "dominant ids are kept in eight bits",
        "stages/compositing.py",
        "ids.masked_fill_(places < 0, -1))",
        "(ids % 256).masked_fill_(places < 0, -1))",
        "test_scale:dominant_ids_and_counts_of_hundreds_in_a_tile_are_the_oracles",
    ),
    (
        "counts_in_eight_bits",
        "blended splats are counted in eight bits",
        "stages/compositing.py",
        "blend.n_blended.to(torch.int32)",
        "(blend.n_blended % 256).to(torch.int32)",
        "test_scale:dominant_ids_and_counts_of_a_thousand_in_a_tile_are_the_oracles",
    ),
    (
        "gradients_of_256",
        "the backward pass ends after 256 entries of a list",
        "stages/compositing.py",
        "gradients.add(group, blend, tiles.index_select(0, group.tiles))",
        "del blend.steps[32:]; gradients.add(group, blend, tiles.index_select(0, group.tiles))",
        "test_scale:the_gradients_of_a_thousand_in_a_tile_are_the_oracles",
    ),
    (
        "weight_of_the_prior_not_read",
        "the weight of the prior is a setting that nothing reads",
        "density/control.py",
        "terms.append(self.lambda_pop * self._prior(",
        "terms.append(1e-3 * self._prior(",
        PRIOR,
    ),
    (
        "prior_never_stops",
        "the prior goes on to the end of the training",
        "density/control.py",
        "return weighs and self.pop_start_iter <= step < self.pop_stop_iter",
        "return weighs and self.pop_start_iter <= step",
        PRIOR,
    ),
    (
        "mask_of_the_first_camera",
        "of several cameras the first one's counts say which Gaussians are important",
        "density/control.py",
        "mask = importance_mask(dominant_counts(info).sum(0))",
        "mask = importance_mask(dominant_counts(info)[0])",
        CAMERAS,
    ),
    (
        "entropy_of_the_other_sign",
        "the entropy of opacities is subtracted",
        "density/control.py",
        "self.lambda_entropy * opacity_entropy(",
        "-self.lambda_entropy * opacity_entropy(",
        READINGS,
    ),
    (
        "signed_gradients_for_absgrad",
        "absgrad=True is accepted and the signed gradients are read",
        "density/control.py",
        "grads = means2d.absgrad if self.absgrad else means2d.grad",
        "grads = means2d.grad",
        OF_3DGS,
    ),
    (
        "cameras_not_scaled_up",
        "of a mean over cameras the gradients count a share each (gsplat multiplies by n_cameras)",
        "density/control.py",
        '0.5 * info["width"] * cameras, 0.5 * info["height"] * cameras]',
        '0.5 * info["width"], 0.5 * info["height"]]',
        OF_3DGS,
    ),
    (
        "packed_rows_seen_once",
        "packed rows of several cameras count their Gaussian once",
        "density/control.py",
        'state["count"].index_add_(0, ids, torch.ones_like(norms))',
        'state["count"][ids] = 1.0',
        PACKED,
    ),
    (
        "packed_gradients_overwrite",
        "of packed rows of one Gaussian the last one's gradient stays (an index_put_ without accumulate)",
        "density/control.py",
        'state["grad2d"].index_add_(0, ids, norms)',
        'state["grad2d"][ids] += norms',
        PACKED,
    ),
    (
        "screen_size_rules_inert",
        "pruning and splitting by screen size are collected and never applied",
        "density/control.py",
        "if context.step < self.refine_scale2d_stop_iter:",
        "if False:",
        READINGS,
    ),
    (
        "screen_size_prune_inert",
        "nobody is pruned by screen size, as in Inria's code",
        "density/control.py",
        "if self.prune_too_big_after < context.step < self.refine_scale2d_stop_iter:",
        "if context.step < -1:",
        READINGS,
    ),
    (
        "last_prune_inert",
        "the last prune of faint Gaussians never comes",
        "density/control.py",
        "if context.step != self.final_prune_iter:",
        "if True:",
        READINGS,
    ),
    (
        "parameters_lose_their_gradient",
        "edited parameters are tensors that do not require a gradient",
        "density/rows.py",
        "requires_grad=old.requires_grad)",
        "requires_grad=False)",
        TRAINED,
    ),
    (
        "optimizers_keep_old_parameters",
        "optimizers go on with the tensors of before the edit, and move nothing that is drawn",
        "density/rows.py",
        'optimizer.param_groups[0]["params"] = [new]',
        "pass",
        HELD,
    ),
    (
        "moments_of_old_parameters_stay",
        "the state of the tensors of before an edit stays in the optimizers (a leak of gsplat's first strategy)",
        "density/rows.py",
        "moments = optimizer.state.pop(old, {})",
        "moments = dict(optimizer.state.get(old, {}))",
        HELD,
    ),
    (
        "counter_reset_by_an_edit",
        "an edit starts the counter of updates again, so that the next steps are corrected as the first",
        "density/rows.py",
        "        if moments:\n",
        '        if moments:\n            moments["step"] = torch.zeros_like(moments["step"])\n',
        COUNTED,
    ),
    (
        "opacities_set_anew_as_logits",
        "Mini-Splatting's new points have the activated opacity as a logit",
        "density/methods.py",
        "torch.logit(points.new_full((n,), opacity))",
        "points.new_full((n,), opacity)",
        OF_MINI,
    ),
    (
        "all_candidates_of_taming_go",
        "Taming-3DGS prunes all that 3DGS would",
        "density/methods.py",
        "mask & _drawn_to_go(mask, weights, context)",
        "mask",
        OF_TAMING,
    ),
    (
        "pup_first_share_twice",
        "both rounds of PUP-3DGS remove the first share",
        "density/methods.py",
        "share = self.prune_shares[self.adam_restarts.index(context.step)]",
        "share = self.prune_shares[0]",
        OF_PUP,
    ),
)

PROGRAM: Final = tuple(Mutant(*line, package=PACKAGE) for line in _LINES)
