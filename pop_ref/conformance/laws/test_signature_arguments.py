"""Laws of gsplat's signature: every frame of a call is what the oracle draws of it alone, with gradients.

Arguments away from their defaults, several cameras, batches, packed rows, and modes of depth.
"""

from __future__ import annotations

import dataclasses
from itertools import product

import numpy as np

from pop_ref.conformance.assertions import assert_same_bits
from pop_ref.conformance.calls import Call, Frame
from pop_ref.conformance.capabilities import (
    ANTIALIASING,
    BATCHES,
    CAMERA_COLORS,
    CAMERAS,
    CHANNELS,
    COLORS,
    COVARS,
    DEPTH,
    EXTENTS,
    NO_BACKGROUND,
    PACKED,
    PLANES,
    PROFILES,
    RADIUS_CLIP,
    SIGNATURE,
    SPARSE_GRAD,
)
from pop_ref.conformance.law import law
from pop_ref.conformance.signature import (
    assert_call_is_the_oracles,
    assert_gradients,
    assert_images,
    assert_rows,
    expectations,
    made,
)
from pop_ref.conformance.views import ASKED, call_for, clear_of_extents, frames


def _assert_it_matters(backend, call, **default):
    """Assert that the oracle draws something else without the argument: a call that cannot tell says nothing."""
    one, other = expectations(backend, call), expectations(backend, dataclasses.replace(call, **default))
    moved = [np.max(np.abs(a.render.image - b.render.image)) for a, b in zip(one[0], other[0], strict=True)]
    assert max(moved) > 2.0**-8, "the argument changes nothing in this scene"


@law("signature", SIGNATURE, COLORS)
def test_plain_colours_are_drawn_as_they_are(backend):
    for seed in (0, 1):
        assert_call_is_the_oracles(backend, Call((frames(backend, seed, channels=3),)))
    # of a light probe, or of features
    (frame,) = frames(backend, 0, channels=3)
    assert_call_is_the_oracles(backend, Call(((dataclasses.replace(frame, colors=frame.colors * 2.0**12),),)))


@law("signature", SIGNATURE, CHANNELS)
def test_colours_of_any_number_of_channels_are_drawn_alike(backend):
    # as many as a renderer blends at a time, and more, too: gsplat's `channel_chunk` is 32
    for channels in (1, 2, 4, 8, 32, 40, 64, 130):
        assert_call_is_the_oracles(backend, Call((frames(backend, channels, channels=channels),)))


@law("signature", SIGNATURE, NO_BACKGROUND, COLORS, CAMERAS)
def test_without_a_background_it_is_black(backend):
    for channels in (0, 3):
        row = frames(backend, 2, 2, channels=channels, black=True)
        assert_call_is_the_oracles(backend, Call((row,), no_background=True))


def _behind(scene):
    """Return the scene with every Gaussian behind its camera."""
    V = scene.camera.viewmat
    behind = V[:3, :3].T @ (np.array([0.0, 0.0, -8.0]) - V[:3, 3])
    return scene.with_overrides(means=np.broadcast_to(behind, scene.gaussians.means.shape))


@law("signature", SIGNATURE)
def test_where_nothing_is_seen_there_is_the_background_whatever_is_asked(backend):
    # a scene without Gaussians, and one behind the cameras; backgrounds learn of every pixel
    for capability, asks in ASKED.items():
        if not backend.has(capability):
            continue
        call = call_for(backend, **asks)
        for rows, moved in (([], False), (slice(None), True)):
            of = [[Frame(backend.sees(_behind(f.scene)) if moved else f.scene.rows(np.array(rows, dtype=int)),
                         f.colors if moved or f.colors is None else f.colors[rows]) for f in row]
                  for row in call.frames]  # fmt: skip
            one = made(backend, dataclasses.replace(call, frames=tuple(map(tuple, of)), planes={}))
            assert all(np.all(e.render.T_final == 1.0) for _, _, e in one.each()), "something is seen"
            assert_images(backend, one)
            assert_gradients(backend, one)


@law("signature", SIGNATURE, COVARS)
def test_covariances_draw_what_their_quaternions_and_scales_draw(backend):
    # antialiasing's factor follows them, too
    for seed, antialiased in product((3, 4), sorted({False, backend.has(ANTIALIASING)})):
        assert_call_is_the_oracles(backend, Call((frames(backend, seed, antialiased=antialiased),), covars=True))


@law("signature", SIGNATURE, COVARS)
def test_covariances_go_before_quaternions_and_scales(backend):
    assert_call_is_the_oracles(backend, Call((frames(backend, 3),), covars=True, overruled=True))


@law("signature", SIGNATURE, PLANES)
def test_the_near_and_the_far_plane_are_where_the_call_says(backend):
    for planes in ({"near_plane": 2.0}, {"far_plane": 4.0}, {"near_plane": 1.5, "far_plane": 4.5}):
        call = Call((frames(backend, 5),), planes=planes)
        _assert_it_matters(backend, call, planes={})
        depths = expectations(backend, call)[0][0].render.splats.depths
        assert all(np.min(np.abs(depths - plane)) > 2.0**-8 for plane in planes.values()), "a depth is at a plane"
        assert_call_is_the_oracles(backend, call)
    nowhere = Call((frames(backend, 5),), planes={"far_plane": np.inf})
    assert_same_bits(
        "image", backend.call(nowhere).images, backend.call(dataclasses.replace(nowhere, planes={})).images
    )


@law("signature", SIGNATURE, PLANES)
def test_the_far_plane_culls_by_depth_and_not_by_distance(backend):
    frame = frames(backend, 5)[0]
    camera, means = frame.scene.camera, frame.scene.gaussians.means
    seen = means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    shown = expectations(backend, Call(((frame,),)))[0][0].render.splats.visible
    beyond = np.where(shown, np.linalg.norm(seen, axis=1) - seen[:, 2], 0.0)
    between = float(seen[np.argmax(beyond), 2] + 0.5 * np.max(beyond))
    assert np.min(np.abs(seen[:, 2] - between)) > 2.0**-8, "a depth is at the plane"
    assert_call_is_the_oracles(backend, Call(((frame,),), planes={"far_plane": between}))


@law("signature", SIGNATURE, PLANES)
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
    # on the plane of the camera there is no pinhole to look through
    nearer["means"] = np.zeros((1, 3))
    called = backend.call(Call(((Frame(scene.with_overrides(**nearer), None),),), planes={"near_plane": 0.0}))
    assert called.alphas.max() == 0.0, "depth 0 at near_plane=0 is drawn"


@law("signature", SIGNATURE, PLANES)
def test_the_low_pass_is_as_wide_as_the_call_says(backend):
    # 0 is a width like any other, and none that was left out
    for eps2d in (0.0625, 2.0, 0.0):
        call = Call((frames(backend, 6),), planes={"eps2d": eps2d})
        _assert_it_matters(backend, call, planes={})
        assert_call_is_the_oracles(backend, call)


@law("signature", SIGNATURE, PLANES, PROFILES)
def test_a_profile_has_its_own_planes_and_low_pass_where_a_call_is_at_the_defaults(backend):
    # as Inria's near plane is 0.2, and gsplat's signature says 0.01 by itself
    (frame,) = frames(backend, 5)
    own = {"near_plane": 2.0, "far_plane": 4.5, "eps2d": 1.0}
    scene = backend.sees(frame.scene.with_overrides(profile=dataclasses.replace(frame.scene.profile, **own)))
    call = Call(((Frame(scene, None),),), planes=own)
    usual = {"near_plane": 0.01, "far_plane": 1e10, "eps2d": 0.3}
    _assert_it_matters(backend, call, planes=usual)
    # what has no argument for a profile reads the planes that it is given
    unsaid = dataclasses.replace(call, planes=usual if backend.takes("profile") else {})
    assert_same_bits("image", backend.call(unsaid).images, backend.call(call).images)


def _in_units(frame, unit):
    """Return a frame of the same world, with lengths, and quaternions, told in a unit: its picture is the same."""
    scene = frame.scene
    viewmat = scene.camera.viewmat.copy()
    viewmat[:3, 3] *= unit
    g = scene.gaussians
    lengths = {"means": g.means * unit, "scales": g.scales * unit, "quats": g.quats * unit**2}
    return dataclasses.replace(frame, scene=scene.with_overrides(**lengths, viewmat=viewmat))


@law("signature", SIGNATURE, PLANES)
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


@law("signature", SIGNATURE, EXTENTS, RADIUS_CLIP)
def test_what_is_no_larger_than_radius_clip_is_culled(backend):
    for seed, clip in ((7, 6.0), (8, 5.5)):
        call = Call((frames(backend, seed),), radius_clip=clip)
        _assert_it_matters(backend, call, radius_clip=0.0)
        assert np.all(clear_of_extents(call.first.scene, backend.dtype)), "rounding decides an extent of this scene"
        assert_call_is_the_oracles(backend, call)


@law("signature", SIGNATURE, PACKED, SPARSE_GRAD)
def test_sparse_gradients_are_the_dense_ones(backend):
    assert_call_is_the_oracles(backend, Call((frames(backend, 9, 1),), packed=True, sparse_grad=True))


@law("signature", SIGNATURE, CAMERAS)
def test_several_cameras_in_one_call_see_what_each_sees_alone(backend):
    for seed, degree in ((0, 1), (1, 3), (2, 0)):
        assert_call_is_the_oracles(backend, Call((frames(backend, seed, 3, degree),)))


@law("signature", SIGNATURE, CAMERAS, CAMERA_COLORS)
def test_every_camera_has_the_colours_and_harmonics_that_were_given_for_it(backend):
    # more cameras than three bits count, and than a warp has threads
    for channels, times in ((0, 3), (3, 11)):
        row = frames(backend, 3, 3, channels=channels, camera_colors=True)
        assert_call_is_the_oracles(backend, Call((row * times,), camera_colors=True))
        # the second from where the first stands, through a lens of its own
        pose = row[0].scene.camera.viewmat
        moved = dataclasses.replace(row[1], scene=row[1].scene.with_overrides(viewmat=pose))
        assert_call_is_the_oracles(backend, Call(((row[0], moved),), camera_colors=True))


@law("signature", SIGNATURE, CAMERAS, COLORS)
def test_where_there_are_as_many_gaussians_as_cameras_a_colour_is_a_gaussians(backend):
    row = frames(backend, 0, 3, channels=3)
    visible = [wanted.render.splats.visible for wanted in expectations(backend, Call((row,)))[0]]
    seen = np.flatnonzero(np.all(visible, axis=0))[:3]
    few = tuple(Frame(frame.scene.rows(seen), frame.colors[seen]) for frame in row)
    assert_call_is_the_oracles(backend, Call((few,)))


@law("signature", SIGNATURE, CAMERAS, CAMERA_COLORS)
def test_where_there_are_as_many_gaussians_as_cameras_a_cameras_colours_are_its_own(backend):
    for channels in (0, 3):
        row = frames(backend, 3, 3, channels=channels, camera_colors=True)
        call = Call((row,), camera_colors=True)
        visible = [wanted.render.splats.visible for wanted in expectations(backend, call)[0]]
        seen = np.flatnonzero(np.all(visible, axis=0))[:3]
        assert len(seen) == 3, "no three Gaussians are seen by all cameras"
        few = tuple(Frame(f.scene.rows(seen), None if f.colors is None else f.colors[seen]) for f in row)
        assert_call_is_the_oracles(backend, Call((few,), camera_colors=True))


@law("signature", SIGNATURE, CAMERAS, BATCHES)
def test_batch_entries_do_not_know_of_each_other(backend):
    rows = tuple(frames(backend, 4 + entry, 2, entry=entry) for entry in range(2))
    assert_call_is_the_oracles(backend, Call(rows, batch=(2,)))
    plain = tuple(frames(backend, 4 + entry, 2, channels=3, camera_colors=True, entry=entry) for entry in range(2))
    assert_call_is_the_oracles(backend, Call(plain, batch=(2,), camera_colors=True))
    # in the order of the first axis, then of the second
    squared = tuple(frames(backend, 4 + entry, entry=entry) for entry in range(4))
    assert_call_is_the_oracles(backend, Call(squared, batch=(2, 2)))
    # the same Gaussians for other cameras, in the memory of one entry
    alike = tuple(frames(backend, 4, 2, entry=entry) for entry in range(2))
    assert_call_is_the_oracles(backend, Call(alike, batch=(2,), expanded=True))


@law("signature", SIGNATURE, PACKED, CAMERAS)
def test_packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same(backend):
    for seed in (0, 6):
        call = Call((frames(backend, seed, 3),), packed=True)
        of = assert_call_is_the_oracles(backend, call)
        assert any(not all(e.render.splats.visible) for _, _, e in of.each()), "no Gaussian is culled"
        assert_rows(backend, of)


@law("signature", SIGNATURE, PACKED, CAMERAS, BATCHES)
def test_packed_rows_of_batch_entries_draw_the_same(backend):
    rows = tuple(frames(backend, 7 + entry, 2, entry=entry) for entry in range(2))
    assert_rows(backend, assert_call_is_the_oracles(backend, Call(rows, batch=(2,), packed=True)))


@law("signature", SIGNATURE, DEPTH)
def test_the_accumulated_depth_is_the_oracles_alone_and_behind_colours(backend):
    for seed in (0, 1):
        (frame,) = frames(backend, seed)
        # thousands of units away, too
        for unit, mode in product((1.0, 2.0**12), ("D", "RGB+D")):
            assert_call_is_the_oracles(backend, Call(((_in_units(frame, unit),),), render_mode=mode))


@law("signature", SIGNATURE, DEPTH)
def test_the_expected_depth_is_the_accumulated_one_over_the_opacity(backend):
    for seed in (0, 1):
        for mode in ("ED", "RGB+ED"):
            of = assert_call_is_the_oracles(backend, Call((frames(backend, seed),), render_mode=mode))
            assert np.any(of.wanted[0][0].render.T_final > 0.125), "no pixel is transparent; both depths would be one"


@law("signature", SIGNATURE, DEPTH, COLORS, CAMERAS)
def test_depth_follows_plain_colours_of_several_cameras(backend):
    # kernels pad channels to the next number that they are compiled for, or take 32 at a time, and depth comes after
    # those that there are
    behind = ((3, "RGB+ED"), (4, "RGB+D"), (2, "RGB+ED"), (6, "RGB+D"), (31, "RGB+D"), (32, "RGB+ED"))
    # a background of one channel is none of a depth
    for channels, mode in (*behind, (1, "D"), (1, "ED")):
        assert_call_is_the_oracles(backend, Call((frames(backend, 9, 2, channels=channels),), render_mode=mode))


@law("signature", SIGNATURE, DEPTH, PACKED)
def test_depth_is_the_same_of_packed_rows(backend):
    for mode in ("ED", "RGB+D"):
        assert_call_is_the_oracles(backend, Call((frames(backend, 10),), render_mode=mode, packed=True))
