"""Which mutants were written, or drawn, before anybody looked which law would notice; docs/kit.md has the shares."""

from __future__ import annotations

from typing import Final

# of "blind seventh" to "blind ninth" and "drawn" those alone that lived at first and are killed now
_NAMES: Final = {
    "trainers": """
        depth_read_from_the_corner depth_by_row_and_column depth_of_the_nearest_pixel
        depths_compared_not_disparities depth_of_nothing_is_infinite points_behind_have_depths
        points_outside_are_kept depth_mask_transposed regularizer_is_a_sum_of_rows exposure_transposed
        exposure_without_offset exposures_drift exposures_centred_at_zero background_where_the_photograph_is
        large_on_screen_need_a_gradient reset_by_precedence children_turned_the_other_way extents_of_packed_rows
        extents_by_the_width extents_of_the_last_view seen_along_one_axis bands_counted_from_one
        positions_fall_linearly weights_decay rows_without_gradient_stay window_forgets_this_view
        flags_outlive_the_change budget_from_the_current_count colours_not_as_harmonics fisher_at_full_size
        hard_share_is_soft masked_mean_forgets_channels halved_not_in_the_gradient depth_clamped_not_slope
        three_sigma_for_all conic_gradient_twice colour_has_no_camera absolute_gradients_are_zero
        depth_in_a_padded_channel quaternion_gradients_by_compact_rows depth_is_divided_always
        dark_splats_are_dropped absolute_gradients_are_inverted one_focal_length principal_point_centred
        expected_depth_of_the_faint
    """,
    "strangers": """
        first_view_shows_everybody gradients_by_the_longer_side blurred_of_any_size_are_split
        sizes_of_children_interleaved new_rows_have_no_size skipped_updates_keep_their_gradients
        adam_counts_the_training last_gradient_of_those_that_wait resets_raise_the_faint clamped_by_the_width
        last_entry_lost tile_numbers_in_sixteen_bits tight_tiles_transposed extremes_exchanged
        extents_of_at_most_1024 blurred_determinant_is_constant extents_of_the_uncompensated
        gradient_of_scales_for_logarithms keys_with_as_few_bits_as_tiles offsets_begin_anew
        smaller_views_without_rounding whole_windows_over_all_pixels render_at_most_white nothing_in_view_fails
        degree_zero_fails empty_scene_fails one_gaussian_fails depth_does_not_move_means
        depth_does_not_move_cameras depth_along_the_ray background_twice_in_the_gradient
        harmonics_learn_of_the_last_camera absolute_of_the_sum centres_told_are_a_copy opacities_told_as_given
        background_of_the_call_before one_entry_has_no_axis centres_in_a_wider_picture alphas_without_gradient
        radius_clip_exclusive
    """,
    "unseen": """
        small_by_the_volume large_ones_go_a_change_early blur_begins_a_change_late pause_is_a_step_longer
        reset_where_refinement_ends extents_of_all_windows views_counted_from_one reset_keeps_the_second_moment
        children_of_the_smaller rounds_decay_a_step_late prior_begins_a_step_late last_rate_at_the_last_step
        principal_point_in_the_middle halves_of_quaternions no_axis_under_a_thousandth no_axis_over_fifty
        opacities_at_most_99_percent translation_learns_nothing alpha_of_the_background depth_of_nothing_is_nan
        extents_in_sixteen_bits extents_are_round centres_told_from_corners conics_told_backwards
        depths_told_from_the_near_plane last_columns_black tiles_of_sixteen three_backgrounds first_chunk_learns
        far_by_distance nearest_plane_of_inria smallest_extent_kept blur_of_three_tenths covariances_overruled
        quaternions_normalized_in_place strides_unread cotangent_of_strides white_in_evaluation
        background_of_the_first_entry centres_in_half_precision opacities_in_eight_bits colours_in_eight_bits
        first_65536 line_fails scales_through_logarithms opacities_through_logits all_bands colours_of_cameras
        alphas_snap_to_one
    """,
    "blind": """
        budget_less_the_step edges_by_eight splits_get_the_rest upper_median outdoor_by_dominance
        samples_rounded_up four_neighbours radius_without_a_tenth radius_down covariance_with_c1
        others_everywhere rewind_to_the_start rounds_fall_smoothly height_is_width blur_outside_its_span
        motion_of_the_world exposures_from_the_first channels_overlap chord_ahead depth_cotangent_once
        third_band_slope prunes_once_less nth_from_step_zero scale_of_l2_lost dark_light_clipped
        background_in_front depth_is_expected expected_beside_colours radii_halved corners_are_integers
        lens_of_the_first even_widths pose_gradient_transposed two_bands background_is_no_leaf far_unread
        small_scales_raised opaque_at_most_99 colours_reach_one
    """,
    "blind second": """
        saturated_sigmoid cotangents_taken_as_symmetric margin_of_the_other_focal_length
        sides_exchanged_in_the_cull squares_about_the_corner visits_are_blends
        loss_of_alpha_lost_beside_expected_depth all_directions_count_too_much equal_pixels_pull
        blur_alone_everywhere refinement_starts_at_its_start first_restart_alone opacities_decay_with_the_others
        depth_weighed_without_the_scene smaller_extent_scores diagonal_unpacked_twice
        regression_of_the_other_picture series_of_the_slope_before rightmost_by_the_wrong_diagonal
        rays_through_the_given_centre seen_once_a_step views_counted_by_steps resets_hurry
        last_prune_by_the_usual_bound large_on_screen_go_at_once first_view_scores_twice passes_are_classic
        parabola_a_post_too_long pruning_takes_the_resets_place grey_background_of_the_score
        factor_off_diagonal_twice restarts_update opacities_that_stop_at_once every_epoch_alike
        sizes_regularized_as_logarithms photographs_over_unexposed_backgrounds rows_counted_by_entries
        written_and_computed_all_the_same pruned_importance_keeps_momentum absolute_gradients_pile_up
        unused_bands_learn portraits_are_cut_square factor_not_in_the_gradient low_pass_of_zero_is_the_default
        near_plane_of_zero_is_the_default last_row_learns pictures_share_a_buffer culled_rows_keep_an_extent
        absolute_gradients_of_the_first_camera near_by_distance four_channels_are_rgba empty_tiles_stay_black
        low_pass_ignored_with_covariances principal_point_inside inference_mode_fails colours_divided_like_depth
        means_learn_absolutely sides_told_exchanged cameras_told_are_images
    """,
    "blind third": """
        lower_degree_weighs_one_side far_plane_forgotten clamped_offset_is_a_constant
        factor_learns_from_its_product depth_over_the_background discriminant_from_zero weight_of_the_first
        fisher_over_black depth_sampled_half_a_pixel_off mask_at_the_windows_corner empty_views_do_not_count
        copies_are_split_too second_moments_survive_a_reset blur_seen_only_while_it_is_split
        cameras_blur_together important_in_the_first_camera large_extents_wait_for_clones
        window_cleared_before_the_prune views_of_all_windows rewound_to_the_start the_last_gradient_counts
        budget_of_the_present dominant_in_the_last_view pruned_in_place_of_grown either_extent_is_clipped
        opacities_of_another_scene rows_for_cameras intrinsics_by_column degree_zero_unclamped
        alpha_still_beside_background directions_are_constants lengths_stretch upper_half_learns
        counted_over_cameras factor_of_the_default expected_over_a_constant nothing_is_black
        behind_the_first_chunk all_learn_by_means every_band kept_intrinsics
    """,
    "blind third more": """
        corrected_in_the_world the_threshold_stays hidden_score_too rays_from_the_given_point
        appearance_a_step_ahead hidden_are_pushed_down first_share_again points_from_masked_pixels no_tile_fits
        last_camera_teaches rows_as_stored cameras_as_stored normalized_in_place seeds_anew tiles_of_16_bits
        rows_of_16_bits
    """,
    "blind fourth": """
        centre_on_a_pixel_is_skipped empty_pixels_teach_no_background faint_pixels_are_dominated_by_nobody
        one_dark_channel_stops_all pose_learns_nothing_from_colours frustum_upside_down
        antialiasing_factor_has_a_floor square_reaches_one_tile_more needles_are_nowhere slope_over_all_pixels
        masked_means_over_pixels points_masked_half_a_pixel_off reset_raises_the_faint moved_before_a_restart
        important_though_out_of_sight window_without_this_view extents_as_shares_of_the_width
        three_neighbours_always centred_rays_of_a_square wide_turns_learn_wrongly third_band_lacks_a_power
        clamped_along_x_for_y eye_moves_the_other_way_round depth_sorted_by_its_upper_bits
        edge_reached_by_the_wrong_axis absolute_gradient_of_circles ceiling_passes_the_clamped_alpha
        distances_around_the_block crossed_terms_once photograph_in_half_precision
        dissimilarity_of_the_last_band packed_extents_of_the_last_view last_view_gives_no_score
        every_view_has_the_whole_budget scored_by_the_first_views rounds_slow_the_centres_too
        sizes_of_the_first_of_a_batch shrunk_photographs_are_the_last one_unit_deep_behind
        shrunk_sizes_rounded_down principal_point_in_whole_pixels low_pass_factor_is_a_constant
        absolute_gradient_of_the_sum last_block_not_launched one_gaussian_stays backgrounds_of_the_first_scene
        empty_pixels_are_farthest tiles_the_other_way far_plane_is_a_sphere intersections_forget_the_camera
        blind_cameras_have_no_number averaged_over_cameras opacities_end_at_99 only_w_made_positive
        needles_are_thickened harmonics_end_at_white one_radius whole_chunks_only packed_backgrounds_stay
        canvas_used_again
    """,
    "blind fifth": """
        centred_half_a_pixel_off frustum_margin_is_of_the_whole_width short_quaternions_stay_short
        near_directions_are_short colour_of_exactly_zero_stays reached_in_the_last_column_alone_is_culled
        absolute_gradients_are_lengths depth_beside_colours_moves_nobody square_culls_by_the_usual_tiles
        eye_gradient_transposed pose_learns_nothing_from_shapes fisher_at_the_papers_ceiling
        nothing_to_compare_is_all_wrong share_of_pixels_is_rounded no_pause_before_the_first_reset
        small_turns_cancel coincident_points_are_smaller last_point_of_a_pixel_counts
        visible_is_what_dominates negative_fits_are_left_out loss_ignores_its_cotangent
        direction_gradients_by_compact_rows ceiling_if_all_are_opaque dominant_places_begin_anew
        last_column_of_a_tile_is_not_asked hard_prunes_keep_their_steps taming_scores_a_clamped_picture
        views_outlive_new_points entropy_of_the_faint_is_constant visible_to_every_camera
        revised_opacity_of_the_opaque_is_infinite rounds_without_a_start_decay_too exposed_renders_are_clamped
        depth_of_the_uncorrected_camera photograph_over_the_first_background coarse_transparency_is_hard
        thin_masks_are_dropped passes_see_uncorrected_cameras common_turn_has_no_lever
        pixels_beyond_the_border_count backgrounds_ignored_with_harmonics
        backgrounds_learn_nothing_beside_depth full_chunks_lose_their_last_channel composited_twice
        absolute_gradients_are_of_ndc radius_clip_is_a_diameter sorted_along_the_cameras_place
        needles_are_culled axis_aligned_splats_vanish directions_in_camera_axes copies_are_drawn_once
        square_pictures_are_transposed centres_outside_stay gradients_end_at_one pixels_end_at_one_255th
        scales_in_half_precision rows_counted_in_a_byte too_many_intersections_draw_nothing
        pose_kept_with_its_tensor cotangents_in_half_precision
    """,
    "blind sixth": """
        left_clamp_pulls_like_the_right limits_about_the_given_centre children_are_never_pruned
        gradients_over_black gradients_of_classic_splats reset_before_the_change prior_a_step_too_long
        l1_objective_pulls_by_whole_windows scale_ends_with_l2 resets_keep_what_is_fainter_moving
        blur_unseen_at_its_last_step rewinds_to_an_unscaled_step logits_end_at_seven
        blur_without_a_prior_ignores_the_mask epoch_begins_anew_on_resume resets_replace_updates_too
        window_lost_on_resume batches_blur_by_all_pixels foreign_draws_repeat
        second_compaction_counts_from_the_first second_way_back_reads_used_buffers green_screens_are_black
        defaults_overrule_the_profile batch_ids_count_images depth_lost_behind_a_full_chunk
        one_empty_camera_fails packed_screen_gradients_of_the_first_camera batch_axes_transposed
        packed_depths_of_the_first_camera gradients_of_the_usual_low_pass nothing_where_transparent
        halved_by_autocast
    """,
    "blind seventh": """
        factor_has_a_floor factor_of_covariances_is_constant short_quaternions_do_not_turn one_pose_one_lens
        depth_ends_at_a_thousand cameras_in_three_bits one_channel_background_behind_depth
        faint_cotangents_are_skipped isotropic_scales_read_densely equal_calls_share_a_picture
        edits_through_data_are_not_seen context_of_the_first_thread entries_of_one_memory_learn_once
    """,
    "blind eighth": "cameras_from_the_thirteenth_on_are_black",
    "blind ninth": "sensitive_after_the_reset",
    "drawn": """
        extents_that_hardly_overlap_are_culled last_start_a_step_early passes_count_too_few_bands
        wide_turns_times_their_angle whole_background_in_passes others_have_no_term series_without_signs
        resumed_without_moments
    """,
    "whole steps": """
        bands_rise_a_step_early bands_rise_from_the_first_step gradients_that_wait_are_lost
        schedule_ahead_of_the_update schedule_of_thirty_thousand positions_move_in_world_units
        loss_never_changes whole_dissimilarity depth_not_divided_by_alpha opacity_term_pulls_at_activations
        mean_scale_costs_nothing entropy_never_stops important_in_this_view_alone last_prune_a_step_late
        renders_are_not_exposed depth_of_all_points depth_behind_the_mask depth_in_world_units
        steps_forget_the_scale rates_forget_the_scale sizes_forget_the_scale changes_of_the_next_step
        phase_of_the_next_step loss_of_the_first_step terms_are_not_told loss_of_the_first_view sum_over_views
        always_the_papers_renderer always_valid_windows always_the_usual_rates passes_by_the_papers_renderer
        passes_over_held_out_views passes_with_all_bands photograph_of_the_first_view mask_of_the_first_view
        nearest_pixel interpolated_pixels camera_of_the_whole_photograph intrinsics_by_the_factor
        centre_of_half_a_pixel any_pixel_of_the_mask coarse_a_step_too_long sizes_by_view stops_count_views
        smallest_side_of_the_whole
    """,
}

ROUNDS: Final = {title: tuple(names.split()) for title, names in _NAMES.items()}
