"""Laws of tile rectangles, tile lists and depth order (D3, D4)."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_same_bits
from pop_ref.conformance.capabilities import INRIAS
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import dyadic
from pop_ref.constants import INRIA

W, H = 11, 7
placed = st.lists(
    st.tuples(dyadic(-6.0, 16.0, bits=1), dyadic(-6.0, 12.0, bits=1), st.integers(0, 6), dyadic(1.0, 4.0, bits=0)),
    max_size=6,
)
tile_sizes = st.sampled_from([4, 1, 2, 3, 16])


def _columns(placed):
    means2d = np.array([p[:2] for p in placed]).reshape(-1, 2)
    radii = np.array([[p[2], p[2]] for p in placed], dtype=np.int64).reshape(-1, 2)
    return means2d, radii, np.array([p[3] for p in placed])


def _lists(backend, placed, tile_size):
    means2d, radii, depths = _columns(placed)
    return backend.stage("tile_lists")(means2d, radii, depths, W, H, tile_size)


@law("tiles", "grid_size", width=st.integers(1, 64), height=st.integers(1, 64), tile_size=st.integers(1, 20))
def test_the_grid_covers_the_image_and_no_tile_lies_outside(backend, width, height, tile_size):
    tiles_x, tiles_y = backend.stage("grid_size")(width, height, tile_size)
    assert (tiles_x - 1) * tile_size < width <= tiles_x * tile_size
    assert (tiles_y - 1) * tile_size < height <= tiles_y * tile_size


@law("tiles", "tile_rects", placed=placed, tile_size=tile_sizes)
def test_a_tile_is_listed_exactly_if_it_overlaps_the_open_extent(backend, placed, tile_size):
    # D3
    means2d, radii, _ = _columns(placed)
    rects = backend.stage("tile_rects")(means2d, radii, W, H, tile_size)
    tiles_x, tiles_y = -(-W // tile_size), -(-H // tile_size)
    for (u, v), (r, _), (x0, y0, x1, y1) in zip(means2d, radii, rects, strict=True):
        inside = {(x, y) for x in range(x0, x1) for y in range(y0, y1)}
        overlapped = {
            (x, y)
            for x in range(tiles_x)
            for y in range(tiles_y)
            if r > 0
            and u - r < (x + 1) * tile_size
            and u + r > x * tile_size
            and v - r < (y + 1) * tile_size
            and v + r > y * tile_size
        }
        assert inside == overlapped


@law("tiles", "tile_rects", INRIAS, placed=placed, tile_size=tile_sizes)
def test_the_square_extents_rectangle_truncates_towards_zero_as_inria_does(backend, placed, tile_size):
    means2d, radii, _ = _columns(placed)
    rects = backend.stage("tile_rects")(means2d, radii, W, H, tile_size, INRIA)
    grid = (-(-W // tile_size), -(-H // tile_size))
    for p, (r, _), rect in zip(means2d - 0.5, radii, rects, strict=True):
        if r > 0:
            low = [min(max(int((c - r) / tile_size), 0), n) for c, n in zip(p, grid, strict=True)]
            high = [min(max(int((c + r + tile_size - 1) / tile_size), 0), n) for c, n in zip(p, grid, strict=True)]
            assert_same_bits("rectangle", rect, np.array([*low, *high]))
        else:
            assert rect[0] >= rect[2] or rect[1] >= rect[3]


@law("tiles", "tile_lists", placed=placed, tile_size=tile_sizes)
def test_lists_run_front_to_back_and_equal_depths_keep_index_order(backend, placed, tile_size):
    # D4
    depths = [p[3] for p in placed]
    for ids in _lists(backend, placed, tile_size):
        keys = [(depths[i], int(i)) for i in ids]
        assert keys == sorted(keys)


@law("tiles", "tile_lists", depth=dyadic(0.5, 64.0), tile_size=tile_sizes)
def test_depths_that_differ_in_their_last_bit_alone_are_told_apart(backend, depth, tile_size):
    depths = [backend.dtype(depth)]
    while len(depths) < 5:
        depths.append(np.nextafter(depths[-1], backend.dtype(0.0), dtype=backend.dtype))
    at = [(0.5 * W, 0.5 * H, 1, float(one)) for one in depths]
    # each is nearer than the one before it
    listed = [list(map(int, ids)) for ids in _lists(backend, at, tile_size) if len(ids)]
    assert listed
    assert all(ids == [4, 3, 2, 1, 0] for ids in listed)


@law("tiles", "tile_lists", "tile_rects", placed=placed, tile_size=tile_sizes)
def test_lists_hold_each_splat_once_in_each_tile_of_its_rectangle(backend, placed, tile_size):
    means2d, radii, _ = _columns(placed)
    rects = backend.stage("tile_rects")(means2d, radii, W, H, tile_size)
    tiles_x = -(-W // tile_size)
    for tile, ids in enumerate(_lists(backend, placed, tile_size)):
        x, y = tile % tiles_x, tile // tiles_x
        expected = [i for i, (x0, y0, x1, y1) in enumerate(rects) if x0 <= x < x1 and y0 <= y < y1]
        assert sorted(int(i) for i in ids) == expected


@law("tiles", "tile_lists", placed=placed, tile_size=tile_sizes, seed=st.randoms(use_true_random=False))
def test_permuting_splats_of_distinct_depths_permutes_ids_only(backend, placed, tile_size, seed):
    apart = [(*p[:3], 1.0 + k) for k, p in enumerate(placed)]
    order = list(range(len(apart)))
    seed.shuffle(order)
    lists = _lists(backend, apart, tile_size)
    permuted = _lists(backend, [apart[i] for i in order], tile_size)
    assert [[order[int(i)] for i in ids] for ids in permuted] == [[int(i) for i in ids] for ids in lists]


@law("tiles", "tile_lists")
def test_an_image_without_splats_has_empty_lists(backend):
    lists = _lists(backend, [], 4)
    assert [list(ids) for ids in lists] == [[] for _ in range(6)]
