"""Checkpoints whose content no run can have written: each is refused before it reaches a step, file and entry named.

Before they were checked, the moment of another shape ended the interpreter (torch's fused Adam wrote behind it), most
others ended in a traceback, and some were accepted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from pop_fast.train import checkpoint as ckpt
from tests.app.children import pop_in_a_child
from tests.app.conftest import Pop
from tests.app.damage import contents, says
from tests.app.drift import drift_engine
from tests.app.forged import FORGED, INF, Content, forge, latest, to
from tests.app.tiny import tiny_capture, tiny_config


@pytest.fixture
def forged(stopped: Path, tmp_path: Path) -> Path:
    """A copy of the run that a test may damage."""
    for path, data in contents(stopped).items():
        copy = tmp_path / "run" / path.relative_to(stopped)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(data)
    return tmp_path / "run"


def on_cpu(folder: Path) -> TrainingRun:
    return TrainingRun(tiny_config(folder), tiny_capture(), resume=True)


def on_device(folder: Path) -> TrainingRun:
    # as a checkpoint of the CPU is read
    forge(folder, to("config.backend", "cuda"))
    return TrainingRun(tiny_config(folder), tiny_capture(), engine=drift_engine(), resume=True)


@pytest.fixture
def no_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a run that would take a step fail instead: with what it has accepted, a step may end the interpreter."""

    def accepted(*_: Any) -> None:
        raise AssertionError("the checkpoint was accepted")

    monkeypatch.setattr(TrainingRun, "_loop", accepted)


@pytest.mark.usefixtures("no_steps")
@pytest.mark.parametrize("case", FORGED)
def test_what_no_run_can_have_written_is_refused_and_named(case: str, forged: Path) -> None:
    change, parts = FORGED[case]
    forge(forged, change)
    before = contents(forged)
    with pytest.raises(PopError) as caught:
        on_cpu(forged).run()
    message = str(caught.value)
    for part in parts:
        assert part in message, message
    assert len(message) < 1000
    if "metrics.jsonl" not in message:
        assert message.startswith(f"{latest(forged)}: ")
    if not message.endswith("reads format 1") and "metrics.jsonl" not in message:
        assert "continue from" in message
    assert contents(forged) == before


@pytest.mark.usefixtures("no_steps")
@pytest.mark.parametrize(
    "case", ["m of another shape", "v NaN", "sums of one row", "no strategy's state", "views true"]
)
def test_a_run_on_a_device_refuses_it_likewise(case: str, forged: Path) -> None:
    change, parts = FORGED[case]
    trainer = on_device(forged)
    forge(forged, change)
    with pytest.raises(PopError) as caught:
        trainer.run()
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.parametrize("content", [None, [], "text", 3, torch.zeros(3)], ids=lambda value: type(value).__name__)
def test_what_is_no_dict_is_refused(content: Any, tmp_path: Path) -> None:
    torch.save(content, tmp_path / "x.pt")
    with pytest.raises(PopError, match=r"x\.pt: has no 'format', so it is not a checkpoint"):
        ckpt.load_checkpoint(tmp_path / "x.pt")


def test_a_checkpoint_under_another_ones_name_is_refused(forged: Path) -> None:
    latest(forged).write_bytes(ckpt.checkpoint_path(forged, 4).read_bytes())
    with pytest.raises(PopError, match=r"step is 4; it must be 9, as the file's name says; remove it to continue from"):
        ckpt.load_checkpoint(latest(forged))


@pytest.mark.usefixtures("no_steps")
def test_a_step_after_the_last_is_refused(forged: Path) -> None:
    def later(content: Content) -> None:
        content["step"] = 99
        for moments in content["optimizers"].values():
            moments["step"] = torch.tensor(100.0)

    forge(forged, later)
    latest(forged).rename(ckpt.checkpoint_path(forged, 99))
    with pytest.raises(PopError, match=r"ckpt_99_rank0\.pt: step is 99; it must be at most 29, the run's last"):
        on_cpu(forged).run()


def test_what_a_run_can_come_to_is_accepted(forged: Path) -> None:
    def unusual(content: Content) -> None:
        # the square of a large gradient overflows, and the parameter stays where it is
        content["optimizers"]["means"]["exp_avg_sq"][0, 0] = INF
        content["splats"]["colour"] = torch.zeros(3)
        content["notes"] = "what nothing reads does no harm"
        content["splats"]["scales"] = content["splats"]["scales"].t().contiguous().t()

    forge(forged, unusual)
    content = ckpt.load_checkpoint(latest(forged))
    assert "colour" not in content["splats"]
    assert all(value.is_contiguous() for value in content["splats"].values())
    on_cpu(forged).run()
    assert ckpt.list_checkpoints(forged)[-1][0] == 29


def test_going_on_from_the_checkpoint_before_ends_in_the_same_bits(forged: Path, stopped: Path, tmp_path: Path) -> None:
    forge(forged, FORGED["m of another shape"][0])
    with pytest.raises(PopError, match=r"remove it to continue from ckpt_4_rank0\.pt"):
        ckpt.load_checkpoint(latest(forged))
    latest(forged).unlink()
    on_cpu(forged).run()
    TrainingRun(tiny_config(tmp_path / "whole"), tiny_capture()).run()
    ours, theirs = (ckpt.load_checkpoint(ckpt.checkpoint_path(f, 29)) for f in (forged, tmp_path / "whole"))
    assert all(torch.equal(ours["splats"][key], theirs["splats"][key]) for key in theirs["splats"])


@pytest.fixture
def unfinished(result: Path) -> Path:
    """A result whose last checkpoint is of the seventh of thirty steps."""
    ckpt.checkpoint_path(result, 29).unlink()
    assert [step for step, _ in ckpt.list_checkpoints(result)] == [6]
    return result


def test_pop_train_refuses_a_moment_of_another_shape_and_lives(unfinished: Path, shared_capture: Path) -> None:
    path = ckpt.checkpoint_path(unfinished, 6)
    content = torch.load(path, weights_only=True)
    content["optimizers"]["means"]["exp_avg"] = torch.zeros(3, 3)
    torch.save(content, path)
    words = ("--steps-scaler", "0.001", "--quiet", "--pop.grow-grad2d", "1e-6", "--resume")
    outcome = pop_in_a_child("train", shared_capture, "--out", unfinished, *words)
    says(outcome, "ckpt_6_rank0.pt: optimizers.means.exp_avg has shape [3, 3]; it must be [", "remove it")


@pytest.mark.parametrize("command", ["eval", "export", "render"])
def test_the_other_commands_refuse_a_flipped_bit(pop: Pop, result: Path, tmp_path: Path, command: str) -> None:
    path = ckpt.checkpoint_path(result, 29)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(bytes(data))
    out = () if command == "eval" else ("--out", tmp_path / "o.ply")
    earlier = ckpt.checkpoint_path(result, 6)
    says(pop(command, result, *out), str(path), "does not agree with its checksum", f"use an earlier one ({earlier})")
    assert not (tmp_path / "o.ply").exists()
