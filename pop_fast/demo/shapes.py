"""Rays against spheres, boxes, frusta and tori, in NumPy, many rays at once.

Rays and points are structures of arrays, float32 [3, M], so that every coordinate is contiguous. Every shape stands in
its own frame, upright on z: `local = turn^T (world - center)`, where `turn` rotates about z.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

__all__ = ["Ball", "Box", "Frustum", "Shape", "Torus", "dot"]

_FAR = np.float32(np.inf)
_NEAR = np.float32(1e-4)
# how near to a surface a walk along a ray ends
_CLOSE = np.float32(2e-4)
# albedo of a surface from its local points and normals, linear rgb: [3, M], [3, M] -> [3, M]
Paint = Callable[[np.ndarray, np.ndarray], np.ndarray]


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products of columns. [3, M], [3, M] -> [M]"""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@dataclass(frozen=True, eq=False)
class Shape:
    """A solid with a surface.

    Attributes:
        center: of the shape's own frame in the world. [3]
        paint: albedo.
        yaw: rotation about z, radians.
        specular: strength of the highlight of the sun.
        gloss: its exponent.
        mirror: reflectance of the sky at normal incidence.
    """

    center: tuple[float, float, float]
    paint: Paint
    yaw: float = 0.0
    specular: float = 0.1
    gloss: float = 20.0
    mirror: float = 0.0
    bound: float = field(init=False, default=0.0)

    def to_local(self, vectors: np.ndarray, is_point: bool) -> np.ndarray:
        """Bring world points or directions into the shape's frame. float32 [3, M]"""
        c, s = np.float32(np.cos(self.yaw)), np.float32(np.sin(self.yaw))
        x, y, z = vectors - np.array(self.center, np.float32)[:, None] if is_point else vectors
        return np.stack([c * x + s * y, c * y - s * x, z])

    def to_world(self, directions: np.ndarray) -> np.ndarray:
        """Bring local directions into the world. float32 [3, M]"""
        c, s = np.float32(np.cos(self.yaw)), np.float32(np.sin(self.yaw))
        x, y, z = directions
        return np.stack([c * x - s * y, s * x + c * y, z])

    def distance(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Measure how far along each ray the surface is entered; infinity where it is missed. float32 [M]

        Only the rays that meet the bounding sphere are looked at closely.
        """
        away = self.middle.astype(np.float32)[:, None] - origins
        along = dot(away, directions)
        reach = along * along - dot(away, away) + np.float32(self.bound**2)
        near = np.flatnonzero((reach > 0.0) & (along > -self.bound))
        t = np.full(directions.shape[1], _FAR, np.float32)
        if len(near):
            o = origins if origins.shape[1] == 1 else origins[:, near]
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                t[near] = self.enter(self.to_local(o, True), self.to_local(directions[:, near], False))
        return t

    @property
    def middle(self) -> np.ndarray:
        """Centre of the bounding sphere, whose radius is `bound`. float64 [3]"""
        return np.array(self.center, np.float64)

    def enter(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Solve for the nearest entry at t > 1e-4 in the shape's own frame. float32 [M]"""
        raise NotImplementedError

    def normals(self, p: np.ndarray) -> np.ndarray:
        """Find the outward normals at local points of the surface. float32 [3, M]"""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class Ball(Shape):
    """A sphere about its centre."""

    radius: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "bound", self.radius)

    def enter(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        along = -dot(o, d)
        root = np.sqrt(along * along - dot(o, o) + np.float32(self.radius**2))
        t = along - root
        return np.where(t > _NEAR, t, _FAR)

    def normals(self, p: np.ndarray) -> np.ndarray:
        return p / np.float32(self.radius)


@dataclass(frozen=True, eq=False)
class Box(Shape):
    """A box that stands on its centre: |x| <= size_x / 2, |y| <= size_y / 2, 0 <= z <= size_z."""

    size: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "bound", 0.5 * float(np.linalg.norm(self.size)))

    @property
    def middle(self) -> np.ndarray:
        return np.add(self.center, (0.0, 0.0, 0.5 * self.size[2]))

    def enter(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        half = 0.5 * np.array(self.size, np.float32)[:, None]
        start = o - np.array([[0.0], [0.0], [0.5 * self.size[2]]], np.float32)
        inverse = 1.0 / d
        reach = np.abs(inverse) * half
        t_in = (-start * inverse - reach).max(axis=0)
        t_out = (-start * inverse + reach).min(axis=0)
        return np.where((t_in < t_out) & (t_in > _NEAR), t_in, _FAR)

    def normals(self, p: np.ndarray) -> np.ndarray:
        half = 0.5 * np.array(self.size, np.float32)[:, None]
        q = (p - np.array([[0.0], [0.0], [0.5 * self.size[2]]], np.float32)) / half
        axis = np.abs(q).argmax(axis=0)
        n = np.zeros_like(p)
        columns = np.arange(p.shape[1])
        n[axis, columns] = np.sign(q[axis, columns])
        return n


@dataclass(frozen=True, eq=False)
class Frustum(Shape):
    """A cylinder or truncated cone with lids: radius `bottom` at z = 0 and `top` at z = height."""

    bottom: float = 1.0
    top: float = 1.0
    height: float = 1.0

    def __post_init__(self) -> None:
        widest = max(self.bottom, self.top)
        object.__setattr__(self, "bound", float(np.hypot(widest, 0.5 * self.height)))

    @property
    def middle(self) -> np.ndarray:
        return np.add(self.center, (0.0, 0.0, 0.5 * self.height))

    @property
    def _slope(self) -> float:
        return (self.top - self.bottom) / self.height

    def enter(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        # x^2 + y^2 = (bottom + slope z)^2 along the ray
        r, dr = np.float32(self.bottom) + np.float32(self._slope) * o[2], np.float32(self._slope) * d[2]
        a = d[0] * d[0] + d[1] * d[1] - dr * dr
        b = o[0] * d[0] + o[1] * d[1] - r * dr
        c = o[0] * o[0] + o[1] * o[1] - r * r
        root = np.sqrt(b * b - a * c)
        t = (-b - root) / a
        z = o[2] + t * d[2]
        best = np.where((t > _NEAR) & (z >= 0.0) & (z <= self.height), t, _FAR)
        for level, radius in ((0.0, self.bottom), (self.height, self.top)):
            t = (np.float32(level) - o[2]) / d[2]
            x, y = o[0] + t * d[0], o[1] + t * d[1]
            best = np.where((t > _NEAR) & (t < best) & (x * x + y * y <= radius * radius), t, best)
        return best

    def normals(self, p: np.ndarray) -> np.ndarray:
        radius = np.maximum(np.hypot(p[0], p[1]), 1e-9)
        side = np.stack([p[0] / radius, p[1] / radius, np.full_like(radius, -self._slope)])
        side /= np.float32(np.hypot(1.0, self._slope))
        off_side = np.abs(radius - (self.bottom + self._slope * p[2]))
        off_lids = np.minimum(np.abs(p[2]), np.abs(p[2] - self.height))
        lid = np.stack([np.zeros_like(radius), np.zeros_like(radius), np.where(p[2] > 0.5 * self.height, 1.0, -1.0)])
        return np.where(off_lids < off_side, lid, side).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Torus(Shape):
    """A ring around z, found by walking along the ray as far as the distance to the surface allows."""

    ring: float = 1.0
    tube: float = 0.3
    steps: int = 100

    def __post_init__(self) -> None:
        object.__setattr__(self, "bound", self.ring + self.tube)

    def enter(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        along = -dot(o, d)
        chord = np.sqrt(np.maximum(along * along - dot(o, o) + np.float32(self.bound**2), 0.0))
        t = np.maximum(along - chord, _NEAR)
        leave = along + chord
        gap = self._gap(o + t * d)
        for _ in range(self.steps):
            t = t + gap
            gap = self._gap(o + t * d)
            if not np.any((np.abs(gap) > _CLOSE) & (t < leave)):
                break
        found = (np.abs(gap) < 2.0 * _CLOSE) & (t < leave) & (t > 10.0 * _NEAR)
        return np.where(found, t, _FAR)

    def _gap(self, p: np.ndarray) -> np.ndarray:
        return np.hypot(np.hypot(p[0], p[1]) - np.float32(self.ring), p[2]) - np.float32(self.tube)

    def normals(self, p: np.ndarray) -> np.ndarray:
        radius = np.maximum(np.hypot(p[0], p[1]), 1e-9)
        inward = 1.0 - np.float32(self.ring) / radius
        n = np.stack([p[0] * inward, p[1] * inward, p[2]])
        return n / np.maximum(np.sqrt(dot(n, n)), 1e-9)
