"""What people type, and how they call their files: none of it is taken for something else or reaches a terminal raw.

Bad captures and settings end with status 2 and one line that names file, field and fix. There is one of each kind here:
`test_bad_input_data` and `test_config` have what is said of all others.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from pop_fast.cli import COMMANDS, main
from pop_fast.cli.completion import bash, fish, options_of
from pop_fast.cli.errors import describe, message, printable
from pop_fast.cli.train import arguments
from pop_fast.cli.train_checks import takes_hours
from pop_fast.data import load_capture, run_sfm
from pop_fast.io.ply import load_ply
from pop_fast.stages.tiles import tile_lists
from pop_fast.train import TrainConfig, choose
from tests.app.captures import (
    assert_one_line,
    colmap_capture,
    edit_transforms,
    photograph,
    transforms_capture,
    write_photograph,
)
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import photo, says
from tests.app.tiny import interrupt


@pytest.mark.parametrize("name", ["a=b", "x y", "--", "-s"])
def test_a_path_may_hold_an_equals_sign_or_a_space(pop: Pop, shared_capture: Path, tmp_path: Path, name: str) -> None:
    data = Path(shutil.copytree(shared_capture, tmp_path / name / "data=1"))
    pop.done("train", data, "--out", tmp_path / f"{name} out=1", *TRAIN, "--max-steps", "2")
    assert (tmp_path / f"{name} out=1" / "cfg.json").is_file()


def test_iterations_are_steps() -> None:
    assert arguments(["scene", "--iterations", "700"])[0].max_steps == 700
    assert arguments(["scene", "--preset", "quick", "--iterations=700"])[0].max_steps == 700


def test_a_photograph_whose_name_is_no_text_is_trained_on(pop: Pop, tmp_path: Path) -> None:
    # a file name is bytes; Python carries the odd ones through a string
    odd = os.fsdecode(b"view\xff.png")
    root = transforms_capture(tmp_path / "scene", 9)
    (root / "images" / "04.png").rename(root / "images" / odd)
    edit_transforms(root, lambda listing: listing["frames"][4].update(file_path=f"images/{odd}"))
    pop.done("train", root, "--out", tmp_path / "r", *TRAIN, "--max-steps", "3", "--test-every", "2")
    assert (tmp_path / "r" / "report.html").is_file()
    assert "view" in (tmp_path / "r" / "stats" / "val_step0002.json").read_text()
    assert (
        pop("train", root, "--out", tmp_path / "r", *TRAIN, "--max-steps", "3", "--test-every", "2", "--resume").status
        == 0
    )


def test_the_search_for_cameras_names_a_photograph_that_colmap_cannot_list(tmp_path: Path) -> None:
    for i, name in enumerate((b"a\xff.png", b"b.png")):
        (tmp_path / os.fsdecode(name)).write_bytes(b"")
        write_photograph(tmp_path / "plain.png", photograph(i))
        (tmp_path / "plain.png").rename(tmp_path / os.fsdecode(name))
    assert_one_line(lambda: run_sfm(tmp_path), "not UTF-8", "rename the photograph")


def test_escape_sequences_in_names_are_shown_and_not_obeyed(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    evil = tmp_path / "a\x1b[31m\r\u202eb"
    outcome = pop("eval", evil)
    says(outcome, r"a\x1b[31m", r"\u202eb")
    shutil.copytree(shared_capture, evil)
    outcome = pop.done("train", evil, "--out", tmp_path / "r", *TRAIN, "--max-steps", "2")
    assert "\x1b" not in outcome.out + outcome.err
    assert r"a\x1b[31m" in outcome.out
    assert "\x1b" not in pop("data", "check", evil).out


def test_tabs_and_letters_of_all_languages_stay() -> None:
    assert printable("Fotos\tgrün 写真 🎈") == "Fotos\tgrün 写真 🎈"
    assert printable("\udcff") == "\\udcff"


def test_a_message_is_no_longer_than_can_be_read() -> None:
    long = "a" + "b" * 10_000 + "c"
    short = message(long)
    assert len(short) < 1_300
    assert (short[0], short[-1]) == ("a", "c")
    assert message("b" * 1_000) == "b" * 1_000


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--seed", "-1"), "seed is -1; it must be at least 0"),
        (("--threads", "100000"), "threads is 100000; it must be at most 512"),
        (("--sfm.matcher", "exhaustive", "--sfm.seed", "-1"), "seed is -1; it must be a whole number from 0"),
    ],
)
def test_numbers_that_libraries_cannot_take_are_refused(
    pop: Pop, shared_capture: Path, tmp_path: Path, words: tuple[str, ...], told: str
) -> None:
    outcome = pop("train", shared_capture, "--out", tmp_path / "r", *words)
    assert outcome.status == 2
    assert told in " ".join(outcome.err.replace("│", " ").split())
    assert not (tmp_path / "r").exists()


def test_a_camera_id_beyond_32_bits_is_named(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, binary=False)
    for name in ("cameras.txt", "images.txt"):
        path = root / "sparse" / "0" / name
        lines = path.read_text().splitlines()
        changed = [line.replace("1 PINHOLE", f"{2**32} SIMPLE_RADIAL") for line in lines]
        path.write_text("\n".join(changed) + "\n")
    cameras = root / "sparse" / "0" / "cameras.txt"
    cameras.write_text(f"{2**32} SIMPLE_RADIAL 40 30 36 20 15 0\n")
    assert_one_line(lambda: load_capture(root), "cameras.txt", f"CAMERA_ID is {2**32}")


def test_what_the_system_refuses_is_explained() -> None:
    told = describe(RuntimeError("can't start new thread"))
    assert told is not None
    assert "ulimit -u" in told


def test_renders_that_are_nested_beyond_reading_are_somebody_else_s(
    pop: Pop, shared_result: Path, tmp_path: Path
) -> None:
    out = tmp_path / "views"
    out.mkdir()
    (out / "renders.json").write_text("[" * 200_000)
    says(pop("render", shared_result, "--out", out, "--overwrite"), "renders.json")


def test_quiet_prints_nothing_and_no_progress_leaves_out_the_bars(
    pop: Pop, shared_capture: Path, tmp_path: Path
) -> None:
    words = [*TRAIN, "--max-steps", "2"]
    assert pop("train", shared_capture, "--out", tmp_path / "a", *words, "--quiet").out == ""
    assert "PSNR" in pop("train", shared_capture, "--out", tmp_path / "b", *words).out


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


def test_an_unfinished_run_is_marked_beside_a_finished_one(
    pop: Pop, shared_capture: Path, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("--eval-steps", "5", "--checkpoint-every", "5")
    interrupt(monkeypatch, at=10)
    assert pop("train", shared_capture, "--out", tmp_path / "r", *TRAIN, *words).status == 130
    _, finished, unfinished = pop("compare", shared_result, tmp_path / "r").out.splitlines()
    assert "5 of 30, unfinished" in unfinished
    assert "unfinished" not in finished
    assert " 1 threads" not in finished


def test_photographs_beside_their_model_have_no_folder_to_name(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    for path in (root / "images").iterdir():
        path.rename(root / path.name)
    (root / "images").rmdir()
    assert load_capture(root, factor=2).notes == ("the photographs are shrunk by 2 here",)


def test_a_run_without_numbers_keeps_no_other_from_being_compared(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = tmp_path / "r"
    interrupt(monkeypatch, at=10)
    words = ("--eval-steps", "30", "--checkpoint-every", "5")
    assert pop("train", shared_capture, "--out", begun, *TRAIN, *words).status == 130
    outcome = pop.done("compare", begun, shared_result)
    assert outcome.err.startswith(f"note: {begun}: has no statistics yet")
    _, row, finished = outcome.out.splitlines()
    assert row.split()[:2] == [shared_capture.name, "POP"]
    assert "dB" not in row
    assert f"{json.loads((shared_result / 'stats' / 'val_step0029.json').read_text())['psnr']:.2f}" in finished
    says(pop("compare", begun), f"{begun}: has no statistics yet; train to the first evaluation")


def test_which_folder_a_factor_reads_is_told(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    assert load_capture(root).notes == ()
    assert load_capture(root, factor=2).notes == ("the photographs of images/ are shrunk by 2 here",)
    for path in (root / "images").iterdir():
        write_photograph(root / "images_2" / path.name, photograph(0, 20, 15))
    (note,) = load_capture(root, factor=2).notes
    assert note.startswith("the photographs of images_2/ are used, made smaller before")


@pytest.mark.parametrize(
    ("words", "hours"),
    [
        ((), True),
        (("--preset", "quick"), False),
        (("--max-steps", "500"), False),
        (("--steps-scaler", "0.1"), False),
        (("--backend", "cuda"), False),
    ],
)
def test_the_paper_s_schedule_is_mentioned_where_nobody_asked_for_it_on_a_cpu(
    words: tuple[str, ...], hours: bool
) -> None:
    config, _ = arguments(["scene", *words])
    assert takes_hours(config) == hours


def test_no_gpu_is_said_where_there_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cuda_ext.why_not", lambda: "the CUDA extension is not built; run `pop build-cuda`")
    config = TrainConfig(result_dir=str(tmp_path))
    monkeypatch.setattr(choose, "has_gpu", lambda: False)
    assert choose.choose_backend(config)[1].endswith("there is no NVIDIA GPU here")
    monkeypatch.setattr(choose, "has_gpu", lambda: True)
    assert choose.choose_backend(config)[1].endswith("run `pop build-cuda`")


def test_help_of_a_switch_that_is_on_reads_forwards(pop: Pop) -> None:
    shown = " ".join(pop("train", "--help-all").out.replace("│", " ").split())
    assert "--normalize, --no-normalize move the capture into gsplat's normalised world. (default: True)" in shown


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
    lists = tile_lists(
        torch.tensor([[side / 2.0, side / 2.0]]),
        torch.tensor([[2.0 * side, 2.0 * side]]),
        torch.tensor([1.0]),
        side,
        side,
        1,
    )
    assert torch.equal(lists.offsets, torch.arange(side * side + 1))


def test_the_package_gives_its_main_names_and_its_version(shared_capture: Path) -> None:
    import pop_fast

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
    import io

    monkeypatch.setattr("sys.stdout", io.StringIO())
    assert main(["--version"]) == 0


def test_numbers_of_a_run_stay_json(shared_result: Path) -> None:
    assert json.loads((shared_result / "cfg.json").read_text())["resolved"]["progress"] is False


def test_a_damaged_capture_is_named_before_anything_is_written(pop: Pop, capture: Path, tmp_path: Path) -> None:
    photo(capture, 3).unlink()
    outcome = pop("train", capture, "--out", tmp_path / "r", *TRAIN)
    says(outcome, "view_003.png", "absent", "--missing skip")
    assert not (tmp_path / "r").exists()


def test_settings_that_exclude_each_other_are_named(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    outcome = pop("train", shared_capture, "--out", tmp_path / "r", "--resume", "--overwrite")
    says(outcome, "--resume and --overwrite")
    assert not (tmp_path / "r").exists()


# Disks that are full and folders that are forbidden: refused in one line, nothing touched.


@pytest.mark.parametrize("command", ["train", "demo", "render", "export"])
def test_a_full_disk_leaves_nothing_half_written(
    pop: Pop, shared_capture: Path, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
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


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written_is_named(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    says(pop("train", shared_capture, "--out", tmp_path / "locked" / "r", *TRAIN), "locked", "permission denied")


# Damaged checkpoints, PLY files and results: refused in one line that names file, field and fix.


def splat_file(shared_result: Path, path: Path, **changes: object) -> Path:
    """Write a checkpoint or PLY like the tiny result's, with tensors changed or left out (None)."""
    params = load_ply(shared_result / "ply" / "point_cloud_29.ply")
    kept = {name: changes.get(name, value) for name, value in params.items()}
    torch.save({"step": 29, "splats": {k: v for k, v in kept.items() if v is not None}}, path)
    return path


def with_value(shape: tuple[int, ...], index: tuple[int, ...], value: float) -> torch.Tensor:
    tensor = torch.zeros(shape)
    tensor[index] = value
    return tensor


def test_every_defect_of_a_checkpoint_is_named_with_its_tensor(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    n = len(load_ply(shared_result / "ply" / "point_cloud_29.ply")["means"])
    cases: list[tuple[dict[str, object], tuple[str, ...]]] = [
        ({"scales": None}, ("no splats.scales",)),
        ({"means": with_value((n, 3), (4, 1), float("nan"))}, ("splats.means[4, 1] is nan",)),
        ({"sh0": with_value((n, 1, 3), (0, 0, 2), float("inf"))}, ("splats.sh0[0, 0, 2] is inf",)),
        ({"quats": torch.zeros((n, 3))}, (f"splats.quats has shape [{n}, 3]; it must be [{n}, 4]",)),
        ({"shN": torch.zeros((n, 7, 3))}, ("splats.shN has shape", "or 0, 3 or 8")),
        ({"opacities": torch.zeros(n, dtype=torch.int64)}, ("splats.opacities is torch.int64", "floats")),
        ({"means": torch.zeros(())}, ("splats.means has shape []",)),
        ({"means": [1.0]}, ("splats.means is list",)),
    ]
    for changes, parts in cases:
        path = splat_file(shared_result, tmp_path / "broken.pt", **changes)
        says(pop("export", path, "--out", tmp_path / "o.ply"), "broken.pt", *parts)
    assert not (tmp_path / "o.ply").exists()


def test_a_zero_quaternion_is_named_before_it_is_rendered_or_exported(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path
) -> None:
    quats = load_ply(shared_result / "ply" / "point_cloud_29.ply")["quats"]
    quats[2] = 0.0
    path = splat_file(shared_result, tmp_path / "zero.pt", quats=quats)
    says(pop("export", path, "--out", tmp_path / "o.ply"), "quats[2", "norm > 0")
    says(pop("eval", path, "--capture", shared_capture), "quats[", "norm > 0")
    assert not (tmp_path / "o.ply").exists()


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["eval", "gone"], ("gone", "no such file or folder")),
        (["report", "gone"], ("gone", "no cfg.json")),
        (["compare", "gone"], ("gone", "no cfg.json")),
        (["compare"], ("name one or more",)),
        (["data", "check", "gone"], ("gone", "no such folder")),
        (["sfm", "gone"], ("gone", "no such folder")),
        (["demo", "here", "--views", "2"], ("2 views", "use 4")),
        (["doctor", "--lpips-alex", "gone"], ("gone", "LPIPS")),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_the_other_subcommands_name_what_is_wrong(
    pop: Pop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], parts: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    says(pop(*words), *parts)
    assert list(tmp_path.iterdir()) == []


def test_a_result_that_was_never_saved_is_named(pop: Pop, result: Path) -> None:
    for path in [*(result / "ckpts").iterdir(), *(result / "ply").iterdir()]:
        path.unlink()
    says(pop("eval", result), "no checkpoint and no PLY", "--resume")


def test_an_unknown_setting_in_cfg_json_is_named(pop: Pop, result: Path) -> None:
    config = json.loads((result / "cfg.json").read_text())
    (result / "cfg.json").write_text(json.dumps({**config, "resolved": {**config["resolved"], "colour": 1}}))
    says(pop("eval", result), "config.colour", "not a setting")


@pytest.mark.parametrize("text", ["", "{oops", '{"max_steps": 0}'], ids=["empty", "not JSON", "out of range"])
@pytest.mark.parametrize("command", ["eval", "compare", "report"])
def test_a_damaged_cfg_json_is_named_by_its_path(pop: Pop, result: Path, command: str, text: str) -> None:
    (result / "cfg.json").write_text(text)
    says(pop(command, result), str(result / "cfg.json"), "repair the file")


def test_a_cfg_json_in_another_encoding_is_named(pop: Pop, result: Path) -> None:
    (result / "cfg.json").write_bytes("{}".encode("utf-16"))
    says(pop("eval", result), str(result / "cfg.json"), "repair the file")


def test_a_capture_that_is_no_longer_there_is_asked_for(pop: Pop, capture: Path, result: Path) -> None:
    config = json.loads((result / "cfg.json").read_text())
    (result / "cfg.json").write_text(
        json.dumps({**config, "resolved": {**config["resolved"], "data": str(capture.parent / "gone")}})
    )
    says(pop("eval", result), str(capture.parent / "gone"), "not there", "--capture DIR")
    assert pop("eval", result, "--capture", capture).status == 0


def test_held_out_views_too_small_to_be_measured_are_named(pop: Pop, shared_result: Path) -> None:
    checkpoint = shared_result / "ckpts" / "ckpt_29_rank0.pt"
    says(pop("eval", checkpoint, "--factor", "4"), "view_000.png is 10 x 8 px", "lower --factor")


def test_endings_may_be_written_in_capitals(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    for source in (shared_result / "ply" / "point_cloud_29.ply", shared_result / "ckpts" / "ckpt_29_rank0.pt"):
        loud = tmp_path / f"LOUD{source.suffix.upper()}"
        loud.write_bytes(source.read_bytes())
        pop.done("export", loud, "--out", tmp_path / f"{source.suffix[1:]}.splat")
