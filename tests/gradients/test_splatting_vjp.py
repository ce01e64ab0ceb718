"""The transpose of everything before a pixel against differences, a depth channel included."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pop_ref import INRIA, PAPER, Camera, Gaussians, Profile, project, project_vjp
from pop_ref.compositing import composite, composite_vjp
from pop_ref.tiles import tile_lists
from tests.gradients.checks import assert_vjp_matches
from tests.oracle.scenes import loose_camera, safe_gaussians, tilted_camera

VIEW = tilted_camera()


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
