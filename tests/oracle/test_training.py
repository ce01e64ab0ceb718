"""Whole training steps: the loss falls, the ladder of ten losses stands, every recipe does what its name says."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from pop_ref import density
from pop_ref.polarization import pop_loss
from pop_ref.recipes import RECIPES, Recipe
from pop_ref.render import render
from pop_ref.training import Training, control, gaussians_from_params, objective, start, train_step
from tests.golden import ten_losses

CAMERAS, PHOTOS = ten_losses.cameras(), ten_losses.photographs()
PARAMS = ten_losses.first_params()


@functools.cache
def ladder() -> list[ten_losses.Rung]:
    return ten_losses.ladder()


def trained(params: dict[str, np.ndarray], steps: int, recipe: Recipe) -> tuple[Training, list[float]]:
    state, losses = start(params), []
    for step in range(steps):
        state, loss = train_step(state, CAMERAS[step % 3], PHOTOS[step % 3], 1.0, ten_losses.draws, recipe)
        losses.append(loss)
    return state, losses


def objective_at(step: int, recipe: Recipe, statistics: density.Statistics | None = None):
    gaussians = gaussians_from_params(PARAMS)
    view = render(gaussians, CAMERAS[0])
    state = replace(start(PARAMS), step=step)
    state = state if statistics is None else replace(state, statistics=statistics)
    return gaussians, view, objective(view, gaussians, PHOTOS[0], state, recipe)


# the other recipes part from these two only later than step 30
@pytest.mark.parametrize("name", ["POP", "3DGS"])
def test_thirty_steps_lower_the_loss_of_every_view(name: str) -> None:
    _, losses = trained(PARAMS, 30, RECIPES[name])
    for view in range(3):
        assert losses[27 + view] < 0.95 * losses[view]


def test_ten_losses_are_those_written_down() -> None:
    rungs, written = ladder(), ten_losses.written()
    assert [rung.n for rung in rungs] == [rung.n for rung in written]
    np.testing.assert_allclose([rung.loss for rung in rungs], [rung.loss for rung in written], rtol=1e-9)


def test_the_ladder_passes_through_every_kind_of_edit(monkeypatch: pytest.MonkeyPatch) -> None:
    edits: dict[str, int] = {"clone_rows": 0, "split_rows": 0, "prune_rows": 0}
    for name in edits:
        original = getattr(density, name)

        def counting(rows, mask, *rest, name=name, original=original):
            edits[name] += int(mask.sum())
            return original(rows, mask, *rest)

        monkeypatch.setattr(density, name, counting)
    ten_losses.ladder()
    assert edits == {"clone_rows": 2, "split_rows": 6, "prune_rows": 2}


def test_the_same_training_gives_the_same_bits() -> None:
    assert ten_losses.ladder() == ladder()


def test_a_step_does_not_touch_the_state_it_starts_from() -> None:
    state = start(PARAMS)
    before = {name: array.copy() for name, array in state.rows.params.items()}
    train_step(state, CAMERAS[0], PHOTOS[0], 1.0, ten_losses.draws)
    assert all(np.array_equal(before[name], state.rows.params[name]) for name in before)
    assert not any(np.any(moment) for moment in (*state.rows.m.values(), *state.rows.v.values()))
    assert state.statistics.n_views == 0


def test_a_key_that_is_not_trained_goes_with_its_row() -> None:
    params = {**PARAMS, "tags": np.arange(10.0)}
    state, _ = trained(params, 1, RECIPES["POP"])
    assert np.array_equal(state.rows.params["tags"], np.arange(10.0))
    assert not np.array_equal(state.rows.params["means"], PARAMS["means"])
    assert set(state.rows.params) == set(state.rows.m) == set(state.rows.v) == set(params)
    # and through densification steps that clone, split and prune
    tagged, _ = trained(params, 10, ten_losses.RECIPE)
    plain, _ = trained(PARAMS, 10, ten_losses.RECIPE)
    assert len(tagged.rows) == len(plain.rows) != 10
    assert set(tagged.rows.params["tags"]) < set(range(10))
    for name in PARAMS:
        assert np.array_equal(tagged.rows.params[name], plain.rows.params[name])


def test_statistics_come_from_the_same_forward_pass_as_the_loss() -> None:
    state, _ = train_step(start(PARAMS), CAMERAS[0], PHOTOS[0], 1.0, ten_losses.draws)
    view = render(gaussians_from_params(PARAMS), CAMERAS[0], sh_degree=0)
    np.testing.assert_array_equal(state.statistics.dominant_sum, view.dominant_counts)
    np.testing.assert_array_equal(state.statistics.n_visible, view.splats.visible)
    assert np.any(state.statistics.grad_sum > 0.0)


def test_bands_above_the_scheduled_degree_stay_untouched() -> None:
    state, _ = trained(PARAMS, 4, replace(RECIPES["POP"], sh_interval=4))
    assert np.array_equal(state.rows.params["shN"], PARAMS["shN"])
    state, _ = train_step(state, CAMERAS[0], PHOTOS[0], 1.0, ten_losses.draws, replace(RECIPES["POP"], sh_interval=4))
    assert not np.array_equal(state.rows.params["shN"], PARAMS["shN"])


def test_pop_term_is_there_from_its_first_step_to_the_one_before_its_last() -> None:
    recipe = replace(RECIPES["POP"], pop_start_iter=3, pop_stop_iter=5)
    base = objective_at(2, recipe)[2]
    assert not np.any(base[2])
    for step, there in ((3, True), (4, True), (5, False)):
        gaussians, view, (loss, v_image, v_opacities) = objective_at(step, recipe)
        mask = view.dominant_counts > 0
        assert loss - base[0] == pytest.approx(there * 1e-3 * pop_loss(gaussians.opacities, mask), abs=1e-16)
        np.testing.assert_array_equal(v_image, base[1])
        assert np.any(v_opacities) == there


def test_importance_may_be_taken_from_the_window_instead_of_the_view() -> None:
    view = render(gaussians_from_params(PARAMS), CAMERAS[0])
    lost = int(np.flatnonzero(view.dominant_counts == 0)[0])
    seen_before = replace(density.zero_statistics(len(view.dominant_counts)), n_views=1)
    seen_before.dominant_sum[lost] = 5
    *_, current = objective_at(0, RECIPES["POP"], seen_before)[2]
    *_, window = objective_at(0, replace(RECIPES["POP"], pop_views="window"), seen_before)[2]
    assert current[lost] > 0.0
    assert window[lost] < 0.0
    assert np.array_equal(current < 0.0, view.dominant_counts > 0)


def test_the_pop_term_may_leave_out_what_the_view_does_not_show() -> None:
    params = {name: array.copy() for name, array in PARAMS.items()}
    params["means"][0] = [50.0, 0.0, 0.0]
    gaussians = gaussians_from_params(params)
    view = render(gaussians, CAMERAS[1])
    assert not view.splats.visible[0]
    state = start(params)
    *_, everyone = objective(view, gaussians, PHOTOS[1], state, RECIPES["POP"])
    *_, shown = objective(view, gaussians, PHOTOS[1], state, replace(RECIPES["POP"], pop_over="visible"))
    assert everyone[0] > 0.0
    assert shown[0] == 0.0


def test_l2_may_give_way_to_the_objective_of_3dgs() -> None:
    recipe = replace(RECIPES["L2"], l2_stop_iter=7)
    assert objective_at(6, recipe)[2][0] == objective_at(0, RECIPES["L2"])[2][0]
    assert objective_at(7, recipe)[2][0] == objective_at(0, RECIPES["gsplat"])[2][0]


def test_recipes_are_the_rows_of_the_ablation_tables() -> None:
    def has(recipe: Recipe) -> tuple[bool, bool, bool]:
        config, steps = recipe.density, range(30_000)
        return (
            any(density.blurs_at(s, config) for s in steps),
            recipe.lambda_pop > 0.0,
            any(density.resets_at(s, config) for s in steps),
        )

    assert {name: has(recipe) for name, recipe in RECIPES.items()} == {
        "POP": (True, True, False),
        "L2": (False, False, False),
        "L2+Blur": (True, False, False),
        "L2+POP": (False, True, False),
        "Reset": (True, False, True),
        "3DGS": (False, False, True),
        "3DGS 2023": (False, False, True),
        "gsplat": (False, False, True),
    }
    assert [name for name, recipe in RECIPES.items() if recipe.pixelwise == "l1"] == ["3DGS", "3DGS 2023", "gsplat"]


def test_a_densification_and_a_reset_of_one_step_happen_in_that_order() -> None:
    rows = start(PARAMS).rows
    config = replace(density.GSPLAT, reset_every=600, prune_opa=0.02)
    after, _ = control(rows, density.zero_statistics(len(rows)), 1.0, 600, ten_losses.draws, config)
    # were the reset first, its ceiling of 0.01 would put everybody under the pruning threshold
    assert len(after) == len(rows) - 1
    assert np.max(after.params["opacities"]) == pytest.approx(np.log(0.01 / 0.99))


def test_nothing_can_be_trained_without_error() -> None:
    nobody = {name: array[:0] for name, array in PARAMS.items()}
    recipe = replace(ten_losses.RECIPE, density=replace(ten_losses.RECIPE.density, refine_start_iter=0))
    state, losses = trained(nobody, 7, recipe)
    assert len(state.rows) == 0
    assert losses[0] == losses[3] == losses[6]


def test_a_population_may_die_out_during_training() -> None:
    faint = {**PARAMS, "opacities": np.full(10, -9.0)}
    state, losses = trained(faint, 6, ten_losses.RECIPE)
    assert len(state.rows) == 0
    assert np.all(np.isfinite(losses))
