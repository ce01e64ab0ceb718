"""Every setting of a recipe is seen in a training step: the loss and the next Gaussians are those found by hand.

By hand means: from `losses`, `polarization` and `render` with the setting's value written out here, never through
`training.objective`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from pop_ref import losses
from pop_ref.ambiguities import AMBIGUITIES
from pop_ref.constants import GSPLAT_1_6, INRIA, PAPER, Profile
from pop_ref.optimizer import adam_step, learning_rates, sh_degree_at
from pop_ref.polarization import pop_loss, pop_loss_vjp
from pop_ref.recipes import L1_DIVIDED, RECIPES, Recipe
from pop_ref.records import Render
from pop_ref.render import render, render_vjp
from pop_ref.training import Training, gaussians_from_params, params_vjp, start, train_step
from tests.golden import ten_losses

CAMERA, PHOTO = ten_losses.cameras()[0], ten_losses.photographs()[0]
# one opaque Gaussian that shows the ceilings apart, and one that this view does not show
PARAMS = {name: array.copy() for name, array in ten_losses.first_params().items()}
PARAMS["opacities"][7] = 9.0
PARAMS["means"][0] = [50.0, 0.0, 0.0]


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
        gaussians, degree = gaussians_from_params(PARAMS), sh_degree_at(self.step, max_degree=1)
        view = render(gaussians, CAMERA, sh_degree=degree, profile=self.profile)
        loss = self.loss(view.image, PHOTO, **self.weights)
        v_image = self.vjp(view.image, PHOTO, 1.0, **self.weights)
        v_opacities = np.zeros(len(gaussians))
        if self.important is not None:
            shown = view.splats.visible if self.visible_only else None
            loss += 1e-3 * pop_loss(gaussians.opacities, self.important(view), shown)
            v_opacities = pop_loss_vjp(gaussians.opacities, self.important(view), 1e-3, shown)
        gradients = render_vjp(gaussians, CAMERA, v_image, sh_degree=degree, profile=self.profile)
        grads = params_vjp(PARAMS, gradients, v_opacities)
        rates = {**learning_rates(self.step, 1.0), "opacities": self.opacity_rate}
        return adam_step(PARAMS, grads, state.rows.m, state.rows.v, self.step + 1, rates)[0], loss


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
    state = replace(start(PARAMS), step=step)
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
    image = render(gaussians_from_params(PARAMS), CAMERA, sh_degree=0).image
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
