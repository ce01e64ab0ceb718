"""`pop train --blocks`: blocks are trained each by itself, merged without overlap, and resumed where they stopped.

Their cores tile the ground, each point belongs to one, and no view is left out. In rounds, merged blocks are trained
on, each its core among all others, and merged again. A Snakemake workflow runs them where it is installed.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.api.backend import get_backend
from pop_fast.blocks import jobs
from pop_fast.blocks.jobs import block_folder, parts_of
from pop_fast.blocks.plan import Job, Partition, Plan, divide, grid_of, make_plan, read_job, read_plan
from pop_fast.blocks.rounds import write_round_block
from pop_fast.blocks.run import TAKEN
from pop_fast.children import module_command, python_command
from pop_fast.cli import main
from pop_fast.data.capture import Capture, View
from pop_fast.data.load import in_picture, list_capture, load_capture, write_block
from pop_fast.errors import PopError
from pop_fast.train.checkpoint import load_splats, save_checkpoint
from pop_fast.train.choose import LAUNCHED
from pop_fast.train.evaluate import evaluate
from pop_fast.train.load_result import CaptureRecord, load_splat, read_record
from pop_fast.train.model import KEYS
from pop_fast.train.results import ResultFolder, read_config
from pop_fast.train.views import ViewTensors
from tests.app.captures import assert_one_line, write_photograph
from tests.app.conftest import TRAIN, Outcome, Pop, done, wait_until
from tests.app.damage import says
from tests.app.tiny import interrupt, skip_without, tiny_capture

SETTINGS = (*TRAIN, "--skip-sizes", "--threads", "1")
BLOCKS = ("--blocks", "2x1", "--blocks-rounds", "0", *SETTINGS)
ROUNDS = ("--blocks", "2x1", *SETTINGS, "--checkpoint-every", "5")
TWO_ROUNDS = ("--blocks-rounds", "2", "--blocks-round-steps", "12")
NAMES = ("0_0", "1_0")
LAST = "ckpts/ckpt_29_rank0.pt"
Train = Callable[..., Outcome]


def in_this_process(words: Sequence[str], quiet: bool) -> int:
    """Do a part without the seconds that a new process takes to import torch."""
    assert list(words[:4]) == module_command("pop_fast.cli")
    return main(list(words[4:]))


def one_process(patch: pytest.MonkeyPatch, run: Callable[..., int] = in_this_process) -> None:
    patch.setattr(jobs, "_run", run)
    patch.setattr(jobs, "has_snakemake", lambda: False)


@pytest.fixture(autouse=True)
def _one_process(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    if "processes" not in request.keywords:
        one_process(monkeypatch)


def trained(made_once: Callable[..., Path], name: str, words: Sequence[object], run=in_this_process) -> Path:
    def make(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            one_process(patch, run)
            assert main(["train", *map(str, words), "--out", str(folder / "toy")]) == 0

    return made_once(name, make) / "toy"


@pytest.fixture(scope="module")
def shared_blocks(shared_capture: Path, made_once: Callable[..., Path]) -> Path:
    return trained(made_once, "blocks", [shared_capture, *BLOCKS])


@pytest.fixture
def blocks(shared_blocks: Path, tmp_path: Path) -> Path:
    """A copy of the run in blocks that a test may change; its blocks still name the first folder's capture alone."""
    return Path(shutil.copytree(shared_blocks, tmp_path / "blocks_run"))


@pytest.fixture(scope="module")
def shared_rounds(shared_capture: Path, made_once: Callable[..., Path]) -> Path:
    return trained(made_once, "rounds", [shared_capture, *ROUNDS, *TWO_ROUNDS])


@pytest.fixture
def rounds(shared_rounds: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(shared_rounds, tmp_path / "rounds"))


@pytest.fixture
def train(pop: Pop, shared_capture: Path, tmp_path: Path) -> Train:
    """`pop train` on the tiny capture, into a folder that is not there yet where none is named."""
    return lambda *words, out=tmp_path / "out": pop("train", shared_capture, "--out", out, *words)


def splats(folder: Path) -> dict[str, torch.Tensor]:
    return load_splats(folder / LAST)[0]


def assert_same(ours: dict[str, torch.Tensor], theirs: dict[str, torch.Tensor]) -> None:
    assert all(torch.equal(ours[key], value) for key, value in theirs.items())


def stats_of(folder: Path) -> dict:
    found = ResultFolder(folder).read_stats("val", 29)
    assert found is not None
    return found


def written(folder: Path) -> dict[str, int]:
    return {name: (folder / "blocks" / name / "result" / LAST).stat().st_mtime_ns for name in NAMES}


def test_the_merged_splat_is_what_each_block_has_in_its_core_and_nothing_twice(shared_blocks):
    merged, plan = splats(shared_blocks), read_plan(shared_blocks)
    partition, entries = plan
    whole = partition.block_of(merged["means"].double().numpy())
    assert np.array_equal(whole, np.sort(whole))
    assert set(whole) == {0, 1}
    for number, entry in enumerate(entries):
        own = splats(shared_blocks / "blocks" / entry["name"] / "result")
        kept = torch.from_numpy(partition.block_of(own["means"].double().numpy()) == number)
        assert 0 < kept.sum() < len(kept)
        for key, value in own.items():
            assert torch.equal(merged[key][torch.from_numpy(whole == number)], value[kept])


def test_statistics_are_those_of_the_whole_and_name_what_each_block_took(shared_blocks, shared_capture):
    stats = stats_of(shared_blocks)
    assert (stats["views"], stats["method"]) == (1, "pop")
    assert list(stats["per_view"]) == [view.name for view in load_capture(shared_capture).test_views()]
    assert stats["num_GS"] == sum(block["kept"] for block in stats["blocks"])
    assert [block["name"] for block in stats["blocks"]] == list(NAMES)
    assert all(block["memory_bytes"] > 0 and block["seconds_total"] > 0 for block in stats["blocks"])
    assert stats["memory_bytes"] >= max(block["memory_bytes"] for block in stats["blocks"])
    assert {path.name for path in shared_blocks.iterdir()} >= {"report.html", "viewer.html", "cfg.json", "renders"}
    assert (shared_blocks / "blocks" / "map.png").read_bytes().startswith(b"\x89PNG")


def test_a_block_is_trained_on_its_own_views_and_points_in_the_frame_of_the_whole(shared_blocks, shared_capture):
    whole, plan = load_capture(shared_capture), read_plan(shared_blocks)
    by_name = {view.name: view for view in whole.views}
    for entry in plan[1]:
        block = load_capture(shared_blocks / "blocks" / entry["name"])
        assert len(block.train_views()) == entry["training_views"]
        assert len(block.test_views()) == entry["held_out_views"]
        assert len(block.points) == entry["points"] + entry["background_points"] <= len(whole.points)
        for view in block.views:
            for name in ("viewmat", "K", "image"):
                assert np.array_equal(getattr(view, name), getattr(by_name[view.name], name))
        assert np.array_equal(block.world_transform, whole.world_transform)
        assert {tuple(point) for point in block.points} <= {tuple(point) for point in whole.points}


def test_other_commands_take_the_merged_folder_for_a_result(pop: Pop, blocks, shared_capture, tmp_path):
    line = f"PSNR       {stats_of(blocks)['psnr']:.3f} dB"
    assert line in pop.done("eval", blocks).out
    pop.done("export", blocks, "--out", tmp_path / "whole.ply")
    assert pop("eval", tmp_path / "whole.ply", "--capture", shared_capture).out.splitlines()[1] == line
    pop.done("render", blocks, "--out", tmp_path / "pictures")
    pop.done("report", blocks)


def test_what_is_finished_is_not_done_again_and_overwriting_begins_anew(train: Train, blocks):
    before = written(blocks)
    assert "are trained and merged" in done(train(*BLOCKS, "--resume", out=blocks))
    (blocks / "blocks" / "merged").unlink()
    done(train(*BLOCKS, "--resume", out=blocks))
    assert written(blocks) == before
    (blocks / "blocks" / "litter").write_text("of the run before")
    done(train(*BLOCKS, "--overwrite", out=blocks))
    assert all(written(blocks)[name] > before[name] for name in NAMES)
    assert not (blocks / "blocks" / "litter").exists()


def test_a_block_that_was_interrupted_goes_on_to_the_same_bits(pop, train, shared_blocks, tmp_path, monkeypatch):
    folder, words = tmp_path / "out", (*BLOCKS, "--checkpoint-every", "5")
    with monkeypatch.context() as patch:
        interrupt(patch, at=11)
        stopped = train(*words)
    assert stopped.status == 130
    assert "with --resume continues" in stopped.err
    assert not (folder / "blocks" / "0_0" / "trained").exists()
    assert pop("eval", folder).err.count("\n") == 1
    assert "continuing from step" in done(train(*words, "--resume"))
    assert_same(splats(folder), splats(shared_blocks))


def test_a_run_of_the_native_step_goes_on_with_other_threads_to_the_same_bits(
    train, shared_blocks, tmp_path, monkeypatch
):
    skip_without("compiled")
    folder = tmp_path / "out"
    with monkeypatch.context() as patch:
        interrupt(patch, at=11)
        assert train(*BLOCKS, "--checkpoint-every", "5").status == 130
    assert "continuing from step" in done(train(*BLOCKS[:-1], 2, "--checkpoint-every", "5", "--resume"))
    results = [folder / "blocks" / name / "result" for name in NAMES]
    assert [read_config(result).threads for result in (folder, *results)] == [2, 2, 2]
    assert_same(splats(folder), splats(shared_blocks))


def test_a_run_by_autograd_whose_sums_depend_on_threads_keeps_them(train: Train, monkeypatch):
    with monkeypatch.context() as patch:
        interrupt(patch, at=1)
        assert train(*BLOCKS, "--backend", "fast").status == 130
    again = train(*BLOCKS[:-1], 2, "--backend", "fast", "--resume")
    says(again, "was begun with threads = 1, but this run has threads = 2")


def test_a_run_that_is_gone_on_with_otherwise_is_refused(train: Train, blocks, result):
    again = partial(train, out=blocks)
    says(again(*BLOCKS, "--blocks", "1x2", "--resume"), "blocks.blocks = 2x1")
    says(again(*BLOCKS, "--blocks-margin", "0.3", "--resume"), "blocks.margin = 0.2")
    says(again(*BLOCKS, "--seed", "1", "--resume"), "seed = 42")
    says(again(*TRAIN, "--resume"), "resume it with --blocks 2x1")
    says(again(*BLOCKS), "--overwrite")
    says(train(*BLOCKS, "--resume", out=result), "begun without blocks")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--blocks", "2"), "two whole numbers"),
        (("--blocks", "1x1"), "is the whole capture"),
        (("--blocks", "4x2"), "needs 8 training views or more, and there are 7"),
        (("--blocks", "2x1", "--blocks-margin", "2"), "between 0 and 1"),
        (("--blocks", "2x1", "--blocks-share", "0"), "over 0"),
        (("--blocks", "2x1", "--blocks-jobs", "0"), "must be 1 or more"),
        (("--blocks", "2x1", "--blocks-jobs", "2"), "needs Snakemake"),
        (("--blocks", "2x1", "--blocks-profile", "slurm"), "needs Snakemake"),
        (("--blocks", "2x1", "--exposure"), "blocks would not"),
        (("--blocks", "2x1", "--refine-cameras"), "blocks would not"),
        (("--blocks", "2x1", "--max-gaussians", "50"), "needs all training photographs"),
        (("--blocks-margin", "0.1"), "add --blocks 2x2"),
        (("--blocks-jobs", "2"), "add --blocks 2x2"),
        (("--blocks-rounds", "1"), "add --blocks 2x2"),
        (("--blocks-round-steps", "10"), "add --blocks 2x2"),
        (("--blocks", "2x1", "--blocks-rounds", "-1"), "must be from 0 to 100"),
        (("--blocks", "2x1", "--blocks-rounds", "101"), "must be from 0 to 100"),
        (("--blocks", "2x1", "--blocks-rounds", "1", "--blocks-round-steps", "0"), "must be 1 or more"),
        (("--blocks", "2x1", "--blocks-rounds", "0", "--blocks-round-steps", "5"), "there are no rounds"),
    ],
)
def test_what_cannot_be_is_said_in_a_line_and_nothing_is_written(train: Train, tmp_path, words, said):
    says(train(*TRAIN, *words), said)
    assert not (tmp_path / "out").exists()


def test_processes_that_train_together_and_the_viewer_are_refused(train: Train, monkeypatch):
    monkeypatch.setattr("pop_fast.cli.train.check_viewer", lambda options: None)
    assert "--view shows one training" in train(*BLOCKS, "--view").err
    for name in LAUNCHED:
        monkeypatch.setenv(name, "2")
    assert "without torchrun" in train(*BLOCKS, "--batch-size", "2").err


def test_parts_ask_for_what_comes_before_them(pop: Pop, result, blocks):
    assert "is not a run in blocks" in pop("blocks", "merge", result).err
    assert "its blocks are 0_0, 1_0" in pop("blocks", "train", blocks, "7_7").err
    assert "its blocks are 0_0, 1_0" in pop("blocks", "train", blocks).err
    assert "leave 0_0 out" in pop("blocks", "merge", blocks, "0_0").err
    shutil.rmtree(blocks / "blocks" / "1_0" / "result")
    assert "no such file or folder" in pop("blocks", "merge", blocks).err
    (blocks / "blocks" / "plan.json").unlink()
    assert "is not divided yet" in pop("blocks", "merge", blocks).err
    assert "is not divided yet" in pop("blocks", "train", blocks, "0_0").err
    assert pop.done("blocks", "partition", blocks).out.startswith("block")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("job.json", b"{}", "job.json: is not what 'pop train --blocks' writes"),
        ("job.json", b'{"blocks": "2x1", "colour": 3}', "job.json"),
        ("job.json", b'{"blocks": "2x1", "coarse": "two"}', "coarse"),
        ("plan.json", b'{"blocks": []}', "plan.json"),
        ("0_0/block.json", b'{"capture": "/nowhere"}', "block.json"),
        ("0_0/block.json", b"\xff", "block.json"),
        ("0_0/points.npz", b"PK", "points.npz"),
    ],
)
def test_a_damaged_file_is_named(pop: Pop, blocks, name, content, said):
    (blocks / "blocks" / name).write_bytes(content)
    says(pop("blocks", "train", blocks, "0_0"), said)


def test_a_capture_that_has_gone_is_named(blocks):
    path = blocks / "blocks" / "0_0" / "block.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "capture": str(blocks / "gone")}))
    assert_one_line(lambda: load_capture(path.parent), "which is not there", "put the capture back")


def test_cameras_alone_and_held_out_photographs_alone_are_those_of_the_whole(shared_capture):
    whole = load_capture(shared_capture, factor=2)
    for photographs, read in (("held out", {0}), ("none", set())):
        part = load_capture(shared_capture, factor=2, photographs=photographs)
        assert np.array_equal(part.world_transform, whole.world_transform)
        assert np.array_equal(part.points, whole.points)
        for index, (view, other) in enumerate(zip(part.views, whole.views, strict=True)):
            for name in ("name", "width", "height", "split"):
                assert getattr(view, name) == getattr(other, name)
            assert np.array_equal(view.K, other.K)
            assert np.array_equal(view.viewmat, other.viewmat)
            assert view.was_read == (index in read)
            if view.was_read:
                assert np.array_equal(view.image, other.image)
            else:
                # no memory for pixels that nobody has asked for
                assert view.image.strides[:2] == (0, 0)
                with pytest.raises(PopError, match="was not read"):
                    ViewTensors.of(view)


def test_a_block_none_of_whose_photographs_has_a_mask_is_read_and_one_with_masks_keeps_them(capture, tmp_path):
    listing = list_capture(capture)
    names = [shot.name for shot in listing.shots]
    write_photograph(capture / "masks" / f"{Path(names[1]).stem}.png", np.full((32, 40), 255, np.uint8))
    whole = load_capture(capture)
    assert [view.mask is not None for view in whole.views] == [name == names[1] for name in names]
    for chosen, masked in ((names[:3], [False, True, False]), (names[3:], [False] * 5)):
        shots = [replace(shot, split="train") for shot in listing.shots if shot.name in chosen]
        write_block(tmp_path / "block", replace(listing, shots=shots, transform=whole.world_transform))
        assert [view.mask is not None for view in load_capture(tmp_path / "block").views] == masked
        assert all(view.mask is None for view in load_capture(tmp_path / "block", masks=False).views)


@pytest.mark.processes
@pytest.mark.slow  # processes that train
def test_parts_are_processes_of_their_own_and_are_stopped_by_sigterm(shared_capture, tmp_path):
    folder = tmp_path / "out"
    long = ("--checkpoint-every", "100", "--max-steps", "200000", "--eval-steps", "--save-steps")
    # with Snakemake, where that is installed, the workflow runs the blocks
    alone = "import sys; from pop_fast.blocks import jobs; jobs.has_snakemake = lambda: False; "
    alone += "from pop_fast.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", alone, "train", str(shared_capture), "--out", str(folder), *BLOCKS, *long]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        wait_until(lambda: list(folder.glob("blocks/0_0/result/ckpts/*")), process)
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=60.0)
    assert process.returncode == 130, err
    assert "stopped after step" in err
    assert "the same command with --resume continues" in err
    assert "block 0_0, 1 of 2" in out
    assert not (folder / "blocks" / "1_0" / "result").exists()


# How the ground is divided, and who trains on which views and points.

GRIDS = st.tuples(st.integers(1, 4), st.integers(1, 4)).filter(lambda grid: grid != (1, 1))
# coarse coordinates, so that cameras share some of them and points lie on borders
COARSE = st.integers(-8, 8).map(lambda n: 0.25 * n)
PLACES = st.lists(st.tuples(COARSE, COARSE, COARSE), min_size=4, max_size=40)


@given(PLACES, GRIDS, PLACES, st.sampled_from([0.0, 0.2, 1.0]))
def test_every_point_lies_in_one_core_which_lies_within_its_margins_and_json_keeps_all(places, grid, more, margin):
    try:
        partition = divide(np.array(places), grid)
    except PopError:
        # so many cameras stand at one place that it is refused
        return
    # and some points on the borders, as exactly as floats can
    borders = [(u, v) for u in (*partition.strips, -50.0, 50.0) for v in (*partition.cores.ravel(), -50.0, 50.0)]
    on_borders = np.array(borders) @ partition.axes + partition.origin
    points = np.concatenate([np.array(more).reshape(-1, 3), on_borders])
    ground, block = partition.on_ground(points), partition.block_of(points)
    inside = np.zeros(len(points), int)
    for number in range(len(partition.names)):
        box = partition.box(number)
        here = np.all((ground >= box[:, 0]) & (ground < box[:, 1]), axis=1)
        inside += here
        assert np.array_equal(here, block == number)
        # a core lies within its own margin, and a wider margin holds a narrower one
        within = partition.inside(number, points, margin)
        assert np.all(within[here])
        assert np.all(partition.inside(number, points, margin + 0.5)[within])
    assert np.all(inside == 1)
    assert np.array_equal(partition.inside(0, points, 0.0), block == 0)
    again = Partition.of(json.loads(json.dumps(partition.plain())))
    assert again.names == partition.names
    assert np.array_equal(again.block_of(points), block)


@given(st.integers(0, 2**32 - 1), GRIDS, st.integers(0, 60))
def test_cores_hold_equally_many_cameras_give_or_take_one_for_each_cut(seed, grid, more):
    k, l = grid
    centers = np.random.default_rng(seed).normal(size=(k * l + more, 3)) * [5.0, 2.0, 0.1]
    count = np.bincount(divide(centers, grid).block_of(centers), minlength=k * l)
    # a strip is rounded once, and its cores once more
    assert count.max() - count.min() <= 2
    assert count.sum() == len(centers)


def test_the_first_axis_is_that_of_greatest_spread_and_height_is_left_out():
    generator = np.random.default_rng(0)
    partition = divide(generator.normal(size=(200, 3)) * [0.1, 3.0, 9.0], (2, 2))
    assert np.allclose(np.abs(partition.axes), [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], atol=0.1)
    assert np.allclose(partition.axes @ partition.axes.T, np.eye(2))
    # the world may be moved, and the blocks stay
    generator = np.random.default_rng(1)
    centers, points = generator.normal(size=(60, 3)) * [5.0, 2.0, 0.5], generator.normal(size=(500, 3)) * 4.0
    partition = divide(centers, (3, 2))
    moved = divide(7.0 * centers + [100.0, -20.0, 3.0], (3, 2))
    assert np.array_equal(moved.block_of(7.0 * points + [100.0, -20.0, 3.0]), partition.block_of(points))


def test_a_grid_is_read_and_one_that_is_none_is_refused():
    assert [grid_of(text) for text in ("2x2", "3X1", " 10×4 ")] == [(2, 2), (3, 1), (10, 4)]
    for text in ("", "2", "2x", "x2", "0x2", "2x0", "-1x2", "2x2x2", "2 2", "a", "1x1", "65x1", "9999999x1"):
        assert_one_line(partial(grid_of, text), "--blocks")
    # so are too few cameras and cameras at one place
    assert_one_line(lambda: divide(np.eye(3), (2, 2)), "needs 4 training views", "there are 3")
    at_one_place = np.concatenate([np.zeros((9, 3)), [[1.0, 0.0, 0.0]]])
    message = assert_one_line(lambda: divide(at_one_place, (3, 1)), "no training view", "fewer blocks")
    assert "block 1_0" in message or "block 0_0" in message


def planned(capture: Capture | None = None, **settings: float) -> Plan:
    return make_plan(capture or tiny_capture(n_views=20), Job(blocks="2x2", **settings), 5)


@pytest.mark.parametrize("share", [0.05, 0.25, 1.0])
def test_every_view_is_in_a_block_and_every_point_too(share):
    capture = tiny_capture(n_views=20)
    plan = planned(capture, share=share)
    train = {view.name for view in capture.train_views(5)}
    assert set().union(*(block.views for block in plan.blocks)) == train
    held_out = [name for block in plan.blocks for name in block.held_out]
    assert sorted(held_out) == [view.name for view in capture.test_views(5)]
    assert not train & set(held_out)
    core = plan.partition.block_of(capture.points)
    for number, block in enumerate(plan.blocks):
        own = block.points[: len(block.points) - block.background]
        assert set(np.flatnonzero(core == number)) <= set(own)
        assert len(set(block.points)) == len(block.points)
        assert block.background <= len(own)
    assert sum(block.own_views for block in plan.blocks) == len(train)


def test_a_view_trains_a_block_that_fills_enough_of_its_picture_and_a_wider_margin_takes_more():
    few, many = planned(share=0.9, margin=0.0), planned(share=0.05, margin=0.0)
    assert all(tight.views <= loose.views for tight, loose in zip(few.blocks, many.blocks, strict=True))
    assert sum(len(block.views) for block in few.blocks) < sum(len(block.views) for block in many.blocks)
    narrow, wide = planned(margin=0.0, share=1.0), planned(margin=0.5, share=1.0)
    for inner, outer in zip(narrow.blocks, wide.blocks, strict=True):
        assert inner.views <= outer.views
        assert len(inner.points) - inner.background <= len(outer.points) - outer.background


def test_a_block_without_points_a_capture_without_any_and_numbers_out_of_range_are_refused():
    capture = tiny_capture(n_views=20)
    far = replace(capture, points=np.full_like(capture.points, 50.0))
    assert_one_line(lambda: planned(far), "has no sparse point", "fewer blocks")
    none = replace(capture, points=capture.points[:0], points_rgb=capture.points_rgb[:0])
    assert_one_line(lambda: planned(none), "no sparse points", "pop sfm")
    # before anything is trained, since no capture has one view
    few = tiny_capture(n_views=4)
    places = np.concatenate([few.points, few.camera_centers])
    around = replace(few, points=places, points_rgb=np.zeros(places.shape, np.uint8))
    alone = partial(make_plan, around, Job(blocks="2x2", margin=0.0, share=1.0), 0)
    assert_one_line(alone, "block 0_0", "one view alone", "--blocks-share")
    for name, value in (("margin", -0.1), ("margin", 1.5), ("share", 0.0), ("share", 1.1)):
        assert_one_line(partial(Job, blocks="2x2", **{name: value}), f"--blocks-{name} is {value}")


# Rounds: merged blocks are trained on, each its core among all others, and merged again.


def core(folder: Path, number: int, name: str) -> dict[str, torch.Tensor]:
    return load_splats(folder / "blocks" / f"round_{number}" / f"{name}.pt")[0]


def merged(folder: Path, number: int) -> dict[str, torch.Tensor]:
    if number == 2:
        return load_splat(folder).params
    parts = [core(folder, number, name) for name in NAMES]
    return {key: torch.cat([part[key] for part in parts]) for key in KEYS}


def test_a_block_trains_its_core_and_holds_what_its_views_see_of_the_others(shared_rounds):
    for name, other in (NAMES, NAMES[::-1]):
        folder = shared_rounds / "blocks" / "round_1" / name
        after = load_splat(folder / "result").params
        before, around = core(shared_rounds, 0, name), core(shared_rounds, 0, other)
        counts, own = json.loads((folder / "start.json").read_text()), len(before["means"])
        assert counts["own"] == own
        assert 0 < counts["fixed"] <= len(around["means"])
        assert counts["merged"] == own + len(around["means"])
        fixed = after["means"][own:].tolist()
        assert len(fixed) == counts["fixed"]
        assert {tuple(row) for row in fixed} <= {tuple(row) for row in around["means"].tolist()}
        assert (after["means"][:own] != before["means"]).any()


def test_a_round_draws_as_many_views_as_the_block_has_from_all_that_show_its_core(shared_rounds):
    places = [(number, name) for number in range(3) for name in NAMES]
    views = {(number, name): load_capture(block_folder(shared_rounds, name, number)) for number, name in places}

    def names(number: int, name: str) -> set[str]:
        return {view.name for view in views[number, name].train_views()}

    for number in (1, 2):
        for name in NAMES:
            own, found = views[0, name], views[number, name]
            assert len(found.train_views()) == len(own.train_views())
            assert names(number, name) <= names(0, "0_0") | names(0, "1_0")
            assert [view.name for view in found.test_views()] == [view.name for view in own.test_views()]
            points = core(shared_rounds, number - 1, name)["means"].double().numpy()
            assert all(in_picture(points, view).any() for view in found.train_views())
    assert len(names(0, "1_0")) == 3
    assert names(1, "1_0") != names(2, "1_0")
    assert not names(1, "1_0") | names(2, "1_0") <= names(0, "1_0")


def all_of(folder: Path) -> list[View]:
    listed = [load_capture(block_folder(folder, name), photographs="none").train_views() for name in NAMES]
    return list({view.name: view for views in listed for view in views}.values())


def test_views_that_show_nothing_of_a_core_are_not_drawn(rounds):
    config, record = read_config(rounds), read_record(rounds) or CaptureRecord()
    every = load_capture(block_folder(rounds, "0_0", 0)).train_views()
    assert len(every) == 7
    # in the middle of one view's picture, a hair before its lens: out of the others' pictures
    alone = (every[2].camera_center + 1e-3 * every[2].viewmat[2, :3]).astype(np.float32)[None]
    showing = {view.name for view in every if in_picture(alone.astype(np.float64), view).any()}
    assert showing < {view.name for view in every}
    write_round_block(rounds, config, record, list(NAMES), "0_0", 7, alone)
    drawn = load_capture(block_folder(rounds, "0_0", 7), photographs="none")
    assert {view.name for view in drawn.train_views()} == showing
    # one view, and none held out, would be no capture: the block keeps its own
    place = block_folder(rounds, "0_0", 0) / "block.json"
    listed = json.loads(place.read_text())
    listed["photographs"] = [one for one in listed["photographs"] if one["split"] == "train"]
    place.write_text(json.dumps(listed))
    anywhere = np.random.default_rng(0).uniform(-9.0, 9.0, (999, 3)).astype(np.float32)
    shown = np.sum([in_picture(anywhere.astype(np.float64), view) for view in all_of(rounds)], axis=0)
    write_round_block(rounds, config, record, list(NAMES), "0_0", 8, anywhere[shown == 1][:1])
    assert len(load_capture(block_folder(rounds, "0_0", 8), photographs="none").train_views()) == 7


def test_the_merge_takes_a_share_of_what_every_block_has_changed(shared_rounds):
    halves, plan = [], read_plan(shared_rounds)
    for number, name in enumerate(NAMES):
        before = core(shared_rounds, 1, name)
        after = load_splat(shared_rounds / "blocks" / "round_2" / name / "result").params
        halves.append({key: value.lerp(after[key][: len(value)], TAKEN) for key, value in before.items()})
        assert (plan[0].block_of(before["means"].double().numpy()) == number).all()
    assert_same(merged(shared_rounds, 2), {key: torch.cat([half[key] for half in halves]) for key in KEYS})


def test_every_round_lowers_the_error_of_the_training_photographs(shared_rounds, shared_capture):
    config = load_splat(shared_rounds).config
    views = [ViewTensors.of(view) for view in load_capture(shared_capture).train_views()]
    found = [evaluate(get_backend("fast"), merged(shared_rounds, number), views, config, 3) for number in range(3)]
    psnr = [each["psnr"] for each in found]
    assert psnr[0] + 0.1 < psnr[1] < psnr[2]


def test_statistics_say_what_every_round_came_to(shared_rounds):
    stats = stats_of(shared_rounds)
    assert [found["round"] for found in stats["rounds"]] == [0, 1, 2]
    assert len({found["num_GS"] for found in stats["rounds"]}) == 1
    assert stats["rounds"][2]["psnr"] == stats["psnr"] > stats["rounds"][0]["psnr"]
    for found in (stats, *stats["rounds"][1:]):
        assert [block["name"] for block in found["blocks"]] == list(NAMES)
        assert found["seconds"] > 0 < found["memory_bytes"] <= stats["memory_bytes"]
    assert all(block["kept"] > 0 for block in stats["blocks"])
    assert stats["seconds"] == pytest.approx(sum(found["seconds"] for found in stats["rounds"]))


def test_without_rounds_nothing_of_them_is_there_and_they_can_be_added(train: Train, shared_rounds, tmp_path):
    folder = tmp_path / "out"
    assert "merged after" not in done(train(*ROUNDS, "--blocks-rounds", "0"))
    assert "rounds" not in stats_of(folder)
    assert not list((folder / "blocks").glob("round_*"))
    assert_same(load_splat(folder).params, merged(shared_rounds, 0))
    # a run of before there were rounds is one without
    path = folder / "blocks" / "job.json"
    job = path.read_text()
    path.write_text(json.dumps({k: v for k, v in json.loads(job).items() if not k.startswith("round")}))
    assert "are trained and merged" in done(train(*ROUNDS, "--resume"))
    path.write_text(job)
    for rounds in ("1", "2"):
        said = done(train(*ROUNDS, "--blocks-rounds", rounds, *TWO_ROUNDS[2:], "--resume"))
    assert "block 0_0, 1 of 2" not in said.replace("round 2 of 2: block 0_0", "")
    assert_same(load_splat(folder).params, merged(shared_rounds, 2))
    # what is not said is as the run was begun
    assert "are trained and merged" in done(train(*ROUNDS, "--resume"))


def test_a_round_that_was_interrupted_goes_on_to_the_same_bits(train: Train, shared_rounds, tmp_path, monkeypatch):
    folder = tmp_path / "out"
    done(train(*ROUNDS, "--blocks-rounds", "0"))
    with monkeypatch.context() as patch:
        interrupt(patch, at=7)
        stopped = train(*ROUNDS, *TWO_ROUNDS, "--resume")
    assert stopped.status == 130
    assert "stopped after step 7" in stopped.err
    assert (folder / "blocks" / "round_0" / "merged").is_file()
    assert not (folder / "blocks" / "round_1" / "0_0" / "trained").exists()
    assert done(train(*ROUNDS, *TWO_ROUNDS, "--resume")).count("continuing from step 5") == 1
    assert_same(load_splat(folder).params, merged(shared_rounds, 2))


def by_parts(pop: Pop, folder: Path) -> None:
    """Do the second round part by part, in another order."""
    shutil.rmtree(folder / "blocks" / "round_2")
    (folder / "blocks" / "merged").unlink()
    for words in (("train", "1_0"), ("train", "0_0"), ("merge",)):
        pop.done("blocks", words[0], folder, *words[1:], "--round", "2")
    assert (folder / "blocks" / "merged").is_file()


def test_parts_can_be_done_one_by_one_and_a_core_without_gaussians_has_nothing_to_train(pop, rounds, shared_rounds):
    by_parts(pop, rounds)
    assert_same(load_splat(rounds).params, merged(shared_rounds, 2))
    none = {key: value[:0] for key, value in core(rounds, 1, "1_0").items()}
    save_checkpoint(rounds / "blocks" / "round_1" / "1_0.pt", {"step": 29, "splats": none})
    by_parts(pop, rounds)
    assert stats_of(rounds)["num_GS"] == len(core(rounds, 1, "0_0")["means"])


def test_a_part_of_a_round_asks_for_what_comes_before_it(pop: Pop, rounds):
    def refused(said: str, *words: object) -> None:
        says(pop("blocks", *words), said)

    round_0, round_1, result = (rounds / "blocks" / name for name in ("round_0", "round_1", "round_2/0_0/result"))
    refused("has no round 3, but rounds 0 to 2", "train", rounds, "0_0", "--round", "3")
    refused("has no round -1, but rounds 0 to 2", "merge", rounds, "--round", "-1")
    refused("applies to all rounds; leave --round out", "partition", rounds, "--round", "1")
    (round_1 / "1_0" / "start.json").unlink()
    refused(f"run pop blocks train {rounds} 1_0 --round 1", "merge", rounds, "--round", "1")
    (round_1 / "0_0" / "start.json").write_text('{"own": 1}')
    refused("is not what 'pop blocks train' writes", "merge", rounds, "--round", "1")
    (round_1 / "stats.json").unlink()
    refused(f"run pop blocks merge {rounds} --round 1", "merge", rounds)
    (round_0 / "merged").unlink()
    refused("starts from the merged blocks of round 0", "train", rounds, "0_0", "--round", "1")
    shutil.rmtree(result / "ckpts")
    shutil.rmtree(result / "ply")
    refused("holds no checkpoint", "merge", rounds)


def test_a_round_that_begins_otherwise_is_not_gone_on_with(pop: Pop, train: Train, rounds):
    for said, *words in (
        ("was begun with blocks.rounds = 2", "--blocks-rounds", "1"),
        ("was begun with blocks.round_steps = 12", "--blocks-round-steps", "5"),
        ("was begun with blocks.round_steps = 12", "--blocks-rounds", "3", "--blocks-round-steps", "5"),
    ):
        assert said in train(*ROUNDS, *words, "--resume", out=rounds).err
    other = core(rounds, 0, "1_0")
    other["sh0"] += 1.0
    save_checkpoint(rounds / "blocks" / "round_0" / "1_0.pt", {"step": 29, "splats": other})
    held = "held fixed are others than this training was begun with"
    says(pop("blocks", "train", rounds, "0_0", "--round", "1"), held)


def test_the_steps_of_a_round_are_a_tenth_unless_they_are_said(train: Train, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "_run", lambda words, quiet: 0)
    done(train(*ROUNDS))
    job = read_job(tmp_path / "out")
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


# The Snakemake workflow: what it would do, that it does it, and that the Slurm profile is read.

with_snakemake = pytest.mark.skipif(
    not jobs.has_snakemake(), reason="snakemake is not installed; pip install 'pop-splatting[blocks]' brings it"
)
TRAININGS = {"block_0_0": 1, "block_1_0": 1}


@pytest.fixture(scope="module")
def begun(shared_capture: Path, made_once: Callable[..., Path]) -> Path:
    """A run whose capture is divided, and whose blocks are not trained."""
    return trained(made_once, "workflow", [shared_capture, *BLOCKS], lambda words, quiet: 0)


@pytest.mark.processes
@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
def test_a_part_that_is_still_being_loaded_is_stopped_without_a_traceback(capfd):
    threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
    assert jobs._run(python_command("-c", "import time; time.sleep(60)"), False) == 130
    assert capfd.readouterr().err == ""


@pytest.fixture
def divided(begun: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(begun, tmp_path / "copy"))


def workflow(folder: Path, scratch: Path, profile: Path | None = None) -> str:
    job = read_job(folder)
    command = jobs.workflow_words(folder, job, 1, 1, "compiled", profile, "-n")
    environment = {**os.environ, "HOME": str(scratch), "XDG_CACHE_HOME": str(scratch / "cache")}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def counted(said: str) -> dict[str, int]:
    """Read the table of jobs that it prints, without the sum and what all wait for."""
    found = {name: int(count) for name, count in re.findall(r"^(\w+) +(\d+)$", said, re.MULTILINE)}
    assert found.pop("total") == sum(found.values())
    assert found.pop("all") == 1
    return found


@with_snakemake
def test_the_workflow_does_what_is_not_done_the_merge_last(divided, tmp_path):
    assert counted(workflow(divided, tmp_path)) == {**TRAININGS, "merge": 1}
    plan = (divided / "blocks" / "plan.json").rename(tmp_path / "plan.json")
    assert counted(workflow(divided, tmp_path)) == {"partition": 1, **TRAININGS, "merge": 1}
    plan.rename(divided / "blocks" / "plan.json")
    (divided / "blocks" / "0_0" / "trained").touch()
    assert counted(workflow(divided, tmp_path)) == {"block_1_0": 1, "merge": 1}


def with_rounds(folder: Path, rounds: int) -> Path:
    """Let a run have rounds, as `pop train --blocks-rounds` does with one that is resumed."""
    path = folder / "blocks" / "job.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "rounds": rounds, "round_steps": 3}))
    return folder


@with_snakemake
def test_a_round_of_the_workflow_waits_for_the_merge_before_it_and_its_merge_for_all_its_blocks(divided, tmp_path):
    order = re.findall(r"^(?:local)?rule (\w+):", workflow(with_rounds(divided, 2), tmp_path), re.MULTILINE)
    for wave in (
        {"block_0_0", "block_1_0"},
        {"round_0_merge"},
        {"round_1_block_0_0", "round_1_block_1_0"},
        {"round_1_merge"},
        {"round_2_block_0_0", "round_2_block_1_0"},
        {"merge"},
        {"all"},
    ):
        assert {order.pop(0) for _ in wave} == wave
    assert order == []


@with_snakemake
def test_rounds_that_are_added_to_a_workflow_do_its_merge_again_and_divide_and_train_nothing_anew(divided, tmp_path):
    for name in NAMES:
        (divided / "blocks" / name / "trained").touch()
    rounds = {"round_0_merge": 1, "round_1_block_0_0": 1, "round_1_block_1_0": 1}
    assert counted(workflow(with_rounds(divided, 1), tmp_path)) == {**rounds, "merge": 1}


@with_snakemake
@pytest.mark.processes
def test_the_workflow_reads_the_slurm_profile(begun, tmp_path):
    pytest.importorskip("snakemake_executor_plugin_slurm", reason="snakemake-executor-plugin-slurm is not installed")
    assert counted(workflow(begun, tmp_path, jobs.profile_folder("slurm"))) == {**TRAININGS, "merge": 1}


@with_snakemake
@pytest.mark.processes
def test_a_profile_of_the_workflow_that_is_none_is_refused(train: Train):
    says(train(*BLOCKS, "--blocks-profile", "nowhere"), "is neither one of slurm nor a folder with a config.yaml")


@pytest.mark.slow
@with_snakemake
@pytest.mark.processes
def test_the_workflow_trains_and_merges(train: Train, divided):
    done(train(*BLOCKS, "--blocks-rounds", "1", "--blocks-jobs", "2", "--resume", out=divided))
    assert (divided / "blocks" / "merged").is_file()
    assert len(stats_of(divided)["rounds"]) == 2
    assert "are trained and merged" in done(train(*BLOCKS, "--blocks-rounds", "1", "--resume", out=divided))
