"""What is POP's own: the blur rule and the prior."""

from __future__ import annotations

import math
import textwrap
import warnings

import pytest
import torch

from pop_fast.api.rasterize import rasterization
from pop_fast.density import DensificationStep, GsplatStrategy, POPStrategy
from tests.app.populations import HEIGHT, WIDTH, densified_at, make, make_info, packed


def test_a_gaussian_that_dominates_enough_pixels_of_one_view_grows_in_the_blur_window_only():
    threshold = 2e-5
    height = width = 1000
    for step, counts, n in ((3000, [20, 21], 3), (7000, [20, 21], 3), (2900, [21, 21], 2), (7100, [21, 21], 2)):
        params, optimizers = make(2)
        info = make_info(2, counts=torch.tensor(counts), width=width, height=height)
        densified_at(POPStrategy(theta_blur=threshold), params, optimizers, info, step)
        assert len(params["means"]) == n, step


def test_a_threshold_in_pixels_bounds_the_blur_rule_from_below():
    for least, counts, n in ((0.0, [0, 1], 3), (11.0, [11, 12], 3), (11.0, [1, 11], 2)):
        params, optimizers = make(2)
        info = make_info(2, counts=torch.tensor(counts), width=240, height=135)
        densified_at(POPStrategy(blur_min_pixels=least), params, optimizers, info, 3000)
        assert len(params["means"]) == n


@pytest.mark.parametrize(("window", "n"), [("any_view", 2), ("sum", 3), ("own_view", 1)])
def test_what_the_dominant_count_is_taken_over_is_a_switch(window, n):
    # Gaussian 0 is over the threshold of 2 px in the first view, Gaussian 1 in the sum alone
    params, optimizers = make(2)
    params["opacities"].data[:] = 0.0
    strategy = POPStrategy(theta_blur=2 / (WIDTH * HEIGHT), blur_window=window, refine_every=2)
    state = strategy.initialize_state()
    for step, counts in ((3001, [3, 2]), (3002, [0, 1])):
        strategy.step_post_backward(params, optimizers, state, step, make_info(2, counts=torch.tensor(counts)))
    assert len(params["means"]) == {"any_view": 3, "sum": 4, "own_view": 2}[window]
    assert n == len(params["means"]) - 1


@pytest.mark.parametrize("window", ["any_view", "sum", "own_view"])
def test_the_share_of_a_masked_view_is_of_the_pixels_that_it_keeps(window):
    kept = WIDTH * HEIGHT // 4
    for pixels, n in ((kept // 2, 3), (kept // 2 + 1, 4)):
        params, optimizers = make(3)
        info = {**make_info(3, counts=[pixels, 0, 0]), "kept_pixels": kept}
        densified_at(POPStrategy(theta_blur=0.5, blur_window=window), params, optimizers, info, 3000)
        assert len(params["means"]) == n


def test_blur_flags_are_forgotten_after_a_densification_step():
    params, optimizers = make(1)
    strategy = POPStrategy()
    state = strategy.initialize_state()
    strategy.step_post_backward(params, optimizers, state, 3000, make_info(1, counts=torch.tensor([99])))
    assert len(params["means"]) == 2
    strategy.step_post_backward(params, optimizers, state, 3100, make_info(2))
    assert len(params["means"]) == 2


def test_blur_clones_small_and_splits_large_or_splits_all():
    for rule, change in (("by_scale", DensificationStep(1, 1)), ("split", DensificationStep(0, 2))):
        params, optimizers = make(2)
        params["scales"].data[1] = math.log(0.05)
        info = make_info(2, counts=torch.tensor([99, 99]))
        assert densified_at(POPStrategy(blur_rule=rule), params, optimizers, info, 3000) == change


def test_growth_by_gradient_can_be_switched_off_altogether_or_in_the_blur_window():
    grads = torch.ones(1, 2)
    for strategy, step, n in (
        (POPStrategy(grow_on_gradient=False), 600, 1),
        (POPStrategy(grow_on_gradient_in_blur_window=False), 600, 2),
        (POPStrategy(grow_on_gradient_in_blur_window=False), 3000, 1),
    ):
        params, optimizers = make(1)
        densified_at(strategy, params, optimizers, make_info(1, grads), step)
        assert len(params["means"]) == n


def test_nothing_happens_from_step_15000():
    params, optimizers = make(2)
    assert densified_at(POPStrategy(), params, optimizers, make_info(2, torch.ones(2, 2)), 15_000) is None
    assert len(params["means"]) == 2


def test_the_regularizer_pulls_dominant_opacities_up_and_the_others_down():
    strategy = POPStrategy()
    opacities = torch.tensor([0.25, 0.5, 0.75, 0.5], requires_grad=True)
    info = make_info(4, counts=torch.tensor([5, 0, 1, 0]))
    term = strategy.regularizer(opacities, strategy.initialize_state(), 0, info)
    assert term is not None
    assert term.item() == pytest.approx(1e-3 * (0.5 + 0.5))
    term.backward()
    assert torch.allclose(opacities.grad, 1e-3 * torch.tensor([-0.5, 0.5, -0.5, 0.5]))


def test_the_regularizer_is_off_outside_its_steps_and_at_weight_0():
    info, opacities = make_info(2), torch.tensor([0.5, 0.5])
    for strategy, step in (
        (POPStrategy(), 15_000),
        (POPStrategy(pop_start_iter=500), 499),
        (POPStrategy(lambda_pop=0), 0),
    ):
        assert strategy.regularizer(opacities, strategy.initialize_state(), step, info) is None
    assert GsplatStrategy().regularizer(opacities, {}, 0, info) is None


def test_importance_can_be_kept_for_the_window_and_the_loss_for_the_visible():
    opacities = torch.tensor([0.25, 0.5, 0.75], requires_grad=True)
    strategy = POPStrategy(pop_views="window", pop_over="visible")
    params, optimizers = make(3)
    state = strategy.initialize_state()
    strategy.step_post_backward(params, optimizers, state, 1, make_info(3, counts=torch.tensor([1, 0, 0])))
    info = make_info(3, visible=[True, True, False], counts=torch.tensor([0, 0, 0]))
    for each in (info, packed(info)):
        term = strategy.regularizer(opacities, state, 2, each)
        assert term is not None
        assert term.item() == pytest.approx(1e-3 * (0.75 + 0.5))


def test_a_trainer_that_leaves_out_the_prior_is_warned() -> None:
    params, optimizers = make(2)
    strategy = POPStrategy()
    state = strategy.initialize_state()
    with pytest.warns(UserWarning, match=r"add strategy\.regularizer"):
        strategy.step_post_backward(params, optimizers, state, 1, make_info(2))
    info = make_info(2)
    strategy.regularizer(torch.sigmoid(params["opacities"]), state, 2, info)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        strategy.step_post_backward(params, optimizers, state, 2, info)
        # nothing is missed where there is no prior
        strategy.step_post_backward(params, optimizers, state, strategy.pop_stop_iter, make_info(2))
        GsplatStrategy().step_post_backward(params, optimizers, GsplatStrategy().initialize_state(), 1, make_info(2))


def documented_loop(steps: int, strategy: POPStrategy, learning_rate: float = 0.01) -> dict[str, torch.Tensor]:
    """Run the loop that the docstring shows another trainer, with `rasterization`; return the parameters."""
    block = (POPStrategy.__doc__ or "").split("where there is one:")[1].split("The defaults are")[0]
    params, _ = make(12, scale=0.3)
    params["means"].data[:, 2] += 4.0
    optimizers = {key: torch.optim.SGD([value], lr=learning_rate) for key, value in params.items()}
    K = torch.tensor([[20.0, 0.0, 12.0], [0.0, 20.0, 8.0], [0.0, 0.0, 1.0]])
    views = [(torch.eye(4), K, torch.full((16, 24, 3), 0.5))] * steps
    names: dict[str, object] = {
        "params": params,
        "optimizers": optimizers,
        "strategy": strategy,
        "views": views,
        "width": 24,
    }
    exec(
        textwrap.dedent(block),
        {**names, "height": 16, "scene_scale": 1.0, "torch": torch, "rasterization": rasterization},
    )
    return {key: value.detach() for key, value in params.items()}


def test_the_loop_that_the_docstring_shows_trains_with_the_prior_and_is_not_warned() -> None:
    # the last steps have no prior
    strategy = POPStrategy(pop_stop_iter=4, refine_start_iter=2, refine_every=3, lambda_pop=0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(documented_loop(6, strategy)["means"]) > 0
        without, with_prior = (documented_loop(1, POPStrategy(lambda_pop=weight)) for weight in (0.0, 0.5))
    moved = (with_prior["opacities"] - without["opacities"]) / 0.01
    # o = 0.5, whose slope is 1/4: up where a pixel is won, down elsewhere, each by its share
    up, down = moved > 0.0, moved < 0.0
    assert up.any()
    assert down.any()
    torch.testing.assert_close(moved[up].sum().item(), 0.5 * 0.25, rtol=1e-3, atol=0.0)
    torch.testing.assert_close(moved[down].sum().item(), -0.5 * 0.25, rtol=1e-3, atol=0.0)
    assert all(torch.equal(with_prior[key], without[key]) for key in without if key != "opacities")
