"""Laws of gsplat's signature: what every key of meta says is what the oracle knows."""

from __future__ import annotations

import numpy as np
import pytest

from pop_ref.conformance.assertions import assert_same_bits
from pop_ref.conformance.calls import Call, Frame
from pop_ref.conformance.capabilities import CAMERAS, EXTENTS, PACKED, PRINCIPAL_POINT, SCALE, SIGNATURE
from pop_ref.conformance.corpus import corpus_scene
from pop_ref.conformance.law import law
from pop_ref.conformance.meta import ROWS, TILES, assert_keys, assert_rows, assert_sizes, assert_tiles
from pop_ref.conformance.signature import expectations
from pop_ref.conformance.views import frames

JUDGED = (SIGNATURE,)
SIZES = ("width", "height", "tile_size", "tile_width", "tile_height", "n_cameras", "n_batches")


def _made(backend, names, needs_all=False, **options):
    """Return a call of two cameras, what came of it and what the oracle says; skip who tells none of the keys."""
    call = Call((frames(backend, 1, 2),), **options)
    called = backend.call(call)
    lacks = [name for name in names if name not in called.meta]
    if len(lacks) == len(names) or (needs_all and lacks):
        pytest.skip(f"{backend.name} has no meta {', '.join(lacks)}")
    return call, called, expectations(backend, call)


@law("signature", *JUDGED, CAMERAS)
def test_meta_says_what_was_asked(backend):
    call, called, _ = _made(backend, SIZES)
    assert_sizes(call, called.meta)


@law("signature", *JUDGED, CAMERAS)
def test_the_splats_that_meta_shows_are_the_oracles(backend):
    call, called, wanted = _made(backend, (*ROWS, "radii"))
    assert_rows(backend, call, called, wanted)


@law("signature", *JUDGED, CAMERAS)
def test_the_tile_lists_that_meta_shows_run_front_to_back_and_hold_who_is_blended(backend):
    call, called, wanted = _made(backend, TILES[1:3], needs_all=True)
    assert_tiles(backend, call, called, wanted)


@law("signature", *JUDGED, CAMERAS, PACKED)
def test_the_tile_lists_of_packed_rows_run_front_to_back_and_hold_who_is_blended(backend):
    call, called, wanted = _made(backend, TILES[1:3], needs_all=True, packed=True)
    assert_tiles(backend, call, called, wanted)


@law("signature", *JUDGED, SCALE, EXTENTS, PRINCIPAL_POINT)
def test_a_splat_over_hundreds_of_tiles_counts_all_of_them(backend):
    meta = backend.call(Call(((Frame(backend.sees(corpus_scene("hundreds_of_tiles_a_splat")), None),),))).meta
    lacks = [name for name in ("tiles_per_gauss", "flatten_ids") if name not in meta]
    if lacks:
        pytest.skip(f"{backend.name} has no meta {', '.join(lacks)}")
    counts = np.bincount(meta["flatten_ids"], minlength=meta["tiles_per_gauss"].size)
    assert counts.max() > 255, "no splat lies over more tiles than a byte counts"
    assert_same_bits("meta tiles_per_gauss", meta["tiles_per_gauss"].reshape(-1), counts)


@law("signature", *JUDGED, CAMERAS, PACKED)
def test_dominant_ids_are_of_gaussians_and_not_of_packed_rows(backend):
    (_, plain, _), (_, packed, _) = (_made(backend, ("dominant_ids",), packed=each) for each in (False, True))
    assert_same_bits("dominant ids, packed or not", packed.meta["dominant_ids"], plain.meta["dominant_ids"])


@law("signature", *JUDGED, CAMERAS)
def test_the_keys_of_intersections_hold_image_tile_and_depth(backend):
    call, called, wanted = _made(backend, ("isect_ids", "flatten_ids", "isect_offsets", "depths"), needs_all=True)
    assert_keys(called.meta, len(call.frames[0]), len(wanted[0][0].render.tile_lists))


@law("signature", *JUDGED, CAMERAS, PACKED)
def test_the_keys_of_packed_intersections_hold_image_tile_and_depth(backend):
    names = ("isect_ids", "flatten_ids", "isect_offsets", "depths")
    call, called, wanted = _made(backend, names, needs_all=True, packed=True)
    assert_keys(called.meta, len(call.frames[0]), len(wanted[0][0].render.tile_lists))
