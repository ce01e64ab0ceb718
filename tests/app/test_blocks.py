"""`pop train --blocks`: blocks are trained each by itself, merged without overlap, and resumed where they stopped.

Their cores tile the ground, each point belongs to one, and no view is left out.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.api.backend import get_backend
from pop_fast.blocks import jobs
from pop_fast.blocks.plan import Job, Partition, Plan, divide, grid_of, make_plan, read_plan
from pop_fast.children import module_command
from pop_fast.cli import main
from pop_fast.data.capture import Capture
from pop_fast.data.load import list_capture, load_capture, write_block
from pop_fast.errors import PopError
from pop_fast.train.checkpoint import load_splats
from pop_fast.train.results import ResultFolder, read_config
from pop_fast.train.views import ViewTensors
from tests.app.captures import assert_one_line, write_photograph
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import says
from tests.app.interruptions import interrupt
from tests.app.tiny import tiny_capture

BLOCKS = ("--blocks", "2x1", "--blocks-rounds", "0", *TRAIN, "--skip-sizes", "--threads", "1")
NAMES = ("0_0", "1_0")
LAST = "ckpts/ckpt_29_rank0.pt"


def in_this_process(words: Sequence[str], quiet: bool) -> int:
    """Do a part without the seconds that a new process takes to import torch."""
    assert list(words[:4]) == module_command("pop_fast.cli")
    return main(list(words[4:]))


@pytest.fixture(autouse=True)
def _one_process(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    if "processes" not in request.keywords:
        monkeypatch.setattr(jobs, "_run", in_this_process)
        monkeypatch.setattr("pop_fast.blocks.jobs.has_snakemake", lambda: False)


@pytest.fixture(scope="module")
def shared_blocks(shared_capture: Path, made_once: Callable[..., Path]) -> Path:
    """A run in two blocks that tests only read."""

    def make(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(jobs, "_run", in_this_process)
            patch.setattr("pop_fast.blocks.jobs.has_snakemake", lambda: False)
            assert main(["train", str(shared_capture), "--out", str(folder / "toy"), *BLOCKS]) == 0

    return made_once("blocks", make) / "toy"


@pytest.fixture
def blocks(shared_blocks: Path, tmp_path: Path) -> Path:
    """A copy of the run in blocks that a test may change; its blocks still name the first folder's capture alone."""
    return Path(shutil.copytree(shared_blocks, tmp_path / "blocks_run"))


def splats(folder: Path) -> dict[str, torch.Tensor]:
    return load_splats(folder / LAST)[0]


def stats_of(folder: Path) -> dict:
    found = ResultFolder(folder).read_stats("val", 29)
    assert found is not None
    return found


def written(folder: Path) -> dict[str, int]:
    return {name: (folder / "blocks" / name / "result" / LAST).stat().st_mtime_ns for name in NAMES}


def test_the_merged_splat_is_what_each_block_has_in_its_core_and_nothing_twice(shared_blocks):
    merged, plan = splats(shared_blocks), read_plan(shared_blocks)
    assert plan is not None
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
    assert stats["views"] == 1
    assert list(stats["per_view"]) == [view.name for view in load_capture(shared_capture).test_views()]
    assert stats["num_GS"] == sum(block["kept"] for block in stats["blocks"])
    assert [block["name"] for block in stats["blocks"]] == list(NAMES)
    assert all(block["memory_bytes"] > 0 and block["seconds_total"] > 0 for block in stats["blocks"])
    assert stats["memory_bytes"] >= max(block["memory_bytes"] for block in stats["blocks"])
    assert stats["method"] == "pop"
    assert {path.name for path in shared_blocks.iterdir()} >= {"report.html", "viewer.html", "cfg.json", "renders"}
    assert (shared_blocks / "blocks" / "map.png").read_bytes().startswith(b"\x89PNG")


def test_a_block_is_trained_on_its_own_views_and_points_in_the_frame_of_the_whole(shared_blocks, shared_capture):
    whole, plan = load_capture(shared_capture), read_plan(shared_blocks)
    assert plan is not None
    by_name = {view.name: view for view in whole.views}
    for entry in plan[1]:
        block = load_capture(shared_blocks / "blocks" / entry["name"])
        assert len(block.train_views()) == entry["training_views"]
        assert len(block.test_views()) == entry["held_out_views"]
        assert len(block.points) == entry["points"] + entry["background_points"] <= len(whole.points)
        for view in block.views:
            assert np.array_equal(view.viewmat, by_name[view.name].viewmat)
            assert np.array_equal(view.K, by_name[view.name].K)
            assert np.array_equal(view.image, by_name[view.name].image)
        assert np.array_equal(block.world_transform, whole.world_transform)
        assert {tuple(point) for point in block.points} <= {tuple(point) for point in whole.points}


def test_other_commands_take_the_merged_folder_for_a_result(pop: Pop, blocks):
    psnr = stats_of(blocks)["psnr"]
    measured = pop.done("eval", blocks)
    assert f"PSNR       {psnr:.3f} dB" in measured.out
    pop.done("export", blocks, "--out", blocks.parent / "whole.ply")
    assert (
        pop(
            "eval",
            blocks.parent / "whole.ply",
            "--capture",
            json.loads((blocks / "cfg.json").read_text())["resolved"]["data"],
        ).out.splitlines()[1]
        == f"PSNR       {psnr:.3f} dB"
    )
    pop.done("render", blocks, "--out", blocks.parent / "pictures")
    pop.done("report", blocks)


def test_what_is_finished_is_not_done_again(pop: Pop, shared_capture, blocks):
    before = written(blocks)
    again = pop.done("train", shared_capture, "--out", blocks, *BLOCKS, "--resume")
    assert "are trained and merged" in again.out
    (blocks / "blocks" / "merged").unlink()
    assert pop("train", shared_capture, "--out", blocks, *BLOCKS, "--resume").status == 0
    assert written(blocks) == before


def test_a_block_that_was_interrupted_goes_on_to_the_same_bits(
    pop: Pop, shared_capture, shared_blocks, tmp_path, monkeypatch
):
    folder = tmp_path / "stopped"
    words = ("train", shared_capture, "--out", folder, *BLOCKS, "--checkpoint-every", "5")
    with monkeypatch.context() as patch:
        interrupt(patch, at=11)
        stopped = pop(*words)
    assert stopped.status == 130
    assert "with --resume continues" in stopped.err
    assert not (folder / "blocks" / "0_0" / "trained").exists()
    assert pop("eval", folder).err.count("\n") == 1
    gone_on = pop.done(*words, "--resume")
    assert "continuing from step" in gone_on.out
    for key, value in splats(shared_blocks).items():
        assert torch.equal(splats(folder)[key], value)


def test_a_run_of_the_native_step_goes_on_with_other_threads_to_the_same_bits(
    pop: Pop, shared_capture, shared_blocks, tmp_path, monkeypatch
):
    reason = get_backend("compiled").why_not()
    if reason is not None:
        pytest.skip(reason)
    folder = tmp_path / "stopped"
    words = ("train", shared_capture, "--out", folder, *BLOCKS[:-1])
    with monkeypatch.context() as patch:
        interrupt(patch, at=11)
        assert pop(*words, 1, "--checkpoint-every", "5").status == 130
    gone_on = pop(*words, 2, "--checkpoint-every", "5", "--resume")
    assert gone_on.status == 0, gone_on.err
    assert "continuing from step" in gone_on.out
    results = [folder / "blocks" / name / "result" for name in NAMES]
    assert [read_config(result).threads for result in (folder, *results)] == [2, 2, 2]
    for key, value in splats(shared_blocks).items():
        assert torch.equal(splats(folder)[key], value)


def test_a_run_by_autograd_whose_sums_depend_on_threads_keeps_them(pop: Pop, shared_capture, tmp_path, monkeypatch):
    words = ("train", shared_capture, "--out", tmp_path / "stopped", *BLOCKS[:-1])
    with monkeypatch.context() as patch:
        interrupt(patch, at=1)
        assert pop(*words, 1, "--backend", "fast").status == 130
    gone_on = pop(*words, 2, "--backend", "fast", "--resume")
    assert gone_on.status == 2
    assert "was begun with threads = 1, but this run has threads = 2" in gone_on.err


def test_a_run_that_is_gone_on_with_otherwise_is_refused(pop: Pop, shared_capture, blocks, result):
    def refused(folder: Path, *words: str) -> str:
        outcome = pop("train", shared_capture, "--out", folder, *words)
        assert outcome.status == 2
        assert outcome.err.count("\n") == 1
        return outcome.err

    assert "blocks.blocks = 2x1" in refused(blocks, *BLOCKS, "--blocks", "1x2", "--resume")
    assert "blocks.margin = 0.2" in refused(blocks, *BLOCKS, "--blocks-margin", "0.3", "--resume")
    assert "seed = 42" in refused(blocks, *BLOCKS, "--seed", "1", "--resume")
    assert "resume it with --blocks 2x1" in refused(blocks, *TRAIN, "--resume")
    assert "begun without blocks" in refused(result, *BLOCKS, "--resume")
    assert "--overwrite" in refused(blocks, *BLOCKS)


def test_overwriting_begins_anew(pop: Pop, shared_capture, blocks):
    before = written(blocks)
    (blocks / "blocks" / "litter").write_text("of the run before")
    pop.done("train", shared_capture, "--out", blocks, *BLOCKS, "--blocks", "2x1", "--overwrite")
    assert all(written(blocks)[name] > before[name] for name in NAMES)
    assert not (blocks / "blocks" / "litter").exists()


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
        (("--blocks", "2x1", "--exposure"), "blocks would not agree on it"),
        (("--blocks", "2x1", "--refine-cameras"), "blocks would not agree on it"),
        (("--blocks", "2x1", "--max-gaussians", "50"), "looks at all training photographs"),
        (("--blocks-margin", "0.1"), "say --blocks 2x2 too"),
        (("--blocks-jobs", "2"), "say --blocks 2x2 too"),
    ],
)
def test_what_cannot_be_is_said_in_a_line_and_nothing_is_written(pop: Pop, shared_capture, tmp_path, words, said):
    says(pop("train", shared_capture, "--out", tmp_path / "out", *TRAIN, *words), said)
    assert not (tmp_path / "out").exists()


def test_processes_that_train_together_and_the_viewer_are_refused(pop: Pop, shared_capture, tmp_path, monkeypatch):
    monkeypatch.setattr("pop_fast.cli.train.check_viewer", lambda options: None)
    outcome = pop("train", shared_capture, "--out", tmp_path / "out", *BLOCKS, "--view")
    assert "--view shows one training" in outcome.err
    monkeypatch.setenv("WORLD_SIZE", "2")
    outcome = pop("train", shared_capture, "--out", tmp_path / "out", *BLOCKS, "--batch-size", "2")
    assert "without torchrun" in outcome.err


def test_parts_ask_for_what_comes_before_them(pop: Pop, result, blocks):
    assert "is no run in blocks" in pop("blocks", "merge", result).err
    assert "its blocks are 0_0, 1_0" in pop("blocks", "train", blocks, "7_7").err
    assert "its blocks are 0_0, 1_0" in pop("blocks", "train", blocks).err
    assert "leave 0_0 out" in pop("blocks", "merge", blocks, "0_0").err
    shutil.rmtree(blocks / "blocks" / "1_0" / "result")
    assert "no such file or folder" in pop("blocks", "merge", blocks).err
    (blocks / "blocks" / "plan.json").unlink()
    assert "is not divided yet" in pop("blocks", "merge", blocks).err
    assert "is not divided yet" in pop("blocks", "train", blocks, "0_0").err
    divided = pop.done("blocks", "partition", blocks)
    assert divided.out.startswith("block")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("job.json", b"{}", "job.json: is not what 'pop train --blocks' writes"),
        ("job.json", b'{"blocks": "2x1", "colour": 3}', "job.json"),
        ("plan.json", b'{"blocks": []}', "plan.json"),
        ("0_0/block.json", b'{"capture": "/nowhere"}', "block.json"),
        ("0_0/block.json", b"\xff", "block.json"),
        ("0_0/points.npz", b"PK", "points.npz"),
    ],
)
def test_a_damaged_file_is_named(pop: Pop, blocks, name, content, said):
    (blocks / "blocks" / name).write_bytes(content)
    says(pop("blocks", "train", blocks, "0_0"), said)


def test_a_capture_that_has_gone_is_named(pop: Pop, blocks):
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
            assert (view.name, view.width, view.height, view.split) == (
                other.name,
                other.width,
                other.height,
                other.split,
            )
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
def test_parts_are_processes_of_their_own_and_are_stopped_by_sigterm(shared_capture, tmp_path):
    folder = tmp_path / "out"
    long = ("--checkpoint-every", "100", "--max-steps", "200000", "--eval-steps", "--save-steps")
    # with Snakemake, where that is installed, the workflow runs the blocks
    alone = "import sys; from pop_fast.blocks import jobs; jobs.has_snakemake = lambda: False; "
    alone += "from pop_fast.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", alone, "train", str(shared_capture), "--out", str(folder), *BLOCKS, *long]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120.0
        while not list(folder.glob("blocks/0_0/result/ckpts/*")) and time.monotonic() < deadline:
            assert process.poll() is None
            time.sleep(0.1)
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=60.0)
    assert process.returncode == 130, err
    assert "stopped after step" in err
    assert "the same command with --resume continues" in err
    assert "block 0_0, 1 of 2" in out
    assert not (folder / "blocks" / "1_0" / "result").exists()


GRIDS = st.tuples(st.integers(1, 4), st.integers(1, 4)).filter(lambda grid: grid != (1, 1))
# coarse coordinates, so that cameras share some of them and points lie on borders
COARSE = st.integers(-8, 8).map(lambda n: 0.25 * n)
PLACES = st.lists(st.tuples(COARSE, COARSE, COARSE), min_size=4, max_size=40)


def divided(places: list[tuple[float, float, float]], grid: tuple[int, int]) -> Partition | None:
    """Divide, or return None where so many cameras stand at one place that it is refused."""
    try:
        return divide(np.array(places), grid)
    except PopError:
        return None


def points_of(partition: Partition, more: list[tuple[float, float, float]]) -> np.ndarray:
    """Add to points some that lie on the borders, as exactly as floats can."""
    us = [*partition.strips, -50.0, 50.0]
    vs = [*partition.cores.ravel(), -50.0, 50.0]
    ground = np.array([(u, v) for u in us for v in vs])
    return np.concatenate([np.array(more).reshape(-1, 3), ground @ partition.axes + partition.origin])


@given(PLACES, GRIDS, PLACES)
def test_every_point_of_the_world_lies_in_exactly_one_core(places, grid, more):
    partition = divided(places, grid)
    if partition is None:
        return
    points = points_of(partition, more)
    ground, block = partition.on_ground(points), partition.block_of(points)
    inside = np.zeros(len(points), int)
    for number in range(len(partition.names)):
        box = partition.box(number)
        here = np.all((ground >= box[:, 0]) & (ground < box[:, 1]), axis=1)
        inside += here
        assert np.array_equal(here, block == number)
    assert np.all(inside == 1)


@given(PLACES, GRIDS, PLACES, st.sampled_from([0.0, 0.2, 1.0]))
def test_a_core_lies_within_its_own_margin_and_a_wider_margin_holds_a_narrower_one(places, grid, more, margin):
    partition = divided(places, grid)
    if partition is None:
        return
    points = points_of(partition, more)
    for number in range(len(partition.names)):
        core = partition.block_of(points) == number
        within = partition.inside(number, points, margin)
        assert np.all(within[core])
        assert np.all(partition.inside(number, points, margin + 0.5)[within])
    assert np.array_equal(partition.inside(0, points, 0.0), partition.block_of(points) == 0)


@given(st.integers(0, 2**32 - 1), GRIDS, st.integers(0, 60))
def test_cores_hold_equally_many_cameras_give_or_take_one_for_each_cut(seed, grid, more):
    k, l = grid
    centers = np.random.default_rng(seed).normal(size=(k * l + more, 3)) * [5.0, 2.0, 0.1]
    count = np.bincount(divide(centers, grid).block_of(centers), minlength=k * l)
    # a strip is rounded once, and its cores once more
    assert count.max() - count.min() <= 2
    assert count.sum() == len(centers)


@given(PLACES, GRIDS)
def test_a_partition_goes_through_json_unchanged(places, grid):
    partition = divided(places, grid)
    if partition is None:
        return
    again = Partition.of(json.loads(json.dumps(partition.plain())))
    points = points_of(partition, places)
    assert again.names == partition.names
    assert np.array_equal(again.block_of(points), partition.block_of(points))


def test_the_first_axis_is_that_of_greatest_spread_and_height_is_left_out():
    generator = np.random.default_rng(0)
    centers = generator.normal(size=(200, 3)) * [0.1, 3.0, 9.0]
    partition = divide(centers, (2, 2))
    assert np.allclose(np.abs(partition.axes), [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], atol=0.1)
    assert np.allclose(partition.axes @ partition.axes.T, np.eye(2))


def test_the_world_may_be_moved_and_the_blocks_stay():
    generator = np.random.default_rng(1)
    centers, points = generator.normal(size=(60, 3)) * [5.0, 2.0, 0.5], generator.normal(size=(500, 3)) * 4.0
    partition = divide(centers, (3, 2))
    moved = divide(7.0 * centers + [100.0, -20.0, 3.0], (3, 2))
    assert np.array_equal(moved.block_of(7.0 * points + [100.0, -20.0, 3.0]), partition.block_of(points))


@pytest.mark.parametrize(
    "text", ["", "2", "2x", "x2", "0x2", "2x0", "-1x2", "2x2x2", "2 2", "a", "1x1", "65x1", "9999999x1"]
)
def test_a_grid_that_is_none_is_refused(text):
    assert_one_line(lambda: grid_of(text), "--blocks")


@pytest.mark.parametrize(("text", "grid"), [("2x2", (2, 2)), ("3X1", (3, 1)), (" 10×4 ", (10, 4))])
def test_a_grid_is_read(text, grid):
    assert grid_of(text) == grid


def test_too_few_cameras_and_cameras_at_one_place_are_refused():
    assert_one_line(lambda: divide(np.eye(3), (2, 2)), "needs 4 training views", "there are 3")
    at_one_place = np.concatenate([np.zeros((9, 3)), [[1.0, 0.0, 0.0]]])
    message = assert_one_line(lambda: divide(at_one_place, (3, 1)), "no training view", "fewer blocks")
    assert "block 1_0" in message or "block 0_0" in message


def planned(capture: Capture, blocks: str = "2x2", test_every: int = 5, **settings: float) -> Plan:
    return make_plan(capture, Job(blocks=blocks, **settings), test_every)


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


def test_a_view_trains_a_block_that_fills_enough_of_its_picture():
    capture = tiny_capture(n_views=20)
    few, many = planned(capture, share=0.9, margin=0.0), planned(capture, share=0.05, margin=0.0)
    for tight, loose in zip(few.blocks, many.blocks, strict=True):
        assert tight.views <= loose.views
    assert sum(len(block.views) for block in few.blocks) < sum(len(block.views) for block in many.blocks)


def test_a_wider_margin_takes_more_views_and_points():
    capture = tiny_capture(n_views=20)
    narrow, wide = planned(capture, margin=0.0, share=1.0), planned(capture, margin=0.5, share=1.0)
    for inner, outer in zip(narrow.blocks, wide.blocks, strict=True):
        assert inner.views <= outer.views
        assert len(inner.points) - inner.background <= len(outer.points) - outer.background


def test_a_block_without_points_and_a_capture_without_any_are_refused():
    capture = tiny_capture(n_views=20)
    far = replace(capture, points=np.full_like(capture.points, 50.0))
    assert_one_line(lambda: planned(far), "has no sparse point", "fewer blocks")
    none = replace(capture, points=capture.points[:0], points_rgb=capture.points_rgb[:0])
    assert_one_line(lambda: planned(none), "no sparse points", "pop sfm")


@pytest.mark.parametrize(("name", "value"), [("margin", -0.1), ("margin", 1.5), ("share", 0.0), ("share", 1.1)])
def test_a_margin_or_share_out_of_range_is_refused(name, value):
    assert_one_line(lambda: Job(blocks="2x2", **{name: value}), f"--blocks-{name} is {value}")
