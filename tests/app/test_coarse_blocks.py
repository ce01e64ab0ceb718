"""A run in blocks that begins from a coarse model of the whole (`pop train --blocks --blocks-coarse`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pop_fast.blocks import jobs
from pop_fast.blocks.jobs import block_folder, parts_of, result_of
from pop_fast.blocks.plan import COARSE, Job, read_job, read_plan
from pop_fast.blocks.run import round_config
from pop_fast.cli import main
from pop_fast.data.load import load_capture
from pop_fast.train.checkpoint import load_splats
from pop_fast.train.load_result import load_splat
from pop_fast.train.results import ResultFolder, read_config
from pop_ref.constants import PAPER
from tests.app.conftest import Outcome, Pop, done
from tests.app.damage import says
from tests.app.test_blocks import ROUNDS, TWO_ROUNDS, assert_same, one_process

COARSELY = (*ROUNDS, *TWO_ROUNDS, "--blocks-coarse", "2")
Train = Callable[..., Outcome]


@pytest.fixture(autouse=True)
def _one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    one_process(monkeypatch)


@pytest.fixture(scope="module")
def shared_coarse(shared_capture: Path, made_once: Callable[..., Path]) -> Path:

    def make(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            one_process(patch)
            assert main(["train", str(shared_capture), *COARSELY, "--out", str(folder / "toy")]) == 0

    return made_once("coarse_blocks", make) / "toy"


@pytest.fixture
def train(pop: Pop, shared_capture: Path, tmp_path: Path) -> Train:
    return lambda *words: pop("train", shared_capture, "--out", tmp_path / "out", *words)


def cores(folder: Path, number: int) -> dict[str, torch.Tensor]:
    parts = [load_splats(jobs.core_of(folder, name, number))[0] for name in ("0_0", "1_0")]
    return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}


def test_the_coarse_model_sees_all_photographs_smaller_through_the_low_pass_of_the_whole(shared_coarse):
    whole, coarse = read_config(shared_coarse), read_config(result_of(shared_coarse, COARSE))
    assert coarse.factor == 2 * whole.factor
    assert whole.renderer == PAPER
    # px^2 of pixels of twice the side
    assert coarse.renderer.eps2d == PAPER.eps2d / 4
    assert coarse.max_steps <= whole.max_steps
    capture, own = load_capture(read_config(shared_coarse).data), load_capture(block_folder(shared_coarse, COARSE))
    assert [view.name for view in own.train_views()] == [view.name for view in capture.train_views(whole.test_every)]
    assert [view.name for view in own.test_views()] == [view.name for view in capture.test_views(whole.test_every)]
    assert torch.equal(torch.from_numpy(own.points), torch.from_numpy(capture.points))


def test_rounds_begin_with_the_coarse_model_divided_by_cores_and_nothing_is_lost(shared_coarse):
    coarse = load_splat(result_of(shared_coarse, COARSE)).params
    plan = read_plan(shared_coarse)
    core = torch.from_numpy(plan[0].block_of(coarse["means"].double().numpy()))
    divided = {key: torch.cat([value[core == number] for number in (0, 1)]) for key, value in coarse.items()}
    assert_same(cores(shared_coarse, 0), divided)
    assert not torch.equal(cores(shared_coarse, 1)["means"], divided["means"])


def test_blocks_are_not_trained_by_themselves_and_statistics_name_the_coarse_model(shared_coarse):
    assert not result_of(shared_coarse, "0_0").exists()
    stats = ResultFolder(shared_coarse).read_stats("val", read_config(shared_coarse).max_steps - 1)
    assert [row["name"] for row in stats["blocks"]] == [COARSE]
    assert [row["name"] for row in stats["rounds"][1]["blocks"]] == ["0_0", "1_0"]
    config = read_config(shared_coarse)
    assert stats["blocks"][0]["training_views"] == len(load_capture(config.data).train_views(config.test_every))
    assert stats["seconds"] == pytest.approx(sum(found["seconds"] for found in stats["rounds"]))


def test_rounds_after_a_coarse_model_have_higher_rates_which_fall(shared_coarse):
    config, job = read_config(shared_coarse), read_job(shared_coarse)
    part = next(part for part in parts_of(job) if part.round == 1 and part.block)
    ours = round_config(shared_coarse, config, part, job).lr
    plain = round_config(shared_coarse, config, part, Job(blocks="2x1", rounds=2, round_steps=12)).lr
    for name in ("scales", "sh_rest", "means"):
        assert getattr(ours, name) > getattr(plain, name)
    assert ours.scales * ours.others_decay < plain.scales * plain.others_decay
    assert ours.means * ours.means_decay == pytest.approx(plain.means * plain.means_decay)
    assert ours.opacities == plain.opacities


def test_a_run_that_was_interrupted_goes_on_to_the_same_bits(train: Train, shared_coarse, tmp_path, monkeypatch):
    kept, calls = jobs._run, []

    def stops(words, quiet):
        calls.append(words)
        return 130 if len(calls) == 3 else kept(words, quiet)

    monkeypatch.setattr(jobs, "_run", stops)
    assert train(*COARSELY).status == 130
    monkeypatch.setattr(jobs, "_run", kept)
    says(train(*ROUNDS, *TWO_ROUNDS, "--resume"), "was begun with blocks.coarse = 2")
    said = done(train(*COARSELY, "--resume"))
    assert "the coarse model" not in said
    assert_same(load_splat(tmp_path / "out").params, load_splat(shared_coarse).params)


def test_parts_are_done_by_name_and_a_run_without_a_coarse_model_has_none(pop, shared_coarse):
    job = read_job(shared_coarse)
    assert [part.name for part in parts_of(job)][:3] == ["block_coarse", "round_0_merge", "round_1_block_0_0"]
    assert f"its blocks are {COARSE}, 0_0, 1_0" in pop("blocks", "train", shared_coarse, "7_7").err
    says(pop("blocks", "train", shared_coarse, "0_0"), f"round 0 trains {COARSE} and not 0_0; name one of these")
    says(pop("blocks", "train", shared_coarse, COARSE, "--round", "1"), "round 1 trains 0_0, 1_0 and not coarse")
    assert parts_of(Job(blocks="2x1", rounds=1, round_steps=1))[0].block == "0_0"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--blocks", "2x1", "--blocks-coarse", "1"), "--blocks-coarse is 1; it must be from 2 to 16"),
        (("--blocks", "2x1", "--blocks-coarse", "17"), "it must be from 2 to 16"),
        (("--blocks", "2x1", "--blocks-coarse", "2", "--blocks-rounds", "0"), "needs rounds"),
        (("--blocks-coarse", "2"), "add --blocks 2x2"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(train: Train, tmp_path, words, said):
    says(train(*words), said)
    assert not (tmp_path / "out").exists()
