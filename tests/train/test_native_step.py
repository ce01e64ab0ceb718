"""The native step's bits depend on nothing but its input, and its counts are true; the laws judge what it computes."""

from __future__ import annotations

import math
import os
import re
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.faults.runs import same
from pop_fast.api.backend import get_backend
from pop_fast.api.backends import CompiledBackend
from pop_fast.compiled import native_step
from pop_fast.data.gaussians import initialize_params
from pop_fast.density import POPStrategy
from pop_fast.errors import PopError
from pop_fast.stages.tiles import TileLists, tile_lists
from pop_fast.train import TrainingRun, stepper
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.engines import engine_of, torch_engine, whole_engine
from pop_fast.train.schedule import steady_updates
from pop_fast.train.stepper import Engine
from pop_fast.train.steps import Phase, StepSettings
from pop_fast.train.views import ViewTensors
from pop_ref.conformance.backends import shipped
from pop_ref.conformance.mutants.trial import law_named, obeys
from pop_ref.constants import PAPER
from pop_ref.settings import PARAMETERS
from tests.app.tiny import HEIGHT, WIDTH, interrupted, last_checkpoint, tiny_capture, tiny_config

REASON = get_backend("compiled").why_not()
pytestmark = [pytest.mark.skipif(REASON is not None, reason=REASON or ""), pytest.mark.usefixtures("one_thread")]

STEPS = 6
# statistics and dominance are collected at every step, and nothing is changed
WATCHED = {"refine_start_iter": 50, "blur_start_iter": 0, "blur_stop_iter": 60, "pop_stop_iter": 60}
MASK = np.hypot(*np.mgrid[-1.0 : 1.0 : HEIGHT * 1j, -1.0 : 1.0 : WIDTH * 1j]) < 0.9

SETTINGS: dict[str, dict[str, Any]] = {
    "on grey, with a mask": {
        "background": (0.5, 0.25, 0.125),
        "mask": MASK,
        "exposure": True,
        "depth_lambda": 0.02,
        "opacity_reg": 0.1,
        "scale_reg": 0.05,
    },
    "antialiased": {"antialiased": True},
    "exposures to the border": {"exposure": True, "ssim_padding": "same"},
}


def run_of(folder: Path, engine: Engine, settings: dict[str, Any]) -> TrainingRun:
    settings = dict(settings)
    capture = tiny_capture(mask=settings.pop("mask", None))
    pop = {name: settings.pop(name) for name in list(settings) if hasattr(POPStrategy, name)}
    config = tiny_config(folder, **settings)
    config = replace(config, strategy=replace(config.strategy, **{**WATCHED, **pop}))
    # axes of one length would leave the rotations' gradients to rounding
    initial = initialize_params(capture, config.seed, config.init_opacity, config.init_scale)
    noise = torch.randn(initial["scales"].shape, generator=torch.Generator().manual_seed(5))
    bands = (config.sh_degree + 1) ** 2 - 1
    initial = {**initial, "scales": initial["scales"] + 0.5 * noise, "shN": initial["shN"][:, :bands]}
    return TrainingRun(config, capture, engine=engine, initial=initial)


def taken(run: TrainingRun, steps: int = STEPS) -> list[Any]:
    return [run.take_steps(step + 1).stats[0] for step in range(steps)]


def put_where(run: TrainingRun, other: TrainingRun) -> None:
    """Give a run the parameters and moments of another one, so that rounding does not add up over steps."""
    for key, param in run.params.items():
        param.data.copy_(other.params[key].data)
        for name, moment in run.optimizers[key].state[param].items():
            moment.copy_(other.optimizers[key].state[other.params[key]][name])


@pytest.mark.parametrize("what", SETTINGS)
def test_steps_are_torchs_where_settings_meet_that_no_law_trains_together(what: str, tmp_path: Path) -> None:
    mine, its = (run_of(tmp_path, engine, SETTINGS[what]) for engine in (whole_engine(), torch_engine("fast")))
    for step in range(STEPS):
        put_where(mine, its)
        found, wanted = (run.take_steps(step + 1).stats[0] for run in (mine, its))
        assert found.objective == pytest.approx(wanted.objective, rel=3e-6)
        for name, learned in its.appearance.params.items():
            torch.testing.assert_close(mine.appearance.params[name], learned, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(mine.state["grad2d"], its.state["grad2d"], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("what", SETTINGS)
def test_the_bits_depend_neither_on_threads_nor_on_how_many_steps_are_asked_for_at_once(what, tmp_path):
    found = []
    for threads, pace in ((1, 1), (2, STEPS), (3, 2), (7, STEPS)):
        torch.set_num_threads(threads)
        run = run_of(tmp_path, whole_engine(), SETTINGS[what])
        stats = [s[:5] for last in range(pace, STEPS + 1, pace) for s in run.take_steps(last).stats]
        found.append((stats, {key: param.detach().clone() for key, param in run.params.items()}))
    for stats, params in found[1:]:
        assert stats == found[0][0]
        assert all(torch.equal(params[key], found[0][1][key]) for key in params)


def test_a_step_that_is_left_changes_nothing_and_is_taken_by_whoever_goes_on(tmp_path: Path) -> None:
    last, settings = 24, {"blur_window": "sum", "sh_interval": 100}

    def state(run: TrainingRun) -> list[torch.Tensor]:
        kept = [param.detach().clone() for param in run.params.values()]
        kept += [value.clone() for of in run.optimizers.values() for value in of.state_dict()["state"][0].values()]
        return [*kept, *(run.state[name].clone() for name in ("grad2d", "count", "dominant_sum", "blurred"))]

    whole = run_of(tmp_path, whole_engine(), settings)
    states = {}
    for step in range(last):
        whole.take_steps(step + 1)
        states[step + 1] = state(whole)
    run = run_of(tmp_path, whole_engine(), settings)
    run.take_steps(1)
    seconds = time.perf_counter()
    run.take_steps(last)
    seconds = time.perf_counter() - seconds
    stopped, trial = set(), 0
    # until a stop falls among the steps, whose time other work on the machine changes
    while trial < 12 or (not stopped - {1, last} and trial < 100):
        trial += 1
        run = run_of(tmp_path, whole_engine(), settings)
        run.take_steps(1)
        timer = threading.Timer(seconds * (0.618 * trial % 1.0), run._stop.ask)
        timer.start()
        taken_until = run.take_steps(last).stats
        timer.join()
        assert run.step == 1 + len(taken_until)
        assert all(map(torch.equal, state(run), states[run.step]))
        stopped.add(run.step)
        if run.step < last:
            assert run.take_steps(last).stats == []
            run._stop._flag.value = 0
            run.take_steps(last)
        assert all(map(torch.equal, state(run), states[last]))
    assert stopped - {1, last}, "nothing was left half way"


@pytest.mark.parametrize("method", ["pop", "gsplat"])
def test_how_many_steps_are_taken_at_a_time_changes_no_bit(method, tmp_path, monkeypatch):
    found: list[dict[str, Any]] = []
    blocks: list[int] = []
    own, took = CompiledBackend.whole_step, TrainingRun.take_steps
    monkeypatch.setattr(TrainingRun, "take_steps", lambda run, last: blocks.append(last - run.step) or took(run, last))
    for seconds, most in ((0.0, 20), (math.inf, 3), (math.inf, 20)):
        monkeypatch.setattr("pop_fast.train.stepper.BLOCK_SECONDS", seconds)
        monkeypatch.setattr(CompiledBackend, "whole_step", lambda self, most=most: replace(own(self), most=most))
        folder = tmp_path / f"{seconds}_{most}"
        config = tiny_config(folder, method, backend="compiled", checkpoint_every=0, save_steps=())
        # the sums of the last window are among what is kept
        config = replace(config, strategy=replace(config.strategy, refine_every=13, refine_stop_iter=60))
        blocks.clear()
        TrainingRun(config, tiny_capture()).run()
        # a block is bounded by time, and by a number where steps take none
        longest = max(blocks)
        assert longest == 1 if seconds == 0.0 else 1 < longest <= most, blocks
        found.append(last_checkpoint(folder, "seconds", "metrics_bytes"))
    assert found[0][".strategy.count"].any()
    assert [name for other in found[1:] for name, value in found[0].items() if not same(value, other[name])] == []


@pytest.mark.parametrize("method", ["pop", "gsplat"])
def test_a_run_goes_on_with_another_number_of_threads_to_the_same_bits(method: str, tmp_path: Path) -> None:
    # so many Gaussians that torch shares them out: those of the densification steps between the native ones too
    rng, many = np.random.default_rng(0), 33_000
    points, colors = rng.uniform(-1.0, 1.0, (many, 3)), rng.integers(0, 255, (many, 3), dtype=np.uint8)
    capture = replace(tiny_capture(), points=points, points_rgb=colors)

    def run(folder: str, threads: int, resume: bool = False) -> None:
        settings = {"max_steps": 7, "eval_steps": (), "save_steps": (), "checkpoint_every": 3, "init_scale": 0.3}
        config = tiny_config(tmp_path / folder, method, backend="compiled", threads=threads, **settings)
        config = replace(config, strategy=replace(config.strategy, grow_grad2d=1e-6))
        TrainingRun(config, capture, resume=resume).run()

    run("whole", 1)
    with interrupted(at=4):
        run("parts", 2)
    run("parts", 3, resume=True)
    whole, parts = (ckpt.load_checkpoint(ckpt.checkpoint_path(tmp_path / name, 6)) for name in ("whole", "parts"))
    assert (whole["threads"], parts["threads"]) == (1, 3)
    assert len(whole["splats"]["means"]) != many
    for part in ("splats", "optimizers", "strategy"):
        assert same(whole[part], parts[part]), part


@pytest.mark.parametrize("most", [1_000_000, 10])
def test_a_step_whose_lists_cannot_be_numbered_is_told_before_it_is_taken(most, tmp_path, monkeypatch):
    monkeypatch.setattr(native_step, "MOST_ENTRIES", most)
    run = run_of(tmp_path, whole_engine(), {})
    before = {key: param.detach().clone() for key, param in run.params.items()}
    if most > 10:
        taken(run, 1)
        assert not torch.equal(run.params["means"], before["means"])
        return
    with pytest.raises(MemoryError, match="step 0: the Gaussians reach more than 10 tiles altogether; train"):
        taken(run, 1)
    assert all(torch.equal(param, before[key]) for key, param in run.params.items())


def test_memory_for_photographs_changes_no_bit(tmp_path: Path) -> None:
    runs = [run_of(tmp_path, whole_engine(), {"target_cache_mb": room}) for room in (0, 1024)]
    first, second = ([stats[:5] for stats in taken(run)] for run in runs)
    assert first == second


@pytest.mark.parametrize("padding", ["valid", "same"])
def test_photographs_of_several_sizes_are_trained_on(padding: str, tmp_path: Path) -> None:
    capture = tiny_capture()
    views = tuple(
        replace(view, image=np.ascontiguousarray(view.image[: HEIGHT - 3 * k, : WIDTH - 2 * k]))
        for k, view in enumerate(capture.views)
    )
    config = tiny_config(tmp_path, ssim_padding=padding)
    mine, its = (
        TrainingRun(config, replace(capture, views=views), engine=e) for e in (whole_engine(), torch_engine("fast"))
    )
    # widths fall and rise from step to step
    for step in range(6):
        put_where(mine, its)
        found, wanted = (run.take_steps(step + 1).stats[0] for run in (mine, its))
        assert found.objective == pytest.approx(wanted.objective, rel=3e-6), step


@pytest.mark.parametrize("key", ["means", "scales", "quats", "opacities", "sh0"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_row_that_is_not_finite_is_named_and_nothing_moves(key: str, value: float, tmp_path: Path) -> None:
    run = run_of(tmp_path, whole_engine(), {})
    taken(run, 2)
    with torch.no_grad():
        run.params[key].view(len(run.params[key]), -1)[17, 0] = value
    before = {name: param.detach().clone() for name, param in run.params.items()}
    with pytest.raises(PopError, match=re.escape(f"{key}[17")):
        run.take_steps(4)
    assert run.step == 2
    for name, param in run.params.items():
        torch.testing.assert_close(param.detach(), before[name], rtol=0.0, atol=0.0, equal_nan=True)


def test_a_run_trains_natively_where_it_can_and_says_so(tmp_path: Path) -> None:
    config = replace(tiny_config(tmp_path), backend="compiled")
    assert TrainingRun(config, tiny_capture()).stepper.name == "native"
    by_absolute_gradients = replace(config, strategy=replace(config.strategy, absgrad=True))
    assert TrainingRun(by_absolute_gradients, tiny_capture()).stepper.name == "torch"
    terms = {"exposure": True, "depth_lambda": 0.01, "opacity_reg": 0.01, "scale_reg": 0.01}
    assert TrainingRun(replace(config, **terms), tiny_capture()).stepper.name == "native"
    assert engine_of(config, own_strategy=False).make_stepper is not None


def test_a_stepper_takes_rows_on_the_cpu_in_single_precision_only(tmp_path: Path) -> None:
    run = run_of(tmp_path, whole_engine(), {})
    fused: Any = run.stepper
    rows = {key: param.detach() for key, param in run.params.items()}
    with pytest.raises(ValueError, match="must be a contiguous float32 tensor on the CPU"):
        fused.fused.rebind({**rows, "means": rows["means"].double()}, rows, rows)


# What the native step says that it had to do is what a plain walk through the tile lists has to do.

WIDE, HIGH, TILE, CHUNK = 40, 24, 16, 16


def gaussians(n: int = 400) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(5)
    z = rng.uniform(2.0, 6.0, n)
    xy = rng.uniform(-0.8, 0.8, (n, 2)) * z[:, None]
    # in the first tile they are so many and so opaque that all its pixels stop
    xy[: n // 2] = rng.uniform((-0.7, -0.5), (-0.1, 0.2), (n // 2, 2)) * z[: n // 2, None]
    opacities, scales = rng.normal(1.0, 2.0, n), rng.normal(-2.3, 0.7, (n, 3))
    opacities[: n // 2] += 4.0
    scales[: n // 2] += 1.0
    made = {
        "means": np.concatenate((xy, z[:, None]), 1),
        "scales": scales,
        "quats": rng.normal(size=(n, 4)),
        "opacities": opacities,
        "sh0": rng.normal(size=(n, 1, 3)),
        "shN": 0.1 * rng.normal(size=(n, 15, 3)),
    }
    return {name: torch.tensor(value, dtype=torch.float32) for name, value in made.items()}


def view() -> ViewTensors:
    K = torch.tensor([[[30.0, 0.0, WIDE / 2], [0.0, 30.0, HIGH / 2], [0.0, 0.0, 1.0]]])
    return ViewTensors("black", torch.zeros(HIGH, WIDE, 3, dtype=torch.uint8), None, torch.eye(4)[None], K)


def listed(params: dict[str, torch.Tensor]) -> tuple[dict[str, np.ndarray], TileLists]:
    """Return splats in double precision, and their lists for the step's tiles."""
    p, seen = {name: value.double() for name, value in params.items()}, view()
    rows = (p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(), torch.cat((p["sh0"], p["shN"]), 1))
    cameras = (seen.viewmat.double(), seen.K.double(), WIDE, HIGH)
    _, _, meta = get_backend("fast").rasterization(*rows, *cameras, sh_degree=3, packed=False)
    exact = {"conics": meta["conics"][0], "opacities": meta["opacities"][0]}
    lists = tile_lists(meta["means2d"][0], meta["radii"][0], meta["depths"][0], WIDE, HIGH, TILE, **exact)
    return {name: meta[name][0].numpy() for name in ("means2d", "conics", "opacities")}, lists


def walked(splats: dict[str, np.ndarray], lists: TileLists) -> dict[str, int]:
    """Walk through the lists entry by entry, with T of every pixel."""
    did = dict.fromkeys(("walked", "chunks", "pairs", "reached"), 0)
    across = -(-WIDE // TILE)
    for tile in range(len(lists.offsets) - 1):
        ids = lists.ids[lists.offsets[tile] : lists.offsets[tile + 1]].tolist()
        x = tile % across * TILE + np.arange(TILE) + 0.5
        y = (tile // across * TILE + np.arange(TILE) + 0.5)[:, None]
        T = np.where((x < WIDE) & (y < HIGH), 1.0, 0.0)
        for first in range(0, len(ids), CHUNK):
            lit = (T > 0.0).any(1)
            if not lit.any():
                break
            chunk = ids[first : first + CHUNK]
            did["walked"] += len(chunk)
            did["chunks"] += 1
            did["pairs"] += len(chunk) * TILE * int(lit.sum())
            for i in chunk:
                dx, dy = splats["means2d"][i, 0] - x, splats["means2d"][i, 1] - y
                a, b, c = splats["conics"][i]
                raw = splats["opacities"][i] * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
                alpha = np.where(raw >= PAPER.alpha_floor, np.minimum(raw, PAPER.alpha_ceiling), 0.0)
                after = T * (1.0 - alpha)
                after = np.where(after > PAPER.transmittance_stop, after, 0.0)
                did["reached"] += int((after < T).any(1).sum())
                T = after
    return did


def test_counts_are_those_of_a_walk_through_the_lists() -> None:
    params = gaussians()
    splats, lists = listed(params)
    expected = walked(splats, lists)
    m, v = ({name: torch.zeros_like(value) for name, value in params.items()} for _ in range(2))
    settings = StepSettings(steady_updates(dict.fromkeys(PARAMETERS, 1e-3), 10), profile=PAPER)
    trainer = native_step.NativeTrainer(params, m, v, [view()], [0] * 10, settings, threads=2)
    assert set(trainer.counts().values()) == {0}
    trainer.run(1, Phase(3, pop=True, statistics=True, blur=True))
    found = trainer.counts()
    assert found["visible"] == len(set(lists.ids.tolist()))
    assert found["entries"] == len(lists.ids)
    assert {name: found[name] for name in expected} == expected
    # a parabola that errs lets too much through, never too little
    assert found["reached"] <= found["marked"] <= found["pairs"] // TILE
    assert found["walked"] < found["entries"]


def test_bands_that_the_gaussians_do_not_have_are_not_trained() -> None:
    params = gaussians()
    params["shN"] = params["shN"][:, :3].contiguous()
    m, v = ({name: torch.zeros_like(value) for name, value in params.items()} for _ in range(2))
    settings = StepSettings(steady_updates(dict.fromkeys(PARAMETERS, 1e-3), 10), profile=PAPER)
    trainer = native_step.NativeTrainer(params, m, v, [view()], [0] * 10, settings)
    trainer.run(1, Phase(1, pop=True, statistics=True, blur=True))
    with pytest.raises(ValueError, match="sh has 4 coefficients; degree 2 needs 9"):
        trainer.run(2, Phase(2, pop=True, statistics=True, blur=True))


def test_a_fork_does_not_let_go_of_threads_that_it_does_not_have() -> None:
    closed: list[int] = []
    functions: Any = SimpleNamespace(close=closed.append)
    native_step._close(functions, 1, os.getpid() + 1)
    native_step._close(functions, 2, os.getpid())
    assert closed == [2]


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("grad2d", lambda found: 0.5 * found),
        ("count", lambda found: found.clamp_min(1.0)),
        ("blurred", lambda found: found & False),
    ],
)
def test_laws_notice_statistics_that_a_whole_step_hands_on_wrongly(name, change, monkeypatch):
    law = law_named("test_collected:a_training_collects_the_oracles_gradients_views_and_blur_flags")
    backend = shipped("compiled32")
    assert obeys(law, backend) is None
    taken_over = stepper.FusedStepper._take_statistics

    def wrongly(stepper: Any, *args: Any) -> None:
        taken_over(stepper, *args)
        stepper._state[name] = change(stepper._state[name])

    monkeypatch.setattr(stepper.FusedStepper, "_take_statistics", wrongly)
    assert obeys(law, backend) is not None
