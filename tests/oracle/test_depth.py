"""The depth modes: by hand for one splat, and as a colour channel that holds depths."""

from __future__ import annotations

import numpy as np
import pytest

from pop_ref import Camera, Gaussians, render
from pop_ref.depth import expected_depth, expected_depth_vjp, with_depth_channel
from tests.oracle.scenes import safe_gaussians, tilted_camera

VIEW = tilted_camera()


def test_one_splat_accumulates_its_depth_times_its_alpha_and_is_expected_at_its_depth() -> None:
    g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
    camera = Camera(np.eye(4), np.array([[8.0, 0.0, 0.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]]), 1, 1)
    seen = {mode: render(g, camera, np.ones(3), render_mode=mode).image[0, 0].tolist() for mode in ("D", "RGB+ED")}
    assert seen == {"D": [2.0], "RGB+ED": [0.75, 0.75, 0.75, 4.0]}


def test_the_accumulated_depth_is_a_colour_that_holds_depths() -> None:
    g = safe_gaussians(VIEW)
    plain = render(g, VIEW)
    as_colour = render(g, VIEW, colors=plain.splats.depths[:, None])
    both = render(g, VIEW, np.ones(3), render_mode="RGB+D")
    np.testing.assert_array_equal(both.image[..., 3:], as_colour.image)
    np.testing.assert_array_equal(both.image[..., :3], render(g, VIEW, np.ones(3)).image)
    np.testing.assert_array_equal(render(g, VIEW, np.ones(3), render_mode="D").image, as_colour.image)
    assert both.splats.colors.shape[1] == 3


def test_an_empty_pixel_has_no_depth_and_passes_none_to_its_opacity() -> None:
    empty = np.zeros((1, 1)), np.ones((1, 1))
    assert expected_depth(*empty).item() == 0.0
    assert [v.item() for v in expected_depth_vjp(*empty, np.ones((1, 1)))] == [1e10, 0.0]


def test_a_mode_that_is_none_and_a_background_with_depth_are_refused() -> None:
    g = safe_gaussians(VIEW)
    with pytest.raises(ValueError, match="render_mode is 'depth'; it must be one of RGB, D, ED, RGB\\+D, RGB\\+ED"):
        with_depth_channel(render(g, VIEW).splats, "depth")
    with pytest.raises(ValueError, match=r"background has shape \[4\]; it must be \[3\]"):
        render(g, VIEW, np.ones(4), render_mode="RGB+D")
