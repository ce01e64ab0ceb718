"""The strategies: their schedules, their protocol, what they ask for and refuse, and the paper's methods as runs.

What each does to the Gaussians at every step the laws of training say, of every setting.
Here are a few Gaussians with optimizers, and what a rasterizer would say about them.
"""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Callable
from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pop_fast.api.rasterize import rasterization
from pop_fast.density import DensityControl, GsplatStrategy, POPStrategy, Strategy
from pop_fast.density.control import SHORTEST_REFINE_EVERY
from pop_fast.density.passes import Passes
from pop_fast.density.protocol import Draws
from pop_fast.errors import PopError
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.model import KEYS
from pop_fast.train.presets import METHODS
from pop_ref import mini_splatting, selection, taming
from pop_ref.contributions import contributions
from pop_ref.records import Camera
from pop_ref.render import render
from pop_ref.training import gaussians_from_params
from tests.app.tiny import skip_without, tiny_capture, tiny_config


def make(n: int, scale: float = 0.005):
    g = torch.Generator().manual_seed(0)
    params = {
        "means": torch.randn(n, 3, generator=g),
        "scales": torch.full((n, 3), math.log(scale)),
        "quats": torch.randn(n, 4, generator=g),
        "opacities": torch.zeros(n),
        "sh0": torch.randn(n, 1, 3, generator=g),
        "shN": torch.randn(n, 15, 3, generator=g),
    }
    params = {key: torch.nn.Parameter(value) for key, value in params.items()}
    optimizers = {key: torch.optim.Adam([value], lr=0.01, eps=1e-15, fused=True) for key, value in params.items()}
    for key, value in params.items():
        value.grad = torch.randn(value.shape, generator=g)
        optimizers[key].step()
    return params, optimizers


def make_info(n: int, grads: Tensor | None = None):
    means2d = torch.zeros(1, n, 2, requires_grad=True)
    means2d.grad = torch.zeros(1, n, 2) if grads is None else grads[None]
    return {
        "means2d": means2d,
        "radii": torch.full((1, n, 2), 4, dtype=torch.int32),
        "width": 64,
        "height": 32,
        "n_cameras": 1,
        "dominant_counts": torch.zeros(1, n, dtype=torch.int64),
        "gaussian_ids": None,
    }


def densified_at(strategy, params, optimizers, info, step: int):
    state = strategy.initialize_state(1.0, seed=3)
    return strategy.step_post_backward(params, optimizers, state, step, info)


def test_whether_rows_are_packed_is_read_from_info_and_absolute_gradients_are_asked_for():
    sums, strategy = [], POPStrategy(lambda_pop=0.0)
    for packed in (None, False, True):
        params, optimizers = make(6, scale=0.5)
        state, seen = strategy.initialize_state(1.0), torch.eye(4).repeat(2, 1, 1)
        seen[:, 2, 3] = 3.0
        K = torch.tensor([[16.0, 0.0, 16.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]]).repeat(2, 1, 1)
        rows = (params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid())
        # packed is the default of a rasterization, and not of a strategy
        how = {} if packed is None else {"packed": packed}
        image, _, info = rasterization(*rows, params["sh0"], seen, K, 32, 16, sh_degree=0, **how, backend="fast")
        strategy.step_pre_backward(params, optimizers, state, 1, info)
        image.square().sum().backward()
        strategy.step_post_backward(params, optimizers, state, 1, info)
        sums.append((state["grad2d"], state["count"]))
        with pytest.raises(ValueError, match="means2d has no absgrad, which is read here; render with absgrad=True"):
            POPStrategy(lambda_pop=0.0, absgrad=True).step_post_backward(params, optimizers, state, 1, info)
    for found in zip(*sums, strict=True):
        assert bool((found[0] > 0.0).any())
        assert all(torch.equal(found[0], other) for other in found[1:])


def test_gsplat_attribute_names_exist_with_gsplat_numbers():
    for strategy in (POPStrategy(), GsplatStrategy()):
        assert isinstance(strategy, Strategy)
        got = [getattr(strategy, name) for name in ("prune_opa", "grow_grad2d", "grow_scale3d", "prune_scale3d")]
        assert got == [0.005, 0.0002, 0.01, 0.1]
        assert (strategy.refine_start_iter, strategy.refine_stop_iter, strategy.refine_every) == (500, 15_000, 100)
        assert (strategy.absgrad, strategy.revised_opacity, strategy.key_for_gradient) == (False, False, "means2d")
    assert (GsplatStrategy().reset_every, POPStrategy().reset_every) == (3000, 0)
    # the ceiling of a reset is no multiple of the threshold of pruning
    assert GsplatStrategy(prune_opa=0.002).reset_opa == 0.01
    assert not GsplatStrategy().is_reset_step(0)
    with pytest.raises(FrozenInstanceError):
        POPStrategy().prune_opa = 0.5


def test_a_scaled_schedule_keeps_its_shape_and_a_window_worth_averaging():
    quick = POPStrategy().scaled(0.1)
    assert (quick.refine_start_iter, quick.refine_stop_iter, quick.refine_every) == (50, 1500, SHORTEST_REFINE_EVERY)
    assert (quick.blur_start_iter, quick.blur_stop_iter, quick.pop_stop_iter) == (300, 700, 1500)
    assert quick.lambda_pop == POPStrategy().lambda_pop
    assert POPStrategy().scaled(1.0) == POPStrategy()
    assert POPStrategy(refine_every=10).scaled(0.1).refine_every == 10


def test_resets_keep_the_steps_that_are_needed_to_recover_from_them():
    control = GsplatStrategy(pause_refine_after_reset=200)
    for factor in (0.01, 0.1, 1.0):
        scaled = control.scaled(factor)
        assert (scaled.reset_every, scaled.pause_refine_after_reset) == (3000, 200)
        assert scaled.prune_too_big_after == 3000
        assert scaled.blur_stop_iter == -1
    assert (control.scaled(2.0).reset_every, control.scaled(2.0).pause_refine_after_reset) == (6000, 400)
    assert not any(GsplatStrategy().scaled(0.1).is_reset_step(step) for step in range(3000))


def test_dominant_counts_are_asked_for_where_they_are_read():
    assert [s for s in range(0, 30_000, 500) if POPStrategy().needs_dominance(s)] == list(range(0, 15_000, 500))
    assert not any(GsplatStrategy().needs_dominance(s) for s in range(0, 30_000, 500))
    params, optimizers = make(2)
    for strategy in (POPStrategy(lambda_pop=0.0), POPStrategy(lambda_pop=0.0, blur_window="sum"), POPStrategy()):
        for step in (0, 7000, 7001, 14_999, 15_000):
            info = make_info(2)
            if not strategy.needs_dominance(step):
                del info["dominant_counts"]
            state = strategy.initialize_state()
            strategy.regularizer(torch.sigmoid(params["opacities"]), state, step, info)
            strategy.step_post_backward(params, optimizers, state, step, info)


def test_missing_dominant_counts_are_explained():
    info = make_info(2)
    del info["dominant_counts"]
    strategy = POPStrategy()
    with pytest.raises(ValueError, match=r"dominant_counts.*pop_fast\.rasterization"):
        strategy.regularizer(torch.tensor([0.5, 0.5]), strategy.initialize_state(), 0, info)
    params, optimizers = make(2)
    densified_at(GsplatStrategy(), params, optimizers, info, 600)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_prunes_for_the_last_time_and_resets_when_it_is_asked_to(method, capsys):
    own = {"max_gaussians": 1} if method == "mini-splatting" else {"refine_every": 7}
    when = {"refine_start_iter": 0, "reset_every": 6, "final_prune_iter": 6, "final_prune_opa": 0.4}
    plan = replace(METHODS[method].strategy(), **own, **when, reset_opa=0.3, verbose=True)
    params, optimizers = make(3)
    with torch.no_grad():
        params["opacities"][0] = -1.0
    done = plan.change(params, optimizers, plan.initialize_state(1.0), 6)
    # the reset brings all of them under what survives
    assert (done.reset, done.pruned, len(params["means"])) == (True, 3, 0)
    assert "step 6: " in capsys.readouterr().out


def test_sanity_checks_name_the_key():
    params, optimizers = make(2)
    strategy = POPStrategy()
    strategy.check_sanity(params, optimizers)
    twice = torch.optim.Adam(list(params.values()))
    for words, *given in (
        ("'quats'", {k: v for k, v in params.items() if k != "quats"}, optimizers),
        ("'sh0' is a parameter without an optimizer", params, {k: v for k, v in optimizers.items() if k != "sh0"}),
        ("'scales' has 3 rows but", {**params, "scales": torch.nn.Parameter(torch.zeros(3, 3))}, optimizers),
        ("exactly one tensor", params, {**optimizers, "sh0": twice}),
    ):
        with pytest.raises(ValueError, match=words):
            strategy.check_sanity(*given)
    with pytest.raises(ValueError, match="refine_every"):
        POPStrategy(refine_every=0).check_sanity(params, optimizers)


# What a densification step does: rows, moments and statistics stay together, and the oracle agrees.


def test_a_parameter_dict_with_a_frozen_extra_is_edited_too():
    params, optimizers = make(4)
    extra = torch.nn.Parameter(torch.arange(4.0), requires_grad=False)
    params = torch.nn.ParameterDict({**params, "tags": extra})
    strategy = POPStrategy()
    strategy.check_sanity(params, optimizers)
    params["opacities"].data[1] = -6.0
    grads = torch.tensor([[1.0, 0], [0.0, 0], [0.0, 0], [1.0, 0]])
    densified_at(strategy, params, optimizers, make_info(4, grads), step=600)
    assert params["tags"].tolist() == [0.0, 2.0, 3.0, 0.0, 3.0]
    assert not params["tags"].requires_grad


def test_the_same_seed_splits_to_the_same_bits_and_another_does_not():
    means = []
    for seed in (1, 1, 2):
        params, optimizers = make(3, scale=0.05)
        strategy = POPStrategy()
        state = strategy.initialize_state(seed=seed)
        strategy.step_post_backward(params, optimizers, state, 600, make_info(3, torch.ones(3, 2)))
        means.append(params["means"].detach())
    assert torch.equal(means[0], means[1])
    assert not torch.equal(means[0], means[2])


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
    block = (POPStrategy.__doc__ or "").split("if `regularizer` returns one:")[1].split("The defaults are")[0]
    params, _ = make(12, scale=0.3)
    params["means"].data[:, 2] += 4.0
    optimizers = {key: torch.optim.SGD([value], lr=learning_rate) for key, value in params.items()}
    K = torch.tensor([[20.0, 0.0, 12.0], [0.0, 20.0, 8.0], [0.0, 0.0, 1.0]])
    views = [(torch.eye(4), K, torch.full((16, 24, 3), 0.5))] * steps
    given = {"params": params, "optimizers": optimizers, "strategy": strategy, "views": views}
    names = {"width": 24, "height": 16, "scene_scale": 1.0, "torch": torch, "rasterization": rasterization}
    exec(textwrap.dedent(block), {**given, **names})
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


BASELINES = ("3dgs", "3dgs-2023", "pup", "mini-splatting", "taming", "speedy-splat")


def plan_of(method: str) -> DensityControl:
    return TrainConfig.of(method=method).strategy


def steps(asked: Callable[[int], bool], last: int = 40_000) -> list[int]:
    return [step for step in range(last) if asked(step)]


def test_every_method_densifies_resets_and_prunes_when_its_paper_says() -> None:
    for method in ("pop", "gsplat", "3dgs", "3dgs-2023", "pup", "speedy-splat"):
        plan = plan_of(method)
        assert steps(plan.is_refine_step) == list(range(600, 15_000, 100))
        assert steps(plan.is_reset_step) == ([] if method == "pop" else [3_000, 6_000, 9_000, 12_000])
    assert steps(plan_of("pop").is_blur_step) == list(range(3_000, 7_001, 100))
    # three soft prunes and five hard ones
    plan = plan_of("speedy-splat")
    assert {step: plan.prune_share_at(step) for step in steps(plan.needs_passes)} == {
        **dict.fromkeys((6_000, 9_000, 12_000), 0.8),
        **dict.fromkeys((15_000, 18_000, 21_000, 24_000, 27_000), 0.3),
    }
    # all are replaced at 5,000 and 10,000, where nobody is cloned or split
    plan = plan_of("mini-splatting")
    assert plan.adam_restarts == (5_000, 10_000, 15_000, 20_000)
    assert set(range(600, 15_000, 100)) - set(steps(plan.is_refine_step)) == {5_000, 10_000}
    assert steps(plan.is_reset_step) == []
    assert [plan.collects_blur(step) for step in (0, 15_000)] == [True, False]
    # 28 times along a parabola that ends at the budget
    plan = plan_of("taming")
    densified = steps(plan.is_refine_step)
    assert densified == list(range(1_000, 15_000, 500))
    assert [plan.densification_at(step) for step in densified] == list(range(1, 29))
    assert plan.n_densifications == 29
    assert taming.budget_at(29, plan.n_densifications, 1000, plan.target(1000)) == 2000
    # from the first change on, also of a schedule that starts between two
    for scaler in (0.01, 0.05, 0.3, 0.77):
        short = plan.scaled(scaler)
        nths = [short.densification_at(step) for step in steps(short.is_refine_step)]
        assert nths == list(range(1, len(nths) + 1))
        assert 1 <= len(nths) <= short.n_densifications <= len(nths) + 1
    # two rounds after the training
    config = TrainConfig.of(method="pup")
    assert config.max_steps == 40_000
    assert steps(config.strategy.needs_passes) == [30_000, 35_000]
    assert config.strategy.prune_shares == (0.8, 0.5)
    assert TrainConfig.of(method="pup", **{"pup.rounds_start_iter": 0}).strategy.adam_restarts == ()


@pytest.mark.parametrize("method", sorted(set(METHODS) - {"gsplat"}))
def test_a_third_of_the_schedule_has_all_density_control(method: str) -> None:
    whole, third = TrainConfig.of(method=method), TrainConfig.of(method=method, steps_scaler=1 / 3)
    assert third.max_steps == pytest.approx(whole.max_steps / 3, abs=1)
    found, wanted = (steps(c.strategy.needs_passes, c.max_steps) for c in (third, whole))
    if method == "taming":
        assert len(found) == len(wanted) == 28
    else:
        assert found == [pytest.approx(step / 3, abs=1) for step in wanted]


def tiny_method(folder: Any, method: str, **changes: Any) -> TrainConfig:
    """Thirty steps of a method, with all its density control."""
    own: dict[str, dict[str, Any]] = {
        "pup": {"rounds_start_iter": 20, "round_steps": 5, "round_decay_every": 2, "prune_shares": (0.5, 0.25)},
        "mini-splatting": {
            "reinit_iters": (7,),
            "reinit_points": 240,
            "sample_iter": 18,
            "sampling_factor": 0.5,
            "prune_iter": 24,
            "prune_mass": 0.05,
            "blur_stop_iter": 18,
            "theta_blur": 0.02,
            "sh_start_iter": 12,
            "means_rewind_iter": 18,
            "means_rewind_to": 6,
        },
        "taming": {"opacities_stop_iter": 24, "sh_rest_every": 4, "score_views": 3, "sampled_prunes": 3},
        "speedy-splat": {"soft_prune_iters": (11,), "hard_prune_iters": (25,)},
    }
    refine = {"refine_start_iter": 3, "refine_stop_iter": 18, "refine_every": 4, "prune_too_big_after": 8}
    grow = {"grow_grad2d": 3e-3, "grow_scale3d": 0.05, "prune_opa": 0.05}
    kind, recipe, _ = METHODS[method]
    resets = {} if method == "mini-splatting" else {"reset_every": 12, "reset_opa": 0.2}
    strategy = kind(**refine, **grow, **resets, **own.get(method, {}))
    base = tiny_config(folder)
    settings = {"profile": recipe.profile.name, "photometric": "l1", "lambda_ssim": 0.2, "ssim_padding": "same"}
    return replace(base, strategy=strategy, **settings, **changes)


@pytest.mark.parametrize("backend", [pytest.param("fast", marks=pytest.mark.slow), "compiled"])
@pytest.mark.parametrize("method", BASELINES)
def test_a_run_that_is_stopped_anywhere_goes_on_to_the_same_bits(method: str, backend: str, tmp_path: Any) -> None:
    skip_without(backend)
    config = tiny_method(tmp_path, method, backend=backend, checkpoint_every=1, keep_checkpoints=30)
    whole = TrainingRun(config, tiny_capture())
    assert np.isfinite(whole.run()["psnr"])
    for path in sorted((tmp_path / "ckpts").glob("ckpt_*"))[4::9]:
        step = int(path.stem.split("_")[1])
        for later in (tmp_path / "ckpts").glob("ckpt_*"):
            if int(later.stem.split("_")[1]) > step:
                later.unlink()
        again = TrainingRun(config, tiny_capture(), resume=True)
        again.run()
        assert all(torch.equal(again.params[key], whole.params[key]) for key in KEYS), f"after step {step}"


# Taming-3DGS looks at the training views whenever it changes rows
@pytest.mark.parametrize("method", sorted(set(METHODS) - {"taming"}))
def test_a_change_that_does_not_read_colors_copies_whatever_stands_in_their_place(method, tmp_path, monkeypatch):
    skip_without("compiled")
    config, without = tiny_method(tmp_path / "whole", method, backend="compiled"), []
    whole = TrainingRun(config, tiny_capture())
    whole.run()
    change = DensityControl.change

    def changed(plan, params, optimizers, state, step, *given, **how):
        if not plan.changes_after(step) or plan.reads_colors(step):
            return change(plan, params, optimizers, state, step, *given, **how)
        colors = {key: params[key].data for key in ("sh0", "shN")}
        for key, rows in colors.items():
            params[key].data = torch.arange(len(rows), dtype=torch.float64)
        done = change(plan, params, optimizers, state, step, *given, **how)
        for key, rows in colors.items():
            params[key].data = rows[params[key].data.long()]
        without.append(done)
        return done

    monkeypatch.setattr(DensityControl, "change", changed)
    again = TrainingRun(replace(config, result_dir=str(tmp_path / "again")), tiny_capture())
    again.run()
    assert all(torch.equal(again.params[key], whole.params[key]) for key in KEYS)
    for what in ("cloned", "split"):
        assert any(getattr(done, what) for done in without), what


def test_a_method_of_another_package_is_taken_to_read_colors_at_every_change() -> None:
    class Paler(POPStrategy):
        pass

    class Quiet(POPStrategy):
        def reads_colors(self, step: int) -> bool:
            return False

    assert [kind().reads_colors(600) for kind in (POPStrategy, Paler, Quiet)] == [False, True, False]


def test_a_method_that_looks_at_the_views_sees_those_of_the_run_as_they_are_drawn(tmp_path, monkeypatch):
    # what each method makes of what it sees the laws of training say, and what a pass sees `tests/fast/test_passes.py`
    config = tiny_method(tmp_path, "mini-splatting")
    start = TrainingRun(config, tiny_capture())
    assert start.state["first_count"] == len(start.params["means"])
    initial = {key: value.detach().double() for key, value in start.params.items()}
    run, drawn, generator = TrainingRun(config, tiny_capture(), initial=initial), [], np.random.default_rng(5)
    profile, degrees, passed = METHODS["mini-splatting"].recipe.profile, [], Passes.contributions

    def noted(passes: Passes, params: Any, index: int, sh_degree: int) -> Any:
        degrees.append(sh_degree)
        return passed(passes, params, index, sh_degree)

    def uniforms(n: int) -> Tensor:
        drawn.append(generator.random(n))
        return torch.tensor(drawn[-1])

    def importance(means: dict[str, np.ndarray], degree: int) -> np.ndarray:
        seen = []
        for view in run._train:
            camera = Camera(view.viewmat[0].numpy(), view.K[0].numpy(), view.width, view.height)
            found = render(gaussians_from_params(means), camera, sh_degree=degree, profile=profile)
            size = (camera.width, camera.height, profile.tile_size)
            weights = contributions(found.splats, found.tile_lists, *size, None, profile)
            seen.append((weights, found.dominant_counts))
        return mini_splatting.scene_importance(seen, False)

    def changed(step: int) -> tuple[dict[str, np.ndarray], Any]:
        """Hold density control after a step by itself; return the parameters before it."""
        while run.step < step:
            run.take_steps(run.step + 1)
        before = {key: value.detach().numpy().copy() for key, value in run.params.items()}
        if step == 18:
            with pytest.raises(ValueError, match="this strategy looks at the training views"):
                run.strategy.change(run.params, run.optimizers, run.state, step)
        return before, run._change(step)

    monkeypatch.setattr(Passes, "contributions", noted)
    run.draws = Draws(lambda n: torch.tensor(generator.standard_normal((2, n, 3))), uniforms)
    before, change = changed(18)
    weights = importance(before, 1)
    wanted = int(0.5 * np.sum(weights > 0))
    chosen = selection.sample_without_replacement(weights, wanted, drawn[-1])
    assert change.replaced == wanted > 20
    for key in ("means", "sh0"):
        np.testing.assert_array_equal(run.params[key].detach().numpy(), before[key][chosen])
    run.step = 19
    before, change = changed(24)
    gone = selection.least_mass(importance(before, 2), 0.05)
    assert 0 < change.pruned == gone.sum() < len(gone)
    np.testing.assert_array_equal(run.params["means"].detach().numpy(), before["means"][~gone])
    assert degrees == [1] * len(run._train) + [2] * len(run._train)


def test_what_scores_cannot_be_taken_of_is_refused_before_the_first_step(tmp_path: Any) -> None:
    config = tiny_method(tmp_path, "pup", antialiased=True)
    with pytest.raises(PopError, match=r"prunes after step 20 by scores that leave out .* leave out --antialiased"):
        TrainingRun(config, tiny_capture())
    TrainingRun(replace(config, max_steps=20), tiny_capture())


@pytest.mark.parametrize(
    ("method", "setting", "words"),
    [
        ("speedy-splat", {"hard_prune_share": 1.5}, "speedy-splat.hard_prune_share is 1.5; it must lie in [0, 1]"),
        ("pup", {"prune_shares": (0.5, -0.1)}, "pup.prune_shares is -0.1; it must lie in [0, 1]"),
        ("pup", {"score_divisor": 0}, "pup.score_divisor is 0; it must be at least 1"),
        ("mini-splatting", {"reinit_opacity": 1}, "mini-splatting.reinit_opacity is 1.0; it must lie between 0 and 1"),
        ("taming", {"sh_rest_every": 0}, "taming.sh_rest_every is 0; it must be at least 1"),
        ("taming", {"budget_multiplier": -2.0}, "taming.budget_multiplier is -2.0; it must be >= 0 and finite"),
    ],
)
def test_a_setting_that_cannot_be_is_named_as_the_command_line_names_it(method, setting, words):
    with pytest.raises(PopError) as error:
        TrainConfig.of(method=method, **{method: setting})
    assert str(error.value) == words
