"""Scenes at scale, the same on every machine: up to 70,000 Gaussians, long lists, many tiles, tiles cut by the border.

They are made by formula, of integers and of elementwise arithmetic alone, and every number is one of float32, so that
all precisions read the same scene. What the oracle says of them is kept in a file, because the oracle would take
minutes: `python -m pop_ref.conformance.corpus` writes it anew. Of an image it has weighted sums over blocks of 8 x 8
pixels and some pixels in full, of a gradient weighted sums over runs of rows, each with what rounding may cost it.
Pixels at which float32 could turn a decision take no part. A test computes a part of it again.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.assertions import extent_near_threshold
from pop_ref.conformance.error_bounds import REACH, PixelErrorBounds, Window, pixel_error_bounds, screen_error_bounds
from pop_ref.conformance.gradient_error_bounds import Bound, error_bounds_of_sums, sums_over_pixels
from pop_ref.conformance.scenes import Scene, cotangents, in_precision
from pop_ref.constants import INRIA, PAPER, Profile
from pop_ref.records import Camera, Gaussians

# odd multipliers: i -> i M mod 2^16 visits every residue, each column of numbers in an order of its own
_MULTIPLIERS: Final = (40503, 24571, 52711, 14009, 61001, 33391, 9973, 46337, 27737, 57193, 19249, 38839)


@dataclass(frozen=True)
class Plan:
    """What a scene of the corpus is for, in numbers.

    Attributes:
        n: Gaussians.
        width, height: px.
        tile_size: px.
        sizes: least and largest standard deviation, px at their depth.
        opacities: least and largest.
        degree: of harmonics.
        turn: wxyz of the camera, of any norm.
        oblong: fy over fx.
        small: the oracle itself draws it in a second.
        profile: the constants; Inria's have the principal point in the middle and their own tiles.
        without: rows that are left out, because rounding decides their extents.
        depths: the nearest and the farthest; beyond a factor of 10 they are spread by their logarithm.
        beyond: px by which centres lie outside the image at most.
        apart: where it is not 0, rows come in pairs at one place, whose depths differ by this share.
    """

    n: int
    width: int
    height: int
    tile_size: int
    sizes: tuple[float, float]
    opacities: tuple[float, float]
    degree: int = 0
    turn: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    oblong: float = 1.0
    small: bool = False
    profile: Profile = PAPER
    without: tuple[int, ...] = ()
    depths: tuple[float, float] = (1.5, 6.0)
    beyond: float = 3.5
    apart: float = 0.0


# rows of hundreds_of_inria whose extents rounding decides
_UNCLEAR: Final = (
    *(25, 59, 64, 77, 93, 99, 111, 118, 131, 134, 147, 150, 158),
    *(159, 181, 202, 204, 220, 221, 236, 251, 252, 260, 275, 287),
)

# and of ten_thousand_in_a_tile
_DECIDED: Final = (4288, 5371, 7179, 9709)

PLANS: Final[dict[str, Plan]] = {
    "fifty": Plan(50, 33, 17, 16, (2.0, 9.0), (0.05, 0.8), 3, (3.0, 1.0, -2.0, 0.5), 1.25, small=True),
    "slanted": Plan(80, 96, 64, 16, (0.5, 9.0), (0.1, 0.95), 1, (0.5, -0.25, 0.125, 0.75), 1.125),
    "hundreds_in_a_tile": Plan(700, 33, 49, 16, (4.0, 12.0), (0.006, 0.03), 0, (2.0, 0.0, 1.0, 1.0)),
    "a_thousand_in_a_tile": Plan(1500, 33, 17, 16, (24.0, 72.0), (0.0045, 0.0075), 0, (1.0, 0.5, 0.0, 0.0)),
    "many_tiles": Plan(2000, 121, 90, 4, (0.75, 3.5), (0.05, 0.985), 2, (1.0, 2.0, 3.0, 4.0), 0.875),
    "five_thousand": Plan(5000, 200, 120, 4, (0.75, 4.0), (0.02, 0.95), 0, (5.0, -1.0, 0.5, 1.0), 1.0),
    "hundreds_of_tiles_a_splat": Plan(50, 121, 90, 4, (8.0, 30.0), (0.02, 0.9), 0, (3.0, -1.0, 1.0, 2.0), 1.0),
    "far_and_huge": Plan(
        16, 521, 37, 4, (8.0, 450.0), (0.05, 0.6), 0, (1.0, 0.25, -0.5, 0.25), 1.0, depths=(1.5, 3000.0), beyond=260.0
    ),
    "near_equal_depths": Plan(
        400, 64, 48, 16, (1.0, 4.0), (0.1, 0.8), 0, (1.0, 0.5, 0.25, -0.5), 1.0, depths=(0.5, 500.0), apart=4e-5
    ),
    "ten_thousand_in_a_tile": Plan(
        10_000, 16, 15, 16, (0.05, 0.4), (0.006, 0.03), 0, (1.0, 0.0, 1.0, 0.5), without=_DECIDED, beyond=0.25
    ),
    "seventy_thousand": Plan(70_000, 521, 259, 4, (0.2, 1.2), (0.05, 0.9), 0, (1.0, -0.25, 0.5, 0.25), beyond=1.5),
    "fifty_of_inria": Plan(
        60, 33, 17, 16, (2.0, 9.0), (0.05, 1.0), 3, (3.0, 1.0, -2.0, 0.5), 1.25, True, INRIA, (9, 10, 31, 36, 45, 46)
    ),
    "hundreds_of_inria": Plan(
        300, 89, 49, 16, (2.0, 6.0), (0.004, 0.2), 1, (2.0, 0.0, 1.0, 1.0), 1.0, False, INRIA, _UNCLEAR
    ),
}


def _column(n: int, k: int) -> np.ndarray:
    """Return n numbers in (0, 1), evenly spread and in an order that no other column has."""
    return (np.mod((np.arange(n, dtype=np.int64) + 1) * _MULTIPLIERS[k], 2**16) + 0.5) / 2**16


def _depths(plan: Plan) -> np.ndarray:
    """Return depths of which no two are so close to each other that rounding could exchange them."""
    low, high = plan.depths
    n = plan.n // 2 if plan.apart else plan.n
    place = np.mod(np.arange(n) * _stride(n), n) + 0.5
    found = low + (high - low) * place / n if high < 10.0 * low else low * (high / low) ** (place / n)
    if plan.apart:
        # of a pair the first in memory is as often the farther one
        farther = np.where(np.arange(n) % 2 == 0, plan.apart, -plan.apart)
        found = np.concatenate([found * (1.0 + farther), found])
    return found


def _places(plan: Plan, k: int) -> np.ndarray:
    """Return a column of places; those of a pair are one."""
    half = plan.n // 2
    return np.tile(_column(half, k), 2) if plan.apart else _column(plan.n, k)


def _between(low: float, high: float, share: np.ndarray) -> np.ndarray:
    return low + (high - low) * share


def corpus_scene(name: str) -> Scene:
    """Return the scene of that name in `PLANS`."""
    plan = PLANS[name]
    n, fx = plan.n, 64.0
    fy = fx * plan.oblong
    centred = plan.profile.principal_point == "centred"
    cx, cy = 0.5 * plan.width + (0.0 if centred else 1.25), 0.5 * plan.height - (0.0 if centred else 0.75)
    depths = _depths(plan)
    # a few pixels beyond the image on all sides, or many
    x = (_between(-plan.beyond, plan.width + plan.beyond, _places(plan, 0)) - cx) / fx * depths
    y = (_between(-plan.beyond, plan.height + plan.beyond, _places(plan, 1)) - cy) / fy * depths
    R, t = in_precision(_rotation(plan.turn)), np.array([0.5, -0.25, 0.75])
    moved = np.stack([x - t[0], y - t[1], depths - t[2]])
    means = in_precision(np.stack([R[0, k] * moved[0] + R[1, k] * moved[1] + R[2, k] * moved[2] for k in range(3)], 1))
    px = np.stack([_between(*plan.sizes, _column(n, k) ** 2) for k in (2, 3, 4)], 1)
    scales = in_precision(px * depths[:, None] / fx)
    # of norms from a quarter to some three
    quats = np.stack([_column(n, k) - 0.5 for k in (5, 6, 7, 8)], 1)
    length = np.sqrt(np.sum(quats * quats, axis=1, keepdims=True))
    quats = in_precision(quats / length * _between(0.25, 3.0, _column(n, 9))[:, None])
    opacities = in_precision(_between(*plan.opacities, _column(n, 10)))
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = R, t
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    camera = Camera(viewmat, K, plan.width, plan.height)
    g = Gaussians(means, quats, scales, opacities, _harmonics(n, plan.degree))
    size = None if plan.profile.extent == "square" else plan.tile_size
    scene = Scene(g, camera, (0.25, 0.5, 0.75), plan.profile, size)
    return scene.rows(np.setdiff1d(np.arange(n), plan.without)) if plan.without else scene


def _stride(n: int) -> int:
    # near n over the golden section, and without a common factor
    return next(k for k in range(int(0.618 * n), n) if np.gcd(k, n) == 1)


def _rotation(quat: tuple[float, float, float, float]) -> np.ndarray:
    w, x, y, z = quat
    s = w * w + x * x + y * y + z * z
    return (
        np.array(
            [
                [s - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), s - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), s - 2 * (x * x + y * y)],
            ]
        )
        / s
    )


def _harmonics(n: int, degree: int) -> np.ndarray:
    """Return coefficients in eighths; one Gaussian in sixteen is darker than black in one channel."""
    k = np.arange(n * (degree + 1) ** 2 * 3, dtype=np.int64)
    sh = (np.mod(k * 2654435761, 2**20) // 2**17 - 3.5).reshape(n, -1, 3) / 8.0
    sh[:, 0] = 3.0 * sh[:, 0] + 1.0
    rows = np.arange(0, n, 16)
    sh[rows, 0, rows % 3] = -3.0
    return sh


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
