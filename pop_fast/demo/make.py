"""Make the demo capture: photographs of a ray-traced still life, as an ordinary COLMAP capture, without downloads.

The cameras are exact. The sparse points are what structure from motion would leave: points of visible surfaces, more of
them where the picture has texture, each with the views that see it and a little noise.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pop_fast.data.capture import Progress
from pop_fast.data.colmap import quiet_colmap
from pop_fast.data.pinhole import require_colmap
from pop_fast.demo.scene import DemoScene, make_scene
from pop_fast.demo.tracer import first_hits, render_view
from pop_fast.errors import CaptureError
from pop_fast.io.atomic import check_folder, folder_atomically
from pop_fast.io.images import write_png

__all__ = ["make_demo"]

_MODEL = {f"{name}.bin" for name in ("cameras", "images", "points3D", "rigs", "frames")}
_CANDIDATES = 150  # a view
_PIXEL_NOISE = 0.4  # px, standard deviation
_SEEN_BY = 3  # views, at least


def make_demo(
    out_dir: str | Path,
    seed: int = 0,
    views: int = 60,
    width: int = 320,
    height: int = 240,
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
) -> Path:
    """Make the demo capture, whole or not at all; the same arguments give the same bytes.

    The first half of the views circles the scene low, the second half high, so that every eighth view holds out both.

    Args:
        out_dir: folder to make: `images/view_000.png` ..., `sparse/0/{cameras,images,points3D}.bin`.
        seed: of textures, places, camera jitter and noise.
        views: how many photographs, at least 4.
        width: px, at least 16.
        height: px, at least 16.
        progress: called with (stage, done, total).
        overwrite: replace an existing folder.

    Raises:
        CaptureError: too few views or pixels, or a negative seed.
    """
    if views < 4 or min(width, height) < 16:
        raise CaptureError(f"the demo was asked for with {views} views of {width}x{height}; use 4 and 16x16 or more")
    if seed < 0:
        raise CaptureError(f"seed is {seed}; it must be at least 0")
    # asked for before the minutes of tracing, not after
    require_colmap()
    out = Path(out_dir)
    check_folder(out, overwrite, recognise=_is_ours)
    scene = make_scene(seed)
    generator = np.random.default_rng([seed, 2])
    viewmats = _orbit(generator, views)
    K = np.array([[0.94 * width, 0.0, 0.503 * width], [0.0, 0.94 * width, 0.496 * height], [0.0, 0.0, 1.0]])
    with folder_atomically(out, overwrite, recognise=_is_ours) as folder:
        photographs = _photograph(scene, viewmats, K, (width, height), progress)
        (folder / "images").mkdir()
        for i, photograph in enumerate(photographs):
            write_png(folder / "images" / _name(i), photograph)
        survey = _survey(scene, viewmats, K, photographs, generator)
        (folder / "sparse" / "0").mkdir(parents=True)
        _write_model(folder / "sparse" / "0", viewmats, K, (width, height), survey)
    return out


def _is_ours(file: Path) -> bool:
    """Tell by its path whether a file of a folder is one that a demo writes."""
    return file.match("images/view_*.png") or (file.parent == Path("sparse", "0") and file.name in _MODEL)


def _name(index: int) -> str:
    return f"view_{index:03d}.png"


def _orbit(generator: np.random.Generator, views: int) -> np.ndarray:
    """Walk round the scene twice, camera in hand. float64 [views, 4, 4]"""
    low = (views + 1) // 2
    viewmats = np.tile(np.eye(4), (views, 1, 1))
    for i in range(views):
        ring, place, count = (0, i, low) if i < low else (1, i - low, views - low)
        azimuth = 2.0 * np.pi * (place + 0.5 * ring) / count + generator.normal(0.0, 0.02)
        elevation = np.radians((16.0, 37.0)[ring] + generator.normal(0.0, 1.0))
        distance = (4.2, 4.0)[ring] + generator.normal(0.0, 0.06)
        flat = np.cos(elevation)
        center = distance * np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        target = np.array([0.0, 0.0, 0.45]) + generator.normal(0.0, 0.05, 3)
        forward = (target - center) / np.linalg.norm(target - center)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        viewmats[i, :3, :3] = [right, np.cross(forward, right), forward]
        viewmats[i, :3, 3] = -viewmats[i, :3, :3] @ center
    return viewmats


def _photograph(
    scene: DemoScene, viewmats: np.ndarray, K: np.ndarray, size: tuple[int, int], progress: Progress | None
) -> list[np.ndarray]:
    photographs: list[np.ndarray] = []
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        for photograph in pool.map(lambda viewmat: render_view(scene, viewmat, K, *size), viewmats):
            photographs.append(photograph)
            if progress is not None:
                progress("taking photographs", len(photographs), len(viewmats))
    return photographs


@dataclass(frozen=True, eq=False)
class _Survey:
    """Points with noise, their colours, and where each view sees which: `seen` bool [V, P], `at` px [V, P, 2]."""

    points: np.ndarray
    rgb: np.ndarray
    seen: np.ndarray
    at: np.ndarray


def _survey(
    scene: DemoScene, viewmats: np.ndarray, K: np.ndarray, photographs: list[np.ndarray], generator: np.random.Generator
) -> _Survey:
    """Pick points of visible surfaces, find the cameras that see them, and add a matcher's noise."""
    points = np.concatenate(
        [_candidates(scene, viewmats[i], K, photograph, generator) for i, photograph in enumerate(photographs)]
    )
    at = np.stack([_project(viewmat, K, points) for viewmat in viewmats])
    height, width = photographs[0].shape[:2]
    seen = np.stack([_sees(scene, viewmat, points) for viewmat in viewmats])
    seen &= (at >= 1.0).all(axis=-1) & (at[..., 0] <= width - 1) & (at[..., 1] <= height - 1)
    # a matcher misses some of what is visible
    seen &= generator.random(seen.shape) < 0.7
    enough = seen.sum(axis=0) >= _SEEN_BY
    points, seen, at = points[enough], seen[:, enough], at[:, enough]
    total = np.zeros((len(points), 3))
    for view, photograph in enumerate(photographs):
        column, row = at[view][seen[view]].astype(int).T
        total[seen[view]] += photograph[row, column]
    rgb = np.rint(total / seen.sum(axis=0)[:, None]).astype(np.uint8)
    depth = np.median(np.linalg.norm(points[None] - _centers(viewmats)[:, None], axis=-1), axis=0)
    # triangulated from m observations, a point is off by about a pixel's footprint over sqrt(m)
    footprint = _PIXEL_NOISE * depth / K[0, 0] / np.sqrt(seen.sum(axis=0))
    noisy = points + footprint[:, None] * generator.standard_normal(points.shape)
    return _Survey(noisy, rgb, seen, at + _PIXEL_NOISE * generator.standard_normal(at.shape))


def _centers(viewmats: np.ndarray) -> np.ndarray:
    return -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])


def _project(viewmat: np.ndarray, K: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Find where points appear, px; NaN behind the camera. float64 [P, 2]"""
    p = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = np.where(p[:, 2] > 0.1, p[:, 2], np.nan)
    return (p @ K.T)[:, :2] / z[:, None]


def _candidates(
    scene: DemoScene, viewmat: np.ndarray, K: np.ndarray, photograph: np.ndarray, generator: np.random.Generator
) -> np.ndarray:
    """Draw pixels of a photograph, textured ones rather than smooth ones, and find the surfaces there. [<=M, 3]"""
    gray = photograph.mean(axis=2)
    rows, columns = np.gradient(gray)
    chance = 2.0 + np.hypot(rows, columns)
    pixels = generator.choice(gray.size, min(_CANDIDATES, gray.size), replace=False, p=(chance / chance.sum()).ravel())
    row, column = np.divmod(pixels, gray.shape[1])
    spot = np.stack([column, row]) + generator.random((2, len(pixels)))
    rays = np.linalg.inv(K) @ np.concatenate([spot, np.ones((1, len(pixels)))])
    directions = viewmat[:3, :3].T @ (rays / np.linalg.norm(rays, axis=0))
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    t, _ = first_hits(scene, center, directions.astype(np.float32))
    hit = np.isfinite(t) & (t < 30.0)
    return (center[:, None] + t[hit] * directions[:, hit]).T


def _sees(scene: DemoScene, viewmat: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Tell which points nothing hides from a camera. bool [P]"""
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    away = points - center
    distance = np.linalg.norm(away, axis=1)
    t, _ = first_hits(scene, center, (away / distance[:, None]).T.astype(np.float32))
    return np.abs(t - distance) < 2e-3 * distance


def _write_model(folder: Path, viewmats: np.ndarray, K: np.ndarray, size: tuple[int, int], survey: _Survey) -> None:
    """Write cameras, poses, points and tracks as a COLMAP model."""
    pycolmap = require_colmap()
    model = pycolmap.Reconstruction()
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=size[0], height=size[1], params=params)
    model.add_camera_with_trivial_rig(camera)
    rank = np.cumsum(survey.seen, axis=1) - 1
    for view, viewmat in enumerate(viewmats):
        image = pycolmap.Image(
            name=_name(view), keypoints=survey.at[view][survey.seen[view]], camera_id=1, image_id=view + 1
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3]))
    for point in range(len(survey.points)):
        views = np.flatnonzero(survey.seen[:, point])
        track = pycolmap.Track([pycolmap.TrackElement(int(v) + 1, int(rank[v, point])) for v in views])
        model.add_point3D(survey.points[point], track, survey.rgb[point])
    with quiet_colmap():
        model.update_point_3d_errors()
        model.write_binary(folder)
