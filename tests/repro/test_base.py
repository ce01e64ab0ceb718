"""Rows that begin where another one has got to: the same bits as alone, and only where that is so."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest

from paper_repro import train_row as module
from paper_repro.base import base_of, steps_for_others
from paper_repro.jobs import jobs_of
from paper_repro.results import write
from paper_repro.rows import load_rows
from paper_repro.train_row import train_row
from pop_fast.train import TrainingRun
from tests.app.interruptions import interrupt
from tests.repro.trained import options, toy, values

# of a hundredth of the schedule, another tenth or two less
SHORT = {"steps_scaler": 0.004}


@pytest.mark.parametrize(
    ("row", "base", "shared", "stop"),
    [("pup", "3dgs_2023", 120, 140), ("mini_splatting_star", "mini_splatting", 60, 90)],
)
def test_a_row_that_begins_from_its_base_comes_to_what_it_comes_to_alone(
    row, base, shared, stop, tmp_path, monkeypatch
):
    job, of_base = toy(row, **SHORT), toy(base, **SHORT)
    alone = train_row(job, options(tmp_path / "alone"))
    assert "base" not in alone.protocol
    how = options(tmp_path / "after")
    first = train_row(of_base, how)
    kept = of_base.work(how.work) / "base" / f"ckpt_{shared - 1}_rank0.pt"
    assert [path.name for path in kept.parent.iterdir()] == [kept.name]
    assert not (of_base.work(how.work) / "ckpts").exists()

    steps, take = [], TrainingRun.take_steps
    monkeypatch.setattr(TrainingRun, "take_steps", lambda run, last: steps.append(run.step) or take(run, last))
    with monkeypatch.context() as patch:
        interrupt(patch, at=stop)
        with pytest.raises(KeyboardInterrupt):
            train_row(job, how)
    assert kept.is_file()
    after = train_row(job, how)
    assert min(steps) == shared

    assert after.protocol == {**alone.protocol, "base": first.run}
    # held-out views are measured at every fifteenth of the base's steps, and then of one's own
    differ = {name for name, value in values(after).items() if value != values(alone)[name]}
    assert differ <= {"protocol", "curve"}
    counts, others = ({p["step"]: p["num_gaussians"] for p in result.curve} for result in (after, alone))
    both = counts.keys() & others.keys()
    assert len(both) >= 12
    assert all(counts[step] == others[step] for step in both)
    # the time of the shared steps is in its own
    assert sum(point["seconds"] is not None for point in after.curve if point["step"] < shared) >= shared // 10
    assert after.seconds["train"] > after.at(shared - 10, "seconds") > 0.0


def test_a_checkpoint_stays_as_long_as_a_row_waits_for_it(tmp_path):
    how, job = options(tmp_path), toy("pup", steps_scaler=0.001)
    of_base = base_of(job)
    train_row(of_base, how)
    kept = of_base.work(how.work) / "base"
    done = train_row(job, how)
    assert kept.is_dir()
    write(replace(done, row="pup_star"), how.results)
    module._remove_bulk(job, how)
    assert not kept.exists()


@pytest.mark.parametrize("change", [{"threads": 2}, {"log_every": 7}], ids=["threads", "settings"])
def test_a_base_of_another_kind_is_not_begun_from(change, tmp_path):
    how, job = options(tmp_path, keep_checkpoints=True), toy("pup", steps_scaler=0.001)
    train_row(base_of(job), how)
    assert "base" not in train_row(job, replace(how, **change)).protocol
    job.file(how.results).unlink()
    shutil.rmtree(job.work(how.work))
    assert "base" in train_row(job, how).protocol


@pytest.mark.parametrize("scale", ["toy", "small", "full", "paper"])
def test_every_row_that_names_a_base_shares_steps_with_it_on_every_scene(scale):
    named = [row for row in load_rows() if row.base is not None]
    assert {row.name for row in named} == {"pup", "pup_star", "mini_splatting_star"}
    for job in jobs_of(scale, [row.name for row in named]):
        plan = job.config().strategy
        parts = plan.rounds_start_iter if job.row.method == "pup" else plan.sample_iter
        assert steps_for_others(base_of(job)) == (parts,)
