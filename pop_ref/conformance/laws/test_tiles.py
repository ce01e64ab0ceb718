"""Laws of tiles: rectangles, lists by depth, and exact ones that are shorter and draw the same (D3, D4, D5)."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st

from pop_ref.compositing import composite
from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.capabilities import INRIAS
from pop_ref.conformance.gradient_error_bounds import screened
from pop_ref.conformance.law import law
from pop_ref.conformance.laws.test_contributions import plain
from pop_ref.conformance.scenes import rounded
from pop_ref.conformance.strategies import dyadic, scenes
from pop_ref.constants import INRIA, PAPER, SPEEDY_SPLAT

W, H = 11, 7
placed = st.lists(
    st.tuples(
        dyadic(-6.0, 16.0, bits=1), dyadic(-6.0, 12.0, bits=1), st.integers(0, 6), st.integers(0, 6),
        dyadic(1.0, 4.0, bits=0),
    ),
    max_size=6,
)  # fmt: skip
tile_sizes = st.sampled_from([4, 1, 2, 3, 16])


def _columns(placed):
    means2d = np.array([p[:2] for p in placed]).reshape(-1, 2)
    radii = np.array([p[2:4] for p in placed], dtype=np.int64).reshape(-1, 2)
    return means2d, radii, np.array([p[4] for p in placed])


def _lists(backend, placed, tile_size):
    means2d, radii, depths = _columns(placed)
    return backend.stage("tile_lists")(means2d, radii, depths, W, H, tile_size)


@law("tiles", "grid_size", width=st.integers(1, 64), height=st.integers(1, 64), tile_size=st.integers(1, 20))
def test_the_grid_covers_the_image_and_no_tile_lies_outside(backend, width, height, tile_size):
    tiles_x, tiles_y = backend.stage("grid_size")(width, height, tile_size)
    assert (tiles_x - 1) * tile_size < width <= tiles_x * tile_size
    assert (tiles_y - 1) * tile_size < height <= tiles_y * tile_size


# without an extent, and with one along one axis alone
_THIN = {"placed": [(5.0, 3.0, 0, 0, 1.0), (5.0, 3.0, 0, 3, 1.0), (5.0, 3.0, 3, 0, 1.0)], "tile_size": 4}


@law("tiles", "tile_rects", placed=placed, tile_size=tile_sizes, first=[_THIN])
def test_a_tile_is_listed_exactly_if_it_overlaps_the_open_extent(backend, placed, tile_size):
    # D3
    means2d, radii, _ = _columns(placed)
    rects = backend.stage("tile_rects")(means2d, radii, W, H, tile_size)
    tiles_x, tiles_y = -(-W // tile_size), -(-H // tile_size)
    for (u, v), (r_x, r_y), (x0, y0, x1, y1) in zip(means2d, radii, rects, strict=True):
        inside = {(x, y) for x in range(x0, x1) for y in range(y0, y1)}
        overlapped = {
            (x, y)
            for x in range(tiles_x)
            for y in range(tiles_y)
            if min(r_x, r_y) > 0
            and u - r_x < (x + 1) * tile_size
            and u + r_x > x * tile_size
            and v - r_y < (y + 1) * tile_size
            and v + r_y > y * tile_size
        }
        assert inside == overlapped


@law("tiles", "tile_rects", INRIAS, placed=placed, tile_size=tile_sizes, first=[_THIN])
def test_the_square_extents_rectangle_truncates_towards_zero_as_inria_does(backend, placed, tile_size):
    means2d, radii, _ = _columns(placed)
    rects = backend.stage("tile_rects")(means2d, radii, W, H, tile_size, INRIA)
    grid = (-(-W // tile_size), -(-H // tile_size))
    for p, reach, rect in zip(means2d - 0.5, radii, rects, strict=True):
        if min(reach) > 0:
            of = list(zip(p, reach, grid, strict=True))
            low = [min(max(int((c - r) / tile_size), 0), n) for c, r, n in of]
            high = [min(max(int((c + r + tile_size - 1) / tile_size), 0), n) for c, r, n in of]
            assert_same_bits("rectangle", rect, np.array([*low, *high]))
        else:
            assert rect[0] >= rect[2] or rect[1] >= rect[3]


# two depths in turn, more of them than a sort takes in the order of insertion
_TIES = {"placed": [(0.5 * W, 0.5 * H, 1, 1, 1.0 + k % 2) for k in range(40)], "tile_size": 16}


@law("tiles", "tile_lists", placed=placed, tile_size=tile_sizes, first=[_TIES])
def test_lists_run_front_to_back_and_equal_depths_keep_index_order(backend, placed, tile_size):
    # D4
    depths = [p[4] for p in placed]
    for ids in _lists(backend, placed, tile_size):
        keys = [(depths[i], int(i)) for i in ids]
        assert keys == sorted(keys)


@law("tiles", "tile_lists", depth=dyadic(0.5, 64.0), tile_size=tile_sizes)
def test_depths_that_differ_in_their_last_bit_alone_are_told_apart(backend, depth, tile_size):
    depths = [backend.dtype(depth)]
    while len(depths) < 5:
        depths.append(np.nextafter(depths[-1], backend.dtype(0.0), dtype=backend.dtype))
    at = [(0.5 * W, 0.5 * H, 1, 1, float(one)) for one in depths]
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
    apart = [(*p[:4], 1.0 + k) for k, p in enumerate(placed)]
    order = list(range(len(apart)))
    seed.shuffle(order)
    lists = _lists(backend, apart, tile_size)
    permuted = _lists(backend, [apart[i] for i in order], tile_size)
    assert [[order[int(i)] for i in ids] for ids in permuted] == [[int(i) for i in ids] for ids in lists]


@law("tiles", "tile_lists")
def test_an_image_without_splats_has_empty_lists(backend):
    lists = _lists(backend, [], 4)
    assert [list(ids) for ids in lists] == [[] for _ in range(6)]


SIZE, ACROSS, DOWN = 4, 6, 5
quarters = st.tuples(*[st.integers(-16, 112).map(lambda k: k / 4.0)] * 2).map(np.array)
variances = st.sampled_from([1.0, 0.5, 4.0, 9.0, 64.0])
leanings = st.sampled_from([0.0, 0.5, -0.875, 0.96875, -0.984375])
seen_opacities = st.sampled_from([1.0, 0.5, 0.125, 1.0 / 128.0, 0.0048828125])


def _conic(a, c, leaning):
    b = leaning * math.sqrt(a * c)
    return np.array([c, -b, a]) / (a * c - b * b)


def _least_exponent(mean2d, conic, x, y, size=SIZE):
    """Return the least exponent over a closed tile: at the centre, or on an edge, along which it is a parabola."""
    (A, B, C), (u, v) = conic, mean2d
    left, right, top, bottom = x * size - u, (x + 1) * size - u, y * size - v, (y + 1) * size - v
    if left <= 0.0 <= right and top <= 0.0 <= bottom:
        return 0.0
    ends = [(dx, min(max(-B * dx / C, top), bottom)) for dx in (left, right)]
    ends += [(min(max(-B * dy / A, left), right), dy) for dy in (top, bottom)]
    return min(0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy for dx, dy in ends)


@law("tight_tiles", "snug_box", at=quarters, a=variances, c=variances, leaning=leanings, opacity=seen_opacities)
def test_the_box_touches_the_ellipse_of_what_can_be_seen_on_its_four_sides(backend, at, a, c, leaning, opacity):
    conic = _conic(a, c, leaning)
    at, conic = rounded((at, conic), backend.dtype)
    left, top, right, bottom = backend.stage("snug_box")(at, conic, opacity)
    A, B, C = conic
    # on a vertical line sigma is least at dy = -B dx / C, where it is half of dx^2 (A - B^2 / C)
    reach = math.log(opacity / PAPER.alpha_floor)
    spread = 1.0 / (1.0 - leaning * leaning)
    for side, centre, steep in ((left, at[0], A - B * B / C), (right, at[0], A - B * B / C),
                                (top, at[1], C - B * B / A), (bottom, at[1], C - B * B / A)):  # fmt: skip
        size = (reach + abs(centre) * math.sqrt(2.0 * reach * steep)) * spread
        assert_close("tight_tiles.box", 0.5 * (side - centre) ** 2 * steep, reach, size + 1.0, backend.dtype)
    assert left <= at[0] <= right
    assert top <= at[1] <= bottom


@law("tight_tiles", "snug_box", "accutile", at=quarters, a=variances, opacity=st.sampled_from([0.0, 0.001, 0.00390625]))
def test_a_splat_that_cannot_be_seen_has_no_box_and_no_tiles_under_the_floor(backend, at, a, opacity):
    conic = _conic(a, a, 0.0)
    below = opacity < PAPER.alpha_floor
    assert (backend.stage("snug_box")(at, conic, opacity) is None) == below
    if below:
        assert len(backend.stage("accutile")(at, conic, opacity, (0, 0, ACROSS, DOWN), SIZE)) == 0


@law("tight_tiles", "accutile", at=quarters, opacity=seen_opacities, x=st.integers(0, 2), y=st.integers(0, 2))
def test_a_conic_without_an_ellipse_keeps_its_whole_rectangle(backend, at, opacity, x, y):
    # rounding leaves such conics of needles: a determinant of 0, and one under it
    whole = {(column, row) for row in range(y, y + 2) for column in range(x, x + 3)}
    for conic in ([1.0, 1.0, 1.0], [0.25, 0.5, 0.5]):
        tiles = backend.stage("accutile")(at, np.array(conic), opacity, (x, y, x + 3, y + 2), SIZE)
        assert sorted((int(column), int(row)) for column, row in tiles) == sorted(whole)


@law("tight_tiles", "accutile", at=quarters, a=variances, c=variances, leaning=leanings, opacity=seen_opacities)
def test_a_tile_is_kept_exactly_if_it_meets_the_ellipse_of_what_can_be_seen(backend, at, a, c, leaning, opacity):
    conic = _conic(a, c, leaning)
    at, conic = rounded((at, conic), backend.dtype)
    # the smaller the tiles, the nearer an end of a row has to be
    for size in (SIZE, 1):
        _assert_kept(backend, at, conic, opacity, ACROSS * SIZE // size, DOWN * SIZE // size, size)


def _assert_kept(backend, at, conic, opacity, across, down, size):
    tiles = backend.stage("accutile")(at, conic, opacity, (0, 0, across, down), size)
    kept = {(int(x), int(y)) for x, y in tiles}
    assert len(kept) == len(tiles)
    for x in range(across):
        for y in range(down):
            least = _least_exponent(at, conic, x, y, size)
            slack = least - math.log(opacity / PAPER.alpha_floor)
            # a tile that is met at a point is met or not by rounding
            if abs(slack) > 2.0**14 * np.finfo(backend.dtype).eps * (1.0 + least):
                assert ((x, y) in kept) == (slack < 0.0), (x, y)


def _listed(backend, given):
    """Return the tight lists of a view, and those of whole rectangles that they are part of."""
    s, wide, width, height, size = given.view
    args = (s.means2d, s.conics, s.opacities, s.radii, s.depths, width, height, size, given.scene.profile)
    return [[int(i) for i in ids] for ids in backend.stage("tight_tile_lists")(*args)], wide


def _same_image(backend, given):
    tight, wide = _listed(backend, given)
    at, sure = given.error_bounds.unambiguous, (*given.view[2:], given.scene.background, given.scene.profile)
    one, other = (composite(given.splats, lists, *sure) for lists in (tight, wide))
    # blended by the oracle both times: what is left out was blended nowhere
    for name in ("image", "T_final", "dominant_ids", "n_blended"):
        assert_same_bits(name, getattr(one, name)[at], getattr(other, name)[at])


@law("tight_tiles", "tight_tile_lists", scene=scenes(anchored=True))
def test_the_image_of_tight_lists_is_that_of_whole_rectangles(backend, scene):
    _same_image(backend, screened(backend, scene))


@law("tight_tiles", "tight_tile_lists", scene=scenes(anchored=True, profile=INRIA))
def test_inside_squares_tight_lists_change_nothing_either(backend, scene):
    _same_image(backend, screened(backend, scene))


@law("tight_tiles", "tight_tile_lists", scene=scenes(anchored=True, profile=SPEEDY_SPLAT))
def test_speedy_splats_lists_give_the_image_of_its_profile(backend, scene):
    _same_image(backend, screened(backend, scene))


@law("tight_tiles", "tight_tile_lists", scene=plain)
def test_tight_lists_are_parts_of_the_rectangles_in_the_same_order(backend, scene):
    tight, wide = _listed(backend, screened(backend, scene))
    assert len(tight) == len(wide)
    for few, many in zip(tight, wide, strict=True):
        assert len(set(few)) == len(few)
        assert few == [i for i in many if i in few]


@law("tight_tiles", "tight_tile_lists", scene=plain)
def test_no_tile_is_listed_that_lies_outside_the_ellipse(backend, scene):
    given = screened(backend, scene.with_overrides(tile_size=SIZE))
    tight, _ = _listed(backend, given)
    s, across = given.splats, -(-given.view[2] // SIZE)
    for tile, ids in enumerate(tight):
        for i in ids:
            least = _least_exponent(s.means2d[i], s.conics[i], tile % across, tile // across)
            brightest = float(s.opacities[i]) * math.exp(-least)
            assert brightest >= PAPER.alpha_floor * (1.0 - 2.0**14 * np.finfo(backend.dtype).eps * (1.0 + least))
