"""Two processes that share the views of each step train to the bits of one."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

import pytest
import torch

import pop_fast.compiled
from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from pop_fast.train.batch_stepper import check_batch
from pop_fast.train.ranks import ALONE, Ranks, join
from tests.app.interruptions import interrupt
from tests.app.launched import launched
from tests.app.tiny import last_checkpoint, tiny_capture, tiny_config

pytestmark = pytest.mark.skipif(
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
def together(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("together")
    outcomes = launched([__file__, folder])
    assert [outcome.status for outcome in outcomes] == [0, 0], outcomes
    return folder


def same(ours: Path, theirs: Path) -> None:
    # all tensors, random generators and settings; not the clock
    one, other = (last_checkpoint(folder, "seconds", "metrics_bytes") for folder in (ours, theirs))
    assert list(one) == list(other)
    for name, value in one.items():
        equal = torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name]
        assert equal, name


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


def test_one_process_continues_what_two_began(together: Path) -> None:
    train(together / "left", "fast", "pop", resume=True)
    same(together / "left", together / "pop")


def test_sums_do_not_depend_on_who_adds(together: Path) -> None:
    alone = ALONE.total(torch.tensor([1e8, 1.0, -1e8]) * (place + 1.0) / 3.0 for place in range(SIZE))
    for rank in (0, 1):
        assert torch.equal(torch.load(together / f"total_{rank}.pt"), alone)


def test_a_process_whose_fellow_has_ended_says_so(together: Path) -> None:
    told = (together / "lost").read_text()
    assert told.startswith("process 1 of 2 lost the others: one of them has ended, and its own message says why")


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


def test_views_that_cannot_be_shared_evenly_are_refused() -> None:
    assert Three().positions(6) == range(2, 4)
    with pytest.raises(PopError, match=r"batch_size is 4; 3 processes share .* use --batch-size 3 or a multiple"):
        check_batch(tiny_config("x", batch_size=4), True, Three())


def test_a_process_that_nobody_launched_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    assert join() is ALONE
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert join() is ALONE


if __name__ == "__main__":
    train_all(Path(sys.argv[1]))
