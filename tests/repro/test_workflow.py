"""The Snakemake workflow: what it would do at each scale, that it runs, and that its Slurm profile is read."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from paper_repro.jobs import jobs_of, trainable
from paper_repro.paper import paper
from paper_repro.results import read_all

ROOT = Path(__file__).parents[2]
SNAKEFILE = ROOT / "paper_repro" / "Snakefile"

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("snakemake") is None,
    reason="snakemake is not installed; pip install 'pop-splatting[repro]' brings it",
)


def workflow(folder: Path, *words: str, profile: Path | None = None, **config: object) -> str:
    """Run the workflow in a folder and return what it printed."""
    settings = {"results": folder / "results", "work": folder / "work", "data": folder, "out": folder / "out", **config}
    chosen = [] if profile is None else ["--profile", str(profile)]
    command = [sys.executable, "-m", "snakemake", "-s", str(SNAKEFILE), *chosen, *words, "--config"]
    command += [f"{name}={value}" for name, value in settings.items()]
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache")}
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def rules(printed: str) -> dict[str, int]:
    """Read the table of jobs that a dry run prints."""
    return {name: int(count) for name, count in re.findall(r"^(\w+) +(\d+)$", printed, re.MULTILINE)}


@pytest.mark.parametrize("scale", ["toy", "small", "paper"])
def test_there_is_one_rule_for_each_row_scene_and_seed_and_one_for_each_table_and_figure(tmp_path, scale):
    planned = rules(workflow(tmp_path, "-n", scale=scale, seeds=2))
    jobs = [job for job in jobs_of(scale, seeds=(42, 43)) if trainable(job)]
    # all of them are planned, since the claims are judged by rows beyond the paper and of other readings too
    needed = {f"train_{job.row.name}_{job.scene.name}_{job.seed}" for job in jobs}
    figures = {f"figure_{figure}" for job in jobs for figure in job.row.figures} | {"figure_3"}
    tables = {f"table_{table.number}" for table in paper().tables} | {"table_beyond"}
    assert set(planned) == needed | figures | tables | {"claims", "all", "total"}
    assert set(planned.values()) == {1, len(planned) - 1}


def test_the_cheapest_row_has_the_highest_priority_and_a_gpu_is_asked_for_at_the_papers_scale(tmp_path):
    printed = workflow(tmp_path, "-n", "rows", scale="paper")
    priority = {
        name: int(found) for name, found in re.findall(r"rule (train_\w+):.*?priority: (\d+)", printed, re.DOTALL)
    }
    jobs = [job for job in jobs_of("paper") if trainable(job)]
    assert len(priority) == len(jobs)
    ranked = sorted(priority, key=lambda name: -priority[name])
    assert ranked == [f"train_{job.row.name}_{job.scene.name}_{job.seed}" for job in jobs]
    assert printed.count("gpu=1") == len(jobs)
    assert "gpu=1" not in workflow(tmp_path, "-n", "rows", scale="small")


def test_the_slurm_profile_is_read(tmp_path):
    pytest.importorskip("snakemake_executor_plugin_slurm", reason="snakemake-executor-plugin-slurm is not installed")
    printed = workflow(tmp_path, "-n", profile=ROOT / "paper_repro" / "profiles" / "slurm", scale="paper")
    assert rules(printed)["train_pop_garden_42"] == 1


def test_rows_are_trained_and_finished_ones_are_left_alone(tmp_path):
    workflow(tmp_path, "-j", "1", "rows", scale="toy", rows="l1_div_100,l2_pop")
    found = read_all("toy", tmp_path / "results")
    assert [result.row for result in found] == ["l1_div_100", "l2_pop"]
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "results").rglob("*.jsonl")}
    assert "Nothing to be done" in workflow(tmp_path, "-j", "1", "rows", scale="toy", rows="l1_div_100,l2_pop")
    # another machine has no memory of this one's runs, and its settings are other words
    (tmp_path / ".snakemake").rename(tmp_path / "forgotten")
    assert "Nothing to be done" in workflow(
        tmp_path, "-j", "1", "rows", scale="toy", rows="l1_div_100,l2_pop", threads=2
    )
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "results").rglob("*.jsonl")} == before


def test_tables_are_made_of_what_is_there(tmp_path):
    workflow(tmp_path, "-j", "1", str(tmp_path / "out" / "toy" / "table_3.md"), scale="toy", rows="l1_div_100")
    assert {path.name for path in (tmp_path / "out" / "toy").iterdir()} == {"table_3.md", "table_3.tex", "table_3.csv"}
    assert "not run" in (tmp_path / "out" / "toy" / "table_3.md").read_text()
