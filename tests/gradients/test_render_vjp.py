"""The whole renderer's transpose against differences, away from thresholds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pop_ref import (
    GSPLAT_1_6,
    INRIA,
    PAPER,
    Camera,
    Gaussians,
    Profile,
    Splats,
    margins,
    project,
    project_vjp,
    render,
    render_vjp,
)
from pop_ref.compositing import composite, composite_vjp
from pop_ref.pixel import SplatRows, composite_pixel, composite_pixel_vjp, zero_gradients
from pop_ref.recipes import RECIPES, Recipe
from pop_ref.tiles import tile_lists
from pop_ref.training import gaussians_from_params, objective, params_vjp, start
from tests.golden import ten_losses
from tests.gradients.checks import assert_vjp_matches, central_gradient
from tests.oracle.scenes import camera, loose_camera, safe_gaussians, tilted_camera

VIEW = tilted_camera()
BACKGROUND = np.array([0.5, 0.25, 1.0])
INRIA_TRUE = Profile(**{**INRIA.__dict__, "clamp_gradient": "exact"})


@pytest.mark.parametrize(
    ("profile", "antialiased"),
    [(PAPER, False), (PAPER, True), (INRIA_TRUE, False)],
    ids=["paper", "antialiased", "inria with true clamp gradient"],
)
def test_transpose_matches_differences_in_every_parameter(profile: Profile, antialiased: bool) -> None:
    gaussians = safe_gaussians(VIEW, profile=profile, antialiased=antialiased)
    options = {"profile": profile, "antialiased": antialiased}

    def scene(means, quats, scales, opacities, sh, viewmat):
        moved = replace(gaussians, means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)
        return moved, loose_camera(VIEW, viewmat)

    def f(*args):
        out = render(*scene(*args[:6]), args[6], **options)
        return out.image, out.T_final

    def vjp(*args):
        *parameters, background, v_image, v_T_final = args
        v = render_vjp(*scene(*parameters), v_image, v_T_final, background, **options)
        return v.means, v.quats, v.scales, v.opacities, v.sh, v.viewmat, v.background

    g = gaussians
    args = [g.means, g.quats, g.scales, g.opacities, g.sh, VIEW.viewmat, BACKGROUND]
    out = render(gaussians, VIEW, BACKGROUND, **options)
    assert np.mean(out.n_blended) > 1.0
    assert np.min(out.T_final) < 0.9
    assert_vjp_matches(f, vjp, args, step=2e-6)


@pytest.mark.parametrize("n_channels", [0, 1, 4], ids=["harmonics", "one channel", "four channels"])
@pytest.mark.parametrize("render_mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_transpose_matches_differences_in_every_mode_and_number_of_channels(render_mode: str, n_channels: int) -> None:
    gaussians, rng = safe_gaussians(VIEW), np.random.default_rng(5)
    given = rng.uniform(0.25, 1.0, (len(gaussians), n_channels))
    behind = rng.uniform(0.25, 1.0, n_channels) if n_channels else BACKGROUND

    def scene(means, quats, scales, opacities, sh, viewmat):
        moved = replace(gaussians, means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)
        return moved, loose_camera(VIEW, viewmat)

    def options(colors):
        return {"render_mode": render_mode, "colors": colors if n_channels else None}

    def f(*args):
        out = render(*scene(*args[:6]), args[6], **options(args[7]))
        return out.image, out.T_final

    def vjp(*args):
        *parameters, background, colors, v_image, v_T_final = args
        v = render_vjp(*scene(*parameters), v_image, v_T_final, background, **options(colors))
        v_colors = np.zeros_like(given) if v.colors is None else v.colors
        return v.means, v.quats, v.scales, v.opacities, v.sh, v.viewmat, v.background, v_colors

    g = gaussians
    args = [g.means, g.quats, g.scales, g.opacities, g.sh, VIEW.viewmat, behind, given]
    colored = render_mode.startswith("RGB")
    assert f(*args)[0].shape[2] == colored * (n_channels or 3) + (render_mode != "RGB")
    # harmonics, background and colours are read by the modes that show colours, and harmonics only without colours
    unread = {4: not colored or n_channels > 0, 6: not colored, 7: not colored or n_channels == 0}
    assert_vjp_matches(f, vjp, args, step=2e-6, zero_gradient_allowed=[k for k, idle in unread.items() if idle])


def test_every_gaussian_has_signal_in_the_scene_the_differences_are_taken_of() -> None:
    v = render_vjp(safe_gaussians(VIEW), VIEW, np.random.default_rng(0).normal(size=(5, 6, 3)))
    for name in ("means", "quats", "scales", "opacities", "sh", "means2d"):
        rows = getattr(v, name)
        assert np.all(np.linalg.norm(rows.reshape(len(rows), -1), axis=1) > 1e-6), name


def test_lower_degrees_leave_the_higher_bands_without_gradient() -> None:
    v = render_vjp(safe_gaussians(VIEW), VIEW, np.ones((5, 6, 3)), sh_degree=0)
    assert np.all(v.sh[:, 1:] == 0.0)
    assert np.any(v.sh[:, 0] != 0.0)


def test_screen_gradients_are_those_of_the_centres_in_px() -> None:
    # moving the principal point moves every screen centre alike
    gaussians = safe_gaussians(camera())
    v_image = np.random.default_rng(3).normal(size=(5, 6, 3))
    v = render_vjp(gaussians, camera(), v_image)

    def loss(shift: float) -> float:
        view = camera()
        # the clamp's limits move with the principal point; a wide margin keeps them out of the picture
        wide = replace(PAPER, frustum_margin=100.0)
        view.K[0, 2] += shift
        return float(np.sum(v_image * render(gaussians, view, profile=wide).image))

    wide = replace(PAPER, frustum_margin=100.0)
    v_wide = render_vjp(gaussians, camera(), v_image, profile=wide)
    slope = (loss(1e-5) - loss(-1e-5)) / 2e-5
    np.testing.assert_allclose(np.sum(v_wide.means2d[:, 0]), slope, rtol=1e-6)
    assert np.all(v.means2d_abs >= np.abs(v.means2d))


def test_a_zero_cotangent_gives_exact_zeros() -> None:
    v = render_vjp(safe_gaussians(VIEW), VIEW, np.zeros((5, 6, 3)), np.zeros((5, 6)), BACKGROUND)
    assert v.colors is None
    for name, value in v.__dict__.items():
        assert name == "colors" or np.all(value == 0.0), name


def test_moving_scene_and_camera_together_has_no_gradient() -> None:
    # a world translation d: means + d and t - R d leave the picture alone
    gaussians = safe_gaussians(VIEW)
    v = render_vjp(gaussians, VIEW, np.random.default_rng(4).normal(size=(5, 6, 3)))
    of_means = np.sum(v.means, axis=0)
    of_camera = VIEW.viewmat[:3, :3].T @ v.viewmat[:3, 3]
    assert np.linalg.norm(of_means) > 1e-3
    np.testing.assert_allclose(of_means, of_camera, rtol=1e-10, atol=1e-12)


def test_the_scene_is_as_far_from_every_threshold_as_the_differences_need() -> None:
    nearest = margins(safe_gaussians(VIEW), VIEW).nearest
    assert nearest is None or nearest.margin > 1e-5


def test_an_empty_scene_sends_everything_to_the_background() -> None:
    v = render_vjp(Gaussians([], [], [], [], []), VIEW, np.ones((5, 6, 3)), background=BACKGROUND)
    assert v.background.tolist() == [30.0, 30.0, 30.0]
    assert v.means.shape == (0, 3)


def test_gradients_of_extreme_opacities_are_finite_and_follow_the_profile() -> None:
    view = camera()
    gaussians = replace(safe_gaussians(view), opacities=np.array([0.0, 1.0 / 512.0, 1.0, 1.0, 0.5]))
    v = render_vjp(gaussians, view, np.ones((5, 6, 3)), background=BACKGROUND)
    assert all(np.all(np.isfinite(value)) for name, value in v.__dict__.items() if name != "colors")
    assert np.all(v.opacities[:2] == 0.0)
    assert np.all(v.means[:2] == 0.0)
    assert v.opacities[4] != 0.0


# The transpose of blending against differences, and what must hold of it exactly.

RNG = np.random.default_rng(7)
WIDTH, HEIGHT, TILE = 4, 3, 2
LISTS = [[2, 0, 1, 3], [0, 1, 2, 3], [3, 2, 1], [1, 0, 2, 3]]
COMPOSITING_BACKGROUND = np.array([0.5, 0.25, 1.0, 0.75])


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

    args = [scene.means2d, scene.conics, scene.opacities, scene.colors, COMPOSITING_BACKGROUND[:n_channels]]
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


# The transpose of everything before a pixel against differences, a depth channel included.


def made_of(like: Gaussians, means, quats, scales, opacities, sh) -> Gaussians:
    return replace(like, means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)


def arguments(g: Gaussians) -> list[np.ndarray]:
    return [g.means, g.quats, g.scales, g.opacities, g.sh, VIEW.viewmat]


@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])
@pytest.mark.parametrize(
    "profile", [PAPER, Profile(**{**INRIA.__dict__, "clamp_gradient": "exact"})], ids=lambda p: p.name
)
def test_transpose_matches_differences_down_to_the_view_matrix(profile: Profile, antialiased: bool) -> None:
    gaussians = safe_gaussians(VIEW, profile=profile, antialiased=antialiased)
    options = {"profile": profile, "antialiased": antialiased}
    visible = project(gaussians, VIEW, **options).visible
    assert np.sum(visible) >= 3

    def f(*args):
        s = project(made_of(gaussians, *args[:5]), loose_camera(VIEW, args[5]), **options)
        # every row has a depth, but a culled one's is not part of the picture
        return s.means2d, s.conics, s.opacities, s.colors, np.where(visible, s.depths, 0.0)

    def vjp(*args):
        v = project_vjp(made_of(gaussians, *args[:5]), loose_camera(VIEW, args[5]), *args[6:], **options)
        return v.means, v.quats, v.scales, v.opacities, v.sh, v.viewmat

    assert_vjp_matches(f, vjp, arguments(gaussians), step=2e-6)


def test_colours_can_be_given_and_get_their_own_gradient() -> None:
    gaussians = safe_gaussians(VIEW)
    colors = np.random.default_rng(1).normal(size=(len(gaussians), 5))
    splats = project(gaussians, VIEW, colors=colors)
    assert np.all(splats.colors[splats.visible] == colors[splats.visible])
    v_colors = np.ones_like(colors)
    zeros = np.zeros((len(gaussians), 3))
    v = project_vjp(gaussians, VIEW, zeros[:, :2], zeros, zeros[:, 0], v_colors, colors=colors)
    assert v.colors is not None
    assert np.all(v.colors == splats.visible[:, None])
    assert np.all(v.sh == 0.0)
    assert np.all(v.means == 0.0)


def test_a_depth_channel_s_transpose_matches_differences() -> None:
    gaussians = safe_gaussians(VIEW)

    def with_depth(means, viewmat):
        splats = project(replace(gaussians, means=means), loose_camera(VIEW, viewmat))
        return replace(splats, colors=np.concatenate([splats.colors, splats.depths[:, None]], axis=1))

    def lists_of(splats):
        return tile_lists(splats.means2d, splats.radii, splats.depths, VIEW.width, VIEW.height, 16)

    def f(means, viewmat):
        splats = with_depth(means, viewmat)
        return composite(splats, lists_of(splats), VIEW.width, VIEW.height, 16).image

    def vjp(means, viewmat, v_image):
        splats = with_depth(means, viewmat)
        v = composite_vjp(splats, lists_of(splats), VIEW.width, VIEW.height, 16, v_image)
        of = project_vjp(
            replace(gaussians, means=means),
            loose_camera(VIEW, viewmat),
            v.v_means2d,
            v.v_conics,
            v.v_opacities,
            v.v_colors[:, :3],
            v_depths=v.v_colors[:, 3],
        )
        return of.means, of.viewmat

    image = f(gaussians.means, VIEW.viewmat)
    assert np.max(image[..., 3]) > 1.0
    assert_vjp_matches(f, vjp, [gaussians.means, VIEW.viewmat], step=2e-6)


def test_culled_rows_are_zero_but_for_their_depth_and_get_exactly_zero() -> None:
    gaussians = safe_gaussians(VIEW)
    means = gaussians.means.copy()
    means[0] = [0.0, 0.0, -4.0]
    means[1] = [900.0, 0.0, 4.0]
    culled = replace(gaussians, means=means, opacities=np.array([0.5, 0.5, 1.0 / 512.0, 0.5, 0.5]))
    splats = project(culled, VIEW)
    assert splats.visible.tolist() == [False, False, False, True, True]
    for name in ("means2d", "conics", "opacities", "colors", "radii"):
        assert np.all(getattr(splats, name)[:3] == 0.0)
    assert np.all(splats.depths != 0.0)
    rng = np.random.default_rng(2)
    v = project_vjp(culled, VIEW, *(rng.normal(size=s) for s in ((5, 2), (5, 3), (5,), (5, 3), (5,))))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert np.all(getattr(v, name)[:3] == 0.0)
        assert np.all(np.any(getattr(v, name)[3:] != 0.0, axis=tuple(range(1, getattr(v, name).ndim))))


def test_an_empty_scene_has_empty_gradients() -> None:
    empty = Gaussians([], [], [], [], [])
    view: Camera = VIEW
    assert len(project(empty, view).depths) == 0
    v = project_vjp(empty, view, np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))
    assert v.means.shape == (0, 3)
    assert np.all(v.viewmat == 0.0)


# The gradient of the whole objective by raw parameters, through every stage at once.

CAMERA, PHOTO = ten_losses.cameras()[1], ten_losses.photographs()[1]
PARAMS = {name: array[4:6] for name, array in ten_losses.first_params().items()}
# one band stands for the others, which are most of all numbers: the raw coefficients are the activated ones
PARAMS["shN"] = PARAMS["shN"][:, :3]


def loss_of(params: dict[str, np.ndarray], recipe: Recipe) -> float:
    gaussians = gaussians_from_params(params)
    return objective(render(gaussians, CAMERA), gaussians, PHOTO, start(params), recipe)[0]


@pytest.mark.parametrize("name", ["POP", "3DGS"])
def test_gradient_by_raw_parameters_matches_differences(name: str) -> None:
    gaussians = gaussians_from_params(PARAMS)
    recipe = RECIPES[name]
    _, v_image, v_opacities = objective(render(gaussians, CAMERA), gaussians, PHOTO, start(PARAMS), recipe)
    analytic = params_vjp(PARAMS, render_vjp(gaussians, CAMERA, v_image), v_opacities)
    for key, array in PARAMS.items():
        # a small step keeps every decision of the render (what is skipped, what wins) as it is
        numeric = central_gradient(lambda x, key=key: loss_of({**PARAMS, key: x}, recipe), array, step=2e-6)
        scale = np.linalg.norm(numeric)
        assert scale > 0.0
        assert np.linalg.norm(analytic[key] - numeric) <= 1e-6 * scale, key
