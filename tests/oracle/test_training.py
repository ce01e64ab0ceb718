"""Whole training steps: the loss falls, the ladder of ten losses stands, every recipe does what its name says."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pop_ref import density, losses
from pop_ref.activations import opacities_from_logits, opacities_from_logits_vjp
from pop_ref.ambiguities import AMBIGUITIES
from pop_ref.constants import GSPLAT_1_6, INRIA, PAPER, Profile
from pop_ref.optimizer import LEARNING_RATES, adam_step, learning_rates, means_learning_rate, sh_degree_at
from pop_ref.polarization import pop_loss, pop_loss_vjp
from pop_ref.recipes import L1_DIVIDED, RECIPES, Recipe
from pop_ref.records import Render
from pop_ref.render import render, render_vjp
from pop_ref.settings import LearningRates
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


# Adam against a scalar loop and against torch, and the two schedules.


def scalar_adam(x: float, gradients: list[float], lr: float, betas: tuple[float, float], eps: float) -> list[float]:
    """Kingma and Ba's algorithm 1, one number at a time."""
    m = v = 0.0
    path = []
    for t, g in enumerate(gradients, start=1):
        m = betas[0] * m + (1.0 - betas[0]) * g
        v = betas[1] * v + (1.0 - betas[1]) * g**2
        m_hat, v_hat = m / (1.0 - betas[0] ** t), v / (1.0 - betas[1] ** t)
        x = x - lr * m_hat / (math.sqrt(v_hat) + eps)
        path.append(x)
    return path


def run(x: np.ndarray, gradients: np.ndarray, lr: float, **options) -> list[np.ndarray]:
    params, m, v = {"x": x}, {"x": np.zeros_like(x)}, {"x": np.zeros_like(x)}
    path = []
    for t, g in enumerate(gradients, start=1):
        params, m, v = adam_step(params, {"x": g}, m, v, t, {"x": lr}, **options)
        path.append(params["x"])
    return path


gradients_st = st.lists(st.sampled_from([0.0, 1.0, -1.0, 0.5]) | st.floats(-8.0, 8.0), min_size=1, max_size=12)


@given(gradients_st, st.sampled_from([1e-15, 1e-8, 0.125]), st.sampled_from([(0.9, 0.999), (0.5, 0.75)]))
def test_adam_is_the_published_algorithm_number_by_number(
    gradients: list[float], eps: float, betas: tuple[float, float]
) -> None:
    path = run(np.array([[0.5]]), np.array(gradients).reshape(-1, 1, 1), 0.25, betas=betas, eps=eps)
    expected = scalar_adam(0.5, gradients, 0.25, betas, eps)
    np.testing.assert_allclose(np.ravel(path), expected, rtol=1e-12, atol=1e-12)


def test_adam_equals_torch_on_rows_of_several_shapes() -> None:
    rng = np.random.default_rng(3)
    params = {"means": rng.normal(size=(5, 3)), "opacities": rng.normal(size=5), "sh0": rng.normal(size=(5, 1, 3))}
    lr = {"means": 1e-3, "opacities": 0.05, "sh0": 0.0025}
    tensors = {name: torch.tensor(array, requires_grad=True) for name, array in params.items()}
    groups = [{"params": [tensors[name]], "lr": lr[name]} for name in params]
    reference = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15, foreach=False)
    m = {name: np.zeros_like(array) for name, array in params.items()}
    v = {name: np.zeros_like(array) for name, array in params.items()}
    for step in range(1, 26):
        # gradients of very different sizes, some exactly zero, as training makes them
        grads = {name: rng.normal(size=a.shape) * 10.0 ** rng.integers(-12, 3, a.shape) for name, a in params.items()}
        for name, g in grads.items():
            g[step % 5] = 0.0
            tensors[name].grad = torch.tensor(g)
        params, m, v = adam_step(params, grads, m, v, step, lr)
        reference.step()
        for name in params:
            state = reference.state[tensors[name]]
            np.testing.assert_allclose(params[name], tensors[name].detach().numpy(), rtol=1e-13, atol=1e-15)
            np.testing.assert_allclose(m[name], state["exp_avg"].numpy(), rtol=1e-13, atol=1e-25)
            np.testing.assert_allclose(v[name], state["exp_avg_sq"].numpy(), rtol=1e-13, atol=1e-30)


def test_a_steady_gradient_moves_a_parameter_by_the_learning_rate_however_small_it_is() -> None:
    for size in (1.0, 1e-6, 1e-12):
        path = run(np.array([0.0]), np.full((4, 1), size), 0.25)
        np.testing.assert_allclose(np.ravel(path), [-0.25, -0.5, -0.75, -1.0], rtol=2e-3)


def test_a_parameter_that_never_had_a_gradient_keeps_its_bits() -> None:
    x = np.array([0.1, -7.25])
    assert run(x, np.zeros((3, 2)), 0.25)[-1].tolist() == x.tolist()


def test_a_parameter_without_a_gradient_coasts_on_its_moments() -> None:
    path = np.ravel(run(np.array([0.0]), np.array([[1.0], [0.0], [0.0]]), 0.25))
    assert path[0] > path[1] > path[2]


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


def test_adam_of_no_rows_is_no_rows() -> None:
    none = {"x": np.zeros((0, 3))}
    assert adam_step(none, none, none, none, 1, {"x": 0.5})[0]["x"].shape == (0, 3)


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
        logit, m, v = adam_step(logit, gradient, m, v, taken, {"o": LEARNING_RATES["opacities"]})
    assert taken == pytest.approx(steps, abs=5)


def test_positions_start_at_their_rate_and_end_at_a_hundredth_of_it() -> None:
    assert means_learning_rate(0, 3.0) == 1.6e-4 * 3.0
    assert means_learning_rate(30_000, 3.0) == pytest.approx(1.6e-6 * 3.0, rel=1e-14)
    assert means_learning_rate(99_999, 3.0) == means_learning_rate(30_000, 3.0)
    assert means_learning_rate(-1, 3.0) == means_learning_rate(0, 3.0)


@given(st.integers(0, 29_999), st.sampled_from([0.5, 1.0, 4.0]))
def test_positions_rate_falls_by_one_factor_a_step(step: int, scene_scale: float) -> None:
    ratio = means_learning_rate(step + 1, scene_scale) / means_learning_rate(step, scene_scale)
    assert ratio == pytest.approx(0.01 ** (1 / 30_000), rel=1e-12)


def test_only_the_positions_rate_changes() -> None:
    early, late = learning_rates(0, 2.0), learning_rates(20_000, 2.0)
    assert [name for name in early if early[name] != late[name]] == ["means"]
    assert early["shN"] == early["sh0"] / 20
    assert learning_rates(500, 2.0, max_steps=1000)["means"] == pytest.approx(0.1 * early["means"], rel=1e-14)


def test_harmonics_gain_a_band_each_thousand_steps_up_to_three() -> None:
    degrees = [sh_degree_at(step) for step in range(30_000)]
    assert [degrees.index(d) for d in range(4)] == [0, 1000, 2000, 3000]
    assert max(degrees) == 3
    assert [sh_degree_at(step, interval=2, max_degree=1) for step in range(5)] == [0, 0, 1, 1, 1]


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
