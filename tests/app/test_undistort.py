"""Undistortion is exact, keeps the principal point, and does nothing where there is nothing to undo."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from pop_fast.data import apply_similarity, load_capture, to_capture_frame
from pop_fast.data.camera_models import CAMERA_MODELS
from pop_fast.data.capture import normalizing_transform, transform_points, transform_viewmats
from pop_fast.data.gaussians import rotate_sh
from pop_fast.data.read_images import intrinsics, undistortion
from pop_fast.errors import PopError
from pop_fast.stages.covariance import covars_from_quats_scales
from pop_fast.stages.harmonics import colors_from_sh, sh_basis
from tests.app.captures import assert_one_line, camera, cloud, colmap_capture, look_at, many, photograph, raw, ring

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
    "BROWN4": (50.0, 52.0, 33.0, 22.5, *[0.0] * 6),
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
    "BROWN4": (50.0, 52.0, 33.0, 22.5, 0.10, -0.05, 0.01, -0.02, 0.004, -0.003),
}


def lens(model: str, params: tuple[float, ...]) -> Any:
    return camera(model, params, W, H)


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


def test_the_table_of_models_has_colmaps_numbers_and_parameters_and_each_field_names_a_term() -> None:
    for name, model in CAMERA_MODELS.items():
        if model.number is not None:
            kind = pycolmap.CameraModelId.__members__[name]
            theirs = pycolmap.Camera.create_from_model_id(1, kind, 1.0, 1, 1)
            assert (model.number, ",".join(model.params)) == (int(kind), theirs.params_info.replace(" ", ""))
        assert all(set(fields) <= set(model.terms) for fields in model.fields.values())
        # readers give the focal lengths and the principal point first
        assert not any(model.fields.values()) or model.params[:4] == ("fx", "fy", "cx", "cy")


def test_browns_polynomial_is_opencvs_without_k4_which_is_the_factor_of_the_eighth_power() -> None:
    *pinhole, k1, k2, k3, k4, p1, p2 = DISTORTED["BROWN4"]
    points = np.random.default_rng(0).uniform([-0.6, -0.6, 0.5], [0.6, 0.6, 1.5], (50, 3))
    found = [lens("BROWN4", (*pinhole, k1, k2, k3, k, p1, p2)).img_from_cam(points) for k in (0.0, k4)]
    K = np.array([[pinhole[0], 0.0, pinhole[2]], [0.0, pinhole[1], pinhole[3]], [0.0, 0.0, 1.0]])
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array([k1, k2, p1, p2, k3]))[0][:, 0]
    np.testing.assert_allclose(found[0], expected, rtol=0.0, atol=1e-9)
    xy = points[:, :2] / points[:, 2:]
    far = k4 * (xy**2).sum(axis=1, keepdims=True) ** 4 * xy * pinhole[:2]
    np.testing.assert_allclose(found[1] - found[0], far, rtol=0.0, atol=1e-9)


def test_the_model_of_arias_glasses_is_colmaps() -> None:
    k, p0, p1 = np.array([0.02, -0.01, 0.03, 0.01, -0.02, 0.01]), 0.01, 0.02
    s0, s1, s2, s3 = 0.03, 0.01, 0.02, 0.04
    a, b = 0.5, -0.25
    # Project Aria's documentation, camera intrinsic models: FisheyeRadTanThinPrism
    r = np.hypot(a, b)
    x, y = np.arctan(r) * (1.0 + k @ np.arctan(r) ** np.arange(2, 14, 2)) * np.array([a, b]) / r
    r2 = x * x + y * y
    u = x + p0 * (2 * x * x + r2) + 2 * p1 * x * y + s0 * r2 + s1 * r2 * r2
    v = y + p1 * (2 * y * y + r2) + 2 * p0 * x * y + s2 * r2 + s3 * r2 * r2
    one = lens("RAD_TAN_THIN_PRISM_FISHEYE", (50.0, 52.0, 33.0, 22.5, *k, p0, p1, s0, s1, s2, s3))
    found = one.img_from_cam(np.array([[a, b, 1.0]]))[0]
    np.testing.assert_allclose(found, [50.0 * u + 33.0, 52.0 * v + 22.5], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("shrunk", [1, 2])
@pytest.mark.parametrize("model", DISTORTED)
def test_a_new_pixel_shows_what_the_lens_shows_in_its_direction_at_any_stored_size(model: str, shrunk: int) -> None:
    one, (w, h) = lens(model, DISTORTED[model]), (W // shrunk, H // shrunk)
    plan = undistortion(one, w, h)
    # the principal point and the ratio of the focal lengths are kept, and the zoom is that of the whole size
    before, after, whole = intrinsics(one), plan.K, undistortion(one, W, H).K
    assert np.array_equal(after[:2, 2] * shrunk, before[:2, 2])
    assert after[0, 0] / before[0, 0] == pytest.approx(after[1, 1] / before[1, 1], rel=1e-12)
    assert after[0, 1] == after[1, 0] == 0.0
    assert np.allclose(after[:2] * shrunk, whole[:2], rtol=1e-9)
    rows, columns = np.meshgrid(np.arange(h), np.arange(w), indexing="ij")
    rays = np.linalg.inv(plan.K) @ np.stack([columns + 0.5, rows + 0.5, np.ones_like(rows)]).reshape(3, -1)
    seen_at = one.img_from_cam(rays.T) / shrunk - 0.5
    assert np.abs(np.stack(plan.maps, axis=-1).reshape(-1, 2) - seen_at).max() < 1e-4


@given(
    model=st.sampled_from(("SIMPLE_RADIAL", "OPENCV_FISHEYE", "OPENCV")),
    k1=st.floats(-0.25, 0.25),
    k2=st.floats(-0.1, 0.1),
    cx=st.floats(20.0, 44.0),
    cy=st.floats(16.0, 32.0),
)
def test_the_zoom_is_the_widest_that_fits(model: str, k1: float, k2: float, cx: float, cy: float) -> None:
    terms = {"SIMPLE_RADIAL": (k1,), "OPENCV": (k1, k2, 0.0, 0.0), "OPENCV_FISHEYE": (k1, k2, 0.0, 0.0)}[model]
    focal = (60.0,) if model == "SIMPLE_RADIAL" else (60.0, 60.0)
    one = lens(model, (*focal, cx, cy, *terms))
    plan = undistortion(one, W, H)
    corners = np.array([[0.0, 0.0], [W, 0.0], [0.0, H], [W, H]])
    if plan.maps is None:
        return
    for at, side in zip(plan.maps, (W, H), strict=True):
        assert at.min() >= -0.5
        assert at.max() <= side - 0.5
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
        assert plan.K[0, 0] / 50.0 == pytest.approx(1.0, abs=2.0 * abs(k))
        assert np.abs(plan.maps[0] - np.arange(W)).max() < 100.0 * abs(k)


def test_a_straight_line_is_straight_again() -> None:
    one = lens("OPENCV", DISTORTED["OPENCV"])
    plan = undistortion(one, W, H)
    # a checkerboard's edge, painted as the lens shows it: left of x = 0.1 z black, right of it white
    rows, columns = np.meshgrid(np.arange(H), np.arange(W), indexing="ij")
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1).reshape(-1, 2)
    rays = np.asarray(one.cam_from_img(pixels)).reshape(H, W, -1)
    bent = np.where(rays[..., 0] > 0.1, 255, 0).astype(np.uint8)
    straight = plan.image(np.repeat(bent[..., None], 3, axis=2))[..., 0]
    edge = plan.K[0, 0] * 0.1 + plan.K[0, 2]
    assert np.abs((255 - straight.astype(float)).sum(axis=1) / 255.0 - edge).max() < 1.0


@pytest.mark.parametrize(
    ("model", "params", "told"),
    [("SIMPLE_RADIAL", (2.0, 33.0, 22.5, -0.9), "folds the image"), ("EQUIRECTANGULAR", (W, H), "EQUIRECTANG")],
)
def test_a_lens_that_folds_the_image_and_a_full_sphere_are_refused(model: str, params: tuple, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        undistortion(lens(model, params), W, H)


# The normalised world shows the same pictures, and splats find their way back.

unit = st.floats(-1.0, 1.0, width=32)
similarities = st.builds(
    lambda turn, shift, exponent: similarity(turn, shift, 2.0**exponent),
    hnp.arrays(np.float64, 3, elements=st.floats(-3.0, 3.0, width=32)),
    hnp.arrays(np.float64, 3, elements=unit),
    st.integers(-3, 3),
)


def similarity(turn: np.ndarray, shift: np.ndarray, scale: float) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = scale * Rotation.from_rotvec(turn).as_matrix(), shift
    return transform


def some_params(n: int = 6) -> dict[str, torch.Tensor]:
    return {name: value.double() for name, value in many(n).items()}


def scale_of(transform: np.ndarray) -> float:
    return float(np.cbrt(np.linalg.det(transform[:3, :3])))


@given(transform=similarities)
def test_a_moved_world_seen_from_moved_cameras_is_the_same_picture(transform: np.ndarray) -> None:
    viewmats, (points, _) = ring(3), cloud()
    scale = scale_of(transform)
    moved, at = transform_viewmats(transform, viewmats), transform_points(transform, points)
    for before, after in zip(viewmats, moved, strict=True):
        R = after[:3, :3]
        assert np.abs(R @ R.T - np.eye(3)).max() < 1e-12
        assert np.linalg.det(R) > 0.0
        assert after[3].tolist() == [0.0, 0.0, 0.0, 1.0]
        seen_before = points @ before[:3, :3].T + before[:3, 3]
        seen_after = at @ R.T + after[:3, 3]
        assert np.allclose(seen_after, scale * seen_before, atol=1e-9 * scale)


def test_the_normalised_world_has_its_principal_axes_along_x_y_z_at_the_median() -> None:
    viewmats, (points, _) = ring(8), cloud(200)
    moved = similarity(np.array([0.4, 1.0, -0.3]), np.array([5.0, 2.0, -1.0]), 3.0)
    viewmats, points = transform_viewmats(moved, viewmats), transform_points(moved, points)
    transform = normalizing_transform(viewmats, points)
    normal = transform_points(transform, points)
    covariance = np.cov(normal, rowvar=False)
    assert np.allclose(covariance, np.diag(np.diag(covariance)), atol=1e-12)
    assert np.all(np.diff(np.diag(covariance)) < 0.0)
    # more points towards the bottom: at most half of them lie above the mean height
    assert np.median(normal[:, 2]) <= np.mean(normal[:, 2]) + 1e-12


def test_distances_are_measured_in_median_camera_distances_from_where_they_look() -> None:
    viewmats = np.stack([look_at((d * np.cos(a), d * np.sin(a), 0.0)) for a, d in ((0.0, 2.0), (2.0, 4.0), (4.0, 9.0))])
    transform = normalizing_transform(viewmats, None)
    assert scale_of(transform) == pytest.approx(1.0 / 4.0)
    assert np.allclose(transform_points(transform, np.zeros((1, 3))), 0.0)
    # without points only the cameras decide: up is -y, and camera z stays in the plane
    assert np.allclose(transform[:3, :3] @ [0.0, 0.0, 4.0], [0.0, -1.0, 0.0])
    turning = np.stack([look_at((1.0, 0.0, 0.0), (0.0, np.sin(a), 0.1)) for a in np.linspace(-1.0, 1.0, 5)])
    assert_one_line(lambda: normalizing_transform(turning, None), "one place")


@given(exponent=st.integers(-6, 6))
def test_the_units_of_a_capture_do_not_matter(exponent: int) -> None:
    viewmats, (points, _) = ring(5), cloud(50)
    scaled = np.diag([2.0**exponent] * 3 + [1.0])
    seen = [(viewmats, points), (transform_viewmats(scaled, viewmats), transform_points(scaled, points))]
    one, other = (transform_points(normalizing_transform(v, p), p) for v, p in seen)
    assert np.allclose(one, other, atol=1e-10)


def test_a_capture_in_coordinates_of_a_map_is_normalised_as_near_its_origin() -> None:
    viewmats, (points, _) = ring(8), cloud(200)
    there = similarity(np.zeros(3), np.array([5e5, 5.4e6, 300.0]), 1.0)
    far = normalizing_transform(transform_viewmats(there, viewmats), transform_points(there, points)) @ there
    near = normalizing_transform(viewmats, points)
    assert scale_of(far) == pytest.approx(scale_of(near), rel=0.1)
    assert np.allclose(transform_points(far, points), transform_points(near, points), atol=0.1)


def test_cameras_whose_up_is_plus_y_are_turned_half_round_without_a_mirror() -> None:
    world = similarity(np.array([-np.pi / 2, 0.0, 0.0]), np.zeros(3), 1.0)
    viewmats = transform_viewmats(world, ring(4))
    down = viewmats[:, 1, :3].mean(axis=0)
    assert np.allclose(down / np.linalg.norm(down), [0, -1, 0])
    transform = normalizing_transform(viewmats, None)
    assert np.allclose(transform[:3, :3] @ [0.0, 1.0, 0.0] / scale_of(transform), [0, -1, 0])
    assert np.linalg.det(transform[:3, :3]) > 0.0


def test_a_capture_remembers_how_it_was_normalised(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    own, normal = raw(root), load_capture(root)
    assert np.allclose(transform_points(normal.world_transform, own.points), normal.points)
    before, after = (np.stack([view.viewmat for view in capture.views]) for capture in (own, normal))
    assert np.allclose(transform_viewmats(normal.world_transform, before), after)
    assert normal.scene_scale() == pytest.approx(own.scene_scale() * normal.world_scale)
    centers = own.camera_centers
    assert own.scene_scale() == pytest.approx(1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


@given(transform=similarities, direction=hnp.arrays(np.float64, 3, elements=unit))
def test_a_moved_splat_looks_the_same_from_a_moved_camera(transform: np.ndarray, direction: np.ndarray) -> None:
    if np.linalg.norm(direction) < 1e-3:
        direction = np.array([0.0, 0.0, 1.0])
    params = some_params()
    moved = apply_similarity(params, transform)
    linear = torch.from_numpy(np.ascontiguousarray(transform[:3, :3]))
    scale = scale_of(transform)
    assert torch.allclose(moved["means"], params["means"] @ linear.T + torch.from_numpy(transform[:3, 3].copy()))
    assert torch.equal(moved["opacities"], params["opacities"])
    before = covars_from_quats_scales(params["quats"], params["scales"].exp())
    after = covars_from_quats_scales(moved["quats"], moved["scales"].exp())
    assert torch.allclose(after, linear @ before @ linear.T, rtol=1e-9, atol=1e-9)
    seen = torch.from_numpy(direction).expand(6, 3)
    colors = colors_from_sh(torch.cat([params["sh0"], params["shN"]], dim=1), seen, 3)
    turned = colors_from_sh(torch.cat([moved["sh0"], moved["shN"]], dim=1), seen @ linear.T / scale, 3)
    assert torch.allclose(colors, turned, atol=1e-12)
    back = to_capture_frame(moved, transform)
    for name in ("means", "scales", "opacities", "sh0", "shN"):
        assert torch.allclose(back[name], params[name], atol=1e-9), name
    signs = torch.sign((back["quats"] * params["quats"]).sum(dim=1, keepdim=True))
    assert torch.allclose(back["quats"] * signs, params["quats"], atol=1e-9)


@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_lower_degrees_are_turned_too_and_every_band_keeps_its_energy(bands: int) -> None:
    sh = torch.randn(4, bands + 1, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    rotation = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    turned = rotate_sh(sh, rotation)
    degree = int((bands + 1) ** 0.5) - 1
    direction = torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64)
    before = sh_basis(direction, degree) @ sh
    after = sh_basis(direction @ torch.from_numpy(rotation.T.copy()), degree) @ turned
    assert torch.allclose(before, after, atol=1e-13)
    for band in range(degree + 1):
        rows = slice(band**2, (band + 1) ** 2)
        assert torch.allclose(sh[:, rows].norm(dim=1), turned[:, rows].norm(dim=1), atol=1e-13)


def test_dtypes_are_kept_and_the_original_is_not_touched() -> None:
    params = {name: value.to(torch.float32) for name, value in some_params().items()}
    copies = {name: value.clone() for name, value in params.items()}
    moved = apply_similarity(params, similarity(np.ones(3), np.ones(3), 2.0))
    assert all(moved[name].dtype == torch.float32 for name in params)
    assert all(torch.equal(params[name], copies[name]) for name in params)


@pytest.mark.parametrize(
    "matrix", [np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.0, 2.0, 1.0, 1.0]), np.eye(3), np.full((4, 4), np.nan)]
)
def test_what_is_no_similarity_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(PopError, match="similarity"):
        apply_similarity(some_params(), matrix)
