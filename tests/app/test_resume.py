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
from pathlib import Path

import pytest
import torch

from pop_fast.train import TrainingRun
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.signals import stop_requests
from tests.app.tiny import last_checkpoint, tiny_capture, tiny_config

ROOT = Path(__file__).parents[2]
# what a clock says differs from run to run
CLOCKS = ("it_per_s", "seconds")


def run_to(folder, stop_after=None, resume=False, method="pop"):
    """Train; leave at once, without any clean-up, after so many steps of the whole run."""
    trainer = TrainingRun(tiny_config(folder, method=method), tiny_capture(), resume=resume)
    take_steps = trainer.take_steps

    def stepping(last):
        if trainer.step == stop_after:
            raise KeyboardInterrupt
        return take_steps(last)

    trainer.take_steps = stepping
    if stop_after is None:
        trainer.run()
    else:
        with pytest.raises(KeyboardInterrupt):
            trainer.run()


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
def uninterrupted(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    run_to(folder, method=request.param)
    return request.param, folder


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
