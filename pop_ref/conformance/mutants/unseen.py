"""Twelve mutants after slips of training programs, written in one go and tried on the laws that there were.

`docs/kit.md` says how many were killed at first sight.
"""

from __future__ import annotations

from typing import Final

from pop_ref.conformance.mutants.copies import PROGRAM as PACKAGE
from pop_ref.conformance.mutants.copies import Mutant

_LINES: Final = (
    (
        "small_by_the_volume",
        "a Gaussian is small if the cube root of its volume is, not its longest axis",
        "stages/density.py",
        "small = scales.amax(-1) <=",
        "small = scales.prod(-1) ** (1.0 / 3.0) <=",
        "test_strategies:a_training_by_pop_is_the_oracles_at_every_step",
    ),
    (
        "large_ones_go_a_change_early",
        "pruning by size begins at the step after which it should",
        "stages/density.py",
        "step <= config.prune_too_big_after",
        "step < config.prune_too_big_after",
        "test_strategies:a_training_by_gsplat_is_the_oracles_at_every_step",
    ),
    (
        "blur_begins_a_change_late",
        "the first step of the blur rule's span has none",
        "stages/density.py",
        "config.blur_start_iter <= step",
        "config.blur_start_iter < step",
        "test_strategies:a_training_by_pop_is_the_oracles_at_every_step",
    ),
    (
        "pause_is_a_step_longer",
        "the change right at the end of the pause after a reset is left out",
        "density/control.py",
        "step % self.reset_every < self.pause_refine_after_reset",
        "step % self.reset_every <= self.pause_refine_after_reset",
        "test_strategies:a_training_by_gsplat_is_the_oracles_at_every_step",
    ),
    (
        "reset_where_refinement_ends",
        "the step at which refinement ends still resets, and nothing prunes afterwards",
        "density/control.py",
        "step % self.reset_every == 0 and step < self.refine_stop_iter",
        "step % self.reset_every == 0 and step <= self.refine_stop_iter",
        "test_strategies:no_reset_happens_where_refinement_ends",
    ),
    (
        "extents_of_all_windows",
        "the largest extent is of the whole training, not of this window",
        "density/rows.py",
        'state["radii"].zero_()',
        'state["radii"].abs_()',
        "test_strategies:a_training_is_the_oracles_under_every_reading",
    ),
    (
        "views_counted_from_one",
        "from the second window on the number of views that saw a Gaussian begins with 1",
        "density/rows.py",
        'state["count"].zero_()',
        'state["count"].fill_(1)',
        "test_strategies:a_training_by_pop_is_the_oracles_at_every_step",
    ),
    (
        "reset_keeps_the_second_moment",
        "a reset forgets the first moments of opacities alone",
        "density/rows.py",
        "if isinstance(value, Tensor) and value.shape == opacities.shape:",
        'if value is optimizers["opacities"].state[opacities]["exp_avg"]:',
        "test_strategies:a_training_by_gsplat_is_the_oracles_at_every_step",
    ),
    (
        "children_of_the_smaller",
        "children are drawn from a Gaussian that has been shrunk already",
        "stages/density.py",
        "(scales * normals)",
        "(scales / SPLIT_SHRINK * normals)",
        "test_strategies:a_training_by_pop_is_the_oracles_at_every_step",
    ),
    (
        "rounds_decay_a_step_late",
        "the steps of a round are counted from 0 where its rates fall",
        "train/schedule.py",
        "taken = (steps - start) % rules.round_steps + 1",
        "taken = (steps - start) % rules.round_steps",
        "test_optimizer:rates_rewind_and_fall_in_rounds_as_the_rules_say",
    ),
    (
        "prior_begins_a_step_late",
        "the first step of the prior has none",
        "density/control.py",
        "self.pop_start_iter <= step",
        "self.pop_start_iter < step",
        "test_strategies:a_training_by_pop_is_the_oracles_at_every_step",
    ),
    (
        "last_rate_at_the_last_step",
        "the rate of positions arrives at its end with the last step, not after it",
        "train/schedule.py",
        "(at / max_steps)",
        "(at / max(max_steps - 1, 1))",
        "test_strategies:a_training_by_pop_is_the_oracles_at_every_step",
    ),
)

UNSEEN: Final = tuple(Mutant(*line, package=PACKAGE) for line in _LINES)
