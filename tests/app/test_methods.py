"""The paper's other methods as runs: when what happens, what density control does, on every CPU engine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pop_fast.api.backend import get_backend
from pop_fast.density import DensityControl
from pop_fast.density.protocol import Draws
from pop_fast.errors import PopError
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.model import KEYS
from pop_fast.train.presets import METHODS
from pop_ref import fisher, mini_splatting, selection, taming
from pop_ref.chord import dominant_points
from pop_ref.contributions import contributions
from pop_ref.density import average_grads
from pop_ref.records import Camera
from pop_ref.render import render
from pop_ref.sensitivity import sensitivities
from pop_ref.training import gaussians_from_params
from tests.app.tiny import tiny_capture, tiny_config
from tests.train.oracle_steps import state_of

BASELINES = ("3dgs", "3dgs-2023", "pup", "mini-splatting", "taming", "speedy-splat")
ENGINES = ("fast", "compiled")


def plan_of(method: str) -> DensityControl:
    return TrainConfig.of(method=method).strategy


def steps(asked: Callable[[int], bool], last: int = 40_000) -> list[int]:
    return [step for step in range(last) if asked(step)]


def test_every_method_densifies_and_resets_when_its_paper_says() -> None:
    for method in ("pop", "gsplat", "3dgs", "3dgs-2023", "pup", "speedy-splat"):
        plan = plan_of(method)
        assert steps(plan.is_refine_step) == list(range(600, 15_000, 100))
        assert len(steps(plan.is_refine_step)) == 144
        assert steps(plan.is_reset_step) == ([] if method == "pop" else [3_000, 6_000, 9_000, 12_000])
    assert steps(plan_of("pop").is_blur_step) == list(range(3_000, 7_001, 100))


def test_speedy_splat_prunes_softly_three_times_and_hard_five_times() -> None:
    plan = plan_of("speedy-splat")
    shares = {step: plan.prune_share_at(step) for step in steps(plan.needs_passes)}
    assert shares == {
        **dict.fromkeys((6_000, 9_000, 12_000), 0.8),
        **dict.fromkeys((15_000, 18_000, 21_000, 24_000, 27_000), 0.3),
    }


def test_mini_splatting_replaces_all_at_5000_and_10000_and_densifies_at_neither() -> None:
    plan = plan_of("mini-splatting")
    assert plan.adam_restarts == (5_000, 10_000, 15_000, 20_000)
    assert set(range(600, 15_000, 100)) - set(steps(plan.is_refine_step)) == {5_000, 10_000}
    assert steps(plan.is_reset_step) == []
    assert plan.collects_blur(0)
    assert not plan.collects_blur(15_000)


def test_taming_grows_28_times_along_a_parabola_that_ends_at_the_budget() -> None:
    plan = plan_of("taming")
    densified = steps(plan.is_refine_step)
    assert densified == list(range(1_000, 15_000, 500))
    assert len(densified) == 28
    assert [plan.densification_at(step) for step in densified] == list(range(1, 29))
    assert plan.n_densifications == 29
    assert taming.budget_at(29, plan.n_densifications, 1000, plan.target(1000)) == 2000


def test_pup_prunes_at_the_beginning_of_two_rounds_after_the_training() -> None:
    config = TrainConfig.of(method="pup")
    assert config.max_steps == 40_000
    assert steps(config.strategy.needs_passes) == [30_000, 35_000]
    assert config.strategy.prune_shares == (0.8, 0.5)


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


def engine_or_skip(backend: str) -> None:
    reason = get_backend(backend).why_not()
    if reason is not None:
        pytest.skip(reason)


@pytest.mark.parametrize("backend", ENGINES)
@pytest.mark.parametrize("method", BASELINES)
def test_a_run_that_is_stopped_anywhere_goes_on_to_the_same_bits(method: str, backend: str, tmp_path: Any) -> None:
    engine_or_skip(backend)
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


class Recorded:
    """Draws from one list of numbers, so that an oracle can be given the same."""

    def __init__(self, seed: int = 5) -> None:
        self.generator = np.random.default_rng(seed)
        self.drawn: list[np.ndarray] = []

    def draws(self) -> Draws:
        return Draws(lambda n: torch.tensor(self.generator.standard_normal((2, n, 3))), self.uniforms)

    def uniforms(self, n: int) -> Tensor:
        self.drawn.append(self.generator.random(n))
        return torch.tensor(self.drawn[-1])


def in_double(folder: Any, method: str, **changes: Any) -> tuple[TrainingRun, Recorded]:
    config = tiny_method(folder, method, **changes)
    start = TrainingRun(config, tiny_capture())
    initial = {key: value.detach().double() for key, value in start.params.items()}
    run, recorded = TrainingRun(config, tiny_capture(), initial=initial), Recorded()
    run.draws = recorded.draws()
    return run, recorded


def stopped_before(run: TrainingRun, step: int) -> None:
    while run.step < step:
        run.take_steps(run.step + 1)


def cameras_of(run: TrainingRun) -> list[tuple[Camera, np.ndarray]]:
    return [
        (Camera(view.viewmat[0].numpy(), view.K[0].numpy(), view.width, view.height), view.photo.numpy())
        for view in run._train
    ]


def arrays_of(run: TrainingRun) -> dict[str, np.ndarray]:
    return {key: value.detach().numpy().copy() for key, value in run.params.items()}


def hold_change(run: TrainingRun, step: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], Any]:
    """Hold density control after a step by itself, and return the parameters before and after it."""
    before = arrays_of(run)
    change = run._change(step)
    return before, arrays_of(run), change


def test_speedy_splat_removes_who_the_oracle_says(tmp_path: Any) -> None:
    run, _ = in_double(tmp_path, "speedy-splat")
    stopped_before(run, 25)
    before, after, change = hold_change(run, 25)
    gaussians, profile, scores = gaussians_from_params(before), METHODS["speedy-splat"].recipe.profile, 0.0
    for camera, _ in cameras_of(run):
        drawn = render(gaussians, camera, profile=profile)
        size = (camera.width, camera.height, profile.tile_size)
        scores = scores + sensitivities(drawn.splats, drawn.tile_lists, *size, None, profile)
    gone = selection.lowest_share(scores, 0.3)
    assert 0 < change.pruned == gone.sum() < len(gone)
    for key in KEYS:
        np.testing.assert_array_equal(after[key], before[key][~gone])


def test_pup_removes_who_the_oracle_says_and_forgets_all_moments(tmp_path: Any) -> None:
    run, _ = in_double(tmp_path, "pup")
    stopped_before(run, 20)
    before, after, change = hold_change(run, 20)
    gaussians, profile = gaussians_from_params(before), METHODS["pup"].recipe.profile
    blocks = np.zeros((len(gaussians), 6, 6))
    for whole, _ in cameras_of(run):
        width, height = -(-whole.width // 4), -(-whole.height // 4)
        K = whole.K * np.array([[width / whole.width], [height / whole.height], [1.0]])
        camera = Camera(whole.viewmat, K, width, height)
        drawn = render(gaussians, camera, profile=profile)
        size = (width, height, profile.tile_size)
        moments = fisher.screen_moments(drawn.splats, drawn.tile_lists, *size, None, profile)
        blocks += fisher.fisher_blocks(gaussians, camera, moments, None, profile)
    gone = selection.lowest_share(fisher.log_det_scores(blocks), 0.5)
    assert 0 < change.pruned == gone.sum() < len(gone)
    for key in KEYS:
        np.testing.assert_array_equal(after[key], before[key][~gone])
        moments = run.optimizers[key].state[run.params[key]]
        assert not any(value.any() for value in moments.values())


def test_mini_splatting_sets_points_where_the_oracle_does(tmp_path: Any) -> None:
    run, recorded = in_double(tmp_path, "mini-splatting")
    stopped_before(run, 7)
    recorded.drawn.clear()
    before, after, change = hold_change(run, 7)
    gaussians, profile = gaussians_from_params(before), METHODS["mini-splatting"].recipe.profile
    views, points, colors = cameras_of(run), [], []
    for (camera, photo), uniforms in zip(views, recorded.drawn, strict=True):
        drawn = render(gaussians, camera, sh_degree=0, profile=profile)
        found = dominant_points(drawn.splats, drawn.tile_lists, gaussians, camera, profile.tile_size, profile)
        weights = np.where(found.ids >= 0, 1.0 - found.T_final, 0.0).ravel()
        wanted = mini_splatting.samples_per_view(len(views), camera.width, camera.height, 240)
        chosen = selection.sample_without_replacement(weights, min(wanted, int(np.sum(weights > 0))), uniforms)
        points.append(found.points.reshape(-1, 3)[chosen])
        colors.append(photo.reshape(-1, 3)[chosen] / 255.0)
    assert change.replaced == len(after["means"]) == sum(map(len, points)) > 100
    np.testing.assert_allclose(after["means"], np.concatenate(points), atol=1e-9)
    rgb = after["sh0"][:, 0] * 0.28209479177387814 + 0.5
    np.testing.assert_allclose(rgb, np.concatenate(colors), atol=1e-12)
    np.testing.assert_allclose(after["scales"], mini_splatting.nearest_log_scales(after["means"]), atol=1e-9)
    np.testing.assert_allclose(after["opacities"], np.log(0.1 / 0.9), rtol=1e-12)
    assert not after["shN"].any()
    np.testing.assert_array_equal(after["quats"], np.tile([1.0, 0.0, 0.0, 0.0], (change.replaced, 1)))


@pytest.mark.parametrize("importance", ["indoor", "outdoor"])
def test_mini_splatting_draws_and_prunes_by_the_oracles_importance(importance: str, tmp_path: Any) -> None:
    run, recorded = in_double(tmp_path, "mini-splatting")
    run.strategy = replace(run.strategy, importance=importance)
    profile = METHODS["mini-splatting"].recipe.profile

    def oracles(params: dict[str, np.ndarray], degree: int) -> np.ndarray:
        gaussians, seen = gaussians_from_params(params), []
        for camera, _ in cameras_of(run):
            drawn = render(gaussians, camera, sh_degree=degree, profile=profile)
            size = (camera.width, camera.height, profile.tile_size)
            seen.append((contributions(drawn.splats, drawn.tile_lists, *size, None, profile), drawn.dominant_counts))
        return mini_splatting.scene_importance(seen, importance == "outdoor")

    stopped_before(run, 18)
    recorded.drawn.clear()
    before, after, change = hold_change(run, 18)
    weights = oracles(before, 1)
    wanted = int(0.5 * np.sum(weights > 0))
    chosen = selection.sample_without_replacement(weights, wanted, recorded.drawn[0])
    assert change.replaced == wanted > 20
    np.testing.assert_array_equal(after["means"], before["means"][chosen])
    np.testing.assert_array_equal(after["sh0"], before["sh0"][chosen])
    run.step = 19
    stopped_before(run, 24)
    before, after, change = hold_change(run, 24)
    gone = selection.least_mass(oracles(before, 2), 0.05)
    assert 0 < change.pruned == gone.sum() < len(gone)
    np.testing.assert_array_equal(after["means"], before["means"][~gone])


@pytest.mark.parametrize("misaligned", [False, True])
def test_taming_grows_and_prunes_who_the_oracle_draws(misaligned: bool, tmp_path: Any) -> None:
    run, recorded = in_double(tmp_path, "taming")
    plan = run.strategy = replace(run.strategy, misaligned_prune_weights=misaligned, grow_grad2d=1e-4, prune_opa=0.6)
    stopped_before(run, 16)
    recorded.drawn.clear()
    # statistics of the window belong to the step before it
    state, draws = state_of(run), recorded.drawn
    before, after, change = hold_change(run, 16)
    views, gaussians = cameras_of(run), gaussians_from_params(before)
    chosen = [views[i] for i in np.argsort(draws[0], kind="stable")[:3]]
    grads = average_grads(state.statistics, plan)
    scores = taming.taming_scores(gaussians, chosen, grads, None, 2, METHODS["taming"].recipe.profile)
    small = gaussians.scales.max(1) <= plan.grow_scale3d * run.state["scene_scale"]
    candidates = grads >= plan.grow_grad2d
    budget = taming.budget_at(plan.densification_at(16), plan.n_densifications, 60, plan.target(60))
    quotas = taming.quotas(budget, len(grads), int((candidates & small).sum()), int((candidates & ~small).sum()))
    sampled = []
    for mask, quota, uniforms in zip((candidates & small, candidates & ~small), quotas, draws[1:3], strict=True):
        weights = np.where(mask, scores, 0.0)
        sampled.append(selection.sample_without_replacement(weights, min(quota, int(np.sum(weights > 0))), uniforms))
    assert (change.cloned, change.split) == tuple(map(len, sampled))
    assert change.cloned + change.split > 0
    kept = np.setdiff1d(np.arange(len(grads)), sampled[1])
    inverse = 1.0 / (1e-6 + scores)
    chances = np.zeros(len(draws[3]))
    first = inverse if misaligned else inverse[kept]
    chances[: len(first)] = first[: len(chances)]
    grown = np.concatenate([before["opacities"][kept], before["opacities"][sampled[0]]])
    grown = np.concatenate([grown, np.tile(before["opacities"][sampled[1]], 2)])
    faint = 1.0 / (1.0 + np.exp(-grown)) < plan.prune_opa
    drawn = selection.sample_without_replacement(chances, int(faint.sum()) // 2, draws[3])
    gone = faint & np.isin(np.arange(len(grown)), drawn)
    assert change.pruned == gone.sum() > 0
    np.testing.assert_array_equal(after["opacities"], grown[~gone])


def test_the_last_densification_step_of_taming_prunes_nothing(tmp_path: Any) -> None:
    run, _ = in_double(tmp_path, "taming")
    run.strategy = replace(run.strategy, prune_opa=0.6, sampled_prunes=run.strategy.densification_at(16) - 1)
    stopped_before(run, 16)
    faint = (torch.sigmoid(run.params["opacities"].detach()) < 0.6).sum()
    assert hold_change(run, 16)[2].pruned == 0 < faint


def test_mini_splatting_splits_who_was_blurred_in_any_view_since_the_last_densification_step(tmp_path: Any) -> None:
    default = METHODS["mini-splatting"].strategy().blur_window
    runs = {window: in_double(tmp_path, "mini-splatting")[0] for window in (default, "own_view")}
    runs["own_view"].strategy = replace(runs["own_view"].strategy, blur_window="own_view")
    flags: dict[str, list[Tensor]] = {window: [] for window in runs}
    # the first densification step comes after step 4: until then both runs have the same Gaussians
    for step in range(1, 5):
        for window, run in runs.items():
            run.take_steps(step)
            flags[window].append(run.state["blurred"].bool().clone())
    of_own_views = torch.stack(flags["own_view"])
    assert torch.equal(flags[default][-1], of_own_views.any(0))
    assert not torch.equal(of_own_views.any(0), of_own_views[-1])


@pytest.mark.parametrize(
    ("method", "setting", "words"),
    [
        ("speedy-splat", {"hard_prune_share": 1.5}, "speedy-splat.hard_prune_share is 1.5; it must lie in [0, 1]"),
        ("pup", {"prune_shares": (0.5, -0.1)}, "pup.prune_shares is -0.1; it must lie in [0, 1]"),
        ("pup", {"score_divisor": 0}, "pup.score_divisor is 0; it must be at least 1"),
        (
            "mini-splatting",
            {"reinit_opacity": 1.0},
            "mini-splatting.reinit_opacity is 1.0; it must lie between 0 and 1",
        ),
        ("taming", {"sh_rest_every": 0}, "taming.sh_rest_every is 0; it must be at least 1"),
        ("taming", {"budget_multiplier": -2.0}, "taming.budget_multiplier is -2.0; it must be >= 0 and finite"),
        ("pop", {"refine_every": 0}, "pop.refine_every is 0; it must be at least 1"),
    ],
)
def test_a_setting_that_cannot_be_is_named_as_the_command_line_names_it(
    method: str, setting: dict[str, Any], words: str
) -> None:
    with pytest.raises(PopError) as error:
        TrainConfig.of(method=method, **{method: setting})
    assert str(error.value) == words


def test_a_method_that_looks_at_the_views_says_so_to_a_trainer_that_has_none(tmp_path: Any) -> None:
    run, _ = in_double(tmp_path, "speedy-splat")
    stopped_before(run, 25)
    with pytest.raises(ValueError, match="this strategy looks at the training views"):
        run.strategy.change(run.params, run.optimizers, run.state, 25)
