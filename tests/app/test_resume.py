"""A run that was stopped, by whatever, continues to the same bits as one that was not."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
import torch

import pop_fast.compiled
from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.ranks import ALONE, Ranks, join
from pop_fast.train.signals import stop_requests
from pop_fast.train.torch_stepper import check_batch
from tests.app.conftest import launched
from tests.app.interruptions import interrupt, run_until
from tests.app.tiny import last_checkpoint, tiny_capture, tiny_config

ROOT = Path(__file__).parents[2]
# what a clock says differs from run to run
CLOCKS = ("it_per_s", "seconds")


def run_to(folder, stop_after=None, resume=False, method="pop"):
    """Train; leave at once, without any clean-up, after so many steps of the whole run."""
    run_until(TrainingRun(tiny_config(folder, method=method), tiny_capture(), resume=resume), stop_after)


def everything(folder):
    """All that a finished run leaves and that must not depend on interruptions, flat."""
    return last_checkpoint(folder, "seconds", "metrics_bytes")


def assert_same_run(folder, reference):
    ours, theirs = everything(folder), everything(reference)
    assert list(ours) == list(theirs)
    kinds = {"splats", "optimizers", "strategy", "view_order"}
    assert kinds <= {name.split(".")[1] for name in ours}
    for name, value in ours.items():
        if isinstance(value, torch.Tensor):
            assert value.dtype == theirs[name].dtype, name
            assert torch.equal(value, theirs[name]), name
        else:
            assert value == theirs[name], name
    assert records(folder) == records(reference)


def records(folder):
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in CLOCKS} for line in lines]


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
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    stats = TrainingRun(tiny_config(folder, method=method), tiny_capture(), resume=True).run()
    assert stats["step"] == 29
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


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
    hashed = ckpt.capture_fingerprint

    def asked(*given):
        os.kill(os.getpid(), signal.SIGTERM)
        taken.append("hash")
        return hashed(*given)

    taken = []
    monkeypatch.setattr(ckpt, "capture_fingerprint", asked)
    with pytest.raises(KeyboardInterrupt):
        TrainingRun(tiny_config(tmp_path / "r"), tiny_capture()).run()
    assert taken == []
    assert not list((tmp_path / "r").rglob("*"))


def test_resuming_where_nothing_was_trained_starts(tmp_path):
    trainer = TrainingRun(tiny_config(tmp_path / "new", max_steps=2), tiny_capture(), resume=True)
    trainer.run()
    assert trainer.step == 2


def start(folder, *words):
    command = [sys.executable, str(ROOT / "tests" / "app" / "tiny.py"), str(folder), *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)


def wait_for(condition, process, seconds=300.0):
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.stderr.read().decode()
        assert time.monotonic() < end, "the process does not get on"
        time.sleep(0.005)


@pytest.mark.slow  # a training that is begun many times
def test_sigkill_at_random_moments_changes_nothing(tmp_path_factory, tmp_path):
    reference = tmp_path_factory.mktemp("reference")
    run_to(reference)
    rng = random.Random(20)
    for kills in (True, True, False):
        have = ckpt.list_checkpoints(tmp_path)
        process = start(tmp_path, "resume")
        if kills:
            wait_for(lambda have=have: ckpt.list_checkpoints(tmp_path) != have, process)
            time.sleep(rng.uniform(0.0, 0.15))
            process.send_signal(signal.SIGKILL)
        assert process.wait(300) == (-signal.SIGKILL if kills else 0)
        process.stderr.close()
    assert_same_run(tmp_path, reference)
    assert not [path for path in tmp_path.rglob("*") if "partial" in path.name]


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


@pytest.fixture
def ctrl_c():
    # a session in the background may have been started with it ignored
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_a_second_ctrl_c_is_obeyed_at_once_and_handlers_are_put_back():
    before = signal.getsignal(signal.SIGINT)

    def press_twice():
        with stop_requests() as stop:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
            assert stop.asked
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1.0)

    with pytest.raises(KeyboardInterrupt):
        press_twice()
    assert signal.getsignal(signal.SIGINT) is before


def test_a_run_in_batches_goes_on_from_a_checkpoint_within_a_window(tmp_path):
    # three steps of four views each: the window has seen more views than steps were taken
    config = {"batch_size": 4, "max_steps": 4, "eval_steps": (), "save_steps": (), "checkpoint_every": 3}
    TrainingRun(tiny_config(tmp_path / "whole", **config), tiny_capture()).run()
    shutil.copytree(tmp_path / "whole", tmp_path / "parts")
    ckpt.checkpoint_path(tmp_path / "parts", 3).unlink()
    assert ckpt.load_checkpoint(ckpt.checkpoint_path(tmp_path / "parts", 2))["strategy"]["views"] == 12
    TrainingRun(tiny_config(tmp_path / "parts", **config), tiny_capture(), resume=True).run()
    parts, whole = (ckpt.load_checkpoint(ckpt.checkpoint_path(tmp_path / name, 3)) for name in ("parts", "whole"))
    assert all(torch.equal(parts["splats"][key], value) for key, value in whole["splats"].items())


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


def train_all(folder: Path) -> None:
    """What each process does: two whole runs, and one that is left after eleven steps."""
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


def same(ours: Path, theirs: Path) -> None:
    # all tensors, random generators and settings; not the clock
    one, other = (last_checkpoint(folder, "seconds", "metrics_bytes") for folder in (ours, theirs))
    assert list(one) == list(other)
    for name, value in one.items():
        equal = torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name]
        assert equal, name


@pytest.mark.slow  # four trainings by two processes
@needs_gloo
@pytest.mark.parametrize("method", RUNS)
def test_two_processes_train_to_the_bits_of_one(together: Path, tmp_path: Path, method: str) -> None:
    train(tmp_path / "alone", RUNS[method], method)
    theirs = together / method
    same(theirs, tmp_path / "alone")
    # density control had something to decide, and the second process wrote nothing of its own
    assert len(last_checkpoint(theirs)[".splats.means"]) > 70
    assert sorted(path.name for path in theirs.iterdir()) == sorted(
        path.name for path in (tmp_path / "alone").iterdir()
    )


@needs_gloo
def test_one_process_continues_what_two_began(together: Path) -> None:
    train(together / "left", "fast", "pop", resume=True)
    same(together / "left", together / "pop")


@needs_gloo
def test_sums_do_not_depend_on_who_adds(together: Path) -> None:
    alone = ALONE.total(torch.tensor([1e8, 1.0, -1e8]) * (place + 1.0) / 3.0 for place in range(SIZE))
    for rank in (0, 1):
        assert torch.equal(torch.load(together / f"total_{rank}.pt"), alone)


@needs_gloo
def test_a_process_whose_fellow_has_ended_says_so(together: Path) -> None:
    told = (together / "lost").read_text()
    assert told.startswith("process 1 of 2 lost the others: one of them has ended, and its own message says why")


@needs_gloo
def test_pop_train_is_one_command_for_two_processes(shared_capture: Path, tmp_path: Path) -> None:
    settings = ["--steps-scaler", "0.0003", "--no-progress", "--backend", "fast", "--batch-size", "2", "--threads", "1"]
    settings += ["--skip-sizes", "--skip-checks", "--max-renders", "1"]
    first, second = launched(["-m", "pop_fast.cli", "train", shared_capture, "--out", tmp_path / "two", *settings])
    assert (first.status, second.status) == (0, 0), (first.err, second.err)
    assert "Gaussians" in first.out
    assert (second.out, second.err) == ("", "")
    assert (tmp_path / "two" / "report.html").is_file()


class Three(Ranks):
    """One of three."""

    rank, size = 1, 3


@needs_gloo
def test_views_that_cannot_be_shared_evenly_are_refused() -> None:
    assert Three().positions(6) == range(2, 4)
    with pytest.raises(PopError, match=r"batch_size is 4; 3 processes share .* use --batch-size 3 or a multiple"):
        check_batch(tiny_config("x", batch_size=4), True, Three())


@needs_gloo
def test_a_process_that_nobody_launched_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    assert join() is ALONE
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert join() is ALONE


if __name__ == "__main__":
    train_all(Path(sys.argv[1]))
