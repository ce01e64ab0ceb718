"""Laws of gradients: what every backward pass owes to its forward pass."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume
from hypothesis import strategies as st

from pop_ref.conformance.assertions import (
    assert_close,
    assert_same_bits,
    assert_same_image,
    assert_same_transmittance,
    assert_seen,
    require,
    with_error_bounds,
)
from pop_ref.conformance.capabilities import (
    ANTIALIASING,
    DERIVATIVES,
    DETERMINISTIC,
    DOUBLE,
    GRADIENTS,
    INSTRUMENTS,
    RENDER,
)
from pop_ref.conformance.error_bounds import pixel_error_bounds, screen_error_bounds
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.law import law
from pop_ref.conformance.laws.test_compositing import colored
from pop_ref.conformance.scenes import SH_C0, cotangents
from pop_ref.conformance.strategies import arrays_of, corners, plain_sizes, scenes, wide_scene

plain = scenes(anchored=True, size=plain_sizes(), max_gaussians=4)
banded = scenes(anchored=True, size=plain_sizes(), max_gaussians=3, max_degree=3)
SIGNAL = ("means", "scales", "opacities", "sh")
PARAMETERS = ("means", "quats", "scales", "opacities", "sh")


def _pulled(backend, seen):
    """Return gradients for the standard cotangents, after making sure that there is something to pull."""
    v_image, v_T_final = cotangents(seen)
    g = backend.gradients(seen, v_image, v_T_final)
    _assert_signal(g)
    return g, v_image, v_T_final


def _pulled_where_unambiguous(backend, seen, error_bounds):
    """Return gradients for cotangents of those pixels alone at which no decision is near its threshold.

    A gradient and a render may come from different code of the backend; where rounding decides, each decides by itself.
    """
    v_image, v_T_final = _at_unambiguous_pixels(seen, error_bounds)
    g = backend.gradients(seen, v_image, v_T_final)
    if np.all(error_bounds.unambiguous):
        _assert_signal(g)
    else:
        assume(all(np.any(g[name] != 0.0) for name in SIGNAL))
    return g, v_image, v_T_final


def _at_unambiguous_pixels(seen, error_bounds):
    v_image, v_T_final = cotangents(seen)
    return v_image * error_bounds.unambiguous[..., None], v_T_final * error_bounds.unambiguous


def _assert_signal(g):
    for name in SIGNAL:
        assert np.any(g[name] != 0.0), f"the gradient of {name} is zero everywhere; the law would say nothing"


@law("gradients", GRADIENTS, first=corners(1), scene=scenes(max_degree=1))
def test_zero_cotangents_give_exact_zeros(backend, scene):
    seen = backend.sees(scene)
    H, W = seen.camera.height, seen.camera.width
    for name, value in backend.gradients(seen, np.zeros((H, W, 3)), np.zeros((H, W))).items():
        assert_same_bits(f"v_{name}", value, np.zeros_like(value))


@law("gradients", GRADIENTS, DETERMINISTIC, first=corners(3), scene=banded)
def test_twice_the_cotangent_is_exactly_twice_the_gradient(backend, scene):
    seen = backend.sees(scene)
    one, v_image, v_T_final = _pulled(backend, seen)
    for name, value in backend.gradients(seen, 2.0 * v_image, 2.0 * v_T_final).items():
        assert_same_bits(f"v_{name}", value, 2.0 * one[name])


@law("gradients", GRADIENTS, first=corners(), scene=plain)
def test_gradients_add_over_pixels(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    whole, v_image, v_T_final = _pulled(backend, seen)
    bounds = gradient_error_bounds(seen, error_bounds, v_image, v_T_final)
    left = (np.arange(seen.camera.width) % 2 == 0)[None, :] & np.ones((seen.camera.height, 1), dtype=bool)
    parts = [backend.gradients(seen, v_image * m[..., None], v_T_final * m) for m in (left, ~left)]
    for name, value in whole.items():
        assert_close(f"gradients.sum.{name}", parts[0][name] + parts[1][name], value, bounds[name], backend.dtype)


@law("gradients", GRADIENTS, first=corners(), scene=plain)
def test_the_quaternion_gradient_of_an_image_is_orthogonal_to_the_quaternion(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    g, v_image, v_T_final = _pulled(backend, seen)
    q = seen.gaussians.quats
    bounds = gradient_error_bounds(seen, error_bounds, v_image, v_T_final)["quats"]
    radial = np.sum(q * g["quats"], axis=1)
    assert_close("gradients.radial", radial, 0.0 * radial, np.sum(np.abs(q) * bounds, axis=1), backend.dtype)


@law("gradients", RENDER, GRADIENTS, first=corners(), scene=scenes(max_gaussians=5, anchored=True))
def test_culled_gaussians_get_exactly_zero(backend, scene):
    seen = backend.sees(scene)
    view = backend.render(seen)
    if view.radii is None:
        pytest.skip(f"{backend.name} shows no radii, so nobody knows which Gaussians it culls")
    culled = ~np.all(view.radii > 0, axis=1)
    g, _, _ = _pulled(backend, seen)
    for name in (*PARAMETERS, "means2d", "means2d_abs"):
        if name in g:
            assert_same_bits(f"v_{name} of culled rows", g[name][culled], np.zeros_like(g[name][culled]))


@law("gradients", GRADIENTS, ANTIALIASING)
def test_antialiasing_takes_a_splat_without_area_away_with_all_its_gradients(backend):
    # its factor is 0, where the derivative of the root is infinite; a line on the axis shows its end alone
    for scene in [each["scene"] for each in corners(1) if len(each["scene"].gaussians) > 1]:
        g, camera = scene.gaussians, scene.camera
        R, t = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
        means, quats, scales = g.means.copy(), g.quats.copy(), g.scales.copy()
        means[0], quats[0] = R.T @ (np.array([0.0, 0.0, 4.0]) - t), (1.0, 0.0, 0.0, 0.0)
        scales[0] = (0.0, 0.0, 0.5) if np.array_equal(R, np.eye(3)) else 0.0
        seen = backend.sees(scene.with_overrides(means=means, quats=quats, scales=scales, antialiased=True))
        others = seen.rows(np.arange(1, len(g)))
        found, without = (backend.gradients(each, *cotangents(seen)) for each in (seen, others))
        for name in PARAMETERS:
            assert np.all(np.isfinite(found[name])), f"the gradient of {name} is not finite"
            assert_same_bits(f"v_{name} of the splat without area", found[name][0], np.zeros_like(found[name][0]))
            size = np.abs(without[name]) + 1.0
            assert_close("gradients.instruments", found[name][1:], without[name], size, backend.dtype)


@law("gradients", GRADIENTS, first=corners(), scene=plain)
def test_moving_world_and_camera_together_has_no_gradient(backend, scene):
    # degree 0: shifts by d and turns by w of the world, undone by the camera
    seen, error_bounds = with_error_bounds(backend, scene)
    g, v_image, v_T_final = _pulled(backend, seen)
    require(backend, g, "viewmat")
    bounds = gradient_error_bounds(seen, error_bounds, v_image, v_T_final)
    R = seen.camera.viewmat[:3, :3]
    shift = np.sum(g["means"], axis=0) - R.T @ g["viewmat"][:3, 3]
    size = np.sum(bounds["means"], axis=0) + np.abs(R.T) @ bounds["viewmat"][:3, 3]
    assert_close("gradients.rigid", shift, np.zeros(3), size, backend.dtype)
    for axis in np.eye(3):
        wx = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        turn, size = np.sum(g["means"] * (seen.gaussians.means @ wx.T)), 0.0
        q = seen.gaussians.quats
        x, y, z = axis
        spin = 0.5 * np.array([[0, -x, -y, -z], [x, 0, -z, y], [y, z, 0, -x], [z, -y, x, 0]])
        turn += np.sum(g["quats"] * (q @ spin.T)) - np.sum(g["viewmat"][:3, :3] * (R @ wx))
        size = np.sum(bounds["means"] * np.abs(seen.gaussians.means) @ np.abs(wx).T)
        size += np.sum(bounds["quats"] * np.abs(q @ spin.T)) + np.sum(bounds["viewmat"][:3, :3] * np.abs(R @ wx))
        assert_close("gradients.rigid", turn, 0.0, size, backend.dtype)


@law("gradients", RENDER, GRADIENTS, first=corners(), scene=plain)
def test_the_background_gradient_is_the_cotangent_seen_through_the_remaining_light(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    g, v_image, _ = _pulled_where_unambiguous(backend, seen, error_bounds)
    require(backend, g, "background")
    T_final = backend.render(seen).T_final
    expected = np.einsum("hw,hwc->c", T_final, v_image)
    size = np.einsum("hw,hwc->c", T_final, np.abs(v_image)) + 1.0
    assert_close("gradients.background", g["background"], expected, size, backend.dtype)


@law("gradients", RENDER, GRADIENTS, first=corners(), scene=plain)
def test_the_colour_gradient_is_what_the_colour_adds_to_the_image(backend, scene):
    # the image is linear in colours, so a finite change of a colour measures its gradient exactly
    n = len(scene.gaussians)
    bright = colored(scene, np.full((n, 3), 1.0))
    seen, error_bounds = with_error_bounds(backend, bright)
    g, v_image, v_T_final = _pulled_where_unambiguous(backend, seen, error_bounds)
    bounds = gradient_error_bounds(seen, error_bounds, v_image, v_T_final)["sh"]
    before = backend.render(seen).image
    for i in range(n):
        brighter = np.full((n, 3), 1.0)
        brighter[i] += 1.0
        more = backend.sees(colored(scene, brighter))
        moved = backend.render(more).image - before
        gained = np.sum(v_image * moved, axis=(0, 1)) * SH_C0
        size = bounds[i, 0] + np.sum(np.abs(v_image) * (error_bounds.image + 2.0 * error_bounds.absolute), axis=(0, 1))
        assert_close("gradients.color", gained, g["sh"][i, 0], size, backend.dtype)


@law("gradients", GRADIENTS, first=corners(), scene=plain)
def test_absolute_screen_gradients_are_at_least_the_signed_ones(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    g, v_image, v_T_final = _pulled(backend, seen)
    require(backend, g, "means2d_abs")
    slack = (
        64.0 * np.finfo(backend.dtype).eps * gradient_error_bounds(seen, error_bounds, v_image, v_T_final)["means2d"]
    )
    assert np.all(g["means2d_abs"] + slack >= np.abs(g["means2d"]))
    assert np.any(g["means2d_abs"] > 0.0)


@law(
    "gradients", GRADIENTS, first=corners(with_={"x": 3, "y": 4}), scene=plain, x=st.integers(0, 7), y=st.integers(0, 7)
)
def test_absolute_and_signed_screen_gradients_agree_in_size_for_one_pixel(backend, scene, x, y):
    seen, error_bounds = with_error_bounds(backend, scene)
    v_image = np.zeros((seen.camera.height, seen.camera.width, 3))
    v_image[y % seen.camera.height, x % seen.camera.width] = [1.0, -0.5, 0.25]
    v_T_final = np.zeros(v_image.shape[:2])
    g = backend.gradients(seen, v_image, v_T_final)
    require(backend, g, "means2d_abs")
    bounds = gradient_error_bounds(seen, error_bounds, v_image, v_T_final)["means2d"]
    assert_close("gradients.absgrad", g["means2d_abs"], np.abs(g["means2d"]), bounds, backend.dtype)


@law(
    "gradients",
    RENDER,
    GRADIENTS,
    DOUBLE,
    DERIVATIVES,
    first=corners(3, with_={"direction": 7}),
    scene=banded,
    direction=st.integers(0, 2**16),
)
def test_a_step_along_any_direction_changes_the_image_as_the_gradient_says(backend, scene, direction):
    # <v, J u> = <J^T v, u>, with J u by central differences; in double precision only
    seen = backend.sees(scene)
    error_bounds = pixel_error_bounds(seen, np.float32)
    g, v_image, v_T_final = _pulled(backend, seen)
    sure = error_bounds.smooth
    v_image, v_T_final = v_image * sure[..., None], v_T_final * sure
    g = backend.gradients(seen, v_image, v_T_final)
    rng = np.random.default_rng(direction)
    h = 2.0**-20
    values = {name: getattr(seen.gaussians, name) for name in PARAMETERS}
    steps = {name: np.round(rng.uniform(-1.0, 1.0, value.shape) * 8.0) / 8.0 for name, value in values.items()}
    for name, value in values.items():
        # quaternions may turn, scales grow by a share of themselves, opacities stay within [0, 1]
        steps[name] *= {"scales": value, "opacities": np.minimum(value, 1.0 - value)}.get(name, 1.0)
    ends = []
    for sign in (1.0, -1.0):
        moved = seen.with_overrides(**{name: values[name] + sign * h * steps[name] for name in PARAMETERS})
        # a decision that flips within the step is not a derivative's business
        moved_bounds = pixel_error_bounds(moved, np.float64)
        same = all(
            np.array_equal(a.blended, b.blended) for a, b in zip(error_bounds.layers, moved_bounds.layers, strict=True)
        )
        assume(same and [a.id for a in error_bounds.layers] == [b.id for b in moved_bounds.layers])
        view = backend.render(moved)
        ends.append(np.sum(v_image * view.image) + np.sum(v_T_final * view.T_final))
    measured = (ends[0] - ends[1]) / (2.0 * h)
    stated = sum(np.sum(g[name] * steps[name]) for name in PARAMETERS)
    _no_kink_near(seen, h)
    size = sum(np.sum(np.abs(g[name] * steps[name])) for name in PARAMETERS) + np.sum(np.abs(v_image)) * 2.0**-10
    # the difference quotient is wrong by h^2 and by eps / h: 1e-6 of the sizes, which is 2^32 eps
    assert_close("gradients.difference", measured, stated, size * 2.0**32, backend.dtype)


def _no_kink_near(seen, h):
    """Set scenes aside whose colours or frustum clamps lie at a kink (B1, B2)."""
    assume(not np.any(screen_error_bounds(seen, 64.0 * h).kinked))


@law(
    "gradients",
    GRADIENTS,
    DETERMINISTIC,
    first=corners(with_={"opacity": np.array([0.5, 0.75, 0.25, 0.875, 0.5, 0.5, 0.5])}),
    scene=plain,
    opacity=arrays_of((7,), 0.125, 0.875),
)
def test_gradients_ignore_the_coefficients_of_other_bands(backend, scene, opacity):
    g = scene.gaussians
    sh = np.concatenate([g.sh[:, :1], np.ones((len(g), 3, 3))], axis=1)
    padded = backend.sees(scene.with_overrides(sh=sh, opacities=opacity[: len(g)], sh_degree=0))
    plain_scene = backend.sees(scene.with_overrides(sh=sh[:, :1], opacities=opacity[: len(g)], sh_degree=0))
    v_image, v_T_final = cotangents(padded)
    one, other = (backend.gradients(s, v_image, v_T_final) for s in (padded, plain_scene))
    assert_same_bits("v_sh of unused bands", one["sh"][:, 1:], np.zeros_like(one["sh"][:, 1:]))
    assert_same_bits("v_sh", one["sh"][:, :1], other["sh"])
    assert_same_bits("v_means", one["means"], other["means"])


@law(
    "gradients",
    RENDER,
    GRADIENTS,
    INSTRUMENTS,
    first=corners(3),
    scene=st.one_of(banded, st.integers(0, 2**16).map(wide_scene)),
)
def test_asking_for_dominance_and_counts_changes_neither_image_nor_gradient(backend, scene):
    # what is asked for nothing, as in training, may choose tiles of its own and leave out what reaches no pixel
    seen, error_bounds = with_error_bounds(backend, scene)
    v_image, v_T_final = _at_unambiguous_pixels(seen, error_bounds)
    bounds = gradient_error_bounds(seen, error_bounds, v_image, v_T_final)
    (plain_view, plain_gradients), *others = backend.otherwise(seen, v_image, v_T_final).values()
    assert_seen(plain_view)
    asked = "means2d_abs" in plain_gradients or not backend.takes("absgrad")
    assert asked, "absgrad=True is taken, and the screen means have no absolute gradients"
    for view, gradients in others:
        assert_same_image("gradients.instruments.image", backend, view.image, plain_view.image, error_bounds)
        assert_same_transmittance(
            "gradients.instruments.image", backend, view.T_final, plain_view.T_final, error_bounds
        )
        for name, value in gradients.items():
            assert_close("gradients.instruments", value, plain_gradients[name], bounds[name], backend.dtype)
