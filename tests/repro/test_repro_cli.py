"""`pop-repro`: quick help, errors that name the fix, a queue that stops and continues, the Snakemake workflow."""

from __future__ import annotations

import importlib.util
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from paper_repro import queue as repro_queue
from paper_repro import results
from paper_repro.cli import COMMANDS, main
from paper_repro.jobs import ROWS, WORK, job_named, jobs_of, load_row, trainable
from paper_repro.paper import paper
from paper_repro.results import read_all
from tests.app.conftest import wait_until

ROOT = Path(__file__).parents[2]
HEAVY = ("torch", "scipy", "cv2", "matplotlib", "pycolmap", "tyro", "snakemake")


def call(*words: object, status: int = 0, capsys: pytest.CaptureFixture[str]) -> str:
    """Call it here and return what it printed, on both streams."""
    assert main([str(word) for word in words]) == status
    printed = capsys.readouterr()
    return printed.out + printed.err


def test_help_names_every_command_and_is_the_answer_to_nothing(capsys):
    text = call("--help", capsys=capsys)
    assert all(f"  {command} " in text for command in COMMANDS)
    assert call(capsys=capsys) == call("help", capsys=capsys) == text
    assert call("help", "run", capsys=capsys).startswith("usage: pop-repro run ")
    assert call("--version", capsys=capsys).startswith("pop-repro 0.")


@pytest.mark.parametrize("command", [*COMMANDS, ""])
def test_help_loads_nothing_heavy(command):
    script = (
        "import sys; from paper_repro.cli import main; status = main(sys.argv[1:])\n"
        f"loaded = [name for name in {HEAVY!r} if name in sys.modules]; assert not loaded, loaded; sys.exit(status)"
    )
    words = [sys.executable, "-c", script, *command.split(), "--help"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "usage: pop-repro" in done.stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["rum"], "'rum' is not a subcommand; did you mean 'pop-repro run'?"),
        (["xyz"], "'xyz' is not a subcommand; see 'pop-repro --help'"),
        (["data"], "'data' is not a subcommand; did you mean 'pop-repro data check'?"),
        (["run", "pops", "fox"], "row is 'pops'; it must be one of 3dgs, 3dgs_2023"),
        (["run", "pop", "garden", "--scale", "small"], "scale 'small' has no garden; its scenes are fox, "),
        (["run", "pop", "fox", "--scale", "tiny"], "argument --scale: invalid choice: 'tiny'"),
        (
            ["run", "pop", "fox", "--data", "nowhere", "--results", "results"],
            "nowhere: no such folder; name the one that holds the scenes with",
        ),
        (["run", "pop"], "the following arguments are required: SCENE"),
        (["table", "6"], "argument N: invalid choice: '6'"),
        (["queue", "--rows", "pops"], "row is 'pops'; it must be one of"),
        (["queue", "--check", "--seeds", "0"], "argument --seeds: is '0'; it must be a whole number of at least 1"),
        (["status", "--seeds", "-1"], "argument --seeds: is '-1'; it must be a whole number of at least 1"),
        (["queue", "--threads", "-1"], "argument --threads: is '-1'; it must be a whole number of at least 0"),
        (["queue", "--log-every", "0"], "argument --log-every: is '0'; it must be a whole number of at least 1"),
        (["run", "pop", "demo", "--checkpoint-every", "9" * 20], "it must be a whole number of at least 0, under 10^9"),
        (["queue", "--nice", "9" * 20], "argument --nice: is '99999999999999999999'; it must be a whole number"),
        (["queue", "--list", "--check"], "argument --check: not allowed with argument --list"),
        (
            ["run", "pop", "demo", "--scale", "toy", "--results", "/proc/x", "--work", "work"],
            "/proc/x/toy: cannot be written to (No such file or directory); choose another folder",
        ),
        (["data", "check", "--scenes", "moon"], "scene is 'moon'; it must be one of bicycle, "),
    ],
)
def test_a_mistake_is_one_line_that_names_the_fix(words, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = call(*words, status=2, capsys=capsys)
    assert says in text
    assert "Traceback" not in text
    assert not (tmp_path / "results").exists()
    assert not (tmp_path / "work" / "toy").exists()


def test_an_installed_package_keeps_nothing_between_its_own_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert results.home(tmp_path / "site-packages" / "paper_repro") == tmp_path / "paper_repro"
    assert results.home(ROOT / "paper_repro") == ROOT / "paper_repro" == results.RESULTS.parent == WORK.parent


def test_a_row_that_this_version_lacks_has_its_own_status(capsys, tmp_path, monkeypatch):
    from pop_fast.train import presets

    monkeypatch.setattr(presets, "METHODS", {"pop": presets.METHODS["pop"]})
    words = ["run", "gsplat", "demo", "--scale", "toy", "--work", tmp_path, "--results", tmp_path]
    assert "has no method 'gsplat'; it has pop" in call(*words, status=69, capsys=capsys)


def test_data_check_names_what_is_absent_and_its_source(capsys, tmp_path):
    text = call("data", "check", "--data", tmp_path, status=1, capsys=capsys)
    assert "  drjohnson, playroom: from https://repo-sam.inria.fr/" in text
    assert text.count("missing") == 17


def test_a_queue_lists_what_is_missing_cheapest_first(capsys, tmp_path):
    words = ["queue", "--scale", "small", "--results", tmp_path, "--list"]
    lines = call(*words, "--seeds", "2", capsys=capsys).splitlines()
    assert len(lines) == 2 * 4 * len(ROWS)
    assert lines[0].split()[1] in ("bear_512", "garden_512")
    # a row that is named twice is trained and counted once
    chosen = call(*words, "--rows", "gsplat", "pop", "gsplat", "--scenes", "fox", capsys=capsys).splitlines()
    assert chosen == ["pop fox --scale small --seed 42", "gsplat fox --scale small --seed 42"]


def test_a_row_that_was_killed_is_named_at_once(capsys, tmp_path, monkeypatch):
    killed = tmp_path / "python"
    killed.write_text("#!/bin/sh\nkill -9 $$\n")
    killed.chmod(0o755)
    monkeypatch.setattr(repro_queue.sys, "executable", str(killed))
    words = ["--scale", "toy", "--rows", "l2_pop", "l1_div_100", "--results", tmp_path, "--work", tmp_path]
    told = call("queue", *words, status=1, capsys=capsys).splitlines()
    name = "l1_div_100 demo --scale toy --seed 42"
    said = "was killed by SIGKILL; the queue continues with it when it is run again"
    assert told[1:3] == [f"[1/2] {name}", f"[1/2] {name} {said}"]
    assert told[3].startswith("[2/2] ")


@pytest.mark.parametrize("command", ["status", "table 1", "figure 7", "claims", "verify pop fox"])
def test_a_folder_of_results_that_is_not_there_is_one_error(command, capsys, tmp_path):
    text = call(*command.split(), "--results", tmp_path / "typo", status=2, capsys=capsys)
    assert text == (
        f"pop-repro: error: {tmp_path / 'typo'}: no such folder; name the one that holds the results with --results\n"
    )


def test_the_papers_scale_begins_with_its_hours_and_what_is_lacking(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(repro_queue.subprocess, "Popen", lambda *_, **__: pytest.fail("trained"))
    words = ["queue", "--scale", "paper", "--rows", "pop", "3dgs", "l1_div_2", "--scenes", "train", "truck", "playroom"]
    where = ["--results", tmp_path, "--work", tmp_path / "work", "--data", tmp_path, "--backend", "cuda"]
    told = call(*words, *where, status=1, capsys=capsys).splitlines()
    assert told[0] == "9 trainings to go"
    taken = {line.split()[0]: float(line.split()[1]) for line in told[1:4]}
    tanks, blending = paper().table(2), paper().table(1)
    seconds = {
        row: 2 * tanks.value(row, "Tanks & Temples", "time_s") + blending.value(row, "Deep Blending", "time_s")
        for row in ("pop", "3dgs")
    }
    # the paper prints no time of it
    seconds["l1_div_2"] = seconds["pop"] * load_row("l1_div_2").cost
    assert taken == {row: pytest.approx(due / 3600, abs=0.05) for row, due in seconds.items()}
    assert told[4].startswith(f"{sum(seconds.values()) / 3600:.1f} hours of one RTX 4090 in all")
    assert "less for" not in told[4]
    total = repro_queue.hours_by_row([job_named("pup", "train", "paper")])[-1]
    assert "; less for pup, where the row that they begin from is finished" in total
    every = repro_queue.hours_by_row(jobs_of("paper"))[-1]
    said = f"({float(every.split()[0]):.0f} for all rows on all thirteen scenes)"
    assert said in (Path(results.__file__).parent / "README.md").read_text(encoding="utf-8")
    assert told[5] == "lacking:"
    assert {line.split(" is ")[0] for line in told[6:9]} == {f"  data: {s}" for s in ("train", "truck", "playroom")}
    assert "it comes from https://repo-sam.inria.fr/" in told[6]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("shutil.disk_usage", lambda _: SimpleNamespace(free=10**6)), "disk: 1 trainings leave up to "),
        (("pop_fast.machine.free_bytes", lambda: 10**9), "memory: pop on demo takes about "),
    ],
)
def test_a_check_names_what_the_machine_lacks(change, says, capsys, tmp_path, monkeypatch):
    where = ["--scale", "toy", "--rows", "pop", "--results", tmp_path, "--work", tmp_path / "work", "--check"]
    told = call("queue", *where, capsys=capsys).splitlines()
    assert told == ["1 trainings to go", "nothing is lacking"]
    monkeypatch.setattr(*change)
    told = call("queue", *where, status=1, capsys=capsys).splitlines()
    assert told[1] == "lacking:"
    assert told[2].startswith(f"  {says}")
    assert not (tmp_path / "work").exists()


@pytest.fixture(scope="module")
def queued(tmp_path_factory):
    """A queue of two toy rows that is stopped by SIGHUP in the first, then called again, with --commit, to the end."""
    folder = tmp_path_factory.mktemp("queue")
    new_repository(folder)
    (folder / "other.txt").write_text("not to be committed")
    git(folder, "add", "other.txt")
    words = ["--scale", "toy", "--rows", "l2_pop", "l1_div_100", "--results", "results", "--work", "work"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    # whoever runs the tests without a terminal may have hangups ignored, which children inherit
    heeding = "import runpy, signal; signal.signal(signal.SIGHUP, signal.SIG_DFL); runpy.run_module('paper_repro')"
    command = [sys.executable, "-c", heeding, "queue", *words, "--checkpoint-every", "50"]
    how = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "cwd": folder, "env": environment}
    process = subprocess.Popen(command, **how)
    metrics = folder / "work" / "toy" / "l1_div_100" / "demo_42" / "metrics.jsonl"
    wait_until(lambda: metrics.is_file() and metrics.stat().st_size > 0, process)
    process.send_signal(signal.SIGHUP)
    stopped = process.communicate(timeout=120)[0], process.returncode
    left = sorted(path.parent.name for path in folder.rglob("ckpts/*.pt"))
    done = subprocess.run([*command, "--commit"], **how)
    return folder, [stopped, (done.stdout, done.returncode)], left


@pytest.mark.slow  # a queue that trains
def test_a_queue_stops_with_a_checkpoint_when_its_terminal_is_closed(queued):
    _, ((text, status), _), left = queued
    assert status == 130
    assert "0 of 2 rows are done; 2 to go" in text
    assert text.splitlines()[-1] == "stopped; the same command continues"
    assert left


@pytest.mark.slow  # a queue that trains
def test_a_queue_that_is_called_again_goes_on_to_the_end(queued):
    folder, (_, (text, status)), _ = queued
    assert status == 0, text
    assert [result.row for result in read_all("toy", folder / "results")] == ["l1_div_100", "l2_pop"]
    assert "with which the run was begun" in text
    assert text.splitlines()[-1] == "2 rows trained"


@pytest.mark.slow  # a queue that trains
def test_status_counts_what_is_done_and_begun(queued, capsys, tmp_path):
    folder = queued[0]
    where = ["--results", folder / "results", "--work", tmp_path]
    text = call("status", "--scale", "toy", "--rows", "l1_div_100", "l2", "l2_pop", *where, capsys=capsys)
    assert text.split("\n")[1:4] == ["l2          to do", "l2_pop      done", "l1_div_100  done"]
    assert "2 of 3 done" in text
    checkpoint = tmp_path / "toy" / "l2" / "demo_42" / "ckpts" / "ckpt_149_rank0.pt"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.touch()
    text = call("status", "--scale", "toy", "--rows", "l2_pop", "l2", "--seeds", "2", *where, capsys=capsys)
    assert "1 done, to do" in text
    assert "step 150, to do" in text


@pytest.mark.slow  # a queue that trains
def test_a_table_is_printed_or_written_in_three_formats(queued, capsys, tmp_path):
    where = ["--scale", "toy", "--results", queued[0] / "results"]
    printed = call("table", "3", *where, capsys=capsys)
    assert "L2 + POP" in printed
    call("table", "3", *where, "--out", tmp_path, capsys=capsys)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["table_3.csv", "table_3.md", "table_3.tex"]
    assert (tmp_path / "table_3.md").read_text().strip() == printed.strip()


@pytest.mark.slow  # a queue that trains
def test_claims_are_judged(queued, capsys):
    assert "claim" in call("claims", "--scale", "toy", "--results", queued[0] / "results", capsys=capsys)


def git(folder, *words):
    return subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=True).stdout


def new_repository(folder):
    for words in (["init", "-q"], ["config", "user.name", "a"], ["config", "user.email", "a@b"]):
        git(folder, *words)


@pytest.mark.slow  # a queue that trains
def test_results_are_committed_where_that_is_asked_for(queued):
    committed = {
        git(queued[0], "show", "--format=%s", "--name-only", place).replace("\n\n", "\n").strip()
        for place in ("HEAD", "HEAD~1")
    }
    assert committed == {
        f"Result: {row} on demo, toy scale, seed 42\nresults/toy/{row}.jsonl" for row in ("l1_div_100", "l2_pop")
    }


def test_pages_made_from_the_packages_results_are_committed_with_them_unless_somebody_edits_them(tmp_path, monkeypatch):
    new_repository(tmp_path)
    job = job_named("pop", "demo", "toy", 42)
    results, pages = tmp_path / "results", [tmp_path / name for name in ("claims.md", "protocol.md")]
    for page in pages:
        page.write_text("old")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "pages")
    pages[1].write_text("being edited")
    path = job.file(results)
    path.parent.mkdir(parents=True)
    path.write_text("{}")
    monkeypatch.setattr(repro_queue, "RESULTS", results)
    monkeypatch.setattr(repro_queue, "stale_files", lambda found: dict.fromkeys(pages, "new"))
    repro_queue._commit(job, results)
    assert set(git(tmp_path, "show", "--format=", "--name-only").split()) == {
        "claims.md", "results/toy/pop.jsonl",
    }  # fmt: skip
    assert [page.read_text() for page in pages] == ["new", "being edited"]
    # elsewhere than in the package's own folder nothing but the result
    pages[0].write_text("old")
    git(tmp_path, "commit", "-q", "-m", "old again", "--", "claims.md")
    path.write_text("{ }")
    monkeypatch.setattr(repro_queue, "RESULTS", tmp_path)
    repro_queue._commit(job, results)
    assert git(tmp_path, "show", "--format=", "--name-only").split() == ["results/toy/pop.jsonl"]


SNAKEFILE = ROOT / "paper_repro" / "Snakefile"

needs_snakemake = pytest.mark.skipif(
    importlib.util.find_spec("snakemake") is None,
    reason="snakemake is not installed; pip install 'pop-splatting[repro]' brings it",
)


def workflow(folder: Path, *words: str, profile: Path | None = None, **config: object) -> str:
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


@needs_snakemake
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


@needs_snakemake
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


@needs_snakemake
def test_the_slurm_profile_is_read(tmp_path):
    pytest.importorskip("snakemake_executor_plugin_slurm", reason="snakemake-executor-plugin-slurm is not installed")
    printed = workflow(tmp_path, "-n", profile=ROOT / "paper_repro" / "profiles" / "slurm", scale="paper")
    assert rules(printed)["train_pop_garden_42"] == 1


@needs_snakemake
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


@needs_snakemake
def test_tables_are_made_of_what_is_there(tmp_path):
    workflow(tmp_path, "-j", "1", str(tmp_path / "out" / "toy" / "table_3.md"), scale="toy", rows="l1_div_100")
    assert {path.name for path in (tmp_path / "out" / "toy").iterdir()} == {"table_3.md", "table_3.tex", "table_3.csv"}
    assert "not run" in (tmp_path / "out" / "toy" / "table_3.md").read_text()
