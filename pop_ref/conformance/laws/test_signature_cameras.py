"""Laws of gsplat's signature: cameras, batches and packed rows; every frame is what the oracle draws of it alone."""

from __future__ import annotations

import numpy as np

from pop_ref.conformance.calls import Call, Frame
from pop_ref.conformance.capabilities import (
    BATCHES,
    CAMERA_COLORS,
    CAMERAS,
    COLORS,
    PACKED,
    SIGNATURE,
)
from pop_ref.conformance.law import law
from pop_ref.conformance.meta import assert_rows
from pop_ref.conformance.signature import assert_call_is_the_oracles, expectations
from pop_ref.conformance.views import frames

JUDGED = (SIGNATURE,)


@law("signature", *JUDGED, CAMERAS)
def test_several_cameras_in_one_call_see_what_each_sees_alone(backend):
    for seed, degree in ((0, 1), (1, 3), (2, 0)):
        assert_call_is_the_oracles(backend, Call((frames(backend, seed, 3, degree),)))


@law("signature", *JUDGED, CAMERAS, CAMERA_COLORS)
def test_every_camera_has_the_colours_and_harmonics_that_were_given_for_it(backend):
    for channels in (0, 3):
        row = frames(backend, 3, 3, channels=channels, camera_colors=True)
        assert_call_is_the_oracles(backend, Call((row,), camera_colors=True))


@law("signature", *JUDGED, CAMERAS, COLORS)
def test_where_there_are_as_many_gaussians_as_cameras_a_colour_is_a_gaussians(backend):
    row = frames(backend, 0, 3, channels=3)
    visible = [wanted.render.splats.visible for wanted in expectations(backend, Call((row,)))[0]]
    seen = np.flatnonzero(np.all(visible, axis=0))[:3]
    few = tuple(Frame(frame.scene.rows(seen), frame.colors[seen]) for frame in row)
    assert_call_is_the_oracles(backend, Call((few,)))


@law("signature", *JUDGED, CAMERAS, CAMERA_COLORS)
def test_where_there_are_as_many_gaussians_as_cameras_a_cameras_colours_are_its_own(backend):
    for channels in (0, 3):
        row = frames(backend, 3, 3, channels=channels, camera_colors=True)
        call = Call((row,), camera_colors=True)
        visible = [wanted.render.splats.visible for wanted in expectations(backend, call)[0]]
        seen = np.flatnonzero(np.all(visible, axis=0))[:3]
        assert len(seen) == 3, "no three Gaussians are seen by all cameras"
        few = tuple(Frame(f.scene.rows(seen), None if f.colors is None else f.colors[seen]) for f in row)
        assert_call_is_the_oracles(backend, Call((few,), camera_colors=True))


@law("signature", *JUDGED, CAMERAS, BATCHES)
def test_batch_entries_do_not_know_of_each_other(backend):
    rows = tuple(frames(backend, 4 + entry, 2, entry=entry) for entry in range(2))
    assert_call_is_the_oracles(backend, Call(rows, batch=(2,)))
    plain = tuple(frames(backend, 4 + entry, 2, channels=3, camera_colors=True, entry=entry) for entry in range(2))
    assert_call_is_the_oracles(backend, Call(plain, batch=(2,), camera_colors=True))


@law("signature", *JUDGED, PACKED, CAMERAS)
def test_packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same(backend):
    for seed in (0, 6):
        call = Call((frames(backend, seed, 3),), packed=True)
        of = assert_call_is_the_oracles(backend, call)
        assert any(not all(e.render.splats.visible) for _, _, e in of.each()), "no Gaussian is culled"
        assert_rows(backend, of)


@law("signature", *JUDGED, PACKED, CAMERAS, BATCHES)
def test_packed_rows_of_batch_entries_draw_the_same(backend):
    rows = tuple(frames(backend, 7 + entry, 2, entry=entry) for entry in range(2))
    assert_rows(backend, assert_call_is_the_oracles(backend, Call(rows, batch=(2,), packed=True)))
