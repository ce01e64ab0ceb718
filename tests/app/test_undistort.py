"""Undistortion is exact, keeps the principal point, and does nothing where there is nothing to undo."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.data.undistort import intrinsics, undistortion
from tests.app.captures import camera, photograph

W, H = 64, 48
PINHOLE_TERMS = {
    "SIMPLE_PINHOLE": (50.0, 33.0, 22.5),
    "PINHOLE": (50.0, 52.0, 33.0, 22.5),
    "SIMPLE_RADIAL": (50.0, 33.0, 22.5, 0.0),
    "RADIAL": (50.0, 33.0, 22.5, 0.0, 0.0),
    "OPENCV": (50.0, 52.0, 33.0, 22.5, 0.0, 0.0, 0.0, 0.0),
    "FULL_OPENCV": (50.0, 52.0, 33.0, 22.5, *[0.0] * 8),
    "SIMPLE_DIVISION": (50.0, 33.0, 22.5, 0.0),
    "DIVISION": (50.0, 52.0, 33.0, 22.5, 0.0),
    "EUCM": (50.0, 52.0, 33.0, 22.5, 0.0, 1.0),
}
DISTORTED = {
    "SIMPLE_RADIAL": (50.0, 33.0, 22.5, 0.08),
    "RADIAL": (50.0, 33.0, 22.5, -0.12, 0.03),
    "OPENCV": (50.0, 52.0, 33.0, 22.5, 0.10, -0.05, 0.004, -0.003),
    "FULL_OPENCV": (50.0, 52.0, 33.0, 22.5, 0.10, -0.05, 0.004, -0.003, 0.01, 0.02, 0.01, 0.0),
    "OPENCV_FISHEYE": (50.0, 52.0, 33.0, 22.5, 0.02, -0.01, 0.003, 0.0),
    "SIMPLE_RADIAL_FISHEYE": (50.0, 33.0, 22.5, 0.02),
    "RADIAL_FISHEYE": (50.0, 33.0, 22.5, 0.02, -0.01),
    "SIMPLE_FISHEYE": (50.0, 33.0, 22.5),
    "FISHEYE": (50.0, 52.0, 33.0, 22.5),
    "FOV": (50.0, 52.0, 33.0, 22.5, 0.6),
    "THIN_PRISM_FISHEYE": (50.0, 52.0, 33.0, 22.5, 0.02, -0.01, 0.002, -0.001, 0.0, 0.0, 0.004, 0.002),
    "RAD_TAN_THIN_PRISM_FISHEYE": (50.0, 52.0, 33.0, 22.5, 0.02, -0.01, *[0.0] * 4, 0.001, 0.002, 0.001, *[0.0] * 3),
    "SIMPLE_DIVISION": (50.0, 33.0, 22.5, -0.1),
    "DIVISION": (50.0, 52.0, 33.0, 22.5, -0.1),
    "EUCM": (50.0, 52.0, 33.0, 22.5, 0.5, 1.1),
}
OPENCV_LIKE = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")


def lens(model: str, params: tuple[float, ...]) -> Any:
    return camera(model, params, W, H)


def opencv_maps(model: str, params: tuple[float, ...], K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's own undistortion maps for the same pictures; its pixel centres are at integers."""
    old = intrinsics(lens(model, params))
    old[:2, 2] -= 0.5
    new = K.copy()
    new[:2, 2] -= 0.5
    terms = np.array(params[4:] if old[0, 0] != old[1, 1] else params[3:])
    if model == "OPENCV_FISHEYE":
        return cv2.fisheye.initUndistortRectifyMap(old, terms, np.eye(3), new, (W, H), cv2.CV_32FC1)
    coefficients = np.zeros(8)
    coefficients[: len(terms)] = terms
    return cv2.initUndistortRectifyMap(old, coefficients, np.eye(3), new, (W, H), cv2.CV_32FC1)


@pytest.mark.parametrize("model", PINHOLE_TERMS)
def test_no_distortion_leaves_the_photograph_and_the_intrinsics_as_they_are(model: str) -> None:
    one = lens(model, PINHOLE_TERMS[model])
    plan = undistortion(one, W, H)
    image = photograph(0, W, H)
    mask = image[:, :, 0] > 128
    assert plan.image(image) is image
    assert plan.mask(mask) is mask
    assert np.array_equal(plan.K, intrinsics(one))


def test_a_fisheye_without_coefficients_is_still_a_fisheye() -> None:
    assert undistortion(lens("OPENCV_FISHEYE", (50.0, 52.0, 33.0, 22.5, 0.0, 0.0, 0.0, 0.0)), W, H).maps is not None


@pytest.mark.parametrize("model", DISTORTED)
def test_every_model_keeps_its_principal_point_and_focal_ratio(model: str) -> None:
    one = lens(model, DISTORTED[model])
    before, after = intrinsics(one), undistortion(one, W, H).K
    assert np.array_equal(after[:2, 2], before[:2, 2])
    assert after[0, 0] / before[0, 0] == pytest.approx(after[1, 1] / before[1, 1], rel=1e-12)
    assert after[0, 1] == after[1, 0] == 0.0


@pytest.mark.parametrize("model", DISTORTED)
def test_a_new_pixel_shows_what_the_lens_shows_in_its_direction(model: str) -> None:
    one = lens(model, DISTORTED[model])
    plan = undistortion(one, W, H)
    assert plan.maps is not None
    rows, columns = np.meshgrid(np.arange(H), np.arange(W), indexing="ij")
    rays = np.linalg.inv(plan.K) @ np.stack([columns + 0.5, rows + 0.5, np.ones_like(rows)]).reshape(3, -1)
    seen_at = one.img_from_cam(rays.T) - 0.5
    assert np.abs(np.stack(plan.maps, axis=-1).reshape(-1, 2) - seen_at).max() < 1e-4


@pytest.mark.parametrize("model", OPENCV_LIKE)
def test_opencv_agrees_on_where_to_sample(model: str) -> None:
    plan = undistortion(lens(model, DISTORTED[model]), W, H)
    assert plan.maps is not None
    for ours, theirs in zip(plan.maps, opencv_maps(model, DISTORTED[model], plan.K), strict=True):
        assert np.abs(ours - theirs).max() < 2e-4


@given(
    model=st.sampled_from(("SIMPLE_RADIAL", "OPENCV_FISHEYE", "OPENCV")),
    k1=st.floats(-0.25, 0.25),
    k2=st.floats(-0.1, 0.1),
    cx=st.floats(20.0, 44.0),
    cy=st.floats(16.0, 32.0),
)
def test_every_new_pixel_lies_in_the_photograph_and_no_wider_zoom_would(
    model: str, k1: float, k2: float, cx: float, cy: float
) -> None:
    terms = {"SIMPLE_RADIAL": (k1,), "OPENCV": (k1, k2, 0.0, 0.0), "OPENCV_FISHEYE": (k1, k2, 0.0, 0.0)}[model]
    focal = (60.0,) if model == "SIMPLE_RADIAL" else (60.0, 60.0)
    one = lens(model, (*focal, cx, cy, *terms))
    plan = undistortion(one, W, H)
    corners = np.array([[0.0, 0.0], [W, 0.0], [0.0, H], [W, H]])
    if plan.maps is None:
        return
    x, y = plan.maps
    assert x.min() >= -0.5
    assert y.min() >= -0.5
    assert x.max() <= W - 0.5
    assert y.max() <= H - 0.5
    zoom = plan.K[0, 0] / 60.0
    assert 0.5 <= zoom <= 4.0
    if zoom > 0.51:  # not at the widest that is allowed: then the outline touches the photograph's
        side = np.linspace(0.0, 1.0, 97)[:, None]
        outline = np.concatenate([a + side * (b - a) for a, b in zip(corners, corners[[1, 3, 0, 2]], strict=True)])
        rays = np.concatenate([(outline - [cx, cy]) / (60.0 * zoom * 0.99), np.ones((len(outline), 1))], axis=1)
        at = one.img_from_cam(rays)
        outside = (at.min() < 0.0) or (at[:, 0].max() > W) or (at[:, 1].max() > H) or not np.isfinite(at).all()
        assert outside or turns_back(one, rays)


def turns_back(one: Any, rays: np.ndarray) -> bool:
    """Tell whether the lens shows some direction nearer to the centre than another one on the way to it."""
    center = [one.principal_point_x, one.principal_point_y]
    steps = np.linspace(0.02, 1.0, 50)[:, None, None] * [1.0, 1.0, 0.0] * rays + [0.0, 0.0, 1.0]
    at = one.img_from_cam(steps.reshape(-1, 3)).reshape(50, -1, 2)
    return bool(np.any(np.diff(np.linalg.norm(at - center, axis=-1), axis=0) < 0.0))


def test_little_distortion_changes_little() -> None:
    for k in (1e-3, 1e-4, -1e-3):
        plan = undistortion(lens("SIMPLE_RADIAL", (50.0, 33.0, 22.5, k)), W, H)
        assert plan.maps is not None
        assert plan.K[0, 0] / 50.0 == pytest.approx(1.0, abs=2.0 * abs(k))
        assert np.abs(plan.maps[0] - np.arange(W)).max() < 100.0 * abs(k)


@pytest.mark.parametrize("model", DISTORTED)
def test_a_photograph_stored_at_half_size_gets_half_the_intrinsics_and_the_same_directions(model: str) -> None:
    full = undistortion(lens(model, DISTORTED[model]), W, H)
    half = undistortion(lens(model, DISTORTED[model]), W // 2, H // 2)
    assert np.allclose(half.K[:2], full.K[:2] / 2.0, rtol=1e-9)
    assert full.maps is not None
    assert half.maps is not None
    # the centre of a half-size pixel is the corner where four full-size pixels meet
    for big, small in zip(full.maps, half.maps, strict=True):
        corners = 0.25 * (big[::2, ::2] + big[1::2, ::2] + big[::2, 1::2] + big[1::2, 1::2])
        assert np.abs((corners + 0.5) / 2.0 - 0.5 - small).max() < 0.02


def test_a_straight_line_is_straight_again() -> None:
    one = lens("OPENCV", DISTORTED["OPENCV"])
    plan = undistortion(one, W, H)
    assert plan.maps is not None
    # a checkerboard's edge, painted as the lens shows it: left of x = 0.1 z black, right of it white
    rows, columns = np.meshgrid(np.arange(H), np.arange(W), indexing="ij")
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1).reshape(-1, 2)
    rays = np.asarray(one.cam_from_img(pixels)).reshape(H, W, -1)
    bent = np.where(rays[..., 0] > 0.1, 255, 0).astype(np.uint8)
    straight = plan.image(np.repeat(bent[..., None], 3, axis=2))[..., 0]
    edge = plan.K[0, 0] * 0.1 + plan.K[0, 2]
    assert np.abs((255 - straight.astype(float)).sum(axis=1) / 255.0 - edge).max() < 1.0


def test_a_lens_that_folds_the_image_is_refused() -> None:
    with pytest.raises(ValueError, match="folds the 64x48 image"):
        undistortion(lens("SIMPLE_RADIAL", (2.0, 33.0, 22.5, -0.9)), W, H)


def test_a_full_sphere_is_refused() -> None:
    with pytest.raises(ValueError, match="EQUIRECTANGULAR"):
        undistortion(camera("EQUIRECTANGULAR", (W, H), W, H), W, H)
