"""Mutants of whole steps: what a training takes of its settings and its photographs, passes, and coarse photographs.

They were written before any law spoke of these, from what trainers did: gsplat's example trainer, Inria's, nerfstudio,
Gaussian-SLAM, stable-dreamfusion, Mini-Splatting. Where an issue or a pull request told of one, the story names it.
"""

from __future__ import annotations

from typing import Final

from pop_ref.conformance.mutants.copies import PROGRAM as PACKAGE
from pop_ref.conformance.mutants.copies import Mutant

_LAWS: Final = "test_whole_steps"
SETTINGS: Final = f"{_LAWS}:every_step_is_the_oracles_under_every_setting"
RULES: Final = f"{_LAWS}:every_step_is_the_oracles_under_every_rule_of_updates"
METHODS: Final = f"{_LAWS}:every_step_of_every_method_is_the_oracles"
DENSITY: Final = f"{_LAWS}:every_step_is_the_oracles_while_the_gaussians_change"
FEW: Final = f"{_LAWS}:every_step_is_the_oracles_with_terms_for_few_photographs"
PASSES: Final = f"{_LAWS}:what_a_method_prunes_by_is_of_all_photographs"
POINTS: Final = f"{_LAWS}:gaussians_begin_anew_on_the_photographs_and_inside_their_masks"
BATCH: Final = f"{_LAWS}:a_step_of_several_views_has_their_mean_loss_and_gradient"
EXPOSED: Final = f"{_LAWS}:an_exposure_learns_to_be_that_of_its_photograph"
COARSE: Final = "test_coarse"
SMALL: Final = f"{COARSE}:a_coarse_photograph_is_the_mean_over_areas_of_the_whole_one"
CAMERA: Final = f"{COARSE}:a_coarse_camera_sees_every_point_at_the_same_place_of_the_photograph"
MASKS: Final = f"{COARSE}:a_pixel_of_a_coarse_mask_counts_where_half_of_its_area_does"
SIZES: Final = f"{COARSE}:every_step_sees_its_photograph_at_the_size_of_its_turn"

_ORACLE: Final = (
    (
        "bands_rise_a_step_early",
        "the degree of the harmonics is that of the next step: Inria counts from 1, and raises at multiples of 1,000",
        "training.py",
        "degree = sh_degree_at(step, recipe.sh_interval",
        "degree = sh_degree_at(step + 1, recipe.sh_interval",
        SETTINGS,
    ),
    (
        "bands_rise_from_the_first_step",
        "the step from which bands are counted is a setting that the step does not read",
        "training.py",
        ", isqrt(gaussians.sh.shape[1]) - 1, recipe.updates.sh_start_iter)",
        ", isqrt(gaussians.sh.shape[1]) - 1)",
        RULES,
    ),
    (
        "gradients_that_wait_are_lost",
        "a parameter that waits moves by the gradient of its own step alone",
        "training.py",
        "{name: g + state.waiting.get(name, 0.0) for name, g in grads.items()}",
        "dict(grads)",
        RULES,
    ),
    (
        "schedule_ahead_of_the_update",
        "the schedule is asked before the optimizer: every rate is that of the next step (torch warns of the order)",
        "training.py",
        "rates = learning_rates(state.step, scene_scale",
        "rates = learning_rates(state.step + 1, scene_scale",
        SETTINGS,
    ),
    (
        "schedule_of_thirty_thousand",
        "rates decay over 30,000 steps, however many there are (a mapper that keeps its first rate: Gaussian-SLAM #46)",
        "training.py",
        "scene_scale, recipe.max_steps, recipe.lr, recipe.updates)",
        "scene_scale, 30_000, recipe.lr, recipe.updates)",
        SETTINGS,
    ),
    (
        "positions_move_in_world_units",
        "the rate of the centres is not in scene scales (asked about in SuGaR #30)",
        "training.py",
        "rates = learning_rates(state.step, scene_scale,",
        "rates = learning_rates(state.step, 1.0,",
        SETTINGS,
    ),
    (
        "loss_never_changes",
        "L2 goes on where L1 was to take over",
        "training.py",
        "goal = recipe.at(state.step, recipe.l2_stop_iter)",
        "goal = recipe.at(state.step, None)",
        SETTINGS,
    ),
    (
        "whole_dissimilarity",
        "D-SSIM that is asked to be halved is not",
        "training.py",
        "options = (goal.lambda_ssim, goal.padding, mask, goal.d_ssim_halved, goal.pixel_scale)",
        "options = (goal.lambda_ssim, goal.padding, mask, False, goal.pixel_scale)",
        SETTINGS,
    ),
    (
        "depth_not_divided_by_alpha",
        "sparse points are compared with accumulated depth (RGB+D, strands-labs/robots #2322)",
        "training.py",
        'mode = "RGB+ED" if deep else "RGB"',
        'mode = "RGB+D" if deep else "RGB"',
        FEW,
    ),
    (
        "opacity_term_pulls_at_activations",
        "the gradient of the mean opacity is added to the logits' as it is",
        "training.py",
        'grads["opacities"] += opacities_from_logits_vjp(params["opacities"], v_opacities)',
        'grads["opacities"] += v_opacities',
        FEW,
    ),
    (
        "mean_scale_costs_nothing",
        "the mean scale pulls and is no part of the loss that is told",
        "training.py",
        "loss += recipe.scale_reg * mean_activation(gaussians.scales)",
        "loss += 0.0 * mean_activation(gaussians.scales)",
        FEW,
    ),
    (
        "entropy_never_stops",
        "the entropy of opacities goes on to the end of the training",
        "training.py",
        "if recipe.lambda_entropy != 0.0 and recipe.pop_start_iter <= step < recipe.pop_stop_iter:",
        "if recipe.lambda_entropy != 0.0 and recipe.pop_start_iter <= step:",
        SETTINGS,
    ),
    (
        "important_in_this_view_alone",
        "what earlier views of the window have shown to be important is forgotten",
        "training.py",
        'counts + state.statistics.dominant_sum if recipe.pop_views == "window" else counts',
        "counts",
        SETTINGS,
    ),
    (
        "last_prune_a_step_late",
        "the last prune of faint Gaussians comes a step after its own",
        "training.py",
        "if step == config.final_prune_iter:",
        "if step == config.final_prune_iter + 1:",
        DENSITY,
    ),
)

_PROGRAM: Final = (
    (
        "renders_are_not_exposed",
        "a render is compared with its photograph without the exposure, which then learns nothing",
        "train/torch_stepper.py",
        "image = self._task.appearance.exposed(rendered.image, index)",
        "image = rendered.image",
        EXPOSED,
    ),
    (
        "depth_of_all_points",
        "a photograph is compared with the depth of every sparse point, also of those that it does not see",
        "train/views.py",
        "torch.from_numpy(points[view.seen]).to(dtype)",
        "torch.from_numpy(points).to(dtype)",
        FEW,
    ),
    (
        "depth_behind_the_mask",
        "sparse points count also where a mask leaves the photograph out",
        "train/views.py",
        "return depth_samples(self.points, camera, self.mask)",
        "return depth_samples(self.points, camera, None)",
        FEW,
    ),
    (
        "depth_in_world_units",
        "the weight of depth is not in scene scales: gsplat's example multiplies the loss by its scene_scale",
        "train/torch_stepper.py",
        "yield config.depth_lambda * self._task.scene_scale * sparse_depth_loss(",
        "yield config.depth_lambda * sparse_depth_loss(",
        FEW,
    ),
    (
        "steps_forget_the_scale",
        "a run does not tell its engine the scale of the scene",
        "train/training_run.py",
        "Task(*given, self._stop, self._scene_scale)",
        "Task(*given, self._stop)",
        FEW,
    ),
    (
        "rates_forget_the_scale",
        "a run lists its rates for a scene of one unit",
        "train/training_run.py",
        "self.updates = updates_of_strategy(self.config, self.strategy, self._scene_scale)",
        "self.updates = updates_of_strategy(self.config, self.strategy, 1.0)",
        SETTINGS,
    ),
    (
        "sizes_forget_the_scale",
        "a run tells its strategy that the scene is one unit large",
        "train/training_run.py",
        "self.strategy.initialize_state(self._scene_scale, seed",
        "self.strategy.initialize_state(1.0, seed",
        DENSITY,
    ),
    (
        "changes_of_the_next_step",
        "Gaussians change by the number of the step to come, as where a loop counts before it edits",
        "train/training_run.py",
        "self._change(self.step - 1) if stats else None",
        "self._change(self.step) if stats else None",
        DENSITY,
    ),
    (
        "phase_of_the_next_step",
        "bands, prior and loss are those of the step to come",
        "train/training_run.py",
        "phase, stepper = phase_at(self.config, self.strategy, first), self.stepper",
        "phase, stepper = phase_at(self.config, self.strategy, first + 1), self.stepper",
        SETTINGS,
    ),
    (
        "loss_of_the_first_step",
        "the loss that a run begins with stays to its end",
        "train/schedule.py",
        "objective=config.objective_at(step),",
        "objective=config.objective_at(0),",
        SETTINGS,
    ),
    (
        "terms_are_not_told",
        "a step tells the photometric loss alone and minimises more",
        "train/torch_stepper.py",
        "0.0 if look.term is None else look.term.item()",
        "0.0",
        SETTINGS,
    ),
    (
        "loss_of_the_first_view",
        "of several views of a step the loss of the first one is told",
        "train/torch_stepper.py",
        "StepStats(*(sum(column) / len(rows) for column in",
        "StepStats(*(column[0] for column in",
        BATCH,
    ),
    (
        "sum_over_views",
        "the gradients of the views of a step are added up and not divided: rates depend on the batch",
        "train/torch_stepper.py",
        "ranks.total(gradients()).div_(size)",
        "ranks.total(gradients())",
        BATCH,
    ),
    (
        "always_the_papers_renderer",
        "a run draws its steps by the constants of the paper, whatever its method's are",
        "train/views.py",
        '"profile": config.renderer,',
        '"profile": "paper",',
        METHODS,
    ),
    (
        "always_valid_windows",
        "a method that pads SSIM's windows is trained without the padding (gsplat pads none, Inria all)",
        "train/presets.py",
        '"ssim_padding": recipe.padding,',
        '"ssim_padding": "valid",',
        METHODS,
    ),
    (
        "always_the_usual_rates",
        "a method with rates of its own is trained at the usual ones",
        "train/presets.py",
        '"lr": recipe.lr,',
        '"lr": LearningRates(),',
        METHODS,
    ),
    (
        "passes_by_the_papers_renderer",
        "a run's passes draw by the constants of the paper: scores are of pictures that the method never draws",
        "density/passes.py",
        "return cls(backend, views, config.renderer, config.background",
        'return cls(backend, views, "paper", config.background',
        PASSES,
    ),
    (
        "passes_over_held_out_views",
        "scores are summed over the held-out photographs as well",
        "train/training_run.py",
        "views = self.appearance.seen(self._train)",
        "views = self.appearance.seen([*self._train, *self._test])",
        PASSES,
    ),
    (
        "passes_with_all_bands",
        "a pass draws all bands, also those whose turn has not come",
        "train/training_run.py",
        "passes=passes, sh_degree=self.sh_degree(step))",
        "passes=passes, sh_degree=self.config.sh_degree)",
        PASSES,
    ),
    (
        "photograph_of_the_first_view",
        "points that are set anew take the colours of the first photograph",
        "density/passes.py",
        "return self._views[index].photo.to(self._device)",
        "return self._views[0].photo.to(self._device)",
        POINTS,
    ),
    (
        "mask_of_the_first_view",
        "points are set anew inside the mask of the first photograph",
        "density/passes.py",
        '        """Return a view."""\n        return self._views[index]',
        '        """Return a view."""\n        return self._views[0]',
        POINTS,
    ),
    (
        "nearest_pixel",
        "a coarse photograph takes one pixel of each block",
        "train/views.py",
        "interpolation=cv2.INTER_AREA",
        "interpolation=cv2.INTER_NEAREST",
        SMALL,
    ),
    (
        "interpolated_pixels",
        "a coarse photograph is interpolated between four pixels, which leaves out the others of an area",
        "train/views.py",
        "interpolation=cv2.INTER_AREA",
        "interpolation=cv2.INTER_LINEAR",
        SMALL,
    ),
    (
        "camera_of_the_whole_photograph",
        "the intrinsics of a coarse view keep their rows of y (a size that is not that of the image: nerfstudio #2897)",
        "train/views.py",
        "    K[:, 1] *= height / view.height\n",
        "",
        CAMERA,
    ),
    (
        "intrinsics_by_the_factor",
        "intrinsics are divided by the factor, and sizes are rounded (sizes that disagree: nerfstudio #3232)",
        "train/views.py",
        "K[:, 0] *= width / view.width",
        "K[:, 0] *= 1.0 / factor",
        CAMERA,
    ),
    (
        "centre_of_half_a_pixel",
        "the principal point is scaled as if the centre of the first pixel were (0, 0)",
        "train/views.py",
        "    mask = None if view.mask is None else small(view.mask.float()) >= 0.5",
        "    K[:, :2, 2] += 0.5 * (width / view.width - 1.0)\n"
        "    mask = None if view.mask is None else small(view.mask.float()) >= 0.5",
        CAMERA,
    ),
    (
        "any_pixel_of_the_mask",
        "a coarse pixel counts where any pixel of its area does (masks and num_downscales: nerfstudio #2920)",
        "train/views.py",
        "small(view.mask.float()) >= 0.5",
        "small(view.mask.float()) > 0.0",
        MASKS,
    ),
    (
        "coarse_a_step_too_long",
        "a stop is the last step of its size, not the first of the next",
        "train/views.py",
        "sum(step < stop for stop in stops)",
        "sum(step <= stop for stop in stops)",
        SIZES,
    ),
    (
        "sizes_by_view",
        "shrunk views are listed view by view and looked up size by size",
        "train/views.py",
        "[shrunk(view, 2**level) for level in range(len(stops) + 1) for view in views]",
        "[shrunk(view, 2**level) for view in views for level in range(len(stops) + 1)]",
        SIZES,
    ),
    (
        "stops_count_views",
        "where a step has several views, stops count views (a schedule by epochs: stable-dreamfusion #29)",
        "train/views.py",
        "index_at(place // size, index, len(views), stops)",
        "index_at(place, index, len(views), stops)",
        SIZES,
    ),
    (
        "smallest_side_of_the_whole",
        "a photograph is shrunk as long as its own side is large enough: windows of SSIM leave the coarse one",
        "train/views.py",
        "min(view.height, view.width) < SMALLEST_SIDE * factor",
        "min(view.height, view.width) < SMALLEST_SIDE",
        SIZES,
    ),
)

WHOLE_STEPS: Final = tuple(Mutant(*line) for line in _ORACLE)
WHOLE_STEPS_PROGRAM: Final = tuple(Mutant(*line, package=PACKAGE) for line in _PROGRAM)
