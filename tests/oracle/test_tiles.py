"""Tile lists against brute force over pixels, and their order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_ref import INRIA, tiles

quarter_px = st.integers(-40, 120).map(lambda k: k / 4.0)
radius = st.integers(1, 9)


@given(quarter_px, quarter_px, radius, radius, st.sampled_from([1, 3, 4, 16]))
def test_a_rectangle_holds_every_pixel_within_the_extent(u: float, v: float, r_x: int, r_y: int, size: int) -> None:
    width, height = 17, 13
    rect = tiles.tile_rects(np.array([[u, v]]), np.array([[r_x, r_y]]), width, height, size)[0].tolist()
    for y in range(height):
        for x in range(width):
            if abs(x + 0.5 - u) <= r_x and abs(y + 0.5 - v) <= r_y:
                assert rect[0] <= x // size < rect[2]
                assert rect[1] <= y // size < rect[3]


@given(quarter_px, radius, st.sampled_from([1, 4, 16]))
def test_a_rectangle_holds_only_tiles_that_the_extent_overlaps(u: float, r: int, size: int) -> None:
    x0, _, x1, _ = tiles.tile_rects(np.array([[u, 4.0]]), np.array([[r, r]]), 17, 13, size)[0].tolist()
    tiles_x, _ = tiles.grid_size(17, 13, size)
    overlapped = [k for k in range(tiles_x) if u - r < (k + 1) * size and u + r > k * size]
    assert list(range(x0, x1)) == overlapped


@given(quarter_px, radius, st.sampled_from([4, 16]))
def test_inria_s_rectangle_is_what_its_integer_arithmetic_gives(u: float, r: int, size: int) -> None:
    x0, _, x1, _ = tiles.tile_rects(np.array([[u, 4.0]]), np.array([[r, r]]), 17, 13, size, INRIA)[0].tolist()
    tiles_x, _ = tiles.grid_size(17, 13, size)
    # in index space, where pixel j lies at j; numpy's int cast truncates toward zero
    p = u - 0.5
    want = [np.trunc((p - r) / size), np.trunc((p + r + size - 1) / size)]
    assert [x0, x1] == [int(min(max(k, 0), tiles_x)) for k in want]


def test_inria_s_rectangle_can_miss_a_pixel_within_the_extent() -> None:
    # the square's last pixel column is cut: p + r + t - 1 = 8 + 3.75 + 4 - 1 truncates to tile 3
    means2d, radii = np.array([[8.25, 8.0]]), np.array([[4, 4]])
    paper = tiles.tile_rects(means2d, radii, 16, 16, 4)[0].tolist()
    inria = tiles.tile_rects(means2d, radii, 16, 16, 4, INRIA)[0].tolist()
    assert (paper[2], inria[2]) == (4, 3)


def test_lists_are_row_major_and_hold_what_overlaps() -> None:
    means2d, radii = np.array([[1.0, 1.0], [5.0, 5.0], [3.0, 3.0]]), np.full((3, 2), 2)
    got = tiles.tile_lists(means2d, radii, np.array([1.0, 2.0, 3.0]), 8, 8, 4)
    assert got == [[0, 1, 2], [1, 2], [1, 2], [1, 2]]


@given(st.lists(st.sampled_from([1.0, 2.0, 2.0 + 2.0**-40, 3.0]), max_size=8))
def test_lists_are_sorted_by_depth_and_ties_keep_index_order(depths: list[float]) -> None:
    n = len(depths)
    (ids,) = tiles.tile_lists(np.full((n, 2), 2.0), np.full((n, 2), 1), np.array(depths), 4, 4, 16)
    assert ids == [i for _, i in sorted(zip(depths, range(n), strict=True))]


def test_a_culled_splat_is_in_no_list() -> None:
    assert tiles.tile_lists(np.array([[2.0, 2.0]]), np.array([[0, 0]]), np.ones(1), 4, 4, 4) == [[]]


def test_no_splats_make_empty_lists_and_the_last_tiles_may_be_partial() -> None:
    assert tiles.grid_size(1, 1, 16) == (1, 1)
    assert tiles.grid_size(33, 16, 16) == (3, 1)
    empty = np.zeros((0, 2))
    assert tiles.tile_lists(empty, empty.astype(np.int64), np.zeros(0), 33, 17, 16) == [[]] * 6


def test_a_tile_size_of_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="tile_size is 0; it must be >= 1"):
        tiles.grid_size(4, 4, 0)
