"""The demo capture: an ordinary COLMAP capture of a scene that is not made of Gaussians, from a seed."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from pop_fast.demo import make_demo
from pop_fast.demo.make import first_hits, render_view
from pop_fast.demo.scene import Ball, Box, Frustum, Shape, Torus, make_scene
from tests.app.captures import assert_one_line, look_at, raw
from tests.app.conftest import Pop
from tests.app.damage import contents

SMALL = {"views": 8, "width": 64, "height": 48}


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_demo(tmp_path_factory.mktemp("demo") / "capture", **SMALL)


def all_bytes(folder: Path) -> dict[str, bytes]:
    return {file.relative_to(folder).as_posix(): data for file, data in contents(folder).items()}


def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_scene(demo: Path, tmp_path: Path) -> None:
    first = all_bytes(demo)
    assert first == all_bytes(make_demo(tmp_path / "again", **SMALL))
    other = all_bytes(make_demo(tmp_path / "other", seed=1, **SMALL))
    assert first.keys() == other.keys()
    assert all(first[name] != other[name] for name in first if name.startswith("images/"))


def test_it_is_an_ordinary_colmap_capture(demo: Path) -> None:
    names = {f"images/view_{i:03d}.png" for i in range(8)}
    assert names | {f"sparse/0/{name}.bin" for name in ("cameras", "images", "points3D")} <= all_bytes(demo).keys()
    model = pycolmap.Reconstruction(demo / "sparse" / "0")
    assert model.is_valid()
    assert model.num_reg_images() == 8
    assert model.num_points3D() > 100
    assert model.compute_mean_track_length() >= 3.0
    assert 0.2 < model.compute_mean_reprojection_error() < 1.0
    # points lie where the photographs show their colours, and not where a mirror would
    photographs = {view.name: view.image.astype(float) for view in raw(demo).views}
    here, mirrored = [], []
    for image in model.images.values():
        photo = photographs[image.name]
        for point in image.get_observation_points2D():
            column, row = point.xy.astype(int)
            color = model.points3D[point.point3D_id].color.astype(float)
            here.append(nearest(photo, row, column, color))
            mirrored.append(nearest(photo, row, photo.shape[1] - 1 - column, color))
    assert np.median(here) < 6.0
    assert np.median(here) < 0.4 * np.median(mirrored)


def nearest(image: np.ndarray, row: int, column: int, color: np.ndarray) -> float:
    """The error of the nearest of nine pixels: points are noisy, and lie on edges more often than not."""
    around = image[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    return float(np.abs(around - color).mean(axis=-1).min())


def test_every_eighth_view_holds_out_both_heights(tmp_path: Path) -> None:
    views = raw(make_demo(tmp_path / "d", views=16, width=16, height=16)).views
    heights = [view.camera_center[2] for view in views]
    assert max(heights[:8]) < min(heights[8:])
    assert {view.name for view in views[::8]} == {"view_000.png", "view_008.png"}


def test_pictures_are_well_exposed_sharp_and_different(demo: Path) -> None:
    stack = np.stack([view.image for view in raw(demo).views]).astype(float)
    assert 90.0 < stack.mean() < 170.0
    assert (stack >= 255.0).all(axis=-1).mean() < 0.02
    assert (stack <= 2.0).all(axis=-1).mean() < 0.02
    assert stack.std(axis=(1, 2)).min() > 15.0
    # colourful: channels differ
    assert np.abs(stack[..., 0] - stack[..., 2]).mean() > 15.0
    assert np.abs(np.diff(stack, axis=0)).mean(axis=(1, 2, 3)).min() > 10.0


def test_brightness_changes_with_the_viewing_direction_somewhere() -> None:
    scene, K = make_scene(0), np.array([[200.0, 0.0, 32.0], [0.0, 200.0, 24.0], [0.0, 0.0, 1.0]])
    top = np.array([0.0, 0.0, 1.57])
    colors = []
    for azimuth in (-0.8, 2.3):
        viewmat = look_at(np.add(top, (2.0 * np.cos(azimuth), 2.0 * np.sin(azimuth), 1.6)), top)
        colors.append(render_view(scene, viewmat, K, 64, 48)[24, 32].astype(float))
    assert np.abs(colors[0] - colors[1]).max() > 8.0


def test_an_existing_folder_is_replaced_only_on_request(tmp_path: Path) -> None:
    target, tiny = tmp_path / "demo", {"views": 4, "width": 16, "height": 16}
    make_demo(target, **tiny)
    before = (target / "images").stat().st_mtime_ns
    assert_one_line(lambda: make_demo(target, **tiny), str(target), "--overwrite")
    make_demo(target, overwrite=True, **tiny)
    assert (target / "images").stat().st_mtime_ns != before
    (target / "mine.txt").write_text("mine")
    before = contents(target)
    assert_one_line(lambda: make_demo(target, overwrite=True, **tiny), str(target), "did not write (mine.txt)")
    assert contents(target) == before


def test_the_next_command_names_a_folder_with_a_space_as_a_shell_takes_it(pop: Pop, tmp_path: Path) -> None:
    out = tmp_path / "a demo"
    last = pop.done("demo", out, "--views", "4", "--width", "16", "--height", "16").out.splitlines()[-1]
    assert shlex.split(last) == ["next:", "pop", "train", str(out), "--minutes", "2"]


@pytest.mark.parametrize("size", [{"views": 3}, {"width": 8}, {"height": 0}, {"views": 10**20}, {"width": 10**20}])
def test_too_small_or_too_large_a_demo_is_refused(tmp_path: Path, size: dict[str, int]) -> None:
    assert_one_line(lambda: make_demo(tmp_path / "d", **(SMALL | size)), "16x16")
    assert list(tmp_path.iterdir()) == []


def nothing(p: np.ndarray, n: np.ndarray) -> np.ndarray:
    return p


SHAPES: list[tuple[Shape, object]] = [
    (Ball((0.0, 0.0, 0.5), nothing, radius=0.5), lambda p: np.linalg.norm(p, axis=0) - 0.5),
    (
        Box((0.1, 0.0, 0.0), nothing, 0.7, size=(0.6, 0.4, 0.8)),
        lambda p: (np.abs(p - [[0.0], [0.0], [0.4]]) - [[0.3], [0.2], [0.4]]).max(axis=0),
    ),
    (
        Frustum((0.0, 0.1, 0.0), nothing, 0.3, bottom=0.5, top=0.2, height=0.9),
        lambda p: np.maximum(np.hypot(p[0], p[1]) - 0.5 + p[2] / 3.0, np.abs(p[2] - 0.45) - 0.45),
    ),
    (Torus((0.0, 0.0, 0.3), nothing, ring=0.5, tube=0.2), lambda p: np.hypot(np.hypot(p[0], p[1]) - 0.5, p[2]) - 0.2),
]


@pytest.mark.parametrize(("shape", "outside"), SHAPES, ids=["ball", "box", "frustum", "torus"])
@given(
    azimuth=st.floats(0.0, 6.3),
    height=st.floats(0.2, 3.0),
    aim=st.tuples(*[st.floats(-0.7, 0.7)] * 2),
    seed=st.integers(0, 9),
)
def test_rays_stop_at_the_surface_and_pass_nothing_before_it(shape: Shape, outside, azimuth, height, aim, seed) -> None:
    origin = np.array([3.0 * np.cos(azimuth), 3.0 * np.sin(azimuth), height])
    target = np.array([*aim, 0.4]) + np.random.default_rng(seed).normal(0.0, 0.1, 3)
    direction = ((target - origin) / np.linalg.norm(target - origin))[:, None]
    t = shape.distance(origin.astype(np.float32)[:, None], direction.astype(np.float32))
    walk = np.linspace(0.5, 6.0, 4000)
    gaps = outside(shape.to_local(origin[:, None] + walk * direction, True))
    nearest = gaps[1:-1][(gaps[1:-1] < gaps[:-2]) & (gaps[1:-1] <= gaps[2:])]
    assume(np.abs(nearest).min() > 1e-2)  # not a ray that grazes, there or on its way
    if np.isinf(t[0]):
        assert gaps.min() > 0.0
        return
    first = walk[np.argmax(gaps < 0.0)]
    assert gaps.min() < 0.0
    assert t[0] == pytest.approx(first, abs=6e-3)
    local = shape.to_local(origin[:, None] + t * direction, True).astype(np.float32)
    n = shape.normals(local)
    assert np.linalg.norm(n) == pytest.approx(1.0, abs=1e-4)
    assert float((shape.to_world(n) * direction).sum()) < 1e-2


def test_the_ground_and_the_sky_are_where_no_object_is() -> None:
    scene = make_scene(0)
    origin = np.array([0.0, -9.0, 1.0])
    directions = np.array([[0.0, -0.6, -0.8], [0.0, -0.6, 0.8]], np.float32).T
    t, which = first_hits(scene, origin, directions)
    assert t[0] == pytest.approx(1.25)
    assert np.isinf(t[1])
    assert which.tolist() == [-1, -1]
