"""Mutants of the oracle, of the program that trains and of whole rasterizers, written without a look at the laws.

They were tried on the laws that there were; `docs/kit.md` says how many were killed at first sight.
"""

from __future__ import annotations

import importlib
from typing import Any, Final

from pop_ref.conformance.mutants.black_box import BlackBox
from pop_ref.conformance.mutants.copies import PROGRAM as PACKAGE
from pop_ref.conformance.mutants.copies import Mutant
from pop_ref.conformance.mutants.unseen_boxes import Given, breaking, meta_telling, passing, telling

_Told = tuple[Any, Any, Any]

_ORACLE: Final = (
    (
        "budget_less_the_step",
        "the parabola's square is lost",
        "taming.py",
        "(2 * n * nth - nth * nth)",
        "(2 * n * nth - nth)",
        "test_taming:the_budget_is_a_parabola_from_the_start_to_the_target",
    ),
    (
        "edges_by_eight",
        "the middle of the edge filter is counted twice",
        "taming.py",
        "9 * int(grey[y, x])",
        "8 * int(grey[y, x])",
        "test_taming:edges_are_eight_times_the_grey_less_its_neighbours_and_the_frame_is_grey",
    ),
    (
        "splits_get_the_rest",
        "what rounding leaves over is split",
        "taming.py",
        "more * n_split // max(n_candidates, 1)",
        "more - more * n_clone // max(n_candidates, 1)",
        "test_taming:quotas_share_what_the_budget_leaves_and_never_ask_for_less_than_none",
    ),
    (
        "upper_median",
        "of an even number the upper one of the middle two is the median",
        "taming.py",
        "(len(ascending) - 1) // 2",
        "len(ascending) // 2",
        "test_taming:a_term_is_its_weight_at_the_lower_median_of_what_is_positive",
    ),
    (
        "outdoor_by_dominance",
        "outdoors the mean weight is over pixels that a Gaussian dominates",
        "mini_splatting.py",
        "np.maximum(found.n_pixels, 1)",
        "np.maximum(dominant_counts, 1)",
        "test_mini_splatting:importance_is_weight_indoors_and_weight_a_pixel_for_who_dominates_outdoors",
    ),
    (
        "samples_rounded_up",
        "views get a point more where the number does not divide",
        "mini_splatting.py",
        "min(max_points // n_views,",
        "min(-(-max_points // n_views),",
        "test_mini_splatting:views_share_the_points_and_give_no_more_than_their_pixels",
    ),
    (
        "four_neighbours",
        "the size of a point is of its four nearest ones",
        "mini_splatting.py",
        ".tolist())[:3]",
        ".tolist())[:4]",
        "test_mini_splatting:a_point_is_as_large_as_its_three_neighbours_are_far",
    ),
    (
        "radius_without_a_tenth",
        "the square radius lacks Inria's 0.1 under the root",
        "footprint.py",
        "max(0.1,",
        "max(0.0,",
        "test_footprint:the_square_extent_is_three_deviations_of_the_longer_axis_whatever_the_opacity",
    ),
    (
        "radius_down",
        "the vertical radius is rounded down",
        "footprint.py",
        "math.ceil(min(_LARGEST_RADIUS, reach_y))",
        "math.floor(min(_LARGEST_RADIUS, reach_y))",
        "test_footprint:known_extents",
    ),
    (
        "covariance_with_c1",
        "the constant of means is added to the covariance",
        "ssim.py",
        "A2 = 2.0 * s_xy + C2",
        "A2 = 2.0 * s_xy + C1",
        "test_losses:similarity_is_symmetric_at_most_one_and_the_loss_is_its_complement",
    ),
    (
        "others_everywhere",
        "Gaussians that no view saw are pushed to zero though only visible ones take part",
        "polarization.py",
        "~mask & taking_part",
        "~mask",
        "test_polarization:restricting_the_prior_to_the_visible_is_the_prior_of_the_visible",
    ),
    (
        "rewind_to_the_start",
        "after a rewind the rate begins at its first value",
        "optimizer.py",
        "step - rules.means_rewind_iter + rules.means_rewind_to",
        "step - rules.means_rewind_iter",
        "test_optimizer:rates_rewind_and_fall_in_rounds_as_the_rules_say",
    ),
    (
        "rounds_fall_smoothly",
        "within a round rates fall with every step",
        "optimizer.py",
        "(taken // rules.round_decay_every)",
        "(taken / rules.round_decay_every)",
        "test_optimizer:rates_rewind_and_fall_in_rounds_as_the_rules_say",
    ),
    (
        "height_is_width",
        "the vertical gradient is scaled by the width",
        "density.py",
        "0.5 * height *",
        "0.5 * width *",
        "test_density:the_density_statistic_averages_ndc_gradients_over_the_views_that_showed_the_gaussian",
    ),
    (
        "blur_outside_its_span",
        "blurred Gaussians are split whenever statistics say so",
        "density.py",
        "statistics.blurred & blurs_at(step, config)",
        "statistics.blurred.copy()",
        "test_density:a_densification_step_is_the_oracles_under_every_reading",
    ),
    (
        "motion_of_the_world",
        "the correction moves the world, not the camera",
        "refinement.py",
        "motion @ viewmat",
        "viewmat @ motion",
        "test_agreement:refined_viewmat_is_the_oracles",
    ),
    (
        "exposures_from_the_first",
        "colours are those of the first photograph",
        "appearance.py",
        "np.mean(exposures, axis=0) - np.eye(3, 4)",
        "exposures[0] - np.eye(3, 4)",
        "test_agreement:centred_exposures_is_the_oracles",
    ),
    (
        "channels_overlap",
        "a channel's background is the next step's first",
        "appearance.py",
        "3 * step + channel",
        "step + channel",
        "test_few_photographs:the_background_of_a_step_hangs_on_the_step_and_the_seed_alone",
    ),
    (
        "chord_ahead",
        "what is densest behind the camera is drawn before it",
        "chord.py",
        "-float(a @ b) / float(b @ b)",
        "abs(float(a @ b)) / float(b @ b)",
        "test_chord:a_gaussian_is_densest_at_the_midpoint",
    ),
    (
        "depth_cotangent_once",
        "the quotient's derivative is divided once",
        "depth.py",
        "v * depth / divisor**2",
        "v * depth / divisor",
        "test_signature_depth:depth_follows_plain_colours_of_several_cameras",
    ),
    (
        "third_band_slope",
        "one coefficient of the third band's slope has the wrong sign",
        "harmonics.py",
        "3.0 * _C3_0 * (2.0 * zz - xx - yy)",
        "3.0 * _C3_0 * (2.0 * zz - xx + yy)",
        "test_agreement:colors_from_sh_vjp_is_the_oracles",
    ),
)

_PROGRAM: Final = (
    (
        "prunes_once_less",
        "the last of the steps that prune does not",
        "density/methods.py",
        "nth > self.sampled_prunes",
        "nth >= self.sampled_prunes",
        "test_strategies:a_training_by_taming_is_the_oracles_at_every_step",
    ),
    (
        "nth_from_step_zero",
        "densification steps are numbered from step 0",
        "density/methods.py",
        "return (step - self.refine_start_iter) // self.refine_every",
        "return step // self.refine_every",
        "test_strategies:a_training_by_taming_is_the_oracles_at_every_step",
    ),
    (
        "scale_of_l2_lost",
        "the divisor of the pixelwise term is not read",
        "stages/losses.py",
        "weights = ((1.0 - lambda_ssim) * l2_scale,",
        "weights = ((1.0 - lambda_ssim),",
        "test_masked_losses:the_objectives_with_every_option_are_the_oracles",
    ),
)


def _torch() -> Any:
    return importlib.import_module("torch")


def _background_in_front(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    behind = given["backgrounds"]
    if behind is None or given["render_mode"] != "RGB":
        return images, alphas, meta
    return images + alphas * behind[..., None, None, :], alphas, meta


def _depth_is_expected(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    if given["render_mode"] not in ("D", "RGB+D"):
        return images, alphas, meta
    expected = images[..., -1:] / alphas.clamp_min(1e-10)
    return _torch().cat((images[..., :-1], expected), -1), alphas, meta


def _expected_beside_colours(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    if given["render_mode"] != "RGB+ED":
        return images, alphas, meta
    plain = images[..., -1:] * alphas.clamp_min(1e-10)
    return _torch().cat((images[..., :-1], plain), -1), alphas, meta


def _lens_of_the_first(given: Given) -> Given:
    return {"Ks": given["Ks"][..., :1, :, :].expand_as(given["Ks"])}


def _even_widths(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    keep = _torch().arange(given["width"], device=images.device) < given["width"] // 2 * 2
    return images * keep[:, None], alphas * keep[:, None], meta


def _pose_gradient_transposed(given: Given) -> Given:
    viewmats = given["viewmats"]
    if not viewmats.requires_grad:
        return {}
    seen = viewmats.clone()

    def transposed(v: Any) -> Any:
        v = v.clone()
        v[..., :3, :3] = v[..., :3, :3].mT.clone()
        return v

    seen.register_hook(transposed)
    return {"viewmats": seen}


def _two_bands(given: Given) -> Given:
    return {"sh_degree": None if given["sh_degree"] is None else min(given["sh_degree"], 2)}


_BOXES: Final = (
    (
        "dark_light_clipped",
        "negative colours come out as black",
        telling(lambda g, i, a, m: (i.clamp_min(0.0), a, m)),
        "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike",
    ),
    (
        "background_in_front",
        "the background shines through whatever covers it",
        telling(_background_in_front),
        "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike",
    ),
    (
        "depth_is_expected",
        "modes D are divided by alpha like modes ED",
        telling(_depth_is_expected),
        "test_signature_depth:depth_follows_plain_colours_of_several_cameras",
    ),
    (
        "expected_beside_colours",
        "depth beside colours is not divided",
        telling(_expected_beside_colours),
        "test_signature_depth:depth_follows_plain_colours_of_several_cameras",
    ),
    (
        "radii_halved",
        "meta tells diameters as radii, rounded",
        meta_telling(radii=lambda g, r: (r + 1) // 2),
        "test_signature_cameras:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same",
    ),
    (
        "corners_are_integers",
        "meta's centres have integers at pixel centres",
        meta_telling(means2d=lambda g, u: u - 0.5),
        "test_signature_meta:the_splats_that_meta_shows_where_nothing_requires_a_gradient_are_the_oracles",
    ),
    (
        "lens_of_the_first",
        "all cameras have the first one's lens",
        breaking(_lens_of_the_first),
        "test_signature_arguments:without_a_background_it_is_black",
    ),
    (
        "even_widths",
        "a last odd column is not drawn",
        telling(_even_widths),
        "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike",
    ),
    (
        "pose_gradient_transposed",
        "the rotation's gradient is transposed",
        breaking(_pose_gradient_transposed),
        "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike",
    ),
    (
        "two_bands",
        "bands beyond the second are not drawn",
        breaking(_two_bands),
        "test_signature_cameras:several_cameras_in_one_call_see_what_each_sees_alone",
    ),
    (
        "background_is_no_leaf",
        "the background has no gradient",
        breaking(lambda g: {"backgrounds": None if g["backgrounds"] is None else g["backgrounds"].detach()}),
        "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike",
    ),
    (
        "far_unread",
        "nothing is too far",
        breaking(lambda g: {"far_plane": 1e10}),
        "test_signature_arguments:the_near_and_the_far_plane_are_where_the_call_says",
    ),
    (
        "small_scales_raised",
        "no scale is under a thousandth",
        passing(lambda s: s.clamp_min(1e-3), "scales"),
        "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike",
    ),
    (
        "opaque_at_most_99",
        "opacities end at 0.99 before they are drawn",
        passing(lambda o: o.clamp_max(0.99), "opacities"),
        "test_agreement:antialiased_gradients_are_the_oracles",
    ),
    (
        "colours_reach_one",
        "plain colours are clamped to 1",
        passing(lambda c: c.clamp_max(1.0) if c.shape[-1] == 3 else c, "colors"),
        "test_signature_arguments:plain_colours_are_drawn_as_they_are",
    ),
)

BLIND: Final = tuple(Mutant(*line) for line in _ORACLE)
BLIND_PROGRAM: Final = tuple(Mutant(*line, package=PACKAGE) for line in _PROGRAM)
BLIND_BOXES: Final = tuple(BlackBox(*box) for box in _BOXES)
