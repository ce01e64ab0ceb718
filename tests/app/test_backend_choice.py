"""Which backend a command runs on: asked for, found by itself, kept when a run is gone on with, stood in for."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from pop_fast.api.rasterize import rasterization
from pop_fast.api.registry import get_backend
from pop_fast.cli.train import check_backend
from pop_fast.density import POPStrategy
from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from pop_fast.train.choose import choose_backend
from pop_fast.train.engines import whole_engine
from pop_fast.train.gpu_proxy import GpuProxy, renderer, translate_oom
from pop_fast.train.views import ViewTensors, render_view
from tests.app.conftest import TRAIN, Pop
from tests.app.drift import drift_engine
from tests.app.tiny import tiny_capture, tiny_config

NOT_BUILT = "the CUDA extension is not built; run `pop build-cuda`"
NOT_COMPILED = "the CPU kernels are not compiled"


@pytest.fixture(autouse=True)
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


def test_auto_is_cuda_where_it_can_run_and_says_why_where_it_cannot(monkeypatch, tmp_path):
    config = tiny_config(tmp_path, backend="auto")
    monkeypatch.setattr("cuda_ext.why_not", lambda: None)
    assert choose_backend(config)[0].backend == "cuda"
    monkeypatch.setattr("cuda_ext.why_not", lambda: NOT_BUILT)
    chosen, line = choose_backend(config)
    assert (chosen.backend, line) == ("fast", f"backend fast (CPU): {NOT_COMPILED}; {NOT_BUILT}")


@pytest.mark.usefixtures("with_gpu")
def test_auto_takes_the_cpu_for_settings_that_the_device_does_not_know(tmp_path):
    chosen, line = choose_backend(tiny_config(tmp_path, backend="auto", strategy=POPStrategy(absgrad=True)))
    assert chosen.backend == "fast"
    assert "pop.absgrad" in line


@pytest.mark.usefixtures("with_gpu")
def test_a_run_is_gone_on_with_by_the_backend_it_was_begun_with(tmp_path):
    config = tiny_config(tmp_path, backend="auto")
    assert choose_backend(config, resume=True)[0].backend == "cuda"
    (tmp_path / "cfg.json").write_text('{"given": null, "resolved": {"backend": "fast"}}')
    assert choose_backend(config, resume=True)[0].backend == "fast"
    assert choose_backend(config, resume=False)[0].backend == "cuda"
    (tmp_path / "cfg.json").write_text("[oops")
    assert choose_backend(config, resume=True)[0].backend == "cuda"


@pytest.mark.usefixtures("with_gpu")
def test_what_takes_the_steps_goes_with_the_backend(tmp_path):
    for backend, stepper in (("cuda", "cuda"), ("fast", "torch"), ("auto", "cuda")):
        training = TrainingRun(tiny_config(tmp_path, backend=backend), tiny_capture())
        assert training.stepper.name == stepper
        assert training.config.backend == ("fast" if stepper == "torch" else "cuda")


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


@pytest.mark.usefixtures("with_gpu")
def test_settings_that_the_device_does_not_know_are_refused_before_anything_is_read(tmp_path):
    with pytest.raises(PopError, match=r"pop\.absgrad = False only, not True; use --backend fast"):
        check_backend(tiny_config(tmp_path, backend="cuda", strategy=POPStrategy(absgrad=True)))


@pytest.mark.usefixtures("with_gpu")
def test_a_run_on_a_gpu_from_the_command_line(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    outcome = pop("train", shared_capture, "--out", tmp_path / "r", *TRAIN, "--skip-sizes")
    assert outcome.status == 0, outcome.err
    assert "backend cuda: a GPU and the build are here" in outcome.out
    assert " s on drift, loading " in outcome.out
    assert settings(tmp_path / "r")["resolved"]["backend"] == "cuda"
    stats = json.loads((tmp_path / "r" / "stats" / "val_step0029.json").read_text())
    assert stats["gpu"] == "drift"
    assert stats["stepper"] == "cuda"
    again = pop("train", shared_capture, "--out", tmp_path / "r", *TRAIN, "--resume", "--skip-sizes")
    assert again.status == 0, again.err
    assert "backend cuda, with which the run was begun" in again.out


def test_a_result_of_a_gpu_can_be_measured_without_one(pop: Pop, result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = settings(result)
    given["resolved"]["backend"] = "cuda"
    (result / "cfg.json").write_text(json.dumps(given))
    monkeypatch.setattr("cuda_ext.why_not", lambda: NOT_BUILT)
    outcome = pop("eval", result)
    assert outcome.status == 0, outcome.err
    assert f"note: backend 'fast' stands in for 'cuda': {NOT_BUILT}" in outcome.err
    assert renderer("auto")[1] is None


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


def test_other_errors_keep_their_words():
    with pytest.raises(RuntimeError, match="a launch failed"), translate_oom():
        raise RuntimeError("a launch failed")
