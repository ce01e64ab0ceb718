"""Training: the ladder of ten losses stands, recipes and density control do what their names say, Adam is torch's."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pop_ref import density, losses
from pop_ref.activations import opacities_from_logits, opacities_from_logits_vjp
from pop_ref.ambiguities import AMBIGUITIES
from pop_ref.conformance.backends import shipped
from pop_ref.constants import GSPLAT_1_6, INRIA, PAPER, Profile
from pop_ref.density import (
    GSPLAT,
    POP,
    Rows,
    Statistics,
    accumulate,
    average_grads,
    blurs_at,
    densifies_at,
    grow_masks,
    resets_at,
    rows_from_params,
    split_rows,
    zero_statistics,
)
from pop_ref.optimizer import (
    adam_step,
    is_updated,
    learning_rates,
    means_learning_rate,
    sh_degree_at,
    update_numbers,
)
from pop_ref.polarization import pop_loss, pop_loss_vjp
from pop_ref.recipes import BASELINES, L1_DIVIDED, RECIPES, Recipe
from pop_ref.records import Render
from pop_ref.render import render, render_vjp
from pop_ref.settings import LearningRates, UpdateRules
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


# Adam against torch, and its schedules.


@pytest.mark.parametrize(("betas", "eps"), [((0.9, 0.999), 1e-15), ((0.5, 0.75), 0.125)])
def test_adam_equals_torch_on_rows_of_several_shapes(betas: tuple[float, float], eps: float) -> None:
    rng = np.random.default_rng(3)
    params = {"means": rng.normal(size=(5, 3)), "opacities": rng.normal(size=5), "sh0": rng.normal(size=(5, 1, 3))}
    lr = {"means": 1e-3, "opacities": 0.05, "sh0": 0.0025}
    tensors = {name: torch.tensor(array, requires_grad=True) for name, array in params.items()}
    groups = [{"params": [tensors[name]], "lr": lr[name]} for name in params]
    reference = torch.optim.Adam(groups, betas=betas, eps=eps, foreach=False)
    m = {name: np.zeros_like(array) for name, array in params.items()}
    v = {name: np.zeros_like(array) for name, array in params.items()}
    for step in range(1, 26):
        # gradients of very different sizes, some exactly zero, as training makes them
        grads = {name: rng.normal(size=a.shape) * 10.0 ** rng.integers(-12, 3, a.shape) for name, a in params.items()}
        for name, g in grads.items():
            g[step % 5] = 0.0
            tensors[name].grad = torch.tensor(g)
        params, m, v = adam_step(params, grads, m, v, step, lr, betas=betas, eps=eps)
        reference.step()
        for name in params:
            state = reference.state[tensors[name]]
            np.testing.assert_allclose(params[name], tensors[name].detach().numpy(), rtol=1e-13, atol=1e-15)
            np.testing.assert_allclose(m[name], state["exp_avg"].numpy(), rtol=1e-13, atol=1e-25)
            np.testing.assert_allclose(v[name], state["exp_avg_sq"].numpy(), rtol=1e-13, atol=1e-30)


def test_an_update_decays_second_moments_as_its_recipe_says() -> None:
    before, gradient = start({"means": np.zeros((1, 3))}), {"means": np.full((1, 3), 2.0)}
    for beta2 in (0.999, 0.75):
        moved, _ = update(before.rows, gradient, before, 1.0, Recipe(lr=LearningRates(beta2=beta2)))
        np.testing.assert_allclose(moved.v["means"], (1.0 - beta2) * 4.0, rtol=1e-12)
        np.testing.assert_allclose(moved.m["means"], 0.2, rtol=1e-12)


def test_adam_leaves_its_arguments_alone() -> None:
    x, g, zero = {"x": np.ones(2)}, {"x": np.ones(2)}, {"x": np.zeros(2)}
    adam_step(x, g, zero, zero, 1, {"x": 0.5})
    assert x["x"].tolist() == g["x"].tolist() == [1.0, 1.0]
    assert zero["x"].tolist() == [0.0, 0.0]


def test_updates_count_from_one() -> None:
    with pytest.raises(ValueError, match="step is 0"):
        adam_step({}, {}, {}, {}, 0, {})


@pytest.mark.parametrize(("opacity", "steps"), [(0.1, 130), (0.5, 380), (0.99, 430)])
def test_an_opacity_that_only_pop_touches_falls_under_the_pruning_threshold_in_so_many_steps(
    opacity: float, steps: int
) -> None:
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


# Density control.

STEPS = range(30_000)
SMALL = 0.005


def population(logits: list[float]) -> Rows:
    n = len(logits)
    params = {"means": np.zeros((n, 3)), "scales": np.zeros((n, 3)), "quats": np.ones((n, 4))}
    return rows_from_params({**params, "opacities": np.array(logits)})


def window(grads: list[float], blurred: list[bool] | None = None) -> Statistics:
    n = len(grads)
    flags = np.array([False] * n if blurred is None else blurred, dtype=bool)
    return replace(zero_statistics(n), grad_sum=np.array(grads), n_visible=np.ones(n, np.int64), blurred=flags)


def test_the_average_may_divide_by_the_views_of_the_window() -> None:
    s = replace(zero_statistics(3), grad_sum=np.array([6.0, 2.0, 0.0]), n_visible=np.array([3, 1, 0]), n_views=4)
    by_window = replace(POP, grad_denominator="window")
    assert average_grads(s, by_window).tolist() == [1.5, 0.5, 0.0]
    assert average_grads(zero_statistics(1), by_window).tolist() == [0.0]


def test_blur_threshold_is_each_views_own() -> None:
    s, config = zero_statistics(1), replace(POP, theta_blur=0.055)
    for height, blurred in ((20, False), (10, True)):
        s = accumulate(s, np.zeros((1, 2)), np.ones(1, bool), np.array([6]), 10, height, config)
        assert s.blurred.tolist() == [blurred]


@pytest.mark.parametrize("backend", ["oracle", "fast64"])
def test_thresholds_are_strict_as_in_gsplat_and_not_as_in_inria_and_the_largest_axis_decides(backend: str) -> None:
    masks = shipped(backend).stage("grow_masks")
    s, scales = window([2e-4, np.nextafter(2e-4, 1.0)]), np.full((2, 3), SMALL)
    assert masks(s, scales, 1.0, 600, POP)[0].tolist() == [False, True]
    assert masks(s, scales, 1.0, 600, replace(POP, inclusive=True))[0].tolist() == [True, True]
    # a size that is the threshold is small
    scales = np.array([[0.25, 0.0, 0.0], [0.0, 0.0, np.nextafter(0.25, 1.0)]])
    clone, split = masks(window([1.0, 1.0]), scales, 1.0, 600, replace(POP, grow_scale3d=0.25))
    assert (clone.tolist(), split.tolist()) == ([True, False], [False, True])


def test_gradient_growth_beside_the_blur_rule_can_be_chosen() -> None:
    s, scales = window([1.0, 0.0], [False, True]), np.full((2, 3), SMALL)
    chosen = {
        POP: ([True, False], [True, True]),
        replace(POP, grow_on_gradient_in_blur_window=False): ([True, False], [False, True]),
        replace(POP, grow_on_gradient=False): ([False, False], [False, True]),
    }
    for config, (before, inside) in chosen.items():
        assert grow_masks(s, scales, 1.0, 2900, config)[0].tolist() == before
        assert grow_masks(s, scales, 1.0, 3000, config)[0].tolist() == inside


def test_split_only_blur_splits_small_ones_and_may_clone_them_as_well() -> None:
    s = window([1.0, 1.0, 0.0, 0.0], [True, False, True, False])
    clone, split = grow_masks(s, np.full((4, 3), SMALL), 1.0, 3000, replace(POP, blur_rule="split"))
    assert clone.tolist() == [True, True, False, False]
    assert split.tolist() == [True, False, True, False]


def test_schedule_has_144_densification_steps_41_with_blur_and_4_resets() -> None:
    densified = [s for s in STEPS if densifies_at(s, POP)]
    assert (len(densified), densified[0], densified[-1]) == (144, 600, 14_900)
    blurred = [s for s in densified if blurs_at(s, POP)]
    assert (len(blurred), blurred[0], blurred[-1]) == (41, 3000, 7000)
    assert [s for s in STEPS if resets_at(s, POP)] == []
    assert [s for s in STEPS if resets_at(s, GSPLAT)] == [3000, 6000, 9000, 12_000]
    assert resets_at(0, replace(GSPLAT, reset_at_zero=True))
    assert not any(blurs_at(s, GSPLAT) for s in STEPS)


@pytest.mark.parametrize("backend", ["oracle", "fast64"])
def test_children_are_drawn_from_their_parent_and_1_6_times_smaller(backend: str) -> None:
    rng, mask = np.random.default_rng(4), np.array([False, True, False, True])
    shapes = {"means": (4, 3), "scales": (4, 3), "quats": (4, 4), "opacities": (4,), "sh0": (4, 1, 3)}
    rows = rows_from_params({name: rng.normal(size=shape) for name, shape in shapes.items()})
    eps = rng.normal(size=(2, 2, 3))
    parents = {name: array[mask] for name, array in rows.params.items()}
    split = shipped(backend).stage("split_rows")(rows, mask, eps).params
    rotation, scales = Rotation.from_quat(parents["quats"], scalar_first=True), np.exp(parents["scales"])
    for child in range(2):
        here = slice(2 + 2 * child, 4 + 2 * child)
        expected = parents["means"] + rotation.apply(scales * eps[child])
        np.testing.assert_allclose(split["means"][here], expected, rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(np.exp(split["scales"][here]), scales / 1.6, rtol=1e-14)
        for name in ("quats", "opacities", "sh0"):
            np.testing.assert_array_equal(split[name][here], parents[name])


@pytest.mark.parametrize("backend", ["oracle", "fast64"])
@given(logit=st.sampled_from([-40.0, 0.0, 40.0]) | st.floats(-30.0, 30.0))
def test_two_revised_children_are_as_opaque_as_their_parent(logit: float, backend: str) -> None:
    split = (population([logit]), np.array([True]), np.zeros((2, 1, 3)), True)
    child = shipped(backend).stage("split_rows")(*split).params["opacities"][0]
    # 1 - o = 1 / (1 + e^logit) on both sides, in logarithms so that neither end is rounded away
    assert 2.0 * np.logaddexp(0.0, child) == pytest.approx(np.logaddexp(0.0, logit), rel=1e-12)


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
