"""A result survives its file, and one that is damaged or does not agree with itself is told by file, line and field.

By `pop-repro verify` it comes out again at its commit, and one that was altered does not.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from paper_repro import verify as repro_verify
from paper_repro.cli import main
from paper_repro.jobs import job_named
from paper_repro.results import RESULTS, SCALES, Result, find, kept, read, read_all, to_line, write
from paper_repro.scenes import SCENES
from paper_repro.train_row import commit
from paper_repro.verify import history, other_kind
from pop_fast.api.backend import get_backend
from pop_fast.errors import PopError
from tests.repro.made import PLAIN, curve, demo, result

ROOT = Path(__file__).parents[2]
STEPS = {"psnr": [None, 20.5], "n_blended": [None, 3.5]}


def test_a_result_is_read_as_it_was_written(tmp_path: Path) -> None:
    told = result(
        curve=curve({0: 1000, 9_999: 1000}, **STEPS), lpips={"vgg_01": 0.2, "alex_norm": None, "alex_01": None}
    )
    path = write(told, tmp_path)
    assert path == tmp_path / "small" / "pop.jsonl"
    assert read(path) == (told,)
    assert find("small", "pop", "fox", 42, tmp_path) == told
    assert find("small", "pop", "fox", 43, tmp_path) is None
    assert path.read_text(encoding="utf-8").count("\n") == 1


def test_results_of_one_scale_are_found_in_order(tmp_path: Path) -> None:
    told = [result("pop", "fox", 43), result("l2", "fox"), result("pop", "bonsai_800"), result("pop", "fox", 7)]
    for one in (*told, replace(PLAIN, scale="toy")):
        write(one, tmp_path)
    assert read_all("small", tmp_path) == (told[1], told[2], told[3], told[0])
    assert sorted(path.name for path in (tmp_path / "small").iterdir()) == ["l2.jsonl", "pop.jsonl"]
    assert kept("small", "pop", tmp_path) == {("fox", 7), ("fox", 43), ("bonsai_800", 42)}
    assert read_all("full", tmp_path) == ()
    with pytest.raises(PopError, match="scale is 'big'; it must be one of toy, "):
        read_all("big", tmp_path)


def test_a_result_takes_the_place_of_an_older_one_and_leaves_the_others_as_they_are(tmp_path: Path) -> None:
    path = write(result("pop", "bonsai_800"), tmp_path)
    write(result("pop", "fox"), tmp_path)
    other = path.read_text(encoding="utf-8").splitlines()[0]
    newer = result("pop", "fox", psnr=31.0)
    write(newer, tmp_path)
    assert read(path) == (result("pop", "bonsai_800"), newer)
    assert path.read_text(encoding="utf-8").splitlines()[0] == other


def test_processes_that_write_at_once_lose_no_line(tmp_path: Path) -> None:
    script = (
        "import sys; from pathlib import Path\n"
        "from paper_repro.results import write; from tests.repro.made import result\n"
        "for seed in range(int(sys.argv[2]), 40, 4): write(result('pop', 'fox', seed), Path(sys.argv[1]))"
    )
    processes = [subprocess.Popen([sys.executable, "-c", script, str(tmp_path), str(i)], cwd=ROOT) for i in range(4)]
    assert [process.wait() for process in processes] == [0] * 4
    assert [each.seed for each in read_all("small", tmp_path)] == list(range(40))


def test_lines_that_git_has_merged_are_read_in_order_and_two_of_one_run_are_refused(tmp_path: Path) -> None:
    path = write(result("pop", "fox"), tmp_path)
    first, second = path.read_text(encoding="utf-8"), to_line(result("pop", "bear_512"))
    path.write_text(f"{first}{second}\n", encoding="utf-8")
    assert [each.scene for each in read(path)] == ["bear_512", "fox"]
    path.write_text(f"{first}{second}\n{first}", encoding="utf-8")
    with pytest.raises(PopError, match=r"pop\.jsonl: lines 1 and 3 are both of fox, seed 42; remove one"):
        read(path)


def _set(field: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(found: dict[str, Any]) -> None:
        *outer, last = field.split("/")
        for name in outer:
            found = found[int(name) if isinstance(found, list) else name]
        found[last] = value

    return change


def _drop(field: str) -> Callable[[dict[str, Any]], None]:
    return lambda found: found.pop(field)


DAMAGE = [
    (_set("schema", 3), "must begin with schema 2, scale, row, scene and seed"),
    (_drop("psnr"), "psnr is absent"),
    (_set("psnrr", 1.0), "psnrr is not a field of a result"),
    (_set("psnr", "30"), 'psnr is "30"; it must be a finite number'),
    (_set("psnr", float("nan")), "psnr is NaN; it must be a finite number"),
    (_set("num_gaussians", 3.5), "num_gaussians is 3.5; it must be a whole number"),
    (_set("num_gaussians", True), "num_gaussians is true"),
    (_set("num_gaussians", 999), "opacity_histogram .* whose sum is num_gaussians, 999"),
    (_set("scale", "huge"), r"is of pop at scale huge; its place is huge/pop\.jsonl"),
    (_set("row", "POP Ours"), "must begin with schema 2"),
    (_set("row", "l2"), r"is of l2 at scale small; its place is small/l2\.jsonl"),
    (_set("run", "12345"), "run is .*twelve hex digits"),
    (_set("commit", "main"), "commit is .*a git commit or null"),
    (_set("cpu", ""), "cpu is .*a text"),
    (_set("protocol/width", 0), "protocol: width is 0; it must be a whole number of at least 1"),
    (_set("protocol/base", "pup"), 'protocol: base is "pup"; it must be twelve hex digits'),
    (_set("protocol/begun", "main"), 'protocol: begun is "main"; it must be a git commit'),
    (_set("protocol/extra", 0), "protocol: extra is not a field"),
    (_set("seconds/train", -1.0), "seconds: train is -1.0"),
    (_set("seconds/cpu", -1.0), "seconds: cpu is -1.0"),
    (_set("lpips/vgg_01", "none"), "lpips: vgg_01"),
    (_set("lpips_reason", None), "lpips_reason is null; it must be a text, since a variant"),
    (_set("opacity_below_0.1", 1.5), "opacity_below_0.1 is 1.5; it must be a finite number from 0 to 1"),
    (_set("curve", {}), r"curve is \{\}; it must be a list of tables"),
    (_set("curve/0/step", [0, 1]), r"curve\[0\] must be an object of lists of one length"),
    (_set("curve/1/step", [0]), r"curve\[1\]: step is 0; it must be a whole number of at least 1"),
    (_set("curve/1/psnr", ["x"]), r"curve\[1\]: psnr is .*a finite number"),
    (_set("curve", [{"step": [0]}]), r"curve\[0\]: num_gaussians is absent"),
    (_set("per_view/a.png", {"psnr": 30.0}), "per_view: a.png: ssim is absent"),
    (_set("ply_hash", "0"), "ply_hash is .*a SHA-256 in hex digits"),
    (_set("files/splat.spz", "0"), "files: splat.spz is .*a SHA-256 in hex digits"),
    (_set("seed", -1), "must begin with schema 2"),
]
# what was edited by hand and is still of the right type: it does not agree with the rest of the result
DISAGREEING = [
    (_set("psnr", 31.0), r"psnr is 31\.0; it must be 30\.0, by per_view"),
    (_set("ssim", 0.95), r"ssim is 0\.95; it must be 0\.9"),
    (_set("per_view/a.png/psnr", 30.5), r"psnr is 30\.0; it must be 30\.07"),
    (_set("schedule/pop.lambda_pop", 0.001), "config_hash is .*the hash of the settings in schedule"),
    (_set("schedule/max_steps", 30_000), "config_hash is .*the hash of the settings in schedule"),
    (_set("run", "0123456789ab"), "run is .*what config_hash, data_hash and seed give"),
    (_set("config_hash", "0" * 64), "config_hash is .*the hash of the settings in schedule"),
    (_set("data_hash", "0" * 64), "run is .*what config_hash, data_hash and seed give"),
    (_set("seed", 43), "run is .*what config_hash, data_hash and seed give"),
    (_set("checkpoint_mib", 0.1), r"checkpoint_mib is 0\.1; it must be 0\.2250.*, 1000 Gaussians of 236 bytes"),
    (_set("protocol/checkpoint_bytes_per_gaussian", 248), "checkpoint_mib is .*1000 Gaussians of 248 bytes"),
    (_set("protocol/test_views", 6), "protocol: test_views is 6; it must be 7, by per_view"),
    (_set("protocol/factor", 2), "protocol: factor is 2; it must be 4, by schedule"),
    (_set("opacity_below_0.1", 0.9), r"opacity_below_0\.1 is 0\.9; it must be 1\.0, by opacity_histogram"),
    (_set("opacity_above_0.9", 0.1), r"opacity_above_0\.9 is 0\.1; it must be 0\.0, by opacity_histogram"),
    (_set("curve/1/step", [9_998]), "curve is .*one that ends at step 9999, of schedule, with 1000 Gaussians"),
    (_set("curve/1/num_gaussians", [999]), "curve is .*one that ends at step 9999, of schedule, with 1000 Gaussians"),
]


@pytest.mark.parametrize(
    ("change", "message"), [*DAMAGE, *DISAGREEING], ids=[message[:40] for _, message in [*DAMAGE, *DISAGREEING]]
)
def test_a_result_that_was_damaged_or_edited_is_told_by_file_line_and_field(change, message, tmp_path):
    settings = {**PLAIN.schedule, "pop.lambda_pop": 0.01}
    write(result(scene="bear_512"), tmp_path)
    path = write(result(curve=curve({0: 1000, 9_999: 1000}, **STEPS), schedule=settings), tmp_path)
    first, second = path.read_text(encoding="utf-8").splitlines()
    found = json.loads(second)
    change(found)
    path.write_text(f"{first}\n{json.dumps(found, separators=(',', ':'))}\n", encoding="utf-8")
    with pytest.raises(PopError, match=message) as error:
        read_all("small", tmp_path)
    assert str(error.value).startswith(f"{path}: line 2")


def test_a_line_that_is_no_result_is_told_by_file_and_line(tmp_path: Path) -> None:
    path = write(PLAIN, tmp_path)
    line = path.read_text(encoding="utf-8")
    for text in ("{\n", "[]\n", json.dumps(json.loads(line)) + "\n"):
        path.write_text(line + text, encoding="utf-8")
        with pytest.raises(PopError, match=r"pop\.jsonl: line 2: must begin with schema 2, .*; remove the line"):
            read(path)
        with pytest.raises(PopError, match=r"pop\.jsonl: line 2: must begin"):
            write(PLAIN, tmp_path)
        assert path.read_text(encoding="utf-8") == line + text
    path.write_text(line.replace('"psnr"', "psnr"), encoding="utf-8")
    with pytest.raises(PopError, match=r"pop\.jsonl: line 1: is not JSON"):
        read(path)


def test_what_cannot_be_read_is_not_written(tmp_path: Path) -> None:
    for strange in (replace(PLAIN, psnr=float("inf")), replace(PLAIN, psnr=31.0), replace(PLAIN, seed=43)):
        with pytest.raises(PopError, match=r"psnr|run"):
            write(strange, tmp_path)
    assert not list(tmp_path.rglob("*.jsonl"))


def test_a_curve_is_read_between_its_points() -> None:
    told = result(curve=curve({0: 100, 100: 200, 300: 400}, psnr=[None, 20.0, 22.0]))
    assert told.at(50) == 150.0
    assert told.at(300) == 400.0
    assert told.at(200, "psnr") == 21.0
    assert told.at(50, "psnr") is None
    assert told.at(301) is None


@pytest.mark.parametrize("scale", SCALES)
def test_every_committed_result_can_be_read_and_is_in_the_one_form(scale: str) -> None:
    found = read_all(scale, RESULTS)
    lines = sum(path.read_text(encoding="utf-8").count("\n") for path in (RESULTS / scale).glob("*.jsonl"))
    assert len({(r.row, r.scene, r.seed) for r in found}) == len(found) == lines
    assert not list((RESULTS / scale).rglob("*.json"))


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


@pytest.mark.slow  # a row is trained several times
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
    write(replace(result, **changes), to / "results")
    return result


@pytest.mark.slow  # a row is trained again
def test_a_result_that_was_altered_and_agrees_with_itself_is_not_confirmed(trained, tmp_path, capsys):
    curve = list(find("toy", "pop", "demo", 42, trained / "results").curve)
    was = curve[1]["psnr"]
    curve[1] = {**curve[1], "psnr": was + 0.1}
    protocol = {**find("toy", "pop", "demo", 42, trained / "results").protocol, "begun": "c0ffee1"}
    altered(trained, tmp_path, curve=tuple(curve), protocol=protocol)
    assert verify(tmp_path, tmp_path / "work", "--steps", "40") == 1
    told = capsys.readouterr().out
    assert "NOT confirmed: 1 values differ" in told
    assert "the first steps of the result were taken at another commit, c0ffee1, which may be why" in told
    assert f"step 10: psnr is {was}, and the result has {was + 0.1}" in told


@pytest.mark.slow  # a row is trained again
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


def test_a_scene_that_is_absent_is_said_before_anything_is_cloned(tmp_path, capsys, monkeypatch):
    if history() is None:
        pytest.skip("this folder is not a clone with its history")
    monkeypatch.setattr(repro_verify, "_check_out", lambda *_: pytest.fail("cloned"))
    write(replace(PLAIN, commit=FOUND[0].commit), tmp_path)
    words = ["verify", "pop", "fox", "--scale", PLAIN.scale, "--results", str(tmp_path), "--work", str(tmp_path)]
    assert main([*words, "--data", str(tmp_path / "nowhere")]) == 2
    assert "nowhere: no such folder; name the one that holds the scenes with --data" in capsys.readouterr().err


def test_a_result_of_a_gpu_is_verified_by_kernels_that_its_commit_builds(tmp_path, monkeypatch):
    built: list[str] = []

    def run(command, **_):
        built.append(command[command.index("-m") + 1])
        return subprocess.CompletedProcess(command, len(built) - 1, "", "a line\nnvcc was not found")

    monkeypatch.setattr(repro_verify.subprocess, "run", run)
    (tmp_path / "clone").mkdir()
    with pytest.raises(PopError, match=r"python -m cuda_ext\.build of commit c0ffee1 failed: nvcc was not found"):
        repro_verify._check_out("c0ffee1", tmp_path / "clone", "cuda")
    built.clear()
    repro_verify._check_out("c0ffee1", tmp_path / "clone", "compiled")
    assert built == ["pop_fast.compiled.build"]


def test_a_backend_that_cannot_run_here_is_said_before_anything_is_cloned(tmp_path, capsys, monkeypatch):
    if history() is None:
        pytest.skip("this folder is not a clone with its history")
    if get_backend("cuda").available():
        pytest.skip("there is a GPU here")
    monkeypatch.setattr(repro_verify, "_check_out", lambda *_: pytest.fail("cloned"))
    (tmp_path / SCENES["fox"].folder).mkdir()
    write(replace(PLAIN, commit=FOUND[0].commit, engine="cuda"), tmp_path)
    words = ["verify", "pop", "fox", "--scale", PLAIN.scale, "--results", str(tmp_path), "--data", str(tmp_path)]
    assert main([*words, "--work", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "backend cuda cannot run here: " in said
    assert said.endswith(", or name another with --backend\n")


def test_what_has_no_result_is_refused(tmp_path, capsys):
    assert main(["verify", "pop", "demo", "--scale", "toy", "--results", str(tmp_path)]) == 2
    assert "pop.jsonl: has no result of demo, seed 42, to verify" in capsys.readouterr().err


def test_another_kind_of_machine_is_not_confirmed_by_the_gaussians_that_a_training_begins_with(tmp_path, monkeypatch):
    then = result(curve=curve({0: 500, 100: 500, 600: 700, 9_999: 1000}))
    monkeypatch.setattr(repro_verify, "curve_of", lambda folder, last: then.curve)
    with pytest.raises(PopError, match=r"after 200 steps there is no point .* held to; take at least 601 with --steps"):
        repro_verify._compare(then, tmp_path, 200, ("processor",))
    assert repro_verify._compare(then, tmp_path, 200, ()).points == 2
    assert repro_verify._compare(then, tmp_path, 700, ("processor",)).points == 1


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
