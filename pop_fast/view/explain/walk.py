"""The oracle at one pixel of a large scene: it is asked about the few Gaussians that can reach the pixel's tile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pop_fast.view.explain.scene import TILE_SIZE, ExplainedView
from pop_ref.alpha import alpha_from_sigma, falloff, sigma_at_pixel
from pop_ref.constants import Profile
from pop_ref.pixel import Pixel, SplatRows, composite_pixel, rows_from_splats, stops
from pop_ref.records import Camera, Gaussians, Splats
from pop_ref.splatting import project
from pop_ref.tiles import grid_size, tile_rects

# px: extents are whole pixels and float32 may put one on the other side of a pixel's edge
_SLACK = 2.0


@dataclass(frozen=True)
class Step:
    """One entry as the walk meets it; `T` is None behind the end of the walk.

    `row` is the entry's row in the splats that were walked.
    """

    row: int
    sigma: float
    falloff: float
    alpha_raw: float
    alpha: float
    status: str
    reason: str
    T: float | None


@dataclass(frozen=True)
class Walk:
    """A pixel, its list and each entry's fate."""

    splats: Splats
    columns: SplatRows
    pixel: Pixel
    steps: tuple[Step, ...]


def candidates(info: Mapping[str, Any], x: int, y: int) -> np.ndarray:
    """List the Gaussians whose extent comes near the pixel's tile, ascending. int64 [M]"""
    means2d, radii = info["means2d"][0].double().numpy(), info["radii"][0].double().numpy()
    low = np.array([x, y]) // TILE_SIZE * TILE_SIZE - _SLACK
    reach = (means2d + radii >= low) & (means2d - radii <= low + TILE_SIZE + 2.0 * _SLACK) & (radii > 0.0)
    return np.flatnonzero(reach.all(axis=1))


def oracle_splats(scene: ExplainedView, ids: np.ndarray, profile: Profile) -> Splats:
    """Project some of the Gaussians with the oracle."""
    chosen = Gaussians(**{name: tensor[ids].numpy() for name, tensor in scene.gaussians.items()})
    view = scene.view
    camera = Camera(view.viewmat, view.K, view.width, view.height)
    return project(chosen, camera, scene.sh_degree, profile, scene.config.antialiased)


def walk(scene: ExplainedView, splats: Splats, x: int, y: int, profile: Profile) -> Walk:
    """Blend one pixel from its tile's list and note every entry's fate.

    Args:
        scene: the view.
        splats: all that can be in the pixel's tile, in index order.
        x: column of the pixel.
        y: row of the pixel.
        profile: every constant.
    """
    columns = rows_from_splats(splats)
    order = tile_list(scene, splats, x, y, profile)
    pixel = composite_pixel(order, columns, x + 0.5, y + 0.5, list(scene.config.background), profile)
    T_of = dict(zip(pixel.ids, pixel.transmittances, strict=True))
    steps: list[Step] = []
    T = 1.0
    for rank, i in enumerate(order):
        sigma = sigma_at_pixel(columns.means2d[i], columns.conics[i], x + 0.5, y + 0.5)
        alpha, skipped = alpha_from_sigma(sigma, columns.opacities[i], profile)
        G = falloff(max(sigma, 0.0))
        raw = columns.opacities[i] * G
        if rank >= pixel.n_traversed:
            status, reason = "hidden", "D7: behind the end of the walk"
        elif i in T_of:
            status, T = "blended", T_of[i]
            reason = f"D6: {raw:.5f} clamped to {profile.alpha_ceiling:g}" if raw > alpha else ""
        elif skipped:
            status = "skipped"
            reason = (
                f"D5: alpha {raw:.2g} < {profile.alpha_floor:.5f}" if sigma >= 0.0 else f"D5: sigma {sigma:.2g} < 0"
            )
        else:
            status = "stopped"
            sign = "<=" if profile.stop_inclusive else "<"
            reason = f"D7: would leave T {T * (1.0 - alpha):.2g} {sign} {profile.transmittance_stop:g}"
            assert stops(T * (1.0 - alpha), profile)
        steps.append(Step(i, sigma, G, raw, alpha, status, reason, None if status == "hidden" else T))
        if status == "blended":
            T *= 1.0 - alpha
    return Walk(splats, columns, pixel, tuple(steps))


def tile_list(scene: ExplainedView, splats: Splats, x: int, y: int, profile: Profile) -> list[int]:
    """List the rows in the pixel's tile, front to back (D3, D4)."""
    width, height = scene.view.width, scene.view.height
    rects = tile_rects(splats.means2d, splats.radii, width, height, TILE_SIZE, profile)
    tiles_x, tiles_y = grid_size(width, height, TILE_SIZE)
    column, line = x // TILE_SIZE, y // TILE_SIZE
    assert column < tiles_x
    assert line < tiles_y
    inside = (rects[:, 0] <= column) & (column < rects[:, 2]) & (rects[:, 1] <= line) & (line < rects[:, 3])
    rows = np.flatnonzero(inside)
    return rows[np.argsort(splats.depths[rows], kind="stable")].tolist()
