"""Ways to cut a run short: Ctrl-C at a step, and a process that ends between two changes of the disk."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pop_fast.train import TrainingRun

_TAKE_STEPS = TrainingRun.take_steps


class Killed(BaseException):
    """The process is gone: from here on nothing that it tries has an effect."""


def interrupt(monkeypatch: pytest.MonkeyPatch, at: int) -> None:
    """Let every run be left at once, without a checkpoint, when it has taken `at` steps."""

    def stepping(training: TrainingRun, last: int) -> Any:
        if training.step == at:
            raise KeyboardInterrupt
        # an engine that takes many steps at a time is stopped there too
        return _TAKE_STEPS(training, min(last, at) if training.step < at else last)

    monkeypatch.setattr(TrainingRun, "take_steps", stepping)


@contextmanager
def interrupted(at: int) -> Iterator[None]:
    """Let the run in this block be left at once, without a checkpoint, when it has taken `at` steps."""
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, at)
        with pytest.raises(KeyboardInterrupt):
            yield


def run_until(training: TrainingRun, at: int | None = None) -> None:
    """Run to the end, or leave at once, without a checkpoint, when `at` steps are taken."""
    if at is None:
        training.run()
        return
    with interrupted(at):
        training.run()


@contextmanager
def killed_after(changes: int) -> Iterator[None]:
    """Let the first so many renames, removals and new folders happen and raise `Killed` at each one after them."""
    left = changes

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal left
            if left == 0:
                raise Killed
            left -= 1
            return function(*args, **kwargs)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for owner, name in ((os, "replace"), (Path, "mkdir"), (Path, "unlink"), (Path, "rmdir"), (shutil, "rmtree")):
            patch.setattr(owner, name, counted(getattr(owner, name)))
        yield
