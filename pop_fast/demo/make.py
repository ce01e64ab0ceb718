"""Make the demo capture: photographs of a ray-traced still life, as an ordinary COLMAP capture, without downloads.

The cameras are exact. The sparse points are what structure from motion would leave: points of visible surfaces, more of
them where the picture has texture, each with the views that see it and a little noise.

Each of a pixel's nine rays asks for the shadow of another point of the sun, so shadows are soft without noise and the
same from every camera. A picture is traced in square patches, and a patch looks only at the objects that it may meet.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pop_fast.data.cameras import require_colmap
from pop_fast.data.capture import Progress, camera_centers
from pop_fast.data.colmap import quiet_colmap
from pop_fast.demo.scene import DemoScene, Shape, dot, make_scene
from pop_fast.errors import CaptureError
from pop_fast.io.atomic import check_folder, folder_atomically
from pop_fast.io.images import in_threads, write_png

_MODEL = {f"{name}.bin" for name in ("cameras", "images", "points3D", "rigs", "frames")}
_CANDIDATES = 150  # a view
_PIXEL_NOISE = 0.4  # px, standard deviation
_SEEN_BY = 3  # views, at least
_MOST = 10_000  # views, and px of a side


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
        CaptureError: too few or too many views or pixels, or a negative seed.
    """
    if not (4 <= views <= _MOST and 16 <= min(width, height) <= max(width, height) <= _MOST):
        asked = f"the demo was asked for with {views} views of {width}x{height}"
        raise CaptureError(f"{asked}; use 4 and 16x16 or more, and {_MOST:,} of each at most")
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
        photographs = in_threads(
            lambda viewmat: render_view(scene, viewmat, K, width, height),
            list(viewmats),
            "taking photographs",
            progress,
        )
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
    depth = np.median(np.linalg.norm(points[None] - camera_centers(viewmats)[:, None], axis=-1), axis=0)
    # triangulated from m observations, a point is off by about a pixel's footprint over sqrt(m)
    footprint = _PIXEL_NOISE * depth / K[0, 0] / np.sqrt(seen.sum(axis=0))
    noisy = points + footprint[:, None] * generator.standard_normal(points.shape)
    return _Survey(noisy, rgb, seen, at + _PIXEL_NOISE * generator.standard_normal(at.shape))


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


_PATCH = 40
_GRID = 3
_SUN_RADIUS = 0.035
_SUN = np.array([2.9, 2.65, 2.2], np.float32)[:, None]
_ZENITH = np.array([0.17, 0.42, 0.98], np.float32)[:, None]
_HORIZON = np.array([0.95, 1.08, 1.20], np.float32)[:, None]
_BOUNCE = np.array([0.16, 0.14, 0.09], np.float32)[:, None]
_HAZE = 26.0
# where the ground ends, long after the haze has swallowed it
_WORLD = 1000.0
_EXPOSURE = 0.75


def render_view(scene: DemoScene, viewmat: np.ndarray, K: np.ndarray, width: int, height: int) -> np.ndarray:
    """Take a picture of size width x height px with a camera, world -> camera. uint8 [height, width, 3], gamma 2.2"""
    image = np.zeros((height, width, 3), np.float32)
    for top in range(0, height, _PATCH):
        for left in range(0, width, _PATCH):
            rows, columns = np.arange(top, min(top + _PATCH, height)), np.arange(left, min(left + _PATCH, width))
            image[rows[0] : rows[-1] + 1, left : columns[-1] + 1] = _patch(scene, viewmat, K, rows, columns)
    return np.rint(255.0 * image).astype(np.uint8)


def first_hits(scene: DemoScene, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find what rays from one point [3] along unit directions, float32 [3, M], meet first.

    Returns:
        Distances (infinity for the sky) float32 [M], and indices into `scene.shapes`, -1 for the ground, int64 [M].
    """
    start = origin.astype(np.float32)[:, None]
    with np.errstate(divide="ignore"):
        t = np.where(directions[2] < 0.0, -start[2] / directions[2], np.float32(np.inf)).astype(np.float32)
    t[t > _WORLD] = np.inf
    which = np.full(len(t), -1)
    for index, shape in enumerate(scene.shapes):
        if not _may_meet(shape, origin, directions):
            continue
        closer = shape.distance(start, directions)
        nearer = closer < t
        t[nearer] = closer[nearer]
        which[nearer] = index
    return t, which


def _may_meet(shape: Shape, origin: np.ndarray, directions: np.ndarray) -> bool:
    """Tell whether a shape's bounding sphere reaches into the cone around a bundle of rays."""
    axis = directions.mean(axis=1)
    axis = axis / np.linalg.norm(axis)
    spread = np.arccos(np.clip((axis[:, None] * directions).sum(axis=0).min(), -1.0, 1.0))
    away = shape.middle - origin
    distance = float(np.linalg.norm(away))
    if distance <= shape.bound:
        return True
    angle = np.arccos(np.clip(float(axis @ away) / distance, -1.0, 1.0))
    return bool(angle < spread + np.arcsin(shape.bound / distance) + 1e-3)


def _patch(scene: DemoScene, viewmat: np.ndarray, K: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Trace a patch with _GRID^2 rays a pixel and average what the eye would see. float32 [h, w, 3] in [0, 1]"""
    sub = (np.arange(_GRID) + 0.5) / _GRID
    y, x, sy, sx = np.meshgrid(rows, columns, sub, sub, indexing="ij")
    camera = np.stack([(x + sx - K[0, 2]) / K[0, 0], (y + sy - K[1, 2]) / K[1, 1], np.ones(x.shape)]).reshape(3, -1)
    directions = viewmat[:3, :3].T @ (camera / np.linalg.norm(camera, axis=0))
    origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
    # one point of the sun a ray: the same nine in every pixel
    sample = np.broadcast_to(np.arange(_GRID * _GRID).reshape(_GRID, _GRID), x.shape).ravel()
    color = _shade(scene, origin, directions.astype(np.float32), sample)
    shown = _EXPOSURE * color
    shown = shown * (1.0 + shown / 4.0) / (1.0 + shown)
    shown = shown.reshape(3, len(rows), len(columns), _GRID * _GRID).mean(axis=-1)
    return np.clip(shown, 0.0, 1.0).transpose(1, 2, 0) ** np.float32(1.0 / 2.2)


def _sky(directions: np.ndarray) -> np.ndarray:
    height = np.clip(directions[2], 0.0, 1.0)
    return _HORIZON + (_ZENITH - _HORIZON) * np.sqrt(height)


def _shade(scene: DemoScene, origin: np.ndarray, directions: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """Find the light that arrives along rays. float32 [3, M]"""
    t, which = first_hits(scene, origin, directions)
    color = _sky(directions)
    hit = np.flatnonzero(np.isfinite(t))
    if len(hit) == 0:
        return color
    d, which, far = directions[:, hit], which[hit], t[hit]
    points = origin.astype(np.float32)[:, None] + far * d
    normals = np.zeros_like(points)
    normals[2] = 1.0
    albedo = np.empty_like(points)
    gleam = np.zeros((3, len(hit)), np.float32)
    for index in np.unique(which):
        here = np.flatnonzero(which == index)
        if index < 0:
            albedo[:, here] = scene.ground(points[:, here], normals[:, here])
            continue
        shape = scene.shapes[index]
        local = shape.to_local(points[:, here], True)
        n = shape.normals(local)
        albedo[:, here] = shape.paint(local, n)
        normals[:, here] = shape.to_world(n)
        gleam[:, here] = np.array([[shape.specular], [shape.gloss], [shape.mirror]], np.float32)
    light = _sun_directions(scene)[:, sample[hit]]
    lit = np.clip(dot(normals, light), 0.0, 1.0)
    facing = np.flatnonzero(lit > 0.0)
    lit[facing] *= _unshadowed(scene, points[:, facing] + np.float32(2e-3) * normals[:, facing], light[:, facing])
    upwards = 0.5 + 0.5 * normals[2]
    around = (_BOUNCE + (0.5 * _ZENITH + 0.2 * _HORIZON - _BOUNCE) * upwards) * _openness(scene, points, normals, which)
    out = albedo * (_SUN * lit + around)
    out += _gleaming(d, normals, light, lit, gleam)
    haze = 1.0 - np.exp(-((far / np.float32(_HAZE)) ** 2))
    color[:, hit] = out + (_HORIZON - out) * haze
    return color


def _gleaming(d: np.ndarray, n: np.ndarray, light: np.ndarray, lit: np.ndarray, gleam: np.ndarray) -> np.ndarray:
    """Add the highlight of the sun (Blinn, Phong) and the mirrored sky (Schlick). float32 [3, M]"""
    glossy = np.flatnonzero(gleam[0] > 0.0)
    out = np.zeros_like(d)
    if len(glossy) == 0:
        return out
    d, n, light, (specular, gloss, mirror) = d[:, glossy], n[:, glossy], light[:, glossy], gleam[:, glossy]
    half = light - d
    half /= np.sqrt(dot(half, half))
    cosine = np.clip(-dot(n, d), 0.0, 1.0)
    shine = specular * np.clip(dot(n, half), 0.0, 1.0) ** gloss * (lit[glossy] > 0.0)
    mirrored = d + 2.0 * cosine * n
    fresnel = mirror + (1.0 - mirror) * (1.0 - cosine) ** 5 * (mirror > 0.0)
    seen = np.where(mirrored[2] > 0.0, _sky(mirrored), _BOUNCE * 2.0)
    out[:, glossy] = _SUN * shine + fresnel * seen
    return out


def _sun_directions(scene: DemoScene) -> np.ndarray:
    """Nine points of the sun's disc. float32 [3, 9]"""
    side = np.cross(scene.sun, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, scene.sun)
    turn = 2.0 * np.pi * 0.381966 * np.arange(_GRID * _GRID)
    radius = _SUN_RADIUS * np.sqrt((np.arange(_GRID * _GRID) + 0.5) / _GRID**2)
    points = scene.sun[:, None] + radius * (side[:, None] * np.cos(turn) + up[:, None] * np.sin(turn))
    return (points / np.linalg.norm(points, axis=0)).astype(np.float32)


def _unshadowed(scene: DemoScene, points: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Tell which points see their point of the sun. bool [M]"""
    clear = np.ones(points.shape[1], bool)
    if len(clear) == 0:
        return clear
    middle = points.mean(axis=1)
    spread = float(np.sqrt(((points - middle[:, None]) ** 2).sum(axis=0).max()))
    for shape in scene.shapes:
        away = shape.middle - middle
        along = float(away @ scene.sun)
        aside = float(np.linalg.norm(away - along * scene.sun))
        margin = shape.bound + spread + _SUN_RADIUS * (max(along, 0.0) + spread)
        if aside > margin or along < -margin:
            continue
        open_still = np.flatnonzero(clear)
        blocked = np.isfinite(shape.distance(points[:, open_still], light[:, open_still]))
        clear[open_still[blocked]] = False
    return clear


def _openness(scene: DemoScene, points: np.ndarray, normals: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Estimate how much of the sky a point sees: every object hides what a ball of its size would. float32 [M]"""
    open_sky = np.ones(points.shape[1], np.float32)
    middle = points.mean(axis=1)
    spread = float(np.sqrt(((points - middle[:, None]) ** 2).sum(axis=0).max()))
    for index, shape in enumerate(scene.shapes):
        radius = 0.8 * shape.bound
        if np.linalg.norm(shape.middle - middle) - spread > 5.0 * radius:
            continue
        away = shape.middle.astype(np.float32)[:, None] - points
        squared = np.maximum(dot(away, away), np.float32(radius**2))
        cosine = np.clip(dot(away, normals) / np.sqrt(squared), 0.0, 1.0)
        hidden = cosine * np.float32(radius**2) / squared
        open_sky *= np.where(which == index, 1.0, 1.0 - 0.85 * hidden)
    return open_sky
