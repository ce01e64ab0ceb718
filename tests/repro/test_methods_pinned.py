"""Every method is what its table says: what a run resolves, on which schedule, and what happens in a step."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from paper_repro.jobs import ROWS, job_named, load_row
from paper_repro.methods import load_pinned, pinned_methods
from paper_repro.scenes import SCALES, SCENES
from pop_fast.cli.train import arguments
from pop_fast.density import rows
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.model import KEYS
from pop_fast.train.presets import METHODS
from tests.app.test_strategies import engine_or_skip, tiny_method
from tests.app.tiny import tiny_capture

# the other settings of a run: where things lie, which engine takes the steps, how often something is written
OF_THE_RUN = {
    *("method", "data", "result_dir", "seed", "backend", "threads", "eval_steps", "save_steps", "checkpoint_every"),
    *("keep_checkpoints", "log_every", "max_renders", "lpips_vgg", "lpips_alex", "target_cache_mb", "progress"),
    *("verbose", "factor", "test_every"),
}
# in which settings a scale of the whole schedule differs from the paper's, of all methods and of one
OF_SCALES: dict[str, dict[str, Any]] = {
    "paper": {},
    "small": {"blur_min_pixels": 10.0},
    "no_floor": {},
    "full": {"blur_min_pixels": 10.0},
}
PAPER_SCENES = sorted(scene.name for scene in SCENES.values() if scene.in_paper)


def resolved(config: TrainConfig) -> dict[str, Any]:
    """Return what decides a training: the settings of the run, and the rasterizer's constants."""
    own = {name.removeprefix(f"{config.method}."): value for name, value in config.flat().items()}
    drawn = {f"renderer.{name}": value for name, value in asdict(config.renderer).items()}
    return {name: value for name, value in {**own, **drawn}.items() if name not in OF_THE_RUN}


def pinned(method: str, row: str | None = None, scene: str | None = None) -> dict[str, Any]:
    table = load_pinned(method)
    # where a row says a setting, that is of all scenes
    parts = (table.settings, table.scenes.get(scene or "", {}), table.rows.get(row or "", {}))
    return {name: value for part in parts for name, (value, _) in part.items()}


def assert_same(found: dict[str, Any], wanted: dict[str, Any]) -> None:
    assert found.keys() == wanted.keys()
    assert {name: (value, wanted[name]) for name, value in found.items() if value != wanted[name]} == {}


def test_every_method_has_a_table_and_every_value_a_source() -> None:
    assert set(pinned_methods()) == set(METHODS)
    for method in METHODS:
        table = load_pinned(method)
        assert table.method == method
        parts = (table.settings, table.order, *table.rows.values(), *table.scenes.values())
        assert all(len(source) > 3 for part in parts for _, source in part.values())
        # of other people's code a commit is named, else a line means nothing
        assert any(re.search(r"\b[0-9a-f]{7}\b", source) for source in table.sources)


@pytest.mark.parametrize("method", METHODS)
def test_what_the_command_line_resolves_is_the_methods_table(method: str) -> None:
    config, _ = arguments(["capture", "--out", "out", "--method", method])
    assert_same(resolved(config), pinned(method))


@pytest.mark.parametrize("row", [row for row in ROWS if load_row(row).paper])
def test_a_row_of_the_paper_is_its_methods_table_and_what_the_row_says_on_every_scene(row: str) -> None:
    method = load_row(row).method
    for scene in PAPER_SCENES:
        if row.startswith("l1_div") or row == "l2_without_ssim":
            continue
        assert_same(resolved(job_named(row, scene, "paper").config()), pinned(method, row, scene))


@pytest.mark.parametrize("row", ["pop", "reset", "gsplat", "3dgs", "3dgs_2023", "pup", "mini_splatting", "taming",
                                 "speedy_splat"])  # fmt: skip
def test_other_scales_of_the_whole_schedule_differ_in_what_they_say_alone(row: str) -> None:
    whole = {name for name, scale in SCALES.items() if scale.steps_scaler == 1.0}
    assert whole == OF_SCALES.keys()
    method = load_row(row).method
    for name in whole - {"paper"}:
        for scene in SCALES[name].factors:
            job = job_named(row, scene, name)
            own = {key.removeprefix("strategy.") for key in job.scale.of_methods.get(method, {})}
            own |= {"sampling_factor", "importance", "budget_multiplier"} & pinned(method).keys()
            found, wanted = resolved(job.config()), {**pinned(method, row), **OF_SCALES[name]}
            if not job.scene.centred and wanted["renderer.principal_point"] == "centred":
                # drawn by gsplat's constants, see P26
                wanted |= {key: value for key, value in pinned("gsplat").items() if key.startswith("renderer.")}
                wanted |= {"profile": "gsplat_1_5", "renderer.name": "gsplat_1_5"}
            assert_same(*({key: v for key, v in part.items() if key not in own} for part in (found, wanted)))


def test_a_near_plane_is_resolved_on_the_capture_where_the_table_says_so() -> None:
    for method in METHODS:
        says = load_pinned(method).settings["near_plane"][1]
        near = TrainConfig.of(method=method).in_world(0.5).renderer.near_plane
        assert near == pinned(method)["renderer.near_plane"] * (0.5 if "capture" in says else 1.0)


# which step of `tiny_method` is which kind: densification comes at 4 (where Taming's budget has no room yet), 8, 12 and
# 16, a reset at 12
KINDS: dict[str, dict[str, int]] = {
    "pop": {"plain": 1, "densify": 4},
    "mini-splatting": {"points set anew": 7, "drawn by importance": 18, "prune by importance": 24},
    "pup": {"round": 20},
    "taming": {"densify": 8, "last densify": 16},
    "speedy-splat": {"densify, soft prune and reset": 12, "hard prune": 25},
}
USUAL = {"plain": 1, "densify": 4, "densify and reset": 12}
CHANGES: dict[str, dict[str, Any]] = {"taming": {"sampled_prunes": 2}, "speedy-splat": {"soft_prune_iters": (12,)}}
# whoever is seen is grown, and somebody is pruned, so that no event is left out for want of Gaussians
EAGER = {"grow_grad2d": 1e-7}
FAINT = -6.0


def traced(run: TrainingRun, patch: pytest.MonkeyPatch) -> list[str]:
    """Record what edits the Gaussians, in the functions that all edits go through, and whether Adam has moved any."""
    events: list[str] = []

    def noted(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def noting(*given: Any, **named: Any) -> Any:
            events.append(name)
            return call(*given, **named)

        return noting

    for name, event in (("clone", "clone"), ("split", "split"), ("prune", "prune"), ("replace_rows", "replace"),
                        ("restart", "restart"), ("reset_opacities", "reset")):  # fmt: skip
        patch.setattr(rows, name, noted(event, getattr(rows, name)))
    take = run.stepper.steps

    def steps(*given: Any) -> Any:
        before = {key: run.params[key].detach().clone() for key in KEYS}
        found = take(*given)
        if any(not torch.equal(before[key], run.params[key].detach()) for key in KEYS):
            events.append("update")
        return found

    patch.setattr(run.stepper, "steps", steps)
    return events


@pytest.mark.parametrize("backend", ["fast", "compiled"])
@pytest.mark.parametrize("method", METHODS)
def test_what_happens_to_the_gaussians_in_a_step_has_the_order_of_the_methods_table(
    method: str, backend: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine_or_skip(backend)
    order = load_pinned(method).order
    kinds = {**{kind: USUAL[kind] for kind in USUAL if kind in order}, **KINDS.get(method, {})}
    assert set(kinds) <= order.keys()
    assert set(order) == set(kinds) | ({"densify"} & set(order))
    config = tiny_method(tmp_path, method, backend=backend)
    resets = {"reset_every": 0} if method == "pop" else {}
    config = replace(config, strategy=replace(config.strategy, **EAGER, **resets, **CHANGES.get(method, {})))
    run = TrainingRun(config, tiny_capture())
    events, found = traced(run, monkeypatch), {}
    for step in range(max(kinds.values()) + 1):
        run.params["opacities"].data[:20] = FAINT
        events.clear()
        run.take_steps(step + 1)
        found[step] = list(events)
    assert {kind: found[step] for kind, step in kinds.items()} == {kind: order[kind][0] for kind in kinds}
