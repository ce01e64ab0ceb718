"""Count how many of a warp's four rows of lanes a splat of a tile's list reaches: what a branch a row could save.

    python benchmarks/row_slots.py

A tile has 16 x 8 pixels; a row of lanes holds rows k and k + 4 of them. Splats have log-normal sizes and lie anywhere,
0.1 a pixel as in the case of NOTES.md; pixels close at T <= 1e-4.
"""

from __future__ import annotations

import numpy as np

TILES, REACH = 100, 150  # tiles, and how far from one splats are made, px
DENSITY, FLOOR, CEILING, STOP = 0.1, 1.0 / 255.0, 0.999, 1e-4


def blended_tile(rng: np.random.Generator, size: float) -> np.ndarray:
    """Blend one tile: list entries visited, pixels blended, rows of lanes reached."""
    n = rng.poisson(DENSITY * (16 + 2 * REACH) * (8 + 2 * REACH))
    x, y = rng.uniform(-REACH, 16 + REACH, n), rng.uniform(-REACH, 8 + REACH, n)
    spread = (size * np.exp(0.7 * rng.standard_normal((n, 2)))) ** 2
    angle = rng.uniform(0.0, np.pi, n)
    cos, sin = np.cos(angle), np.sin(angle)
    xx = cos**2 * spread[:, 0] + sin**2 * spread[:, 1] + 0.3
    yy = sin**2 * spread[:, 0] + cos**2 * spread[:, 1] + 0.3
    xy = cos * sin * (spread[:, 0] - spread[:, 1])
    opacity = np.where(rng.random(n) < 0.5, 0.9 + 0.1 * rng.random(n), 0.3 * rng.random(n))
    column, row = np.arange(16) + 0.5, (np.arange(8) + 0.5)[:, None]
    T, found = np.ones((8, 16)), np.zeros(3)
    for i in range(n):
        dx, dy = x[i] - column, y[i] - row
        sigma = 0.5 * (yy[i] * dx**2 + xx[i] * dy**2 - 2.0 * xy[i] * dx * dy) / (xx[i] * yy[i] - xy[i] ** 2)
        alpha = np.minimum(CEILING, opacity[i] * np.exp(-sigma))
        listed = alpha >= FLOOR
        if not listed.any() or (T <= STOP).all():
            continue
        reached = listed & (T > STOP)
        rows = reached.any(1)
        T = np.where(reached, T * (1.0 - alpha), T)
        found += (1, (reached & (T > STOP)).sum(), (rows[:4] | rows[4:]).sum())
    return found


def main() -> None:
    """Print a line for every median size, px."""
    for size in (2.5, 4.0, 6.0):
        rng = np.random.default_rng(0)
        entries, blended, rows = sum(blended_tile(rng, size) for _ in range(TILES))
        print(
            f"{size} px: {entries / TILES:.0f} entries, {blended / 128 / TILES:.0f} blended, {rows / entries:.2f} rows"
        )


if __name__ == "__main__":
    main()
