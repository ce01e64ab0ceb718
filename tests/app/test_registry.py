"""Backends of other packages: found under their entry point, they draw, train, save, resume and are measured."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from pop_fast.api import registry
from pop_fast.api.rasterize import rasterization
from pop_fast.api.registry import BACKENDS
from pop_fast.errors import PopError
from pop_fast.stages.backend import FAST
from pop_fast.train import TrainConfig
from pop_fast.train import checkpoint as ckpt
from tests.app.conftest import TRAIN, Pop
from tests.app.interruptions import interrupt
from tests.fast.test_rasterization import cameras, scene

# as somebody else writes one who reads `pop_fast.api.backend.Backend`: torch's stages, and a count of who asks for them
MODULE = """
from dataclasses import dataclass

from pop_fast.stages.backend import TorchBackend

ASKED = []


@dataclass(frozen=True)
class MadeUp(TorchBackend):
    def stages(self):
        ASKED.append(self.name)
        return super().stages()


MINE = MadeUp("mine", "cpu", ("float32", "float64"), speed=None)
"""
ENTRIES = f"[{BACKENDS.group}]\nmine = made_up_backend:MINE\nbroken = no_such_package:BACKEND\n"


@pytest.fixture
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[pytest.MonkeyPatch]:
    """As where another distribution has registered two backends, one of which is not there; undoing it removes it."""
    site = tmp_path_factory.mktemp("site")
    (site / "made_up_backend.py").write_text(MODULE)
    about = site / "made_up_backend-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: made-up-backend\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(ENTRIES)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(site))
        look_again()
        yield patch
    look_again()


def look_again() -> None:
    BACKENDS.look_again()


def test_a_registered_backend_is_known_by_its_name_and_draws(installed: pytest.MonkeyPatch) -> None:
    assert registry.backend_names() == ("fast", "compiled", "cuda", "ref", "mine", "broken")
    drawn = rasterization(**scene(), **cameras(), backend="mine")[0]
    assert torch.equal(drawn, rasterization(**scene(), **cameras(), backend="fast")[0])
    assert torch.equal(drawn, rasterization(**scene(), **cameras(), backend=registry.get_backend("mine"))[0])


def test_one_that_cannot_be_loaded_is_named(installed: pytest.MonkeyPatch) -> None:
    with pytest.raises(PopError, match=r"the backend at no_such_package:BACKEND cannot be loaded: No module named"):
        registry.get_backend("broken")


def test_a_registered_backend_trains_saves_resumes_and_is_measured(
    installed: pytest.MonkeyPatch, pop: Pop, shared_capture: Path, tmp_path: Path
) -> None:
    words = ("train", shared_capture, *TRAIN, "--backend", "mine", "--threads", "1", "--checkpoint-every", "5")
    outcome = pop(*words, "--out", tmp_path / "whole")
    assert outcome.status == 0, outcome.err
    assert "backend mine, as asked for" in outcome.out
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, at=13)
        assert pop(*words, "--out", tmp_path / "parts").status == 130
    # what it was begun with is what goes on
    resumed = [word if word != "mine" else "auto" for word in words]
    outcome = pop(*resumed, "--out", tmp_path / "parts", "--resume")
    assert outcome.status == 0, outcome.err
    assert "backend mine, with which the run was begun" in outcome.out
    assert pop(*resumed, "--out", tmp_path / "fast", "--backend", "fast").status == 0
    whole, parts, fast = (
        ckpt.load_checkpoint(ckpt.checkpoint_path(tmp_path / name, 29))["splats"] for name in ("whole", "parts", "fast")
    )
    assert len(whole["means"]) > 0
    for name, value in whole.items():
        assert torch.equal(value, parts[name]), name
        assert torch.equal(value, fast[name]), name
    text = (tmp_path / "whole" / "cfg.json").read_text()
    config = TrainConfig.from_json(text)
    assert (config.backend, config.to_json()) == ("mine", text)
    assert json.loads((tmp_path / "whole" / "stats" / "val_step0029.json").read_text())["backend"] == "mine"
    import made_up_backend  # type: ignore[import-not-found]

    asked = len(made_up_backend.ASKED)
    assert asked > 2 * 30
    assert pop("eval", tmp_path / "whole").status == 0
    assert len(made_up_backend.ASKED) > asked


def test_a_name_that_nobody_registers_is_refused_before_anything_is_written(
    installed: pytest.MonkeyPatch, pop: Pop, shared_capture: Path, tmp_path: Path
) -> None:
    made = TrainConfig.of(backend="mine").to_json()
    installed.undo()
    look_again()
    for make in (lambda: TrainConfig(backend="mine"), lambda: TrainConfig.of(backend="mine")):
        with pytest.raises(
            PopError, match=r"backend is 'mine'; it must be one of auto, fast, compiled, cuda, ref; one"
        ):
            make()
    with pytest.raises(PopError, match="where that is installed"):
        TrainConfig.from_json(made)
    assert pop("train", shared_capture, *TRAIN, "--backend", "mine", "--out", tmp_path / "none").status == 2
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("name", [FAST.name, "auto"])
def test_names_of_this_package_are_known_without_a_look_at_what_is_installed(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: pytest.fail("looked"))
    look_again()
    assert TrainConfig.from_json(TrainConfig(backend=name).to_json()).backend == name
