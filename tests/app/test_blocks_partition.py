"""The cores of a divided capture: they tile the ground, each point belongs to one, and no view is left out."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.blocks.partition import Partition, divide, grid_of
from pop_fast.blocks.plan import Job, Plan, make_plan
from pop_fast.data.capture import Capture
from pop_fast.errors import PopError
from tests.app.captures import assert_one_line
from tests.app.tiny import tiny_capture

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
