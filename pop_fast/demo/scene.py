"""The demo's still life: toys on a round paved terrace in a meadow, under a hazy sky. Made from a seed.

It has what a real capture has: fine texture (paving, grass, wood, sprinkles), smooth surfaces (a ruby ball, the sky),
thin poles, objects in front of each other, highlights that move with the camera, soft shadows. None of it is a
Gaussian.

Rays and points are structures of arrays, float32 [3, M], so that every coordinate is contiguous. Every shape stands in
its own frame, upright on z: `local = turn^T (world - center)`, where `turn` rotates about z.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

_TERRACE = 2.7


@dataclass(frozen=True, eq=False)
class DemoScene:
    """Objects on a ground at z = 0, and the light."""

    shapes: tuple[Shape, ...]  # what stands on the ground
    ground: Paint  # albedo of the ground; normals are passed but not looked at
    sun: np.ndarray  # unit vector towards the middle of the sun. float32 [3]


class _Noise:
    """A tile of smooth noise in [0, 1], 1024 x 1024, repeated without seams; spectrum 1 / frequency^power."""

    def __init__(self, generator: np.random.Generator, power: float) -> None:
        n = 1024
        fy, fx = np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None, :]
        frequency = np.hypot(fx, fy)
        frequency[0, 0] = 1.0
        spectrum = np.fft.rfft2(generator.standard_normal((n, n))) * frequency**-power
        spectrum[0, 0] = 0.0
        tile = np.fft.irfft2(spectrum, s=(n, n))
        self.tile = np.clip(0.5 + 0.25 * tile / tile.std(), 0.0, 1.0).astype(np.float32)

    def __call__(self, u: np.ndarray, v: np.ndarray, period: float = 1.0) -> np.ndarray:
        """Look the noise up at points of a plane; it repeats after `period`."""
        scale = np.float32(1024.0 / period)
        return self.tile[(v * scale).astype(np.int32) & 1023, (u * scale).astype(np.int32) & 1023]


def _rgb(code: str) -> np.ndarray:
    """Turn a web colour into linear light. float32 [3, 1]"""
    srgb = np.array([int(code[i : i + 2], 16) for i in (0, 2, 4)]) / 255.0
    return (srgb**2.2).astype(np.float32)[:, None]


def _mix(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return a + (b - a) * weight


def _step(x: np.ndarray, edge: float, width: float) -> np.ndarray:
    """Rise smoothly from 0 to 1 across edge +- width / 2."""
    s = np.clip((x - np.float32(edge)) / np.float32(width) + 0.5, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


def _plain(color: str, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    return np.broadcast_to(_rgb(color), p.shape)


def _ground(stone: _Noise, grass: _Noise, hues: np.ndarray, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Rings of paving stones with joints, a mosaic border, grass beyond."""
    radius, angle = np.hypot(p[0], p[1]), np.arctan2(p[1], p[0]) / np.float32(2.0 * np.pi) + np.float32(0.5)
    ring = np.floor(radius / 0.3)
    count = np.floor(5.0 + 6.0 * ring)
    place = angle * count + 0.37 * ring
    stone_id = (np.floor(place) + 131.0 * ring).astype(np.int32) % len(hues)
    across, inwards = place - np.floor(place), radius / 0.3 - ring
    edge = np.minimum(
        0.3 * np.minimum(inwards, 1.0 - inwards), 2.0 * np.pi * radius / count * np.minimum(across, 1.0 - across)
    )
    grain = stone(p[0], p[1], 1.7)
    paving = hues[stone_id].T * (0.55 + 0.9 * grain)
    paving = _mix(_rgb("6b6459"), paving, _step(edge, 0.012, 0.012))
    wedge = angle * 72.0
    slant = np.abs(2.0 * (wedge - np.floor(wedge)) - 1.0)
    border = _mix(_rgb("f1ead8"), _rgb("23567f"), _step(slant - (radius - 2.42) / 0.28, 0.0, 0.05))
    on_border = _step(radius, 2.42, 0.01) * (1.0 - _step(radius, _TERRACE, 0.01))
    blades, patches = grass(p[0], p[1], 1.1), stone(p[1], p[0], 9.0)
    meadow = _mix(_rgb("3f6d25"), _rgb("a3b54a"), np.clip(0.9 * blades + 0.8 * patches - 0.45, 0.0, 1.0))
    meadow = meadow * (0.55 + 0.8 * blades)
    return _mix(_mix(paving, border, on_border), meadow, _step(radius, _TERRACE, 0.02))


def _beach_ball(p: np.ndarray, n: np.ndarray) -> np.ndarray:
    sector = np.floor((np.arctan2(n[1], n[2]) / (2.0 * np.pi) + 0.5) * 6.0).astype(np.int32) % 6
    colors = np.concatenate([_rgb(c) for c in ("f7f4ea", "d9352c", "f7f4ea", "f2b821", "f7f4ea", "2272c3")], axis=1)
    return _mix(colors[:, sector], _rgb("f7f4ea"), _step(np.abs(n[0]), 0.95, 0.02))


def _planet(noise: _Noise, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    longitude = np.arctan2(n[1], n[0]) / np.float32(2.0 * np.pi)
    height = n[2] + 0.22 * (noise(longitude * 2.0, 0.35 * n[2], 1.0) - 0.5)
    band = 0.5 + 0.5 * np.sin(14.0 * height)
    swirl = noise(longitude * 2.0 + 0.5, n[2] * 0.9, 1.0)
    color = _mix(_rgb("8c3f1d"), _rgb("f6dfb4"), band)
    color = _mix(color, _rgb("2f8f8a"), 1.0 - _step(np.abs(n[2] - 0.32), 0.09, 0.03))
    return color * (0.75 + 0.5 * swirl)


def _marble(noise: _Noise, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    turn = np.arctan2(p[1], p[0]) / np.float32(2.0 * np.pi)
    veins = np.abs(np.sin(9.0 * p[2] + 5.0 * turn + 9.0 * noise(turn, p[2], 1.0)))
    flutes = 0.80 + 0.20 * np.abs(np.sin(np.float32(24.0 * np.pi) * turn))
    return _mix(_rgb("4f6f62"), _rgb("f3efe6"), np.sqrt(veins)) * flutes


def _crate(noise: _Noise, size: float, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    flat = np.abs(n[2]) > 0.5
    u = np.where(np.abs(n[0]) > 0.5, p[1], p[0]) / size + 0.5
    v = np.where(flat, p[1] / size + 0.5, p[2] / size)
    framed = np.minimum(np.minimum(u, 1.0 - u), np.minimum(v, 1.0 - v)) < 0.13
    board = v * 5.0
    gap = np.minimum(board - np.floor(board), 1.0 - (board - np.floor(board)))
    grain = noise(u * 0.12 + 0.31 * np.floor(board), v * 1.5, 1.0)
    wood = _mix(_rgb("8a5a2b"), _rgb("d9a866"), grain)
    wood = wood * np.where(framed, 1.12, 0.85 * (0.35 + 0.65 * _step(gap, 0.04, 0.04)))
    joint = np.abs(np.minimum(np.minimum(u, 1.0 - u), np.minimum(v, 1.0 - v)) - 0.13) < 0.008
    return wood * np.where(joint, 0.35, 1.0)


def _die(face: str, pip: str, size: float, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    layouts = ([(0, 0)], [(-1, -1), (1, 1)], [(-1, -1), (0, 0), (1, 1)], [(-1, -1), (-1, 1), (1, -1), (1, 1)])
    five = [*layouts[3], (0, 0)]
    six = [*layouts[3], (-1, 0), (1, 0)]
    faces = (layouts[0], six, layouts[1], five, layouts[2], layouts[3])
    sides = {(axis, sign): faces[2 * axis + (sign < 0)] for axis in range(3) for sign in (1, -1)}
    q = (p - np.array([[0.0], [0.0], [0.5 * size]], np.float32)) / np.float32(size)
    nearest = np.full(p.shape[1], 1.0, np.float32)
    for (axis, sign), pips in sides.items():
        here = n[axis] * sign > 0.5
        u, v = q[(axis + 1) % 3], q[(axis + 2) % 3]
        for x, y in pips:
            nearest = np.where(here, np.minimum(nearest, np.hypot(u - 0.27 * x, v - 0.27 * y)), nearest)
    return _mix(_rgb(pip), _rgb(face), _step(nearest, 0.1, 0.03))


def _donut(spots: np.ndarray, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Dough below, icing with a wavy rim above, sprinkles on the icing."""
    angle = np.arctan2(p[1], p[0])
    rim = 0.10 * np.sin(7.0 * angle) + 0.06 * np.sin(11.0 * angle + 1.0)
    u = np.floor((angle / (2.0 * np.pi) + 0.5) * 64.0).astype(np.int32) % 64
    around = np.arctan2(n[2], n[0] * np.cos(angle) + n[1] * np.sin(angle))
    v = np.floor((around / (2.0 * np.pi) + 0.5) * 30.0).astype(np.int32) % 30
    sugar = spots[:, v, u]
    icing = np.where(sugar[0] < 0.0, _rgb("ee86b0"), sugar)
    return _mix(_rgb("b9773a"), icing, _step(n[2] - rim, 0.05, 0.06))


def _bands(first: str, second: str, width: float, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    stripe = np.abs((p[2] / width) % 2.0 - 1.0)
    return _mix(_rgb(first), _rgb(second), _step(stripe, 0.5, 0.06))


def _checkers(first: str, second: str, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    turn = np.floor(np.arctan2(p[1], p[0]) / np.float32(2.0 * np.pi) * 12.0)
    odd = (turn + np.floor(p[2] / 0.125)) % 2.0
    ring = np.floor(np.hypot(p[0], p[1]) / 0.055) % 2.0
    return _mix(_rgb(first), _rgb(second), np.where(np.abs(n[2]) > 0.5, ring, odd))


def _sprinkles(generator: np.random.Generator) -> np.ndarray:
    """Colours on a grid round the donut, negative where there is none. float32 [3, 30, 64]"""
    colors = np.concatenate([_rgb(c) for c in ("fff7d6", "3f7fd0", "f4c430", "57b356", "ffffff")], axis=1)
    grid = colors[:, generator.integers(0, 5, (30, 64))]
    return np.where(generator.random((30, 64)) < 0.22, grid, np.float32(-1.0))


def make_scene(seed: int) -> DemoScene:
    """Set the scene: the same seed gives the same scene, another one other textures, turns and places."""
    generator = np.random.default_rng([seed, 1])
    clouds, fine = _Noise(generator, 1.6), _Noise(generator, 0.9)
    palette = np.concatenate([_rgb(c) for c in ("c9a27e", "b58463", "d8c3a0", "a9a49b", "bd9f8a")], axis=1).T
    hues = palette[generator.integers(0, len(palette), 1024)] * generator.uniform(0.8, 1.15, (1024, 1))
    spots = _sprinkles(generator)

    def at(x: float, y: float, z: float = 0.0, spread: float = 0.04) -> tuple[float, float, float]:
        dx, dy = generator.uniform(-spread, spread, 2)
        return (x + float(dx), y + float(dy), z)

    def turn() -> float:
        return float(generator.uniform(0.0, 2.0 * np.pi))

    drum = at(0.95, 0.85)
    crate = at(-1.05, 0.62)
    cone = at(-0.72, -1.12)
    tilt = turn()
    poles = [at(-1.42, -0.28), at(0.18, -1.45), at(1.5, 0.12)]
    white_die, stripes = partial(_die, "f4f1ea", "1c1c22", 0.26), partial(_bands, "f06a1d", "f7f3ec", 0.2)
    things = [
        Frustum((0.0, 0.0, 0.0), partial(_marble, clouds), bottom=0.36, top=0.33, height=0.72, specular=0.15),
        Frustum((0.0, 0.0, 0.72), partial(_plain, "e9e2d2"), bottom=0.44, top=0.47, height=0.09),
        Ball((0.0, 0.0, 1.19), partial(_planet, clouds), turn(), 0.5, 60.0, 0.06, radius=0.38),
        Ball(at(1.12, -0.62, 0.36), _beach_ball, turn(), 0.35, 40.0, 0.03, radius=0.36),
        Box(crate, partial(_crate, clouds, 0.62), tilt, size=(0.62, 0.62, 0.62)),
        Box((crate[0], crate[1], 0.62), white_die, turn(), 0.3, 50.0, size=(0.26, 0.26, 0.26)),
        Box(at(-0.32, -0.72), partial(_die, "b8232b", "f6f2e8", 0.3), turn(), 0.3, 50.0, size=(0.3, 0.3, 0.3)),
        Torus(at(0.15, 1.22, 0.15), partial(_donut, spots), turn(), 0.25, 30.0, ring=0.33, tube=0.15),
        Box(cone, partial(_plain, "2c2b2b"), turn(), size=(0.46, 0.46, 0.05)),
        Frustum((cone[0], cone[1], 0.05), stripes, bottom=0.18, top=0.035, height=0.58),
        Frustum(drum, partial(_checkers, "1f2f5c", "f0c644"), turn(), bottom=0.25, top=0.25, height=0.5),
        Ball((drum[0], drum[1], 0.69), partial(_plain, "a3122a"), 0.0, 0.9, 120.0, 0.08, radius=0.19),
        Ball(at(-1.28, 1.25, 0.24), partial(_plain, "8d979f"), 0.0, 0.6, 80.0, 0.35, radius=0.24),
        Ball(at(0.62, -1.08, 0.13), partial(_plain, "2f9e6e"), 0.0, 0.6, 90.0, 0.06, radius=0.13),
    ]
    shapes: list[Shape] = [*things]
    for pole, color in zip(poles, ("f2c230", "3f8fd6", "e85d75"), strict=True):
        shapes.append(Frustum(pole, partial(_bands, "f4f1ea", color, 0.12), bottom=0.022, top=0.022, height=1.05))
        shapes.append(Ball((pole[0], pole[1], 1.12), partial(_plain, color), 0.0, 0.6, 80.0, 0.05, radius=0.09))
    sun = np.array([0.52, -0.38, 0.77], np.float32)
    return DemoScene(tuple(shapes), partial(_ground, clouds, fine, hues.astype(np.float32)), sun / np.linalg.norm(sun))


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
    """A solid with a surface."""

    center: tuple[float, float, float]  # of the shape's own frame in the world. [3]
    paint: Paint  # albedo
    yaw: float = 0.0  # rotation about z, radians
    specular: float = 0.1  # strength of the highlight of the sun
    gloss: float = 20.0  # its exponent
    mirror: float = 0.0  # reflectance of the sky at normal incidence
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
