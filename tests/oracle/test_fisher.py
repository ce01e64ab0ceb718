"""Fisher blocks against the outer products of every pixel's and channel's own gradient."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pop_ref import INRIA, PAPER, SPEEDY_SPLAT, Camera, Gaussians, Profile, render, render_vjp
from pop_ref.compositing import composite_vjp
from pop_ref.fisher import fisher_blocks, log_det_scores, screen_moments
from tests.oracle.scenes import camera, random_gaussians, tilted_camera

BACKGROUND = np.array([0.25, 0.5, 1.0])


def one_hots(view: Camera):
    for y in range(view.height):
        for x in range(view.width):
            for c in range(3):
                v_image = np.zeros((view.height, view.width, 3))
                v_image[y, x, c] = 1.0
                yield c, v_image


def moments_of(gaussians: Gaussians, view: Camera, profile: Profile, sh_degree: int | None = None) -> np.ndarray:
    drawn = render(gaussians, view, BACKGROUND, sh_degree, profile)
    size = profile.tile_size
    return screen_moments(drawn.splats, drawn.tile_lists, view.width, view.height, size, BACKGROUND, profile)


def blocks_by_pixel(gaussians: Gaussians, view: Camera, profile: Profile, sh_degree: int | None) -> np.ndarray:
    """Sum g g^T over pixels and channels, g from the whole renderer's transpose of a one-hot cotangent."""
    blocks = np.zeros((len(gaussians), 6, 6))
    for _, v_image in one_hots(view):
        v = render_vjp(gaussians, view, v_image, background=BACKGROUND, sh_degree=sh_degree, profile=profile)
        g = np.concatenate([v.means, v.scales * gaussians.scales], axis=1)
        blocks += g[:, :, None] * g[:, None, :]
    return blocks


@pytest.mark.parametrize("profile", [PAPER, INRIA, SPEEDY_SPLAT], ids=lambda p: p.name)
@pytest.mark.parametrize(("n_sh", "degree"), [(1, None), (16, None), (16, 1)])
def test_blocks_are_the_sums_of_outer_products(profile: Profile, n_sh: int, degree: int | None) -> None:
    gaussians, view = random_gaussians(2, 6, n_sh), tilted_camera()
    # one at the ceiling, where profiles differ in what they let through
    gaussians = replace(gaussians, opacities=np.append(gaussians.opacities[:-1], 1.0))
    want = blocks_by_pixel(gaussians, view, profile, degree)
    found = fisher_blocks(gaussians, view, moments_of(gaussians, view, profile, degree), degree, profile)
    scale = np.max(np.abs(want), axis=(1, 2), keepdims=True)
    assert np.count_nonzero(scale) >= 4
    assert np.all(np.abs(found - want) <= 1e-11 * scale)
    assert np.array_equal(found, np.swapaxes(found, 1, 2))


def test_the_view_direction_counts_and_channels_do_not_leak_into_each_other() -> None:
    # with colours that depend on direction in one channel only, the two others have the block of flat colours
    gaussians, view = random_gaussians(2, 6, 4), camera()
    painted = gaussians.sh.copy()
    painted[:, 1:, 1:] = 0.0
    flat = painted.copy()
    flat[:, 1:] = 0.0
    directed, plain = replace(gaussians, sh=painted), replace(gaussians, sh=flat)
    blocks = [fisher_blocks(g, view, moments_of(g, view, PAPER)) for g in (directed, plain)]
    assert not np.allclose(blocks[0], blocks[1])
    np.testing.assert_allclose(blocks[0], blocks_by_pixel(directed, view, PAPER, None), rtol=1e-8, atol=1e-12)


def test_moments_are_those_of_single_pixels_in_the_order_that_is_stated() -> None:
    gaussians, view = random_gaussians(4, 5, 1), camera(4, 3)
    drawn = render(gaussians, view, BACKGROUND)
    want = np.zeros((len(gaussians), 31))
    for c, v_image in one_hots(view):
        args = (drawn.splats, drawn.tile_lists, view.width, view.height, PAPER.tile_size, v_image)
        v = composite_vjp(*args, background=BACKGROUND)
        q, w = np.concatenate([v.v_means2d, v.v_conics], axis=1), v.v_colors[:, c]
        pairs = [(i, j) for i in range(5) for j in range(i, 5)]
        want[:, :15] += np.stack([q[:, i] * q[:, j] for i, j in pairs], axis=1)
        want[:, 15 + 5 * c : 20 + 5 * c] += q * w[:, None]
        # the same in all three channels: counted once
        want[:, 30] += w * w * (c == 0)
    found = moments_of(gaussians, view, PAPER)
    assert np.all(np.any(want[:4] != 0.0, axis=1))
    np.testing.assert_allclose(found, want, rtol=1e-10, atol=1e-13)


def test_scores_are_log_determinants() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(5, 6, 8)) * np.exp(rng.normal(size=(5, 6, 1)))
    blocks = A @ np.swapaxes(A, 1, 2)
    np.testing.assert_allclose(log_det_scores(blocks), np.linalg.slogdet(blocks)[1], rtol=1e-11)


def test_scores_do_not_lose_a_flat_gaussian_and_know_a_deficient_block() -> None:
    rng = np.random.default_rng(2)
    A = rng.normal(size=(6, 9))
    sound = A @ A.T
    units = np.array([1e6, 1e6, 1e6, 1.0, 1.0, 1e-7])
    # units change the determinant by their squares; singular values of the block as it is would have lost the last
    scores = log_det_scores(np.stack([sound, sound * np.outer(units, units)]))
    assert scores[1] == pytest.approx(scores[0] + 2.0 * np.sum(np.log(units)), rel=1e-12)
    deficient = A[:, :4] @ A[:, :4].T
    assert log_det_scores(np.stack([deficient, np.zeros((6, 6))])).tolist() == [-np.inf, -np.inf]


def test_what_does_not_fit_is_told() -> None:
    gaussians, view = random_gaussians(2, 3, 1), camera()
    drawn = render(gaussians, view)
    grey = replace(drawn.splats, colors=drawn.splats.colors[:, :1])
    with pytest.raises(ValueError, match="splats have 1 colour channels; they must have 3"):
        screen_moments(grey, drawn.tile_lists, view.width, view.height, 16)
    with pytest.raises(ValueError, match=r"moments has shape \[2, 31\]; it must be \[3, 31\]"):
        fisher_blocks(gaussians, view, np.zeros((2, 31)))
