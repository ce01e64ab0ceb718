"""What a pixel blends, from the definition: all alphas of its tile's list, prefix products, the first stop."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from pop_ref import Profile, Render, Splats


class Blended(NamedTuple):
    """One blended splat of one pixel."""

    id: int
    T: float
    alpha: float


def blended_at(
    splats: Splats, lists: list[list[int]], width: int, tile_size: int, x: int, y: int, profile: Profile
) -> list[Blended]:
    """List the splats that pixel (x, y) blends, front to back."""
    ids = np.array(lists[(y // tile_size) * -(-width // tile_size) + x // tile_size], dtype=np.int64)
    d = splats.means2d[ids] - [x + 0.5, y + 0.5]
    Q = splats.conics[ids]
    sigma = 0.5 * (Q[:, 0] * d[:, 0] ** 2 + Q[:, 2] * d[:, 1] ** 2) + Q[:, 1] * d[:, 0] * d[:, 1]
    alphas = np.minimum(profile.alpha_ceiling, splats.opacities[ids] * np.exp(-sigma))
    part = (sigma >= 0.0) & (alphas >= profile.alpha_floor)
    ids, alphas = ids[part], alphas[part]
    after = np.cumprod(1.0 - alphas)
    stop = profile.transmittance_stop
    ends = np.flatnonzero(after <= stop if profile.stop_inclusive else after < stop)
    n = int(ends[0]) if len(ends) else len(ids)
    before = np.concatenate([[1.0], after])[:n]
    return list(itertools.starmap(Blended, zip(ids[:n].tolist(), before.tolist(), alphas[:n].tolist(), strict=True)))


def blended_pixels(drawn: Render, tile_size: int, profile: Profile) -> dict[tuple[int, int], list[Blended]]:
    """List the blended splats of every pixel of a render, by (x, y)."""
    height, width = drawn.T_final.shape
    return {
        (x, y): blended_at(drawn.splats, drawn.tile_lists, width, tile_size, x, y, profile)
        for y in range(height)
        for x in range(width)
    }
