"""Laws of blending: what an image owes to weights, transmittance and background (D5, D6, D7)."""

from __future__ import annotations

import dataclasses

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from pop_ref.conformance.assertions import (
    assert_close,
    assert_same_bits,
    assert_same_image,
    assert_same_transmittance,
    assert_seen,
    with_error_bounds,
)
from pop_ref.conformance.capabilities import PRINCIPAL_POINT, RENDER
from pop_ref.conformance.law import law
from pop_ref.conformance.scenes import SH_C0, Record, Scene, pack
from pop_ref.conformance.strategies import (
    arrays_of,
    cameras,
    corners,
    dyadic,
    faint_opacities,
    opacities,
    plain_sizes,
    scenes,
)
from pop_ref.constants import PROFILES as ALL_PROFILES
from pop_ref.records import Camera

plain = scenes(anchored=True, size=plain_sizes())
COLOURS = {name: np.arange(21.0).reshape(7, 3)[::step] / 16.0 for name, step in (("one", 1), ("other", -1))}
faint = scenes(anchored=True, opacity=faint_opacities(), size=plain_sizes())


def colored(scene, colors):
    """Return the scene with plain colours [N, 3], >= 0, from every direction."""
    return scene.with_overrides(sh=((np.asarray(colors) - 0.5) / SH_C0)[:, None, :])


def camera_depths(scene):
    V = scene.camera.viewmat
    return scene.gaussians.means @ V[2, :3] + V[2, 3]


@law("compositing", RENDER, first=corners(), scene=plain)
def test_weights_and_remaining_light_sum_to_one(backend, scene):
    white = colored(scene, np.ones((len(scene.gaussians), 3))).with_overrides(background=np.zeros(3))
    seen, error_bounds = with_error_bounds(backend, white)
    view = backend.render(seen)
    assert_seen(view)
    total = view.image + view.T_final[..., None]
    magnitude = error_bounds.image + error_bounds.T_final[..., None] + 1.0
    # whatever was decided, the identity holds at every pixel
    assert_close("compositing.sum", total, np.ones_like(total), magnitude, backend.dtype)


@law("compositing", RENDER, first=corners(), scene=scenes())
def test_remaining_light_lies_between_the_stop_and_one(backend, scene):
    seen = backend.sees(scene)
    view = backend.render(seen)
    assert np.all(view.T_final <= 1.0)
    assert np.all(view.T_final >= seen.profile.transmittance_stop * (1.0 - 1e-3))


@law("compositing", RENDER, first=corners(), scene=plain)
def test_light_never_rises_when_a_splat_is_added_behind(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    rearmost = int(np.lexsort((np.arange(len(scene.gaussians)), camera_depths(seen)))[-1])
    without = backend.render(seen.rows(np.arange(len(scene.gaussians)) != rearmost)).T_final
    allowed = 64.0 * np.finfo(backend.dtype).eps * (error_bounds.T_final + 1.0)
    assert np.all((backend.render(seen).T_final <= without + allowed)[error_bounds.unambiguous])


@law("compositing", RENDER, scene=faint, cut=st.integers(1, 5))
def test_a_list_composites_as_its_front_over_its_back(backend, scene, cut):
    seen, error_bounds = with_error_bounds(backend, scene)
    order = np.lexsort((np.arange(len(seen.gaussians)), camera_depths(seen)))
    front, back = np.sort(order[:cut]), np.sort(order[cut:])
    over = backend.render(seen.rows(front).with_overrides(background=np.zeros(3)))
    under = backend.render(seen.rows(back))
    expected = over.image + over.T_final[..., None] * under.image
    whole = backend.render(seen)
    assert_seen(whole)
    assert_same_image("compositing.split", backend, whole.image, expected, error_bounds)
    assert_same_transmittance("compositing.split", backend, whole.T_final, over.T_final * under.T_final, error_bounds)


@law(
    "compositing",
    RENDER,
    first=corners(with_=COLOURS),
    scene=plain,
    one=arrays_of((7, 3), 0.0, 2.0),
    other=arrays_of((7, 3), 0.0, 2.0),
)
def test_the_image_is_linear_in_the_colours(backend, scene, one, other):
    n = len(scene.gaussians)
    dark = scene.with_overrides(background=np.zeros(3))
    both, error_bounds = with_error_bounds(backend, colored(dark, one[:n] + other[:n]))
    parts = [backend.render(backend.sees(colored(dark, c[:n]))).image for c in (one, other)]
    error_bounds.absolute += 1.0  # a colour is written as an SH coefficient, offset by one half
    assert_same_image("compositing.linear", backend, backend.render(both).image, parts[0] + parts[1], error_bounds)


@law(
    "compositing",
    RENDER,
    first=corners(with_={"background": np.array([0.5, 2.0, 1.0])}),
    scene=plain,
    background=arrays_of((3,), 0.0, 2.0),
)
def test_the_background_enters_with_the_remaining_light(backend, scene, background):
    seen, error_bounds = with_error_bounds(backend, scene.with_overrides(background=background))
    over_black = backend.render(seen.with_overrides(background=np.zeros(3)))
    over = backend.render(seen)
    expected = over_black.image + over_black.T_final[..., None] * background
    assert_same_bits("remaining transmittance", over.T_final, over_black.T_final)
    assert_same_image("compositing.background", backend, over.image, expected, error_bounds)


@law("compositing", RENDER, s=st.sampled_from([0.5, 0.25, 0.75, 0.125, 0.9375]), color=arrays_of((3,), 0.0, 1.0))
def test_two_coincident_copies_at_one_minus_the_root_look_like_one(backend, s, color):
    # at the centre alpha is the opacity: (1 - o)^2 = 1 - O with O = 1 - s^2, o = 1 - s
    camera = Camera(np.eye(4), np.array([[8.0, 0, 2.5], [0, 8.0, 2.5], [0, 0, 1]]), 5, 5)
    record = Record(2.5, 2.5, 1.0, (2.0, 2.0, 2.0))

    def at(opacity, copies):
        records = [dataclasses.replace(record, opacity=opacity)] * copies
        scene = Scene(pack(records, camera), camera, np.array([0.25, 0.5, 1.0]))
        view = backend.render(backend.sees(colored(scene, np.repeat(color[None], copies, 0))))
        return np.append(view.image[2, 2], view.T_final[2, 2])

    assert_close("compositing.copies", at(1.0 - s, 2), at(1.0 - s * s, 1), 2.0, backend.dtype)


@law(
    "compositing",
    RENDER,
    PRINCIPAL_POINT,
    opacity=opacities(),
    depth=st.sampled_from([1.0, 2.0, 4.0]),
    size=st.sampled_from([1.0, 0.5, 2.0, 0.0]),
    x=dyadic(0.0, 8.0),
    y=dyadic(0.0, 6.0),
)
def test_a_round_splat_on_the_axis_looks_as_the_formula_says(backend, opacity, depth, size, x, y):
    # seen straight on, a sphere of s px has covariance s^2 + 0.3 in every direction
    camera = Camera(np.eye(4), np.array([[8.0, 0, x], [0, 8.0, y], [0, 0, 1]]), 8, 6)
    scene = Scene(pack([Record(x, y, depth, (size,) * 3, opacity=opacity)], camera), camera, np.zeros(3))
    seen, error_bounds = with_error_bounds(backend, colored(scene, [[1.0, 0.5, 0.25]]))
    profile = seen.profile
    px, py = np.meshgrid(np.arange(8) + 0.5, np.arange(6) + 0.5)
    o = float(seen.gaussians.opacities[0])
    raw = o * np.exp(-0.5 * ((px - x) ** 2 + (py - y) ** 2) / (size**2 + profile.eps2d))
    alpha = np.where(raw < profile.alpha_floor, 0.0, np.minimum(raw, profile.alpha_ceiling))
    view = backend.render(seen)
    assert_same_transmittance("compositing.formula", backend, view.T_final, 1.0 - alpha, error_bounds)
    expected = alpha[..., None] * np.array([1.0, 0.5, 0.25])
    assert_same_image("compositing.formula", backend, view.image, expected, error_bounds)


@law(
    "compositing",
    RENDER,
    # the fourth would pass the stop, the fifth alone would not
    first=[{"alphas": [0.9, 0.9, 0.9, 0.99, 0.5], "name": name} for name in sorted(ALL_PROFILES)],
    alphas=st.lists(opacities(), min_size=1, max_size=6),
    name=st.sampled_from(sorted(ALL_PROFILES)),
)
def test_a_pixel_ends_before_the_splat_that_would_pass_the_stop(backend, alphas, name):
    # D5, D6, D7 on a stack whose alphas at the middle pixel are its opacities
    camera = Camera(np.eye(4), np.array([[8.0, 0, 1.5], [0, 8.0, 1.5], [0, 0, 1]]), 3, 3)
    records = [Record(1.5, 1.5, 2.0 + k, (2.0,) * 3, opacity=a) for k, a in enumerate(alphas)]
    scene = backend.sees(Scene(pack(records, camera), camera, np.zeros(3), ALL_PROFILES[name]))
    profile = scene.profile
    T, blended, traversed, stopped = 1.0, 0, 0, False
    for opacity in scene.gaussians.opacities.tolist():
        # each decision must be clear of rounding: thresholds have tests of their own
        assume(opacity == 0.0 or abs(opacity / profile.alpha_floor - 1.0) > 1e-5)
        listed = profile.extent == "square" or opacity > profile.alpha_floor
        alpha = min(opacity, profile.alpha_ceiling)
        next_T = T * (1.0 - alpha)
        assume(abs(next_T / profile.transmittance_stop - 1.0) > 1e-3)
        traversed += listed
        if alpha < profile.alpha_floor:
            continue
        stopped = next_T <= profile.transmittance_stop
        if stopped:
            break
        T, blended = next_T, blended + 1
    view = backend.render(scene)
    assert_close("compositing.stop", view.T_final[1, 1], T, len(alphas) * (1.0 + T), backend.dtype)
    if view.n_blended is not None:
        assert_same_bits("blended", view.n_blended[1, 1], blended)
    if view.n_traversed is not None:
        assert view.n_traversed[1, 1] <= len(alphas)
        # what ends a pixel has been visited, and is not blended
        assert view.n_traversed[1, 1] >= blended + stopped
        if backend.name == "oracle":
            assert_same_bits("traversed", view.n_traversed[1, 1], traversed)


@law("compositing", "stops", name=st.sampled_from(sorted(ALL_PROFILES)))
def test_the_stop_itself_ends_a_pixel_where_the_profile_includes_it(backend, name):
    # D7
    profile = ALL_PROFILES[name]
    stops, at = backend.stage("stops"), profile.transmittance_stop
    assert stops(at, profile) == profile.stop_inclusive
    assert stops(0.5 * at, profile)
    assert not stops(2.0 * at, profile)


@law("compositing", RENDER, camera=cameras(turned=False, centred=True), near=opacities(), far=opacities())
def test_the_nearer_splat_hides_the_farther_whatever_their_order_in_memory(backend, camera, near, far):
    x, y = camera.width // 2 + 0.5, camera.height // 2 + 0.5
    pair = [Record(x, y, 2.0, (2.0,) * 3, opacity=near), Record(x, y, 4.0, (2.0,) * 3, opacity=far)]
    colors = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    scene = colored(Scene(pack(pair, camera), camera), colors)
    one = backend.render(backend.sees(scene))
    other = backend.render(backend.sees(scene.rows([1, 0])))
    assert_close("compositing.order", one.image, other.image, 1.0, backend.dtype)
    assert np.all(one.image[..., 1] <= 1.0 - one.image[..., 0] + 1e-6)
