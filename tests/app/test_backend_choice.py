"""Which backend a command runs on: asked for, found by itself, kept when a run is gone on with, stood in for.

And how the kernels of the CPU are compiled, and what there is without them.
"""

from __future__ import annotations

import errno
import json
import os
import stat
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cuda_ext.toolkit import find_compiler
from pop_fast import compiled
from pop_fast.api.backend import get_backend
from pop_fast.api.rasterize import rasterization
from pop_fast.blocks import jobs
from pop_fast.cli.doctor import backends
from pop_fast.cli.train import check_backend
from pop_fast.compiled import build as building
from pop_fast.compiled.library import open_library
from pop_fast.density import POPStrategy
from pop_fast.errors import PopError
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.choose import check_gpus, choose_backend
from pop_fast.train.engines import GpuProxy, renderer, translate_oom, whole_engine
from pop_fast.train.environment import reproducible
from pop_fast.train.preflight import facts, find_warnings
from pop_fast.train.views import ViewTensors, render_view
from tests.app.conftest import TRAIN, Pop, in_a_child
from tests.app.damage import says
from tests.app.test_fused_stepper import drift_engine
from tests.app.tiny import tiny_capture, tiny_config

NOT_BUILT = "the CUDA extension is not built; run `pop build-cuda`"
NOT_COMPILED = "the CPU kernels are not compiled"


@pytest.fixture(autouse=True)
def _without_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine where the extension was never built."""
    monkeypatch.setattr("cuda_ext.why_not", lambda: NOT_BUILT)
    monkeypatch.setattr("pop_fast.train.choose.has_gpu", lambda: True)


@pytest.fixture
def without_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine without a C++ compiler."""
    monkeypatch.setattr("pop_fast.compiled.why_not", lambda: NOT_COMPILED)


@pytest.fixture
def with_gpu(monkeypatch: pytest.MonkeyPatch, without_compiled: None) -> None:
    """As on a machine with a GPU and the build, whose part something else plays."""
    monkeypatch.setattr("cuda_ext.why_not", lambda: None)
    monkeypatch.setattr("pop_fast.train.engines.whole_engine", lambda backend: drift_engine())


def settings(folder: Path) -> dict[str, object]:
    return json.loads((folder / "cfg.json").read_text())


@pytest.mark.usefixtures("without_compiled")
def test_auto_is_cuda_where_it_can_run_and_says_why_where_it_cannot(monkeypatch, tmp_path):
    config = tiny_config(tmp_path, backend="auto")
    chosen, line = choose_backend(config)
    assert (chosen.backend, line) == ("fast", f"backend fast (CPU): {NOT_COMPILED}; {NOT_BUILT}")
    monkeypatch.setattr("cuda_ext.why_not", lambda: None)
    assert choose_backend(config)[0].backend == "cuda"


@pytest.mark.usefixtures("with_gpu")
def test_settings_that_the_device_does_not_know_are_the_cpus_or_refused(tmp_path):
    absgrad = {"strategy": POPStrategy(absgrad=True)}
    chosen, line = choose_backend(tiny_config(tmp_path, backend="auto", **absgrad))
    assert chosen.backend == "fast"
    assert "pop.absgrad" in line
    with pytest.raises(PopError, match=r"pop\.absgrad = False only, not True; use --backend fast"):
        check_backend(tiny_config(tmp_path, backend="cuda", **absgrad))


@pytest.mark.usefixtures("with_gpu")
def test_a_run_is_gone_on_with_by_the_backend_it_was_begun_with(tmp_path):
    config = tiny_config(tmp_path, backend="auto")
    assert choose_backend(config, resume=True)[0].backend == "cuda"
    (tmp_path / "cfg.json").write_text('{"given": null, "resolved": {"backend": "fast"}}')
    assert choose_backend(config, resume=True)[0].backend == "fast"
    assert choose_backend(config, resume=False)[0].backend == "cuda"
    (tmp_path / "cfg.json").write_text("[oops")
    assert choose_backend(config, resume=True)[0].backend == "cuda"
    # what takes the steps goes with it
    for backend, stepper, used in (("cuda", "cuda", "cuda"), ("fast", "torch", "fast"), ("auto", "cuda", "cuda")):
        training = TrainingRun(tiny_config(tmp_path, backend=backend), tiny_capture())
        assert (training.stepper.name, training.config.backend) == (stepper, used)


def test_cuda_asked_for_in_vain_is_one_sentence_before_anything_is_read(pop: Pop, tmp_path: Path) -> None:
    outcome = pop("train", tmp_path / "no such capture", "--backend", "cuda", "--out", tmp_path / "r")
    assert (outcome.status, outcome.err) == (2, f"pop: error: backend 'cuda' cannot run: {NOT_BUILT}\n")
    with pytest.raises(PopError, match="not built"):
        whole_engine("cuda")
    one = torch.ones(1, 3)
    for draw in (
        lambda: get_backend("cuda").rasterization(),
        lambda: rasterization(one, one, one, one, one, one, one, 4, 4, backend="cuda"),
    ):
        with pytest.raises(PopError, match="backend 'cuda' cannot run: the CUDA extension is not built"):
            draw()


@pytest.mark.usefixtures("with_gpu")
def test_a_run_on_a_gpu_from_the_command_line(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    words = ("train", shared_capture, "--out", tmp_path / "r", *TRAIN, "--skip-sizes")
    outcome = pop.done(*words)
    assert "backend cuda: there is a GPU, and the extension is built" in outcome.out
    assert " s on drift, loading " in outcome.out
    assert settings(tmp_path / "r")["resolved"]["backend"] == "cuda"
    stats = json.loads((tmp_path / "r" / "stats" / "val_step0029.json").read_text())
    assert (stats["gpu"], stats["stepper"]) == ("drift", "cuda")
    assert "backend cuda, with which the run was begun" in pop.done(*words, "--resume").out


@pytest.mark.usefixtures("without_compiled")
def test_a_result_of_a_gpu_can_be_measured_without_one(pop: Pop, result: Path) -> None:
    given = settings(result)
    given["resolved"]["backend"] = "cuda"
    (result / "cfg.json").write_text(json.dumps(given))
    assert f"note: backend 'fast' stands in for 'cuda': {NOT_BUILT}" in pop.done("eval", result).err
    assert renderer("auto")[1] is None


def test_images_and_what_is_told_of_them_come_back_from_the_device(tmp_path):
    trainer = TrainingRun(tiny_config(tmp_path), tiny_capture())
    on = GpuProxy(get_backend("fast"), torch.device("cpu"))
    given = (trainer.params, trainer._train[0], trainer.config, 0)
    there, here = (render_view(backend, *given, counts=True) for backend in (on, get_backend("fast")))
    assert torch.equal(there.image, here.image.detach())
    assert not there.image.requires_grad
    for key in ("n_contrib", "n_traversed", "dominant_ids"):
        assert key in there.info
        assert torch.equal(there.info[key], here.info[key])
    assert there.info.get("nothing of that name") is None
    assert (on.name, on.available(), on.why_not()) == ("fast", True, None)


def test_a_driver_without_room_is_told_in_a_sentence_and_other_errors_keep_their_words():
    with pytest.raises(PopError, match=r"the GPU has no room .*out of memory.*; use smaller images"), translate_oom():
        raise torch.AcceleratorError("CUDA error: out of memory\nCompile with `TORCH_USE_CUDA_DSA`")
    for error in (RuntimeError("a launch failed"), torch.AcceleratorError("CUDA error: an illegal address")):
        with pytest.raises(type(error), match=str(error)), translate_oom():
            raise error


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


def test_freed_memory_is_kept_and_so_not_asked_for_again(monkeypatch):
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
    monkeypatch.setenv("GLIBC_TUNABLES", "")
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "65536")
    (kept, few), (_, many) = (map(int, in_a_child(script, mode).out.split()) for mode in ("keep", "plain"))
    if not kept:
        pytest.skip("the C library is not glibc, which alone has this setting")
    assert few < 0.05 * many


# What settings come to on a capture: the numbers of the statistics, and the warnings before the first step.


def a_view(
    width: int, height: int, mask: torch.Tensor | None = None, moved: tuple[float, float] = (0.0, 0.0)
) -> ViewTensors:
    photo = torch.zeros((height, width, 3), dtype=torch.uint8)
    K = torch.eye(3)[None].clone()
    K[0, 0, 2], K[0, 1, 2] = width / 2 + moved[0], height / 2 + moved[1]
    return ViewTensors("a.jpg", photo, mask, torch.eye(4)[None], K)


def said_of(width: int = 980, height: int = 545, **settings: object) -> list[str]:
    """Return what is warned of two views, the second of this size; the defaults are the paper's."""
    return list(find_warnings(TrainConfig.of(**settings), [a_view(1600, 1200), a_view(width, height)]))


def test_small_images_need_a_least_number_of_pixels():
    assert [said_of(method=method) for method in ("pop", "gsplat", "3dgs")] == [[], [], []]
    (warning,) = said_of(480, 270)
    assert "theta_blur is 2.6 pixels of a.jpg (480 x 270)" in warning
    assert "--pop.blur-min-pixels 10" in warning
    # what it names fixes it; quick has it; and where nothing grows by blur there is nothing to fix
    for settings in (
        {"pop.blur_min_pixels": 10},
        {"preset": "quick"},
        {"pop.blur_stop_iter": -1},
        {"method": "gsplat"},
    ):
        assert said_of(480, 270, **settings) == []
    # a mask makes a view as small as what it keeps
    mask = torch.zeros((545, 980), dtype=torch.bool)
    mask[:100] = True
    (warning,) = find_warnings(TrainConfig.of(), [a_view(980, 545, mask)])
    assert "theta_blur is 2.0 pixels" in warning


@pytest.mark.parametrize("method", ["gsplat", "3dgs"])
def test_a_run_that_ends_soon_after_a_reset_is_warned_of_and_a_short_one_has_none_unless_asked_for(method):
    assert said_of(method=method, preset="quick") == []
    (warning,) = said_of(method=method, preset="quick", **{f"{method}.reset_every": 300})
    assert "reset after step 300 and have 300 steps (6 densification steps) to recover" in warning
    assert f"--{method}.reset-every 0" in warning
    assert said_of(method=method, preset="quick", **{f"{method}.reset_every": 0}) == []
    (warning,) = said_of(method=method, max_steps=6500)
    assert "reset after step 6,000 and have 500 steps" in warning
    assert said_of(method=method, steps_scaler=2.0) == []


def test_a_centred_principal_point_is_warned_of_where_the_cameras_have_another():
    away = [a_view(512, 512), a_view(512, 512, moved=(3.0, -4.0))]
    (warning,) = find_warnings(TrainConfig.of(method="3dgs"), away)
    assert "a.jpg is 5.0 pixels away" in warning
    assert "--profile gsplat_1_5" in warning
    assert list(find_warnings(TrainConfig.of(method="3dgs", profile="gsplat_1_5"), away)) == []
    assert list(find_warnings(TrainConfig.of(method="gsplat"), away)) == []
    assert list(find_warnings(TrainConfig.of(method="3dgs"), [a_view(512, 512, moved=(0.6, 0.6))])) == []


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
    stats = TrainingRun(tiny_config(tmp_path, max_steps=1), tiny_capture()).run()
    assert set(quick) <= set(stats)
    assert quick.pop("theta_blur_pixels") == pytest.approx([2.592, 10.368])
    assert quick == {
        "method": "pop",
        "preset": "quick",
        "seed": 42,
        "lambda_pop": 0.001,
        "blur_min_pixels": 10.0,
        "blur_events": 5,
    }
    for settings, events in (({}, 41), ({"method": "gsplat"}, 0), ({"max_steps": 3100}, 1)):
        assert facts(TrainConfig.of(**settings), views)["blur_events"] == events


# Machines with several GPUs: counted stubs of them, at the doors that a user uses.


@pytest.fixture
def eight_gpus(monkeypatch: pytest.MonkeyPatch, with_gpu: None) -> list[int]:
    """As on a machine with eight GPUs; returns the numbers that are chosen."""
    chosen: list[int] = []
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 8)
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    return chosen


def test_gpus_that_are_left_idle_are_said_with_what_would_use_them(pop, shared_capture, tmp_path, eight_gpus):
    outcome = pop.done("train", shared_capture, "--out", tmp_path / "r", *TRAIN, "--skip-sizes")
    note = "note: 1 of 8 GPUs is used; torchrun --nproc-per-node 8 --no-python pop train ... --batch-size 8 uses all"
    assert f"\n{note}, for steps of 8 views\n" in outcome.out
    assert eight_gpus == []


@pytest.mark.usefixtures("eight_gpus")
def test_processes_use_as_many_gpus_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, chosen = choose_backend(tiny_config(tmp_path, backend="auto", batch_size=8))
    assert (config.backend, chosen) == ("cuda", "backend cuda: there is a GPU, and the extension is built")
    monkeypatch.setenv("LOCAL_RANK", "7")
    assert check_gpus(config, 8) is None
    assert (check_gpus(config, 2) or "").startswith("2 of 8 GPUs are used")
    # two machines of two processes each
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert (check_gpus(config, 4) or "").startswith("2 of 8 GPUs are used")
    assert check_gpus(replace(config, backend="fast"), 4) is None
    monkeypatch.setenv("LOCAL_RANK", "8")
    with pytest.raises(
        PopError, match=r"process 8 of this machine has no GPU of its own, because there are 8; start one"
    ):
        check_gpus(config, 16)
    monkeypatch.setenv("LOCAL_RANK", "-1")
    with pytest.raises(PopError, match=r"LOCAL_RANK is '-1'; it must be the number of this process, from 0"):
        check_gpus(config, 16)


def test_each_block_is_trained_on_a_gpu_of_its_own(pop, shared_capture, tmp_path, eight_gpus, monkeypatch):
    begun: list[list[str]] = []
    monkeypatch.setattr(jobs, "has_snakemake", lambda: True)
    monkeypatch.setattr(jobs, "_run", lambda words, quiet, *_: begun.append(list(words)) or 0)
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
        says(outcome, f"{folder}: a block is trained on each of the 8 GPUs; wait until one is done")
    monkeypatch.setattr(jobs, "has_snakemake", lambda: False)
    again = pop.done(*words, "--overwrite")
    assert "note: blocks are trained one after the other, on 1 of 8 GPUs; with Snakemake one on each" in again.out


# Compiling the kernels of the CPU, and what there is without them.

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="there is no C++ compiler")
# a compiler that remembers: ten seconds for each of a dozen builds of the same sources would show nothing more. All are
# of code for any processor; that for this machine's is what every other test runs
REMEMBERING = """#!{python} -IS
import hashlib, os, shutil, subprocess, sys

words = [word for word in sys.argv[1:] if not word.startswith("-m")]
at = words.index("-o") + 1
units = [word for word in words if word.endswith(".cpp")]
folder = os.path.dirname(units[0])
asked = [word for word in words if word not in units and word != words[at]]
key = hashlib.sha256(repr((asked, list(map(os.path.basename, units)))).encode())
for name in sorted(os.listdir(folder)):
    if name.endswith((".h", ".cpp")):
        key.update(name.encode())
        key.update(open(os.path.join(folder, name), "rb").read())
kept = os.path.join({kept!r}, key.hexdigest())
if not os.path.exists(kept):
    status = subprocess.run([*{real!r}, *words]).returncode
    if status:
        sys.exit(status)
    beside = kept + "." + str(os.getpid())
    shutil.copyfile(words[at], beside)
    os.replace(beside, kept)
shutil.copyfile(kept, words[at])
"""


@pytest.fixture(scope="session")
def remembering(made_once: Callable[..., Path]) -> str | None:
    """Return a command that compiles as the compiler of this machine, the same sources once; None without one."""
    real = find_compiler()
    if real is None:
        return None

    def make(folder: Path) -> None:
        program = folder / "remembering"
        program.write_text(REMEMBERING.format(python=sys.executable, kept=str(folder), real=real))
        program.chmod(0o755)

    return str(made_once("remembered", make) / "remembering")


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, remembering: str | None) -> Path:
    """A package whose blend was never compiled."""
    if remembering is not None:
        monkeypatch.setenv("CXX", remembering)
    for name in building.SOURCES:
        (tmp_path / name).write_bytes((building.HERE / name).read_bytes())
    monkeypatch.setattr(building, "HERE", tmp_path)
    # what is compiled here is loaded and run once: optimising it would take most of these tests' time
    monkeypatch.setattr(building, "FLAGS", tuple("-O0" if flag == "-O3" else flag for flag in building.FLAGS))
    building.library_path.cache_clear()
    yield tmp_path
    building.library_path.cache_clear()


def compiler(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a program in the compiler's place."""
    path = folder / "compiler"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("CXX", str(path))


@pytest.mark.slow  # it compiles the kernels
@needs_compiler
def test_it_is_compiled_once_older_versions_go_and_a_run_that_has_it_loaded_goes_on_without(fresh, pop):
    assert "run `pop build-cpu`" in (compiled.why_not() or "")
    older = building.library_path().name.split("_")
    older[2] = "0123456789abcdef"
    (fresh / "_".join(older)).write_bytes(b"of an older version")
    outcome = pop("build-cpu")
    (library,) = fresh.glob("*.so")
    assert (outcome.status, outcome.out) == (0, f"{library}\n")
    assert compiled.available()
    made = library.stat().st_mtime_ns
    assert pop("build-cpu").status == 0
    assert library.stat().st_mtime_ns == made
    # as an update removes it
    library.unlink()
    assert compiled.available()
    assert get_backend("compiled").why_not() is None


@pytest.mark.slow
@needs_compiler
def test_a_change_of_the_source_and_another_processor_ask_for_a_new_build_and_leave_the_first_ones(fresh, monkeypatch):
    before = building.build()
    monkeypatch.setattr(building, "processor_features", lambda: "another one")
    building.library_path.cache_clear()
    assert building.library_path() != before
    assert not compiled.available()
    second = building.build()
    assert second != before
    assert before.exists()
    with (fresh / "lanes.h").open("a") as file:
        file.write("// changed\n")
    building.library_path.cache_clear()
    assert building.library_path() not in (before, second)


@needs_compiler
@pytest.mark.slow  # it compiles
def test_a_processor_that_nothing_is_known_of_gets_code_for_any(fresh, pop, monkeypatch):
    monkeypatch.setattr(building, "processor_features", lambda: None)
    building.library_path.cache_clear()
    outcome = pop.done("build-cpu", "--verbose")
    assert "=native" not in outcome.out
    assert compiled.available()


V2 = "cx16 lahf_lm popcnt pni sse4_1 sse4_2 ssse3"
V3 = f"{V2} avx avx2 bmi1 bmi2 f16c fma abm movbe"
V4 = f"{V3} avx512f avx512bw avx512cd avx512dq avx512vl"


@pytest.mark.parametrize(
    ("machine", "features", "levels"),
    [
        ("x86_64", V4, ["x86-64-v4", "x86-64-v3", "x86-64-v2"]),
        ("x86_64", V4.replace(" avx512dq", ""), ["x86-64-v3", "x86-64-v2"]),
        ("x86_64", V2, ["x86-64-v2"]),
        ("x86_64", V4.replace("popcnt ", ""), []),
        ("aarch64", "fp asimd evtstrm", ["armv8-a"]),
        ("riscv64", "fp asimd", []),
    ],
)
def test_a_wheel_brings_the_highest_level_that_the_processor_has(fresh, monkeypatch, machine, features, levels):
    monkeypatch.setattr(building.platform, "machine", lambda: machine)
    monkeypatch.setattr(building, "processor_features", lambda: f"{machine} flags : {features}")
    assert building.supported_levels() == levels
    for of_machine in building.LEVELS.values():
        for name, _ in of_machine:
            (fresh / building.level_name(name)).write_bytes(b"of a wheel")

    def found() -> Path:
        building.library_path.cache_clear()
        return building.library_path()

    # what was compiled here goes before what a wheel brought, and has its place where nothing else runs here
    building.native_path().write_bytes(b"compiled here")
    assert found() == building.native_path()
    building.native_path().unlink()
    for level in levels:
        assert found() == fresh / building.level_name(level)
        found().unlink()
    assert found() == building.native_path()


@needs_compiler
@pytest.mark.slow  # it compiles
def test_a_library_that_no_longer_loads_is_compiled_again(fresh: Path, pop: Pop) -> None:
    building.library_path().write_bytes(b"of a system that is gone")
    assert "compile them again: `pop build-cpu`" in (compiled.why_not() or "")
    pop.done("build-cpu")
    assert compiled.available()


@needs_compiler
def test_the_compiler_that_is_asked_for_is_the_one_that_runs(fresh, pop, monkeypatch, remembering):
    monkeypatch.setenv("CXX", "clang++-of-tomorrow")
    outcome = pop("build-cpu")
    says(outcome, "CXX is 'clang++-of-tomorrow', which is not on this machine")
    monkeypatch.setenv("CXX", f"env {remembering}")
    outcome = pop.done("build-cpu", "--verbose")
    assert outcome.out.split()[0].endswith("/env")


def test_a_compiler_that_does_not_run_or_fails_is_named_and_leaves_nothing(fresh, pop, monkeypatch):
    junk = fresh / "junk"
    junk.write_bytes(bytes(64))
    junk.chmod(0o755)
    monkeypatch.setenv("CXX", str(junk))
    says(pop("build-cpu"), str(junk))
    assert not list(fresh.glob("*.so"))
    compiler(fresh, "echo 'lanes.h:1: error: no such vectors' >&2; exit 1", monkeypatch)
    outcome = pop("build-cpu")
    says(outcome, "compiling the CPU kernels failed")
    assert "error: no such vectors" in outcome.out
    assert not list(fresh.glob("*.so"))
    monkeypatch.setenv("CXX", "g++ '-DA=1")
    says(pop("build-cpu"), """CXX is "g++ '-DA=1", which is not on this machine""")


def test_without_a_compiler_it_says_which_to_install(fresh, pop, monkeypatch, capsys):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(building, "find_compiler", lambda: None)
    outcome = pop("build-cpu")
    assert outcome.status == 2
    assert outcome.err == "pop: error: no C++ compiler was found; install g++ or clang++, or set CXX to one's path\n"
    # as `make setup` calls it, where it may be missing
    monkeypatch.setattr("sys.argv", ["build", "--if-possible"])
    assert building.main() == 0
    assert "backend fast stands in: no C++ compiler was found" in capsys.readouterr().err
    monkeypatch.setattr("sys.argv", ["build"])
    assert building.main() == 1


@needs_compiler
def test_a_compiler_that_does_not_know_the_processor_makes_code_for_any(fresh, pop, monkeypatch):
    real = " ".join(find_compiler() or [])
    compiler(fresh, f'case "$*" in *=native*) echo "unknown value" >&2; exit 1;; esac; exec {real} "$@"', monkeypatch)
    outcome = pop.done("build-cpu", "--verbose")
    assert [line.count("=native") for line in outcome.out.splitlines()] == [1, 1, 1, 0, 0]
    assert compiled.available()


def test_a_library_that_does_not_load_is_a_sentence(fresh: Path, pop: Pop, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler(fresh, 'while [ "$1" != "-o" ]; do shift; done; echo "no library" > "$2"', monkeypatch)
    says(pop("build-cpu"), "the compiled CPU kernels do not load")
    with pytest.raises(PopError, match="backend 'compiled' cannot run: the compiled CPU kernels do not load"):
        get_backend("compiled").rasterization()


@needs_compiler
def test_a_folder_that_cannot_be_written_to_is_named(fresh: Path, pop: Pop, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: object) -> tuple[int, str]:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(building.tempfile, "mkstemp", refuse)
    says(pop("build-cpu"), f"{fresh} cannot be written to (Permission denied); install the package for yourself")


def test_a_library_of_another_layout_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    if not compiled.available():
        pytest.skip(compiled.why_not() or "")
    monkeypatch.setattr("pop_fast.compiled.library.ctypes.sizeof", lambda _: 8)
    with pytest.raises(OSError, match="arguments of another layout"):
        open_library.__wrapped__(str(building.library_path()))


def test_auto_takes_it_where_it_is_and_says_how_to_get_it_where_it_is_not(fresh, tmp_path, monkeypatch):
    chosen, line = choose_backend(tiny_config(tmp_path, backend="auto"))
    assert chosen.backend == "fast"
    assert line.startswith("backend fast (CPU): the CPU kernels are not compiled")
    assert line.endswith(f"run `pop build-cpu`; {NOT_BUILT}")
    (finding,) = (found for found in backends() if found.name == "backend compiled")
    assert finding.state == "off"
    assert "`pop build-cpu`" in finding.found
    # results that were trained with it are drawn without it
    drawing, note = renderer("compiled")
    assert drawing.name == "fast"
    assert (note or "").startswith("backend 'fast' stands in for 'compiled': the CPU kernels are not compiled")
    monkeypatch.setattr("pop_fast.compiled.why_not", lambda: None)
    chosen, line = choose_backend(tiny_config(tmp_path, backend="auto"))
    assert (chosen.backend, line) == ("compiled", f"backend compiled (CPU): {NOT_BUILT}")
    assert [(renderer(name)[0].name, renderer(name)[1]) for name in ("compiled", "auto")] == [("compiled", None)] * 2
    assert renderer("cuda")[1] == f"backend 'compiled' stands in for 'cuda': {NOT_BUILT}"
