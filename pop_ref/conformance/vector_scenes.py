"""What the portable vectors draw: single scenes, one for each thing that goes wrong in a port, and calls of cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from pop_ref.conformance.adapter import Adapter
from pop_ref.conformance.calls import Call, Frame
from pop_ref.conformance.scenes import Record, Scene, golden_scene, pack
from pop_ref.conformance.views import call_for, clear_call
from pop_ref.constants import GSPLAT_1_6, INRIA, PAPER, Profile
from pop_ref.depth import RenderMode
from pop_ref.records import Camera
from pop_ref.splatting import project


def calls() -> dict[str, Call]:
    """Return the calls by name."""
    reader = Adapter()  # float32 and the paper's constants

    def seen(seed: int, count: int, mode: RenderMode = "RGB", **asks: Any) -> Call:
        return clear_call(reader, 16 * seed, count=count, render_mode=mode, **asks)

    found = {"three_cameras": seen(0, 3), "three_cameras_of_degree_three": seen(1, 3, degree=3)}
    for k, mode in enumerate(("D", "ED", "RGB+D", "RGB+ED")):
        found[f"mode_{mode.lower().replace('+', '_and_')}"] = seen(2 + k, 2, mode)
    return found | {
        "five_channels": seen(6, 2, channels=5),
        "one_channel_and_depth": seen(7, 2, "RGB+ED", channels=1),
        "thirty_three_channels": seen(8, 2, channels=33),
        "antialiased_cameras": seen(9, 2, antialiased=True),
        "antialiased_depth_under_a_wide_low_pass": seen(10, 2, "RGB+ED", antialiased=True, eps2d=1.25),
        "a_near_plane": seen(11, 2, "RGB+D", near_plane=2.0),
        "a_far_plane": seen(12, 2, far_plane=4.5),
        "small_splats_left_out": seen(13, 2, "ED", radius_clip=5.5),
        "first_band_of_three": seen(14, 2, degree=3, sh_degree=1),
        "harmonics_of_each_camera": seen(15, 3, degree=3, camera_colors=True),
        "colors_of_each_camera": seen(16, 3, "RGB+D", channels=4, camera_colors=True),
        "a_camera_that_sees_nothing": seen(17, 2, blind=1),
        "hundreds_of_tiles": seen(18, 2, size=(35, 33), tile_size=2),
        "batches": seen(19, 2, "RGB+ED", batch=(2,)),
        "batches_of_two_dimensions": seen(20, 2, batch=(2, 2), antialiased=True, eps2d=1.25),
        "packed": seen(21, 3, packed=True),
        "packed_depth_and_a_blind_camera": seen(22, 3, "RGB+ED", packed=True, blind=0),
        "packed_antialiased": seen(23, 2, packed=True, antialiased=True, eps2d=1.25),
        "packed_between_planes": seen(24, 2, packed=True, near_plane=2.0, far_plane=4.5),
        "packed_small_splats_left_out": seen(25, 2, packed=True, radius_clip=5.5, sh_degree=1, degree=3),
        "packed_colors_of_each_camera": seen(26, 3, packed=True, channels=4, camera_colors=True),
        "packed_plain_colors": seen(27, 2, packed=True, channels=3),
        "packed_batches": seen(28, 2, batch=(2,), packed=True),
        "packed_batches_of_two_dimensions": seen(29, 2, batch=(2, 2), packed=True),
        "packed_covariances": seen(30, 2, packed=True, covars=True),
        "covariances": seen(31, 2, covars=True, antialiased=True),
        "covariances_of_batches": seen(32, 2, covars=True, batch=(2,)),
        "covariances_between_planes": seen(33, 2, covars=True, near_plane=2.0, radius_clip=5.5),
        "small_splats_of_one_axis_stay": seen(34, 2, radius_clip=4.5),
        "without_backgrounds": seen(35, 2, no_background=True),
        "plain_batches": seen(36, 2, batch=(2,), channels=3),
        "small_splats_of_one_camera": seen(37, 1, radius_clip=4.5),
        "packed_and_the_last_camera_is_blind": seen(38, 3, packed=True, blind=2),
        "a_tile_for_every_pixel": seen(39, 2, size=(35, 33), tile_size=1),
        "a_centre_on_the_far_plane": _on_the_far_plane(reader),
        "planes_are_no_spheres": _off_the_axis(reader),
        "no_near_plane": _before_the_eye(reader),
        "no_low_pass": seen(40, 2, eps2d=0.0),
        "exactly_as_small_as_the_clip": _as_small_as_the_clip(reader),
        "thirty_two_channels": seen(41, 2, channels=32),
        "depth_behind_thirty_two_channels": seen(42, 2, "RGB+ED", channels=32),
        "as_many_gaussians_as_cameras": _few(seen(43, 3, channels=3), 3),
        "as_many_gaussians_as_cameras_of_own_colors": _few(seen(44, 3, channels=3, camera_colors=True), 3),
        "a_batch_of_one": seen(45, 2, batch=(1,)),
        "covariances_under_a_wide_low_pass": seen(46, 2, covars=True, eps2d=1.25),
        "packed_depth": seen(47, 3, "D", packed=True),
        "packed_screen_centres_of_three_cameras": seen(48, 3, packed=True, degree=2),
        **_beyond_the_usual(seen, reader),
    }


def _beyond_the_usual(seen: Callable[..., Call], reader: Adapter) -> dict[str, Call]:
    """Return calls of more cameras, farther away, of smaller numbers than scenes usually have."""
    return {
        "fifteen_cameras": _five_times(seen(49, 3, degree=2, camera_colors=True)),
        "cameras_at_one_place": _at_one_place(seen(50, 2)),
        "short_quaternions": _told_in_units(seen(51, 2), quats=2.0**-24),
        "thousands_of_units_away": _told_in_units(seen(52, 2, "RGB+D"), lengths=2.0**12),
        "covariances_of_one_camera": seen(53, 1, covars=True, antialiased=True),
        "a_background_of_one_channel": seen(54, 2, "ED", channels=1),
        "specks": Call(((Frame(reader.sees(_specks())),),)),
    }


def _five_times(call: Call) -> Call:
    """Return a call of every camera five times."""
    return replace(call, frames=(5 * call.frames[0],))


def _at_one_place(call: Call) -> Call:
    """Return a call whose second camera stands where the first one does, and has a lens of its own."""
    first, second = call.frames[0]
    moved = replace(second, scene=second.scene.with_overrides(viewmat=first.scene.camera.viewmat))
    return replace(call, frames=((first, moved),))


def _told_in_units(call: Call, quats: float = 1.0, lengths: float = 1.0) -> Call:
    """Return a call with quaternions, and lengths of the world, times powers of two: its pictures are the same."""
    frames = []
    for frame in call.frames[0]:
        scene, g = frame.scene, frame.scene.gaussians
        viewmat = scene.camera.viewmat.copy()
        viewmat[:3, 3] *= lengths
        told = {"quats": quats * g.quats, "means": lengths * g.means, "scales": lengths * g.scales}
        frames.append(replace(frame, scene=scene.with_overrides(**told, viewmat=viewmat)))
    return replace(call, frames=(tuple(frames),))


def _specks() -> Scene:
    """Return white specks in a row, which antialiasing dims to little more than an alpha that is skipped."""
    camera = _camera()
    one = Record(5.5, 4.5, size=(0.0375, 0.0375, 0.0375), opacity=0.9375, sh=((1.5, 1.5, 1.5),))
    return Scene(pack([replace(one, depth=2.0 + k) for k in range(12)], camera), camera, antialiased=True)


def _few(call: Call, n: int) -> Call:
    """Return a call of the first Gaussians that some camera sees."""
    rows = list(range(2, 2 + n))
    frames = tuple(
        Frame(frame.scene.rows(rows), None if frame.colors is None else frame.colors[rows]) for frame in call.frames[0]
    )
    return replace(call, frames=(frames,))


def _off_the_axis(reader: Adapter) -> Call:
    """Return a call of a wide camera with Gaussians that planes part by depth, and distance would otherwise."""
    frame = call_for(reader, 601).first
    K = np.array([[6.0, 0.0, 8.5], [0.0, 6.0, 5.5], [0.0, 0.0, 1.0]])
    camera = Camera(np.eye(4), K, frame.scene.camera.width, frame.scene.camera.height)
    means = np.array([[1.875, 0.0, 1.75], [2.5, 0.25, 3.75], [0.125, 0.25, 2.5]])
    scene = frame.scene.rows([2, 3, 4]).with_overrides(means=means, camera=camera)
    return Call(((Frame(scene),),), planes={"near_plane": 2.0, "far_plane": 4.0})


def _before_the_eye(reader: Adapter) -> Call:
    """Return a call without a near plane, and with a Gaussian that its default would cull."""
    frame = call_for(reader, 602).first
    means = np.array([[0.0, 0.0, 2.0**-8], [0.25, 0.0, 3.0], [-0.5, 0.25, 2.0]])
    scales = np.array([[2.0**-11] * 3, [0.25, 0.5, 0.125], [0.25, 0.125, 0.25]])
    scene = frame.scene.rows([2, 3, 4]).with_overrides(means=means, scales=scales, viewmat=np.eye(4))
    return Call(((Frame(scene),),), planes={"near_plane": 0.0})


def _as_small_as_the_clip(reader: Adapter) -> Call:
    """Return a call of a Gaussian whose larger extent is the clip: it is left out (D2)."""
    for seed in range(700, 764):
        call = clear_call(reader, seed, radius_clip=5.0)
        scene = call.first.scene
        radii = project(scene.gaussians, scene.camera, scene.sh_degree, scene.profile, scene.antialiased).radii
        if np.any(np.max(radii, axis=1) == call.radius_clip):
            return call
    raise AssertionError("no Gaussian has an extent of the clip")


def _on_the_far_plane(reader: Adapter) -> Call:
    """Return a call of a camera that does not turn, with a centre on its far plane and one beyond."""
    frame = call_for(reader, 600).first
    placed = {"means": np.array([[0.0, 0.0, 3.0], [0.25, 0.0, 5.0]]), "viewmat": np.eye(4)}
    return Call(((Frame(frame.scene.rows([0, 1]).with_overrides(**placed)),),), planes={"far_plane": 3.0})


_BANDS = tuple((0.125 * (k % 5) - 0.25, 0.0625 * (k % 7) - 0.125, 0.25 - 0.0625 * (k % 3)) for k in range(15))


def _camera(width: int = 12, height: int = 9, turned: bool = False) -> Camera:
    K = np.array([[12.0, 0.0, 5.5], [0.0, 11.0, 4.75], [0.0, 0.0, 1.0]])
    viewmat = np.eye(4)
    if turned:
        viewmat[:3] = [[0.0, 0.0, -1.0, 0.5], [0.6, 0.8, 0.0, -0.25], [0.8, -0.6, 0.0, 1.5]]
    return Camera(viewmat, K, width, height)


def _aside() -> Camera:
    camera = _camera()
    K = camera.K.copy()
    K[0, 2] = -4.0
    return dataclasses.replace(camera, K=K)


def _scene(records: list[Record], turned: bool = False, profile: Profile = PAPER) -> Scene:
    camera = _camera(turned=turned)
    return Scene(pack(records, camera), camera, np.array([0.125, 0.25, 0.5]), profile)


def vector_scenes() -> dict[str, Scene]:
    """Return the scenes by name."""
    one = Record(5.75, 4.25, 2.0, (2.0, 2.0, 2.0), opacity=0.75, sh=((1.0, 0.5, -0.25),))
    turned = dataclasses.replace(one, size=(3.0, 1.0, 0.5), quat=(1.0, 0.5, -0.25, 0.75))
    coloured = dataclasses.replace(turned, sh=((0.5, 0.25, 1.0), *_BANDS))
    stack = [dataclasses.replace(one, depth=1.0 + k, opacity=o) for k, o in enumerate((0.9, 0.99, 0.95, 1.0, 0.5))]
    clones = [dataclasses.replace(one, opacity=0.5)] * 3
    faint = [dataclasses.replace(one, opacity=o, depth=1.0 + o) for o in (0.0, 0.003, 0.0035, 0.005, 0.0625)]
    far_out = [
        dataclasses.replace(one, x=-30.0, size=(12.0, 12.0, 12.0)),
        dataclasses.replace(one, y=40.0, size=(16.0,) * 3),
    ]
    hidden = [
        one,
        dataclasses.replace(one, depth=-1.0),
        dataclasses.replace(one, depth=0.001),
        dataclasses.replace(one, x=900.0),
    ]
    # in a tile of 16 px, and in none of 4
    beyond = dataclasses.replace(one, x=21.0)
    needle = dataclasses.replace(one, size=(24.0, 0.0625, 0.0625), quat=(1.0, 0.0, 0.0, 0.5), opacity=1.0)
    scenes = {
        "one round splat": _scene([one]),
        "one turned splat": _scene([turned]),
        "a turned camera": _scene([one, turned], turned=True),
        "harmonics of degree three": _scene([coloured], turned=True),
        "a stack that ends early": _scene(stack),
        "coincident clones": _scene(clones),
        "opacities about the floor": _scene(faint),
        "a clamped jacobian": _scene([one, *far_out]),
        "hidden splats": _scene(hidden),
        "a needle": _scene([needle, one]),
        "antialiased": _scene([one, dataclasses.replace(one, size=(0.25, 0.5, 0.25), opacity=1.0)]).with_overrides(
            antialiased=True
        ),
        "the ceiling of 0.99": _scene(stack, profile=GSPLAT_1_6),
        "inria": _scene([one, turned, *stack[2:]], profile=INRIA),
        "inria in smaller tiles": _scene([one, *far_out, beyond], profile=INRIA).with_overrides(tile_size=4),
        "no splat": _scene([]),
        "nothing in view": _scene(hidden[1:]),
        "a row of pixels": _scene([one, turned]).with_overrides(camera=_camera(height=1)),
        "a column of pixels": _scene([one, turned]).with_overrides(camera=_camera(width=1)),
        "more rows than a byte numbers": _scene([one, dataclasses.replace(turned, y=262.5)]).with_overrides(
            camera=_camera(height=270)
        ),
        "flat splats": _scene([dataclasses.replace(turned, size=(3.0, 1.0, size)) for size in (0.0, 2.0**-8)]),
        "a splat before the eye": _scene([dataclasses.replace(one, depth=0.125)]),
        "a principal point outside": _scene([one, turned]).with_overrides(camera=_aside()),
        "golden": golden_scene(),
    }
    return {name.replace(" ", "_"): scene for name, scene in scenes.items()}
