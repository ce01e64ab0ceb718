"""The whole renderer's transpose against differences, away from thresholds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pop_ref import INRIA, PAPER, Gaussians, Profile, margins, render, render_vjp
from tests.gradients.checks import assert_vjp_matches
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
