"""Verdicts on gsplat's `meta`: what each key says of the splats, of their order and of the tiles, beside the oracle."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.calls import Call, Called, packed_index, unpacked
from pop_ref.conformance.signature import Expected
from pop_ref.margins import margins

Wanted = list[list[Expected]]
ROWS = ("means2d", "depths", "conics", "opacities")
TILES = ("tiles_per_gauss", "flatten_ids", "isect_offsets", "isect_ids")


def clear_of_extents(e: Expected, dtype: Any) -> np.ndarray:
    """Return the Gaussians whose culls and extents rounding does not decide (D1, D2, D3). [N]"""
    s = e.scene
    found = margins(s.gaussians, s.camera, s.sh_degree, s.profile, s.tile_size, s.antialiased)
    return found.safe_gaussians(64.0 * float(np.finfo(dtype).eps), ("D1", "D2", "D3"))


def assert_sizes(call: Call, meta: dict[str, Any]) -> None:
    """Assert that what meta says of pictures, tiles and counts is what was asked."""
    scene = call.frames[0][0].scene
    size = scene.profile.tile_size if scene.tile_size is None else scene.tile_size
    width, height = scene.camera.width, scene.camera.height
    wanted = {"width": width, "height": height, "tile_size": size}
    wanted |= {"tile_width": -(-width // size), "tile_height": -(-height // size)}
    wanted |= {"n_cameras": len(call.frames[0]), "n_batches": len(call.frames)}
    for name, value in wanted.items():
        if name in meta:
            assert int(meta[name]) == value, f"meta[{name!r}] is {int(meta[name])}; it must be {value}"


def assert_rows(backend: Any, call: Call, called: Called, wanted: Wanted) -> None:
    """Assert that the rows of meta are the oracle's splats, and that packed rows are the visible ones."""
    meta = called.meta
    if call.packed:
        _assert_visible_rows(backend, call, meta, wanted)
    rows = {name: unpacked(call, meta[name], meta) for name in (*ROWS, "radii") if name in meta}
    for b, row in enumerate(wanted):
        for c, e in enumerate(row):
            s, clear = e.error_bounds.screen, clear_of_extents(e, backend.dtype)
            drawn = clear & e.render.splats.visible
            if "radii" in rows:
                assert_same_bits("meta radii", rows["radii"][b, c][clear], e.render.splats.radii[clear])
            error_bounds = {
                "means2d": s.e_means2d,
                "depths": s.e_depths,
                "conics": s.e_conics,
                "opacities": s.e_opacities,
            }
            for name in ROWS:
                if name in rows:
                    expected = getattr(e.render.splats, name)[drawn]
                    size = error_bounds[name][drawn] + np.abs(expected)
                    assert_close("meta.rows", rows[name][b, c][drawn], expected, size, backend.dtype, True)


def _assert_visible_rows(backend: Any, call: Call, meta: dict[str, Any], wanted: Wanted) -> None:
    index = packed_index(meta)
    shape = (len(call.frames), len(call.frames[0]), len(call.frames[0][0].scene.gaussians))
    present = np.zeros(shape, dtype=np.int64)
    np.add.at(present, index, 1)
    for b, row in enumerate(wanted):
        for c, e in enumerate(row):
            clear = clear_of_extents(e, backend.dtype)
            visible = e.render.splats.visible.astype(np.int64)
            assert_same_bits("packed rows of visible Gaussians", present[b, c][clear], visible[clear])


def assert_tiles(backend: Any, call: Call, called: Called, wanted: Wanted) -> None:
    """Assert that the tile lists of meta run front to back, and hold who is blended and nobody whom the oracle culls.

    A list may be tighter than the oracle's, which is of whole extents; who is culled by rounding is left out.
    """
    meta, every = called.meta, [e for row in wanted for e in row]
    n, flat, offsets = len(every[0].scene.gaussians), meta["flatten_ids"], meta["isect_offsets"]
    size = every[0].scene.tile_size or every[0].scene.profile.tile_size
    tiles = (-(-every[0].scene.camera.height // size), -(-every[0].scene.camera.width // size))
    assert offsets.shape[-2:] == tiles, f"meta['isect_offsets'] has shape {offsets.shape}; it must end in {tiles}"
    starts = np.append(offsets.reshape(-1), len(flat))
    assert starts[0] == 0, f"meta['isect_offsets'] begins with {starts[0]}"
    assert np.all(np.diff(starts) >= 0), "meta['isect_offsets'] falls"
    assert len(starts) == len(every) * tiles[0] * tiles[1] + 1, "meta['isect_offsets'] has another number of tiles"
    owner = np.ravel_multi_index(_index(call, meta, flat), (len(call.frames), len(call.frames[0]), n))
    clear = [clear_of_extents(e, backend.dtype) for e in every]
    lists = [owner[a:z] for a, z in itertools.pairwise(starts)]
    for number, listed in enumerate(lists):
        image, tile = divmod(number, tiles[0] * tiles[1])
        assert np.all(listed // n == image), f"a list of image {image} holds Gaussians of another"
        _assert_list(every[image], clear[image], tile, listed % n, tiles[1])
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
    if call.packed:
        return tuple(each[flat] for each in packed_index(meta))
    shape = (len(call.frames), len(call.frames[0]), len(call.frames[0][0].scene.gaussians))
    return np.unravel_index(flat, shape)


def _assert_list(e: Expected, clear: np.ndarray, tile: int, listed: np.ndarray, tiles_x: int) -> None:
    size, (y, x) = e.scene.tile_size or e.scene.profile.tile_size, divmod(tile, tiles_x)
    window = (slice(y * size, (y + 1) * size), slice(x * size, (x + 1) * size))
    sure = e.error_bounds.unambiguous[window]
    shown = [layer.id for layer in e.error_bounds.layers if np.any(layer.blended[window] & sure)]
    lost = [i for i in shown if i not in listed]
    assert not lost, f"tile {tile} does not list Gaussians {lost}, which are blended in it"
    allowed, listed = e.render.tile_lists[tile], listed[clear[listed]]
    strangers = [int(i) for i in listed if i not in allowed]
    assert not strangers, f"tile {tile} lists Gaussians {strangers}, which do not reach it"
    order = [i for i in allowed if i in set(listed.tolist())]
    assert listed.tolist() == order, f"tile {tile} lists {listed.tolist()}; from front to back they are {order}"
