"""Mutants of losses, the prior, density control and Adam."""

from __future__ import annotations

from typing import Final

from pop_ref.conformance.mutants.copies import Mutant

TRAINING: Final = (
    Mutant(
        "halved_l2",
        "half the mean square, as in many textbooks: the balance with SSIM shifts by two (A10)",
        "losses.py",
        "return float(np.sum(difference**2) / _n_kept(image, mask))",
        "return float(0.5 * np.sum(difference**2) / _n_kept(image, mask))",
        "test_losses:losses_are_means_over_pixels_and_channels",
    ),
    Mutant(
        "halved_d_ssim",
        "(1 - SSIM) / 2 for 1 - SSIM (A11)",
        "ssim.py",
        "return (0.5 if halved else 1.0) * (1.0 - ssim(image, target, padding, mask))",
        "return 0.5 * (1.0 - ssim(image, target, padding, mask))",
        "test_losses:similarity_is_symmetric_at_most_one_and_the_loss_is_its_complement",
    ),
    Mutant(
        "prior_over_all",
        "both sums of the prior are divided by N instead of their own number",
        "polarization.py",
        "toward_one = np.sum(1.0 - opacities[important]) / max(int(np.sum(important)), 1)",
        "toward_one = np.sum(1.0 - opacities[important]) / max(len(mask), 1)",
        "test_polarization:the_prior_is_the_mean_distance_of_each_side_from_its_pole",
    ),
    Mutant(
        "nobody_important",
        "a mean over no Gaussian: 0 / 0 is NaN and everything after it (A7)",
        "polarization.py",
        "toward_one = np.sum(1.0 - opacities[important]) / max(int(np.sum(important)), 1)",
        "toward_one = np.sum(1.0 - opacities[important]) / np.float64(np.sum(important))",
        "test_polarization:the_prior_is_finite_when_all_or_none_are_important",
    ),
    Mutant(
        "prior_pushes_the_wrong_way",
        "important opacities are pushed to 0",
        "polarization.py",
        "v_opacities[important] = -v_loss",
        "v_opacities[important] = v_loss",
        "test_polarization:the_prior_pulls_the_important_up_and_the_others_down_by_one_over_their_number",
    ),
    Mutant(
        "pixel_gradients_for_ndc",
        "the density statistic reads gradients per px: thresholds depend on the resolution",
        "density.py",
        "grads = np.sqrt((0.5 * width * v_means2d[:, 0]) ** 2 + (0.5 * height * v_means2d[:, 1]) ** 2)",
        "grads = np.sqrt(v_means2d[:, 0] ** 2 + v_means2d[:, 1] ** 2)",
        "test_density:the_density_statistic_averages_ndc_gradients_over_the_views_that_showed_the_gaussian",
    ),
    Mutant(
        "hidden_views_counted",
        "the average divides by all views, so what is seldom seen is never densified (A23)",
        "density.py",
        "n_visible=statistics.n_visible + visible,",
        "n_visible=statistics.n_visible + 1,",
        "test_density:the_density_statistic_averages_ndc_gradients_over_the_views_that_showed_the_gaussian",
    ),
    Mutant(
        "moments_left_behind",
        "pruning gathers parameters but truncates moments: every survivor inherits a stranger's momentum",
        "density_rows.py",
        "m = {name: np.concatenate([array[keep],",
        "m = {name: np.concatenate([array[: int(np.sum(keep))],",
        "test_density:survivors_of_pruning_keep_their_order_bits_and_moments",
    ),
    Mutant(
        "clones_inherit_moments",
        "copies start with moments of their own values instead of zero",
        "density_rows.py",
        "v = {name: np.concatenate([array[keep], np.zeros_like(new[name])]) for name, array in rows.v.items()}",
        "v = {name: np.concatenate([array[keep], np.square(new[name])]) for name, array in rows.v.items()}",
        "test_density:clones_are_exact_copies_at_the_end_with_fresh_moments",
    ),
    Mutant(
        "split_along_world_axes",
        "children are drawn along the world's axes instead of the Gaussian's own",
        "density_rows.py",
        'children["means"][child * n_split + i] += rotmats[i] @ (scales[i] * normals[child, i])',
        'children["means"][child * n_split + i] += scales[i] * normals[child, i]',
        "test_density:a_split_replaces_each_parent_by_two_smaller_children_drawn_from_it",
    ),
    Mutant(
        "blur_flag_forgets",
        "the blur flag of earlier views is overwritten: only the event's own view counts (A2)",
        "density.py",
        "blurred = blurred | statistics.blurred",
        "blurred = blurred",
        "test_density:blur_flags_combine_over_views_as_the_reading_says",
    ),
    Mutant(
        "adam_without_bias_correction",
        "the first steps are a tenth of what they should be",
        "optimizer.py",
        "lr[name] / (1.0 - beta1**step)",
        "lr[name]",
        "test_optimizer:the_first_step_has_the_length_of_the_learning_rate",
    ),
)
