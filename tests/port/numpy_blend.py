"""A renderer by somebody else, in NumPy alone: blends whole tiles at once, and leaves projecting to the oracle.

`.ci/distributions` has the kit of an installed pop-ref judge it: `Blend` obeys every law, `Forgetful` breaks one.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from pop_ref.conformance import Adapter


class Blend(Adapter):
    """Front to back over a tile's list, all pixels of the tile at a time."""

    name, dtype, profile = "a blend in NumPy", np.float64, None

    def composite(
        self, splats: Any, lists: Any, width: int, height: int, tile_size: int, background: Any, profile: Any
    ) -> Any:
        """Return the image and what is left of the light."""
        image, T_final = np.zeros((height, width, splats.colors.shape[1])), np.ones((height, width))
        columns = -(-width // tile_size)
        for tile, ids in enumerate(lists):
            top, left = tile // columns * tile_size, tile % columns * tile_size
            rows, cols = slice(top, min(top + tile_size, height)), slice(left, min(left + tile_size, width))
            py, px = np.mgrid[rows, cols] + 0.5
            T, alive, color = np.ones(px.shape), np.ones(px.shape, bool), np.zeros((*px.shape, image.shape[2]))
            for i in ids:
                dx, dy = splats.means2d[i, 0] - px, splats.means2d[i, 1] - py
                A, B, C = splats.conics[i]
                sigma = 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy
                alpha = np.minimum(profile.alpha_ceiling, splats.opacities[i] * np.exp(-sigma))
                takes = alive & (sigma >= 0.0) & (alpha >= profile.alpha_floor)
                after = T * (1.0 - alpha)
                stops = (after < profile.transmittance_stop) | (
                    profile.stop_inclusive & (after == profile.transmittance_stop)
                )
                alive &= ~(takes & stops)
                takes &= ~stops
                color += np.where(takes, T * alpha, 0.0)[..., None] * splats.colors[i]
                T = np.where(takes, after, T)
            image[rows, cols] = color + T[..., None] * background
            T_final[rows, cols] = T
        return SimpleNamespace(image=image, T_final=T_final)


class Forgetful(Blend):
    """The same, over black whatever is asked for."""

    name = "a blend that forgets the background"

    def composite(self, splats: Any, lists: Any, *rest: Any) -> Any:  # type: ignore[override]
        """Return them."""
        width, height, tile_size, background, profile = rest
        return super().composite(splats, lists, width, height, tile_size, 0.0 * background, profile)
