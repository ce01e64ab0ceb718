"""Trace the demo's pictures: nine rays a pixel, soft shadows, light from the sky, highlights, haze.

Each of a pixel's nine rays asks for the shadow of another point of the sun, so shadows are soft without noise and the
same from every camera. A picture is traced in square patches, and a patch looks only at the objects that it may meet.
"""

from __future__ import annotations

import numpy as np

from pop_fast.demo.scene import DemoScene
from pop_fast.demo.shapes import Shape, dot

__all__ = ["first_hits", "render_view"]

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
    """Take a picture.

    Args:
        scene: what to look at.
        viewmat: world -> camera. [4, 4]
        K: intrinsics, px. [3, 3]
        width: px.
        height: px.

    Returns:
        uint8 [height, width, 3], gamma 2.2.
    """
    image = np.zeros((height, width, 3), np.float32)
    for top in range(0, height, _PATCH):
        for left in range(0, width, _PATCH):
            rows, columns = np.arange(top, min(top + _PATCH, height)), np.arange(left, min(left + _PATCH, width))
            image[rows[0] : rows[-1] + 1, left : columns[-1] + 1] = _patch(scene, viewmat, K, rows, columns)
    return np.rint(255.0 * image).astype(np.uint8)


def first_hits(scene: DemoScene, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find what rays from one point meet first.

    Args:
        scene: what they may meet.
        origin: [3]
        directions: unit, float32 [3, M].

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
