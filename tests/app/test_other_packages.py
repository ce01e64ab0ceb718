"""A package of somebody else adds a backend, a method, a loss, a profile, a format and a row, and no file of ours."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from pop_fast.train import checkpoint as ckpt
from tests.app.conftest import TRAIN

ROOT = Path(__file__).resolve().parents[2]
# no other file of the tree knows this name
NAME = "elsewhere_" + "made_up"
MODULE = '''
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pop_fast.density import DensityControl
from pop_fast.train.presets import Method
from pop_ref.constants import GSPLAT_1_5
from pop_ref.recipes import RECIPES
from pop_ref.settings import GSPLAT

LISTED = Path(__file__).with_name("asked.txt")


def backend():
    from pop_fast.stages.backend import TorchBackend

    @dataclass(frozen=True)
    class MadeUp(TorchBackend):
        def stages(self):
            with LISTED.open("a") as asked:
                asked.write("x")
            return super().stages()

    return MadeUp("mine", "cpu", ("float32", "float64"), speed=None)


@dataclass(frozen=True, kw_only=True)
class Fading(DensityControl):
    """Prunes the faintest Gaussian now and then."""

    lambda_pop: float = 0.0
    fade_every: int = 7

    def changes_after(self, step):
        return step > 0 and step % self.fade_every == 0

    def edit(self, context):
        from pop_fast.density import DensificationStep
        from pop_fast.density.rows import clear, prune_marked

        opacities = context.params["opacities"].detach().flatten()
        pruned = prune_marked(context, opacities == opacities.min())
        clear(context.state)
        return DensificationStep(pruned=pruned)


PROFILE = replace(GSPLAT_1_5, name="mine", alpha_ceiling=0.9)
METHOD = Method(Fading, replace(RECIPES["gsplat"], pixelwise="huber", profile=PROFILE), "Fading")
ROW = Path(__file__).with_name("row.toml")


def __getattr__(name):
    if name == "BACKEND":
        return backend()
    if name == "LOSS":
        import torch
        from pop_fast.stages.losses import Loss

        def huber(image, target, mask):
            values = torch.nn.functional.huber_loss(image, target, reduction="none", delta=0.1)
            return values.mean() if mask is None else values[mask].mean()

        return Loss("huber", huber)
    if name == "FORMAT":
        from pop_fast.io.formats import Format

        words = dict.fromkeys(("centre", "scale", "rotation", "opacity", "colour", "view dependence"), "nothing")
        about = ("numbers", "none", ("56", "236"), words, "none")
        return Format("numbers", ".numbers", *about, encode=lambda cloud: cloud.means.tobytes(), decode=None)
    raise AttributeError(name)
'''
ROW = """# Claim: none of the paper's.
# Hardware: any.
# Hours: seconds.
title = "Fading, by somebody else"
method = "mine"
options = ["--mine.fade-every", "5"]
tables = []
figures = []
cost = 1.0
bytes_per_gaussian = 236
description = "Prunes the faintest."
[paper]
"""
KINDS = {"backends": "BACKEND", "methods": "METHOD", "profiles": "PROFILE", "rows": "ROW"}
ENTRIES = "".join(f"[pop_splatting.{kind}]\nmine = {NAME}:{value}\n" for kind, value in KINDS.items())
ENTRIES += f"[pop_splatting.losses]\nhuber = {NAME}:LOSS\n[pop_splatting.formats]\nnumbers = {NAME}:FORMAT\n"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as pip leaves it where that package is installed."""
    site = tmp_path_factory.mktemp("site")
    (site / f"{NAME}.py").write_text(MODULE)
    (site / "row.toml").write_text(ROW)
    about = site / f"{NAME}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {NAME}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(ENTRIES)
    return site


def call(site: Path, module: str, *words: object, status: int = 0) -> str:
    """Call a program of ours where the package is installed, and return what it prints."""
    command = [sys.executable, "-c", f"import sys; from {module} import main; sys.exit(main(sys.argv[1:]))"]
    paths = os.pathsep.join(map(str, (site, ROOT)))
    env = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "COLUMNS": "300"}
    done = subprocess.run([*command, *map(str, words)], capture_output=True, text=True, env=env, cwd=site)
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_the_help_lists_all_that_another_package_adds(site: Path) -> None:
    text = "".join(call(site, "pop_fast.cli", "train", "--method", "mine", "--help-all").split())
    assert "|mine" in text or ",mine" in text
    for said in ("huber", "numbers", "--mine.fade-every", "speedy_splat,mine", "speedy-splat,mine", "ref,mine"):
        assert said in text, said


def test_it_trains_saves_resumes_and_exports(site: Path, shared_capture: Path, tmp_path: Path) -> None:
    own = [str(word).replace("--pop.", "--mine.") for word in TRAIN]
    words = ("train", shared_capture, *own, "--method", "mine", "--backend", "mine", "--threads", "1")
    words = (*words, "--checkpoint-every", "5", "--skip-sizes", "--export", "numbers")
    out = call(site, "pop_fast.cli", *words, "--out", tmp_path / "whole")
    assert "backend mine, as asked for" in out
    config = json.loads((tmp_path / "whole" / "cfg.json").read_text())["resolved"]
    given = {"method": "mine", "backend": "mine", "photometric": "huber", "profile": "mine"}
    assert {name: config[name] for name in given} == given
    assert (site / "asked.txt").stat().st_size > 30
    records = [json.loads(line) for line in (tmp_path / "whole" / "metrics.jsonl").read_text().splitlines()]
    assert all(0.0 < record["huber"] < record["huber"] ** 0.5 for record in records)
    assert any(record.get("pruned") for record in records)
    # as if it had been stopped after step 14
    call(site, "pop_fast.cli", *words, "--out", tmp_path / "parts")
    for path in (tmp_path / "parts" / "ckpts").glob("ckpt_*"):
        if int(path.stem.split("_")[1]) > 14:
            path.unlink()
    call(site, "pop_fast.cli", *words, "--out", tmp_path / "parts", "--resume")
    whole, parts = (ckpt.load_checkpoint(ckpt.checkpoint_path(tmp_path / n, 29))["splats"] for n in ("whole", "parts"))
    assert len(whole["means"]) > 0
    assert all(torch.equal(value, parts[name]) for name, value in whole.items())
    asked = (site / "asked.txt").stat().st_size
    call(site, "pop_fast.cli", "eval", tmp_path / "whole")
    assert (site / "asked.txt").stat().st_size > asked
    (exported,) = (tmp_path / "whole" / "export").iterdir()
    assert exported.suffix == ".numbers"
    assert exported.stat().st_size == 12 * len(whole["means"])
    assert "Fading" in (tmp_path / "whole" / "report.html").read_text()


@pytest.mark.slow
def test_its_method_stands_in_a_table(site: Path, tmp_path: Path) -> None:
    places = ("--scale", "toy", "--results", tmp_path / "results")
    call(site, "paper_repro.cli", "run", "mine", "demo", *places, "--work", tmp_path / "work")
    lines = call(site, "paper_repro.cli", "table", "beyond", *places).splitlines()
    (line,) = (line for line in lines if "Fading, by somebody else" in line and "not run" not in line)
    assert any(cell.strip().replace(".", "").isdigit() for cell in line.split("|"))


def test_no_file_of_ours_names_it() -> None:
    sources = [path for room in ("pop_ref", "pop_fast", "cuda_ext", "paper_repro") for path in (ROOT / room).rglob("*")]
    texts = [path for path in sources if path.suffix in (".py", ".toml", ".cpp", ".h", ".cu", ".cuh")]
    assert len(texts) > 300
    named = [path for path in texts if NAME in path.read_text(encoding="utf-8")]
    assert named == []
