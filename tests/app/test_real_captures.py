"""Real photographs, where they lie next to the repository: loaded whole, posed right, quickly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pop_fast.data import Capture, View, initialize_params, load_capture
from tests.app.captures import assert_one_line

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def real(name: str) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"the real capture {name} is not at {DATA}")
    return DATA / name


def pixels_of(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points appear: indices of those inside the picture, and their rows and columns. [M], [2, M]"""
    p = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    front = np.flatnonzero(p[:, 2] > 1e-3)
    x, y = (p[front] @ view.K.T)[:, :2].T / p[front, 2]
    inside = (x >= 0.0) & (x < view.width) & (y >= 0.0) & (y < view.height)
    return front[inside], np.stack([y[inside], x[inside]]).astype(int)


def color_errors(capture: Capture) -> tuple[float, float, float]:
    """Median colour error of points where they project, and where they would in a mirror and upside down."""
    errors: list[list[float]] = [[], [], []]
    for view in capture.views[::5]:
        which, (row, column) = pixels_of(view, capture.points)
        places = ((row, column), (row, view.width - 1 - column), (view.height - 1 - row, column))
        for i, (r, c) in enumerate(places):
            off = np.abs(view.image[r, c].astype(float) - capture.points_rgb[which]).mean(axis=1)
            errors[i].append(float(np.median(off)))
    here, mirrored, upended = (float(np.mean(e)) for e in errors)
    return here, mirrored, upended


CAPTURES = [
    ("fox", {"factor": 4}, 50, (270, 480), 12_174, 7),
    ("bear_512", {"factor": 2}, 96, (256, 256), 34_174, 12),
    ("m360_garden_512", {"factor": 4}, 185, (128, 128), 138_766, 24),
    ("m360_bonsai_800", {"factor": 4}, 292, (200, 133), 109_926, 37),
]


@pytest.mark.parametrize(
    ("name", "options", "views", "size", "points", "tests"), CAPTURES, ids=[c[0] for c in CAPTURES]
)
def test_a_real_capture_is_loaded_whole_and_its_points_project_onto_their_colours(
    name: str, options: dict[str, int], views: int, size: tuple[int, int], points: int, tests: int
) -> None:
    capture = load_capture(real(name), **options)
    assert len(capture.views) == views
    assert len(capture.test_views()) == tests
    assert len(capture.train_views()) == views - tests
    assert {(view.width, view.height) for view in capture.views} == {size}
    assert capture.points.shape == (points, 3)
    inside = [len(pixels_of(view, capture.points)[0]) / points for view in capture.views[::5]]
    assert np.mean(inside) > 0.3
    here, mirrored, upended = color_errors(capture)
    assert here < 0.75 * mirrored
    assert here < 0.75 * upended
    # normalised: cameras about one unit away, the points around the origin
    assert 0.5 < capture.scene_scale() < 3.0
    assert np.abs(np.median(capture.points, axis=0)).max() < 0.5
    params = initialize_params(capture)
    assert all(bool(value.isfinite().all()) for value in params.values())


def test_fox_is_loaded_from_its_listing_too_when_absent_photographs_may_be_skipped() -> None:
    root = real("fox")
    options = {"factor": 8, "source": "transforms"}
    assert_one_line(
        lambda: load_capture(root, **options),
        str(root / "transforms.json"),
        "lists 67 images, 17 of them absent",
        "images/0005.jpg",
        "--missing skip",
    )
    capture = load_capture(root, missing="skip", **options)
    assert len(capture.views) == 50
    assert capture.notes[0] == "17 of 67 listed images are absent and were skipped"
    assert "no points: 30000 random ones (seed 0)" in capture.source


def test_both_routes_to_fox_agree_on_the_cameras_up_to_a_similarity() -> None:
    root = real("fox")
    model = load_capture(root, factor=8, normalize=False)
    listing = load_capture(root, factor=8, normalize=False, source="transforms", missing="skip")
    by_name = {Path(view.name).name: view.camera_center for view in listing.views}
    a = model.camera_centers
    b = np.stack([by_name[view.name] for view in model.views])
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    assert np.linalg.det(U @ Vt) > 0.0  # no mirror between them
    scale = S.sum() / (a**2).sum()
    assert np.abs(scale * a @ (U @ Vt).T - b).max() < 0.05 * np.abs(b).max()
    assert model.views[0].K[0, 0] == pytest.approx(listing.views[0].K[0, 0], rel=0.02)
