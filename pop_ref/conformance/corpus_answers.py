"""What the oracle says of the corpus, in sums: `python -m pop_ref.conformance.corpus_answers` writes it anew.

An image is kept as weighted sums over blocks of 8 x 8 pixels and as some pixels in full, a gradient as weighted sums
over runs of rows, each beside what rounding may cost it. Pixels at which float32 could turn a decision take no part.
A test computes a part of it again.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.assertions import extent_near_threshold
from pop_ref.conformance.corpus import PLANS, corpus_scene
from pop_ref.conformance.error_bounds import REACH, PixelErrorBounds, Window, pixel_error_bounds
from pop_ref.conformance.gradient_error_bounds import Bound, error_bounds_of_sums, sums_over_pixels
from pop_ref.conformance.scenes import Scene, cotangents
from pop_ref.conformance.screen_error_bounds import screen_error_bounds

FILE: Final = Path(__file__).with_name("corpus_answers.npz")
BLOCK: Final = 8
# side of what is bounded at once, px
WINDOW: Final = 16
# this many runs of rows, or a little more
RUNS: Final = 100
MAPS: Final = ("unambiguous", "smooth", "decided")
GRADIENTS: Final = ("means", "quats", "scales", "opacities", "sh", "means2d", "means2d_abs")


def weighted_blocks(image: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Sum a map over blocks of pixels, each pixel with a weight of 1 to 16 that no neighbour shares. [blocks, D]"""
    H, W = where.shape
    y, x = np.mgrid[:H, :W]
    weight = np.where(where, 1 + (7 * x + 13 * y) % 16, 0)
    values = weight[..., None] * image.reshape(H, W, -1)
    padded = np.pad(values, ((0, -H % BLOCK), (0, -W % BLOCK), (0, 0)))
    rows, columns = padded.shape[0] // BLOCK, padded.shape[1] // BLOCK
    return padded.reshape(rows, BLOCK, columns, BLOCK, -1).sum((1, 3)).reshape(rows * columns, -1)


def weighted_runs(rows: np.ndarray) -> np.ndarray:
    """Sum a gradient over runs of consecutive rows, each row with a weight of 1 to 16. [runs, K]"""
    values = rows.reshape(len(rows), -1)
    length = max(1, len(values) // RUNS)
    weighted = values * (1 + (7 * np.arange(len(values))) % 16)[:, None]
    return np.add.reduceat(weighted, np.arange(0, len(values), length), axis=0)


def picked_pixels(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the pixels that are kept in full: the corners, and about sixty between."""
    H, W = scene.camera.height, scene.camera.width
    k = np.concatenate([[0, W - 1, (H - 1) * W, H * W - 1], (np.arange(60) * 40503) % (H * W)])
    return k // W, k % W


def bounded_windows(scene: Scene, at: Any = None) -> list[tuple[tuple[slice, slice], PixelErrorBounds]]:
    """Bound the rounding of a scene in float32, a window at a time.

    Args:
        scene: what is drawn.
        at: which of the windows; all for None.
    """
    H, W = scene.camera.height, scene.camera.width
    screen = screen_error_bounds(scene, REACH * float(np.finfo(np.float32).eps))
    # no splat is seen beyond these sigmas
    reach = scene.profile.extent_sigmas * np.sqrt(np.stack([screen.covars2d[:, k, k] for k in (0, 1)], 1)) + 1.0
    lists = OracleAdapter().full_render(scene).tile_lists if scene.profile.extent == "square" else None
    found = []
    for top, left in [(y, x) for y in range(0, H, WINDOW) for x in range(0, W, WINDOW)][at or slice(None)]:
        low, high = np.array([left, top]), np.array([min(left + WINDOW, W), min(top + WINDOW, H)])
        rows = np.all((screen.means2d + reach > low) & (screen.means2d - reach < high), axis=1)
        window = Window(left, top, int(high[0]), int(high[1]), screen, rows)
        place = (slice(top, window.bottom), slice(left, window.right))
        found.append((place, pixel_error_bounds(scene, np.float32, lists, window=window)))
    return found


def masks_of(
    windows: list[tuple[tuple[slice, slice], PixelErrorBounds]], shape: tuple[int, int]
) -> dict[str, np.ndarray]:
    """Return where no decision of an image, its gradient, its dominant splats is near its threshold. [H, W] each"""
    found = {name: np.zeros(shape, dtype=bool) for name in MAPS}
    for place, error_bounds in windows:
        for name, mask in found.items():
            mask[place] = getattr(error_bounds, name)
    return found


def image_error_bounds(
    windows: list[tuple[tuple[slice, slice], PixelErrorBounds]], shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return what rounding may cost the image and the remaining transmittance. [H, W, 3], [H, W]"""
    image, transmittance = np.zeros((*shape, 3)), np.zeros(shape)
    for place, error_bounds in windows:
        image[place], transmittance[place] = error_bounds.image + error_bounds.absolute, error_bounds.T_final + 1.0
    return image, transmittance


def unambiguous_cotangents(scene: Scene, smooth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cotangents of the image and of T_final that are zero where a decision is near its threshold."""
    v_image, v_T_final = cotangents(scene)
    return v_image * smooth[..., None], v_T_final * smooth


def answer(name: str) -> dict[str, np.ndarray]:
    """Ask the oracle about a scene of the corpus; some seconds for each.

    Raises:
        ValueError: rounding decides about a Gaussian's clamp, so that its gradient is not one number, or its extent.
    """
    scene = corpus_scene(name)
    shape = scene.camera.height, scene.camera.width
    drawn, windows = OracleAdapter().full_render(scene), bounded_windows(scene)
    screen = windows[0][1].screen
    if np.any(screen.kinked | screen.near):
        raise ValueError(f"{name}: Gaussians {np.flatnonzero(screen.kinked | screen.near).tolist()} are at a clamp")
    if scene.profile.extent == "square" and extent_near_threshold(scene, np.float32):
        raise ValueError(f"{name}: rounding decides an extent, which is part of the meaning in this profile")
    masks, (e_image, e_transmittance) = masks_of(windows, shape), image_error_bounds(windows, shape)
    at, sure = picked_pixels(scene), masks["unambiguous"]
    seen = np.concatenate([drawn.image, drawn.T_final[..., None]], axis=2)
    bounds = np.concatenate([e_image, e_transmittance[..., None]], axis=2)
    found = {key: np.packbits(mask) for key, mask in masks.items()}
    found |= {"pixels": seen[at], "e_pixels": _short(bounds[at])}
    found |= {"blocks": weighted_blocks(seen, sure), "e_blocks": _short(weighted_blocks(bounds, sure))}
    found["blended"] = weighted_blocks(drawn.n_blended, sure)
    found["winners"] = weighted_blocks(drawn.dominant_ids, masks["decided"])
    v_image, v_T_final = unambiguous_cotangents(scene, masks["smooth"])
    pulled, error_bounds = OracleAdapter().gradients(scene, v_image, v_T_final), _gradient_error_bounds(scene, windows)
    for key in GRADIENTS:
        found[f"v_{key}"], found[f"e_{key}"] = weighted_runs(pulled[key]), _short(weighted_runs(error_bounds[key]))
    for key in ("background", "viewmat"):
        found[f"v_{key}"], found[f"e_{key}"] = pulled[key], error_bounds[key]
    return found


def _short(error_bounds: np.ndarray) -> np.ndarray:
    # three digits of an error bound are enough
    return error_bounds.astype(np.float32)


def _gradient_error_bounds(
    scene: Scene, windows: list[tuple[tuple[slice, slice], PixelErrorBounds]]
) -> dict[str, np.ndarray]:
    total: dict[str, Bound] = {}
    background = np.zeros(3)
    masks = masks_of(windows, (scene.camera.height, scene.camera.width))
    v_image, v_T_final = unambiguous_cotangents(scene, masks["smooth"])
    for place, error_bounds in windows:
        rows, behind = sums_over_pixels(scene, error_bounds, v_image[place], v_T_final[place])
        total = {name: total[name] + bound if name in total else bound for name, bound in rows.items()}
        background = background + behind
    return error_bounds_of_sums(scene, windows[0][1].screen, total, background)


@functools.cache
def answers(name: str) -> dict[str, np.ndarray]:
    """Return what is kept of a scene; masks as [H, W]."""
    plan = PLANS[name]
    with np.load(FILE) as kept:
        found = {key.partition("/")[2]: kept[key] for key in kept.files if key.startswith(f"{name}/")}
    n_pixels = plan.width * plan.height
    for key in MAPS:
        found[key] = np.unpackbits(found[key])[:n_pixels].astype(bool).reshape(plan.height, plan.width)
    return found


def main() -> None:
    """Write the file."""
    kept = {f"{name}/{key}": value for name in PLANS for key, value in answer(name).items()}
    np.savez_compressed(FILE, **kept)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
