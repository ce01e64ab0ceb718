"""Which backend a command runs on: asked for, found by itself, kept when a run is gone on with, stood in for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pop_fast.api.backend import get_backend
from pop_fast.api.rasterize import rasterization
from pop_fast.blocks import jobs
from pop_fast.cli.train import check_backend
from pop_fast.density import POPStrategy
from pop_fast.errors import PopError
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.choose import check_gpus, choose_backend
from pop_fast.train.engines import GpuProxy, renderer, translate_oom, whole_engine
from pop_fast.train.environment import reproducible
from pop_fast.train.preflight import facts, find_warnings
from pop_fast.train.views import ViewTensors, render_view
from tests.app.conftest import TRAIN, Pop
from tests.app.drift import drift_engine
from tests.app.tiny import tiny_capture, tiny_config

NOT_BUILT = "the CUDA extension is not built; run `pop build-cuda`"
NOT_COMPILED = "the CPU kernels are not compiled"


@pytest.fixture
def _without_compiled_blend(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine without a C++ compiler; `test_build_cpu` tells what there is with one."""
    monkeypatch.setattr("pop_fast.compiled.why_not", lambda: NOT_COMPILED)
    monkeypatch.setattr("pop_fast.train.choose.has_gpu", lambda: True)


@pytest.fixture
def without_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine where the extension was never built."""
    monkeypatch.setattr("cuda_ext.why_not", lambda: NOT_BUILT)


@pytest.fixture
def with_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine with a GPU and the build, whose part something else plays."""
    monkeypatch.setattr("cuda_ext.why_not", lambda: None)
    monkeypatch.setattr("pop_fast.train.engines.whole_engine", lambda backend: drift_engine())


def settings(folder: Path) -> dict[str, object]:
    return json.loads((folder / "cfg.json").read_text())


@pytest.mark.usefixtures("_without_compiled_blend")
def test_auto_is_cuda_where_it_can_run_and_says_why_where_it_cannot(monkeypatch, tmp_path):
    config = tiny_config(tmp_path, backend="auto")
    monkeypatch.setattr("cuda_ext.why_not", lambda: None)
    assert choose_backend(config)[0].backend == "cuda"
    monkeypatch.setattr("cuda_ext.why_not", lambda: NOT_BUILT)
    chosen, line = choose_backend(config)
    assert (chosen.backend, line) == ("fast", f"backend fast (CPU): {NOT_COMPILED}; {NOT_BUILT}")


@pytest.mark.usefixtures("_without_compiled_blend")
@pytest.mark.usefixtures("with_gpu")
def test_auto_takes_the_cpu_for_settings_that_the_device_does_not_know(tmp_path):
    chosen, line = choose_backend(tiny_config(tmp_path, backend="auto", strategy=POPStrategy(absgrad=True)))
    assert chosen.backend == "fast"
    assert "pop.absgrad" in line


@pytest.mark.usefixtures("_without_compiled_blend")
@pytest.mark.usefixtures("with_gpu")
def test_a_run_is_gone_on_with_by_the_backend_it_was_begun_with(tmp_path):
    config = tiny_config(tmp_path, backend="auto")
    assert choose_backend(config, resume=True)[0].backend == "cuda"
    (tmp_path / "cfg.json").write_text('{"given": null, "resolved": {"backend": "fast"}}')
    assert choose_backend(config, resume=True)[0].backend == "fast"
    assert choose_backend(config, resume=False)[0].backend == "cuda"
    (tmp_path / "cfg.json").write_text("[oops")
    assert choose_backend(config, resume=True)[0].backend == "cuda"


@pytest.mark.usefixtures("_without_compiled_blend")
@pytest.mark.usefixtures("with_gpu")
def test_what_takes_the_steps_goes_with_the_backend(tmp_path):
    for backend, stepper in (("cuda", "cuda"), ("fast", "torch"), ("auto", "cuda")):
        training = TrainingRun(tiny_config(tmp_path, backend=backend), tiny_capture())
        assert training.stepper.name == stepper
        assert training.config.backend == ("fast" if stepper == "torch" else "cuda")


@pytest.mark.usefixtures("_without_compiled_blend")
@pytest.mark.usefixtures("without_gpu")
def test_cuda_asked_for_in_vain_is_one_sentence_before_anything_is_read(pop: Pop, tmp_path: Path) -> None:
    outcome = pop("train", tmp_path / "no such capture", "--backend", "cuda", "--out", tmp_path / "r")
    assert outcome.status == 2
    assert outcome.err == f"pop: error: backend 'cuda' cannot run: {NOT_BUILT}\n"
    with pytest.raises(PopError, match="not built"):
        whole_engine("cuda")
    with pytest.raises(PopError, match="backend 'cuda' cannot run: the CUDA extension is not built"):
        get_backend("cuda").rasterization()
    one = torch.ones(1, 3)
    with pytest.raises(PopError, match="backend 'cuda' cannot run: the CUDA extension is not built"):
        rasterization(one, one, one, one, one, one, one, 4, 4, backend="cuda")


@pytest.mark.usefixtures("_without_compiled_blend")
@pytest.mark.usefixtures("with_gpu")
def test_settings_that_the_device_does_not_know_are_refused_before_anything_is_read(tmp_path):
    with pytest.raises(PopError, match=r"pop\.absgrad = False only, not True; use --backend fast"):
        check_backend(tiny_config(tmp_path, backend="cuda", strategy=POPStrategy(absgrad=True)))


@pytest.mark.usefixtures("_without_compiled_blend")
@pytest.mark.usefixtures("with_gpu")
def test_a_run_on_a_gpu_from_the_command_line(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    outcome = pop.done("train", shared_capture, "--out", tmp_path / "r", *TRAIN, "--skip-sizes")
    assert "backend cuda: a GPU and the build are here" in outcome.out
    assert " s on drift, loading " in outcome.out
    assert settings(tmp_path / "r")["resolved"]["backend"] == "cuda"
    stats = json.loads((tmp_path / "r" / "stats" / "val_step0029.json").read_text())
    assert stats["gpu"] == "drift"
    assert stats["stepper"] == "cuda"
    again = pop.done("train", shared_capture, "--out", tmp_path / "r", *TRAIN, "--resume", "--skip-sizes")
    assert "backend cuda, with which the run was begun" in again.out


@pytest.mark.usefixtures("_without_compiled_blend")
def test_a_result_of_a_gpu_can_be_measured_without_one(pop: Pop, result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = settings(result)
    given["resolved"]["backend"] = "cuda"
    (result / "cfg.json").write_text(json.dumps(given))
    monkeypatch.setattr("cuda_ext.why_not", lambda: NOT_BUILT)
    outcome = pop.done("eval", result)
    assert f"note: backend 'fast' stands in for 'cuda': {NOT_BUILT}" in outcome.err
    assert renderer("auto")[1] is None


@pytest.mark.usefixtures("_without_compiled_blend")
def test_images_and_what_is_told_of_them_come_back_from_the_device(tmp_path):
    trainer = TrainingRun(tiny_config(tmp_path), tiny_capture())
    view: ViewTensors = trainer._train[0]
    on = GpuProxy(get_backend("fast"), torch.device("cpu"))
    there = render_view(on, trainer.params, view, trainer.config, 0, counts=True)
    here = render_view(get_backend("fast"), trainer.params, view, trainer.config, 0, counts=True)
    assert torch.equal(there.image, here.image.detach())
    assert not there.image.requires_grad
    for key in ("n_contrib", "n_traversed", "dominant_ids"):
        assert key in there.info
        assert torch.equal(there.info[key], here.info[key])
    assert there.info.get("nothing of that name") is None
    assert (on.name, on.available(), on.why_not()) == ("fast", True, None)


@pytest.mark.usefixtures("_without_compiled_blend")
def test_other_errors_keep_their_words():
    with pytest.raises(RuntimeError, match="a launch failed"), translate_oom():
        raise RuntimeError("a launch failed")
    with pytest.raises(torch.AcceleratorError, match="an illegal address"), translate_oom():
        raise torch.AcceleratorError("CUDA error: an illegal address")


def test_a_driver_without_room_is_told_in_a_sentence():
    with pytest.raises(PopError, match=r"the GPU has no room .*out of memory.*; use smaller images"), translate_oom():
        raise torch.AcceleratorError("CUDA error: out of memory\nCompile with `TORCH_USE_CUDA_DSA`")


# What a run changes in its process: settings of torch that are put back, memory that is kept.


def test_settings_of_torch_are_put_back_after_a_run():
    before = (torch.get_num_threads(), torch.are_deterministic_algorithms_enabled())
    small = torch.full((4 * 65_536,), torch.finfo(torch.float32).tiny)
    with reproducible(2):
        assert torch.get_num_threads() == 2
        assert torch.are_deterministic_algorithms_enabled()
        assert (small * 0.5 == 0.0).all()
    assert (torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()) == before
    assert (small * 0.5 > 0.0).all()


def test_freed_memory_is_kept_and_so_not_asked_for_again():
    # in a process of its own: the setting is for good. 64 MB are 16,384 pages; the first few may still be new ones
    script = """
import resource, sys
import torch
from pop_fast.train.environment import keep_freed_memory
kept = sys.argv[1] == "keep" and keep_freed_memory()
for _ in range(6):
    torch.ones(16 << 20)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    torch.ones(16 << 20)
print(int(kept), resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""

    def run(mode: str) -> tuple[int, int]:
        environment = {**os.environ, "GLIBC_TUNABLES": "", "MALLOC_MMAP_MAX_": "65536"}
        done = subprocess.run(
            [sys.executable, "-c", script, mode], capture_output=True, text=True, check=True, env=environment
        )
        kept, faults = done.stdout.split()
        return int(kept), int(faults)

    kept, few = run("keep")
    if not kept:
        pytest.skip("the C library is not glibc, which alone has this setting")
    assert few < 0.05 * run("plain")[1]


# What settings come to on a capture: the numbers of the statistics, and the warnings before the first step.


def a_view(
    width: int, height: int, mask: torch.Tensor | None = None, moved: tuple[float, float] = (0.0, 0.0)
) -> ViewTensors:
    photo = torch.zeros((height, width, 3), dtype=torch.uint8)
    K = torch.eye(3)[None].clone()
    K[0, 0, 2], K[0, 1, 2] = width / 2 + moved[0], height / 2 + moved[1]
    return ViewTensors("a.jpg", photo, mask, torch.eye(4)[None], K)


def said_of(width: int = 980, height: int = 545, **settings: object) -> list[str]:
    return list(find_warnings(TrainConfig.of(**settings), [a_view(1600, 1200), a_view(width, height)]))


def test_the_papers_schedule_on_the_papers_images_raises_no_doubt():
    assert [said_of(method=method) for method in ("pop", "gsplat", "3dgs")] == [[], [], []]


def test_small_images_need_a_least_number_of_pixels():
    (warning,) = said_of(480, 270)
    assert "theta_blur is 2.6 pixels of a.jpg (480 x 270)" in warning
    assert "--pop.blur-min-pixels 10" in warning
    # what it names fixes it; quick has it; and where nothing grows by blur there is nothing to fix
    assert said_of(480, 270, **{"pop.blur_min_pixels": 10}) == []
    assert said_of(480, 270, preset="quick") == []
    assert said_of(480, 270, **{"pop.blur_stop_iter": -1}) == []
    assert said_of(480, 270, method="gsplat") == []


def test_a_mask_makes_a_view_as_small_as_what_it_keeps():
    mask = torch.zeros((545, 980), dtype=torch.bool)
    mask[:100] = True
    (warning,) = find_warnings(TrainConfig.of(), [a_view(980, 545, mask)])
    assert "theta_blur is 2.0 pixels" in warning


@pytest.mark.parametrize("method", ["gsplat", "3dgs"])
def test_a_short_schedule_has_no_resets_unless_they_are_asked_for(method):
    assert said_of(method=method, preset="quick") == []
    (warning,) = said_of(method=method, preset="quick", **{f"{method}.reset_every": 300})
    assert "reset after step 300 and have 300 steps (6 densification steps) to recover" in warning
    assert f"--{method}.reset-every 0" in warning
    assert said_of(method=method, preset="quick", **{f"{method}.reset_every": 0}) == []


def test_a_centred_principal_point_is_warned_of_where_the_cameras_have_another():
    away = [a_view(512, 512), a_view(512, 512, moved=(3.0, -4.0))]
    (warning,) = find_warnings(TrainConfig.of(method="3dgs"), away)
    assert "a.jpg lies 5.0 pixels from there" in warning
    assert "--profile gsplat_1_5" in warning
    assert list(find_warnings(TrainConfig.of(method="3dgs", profile="gsplat_1_5"), away)) == []
    assert list(find_warnings(TrainConfig.of(method="gsplat"), away)) == []
    assert list(find_warnings(TrainConfig.of(method="3dgs"), [a_view(512, 512, moved=(0.6, 0.6))])) == []


def test_a_run_that_ends_soon_after_a_reset_is_warned_of():
    (warning,) = said_of(method="gsplat", max_steps=6500)
    assert "reset after step 6,000 and have 500 steps" in warning
    assert said_of(method="gsplat", steps_scaler=2.0) == []


def test_warnings_come_before_the_first_step_also_without_a_terminal(tmp_path, capsys, monkeypatch):
    before: list[str] = []

    def stops(training: TrainingRun, last: int) -> None:
        before.append(capsys.readouterr().err)
        raise KeyboardInterrupt

    monkeypatch.setattr(TrainingRun, "take_steps", stops)
    strategy = replace(tiny_config(tmp_path).strategy, theta_blur=1e-4)
    with pytest.raises(KeyboardInterrupt):
        TrainingRun(tiny_config(tmp_path, strategy=strategy), tiny_capture()).run()
    assert before[0].startswith("warning: theta_blur is 0.1 pixels of ")


def test_statistics_name_what_decides_a_comparison(tmp_path):
    views = [a_view(480, 270), a_view(960, 540)]
    quick = facts(TrainConfig.of(preset="quick"), views)
    assert quick["theta_blur_pixels"] == pytest.approx([2.592, 10.368])
    del quick["theta_blur_pixels"]
    named = {
        "method": "pop",
        "preset": "quick",
        "seed": 42,
        "lambda_pop": 0.001,
        "blur_min_pixels": 10.0,
        "blur_events": 5,
    }
    assert quick == named
    assert facts(TrainConfig.of(), views)["blur_events"] == 41
    assert facts(TrainConfig.of(method="gsplat"), views)["blur_events"] == 0
    assert facts(TrainConfig.of(max_steps=3100), views)["blur_events"] == 1
    stats = TrainingRun(tiny_config(tmp_path, max_steps=1), tiny_capture()).run()
    assert {"method", "preset", "seed", "lambda_pop", "theta_blur_pixels", "blur_min_pixels", "blur_events"} <= set(
        stats
    )


# Machines with several GPUs: counted stubs of them, at the doors that a user uses.


@pytest.fixture
def eight_gpus(monkeypatch: pytest.MonkeyPatch, with_gpu: None) -> list[int]:
    """As on a machine with eight GPUs; returns the numbers that are chosen."""
    chosen: list[int] = []
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 8)
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    return chosen


def test_gpus_that_are_left_idle_are_said_with_what_would_use_them(
    pop: Pop, shared_capture: Path, tmp_path: Path, eight_gpus: list[int]
) -> None:
    outcome = pop.done("train", shared_capture, "--out", tmp_path / "r", *TRAIN, "--skip-sizes")
    note = "note: 1 of 8 GPUs is used; torchrun --nproc-per-node 8 --no-python pop train ... --batch-size 8 uses all"
    assert f"\n{note}, for steps of 8 views\n" in outcome.out
    assert eight_gpus == []


@pytest.mark.usefixtures("eight_gpus")
def test_processes_use_as_many_gpus_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, chosen = choose_backend(tiny_config(tmp_path, backend="auto", batch_size=8))
    assert (config.backend, chosen) == ("cuda", "backend cuda: a GPU and the build are here")
    monkeypatch.setenv("LOCAL_RANK", "7")
    assert check_gpus(config, 8) is None
    assert (check_gpus(config, 2) or "").startswith("2 of 8 GPUs are used")
    # two machines of two processes each
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert (check_gpus(config, 4) or "").startswith("2 of 8 GPUs are used")
    assert check_gpus(replace(config, backend="fast"), 4) is None
    monkeypatch.setenv("LOCAL_RANK", "8")
    with pytest.raises(PopError, match=r"process 8 of this machine has no GPU of its own, as there are 8; start one"):
        check_gpus(config, 16)
    monkeypatch.setenv("LOCAL_RANK", "-1")
    with pytest.raises(PopError, match=r"LOCAL_RANK is '-1'; it must be the number of this process, from 0"):
        check_gpus(config, 16)


def test_each_block_is_trained_on_a_gpu_of_its_own(
    pop: Pop, shared_capture: Path, tmp_path: Path, eight_gpus: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[list[str]] = []
    monkeypatch.setattr(jobs, "has_snakemake", lambda: True)
    monkeypatch.setattr(jobs, "_run", lambda words, quiet: begun.append(list(words)) or 0)
    folder = tmp_path / "blocks"
    words = ("train", shared_capture, "--out", folder, *TRAIN, "--skip-sizes", "--threads", "3", "--blocks", "2x1")
    pop.done(*words)
    (command,) = begun
    # eight GPUs, two blocks with three threads each, a GPU for each
    assert command[command.index("--resources") + 1] == "gpu=8"
    assert command[command.index("--cores") + 1] == "6"
    assert "gpus=1" in command
    with jobs.own_gpu(folder, "cuda"):
        pop.done("blocks", "train", folder, "0_0")
        assert eight_gpus == [0, 1]
    pop.done("blocks", "train", folder, "1_0")
    assert eight_gpus == [0, 1, 0]
    with ExitStack() as others:
        for _ in range(8):
            others.enter_context(jobs.own_gpu(folder, "cuda"))
        outcome = pop("blocks", "train", folder, "1_0")
        assert (
            outcome.err == f"pop: error: {folder}: a block is trained on each of the 8 GPUs; wait until one is done\n"
        )
    monkeypatch.setattr(jobs, "has_snakemake", lambda: False)
    again = pop.done(*words, "--overwrite")
    assert "note: blocks are trained one after the other, on 1 of 8 GPUs; with Snakemake one on each" in again.out
