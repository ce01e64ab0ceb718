"""What other people write: a strategy, and a package with one value of each registry and a row.

The package changes no file of ours. The strategy follows gsplat's protocol and knows nothing of ours.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
import torch

from pop_fast.api import backend
from pop_fast.api import backend as api_backend
from pop_fast.api.backend import BACKENDS
from pop_fast.api.backends import FAST, TorchBackend
from pop_fast.api.rasterize import rasterization
from pop_fast.density import DensificationStep, POPStrategy
from pop_fast.errors import PopError
from pop_fast.io.ply import save_ply
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.choose import choose_backend
from pop_fast.train.presets import METHODS, Method
from pop_ref.recipes import RECIPES
from tests.app.captures import edit_transforms, transforms_capture
from tests.app.conftest import ROOT, TRAIN
from tests.app.tiny import assert_same_run, records, run_until, tiny_capture, tiny_config
from tests.fast.test_rasterization import cameras, scene

# no other file of the tree knows this name
NAME = "elsewhere_" + "made_up"
MODULE = '''
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pop_fast.data.camera_models import CameraModel
from pop_fast.density import DensityControl
from pop_fast.train.presets import Method
from pop_ref.constants import GSPLAT_1_5
from pop_ref.recipes import RECIPES
from pop_ref.settings import GSPLAT

LISTED = Path(__file__).with_name("asked.txt")


def backend():
    from pop_fast.api.backends import TorchBackend

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
        return self.fade_every > 0 and step > 0 and step % self.fade_every == 0

    def at_rest(self):
        return replace(super().at_rest(), fade_every=0)

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
BARREL = {("transforms", "BARREL"): {"k": "bend"}}
LENS = CameraModel("mine", ("fx", "fy", "cx", "cy", "k"), None, lambda x, y, k: (x - k * x**3, y - k * y**3), BARREL)


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
KINDS = {"backends": "BACKEND", "methods": "METHOD", "profiles": "PROFILE", "rows": "ROW", "camera_models": "LENS"}
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


@pytest.mark.slow  # three programs that train
def test_it_trains_saves_resumes_and_exports(site: Path, shared_capture: Path, tmp_path: Path) -> None:
    own = [str(word).replace("--pop.", "--mine.") for word in TRAIN]
    words = ("train", shared_capture, *own, "--method", "mine", "--backend", "mine", "--threads", "1")
    words = (*words, "--checkpoint-every", "5", "--skip-sizes", "--export", "numbers")
    out = call(site, "pop_fast.cli", *words, "--out", tmp_path / "whole")
    assert "backend mine, as requested" in out
    config = json.loads((tmp_path / "whole" / "cfg.json").read_text())["resolved"]
    given = {"method": "mine", "backend": "mine", "photometric": "huber", "profile": "mine"}
    assert {name: config[name] for name in given} == given
    assert (site / "asked.txt").stat().st_size > 30
    found = records(tmp_path / "whole")
    assert all(0.0 < record["huber"] < record["huber"] ** 0.5 for record in found)
    assert any(record.get("pruned") for record in found)
    # as if it had been stopped after step 14
    shutil.copytree(tmp_path / "whole", tmp_path / "parts")
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
    (result,) = (tmp_path / "results").rglob("*.jsonl")
    assert '"huber":' in result.read_text()
    lines = call(site, "paper_repro.cli", "table", "beyond", *places).splitlines()
    (line,) = (line for line in lines if "Fading, by somebody else" in line and "not run" not in line)
    assert any(cell.strip().replace(".", "").isdigit() for cell in line.split("|"))


def test_its_camera_model_is_read_from_transforms_json(site: Path, tmp_path: Path) -> None:
    root = transforms_capture(tmp_path, camera_model="BARREL", bend=0.1)
    assert "4 x mine 40x30" in call(site, "pop_fast.cli", "data", "check", root)
    edit_transforms(root, lambda listing: listing.update(bend=200.0))
    assert "(mine) has distortion" in call(site, "pop_fast.cli", "data", "check", root, status=1)


def test_no_file_of_ours_names_it() -> None:
    sources = [path for room in ("pop_ref", "pop_fast", "cuda_ext", "paper_repro") for path in (ROOT / room).rglob("*")]
    texts = [path for path in sources if path.suffix in (".py", ".toml", ".cpp", ".h", ".cu", ".cuh")]
    assert len(texts) > 300
    named = [path for path in texts if NAME in path.read_text(encoding="utf-8")]
    assert named == []


@dataclass
class Jitter:
    """Every fourth step the Gaussian that moved most on the screen gets a copy nearby, placed by torch's numbers."""

    every: int = 4
    tells: bool = False

    def check_sanity(self, params: Any, optimizers: Any) -> None:
        assert set(params) == set(optimizers)

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        return {"grad2d": None, "count": None, "scene_scale": scene_scale, "jitter": torch.tensor(0.1), "seen": 0}

    def step_pre_backward(self, params: Any, optimizers: Any, state: Any, step: int, info: Any) -> None:
        info["means2d"].retain_grad()

    def step_post_backward(
        self, params: Any, optimizers: Any, state: Any, step: int, info: Any, packed: bool = False
    ) -> Any:
        assert not packed
        state["seen"] += 1
        moved = info["means2d"].grad[0].norm(dim=-1)
        state["grad2d"] = moved if state["grad2d"] is None else state["grad2d"] + moved
        state["count"] = torch.ones_like(moved)
        if step % self.every:
            return None
        source = int(state["grad2d"].argmax())
        for key, optimizer in optimizers.items():
            old = params[key]
            row = old.detach()[source : source + 1].clone()
            if key == "means":
                row += state["jitter"] * torch.randn(1, 3)
            new = torch.nn.Parameter(torch.cat([old.detach(), row]))
            moments = optimizer.state.pop(old)
            grown = {k: v if k == "step" else torch.cat([v, torch.zeros_like(row)]) for k, v in moments.items()}
            optimizer.state[new] = grown
            optimizer.param_groups[0]["params"] = [new]
            params[key] = new
        state["grad2d"] = state["count"] = None
        return DensificationStep(cloned=1) if self.tells else None


def run(folder: Any, stop_after: int | None = None, resume: bool = False, **options: Any) -> TrainingRun:
    training = TrainingRun(tiny_config(folder), tiny_capture(), strategy=Jitter(**options), resume=resume)
    run_until(training, stop_after)
    return training


def test_it_decides_over_the_population_and_the_loss_falls(tmp_path):
    n = len(tiny_capture().points)
    training = run(tmp_path / "a")
    # steps 0, 4, ... 28
    assert len(training.params["means"]) == n + 8
    stats = json.loads((tmp_path / "a" / "stats" / "val_step0029.json").read_text())
    assert (stats["num_GS"], stats["stepper"], stats["method"]) == (n + 8, "torch", "Jitter")
    found = records(tmp_path / "a")
    assert found[-1]["loss"] < found[0]["loss"]
    assert not any("cloned" in record or "pop" in record for record in found)
    # what it says of a change goes into the records
    run(tmp_path / "b", every=5, tells=True)
    changed = [record for record in records(tmp_path / "b") if "cloned" in record]
    assert [record["step"] for record in changed] == [0, 5, 10, 15, 20, 25]
    assert all((record["cloned"], record["pruned"]) == (1, 0) for record in changed)


def test_a_run_that_is_resumed_goes_on_to_the_same_bits_whatever_it_drew_with(tmp_path):
    run(tmp_path / "whole")
    for place, stop_after in enumerate((7, 11, 18)):
        torch.manual_seed(stop_after)
        run(tmp_path / "parts", stop_after, resume=place > 0)
    run(tmp_path / "parts", resume=True)
    assert_same_run(tmp_path / "parts", tmp_path / "whole")


def test_our_own_strategies_follow_the_protocol_too(tmp_path, monkeypatch):
    own = tiny_config("x").strategy
    assert isinstance(own, POPStrategy)
    given = TrainingRun(tiny_config(tmp_path / "given"), tiny_capture(), strategy=own)
    given.run()
    named = TrainingRun(tiny_config(tmp_path / "named"), tiny_capture())
    # by gsplat's protocol a strategy is not told a seed
    named.state["generator"].manual_seed(0)
    named.run()
    for key, value in named.params.items():
        assert torch.equal(given.params[key], value), key
    # a GPU trains with no others
    monkeypatch.setattr("cuda_ext.why_not", lambda: None)
    with pytest.raises(PopError, match="strategies of this package only; use --backend fast"):
        TrainingRun(tiny_config(tmp_path, backend="cuda"), tiny_capture(), strategy=Jitter())


# Backends of other packages: found under their entry point, they draw, train, save, resume and are measured.

MINE = TorchBackend("mine", "cpu", ("float32", "float64"), speed=None)


@pytest.fixture
def installed() -> Iterator[pytest.MonkeyPatch]:
    """As where other distributions have registered two backends, one of which is not there; undoing it removes both."""
    places = {"mine": f"{__name__}:MINE", "broken": "no_such_package:BACKEND"}
    found = [EntryPoint(name, place, BACKENDS.group) for name, place in places.items()]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("importlib.metadata.entry_points", lambda group: found if group == BACKENDS.group else [])
        BACKENDS.look_again()
        yield patch
    BACKENDS.look_again()


@pytest.mark.usefixtures("installed")
def test_a_registered_backend_is_known_by_its_name_and_draws_and_one_that_cannot_be_loaded_is_named() -> None:
    *own, added, unloadable = api_backend.backend_names()
    assert (added, unloadable) == ("mine", "broken")
    assert {"fast", "compiled", "cuda", "ref"} <= set(own)
    expected = rasterization(**scene(), **cameras(), backend="fast")[0]
    for mine in ("mine", api_backend.get_backend("mine")):
        assert torch.equal(rasterization(**scene(), **cameras(), backend=mine)[0], expected)
    with pytest.raises(PopError, match=r"no_such_package cannot be loaded: ModuleNotFoundError: No module named"):
        backend.get_backend("broken")


def test_a_name_that_nobody_registers_is_refused_before_anything_is_written(installed, pop, shared_capture, tmp_path):
    made = TrainConfig.of(backend="mine").to_json()
    installed.undo()
    BACKENDS.look_again()
    names = f"backend is 'mine'; it must be one of auto, {', '.join(api_backend.backend_names())}; one"
    for make in (TrainConfig, TrainConfig.of):
        with pytest.raises(PopError, match=names):
            make(backend="mine")
    with pytest.raises(PopError, match=f"backend is 'mine', of another package; .* with the package of {__name__}"):
        TrainConfig.from_json(made)
    assert pop("train", shared_capture, *TRAIN, "--backend", "mine", "--out", tmp_path / "none").status == 2
    assert not (tmp_path / "none").exists()


def test_names_of_this_package_are_known_without_a_look_at_what_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: pytest.fail("looked"))
    for name in (FAST.name, "auto"):
        BACKENDS.look_again()
        assert TrainConfig.from_json(TrainConfig(backend=name).to_json()).backend == name


# What other packages do wrong is said with the package's name, where it is asked for and nowhere else.


def distribution(site: Path, name: str, source: str, **entries: str) -> None:
    """Install a distribution of one module, of the same name, with one entry called `mine` for each group."""
    (site / f"{name}.py").write_text(source)
    about = site / f"{name}-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("".join(f"[pop_splatting.{k}]\n{v}\n" for k, v in entries.items()))


def test_a_name_that_two_packages_declare_is_refused_with_both(tmp_path: Path) -> None:
    imports = "from dataclasses import replace\nfrom pop_ref.constants import PAPER\n"
    for name in ("one", "two"):
        distribution(tmp_path, name, f"{imports}MINE = replace(PAPER, name='mine')\n", profiles=f"mine = {name}:MINE")
    asks = (
        "from pop_ref.constants import PROFILES\ndef main(words):\n    try:\n        print(PROFILES.named('mine').name)"
    )
    (tmp_path / "asks.py").write_text(f"{asks}\n    except ValueError as error:\n        print(error)\n")
    refused = "profile 'mine' is declared by one 1.0 and two 1.0; uninstall all but one of them\n"
    assert call(tmp_path, "asks") == refused
    # unless both name the same thing, as a package under its old name and its new one does
    (tmp_path / "two-1.0.dist-info" / "entry_points.txt").write_text("[pop_splatting.profiles]\nmine = one:MINE\n")
    assert call(tmp_path, "asks") == "mine\n"


def test_a_package_that_cannot_be_loaded_disturbs_nobody_who_does_not_ask_for_it(tmp_path: Path) -> None:
    kinds = dict.fromkeys(("formats", "backends", "methods"), "mine = broken:X")
    distribution(tmp_path, "broken", "import sys\nsys.exit('needs libfoo')\n", **kinds, profiles="paper = broken:X")
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}
    save_ply(tmp_path / "a.ply", {name: torch.ones(2, *shape) for name, shape in shapes.items()})
    call(tmp_path, "pop_fast.cli", "convert", "a.ply", "a.spz")
    why = "at broken:X of broken 1.0 cannot be loaded: SystemExit: needs libfoo"
    doctor = call(tmp_path, "pop_fast.cli", "doctor")
    assert doctor.count(why) == 3
    assert "that of broken 1.0 is not used; another profile has its name" in doctor
    # before the training, not after it
    assert f"the format {why}" in call(tmp_path, "pop_fast.cli", "train", "x", "--export", "mine", status=2)
    assert f"the method {why}" in call(tmp_path, "pop_fast.cli", "train", "x", "--method", "mine", status=2)


@pytest.mark.parametrize(
    ("strategy", "recipe", "said"),
    [
        (int, RECIPES["POP"], "its strategy is <class 'int'>; it must be a class derived from DensityControl"),
        (POPStrategy, None, "its recipe is None; it must be a"),
        (POPStrategy, RECIPES["POP"], "its POPStrategy is that of method 'pop', by which runs tell theirs"),
    ],
)
def test_a_method_is_of_the_right_types_and_has_a_class_of_its_own(monkeypatch, strategy, recipe, said) -> None:
    monkeypatch.setitem(METHODS._given, "mine", Method(strategy, recipe, "Mine"))
    with pytest.raises(PopError, match=f"method 'mine': {said}"):
        TrainConfig.of(method="mine")
    METHODS.look_again()


def test_a_result_names_the_packages_that_it_was_made_with(site: Path, tmp_path: Path) -> None:
    script = (
        "from pop_fast.train import TrainConfig\ndef main(words):\n    print(TrainConfig.of(method='mine').to_json())"
    )
    (site / "makes_settings.py").write_text(script)
    made = call(site, "makes_settings")
    assert json.loads(made)["packages"] == [f"{NAME} 1.0"]
    with pytest.raises(PopError, match=f"method is 'mine', of another package; the run was made with {NAME} 1.0, not"):
        TrainConfig.from_json(made)
    begun = json.loads(TrainConfig(backend="compiled").to_json()) | {"packages": ["theirs 1.0"]}
    begun["resolved"]["backend"] = "theirs"
    (tmp_path / "cfg.json").write_text(json.dumps(begun))
    with pytest.raises(PopError, match=r"cfg.json: config.backend is 'theirs', .* was made with theirs 1.0, not"):
        choose_backend(TrainConfig(result_dir=str(tmp_path)), resume=True)
    assert "packages" not in json.loads(TrainConfig().to_json())
