"""Laws of gsplat's signature: what every key of meta says is what the oracle knows."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pop_ref.conformance.assertions import assert_same_bits
from pop_ref.conformance.calls import Call, Frame
from pop_ref.conformance.capabilities import CAMERAS, EXTENTS, PACKED, PRINCIPAL_POINT, SCALE, SIGNATURE
from pop_ref.conformance.corpus import corpus_scene
from pop_ref.conformance.law import law
from pop_ref.conformance.signature import (
    ROWS,
    assert_dominance,
    assert_keys,
    assert_rows,
    assert_sizes,
    assert_tiles,
    lacks_for_tiles,
    made,
)
from pop_ref.conformance.views import call_for, frames

SIZES = ("width", "height", "tile_size", "tile_width", "tile_height", "n_cameras", "n_batches")


def _made(backend, names, **options):
    """Return what came of a call of two cameras; skip a rasterizer that tells none of the keys."""
    of = made(backend, Call((frames(backend, 1, 2),), **options))
    if not any(name in of.called.meta for name in names):
        pytest.skip(f"{backend.name} has no meta {', '.join(names)}")
    return of


def _listed(backend, *more, **options):
    """Return such a call whose meta has tile lists, and the keys besides; skip a rasterizer that lacks some."""
    of = made(backend, Call((frames(backend, 1, 2),), **options))
    lacks = [*lacks_for_tiles(of), *(name for name in more if name not in of.called.meta)]
    if not backend.takes("tile_size") and backend.own_tile_size is None:
        lacks.append("tile_size")
    if lacks:
        pytest.skip(f"{backend.name} has no meta {', '.join(lacks)}")
    return of


@law("signature", SIGNATURE, CAMERAS)
def test_meta_says_what_was_asked(backend):
    assert_sizes(_made(backend, SIZES))


@law("signature", SIGNATURE, CAMERAS)
def test_the_splats_that_meta_shows_are_the_oracles(backend):
    assert_rows(backend, _made(backend, (*ROWS, "radii")))


@law("signature", SIGNATURE, CAMERAS)
def test_the_splats_that_meta_shows_where_nothing_requires_a_gradient_are_the_oracles(backend):
    of = _made(backend, (*ROWS, "radii"))
    assert_rows(backend, dataclasses.replace(of, called=backend.call(of.call)))


@law("signature", SIGNATURE, EXTENTS)
def test_extents_that_sixteen_bits_do_not_hold_are_told_as_they_are(backend):
    (frame,) = frames(backend, 1)
    huge = frame.scene.with_overrides(scales=frame.scene.gaussians.scales * 2.0**13)
    of = made(backend, Call(((Frame(backend.sees(huge), None),),)))
    if "radii" not in of.called.meta:
        pytest.skip(f"{backend.name} has no meta radii")
    ((wanted,),) = of.wanted
    extents, found = wanted.render.splats.radii, of.called.meta["radii"].reshape(-1, 2)
    assert np.any(extents > 2**15), "no splat is as large as that"
    # an extent is rounded up, and rounding decides to what
    off = np.abs(found - extents) > 1.0 + 2.0**10 * np.finfo(backend.dtype).eps * extents
    assert not np.any(off), f"meta radii are {found[off][0]:g}, expected {extents[off][0]:g}"


@law("signature", SIGNATURE, CAMERAS)
def test_the_tile_lists_that_meta_shows_run_front_to_back_and_hold_who_is_blended(backend):
    assert_tiles(backend, _listed(backend))


@law("signature", SIGNATURE, CAMERAS, PACKED)
def test_the_tile_lists_of_packed_rows_run_front_to_back_and_hold_who_is_blended(backend):
    assert_tiles(backend, _listed(backend, packed=True))


@law("signature", SIGNATURE, SCALE, EXTENTS, PRINCIPAL_POINT)
def test_a_splat_over_hundreds_of_tiles_counts_all_of_them(backend):
    if not backend.takes("tile_size"):
        pytest.skip(f"{backend.name} has no tiles of another side than its own")
    meta = backend.call(Call(((Frame(backend.sees(corpus_scene("hundreds_of_tiles_a_splat")), None),),))).meta
    lacks = [name for name in ("tiles_per_gauss", "flatten_ids") if name not in meta]
    if lacks:
        pytest.skip(f"{backend.name} has no meta {', '.join(lacks)}")
    counts = np.bincount(meta["flatten_ids"], minlength=meta["tiles_per_gauss"].size)
    assert counts.max() > 255, "no splat lies over more tiles than a byte counts"
    assert_same_bits("meta tiles_per_gauss", meta["tiles_per_gauss"].reshape(-1), counts)


@law("signature", SIGNATURE, CAMERAS, PACKED)
def test_dominant_ids_are_of_gaussians_and_not_of_packed_rows(backend):
    plain, packed = (_made(backend, ("dominant_ids",), packed=each).called for each in (False, True))
    assert_same_bits("dominant ids, packed or not", packed.meta["dominant_ids"], plain.meta["dominant_ids"])


@law("signature", SIGNATURE, CAMERAS)
def test_every_camera_has_dominant_gaussians_and_counts_of_its_own(backend):
    assert_dominance(backend, _made(backend, ("dominant_ids", "dominant_counts", "n_contrib", "final_T")))


@law("signature", SIGNATURE, CAMERAS)
def test_the_keys_of_intersections_hold_image_tile_and_depth(backend):
    of = _listed(backend, "isect_ids", "depths")
    assert_keys(of.called.meta, len(of.call.frames[0]), len(of.wanted[0][0].render.tile_lists))


@law("signature", SIGNATURE, CAMERAS, PACKED)
def test_the_keys_of_packed_intersections_hold_image_tile_and_depth(backend):
    of = _listed(backend, "isect_ids", "depths", packed=True)
    assert_keys(of.called.meta, len(of.call.frames[0]), len(of.wanted[0][0].render.tile_lists))


@law("signature", SIGNATURE)
def test_of_more_tiles_than_sixteen_bits_number_each_lists_who_overlaps_it(backend):
    # as many as a signed number of two bytes does not count, and as none does
    for width, height in ((256, 160), (320, 208)):
        call = call_for(backend, size=(width, height), tile_size=1)
        meta = backend.call(call).meta
        lacks = [name for name in ("flatten_ids", "isect_offsets", "radii", "means2d") if name not in meta]
        if lacks or not backend.takes("tile_size") or call.tile_size != 1:
            pytest.skip(f"{backend.name} has no lists of tiles of 1 px: {', '.join(lacks) or 'its tiles are others'}")
        rows = meta["flatten_ids"]
        lists = np.repeat(np.arange(width * height), np.diff(np.append(meta["isect_offsets"].reshape(-1), len(rows))))
        assert len(np.unique(lists // 2**15)) > 1, "nothing is drawn in the latter tiles"
        centres, extents = meta["means2d"].reshape(-1, 2)[rows], meta["radii"].reshape(-1, 2)[rows]
        away = np.abs(np.stack((lists % width, lists // width), axis=1) + 0.5 - centres)
        strangers = np.flatnonzero(np.any(away > extents + 1.0, axis=1))
        assert len(strangers) == 0, f"tile {lists[strangers[0]]} lists Gaussian {rows[strangers[0]]}, far from it"
