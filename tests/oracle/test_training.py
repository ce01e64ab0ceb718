"""Training: the ladder of ten losses stands, recipes and schedules do what their names say, settings show in a step."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from pop_ref import density, losses
from pop_ref.activations import opacities_from_logits, opacities_from_logits_vjp
from pop_ref.ambiguities import AMBIGUITIES
from pop_ref.conformance.short_training import ShortTraining
from pop_ref.constants import GSPLAT_1_6, INRIA, PAPER, Profile
from pop_ref.density import Rows, rows_from_params, split_rows
from pop_ref.optimizer import adam_step, is_updated, learning_rates, means_learning_rate, sh_degree_at, update_numbers
from pop_ref.polarization import pop_loss, pop_loss_vjp
from pop_ref.recipes import BASELINES, L1_DIVIDED, RECIPES, Recipe
from pop_ref.records import Render
from pop_ref.render import render, render_vjp
from pop_ref.settings import LearningRates, UpdateRules
from pop_ref.short_training import taken_steps
from pop_ref.training import Training, control, gaussians_from_params, objective, params_vjp, start, train_step, update
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


def objective_at(step: int, recipe: Recipe):
    gaussians = gaussians_from_params(PARAMS)
    view = render(gaussians, CAMERAS[0])
    return gaussians, view, objective(view, gaussians, PHOTOS[0], replace(start(PARAMS), step=step), recipe)


def test_ten_losses_are_those_written_down() -> None:
    rungs, written = ladder(), ten_losses.WRITTEN
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


@pytest.mark.parametrize("reset_every", [0, 1])
def test_gradients_that_wait_through_a_last_prune_are_of_those_that_are_left(reset_every: int) -> None:
    base = RECIPES["POP"]
    # a reset of the same step comes first, and makes all of them faint
    config = replace(base.density, final_prune_iter=1, final_prune_opa=0.45, reset_every=reset_every, reset_opa=0.4)
    recipe = replace(base, density=config, updates=replace(base.updates, sh_rest_every=4))
    state, _ = trained(PARAMS, 2, recipe)
    assert len(state.waiting["shN"]) == len(state.rows) < len(PARAMS["means"])
    assert (len(state.rows) > 0) == (reset_every == 0)
    kept, _ = trained(PARAMS, 2, replace(recipe, density=replace(config, final_prune_iter=-1)))
    left = [int(np.argmin(np.abs(kept.rows.params["means"] - mean).sum(axis=1))) for mean in state.rows.params["means"]]
    np.testing.assert_array_equal(state.waiting["shN"], kept.waiting["shN"][left])


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


def test_an_update_decays_second_moments_as_its_recipe_says() -> None:
    before, gradient = start({"means": np.zeros((1, 3))}), {"means": np.full((1, 3), 2.0)}
    for beta2 in (0.999, 0.75):
        moved, _ = update(before.rows, gradient, before, 1.0, Recipe(lr=LearningRates(beta2=beta2)))
        np.testing.assert_allclose(moved.v["means"], (1.0 - beta2) * 4.0, rtol=1e-12)
        np.testing.assert_allclose(moved.m["means"], 0.2, rtol=1e-12)


def test_updates_count_from_one() -> None:
    with pytest.raises(ValueError, match="step is 0"):
        adam_step({}, {}, {}, {}, 0, {})


@pytest.mark.parametrize(("opacity", "steps"), [(0.1, 130), (0.5, 380), (0.99, 430)])
def test_an_opacity_that_only_pop_touches_falls_under_the_pruning_threshold_in_so_many_steps(opacity, steps):
    logit = {"o": np.log(np.array([opacity]) / (1.0 - opacity))}
    m = v = {"o": np.zeros(1)}
    taken = 0
    while opacities_from_logits(logit["o"])[0] >= 0.005:
        taken += 1
        gradient = {"o": opacities_from_logits_vjp(logit["o"], np.array([1e-3 / 40_000]))}
        logit, m, v = adam_step(logit, gradient, m, v, taken, {"o": LearningRates().opacities})
    assert taken == pytest.approx(steps, abs=5)


def test_positions_start_at_their_rate_and_end_at_a_hundredth_of_it() -> None:
    assert means_learning_rate(0, 3.0) == 1.6e-4 * 3.0
    assert means_learning_rate(30_000, 3.0) == pytest.approx(1.6e-6 * 3.0, rel=1e-14)
    assert means_learning_rate(99_999, 3.0) == means_learning_rate(30_000, 3.0)
    assert means_learning_rate(-1, 3.0) == means_learning_rate(0, 3.0)
    halfway = learning_rates(500, 2.0, max_steps=1000)["means"]
    assert halfway == pytest.approx(0.1 * learning_rates(0, 2.0)["means"], rel=1e-14)


# Every setting of a recipe is seen in a training step: the loss and the next Gaussians are those found by hand.

CAMERA, PHOTO = ten_losses.cameras()[0], ten_losses.photographs()[0]
# one opaque Gaussian that shows the ceilings apart, and one that this view does not show
RECIPES_PARAMS = {name: array.copy() for name, array in ten_losses.first_params().items()}
RECIPES_PARAMS["opacities"][7] = 9.0
RECIPES_PARAMS["means"][0] = [50.0, 0.0, 0.0]


def in_this_view(view: Render) -> np.ndarray:
    return view.dominant_counts > 0


@dataclass(frozen=True)
class ByHand:
    """What a step ought to do; the defaults are POP's first step.

    Attributes:
        step: its number.
        loss, vjp: of the image.
        weights: their settings.
        profile: of the renderer.
        important: who is, None where there is no POP term.
        visible_only: the POP term leaves out what is not seen.
        opacity_rate: learning rate of the opacities.
    """

    step: int = 0
    loss: Callable[..., float] = losses.photometric_pop
    vjp: Callable[..., np.ndarray] = losses.photometric_pop_vjp
    weights: dict[str, Any] = field(default_factory=dict)
    profile: Profile = PAPER
    important: Callable[[Render], np.ndarray] | None = in_this_view
    visible_only: bool = False
    opacity_rate: float = 0.05

    def take(self, state: Training) -> tuple[dict[str, np.ndarray], float]:
        gaussians, degree = gaussians_from_params(RECIPES_PARAMS), sh_degree_at(self.step, max_degree=1)
        view = render(gaussians, CAMERA, sh_degree=degree, profile=self.profile)
        loss = self.loss(view.image, PHOTO, **self.weights)
        v_image = self.vjp(view.image, PHOTO, 1.0, **self.weights)
        v_opacities = np.zeros(len(gaussians))
        if self.important is not None:
            shown = view.splats.visible if self.visible_only else None
            loss += 1e-3 * pop_loss(gaussians.opacities, self.important(view), shown)
            v_opacities = pop_loss_vjp(gaussians.opacities, self.important(view), 1e-3, shown)
        gradients = render_vjp(gaussians, CAMERA, v_image, sh_degree=degree, profile=self.profile)
        grads = params_vjp(RECIPES_PARAMS, gradients, v_opacities)
        rates = {**learning_rates(self.step, 1.0), "opacities": self.opacity_rate}
        return adam_step(RECIPES_PARAMS, grads, state.rows.m, state.rows.v, self.step + 1, rates)[0], loss


L1 = {"loss": losses.photometric_3dgs, "vjp": losses.photometric_3dgs_vjp}
SEEN_BEFORE = 6

ALTERNATIVES = {
    "Recipe.pop_views = window": ByHand(important=lambda view: in_this_view(view) | (np.arange(10) == SEEN_BEFORE)),
    "Recipe.pixel_scale = 0.5": ByHand(weights={"l2_scale": 0.5}),
    "Recipe.pixel_scale = 3.0": ByHand(weights={"l2_scale": 3.0}),
    "Recipe.d_ssim_halved = True": ByHand(weights={"halved": True}),
    "Recipe.padding = same": ByHand(weights={"padding": "same"}),
    "Recipe.pop_over = visible": ByHand(visible_only=True),
    "Recipe.pop_start_iter = 500": ByHand(important=None),
    "Recipe.l2_stop_iter = 15000": ByHand(step=15_000, **L1, weights={"lambda_ssim": 0.2}, important=None),
    "Recipe.lambda_pop = 0.0": ByHand(important=None),
    "Recipe.lambda_ssim = 0.0": ByHand(weights={"lambda_ssim": 0.0}),
    "Recipe.profile = gsplat_1_6": ByHand(profile=GSPLAT_1_6),
    "Recipe.profile = inria": ByHand(profile=INRIA),
}


def state_at(step: int) -> Training:
    state = replace(start(RECIPES_PARAMS), step=step)
    state.statistics.dominant_sum[SEEN_BEFORE] = 5
    return state


def taken(recipe: Recipe, step: int = 0) -> tuple[dict[str, np.ndarray], float]:
    state, loss = train_step(state_at(step), CAMERA, PHOTO, 1.0, ten_losses.draws, recipe)
    return dict(state.rows.params), loss


def assert_same_step(recipe: Recipe, by_hand: ByHand) -> None:
    (params, loss), (expected, expected_loss) = taken(recipe, by_hand.step), by_hand.take(state_at(by_hand.step))
    assert loss == pytest.approx(expected_loss, rel=1e-14)
    for name, array in expected.items():
        np.testing.assert_array_equal(params[name], array, err_msg=name)


def chosen(alternative: str) -> Recipe:
    name, text = alternative.removeprefix("Recipe.").split(" = ")
    default = getattr(Recipe(), name)
    values = {"gsplat_1_6": GSPLAT_1_6, "inria": INRIA, "True": True, "15000": 15_000}
    return replace(Recipe(), **{name: values[text] if text in values else type(default)(text)})


def test_every_alternative_of_a_recipe_is_in_the_table() -> None:
    listed = {text for ambiguity in AMBIGUITIES for text in ambiguity.alternatives if text.startswith("Recipe.")}
    assert set(ALTERNATIVES) == listed


def test_a_step_of_pop_is_the_one_taken_by_hand() -> None:
    assert_same_step(RECIPES["POP"], ByHand())


@pytest.mark.parametrize("alternative", ALTERNATIVES)
def test_an_alternative_reading_takes_the_step_it_says_and_not_pops(alternative: str) -> None:
    by_hand = ALTERNATIVES[alternative]
    assert_same_step(chosen(alternative), by_hand)
    params, loss = taken(RECIPES["POP"], by_hand.step)
    expected, expected_loss = by_hand.take(state_at(by_hand.step))
    assert loss != pytest.approx(expected_loss, rel=1e-9)
    assert any(not np.array_equal(params[name], expected[name]) for name in params)


@pytest.mark.parametrize("n", L1_DIVIDED)
def test_l1_divided_is_the_share_of_l1_beside_an_unchanged_d_ssim(n: int) -> None:
    image = render(gaussians_from_params(RECIPES_PARAMS), CAMERA, sh_degree=0).image
    expected = 0.99 * losses.l1(image, PHOTO) / n + 0.01 * losses.photometric_3dgs(image, PHOTO, 1.0)
    assert taken(L1_DIVIDED[n])[1] == pytest.approx(expected, rel=1e-14)
    assert_same_step(L1_DIVIDED[n], ByHand(**L1, weights={"lambda_ssim": 0.01, "l1_scale": 1.0 / n}, important=None))
    # A28: nothing else differs from the row "L2", which has no blur, no POP and no reset
    assert replace(L1_DIVIDED[n], pixelwise="l2", pixel_scale=1.0) == RECIPES["L2"]


def test_the_figure_has_seven_divisors() -> None:
    assert list(L1_DIVIDED) == [1, 2, 5, 10, 20, 50, 100]


def test_3dgs_is_inrias_code_of_october_2024() -> None:
    weights = {"lambda_ssim": 0.2, "padding": "same"}
    by_hand = ByHand(**L1, weights=weights, profile=INRIA, important=None, opacity_rate=0.025)
    assert_same_step(RECIPES["3DGS"], by_hand)
    config = RECIPES["3DGS"].density
    assert config.inclusive
    assert (config.grow_grad2d, config.reset_every, config.reset_opa, config.prune_opa) == (2e-4, 3000, 0.01, 0.005)


def test_gsplat_is_its_default_strategy() -> None:
    assert_same_step(RECIPES["gsplat"], ByHand(**L1, weights={"lambda_ssim": 0.2}, important=None))
    assert not RECIPES["gsplat"].density.inclusive


def population(logits: list[float]) -> Rows:
    n = len(logits)
    params = {"means": np.zeros((n, 3)), "scales": np.zeros((n, 3)), "quats": np.ones((n, 4))}
    return rows_from_params({**params, "opacities": np.array(logits)})


def test_unfit_rows_and_draws_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="lengths"):
        rows_from_params({"means": np.zeros((2, 3)), "opacities": np.zeros(3)})
    with pytest.raises(ValueError, match="at least one key"):
        rows_from_params({})
    with pytest.raises(ValueError, match=r"v\['means'\]"):
        Rows({"means": np.zeros((2, 3))}, {"means": np.zeros((2, 3))}, {"means": np.zeros((2, 2))})
    with pytest.raises(Exception, match="normals"):
        split_rows(population([0.0, 0.0]), np.array([True, False]), np.zeros((2, 2, 3)))


# What Adam moves at which step: numbers of updates and rates of every method's schedule, against counts by hand.

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
    # as its loop counts, from 1: where a multiple of 16 is a densification step too, the new tensors have no gradient
    lost = [step for step in range(16, 15_000, 16) if step % 500 == 0]
    assert lost == list(range(2_000, 15_000, 2_000))
    assert moved(recipe, "shN") == [step for step in range(16, 30_000, 16) if step not in lost]
    assert max(moved(recipe, "opacities")) == 14_999
    assert max(moved(recipe, "means")) == 29_999
    assert update_numbers(["shN"], 48, recipe) == {"shN": 3}


def test_a_short_training_of_taming_that_would_grow_by_no_score_is_told() -> None:
    settings = {"refine_start_iter": 0, "refine_every": 2}
    assert len(taken_steps(ShortTraining("taming", settings, order=(0, 1)))) == 2
    for batch in (1, 2):
        with pytest.raises(ValueError, match="step 2 is a densification step; Taming-3DGS grows by scores"):
            taken_steps(ShortTraining("taming", settings, order=(0, 1) * 3, batch=batch))


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
