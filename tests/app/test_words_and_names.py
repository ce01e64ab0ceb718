"""What people type, and how they call their files: none of it is taken for something else or reaches a terminal raw.

Bad captures and settings end with status 2 and one line that names file, field and fix. There is one of each kind here:
`test_captures`, `test_transforms`, `test_config` and `test_damaged_results` have what is said of all others.
"""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

import pop_fast
from pop_fast.cli import COMMANDS, describe, main, message, printable
from pop_fast.cli.completion import bash, fish, options_of
from pop_fast.cli.train import arguments
from pop_fast.cli.train_options import takes_hours
from pop_fast.stages.tiles import tile_lists
from pop_fast.train import TrainConfig, choose
from tests.app.captures import edit_transforms, photograph, transforms_capture, write_photograph
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import says
from tests.app.tiny import interrupt


@pytest.mark.parametrize("name", ["a=b", "x y", "--", "-s"])
def test_a_path_may_hold_an_equals_sign_or_a_space(pop: Pop, shared_capture: Path, tmp_path: Path, name: str) -> None:
    data = Path(shutil.copytree(shared_capture, tmp_path / name / "data=1"))
    pop.done("train", data, "--out", tmp_path / f"{name} out=1", *TRAIN, "--max-steps", "2")
    assert (tmp_path / f"{name} out=1" / "cfg.json").is_file()


def test_iterations_are_steps() -> None:
    assert arguments(["scene", "--iterations", "700"])[0].max_steps == 700
    assert arguments(["scene", "--preset", "quick", "--iterations=700"])[0].max_steps == 700


@pytest.mark.slow  # it trains
def test_a_photograph_whose_name_is_no_text_is_trained_on(pop: Pop, tmp_path: Path) -> None:
    # a file name is bytes; Python carries the odd ones through a string
    odd = os.fsdecode(b"view\xff.png")
    root = transforms_capture(tmp_path / "scene", 9)
    (root / "images" / "04.png").rename(root / "images" / odd)
    edit_transforms(root, lambda listing: listing["frames"][4].update(file_path=f"images/{odd}"))
    words = ("train", root, "--out", tmp_path / "r", *TRAIN, "--max-steps", "3", "--test-every", "2")
    pop.done(*words)
    assert (tmp_path / "r" / "report.html").is_file()
    assert "view" in (tmp_path / "r" / "stats" / "val_step0002.json").read_text()
    pop.done(*words, "--resume")


def test_escape_sequences_in_names_are_shown_and_not_obeyed(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    evil = tmp_path / "a\x1b[31m\r\u202eb"
    says(pop("eval", evil), r"a\x1b[31m", r"\u202eb")
    shutil.copytree(shared_capture, evil)
    outcome = pop.done("train", evil, "--out", tmp_path / "r", *TRAIN, "--max-steps", "2")
    assert "\x1b" not in outcome.out + outcome.err
    assert r"a\x1b[31m" in outcome.out
    assert "\x1b" not in pop("data", "check", evil).out


def test_messages_keep_letters_of_all_languages_and_are_no_longer_than_can_be_read() -> None:
    assert printable("Fotos\tgrün 写真 🎈") == "Fotos\tgrün 写真 🎈"
    assert printable("\udcff") == "\\udcff"
    short = message("a" + "b" * 10_000 + "c")
    assert len(short) < 1_300
    assert (short[0], short[-1]) == ("a", "c")
    assert message("b" * 1_000) == "b" * 1_000
    # what the system refuses is explained
    assert "ulimit -u" in (describe(RuntimeError("can't start new thread")) or "")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--seed -1", "seed is -1; it must be at least 0"),
        ("--threads 100000", "threads is 100000; it must be at most 512"),
        ("--sfm.matcher exhaustive --sfm.seed -1", "seed is -1; it must be a whole number from 0"),
    ],
)
def test_numbers_out_of_range_are_refused(pop, shared_capture, tmp_path, words, told):
    outcome = pop("train", shared_capture, "--out", tmp_path / "r", *words.split())
    assert outcome.status == 2
    assert told in " ".join(outcome.err.replace("│", " ").split())
    assert not (tmp_path / "r").exists()


def test_quiet_prints_nothing_and_help_reads_forwards(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    shown = " ".join(pop("train", "--help-all").out.replace("│", " ").split())
    assert "--normalize, --no-normalize move the capture into gsplat's normalised world. (default: True)" in shown
    words = ["train", shared_capture, *TRAIN, "--max-steps", "2", "--out"]
    assert pop(*words, tmp_path / "a", "--quiet").out == ""
    assert "PSNR" in pop(*words, tmp_path / "b").out


def test_how_cameras_are_found_can_be_said_to_train(pop: Pop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for i in range(3):
        write_photograph(tmp_path / "in" / f"{i}.png", photograph(i))
    asked: dict[str, object] = {}

    def placed(photos: Path, root: Path, **options: object) -> None:
        asked.update(options)
        raise KeyboardInterrupt

    monkeypatch.setattr("pop_fast.data.load.run_sfm", placed)
    words = ("--sfm.camera-model", "OPENCV", "--sfm.matcher", "sequential", "--sfm.max-size", "800")
    assert pop("train", tmp_path / "in", "--out", tmp_path / "r", *words).status == 130
    assert (asked["camera_model"], asked["matcher"], asked["max_size"]) == ("OPENCV", "sequential", 800)


def test_an_unfinished_run_is_marked_and_one_without_numbers_keeps_no_other_from_being_compared(
    pop, shared_result, shared_capture, tmp_path, monkeypatch
):
    interrupt(monkeypatch, at=10)
    begun, unfinished = tmp_path / "r", tmp_path / "u"
    for out, first in ((begun, "30"), (unfinished, "5")):
        words = (*TRAIN, "--checkpoint-every", "5", "--eval-steps", first)
        assert pop("train", shared_capture, "--out", out, *words).status == 130
    _, finished, row = pop("compare", shared_result, unfinished).out.splitlines()
    assert "5 of 30, unfinished" in row
    assert "unfinished" not in finished
    assert " 1 threads" not in finished
    outcome = pop.done("compare", begun, shared_result)
    assert outcome.err.startswith(f"note: {begun}: has no statistics yet")
    _, row, finished = outcome.out.splitlines()
    assert row.split()[:2] == [shared_capture.name, "POP"]
    assert "dB" not in row
    assert f"{json.loads((shared_result / 'stats' / 'val_step0029.json').read_text())['psnr']:.2f}" in finished
    says(pop("compare", begun), f"{begun}: has no statistics yet; train to the first evaluation")


@pytest.mark.parametrize("words", ["", "--preset quick", "--max-steps 500", "--steps-scaler 0.1", "--backend cuda"])
def test_the_paper_s_schedule_is_mentioned_where_nobody_asked_for_it_on_a_cpu(words: str) -> None:
    config, _ = arguments(["scene", *words.split()])
    assert takes_hours(config) == (not words)


def test_no_gpu_is_said_where_there_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cuda_ext.why_not", lambda: "the CUDA extension is not built; run `pop build-cuda`")
    config = TrainConfig(result_dir=str(tmp_path))
    monkeypatch.setattr(choose, "has_gpu", lambda: False)
    assert choose.choose_backend(config)[1].endswith("there is no NVIDIA GPU here")
    monkeypatch.setattr(choose, "has_gpu", lambda: True)
    assert choose.choose_backend(config)[1].endswith("run `pop build-cuda`")


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_options_and_files(tmp_path: Path, pop: Pop) -> None:
    (tmp_path / "pop.bash").write_text(pop("completion", "bash").out)
    (tmp_path / "scene").mkdir()
    script = 'source ./pop.bash; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _pop; echo "${COMPREPLY[@]}"'

    def completed(*words: str) -> list[str]:
        command = ["bash", "-c", script, "-", *words]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split()

    assert completed("pop", "tra") == ["train"]
    assert completed("pop", "data", "") == ["check"]
    assert "--pop.lambda-pop" in completed("pop", "train", "--pop.l")
    assert completed("pop", "eval", "sc") == ["scene"]
    assert set(completed("pop", "")) == {name.split()[0] for name in COMMANDS}


def test_every_option_of_every_command_is_completed() -> None:
    words = {name: options_of(name) for name in COMMANDS}
    assert {"--help", "--capture", "--json"} <= set(words["eval"])
    assert "--max-steps" in words["train"]
    assert all("--help" in options for options in words.values())
    assert "-l max-steps" in fish(words)
    assert "bashcompinit" in bash(words, zsh=True)


def test_tiles_beyond_what_a_float_counts_are_listed_in_the_right_rows() -> None:
    # one splat over 4,099 x 4,099 tiles of a pixel: past 2^24 of them a quotient in float32 is rounded
    side = 4_099
    middle = torch.tensor([[side / 2.0, side / 2.0]])
    lists = tile_lists(middle, 4.0 * middle, torch.tensor([1.0]), side, side, 1)
    assert torch.equal(lists.offsets, torch.arange(side * side + 1))


def test_the_package_gives_its_main_names_and_its_version(shared_capture: Path) -> None:
    for name in pop_fast.__all__:
        assert getattr(pop_fast, name) is not None
    assert pop_fast.__version__[0].isdigit()
    with pytest.raises(AttributeError, match="no attribute 'rasterisation'"):
        _ = pop_fast.rasterisation
    assert callable(pop_fast.rasterization)
    loaded = pop_fast.load_capture(shared_capture)
    assert repr(loaded).startswith("Capture('toy', 8 views, ")
    assert loaded._repr_html_().count("<img src=") == 8
    assert loaded.views[0]._repr_html_().count("data:image/png;base64,") == 1


def test_a_replaced_stream_is_no_obstacle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", io.StringIO())
    assert main(["--version"]) == 0


def test_a_bad_capture_and_bad_settings_are_named_before_the_work(pop: Pop, capture: Path, tmp_path: Path) -> None:
    (capture / "images" / "view_003.png").unlink()
    says(pop("train", capture, "--out", tmp_path / "r", *TRAIN), "view_003.png", "absent", "--missing skip")
    says(pop("train", capture, "--out", tmp_path / "r", "--resume", "--overwrite"), "--resume and --overwrite")
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("command", ["train", "demo", "render", "export"])
def test_a_full_disk_leaves_nothing_half_written(pop, shared_capture, shared_result, tmp_path, monkeypatch, command):
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    target = tmp_path / "here" / ("out.ply" if command == "export" else "out")
    words = {
        "train": ["train", shared_capture, "--out", target, *TRAIN],
        "demo": ["demo", target, "--views", "4", "--width", "16", "--height", "16"],
        "render": ["render", shared_result, "--out", target],
        "export": ["export", shared_result, "--out", target],
    }
    says(pop(*words[command]), str(target.parent), "the disk is full", "free some space")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("eval gone", ("gone", "no such file or folder")),
        ("compare", ("name one or more",)),
        ("data check gone", ("gone", "no such folder")),
        ("train gone.mp4", ("gone.mp4", "no such file;")),
        ("compare gone.ply", ("gone.ply", "no such file or folder", "pop train")),
        ("report gone", ("gone", "no such file or folder", "pop train")),
        ("sfm gone", ("gone", "no such folder")),
        ("demo here --views 2", ("2 views", "use 4")),
        ("doctor --lpips-alex gone", ("gone", "LPIPS")),
    ],
)
def test_the_other_subcommands_name_what_is_wrong(pop, tmp_path, monkeypatch, words, parts):
    monkeypatch.chdir(tmp_path)
    says(pop(*words.split()), *parts)
    assert list(tmp_path.iterdir()) == []
