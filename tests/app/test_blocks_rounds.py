"""`pop train --blocks-rounds`: merged blocks are trained on, each its core among all others, and merged again."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from pop_fast.api.backend import get_backend
from pop_fast.blocks import jobs
from pop_fast.blocks.jobs import block_folder, parts_of
from pop_fast.blocks.plan import Job, read_job, read_plan
from pop_fast.blocks.rounds import write_round_block
from pop_fast.blocks.run import TAKEN
from pop_fast.cli import main
from pop_fast.data.load import in_picture, load_capture
from pop_fast.train.checkpoint import load_splats, save_checkpoint
from pop_fast.train.evaluate import evaluate
from pop_fast.train.load_result import CaptureRecord, load_splat, read_record
from pop_fast.train.model import KEYS
from pop_fast.train.results import read_config
from pop_fast.train.views import ViewTensors
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import says
from tests.app.interruptions import interrupt
from tests.app.test_blocks import NAMES, in_this_process, stats_of

SETTINGS = (*TRAIN, "--skip-sizes", "--threads", "1", "--checkpoint-every", "5")
BLOCKS = ("--blocks", "2x1", *SETTINGS)
ROUNDS = ("--blocks-rounds", "2", "--blocks-round-steps", "12")


@pytest.fixture(autouse=True)
def _one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jobs, "_run", in_this_process)
    monkeypatch.setattr("pop_fast.blocks.jobs.has_snakemake", lambda: False)


@pytest.fixture(scope="module")
def shared_rounds(shared_capture: Path, made_once: Callable[..., Path]) -> Path:
    """A run in two blocks and two rounds that tests only read."""

    def make(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(jobs, "_run", in_this_process)
            patch.setattr("pop_fast.blocks.jobs.has_snakemake", lambda: False)
            assert main(["train", str(shared_capture), "--out", str(folder / "toy"), *BLOCKS, *ROUNDS]) == 0

    return made_once("rounds", make) / "toy"


@pytest.fixture
def rounds(shared_rounds: Path, tmp_path: Path) -> Path:
    """A copy of the run that a test may change."""
    return Path(shutil.copytree(shared_rounds, tmp_path / "rounds"))


def core(folder: Path, number: int, name: str) -> dict[str, torch.Tensor]:
    return load_splats(folder / "blocks" / f"round_{number}" / f"{name}.pt")[0]


def merged(folder: Path, number: int) -> dict[str, torch.Tensor]:
    if number == 2:
        return load_splat(folder).params
    parts = [core(folder, number, name) for name in NAMES]
    return {key: torch.cat([part[key] for part in parts]) for key in KEYS}


def place(folder: Path, number: int, name: str) -> Path:
    return block_folder(folder, name, number)


def same(first: Path, second: Path) -> bool:
    ours, theirs = load_splat(first).params, load_splat(second).params
    return all(torch.equal(ours[key], theirs[key]) for key in KEYS)


def test_a_block_trains_its_core_and_holds_what_its_views_see_of_the_others(shared_rounds):
    for name, other in (NAMES, NAMES[::-1]):
        folder = shared_rounds / "blocks" / "round_1" / name
        after, before, around = (
            load_splat(folder / "result").params,
            core(shared_rounds, 0, name),
            core(shared_rounds, 0, other),
        )
        counts, own = json.loads((folder / "start.json").read_text()), len(before["means"])
        assert counts["own"] == own
        assert 0 < counts["fixed"] <= len(around["means"])
        assert counts["merged"] == own + len(around["means"])
        fixed = {key: value[own:] for key, value in after.items()}
        assert len(fixed["means"]) == counts["fixed"]
        given = {tuple(row) for row in around["means"].tolist()}
        assert {tuple(row) for row in fixed["means"].tolist()} <= given
        assert (after["means"][:own] != before["means"]).any()


def test_a_round_draws_as_many_views_as_the_block_has_from_all_that_show_its_core(shared_rounds):
    views = {number: {name: load_capture(place(shared_rounds, number, name)) for name in NAMES} for number in range(3)}
    training = {view.name for view in views[0]["0_0"].train_views()} | {
        view.name for view in views[0]["1_0"].train_views()
    }
    drawn = []
    for number in (1, 2):
        for name in NAMES:
            own, found = views[0][name], views[number][name]
            assert len(found.train_views()) == len(own.train_views())
            assert {view.name for view in found.train_views()} <= training
            assert [view.name for view in found.test_views()] == [view.name for view in own.test_views()]
            points = core(shared_rounds, number - 1, name)["means"].double().numpy()
            assert all(in_picture(points, view).any() for view in found.train_views())
        drawn.append({view.name for view in views[number]["1_0"].train_views()})
    own_views = {view.name for view in views[0]["1_0"].train_views()}
    assert len(own_views) == 3
    assert drawn[0] != drawn[1]
    assert not drawn[0] | drawn[1] <= own_views


def test_views_that_show_nothing_of_a_core_are_not_drawn(shared_rounds, tmp_path):
    folder = Path(shutil.copytree(shared_rounds, tmp_path / "copy"))
    config, record = read_config(folder), read_record(folder) or CaptureRecord()
    every = load_capture(place(folder, 0, "0_0")).train_views()
    assert len(every) == 7
    # in the middle of one view's picture, a hair before its lens: out of the others' pictures
    alone = (every[2].camera_center + 1e-3 * every[2].viewmat[2, :3]).astype(np.float32)[None]
    showing = {view.name for view in every if in_picture(alone.astype(np.float64), view).any()}
    assert showing < {view.name for view in every}
    write_round_block(folder, config, record, list(NAMES), "0_0", 7, alone)
    assert {view.name for view in load_capture(place(folder, 7, "0_0"), photographs="none").train_views()} == showing


def test_the_merge_takes_a_share_of_what_every_block_has_changed(shared_rounds):
    halves = []
    for name in NAMES:
        before = core(shared_rounds, 1, name)
        after = load_splat(shared_rounds / "blocks" / "round_2" / name / "result").params
        halves.append({key: value.lerp(after[key][: len(value)], TAKEN) for key, value in before.items()})
    whole = merged(shared_rounds, 2)
    assert all(torch.equal(whole[key], torch.cat([half[key] for half in halves])) for key in KEYS)
    plan = read_plan(shared_rounds)
    assert plan is not None
    for number, name in enumerate(NAMES):
        places = plan[0].block_of(core(shared_rounds, 1, name)["means"].double().numpy())
        assert (places == number).all()


def test_every_round_lowers_the_error_of_the_training_photographs(shared_rounds, shared_capture):
    config = load_splat(shared_rounds).config
    views = [ViewTensors.of(view) for view in load_capture(shared_capture).train_views()]
    found = [evaluate(get_backend("fast"), merged(shared_rounds, number), views, config, 3) for number in range(3)]
    psnr = [each["psnr"] for each in found]
    assert psnr[0] + 0.1 < psnr[1]
    assert psnr[1] < psnr[2]


def test_statistics_say_what_every_round_came_to(shared_rounds):
    stats = stats_of(shared_rounds)
    assert [found["round"] for found in stats["rounds"]] == [0, 1, 2]
    assert len({found["num_GS"] for found in stats["rounds"]}) == 1
    assert stats["rounds"][2]["psnr"] == stats["psnr"] > stats["rounds"][0]["psnr"]
    assert [block["name"] for block in stats["blocks"]] == list(NAMES)
    assert all(block["kept"] > 0 for block in stats["blocks"])
    for found in stats["rounds"][1:]:
        assert [block["name"] for block in found["blocks"]] == list(NAMES)
        assert found["seconds"] > 0 < found["memory_bytes"] <= stats["memory_bytes"]
    assert stats["seconds"] == pytest.approx(sum(found["seconds"] for found in stats["rounds"]))


def test_without_rounds_nothing_of_them_is_there(pop: Pop, shared_capture, shared_rounds, tmp_path):
    folder = tmp_path / "out"
    done = pop.done("train", shared_capture, "--out", folder, *BLOCKS, "--blocks-rounds", "0")
    assert "merged after" not in done.out
    assert "rounds" not in stats_of(folder)
    assert not list((folder / "blocks").glob("round_*"))
    kept = merged(shared_rounds, 0)
    assert all(torch.equal(load_splat(folder).params[key], kept[key]) for key in KEYS)
    # a run of before there were rounds is one without
    path = folder / "blocks" / "job.json"
    old = {name: value for name, value in json.loads(path.read_text()).items() if not name.startswith("round")}
    path.write_text(json.dumps(old))
    again = pop.done("train", shared_capture, "--out", folder, *BLOCKS, "--resume")
    assert "are trained and merged" in again.out


def test_rounds_can_be_added_to_a_run_that_is_finished(pop: Pop, shared_capture, shared_rounds, tmp_path):
    folder = tmp_path / "out"
    for rounds in ("0", "1", "2"):
        how = ("--blocks-rounds", rounds, *(ROUNDS[2:] if rounds != "0" else ()), "--resume")
        done = pop.done("train", shared_capture, "--out", folder, *BLOCKS, *how)
    assert "block 0_0, 1 of 2" not in done.out.replace("round 2 of 2: block 0_0", "")
    assert same(folder, shared_rounds)
    # what is not said is as the run was begun
    again = pop.done("train", shared_capture, "--out", folder, *BLOCKS, "--resume")
    assert "are trained and merged" in again.out


def test_a_round_that_was_interrupted_goes_on_to_the_same_bits(
    pop: Pop, shared_capture, shared_rounds, tmp_path, monkeypatch
):
    folder = tmp_path / "stopped"
    words = ("train", shared_capture, "--out", folder, *BLOCKS)
    assert pop(*words, "--blocks-rounds", "0").status == 0
    with monkeypatch.context() as patch:
        interrupt(patch, at=7)
        stopped = pop(*words, *ROUNDS, "--resume")
    assert stopped.status == 130
    assert "stopped after step 7" in stopped.err
    assert (folder / "blocks" / "round_0" / "merged").is_file()
    assert not (folder / "blocks" / "round_1" / "0_0" / "trained").exists()
    gone_on = pop.done(*words, *ROUNDS, "--resume")
    assert gone_on.out.count("continuing from step 5") == 1
    assert same(folder, shared_rounds)


def test_parts_can_be_done_one_by_one_in_any_order_within_a_round(pop: Pop, rounds, shared_rounds):
    shutil.rmtree(rounds / "blocks" / "round_2")
    (rounds / "blocks" / "merged").unlink()
    for words in (("train", "1_0"), ("train", "0_0"), ("merge",)):
        pop.done("blocks", words[0], rounds, *words[1:], "--round", "2")
    assert (rounds / "blocks" / "merged").is_file()
    assert same(rounds, shared_rounds)


def test_a_core_without_gaussians_has_nothing_to_train(pop: Pop, rounds):
    shutil.rmtree(rounds / "blocks" / "round_2")
    none = {key: value[:0] for key, value in core(rounds, 1, "1_0").items()}
    save_checkpoint(rounds / "blocks" / "round_1" / "1_0.pt", {"step": 29, "splats": none})
    for words in (("train", "1_0"), ("train", "0_0"), ("merge",)):
        pop.done("blocks", words[0], rounds, *words[1:], "--round", "2")
    assert stats_of(rounds)["num_GS"] == len(core(rounds, 1, "0_0")["means"])


def test_a_part_of_a_round_asks_for_what_comes_before_it(pop: Pop, rounds):
    def refused(*words: object) -> str:
        outcome = pop("blocks", *words)
        assert outcome.status == 2
        assert outcome.err.count("\n") == 1
        return outcome.err

    assert "has no round 3, but rounds 0 to 2" in refused("train", rounds, "0_0", "--round", "3")
    assert "has no round -1, but rounds 0 to 2" in refused("merge", rounds, "--round", "-1")
    assert "is of all rounds; leave --round out" in refused("partition", rounds, "--round", "1")
    (rounds / "blocks" / "round_1" / "1_0" / "start.json").unlink()
    assert f"run pop blocks train {rounds} 1_0 --round 1" in refused("merge", rounds, "--round", "1")
    (rounds / "blocks" / "round_1" / "0_0" / "start.json").write_text('{"own": 1}')
    assert "is not what 'pop blocks train' writes" in refused("merge", rounds, "--round", "1")
    (rounds / "blocks" / "round_1" / "stats.json").unlink()
    assert f"run pop blocks merge {rounds} --round 1" in refused("merge", rounds)
    (rounds / "blocks" / "round_0" / "merged").unlink()
    assert "starts from the merged blocks of round 0" in refused("train", rounds, "0_0", "--round", "1")
    shutil.rmtree(rounds / "blocks" / "round_2" / "0_0" / "result" / "ckpts")
    shutil.rmtree(rounds / "blocks" / "round_2" / "0_0" / "result" / "ply")
    assert "holds no checkpoint" in refused("merge", rounds)


def test_a_round_that_begins_with_other_gaussians_is_not_gone_on_with(pop: Pop, rounds):
    other = core(rounds, 0, "1_0")
    other["sh0"] += 1.0
    save_checkpoint(rounds / "blocks" / "round_0" / "1_0.pt", {"step": 29, "splats": other})
    says(
        pop("blocks", "train", rounds, "0_0", "--round", "1"), "held fixed are others than this training was begun with"
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--blocks-rounds", "1"), "say --blocks 2x2 too"),
        (("--blocks-round-steps", "10"), "say --blocks 2x2 too"),
        (("--blocks", "2x1", "--blocks-rounds", "-1"), "must be from 0 to 100"),
        (("--blocks", "2x1", "--blocks-rounds", "101"), "must be from 0 to 100"),
        (("--blocks", "2x1", "--blocks-rounds", "1", "--blocks-round-steps", "0"), "must be 1 or more"),
        (("--blocks", "2x1", "--blocks-rounds", "0", "--blocks-round-steps", "5"), "there are no rounds"),
    ],
)
def test_rounds_that_cannot_be_are_refused_in_a_line(pop: Pop, shared_capture, tmp_path, words, said):
    says(pop("train", shared_capture, "--out", tmp_path / "out", *TRAIN, *words), said)
    assert not (tmp_path / "out").exists()


def test_a_run_with_other_rounds_is_not_gone_on_with(pop: Pop, shared_capture, rounds):
    def refused(*words: str) -> str:
        return pop("train", shared_capture, "--out", rounds, *BLOCKS, *words, "--resume").err

    assert "was begun with blocks.rounds = 2" in refused("--blocks-rounds", "1")
    assert "was begun with blocks.round_steps = 12" in refused("--blocks-round-steps", "5")
    assert "was begun with blocks.round_steps = 12" in refused("--blocks-rounds", "3", "--blocks-round-steps", "5")


def test_the_steps_of_a_round_are_a_tenth_unless_they_are_said(pop: Pop, shared_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "_run", lambda words, quiet: 0)
    pop.done("train", shared_capture, "--out", tmp_path / "out", *BLOCKS)
    job = read_job(tmp_path / "out")
    assert job is not None
    assert job.rounds > 0
    assert job.round_steps == 3


def test_the_parts_of_a_run_come_in_order_and_only_the_last_merge_is_the_last():
    parts = parts_of(Job(blocks="2x1", rounds=1, round_steps=5))
    assert [part.name for part in parts] == [
        *("block_0_0", "block_1_0", "round_0_merge"),
        *("round_1_block_0_0", "round_1_block_1_0", "merge"),
    ]
    assert [part.last for part in parts] == [False] * 5 + [True]
    assert len({part.marker(Path("run")) for part in parts}) == len(parts)
