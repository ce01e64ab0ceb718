"""Laws of gsplat's signature: colours, backgrounds, covariances, planes and radius_clip away from their defaults."""

from __future__ import annotations

import dataclasses

import numpy as np

from pop_ref.conformance.calls import Call, Frame
from pop_ref.conformance.capabilities import (
    CAMERAS,
    CHANNELS,
    COLORS,
    COVARS,
    EXTENTS,
    NO_BACKGROUND,
    PACKED,
    PLANES,
    RADIUS_CLIP,
    SIGNATURE,
    SPARSE_GRAD,
)
from pop_ref.conformance.law import law
from pop_ref.conformance.signature import assert_call_is_the_oracles, expectations
from pop_ref.conformance.views import clear_of_extents, frames

JUDGED = (SIGNATURE,)


def _assert_it_matters(backend, call, **default):
    """Assert that the oracle draws something else without the argument: a call that cannot tell says nothing."""
    one, other = expectations(backend, call), expectations(backend, dataclasses.replace(call, **default))
    moved = [np.max(np.abs(a.render.image - b.render.image)) for a, b in zip(one[0], other[0], strict=True)]
    assert max(moved) > 2.0**-8, "the argument changes nothing in this scene"


@law("signature", *JUDGED, COLORS)
def test_plain_colours_are_drawn_as_they_are(backend):
    for seed in (0, 1):
        assert_call_is_the_oracles(backend, Call((frames(backend, seed, channels=3),)))


@law("signature", *JUDGED, CHANNELS)
def test_colours_of_any_number_of_channels_are_drawn_alike(backend):
    # more than a renderer blends at a time, too: gsplat's `channel_chunk` is 32
    for channels in (1, 2, 4, 8, 40):
        assert_call_is_the_oracles(backend, Call((frames(backend, channels, channels=channels),)))


@law("signature", *JUDGED, NO_BACKGROUND, COLORS, CAMERAS)
def test_without_a_background_it_is_black(backend):
    for channels in (0, 3):
        row = frames(backend, 2, 2, channels=channels, black=True)
        assert_call_is_the_oracles(backend, Call((row,), no_background=True))


@law("signature", *JUDGED, COVARS)
def test_covariances_draw_what_their_quaternions_and_scales_draw(backend):
    for seed in (3, 4):
        assert_call_is_the_oracles(backend, Call((frames(backend, seed),), covars=True))


@law("signature", *JUDGED, COVARS)
def test_covariances_go_before_quaternions_and_scales(backend):
    assert_call_is_the_oracles(backend, Call((frames(backend, 3),), covars=True, overruled=True))


@law("signature", *JUDGED, PLANES)
def test_the_near_and_the_far_plane_are_where_the_call_says(backend):
    for planes in ({"near_plane": 2.0}, {"far_plane": 4.0}, {"near_plane": 1.5, "far_plane": 4.5}):
        call = Call((frames(backend, 5),), planes=planes)
        _assert_it_matters(backend, call, planes={})
        depths = expectations(backend, call)[0][0].render.splats.depths
        assert all(np.min(np.abs(depths - plane)) > 2.0**-8 for plane in planes.values()), "a depth is at a plane"
        assert_call_is_the_oracles(backend, call)


@law("signature", *JUDGED, PLANES)
def test_the_far_plane_culls_by_depth_and_not_by_distance(backend):
    frame = frames(backend, 5)[0]
    camera, means = frame.scene.camera, frame.scene.gaussians.means
    seen = means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    shown = expectations(backend, Call(((frame,),)))[0][0].render.splats.visible
    beyond = np.where(shown, np.linalg.norm(seen, axis=1) - seen[:, 2], 0.0)
    between = float(seen[np.argmax(beyond), 2] + 0.5 * np.max(beyond))
    assert np.min(np.abs(seen[:, 2] - between)) > 2.0**-8, "a depth is at the plane"
    assert_call_is_the_oracles(backend, Call(((frame,),), planes={"far_plane": between}))


@law("signature", *JUDGED, PLANES)
def test_a_centre_on_the_far_plane_is_drawn_and_one_on_the_near_plane_as_the_profile_says(backend):
    (frame,) = frames(backend, 5)
    one = {"means": [[0.0, 0.0, 3.0]], "scales": [[0.5, 0.5, 0.5]], "opacities": [0.75], "viewmat": np.eye(4)}
    scene = backend.sees(frame.scene.rows([0]).with_overrides(**{name: np.array(value) for name, value in one.items()}))
    assert scene.gaussians.means[0, 2] == 3.0
    for plane, drawn in (("far_plane", True), ("near_plane", not scene.profile.near_inclusive)):
        called = backend.call(Call(((Frame(scene, None),),), planes={plane: 3.0}))
        assert (called.alphas.max() > 0.25) == drawn, f"depth 3 at {plane}=3 is {'culled' if drawn else 'drawn'}"
    # nearer than any default; 0 is a plane like any other, and none that was left out
    nearer = {"means": np.array([[0.0, 0.0, 2.0**-10]]), "scales": np.full((1, 3), 2.0**-12)}
    called = backend.call(Call(((Frame(scene.with_overrides(**nearer), None),),), planes={"near_plane": 0.0}))
    assert called.alphas.max() > 0.25, "depth 2^-10 at near_plane=0 is culled"


@law("signature", *JUDGED, PLANES)
def test_the_low_pass_is_as_wide_as_the_call_says(backend):
    # 0 is a width like any other, and none that was left out
    for eps2d in (0.0625, 2.0, 0.0):
        call = Call((frames(backend, 6),), planes={"eps2d": eps2d})
        _assert_it_matters(backend, call, planes={})
        assert_call_is_the_oracles(backend, call)


def _in_units(frame, unit):
    """Return a frame of the same world, whose lengths are told in a unit: its picture is the same."""
    scene = frame.scene
    viewmat = scene.camera.viewmat.copy()
    viewmat[:3, 3] *= unit
    g = scene.gaussians
    lengths = {"means": g.means * unit, "scales": g.scales * unit}
    return dataclasses.replace(frame, scene=scene.with_overrides(**lengths, viewmat=viewmat))


@law("signature", *JUDGED, PLANES)
def test_a_world_told_in_other_units_is_drawn_alike(backend):
    # where a coordinate is a millimetre or a light-year: no length may be compared with a constant of the renderer
    drawn = []
    for power in (0, -12, 12):
        (frame,) = frames(backend, 5)
        near, far = (plane * 2.0**power for plane in (0.0078125, 1e9))
        call = Call(((_in_units(frame, 2.0**power),),), planes={"near_plane": near, "far_plane": far})
        drawn.append(expectations(backend, call)[0][0].render.image)
        assert_call_is_the_oracles(backend, call)
    assert all(np.array_equal(image, drawn[0]) for image in drawn[1:]), "the oracle knows a length"


@law("signature", *JUDGED, EXTENTS, RADIUS_CLIP)
def test_what_is_no_larger_than_radius_clip_is_culled(backend):
    for seed, clip in ((7, 6.0), (8, 5.5)):
        call = Call((frames(backend, seed),), radius_clip=clip)
        _assert_it_matters(backend, call, radius_clip=0.0)
        assert np.all(clear_of_extents(call.first.scene, backend.dtype)), "rounding decides an extent of this scene"
        assert_call_is_the_oracles(backend, call)


@law("signature", *JUDGED, PACKED, SPARSE_GRAD)
def test_sparse_gradients_are_the_dense_ones(backend):
    assert_call_is_the_oracles(backend, Call((frames(backend, 9, 1),), packed=True, sparse_grad=True))
