"""Laws of whole renders: what must not change an image, and what must move it."""

from __future__ import annotations

import dataclasses

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import (
    assert_close,
    assert_same_bits,
    assert_same_image,
    assert_same_transmittance,
    assert_seen,
    with_error_bounds,
)
from pop_ref.conformance.capabilities import (
    DETERMINISTIC,
    EXTENTS,
    HOMOGENEOUS,
    INRIAS,
    PRINCIPAL_POINT,
    RENDER,
    ROWWISE,
)
from pop_ref.conformance.law import law
from pop_ref.conformance.scenes import Record, Scene, pack
from pop_ref.conformance.strategies import backgrounds, cameras, corners, plain_sizes, quats, records, rigid, scenes
from pop_ref.constants import INRIA
from pop_ref.records import Camera, Gaussians

plain = scenes(anchored=True, size=plain_sizes())


def _tallies(view):
    return [(n, getattr(view, n)) for n in ("dominant_ids", "n_blended") if getattr(view, n) is not None]


def _same_image_and_transmittance(key, backend, one, other, error_bounds):
    assert_same_image(key, backend, one.image, other.image, error_bounds)
    assert_same_transmittance(key, backend, one.T_final, other.T_final, error_bounds)


def _same_render(key, backend, one, other, error_bounds):
    _same_image_and_transmittance(key, backend, one, other, error_bounds)
    for (name, a), (_, b) in zip(_tallies(one), _tallies(other), strict=True):
        assert_same_bits(name, a, b, error_bounds.decided)


@law("whole", RENDER, DETERMINISTIC, first=corners(3), scene=scenes(max_degree=3))
def test_two_runs_give_the_same_bits(backend, scene):
    seen = backend.sees(scene)
    one, other = backend.render(seen), backend.render(seen)
    assert_same_bits("image", one.image, other.image)
    assert_same_bits("remaining transmittance", one.T_final, other.T_final)
    for (name, a), (_, b) in zip(_tallies(one), _tallies(other), strict=True):
        assert_same_bits(name, a, b)


@law("whole", RENDER, camera=cameras(), background=backgrounds())
def test_an_empty_scene_is_the_background(backend, camera, background):
    view = backend.render(backend.sees(Scene(pack([], camera), camera, background)))
    H, W = camera.height, camera.width
    assert_same_bits("image", view.image, np.broadcast_to(np.array(background), (H, W, 3)))
    assert_same_bits("remaining transmittance", view.T_final, np.ones((H, W)))


@law("whole", RENDER, EXTENTS, first=corners(with_={"size": 5}), scene=plain, size=st.sampled_from([1, 2, 3, 5, 16]))
def test_any_tile_size_gives_the_same_image(backend, scene, size):
    # D3: where extents hold all visible alpha, tiling is only an optimisation
    seen, error_bounds = with_error_bounds(backend, scene)
    view = backend.render(seen)
    assert_seen(view)
    _same_render("whole.tiles", backend, backend.render(seen.with_overrides(tile_size=size)), view, error_bounds)


@law("whole", RENDER, INRIAS)
def test_square_extents_are_culled_by_tiles_of_the_size_that_is_asked_for(backend):
    # its extent begins at 52.5 px, beyond a picture of three tiles of 16 px, and in the second tile of 32; where warps
    # draw, smaller tiles are refused
    camera = Camera(np.eye(4), np.array([[16.0, 0.0, 20.0], [0.0, 16.0, 6.0], [0.0, 0.0, 1.0]]), 40, 12)
    columns = [[[9.0, 0.0, 4.0]], [[1.0, 0.0, 0.0, 0.0]], [[0.0625] * 3], [0.75], np.zeros((1, 1, 3))]
    for size in (16, 32):
        scene = backend.sees(Scene(Gaussians(*map(np.array, columns)), camera, (0.25, 0.5, 0.75), INRIA, size))
        radii = backend.render(scene).radii
        if radii is not None:
            assert np.all(radii > 0) == (scene.side == 32), f"with tiles of {scene.side} px it has extents {radii}"


@law("whole", RENDER, EXTENTS)
def test_tiles_of_a_number_beyond_16_bits_are_drawn(backend):
    # 264 x 260 tiles of a pixel: splats about the middle, beyond tile 2^15, and in the last corner, beyond 2^16 and in
    # a row that no byte counts
    camera = Camera(np.eye(4), np.array([[256.0, 0.0, 132.0], [0.0, 256.0, 128.0], [0.0, 0.0, 1.0]]), 264, 260)
    at = ((8.0, 8.0), (132.0, 124.0), (250.0, 130.0), (260.0, 257.0))
    splats = pack([Record(x=x, y=y, depth=2.0, size=(2.0, 2.0, 2.0), opacity=0.75) for x, y in at], camera)
    scene = backend.sees(Scene(splats, camera, (0.25, 0.5, 0.75), tile_size=1))
    view = backend.plainly(scene)
    for x, y in at:
        # nearly all of the opacity, next to the centre
        light, color = view.T_final[int(y), int(x)], view.image[int(y), int(x)]
        shown = light < 0.375 and np.max(np.abs(color - scene.background)) > 0.0625
        assert shown, f"the splat at {x}, {y} of 264 x 260 tiles is not drawn"
    whole = backend.plainly(scene.with_overrides(tile_size=16))
    for name in ("image", "T_final"):
        assert_close("whole.tiles", getattr(view, name), getattr(whole, name), 16.0, backend.dtype)


@law("whole", RENDER, PRINCIPAL_POINT)
def test_a_picture_of_thousands_of_columns_or_rows_is_drawn_to_its_end(backend):
    # beyond what twelve bits number, and what textures hold
    for size in ((4100, 3), (3, 4100)):
        K = np.array([[4096.0, 0.0, size[0] / 2.0], [0.0, 4096.0, size[1] / 2.0], [0.0, 0.0, 1.0]])
        camera = Camera(np.eye(4), K, *size)
        at = [(end, 1.5) if size[0] > 3 else (1.5, end) for end in (8.0, 1030.0, 2052.0, 4098.0)]
        splats = pack([Record(x=x, y=y, depth=2.0, size=(2.0, 2.0, 2.0), opacity=0.75) for x, y in at], camera)
        view = backend.plainly(backend.sees(Scene(splats, camera, (0.25, 0.5, 0.75))))
        for x, y in at:
            shown = view.T_final[int(y), int(x)] < 0.375 and view.image[int(y), int(x), 0] > 0.5
            assert shown, f"the splat at {x}, {y} of a picture of {size[0]} x {size[1]} px is not drawn"


GREY, RED, BLUE = ((0.0, 0.0, 0.0),), ((2.0, -1.0, -1.0),), ((-1.0, -1.0, 2.0),)


@law("whole", RENDER, EXTENTS)
def test_tiles_whose_light_ends_one_after_the_other_show_what_ended_it(backend):
    # four tiles of 8 px in a row, each behind 32 more faint splats than the one before it; lists get shorter, so that
    # whatever is done for several tiles at a time goes on without the first, then without the second
    camera = Camera(np.eye(4), np.array([[16.0, 0.0, 16.0], [0.0, 16.0, 4.0], [0.0, 0.0, 1.0]]), 32, 8)
    records, size = [], (3.5, 3.5, 3.5)
    for tile in range(4):
        x, kinds = 8.0 * tile + 4.0, ((32 * tile, 0.0078125, GREY), (24, 0.984375, BLUE), (96 - 32 * tile, 0.5, RED))
        for depth, (count, opacity, sh) in enumerate(kinds, 1):
            depths = (depth + np.arange(count) / 256.0).tolist()
            records += [Record(x=x, y=4.0, depth=d, size=size, opacity=opacity, sh=sh) for d in depths]
    scene = backend.sees(Scene(pack(records, camera), camera, (1.0, 1.0, 1.0), tile_size=8))
    view = backend.plainly(scene)
    whole = backend.plainly(scene.with_overrides(tile_size=16))
    assert np.max(np.abs(view.image - whole.image)) < 0.03125, "tiles of 8 px show another picture than one of 16"
    for tile in range(4):
        at = np.s_[2:6, 8 * tile + 2 : 8 * tile + 6]
        light, color = view.T_final[at], view.image[at]
        shown = np.max(light) < 0.0078125 and np.min(color[..., 2]) > 1.5 * np.max(color[..., 0])
        assert shown, f"tile {tile} does not show the splats that take its light"


@law("whole", RENDER, scene=plain, seed=st.randoms(use_true_random=False))
def test_permuting_gaussians_permutes_ids_only(backend, scene, seed):
    # depths are made distinct: memory order decides ties (D4)
    depths = scene.gaussians.means @ scene.camera.viewmat[2, :3] + scene.camera.viewmat[2, 3]
    _, first = np.unique(np.round(depths, 4), return_index=True)
    seen, error_bounds = with_error_bounds(backend, scene.rows(np.sort(first)))
    order = list(range(len(seen.gaussians)))
    seed.shuffle(order)
    one, other = backend.render(seen), backend.render(seen.rows(order))
    assert_same_image("whole.permutation", backend, other.image, one.image, error_bounds)
    if one.dominant_ids is not None:
        sure = error_bounds.decided & (other.dominant_ids >= 0)
        assert_same_bits("winner", np.array(order)[other.dominant_ids[sure]], one.dominant_ids[sure])


invisible = st.sampled_from(
    [
        Record(depth=-2.0, size=(8.0, 8.0, 8.0), opacity=1.0),
        Record(depth=0.001953125, size=(8.0, 8.0, 8.0), opacity=1.0),
        Record(x=-400.0, size=(4.0, 4.0, 4.0), opacity=1.0),
        Record(y=400.0, size=(4.0, 4.0, 4.0), opacity=1.0),
        Record(size=(64.0, 64.0, 64.0), opacity=0.0),
        Record(size=(64.0, 64.0, 64.0), opacity=0.001086),
        Record(size=(64.0, 64.0, 64.0), opacity=1.0 / 256.0),
    ]
)


def _joined(scene, hidden, at):
    """Return the scene with one more Gaussian at an index."""
    g, more = scene.gaussians, pack([hidden], scene.camera)
    sh = np.zeros((1, g.sh.shape[1], 3))
    sh[:, :1] = more.sh
    at = min(at, len(g))
    columns = ((g.means, more.means), (g.quats, more.quats), (g.scales, more.scales), (g.opacities, more.opacities))
    inserted = [np.insert(a, at, b, axis=0) for a, b in (*columns, (g.sh, sh))]
    return dataclasses.replace(scene, gaussians=Gaussians(*inserted))


@law("whole", RENDER, scene=scenes(max_gaussians=4), hidden=invisible, at=st.integers(0, 4))
def test_an_invisible_gaussian_changes_nothing(backend, scene, hidden, at):
    seen, error_bounds = with_error_bounds(backend, scene)
    more = backend.render(backend.sees(_joined(scene, hidden, at)))
    _same_image_and_transmittance("whole.invisible", backend, more, backend.render(seen), error_bounds)


@law("whole", RENDER, DETERMINISTIC, ROWWISE, scene=scenes(max_gaussians=4), hidden=invisible, at=st.integers(0, 4))
def test_an_invisible_gaussian_changes_no_bit(backend, scene, hidden, at):
    one = backend.render(backend.sees(scene))
    other = backend.render(backend.sees(_joined(scene, hidden, at)))
    assert_same_bits("image", other.image, one.image)
    assert_same_bits("remaining transmittance", other.T_final, one.T_final)


@law(
    "whole",
    RENDER,
    DETERMINISTIC,
    HOMOGENEOUS,
    first=corners(with_={"power": 2}),
    scene=plain,
    power=st.integers(-3, 3),
)
def test_scaling_the_world_by_a_power_of_two_changes_no_bit(backend, scene, power):
    scale = 2.0**power
    seen = backend.sees(scene)
    viewmat = seen.camera.viewmat.copy()
    viewmat[:3, 3] *= scale
    g = seen.gaussians
    bigger = seen.with_overrides(means=g.means * scale, scales=g.scales * scale, viewmat=viewmat)
    depths = g.means @ seen.camera.viewmat[2, :3] + seen.camera.viewmat[2, 3]
    # the near plane is in world units, so only what is well before or behind it is scaled
    clear = (depths < 0.0) | (depths > 10.0 * seen.profile.near_plane)
    one, other = backend.render(seen.rows(clear)), backend.render(bigger.rows(clear))
    assert_seen(one)
    assert_same_bits("image", other.image, one.image)
    assert_same_bits("remaining transmittance", other.T_final, one.T_final)


@law(
    "whole",
    RENDER,
    first=corners(with_={"turn": (2.0, -1.0, 0.5, 1.0), "shift": (1.0, -2.0, 3.0)}),
    scene=plain,
    turn=quats(),
    shift=st.tuples(*[st.integers(-4, 4).map(float)] * 3),
)
def test_moving_world_and_camera_together_changes_nothing(backend, scene, turn, shift):
    # degree 0: colours of higher bands are fixed to the world's axes
    motion = rigid(turn, shift)
    R, t = motion[:3, :3], motion[:3, 3]
    g = scene.gaussians
    w, x, y, z = np.array(turn) / np.linalg.norm(turn)
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    moved = scene.with_overrides(
        means=g.means @ R.T + t, quats=g.quats @ left.T, viewmat=scene.camera.viewmat @ np.linalg.inv(motion)
    )
    seen, error_bounds = with_error_bounds(backend, scene)
    seen_moved, moved_bounds = with_error_bounds(backend, moved)
    error_bounds.image += moved_bounds.image
    error_bounds.T_final += moved_bounds.T_final
    for label, close in moved_bounds.near_threshold.items():
        error_bounds.near_threshold[label] |= close
    view = backend.render(seen)
    assert_seen(view)
    _same_render("whole.rigid", backend, backend.render(seen_moved), view, error_bounds)


@law(
    "whole",
    RENDER,
    EXTENTS,
    PRINCIPAL_POINT,
    scene=scenes(anchored=True, size=plain_sizes(), max_side=8),
    left=st.integers(0, 3),
    top=st.integers(0, 3),
)
def test_cropping_commutes_with_rendering(backend, scene, left, top):
    W, H = scene.camera.width, scene.camera.height
    left, top = min(left, W - 1), min(top, H - 1)
    K = scene.camera.K.copy()
    K[0, 2], K[1, 2] = K[0, 2] - left, K[1, 2] - top
    # the frustum clamp is measured in image widths (B1), so what it touches is left out
    p = scene.gaussians.means @ scene.camera.viewmat[:3, :3].T + scene.camera.viewmat[:3, 3]
    u, v = (scene.camera.K[a, a] * p[:, a] / p[:, 2] + scene.camera.K[a, 2] for a in (0, 1))
    inside = (p[:, 2] > 0.0) & (u > left) & (u < W) & (v > top) & (v < H)
    seen, error_bounds = with_error_bounds(backend, scene.rows(inside))
    crop = backend.sees(seen.with_overrides(K=K, width=W - left, height=H - top))
    whole, part = backend.render(seen), backend.render(crop)
    window = (slice(top, None), slice(left, None))
    sure = error_bounds.unambiguous[window]
    size = (error_bounds.image + error_bounds.absolute + error_bounds.T_final[..., None])[window]
    assert_close("whole.crop", part.image[sure], whole.image[window][sure], size[sure], backend.dtype)


@law(
    "whole", RENDER, EXTENTS, first=corners(turned=False), scene=scenes(anchored=True, size=plain_sizes(), turned=False)
)
def test_a_mirrored_world_makes_a_mirrored_image(backend, scene):
    # x -> -x: the principal point mirrors about the image's middle, a rotation keeps w and x and flips y and z
    mirror = np.array([-1.0, 1.0, 1.0])
    g, c = scene.gaussians, scene.camera
    K, viewmat = c.K.copy(), c.viewmat.copy()
    K[0, 2] = c.width - K[0, 2]
    viewmat[0, 3] = -viewmat[0, 3]
    viewmat[:3, :3] = np.eye(3)
    upright = scene.with_overrides(
        viewmat=np.vstack([np.hstack([np.eye(3), c.viewmat[:3, 3:]]), [[0.0, 0.0, 0.0, 1.0]]])
    )
    mirrored = upright.with_overrides(
        means=g.means * mirror, quats=g.quats * np.array([1.0, 1.0, -1.0, -1.0]), K=K, viewmat=viewmat
    )
    seen, error_bounds = with_error_bounds(backend, upright)
    view, flipped = backend.render(seen), backend.render(backend.sees(mirrored))
    assert_same_image("whole.mirror", backend, flipped.image[:, ::-1], view.image, error_bounds)
    assert_same_transmittance("whole.mirror", backend, flipped.T_final[:, ::-1], view.T_final, error_bounds)


denormals = st.sampled_from([5e-324, 1e-310, 1e-45, 1e-40, 1e-30])


@law("whole", RENDER, small=denormals, record=records(5, 5))
def test_denormal_sizes_and_opacities_give_finite_images(backend, small, record):
    camera = Camera(np.eye(4), np.array([[8.0, 0, 2.5], [0, 8.0, 2.5], [0, 0, 1]]), 5, 5)
    g = pack([record, Record(2.5, 2.5)], camera)
    tiny_opacity, tiny_scales = g.opacities.copy(), g.scales.copy()
    tiny_opacity[1], tiny_scales[0] = small, small
    view = backend.render(backend.sees(Scene(g, camera).with_overrides(opacities=tiny_opacity, scales=tiny_scales)))
    assert np.all(np.isfinite(view.image))
    assert np.all(np.isfinite(view.T_final))


@law("whole", RENDER, first=corners(), scene=scenes(max_gaussians=3))
def test_a_huge_world_far_away_is_finite(backend, scene):
    scale = 2.0**40
    g = scene.gaussians
    viewmat = scene.camera.viewmat.copy()
    viewmat[:3, 3] *= scale
    view = backend.render(
        backend.sees(scene.with_overrides(means=g.means * scale, scales=g.scales * scale, viewmat=viewmat))
    )
    assert np.all(np.isfinite(view.image))
