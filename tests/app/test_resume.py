"""A run that was stopped, by whatever, continues to the same bits as one that was not."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import pop_fast.compiled
from pop_fast.children import module_command
from pop_fast.data.gaussians import initialize_params
from pop_fast.errors import PopError
from pop_fast.train import TrainingRun, training_run
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.ranks import ALONE, Ranks, join
from pop_fast.train.signals import stop_requests
from pop_fast.train.torch_stepper import check_batch
from tests.app.captures import PINHOLE, camera, photograph, ring, write_model, write_photograph
from tests.app.conftest import ROOT, TRAIN, in_a_child, launched, wait_until
from tests.app.damage import contents
from tests.app.tiny import (
    assert_same_run,
    interrupt,
    last_checkpoint,
    run_until,
    skip_without,
    tiny_capture,
    tiny_config,
)


def run_to(folder, stop_after=None, resume=False, method="pop"):
    """Train; leave at once, without any clean-up, after so many steps of the whole run."""
    run_until(TrainingRun(tiny_config(folder, method=method), tiny_capture(), resume=resume), stop_after)


@pytest.fixture(scope="module", params=["pop", "gsplat"])
def uninterrupted(request, made_once):
    return request.param, made_once(f"whole-{request.param}", lambda folder: run_to(folder, method=request.param))


def test_stopping_anywhere_and_going_on_changes_nothing(uninterrupted, tmp_path):
    method, reference = uninterrupted
    # before the first checkpoint, on one, right after a densification step, between two, in the last segment
    for place, stop_after in enumerate((3, 10, 13, 17, 29)):
        run_to(tmp_path, stop_after, resume=place > 0, method=method)
    run_to(tmp_path, resume=True, method=method)
    assert_same_run(tmp_path, reference)


def test_resuming_a_finished_run_returns_its_statistics_and_writes_nothing_anew(uninterrupted):
    method, folder = uninterrupted
    before = contents(folder)
    stats = TrainingRun(tiny_config(folder, method=method), tiny_capture(), resume=True).run()
    assert stats["step"] == 29
    assert contents(folder) == before


def test_photographs_are_hashed_once_and_before_the_first_step(tmp_path, monkeypatch):
    # seconds for large ones, which a request to stop must not wait for
    took, hashed, taken = TrainingRun.take_steps, ckpt.capture_fingerprint, []
    monkeypatch.setattr(ckpt, "capture_fingerprint", lambda *given: taken.append("hash") or hashed(*given))
    monkeypatch.setattr(TrainingRun, "take_steps", lambda training, last: taken.append("steps") or took(training, last))
    for stop_after, resume in ((17, False), (None, True)):
        taken.clear()
        run_to(tmp_path, stop_after, resume)
        assert len(ckpt.list_checkpoints(tmp_path)) > 1
        assert (taken[0], taken.count("hash")) == ("hash", 1)


def test_a_request_to_stop_while_photographs_are_hashed_is_heard_at_once(tmp_path, monkeypatch):
    hashed, taken = ckpt.capture_fingerprint, []

    def asked(*given):
        os.kill(os.getpid(), signal.SIGTERM)
        taken.append("hash")
        return hashed(*given)

    monkeypatch.setattr(ckpt, "capture_fingerprint", asked)
    with pytest.raises(KeyboardInterrupt):
        run_to(tmp_path / "r")
    assert taken == []
    assert not list((tmp_path / "r").rglob("*"))


def test_ctrl_c_writes_a_checkpoint_of_the_step_it_came_at(tmp_path):
    trainer = TrainingRun(tiny_config(tmp_path, checkpoint_every=0, save_steps=()), tiny_capture())
    take_steps = trainer.take_steps

    def interrupted(last):
        done = take_steps(last)
        if trainer.step == 7:
            os.kill(os.getpid(), signal.SIGINT)
        return done

    trainer.take_steps = interrupted
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert trainer.step == 7
    assert [number for number, _ in ckpt.list_checkpoints(tmp_path)] == [6]


def test_a_request_to_stop_is_heard_while_the_last_checkpoint_is_written(tmp_path, monkeypatch):
    saved = ckpt.save_checkpoint

    def asked(path, content):
        if content["step"] == 29:
            os.kill(os.getpid(), signal.SIGTERM)
        saved(path, content)

    monkeypatch.setattr(ckpt, "save_checkpoint", asked)
    with pytest.raises(KeyboardInterrupt):
        run_to(tmp_path)
    assert ckpt.list_checkpoints(tmp_path)[-1][0] == 29
    assert TrainingRun(tiny_config(tmp_path), tiny_capture(), resume=True).run()["step"] == 29


def test_a_second_ctrl_c_is_obeyed_at_once_and_handlers_are_put_back():
    # a session in the background may have been started with it ignored
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)

    def press_twice():
        with stop_requests() as stop:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
            assert stop.asked
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1.0)

    try:
        with pytest.raises(KeyboardInterrupt):
            press_twice()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, inherited)


def test_a_run_in_batches_goes_on_from_a_checkpoint_within_a_window(tmp_path):
    # three steps of four views each: the window has seen more views than steps were taken
    config = {"batch_size": 4, "max_steps": 4, "eval_steps": (), "save_steps": (), "checkpoint_every": 3}
    TrainingRun(tiny_config(tmp_path / "whole", **config), tiny_capture()).run()
    shutil.copytree(tmp_path / "whole", tmp_path / "parts")
    ckpt.checkpoint_path(tmp_path / "parts", 3).unlink()
    assert ckpt.load_checkpoint(ckpt.checkpoint_path(tmp_path / "parts", 2))["strategy"]["views"] == 12
    TrainingRun(tiny_config(tmp_path / "parts", **config), tiny_capture(), resume=True).run()
    parts, whole = (ckpt.load_splats(ckpt.checkpoint_path(tmp_path / name, 3))[0] for name in ("parts", "whole"))
    assert all(torch.equal(parts[key], value) for key, value in whole.items())


@pytest.mark.parametrize(("dtype", "degree"), [(torch.float64, 3), (torch.float32, 2), (torch.float32, 0)])
def test_a_run_in_double_precision_or_of_fewer_bands_goes_on_to_the_same_bits(tmp_path, dtype, degree):
    capture = tiny_capture()
    initial = initialize_params(capture, 7, 0.5, 0.5, dtype)
    initial["shN"] = initial["shN"][:, : (degree + 1) ** 2 - 1]

    def run(folder, stop_after=None, resume=False):
        config = tiny_config(tmp_path / folder, sh_degree=degree, max_steps=18, exposure=True)
        training = TrainingRun(config, capture, initial=initial, resume=resume)
        run_until(training, stop_after)
        return training.params

    run("parts", 13)
    parts, whole = run("parts", resume=True), run("whole")
    assert all(value.dtype == dtype and torch.equal(parts[key], value) for key, value in whole.items())


@pytest.mark.parametrize("engine", ["fast", "compiled"])
def test_a_measurement_that_is_left_is_made_by_who_resumes(tmp_path, monkeypatch, engine):
    skip_without(engine)
    whole = tiny_config(tmp_path / "whole", eval_steps=(12,), backend=engine)
    TrainingRun(whole, tiny_capture()).run()
    parts = replace(whole, result_dir=str(tmp_path / "parts"))
    measured = training_run.evaluate

    def asking(*given: Any) -> Any:
        # the last argument is the step, from 0
        if given[-1] == due - 1:
            os.kill(os.getpid(), signal.SIGTERM)
        return measured(*given)

    for due in (12, 30):
        with monkeypatch.context() as patch:
            patch.setattr(training_run, "evaluate", asking)
            with pytest.raises(KeyboardInterrupt):
                TrainingRun(parts, tiny_capture(), resume=due == 30).run()
        assert ckpt.list_checkpoints(tmp_path / "parts")[-1][0] == due - 1
        assert not (tmp_path / "parts" / "stats" / f"val_step{due - 1:04d}.json").exists()
    TrainingRun(parts, tiny_capture(), resume=True).run()
    for step in (11, 29):
        texts = ((tmp_path / name / "stats" / f"val_step{step:04d}.json").read_text() for name in ("parts", "whole"))
        mine, theirs = map(json.loads, texts)
        assert (mine["psnr"], mine["per_view"]) == (theirs["psnr"], theirs["per_view"])
    mine, theirs = (last_checkpoint(tmp_path / name)[".splats.means"] for name in ("parts", "whole"))
    assert torch.equal(mine, theirs)


# Two processes that share the views of each step train to the bits of one.

needs_gloo = pytest.mark.skipif(
    not (torch.distributed.is_available() and torch.distributed.is_gloo_available()), reason="this torch has no gloo"
)

# growth by blur and the prior, by torch's stages; resets of opacities, by those in C++ where they are compiled
RUNS = {"pop": "fast", "gsplat": "compiled" if pop_fast.compiled.why_not() is None else "fast"}
SIZE = 4


def train(folder: Path, backend: str, method: str, resume: bool = False, ranks: Ranks = ALONE) -> None:
    config = tiny_config(folder, method, batch_size=SIZE, backend=backend)
    TrainingRun(config, tiny_capture(), resume=resume, ranks=ranks).run()


def differing(folder: Path, ranks: Ranks) -> Iterator[str]:
    """Say how runs end in which the second process continues nothing, sees another capture, or has other Gaussians."""
    own = folder / f"own_{ranks.rank}"
    if ranks.writes:
        shutil.copytree(folder / "left", own)
    plain = tiny_config(own, batch_size=2, checkpoint_every=0, save_steps=(), eval_steps=())
    config = tiny_config(own, batch_size=SIZE)
    runs = [TrainingRun(config, tiny_capture(), resume=True, ranks=ranks)]
    runs += [TrainingRun(plain, tiny_capture(seed), overwrite=True, ranks=ranks) for seed in (ranks.rank, 0)]
    # none is bright enough to stay after the first change
    runs[2].params["opacities"].data -= 20.0 * ranks.rank
    for run in runs:
        with pytest.raises(PopError) as error:
            run.run()
        yield str(error.value)


def train_all(folder: Path) -> None:
    """What each process does: two whole runs, one that is left after eleven steps, and runs that cannot be."""
    ranks = join()
    # sums of an uneven number of entries, and of numbers whose order matters
    mine = [torch.tensor([1e8, 1.0, -1e8]) * (place + 1.0) / 3.0 for place in ranks.positions(SIZE)]
    torch.save(ranks.total(iter(mine)), folder / f"total_{ranks.rank}.pt")
    for method, backend in RUNS.items():
        train(folder / method, backend, method, ranks=ranks)
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, at=11)
        with suppress(KeyboardInterrupt):
            train(folder / "left", "fast", "pop", ranks=ranks)
    (folder / f"differ_{ranks.rank}").write_text("\n".join(differing(folder, ranks)))
    if ranks.writes:
        os._exit(0)
    try:
        ranks.wait()
    except PopError as error:
        (folder / "lost").write_text(str(error))


@pytest.fixture(scope="module")
def together(made_once: Callable[..., Path]) -> Path:
    def make(folder: Path) -> None:
        outcomes = launched([__file__, folder])
        assert [outcome.status for outcome in outcomes] == [0, 0], outcomes

    return made_once("together", make)


@pytest.mark.slow  # four trainings by two processes
@needs_gloo
@pytest.mark.parametrize("method", RUNS)
def test_two_processes_train_to_the_bits_of_one(together: Path, tmp_path: Path, method: str) -> None:
    alone, theirs = tmp_path / "alone", together / method
    train(alone, RUNS[method], method)
    assert_same_run(theirs, alone)
    # density control had something to decide, and the second process wrote nothing of its own
    assert len(last_checkpoint(theirs)[".splats.means"]) > 70
    assert sorted(path.name for path in theirs.iterdir()) == sorted(path.name for path in alone.iterdir())


@pytest.mark.slow
@needs_gloo
def test_processes_that_differ_say_in_what(together: Path) -> None:
    first, second = ((together / f"differ_{rank}").read_text().splitlines() for rank in (0, 1))
    assert first[:2] == second[:2]
    fix = ": start all with the same options, and let them read the capture and the result folder from one file system"
    assert first[:2] == [f"the 2 processes have different {name}{fix}" for name in ("checkpoints", "photographs")]
    for said in (first[2], second[2]):
        assert said.startswith("the 2 processes no longer hold the same Gaussians after 5 steps; ")


@pytest.mark.slow
@needs_gloo
def test_one_process_continues_what_two_began(together: Path) -> None:
    train(together / "left", "fast", "pop", resume=True)
    assert_same_run(together / "left", together / "pop")


@pytest.mark.slow  # four trainings by two processes
@needs_gloo
def test_sums_do_not_depend_on_who_adds_and_a_process_whose_fellow_has_ended_says_so(together: Path) -> None:
    alone = ALONE.total(torch.tensor([1e8, 1.0, -1e8]) * (place + 1.0) / 3.0 for place in range(SIZE))
    for rank in (0, 1):
        assert torch.equal(torch.load(together / f"total_{rank}.pt"), alone)
    told = (together / "lost").read_text()
    assert told.startswith("process 1 of 2 lost the others: one of them has ended, and its own message says why")


@pytest.mark.slow  # two processes that train
@needs_gloo
def test_pop_train_is_one_command_for_two_processes(shared_capture: Path, tmp_path: Path) -> None:
    settings = ["--steps-scaler", "0.0003", "--no-progress", "--backend", "fast", "--batch-size", "2", "--threads", "1"]
    settings += ["--skip-sizes", "--skip-checks", "--max-renders", "1"]
    # which one of them unpacks
    archive = shutil.make_archive(f"{tmp_path}/toy", "zip", shared_capture)
    first, second = launched(["-m", "pop_fast.cli", "train", archive, "--out", tmp_path / "two", *settings])
    assert (first.status, second.status) == (0, 0), (first.err, second.err)
    assert "Gaussians" in first.out
    assert (second.out, second.err) == ("", "")
    assert (tmp_path / "two" / "report.html").is_file()


class Three(Ranks):
    """One of three."""

    rank, size = 1, 3


@needs_gloo
def test_views_are_shared_evenly_and_a_process_that_nobody_launched_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Three().positions(6) == range(2, 4)
    with pytest.raises(PopError, match=r"batch_size is 4; 3 processes share .* use --batch-size 3 or a multiple"):
        check_batch(tiny_config("x", batch_size=4), True, Three())
    for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    assert join() is ALONE
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert join() is ALONE


@pytest.fixture
def first_of_two(monkeypatch: pytest.MonkeyPatch) -> tuple[str, int]:
    """Let this process and those that it starts be the first of two; return where the second one would find it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        host, port = free.getsockname()
    told = {"RANK": 0, "WORLD_SIZE": 2, "MASTER_ADDR": host, "MASTER_PORT": port}
    for name, value in told.items():
        monkeypatch.setenv(name, str(value))
    return host, port


@needs_gloo
def test_a_process_whose_fellow_does_not_come_says_so(first_of_two, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pop_fast.train.ranks._MEETING", timedelta(seconds=1))
    with pytest.raises(PopError, match=r"cannot connect to the other processes \(RANK=0, .*\): .*; start them with"):
        join()


# Ctrl-C, SIGTERM, SIGHUP and SIGKILL, at a program that is at work in a process of its own.

posix = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
_POP = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from pop_fast.cli import main
sys.exit(main())
"""
# whoever runs the tests without a terminal may have hangups ignored, which children inherit
_HEEDING = "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"


def start(tmp_path: Path, *words: object, script: str = _HEEDING + _POP) -> subprocess.Popen[str]:
    """Begin `pop WORD ...` with a folder for what it keeps for a while."""
    scratch = tmp_path / "scratch"
    scratch.mkdir(exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(scratch), "OMP_NUM_THREADS": "1"}
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", script, *map(str, words)], env=environment, cwd=ROOT, **pipes)


@pytest.mark.slow  # a training that is begun many times
@posix
def test_sigkill_at_random_moments_changes_nothing(tmp_path):
    run_to(tmp_path / "reference")
    rng, folder = random.Random(20), tmp_path / "r"
    script = "import runpy, sys; del sys.argv[0]; runpy.run_path(sys.argv[0], run_name='__main__')"
    for kills in (True, True, False):
        have = ckpt.list_checkpoints(folder)
        process = start(tmp_path, "tests/app/tiny.py", folder, "resume", script=script)
        if kills:
            wait_until(lambda have=have: ckpt.list_checkpoints(folder) != have, process)
            time.sleep(rng.uniform(0.0, 0.15))
            process.send_signal(signal.SIGKILL)
        process.communicate(timeout=300)
        assert process.returncode == (-signal.SIGKILL if kills else 0)
    assert_same_run(folder, tmp_path / "reference")
    assert not [path for path in folder.rglob("*") if "partial" in path.name]


@posix
@pytest.mark.parametrize(
    ("number", "status"),
    [
        pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow),
        (signal.SIGTERM, 143),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, -signal.SIGKILL, marks=pytest.mark.slow),
    ],
)
def test_the_search_for_cameras_is_left_at_once_and_leaves_nothing(tmp_path, number, status):
    # photographs of noise that overlap: thousands of features each, minutes of matching
    wall = np.random.default_rng(0).integers(0, 256, (900, 3000, 3), dtype=np.uint8)
    for i in range(24):
        write_photograph(tmp_path / "in" / f"{i:02d}.png", wall[:, 80 * i : 80 * i + 1100])
    before = contents(tmp_path / "in")
    process = start(tmp_path, "sfm", tmp_path / "in")
    # while features are found, in one call of COLMAP that takes longer than the test waits
    wait_until(lambda: any((tmp_path / "scratch").glob("pop_sfm_*/database.db")), process)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == status
    if number != signal.SIGKILL:
        assert err == "pop: interrupted\n"
        assert contents(tmp_path / "in") == before
    # the other process notices that this one is gone, whatever ended it
    wait_until(lambda: not any((tmp_path / "scratch").iterdir()))


@posix
@pytest.mark.parametrize(
    "run", ["pop_fast.blocks.jobs import _run as run", "paper_repro.queue import _Child; run = _Child().run"]
)
def test_the_process_of_a_block_or_a_row_ends_when_its_starter_is_killed(tmp_path, run):
    child = module_command("timeit", "-n1", "-r1", "import time; print('at work', flush=True); time.sleep(99)")
    starter = start(tmp_path, script=f"from {run}; run({child}, 0)")
    assert starter.stdout.readline() == "at work\n"
    starter.kill()
    # both streams end with the last process that holds them
    assert starter.communicate(timeout=60)[0] == ""


@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_training_that_is_told_to_stop_writes_a_checkpoint(shared_capture, tmp_path, number):
    folder = tmp_path / "r"
    words = ("--max-steps", "100000", "--checkpoint-every", "0", *TRAIN)
    process = start(tmp_path, "train", shared_capture, "--out", folder, *words)
    wait_until(lambda: (folder / "cfg.json").exists(), process)
    process.send_signal(number)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    ((step, _),) = ckpt.list_checkpoints(folder)
    assert err == f"pop: stopped after step {step + 1:,}; the same command with --resume continues\n"


@posix
@needs_gloo
def test_sigterm_ends_a_process_that_waits_for_its_fellow(first_of_two, shared_capture: Path, tmp_path: Path) -> None:
    process = start(tmp_path, "train", shared_capture, "--out", tmp_path / "r", "--batch-size", "2", *TRAIN)

    def waits() -> bool:
        with socket.socket() as second:
            return second.connect_ex(first_of_two) == 0

    wait_until(waits, process)
    process.terminate()
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err.splitlines()[-1]) == (143, "", "pop: interrupted")


@posix
def test_a_hangup_that_is_ignored_stays_so(shared_capture: Path, tmp_path: Path) -> None:
    folder = tmp_path / "r"
    ignoring = (
        "import os, signal, sys; signal.signal(signal.SIGHUP, signal.SIG_IGN); os.execv(sys.argv[1], sys.argv[1:])"
    )
    command = (sys.executable, "-c", _POP, "train", shared_capture, "--out", folder, "--max-steps", "600", *TRAIN)
    process = start(tmp_path, *command, script=ignoring)
    wait_until(lambda: (folder / "cfg.json").exists(), process)
    process.send_signal(signal.SIGHUP)
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 0
    assert "report: " in out


_LOADING = """
import atexit, os, time
from pathlib import Path

class Large:
    # taken apart when Python ends in its own way, as all that a training holds would be
    def __del__(self, write=os.write):
        write(1, b"taken apart")

large = Large()
atexit.register(print, "what was registered for the end is done")

from pop_fast.data import load
from pop_fast.data.cameras import require_colmap

def slowly(*_, **__):
    require_colmap()
    Path(sys.argv[-1], "reading").touch()
    time.sleep(300.0)

load.load_capture = slowly
"""


@posix
def test_sigterm_while_a_capture_is_read_is_one_line_and_the_end(shared_capture: Path, tmp_path: Path) -> None:
    script = _POP.replace("from pop_fast.cli import main", f"{_LOADING}from pop_fast.cli import main")
    # pycolmap prints a stack trace of its own where it is let
    words = ("train", shared_capture, "--out", f"{tmp_path}/r", "--images", tmp_path)
    process = start(tmp_path, *words, script=script)
    wait_until(lambda: (tmp_path / "reading").exists(), process)
    process.terminate()
    out, err = process.communicate(timeout=60)
    assert err == "pop: interrupted\n"
    assert out == "what was registered for the end is done\n"
    assert process.returncode == 143


@posix
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_that_comes_while_an_object_is_freed_is_heard(tmp_path: Path, number: int, status: int) -> None:
    freed = f"""
import os, time
from pop_fast import cli

class Freed:
    def __del__(self):
        os.kill(os.getpid(), {number:d})
        time.sleep(0.01)

def run(words):
    Freed()
    time.sleep(60.0)

cli.command = lambda name: run
"""
    process = start(tmp_path, "doctor", script=_POP.replace("from pop_fast.cli import main", freed + "main = cli.main"))
    _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (status, "pop: interrupted\n")


@pytest.mark.slow  # photographs of 12 megapixels
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_training_on_photographs_of_12_megapixels_is_gone_after_less_than_two_seconds_of_work(tmp_path, number):
    skip_without("compiled")
    names, folder = [f"{i}.bmp" for i in range(6)], tmp_path / "r"
    for i, name in enumerate(names):
        write_photograph(tmp_path / "large" / "images" / name, photograph(i, 4000, 3000))
    wide = camera(params=[100.0 * value for value in PINHOLE], width=4000, height=3000)
    write_model(tmp_path / "large" / "sparse" / "0", names, ring(len(names)), [wide])
    words = ("--out", folder, "--max-steps", "1000", "--test-every", "0", "--no-progress", "--quiet")
    process = start(tmp_path, "train", tmp_path / "large", *words)
    wait_until(lambda: (folder / "metrics.jsonl").exists(), process)
    before = sum(map(int, Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[11:13]))
    process.send_signal(number)
    # by what it does and not by the clock, which depends on who else is at work
    _, status, used = os.wait4(process.pid, 0)
    assert os.waitstatus_to_exitcode(status) == 130
    ((step, _),) = ckpt.list_checkpoints(folder)
    assert process.stderr.read() == f"pop: stopped after step {step + 1:,}; the same command with --resume continues\n"
    assert used.ru_utime + used.ru_stime - before / os.sysconf("SC_CLK_TCK") < 2.0


# the handler runs between any two lines of what the main thread is doing: here at each line of the wait in turn
_AT_EVERY_LINE = """
import signal, sys
from pop_fast.blocks import jobs

jobs._PAUSE = 0.01
SLEEPER = [sys.executable, "-IS", "-c", "import time; time.sleep(100.0)"]

def status_after_a_signal_at(line):
    seen = 0

    def trace(frame, event, argument):
        nonlocal seen
        caller = frame
        while caller is not None and caller.f_code is not jobs._run.__code__:
            caller = caller.f_back
        if event == "line" and caller is not None and "process" in caller.f_locals:
            seen += 1
            if seen == line:
                signal.raise_signal(signal.SIGTERM)
        return trace

    sys.settrace(trace)
    try:
        return jobs._run(SLEEPER, True)
    finally:
        sys.settrace(None)

print(*[status_after_a_signal_at(line) for line in range(1, 61)])
"""


@posix
def test_a_request_to_stop_is_heard_at_every_line_of_waiting_for_a_process() -> None:
    outcome = in_a_child(_AT_EVERY_LINE, seconds=120.0)
    assert outcome.status == 0, outcome.err
    assert outcome.out.split() == ["130"] * 60


_IN_A_CALL = """
import ctypes, os, signal, threading, time
from pop_fast.train.signals import Abandoned, heard, stop_requests

def seconds_until_left(call):
    start = time.monotonic()
    with stop_requests() as stop:
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)).start()
        try:
            with stop.abandoning():
                call()
        except Abandoned:
            return time.monotonic() - start
    raise SystemExit("nobody was heard")

# as long as a call of compiled code, in which Python runs no handler
pthread_mutex = ctypes.create_string_buffer(64)
library = ctypes.CDLL(None)
library.pthread_mutex_init(pthread_mutex, None)
library.pthread_mutex_lock(pthread_mutex)
threading.Timer(2.5, library.pthread_mutex_unlock, (pthread_mutex,)).start()
print(seconds_until_left(lambda: heard(library.pthread_mutex_lock, pthread_mutex)), flush=True)
"""


@posix
def test_a_signal_is_heard_through_a_call_of_compiled_code() -> None:
    outcome = in_a_child(_IN_A_CALL, seconds=60.0)
    assert outcome.status == 0, outcome.err
    assert float(outcome.out) < 2.0


if __name__ == "__main__":
    train_all(Path(sys.argv[1]))
