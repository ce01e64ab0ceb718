"""Verdicts on gsplat's `meta`: what each key says of the splats, of their order and of the tiles, beside the oracle."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.calls import Call, packed_index, unpacked
from pop_ref.conformance.signature import Expected, Made, in_frame

ROWS = ("means2d", "depths", "conics", "opacities")
TILES = ("tiles_per_gauss", "flatten_ids", "isect_offsets", "isect_ids")


def assert_sizes(of: Made) -> None:
    """Assert that what meta says of pictures, tiles and counts is what was asked."""
    call, meta, size = of.call, of.called.meta, of.call.tile_size
    width, height = call.first.scene.camera.width, call.first.scene.camera.height
    wanted = {"width": width, "height": height, "tile_size": size}
    wanted |= {"tile_width": -(-width // size), "tile_height": -(-height // size)}
    wanted |= {"n_cameras": len(call.frames[0]), "n_batches": len(call.frames)}
    for name, value in wanted.items():
        if name in meta:
            assert int(meta[name]) == value, f"meta[{name!r}] is {int(meta[name])}; it must be {value}"


def assert_rows(backend: Any, of: Made) -> None:
    """Assert that the rows of meta are the oracle's splats, and that packed rows are the visible ones.

    Packed rows that do not tell whose they are have nothing to be compared with.
    """
    call, meta = of.call, of.called.meta
    given = {name: unpacked(call, meta[name], meta) for name in (*ROWS, "radii") if name in meta}
    rows = {name: value for name, value in given.items() if value is not None}
    index = packed_index(call, meta) if call.packed else None
    present = np.zeros(call.shape, dtype=np.int64)
    if index is not None:
        np.add.at(present, index, 1)
    for b, c, e in of.each():
        s, clear, visible = e.error_bounds.screen, e.clear, e.render.splats.visible
        frame = in_frame(of, b, c)

        def gaussian(at: tuple[int, ...], frame: str = frame) -> str:
            return f"{frame}Gaussian {at[0]}" + "".join(f", entry {k}" for k in at[1:])

        if index is not None:
            assert_same_bits("packed rows of it", present[b, c], visible.astype(np.int64), clear, gaussian)
        if "radii" in rows:
            assert_same_bits("meta radii", rows["radii"][b, c], e.render.splats.radii, clear, gaussian)
        units = {"means2d": s.e_means2d, "depths": s.e_depths, "conics": s.e_conics, "opacities": s.e_opacities}
        # what is culled holds no number
        drawn, splats = clear & visible, e.render.splats
        for name in (name for name in ROWS if name in rows):
            size = units[name] + np.abs(getattr(splats, name))
            place = functools.partial(_of, name, gaussian)
            values = (rows[name][b, c], getattr(splats, name), size)
            assert_close("meta.rows", *values, backend.dtype, True, drawn, place)


def _of(name: str, gaussian: Callable[[tuple[int, ...]], str], at: tuple[int, ...]) -> str:
    return f"{name} of {gaussian(at)}"


def assert_dominance(backend: Any, of: Made) -> None:
    """Assert that what meta tells of the dominant Gaussians, the blended splats and what is left is every frame's own.

    The counts of a frame are those of its ids, also where rounding decides who dominates.
    """
    call, meta = of.call, of.called.meta
    B, C, N = call.shape
    ids = ("dominant_ids", "dominant_weights", "n_contrib", "final_T")
    told = {name: meta[name].reshape(B, C, *meta[name].shape[-2:]) for name in ids if name in meta}
    for b, c, e in of.each():
        bounds, frame = e.error_bounds, in_frame(of, b, c)

        def pixel(at: tuple[int, ...], frame: str = frame) -> str:
            return f"{frame}pixel ({at[1]}, {at[0]})"

        for name, wanted, sure in (("dominant_ids", e.render.dominant_ids, bounds.decided),
                                   ("n_contrib", e.render.n_blended, bounds.unambiguous)):  # fmt: skip
            if name in told:
                assert_same_bits(f"meta {name}", told[name][b, c], wanted, sure, pixel)
        for name, key, wanted, size in (
            ("dominant_weights", "agreement.weight", e.render.dominant_weights, bounds.dominant_weight + 1.0),
            ("final_T", "agreement.T_final", e.render.T_final, bounds.T_final + 1.0),
        ):
            if name in told:
                assert_close(key, told[name][b, c], wanted, size, backend.dtype, True, bounds.unambiguous, pixel)
        if "dominant_ids" in told and "dominant_counts" in meta:
            own = told["dominant_ids"][b, c]
            counts = np.bincount(own[own >= 0], minlength=N)
            given = meta["dominant_counts"].reshape(B, C, N)[b, c]
            assert_same_bits(f"meta dominant_counts beside dominant_ids, {frame}Gaussian", given, counts)


def lacks_for_tiles(of: Made) -> list[str]:
    """Return what meta would have to tell for its tile lists to be judged, and does not."""
    lacks = [name for name in ("flatten_ids", "isect_offsets") if name not in of.called.meta]
    if of.call.packed and packed_index(of.call, of.called.meta) is None:
        lacks.append("camera_ids")
    return lacks


def assert_tiles_where_told(backend: Any, of: Made) -> None:
    """Assert what meta says of sizes, and its tile lists and their keys as far as it tells them."""
    assert_sizes(of)
    sized = backend.takes("tile_size") or backend.own_tile_size is not None
    if sized and not lacks_for_tiles(of):
        assert_tiles(backend, of)
        if "isect_ids" in of.called.meta and "depths" in of.called.meta:
            assert_keys(of.called.meta, sum(1 for _ in of.each()), of.call.n_tiles)


def assert_tiles(backend: Any, of: Made) -> None:
    """Assert that tile lists run front to back, and hold every Gaussian that is blended and none that the oracle culls.

    A list may be tighter than the oracle's, which is of whole extents; what rounding culls is left out.
    """
    call, meta, every = of.call, of.called.meta, list(of.each())
    B, C, n = call.shape
    camera, size = call.first.scene.camera, call.tile_size
    flat, offsets = meta["flatten_ids"], meta["isect_offsets"]
    tiles = (-(-camera.height // size), -(-camera.width // size))
    assert offsets.shape[-2:] == tiles, f"meta['isect_offsets'] has shape {offsets.shape}; it must end in {tiles}"
    starts = np.append(offsets.reshape(-1), len(flat))
    assert starts[0] == 0, f"meta['isect_offsets'] begins with {starts[0]}"
    assert np.all(np.diff(starts) >= 0), "meta['isect_offsets'] falls"
    n_lists = len(every) * tiles[0] * tiles[1]
    assert len(starts) == n_lists + 1, f"meta['isect_offsets'] has {len(starts) - 1} tiles; there are {n_lists}"
    owner = np.ravel_multi_index(_index(call, meta, flat), (B, C, n))
    clear = [e.clear for _, _, e in every]
    lists = [owner[a:z] for a, z in itertools.pairwise(starts)]
    for number, listed in enumerate(lists):
        image, tile = divmod(number, tiles[0] * tiles[1])
        b, c, e = every[image]
        assert np.all(listed // n == image), f"{in_frame(of, b, c)}tile {tile}: it lists Gaussians of another frame"
        _assert_list(e, clear[image], tile, listed % n, tiles[1], in_frame(of, b, c))
    if "tiles_per_gauss" in meta:
        counts = np.bincount(flat, minlength=meta["tiles_per_gauss"].size)
        assert_same_bits("meta tiles_per_gauss", meta["tiles_per_gauss"].reshape(-1), counts)
    if "isect_ids" in meta:
        keys = meta["isect_ids"]
        assert len(keys) == len(flat), f"{len(keys)} isect_ids for {len(flat)} flatten_ids"
        assert np.all(np.diff(keys) >= 0), "meta['isect_ids'] are not sorted"


def assert_keys(meta: dict[str, Any], n_images: int, n_tiles: int) -> None:
    """Assert that an intersection's key holds, from the high bits down, its image, its tile and its float32 depth.

    The tile takes as many bits as the number of tiles has, the depth the low 32, so that keys sort front to back.
    """
    keys, flat = np.asarray(meta["isect_ids"], dtype=np.int64), np.asarray(meta["flatten_ids"])
    counts = np.diff(np.append(np.asarray(meta["isect_offsets"]).reshape(-1), len(flat)))
    lists = np.repeat(np.arange(n_images * n_tiles), counts)
    bits = n_tiles.bit_length()
    assert_same_bits("images in meta isect_ids", keys >> (32 + bits), lists // n_tiles)
    assert_same_bits("tiles in meta isect_ids", (keys >> 32) & ((1 << bits) - 1), lists % n_tiles)
    depths = np.asarray(meta["depths"]).reshape(-1)[flat].astype(np.float32)
    assert_same_bits("depths in meta isect_ids", keys & 0xFFFFFFFF, depths.view(np.int32).astype(np.int64))


def _index(call: Call, meta: dict[str, Any], flat: np.ndarray) -> tuple[np.ndarray, ...]:
    index = packed_index(call, meta) if call.packed else None
    return np.unravel_index(flat, call.shape) if index is None else tuple(each[flat] for each in index)


def _assert_list(e: Expected, clear: np.ndarray, tile: int, listed: np.ndarray, tiles_x: int, frame: str) -> None:
    size, (y, x) = e.scene.tile_size or e.scene.profile.tile_size, divmod(tile, tiles_x)
    window = (slice(y * size, (y + 1) * size), slice(x * size, (x + 1) * size))
    sure = e.error_bounds.unambiguous[window]
    shown = [layer.id for layer in e.error_bounds.layers if np.any(layer.blended[window] & sure)]
    lost = [i for i in shown if i not in listed]
    assert not lost, f"{frame}tile {tile} does not list Gaussians {lost}, which are blended in it"
    allowed, listed = e.render.tile_lists[tile], listed[clear[listed]]
    strangers = [int(i) for i in listed if i not in allowed]
    assert not strangers, f"{frame}tile {tile} lists Gaussians {strangers}, which do not reach it"
    order = [i for i in allowed if i in set(listed.tolist())]
    assert listed.tolist() == order, f"{frame}tile {tile} lists {listed.tolist()}; from front to back they are {order}"
