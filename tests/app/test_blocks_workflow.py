"""The Snakemake workflow of a run in blocks: what it would do, that it does it, and that the Slurm profile is read."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from pop_fast.blocks import jobs
from pop_fast.blocks.plan import read_job
from pop_fast.cli import main
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import says

pytestmark = pytest.mark.skipif(
    not jobs.has_snakemake(), reason="snakemake is not installed; pip install 'pop-splatting[blocks]' brings it"
)
BLOCKS = ("--blocks", "2x1", "--blocks-rounds", "0", *TRAIN, "--skip-sizes", "--threads", "1")


@pytest.fixture(scope="module")
def begun(shared_capture: Path, made_once: Callable[..., Path]) -> Path:
    """A run whose capture is divided, and whose blocks are not trained."""

    def make(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(jobs, "_run", lambda words, quiet: 0)
            assert main(["train", str(shared_capture), "--out", str(folder / "toy"), *BLOCKS]) == 0

    return made_once("workflow", make) / "toy"


def planned(folder: Path, tmp_path: Path, *words: str, profile: Path | None = None) -> str:
    """Ask the workflow what it would do."""
    job = read_job(folder)
    assert job is not None
    command = jobs.workflow_words(folder, job, 1, 1, "compiled", profile, "-n", *words)
    environment = {**os.environ, "HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def dry_run(folder: Path, tmp_path: Path, *words: str, profile: Path | None = None) -> dict[str, int]:
    """Ask the workflow what it would do, and read the table of jobs that it prints."""
    said = planned(folder, tmp_path, *words, profile=profile)
    return {name: int(count) for name, count in re.findall(r"^(\w+) +(\d+)$", said, re.MULTILINE)}


TRAININGS = {"block_0_0": 1, "block_1_0": 1}


def test_there_is_one_job_for_each_block_and_then_the_merge(begun, tmp_path):
    assert dry_run(begun, tmp_path) == {"all": 1, **TRAININGS, "merge": 1, "total": 4}


def test_a_capture_that_is_not_divided_is_divided_first(begun, tmp_path):
    folder = Path(shutil.copytree(begun, tmp_path / "copy"))
    (folder / "blocks" / "plan.json").unlink()
    assert dry_run(folder, tmp_path) == {"all": 1, "partition": 1, **TRAININGS, "merge": 1, "total": 5}


def test_a_block_that_is_trained_is_left_alone(begun, tmp_path):
    folder = Path(shutil.copytree(begun, tmp_path / "copy"))
    (folder / "blocks" / "0_0" / "trained").touch()
    assert dry_run(folder, tmp_path) == {"all": 1, "block_1_0": 1, "merge": 1, "total": 3}


def with_rounds(folder: Path, rounds: int) -> Path:
    """Let a run have rounds, as `pop train --blocks-rounds` does with one that is resumed."""
    path = folder / "blocks" / "job.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "rounds": rounds, "round_steps": 3}))
    return folder


def test_a_round_waits_for_the_merge_before_it_and_its_merge_for_all_its_blocks(begun, tmp_path):
    folder = with_rounds(Path(shutil.copytree(begun, tmp_path / "copy")), 2)
    said = planned(folder, tmp_path)
    order = re.findall(r"^(?:local)?rule (\w+):", said, re.MULTILINE)
    waves = [
        {"block_0_0", "block_1_0"},
        {"round_0_merge"},
        {"round_1_block_0_0", "round_1_block_1_0"},
        {"round_1_merge"},
        {"round_2_block_0_0", "round_2_block_1_0"},
        {"merge"},
        {"all"},
    ]
    starts = [sum(map(len, waves[:index])) for index in range(len(waves))]
    assert [set(order[first : first + len(wave)]) for first, wave in zip(starts, waves, strict=True)] == waves
    assert len(order) == sum(map(len, waves))


def test_rounds_that_are_added_to_a_run_do_its_merge_again_and_divide_and_train_nothing_anew(begun, tmp_path):
    folder = Path(shutil.copytree(begun, tmp_path / "copy"))
    for name in ("0_0", "1_0"):
        (folder / "blocks" / name / "trained").touch()
    found = dry_run(with_rounds(folder, 1), tmp_path)
    rounds = {"round_0_merge": 1, "round_1_block_0_0": 1, "round_1_block_1_0": 1}
    assert found == {"all": 1, **rounds, "merge": 1, "total": 5}


def test_the_slurm_profile_is_read(begun, tmp_path):
    pytest.importorskip("snakemake_executor_plugin_slurm", reason="snakemake-executor-plugin-slurm is not installed")
    found = dry_run(begun, tmp_path, profile=jobs.profile_folder("slurm"))
    assert found == {"all": 1, **TRAININGS, "merge": 1, "total": 4}


def test_a_profile_that_is_none_is_refused(pop: Pop, shared_capture, tmp_path):
    says(
        pop("train", shared_capture, "--out", tmp_path / "out", *BLOCKS, "--blocks-profile", "nowhere"),
        "is neither one of slurm nor a folder with a config.yaml",
    )


@pytest.mark.slow
def test_the_workflow_trains_and_merges(pop: Pop, shared_capture, begun, tmp_path):
    folder = Path(shutil.copytree(begun, tmp_path / "copy"))
    pop.done(
        "train", shared_capture, "--out", folder, *BLOCKS, "--blocks-rounds", "1", "--blocks-jobs", "2", "--resume"
    )
    assert (folder / "blocks" / "merged").is_file()
    assert len(json.loads((folder / "stats" / "val_step0029.json").read_text())["rounds"]) == 2
    again = pop.done("train", shared_capture, "--out", folder, *BLOCKS, "--blocks-rounds", "1", "--resume")
    assert "are trained and merged" in again.out
