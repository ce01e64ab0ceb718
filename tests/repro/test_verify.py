"""`pop-repro verify`: a result comes out again at its commit, and one that was altered does not."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from paper_repro.cli import main
from paper_repro.jobs import job_named
from paper_repro.record import Result
from paper_repro.results import RESULTS, SCALES, find, read_all, write
from paper_repro.train_row import commit
from paper_repro.verify import history, other_kind
from tests.repro.made import PLAIN, demo

FOUND = [result for scale in SCALES for result in read_all(scale, RESULTS)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with the result of POP at toy scale, trained by the command at the commit that is checked out."""
    here = commit()
    if here is None or here.endswith("-dirty"):
        pytest.skip("a result is verified at its commit, and this folder is not a clone without changes")
    folder = tmp_path_factory.mktemp("verify")
    shutil.copytree(demo(), folder / "work" / "demo")
    words = ["run", "pop", "demo", "--scale", "toy", "--results", str(folder / "results")]
    assert main([*words, "--work", str(folder / "work")]) == 0
    return folder


def verify(folder: Path, work: Path, *words: str) -> int:
    # a relative folder, since git and the training are run in others
    where = ["--results", str(folder / "results"), "--work", os.path.relpath(work)]
    return main(["verify", "pop", "demo", "--scale", "toy", *where, *words])


def test_a_result_comes_out_again_to_the_last_bit_on_the_same_machine(trained, tmp_path, capsys):
    assert verify(trained, tmp_path) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[-1] == "confirmed: all of it is equal"
    assert "300 steps were trained again; compared 45 points of the curve, the held-out views and the Gaus" in told[-2]
    # the clone and what was trained in it are gone
    assert not [path for path in (tmp_path / "verify").rglob("*") if path.is_file()]


def altered(folder: Path, to: Path, **changes) -> Result:
    """Write the folder's result with changes to another one; the result agrees with itself all the same."""
    result = find("toy", "pop", "demo", 42, folder / "results")
    assert result is not None
    write(replace(result, **changes), to / "results")
    return result


def test_a_result_that_was_altered_and_agrees_with_itself_is_not_confirmed(trained, tmp_path, capsys):
    curve = list(find("toy", "pop", "demo", 42, trained / "results").curve)
    was = curve[1]["psnr"]
    curve[1] = {**curve[1], "psnr": was + 0.1}
    altered(trained, tmp_path, curve=tuple(curve))
    assert verify(tmp_path, tmp_path / "work", "--steps", "40") == 1
    told = capsys.readouterr().out
    assert "NOT confirmed: 1 values differ" in told
    assert f"step 10: psnr is {was}, and the result has {was + 0.1}" in told


def test_another_kind_of_machine_is_held_to_the_tolerances(trained, tmp_path, capsys):
    curve = [{**point, "psnr": 1.0} for point in find("toy", "pop", "demo", 42, trained / "results").curve]
    altered(trained, tmp_path, cpu="another kind", curve=tuple(curve))
    assert verify(tmp_path, tmp_path / "work", "--steps", "40") == 0
    told = capsys.readouterr().out
    assert "another kind of machine: kind of processor is " in told
    assert "within 0.05 of num_gaussians, 0.3 of psnr_test, 0.01 of ssim" in told
    assert told.endswith("confirmed\n")


@pytest.mark.parametrize(
    ("named", "says"),
    [
        ("0" * 40, "commit 0000000000000000000000000000000000000000 is not in "),
        ("abcdef1-dirty", "its commit is abcdef1-dirty, which is no commit; train it again in a clean clone"),
        (None, "its commit is None, which is no commit"),
    ],
)
def test_a_result_whose_commit_is_not_there_is_refused(named, says, tmp_path, capsys):
    if history() is None and named is not None and "dirty" not in named:
        pytest.skip("this folder is not a clone with its history")
    write(replace(PLAIN, commit=named), tmp_path)
    assert main(["verify", "pop", "fox", "--scale", PLAIN.scale, "--results", str(tmp_path)]) == 2
    assert says in capsys.readouterr().err


def test_what_has_no_result_is_refused(tmp_path, capsys):
    assert main(["verify", "pop", "demo", "--scale", "toy", "--results", str(tmp_path)]) == 2
    assert "pop.jsonl: has no result of demo, seed 42, to verify" in capsys.readouterr().err


def test_a_machine_of_the_same_kind_differs_in_nothing():
    assert other_kind(replace(PLAIN, machine="x", cpu=None, versions={}))[0].startswith("processor is ")
    assert [words.split()[0] for words in other_kind(replace(PLAIN, versions={"torch": "0.1"}))][-1] == "torch"


@pytest.mark.parametrize("result", FOUND, ids=lambda r: f"{r.scale}-{r.row}-{r.scene}-{r.seed}")
def test_every_committed_result_names_a_commit_of_this_branch(result: Result):
    commits = history()
    if commits is None:
        pytest.skip("this folder is not a clone with its history")
    assert result.commit in commits, (
        f"{result.row} {result.scene}: {result.commit} is not in this branch; train it again"
    )


@pytest.mark.parametrize("result", FOUND, ids=lambda r: f"{r.scale}-{r.row}-{r.scene}-{r.seed}")
def test_every_committed_result_was_trained_as_its_row_is_now(result: Result):
    from paper_repro.collect import first_change

    job = job_named(result.row, result.scene, result.scale, result.seed)
    assert first_change(result, job.config()) is None


def test_a_finished_row_is_told_and_what_trains_it_again(trained, capsys, tmp_path):
    words = ["run", "pop", "demo", "--scale", "toy", "--results", str(trained / "results"), "--work", str(tmp_path)]
    assert main(words) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("pop demo --scale toy --seed 42 is finished: ")
    assert told[0].endswith(f"trained at commit {commit()[:7]}; --again trains it again")
    assert told[1] == str(trained / "results" / "toy" / "pop.jsonl")
    assert not list(tmp_path.iterdir())
