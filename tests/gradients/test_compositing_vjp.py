"""The transpose of blending against differences, and what must hold of it exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pop_ref import GSPLAT_1_6, INRIA, PAPER, Profile, Splats
from pop_ref.compositing import composite, composite_vjp
from pop_ref.pixel import SplatRows, composite_pixel, composite_pixel_vjp, zero_gradients
from tests.gradients.checks import assert_vjp_matches

RNG = np.random.default_rng(7)
WIDTH, HEIGHT, TILE = 4, 3, 2
LISTS = [[2, 0, 1, 3], [0, 1, 2, 3], [3, 2, 1], [1, 0, 2, 3]]
BACKGROUND = np.array([0.5, 0.25, 1.0, 0.75])


def splats(n_channels: int = 4) -> Splats:
    roots = RNG.normal(size=(4, 2, 2)) * 0.3 + 0.5 * np.eye(2)
    conics = roots @ roots.swapaxes(1, 2)
    return Splats(
        means2d=RNG.uniform(0.0, 1.0, size=(4, 2)) * [WIDTH, HEIGHT],
        depths=np.arange(4.0) + 1.0,
        conics=np.stack([conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]], axis=1),
        opacities=np.array([0.75, 0.9, 0.5, 0.8]),
        colors=RNG.normal(size=(4, n_channels)),
        radii=np.full((4, 2), 9),
    )


@pytest.mark.parametrize("profile", [PAPER, GSPLAT_1_6, INRIA], ids=lambda p: p.name)
@pytest.mark.parametrize("n_channels", [1, 4])
def test_transpose_matches_differences_with_a_background_and_a_cotangent_of_what_is_left(
    profile: Profile, n_channels: int
) -> None:
    scene = splats(n_channels)

    def f(means2d, conics, opacities, colors, background):
        moved = replace(scene, means2d=means2d, conics=conics, opacities=opacities, colors=colors)
        out = composite(moved, LISTS, WIDTH, HEIGHT, TILE, background, profile)
        return out.image, out.T_final

    def vjp(means2d, conics, opacities, colors, background, v_image, v_T_final):
        moved = replace(scene, means2d=means2d, conics=conics, opacities=opacities, colors=colors)
        v = composite_vjp(moved, LISTS, WIDTH, HEIGHT, TILE, v_image, v_T_final, background, profile)
        return v.v_means2d, v.v_conics, v.v_opacities, v.v_colors, v.v_background

    args = [scene.means2d, scene.conics, scene.opacities, scene.colors, BACKGROUND[:n_channels]]
    assert_vjp_matches(f, vjp, args, step=1e-5)


def test_transpose_matches_differences_where_a_ray_terminates_early() -> None:
    scene = replace(splats(1), opacities=np.full(4, 0.998), conics=np.tile([0.01, 0.0, 0.01], (4, 1)))
    out = composite(scene, LISTS, WIDTH, HEIGHT, TILE)
    assert np.all(out.n_blended < 3)
    assert np.all(out.n_traversed > out.n_blended)
    assert np.all(out.T_final > 1.01e-4)

    def f(opacities, colors):
        return composite(replace(scene, opacities=opacities, colors=colors), LISTS, WIDTH, HEIGHT, TILE).image

    def vjp(opacities, colors, v_image):
        moved = replace(scene, opacities=opacities, colors=colors)
        v = composite_vjp(moved, LISTS, WIDTH, HEIGHT, TILE, v_image)
        return v.v_opacities, v.v_colors

    assert_vjp_matches(f, vjp, [scene.opacities, scene.colors], step=1e-6)


def one_pixel_gradient_of_alpha(opacities: list[float], profile: Profile = PAPER) -> list[float]:
    # at the pixel's own centre exp(-sigma) = 1, so that v_opacity is dC/dalpha
    n = len(opacities)
    rows = SplatRows([[0.5, 0.5]] * n, [[1.0, 0.0, 1.0]] * n, opacities, [[float(2**k)] for k in range(n)])
    pixel = composite_pixel(range(n), rows, 0.5, 0.5, [0.25], profile)
    assert pixel.ids == list(range(n))
    totals = zero_gradients(n, 1)
    composite_pixel_vjp(pixel, rows, 0.5, 0.5, [0.25], [1.0], 0.0, totals, profile)
    return totals.v_opacities.tolist()


def test_the_colour_s_derivative_by_alpha_does_not_depend_on_the_splat_s_own_opacity() -> None:
    # eq. 10 of the paper: dc/dalpha_i = T_i (c_i - colour behind i)
    for i in range(3):
        gradients = set()
        for opacity in (0.125, 0.5, 0.875):
            opacities = [0.25, 0.5, 0.75]
            opacities[i] = opacity
            gradients.add(one_pixel_gradient_of_alpha(opacities)[i])
        assert len(gradients) == 1
        assert gradients != {0.0}


def test_the_colour_s_derivative_by_alpha_is_light_left_times_own_colour_minus_colour_behind() -> None:
    # T = 1, 3/4, 3/8; colours 1, 2, 4; background 1/4; behind: 3/4 4 + 1/4 1/4 = 49/16, (2 + 49/16) / 2 = 81/32
    want = [1.0 - 81.0 / 32.0, 0.75 * (2.0 - 49.0 / 16.0), 0.375 * (4.0 - 0.25)]
    assert one_pixel_gradient_of_alpha([0.25, 0.5, 0.75]) == want


def test_an_opaque_splat_in_front_leaves_a_finite_gradient() -> None:
    # opacity exactly at a ceiling of 1: recovering T by division would be 0 / 0
    opaque = Profile(**{**PAPER.__dict__, "alpha_ceiling": 1.0, "transmittance_stop": -1.0})
    gradients = one_pixel_gradient_of_alpha([0.5, 1.0, 0.5], opaque)
    assert gradients == [1.0 - 2.0, 0.5 * (2.0 - (0.5 * 4.0 + 0.5 * 0.25)), 0.0]


def test_absolute_gradients_bound_signed_ones_and_equal_them_for_a_loss_of_one_pixel() -> None:
    scene = splats(4)
    v_image = RNG.normal(size=(HEIGHT, WIDTH, 4))
    v = composite_vjp(scene, LISTS, WIDTH, HEIGHT, TILE, v_image)
    assert np.all(v.v_means2d_abs >= np.abs(v.v_means2d))
    assert np.any(v.v_means2d_abs > 1.5 * np.abs(v.v_means2d))
    v_image[1:] = 0.0
    v_image[0, 1:] = 0.0
    one = composite_vjp(scene, LISTS, WIDTH, HEIGHT, TILE, v_image)
    assert np.any(one.v_means2d != 0.0)
    assert np.all(one.v_means2d_abs == np.abs(one.v_means2d))


def test_absolute_gradients_are_the_sum_of_one_pixel_s_absolute_gradients() -> None:
    scene = splats(4)
    v_image = RNG.normal(size=(HEIGHT, WIDTH, 4))
    total = np.zeros((4, 2))
    for y in range(HEIGHT):
        for x in range(WIDTH):
            only = np.zeros_like(v_image)
            only[y, x] = v_image[y, x]
            total += np.abs(composite_vjp(scene, LISTS, WIDTH, HEIGHT, TILE, only).v_means2d)
    np.testing.assert_allclose(
        composite_vjp(scene, LISTS, WIDTH, HEIGHT, TILE, v_image).v_means2d_abs, total, rtol=1e-12
    )


def test_the_background_s_gradient_is_the_light_left() -> None:
    scene = splats(1)
    out = composite(scene, LISTS, WIDTH, HEIGHT, TILE)
    v = composite_vjp(scene, LISTS, WIDTH, HEIGHT, TILE, np.ones((HEIGHT, WIDTH, 1)))
    np.testing.assert_allclose(v.v_background, [np.sum(out.T_final)], rtol=1e-14)


def test_a_color_s_gradient_is_the_sum_of_its_weights() -> None:
    # eq. 1: dc/dc_i = T_i alpha_i, so with every weight's remaining light they sum to one a pixel
    scene = splats(1)
    out = composite(scene, LISTS, WIDTH, HEIGHT, TILE)
    v = composite_vjp(scene, LISTS, WIDTH, HEIGHT, TILE, np.ones((HEIGHT, WIDTH, 1)))
    np.testing.assert_allclose(np.sum(v.v_colors) + np.sum(out.T_final), WIDTH * HEIGHT, rtol=1e-14)


def test_a_splat_in_no_list_and_one_behind_the_stop_get_exactly_zero() -> None:
    rows = SplatRows([[0.5, 0.5]] * 4, [[1.0, 0.0, 1.0]] * 4, [0.998, 0.998, 0.5, 0.5], [[1.0]] * 4)
    pixel = composite_pixel([0, 1, 2], rows, 0.5, 0.5, [0.0], PAPER)
    assert pixel.ids == [0]
    totals = zero_gradients(4, 1)
    composite_pixel_vjp(pixel, rows, 0.5, 0.5, [0.0], [1.0], 0.0, totals)
    assert totals.v_opacities[0] != 0.0
    assert totals.v_opacities[1:].tolist() == [0.0, 0.0, 0.0]
