"""Mutants of what a training's steps collect for density control and learn of photographs, and of what passes sum."""

from __future__ import annotations

from typing import Final

from pop_ref.conformance.mutants.copies import PROGRAM as PACKAGE
from pop_ref.conformance.mutants.copies import Mutant

_LAWS: Final = "test_collected"
MASK: Final = f"{_LAWS}:pixels_that_a_mask_leaves_out_are_not_collected"
BATCH: Final = f"{_LAWS}:the_views_of_one_step_are_collected_one_after_the_other"
SUMS: Final = f"{_LAWS}:a_training_collects_the_oracles_gradients_views_and_blur_flags"

_LINES: Final = (
    (
        "masked_pixels_are_dominated",
        "pixels that a mask leaves out count for the Gaussians that dominate them",
        "train/views.py",
        "ids = dominant_ids[0][mask & (dominant_ids[0] >= 0)]",
        "ids = dominant_ids[0][dominant_ids[0] >= 0]",
        MASK,
    ),
    (
        "share_of_the_whole_photograph",
        "a step tells density control that all pixels of a masked photograph count",
        "train/views.py",
        'info["kept_pixels"] = view.kept_pixels',
        'info["kept_pixels"] = view.height * view.width',
        MASK,
    ),
    (
        "steps_over_black",
        "a step draws over black, whatever the settings' background",
        "train/views.py",
        "background = torch.tensor(config.background)",
        "background = torch.zeros(3)",
        SUMS,
    ),
    (
        "steps_are_classic",
        "a training that was asked to be antialiased is classic",
        "train/views.py",
        '"antialiased" if config.antialiased else "classic"',
        '"classic"',
        f"{_LAWS}:antialiased_steps_collect_antialiased_gradients",
    ),
    (
        "all_bands_from_the_first_step",
        "a step draws with all bands, also with those whose turn has not come",
        "train/torch_stepper.py",
        "            phase.sh_degree,",
        "            config.sh_degree,",
        SUMS,
    ),
    (
        "gradients_of_the_mean_over_views",
        "screen gradients are those of the mean over the views of a step, and thresholds depend on how many these are",
        "train/torch_stepper.py",
        "means2d.absgrad if strategy.absgrad else means2d.grad",
        "means2d.grad / self._task.config.batch_size",
        BATCH,
    ),
    (
        "last_view_of_the_step",
        "of the views of a step the last one alone is collected",
        "train/torch_stepper.py",
        "for place, index in enumerate(indices):",
        "for place, index in list(enumerate(indices))[-1:]:",
        BATCH,
    ),
    (
        "passes_count_masked_pixels",
        "a pass over a photograph counts dominated pixels that its mask leaves out",
        "density/passes.py",
        "dominant_counts(ids if mask is None else ids[mask.to(ids.device)]",
        "dominant_counts(ids",
        f"{_LAWS}:passes_over_photographs_count_dominated_pixels_inside_the_mask",
    ),
    (
        "passes_over_black",
        "passes over photographs draw over black",
        "density/passes.py",
        'background = self._background.to(raw["means"])',
        'background = torch.zeros_like(raw["means"][0])',
        f"{_LAWS}:passes_over_photographs_sum_what_their_views_show",
    ),
    (
        "appearance_does_not_decay",
        "exposures and cameras are learned at their first rates to the end",
        "train/appearance.py",
        "rate * decay**share",
        "rate",
        "test_few_photographs:rates_of_exposures_and_cameras_fall_from_step_to_step_and_not_as_one_another",
    ),
    (
        "cameras_drift_together",
        "the motion that all cameras share is left in them: the scene turns away from its held-out views",
        "train/appearance.py",
        'if "cameras" in self.params:\n            self.params["cameras"].copy_',
        'if "none" in self.params:\n            self.params["cameras"].copy_',
        "test_few_photographs:exposures_and_cameras_learn_as_the_oracles_do",
    ),
)

COLLECTED: Final = tuple(Mutant(*line, package=PACKAGE) for line in _LINES)
