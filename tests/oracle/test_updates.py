"""Whom Adam moves at which step: numbers of updates and rates of every method's schedule, against counts by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pop_ref.density import zero_statistics
from pop_ref.optimizer import is_updated, learning_rates, sh_degree_at, update_numbers
from pop_ref.recipes import BASELINES, RECIPES
from pop_ref.settings import Recipe, UpdateRules
from pop_ref.training import Training, rows_from_params, update

NAMES = ("means", "opacities", "shN")


def moved(recipe: Recipe, name: str) -> list[int]:
    return [step for step in range(recipe.max_steps) if is_updated(name, step, recipe)]


def test_a_step_that_edits_the_population_moves_nothing_in_inrias_loop() -> None:
    quiet = sorted(set(range(30_000)) - set(moved(RECIPES["3DGS"], "means")))
    assert quiet == list(range(600, 15_000, 100))
    assert len(quiet) == 144
    assert moved(RECIPES["gsplat"], "means") == list(range(30_000))


def test_a_round_of_pup_loses_the_update_that_its_pruning_replaces_and_starts_adam_anew() -> None:
    recipe = BASELINES["PUP-3DGS"]
    late = [step for step in moved(recipe, "means") if step >= 30_000]
    assert late == [*range(30_001, 35_000), *range(35_001, 40_000)]
    assert update_numbers(NAMES, 30_001, recipe) == dict.fromkeys(NAMES, 1)
    assert update_numbers(NAMES, 34_999, recipe)["means"] == 4_999


def test_taming_moves_upper_bands_each_16_steps_and_opacities_until_15_000() -> None:
    recipe = replace(BASELINES["Taming-3DGS"], updates=replace(BASELINES["Taming-3DGS"].updates))
    bands = moved(recipe, "shN")
    assert bands[:3] == [15, 31, 47]
    assert all((step + 1) % 16 == 0 for step in bands)
    assert max(moved(recipe, "opacities")) == 14_999
    assert max(moved(recipe, "means")) == 29_999
    assert update_numbers(["shN"], 47, recipe) == {"shN": 3}


def test_the_positions_rate_of_mini_splatting_goes_back_to_what_it_was() -> None:
    rules, plain = BASELINES["Mini-Splatting"].updates, UpdateRules()
    for step, like in ((14_999, 14_999), (15_000, 5_000), (29_999, 19_999)):
        assert learning_rates(step, 1.0, rules=rules)["means"] == learning_rates(like, 1.0, rules=plain)["means"]
    steps = (14_999, 15_999, 16_000, 17_000, 18_000)
    assert [sh_degree_at(step, start=rules.sh_start_iter) for step in steps] == [0, 0, 1, 2, 3]


def test_in_a_round_of_pup_rates_fall_from_where_the_training_ended() -> None:
    rules = BASELINES["PUP-3DGS"].updates
    first, last = (learning_rates(step, 1.0, 40_000, rules=rules) for step in (30_000, 34_999))
    assert first["means"] == pytest.approx(1.6e-4 * 0.01 ** (30_001 / 35_000), rel=1e-14)
    assert last["means"] == pytest.approx(1.6e-6, rel=1e-14)
    # twelve times, 0.95 each
    assert last["scales"] / first["scales"] == pytest.approx(0.95**12, rel=1e-14)
    assert learning_rates(35_000, 1.0, 40_000, rules=rules) == first
    before = learning_rates(29_999, 1.0, 40_000, rules=rules)
    assert before["means"] == pytest.approx(1.6e-4 * 0.01 ** (29_999 / 30_000), rel=1e-14)
    assert before["scales"] == first["scales"]


def test_gradients_that_wait_are_spent_at_once() -> None:
    recipe = Recipe(updates=UpdateRules(sh_rest_every=3))
    rows = rows_from_params({"means": np.zeros((1, 3)), "shN": np.zeros((1, 3, 3))})
    state = Training(rows, zero_statistics(1))
    for step, size in enumerate((1.0, 2.0, 4.0)):
        state = replace(state, step=step)
        grads = {"means": np.ones((1, 3)), "shN": np.full((1, 3, 3), size)}
        rows, waiting = update(state.rows, grads, state, 1.0, recipe)
        state = replace(state, rows=rows, waiting=waiting)
        assert (state.rows.params["shN"] != 0.0).any() == (step == 2)
    assert not state.waiting
    # m = (1 - beta1) g of the sum of all three
    np.testing.assert_allclose(state.rows.m["shN"], 0.1 * 7.0, rtol=1e-14)
    assert (state.rows.params["means"] != 0.0).all()
